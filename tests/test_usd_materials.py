"""UsdPreviewSurface, RefractMaterialAPI and unknown surfaces as rows of the material table."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from material_reading import Reading, api, preview, shader, stage_of
from pxr import Usd, UsdShade

from refract_core.errors import StageError
from refract_core.scene import Model, Param, Source
from refract_core.usd.materials.read import display_color_material, read_material

# --- UsdPreviewSurface ----------------------------------------------------------------------------------------------


def test_defaults_are_those_of_the_usdpreviewsurface_specification() -> None:
    found = preview()
    expected = {
        Param.DIFFUSE: (0.18, 0.18, 0.18),
        Param.EMISSIVE: (0.0, 0.0, 0.0),
        Param.SPECULAR: (0.0, 0.0, 0.0),
        Param.METALLIC: (0.0,),
        Param.ROUGHNESS: (0.5,),
        Param.CLEARCOAT: (0.0,),
        Param.CLEARCOAT_ROUGHNESS: (0.01,),
        Param.OPACITY: (1.0,),
        Param.IOR: (1.5,),
        Param.NORMAL: (0.0, 0.0, 1.0),
        Param.OCCLUSION: (1.0,),
    }
    for param, value in expected.items():
        assert found[param].value[: len(value)] == pytest.approx(value), param
    assert found.material.model is Model.NONE
    assert not found.material.specular_workflow
    assert not found.notices
    assert len(found.material.inputs) == len(Param)


def test_every_input_reaches_its_own_column() -> None:
    scalars = {
        "metallic": (Param.METALLIC, 0.31),
        "roughness": (Param.ROUGHNESS, 0.32),
        "clearcoat": (Param.CLEARCOAT, 0.33),
        "clearcoatRoughness": (Param.CLEARCOAT_ROUGHNESS, 0.34),
        "opacity": (Param.OPACITY, 0.35),
        "ior": (Param.IOR, 1.36),
        "occlusion": (Param.OCCLUSION, 0.37),
    }
    colors = {
        "color3f inputs:diffuseColor": (Param.DIFFUSE, (0.1, 0.2, 0.3)),
        "color3f inputs:emissiveColor": (Param.EMISSIVE, (4.0, 5.0, 6.0)),
        "color3f inputs:specularColor": (Param.SPECULAR, (0.7, 0.8, 0.9)),
        "normal3f inputs:normal": (Param.NORMAL, (0.0, 0.6, 0.8)),
    }
    text = "\n".join(f"float inputs:{name} = {value}" for name, (_, value) in scalars.items())
    text += "\n" + "\n".join(f"{name} = {value}" for name, (_, value) in colors.items())
    found = preview(text + "\nint inputs:useSpecularWorkflow = 1")
    for param, value in scalars.values():
        assert found[param].value == pytest.approx((value,) * 4)
    for param, triple in colors.values():
        assert found[param].value == pytest.approx((*triple, 1.0))
    assert found.material.specular_workflow


def test_values_come_through_node_graphs_and_interface_inputs_at_the_time_asked_for() -> None:
    stage = stage_of("""
    float inputs:rough.timeSamples = { 0: 0.2, 10: 0.4 }
    token outputs:surface.connect = </M/G.outputs:surface>
    def NodeGraph "G"
    {
        float inputs:r.connect = </M.inputs:rough>
        token outputs:surface.connect = </M/G/S.outputs:surface>
        def Shader "S"
        {
            uniform token info:id = "UsdPreviewSurface"
            float inputs:roughness = 0.9
            float inputs:roughness.connect = </M/G.inputs:r>
            token outputs:surface
        }
    }
    """)
    assert Reading(stage, time=5.0)[Param.ROUGHNESS].value[0] == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("inputs", "closed", "model"),
    [
        ("float inputs:opacity = 0.2", True, Model.TRACED),
        ("float inputs:opacity = 0.2", False, Model.THIN),
        ("float inputs:opacity = 1", True, Model.NONE),
        ('float inputs:opacity = 0.2\ntoken inputs:opacityMode = "presence"', True, Model.NONE),
        ("float inputs:opacity = 0.2\nfloat inputs:opacityThreshold = 0.5", True, Model.NONE),
    ],
)
def test_transparent_opacity_is_glass_traced_where_closed(inputs: str, closed: bool, model: Model) -> None:
    found = preview(inputs, closed=closed)
    assert found.material.model is model
    if model is Model.THIN:
        assert found[Param.THICKNESS] == Source(value=(0.005,) * 4)
        assert found.material.absorption_distance == pytest.approx(0.005)
    assert found.material.opacity_presence == ("presence" in inputs)
    assert found.material.opacity_threshold == (0.5 if "Threshold" in inputs else 0.0)


@pytest.mark.parametrize(
    ("text", "param", "kept", "said"),
    [
        ("float inputs:ior = 0.5", Param.IOR, 1.0, "at least 1"),
        ("float inputs:ior = nan", Param.IOR, 1.5, "inputs:ior is nan"),
        ("float inputs:roughness = 1.5", Param.ROUGHNESS, 1.0, "0 to 1"),
        ("float inputs:metallic = -1", Param.METALLIC, 0.0, "0 to 1"),
        ("float inputs:opacity = 7", Param.OPACITY, 1.0, "0 to 1"),
        ("color3f inputs:diffuseColor = (nan, 1, 1)", Param.DIFFUSE, 0.18, "diffuseColor"),
        ("normal3f inputs:normal = (0, 0, 0)", Param.NORMAL, 0.0, "no direction"),
    ],
)
def test_a_value_out_of_range_is_named_and_brought_back(text: str, param: Param, kept: float, said: str) -> None:
    found = preview(text)
    assert found[param].value[0] == pytest.approx(kept)
    assert len(found.notices) == 1
    assert found.notices[0].path == "/M"
    assert said in found.notices[0].text


@pytest.mark.parametrize(("value", "count"), [("0", 0), ("0.5", 1)])
def test_displacement_is_named_where_it_would_show(value: str, count: int) -> None:
    assert preview(f"float inputs:displacement = {value}").texts.count("displacement is ignored") == count




# --- RefractMaterialAPI ---------------------------------------------------------------------------------------------


def test_api_lengths_are_metres_and_the_multiplier_is_folded_in() -> None:
    found = api(
        """
        uniform token refraction:model = "box"
        float inputs:refraction:ior = 1.33
        float inputs:refraction:thickness = 4
        float inputs:refraction:thicknessMultiplier = 3
        color3f inputs:refraction:transmittanceColor = (0.5, 0.6, 0.7)
        float inputs:refraction:absorptionDistance = 5
        float inputs:refraction:abbeNumber = 40
        uniform int refraction:priority = 2
        """,
        "float inputs:ior = 2\nfloat inputs:roughness = 0.1",
        metres_per_unit=0.01,
    )
    material = found.material
    assert material.model is Model.BOX
    assert found[Param.IOR].value[0] == pytest.approx(1.33)
    assert found[Param.THICKNESS].value[0] == pytest.approx(0.12)
    assert found[Param.THICKNESS].primvar == "refraction:thickness"
    assert found[Param.THICKNESS].scale[0] == pytest.approx(0.03)  # a primvar of 4 gives the same 0.12 m
    assert found[Param.TRANSMITTANCE].value[:3] == pytest.approx((0.5, 0.6, 0.7))
    assert material.absorption_distance == pytest.approx(0.05)
    assert (material.abbe, material.priority) == (40.0, 2)
    assert found[Param.ROUGHNESS].value[0] == pytest.approx(0.1)
    assert found[Param.OPACITY].value[0] == 0.0  # nothing authored: fully refractive
    assert found.notices == []


@pytest.mark.parametrize("priority", [0, 2, -1])
def test_a_priority_is_any_whole_number(priority: int) -> None:
    found = api(f"uniform int refraction:priority = {priority}")
    assert found.material.priority == priority
    assert found.notices == []


def test_api_without_any_attribute_or_shader_is_clear_spherical_glass() -> None:
    found = Reading(stage_of("", api=True))
    assert found.material.model is Model.SPHERE
    assert found[Param.IOR].value[0] == 1.5
    assert found[Param.THICKNESS].value[0] == 1.0
    assert found[Param.ROUGHNESS].value[0] == found[Param.OPACITY].value[0] == 0.0
    assert not found.notices


@pytest.mark.parametrize(("opacity", "count"), [("0.25", 0), ("1", 1)])
def test_authored_opacity_is_kept_under_the_api(opacity: str, count: int) -> None:
    found = api("", f"float inputs:opacity = {opacity}")
    assert found[Param.OPACITY].value[0] == float(opacity)
    assert found.texts.count("no refraction shows") == count


def test_thin_fixes_five_millimetres_whatever_is_authored() -> None:
    found = api('uniform token refraction:model = "thin"\nfloat inputs:refraction:thickness = 3', metres_per_unit=0.01)
    assert found[Param.THICKNESS] == Source(value=(0.005,) * 4)
    assert found.material.absorption_distance == 0.005
    assert "refraction:thickness is ignored" in found.texts


def test_model_none_leaves_opacity_as_coverage() -> None:
    found = api('uniform token refraction:model = "none"', "float inputs:opacity = 0.5")
    assert not found.material.refractive
    assert found.material.opacity_presence


def test_an_unknown_model_token_is_an_error_with_the_allowed_ones() -> None:
    with pytest.raises(StageError, match=r"/M: refraction:model is 'banana'.*none, sphere, box, thin, traced"):
        api('uniform token refraction:model = "banana"')


@pytest.mark.parametrize(
    ("attribute", "said"),
    [
        ("float inputs:refraction:ior = 0.9", "refraction:ior"),
        ("float inputs:refraction:thickness = 0", "thickness"),
        ("float inputs:refraction:thickness = nan", "thickness"),
        ("float inputs:refraction:thicknessMultiplier = -1", "thicknessMultiplier"),
        ("float inputs:refraction:absorptionDistance = 0", "absorptionDistance"),
        ("float inputs:refraction:abbeNumber = -3", "abbeNumber"),
        ("color3f inputs:refraction:transmittanceColor = (2, 0, 0)", "transmittanceColor"),
    ],
)
def test_bad_api_values_are_named_and_leave_a_renderable_material(attribute: str, said: str) -> None:
    found = api(attribute)
    assert len(found.notices) == 1
    assert said in found.notices[0].text
    assert found[Param.IOR].value[0] >= 1.0
    assert found[Param.THICKNESS].value[0] >= 1e-4
    assert found.material.absorption_distance > 0.0
    assert found.material.abbe >= 0.0
    assert all(0.0 <= c <= 1.0 for c in found[Param.TRANSMITTANCE].value)


# --- what is not known ---

BARE = 'def Shader "S" { token outputs:out; }'


@pytest.mark.parametrize(
    ("inner", "said"),
    [
        (shader("", identifier="ArnoldStandard"), "ArnoldStandard"),
        ('token outputs:surface.connect = </M/S.outputs:out>\n' + BARE, "without info:id"),
        ('token outputs:mdl:surface.connect = </M/S.outputs:out>\n' + BARE, "outputs:mdl"),
        ("", "has no surface shader"),
    ],
)
def test_an_unknown_surface_is_named_and_shows_display_color(inner: str, said: str) -> None:
    found = Reading(stage_of(inner))
    assert said in found.texts
    assert found[Param.DIFFUSE].primvar == "displayColor"
    assert found[Param.DIFFUSE].value[0] == pytest.approx(0.18)
    assert found.material.model is Model.NONE


def test_display_color_material_has_opacity_only_where_asked() -> None:
    plain, faded = (display_color_material("/Mesh", has_opacity=has) for has in (False, True))
    assert plain.inputs[Param.DIFFUSE].primvar == "displayColor"
    assert plain.inputs[Param.OPACITY].primvar == ""
    assert not plain.cutout
    assert faded.inputs[Param.OPACITY].primvar == "displayOpacity"
    assert faded.cutout
    assert not faded.refractive


def test_a_loop_of_nodes_ends() -> None:
    loop = "".join(
        f'def Shader "{a}" {{ uniform token info:id = "ND_dot_float"; float inputs:in.connect = </M/{b}.outputs:out>; '
        "float outputs:out; }\n"
        for a, b in (("A", "B"), ("B", "A"))
    )
    found = preview("float inputs:roughness.connect = </M/A.outputs:out>", loop)
    assert math.isfinite(found[Param.ROUGHNESS].value[0])
    assert found.notices


def test_every_material_of_the_real_stages_can_be_read(assets: Path) -> None:
    count = 0
    for path in sorted([*assets.glob("openusd_*/*.usda"), *assets.glob("cornell_box/*/*.usda")]):
        stage = Usd.Stage.Open(str(path))
        for prim in stage.Traverse():
            if prim.IsA(UsdShade.Material):
                material = read_material(UsdShade.Material(prim), Usd.TimeCode(0), metres_per_unit=0.01, closed=True,
                                         textures={}, notices=[])  # fmt: skip
                assert all(math.isfinite(v) for source in material.inputs for v in source.value)
                count += 1
    assert count > 50
