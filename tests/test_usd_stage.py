"""Opening stages, what is seen of them, engine world, instances, time, and what goes wrong."""

from __future__ import annotations

import math
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pxr import Gf, Usd, UsdGeom, UsdSkel, UsdUtils
from scene_reading import CUBE, drawn, read, signed_volume, stage_of, texts, to_stage

from refract_core.errors import StageError, UsageError
from refract_core.scene import Param
from refract_core.usd.stage import load_stage, open_stage, scene_from_stage, time_range

BALL = 'def Sphere "S" { double radius = 2 }'


def write(path: Path, text: str) -> Path:
    path.write_text("#usda 1.0\n" + text.replace("{", "{\n").replace("}", "\n}\n"), encoding="utf-8")
    return path


# --- opening --------------------------------------------------------------------------------------------------------


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(StageError, match=r"nothing\.usda: there is no such file"):
        load_stage(tmp_path / "nothing.usda")


def test_a_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(StageError, match="is a folder"):
        load_stage(tmp_path)


@pytest.mark.parametrize("name", ["picture.png", "text.usda", "binary.usdc", "package.usdz"])
def test_a_file_that_is_not_usd_is_named_with_what_usd_says(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(b"certainly not")
    with pytest.raises(StageError, match=rf"{name}: cannot be read as \.usd, \.usda, \.usdc or \.usdz: \S+"):
        load_stage(path)


def test_a_package_that_was_cut_off_is_no_empty_stage(tmp_path: Path) -> None:
    stage = write(tmp_path / "s.usda", BALL)
    whole = tmp_path / "whole.usdz"
    assert UsdUtils.CreateNewUsdzPackage(str(stage), str(whole))
    assert load_stage(whole).spheres
    data = whole.read_bytes()
    for size in (len(data) - 30, len(data) // 2, 100):
        whole.write_bytes(data[:size])
        with pytest.raises(StageError, match="was cut off"):
            load_stage(whole)


def test_nothing_of_usd_reaches_stderr_and_a_broken_reference_is_a_notice(tmp_path: Path) -> None:
    path = write(tmp_path / "s.usda", 'def Xform "A" (references = @./gone.usda@) {}\n' + BALL)
    code = f"""
from refract_core.usd.stage import load_stage
scene = load_stage({str(path)!r})
assert [sphere.path for sphere in scene.spheres] == ["/S"]
assert any(n.path == "/A" and "gone.usda" in n.text for n in scene.notices), scene.notices
"""
    root = Path(__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=root, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_a_missing_sublayer_is_a_notice_about_the_file(tmp_path: Path) -> None:
    path = write(tmp_path / "s.usda", "(\nsubLayers = [@./gone.usda@]\n)\n" + BALL)
    scene = load_stage(path)
    assert len(scene.spheres) == 1
    assert any(notice.path.endswith("s.usda") and "gone.usda" in notice.text for notice in scene.notices)


def test_a_changed_file_is_read_anew_while_an_old_stage_is_held(tmp_path: Path) -> None:
    path = write(tmp_path / "s.usda", BALL)
    held = open_stage(path)
    path.unlink()
    write(path, BALL.replace("2", "300"))
    assert load_stage(path).spheres[0].radius == pytest.approx(3.0)
    assert held


def test_edits_in_memory_survive_opening_the_same_file_again(tmp_path: Path) -> None:
    stage = open_stage(write(tmp_path / "s.usda", BALL))
    UsdGeom.Sphere(stage.GetPrimAtPath("/S")).GetRadiusAttr().Set(700.0)
    open_stage(tmp_path / "s.usda")
    assert scene_from_stage(stage).spheres[0].radius == pytest.approx(7.0)


def test_a_scene_pickles_and_says_where_it_comes_from(tmp_path: Path) -> None:
    path = write(tmp_path / "s.usda", BALL + CUBE())
    scene = load_stage(path)
    again = pickle.loads(pickle.dumps(scene))
    assert (again.meshes[0].points == scene.meshes[0].points).all()
    assert Path(scene.name) == path


# --- engine world ---------------------------------------------------------------------------------------------------


def placed_cube(at: tuple[float, float, float], size: float) -> str:
    return CUBE(
        extra=f"""double3 xformOp:translate = {at}
        float3 xformOp:rotateXYZ = (20, 30, 40)
        double3 xformOp:scale = ({size}, {size}, {size})
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ", "xformOp:scale"]"""
    )


def test_a_stage_moved_ten_kilometres_gives_the_same_arrays() -> None:
    text = """def Xform "X" {{ double3 xformOp:translate = {0}
        uniform token[] xformOpOrder = ["xformOp:translate"]
        {1} }}"""
    here = read(text.format((0, 0, 0), placed_cube((1, 2, 3), 0.5) + BALL), unit=0.01)
    far = (1e6, -1e6, 0.5e6)  # centimetres
    there = read(text.format(far, placed_cube((1, 2, 3), 0.5) + BALL), unit=0.01)
    assert np.abs(here.meshes[0].points - there.meshes[0].points).max() < 1e-9
    assert here.spheres[0].centre == pytest.approx(there.spheres[0].centre, abs=1e-9)
    moved = to_stage(there, there.meshes[0].points) - to_stage(here, here.meshes[0].points)
    assert moved == pytest.approx(np.broadcast_to(far, moved.shape), abs=1e-4)


def test_metres_and_centimetres_give_the_same_arrays() -> None:
    metres = read(placed_cube((1, 2, 3), 0.5) + 'def Sphere "S" { double radius = 2 }', unit=1.0)
    centimetres = read(placed_cube((100, 200, 300), 50.0) + 'def Sphere "S" { double radius = 200 }', unit=0.01)
    assert metres.meshes[0].points == pytest.approx(centimetres.meshes[0].points, abs=1e-6)
    assert metres.spheres[0].radius == pytest.approx(centimetres.spheres[0].radius)
    assert metres.bounds[0] == pytest.approx(centimetres.bounds[0])


def test_z_up_turns_to_y_up_with_x_kept() -> None:
    """Stage +X +Y +Z of a Z-up stage are engine +X -Z +Y."""
    ball = """def Sphere "{0}" {{ double radius = 0.1
        double3 xformOp:translate = {1}
        uniform token[] xformOpOrder = ["xformOp:translate"] }}"""
    balls = ball.format("X", (5, 0, 0)) + ball.format("Y", (0, 5, 0)) + ball.format("Z", (0, 0, 5))
    scene = read(CUBE() + balls, up="Z")
    middle = scene.meshes[0].points.mean(axis=0)
    found = {sphere.path: np.array(sphere.centre) - middle for sphere in scene.spheres}
    assert found["/X"] == pytest.approx((5, 0, 0), abs=1e-5)
    assert found["/Y"] == pytest.approx((0, 0, -5), abs=1e-5)
    assert found["/Z"] == pytest.approx((0, 5, 0), abs=1e-5)
    assert signed_volume(scene.meshes[0]) == pytest.approx(8.0)


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.floats(-3, 3), min_size=16, max_size=16),
    st.sampled_from(["Y", "Z"]),
    st.sampled_from([0.001, 0.01, 1.0, 10.0]),
)
def test_engine_points_taken_back_are_where_usd_puts_them(numbers: list[float], up: str, unit: float) -> None:
    """Any affine transform; the outside number is Gf.Matrix4d.Transform."""
    rows = np.array(numbers).reshape(4, 4)
    rows[:, 3] = (0, 0, 0, 1)
    if abs(np.linalg.det(rows[:3, :3])) < 1e-2:
        return
    matrix = Gf.Matrix4d(rows.tolist())
    text = ", ".join(str(tuple(row)) for row in rows.tolist())
    scene = read(CUBE(extra=f"""matrix4d xformOp:transform = ({text})
        uniform token[] xformOpOrder = ["xformOp:transform"]"""), up=up, unit=unit)  # fmt: skip
    (mesh,) = scene.meshes
    expected = [matrix.Transform(Gf.Vec3d(x, y, z)) for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]
    assert to_stage(scene, mesh.points) == pytest.approx(np.array(expected), abs=1e-5)
    assert signed_volume(mesh) == pytest.approx(8 * abs(matrix.GetDeterminant()) * unit**3, rel=1e-3)


def test_bounds_hold_everything_around_the_origin() -> None:
    scene = read(placed_cube((7, 8, 9), 1.0) + BALL)
    low, high = np.array(scene.bounds)
    assert np.abs(low + high).max() / 2 <= (high - low).max() / 8
    everything = np.concatenate([mesh.points for mesh in scene.meshes])
    assert (everything >= low - 1e-5).all()
    assert (everything <= high + 1e-5).all()
    assert to_stage(scene, low) == pytest.approx([-2, -2, -2])


def test_what_moves_a_little_leaves_the_origin_where_it_is() -> None:
    """So what does not move has the same numbers in every frame."""
    origins = {tuple(read(placed_cube((7.0 + x, 8, 9), 1.0) + BALL).stage_from_engine[:3, 3]) for x in (0, 0.1, 0.2)}
    assert len(origins) == 1


@pytest.mark.parametrize(("unit", "expected"), [(0.0, 0.01), (-1.0, 0.01), (math.nan, 0.01), (None, 0.01), (2.5, 2.5)])
def test_metres_per_unit_falls_back_to_usds_centimetre(unit: float | None, expected: float) -> None:
    scene = read(BALL, unit=unit)
    assert scene.metres_per_unit == expected
    assert scene.spheres[0].radius == pytest.approx(2 * expected)
    said = any("metersPerUnit" in notice.text for notice in scene.notices)
    assert said == (unit is not None and unit != expected)


def test_an_unknown_up_axis_is_said() -> None:
    scene = read(BALL, up="X")
    assert any("upAxis is 'X'" in notice.text for notice in scene.notices)


def test_an_empty_stage_is_a_scene_and_says_so() -> None:
    scene = read('def Xform "X" {}')
    assert not scene.meshes
    assert any("nothing is visible" in notice.text for notice in scene.notices)
    assert np.isfinite(scene.bounds).all()
    assert len(scene.cameras) == 1


def test_garbage_far_away_does_not_take_the_scene_with_it() -> None:
    scene = read(BALL + placed_cube((1e300, 0, 0), 1.0))
    assert [sphere.path for sphere in scene.spheres] == ["/S"]
    assert "skipped" in texts(scene, "/C")
    assert scene.bounds[1] == pytest.approx((2, 2, 2))


# --- what is seen ---------------------------------------------------------------------------------------------------


def test_invisible_inactive_class_and_over_prims_are_not_drawn() -> None:
    scene = read("""def Sphere "Seen" { token visibility = "inherited" }
        def Xform "X" { token visibility = "invisible"
            def Sphere "Child" { token visibility = "inherited" } }
        def Sphere "Off" (active = false) {}
        class Sphere "Class" {}
        over "Over" { def Sphere "Inside" {} }""")
    assert set(drawn(scene)) == {"/Seen"}


def test_visibility_is_that_of_the_time() -> None:
    text = 'def Sphere "S" { token visibility.timeSamples = { 1: "invisible", 2: "inherited" \n} }'
    assert not read(text, time_code=1).spheres
    assert len(read(text, time_code=2).spheres) == 1


def test_purposes_choose_what_is_drawn() -> None:
    text = "".join(f'def Sphere "{p}" {{ uniform token purpose = "{p}" }}\n' for p in ("render", "proxy", "guide"))
    text += 'def Sphere "default" {}'
    assert set(drawn(read(text))) == {"/default", "/render"}
    assert set(drawn(read(text, purposes=("default", "proxy")))) == {"/default", "/proxy"}
    assert set(drawn(read(text, purposes=("guide",)))) == {"/guide"}


@pytest.mark.parametrize("name", ["InheritedPurposes", "InheritedPurposes_Instanced"])
@pytest.mark.parametrize("purposes", [("default",), ("default", "render"), ("proxy",), ("guide",)])
def test_inherited_purposes_are_those_usd_computes(assets: Path, name: str, purposes: tuple[str, ...]) -> None:
    path = assets / f"openusd_geom/InheritedPurpose/{name}.usd"
    stage = open_stage(path)
    expected = {
        str(prim.GetPath())
        for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())
        if prim.IsA(UsdGeom.Gprim) and UsdGeom.Imageable(prim).ComputePurpose() in purposes
    }
    assert expected
    assert set(drawn(load_stage(path, purposes=purposes))) == expected


# --- time and what moves --------------------------------------------------------------------------------------------

SPLINES = """def Sphere "S" (
    prepend apiSchemas = ["MaterialBindingAPI"]
) {
    rel material:binding = </M>
    double radius.spline = { 0: 1; post linear,
        10: 3; post linear,
 }
    double xformOp:translateX.spline = { 0: 5; post linear,
        10: 7; post linear,
 }
    uniform token[] xformOpOrder = ["xformOp:translateX"] }
def Material "M" (
    prepend apiSchemas = ["RefractMaterialAPI"]
) {
    uniform token refraction:model = "traced"
    float inputs:refraction:ior.spline = { 0: 1.2; post linear,
        10: 1.6; post linear,
 } }
def Camera "Cam" {
    float focalLength.spline = { 0: 20; post linear,
        10: 60; post linear,
 } }
"""


@pytest.mark.parametrize("time", [0.0, 2.5, 10.0])
def test_splines_are_read_at_the_time(time: float) -> None:
    """Linear ones, whose values at a time anybody can tell: radius, place, index of refraction and focal length."""
    scene = read(SPLINES, time_code=time)
    share = time / 10.0
    (ball,) = scene.spheres
    assert ball.radius == pytest.approx(1.0 + 2.0 * share)
    assert to_stage(scene, ball.centre)[0] == pytest.approx(5.0 + 2.0 * share, abs=1e-6)
    assert not ball.static
    (ior,) = (m.inputs[Param.IOR].value[0] for m in scene.materials if m.name == "/M")
    assert ior == pytest.approx(1.2 + 0.4 * share)
    left, right, *_ = scene.cameras[0].window
    assert right - left == pytest.approx(20.955 / (20.0 + 40.0 * share), rel=1e-6)


MOVING = """def Xform "X" {
    double3 xformOp:translate.timeSamples = { 10: (0, 0, 0), 20: (10, 0, 0)
    }
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Sphere "Moving" {} }
    def Sphere "Growing" { double radius.timeSamples = { 10: 1, 20: 11
    } }
    def Sphere "Still" {}
    def Xform "Told" { bool primvars:refract:static = 0
        def Sphere "Moved" {} }"""


def test_the_first_frame_is_the_default_time_and_samples_are_interpolated() -> None:
    head = "startTimeCode = 10\nendTimeCode = 20"
    assert read(MOVING, head=head).time_code == 10
    assert read(MOVING).time_code == 0
    scene = read(MOVING, head=head, time_code=15)
    assert scene.time_code == 15
    assert drawn(scene)["/X/Moving"] == [5, 0, 0]
    assert {sphere.path: sphere.radius for sphere in scene.spheres}["/Growing"] == pytest.approx(6)


def test_static_means_no_motion_of_its_own_or_above_and_not_told_otherwise() -> None:
    static = {sphere.path: sphere.static for sphere in read(MOVING).spheres}
    assert static == {"/X/Moving": False, "/Growing": False, "/Still": True, "/Told/Moved": False}


def test_several_frames_of_one_opened_stage() -> None:
    stage = stage_of(MOVING, head="startTimeCode = 10\nendTimeCode = 20")
    assert time_range(stage) == (10, 20)
    places = [drawn(scene_from_stage(stage, time_code=time))["/X/Moving"][0] for time in (10, 12, 20)]
    assert places == [0, 2, 10]


@pytest.mark.parametrize(
    ("head", "expected"), [("", (0, 0)), ("startTimeCode = 3", (3, 3)), ("endTimeCode = 7", (0, 7))]
)
def test_time_range_of_half_authored_stages(head: str, expected: tuple[float, float]) -> None:
    assert time_range(stage_of("", head=head)) == expected


def test_a_time_that_is_no_number_is_refused() -> None:
    with pytest.raises(UsageError, match="time_code is nan"):
        read(BALL, time_code=math.nan)


@pytest.mark.parametrize("time", [1.0, 10.5, 23.25])
def test_skinned_points_are_those_usdskel_computes(assets: Path, time: float) -> None:
    stage = open_stage(assets / "usdwg_usdz/RiggedSimple/RiggedSimple.usdz")
    before = stage.GetSessionLayer().ExportToString()
    scene = scene_from_stage(stage, time_code=time)
    assert stage.GetSessionLayer().ExportToString() == before
    (root,) = [UsdSkel.Root(prim) for prim in stage.Traverse() if prim.IsA(UsdSkel.Root)]
    cache = UsdSkel.Cache()
    cache.Populate(root, Usd.PrimDefaultPredicate)
    (binding,) = cache.ComputeSkelBindings(root, Usd.PrimDefaultPredicate)
    (skin,) = binding.GetSkinningTargets()
    points = UsdGeom.Mesh(skin.GetPrim()).GetPointsAttr().Get(time)
    transforms = cache.GetSkelQuery(binding.GetSkeleton()).ComputeSkinningTransforms(time)
    assert skin.ComputeSkinnedPoints(transforms, points, time)
    to_world = UsdGeom.XformCache(time).GetLocalToWorldTransform(binding.GetSkeleton().GetPrim())
    expected = np.array([to_world.Transform(Gf.Vec3d(point)) for point in points])
    (mesh,) = scene.meshes
    assert to_stage(scene, mesh.points) == pytest.approx(expected, abs=1e-5)
    assert not mesh.static
    assert mesh.normals is not None
    corners = mesh.points[mesh.triangles]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    assert (facing[:, None] * mesh.normals).sum(axis=2).mean() > 0.95, "normals bend with the skin"


# --- lights ---------------------------------------------------------------------------------------------------------


def test_the_camera_light_shines_only_where_there_is_no_light_at_all() -> None:
    assert read(BALL).camera_light
    assert not read(BALL + 'def SphereLight "L" {}').camera_light
    assert not read(BALL + 'def DomeLight "L" { token visibility = "invisible" }').camera_light


GLOWING = """
    def Material "M" {
        token outputs:surface.connect = </M/S.outputs:out>
        def Shader "S" {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:emissiveColor = (0, 0.5, 0)
            token outputs:out
        }
    }
    def Cube "Wall" (prepend apiSchemas = ["MaterialBindingAPI"]) { rel material:binding = </M> }
"""


@pytest.mark.parametrize(("glow", "lit"), [("(0, 0, 0)", True), ("(0, 0.5, 0)", False)])
def test_the_camera_light_does_not_shine_on_what_glows(glow: str, lit: bool) -> None:
    """A lamp at the eye burns a sun into every sphere of a room that is lit by its own walls."""
    bound = GLOWING.replace("(0, 0.5, 0)", "GLOW")
    assert read(BALL + bound.replace("GLOW", glow)).camera_light is lit
    assert read(BALL + bound.replace("GLOW", glow).replace("</M>", "</N>")).camera_light  # bound to nothing


# --- tints

TINTED = """
    def Material "Amber" {
        token outputs:mtlx:surface.connect = </Amber/S.outputs:out>
        def Shader "S" {
            uniform token info:id = "ND_standard_surface_surfaceshader"
            float inputs:transmission = 1
            color3f inputs:transmission_color = (0.9, 0.6, 0.2)
            token outputs:out
        }
    }
"""


@pytest.mark.parametrize("size", [0.01, 2.0, 300.0])
@pytest.mark.parametrize(("kind", "way"), [("Sphere", 4.0 / 3.0), ("Cube", 4.0 / 3.0)])
def test_a_tint_is_left_after_the_mean_way_through_its_body(kind: str, way: float, size: float) -> None:
    """4 V / S: of a ball 4 r / 3, of a cube 2/3 of its side; whatever the size."""
    side = f"double radius = {size}" if kind == "Sphere" else f"double size = {2 * size}"
    what = read(f"{TINTED}def {kind} \"Bead\" (prepend apiSchemas = [\"MaterialBindingAPI\"]) {{ {side}\n"
                "rel material:binding = </Amber> }")  # fmt: skip
    (amber,) = (material for material in what.materials if material.name == "/Amber")
    assert amber.absorption_distance / what.metres_per_unit == pytest.approx(way * size, rel=1e-4)
    assert "without a depth" in texts(what, "/Amber")


# --- real stages ----------------------------------------------------------------------------------------------------

REFUSED = {"framesPerSecond_-1.usda", "framesPerSecond_0.usda"}


@pytest.mark.draws
def test_every_real_stage_reads_or_is_refused_in_words(assets: Path) -> None:
    seen = 0
    for path in sorted(assets.rglob("*.usd*")):
        if path.name in REFUSED:
            with pytest.raises(StageError, match="framesPerSecond"):
                load_stage(path)
            continue
        scene = load_stage(path)
        seen += 1
        for mesh in scene.meshes:
            assert np.isfinite(mesh.points).all(), path
            assert mesh.triangles.max() < len(mesh.points), path
            assert mesh.materials.max() < len(scene.materials), path
            if mesh.normals is not None:
                assert np.linalg.norm(mesh.normals, axis=2) == pytest.approx(1.0, abs=1e-5), path
    assert seen > 100


def test_words_that_are_no_text_are_a_sentence_too(tmp_path: Path) -> None:
    """USD quotes the line it could not read, and here that line is not UTF-8."""
    file = tmp_path / "broken.usda"
    file.write_bytes(b'#usda 1.0\ndef Xform "\xff\xfe\xfa" { \xff }\n')
    with pytest.raises(StageError, match="cannot be read"):
        open_stage(file)
