"""Reflection probes: where they stand, what they see and how far they reach, in metres of engine world."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from probe_reading import Y_UP, Z_UP, planar, probe, read, read_one, read_only, to_engine

from refract_core.scene import F64, Cubemap, Probe

# ---- the values


def test_schema_fallbacks_become_metres() -> None:
    found, notices = read_one(metres=0.01)
    assert notices == []
    assert found.path == "/P"
    assert (found.mode, found.resolution, found.captured) == ("baked", 128, None)
    assert (found.cubemap, found.bake, found.background) == (None, None, None)
    assert (found.planar, found.distance_roughness) == (False, False)
    assert found.influence.extents == pytest.approx((0.05, 0.05, 0.05))
    assert found.clipping == pytest.approx((0.001, 10.0))
    assert found.fade_distance == pytest.approx(100.0)
    assert (found.blend_distance, found.face_fade) == ((0.0,) * 6, (1.0,) * 6)
    assert (found.importance, found.weight, found.multiplier) == (1, 1.0, 1.0)
    assert not found.influence.sphere
    assert found.proxy == found.influence


def in_units(unit: float) -> str:
    """One and the same probe, written in a scene unit of `unit` metres."""

    def many(*metres: float) -> str:
        return ", ".join(repr(value / unit) for value in metres)

    return probe(
        f"""
        double3 xformOp:translate = ({many(1, 2, 3)})
        double xformOp:rotateY = 30
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateY"]
        float3 probe:captureOffset = ({many(0.5, 0.25, 0)})
        float3 probe:influence:size = ({many(4, 6, 8)})
        float[] probe:influence:blendDistance = [{many(0.1, 0.2, 0.3, 0.4, 0.5, 0.6)}]
        float[] probe:influence:blendNormalDistance = [{many(0.6, 0.5, 0.4, 0.3, 0.2, 0.1)}]
        float2 probe:clippingRange = ({many(0.2, 50)})
        float probe:fadeDistance = {many(25)}
        uniform token probe:proxy = "volume"
        float3 probe:proxy:size = ({many(10, 12, 14)})
        """
    )


def test_the_scene_unit_does_not_matter() -> None:
    (metre,), first = read(in_units(1.0), metres=1.0)
    (inch,), second = read(in_units(0.0254), metres=0.0254)
    assert first == second == []
    assert metre.proxy is not None
    assert inch.proxy is not None
    for volume, other in ((metre.influence, inch.influence), (metre.proxy, inch.proxy)):
        assert other.world_from_volume == pytest.approx(volume.world_from_volume, abs=1e-6)
        assert other.extents == pytest.approx(volume.extents)
    assert metre.proxy.extents == pytest.approx((5, 6, 7))
    for name in ("capture_point", "blend_distance", "blend_normal_distance", "clipping", "fade_distance"):
        assert getattr(inch, name) == pytest.approx(getattr(metre, name))
    assert metre.blend_distance == pytest.approx((0.1, 0.2, 0.3, 0.4, 0.5, 0.6))


def test_sphere_takes_the_radius() -> None:
    found, notices = read_one(
        'uniform token probe:shape = "sphere"\nfloat probe:influence:radius = 2\n'
        "float[] probe:influence:blendDistance = [1.5, 9, 9, 9, 9, 9]"
    )
    assert notices == []
    assert found.influence.sphere
    assert found.influence.extents == (2.0, 2.0, 2.0)
    assert found.blend_distance[0] == 1.5


def test_animated_values_are_read_at_the_time_asked_for() -> None:
    moving = probe(
        "float probe:weight.timeSamples = { 0: 0, 10: 1 }\n"
        "double3 xformOp:translate.timeSamples = { 0: (0, 0, 0), 10: (10, 0, 0) }\n"
        'uniform token[] xformOpOrder = ["xformOp:translate"]'
    )
    (found,), _ = read(moving, time=2.5)
    assert found.weight == pytest.approx(0.25)
    assert found.capture_point == pytest.approx((2.5, 0, 0))


# ---- the frame


def corners(probe_volume: Probe) -> F64:
    """The eight corners of the influence box in engine world, in sorted order. shape (8, 3) [m]"""
    volume = probe_volume.influence
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    points = (signs * volume.extents) @ volume.world_from_volume[:3, :3].T + volume.world_from_volume[:3, 3]
    return np.array(sorted(points.round(6).tolist()))


def placed(ops: str, order: str, more: str = "") -> str:
    return f"{ops}\nuniform token[] xformOpOrder = [{order}]\nfloat3 probe:influence:size = (2, 4, 6)\n{more}"


def test_capture_offset_turns_with_the_prim() -> None:
    turned = placed(
        "double3 xformOp:translate = (1, 2, 3)\ndouble xformOp:rotateY = 90",
        '"xformOp:translate", "xformOp:rotateY"',
        "float3 probe:captureOffset = (0.5, 0, 0)",
    )
    found, notices = read_one(turned)
    assert notices == []
    # A quarter turn about +Y takes +X to -Z.
    assert found.capture_point == pytest.approx((1, 2, 2.5))
    assert np.ptp(corners(found), axis=0) == pytest.approx((6, 4, 2))


def test_scale_is_taken_out_and_told() -> None:
    plain, _ = read_one(placed("double xformOp:rotateZ = 30", '"xformOp:rotateZ"'))
    scaled, notices = read_one(
        placed("double xformOp:rotateZ = 30\nfloat3 xformOp:scale = (2, 3, 4)", '"xformOp:rotateZ", "xformOp:scale"')
    )
    assert scaled.influence.world_from_volume == pytest.approx(plain.influence.world_from_volume, abs=1e-9)
    assert scaled.influence.extents == plain.influence.extents
    assert len(notices) == 1
    assert "scale" in notices[0]
    assert "4, 3, 2" in notices[0]


def test_mirrored_probe_keeps_its_faces_on_their_sides() -> None:
    blends = "float[] probe:influence:blendDistance = [0.9, 0.1, 0, 0, 0, 0]\nfloat3 probe:captureOffset = (0.5, 0, 0)"
    found, notices = read_one(placed("float3 xformOp:scale = (-1, 1, 1)", '"xformOp:scale"', blends))
    assert notices == []
    axes = found.influence.world_from_volume[:3, :3]
    assert np.linalg.det(axes) == pytest.approx(1.0)
    # The prim's own +x face lies at -x in the world.
    face = int(np.argmax(found.blend_distance))
    outward = axes[:, face // 2] * (1 if face % 2 == 0 else -1)
    assert outward == pytest.approx((-1, 0, 0))
    assert found.capture_point == pytest.approx((-0.5, 0, 0))


def test_up_axis_unit_and_move_of_the_stage() -> None:
    body = placed("double3 xformOp:translate = (100, 200, 300)", '"xformOp:translate"')
    matrix = to_engine(0.01, Z_UP, centre=(100, 200, 0))
    (found,), _ = read(probe(body), matrix, 0.01)
    assert found.capture_point == pytest.approx((0, 3, 0))
    # 2 x 4 x 6 cm, and what was up (z, 6) still is.
    assert np.ptp(corners(found), axis=0) == pytest.approx((0.02, 0.06, 0.04))


@pytest.mark.parametrize("scale", ["(0, 1, 1)", "(nan, 1, 1)"])
def test_probe_without_a_usable_transform_is_skipped(scale: str) -> None:
    body = f'float3 xformOp:scale = {scale}\nuniform token[] xformOpOrder = ["xformOp:scale"]'
    found, notices = read(probe(body))
    assert found == ()
    assert [notice.path for notice in notices] == ["/P"]
    assert "xformOps" in notices[0].text


# ---- which prims


def test_applied_api_counts_like_the_typed_prim() -> None:
    found, notices = read('def Xform "Lamp" (prepend apiSchemas = ["RefractProbeAPI"]) { float probe:weight = 0.5 }\n')
    assert notices == []
    assert [(probe.path, probe.weight) for probe in found] == [("/Lamp", 0.5)]


def test_hidden_probes_are_skipped_in_silence() -> None:
    text = (
        'def Xform "A" { token visibility = "invisible"\n def RefractProbe "P" {} }\n'
        'def RefractProbe "B" (active = false) {}\nclass RefractProbe "C" {}\n'
    )
    assert read(text) == ((), [])


@pytest.mark.parametrize(
    ("text", "path", "word"),
    [
        ('def Scope "P" (prepend apiSchemas = ["RefractProbeAPI"]) {}', "/P", "has no transform"),
        ('def PointInstancer "I" { def RefractProbe "P" {} }', "/I/P", "point instancer /I"),
    ],
)
def test_probes_that_cannot_be_served_are_named(text: str, path: str, word: str) -> None:
    found, notices = read(text)
    assert found == ()
    assert [notice.path for notice in notices] == [path]
    assert word in notices[0].text


def test_probes_in_native_instances_are_read_in_place() -> None:
    text = (
        'class Xform "Proto" { def RefractProbe "P" {} }\n'
        + "\n".join(
            f'def Xform "I{x}" (instanceable = true\n prepend inherits = </Proto>) {{\n'
            f'double3 xformOp:translate = ({x}, 0, 0)\nuniform token[] xformOpOrder = ["xformOp:translate"] }}'
            for x in (1, 2)
        )
    )
    found, _ = read(text)
    assert [(probe.path, probe.capture_point[0]) for probe in found] == [("/I1/P", 1.0), ("/I2/P", 2.0)]


# ---- planar probes


def test_planar_probe_has_the_values_of_any_other_but_its_mode_and_importance() -> None:
    found, notices = read_only(planar(), metres=0.01)
    plain, _ = read_one(metres=0.01)
    assert notices == []
    assert found.planar
    assert (found.mode, found.importance) == ("realtime", 64)  # HDRP's defaults for planar probes
    for name in ("capture_point", "clipping", "blend_distance", "weight", "fade_distance", "background"):
        assert getattr(found, name) == getattr(plain, name)
    assert found.influence.extents == plain.influence.extents


@pytest.mark.parametrize("turn", [Y_UP, Z_UP])
@pytest.mark.parametrize("mirror", ["(1, 1, 1)", "(-1, 1, 1)"])
def test_window_of_a_planar_probe_lies_in_its_own_xy_plane(turn: F64, mirror: str) -> None:
    body = placed(
        f"double3 xformOp:translate = (10, 20, 30)\ndouble xformOp:rotateX = -90\nfloat3 xformOp:scale = {mirror}",
        '"xformOp:translate", "xformOp:rotateX", "xformOp:scale"',
        "float[] probe:influence:blendDistance = [0.5, 0.25, 0, 0, 0, 0]",
    )
    matrix = to_engine(0.1, turn)
    (found,), notices = read(planar(body), matrix, 0.1)
    assert notices == []
    frame = found.influence.world_from_volume
    assert frame[:3, 3] == pytest.approx((matrix @ (10, 20, 30, 1))[:3])
    # The quarter turn about X takes the plane's +Z to +Y of the stage.
    assert frame[:3, 2] == pytest.approx(matrix[:3, 1] / 0.1, abs=1e-9)
    assert found.influence.extents == pytest.approx((0.1, 0.2, 0.3))
    assert sorted(found.blend_distance) == pytest.approx([0, 0, 0, 0, 0.025, 0.05])


@pytest.mark.parametrize(
    ("authored", "field", "used"),
    [
        ("float[] probe:influence:blendNormalDistance = [0, 0, 1, 0, 0, 0]", "blend_normal_distance", (0.0,) * 6),
        ("float[] probe:influence:faceFade = [1, 1, 0.5, 1, 1, 1]", "face_fade", (1.0,) * 6),
        ("float3 probe:captureOffset = (0, 1, 0)", "capture_point", (0.0,) * 3),
        ("uniform bool probe:distanceBasedRoughness = 1", "distance_roughness", False),
    ],
)
def test_what_a_planar_probe_does_not_have_is_told(authored: str, field: str, used: object) -> None:
    found, notices = read_only(planar(authored))
    assert getattr(found, field) == used
    name = authored.split(" = ")[0].split()[-1]
    assert [text.startswith(f"{name} is ") and "ignored" in text and "Remove it" in text for text in notices] == [True]


def test_what_a_planar_probe_would_do_anyway_may_be_authored() -> None:
    body = (
        "float[] probe:influence:blendNormalDistance = [0, 0, 0, 0, 0, 0]\n"
        "float[] probe:influence:faceFade = [1, 1, 1, 1, 1, 1]\nfloat3 probe:captureOffset = (0, 0, 0)\n"
        "uniform bool probe:distanceBasedRoughness = 0\nint probe:importance = 3"
    )
    found, notices = read_only(planar(body))
    assert notices == []
    assert found.importance == 3


# ---- what it sees

ROOM = """
def Xform "Room" {
    def Cube "Wall" {}
    def Cube "Lamp" {}
}
def Sphere "Ball" {}
"""


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("", None),
        ("rel collection:captured:excludes = </Room/Lamp>", {"/Room/Wall", "/Ball"}),
        ("uniform bool collection:captured:includeRoot = 0\nrel collection:captured:includes = </Room>",
         {"/Room/Wall", "/Room/Lamp"}),
        ("uniform bool collection:captured:includeRoot = 0\nrel collection:captured:includes = </Room>\n"
         "rel collection:captured:excludes = </Room/Wall>", {"/Room/Lamp"}),
        ("uniform bool collection:captured:includeRoot = 0", set()),
    ],
)  # fmt: skip
def test_captured_collection(body: str, expected: set[str] | None) -> None:
    (found,), notices = read(ROOM + probe(body))
    assert notices == []
    assert (None if found.captured is None else set(found.captured)) == expected


def test_captured_target_that_does_not_exist_is_told() -> None:
    (found,), notices = read(ROOM + probe("rel collection:captured:excludes = </Room/Lmap>"))
    assert set(found.captured or ()) == {"/Ball", "/Room/Lamp", "/Room/Wall"}
    assert ["/Room/Lmap" in notice.text for notice in notices] == [True]


# ---- the proxy


def test_infinite_proxy() -> None:
    assert read_one('uniform token probe:proxy = "infinite"')[0].proxy is None


def test_a_proxy_of_depth_marches_and_lends_its_influence_volume() -> None:
    found, notices = read_one('uniform token probe:proxy = "depth"')
    assert (found.marched, found.proxy, notices) == (True, found.influence, [])
    assert not read_one()[0].marched


def test_a_planar_probe_has_no_depth_to_march() -> None:
    (found,), notices = read(planar('uniform token probe:proxy = "depth"'))
    assert (found.marched, found.proxy) == (False, found.influence)
    assert [(notice.path, "not for planar probes" in notice.text) for notice in notices] == [("/P", True)]


GIVEN = 'uniform token probe:mode = "custom"\nasset probe:texture = @room.exr@\nuniform token probe:proxy = '


@pytest.mark.parametrize(("proxy", "coverage", "distance", "told"), [
    ("depth", 1.0, 0.0, True), ("depth", 1.0, 2.0, False), ("depth", 0.0, 0.0, False), ("influence", 1.0, 0.0, False),
])  # fmt: skip
def test_a_picture_without_distances_is_told_by_its_prim(
    proxy: str, coverage: float, distance: float, told: bool
) -> None:
    """One that shows nothing but the sky has none to tell."""
    texels = np.zeros((6, 8, 8, 5), np.float32)
    texels[:, 2, 3, 3:] = coverage, distance
    (found,), notices = read(probe(f'{GIVEN}"{proxy}"'), read_cubemap=lambda _path, _n: Cubemap((texels,)))
    assert found.marched == (proxy == "depth" and not told)
    assert [notice.path for notice in notices] == ["/P"] * told
    assert all("no distances" in n.text and "refract bake probes" in n.text for n in notices)


def test_own_proxy_has_the_probes_frame_and_its_own_size() -> None:
    body = placed(
        "double xformOp:rotateY = 20",
        '"xformOp:rotateY"',
        'uniform token probe:proxy = "volume"\nfloat3 probe:proxy:size = (20, 22, 24)',
    )
    found, notices = read_one(body)
    assert notices == []
    assert found.proxy is not None
    assert found.proxy.extents == (10.0, 11.0, 12.0)
    assert found.proxy.world_from_volume == pytest.approx(found.influence.world_from_volume)


HALL = """
def Xform "Hall" {
    double3 xformOp:translate = (10, 20, 30)
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Cube "Block" { double size = 4 }
    def Sphere "Ball" {
        double3 xformOp:translate = (5, 0, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
}
"""
BY_PRIM = 'uniform token probe:proxy = "volume"\nrel probe:proxy:prim = </Hall>'


@pytest.mark.parametrize("turn", [Y_UP, Z_UP])
def test_proxy_from_another_prims_bounds(turn: F64) -> None:
    matrix = to_engine(0.1, turn, centre=(1, 2, 3))
    (found,), notices = read(HALL + probe(BY_PRIM), matrix, 0.1)
    assert notices == []
    assert found.proxy is not None
    assert not found.proxy.sphere
    # Cube -2..2, ball 4..6 along x: the hall spans x 8..16, y 18..22, z 28..32 in the stage.
    low, high = (matrix @ np.array([*corner, 1.0]) for corner in ((8, 18, 28), (16, 22, 32)))
    frame = found.proxy.world_from_volume
    assert np.linalg.det(frame[:3, :3]) == pytest.approx(1.0)
    half = np.abs(frame[:3, :3] @ np.array(found.proxy.extents))
    assert frame[:3, 3] - half == pytest.approx(np.minimum(low, high)[:3])
    assert frame[:3, 3] + half == pytest.approx(np.maximum(low, high)[:3])


@pytest.mark.parametrize(
    ("scene", "body", "word"),
    [
        ("", BY_PRIM, "does not exist"),
        ('def Xform "Hall" {}\n', BY_PRIM, "no bounds"),
        (HALL, "rel probe:proxy:prim = </Hall>", "is ignored, for probe:proxy is 'influence'"),
    ],
)
def test_proxy_prim_that_cannot_serve_leaves_the_influence_volume(scene: str, body: str, word: str) -> None:
    (found,), notices = read(scene + probe(body))
    assert found.proxy == found.influence
    assert ["probe:proxy:prim" in notice.text and word in notice.text for notice in notices] == [True]


def test_flat_proxy_prim_is_given_a_thickness() -> None:
    ground = 'def Plane "Hall" { double width = 10\ndouble length = 10\nuniform token axis = "Y" }\n'
    (found,), notices = read(ground + probe(BY_PRIM))
    assert found.proxy is not None
    assert found.proxy.extents[1] > 0.0
    assert found.proxy.extents[0] == pytest.approx(5.0)
    assert ["flat" in notice.text for notice in notices] == [True]
