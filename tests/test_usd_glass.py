"""OpenPBR, standard_surface and glTF PBR as rows of the material table."""

from __future__ import annotations

from pathlib import Path

import pytest
from material_reading import HEADER, Reading, shader, stage_of, write_png
from pxr import Usd

from refract_core.scene import Model, Param, Wrap


def mtlx(identifier: str, inputs: str = "", more: str = "", **how: object) -> Reading:
    text = shader(inputs, identifier=f"ND_{identifier}_surfaceshader", output="mtlx:surface")
    return Reading(stage_of(text + more), **how)  # type: ignore[arg-type]


GLASS = {
    "open_pbr_surface": "float inputs:transmission_weight = 0.75\nfloat inputs:specular_ior = 1.4\n"
    "float inputs:specular_roughness = 0.2\ncolor3f inputs:transmission_color = (0.5, 0.6, 0.7)\n"
    "float inputs:transmission_depth = 3\nfloat inputs:transmission_dispersion_scale = 0.5\n"
    "float inputs:transmission_dispersion_abbe_number = 20",
    "standard_surface": "float inputs:transmission = 0.75\nfloat inputs:specular_IOR = 1.4\n"
    "float inputs:specular_roughness = 0.2\ncolor3f inputs:transmission_color = (0.5, 0.6, 0.7)\n"
    "float inputs:transmission_depth = 3\nfloat inputs:transmission_dispersion = 40",
    "gltf_pbr": "float inputs:transmission = 0.75\nfloat inputs:ior = 1.4\nfloat inputs:metallic = 0\n"
    "float inputs:roughness = 0.2\ncolor3f inputs:attenuation_color = (0.5, 0.6, 0.7)\n"
    "float inputs:attenuation_distance = 3\nfloat inputs:dispersion = 0.5\nfloat inputs:thickness = 1",
}


@pytest.mark.parametrize("identifier", list(GLASS))
def test_the_same_glass_in_three_shaders_is_the_same_material(identifier: str) -> None:
    found = mtlx(identifier, GLASS[identifier], metres_per_unit=0.1)
    assert found.material.model is Model.TRACED
    assert found[Param.OPACITY].value[0] == pytest.approx(0.25)
    assert found[Param.IOR].value[0] == pytest.approx(1.4)
    assert found[Param.ROUGHNESS].value[0] == pytest.approx(0.2)
    assert found[Param.TRANSMITTANCE].value[:3] == pytest.approx((0.5, 0.6, 0.7))
    assert found.material.absorption_distance == pytest.approx(0.3)
    assert found.material.abbe == pytest.approx(40.0)
    assert not found.notices
    assert mtlx(identifier, GLASS[identifier], closed=False).material.model is Model.THIN


def test_thin_walled_is_thin_and_its_colour_tints_once() -> None:
    found = mtlx(
        "open_pbr_surface",
        "float inputs:transmission_weight = 1\nbool inputs:geometry_thin_walled = 1\n"
        "color3f inputs:transmission_color = (0.2, 0.4, 0.8)",
    )
    assert found.material.model is Model.THIN
    # 5 mm of wall over a distance of 5 mm: the colour itself.
    assert found[Param.THICKNESS].value[0] / found.material.absorption_distance == pytest.approx(1.0)


def test_opaque_open_pbr_maps_weights_and_presence() -> None:
    found = mtlx(
        "open_pbr_surface",
        "float inputs:base_weight = 0.5\ncolor3f inputs:base_color = (0.2, 0.4, 0.6)\n"
        "float inputs:emission_luminance = 10\ncolor3f inputs:emission_color = (1, 0.5, 0)\n"
        "float inputs:geometry_opacity = 0.4\nfloat inputs:specular_weight = 0\nfloat inputs:fuzz_weight = 1",
    )
    assert found.material.model is Model.NONE
    assert found[Param.DIFFUSE].value[:3] == pytest.approx((0.1, 0.2, 0.3))
    assert found[Param.EMISSIVE].value[:3] == pytest.approx((10, 5, 0))
    assert found.material.opacity_presence
    assert found[Param.OPACITY].value[0] == pytest.approx(0.4)
    assert found[Param.IOR].value[0] == pytest.approx(1.0)  # weight 0: no reflectance at normal incidence
    assert "fuzz_weight" in found.texts


def test_a_mapped_weight_tints_a_constant_colour() -> None:
    more = """
    def Shader "P"
    {
        uniform token info:id = "ND_geompropvalue_float"
        string inputs:geomprop = "glow"
        float outputs:out
    }
    """
    found = mtlx("standard_surface", "float inputs:emission.connect = </M/P.outputs:out>\n"
                 "color3f inputs:emission_color = (1, 2, 3)", more)  # fmt: skip
    assert found[Param.EMISSIVE].primvar == "glow"
    assert found[Param.EMISSIVE].scale[:3] == (1.0, 2.0, 3.0)


def test_half_the_specular_weight_halves_the_normal_reflectance() -> None:
    def f0(n: float) -> float:
        return ((n - 1.0) / (n + 1.0)) ** 2

    whole = mtlx("open_pbr_surface", "float inputs:specular_ior = 1.6")[Param.IOR].value[0]
    half = mtlx("open_pbr_surface", "float inputs:specular_ior = 1.6\nfloat inputs:specular_weight = 0.5")
    assert f0(half[Param.IOR].value[0]) == pytest.approx(0.5 * f0(whole))


def test_an_unlit_surface_glows_and_reflects_nothing() -> None:
    text = shader("float inputs:emission = 2\ncolor3f inputs:emission_color = (1, 0.5, 0)\nfloat inputs:opacity = 0.5",
                  identifier="ND_surface_unlit", output="mtlx:surface")  # fmt: skip
    found = Reading(stage_of(text))
    assert found[Param.EMISSIVE].value[:3] == pytest.approx((2.0, 1.0, 0.0))
    assert found[Param.DIFFUSE].value[:3] == (0.0, 0.0, 0.0)
    assert found[Param.IOR].value[0] == 1.0  # no reflectance at normal incidence
    assert found.material.opacity_presence
    assert not found.notices


IMAGE = """
    def Shader "I"
    {
        uniform token info:id = "ND_image_color3"
        asset inputs:file = @FILE@
        string inputs:uaddressmode = "clamp"
        color3f outputs:out
    }
"""


def test_materialx_images_are_followed(tmp_path: Path) -> None:
    write_png(tmp_path / "t.png", [[(255, 0, 0, 255)]])
    path = tmp_path / "m.usda"
    surface = shader("color3f inputs:base_color.connect = </M/I.outputs:out>\nfloat inputs:base = 0.5",
                     identifier="ND_standard_surface_surfaceshader", output="mtlx:surface")  # fmt: skip
    path.write_text(f'{HEADER}def Material "M"\n{{\n{IMAGE.replace("FILE", "t.png")}{surface}\n}}\n')
    source = Reading(Usd.Stage.Open(str(path)))[Param.DIFFUSE]
    assert source.texture == 0
    assert source.uv_primvar == "st"
    assert source.wrap == (Wrap.CLAMP, Wrap.REPEAT)
    assert source.scale[:3] == pytest.approx((0.5, 0.5, 0.5))


def test_the_universal_surface_stands_in_for_a_materialx_one_that_is_not_understood() -> None:
    both = shader("float inputs:specular_roughness.connect = </M/N.outputs:out>",
                  identifier="ND_standard_surface_surfaceshader", output="mtlx:surface") + """
    token outputs:surface.connect = </M/U.outputs:out>
    def Shader "U" { uniform token info:id = "UsdPreviewSurface"; float inputs:roughness = 0.77; token outputs:out; }
    def Shader "N" { uniform token info:id = "ND_noise2d_float"; float outputs:out; }
    """  # fmt: skip
    found = Reading(stage_of(both))
    assert found[Param.ROUGHNESS].value[0] == pytest.approx(0.77)
    assert len(found.notices) == 1
    assert "/M/N" in found.notices[0].text
