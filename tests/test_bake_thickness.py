"""`refract bake thickness`: what it authors, how the renderer reads it, what it leaves alone, and where it writes."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade
from test_thickness import ball, both, box, torus
from thickness_stages import NAME, bind, drawn, from_picture, glass, mapped, mesh, metres, new, run, scaled, unwrapped
from typer.testing import CliRunner

from refract_core.cli import app
from refract_core.errors import Cancelled, UsageError
from refract_core.progress import Report
from refract_core.scene import Param
from refract_core.usd.layers.write import overlay
from refract_core.usd.stage import load_stage
from refract_core.verbs.bake_thickness import ThicknessOrder, bake_over, bake_thickness

# --- primvars -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("unit", "up"), [(1.0, "Y"), (0.01, "Z"), (0.001, "Y")])
def test_the_renderer_reads_metres_of_what_is_drawn(tmp_path: Path, unit: float, up: str) -> None:
    stage = new(tmp_path / "in.usda", unit=unit, up=up)
    material = glass(stage, thickness=5.0)
    scaled(mesh(stage, "/W/Torus", torus(2.0, 0.5), material), 2.0)
    scaled(mesh(stage, "/W/Mirrored", ball(3.0), material), -1.0, 1.0, 1.0)
    stage.Save()
    rows, _ = run(tmp_path / "in.usda", tmp_path / "out.usda")
    scene = load_stage(tmp_path / "out.usda")
    np.testing.assert_allclose(metres(scene, "Torus"), 2.0 * unit, rtol=2e-3)
    np.testing.assert_allclose(metres(scene, "Mirrored"), 6.0 * unit, rtol=1e-5)
    assert rows["Mirrored"].how == "vertex"
    assert rows["Mirrored"].mean == pytest.approx(6.0, rel=1e-5)


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_hard_edges_have_a_value_for_every_face(tmp_path: Path, mirror: float) -> None:
    stage = new(tmp_path / "in.usda")
    scaled(mesh(stage, "/W/Box", box(1.0, 1.0, 1.0), glass(stage, model="box")), mirror * 4.0, 2.0, 0.5)
    stage.Save()
    rows, _ = run(tmp_path / "in.usda", tmp_path / "out.usda")
    assert rows["Box"].how == "faceVarying"
    scene = load_stage(tmp_path / "out.usda")
    found, _ = drawn(scene, "Box")
    at = found.points[found.triangles]
    facing = np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0])
    expected = np.array([4.0, 2.0, 0.5])[np.abs(facing).argmax(axis=1)]
    np.testing.assert_allclose(metres(scene, "Box"), np.repeat(expected[:, None], 3, axis=1), rtol=1e-4)


def test_the_wall_of_a_hollow_body_and_the_models_path_along_refracted_rays(tmp_path: Path) -> None:
    stage = new(tmp_path / "in.usda")
    mesh(stage, "/W/Shell", both(ball(1.0), ball(0.8, outward=-1.0)), glass(stage, "Shell"))
    mesh(stage, "/W/Ball", ball(1.0, count=5), glass(stage, "Ball", ior=1.7))
    stage.Save()
    rows, _ = run(tmp_path / "in.usda", tmp_path / "out.usda")
    assert rows["Shell"].least == pytest.approx(0.2, rel=2e-2)
    rows, _ = run(tmp_path / "in.usda", tmp_path / "out.usda", along="refracted")
    assert rows["Ball"].least == pytest.approx(2.0, rel=2e-3)
    assert rows["Ball"].most == pytest.approx(2.0, rel=2e-3)


@pytest.mark.parametrize("scheme", ["catmullClark", "loop"])
def test_a_subdivision_surface_carries_values_at_the_points_of_its_cage(tmp_path: Path, scheme: str) -> None:
    stage = new(tmp_path / "in.usda")
    mesh(stage, "/W/Ball", ball(1.0, count=2), glass(stage)).GetSubdivisionSchemeAttr().Set(scheme)
    stage.Save()
    rows, _ = run(tmp_path / "in.usda", tmp_path / "out.usda")
    assert rows["Ball"].how == "varying"
    scene = load_stage(tmp_path / "out.usda")
    found, _ = drawn(scene, "Ball")
    radius = np.linalg.norm(found.points - found.points.mean(axis=0), axis=1).mean()
    assert radius < 0.99  # it lies inside of its cage
    np.testing.assert_allclose(metres(scene, "Ball"), 2.0 * radius, rtol=3e-2)


def test_gprims_carry_one_value(tmp_path: Path) -> None:
    stage = new(tmp_path / "in.usda", unit=0.01)
    material = glass(stage)
    for kind in (UsdGeom.Sphere, UsdGeom.Cube, UsdGeom.Cylinder):
        bind(kind.Define(stage, f"/W/{kind.__name__}"), material)
    scaled(stage.GetPrimAtPath("/W/Sphere"), 1.5)
    scaled(stage.GetPrimAtPath("/W/Cube"), 3.0, 2.0, 0.1)
    stage.Save()
    rows, told = run(tmp_path / "in.usda", tmp_path / "out.usda", texture=64)
    assert {row.how for row in rows.values()} == {"constant"}
    assert rows["Sphere"].mean == pytest.approx(3.0, rel=1e-6)
    assert rows["Cube"].mean == pytest.approx(0.2, rel=1e-4)  # a pane: most of it is its two large faces
    assert rows["Cylinder"].mean == pytest.approx(2.0, rel=1e-3)
    assert "/W/Cube: a Cube carries one value" in told
    assert "/W/Sphere: a Sphere" not in told
    scene = load_stage(tmp_path / "out.usda")
    (sphere,) = scene.spheres
    assert sphere.primvars[NAME].shape == (1, 1, 1)
    assert metres(scene, "Cube").item() == pytest.approx(0.002, rel=1e-4)


def test_a_map_of_the_material_no_longer_comes_first(tmp_path: Path) -> None:
    stage = new(tmp_path / "in.usda")
    material = glass(stage, thickness=7.0)
    mapped(stage, material)
    mesh(stage, "/W/Ball", ball(1.0), material)
    mesh(stage, "/W/Sheet", (lambda s: (s[0], s[1][:2], s[2][:2]))(box(1.0, 1.0, 1.0)), material)
    stage.Save()
    _, told = run(tmp_path / "in.usda", tmp_path / "out.usda")
    assert "warning /W/Looks/Glass: its thickness is disconnected, also for /W/Sheet" in told
    scene = load_stage(tmp_path / "out.usda")
    np.testing.assert_allclose(metres(scene, "Ball"), 2.0, rtol=1e-5)
    assert drawn(scene, "Sheet")[1].inputs[Param.THICKNESS].value[0] == 7.0


def test_indices_of_an_older_primvar_do_not_stay(tmp_path: Path) -> None:
    stage = new(tmp_path / "in.usda")
    made = mesh(stage, "/W/Ball", ball(1.0), glass(stage))
    old = UsdGeom.PrimvarsAPI(made).CreatePrimvar(NAME, Sdf.ValueTypeNames.FloatArray, "vertex")
    old.Set([0.1, 0.2])
    old.SetIndices([0] * len(ball(1.0)[0]))
    stage.Save()
    run(tmp_path / "in.usda", tmp_path / "out.usda")
    np.testing.assert_allclose(metres(load_stage(tmp_path / "out.usda"), "Ball"), 2.0, rtol=1e-5)


def test_a_factor_on_the_thickness_is_named(tmp_path: Path) -> None:
    stage = new(tmp_path / "in.usda")
    mesh(stage, "/W/Ball", ball(1.0), glass(stage, thicknessMultiplier=3.0))
    stage.Save()
    rows, told = run(tmp_path / "in.usda", tmp_path / "out.usda")
    assert rows["Ball"].mean == pytest.approx(2.0, rel=1e-5)
    assert "thicknessMultiplier of /W/Looks/Glass is 3" in told


# --- what is left alone ---------------------------------------------------------------------------------------------


def test_what_has_no_far_side_is_named_and_left_alone(tmp_path: Path) -> None:
    stage = new(tmp_path / "in.usda")
    material = glass(stage)
    points, triangles, normals = box(1.0, 1.0, 1.0)
    mesh(stage, "/W/Open", (points, triangles[:-2], normals[:-2]), material)
    fin = np.array([[triangles[0, 0], triangles[0, 1], 6]], np.uint32)
    mesh(stage, "/W/Fin", (points, np.concatenate((triangles, fin)), np.concatenate((normals, normals[:1]))), material)
    mesh(stage, "/W/Inwards", ball(1.0, outward=-1.0), material)
    scaled(mesh(stage, "/W/Flat", ball(1.0), material), 1.0, 1.0, 0.0)
    mesh(stage, "/W/Pane", ball(1.0), glass(stage, "Thin", model="thin"))
    stage.Save()
    rows, told = run(tmp_path / "in.usda", tmp_path / "out.usda")
    assert rows == {}
    assert "warning /W/Open: left alone: it is open: 4 edges" in told
    assert "warning /W/Fin: left alone: it is not manifold" in told
    assert "warning /W/Inwards: left alone: its faces look inwards" in told
    assert "warning /W/Flat: left alone: its transform" in told
    assert "\n/W/Pane: left alone: its model" in told
    layer = Sdf.Layer.FindOrOpen(str(tmp_path / "out.usda"))
    assert list(layer.rootPrims) == []


def test_instances_of_one_size_are_measured_once_and_others_left_alone(tmp_path: Path) -> None:
    stage = new(tmp_path / "in.usda")
    for name, scales in (("Same", (2.0, 2.0)), ("Other", (1.0, 2.0))):
        material = UsdShade.Material.Define(stage, f"/Protos/{name}/Glass")
        material.GetPrim().ApplyAPI("RefractMaterialAPI")
        mesh(stage, f"/Protos/{name}/Ball", ball(1.0), material)
        for number, scale in enumerate(scales):
            instance = UsdGeom.Xform.Define(stage, f"/W/{name}{number}")
            instance.GetPrim().GetReferences().AddInternalReference(f"/Protos/{name}")
            instance.GetPrim().SetInstanceable(True)
            UsdGeom.XformCommonAPI(instance).SetTranslate(Gf.Vec3d(5.0 * number, 0, 0))
            scaled(instance, scale)
    stage.GetPrimAtPath("/Protos").SetSpecifier(Sdf.SpecifierOver)
    stage.Save()
    rows, told = run(tmp_path / "in.usda", tmp_path / "out.usda")
    assert [row.path for row in rows.values()] == ["/W/Same0/Ball"]
    assert "/W/Other0/Ball: left alone: its 2 instances have different sizes, from 1 to 2 times" in told
    scene = load_stage(tmp_path / "out.usda")
    same = [one for one in scene.meshes if "Same" in one.path]
    assert len(same) == 2
    for one in same:
        np.testing.assert_allclose(one.primvars[NAME], 4.0, rtol=1e-5)


@pytest.mark.parametrize("scales", [(3.0, 3.0), (3.0, 1.0)])
def test_a_prototype_of_a_point_instancer(tmp_path: Path, scales: tuple[float, float]) -> None:
    stage = new(tmp_path / "in.usda")
    instancer = UsdGeom.PointInstancer.Define(stage, "/W/Many")
    mesh(stage, "/W/Many/Ball", ball(1.0), glass(stage))
    instancer.CreatePrototypesRel().AddTarget("/W/Many/Ball")
    instancer.CreateProtoIndicesAttr([0, 0])
    instancer.CreatePositionsAttr([(0, 0, 0), (9, 0, 0)])
    instancer.CreateScalesAttr([(scale,) * 3 for scale in scales])
    stage.Save()
    rows, told = run(tmp_path / "in.usda", tmp_path / "out.usda")
    if scales[0] == scales[1]:
        assert rows["Ball"].mean == pytest.approx(6.0, rel=1e-5)
        found = load_stage(tmp_path / "out.usda").meshes
        assert [float(one.primvars[NAME].mean()) for one in found] == pytest.approx([6.0, 6.0], rel=1e-5)
    else:
        assert rows == {}
        assert "/W/Many/Ball: left alone: its 2 instances have different sizes" in told


# --- pictures -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["out.usda", "out.usdz"])
def test_pictures_in_materials_of_their_own(tmp_path: Path, name: str) -> None:
    stage = new(tmp_path / "in.usda", unit=0.01)
    shared, single = glass(stage, "Shared", ior=1.7), glass(stage, "Single", model="box", ior=1.3)
    sides = {"A": (1.0, 2.0, 3.0), "B": (4.0, 5.0, 6.0), "C": (7.0, 8.0, 9.0)}
    for prim, material in zip(sides, (shared, shared, single), strict=True):
        unwrapped(stage, f"/W/{prim}", material, sides[prim])
    stage.Save()
    rows, told = run(tmp_path / "in.usda", tmp_path / name, texture=64)
    assert "warning" not in told
    assert rows["B"].how == "W_B.exr"
    scene = load_stage(tmp_path / name)
    for prim, expected in sides.items():
        values, found = from_picture(scene, prim)
        at = found.points[found.triangles]
        facing = np.abs(np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0])).argmax(axis=1)
        np.testing.assert_allclose(values, 0.01 * np.array(expected)[facing], rtol=1e-3)
    names = {prim: drawn(scene, prim)[1].name for prim in sides}
    assert names == {"A": "/W/Looks/Shared_A", "B": "/W/Looks/Shared_B", "C": "/W/Looks/Single"}
    before = load_stage(tmp_path / "in.usda")
    for prim in sides:
        old, new_one = drawn(before, prim)[1], drawn(scene, prim)[1]
        assert new_one.model is old.model
        kept = [param for param in Param if param is not Param.THICKNESS]
        assert [new_one.inputs[param] for param in kept] == [old.inputs[param] for param in kept]
    assert (tmp_path / "out.thickness").exists() is (name == "out.usda")


def test_what_cannot_have_a_picture_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xatlas", None)  # as where the extra is not installed
    stage = new(tmp_path / "in.usda")
    mesh(stage, "/W/Bare", ball(1.0), glass(stage))
    unwrapped(stage, "/W/Plain", UsdShade.Material.Define(stage, "/W/Looks/Plain"), (1.0, 1.0, 1.0))
    shader = UsdShade.Shader.Define(stage, "/W/Looks/Plain/S")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("opacity", Sdf.ValueTypeNames.Float).Set(0.0)
    plain = UsdShade.Material(stage.GetPrimAtPath("/W/Looks/Plain"))
    plain.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    stage.Save()
    rows, told = run(tmp_path / "in.usda", tmp_path / "out.usda", texture=32)
    assert rows == {}
    assert "/W/Bare: left alone: it has no uv for a picture, and making some needs the extra `unwrap`" in told
    assert "/W/Plain: left alone: its material has no RefractMaterialAPI" in told
    assert not (tmp_path / "out.thickness").exists()


# --- the verb -------------------------------------------------------------------------------------------------------


@pytest.fixture
def two(tmp_path: Path) -> Path:
    stage = new(tmp_path / "in.usda")
    material = glass(stage)
    mesh(stage, "/W/Set/A", ball(1.0), material)
    mesh(stage, "/W/B", ball(2.0), material)
    stage.Save()
    return tmp_path / "in.usda"


def test_only_some_and_the_input_is_never_changed(two: Path, tmp_path: Path) -> None:
    before = two.read_bytes()
    assert list(run(two, tmp_path / "out.usda", only=("/W/Set",))[0]) == ["A"]
    assert list(run(two, tmp_path / "out.usda", only=("*B", "/W/Set/*"))[0]) == ["A", "B"]
    with pytest.raises(UsageError, match=r"--only /W/C: the stage has no such glass; it has /W/Set/A, /W/B"):
        run(two, tmp_path / "out.usda", only=("/W/C",))
    assert two.read_bytes() == before


def test_an_earlier_bake_is_replaced_and_anything_else_only_when_asked(two: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.usda"
    run(two, out)
    run(two, out)
    out.write_text("#usda 1.0\n")
    with pytest.raises(UsageError, match="--overwrite"):
        run(two, out)
    run(two, out, overwrite=True)
    stage = new(tmp_path / "uv.usda")
    unwrapped(stage, "/W/A", glass(stage), (1.0, 1.0, 1.0))
    stage.Save()
    picture = tmp_path / "other.thickness" / "W_A.exr"
    picture.parent.mkdir()
    picture.write_text("somebody's")
    with pytest.raises(UsageError, match=r"W_A\.exr: exists already"):
        run(tmp_path / "uv.usda", tmp_path / "other.usda", texture=32)
    assert picture.read_text() == "somebody's"
    assert not (tmp_path / "other.usda").exists()


def test_stopping_leaves_nothing(two: Path, tmp_path: Path) -> None:
    silent = Report(lambda _f, _t: None, lambda _p, _t: None, lambda _p, _t: None, lambda _t: None)
    order = ThicknessOrder(stage=str(two), out=str(tmp_path / "out.usda"), texture=32)
    with pytest.raises(Cancelled):
        bake_thickness(order, silent, lambda: True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.usda"]


@pytest.mark.parametrize(
    ("options", "text"),
    [({"along": "view"}, "--along"), ({"texture": 8}, "--texture"), ({"texture": 9000}, "--texture"),
     ({"jobs": -1}, "--jobs")],
)  # fmt: skip
def test_an_order_that_makes_no_sense_is_refused(options: dict[str, Any], text: str) -> None:
    with pytest.raises(UsageError, match=text):
        ThicknessOrder(stage="a.usda", out="b.usda", **options)


def test_where_nothing_can_be_measured_that_is_said(tmp_path: Path) -> None:
    """A thin pane alone: the layer is written, and nobody thinks that it says something."""
    stage = new(tmp_path / "in.usda")
    pane = mesh(stage, "/W/Pane", ball(1.0), glass(stage, "Thin", model="thin"))
    stage.Save()
    rows, told = run(tmp_path / "in.usda", tmp_path / "out.usda")
    assert rows == {}
    assert f"warning {tmp_path / 'out.usda'}: nothing was measured, and the layer changes nothing" in told
    assert "the model of /W/Pane fixes the thickness; give it another" in told
    bind(pane, glass(stage, "Thick"))
    stage.Save()
    rows, told = run(tmp_path / "in.usda", tmp_path / "out.usda")
    assert list(rows) == ["Pane"]
    assert "nothing was measured" not in told


def test_a_stage_without_glass_gives_a_layer_that_changes_nothing(tmp_path: Path) -> None:
    stage = new(tmp_path / "in.usda")
    mesh(stage, "/W/Ball", ball(1.0))
    stage.Save()
    _, told = run(tmp_path / "in.usda", tmp_path / "out.usda")
    assert "has no glass" in told
    assert list(Sdf.Layer.FindOrOpen(str(tmp_path / "out.usda")).rootPrims) == []


def test_measured_in_place_of_typed_in_a_layer_that_is_being_made(two: Path) -> None:
    layer = overlay(str(two), made="convert")
    typed = Sdf.AttributeSpec(Sdf.CreatePrimInLayer(layer, "/W/B"), f"primvars:{NAME}", Sdf.ValueTypeNames.Float)
    typed.default = 9.0
    assert bake_over(layer, ["/W/B", "/W/Looks"]) == ()
    stage = Usd.Stage.Open(layer)
    primvar = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/W/B")).GetPrimvar(NAME)
    assert primvar.GetInterpolation() == "vertex"
    np.testing.assert_allclose(np.array(primvar.Get()), 4.0, rtol=1e-5)
    assert not UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/W/Set/A")).HasPrimvar(NAME)


def test_the_command(two: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out.usda"
    done = CliRunner().invoke(app, ["bake", "thickness", str(two), str(out), "--progress", "json"])
    assert done.exit_code == 0
    assert '{"event": "done", "path": "/W/B", "text": "4 to 4, mean 4; vertex"}' in done.stderr
    again = ["bake", "thickness", str(two), str(out), "--along", "sideways"]
    assert CliRunner().invoke(app, again).exit_code == 2
    orders: list[ThicknessOrder] = []
    module = importlib.import_module("refract_core.verbs.bake_thickness")
    monkeypatch.setattr(module, "bake_thickness", lambda order, _report, _cancel: orders.append(order))
    words = ["--only", "/A,/B", "--along", "refracted", "--texture", "64", "--jobs", "1", "--overwrite"]
    assert CliRunner().invoke(app, ["bake", "thickness", "a.usda", "b.usda", *words]).exit_code == 0
    assert orders == [
        ThicknessOrder(
            stage="a.usda", out="b.usda", only=("/A", "/B"), along="refracted", texture=64, jobs=1, overwrite=True
        )
    ]
