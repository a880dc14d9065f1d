"""UsdLux lights: emission, size and place against the UsdLux documents, and domes against OpenEXR's latlong words."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from numpy.typing import NDArray
from pxr import Usd, UsdLux

from refract_core.scene import Environment, Light, LightKind, Notice
from refract_core.usd.lights.domes import directions, linear, lookup
from refract_core.usd.lights.read import read_lights
from refract_core.usd.materials.textures import read_texture

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
        ('def GeometryLight "L" {}', "GeometryLight"),
        ('def PortalLight "L" {}', "PortalLight"),
        ('def PluginLight "L" {}', "PluginLight"),
        ('def Mesh "L" (prepend apiSchemas = ["MeshLightAPI"]) {}', "MeshLightAPI"),
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


@pytest.mark.parametrize(
    ("inputs", "said"),
    [
        ("asset inputs:texture:file = @none.exr@", "none.exr"),
        ('asset inputs:texture:file = @none.exr@\ntoken inputs:texture:format = "mirroredBall"', "mirroredBall"),
    ],
)
def test_a_dome_map_that_cannot_be_used_is_named_and_skipped(inputs: str, said: str) -> None:
    _, environment, notices = read(f'def DomeLight "D"\n{{\n{inputs}\n}}')
    assert environment is None
    assert len(notices) == 1
    assert said in notices[0].text


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
