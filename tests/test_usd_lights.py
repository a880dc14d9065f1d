"""UsdLux lights: emission, size and place against the UsdLux documents, and domes against OpenEXR's latlong words."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from numpy.typing import NDArray
from pxr import Usd, UsdLux

from refract_core.scene import Environment, Light, LightKind, Notice, Param
from refract_core.usd.lights.domes import directions, linear, lookup
from refract_core.usd.lights.ies import Ies, parse, profile
from refract_core.usd.lights.read import read_lights
from refract_core.usd.materials.textures import read_texture
from refract_core.usd.stage import scene_from_stage

IDENTITY = np.eye(4)
Read = tuple[tuple[Light, ...], Environment | None, list[Notice]]


def read(
    text: str | Usd.Stage, *, engine_from_stage: NDArray[np.float64] = IDENTITY, metres_per_unit: float = 1.0,
    up: str = "Y", purposes: tuple[str, ...] = ("default", "render"), time: float = 0.0,
) -> Read:  # fmt: skip
    if isinstance(text, str):
        stage = Usd.Stage.CreateInMemory()
        stage.GetRootLayer().ImportFromString(f'#usda 1.0\n(\n    upAxis = "{up}"\n)\n{text}\n')
    else:
        stage = text
    notices: list[Notice] = []
    lights, environment = read_lights(
        stage, Usd.TimeCode(time), engine_from_stage=engine_from_stage, metres_per_unit=metres_per_unit,
        purposes=purposes, notices=notices,
    )  # fmt: skip
    return lights, environment, notices


def one(kind: str, inputs: str = "", **how: object) -> Light:
    lights, _, notices = read(f'def {kind} "L"\n{{\n{inputs}\n}}', **how)  # type: ignore[arg-type]
    assert not notices
    return lights[0]


MOVED = """
    double3 xformOp:translate = (1, 2, 3)
    double3 xformOp:rotateXYZ = (0, 90, 0)
    double3 xformOp:scale = (2, 2, 2)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateXYZ", "xformOp:scale"]
"""


def test_defaults_are_those_of_the_usdlux_schema() -> None:
    assert one("DistantLight").radiance == (50000.0,) * 3
    assert one("DistantLight").size[0] == pytest.approx(math.radians(0.53))
    assert one("SphereLight").size[0] == one("DiskLight").size[0] == 0.5
    assert one("RectLight").size == (1.0, 1.0)
    for kind in ("SphereLight", "RectLight", "DiskLight"):
        light = one(kind)
        assert light.radiance == (1.0,) * 3
        assert (light.diffuse, light.specular) == (1.0, 1.0)


def test_emission_is_color_times_intensity_times_two_to_the_exposure() -> None:
    light = one("RectLight", """
        float inputs:intensity = 3
        float inputs:exposure = 2
        color3f inputs:color = (1, 0.5, 0.25)
        float inputs:diffuse = 0.5
        float inputs:specular = 0
    """)  # fmt: skip
    assert light.radiance == pytest.approx((12, 6, 3))
    assert (light.diffuse, light.specular) == (0.5, 0.0)


def test_colour_temperature_multiplies_only_where_enabled() -> None:
    warm = "float inputs:colorTemperature = 3200\n"
    assert one("RectLight", warm).radiance == (1.0,) * 3
    assert one("RectLight", warm + "bool inputs:enableColorTemperature = 1").radiance == pytest.approx(
        (1.68, 0.866, 0.326), abs=5e-3
    )


@pytest.mark.parametrize("kelvin", ["nan", "-5", "1e9"])
def test_an_impossible_colour_temperature_is_named(kelvin: str) -> None:
    text = f"float inputs:colorTemperature = {kelvin}\nbool inputs:enableColorTemperature = 1"
    lights, _, notices = read(f'def RectLight "L"\n{{\n{text}\n}}')
    assert "colorTemperature" in notices[0].text
    assert all(math.isfinite(c) and c > 0 for c in lights[0].radiance[:1])


@pytest.mark.parametrize(
    ("kind", "inputs", "area"),
    [
        ("SphereLight", "float inputs:radius = 3", 4 * math.pi * 9),
        ("DiskLight", "float inputs:radius = 3", math.pi * 9),
        ("RectLight", "float inputs:width = 3\nfloat inputs:height = 5", 15.0),
    ],
)
@pytest.mark.parametrize("metres_per_unit", [1.0, 0.01])
def test_normalize_divides_by_the_world_area_in_stage_units(
    kind: str, inputs: str, area: float, metres_per_unit: float
) -> None:
    scale = np.diag([metres_per_unit] * 3 + [1.0])
    text = inputs + "\nfloat inputs:intensity = 7\nbool inputs:normalize = 1" + MOVED
    light = one(kind, text, engine_from_stage=scale, metres_per_unit=metres_per_unit)
    assert light.radiance[0] == pytest.approx(7 / (4 * area))  # the transform doubles every length


@pytest.mark.parametrize(("degrees", "size_factor"), [
    (0.0, 1.0),
    (0.53, math.pi * math.sin(math.radians(0.265)) ** 2),
    (180.0, math.pi),
    (240.0, math.pi * (2 - math.sin(math.radians(120)) ** 2)),
])  # fmt: skip
def test_a_normalized_distant_light_follows_usdlux(degrees: float, size_factor: float) -> None:
    text = f"float inputs:angle = {degrees}\nfloat inputs:intensity = 2\nbool inputs:normalize = 1"
    light = one("DistantLight", text)
    assert light.radiance[0] == pytest.approx(2 / size_factor)


def test_place_and_direction_follow_the_transform_into_the_engine() -> None:
    engine_from_stage = np.array([[0.1, 0, 0, 5], [0, 0, 0.1, 6], [0, -0.1, 0, 7], [0, 0, 0, 1.0]])  # Z-up, decimetres
    light = one("RectLight", MOVED, engine_from_stage=engine_from_stage, metres_per_unit=0.1)
    # Rotated 90 degrees about +Y, the emission axis -Z of the light is -X of the stage.
    assert -light.world_from_light[:3, 2] == pytest.approx([-1, 0, 0], abs=1e-12)
    assert light.world_from_light[:3, 3] == pytest.approx([5.1, 6.3, 6.8])
    assert light.size == pytest.approx((0.2, 0.2))
    assert light.world_from_light[:3, :3] @ light.world_from_light[:3, :3].T == pytest.approx(np.eye(3))


def test_mirroring_keeps_the_emission_axis_and_a_right_handed_frame() -> None:
    mirrored = 'double3 xformOp:scale = (1, 1, -1)\nuniform token[] xformOpOrder = ["xformOp:scale"]'
    frame = one("DiskLight", mirrored).world_from_light
    assert -frame[:3, 2] == pytest.approx([0, 0, 1])
    assert np.linalg.det(frame) == pytest.approx(1.0)


def test_a_rectangle_scaled_unevenly_keeps_its_sides() -> None:
    scaled = 'double3 xformOp:scale = (2, 5, 0)\nuniform token[] xformOpOrder = ["xformOp:scale"]'
    light = one("RectLight", scaled)
    assert light.size == pytest.approx((2, 5))
    assert light.world_from_light[:3, 2] == pytest.approx([0, 0, 1])


def test_a_point_gives_the_irradiance_of_the_sphere_it_stands_for() -> None:
    sphere = one("SphereLight", "float inputs:radius = 0.25\nfloat inputs:intensity = 3")
    point = one("SphereLight", "float inputs:radius = 0.25\nfloat inputs:intensity = 3\nbool treatAsPoint = 1")
    far = 1000.0
    assert point.size == (0.0, 0.0)
    assert point.radiance[0] / far**2 == pytest.approx(math.pi * sphere.radiance[0] * (sphere.size[0] / far) ** 2)
    for radius in (0.0, 0.5, 2.0):
        text = f"float inputs:radius = {radius}\nbool inputs:normalize = 1\nbool treatAsPoint = 1"
        assert one("SphereLight", text).radiance[0] == pytest.approx(0.25)


@pytest.mark.parametrize(
    "inputs",
    ["float inputs:intensity = nan", "float inputs:intensity = -1", "float inputs:exposure = inf",
     "color3f inputs:color = (1, -1, 1)", "float inputs:exposure = 2000"],
)  # fmt: skip
def test_an_impossible_emission_is_named_and_skipped(inputs: str) -> None:
    lights, environment, notices = read(
        f'def RectLight "L"\n{{\n{inputs}\n}}\ndef DomeLight "D"\n{{\n{inputs}\n}}\ndef RectLight "Good" {{}}'
    )
    assert [light.path for light in lights] == ["/Good"]
    assert environment is None
    assert [notice.path for notice in notices] == ["/L", "/D"]


def test_a_light_with_no_area_or_a_broken_transform_is_named_and_skipped() -> None:
    bad = 'double3 xformOp:translate = (nan, 0, 0)\nuniform token[] xformOpOrder = ["xformOp:translate"]'
    lights, _, notices = read(
        f'def RectLight "A" {{ float inputs:width = 0; }}\ndef DiskLight "B" {{ float inputs:radius = 0; }}\n'
        f'def RectLight "C"\n{{\n{bad}\n}}'
    )
    assert not lights
    assert [notice.path for notice in notices] == ["/A", "/B", "/C"]


def test_invisible_lights_and_other_purposes_are_left_out() -> None:
    text = """
    def Xform "Off"
    {
        token visibility = "invisible"
        def RectLight "L" {}
    }
    def RectLight "Guide" { uniform token purpose = "guide"; }
    def RectLight "On" {}
    """
    assert [light.path for light in read(text)[0]] == ["/On"]
    assert [light.path for light in read(text, purposes=("default", "guide"))[0]] == ["/Guide", "/On"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('def PortalLight "L" {}', "PortalLight"),
        ('def PluginLight "L" {}', "PluginLight"),
        ('def RectLight "L" { asset inputs:texture:file = @x.png@; }', "x.png"),
        ('def RectLight "L" (prepend apiSchemas = ["ShapingAPI"]) { asset inputs:shaping:ies:file = @a.ies@; }', "ies"),
        ('def DistantLight "L" (prepend apiSchemas = ["ShapingAPI"]) { float inputs:shaping:cone:angle = 9; }', "cone"),
        ('def DistantLight "L" (prepend apiSchemas = ["ShapingAPI"]) { float inputs:shaping:focus = 2; }', "focus"),
        ('def DomeLight "L" (prepend apiSchemas = ["ShadowAPI"]) { bool inputs:shadow:enable = 0; }', "shadow:enable"),
        ('def DomeLight "L" { uniform bool collection:lightLink:includeRoot = 0; }', "lightLink"),
        ('def DomeLight "L" { rel collection:shadowLink:excludes = </X>; }', "shadowLink"),
        ('def DomeLight "L" { float inputs:diffuse = 0; }', "inputs:diffuse"),
        ('def SphereLight "L" { double3 xformOp:scale = (1, 2, 1)\nuniform token[] xformOpOrder = ["xformOp:scale"]; }',
         "non-uniform"),
    ],
)  # fmt: skip
def test_what_is_not_rendered_is_named(text: str, said: str) -> None:
    notices = read(text)[2]
    assert [notice.path for notice in notices] == ["/L"]
    assert said in notices[0].text


def test_plain_shaping_and_links_are_no_notice() -> None:
    text = 'def RectLight "L" (prepend apiSchemas = ["ShapingAPI", "ShadowAPI"]) {}'
    assert not read(text)[2]


# --- domes ----------------------------------------------------------------------------------------------------------

HEIGHT, WIDTH = 32, 64
# OpenEXR: latitude +pi/2 is the top row, longitude +pi the left edge; longitude 0 is +Z, longitude pi/2 is +X.
AXES = {(0, 0, 1): (1.0, 0.0, 0.0), (1, 0, 0): (0.0, 1.0, 0.0), (0, 1, 0): (0.0, 0.0, 1.0)}


def compass(path: Path) -> Path:
    """A map that is red around +Z, green around +X and blue around +Y of the dome, painted by OpenEXR's words."""
    row, column = np.mgrid[0:HEIGHT, 0:WIDTH]
    latitude = math.pi / 2 - (row + 0.5) / HEIGHT * math.pi
    longitude = math.pi - (column + 0.5) / WIDTH * 2 * math.pi
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    pixels[(abs(latitude) < 0.5) & (abs(longitude) < 0.5), 0] = 1.0
    pixels[(abs(latitude) < 0.5) & (abs(longitude - math.pi / 2) < 0.5), 1] = 1.0
    pixels[latitude > math.pi / 2 - 0.5, 2] = 1.0
    file = oiio.ImageOutput.create(str(path))
    assert file is not None
    assert file.open(str(path), oiio.ImageSpec(WIDTH, HEIGHT, 3, oiio.FLOAT))
    assert file.write_image(pixels)
    file.close()
    return path


def seen(environment: Environment | None, direction: tuple[float, float, float]) -> tuple[float, ...]:
    """Radiance along an engine-world direction, by `scene.Environment`'s own convention."""
    assert environment is not None
    x, y, z = environment.dome_from_world @ np.array(direction, np.float64)
    height, width = environment.pixels.shape[:2]
    u, v = 0.5 - math.atan2(x, z) / (2 * math.pi), math.acos(max(-1.0, min(1.0, y))) / math.pi
    pixel = environment.pixels[min(int(v * height), height - 1), min(int(u * width), width - 1)]
    return tuple(float(c) for c in pixel)


Z_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])  # stage +Z is engine +Y
NAMES = {"red": (0, 0, 1), "green": (1, 0, 0), "blue": (0, 1, 0)}


@pytest.mark.parametrize(
    ("kind", "up", "inputs", "red", "green", "blue"),
    [
        ("DomeLight", "Y", "", (0, 0, 1), (1, 0, 0), (0, 1, 0)),
        ("DomeLight_1", "Y", "", (0, 0, 1), (1, 0, 0), (0, 1, 0)),
        # Z-up stage, directions in engine world.
        # Legacy: pole along stage +Y = engine -Z, red along stage +Z = engine +Y.
        ("DomeLight", "Z", "", (0, 1, 0), (1, 0, 0), (0, 0, -1)),
        # poleAxis scene: pole along stage +Z = engine +Y, red along stage -Y = engine +Z.
        ("DomeLight_1", "Z", "", (0, 0, 1), (1, 0, 0), (0, 1, 0)),
        ("DomeLight_1", "Z", 'uniform token poleAxis = "Y"', (0, 1, 0), (1, 0, 0), (0, 0, -1)),
        ("DomeLight_1", "Y", 'uniform token poleAxis = "Z"', (0, -1, 0), (1, 0, 0), (0, 0, 1)),
        # Turned 90 degrees about +Y: what looked along +Z looks along +X, what looked along +X along -Z.
        ("DomeLight", "Y", 'float xformOp:rotateY = 90\nuniform token[] xformOpOrder = ["xformOp:rotateY"]',
         (1, 0, 0), (0, 0, -1), (0, 1, 0)),
    ],
)  # fmt: skip
def test_a_dome_is_oriented_as_openexr_and_usdlux_say(
    tmp_path: Path, kind: str, up: str, inputs: str,
    red: tuple[float, float, float], green: tuple[float, float, float], blue: tuple[float, float, float],
) -> None:  # fmt: skip
    path = compass(tmp_path / "sky.exr")
    text = f'def {kind} "D"\n{{\nasset inputs:texture:file = @{path}@\n{inputs}\n}}'
    _, environment, notices = read(text, up=up, engine_from_stage=Z_UP if up == "Z" else IDENTITY)
    assert not notices
    assert seen(environment, red) == (1.0, 0.0, 0.0)
    assert seen(environment, green) == (0.0, 1.0, 0.0)
    assert seen(environment, blue) == (0.0, 0.0, 1.0)


def test_a_dome_without_texture_is_constant() -> None:
    _, environment, _ = read('def DomeLight "D"\n{\nfloat inputs:intensity = 2\ncolor3f inputs:color = (1, 2, 3)\n}')
    assert environment is not None
    assert (environment.pixels == np.array([2, 4, 6], np.float32)).all()


def test_domes_add_up_in_every_direction(tmp_path: Path) -> None:
    path = compass(tmp_path / "sky.exr")
    text = f"""
    def DomeLight "Sky" {{ color3f inputs:color = (0.5, 0.5, 0.5); }}
    def DomeLight "A" {{ asset inputs:texture:file = @{path}@; }}
    def DomeLight "B"
    {{
        asset inputs:texture:file = @{path}@
        float inputs:intensity = 3
        float xformOp:rotateY = 90
        uniform token[] xformOpOrder = ["xformOp:rotateY"]
    }}
    """
    _, environment, _ = read(text)
    assert environment is not None
    assert environment.pixels.shape == (HEIGHT, WIDTH, 3)
    assert seen(environment, (0, 0, 1)) == pytest.approx((1.5, 0.5, 0.5), abs=1e-5)
    assert seen(environment, (1, 0, 0)) == pytest.approx((3.5, 1.5, 0.5), abs=1e-5)
    assert seen(environment, (0, 0, -1)) == pytest.approx((0.5, 3.5, 0.5), abs=1e-5)
    assert seen(environment, (0, 1, 0)) == pytest.approx((0.5, 0.5, 4.5), abs=1e-5)


def test_looking_up_a_map_at_its_own_pixels_gives_the_map() -> None:
    pixels = np.random.default_rng(1).random((6, 12, 3), np.float32)
    assert lookup(pixels, directions(slice(0, 6), 6, 12)) == pytest.approx(pixels, abs=1e-5)
    assert np.linalg.norm(directions(slice(2, 4), 6, 12), axis=-1) == pytest.approx(np.ones((2, 12)))


def test_an_eight_bit_dome_is_decoded_from_srgb(tmp_path: Path) -> None:
    path = tmp_path / "sky.png"
    file = oiio.ImageOutput.create(str(path))
    assert file is not None
    assert file.open(str(path), oiio.ImageSpec(2, 1, 3, oiio.UINT8))
    assert file.write_image(np.array([[[0, 128, 255], [188, 188, 188]]], np.uint8))
    file.close()
    found = linear(read_texture(str(path), "auto"))
    assert found[0, 0] == pytest.approx([0.0, 0.21586, 1.0], abs=1e-4)  # sRGB 0.5 is 21.6 % light
    assert found[0, 1] == pytest.approx([0.5029] * 3, abs=1e-3)


def test_a_dome_map_that_is_missing_is_named_and_the_domes_own_colour_shines() -> None:
    more = "asset inputs:texture:file = @none.exr@\ncolor3f inputs:color = (1, 0.5, 0.25)\nfloat inputs:intensity = 4"
    _, environment, notices = read(f'def DomeLight "D"\n{{\n{more}\n}}')
    assert environment is not None
    assert environment.pixels.reshape(-1, 3) == pytest.approx(np.tile([4.0, 2.0, 1.0], (8, 1)))
    assert len(notices) == 1
    assert "none.exr" in notices[0].text


def test_time_samples_are_taken_at_the_frame() -> None:
    text = 'def RectLight "L"\n{\nfloat inputs:intensity.timeSamples = { 0: 1, 10: 3 }\n}'
    assert read(text, time=5.0)[0][0].radiance[0] == pytest.approx(2.0)


def test_lights_of_native_instances_are_all_there() -> None:
    text = """
    class Xform "Lamp"
    {
        def RectLight "L" {}
    }
    def Xform "A" (instanceable = true
        inherits = </Lamp>) {}
    def Xform "B" (instanceable = true
        inherits = </Lamp>) {}
    """
    assert [light.path for light in read(text)[0]] == ["/A/L", "/B/L"]


def test_every_light_of_the_real_stages_can_be_read(assets: Path) -> None:
    count = 0
    for path in sorted(assets.glob("*/*.usda")):
        stage = Usd.Stage.Open(str(path))
        present = sum(bool(prim.HasAPI(UsdLux.LightAPI)) for prim in stage.Traverse())
        lights, environment, notices = read(stage, metres_per_unit=0.01)
        assert all(math.isfinite(value) for light in lights for value in light.radiance)
        assert present == 0 or lights or environment is not None or notices
        count += len(lights)
    assert count >= 10


def test_kinds_are_kept_apart() -> None:
    text = 'def DistantLight "A" {}\ndef SphereLight "B" {}\ndef RectLight "C" {}\ndef DiskLight "D" {}'
    kinds = [light.kind for light in read(text)[0]]
    assert kinds == [LightKind.DISTANT, LightKind.SPHERE, LightKind.RECT, LightKind.DISK]


# --- Cylinders, shaping, shadows, links -----------------------------------------------------------------------------


def test_a_cylinder_is_about_its_x_and_normalizes_by_its_round() -> None:
    text = "float inputs:radius = 0.1\nfloat inputs:length = 3\nfloat inputs:intensity = 7\n"
    assert one("CylinderLight").size == (0.5, 1.0)
    assert one("CylinderLight", text).radiance[0] == 7.0
    light = one("CylinderLight", text + "bool inputs:normalize = 1" + MOVED)
    assert light.kind is LightKind.CYLINDER
    assert light.size == pytest.approx((0.2, 6.0))
    assert light.radiance[0] == pytest.approx(7 / (2 * math.pi * 0.2 * 6.0))
    assert light.world_from_light[:3, 0] == pytest.approx([0, 0, -1], abs=1e-12)  # 90 degrees about Y


@pytest.mark.parametrize("normalize", ["", "bool inputs:normalize = 1\n"])
@pytest.mark.parametrize("metres_per_unit", [1.0, 0.01])
def test_a_line_gives_the_light_of_the_tube_it_stands_for(normalize: str, metres_per_unit: float) -> None:
    """Its radiance times width is that of the tube: 2 r L, whatever the units."""
    scale = np.diag([metres_per_unit] * 3 + [1.0])
    text = f"float inputs:radius = 0.2\nfloat inputs:length = 3\n{normalize}"
    tube = one("CylinderLight", text, engine_from_stage=scale, metres_per_unit=metres_per_unit)
    line = one("CylinderLight", text + "bool treatAsLine = 1", engine_from_stage=scale, metres_per_unit=metres_per_unit)
    assert line.size == pytest.approx((0.0, 3.0 * metres_per_unit))
    assert line.radiance[0] == pytest.approx(tube.radiance[0] * 2 * tube.size[0])


SHAPED = '(prepend apiSchemas = ["ShapingAPI"])'


def shaped(kind: str, inputs: str) -> Light:
    lights, _, notices = read(f'def {kind} "L" {SHAPED}\n{{\n{inputs}\n}}')
    assert not notices
    return lights[0]


def test_shaping_is_read() -> None:
    shaping = shaped("RectLight", """
        float inputs:shaping:cone:angle = 30
        float inputs:shaping:cone:softness = 0.25
        float inputs:shaping:focus = 4
        color3f inputs:shaping:focusTint = (0, 0.5, 1)
    """).shaping  # fmt: skip
    assert shaping.cone == pytest.approx(math.radians(30))
    assert (shaping.softness, shaping.focus, shaping.focus_tint) == (0.25, 4.0, (0.0, 0.5, 1.0))


def test_the_schemas_cone_cuts_what_shines_backwards_only() -> None:
    """ShapingAPI's own angle is 90 degrees: half of a sphere is dark, of a rectangle nothing."""
    assert shaped("SphereLight", "").shaping.cone == pytest.approx(math.pi / 2)
    assert shaped("RectLight", "").shaping.cone == math.pi
    assert one("SphereLight").shaping.cone == math.pi


def test_values_beyond_the_schemas_ranges_are_cut() -> None:
    shaping = shaped("SphereLight", "float inputs:shaping:focus = -3\nfloat inputs:shaping:cone:softness = 7").shaping
    assert (shaping.focus, shaping.softness) == (0.0, 1.0)


def test_shadow_inputs_are_read_in_metres() -> None:
    text = """(prepend apiSchemas = ["ShadowAPI"])
    {
        color3f inputs:shadow:color = (0.1, 0.2, 0.3)
        float inputs:shadow:distance = 50
        float inputs:shadow:falloff = 80
        float inputs:shadow:falloffGamma = 2
    }"""
    scale = np.diag([0.01] * 3 + [1.0])
    (light,), _, notices = read(f'def RectLight "L" {text}', engine_from_stage=scale, metres_per_unit=0.01)
    assert not notices
    assert light.casts_shadow
    assert light.shadow.color == pytest.approx((0.1, 0.2, 0.3))
    assert light.shadow.distance == pytest.approx(0.5)
    assert light.shadow.falloff == pytest.approx(0.5)  # it cannot exceed the distance
    assert light.shadow.gamma == 2.0
    off = text.replace("color3f", "bool inputs:shadow:enable = 0\ncolor3f")
    assert not read(f'def RectLight "L" {off}')[0][0].casts_shadow


DRAWN = ("/Set/Wall", "/Set/Floor", "/Ball")


def linked(text: str) -> Light:
    stage = Usd.Stage.CreateInMemory()
    stage.GetRootLayer().ImportFromString(f'#usda 1.0\ndef RectLight "L"\n{{\n{text}\n}}\n')
    notices: list[Notice] = []
    (light,), _ = read_lights(
        stage, Usd.TimeCode(0.0), engine_from_stage=IDENTITY, metres_per_unit=1.0, purposes=("default",),
        notices=notices, drawn=DRAWN,
    )  # fmt: skip
    assert not notices
    return light


def test_links_hold_what_their_collections_do() -> None:
    assert linked("").lit is None
    assert linked("").casters is None
    only = "uniform bool collection:lightLink:includeRoot = 0\nrel collection:lightLink:includes = </Set>"
    assert linked(only).lit == ("/Set/Wall", "/Set/Floor")
    assert linked("rel collection:shadowLink:excludes = </Ball>").casters == ("/Set/Wall", "/Set/Floor")
    assert linked("rel collection:shadowLink:excludes = </Elsewhere>").casters is None
    assert linked("uniform bool collection:lightLink:includeRoot = 0").lit == ()


def test_more_sets_of_casters_than_masks_are_named() -> None:
    lamps = "\n".join(
        f'def RectLight "L{k}" {{ rel collection:shadowLink:excludes = </P{k}>; }}' for k in range(6)
    )
    stage = Usd.Stage.CreateInMemory()
    stage.GetRootLayer().ImportFromString(f"#usda 1.0\n{lamps}")
    notices: list[Notice] = []
    lights, _ = read_lights(
        stage, Usd.TimeCode(0.0), engine_from_stage=IDENTITY, metres_per_unit=1.0, purposes=("default",),
        notices=notices, drawn=[f"/P{k}" for k in range(6)],
    )  # fmt: skip
    assert [light.casters is None for light in lights] == [False] * 4 + [True] * 2
    assert [notice.path for notice in notices] == ["/L4", "/L5"]


# --- Measured profiles ----------------------------------------------------------------------------------------------


def ies(vertical: Sequence[float], horizontal: Sequence[float], candela: Sequence[Sequence[float]], factor: float = 1.0,
        kind: int = 1, tilt: str = "NONE") -> str:  # fmt: skip
    """An LM-63-2002 file; `candela` by horizontal angle, then by vertical."""
    rows = "\n".join(" ".join(f"{v:g}" for v in row) for row in candela)
    return (
        f"IESNA:LM-63-2002\n[TEST] made here\n[MANUFAC] nobody\nTILT={tilt}\n"
        f"1 1000 {factor:g} {len(vertical)} {len(horizontal)} {kind} 2 0 0 0\n1.0 1.0 50\n"
        f"{' '.join(map(str, vertical))}\n{', '.join(map(str, horizontal))}\n{rows}\n"
    )


def at(found: Ies, off: float, around: float) -> float:
    """The profile at an angle from -Z and one from +X [degrees]."""
    values = profile(found, 0.0, False)
    row = off / 180.0 * (values.shape[0] - 1)
    column = around % 360.0 / 360.0 * (values.shape[1] - 1)
    assert row == int(row)
    return float(values[int(row), round(column)])


def test_a_round_profile_is_linear_between_its_angles_and_dark_beyond() -> None:
    found = parse(ies([0, 30, 90], [0], [[100, 40, 10]], 2.0))
    assert [at(found, off, 123.0) for off in (0, 15, 30, 60, 90, 91, 180)] == pytest.approx(
        [200, 140, 80, 50, 20, 0, 0]
    )


def test_a_quarter_stands_for_all_four() -> None:
    """Angles 0 .. 90: symmetric about both planes."""
    found = parse(ies([0, 90], [0, 45, 90], [[1, 1], [1, 2], [1, 5]]))
    for around, value in ((0, 1), (45, 2), (90, 5), (135, 2), (180, 1), (225, 2), (270, 5), (315, 2), (22.5, 1.5)):
        assert at(found, 90, around) == pytest.approx(value)


def test_a_half_stands_for_the_other_one() -> None:
    """0 .. 180: symmetric about the plane of 0 and 180. 90 .. 270: about that of 90 and 270."""
    found = parse(ies([0, 90], [0, 90, 180], [[1, 1], [1, 2], [1, 5]]))
    for around, value in ((0, 1), (90, 2), (180, 5), (270, 2), (45, 1.5)):
        assert at(found, 90, around) == pytest.approx(value)
    found = parse(ies([0, 90], [90, 180, 270], [[1, 1], [1, 2], [1, 5]]))
    for around, value in ((90, 1), (180, 2), (270, 5), (0, 2), (45, 1.5), (315, 3.5)):
        assert at(found, 90, around) == pytest.approx(value)


def test_all_around_is_as_it_is() -> None:
    for angles, rows in (([0, 90, 180, 270, 360], [1, 2, 3, 4, 1]), ([0, 90, 180, 270], [1, 2, 3, 4])):
        found = parse(ies([0, 180], angles, [[v, v] for v in rows]))
        assert [at(found, 90, a) for a in (0, 90, 180, 270, 315)] == pytest.approx([1, 2, 3, 4, 2.5])


def test_tilt_and_old_heads_are_passed_over() -> None:
    included = ies([0, 90], [0], [[3, 1]], tilt="INCLUDE").replace("INCLUDE\n", "INCLUDE\n1\n2\n0 90\n1 0.8\n")
    assert at(parse(included), 0, 0) == 3.0
    old = "\n".join(ies([0, 90], [0], [[3, 1]]).split("\n")[1:])  # LM-63-1986 has no first line
    assert at(parse(old), 0, 0) == 3.0


def test_a_normalized_profile_keeps_the_lights_power() -> None:
    """Its mean over the sphere is 1, or over the half that the file has; whatever its shape."""
    for vertical, share in (([0, 20, 45, 90], 0.5), ([0, 20, 45, 90, 180], 1.0)):
        candela = [[900, 500, 20, 5, 3][: len(vertical)], [900, 300, 40, 1, 3][: len(vertical)]]
        values = profile(parse(ies(vertical, [0, 90], candela)), 0.0, True)
        off = np.linspace(0, np.pi, len(values))
        means = 0.5 * (values[:, 1:] + values[:, :-1]).mean(1)
        assert np.trapezoid(means * np.sin(off), off) / 2 == pytest.approx(share, rel=1e-3)


@pytest.mark.parametrize(("scale", "off", "read_at"), [
    (0.5, 30, 60), (2.0, 60, 30), (0.0, 40, 40), (-0.5, 150, 120), (-2.0, 100, 140), (0.5, 120, 240),
])  # fmt: skip
def test_angle_scale_follows_usdlux(scale: float, off: int, read_at: int) -> None:
    """theta / s for s > 0, (theta - pi) / -s + pi for s < 0; beyond the file's angles it is dark."""
    found = parse(ies([0, 180], [0], [[0, 180]]))
    assert profile(found, scale, False)[4 * off, 0] == pytest.approx(read_at if read_at <= 180 else 0.0)


@pytest.mark.parametrize(("text", "said"), [
    ("hello", "TILT"), (ies([0, 90], [0], [[1]]), "too soon"), (ies([0, 90], [0], [[1, 2]], kind=2), "type B"),
    (ies([90, 0], [0], [[1, 2]]), "rise"), (ies([0, 90], [0, 70], [[1, 2], [1, 2]]).replace("0, 70", "5, 70"), "70"),
    (ies([0, 90], [0], [[1, -2]]), "below 0"), (ies([0, 90], [0], [[1, 2]]).replace(" 2 1 1 2 ", " 2000000 9 1 2 "),
     "2e+06"),
])  # fmt: skip
def test_a_file_that_is_no_profile_says_why(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=re.escape(said)):
        parse(text)


def test_a_profile_of_a_light_is_read(tmp_path: Path) -> None:
    file = tmp_path / "lamp.ies"
    file.write_text(ies([0, 90], [0], [[100, 0]]))
    light = shaped("SphereLight", f"asset inputs:shaping:ies:file = @{file}@\nfloat inputs:shaping:cone:angle = 180")
    assert light.shaping.profile is not None
    assert light.shaping.profile[0, 0] == 100.0
    file.write_text("nothing")
    (light,), _, notices = read(
        f'def SphereLight "L" {SHAPED} {{ asset inputs:shaping:ies:file = @{file}@; }}'
    )
    assert light.shaping.profile is None
    assert "TILT" in notices[0].text


# --- Pictures on rectangles -----------------------------------------------------------------------------------------


def test_the_first_pixel_of_a_picture_is_at_plus_x_plus_y(tmp_path: Path) -> None:
    """UsdLuxRectLight. Who stands before the light, at -Z, has +X at the left: the picture is upright to them. Mirrored
    by its transform, it is mirrored."""
    path = tmp_path / "red.exr"
    pixels = np.zeros((2, 2, 3), np.float32)
    pixels[0, 0, 0] = 1.0
    file = oiio.ImageOutput.create(str(path))
    assert file is not None
    assert file.open(str(path), oiio.ImageSpec(2, 2, 3, oiio.FLOAT))
    assert file.write_image(pixels)
    file.close()
    text = f"asset inputs:texture:file = @{path}@\n"
    picture = one("RectLight", text).shaping.picture
    assert picture is not None
    assert picture[0, 0, 0] == 1.0
    turned = one("RectLight", text + 'double3 xformOp:scale = (-1, 1, 1)\n'
                 'uniform token[] xformOpOrder = ["xformOp:scale"]')  # fmt: skip
    assert turned.shaping.picture is not None
    assert turned.shaping.picture[0, 1, 0] == 1.0
    assert turned.world_from_light[:3, 0] == pytest.approx([1, 0, 0])


# --- Colour temperature ---------------------------------------------------------------------------------------------


def planckian(kelvin: float) -> NDArray[np.float64]:
    """Linear BT.709 of a black body at luminance 1: Planck's law under the CIE 1931 curves as Wyman, Sloan and Shirley
    fit them (JCGT 2(2), 2013)."""
    nm = np.arange(380.0, 781.0, 1.0)

    def bump(middle: float, below: float, above: float) -> NDArray[np.float64]:
        return np.asarray(np.exp(-0.5 * ((nm - middle) * np.where(nm < middle, below, above)) ** 2))

    x = 0.362 * bump(442.0, 0.0624, 0.0374) + 1.056 * bump(599.8, 0.0264, 0.0323) - 0.065 * bump(501.1, 0.0490, 0.0382)
    y = 0.821 * bump(568.8, 0.0213, 0.0247) + 0.286 * bump(530.9, 0.0613, 0.0322)
    z = 1.217 * bump(437.0, 0.0845, 0.0278) + 0.681 * bump(459.0, 0.0385, 0.0725)
    light = (nm * 1e-9) ** -5 / np.expm1(1.4387769e-2 / (nm * 1e-9 * kelvin))
    xyz = np.array([(light * curve).sum() for curve in (x, y, z)])
    to_rgb = np.array([[3.2404542, -1.5371385, -0.4985314], [-0.969266, 1.8760108, 0.041556],
                       [0.0556434, -0.2040259, 1.0572252]])  # fmt: skip
    return np.asarray(to_rgb @ (xyz / xyz[1]))


@pytest.mark.parametrize("kelvin", [2000.0, 3200.0, 4500.0, 6500.0, 9000.0])
def test_colour_temperature_is_a_black_bodys(kelvin: float) -> None:
    """Colour of Planck's law at luminance 1 (UsdLux: normalized), within 3 % of its brightest channel."""
    light = one("RectLight", f"bool inputs:enableColorTemperature = 1\nfloat inputs:colorTemperature = {kelvin}")
    expected = np.maximum(planckian(kelvin), 0.0)
    assert np.array(light.radiance) == pytest.approx(expected, abs=0.03 * expected.max())
    assert np.dot(light.radiance, (0.2126, 0.7152, 0.0722)) == pytest.approx(1.0, abs=2e-3)


# --- Other forms of a dome's map ------------------------------------------------------------------------------------


def painted(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """A smooth sky without symmetry, by direction in the dome's frame."""
    x, y, z = (direction[..., k] for k in range(3))
    return np.stack([1 + x + 0.5 * y * z, 1.2 + y - 0.3 * x, 1.4 + z + 0.2 * x * y], -1)


def ball_photograph(n: int) -> NDArray[np.float32]:
    """A mirrored ball seen along -Z by an eye at +Z whose right is +X: what each of its normals reflects."""
    v, u = np.mgrid[0:n, 0:n]
    x, y = (u + 0.5) / n * 2 - 1, 1 - (v + 0.5) / n * 2
    z = np.sqrt(np.maximum(0.0, 1 - x * x - y * y))
    normal = np.stack([x, y, z], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.asarray(painted(2 * normal[..., 2:] * normal - np.array([0, 0, 1.0])), np.float32)


def light_probe(n: int) -> NDArray[np.float32]:
    """The radius is the angle from +Z; +X is at the left, as in a latlong map."""
    v, u = np.mgrid[0:n, 0:n]
    a, b = (u + 0.5) / n * 2 - 1, 1 - (v + 0.5) / n * 2
    radius = np.hypot(a, b)
    off = np.minimum(radius, 1.0) * np.pi
    side = np.sin(off) / np.maximum(radius, 1e-9)
    return np.asarray(painted(np.stack([-a * side, b * side, np.cos(off)], -1)), np.float32)


def vertical_cross(n: int) -> NDArray[np.float32]:
    """Folded up it is a box seen from within: +Z in the middle, +Y above, +X at its left, -Z last, hung from -Y."""
    out = np.zeros((4 * n, 3 * n, 3), np.float32)
    t, s = np.mgrid[0:n, 0:n]
    s, t = (s + 0.5) / n * 2 - 1, 1 - (t + 0.5) / n * 2
    one = np.ones_like(s)
    faces = {(0, 1): (-s, one, -t), (1, 0): (one, t, s), (1, 1): (-s, t, one), (1, 2): (-one, t, -s),
             (2, 1): (-s, -one, t), (3, 1): (-s, -t, -one)}  # fmt: skip
    for (row, column), axes in faces.items():
        d = np.stack(axes, -1)
        d = d / np.linalg.norm(d, axis=-1, keepdims=True)
        out[row * n : (row + 1) * n, column * n : (column + 1) * n] = painted(d)
    return out


@pytest.mark.parametrize("said", ["authored", "automatic"])
@pytest.mark.parametrize(
    ("form", "pixels", "guessed"),
    [("mirroredBall", ball_photograph(256), False), ("angular", light_probe(256), True),
     ("cubeMapVerticalCross", vertical_cross(64), True)],
    ids=["ball", "angular", "cross"],
)  # fmt: skip
def test_every_form_of_a_map_shows_the_same_sky(
    tmp_path: Path, said: str, form: str, pixels: NDArray[np.float32], guessed: bool
) -> None:
    """Each drawn here by its own geometry, and found again in every direction; what sides do not tell must be said."""
    if said == "automatic" and not guessed:
        return
    path = tmp_path / "sky.exr"
    file = oiio.ImageOutput.create(str(path))
    assert file is not None
    assert file.open(str(path), oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, oiio.FLOAT))
    assert file.write_image(pixels)
    file.close()
    token = form if said == "authored" else "automatic"
    text = f'asset inputs:texture:file = @{path}@\ntoken inputs:texture:format = "{token}"'
    _, environment, notices = read(f'def DomeLight "D"\n{{\n{text}\n}}')
    assert [form in notice.text for notice in notices] == ([True] if said == "automatic" else [])
    height = 128
    found = lookup(environment.pixels, directions(slice(0, height), height, 2 * height))  # type: ignore[union-attr]
    expected = painted(directions(slice(0, height), height, 2 * height))
    behind = directions(slice(0, height), height, 2 * height)[..., 2] < -0.97  # there a ball shows next to nothing
    assert np.abs(found - expected)[~behind].max() < 0.04
    assert np.abs(found - expected)[~behind].mean() < 0.005


def test_a_form_that_nobody_knows_is_named(tmp_path: Path) -> None:
    path = compass(tmp_path / "sky.exr")
    text = f'asset inputs:texture:file = @{path}@\ntoken inputs:texture:format = "fisheye"'
    _, environment, notices = read(f'def DomeLight "D"\n{{\n{text}\n}}')
    assert "fisheye" in notices[0].text
    assert environment is not None


# --- Meshes that are lights -----------------------------------------------------------------------------------------

SQUARE = """
    int[] faceVertexCounts = [4]
    int[] faceVertexIndices = [0, 1, 2, 3]
    point3f[] points = [(0, 0, 0), (2, 0, 0), (2, 0, 3), (0, 0, 3)]
    uniform token subdivisionScheme = "none"
"""


def emitted(text: str) -> tuple[dict[str, tuple[float, ...]], list[str]]:
    """Emission of every mesh by its path, and the paths of notices."""
    stage = Usd.Stage.CreateInMemory()
    stage.GetRootLayer().ImportFromString(f'#usda 1.0\n(\n    metersPerUnit = 0.5\n    upAxis = "Y"\n)\n{text}\n')
    what = scene_from_stage(stage)
    found = {m.path: what.materials[m.materials[0]].inputs[Param.EMISSIVE].value[:3] for m in what.meshes}
    return found, [notice.path for notice in what.notices]


def test_a_mesh_light_glows_by_its_inputs() -> None:
    api = '(prepend apiSchemas = ["MeshLightAPI"])'
    bright = "float inputs:intensity = 3\nfloat inputs:exposure = 1\ncolor3f inputs:color = (1, 0.5, 0)"
    found, said = emitted(f'def Mesh "L" {api} {{ {SQUARE}\n{bright}\n}}\ndef Mesh "Other" {{ {SQUARE} }}')
    assert found == {"/L": pytest.approx((6, 3, 0)), "/Other": (0, 0, 0)}
    assert not {"/L", "/G"} & set(said)
    found, _ = emitted(f'def Mesh "L" {api} {{ {SQUARE}\n{bright}\nbool inputs:normalize = 1\n}}')
    assert found["/L"] == pytest.approx((1, 0.5, 0))  # an area of 6 in the stage's units


def test_a_geometry_light_makes_its_mesh_glow() -> None:
    light = 'def GeometryLight "G" { float inputs:intensity = 4\nrel geometry = </M>\n}'
    found, said = emitted(f'def Mesh "M" {{ {SQUARE} }}\n{light}')
    assert found["/M"] == (4.0, 4.0, 4.0)
    assert not {"/L", "/G"} & set(said)
    found, said = emitted(f'def Mesh "M" {{ {SQUARE} }}\n{light.replace("</M>", "</N>")}')
    assert found["/M"] == (0.0, 0.0, 0.0)
    assert "/G" in said


def test_a_bound_material_glows_by_itself_unless_the_light_says_otherwise() -> None:
    material = """
    def Material "Mat"
    {
        token outputs:surface.connect = </Mat/S.outputs:surface>
        def Shader "S"
        {
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:emissiveColor = (0.25, 0, 0)
            token outputs:surface
        }
    }
    """
    api = '(prepend apiSchemas = ["MeshLightAPI", "MaterialBindingAPI"])'
    mesh = f'def Mesh "L" {api} {{ {SQUARE}\nrel material:binding = </Mat>\n'
    assert emitted(material + mesh + "}")[0]["/L"] == (0.25, 0.0, 0.0)
    alone = 'uniform token light:materialSyncMode = "noMaterialResponse"\n}'
    assert emitted(material + mesh + alone)[0]["/L"] == (1.0, 1.0, 1.0)


@pytest.mark.parametrize("normalize", [0, 1])
@pytest.mark.parametrize("of", ["MeshLightAPI", "GeometryLight"])
def test_mesh_lights_of_a_point_instancer_glow_in_all_their_places(of: str, normalize: int) -> None:
    """As one that stands there by itself, twice as large: of an area of 6 x 4 in the stage's units."""
    inputs = f"float inputs:intensity = 48\nbool inputs:normalize = {normalize}"
    mesh = f'def Mesh "L" {{\n{SQUARE}\n}}'
    if of == "MeshLightAPI":
        mesh, light = f'def Mesh "L" (prepend apiSchemas = ["MeshLightAPI"]) {{\n{SQUARE}\n{inputs}\n}}', ""
    else:
        light = f'def GeometryLight "G" {{\n{inputs}\nrel geometry = </P/Bulb/L>\n}}'
    many = "int[] protoIndices = [0, 0]\npoint3f[] positions = [(0, 0, 0), (9, 0, 0)]\nfloat3[] scales = [(2, 2, 2), "
    many += "(2, 2, 2)]\nrel prototypes = </P/Bulb>"
    found, said = emitted(f'def PointInstancer "P" {{\n{many}\ndef Xform "Bulb" {{\n{mesh}\n}}\n}}\n{light}')
    wanted = 48.0 / 24.0 if normalize else 48.0
    assert found == {f"/P/[{place}]/Bulb/L": pytest.approx((wanted,) * 3) for place in (0, 1)}
    assert not {"/P", "/G", "/P/Bulb/L"} & set(said)


LAMPS = """
    int[] protoIndices = [0, 0, 0]
    point3f[] positions = [(1, 0, 0), (2, 0, 0), (3, 0, 0)]
    float3[] scales = [(1, 1, 1), (2, 2, 2), (1, 1, 1)]
    rel prototypes = </P/Post>
"""


def lamps(kind: str, said: str = "", more: str = "") -> tuple[list[Light], list[str]]:
    """Lights of a point instancer in places 1, 2 and 3, each 5 above it, and what was told."""
    stage = Usd.Stage.CreateInMemory()
    up = 'double3 xformOp:translate = (0, 5, 0)\nuniform token[] xformOpOrder = ["xformOp:translate"]'
    light = f'def {kind} "L"\n{{\n{said}\n{up}\n}}'
    text = f'def PointInstancer "P"\n{{\n{LAMPS}\n{more}\ndef Xform "Post"\n{{\n{light}\n}}\n}}'
    stage.GetRootLayer().ImportFromString(f"#usda 1.0\n(\n    metersPerUnit = 1\n)\n{text}\n")
    what = scene_from_stage(stage)
    return list(what.lights), [f"{notice.path}: {notice.text}" for notice in what.notices]


def test_lights_of_a_point_instancer_shine_in_all_their_places() -> None:
    """As each would by itself: where its instance stands, and as large."""
    found, _ = lamps("SphereLight", "float inputs:radius = 0.5\nfloat inputs:intensity = 7")
    assert [light.path for light in found] == [f"/P/[{place}]/Post/L" for place in range(3)]
    assert [light.size[0] for light in found] == pytest.approx([0.5, 1.0, 0.5])
    assert {light.radiance for light in found} == {(7.0, 7.0, 7.0)}
    places = np.array([light.world_from_light[:3, 3] for light in found])
    np.testing.assert_allclose(places - places[0], [(0, 0, 0), (1, 5, 0), (2, 0, 0)], atol=1e-6)


def test_what_is_not_there_of_a_point_instancer_does_not_shine() -> None:
    found, _ = lamps("SphereLight", more="int64[] invisibleIds = [1]")
    assert [light.path for light in found] == ["/P/[0]/Post/L", "/P/[2]/Post/L"]
    assert not lamps("SphereLight", 'token visibility = "invisible"')[0]
    found, said = lamps("DomeLight")
    assert not found
    assert any("/P/Post/L" in one and "sky" in one for one in said)
