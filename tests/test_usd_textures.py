"""Textures, their coordinates and primvar readers as `Source` records."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from material_reading import HEADER, Reading, preview, shader, write_png
from pxr import Usd, UsdUtils

from refract_core.errors import ImageError
from refract_core.scene import Channel, Model, Param, Wrap
from refract_core.usd.materials.textures import read_texture

TEXTURED = """
    string inputs:uvName = "st1"
    def Shader "T"
    {
        uniform token info:id = "UsdUVTexture"
        asset inputs:file = @FILE@
        float4 inputs:fallback = (0.1, 0.2, 0.3, 0.4)
        float4 inputs:scale = (2, 3, 4, 5)
        float4 inputs:bias = (0.01, 0.02, 0.03, 0.04)
        token inputs:wrapS = "mirror"
        token inputs:wrapT = "black"
        token inputs:sourceColorSpace = "raw"
        float2 inputs:st.connect = </M/X.outputs:result>
        float outputs:r
        float outputs:g
        float outputs:a
        float3 outputs:rgb
    }
    def Shader "X"
    {
        uniform token info:id = "UsdTransform2d"
        float2 inputs:in.connect = </M/P.outputs:result>
        float inputs:rotation = 90
        float2 inputs:scale = (2, 4)
        float2 inputs:translation = (10, 20)
        float2 outputs:result
    }
    def Shader "P"
    {
        uniform token info:id = "UsdPrimvarReader_float2"
        string inputs:varname.connect = </M.inputs:uvName>
        float2 inputs:fallback = (0.25, 0.75)
        float2 outputs:result
    }
"""


def textured(folder: Path, inputs: str, file: str = "t.png", header: str = "", body: str = TEXTURED) -> Reading:
    path = folder / "m.usda"
    path.write_text(f'{HEADER}def Material "M" {header}\n{{\n{body.replace("FILE", file)}{shader(inputs)}\n}}\n')
    return Reading(Usd.Stage.Open(str(path)))


def test_a_texture_keeps_its_wrap_scale_bias_and_coordinates(tmp_path: Path) -> None:
    write_png(tmp_path / "t.png", [[(255, 0, 0, 255), (0, 255, 0, 128)]])
    found = textured(
        tmp_path,
        "color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>\nfloat inputs:metallic.connect = </M/T.outputs:g>\n"
        "float inputs:roughness.connect = </M/T.outputs:rgb>",
    )
    source = found[Param.DIFFUSE]
    assert list(found.textures)[source.texture] == next(iter(found.textures.values())).name
    assert len(found.textures) == 1
    assert source.channel is Channel.RGB
    assert source.wrap == (Wrap.MIRROR, Wrap.BLACK)
    assert source.scale == pytest.approx((2, 3, 4, 5))
    assert source.bias == pytest.approx((0.01, 0.02, 0.03, 0.04))
    assert source.uv_primvar == "st1"
    assert source.uv_value == pytest.approx((0.25, 0.75))
    # Scale, then 90 degrees counter-clockwise, then move: (1, 0) -> (2, 0) -> (0, 2) -> (10, 22).
    m = np.array(source.uv_matrix).reshape(2, 3)
    assert m @ (1, 0, 1) == pytest.approx((10, 22))
    assert m @ (0, 1, 1) == pytest.approx((6, 20))
    assert found[Param.METALLIC].channel is Channel.G
    assert found[Param.METALLIC].scale[0] == found[Param.METALLIC].scale[Channel.G] == pytest.approx(3.0)
    assert found[Param.ROUGHNESS].channel is Channel.R
    assert found[Param.ROUGHNESS].scale[0] == pytest.approx(2.0)


@pytest.mark.parametrize("file", ["missing.png", "broken.png", "tile.<UDIM>.png"])
def test_an_unreadable_texture_becomes_its_fallback_and_is_named(tmp_path: Path, file: str) -> None:
    (tmp_path / "broken.png").write_bytes(b"not a picture")
    found = textured(
        tmp_path,
        "color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>\nfloat inputs:roughness.connect = </M/T.outputs:a>",
        file,
    )
    assert found[Param.DIFFUSE].texture == -1
    assert found[Param.DIFFUSE].value[:3] == pytest.approx((0.1, 0.2, 0.3))
    assert found[Param.ROUGHNESS].value[0] == pytest.approx(0.4)
    assert [n.path for n in found.notices] == ["/M/T"]
    assert file in found.notices[0].text


@pytest.mark.parametrize(("space", "srgb"), [("raw", False), ("sRGB", True), ("auto", True)])
def test_source_color_space_reaches_the_texture(tmp_path: Path, space: str, srgb: bool) -> None:
    write_png(tmp_path / "t.png", [[(10, 20, 30)]])
    body = TEXTURED.replace('"raw"', f'"{space}"')
    found = textured(tmp_path, "color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>", body=body)
    assert [texture.srgb for texture in found.textures.values()] == [srgb]


def test_one_file_read_both_ways_is_two_textures(tmp_path: Path) -> None:
    write_png(tmp_path / "t.png", [[(10, 20, 30)]])
    raw, srgb = (read_texture(str(tmp_path / "t.png"), space) for space in ("raw", "sRGB"))
    assert raw.name != srgb.name
    assert np.array_equal(raw.pixels, srgb.pixels)


@pytest.mark.parametrize(("alpha", "model"), [(255, Model.NONE), (254, Model.TRACED)])
def test_an_opacity_map_that_is_opaque_everywhere_is_not_glass(tmp_path: Path, alpha: int, model: Model) -> None:
    write_png(tmp_path / "t.png", [[(0, 0, 0, 255), (0, 0, 0, alpha)]])
    plain = TEXTURED.replace("(2, 3, 4, 5)", "(1, 1, 1, 1)").replace("0.04)", "0)").replace('"black"', '"clamp"')
    found = textured(tmp_path, "float inputs:opacity.connect = </M/T.outputs:a>", body=plain)
    assert found.material.model is model


def test_textures_inside_a_package_are_read(tmp_path: Path) -> None:
    write_png(tmp_path / "t.png", [[(1, 2, 3, 255), (4, 5, 6, 255)]])
    textured(tmp_path, "color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>")
    package = tmp_path / "packed.usdz"
    assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "m.usda"), str(package))
    (tmp_path / "t.png").unlink()
    found = Reading(Usd.Stage.Open(str(package)))
    texture = found.textures[list(found.textures)[found[Param.DIFFUSE].texture]]
    assert texture.pixels[0, :, :3].tolist() == [[1, 2, 3], [4, 5, 6]]
    assert not found.notices
    with pytest.raises(ImageError, match=r"holds no file 'none\.png'"):
        read_texture(f"{package}[none.png]", "auto")


def test_a_path_with_back_slashes_is_found(tmp_path: Path) -> None:
    (tmp_path / "tex").mkdir()
    write_png(tmp_path / "tex" / "t.png", [[(1, 2, 3)]])
    found = textured(tmp_path, "color3f inputs:diffuseColor.connect = </M/T.outputs:rgb>", "tex\\t.png")
    assert found[Param.DIFFUSE].texture == 0


def test_a_normal_map_without_bias_is_named(tmp_path: Path) -> None:
    write_png(tmp_path / "t.png", [[(128, 128, 255)]])
    assert "leans" in textured(tmp_path, "normal3f inputs:normal.connect = </M/T.outputs:rgb>").texts
    good = TEXTURED.replace("(2, 3, 4, 5)", "(2, 2, 2, 1)").replace("(0.01, 0.02, 0.03, 0.04)", "(-1, -1, -1, 0)")
    found = textured(tmp_path, "normal3f inputs:normal.connect = </M/T.outputs:rgb>", body=good)
    assert not found.notices
    flat = [0.5 * s + b for s, b in zip(found[Param.NORMAL].scale, found[Param.NORMAL].bias, strict=True)]
    assert flat[:2] == pytest.approx([0.0, 0.0])


def reader(kind: str, fallback: str) -> str:
    return f"""
    def Shader "P"
    {{
        uniform token info:id = "UsdPrimvarReader_{kind}"
        token inputs:varname = "primvars:tint"
        {fallback}
        {kind} outputs:result
    }}
    """


def test_primvar_readers_give_a_primvar_and_their_fallback() -> None:
    found = preview("float inputs:roughness.connect = </M/P.outputs:result>",
                    reader("float", "float inputs:fallback = 0.3"))  # fmt: skip
    assert found[Param.ROUGHNESS].primvar == "tint"
    assert found[Param.ROUGHNESS].value[0] == pytest.approx(0.3)
    found = preview("color3f inputs:diffuseColor.connect = </M/P.outputs:result>",
                    reader("float3", "float3 inputs:fallback = (1, 0, 0)"))  # fmt: skip
    assert found[Param.DIFFUSE].value[:3] == (1.0, 0.0, 0.0)


def test_opacity_from_a_primvar_may_be_glass() -> None:
    found = preview("float inputs:opacity.connect = </M/P.outputs:result>", reader("float", ""))
    assert found.material.model is Model.TRACED


def test_an_unknown_node_is_named_and_the_default_used() -> None:
    more = 'def Shader "N" { uniform token info:id = "ND_noise2d_float"; float outputs:out; }'
    found = preview("float inputs:roughness.connect = </M/N.outputs:out>", more)
    assert found[Param.ROUGHNESS].value[0] == 0.5
    assert "ND_noise2d_float" in found.texts
    assert found.notices[0].path == "/M/N"




def test_a_thickness_map_wins_over_the_primvar_and_is_scaled_to_metres(tmp_path: Path) -> None:
    write_png(tmp_path / "t.png", [[(255, 0, 0, 255)]])
    body = TEXTURED + (
        "float inputs:refraction:thickness.connect = </M/T.outputs:r>\n"
        "float inputs:refraction:thicknessMultiplier = 10\n"
    )
    header = '(prepend apiSchemas = ["RefractMaterialAPI"])'
    source = textured(tmp_path, "", header=header, body=body)[Param.THICKNESS]
    assert source.texture == 0
    assert source.primvar == ""
    assert source.channel is Channel.R
    assert 1.0 * source.scale[0] + source.bias[0] == pytest.approx(10 * (2 + 0.01))
