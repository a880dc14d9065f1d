"""Omniverse's MDL templates, known by name: OmniPBR, OmniGlass, OmniSurface."""

from __future__ import annotations

from pathlib import Path

import pytest
from material_reading import HEADER, Reading, write_png
from pxr import Usd
from test_convert import block, material, run

from refract_core.scene import Channel, Model, Param
from refract_core.usd.stage import load_stage

BOUND = 'def Plane "G" (prepend apiSchemas = ["MaterialBindingAPI"])\n{\nrel material:binding = </M>\n}\n'


def written(folder: Path, name: str, *inputs: str, module: str = "") -> Path:
    write_png(folder / "t.png", [[(51, 102, 204, 128)]])
    shader = block(
        'def Shader "S"', 'uniform token info:implementationSource = "sourceAsset"',
        f"uniform asset info:mdl:sourceAsset = @{module or name + '.mdl'}@",
        f'uniform token info:mdl:sourceAsset:subIdentifier = "{name}"', *inputs, "token outputs:out",
    )  # fmt: skip
    path = folder / "m.usda"
    made = block('def Material "M"', "token outputs:mdl:surface.connect = </M/S.outputs:out>", shader)
    path.write_text(f"{HEADER}{made}\n{BOUND}")
    return path


def read(folder: Path, name: str, *inputs: str, module: str = "", **how: object) -> Reading:
    return Reading(Usd.Stage.Open(str(written(folder, name, *inputs, module=module))), **how)  # type: ignore[arg-type]


def picture(name: str) -> str:
    return f"asset inputs:{name} = @./t.png@"


def test_omni_pbr_has_the_defaults_of_its_template(tmp_path: Path) -> None:
    found = read(tmp_path, "OmniPBR")
    assert found[Param.DIFFUSE].value[:3] == pytest.approx((0.2, 0.2, 0.2))
    assert found[Param.ROUGHNESS].value[0] == 0.5
    assert found[Param.METALLIC].value[0] == 0.0
    n = found[Param.IOR].value[0]
    assert ((n - 1.0) / (n + 1.0)) ** 2 == pytest.approx(0.04)  # specular level 0.5
    assert found[Param.EMISSIVE].value[:3] == (0.0, 0.0, 0.0)
    assert found.material.model is Model.NONE
    assert not found.notices


def test_pictures_and_their_influence(tmp_path: Path) -> None:
    found = read(
        tmp_path, "OmniPBR", picture("diffuse_texture"), "color3f inputs:diffuse_tint = (0.5, 1, 1)",
        picture("reflectionroughness_texture"), "float inputs:reflection_roughness_texture_influence = 0.25",
        "float inputs:reflection_roughness_constant = 0.8", picture("metallic_texture"),
        picture("normalmap_texture"), "float inputs:bump_factor = 0.5", "float2 inputs:texture_scale = (2, 3)",
        "float2 inputs:texture_translate = (0.1, 0.2)", "int inputs:uv_space_index = 1",
    )  # fmt: skip
    color, rough = found[Param.DIFFUSE], found[Param.ROUGHNESS]
    assert color.scale[:3] == (0.5, 1.0, 1.0)
    assert color.uv_primvar == "st1"
    assert color.uv_matrix == pytest.approx((2, 0, 0.1, 0, 3, 0.2))
    of = 0.4 * rough.scale[0] + rough.bias[0]
    assert of == pytest.approx(0.25 * 0.4 + 0.75 * 0.8)
    assert found[Param.METALLIC].texture < 0  # whose influence is 0
    assert found[Param.NORMAL].scale[:3] == (1.0, 1.0, 2.0)
    spaces = {name.rsplit("(", 1)[-1] for name in found.textures}
    assert len(found.textures) == 2  # the same file as colour and as data
    assert "raw)" in spaces


def test_a_packed_picture_has_occlusion_roughness_metal(tmp_path: Path) -> None:
    found = read(tmp_path, "OmniPBR", "bool inputs:enable_ORM_texture = 1", picture("ORM_texture"),
                 "float inputs:reflection_roughness_texture_influence = 1",
                 "float inputs:metallic_texture_influence = 1", "float inputs:ao_to_diffuse = 1")  # fmt: skip
    places = {Param.OCCLUSION: Channel.R, Param.ROUGHNESS: Channel.G, Param.METALLIC: Channel.B}
    for param, channel in places.items():
        assert found[param].texture >= 0
        assert found[param].channel is channel


def test_opacity_counts_where_it_is_switched_on(tmp_path: Path) -> None:
    off = read(tmp_path, "OmniPBR", "float inputs:opacity_constant = 0.25")
    on = read(tmp_path, "OmniPBR", "float inputs:opacity_constant = 0.25", "bool inputs:enable_opacity = 1")
    cut = read(tmp_path, "OmniPBR_Opacity", picture("opacity_texture"), "bool inputs:enable_opacity = 1",
               "int inputs:opacity_mode = 0", "float inputs:opacity_threshold = 0.3")  # fmt: skip
    assert not off.material.cutout
    assert on.material.opacity_presence
    assert on.material.model is Model.NONE
    assert cut.material.opacity_threshold == pytest.approx(0.3)
    assert cut[Param.OPACITY].channel is Channel.A


def test_emission_needs_its_switch(tmp_path: Path) -> None:
    glow = ("color3f inputs:emissive_color = (1, 0.5, 0)", "float inputs:emissive_intensity = 10")
    assert read(tmp_path, "OmniPBR", *glow)[Param.EMISSIVE].value[:3] == (0.0, 0.0, 0.0)
    on = read(tmp_path, "OmniPBR", *glow, "bool inputs:enable_emission = 1")
    assert on[Param.EMISSIVE].value[:3] == pytest.approx((10.0, 5.0, 0.0))


def test_stained_omni_glass(tmp_path: Path) -> None:
    inputs = (picture("glass_color_texture"), picture("roughness_texture"), "bool inputs:thin_walled = 1")
    found = read(tmp_path, "OmniGlass", *inputs)
    assert found.material.model is Model.THIN
    assert found[Param.TRANSMITTANCE].texture >= 0
    assert found[Param.ROUGHNESS].channel is Channel.R
    out = tmp_path / "out.usda"
    assert run(str(tmp_path / "m.usda"), out)["M"].color_from
    after = material(load_stage(out), "M")
    assert after.inputs[Param.TRANSMITTANCE].texture >= 0  # as a UsdUVTexture


TRANSMITS = ("bool inputs:enable_specular_transmission = 1", "float inputs:specular_transmission_weight = 0.75",
             "color3f inputs:specular_transmission_color = (0.2, 0.5, 0.9)",
             "float inputs:specular_transmission_scattering_depth = 7",
             "float inputs:specular_transmission_dispersion_abbe = 40",
             "float inputs:specular_reflection_ior = 1.33")  # fmt: skip


@pytest.mark.parametrize("name", ["OmniSurface", "OmniSurfaceBase"])
def test_omni_surface_is_glass_where_it_transmits(tmp_path: Path, name: str) -> None:
    found = read(tmp_path, name, *TRANSMITS, metres_per_unit=0.1)
    assert found.material.model is Model.TRACED
    assert found[Param.OPACITY].value[0] == pytest.approx(0.25)
    assert found[Param.IOR].value[0] == pytest.approx(1.33)
    assert found[Param.TRANSMITTANCE].value[:3] == pytest.approx((0.2, 0.5, 0.9))
    assert found.material.absorption_distance == pytest.approx(0.7)
    assert found.material.abbe == pytest.approx(40.0)
    opaque = read(tmp_path, name, *TRANSMITS[1:])  # the switch is off
    assert opaque.material.model is Model.NONE
    assert opaque[Param.DIFFUSE].value[:3] == pytest.approx((0.8, 0.8, 0.8))


def test_a_name_with_types_and_packages_is_the_same_material(tmp_path: Path) -> None:
    found = read(tmp_path, "::nvidia::OmniGlass(color,float)", module="nvidia/OmniGlass.mdl")
    assert found.material.model is Model.TRACED


def test_any_other_mdl_is_named_once_for_all_it_is_on(tmp_path: Path) -> None:
    path = written(tmp_path, "Fancy_Marble")
    text = path.read_text()
    path.write_text(text + text.removeprefix(HEADER).replace('"M"', '"N"').replace("</M", "</N").replace('"G"', '"H"'))
    told = [notice.text for notice in load_stage(path).notices if "MDL" in notice.text]
    assert len(told) == 1
    assert "'Fancy_Marble'" in told[0]
    assert "/M, /N" in told[0]
