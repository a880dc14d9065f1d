"""Glass in other renderers' shaders, mapped onto the schema, and the nearest standard surface written back."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
from material_reading import Reading, stage_of
from pxr import Usd, UsdShade
from test_convert import HEAD, block, material, run

from refract_core.scene import Model, Param, Scene
from refract_core.usd.stage import load_stage

ARNOLD = block(
    'def Shader "S"', 'uniform token info:id = "arnold:standard_surface"', "float inputs:transmission = 1",
    "float inputs:specular_IOR = 1.33", "color3f inputs:transmission_color = (0.2, 0.5, 0.9)",
    "float inputs:transmission_depth = 7", "float inputs:transmission_dispersion = 40", "token outputs:out",
)  # fmt: skip
OMNI = block(
    'def Shader "S"', 'uniform token info:implementationSource = "sourceAsset"',
    "uniform asset info:mdl:sourceAsset = @OmniGlass.mdl@",
    'uniform token info:mdl:sourceAsset:subIdentifier = "OmniGlass"', "float inputs:glass_ior = 1.6",
    "float inputs:frosting_roughness = 0.25", "color3f inputs:glass_color = (0.9, 1, 0.8)", "token outputs:out",
)  # fmt: skip
PIXAR = block(
    'def Shader "S"', 'uniform token info:id = "PxrSurface"', "float inputs:refractionGain = 0.75",
    "float inputs:glassIor = 1.8", "float inputs:glassRoughness = 0.05", "token outputs:out",
)  # fmt: skip
OPEN_PBR = block(
    'def Shader "S"', 'uniform token info:id = "ND_open_pbr_surface_surfaceshader"',
    "float inputs:transmission_weight = 1", "float inputs:specular_ior = 1.52", "float inputs:specular_roughness = 0.1",
    "color3f inputs:transmission_color = (0.25, 0.5, 1)", "float inputs:transmission_depth = 2",
    "float inputs:transmission_dispersion_scale = 0.5", "float inputs:transmission_dispersion_abbe_number = 20",
    "token outputs:out",
)  # fmt: skip
GLTF = block(
    'def Shader "S"', 'uniform token info:id = "ND_gltf_pbr_surfaceshader"', "float inputs:transmission = 1",
    "float inputs:metallic = 0", "float inputs:ior = 1.45", "float inputs:thickness = 0.8",
    "color3f inputs:attenuation_color = (0.25, 0.5, 1)", "float inputs:attenuation_distance = 3",
    "float inputs:dispersion = 0.5", "token outputs:out",
)  # fmt: skip


def inside(context: str, shader: str) -> str:
    return f"token outputs:{context}surface.connect = </M/S.outputs:out>\n{shader}"


def stage(folder: Path, context: str, shader: str, shape: str = "Sphere", *, unit: float = 1.0) -> str:
    made = block('def Material "M"', inside(context, shader))
    bound = block(f'def {shape} "G" (prepend apiSchemas = ["MaterialBindingAPI"])', "rel material:binding = </M>")
    path = folder / "in.usda"
    path.write_text(f"{HEAD.format(unit=unit).replace('W', 'G')}{made}\n{bound}\n")
    return str(path)


def both(path: str, out: Path) -> tuple[Scene, Scene]:
    return load_stage(path), load_stage(out)


def surface_id(path: Path, context: str) -> str:
    opened = Usd.Stage.Open(str(path))
    made = UsdShade.Material(opened.GetPrimAtPath("/M"))
    return str(made.ComputeSurfaceSource(context)[0].GetShaderId())


# --- the renderer's readers


def test_arnold_reads_as_standard_surface() -> None:
    found = Reading(stage_of(inside("arnold:", ARNOLD)), metres_per_unit=0.1)
    assert found.material.model is Model.TRACED
    assert found[Param.IOR].value[0] == pytest.approx(1.33)
    assert found[Param.OPACITY].value[0] == 0.0
    assert found.material.abbe == pytest.approx(40.0)
    assert found.material.absorption_distance == pytest.approx(0.7)


def test_omni_glass_is_clear_and_tinted() -> None:
    found = Reading(stage_of(inside("mdl:", OMNI)))
    assert found.material.model is Model.TRACED
    assert found[Param.IOR].value[0] == pytest.approx(1.6)
    assert found[Param.ROUGHNESS].value[0] == pytest.approx(0.25)
    assert found[Param.TRANSMITTANCE].value[:3] == pytest.approx((0.9, 1.0, 0.8))
    default = Reading(stage_of(inside("mdl:", OMNI.replace("float inputs:glass_ior = 1.6", ""))))
    assert default[Param.IOR].value[0] == pytest.approx(1.491)  # OmniGlass's own


def test_thin_walled_omni_glass_is_thin() -> None:
    shader = OMNI.replace("token outputs:out", "bool inputs:thin_walled = 1\ntoken outputs:out")
    assert Reading(stage_of(inside("mdl:", shader))).material.model is Model.THIN


def test_a_pxr_surface_counts_where_it_refracts() -> None:
    found = Reading(stage_of(inside("ri:", PIXAR)))
    assert found.material.model is Model.TRACED
    assert found[Param.OPACITY].value[0] == pytest.approx(0.25)
    assert found[Param.IOR].value[0] == pytest.approx(1.8)
    opaque = Reading(stage_of(inside("ri:", PIXAR.replace("0.75", "0"))))
    assert opaque.material.model is Model.NONE
    assert "outputs:ri:surface leads to no surface shader this renderer reads" in opaque.texts


def test_a_surface_for_all_wins_over_one_renderers_own() -> None:
    preview = block('def Shader "U"', 'uniform token info:id = "UsdPreviewSurface"', "float inputs:roughness = 0.9",
                    "token outputs:surface")  # fmt: skip
    both_of = inside("mdl:", OMNI) + f"\ntoken outputs:surface.connect = </M/U.outputs:surface>\n{preview}"
    assert Reading(stage_of(both_of)).material.model is Model.NONE


# --- the table of what maps to what


@pytest.mark.parametrize(
    ("context", "shader", "ior", "abbe", "distance"),
    [
        ("arnold:", ARNOLD, 1.33, 40.0, 7.0),
        ("mtlx:", OPEN_PBR, 1.52, 40.0, 2.0),  # V_d = abbe number / scale
        ("mtlx:", GLTF, 1.45, 40.0, 3.0),  # dispersion = 20 / V_d
    ],
)
@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_numbers_come_over_in_stage_units(
    tmp_path: Path, context: str, shader: str, ior: float, abbe: float, distance: float, unit: float
) -> None:
    path, out = stage(tmp_path, context, shader, "Cone", unit=unit), tmp_path / "out.usda"
    row = run(path, out)["M"]
    assert (row.model, row.ior, row.abbe, row.distance) == ("traced", ior, abbe, distance)
    before, after = both(path, out)
    old, new = material(before, "M"), material(after, "M")
    assert new.absorption_distance == pytest.approx(distance * unit)
    assert new.absorption_distance == pytest.approx(old.absorption_distance)
    assert new.inputs[Param.TRANSMITTANCE].value == pytest.approx(old.inputs[Param.TRANSMITTANCE].value)
    assert new.abbe == pytest.approx(old.abbe)


def test_the_thickness_of_a_gltf_shader_is_kept(tmp_path: Path) -> None:
    assert run(stage(tmp_path, "mtlx:", GLTF), tmp_path / "out.usda")["M"].thickness == pytest.approx(0.8)


def test_a_thin_wall_on_a_closed_shape_stays_thin(tmp_path: Path) -> None:
    shader = OPEN_PBR.replace("token outputs:out", "bool inputs:geometry_thin_walled = 1\ntoken outputs:out")
    row = run(stage(tmp_path, "mtlx:", shader), tmp_path / "out.usda")["M"]
    assert (row.model, row.why) == ("thin", "thin-walled by its shader")


def test_thin_absorbs_as_much_as_before(tmp_path: Path) -> None:
    path, out = stage(tmp_path, "mtlx:", OPEN_PBR, "Plane", unit=0.01), tmp_path / "out.usda"
    assert run(path, out)["M"].model == "thin"
    old, new = (material(scene, "M") for scene in both(path, out))
    assert old.absorption_distance == new.absorption_distance == 0.005
    # Beer-Lambert over the thin model's 5 mm: 0.25 after 2 cm is 0.25^(1/4) after 5 mm.
    assert new.inputs[Param.TRANSMITTANCE].value[0] == pytest.approx(0.25**0.25, rel=1e-5)
    assert new.inputs[Param.TRANSMITTANCE].value == pytest.approx(old.inputs[Param.TRANSMITTANCE].value, rel=1e-5)


def test_a_tint_is_reached_through_the_whole_body(tmp_path: Path) -> None:
    path, out = stage(tmp_path, "mdl:", OMNI), tmp_path / "out.usda"
    row = run(path, out)["M"]
    assert row.model == "sphere"
    assert row.distance == pytest.approx(4.0 / 3.0, rel=1e-3)  # 4 V / S of a ball of 1, as where nothing is converted
    before, after = (material(scene, "M").absorption_distance for scene in both(path, out))
    assert after == pytest.approx(before, rel=1e-3)


def test_a_tint_of_any_other_body_is_reached_over_the_mean_way_through_it(tmp_path: Path) -> None:
    """4 V / S of a cone: a third of pi r^2 h over pi r (r + s). Drawn as it is and as it is converted."""
    path, out = stage(tmp_path, "mdl:", OMNI, "Cone"), tmp_path / "out.usda"
    row = run(path, out)["M"]
    assert row.model == "traced"
    assert row.distance == pytest.approx(4.0 / 3.0 * 2.0 / (1.0 + math.sqrt(5.0)), rel=0.02)
    before, after = (material(scene, "M").absorption_distance for scene in both(path, out))
    assert before == pytest.approx(after, rel=1e-4)


def test_a_mapped_colour_stays_mapped(tmp_path: Path) -> None:
    reader = block('def Shader "P"', 'uniform token info:id = "ND_geompropvalue_color3"',
                   'string inputs:geomprop = "tint"', "color3f outputs:out")  # fmt: skip
    shader = OPEN_PBR.replace("transmission_color = (0.25, 0.5, 1)", "transmission_color.connect = </M/P.outputs:out>")
    path, out = stage(tmp_path, "mtlx:", f"{shader}\n{reader}", "Cone"), tmp_path / "out.usda"
    assert run(path, out)["M"].color_from == "/M/P.outputs:out"
    before, after = both(path, out)
    assert material(after, "M").inputs[Param.TRANSMITTANCE].primvar == "tint"
    assert material(before, "M").inputs[Param.TRANSMITTANCE].primvar == "tint"


# --- --to

WRITTEN = {
    "preview": ("", "UsdPreviewSurface"),
    "openpbr": ("mtlx", "ND_open_pbr_surface_surfaceshader"),
    "gltf": ("mtlx", "ND_gltf_pbr_surfaceshader"),
}


@pytest.mark.parametrize("target", list(WRITTEN))
@pytest.mark.parametrize(("context", "shader"), [("arnold:", ARNOLD), ("mdl:", OMNI), ("ri:", PIXAR)])
@pytest.mark.parametrize("shape", ["Sphere", "Plane", "Cone"])
def test_a_surface_written_back_renders_the_same(
    tmp_path: Path, target: str, context: str, shader: str, shape: str
) -> None:
    path = stage(tmp_path, context, shader, shape)
    run(path, tmp_path / "plain.usda")
    run(path, tmp_path / "to.usda", to=target)
    assert surface_id(tmp_path / "to.usda", WRITTEN[target][0]) == WRITTEN[target][1]
    plain, to = (material(load_stage(tmp_path / name), "M") for name in ("plain.usda", "to.usda"))
    if plain.inputs[Param.OPACITY].value[0] == 0.0:  # no surface colour shows
        diffuse = to.inputs[Param.DIFFUSE]
        plain = replace(plain, inputs=(diffuse, *plain.inputs[1:]))
    assert to.inputs[Param.CLEARCOAT].value[0] == plain.inputs[Param.CLEARCOAT].value[0] == 0.0
    for param in set(Param) - {Param.CLEARCOAT_ROUGHNESS}:
        assert to.inputs[param].value[:3] == pytest.approx(plain.inputs[param].value[:3], abs=1e-5), param
    assert (to.model, to.abbe) == (plain.model, plain.abbe)


@pytest.mark.parametrize("target", ["openpbr", "gltf"])
@pytest.mark.parametrize("shape", ["Plane", "Cone"])
def test_a_surface_written_back_is_the_same_glass_without_the_schema(tmp_path: Path, target: str, shape: str) -> None:
    out = tmp_path / "to.usda"
    run(stage(tmp_path, "arnold:", ARNOLD, shape, unit=0.01), out, to=target, flatten=True)
    with_schema = material(load_stage(out), "M")
    text = out.read_text().replace('prepend apiSchemas = ["RefractMaterialAPI"]', "")
    (tmp_path / "bare.usda").write_text(text)
    bare = material(load_stage(tmp_path / "bare.usda"), "M")
    assert bare.model is with_schema.model
    assert bare.abbe == pytest.approx(with_schema.abbe)
    assert bare.absorption_distance == pytest.approx(with_schema.absorption_distance)
    for param in (Param.IOR, Param.TRANSMITTANCE, Param.OPACITY, Param.ROUGHNESS):
        assert bare.inputs[param].value == pytest.approx(with_schema.inputs[param].value, abs=1e-5)


def test_what_stands_on_the_output_is_not_replaced(tmp_path: Path) -> None:
    out = tmp_path / "out.usda"
    row = run(stage(tmp_path, "mtlx:", OPEN_PBR), out, to="gltf")["M"]
    assert any("already" in note for note in row.notes)
    assert surface_id(out, "mtlx") == WRITTEN["openpbr"][1]


def test_an_own_surface_is_filled_in_and_its_opinions_stay(tmp_path: Path) -> None:
    own = block('def Shader "S"', 'uniform token info:id = "UsdPreviewSurface"', "float inputs:ior = 1.9",
                "token outputs:out")  # fmt: skip
    path = stage(tmp_path, "", own)
    text = (
        Path(path)
        .read_text()
        .replace(
            'def Material "M"',
            'def Material "M" (prepend apiSchemas = ["RefractMaterialAPI"])',
        )
    )
    Path(path).write_text(text)
    row = run(path, tmp_path / "out.usda", to="preview")["M"]
    opened = Usd.Stage.Open(str(tmp_path / "out.usda"))
    made = UsdShade.Shader(opened.GetPrimAtPath("/M/S"))
    assert made.GetInput("ior").Get() == pytest.approx(1.9)
    assert made.GetInput("opacity").Get() == 0.0
    assert any("keeps its own ior" in note for note in row.notes)
