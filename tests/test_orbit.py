"""The one camera model: angles in the stage's own upright, frames that hold what they frame, a start from a camera."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scene_reading import CUBE, F64, read, to_stage
from typer.testing import CliRunner

import refract_core as rc
from refract_core.cli import app
from refract_core.errors import UsageError
from refract_core.images.pictures import read_planes
from refract_core.rendering.ready import camera_of
from refract_core.scene import Camera, Scene
from refract_core.verbs.render_files import Order, chosen_settings, outs_of
from refract_core.view.camera import image_size, view_of

CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
QUICK: dict[str, Any] = {"image_width": 48, "samples": 1, "caustics": 0}


def box(size: tuple[float, float, float], at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> str:
    """A cube of these half sides at a place."""
    return CUBE(extra=f"""double3 xformOp:translate = {at}
        double3 xformOp:scale = {size}
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]""")


def asked(**values: Any) -> rc.RenderSettings:
    return rc.RenderSettings(**values)


def eye_of(scene: Scene, camera: Camera) -> F64:
    """In the stage's own world and units."""
    return to_stage(scene, camera.world_from_camera[:3, 3])


def in_picture(camera: Camera, wanted: rc.RenderSettings, points: F64) -> F64:
    """Places of points [m] in the picture, -1 .. 1 from edge to edge, shape (N, 2)."""
    view = view_of(camera, *image_size(camera, wanted.image_width, wanted.image_height))
    at = points - view.axes[3]
    x, y = (at @ view.axes[k] / (at @ view.axes[2]) for k in (0, 1))
    left, right, bottom, top = view.window
    return np.stack([(2 * x - left - right) / (right - left), (2 * y - bottom - top) / (top - bottom)], axis=1)


def corners_of(scene: Scene) -> F64:
    low, high = np.array(scene.bounds)
    return np.asarray((low + high) / 2 + CORNERS * (high - low) / 2)


# --- angles -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("unit", [0.01, 1.0])
@pytest.mark.parametrize(
    ("up", "azimuth", "elevation", "side"),
    [
        ("Y", 0, 0, (0, 0, 1)), ("Y", 90, 0, (1, 0, 0)), ("Y", 180, 0, (0, 0, -1)), ("Y", -90, 0, (-1, 0, 0)),
        ("Y", 0, 90, (0, 1, 0)), ("Y", 0, -90, (0, -1, 0)), ("Z", 0, 0, (0, -1, 0)), ("Z", 90, 0, (1, 0, 0)),
        ("Z", 180, 0, (0, 1, 0)), ("Z", 0, 90, (0, 0, 1)),
        ("Y", 45, 30, (math.sqrt(0.375), 0.5, math.sqrt(0.375))),
    ],
)  # fmt: skip
def test_angles_are_in_the_upright_of_the_stage(
    up: str, azimuth: float, elevation: float, side: tuple[float, ...], unit: float
) -> None:
    scene = read(box((1, 2, 3), (5, 6, 7)), up=up, unit=unit)
    camera = camera_of(scene, asked(azimuth=azimuth, elevation=elevation, distance=40.0))
    assert eye_of(scene, camera) == pytest.approx(np.array([5, 6, 7]) + 40.0 * np.array(side), abs=1e-4)
    middle = in_picture(camera, asked(), corners_of(scene).mean(axis=0, keepdims=True))
    assert middle == pytest.approx(np.zeros((1, 2)), abs=1e-9)


@pytest.mark.parametrize("elevation", [-90.0, -20.0, 0.0, 65.0, 90.0])
def test_the_picture_stands_upright(elevation: float) -> None:
    scene = read(box((1, 1, 1)))
    pose = camera_of(scene, asked(azimuth=77.0, elevation=elevation)).world_from_camera[:3, :3]
    assert pose @ pose.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(pose) == pytest.approx(1.0)
    assert pose[1, 0] == 0.0  # what is to the right is no higher
    assert pose[1, 1] >= -1e-12


def test_a_whole_turn_is_no_turn() -> None:
    scene = read(box((1, 2, 3)))
    poses = [camera_of(scene, asked(azimuth=12.5 + turn)).world_from_camera for turn in (0.0, 360.0, -360.0)]
    assert (poses[0] == poses[1]).all()
    assert poses[2] == pytest.approx(poses[0], abs=1e-12)
    first, last = (rc.render(scene, asked(**QUICK, azimuth=a)).planes["beauty"] for a in (0.0, 360.0))
    assert (first == last).all()


def test_the_same_thing_is_seen_whichever_axis_is_up() -> None:
    """A box built in Y-up, and the same box built in Z-up (x, y, z) -> (x, -z, y), from one side."""
    wanted = asked(**QUICK, azimuth=130.0, elevation=35.0, look_at="/C")
    y_up = rc.render(read(box((1, 2, 3), (4, 5, 6)), up="Y"), wanted).planes
    z_up = rc.render(read(box((1, 3, 2), (4, -6, 5)), up="Z"), wanted).planes
    assert (y_up["beauty"][..., 3] > 0.0).any()
    for name in ("beauty", "Z"):  # but where a pixel's middle is on an edge
        assert np.isclose(y_up[name], z_up[name], rtol=1e-5, atol=1e-5).mean() > 0.99


# --- frames -------------------------------------------------------------------------------------------------------

sides = st.sampled_from([0.0, 0.2, 1.0, 9.0])


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(sides, sides, sides).filter(lambda size: sorted(size)[1] > 0.0), st.floats(-720, 720), st.floats(-90, 90),
    st.sampled_from([(300, 0), (300, 300), (300, 900), (900, 300)]), st.sampled_from([10.0, 50.0, 200.0]),
)  # fmt: skip
def test_at_fit_1_the_frame_touches_what_it_frames(
    size: tuple[float, ...], azimuth: float, elevation: float, picture: tuple[int, int], lens: float
) -> None:
    scene = Scene((), (), bounds=((-size[0], -size[1], 0.0), (size[0], size[1], size[2])))
    wanted = asked(
        image_width=picture[0], image_height=picture[1], azimuth=azimuth, elevation=elevation, focal_length=lens, fit=1
    )
    seen = np.abs(in_picture(camera_of(scene, wanted), wanted, corners_of(scene)))
    assert seen.max() == pytest.approx(1.0, abs=1e-2 if picture[1] == 0 else 1e-6)  # a height is a whole number


def test_a_line_that_is_looked_along_is_before_the_camera() -> None:
    scene = Scene((), (), bounds=((0.0, 0.0, -9.0), (0.0, 0.0, 9.0)))
    camera = camera_of(scene, asked(azimuth=0.0, elevation=0.0, fit=1.0))
    assert camera.world_from_camera[2, 3] > 9.0


@pytest.mark.parametrize("picture", [(300, 0), (300, 300), (300, 900), (900, 300)])
def test_without_a_word_the_thing_fills_the_picture_and_has_air(picture: tuple[int, int]) -> None:
    scene = read(box((1, 5, 2)))
    wanted = asked(image_width=picture[0], image_height=picture[1])
    assert 0.8 < np.abs(in_picture(camera_of(scene, wanted), wanted, corners_of(scene))).max() < 0.99


def test_the_automatic_camera_is_the_model_with_its_default_numbers() -> None:
    scene = read(box((1, 5, 2)))
    by_itself, by_words = camera_of(scene, asked()), camera_of(scene, asked(azimuth=30, elevation=20, fit=1.1))
    assert (by_itself.world_from_camera == by_words.world_from_camera).all()
    assert by_itself.window == by_words.window == scene.cameras[0].window
    assert (by_itself.world_from_camera == scene.cameras[0].world_from_camera).all()
    assert by_words.window == camera_of(scene, asked(focal_length=50)).window


def test_a_field_of_view_is_that_of_the_pictures_width() -> None:
    scene = read(box((1, 1, 1)))
    for height in (0, 100, 900):
        view = view_of(camera_of(scene, asked(fov=70.0, image_height=height)), 960, height or 701)
        assert 2 * math.degrees(math.atan(view.window[1])) == pytest.approx(70.0, abs=0.05)
    same = 20.955 / 2 / math.tan(math.radians(35.0))
    assert camera_of(scene, asked(focal_length=same)).window == pytest.approx(camera_of(scene, asked(fov=70.0)).window)


TWO = box((1, 1, 1)).replace('"C"', '"Near"') + box((2, 2, 2), (50, 0, 0)).replace('"C"', '"Far"')


def test_a_prim_that_is_looked_at_is_framed_and_a_point_is_in_the_middle() -> None:
    scene = read(TWO)
    wanted = asked(look_at="/Far", fit=1.0)
    camera = camera_of(scene, wanted)
    far = scene.meshes[[mesh.path for mesh in scene.meshes].index("/Far")]
    assert np.abs(in_picture(camera, wanted, far.points.astype(np.float64))).max() == pytest.approx(1.0, abs=1e-2)
    wanted = asked(look_at=(50.0, 2.0, 0.0))
    engine = np.linalg.inv(scene.stage_from_engine) @ (50.0, 2.0, 0.0, 1.0)
    camera = camera_of(scene, wanted)
    assert in_picture(camera, wanted, engine[None, :3]) == pytest.approx(np.zeros((1, 2)), abs=1e-6)
    assert np.abs(in_picture(camera, wanted, corners_of(scene))).max() <= 1.0  # of a point, everything is in the frame


def test_what_stands_in_many_places_can_be_looked_at() -> None:
    text = f"""def PointInstancer "Many" {{
        rel prototypes = </Many/Proto>
        int[] protoIndices = {[0] * 4000}
        point3f[] positions = {[(3.0 * k, 0, 0) for k in range(4000)]}
        def Xform "Proto" {{ {CUBE()} }} }}"""
    scene = read(text)
    assert scene.instances
    one = camera_of(scene, asked(look_at="/Many/[3999]", distance=10.0, azimuth=0, elevation=0))
    assert eye_of(scene, one) == pytest.approx((11997.0, 0.0, 10.0), abs=1e-2)
    assert eye_of(scene, camera_of(scene, asked(look_at="/Many", distance=10.0)))[0] == pytest.approx(5998.5, abs=0.1)


# --- a start from a camera of the stage ----------------------------------------------------------------------------

HERO = """def Camera "Hero" {
    float focalLength = 85
    double3 xformOp:translate = (0, 2, 30)
    float xformOp:rotateX = 4
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]
    EXTRA }
"""


def hero(extra: str = "") -> Scene:
    return read(box((1, 2, 3)) + HERO.replace("EXTRA", extra), camera="Hero")


def test_cameras_of_the_stage_are_passed_over_where_none_is_named() -> None:
    scene, alone = hero(), read(box((1, 2, 3)))
    wanted = asked(azimuth=20.0)
    assert (camera_of(scene, wanted).world_from_camera == camera_of(alone, wanted).world_from_camera).all()
    assert camera_of(scene, asked()).path == "/Hero"


def test_a_stages_own_settings_name_no_start() -> None:
    assert chosen_settings({"camera": "/Hero"}, {"azimuth": 20.0}).camera == ""
    assert chosen_settings({"camera": "/Hero"}, {"azimuth": 20.0, "camera": "/Other"}).camera == "/Other"
    assert chosen_settings({"camera": "/Hero"}, {}).camera == "/Hero"


def test_from_a_camera_what_is_not_said_stays() -> None:
    scene = hero()
    start = scene.cameras[0]
    lens = camera_of(scene, asked(camera="Hero", fov=60.0))
    assert (lens.world_from_camera == start.world_from_camera).all()
    left, right, bottom, top = lens.window
    assert right - left == pytest.approx(2 * math.tan(math.radians(30)))
    assert (top - bottom) / (right - left) == pytest.approx(15.2908 / 20.955)
    turned = camera_of(scene, asked(camera="Hero", azimuth=90.0))
    assert turned.window == start.window
    # It looks at the point of its axis that is nearest to the middle of everything, from as far as before.
    eye, forward = start.world_from_camera[:3, 3], -start.world_from_camera[:3, 2]
    target = eye + forward * float((np.array(scene.bounds).mean(axis=0) - eye) @ forward)
    away = turned.world_from_camera[:3, 3] - target
    assert np.linalg.norm(away) == pytest.approx(np.linalg.norm(eye - target))
    assert math.degrees(math.atan2(away[0], away[2])) == pytest.approx(90.0)
    assert away[1] == pytest.approx((eye - target)[1])


def test_turning_a_camera_to_where_it_is_leaves_the_picture() -> None:
    scene = hero()
    azimuth, elevation = 0.0, -4.0
    same = camera_of(scene, asked(camera="Hero", azimuth=azimuth, elevation=elevation))
    assert same.world_from_camera == pytest.approx(scene.cameras[0].world_from_camera, abs=1e-6)


def test_an_orthographic_camera_turns_and_fits_but_has_no_lens() -> None:
    scene = hero('token projection = "orthographic"')
    with pytest.raises(UsageError, match=r"fov .* orthographic"):
        camera_of(scene, asked(camera="Hero", fov=40.0))
    wanted = asked(camera="Hero", azimuth=30.0, elevation=10.0, fit=1.0)
    camera = camera_of(scene, wanted)
    at = (corners_of(scene) - camera.world_from_camera[:3, 3]) @ camera.world_from_camera[:3, :3]
    left, right, bottom, top = camera.window
    assert max(np.abs(at[:, 0] / right).max(), np.abs(at[:, 1] / top).max()) == pytest.approx(1.0)
    assert (left, bottom) == (-right, -top)


# --- several cameras ------------------------------------------------------------------------------------------------

CAMERAS = """#usda 1.0
(
    metersPerUnit = 1
)
def Cube "C"
{
    color3f[] primvars:displayColor = [(0.2, 0.5, 0.9)]
}
def Camera "Front"
{
    double3 xformOp:translate = (0, 0, 12)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
def Camera "Side"
{
    double3 xformOp:translate = (12, 3, 0)
    float xformOp:rotateY = 90
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateY"]
}
"""
SMALL = ("-w", "24", "--samples", "1")


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    path = tmp_path / "stage.usda"
    path.write_text(CAMERAS)
    return path


def refract(*words: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, [str(word) for word in words])
    return done.exit_code, done.output


def test_every_camera_that_is_named_has_its_picture(stage: Path) -> None:
    folder = stage.parent
    code, said = refract("render", stage, folder / "p.{camera}.exr", "--camera", "/Side", "--camera", "Front", *SMALL)
    assert code == 0, said
    assert {path.name for path in folder.glob("p.*")} == {"p.Side.exr", "p.Front.exr"}
    for name in ("Side", "Front"):
        assert refract("render", stage, folder / f"{name}.exr", "--camera", name, *SMALL)[0] == 0
        assert (folder / f"{name}.exr").read_bytes() == (folder / f"p.{name}.exr").read_bytes()


def test_names_of_files_tell_cameras_apart() -> None:
    def names(*cameras: str) -> list[str]:
        return [out for _, out in outs_of(Order(stage="s", out="a/{camera}.##.png", cameras=cameras))]

    assert names("/A/One", "Two") == ["a/One.##.png", "a/Two.##.png"]
    assert names("/A/Cam", "/B/Cam") == ["a/A_Cam.##.png", "a/B_Cam.##.png"]
    assert names("Cam", "Cam") == ["a/Cam.##.png"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--camera", "Front", "--camera", "Side"), "{camera}"),
        (("--azimuth", "nan"), "--azimuth is nan"),
        (("--elevation", "91"), "--elevation is 91.0; it must be between -90.0 and 90.0"),
        (("--distance", "0"), "--distance is 0.0"),
        (("--fov", "180"), "--fov is 180.0"),
        (("--distance", "2", "--fit", "1"), "--distance says what fit says, too"),
        (("--fov", "40", "--focal-length", "35"), "--fov says what focal length says, too"),
        (("--look-at", "World"), "--look-at is 'World'"),
        (("--look-at", "1,2"), "--look-at is (1.0, 2.0)"),
        (("--look-at", "/Nobody"), "--look-at is /Nobody, but nothing is drawn there"),
        (("--camera", "Nobody", "--azimuth", "3"), "camera 'Nobody' does not exist"),
    ],
)
def test_what_cannot_be_is_said_in_one_sentence(stage: Path, words: tuple[str, ...], said: str) -> None:
    code, output = refract("render", stage, stage.parent / "out.png", *words, *SMALL)
    assert code == 2
    assert said in output
    assert output.count("error") == 1
    assert not (stage.parent / "out.png").exists()


def test_a_name_for_cameras_needs_cameras(stage: Path) -> None:
    code, output = refract("render", stage, stage.parent / "out.{camera}.png", *SMALL)
    assert code == 2
    assert "needs --camera" in output


def test_a_camera_of_its_own_says_nothing_of_those_of_the_stage(stage: Path) -> None:
    _, chosen = refract("render", stage, stage.parent / "a.exr", *SMALL)
    code, own = refract("render", stage, stage.parent / "b.exr", "--azimuth", "200", *SMALL)
    assert code == 0
    assert "cameras" in chosen
    warned = " ".join(line for line in own.splitlines() if line.startswith("warning: "))
    assert "camera" not in warned.replace("the camera lights it", "").replace("--disable-camera-light", "")
    seen = [read_planes(str(stage.parent / name))["beauty"] for name in ("a.exr", "b.exr")]
    assert (seen[0] != seen[1]).any()
