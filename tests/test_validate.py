"""`refract validate`: one sample per rule, what `--fix` may do, and USD's own way to our rules."""

from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdValidation
from scene_reading import CUBE, solid, stage_of
from typer.testing import CliRunner, Result

import schemas
from refract_core.cli import app
from refract_core.probes.digest import probe_digest
from refract_core.usd.rules import plugin as rules_plugin
from refract_core.usd.rules.findings import Finding
from refract_core.usd.rules.glass import sides
from refract_core.usd.rules.stage import RULES, stage_findings, stock_findings
from refract_core.usd.stage import load_stage, open_stage
from refract_core.verbs.validate import ValidateOrder, validate
from refract_core.version import __version__
from refract_core.world.solid import is_convex, signed_volume, winding

SAMPLES = Path(__file__).parents[1] / "usd_samples"
FOLDER = SAMPLES / "bad" / "validate"
BAD = {path.stem.replace("_", "-"): path for path in sorted(FOLDER.glob("*.usda"))}
ELSEWHERE = {
    "refract.ior-below-one": "ior_below_one",
    "refract.unknown-token": "unknown_model",
    "refract.not-finite": "ior_nan",
    "refract.out-of-range": "transmittance_above_one",
    "refract.reader": "nan_points",
}
FOLLOWS = {"refract.unreadable": {"refract.unknown-token"}}
"""Rules that cannot be broken alone."""
SAFE = [rule.id for rule in RULES.values() if rule.safe]


def file_of(rule: str) -> Path:
    return SAMPLES / "bad" / f"{ELSEWHERE[rule]}.usda" if rule in ELSEWHERE else BAD[rule.removeprefix("refract.")]


def findings(path: Path) -> list[Finding]:
    return stage_findings(open_stage(path))


def rules(found: list[Finding]) -> set[str]:
    return {finding.rule for finding in found}


def refract(*words: object) -> Result:
    result = CliRunner().invoke(app, ["validate", *map(str, words)])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


def digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


# --- the samples ----------------------------------------------------------------------------------------------------


def test_every_rule_has_a_sample_and_a_line() -> None:
    assert {f"refract.{name}" for name in BAD} | set(ELSEWHERE) == set(RULES)
    readme = (FOLDER / "README.md").read_text("utf-8")
    for name, path in BAD.items():
        (line,) = [line for line in readme.splitlines() if f"`{path.name}`" in line]
        assert f"`refract.{name}`" in line
        rule = RULES[f"refract.{name}"]
        assert f"| {rule.severity} |" in line
        assert line.endswith("| no |") is not rule.safe


@pytest.mark.parametrize("rule", RULES)
def test_a_sample_breaks_its_rule_and_no_other(rule: str) -> None:
    found = findings(file_of(rule))
    assert rules(found) - FOLLOWS.get(rule, set()) == {rule}
    (finding,) = [finding for finding in found if finding.rule == rule]
    assert finding.severity == RULES[rule].severity
    assert finding.path.startswith("/World/") or Path(finding.path).name == file_of(rule).name
    assert bool(finding.repairs) is (RULES[rule].safe and rule != "refract.unknown-token")
    assert finding.fix or rule in ("refract.reader", "refract.unreadable")


@pytest.mark.parametrize("rule", RULES)
def test_the_exit_code_is_1_exactly_where_errors_are_found(rule: str) -> None:
    result = refract(file_of(rule), "--json")
    said = json.loads(result.stdout)
    assert result.exit_code == int(any(finding["severity"] == "error" for finding in said["findings"]))
    assert rule in {finding["rule"] for finding in said["findings"]}


@pytest.mark.parametrize("path", sorted((SAMPLES / "good").glob("*.usda")), ids=lambda path: path.stem)
def test_good_samples_pass(path: Path) -> None:
    verdict = validate(ValidateOrder(stage=str(path)))
    assert {finding.rule for finding in verdict.findings} <= {"refract.probe-not-baked"}


@pytest.mark.parametrize("path", sorted((SAMPLES / "bad").glob("*.usda")), ids=lambda path: path.stem)
def test_every_bad_sample_is_found_out(path: Path) -> None:
    result = refract(path)
    if path.stem == "not_usd":
        assert (result.exit_code, result.stdout) == (1, "")
    else:
        assert re.search(r"^(error|warning) +refract\.", result.stdout, re.MULTILINE)


# --- --fix ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", [rule for rule in SAFE if rule != "refract.unknown-token"])
def test_fix_mends_in_a_layer_and_leaves_the_stage_alone(rule: str, tmp_path: Path) -> None:
    source, out = file_of(rule), tmp_path / "fixed.usda"
    before = digest(source)
    result = refract(source, "--fix", out, "--json")
    said = json.loads(result.stdout)
    assert digest(source) == before
    assert [finding["rule"] for finding in said["fixed"]] == [rule]
    assert rule not in rules(findings(out))
    assert result.exit_code == 0
    layer = Sdf.Layer.FindOrOpen(str(out))
    assert [Path(name).name for name in layer.subLayerPaths] == [source.name]


@pytest.mark.parametrize(
    "name", ["absorption_distance_negative", "ior_below_one", "ior_nan", "thickness_zero", "transmittance_above_one"]
)
def test_fix_writes_what_the_renderer_uses_anyway(name: str, tmp_path: Path) -> None:
    source, out = SAMPLES / "bad" / f"{name}.usda", tmp_path / "fixed.usda"
    assert validate(ValidateOrder(stage=str(source), fix=str(out))).fixed
    assert load_stage(out).materials == load_stage(source).materials


def test_fix_turns_what_the_renderer_turns_anyway(tmp_path: Path) -> None:
    source, out = BAD["inverted-normals"], tmp_path / "fixed.usda"
    assert validate(ValidateOrder(stage=str(source), fix=str(out))).fixed
    (before,), (after,) = load_stage(source).meshes, load_stage(out).meshes
    assert (before.inside_out, after.inside_out) == (True, False)
    np.testing.assert_array_equal(before.triangles, after.triangles)


def test_inside_out_glass_is_told_once_with_and_without_a_part_that_is_opaque() -> None:
    subset = f"""def GeomSubset "s" (prepend apiSchemas = ["MaterialBindingAPI"]) {{
        uniform token elementType = "face"
        uniform token familyName = "materialBind"
        int[] indices = [0, 1]
        {BOUND} }}"""
    for extra in (subset, BOUND):
        found = stage_findings(stage_of(CUBE(reverse=True, extra=extra) + GLASS.format(model="traced", thickness=2)))
        about = [finding for finding in found if "inwards" in finding.text]
        assert [(finding.rule, bool(finding.repairs)) for finding in about] == [("refract.inverted-normals", True)]


def test_fix_keeps_what_is_good_of_an_animated_value(tmp_path: Path) -> None:
    path = tmp_path / "animated.usda"
    text = (SAMPLES / "bad" / "ior_below_one.usda").read_text("utf-8")
    assert "float inputs:refraction:ior = 0.8" in text
    samples = "float inputs:refraction:ior.timeSamples = { 1: 1.4, 2: 0.5, 3: 1.6 }"
    path.write_text(text.replace("float inputs:refraction:ior = 0.8", samples))
    (finding,) = [finding for finding in findings(path) if finding.rule == "refract.ior-below-one"]
    assert "at time 2" in finding.text
    validate(ValidateOrder(stage=str(path), fix=str(tmp_path / "out.usda")))
    stage = open_stage(tmp_path / "out.usda")
    port = stage.GetAttributeAtPath("/World/Material.inputs:refraction:ior")
    assert [port.Get(time) for time in (1, 2, 3)] == pytest.approx([1.4, 1.0, 1.6])


def test_fix_mends_the_case_of_a_token_but_guesses_nothing(tmp_path: Path) -> None:
    text = (SAMPLES / "bad" / "unknown_model.usda").read_text("utf-8")
    for word, becomes in (("Box", "box"), ("banana", "banana")):
        path, out = tmp_path / f"{word}.usda", tmp_path / f"{word}_fixed.usda"
        path.write_text(text.replace('"banana"', f'"{word}"'))
        verdict = validate(ValidateOrder(stage=str(path), fix=str(out)))
        stage = open_stage(out)
        assert stage.GetAttributeAtPath("/World/Material.refraction:model").Get() == becomes
        assert ("refract.unknown-token" in {finding.rule for finding in verdict.findings}) is (word == "banana")


def test_fix_does_not_replace_what_is_there_unless_told(tmp_path: Path) -> None:
    source, out = file_of("refract.ior-below-one"), tmp_path / "out.usda"
    out.write_text("#usda 1.0\n")
    result = refract(source, "--fix", out)
    assert (result.exit_code, out.read_text()) == (2, "#usda 1.0\n")
    assert str(out) in result.stderr
    assert refract(source, "--fix", out, "--overwrite").exit_code == 0


def test_a_missing_stage_is_one_line(tmp_path: Path) -> None:
    result = refract(tmp_path / "nothing.usda")
    assert (result.exit_code, result.stdout, len(result.stderr.splitlines())) == (1, "", 1)


# --- words ----------------------------------------------------------------------------------------------------------


def test_json_has_the_shape_that_is_promised() -> None:
    said = json.loads(refract(file_of("refract.ior-below-one"), "--json").stdout)
    assert said["format"] == "refract.validate/1"
    assert set(said) == {"format", "stage", "engine", "fixed_in", "errors", "warnings", "infos", "fixed", "findings"}
    (finding,) = said["findings"]
    assert set(finding) == {"rule", "severity", "path", "text", "fix", "safe"}
    assert (finding["path"], finding["safe"], said["errors"]) == ("/World/Material", True, 1)


def test_a_command_in_a_fix_names_the_stage() -> None:
    path = file_of("refract.probe-not-baked")
    assert f"fix: run refract bake probes {path} OUT" in refract(path).stdout


# --- rules in detail ------------------------------------------------------------------------------------------------


GLASS = """
def Material "M" (
    prepend apiSchemas = ["RefractMaterialAPI"]
) {{
    uniform token refraction:model = "{model}"
    float inputs:refraction:thickness = {thickness} }}
"""
BOUND = "rel material:binding = </M>"


@pytest.mark.parametrize(("unit", "size"), [(1.0, 0.05), (0.01, 5.0), (0.001, 50.0)])
@pytest.mark.parametrize(
    ("factor", "rule"), [(2.0, ""), (0.25, ""), (7.0, "size"), (0.04, "size")], ids=["diameter", "less", "more", "tiny"]
)
def test_thickness_against_size_is_the_same_in_every_unit(unit: float, size: float, factor: float, rule: str) -> None:
    ball = f'def Sphere "B" {{ \n double radius = {size}\n {BOUND} }}'
    found = rules(stage_findings(stage_of(ball + GLASS.format(model="sphere", thickness=factor * size), unit=unit)))
    assert ("refract.thickness-against-size" in found) is (rule == "size")
    assert "refract.thickness-units" not in found


@pytest.mark.parametrize(
    ("unit", "radius", "thickness"), [(0.01, 5, 0.1), (1, 0.05, 10), (1, 0.05, 100), (0.001, 50, 0.1)]
)
def test_a_thickness_in_another_unit_is_told(unit: float, radius: float, thickness: float) -> None:
    """A ball of 10 cm, its diameter given in metres, centimetres or millimetres on a stage of another unit."""
    ball = f'def Sphere "B" {{ \n double radius = {radius}\n {BOUND} }}'
    found = stage_findings(stage_of(ball + GLASS.format(model="sphere", thickness=thickness), unit=unit))
    (finding,) = [finding for finding in found if finding.rule.startswith("refract.thickness")]
    assert finding.rule == "refract.thickness-units"
    assert float(finding.fix.rpartition(" ")[2]) * thickness == pytest.approx(2 * radius)


@pytest.mark.parametrize("handed", ["rightHanded", "leftHanded"])
@pytest.mark.parametrize("mirrored", [False, True])
def test_inverted_normals_know_orientation_and_mirrors(handed: str, mirrored: bool) -> None:
    extra = f'uniform token orientation = "{handed}"\n {BOUND}\n'
    if mirrored:
        extra += 'float3 xformOp:scale = (-1, 1, 1)\n uniform token[] xformOpOrder = ["xformOp:scale"]\n'
    found = rules(stage_findings(stage_of(CUBE(extra=extra) + GLASS.format(model="box", thickness=2))))
    assert ("refract.inverted-normals" in found) is (handed == "leftHanded")


def test_a_bubble_in_glass_may_face_inwards() -> None:
    small = 'float3 xformOp:scale = (0.5, 0.5, 0.5)\n uniform token[] xformOpOrder = ["xformOp:scale"]\n'
    bubble = CUBE(name="Bubble", reverse=True, extra=small + BOUND)
    text = CUBE(name="Outer", extra=BOUND) + bubble + GLASS.format(model="traced", thickness=2)
    assert "refract.inverted-normals" not in rules(stage_findings(stage_of(text)))
    alone = bubble + GLASS.format(model="traced", thickness=2)
    assert "refract.inverted-normals" in rules(stage_findings(stage_of(alone)))


@pytest.mark.parametrize("inside", [True, False], ids=["room", "block"])
def test_a_room_is_not_a_solid(inside: bool) -> None:
    """The probe stands in a closed box both times; the glass only in the room."""
    head = "fallbackPrimTypes = { token[] RefractProbe = [\"Xform\"] }"
    at = (0.2, 0, 0) if inside else (9, 0, 0)
    ball = f'def Sphere "B" {{ \n double radius = 0.2\n {BOUND}\n double3 xformOp:translate = {at}\n'
    ball += 'uniform token[] xformOpOrder = ["xformOp:translate"] }\n'
    probe = 'def RefractProbe "P" { \n uniform token probe:mode = "realtime"\n'
    probe += "float3 probe:influence:size = (50, 50, 50) }"
    text = CUBE() + ball + probe + GLASS.format(model="sphere", thickness=0.4)
    found = rules(stage_findings(stage_of(text, head=head.replace("{", "{\n").replace("}", "\n}"))))
    assert ("refract.capture-inside-object" in found) is not inside


def test_stock_validators_speak_too() -> None:
    stage = stage_of(CUBE(), unit=None)
    assert "usdGeomValidators:StageMetadataChecker.MissingMetersPerUnitMetadata" in rules(stock_findings(stage))
    assert not any(rule.startswith("refract") for rule in rules(stock_findings(stage)))


def test_checking_changes_nothing() -> None:
    stage = Usd.Stage.Open(str(file_of("refract.unknown-token")))
    before = [layer.ExportToString() for layer in (stage.GetRootLayer(), stage.GetSessionLayer())]
    stage_findings(stage)
    assert [layer.ExportToString() for layer in (stage.GetRootLayer(), stage.GetSessionLayer())] == before


# --- the measures ---------------------------------------------------------------------------------------------------


def cube() -> tuple[np.ndarray, np.ndarray]:
    points, faces = solid("cube")
    triangles = [(face[0], face[i], face[i + 1]) for face in faces for i in (1, 2)]
    return np.array(points, np.float64), np.array(triangles, np.int64)


def test_volume_and_winding_of_a_cube() -> None:
    points, triangles = cube()
    assert signed_volume(points, triangles) == pytest.approx(8.0)
    assert signed_volume(points + 1000.0, triangles[:, ::-1]) == pytest.approx(-8.0)
    for point, times in (((0.9, -0.9, 0.9), 1.0), ((1.1, 0, 0), 0.0), ((50, 50, 50), 0.0)):
        assert winding(np.array(point), points, triangles) == pytest.approx(times, abs=1e-9)
        assert winding(np.array(point), points, triangles[:, ::-1]) == pytest.approx(-times, abs=1e-9)


def test_a_cube_is_convex_and_a_dented_one_is_not() -> None:
    points, triangles = cube()
    assert is_convex(points, triangles)
    assert is_convex(points, triangles[:, ::-1])
    dented = points.copy()
    dented[0] *= 0.1
    assert not is_convex(dented, triangles)


def test_sides_do_not_depend_on_how_a_box_is_turned() -> None:
    points = cube()[0] * (1.0, 2.0, 4.0)
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    assert sides(points @ turn.T) == pytest.approx((2.0, 4.0, 8.0))


# --- baked textures -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("change", ["", "wall", "glass", "engine"])
def test_a_texture_is_stale_when_what_it_shows_has_changed(change: str, tmp_path: Path) -> None:
    """Glass is not in a probe's picture; walls are."""
    path = tmp_path / "baked.usda"
    text = (FOLDER / "probe_texture_stale.usda").read_text("utf-8")
    text = text.replace("../../good/textures/studio.exr", str(SAMPLES / "good" / "textures" / "studio.exr"))
    text = text.replace('def Sphere "Ball"', 'def Cube "Wall"\n    {\n    }\n\n    def Sphere "Ball"', 1)
    path.write_text(text)
    scene = load_stage(path)
    record = {"0000": probe_digest(scene, scene.probes[0]), "0.0.1": "0.0.0" if change == "engine" else __version__}
    for old, new in record.items():
        text = text.replace(f'"{old}"', f'"{new}"')
    if change == "wall":
        text = text.replace('def Cube "Wall"\n    {', 'def Cube "Wall"\n    {\n        double size = 3')
    if change == "glass":
        text = text.replace("double radius = 1", "double radius = 1.1")
    path.write_text(text)
    assert ("refract.probe-texture-stale" in rules(findings(path))) is (change in ("wall", "engine"))


# --- other programs -------------------------------------------------------------------------------------------------

HOST = """
import sys
from pxr import Usd, UsdValidation
stage = Usd.Stage.Open(sys.argv[1])
registry = UsdValidation.ValidationRegistry()
context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
for error in context.Validate(stage):
    print(error.GetIdentifier(), error.GetSites()[0].GetPrim().GetPath())
"""


def host(stage: Path, *, plugins: list[Path], python: Path | None) -> list[str]:
    """What a program prints that knows nothing of us but a path."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "PXR_"))}
    told = {"PXR_PLUGINPATH_NAME": os.pathsep.join(map(str, plugins))}
    if python is not None:
        told["PYTHONPATH"] = str(python)
    done = subprocess.run(
        [sys.executable, "-c", HOST, str(stage)], env=inherited | told, cwd=FOLDER, capture_output=True, text=True,
        check=True, timeout=120,
    )  # fmt: skip
    return done.stdout.splitlines()


@pytest.mark.skipif(not hasattr(UsdValidation.ValidationRegistry, "RegisterPluginPrimValidator"), reason="USD < 26.05")
@pytest.mark.parametrize("rule", ["refract.ior-below-one", "refract.inverted-normals"])
def test_other_programs_find_our_rules_by_the_plugin_path(rule: str) -> None:
    plugins = [schemas.FOLDER, schemas.FOLDER / "validators"]
    said = host(file_of(rule), plugins=plugins, python=schemas.FOLDER.parent)
    name, where = said[0].split()
    assert (name.rpartition(".")[2], len(said)) == (rule.removeprefix("refract."), 1)
    assert where.startswith("/World/")


def test_a_program_with_the_schemas_alone_keeps_its_own_validators() -> None:
    """Where our Python cannot be imported, a validator of ours in that path would take all others away."""
    said = host(file_of("refract.ior-below-one"), plugins=[schemas.FOLDER], python=None)
    assert said == []


def test_python_can_register_the_rules() -> None:
    rules_plugin.register()
    rules_plugin.register()
    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(
        registry.GetOrLoadValidatorsByName([rules_plugin.VALUES, rules_plugin.SCENE])
    )
    for rule in RULES:
        stage = open_stage(file_of(rule))
        told = {str(error.GetName()) for error in context.Validate(stage)}
        assert told == {found.removeprefix("refract.") for found in rules(stage_findings(stage))}
