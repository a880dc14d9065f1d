"""What is put around a thing that comes without light: laws of studios, of surroundings from a file, of backgrounds."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from numpy.typing import NDArray
from scenes import camera, dome, draw, glass, light, material, scene, surrounding
from typer.testing import CliRunner

import refract_core as rc
from refract_core.cli import app
from refract_core.rendering.ready import choose_camera
from refract_core.scene import LightKind, Model, Sphere
from refract_core.settings import PRESETS, named_settings
from refract_core.studio.compose import dressed, turned_to, with_studio
from refract_core.studio.domes import ROWS, SETS, directions, dome_of

BALL = Sphere("/ball", (0.0, 0.0, 0.0), 0.6, 0)
STUDIOS = sorted(SETS)
SMALL: dict[str, Any] = {"image_width": 40, "image_height": 30, "samples": 4, "jobs": 1, "caustics": 0}
RED = (0.6, 0.1, 0.1)


def alone(*, clear: bool = True, **fields: Any) -> rc.Scene:
    """A ball without any light."""
    kind = glass(Model.TRACED) if clear else material("/red", DIFFUSE=RED)
    return scene([], [kind], [BALL], **{"camera_light": True, **fields})


def _write(path: Path, pixels: NDArray[np.float32]) -> None:
    height, width = pixels.shape[:2]
    file = oiio.ImageOutput.create(str(path))
    assert file is not None
    assert file.open(str(path), oiio.ImageSpec(width, height, 3, oiio.FLOAT))
    assert file.write_image(pixels)
    assert file.close()


def frame(what: rc.Scene, **settings: Any) -> rc.Frame:
    return rc.render(what, rc.RenderSettings(**{**SMALL, **settings}))


# --- when it comes by itself ----------------------------------------------------------------------------------------

LIT: dict[str, Callable[[], rc.Scene]] = {
    "a lamp": lambda: alone(
        clear=False, camera_light=False, lights=(light(LightKind.SPHERE, (0, 2, 2), (0, -1, 0), (0.2, 0.0), 50.0),)
    ),
    "a dome": lambda: alone(camera_light=False, environment=dome(0.5)),
    "its own glow": lambda: scene([], [material("/glow", EMISSIVE=RED)], [BALL]),
    "probes": lambda: alone(clear=False, probes=(surrounding(),)),
    "a room around the camera": lambda: alone(clear=False, bounds=((-5, -5, -5), (5, 5, 5))),
    "a camera that looks away": lambda: alone(clear=False, cameras=(camera((0, 0, 2.5), (0, 0, 9)),)),
}


@pytest.mark.parametrize("what", LIT)
def test_where_something_shines_or_one_stands_within_nothing_is_added(what: str) -> None:
    """Bit by bit what `none` draws, and nothing said."""
    one, two = frame(LIT[what]()), frame(LIT[what](), studio="none")
    for name, plane in one.planes.items():
        np.testing.assert_array_equal(plane, two.planes[name], err_msg=name)
    assert one.notices == two.notices


def test_a_thing_alone_gets_soft_boxes_and_it_is_said_once() -> None:
    by_itself, asked = frame(alone()), frame(alone(), studio="softbox")
    np.testing.assert_array_equal(by_itself.planes["beauty"], asked.planes["beauty"])
    assert len([note for note in by_itself.notices if "--studio none" in note.text]) == 1
    assert not [note for note in asked.notices if "studio" in note.text]
    assert (by_itself.planes["beauty"][..., 3] == 1.0).all()


def test_no_light_from_the_camera_means_no_studio_either() -> None:
    planes = frame(alone(clear=False), camera_light=False).planes
    assert planes["beauty"][..., :3].max() == 0.0
    assert planes["beauty"][..., 3].min() == 0.0


@pytest.mark.parametrize("preset", PRESETS)
def test_pictures_of_other_renderers_get_none(preset: str) -> None:
    asked = rc.RenderSettings(**named_settings(preset=preset))
    what = alone()
    dark, notices = dressed(what, choose_camera(what, ""), asked)
    assert dark.environment is None
    assert dark.camera_light
    assert not notices


def test_a_studio_that_is_asked_for_keeps_the_light_of_the_stage() -> None:
    what = LIT["a lamp"]()
    both = with_studio(what, what.cameras[0], "softbox")
    assert both.lights[0] == what.lights[0]


# --- size, place, direction -----------------------------------------------------------------------------------------

STAGE = """#usda 1.0
(
    metersPerUnit = {unit}
    upAxis = "{up}"
)
def Sphere "Glass" (prepend apiSchemas = ["MaterialBindingAPI"])
{{
    double radius = 2
    double3 xformOp:translate = {place}
    uniform token[] xformOpOrder = ["xformOp:translate"]
    rel material:binding = </M>
}}
def Sphere "Red"
{{
    color3f[] primvars:displayColor = [(0.6, 0.1, 0.1)]
}}
def Material "M"
{{
    token outputs:surface.connect = </M/S.outputs:surface>
    def Shader "S"
    {{
        uniform token info:id = "UsdPreviewSurface"
        float inputs:opacity = 0
        float inputs:roughness = 0
        token outputs:surface
    }}
}}
"""


def _stage(folder: Path, name: str, **how: Any) -> rc.Scene:
    path = folder / f"{name}.usda"
    path.write_text(STAGE.format(**{"unit": 1, "up": "Y", "place": (3, 1, -1), **how}))
    return rc.load_stage(path)


@pytest.mark.parametrize("studio", STUDIOS)
def test_how_large_a_thing_is_does_not_matter(studio: str, tmp_path: Path) -> None:
    settings = {"studio": studio, "caustics": 1 << 12}
    usual = frame(_stage(tmp_path, "usual"), **settings).planes["beauty"]
    # By powers of two all but lengths that are cut into even cells is the same; by others, floats round otherwise, and
    # the few rays that see a part of a lamp are others.
    for unit, apart in ((2.0**-10, 1e-3), (2.0**10, 1e-3), (0.001, 8e-3), (1000.0, 8e-3)):
        other = frame(_stage(tmp_path, f"other{unit}", unit=unit), **settings).planes["beauty"]
        assert np.abs(other - usual).mean() < apart


@pytest.mark.parametrize("studio", STUDIOS)
def test_the_axis_that_points_up_does_not_matter(studio: str, tmp_path: Path) -> None:
    usual = frame(_stage(tmp_path, "y"), studio=studio).planes["beauty"]
    turned = frame(_stage(tmp_path, "z", up="Z", place=(3, 1, 1)), studio=studio).planes["beauty"]
    assert np.abs(turned - usual).mean() < 2e-3


@pytest.mark.parametrize("studio", STUDIOS)
def test_the_studio_faces_the_camera_from_wherever_it_looks(studio: str) -> None:
    """A ball of one colour looks the same from all around."""
    eyes = [(4 * math.sin(a), 1.5, 4 * math.cos(a)) for a in (0.0, 2.0, 4.0)]
    pictures = [frame(alone(clear=False, cameras=(camera(eye, aspect=4 / 3),)), studio=studio) for eye in eyes]
    for other in pictures[1:]:
        assert np.abs(other.planes["beauty"] - pictures[0].planes["beauty"]).mean() < 4e-3


@pytest.mark.parametrize("height", [0.0, 0.3, 5.0, 1e9, -5.0, -1e9])
def test_front_is_where_the_bottom_of_the_picture_is(height: float) -> None:
    """From above and from below, up to straight down and straight up."""
    seen = camera((1.0, height, 0.0)) if abs(height) < 1e8 else camera((0.0, height, 0.0))
    front = turned_to(seen)[:, 2]
    pose = seen.world_from_camera
    np.testing.assert_allclose(np.linalg.norm(front), 1.0)
    assert front[1] == 0.0
    if abs(height) < 1e8:
        np.testing.assert_allclose(front, [1.0, 0.0, 0.0], atol=1e-9)
    else:
        np.testing.assert_allclose(front, -np.sign(height) * pose[:3, 1], atol=1e-9)


# --- the floor ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("studio", STUDIOS)
def test_nobody_sees_where_the_floor_ends(studio: str) -> None:
    """At its rim it looks as the lower half of the dome, which is what one sees past it, where the thing's own shadow
    does not fall; but for what a narrow box loses in the coarse map of a dome's irradiance."""
    speck = scene([], [material("/red", DIFFUSE=RED)], [replace(BALL, radius=0.01)])
    rim = camera((0.079, 0.5, 0.0), (0.079, 0.0, 0.0), fov=1e-4)
    what = replace(with_studio(speck, camera((0, 0, 1)), studio), cameras=(rim,), spheres=())
    planes = draw(what, 9, 9, light_samples=256, samples=64, tolerance=0.0)
    assert (planes["Z"] < np.inf).all()
    below = dome_of(studio)[-1, 0]
    np.testing.assert_allclose(planes["beauty"][..., :3].mean((0, 1)), below, rtol=0.01)


@pytest.mark.parametrize("studio", STUDIOS)
def test_the_horizon_does_not_show(studio: str) -> None:
    """Behind the thing, up to 40 degrees to the sides."""
    around, d = dome_of(studio), directions(ROWS)
    assert (d[ROWS // 2 :, :, 1] < 0.0).all()
    behind = d[ROWS // 2, :, 2] < -math.cos(math.radians(40.0))
    above, below = around[ROWS // 2 - 1][behind], around[ROWS // 2][behind]
    np.testing.assert_allclose(above, below, rtol=0.03)
    assert (around[ROWS // 2 :] == around[-1, 0]).all()


def test_things_stand_on_the_floor_and_cast_their_shadow_on_it() -> None:
    """Right under a ball it is darker than beside it."""
    seen = camera((0.0, 1.2, 4.0), (0.0, -0.4, 0.0), fov=0.35)
    what = with_studio(alone(clear=False, cameras=(seen,)), seen, "softbox")
    planes = draw(what, 64, 64, light_samples=64)
    floor = planes["P"][..., 1] < -0.6
    at = np.hypot(planes["P"][..., 0], planes["P"][..., 2])
    grey = planes["beauty"][..., 1]
    assert grey[floor & (at < 0.35)].mean() < 0.7 * grey[floor & (at > 1.2)].mean()


def test_a_camera_under_the_floor_looks_through() -> None:
    low = camera((0.0, -2.0, 3.0))
    what = with_studio(alone(cameras=(low,)), low, "softbox")
    assert not what.meshes
    assert what.environment is not None


# --- backgrounds ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("studio", STUDIOS)
def test_a_transparent_background_has_no_alpha_beside_the_thing(studio: str) -> None:
    planes = frame(alone(clear=False), studio=studio, background="transparent").planes
    beside = planes["Z"] == np.inf
    assert beside.any()
    assert planes["beauty"][0, 0].tolist() == [0.0, 0.0, 0.0, 0.0]
    solid = planes["beauty"][15, 20]
    assert solid[3] == 1.0
    assert solid[:3].min() > 0.0


@pytest.mark.parametrize("model", [Model.TRACED, Model.SPHERE, Model.THIN])
@pytest.mark.parametrize("studio", STUDIOS)
def test_glass_that_is_left_open_composes_over_a_colour(studio: str, model: Model) -> None:
    """A over B is A + (1 - alpha) B: the open picture over grey is the picture before grey."""
    grey = ((0x80 / 255.0 + 0.055) / 1.055) ** 2.4
    what = scene([], [glass(model)], [BALL])
    settings = {"studio": studio, "samples": 1, "cut": 0.0}
    clear = frame(what, background="transparent", **settings).planes["beauty"]
    before = frame(what, background="#808080", **settings).planes["beauty"]
    over = clear[..., :3] + (1.0 - clear[..., 3:]) * grey
    np.testing.assert_allclose(over, before[..., :3], atol=2e-6)
    inside = clear[15, 20]
    assert 0.0 < inside[3] < 0.2
    assert (before[..., 3] > 1.0 - 1e-6).all()


def test_what_a_mirror_shows_is_the_studio_and_no_background() -> None:
    mirror = scene([], [material("/metal", METALLIC=1.0, DIFFUSE=0.9, ROUGHNESS=0.0)], [BALL])
    open_, white = (
        frame(mirror, studio="softbox", samples=1, background=b).planes["beauty"] for b in ("transparent", "#ffffff")
    )
    on = open_[..., 3] == 1.0
    np.testing.assert_array_equal(open_[on], white[on])
    assert open_[on][:, :3].max() > 2.0  # a soft box


@pytest.mark.parametrize("exposure", [0.0, 1.5])
def test_a_colour_is_that_colour_in_the_file(exposure: float) -> None:
    planes = frame(alone(), studio="softbox", background="#3366cc", exposure=exposure).planes
    shown = planes["beauty"][0, 0, :3]
    wanted = [((c / 255.0 + 0.055) / 1.055) ** 2.4 for c in (0x33, 0x66, 0xCC)]
    np.testing.assert_allclose(shown, wanted, rtol=1e-5)


def test_a_background_hides_the_stage_s_own_dome_but_not_its_light() -> None:
    what = alone(clear=False, camera_light=False, environment=dome(1.0))
    seen, hidden = frame(what).planes["beauty"], frame(what, background="transparent").planes["beauty"]
    ball = hidden[..., 3] == 1.0
    assert hidden[0, 0, 3] == 0.0
    np.testing.assert_array_equal(seen[ball], hidden[ball])


# --- surroundings from a file ---------------------------------------------------------------------------------------


def test_surroundings_of_one_radiance_make_clear_glass_invisible(tmp_path: Path) -> None:
    """The white furnace, from a file, in place of what the stage has."""
    path = tmp_path / "even.exr"
    _write(path, np.full((8, 16, 3), 0.75, np.float32))
    what = alone(camera_light=False, environment=dome(0.1))
    shown = frame(what, environment=str(path), cut=0.0, max_layers=32).planes["beauty"]
    np.testing.assert_allclose(shown[..., :3], 0.75, atol=2e-3)
    assert not [note for note in frame(alone(), environment=str(path)).notices if "studio" in note.text]


def test_a_file_that_is_not_latlong_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "square.exr"
    _write(path, np.ones((8, 8, 3), np.float32))
    with pytest.raises(rc.ImageError, match="twice as wide as high"):
        frame(alone(), environment=str(path))
    with pytest.raises(rc.UsageError, match="no such file"):
        frame(alone(), environment=str(tmp_path / "nowhere.hdr"))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"studio": "beach"}, "softbox"),
        ({"background": "white"}, "#rrggbb"),
        ({"background": "#12345"}, "#rrggbb"),
        ({"studio": "dark", "environment": "a.hdr"}, "choose one"),
    ],
)
def test_what_cannot_be_is_one_sentence(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(rc.UsageError, match=words):
        rc.RenderSettings(**settings)


def test_the_command_line_says_and_takes_it(tmp_path: Path) -> None:
    stage = tmp_path / "thing.usda"
    stage.write_text(STAGE.format(unit=1, up="Y", place=(3, 1, -1)))
    words = ["render", str(stage), str(tmp_path / "a.png"), "-w", "32", "--samples", "1"]
    by_itself = CliRunner().invoke(app, words)
    assert (by_itself.exit_code, by_itself.stderr.count("--studio none")) == (0, 1)
    asked = CliRunner().invoke(app, [*words, "--studio", "dark", "--background", "#ffffff"])
    assert (asked.exit_code, asked.stderr.count("studio")) == (0, 0)
    assert CliRunner().invoke(app, [*words, "--studio", "beach"]).exit_code == 2
