"""Colour spaces by name: against the published matrices, and against two other libraries that know them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from material_reading import HEADER, Reading, shader, write_png
from numpy.typing import NDArray
from pxr import Gf, Usd

from refract_core.images import spaces
from refract_core.images.pictures import read_texture
from refract_core.scene import Param

COLOURS = [(0.2, 0.5, 0.8), (1.0, 1.0, 1.0), (0.9, 0.05, 0.3), (0.01, 0.02, 0.03)]
USD = {
    "lin_ap1": "lin_ap1_scene", "lin_ap0": "lin_ap0_scene", "lin_p3d65": "lin_p3d65_scene",
    "lin_rec2020": "lin_rec2020_scene", "lin_adobergb": "lin_adobergb_scene", "g22_adobergb": "g22_adobergb_scene",
    "g22_rec709": "g22_rec709_scene", "g18_rec709": "g18_rec709_scene", "srgb_ap1": "srgb_ap1_scene",
    "g22_ap1": "g22_ap1_scene", "srgb_p3d65": "srgb_p3d65_scene", "lin_ciexyzd65": "lin_ciexyzd65_scene",
    "sRGB": "srgb_rec709_scene", "raw": "lin_rec709_scene", "g24_rec709": "g24_rec709_scene",
}  # fmt: skip


LOGARITHMS = {"acescc", "acescct"}
"""Of which OpenUSD knows nothing."""


@pytest.mark.parametrize("space", sorted(set(spaces.NAMES) - {spaces.AUTO} - LOGARITHMS))
@pytest.mark.parametrize("colour", COLOURS)
def test_every_space_is_what_openusd_makes_of_it(space: str, colour: tuple[float, float, float]) -> None:
    wanted = Gf.ColorSpace("lin_rec709_scene").Convert(Gf.ColorSpace(USD[space]), Gf.Vec3f(*colour)).GetRGB()
    np.testing.assert_allclose(spaces.linear(colour, space), wanted, atol=2e-4)


@pytest.mark.parametrize(
    ("space", "theirs"),
    [("lin_ap1", "ACEScg"), ("lin_ap0", "ACES2065-1"), ("g22_adobergb", "Gamma 2.2 Encoded AdobeRGB"),
     ("lin_p3d65", "Linear P3-D65"), ("lin_rec2020", "Linear Rec.2020"), ("sRGB", "sRGB Encoded Rec.709 (sRGB)"),
     ("acescc", "ACEScc"), ("acescct", "ACEScct"), ("g18_rec709", "Gamma 1.8 Encoded Rec.709"),
     ("srgb_ap1", "sRGB Encoded AP1")],
)  # fmt: skip
def test_and_what_opencolorio_does(space: str, theirs: str) -> None:
    """By the configuration that OpenColorIO has built in; its own name is known, too."""
    oiio = pytest.importorskip("OpenImageIO")
    assert spaces.canonical(theirs) == space
    pixels = np.array([COLOURS], np.float32)
    shown = oiio.ImageBufAlgo.colorconvert(oiio.ImageBuf(pixels), theirs, "lin_rec709")
    if shown.has_error:
        pytest.skip(shown.geterror())
    wanted = np.asarray(shown.get_pixels(oiio.FLOAT)).reshape(-1, 3)
    got = [spaces.linear(colour, space) for colour in COLOURS]
    # Of a logarithm it goes between the entries of a table.
    slack = 4e-3 * np.abs(wanted).max(axis=1, keepdims=True) if space in LOGARITHMS else 2e-4
    assert (np.abs(np.array(got) - wanted) <= slack).all()


@pytest.mark.parametrize(
    ("space", "code", "light"),
    [("acescc", 0.4135884025, 0.18), ("acescct", 0.4135884025, 0.18), ("acescc", 1.467996312, 65504.0),
     ("acescct", 1.467996312, 65504.0), ("acescc", -0.3584474886, 0.0), ("acescct", 0.0729055342, 0.0),
     ("acescct", 0.1552511416, 0.0078125), ("acescc", 0.5547945205, 1.0), ("acescct", 2.0, 65504.0)],
)  # fmt: skip
def test_logarithms_have_the_values_of_their_specifications(space: str, code: float, light: float) -> None:
    """S-2014-003 and S-2016-001: grey of 18 %, black, white, the largest half, the end of the toe."""
    got = spaces.decoded(np.array([code], np.float32), space)[0]
    assert got == pytest.approx(light, rel=2e-4, abs=2e-7)


def test_acescg_to_rec709_is_the_published_matrix() -> None:
    """ACES, "Technical documentation: ACEScg": AP1 to Rec. 709 with Bradford's adaptation of D60 to D65."""
    wanted = [[1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297]]
    np.testing.assert_allclose(spaces.to_rec709("lin_ap1"), wanted, atol=2e-5)


@pytest.mark.parametrize("name", ["ACEScg", "ACES - ACEScg", "acescg", "lin_ap1", "lin_ap1_scene"])
def test_a_space_has_many_names(name: str) -> None:
    assert spaces.canonical(name) == "lin_ap1"


def test_white_is_white_in_every_space() -> None:
    for space in set(spaces.NAMES) - {"auto", "lin_ciexyzd65"} - LOGARITHMS:
        assert spaces.linear((1.0, 1.0, 1.0), space) == pytest.approx((1, 1, 1), abs=1e-6)


TEXTURE = """
    def Shader "T"
    {
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @t.png@ META
        token inputs:sourceColorSpace = "SPACE"
        float2 inputs:st = (0.5, 0.5)
        float3 outputs:rgb
    }
"""


def read(folder: Path, space: str, meta: str = "") -> tuple[Reading, NDArray[np.float32]]:
    write_png(folder / "t.png", [[(51, 128, 204, 255)]])
    path = folder / "m.usda"
    body = TEXTURE.replace("SPACE", space).replace("META", meta)
    inputs = "color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>"
    path.write_text(f'{HEADER}def Material "M"\n{{\n{body}{shader(inputs)}\n}}\n')
    found = Reading(Usd.Stage.Open(str(path)))
    (texture,) = found.textures.values()
    pixel = texture.pixels[0, 0].astype(np.float32) / (255.0 if texture.pixels.dtype == np.uint8 else 1.0)
    if texture.srgb:
        pixel[:3] = spaces.decoded(pixel[:3], "sRGB")
    return found, pixel


@pytest.mark.parametrize("by_metadata", [False, True])
@pytest.mark.parametrize(
    "space", ["ACEScg", "ACEScct", "lin_rec709", "lin_srgb", "srgb_texture", "g22_rec709", "raw", "Linear P3-D65"]
)
def test_a_picture_is_taken_to_linear_rec709(tmp_path: Path, space: str, by_metadata: bool) -> None:
    how = ("auto", f'(colorSpace = "{space}")') if by_metadata else (space, "")
    found, pixel = read(tmp_path, *how)
    wanted = spaces.linear((51 / 255, 128 / 255, 204 / 255), spaces.canonical(space))
    np.testing.assert_allclose(pixel, (*wanted, 1.0), atol=1e-6)
    assert "colour space" not in found.texts


def test_a_space_that_nobody_knows_is_named_with_those_that_are(tmp_path: Path) -> None:
    found, pixel = read(tmp_path, "ARRI LogC3")
    assert "'ARRI LogC3'" in found.texts
    assert "lin_ap1" in found.texts
    np.testing.assert_allclose(pixel, read(tmp_path, "auto")[1])


def test_half_and_float_files_hold_linear_light(tmp_path: Path) -> None:
    """Of a name the primaries count, its curve does not: it is one of integers."""
    oiio = pytest.importorskip("OpenImageIO")
    spec = oiio.ImageSpec(1, 1, 3, "half")
    file = oiio.ImageOutput.create("exr")
    assert file.open(str(tmp_path / "a.exr"), spec)
    assert file.write_image(np.array([[[0.25, 0.5, 4.0]]], np.float32))
    file.close()

    def pixel(space: str) -> NDArray[np.float32]:
        found = read_texture(str(tmp_path / "a.exr"), name="a", color_space=space).pixels[0, 0, :3]
        return found.astype(np.float32)

    np.testing.assert_allclose(pixel("lin_ap1"), spaces.linear((0.25, 0.5, 4.0), "lin_ap1"), rtol=1e-5)
    np.testing.assert_allclose(pixel("srgb_ap1"), pixel("lin_ap1"), rtol=1e-6)
    np.testing.assert_allclose(pixel("sRGB"), (0.25, 0.5, 4.0))
    # A logarithm is in the numbers, whatever holds them.
    np.testing.assert_allclose(pixel("acescct"), spaces.linear((0.25, 0.5, 4.0), "acescct"), rtol=1e-5)


@pytest.mark.parametrize("how", ["attribute", "prim", "above"])
def test_a_colour_has_the_space_of_its_attribute_or_prim(tmp_path: Path, how: str) -> None:
    api = '(prepend apiSchemas = ["ColorSpaceAPI"])'
    line = 'uniform token colorSpace:name = "lin_ap1_scene"'
    above, at = (api, line) if how == "above" else ("", "")
    meta = '(colorSpace = "lin_ap1_scene")' if how == "attribute" else ""
    inputs = f"color3f inputs:diffuseColor = (0.5, 0.4, 0.3) {meta}\nfloat inputs:roughness = 0.3"
    surface = shader(inputs)
    if how == "prim":
        surface = surface.replace('def Shader "S"', f'def Shader "S" {api}').replace("info:id", "info:id", 1)
        surface = surface.replace("{", "{\n" + line, 1)
    path = tmp_path / "m.usda"
    path.write_text(f'{HEADER}def Material "M" {above}\n{{\n{at}\n{surface}\n}}\n')
    found = Reading(Usd.Stage.Open(str(path)))
    assert found[Param.DIFFUSE].value[:3] == pytest.approx(spaces.linear((0.5, 0.4, 0.3), "lin_ap1"), abs=1e-5)
    assert found[Param.ROUGHNESS].value[0] == pytest.approx(0.3)
