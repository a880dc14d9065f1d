"""Pictures in tiles (UDIM): every tile's texels appear at its coordinates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from material_reading import HEADER, Reading, shader, write_png
from numpy.typing import NDArray
from pxr import Usd, UsdUtils
from test_convert import material, run

from refract_core.errors import ImageError
from refract_core.images import codec
from refract_core.scene import Model, Param, Source, Texture, Wrap
from refract_core.usd.materials import udim
from refract_core.usd.materials.textures import read_texture
from refract_core.usd.stage import load_stage
from refract_core.world.textures import pack, sample

NETWORK = """
    def Shader "T"
    {
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @tex/t.<UDIM>.png@
        float4 inputs:fallback = (0.1, 0.2, 0.3, 0.4)
        token inputs:sourceColorSpace = "raw"
        float2 inputs:st.connect = </M/P.outputs:result>
        float outputs:r
        float outputs:a
        float3 outputs:rgb
    }
    def Shader "P"
    {
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname = "st"
        float2 outputs:result
    }
"""
DIFFUSE = "color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>"


def tile(number: int, side: int = 4) -> list[list[tuple[int, ...]]]:
    """Every texel of every tile has a colour of its own, row 0 on top."""
    return [[(number - 1000, 10 * x + 5, 10 * y + 5, 255) for x in range(side)] for y in range(side)]


def tiles(folder: Path, numbers: tuple[int, ...], side: int = 4) -> str:
    (folder / "tex").mkdir(exist_ok=True)
    for number in numbers:
        write_png(folder / "tex" / f"t.{number}.png", tile(number, side))
    return str(folder / "tex" / "t.<UDIM>.png")


def stage(folder: Path, inputs: str = DIFFUSE, network: str = NETWORK) -> Path:
    path = folder / "m.usda"
    path.write_text(f'{HEADER}def Material "M"\n{{\n{network}{shader(inputs)}\n}}\n')
    return path


def looked_up(source: Source, textures: dict[str, Texture], s: float, t: float) -> NDArray[np.float64]:
    """What the renderer finds at (s, t), in bytes."""
    a, b, c, d, e, f = source.uv_matrix
    table = pack(list(textures.values()))
    wrap = int(source.wrap[0]), int(source.wrap[1])
    found = sample(table, source.texture, a * s + b * t + c, d * s + e * t + f, 0.0, *wrap)
    return np.array(found) * 255.0


@pytest.mark.parametrize("numbers", [(1001,), (1001, 1002), (1003, 1012), (1001, 1011, 1012), (1100,)])
def test_each_texel_is_at_its_uv(tmp_path: Path, numbers: tuple[int, ...]) -> None:
    tiles(tmp_path, numbers)
    found = Reading(Usd.Stage.Open(str(stage(tmp_path))))
    assert not found.notices
    source = found[Param.DIFFUSE]
    for number in numbers:
        v, u = divmod(number - 1001, 10)
        for y, row in enumerate(tile(number)):
            for x, colour in enumerate(row):
                s, t = u + (x + 0.5) / 4, v + 1.0 - (y + 0.5) / 4
                np.testing.assert_allclose(looked_up(source, found.textures, s, t), colour, atol=0.01)


def test_the_very_edge_of_a_tile_takes_in_no_black_and_beyond_all_is(tmp_path: Path) -> None:
    tiles(tmp_path, (1001, 1003))
    found = Reading(Usd.Stage.Open(str(stage(tmp_path))))
    source = found[Param.DIFFUSE]
    for s, t in ((0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (2.0, 0.5), (3.0, 1.0)):
        nearest = tile(1001 if s <= 1.0 else 1003)[3 if t == 0.0 else 0][0 if s in (0.0, 2.0) else 3]
        seen = looked_up(source, found.textures, s, t)
        assert seen[0] == pytest.approx(nearest[0], abs=0.01)  # of this tile alone
        if t != 0.5:
            np.testing.assert_allclose(seen, nearest, atol=0.01)
    for s, t in ((1.5, 0.5), (-0.5, 0.5), (3.5, 0.5), (0.5, 1.5), (0.5, -0.5)):
        assert looked_up(source, found.textures, s, t).max() == 0.0


def test_tiles_of_several_sizes_and_kinds_keep_their_colours(tmp_path: Path) -> None:
    path = tiles(tmp_path, (1001,))
    write_png(tmp_path / "tex" / "t.1002.png", [[(200, 100, 50, 255)] * 2] * 2)  # smaller
    source = Reading(Usd.Stage.Open(str(stage(tmp_path))))
    for s, t in ((1.25, 0.25), (1.75, 0.75)):
        seen = looked_up(source[Param.DIFFUSE], source.textures, s, t)
        np.testing.assert_allclose(seen[:3], (200, 100, 50), atol=0.01)
    grey = tmp_path / "grey"
    grey.mkdir()
    path = tiles(grey, (1001,))
    oiio = pytest.importorskip("OpenImageIO")
    file = oiio.ImageOutput.create("png")
    assert file.open(str(grey / "tex" / "t.1002.png"), oiio.ImageSpec(4, 4, 1, "uint8"))  # auto: not of sRGB's curve
    assert file.write_image(np.full((4, 4, 1), 128, np.uint8))
    file.close()
    mixed = read_texture(path, "auto")
    assert isinstance(mixed, udim.Tiled)
    assert mixed.srgb
    first, second = mixed.parts()
    assert first[0, 0].tolist() == [1, 5, 5, 255]
    assert second[0, 0].tolist() == [188, 188, 188, 255]  # 128 / 255 is linear light: 188 in sRGB


def test_no_tile_at_all_is_the_fallback_and_named(tmp_path: Path) -> None:
    found = Reading(Usd.Stage.Open(str(stage(tmp_path))))
    assert found[Param.DIFFUSE].texture == -1
    assert found[Param.DIFFUSE].value[:3] == pytest.approx((0.1, 0.2, 0.3))
    assert "no tile of it is there" in found.texts


def test_gaps_between_tiles_make_no_glass(tmp_path: Path) -> None:
    """Opacity is 1 wherever there is a tile; black between them is meant by nobody."""
    tiles(tmp_path, (1001, 1003, 1021))
    found = Reading(Usd.Stage.Open(str(stage(tmp_path, "float inputs:opacity.connect = </M/T.outputs:a>"))))
    assert found.material.model is Model.NONE


def test_too_many_tiles_are_made_smaller_and_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiles(tmp_path, (1001, 1004), side=8)
    monkeypatch.setattr(udim, "LARGEST", 1000)
    found = Reading(Usd.Stage.Open(str(stage(tmp_path))))
    assert "at 1/" in found.texts
    texture = next(iter(found.textures.values()))
    assert texture.pixels.nbytes <= 1000
    seen = looked_up(found[Param.DIFFUSE], found.textures, 0.5, 0.5)
    assert seen[0] == pytest.approx(1.0, abs=0.01)
    assert seen[1] == pytest.approx(np.mean([10 * x + 5 for x in range(8)]), abs=1.0)


def test_tiles_together_keep_the_limit_on_one_texture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a service sets it."""
    tiles(tmp_path, (1001, 1002, 1003), side=8)
    monkeypatch.setattr(codec, "MAX_TEXTURE_PIXELS", 100)
    found = Reading(Usd.Stage.Open(str(stage(tmp_path))))
    assert "at 1/" in found.texts
    (texture,) = found.textures.values()
    assert texture.pixels.shape[0] * texture.pixels.shape[1] <= 100


def test_tiles_inside_a_package_are_read(tmp_path: Path) -> None:
    tiles(tmp_path, (1001, 1002))
    package = tmp_path / "packed.usdz"
    assert UsdUtils.CreateNewUsdzPackage(str(stage(tmp_path)), str(package))
    found = Reading(Usd.Stage.Open(str(package)))
    seen = looked_up(found[Param.DIFFUSE], found.textures, 1.125, 0.875)
    np.testing.assert_allclose(seen, tile(1002)[0][0], atol=0.01)


def test_a_broken_tile_is_named(tmp_path: Path) -> None:
    path = tiles(tmp_path, (1001, 1002))
    (tmp_path / "tex" / "t.1002.png").write_bytes(b"no picture")
    with pytest.raises(ImageError, match=r"t\.1002\.png"):
        read_texture(path, "raw")


@pytest.mark.parametrize("to", ["preview", "openpbr", "gltf"])
def test_tiles_are_written_back_by_their_own_name(tmp_path: Path, to: str) -> None:
    """What `convert --to` writes reads back as the same picture at the same coordinates."""
    tiles(tmp_path, (1002, 1003))
    inputs = "color3f inputs:emissiveColor.connect = </M/T.outputs:rgb>\nfloat inputs:opacity = 0"
    network = "color3f inputs:refraction:transmittanceColor.connect = </M/T.outputs:rgb>" + NETWORK
    path = stage(tmp_path, inputs, network)
    text = path.read_text().replace('"M"', '"M" (prepend apiSchemas = ["RefractMaterialAPI"])', 1)
    ball = 'def Sphere "B" (prepend apiSchemas = ["MaterialBindingAPI"])\n{\nrel material:binding = </M>\n}\n'
    path.write_text(text + ball)
    out = tmp_path / "sub" / "out.usda"
    out.parent.mkdir()
    run(str(path), out, to=to)
    before, after = load_stage(path), load_stage(out)
    for one in (before, after):
        source = material(one, "M").inputs[Param.TRANSMITTANCE]
        assert source.wrap == (Wrap.BLACK, Wrap.BLACK)
        textures = {str(n): texture for n, texture in enumerate(one.textures)}
        for number, u in ((1002, 1), (1003, 2)):
            np.testing.assert_allclose(looked_up(source, textures, u + 0.125, 0.875), tile(number)[0][0], atol=0.01)
