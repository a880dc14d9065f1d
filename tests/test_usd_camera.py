"""Cameras against USD's own frustum, and the order in which one is chosen."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pxr import Gf, UsdGeom
from scene_reading import CUBE, F64, read, stage_of, texts, to_stage

from refract_core.errors import UsageError
from refract_core.scene import Camera, Scene
from refract_core.usd.stage import scene_from_stage
from refract_core.view.orbit import see_everything


def camera_text(name: str = "Cam", extra: str = "") -> str:
    return f'def Camera "{name}" {{ {extra} }}\n'


def ray(scene: Scene, camera: Camera, x: float, y: float) -> tuple[F64, F64]:
    """Origin and unit direction in the stage's world through the picture at x, y in -1 .. 1."""
    left, right, bottom, top = camera.window
    u, v = left + (right - left) * (x + 1) / 2, bottom + (top - bottom) * (y + 1) / 2
    if camera.orthographic:
        start, end = np.array([u, v, 0, 1]), np.array([u, v, -1, 1])
    else:
        start, end = np.array([0.0, 0, 0, 1]), np.array([u, v, -1, 1])
    start, end = (camera.world_from_camera @ point for point in (start, end))
    start, end = to_stage(scene, start[:3]), to_stage(scene, end[:3])
    return start, (end - start) / np.linalg.norm(end - start)


numbers = st.floats(-1.0, 1.0)


@settings(max_examples=40, deadline=None)
@given(
    st.tuples(st.floats(10, 100), st.floats(5, 50), st.floats(5, 50), st.floats(-9, 9), st.floats(-9, 9)),
    st.tuples(st.floats(-500, 500), st.floats(-500, 500), st.floats(-500, 500)),
    st.tuples(st.floats(-180, 180), st.floats(-80, 80), st.floats(-180, 180)),
    st.booleans(),
    st.sampled_from(["Y", "Z"]),
    st.sampled_from([0.01, 1.0]),
    st.tuples(numbers, numbers),
)
def test_rays_are_those_of_usds_frustum(
    lens: tuple[float, ...],
    at: tuple[float, ...],
    turn: tuple[float, ...],
    orthographic: bool,
    up: str,
    unit: float,
    place: tuple[float, float],
) -> None:
    stage = stage_of(
        CUBE()
        + camera_text(
            extra=f"""float focalLength = {lens[0]}
        float horizontalAperture = {lens[1]}
        float verticalAperture = {lens[2]}
        float horizontalApertureOffset = {lens[3]}
        float verticalApertureOffset = {lens[4]}
        token projection = "{"orthographic" if orthographic else "perspective"}"
        double3 xformOp:translate = {at}
        float3 xformOp:rotateXYZ = {turn}
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ"]"""
        ),
        up=up,
        unit=unit,
    )
    scene = scene_from_stage(stage)
    frustum = UsdGeom.Camera(stage.GetPrimAtPath("/Cam")).GetCamera(0.0).frustum
    expected = frustum.ComputePickRay(Gf.Vec2d(*place))
    origin, direction = ray(scene, scene.cameras[0], *place)
    assert direction == pytest.approx(np.array(expected.direction.GetNormalized()), abs=1e-5)
    # USD starts its pick rays on the near plane.
    offset = np.array(expected.startPoint) - origin
    assert np.linalg.norm(np.cross(offset, direction)) < 1e-3


def test_defaults_are_those_of_usdgeomcamera() -> None:
    """50 mm, 20.955 x 15.2908 mm, clipping (1, 1000000) scene units."""
    camera = read(camera_text(), unit=0.01).cameras[0]
    assert camera.window == pytest.approx((-0.20955, 0.20955, -0.152908, 0.152908), abs=1e-6)
    assert camera.clipping == pytest.approx((0.01, 1e4))
    assert camera.exposure_scale == 1.0
    assert not camera.orthographic


def test_an_orthographic_aperture_is_tenths_of_a_scene_unit() -> None:
    extra = 'token projection = "orthographic"\nfloat horizontalAperture = 40\nfloat verticalAperture = 20'
    camera = read(camera_text(extra=extra), unit=0.5).cameras[0]
    assert camera.orthographic
    assert camera.window == pytest.approx((-1.0, 1.0, -0.5, 0.5))


@pytest.mark.parametrize("scale", ["(3, 3, 3)", "(1, 2, 5)", "(-2, -2, -2)"])
def test_scale_is_no_part_of_a_pose(scale: str) -> None:
    extra = f"""float3 xformOp:rotateXYZ = (10, 20, 30)
        double3 xformOp:scale = {scale}
        uniform token[] xformOpOrder = ["xformOp:rotateXYZ", "xformOp:scale"]"""
    pose = read(camera_text(extra=extra)).cameras[0].world_from_camera
    assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    plain = read(camera_text(extra=extra.replace(scale, "(1, 1, 1)"))).cameras[0].world_from_camera
    if scale == "(3, 3, 3)":
        assert pose == pytest.approx(plain)


@pytest.mark.parametrize(
    ("extra", "expected"),
    [
        ("float exposure = 1", 2.0),
        ("float exposure = 1\nfloat exposure:iso = 400", 8.0),
        ("float exposure:time = 0.01\nfloat exposure:fStop = 2", 0.0025),
        ("float exposure:responsivity = 3", 3.0),
    ],
)
def test_exposure_follows_its_formula(extra: str, expected: float) -> None:
    """2^exposure * time * iso / 100 * responsivity / fStop^2: documentation of UsdGeomCamera."""
    assert read(camera_text(extra=extra)).cameras[0].exposure_scale == pytest.approx(expected)


@pytest.mark.parametrize(
    ("extra", "name"),
    [
        ("float focalLength = 0", "focalLength"),
        ("float focalLength = nan", "focalLength"),
        ("float horizontalAperture = -1", "horizontalAperture"),
        ("float verticalApertureOffset = inf", "verticalApertureOffset"),
        ("float2 clippingRange = (10, 1)", "clippingRange"),
        ("float2 clippingRange = (0, 1)", "clippingRange"),
        ("float exposure:fStop = 0", "exposure"),
    ],
)
def test_impossible_values_are_named_and_replaced(extra: str, name: str) -> None:
    scene = read(camera_text(extra=extra))
    camera = scene.cameras[0]
    assert name in texts(scene, "/Cam")
    assert np.isfinite(camera.window).all()
    assert camera.window[0] < camera.window[1]
    assert camera.window[2] < camera.window[3]
    assert 0 < camera.clipping[0] < camera.clipping[1]
    assert 0 < camera.exposure_scale < math.inf


@pytest.mark.parametrize("unit", [0.01, 1.0])
def test_a_lens_is_as_wide_as_its_focal_length_over_its_stop(unit: float) -> None:
    """50 mm at f / 2.5 are a lens of 20 mm across, where a scene unit is a centimetre."""
    lens = "float focalLength = 50\nfloat fStop = 2.5\nfloat focusDistance = 300"
    (camera,) = read(camera_text(extra=lens), unit=unit).cameras
    assert camera.lens_radius == pytest.approx(1.0 * unit)
    assert camera.focus_distance == pytest.approx(300 * unit)


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        ("float fStop = 0\nfloat focusDistance = 3", ""),
        ("float focusDistance = 3", ""),
        ("float fStop = 2.8", "focusDistance is 0"),
        ("float fStop = 2.8\nfloat focusDistance = -4", "focusDistance is -4"),
        ("float fStop = nan\nfloat focusDistance = 4", "fStop is nan"),
        ("float fStop = 2.8\nfloat focusDistance = 4\ntoken projection = 'orthographic'", "it is orthographic"),
    ],
)
def test_a_lens_without_a_stop_or_a_focus_is_a_pinhole(extra: str, said: str) -> None:
    scene = read(camera_text(extra=extra))
    assert scene.cameras[0].lens_radius == 0.0
    assert said in texts(scene, "/Cam")
    assert bool(texts(scene, "/Cam")) == bool(said)


def test_render_settings_switch_the_lens_off() -> None:
    lens = camera_text(extra="float fStop = 2\nfloat focusDistance = 3")
    for off in (0, 1):
        scene = read(lens + f'def RenderSettings "R" {{ bool disableDepthOfField = {off} }}', head=HEAD)
        assert (scene.cameras[0].lens_radius == 0.0) == bool(off)


SHUTTER = "double shutter:open = -0.25\ndouble shutter:close = 0.25"
MOVES = "double3 xformOp:translate.timeSamples = { 0: (0, 0, 0), 1: (1, 0, 0) }\n"
MOVES += 'uniform token[] xformOpOrder = ["xformOp:translate"]'


def test_a_camera_has_its_shutter_where_something_moves() -> None:
    still, moving = CUBE(), CUBE(extra=MOVES)
    assert read(moving + camera_text(extra=SHUTTER)).cameras[0].shutter == (-0.25, 0.25)
    assert read(still + camera_text(extra=SHUTTER + "\n" + MOVES)).cameras[0].shutter == (-0.25, 0.25)
    assert read(still + camera_text(extra=SHUTTER)).cameras[0].shutter == (0.0, 0.0)
    assert read(moving + camera_text()).cameras[0].shutter == (0.0, 0.0)
    closed = SHUTTER.replace("-0.25", "0.25")
    assert read(moving + camera_text(extra=closed)).cameras[0].shutter == (0.0, 0.0)


def test_a_camera_without_a_place_is_skipped() -> None:
    extra = 'double3 xformOp:scale = (0, 0, 0)\nuniform token[] xformOpOrder = ["xformOp:scale"]'
    scene = read(camera_text(extra=extra))
    assert "skipped" in texts(scene, "/Cam")
    assert scene.cameras[0].path == ""


# --- which one ------------------------------------------------------------------------------------------------------

SEVERAL = camera_text("b") + camera_text("a") + 'def Xform "X" { ' + camera_text("deep") + " }\n"
SETTINGS = 'def RenderSettings "R" { rel camera = </b> }\n'
HEAD = 'renderSettingsPrimPath = "/R"'


def test_an_asked_for_camera_comes_first_by_path_or_name() -> None:
    for wanted in ("/X/deep", "deep"):
        scene = read(SEVERAL + camera_text("main_cam") + SETTINGS, head=HEAD, camera=wanted)
        assert scene.cameras[0].path == "/X/deep"
        assert [camera.path for camera in scene.cameras[1:]] == ["/a", "/b", "/main_cam"]


def test_an_unknown_camera_is_an_error_that_lists_the_others() -> None:
    with pytest.raises(UsageError, match=r"'nope' does not exist; the stage has /X/deep, /a, /b"):
        read(SEVERAL, camera="nope")
    with pytest.raises(UsageError, match="none at all"):
        read(CUBE(), camera="nope")


def test_the_render_settings_come_next_then_main_cam_then_the_first() -> None:
    main = camera_text("main_cam")
    assert read(SEVERAL + main + SETTINGS, head=HEAD).cameras[0].path == "/b"
    assert read(SEVERAL + main).cameras[0].path == "/main_cam"
    scene = read(SEVERAL)
    assert scene.cameras[0].path == "/X/deep"
    assert "/a, /b" in texts(scene, "/X/deep")


def test_render_settings_that_name_no_camera_are_passed_over_and_said() -> None:
    scene = read(SEVERAL + SETTINGS.replace("</b>", "</gone>"), head=HEAD)
    assert scene.cameras[0].path == "/X/deep"
    assert "/gone" in texts(scene, "/R")


@pytest.mark.parametrize("up", ["Y", "Z"])
def test_without_a_camera_everything_is_in_the_picture(up: str) -> None:
    text = CUBE(extra='double3 xformOp:scale = (5, 1, 2)\nuniform token[] xformOpOrder = ["xformOp:scale"]')
    scene = read(text + 'def Xform "Y" { ' + CUBE() + " }", up=up)
    assert any("no camera" in notice.text for notice in scene.notices)
    (camera,) = scene.cameras
    into = np.linalg.inv(camera.world_from_camera)
    for mesh in scene.meshes:
        seen = mesh.points @ into[:3, :3].T + into[:3, 3]
        depth = -seen[:, 2]
        assert (depth > camera.clipping[0]).all()
        assert (depth < camera.clipping[1]).all()
        assert (np.abs(seen[:, 0] / depth) <= camera.window[1]).all()
        assert (np.abs(seen[:, 1] / depth) <= camera.window[3]).all()


def seen_by(camera: Camera, points: F64) -> F64:
    """Place in the picture, -1 .. 1 from edge to edge, shape (N, 2)."""
    at = (points - camera.world_from_camera[:3, 3]) @ camera.world_from_camera[:3, :3]
    found: F64 = at[:, :2] / -at[:, 2:] / (camera.window[1], camera.window[3])
    return found


sides = st.sampled_from([0.0, 0.1, 1.0, 7.0])


@given(st.tuples(sides, sides, sides))
def test_without_a_camera_nothing_flat_is_seen_edge_on(size: tuple[float, float, float]) -> None:
    """Everything fits with air around it, and a flat thing covers a part of the picture, however it lies."""
    high = np.array(size) / 2
    camera, _ = see_everything(((-high[0], -high[1], -high[2]), (high[0], high[1], high[2])))
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * high
    seen = seen_by(camera, corners)
    assert np.abs(seen).max() <= 1.0 + 1e-9
    if sum(side > 0.5 for side in size) >= 2 and min(size) == 0.0:
        flat = np.unique(corners, axis=0)
        a, b, c = (seen_by(camera, flat[k : k + 1])[0] for k in (0, 1, 2))
        area = abs((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
        assert area > 0.03 * 4.0


def test_a_picture_on_a_plane_is_looked_at_from_the_front() -> None:
    scene = read(PICTURE)
    assert scene.cameras[0].world_from_camera[:3, :3] == pytest.approx(np.eye(3))
    assert any("from the front is used" in notice.text for notice in scene.notices)


PICTURE = """def Mesh "Picture" {
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]
    uniform token subdivisionScheme = "none" }
"""

SAVED = """customLayerData = {
    dictionary cameraSettings = {
        dictionary Perspective = {
            double3 position = (3, 4, 5)
            double3 target = (1, 1, 1)
        }
        string boundCamera = "/OmniverseKit_Persp"
    }
}"""


@pytest.mark.parametrize("up", ["Y", "Z"])
def test_without_a_camera_the_view_that_a_stage_was_saved_with_is_taken(up: str) -> None:
    scene = read(CUBE(), up=up, head=SAVED)
    (camera,) = scene.cameras
    start, along = ray(scene, camera, 0.0, 0.0)
    assert start == pytest.approx((3, 4, 5), abs=1e-5)
    assert along == pytest.approx(-np.array([2, 3, 4]) / math.sqrt(29), abs=1e-6)
    _, upward = ray(scene, camera, 0.0, 1.0)
    vertical = np.array({"Y": (0, 1, 0), "Z": (0, 0, 1)}[up])
    assert np.cross(along, upward) @ vertical == pytest.approx(0.0, abs=1e-6)  # upright
    assert upward @ vertical > along @ vertical
    half = math.degrees(math.atan(camera.window[1]))
    assert 2 * half == pytest.approx(60.0, abs=0.01)  # Kit's own camera
    assert any("the view it was saved with" in notice.text for notice in scene.notices)


@pytest.mark.parametrize(
    "broken", [("(3, 4, 5)", "(1, 1, 1)"), ("(3, 4, 5)", "(nan, 4, 5)"), ("double3 position", "string other")]
)
def test_a_saved_view_that_makes_no_sense_is_passed_over(broken: tuple[str, str]) -> None:
    head = SAVED.replace(*broken)
    head = head.replace("string other = (3, 4, 5)", 'string other = "x"')
    scene = read(CUBE(), head=head)
    assert any("cameraSettings" in notice.text for notice in scene.notices)
    assert any("frames everything" in notice.text for notice in scene.notices)


ORTHOGRAPHIC = """customLayerData = {
    dictionary cameraSettings = {
        dictionary Front = {
            double3 position = FRONT
            double radius = 8
        }
        dictionary Perspective = {
            double3 position = (3, 4, 5)
            double3 target = (1, 1, 1)
        }
        dictionary Right = {
            double3 position = RIGHT
            double radius = 6
        }
        dictionary Top = {
            double3 position = TOP
            double radius = 4
        }
        string boundCamera = "/OmniverseKit_BOUND"
    }
}"""


@pytest.mark.parametrize("up", ["Y", "Z"])
@pytest.mark.parametrize(("bound", "width"), [("Front", 8.0), ("Right", 6.0), ("Top", 4.0)])
def test_a_stage_saved_in_a_parallel_view_is_seen_in_it(up: str, bound: str, width: float) -> None:
    """The places that Kit writes for new stages, the front one moved aside."""
    places = ("(0.5, 1, 90)", "(-90, 0, 0)", "(0, 90, 0)")
    if up == "Z":
        places = ("(90, 0.5, 1)", "(0, -90, 0)", "(0, 0, 90)")
    head = ORTHOGRAPHIC.replace("BOUND", bound)
    for name, place in zip(("FRONT", "RIGHT", "TOP"), places, strict=True):
        head = head.replace(name, place)
    scene = read(CUBE(), up=up, head=head)
    (camera,) = scene.cameras
    assert camera.orthographic
    start, along = ray(scene, camera, 0.0, 0.0)
    wanted = {"Front": places[0], "Right": places[1], "Top": places[2]}[bound]
    stands = np.array([float(number) for number in wanted.strip("()").split(",")])
    axis = int(np.abs(stands).argmax())
    assert along == pytest.approx(-np.sign(stands[axis]) * np.eye(3)[axis], abs=1e-6)
    across = np.delete(np.asarray(start) - stands, axis)
    assert across == pytest.approx((0.0, 0.0), abs=1e-5)
    assert camera.window[1] - camera.window[0] == pytest.approx(width)
    assert any("the view it was saved with" in notice.text for notice in scene.notices)


def test_the_camera_that_a_stage_was_saved_with_comes_before_the_first() -> None:
    scene = read(SEVERAL, head=SAVED.replace("/OmniverseKit_Persp", "/b"))
    assert scene.cameras[0].path == "/b"
    assert read(SEVERAL, head=SAVED).cameras[0].path == "/X/deep"
