"""What each attribute of the schemas promises, and every way by which USD may come to know them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from pxr import Sdf, Usd, UsdGeom, UsdRender, UsdShade

import schemas
from refract_core.errors import UsageError
from refract_core.models import DEFAULT, explained
from refract_core.settings import MODELS, TIERS, RenderSettings
from schemas import FOLDER
from schemas.generate import generate

ROOT = Path(__file__).parents[1]


class Attribute(NamedTuple):
    """One row of the design's table, written down here a second time on purpose."""

    schema: str
    name: str
    type_name: str
    fallback: Any
    tokens: tuple[str, ...] = ()
    minimum: Any = None
    maximum: Any = None
    uniform: bool = False


MATERIAL, PROBE, SETTINGS = "RefractMaterialAPI", "RefractProbeAPI", "RefractSettingsAPI"
ZEROS, ONES = (0.0,) * 6, (1.0,) * 6
TABLE = (
    Attribute(MATERIAL, "refraction:model", "token", DEFAULT.token, MODELS, uniform=True),
    Attribute(MATERIAL, "inputs:refraction:ior", "float", 1.5, minimum=1.0),
    Attribute(MATERIAL, "inputs:refraction:thickness", "float", 1.0, minimum=0.0),
    Attribute(MATERIAL, "inputs:refraction:thicknessMultiplier", "float", 1.0, minimum=0.0),
    Attribute(
        MATERIAL, "inputs:refraction:transmittanceColor", "color3f", (1, 1, 1), minimum=(0, 0, 0), maximum=(1, 1, 1)
    ),
    Attribute(MATERIAL, "inputs:refraction:absorptionDistance", "float", 1.0, minimum=0.0),
    Attribute(MATERIAL, "inputs:refraction:abbeNumber", "float", 0.0, minimum=0.0),
    Attribute(MATERIAL, "refraction:priority", "int", 0, uniform=True),
    Attribute(PROBE, "probe:mode", "token", "baked", ("baked", "realtime", "custom"), uniform=True),
    Attribute(PROBE, "probe:texture", "asset", None),
    Attribute(PROBE, "probe:resolution", "int", 128, minimum=8, maximum=4096, uniform=True),
    Attribute(PROBE, "probe:clippingRange", "float2", pytest.approx((0.1, 1000)), minimum=(0, 0)),
    Attribute(PROBE, "probe:captureOffset", "float3", (0, 0, 0)),
    Attribute(PROBE, "probe:clear", "token", "sky", ("sky", "color"), uniform=True),
    Attribute(PROBE, "probe:backgroundColor", "color3f", (0, 0, 0), minimum=(0, 0, 0)),
    Attribute(PROBE, "probe:shape", "token", "box", ("box", "sphere"), uniform=True),
    Attribute(PROBE, "probe:influence:size", "float3", (10, 10, 10), minimum=(0, 0, 0)),
    Attribute(PROBE, "probe:influence:radius", "float", 3.0, minimum=0.0),
    Attribute(PROBE, "probe:influence:blendDistance", "float[]", ZEROS),
    Attribute(PROBE, "probe:influence:blendNormalDistance", "float[]", ZEROS),
    Attribute(PROBE, "probe:influence:faceFade", "float[]", ONES),
    Attribute(PROBE, "probe:proxy", "token", "influence", ("influence", "volume", "infinite", "depth"), uniform=True),
    Attribute(PROBE, "probe:proxy:size", "float3", (10, 10, 10), minimum=(0, 0, 0)),
    Attribute(PROBE, "probe:proxy:radius", "float", 3.0, minimum=0.0),
    Attribute(PROBE, "probe:importance", "int", 1, minimum=0, maximum=32767),
    Attribute(PROBE, "probe:weight", "float", 1.0, minimum=0.0, maximum=1.0),
    Attribute(PROBE, "probe:multiplier", "float", 1.0, minimum=0.0),
    Attribute(PROBE, "probe:captureRefraction", "bool", False, uniform=True),
    Attribute(PROBE, "probe:distanceBasedRoughness", "bool", False, uniform=True),
    Attribute(PROBE, "probe:fadeDistance", "float", 10000.0, minimum=0.0),
    Attribute(PROBE, "collection:captured:includeRoot", "bool", True, uniform=True),
    Attribute(SETTINGS, "refract:samples", "int", 16, minimum=1, maximum=4096, uniform=True),
    Attribute(SETTINGS, "refract:tiers", "token[]", ("screen", "probe", "ray", "sky"), TIERS, uniform=True),
    Attribute(SETTINGS, "refract:maxLayers", "int", 16, minimum=1, maximum=32, uniform=True),
)
IDS = [row.name for row in TABLE]
HOST = {MATERIAL: "Material", PROBE: "Xform", SETTINGS: "RenderSettings"}


@pytest.fixture
def stage() -> Usd.Stage:
    return Usd.Stage.CreateInMemory()


def attribute_of(stage: Usd.Stage, row: Attribute) -> Usd.Attribute:
    prim = stage.DefinePrim("/Prim", HOST[row.schema])
    assert not prim.GetAttribute(row.name)
    prim.ApplyAPI(row.schema)
    return prim.GetAttribute(row.name)


@pytest.mark.parametrize("row", TABLE, ids=IDS)
def test_attribute_has_the_type_and_fallback_of_the_design(stage: Usd.Stage, row: Attribute) -> None:
    attribute = attribute_of(stage, row)
    value = attribute.Get()
    assert str(attribute.GetTypeName()) == row.type_name
    assert (tuple(value) if isinstance(row.fallback, tuple) else value) == row.fallback
    assert (attribute.GetVariability() == Sdf.VariabilityUniform) is row.uniform
    assert not attribute.IsCustom()


@pytest.mark.parametrize("row", TABLE, ids=IDS)
def test_attribute_lists_its_tokens_and_limits(stage: Usd.Stage, row: Attribute) -> None:
    attribute = attribute_of(stage, row)
    limits = attribute.GetHardLimits()
    assert tuple(attribute.GetMetadata("allowedTokens") or ()) == row.tokens
    assert limits.GetMinimum() == row.minimum
    assert limits.GetMaximum() == row.maximum


@pytest.mark.parametrize("row", TABLE, ids=IDS)
def test_attribute_is_documented_with_meaning_range_and_unit(stage: Usd.Stage, row: Attribute) -> None:
    definition = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(row.schema)
    attribute = attribute_of(stage, row)
    text = attribute.GetDocumentation()
    assert definition.GetPropertyDocumentation(row.name) == text
    meaning = text.split("\n\n")[0]
    assert len(meaning) > 10
    assert "Range: " in text
    assert "Unit: " in text
    assert all(token in text for token in row.tokens)
    assert attribute.GetDisplayGroup()
    assert attribute.GetDisplayName()


@pytest.mark.parametrize("schema", schemas.APPLIED)
def test_the_table_above_lists_every_property(schema: str) -> None:
    definition = Usd.SchemaRegistry().FindAppliedAPIPrimDefinition(schema)
    collection = {name for name in definition.GetPropertyNames() if name.startswith("collection:")}
    listed = {row.name for row in TABLE if row.schema == schema}
    assert set(definition.GetPropertyNames()) - collection - {"probe:proxy:prim"} == listed - collection
    assert definition.GetDocumentation()


def test_the_schema_explains_every_model_as_the_engine_does(stage: Usd.Stage) -> None:
    text = attribute_of(stage, TABLE[0]).GetDocumentation()
    assert f"Range: {explained()}." in " ".join(text.split())


@pytest.mark.parametrize("name", schemas.TYPED)
def test_typed_probes_are_placed_and_carry_the_probe_attributes(stage: Usd.Stage, name: str) -> None:
    prim = stage.DefinePrim("/Probe", name)
    assert prim.HasAPI(PROBE)
    assert prim.IsA(UsdGeom.Xformable)
    assert prim.GetAttribute("probe:resolution").Get() == 128
    assert Usd.SchemaRegistry().FindConcretePrimDefinition(name).GetDocumentation()
    stage.WriteFallbackPrimTypes()
    assert list(stage.GetRootLayer().pseudoRoot.GetInfo("fallbackPrimTypes")[name]) == ["Xform"]


@pytest.mark.parametrize(("name", "importance"), [("RefractProbe", 1), ("RefractPlanarProbe", 64)])
def test_planar_probes_come_first_as_in_hdrp(stage: Usd.Stage, name: str, importance: int) -> None:
    attribute = stage.DefinePrim("/Probe", name).GetAttribute("probe:importance")
    definition = Usd.SchemaRegistry().FindConcretePrimDefinition(name)
    assert attribute.Get() == definition.GetAttributeFallbackValue("probe:importance") == importance
    assert (attribute.GetHardLimits().GetMinimum(), attribute.GetHardLimits().GetMaximum()) == (0, 32767)
    assert "Range: 0 to 32767. Unit: none." in attribute.GetDocumentation()
    assert attribute.GetDisplayGroup() == "Blending"


def test_planar_probes_differ_from_the_others_in_their_mode_and_importance(stage: Usd.Stage) -> None:
    plain, planar = (Usd.SchemaRegistry().FindConcretePrimDefinition(name) for name in schemas.TYPED)
    assert plain.GetPropertyNames() == planar.GetPropertyNames()
    assert plain.GetAppliedAPISchemas() == planar.GetAppliedAPISchemas()
    own = [name for name in plain.GetPropertyNames() if name.startswith("probe:") and name != "probe:proxy:prim"]
    differing = [n for n in own if plain.GetAttributeFallbackValue(n) != planar.GetAttributeFallbackValue(n)]
    assert sorted(differing) == ["probe:importance", "probe:mode"]


def test_a_probe_sees_everything_unless_its_collection_says_otherwise(stage: Usd.Stage) -> None:
    probe = stage.DefinePrim("/Probe", "RefractProbe")
    stage.DefinePrim("/Room/Lamp")
    captured = Usd.CollectionAPI(probe, "captured")
    assert captured.ComputeMembershipQuery().IsPathIncluded("/Room/Lamp")
    captured.ExcludePath("/Room/Lamp")
    assert not captured.ComputeMembershipQuery().IsPathIncluded("/Room/Lamp")
    assert captured.ComputeMembershipQuery().IsPathIncluded("/Room")


@pytest.mark.parametrize(
    ("schema", "host", "allowed"),
    [
        (MATERIAL, "Material", True),
        (MATERIAL, "Xform", False),
        (MATERIAL, "Shader", False),
        (PROBE, "Xform", True),
        (PROBE, "Mesh", True),
        (PROBE, "Material", False),
        (PROBE, "RenderSettings", False),
        (SETTINGS, "RenderSettings", True),
        (SETTINGS, "Xform", False),
    ],
)
def test_schemas_apply_only_where_they_mean_something(stage: Usd.Stage, schema: str, host: str, allowed: bool) -> None:
    assert bool(stage.DefinePrim("/Prim", host).CanApplyAPI(schema)) is allowed


@pytest.mark.parametrize("name", ["thickness", "transmittanceColor"])
def test_a_texture_inside_the_material_can_drive(stage: Usd.Stage, name: str) -> None:
    material = UsdShade.Material.Define(stage, "/Material")
    material.GetPrim().ApplyAPI(MATERIAL)
    inner = UsdShade.Shader.Define(stage, "/Material/Map")
    outer = UsdShade.Shader.Define(stage, "/Map")
    for shader in (inner, outer):
        shader.CreateIdAttr("UsdUVTexture")
        shader.CreateOutput("r", Sdf.ValueTypeNames.Float)
    driven = material.GetInput(f"refraction:{name}")
    assert not UsdShade.ConnectableAPI.CanConnect(driven, outer.GetOutput("r"))
    assert driven.ConnectToSource(inner.GetOutput("r"))
    assert [str(source.GetPath()) for source in driven.GetValueProducingAttributes()] == ["/Material/Map.outputs:r"]


def test_settings_have_the_fallbacks_and_limits_of_the_command_line(stage: Usd.Stage) -> None:
    prim = UsdRender.Settings.Define(stage, "/Render").GetPrim()
    prim.ApplyAPI(SETTINGS)
    defaults = RenderSettings()
    assert prim.GetAttribute("refract:samples").Get() == defaults.samples
    assert tuple(prim.GetAttribute("refract:tiers").Get()) == defaults.tiers
    assert prim.GetAttribute("refract:maxLayers").Get() == defaults.max_layers
    for name, attribute in (("samples", "refract:samples"), ("max_layers", "refract:maxLayers")):
        limits = prim.GetAttribute(attribute).GetHardLimits()
        for inside, step in ((limits.GetMinimum(), -1), (limits.GetMaximum(), 1)):
            RenderSettings(**{name: inside})
            with pytest.raises(UsageError, match=name):
                RenderSettings(**{name: inside + step})


def test_generated_files_are_current(tmp_path: Path) -> None:
    pytest.importorskip("jinja2")
    generate(tmp_path)
    assert json.loads((tmp_path / "plugInfo.json").read_text()) == json.loads((FOLDER / "plugInfo.json").read_text())
    made, committed = (own_properties(folder / "generatedSchema.usda") for folder in (tmp_path, FOLDER))
    assert made == committed


def own_properties(path: Path) -> str:
    """The registry without what it inherits from USD's schemas, whose wording depends on USD's version."""
    layer = Sdf.Layer.OpenAsAnonymous(str(path))
    source = Sdf.Layer.OpenAsAnonymous(str(FOLDER / "schema.usda"))
    for prim in layer.rootPrims:
        for spec in list(prim.properties):
            if source.GetObjectAtPath(spec.path) is None:
                prim.RemoveProperty(spec)
    return str(layer.ExportToString())


def test_plug_info_is_resolved_and_its_types_differ_from_their_identifiers() -> None:
    plugin = json.loads((FOLDER / "plugInfo.json").read_text())["Plugins"][0]
    assert (plugin["Root"], plugin["ResourcePath"], plugin["LibraryPath"]) == (".", ".", "")
    types = plugin["Info"]["Types"]
    assert {row["schemaIdentifier"] for row in types.values()} == {*schemas.APPLIED, *schemas.TYPED}
    assert all(name != row["schemaIdentifier"] for name, row in types.items())


# ---- ways to be found, each in a process of its own

USE = """
from pxr import Usd
stage = Usd.Stage.CreateInMemory()
prim = stage.DefinePrim("/M", "Material")
prim.ApplyAPI("RefractMaterialAPI")
print(prim.GetAttribute("inputs:refraction:ior").Get())
"""


def run(code: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run `code` in a fresh process, in `folder`, where nothing of ours is on the path but what `environment` says."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "PXR_"))}
    command = [sys.executable, "-W", "error", "-c", code]
    return subprocess.run(
        command, cwd=folder, env=inherited | environment, capture_output=True, text=True, check=False, timeout=120
    )


def test_found_through_plugin_path_without_our_python(tmp_path: Path) -> None:
    done = run(USE + "import sys; assert 'schemas' not in sys.modules", tmp_path, PXR_PLUGINPATH_NAME=str(FOLDER))
    assert (done.stdout, done.stderr) == ("1.5\n", "")


def test_unknown_without_any_of_the_ways(tmp_path: Path) -> None:
    assert "Cannot find a valid schema" in run(USE, tmp_path).stderr


LOOK = """
from pxr import Sdf, Usd, UsdGeom
stage = Usd.Stage.Open("probes.usda")
assert Usd.SchemaRegistry().FindAppliedAPIPrimDefinition("RefractProbeAPI") is None
for prim in stage.GetPseudoRoot().GetChildren():
    known = prim.GetPrimTypeInfo().GetSchemaTypeName()
    child = UsdGeom.Imageable(prim.GetChild("Ball")).ComputeLocalToWorldTransform(0).ExtractTranslation()
    weight = prim.GetAttribute("probe:weight").Get()
    print(prim.GetTypeName(), known, prim.IsA(UsdGeom.Xformable), child[0], weight)
"""


@pytest.mark.parametrize(("fallback", "known"), [(True, "Xform True"), (False, " False")])
def test_stages_with_probes_open_where_the_schemas_are_unknown(tmp_path: Path, fallback: bool, known: str) -> None:
    """The probes are Xforms there by `fallbackPrimTypes`, prims without a type where it is missing."""
    stage = Usd.Stage.CreateNew(str(tmp_path / "probes.usda"))
    for name in schemas.TYPED:
        prim = stage.DefinePrim(f"/{name}", name)
        prim.GetAttribute("probe:weight").Set(0.5)
        UsdGeom.Xformable(prim).AddTranslateOp().Set((3, 0, 0))
        UsdGeom.Sphere.Define(stage, f"/{name}/Ball")
    if fallback:
        stage.WriteFallbackPrimTypes()
    stage.Save()
    done = run(LOOK, tmp_path)
    assert done.stderr == ""
    moved = "3.0" if fallback else "0.0"
    assert done.stdout.splitlines() == [f"{name} {known} {moved} 0.5" for name in schemas.TYPED]


def test_registering_after_a_stage_was_opened_says_what_to_do(tmp_path: Path) -> None:
    late = "from pxr import Usd\nUsd.Stage.CreateInMemory().DefinePrim('/A', 'Xform')\n"
    done = run(late + "import schemas; schemas.register()", tmp_path, PYTHONPATH=str(ROOT))
    assert done.returncode == 1
    assert "before schemas.register() was called" in done.stderr
    assert f"PXR_PLUGINPATH_NAME={FOLDER}" in done.stderr


@pytest.mark.parametrize("variable", ["", "PXR_PLUGINPATH_NAME"])
def test_registering_twice_and_after_importing_usd_is_fine(tmp_path: Path, variable: str) -> None:
    code = "from pxr import Usd\nimport schemas; schemas.register(); schemas.register()" + USE
    done = run(code, tmp_path, PYTHONPATH=str(ROOT), **({variable: str(FOLDER)} if variable else {}))
    assert (done.stdout, done.stderr) == ("1.5\n", "")


def test_importing_the_package_loads_no_usd(tmp_path: Path) -> None:
    done = run("import schemas, sys; assert 'pxr' not in sys.modules", tmp_path, PYTHONPATH=str(ROOT))
    assert (done.returncode, done.stderr) == (0, "")
