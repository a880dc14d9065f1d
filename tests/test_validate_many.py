"""`refract validate` on many files: forms for machines, what fails, USD's own validators; misspelt names."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from scene_reading import stage_of
from typer.testing import CliRunner, Result

from refract_core.cli import app
from refract_core.usd.rules.findings import ERROR, WARNING, Finding
from refract_core.usd.rules.names import name_findings
from refract_core.usd.rules.stage import RULES, stage_findings
from refract_core.verbs import validate_many
from refract_core.verbs.validate import Verdict, to_text
from refract_core.verbs.validate_forms import to_junit, to_sarif, uri_of
from refract_core.verbs.validate_many import validate_each

SAMPLES = Path(__file__).parents[1] / "usd_samples"
ERRS = SAMPLES / "bad" / "validate" / "misspelt_name.usda"
WARNS = SAMPLES / "bad" / "validate" / "unknown_name.usda"
DAMAGED = SAMPLES / "bad" / "not_usd.usda"


def refract(*words: object) -> Result:
    result = CliRunner().invoke(app, ["validate", *map(str, words)])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


def good() -> Path:
    return next(path for path in sorted((SAMPLES / "good").glob("*.usda")) if not refract(path, "--strict").exit_code)


# --- names ----------------------------------------------------------------------------------------------------------

MATERIAL = 'def Material "M" (\n prepend apiSchemas = ["RefractMaterialAPI"]\n) {{ \n {body} }}'


def names(text: str) -> list[tuple[str, str, str]]:
    found = name_findings(stage_of(text))
    return [(finding.rule.removeprefix("refract."), finding.path, finding.text) for finding in found]


@pytest.mark.parametrize(
    ("authored", "meant"),
    [
        ("float refraction:ior = 1.3", "inputs:refraction:ior"),
        ("float inputs:refraction:thicknes = 2", "inputs:refraction:thickness"),
        ("float inputs:refraction:absorbtionDistance = 2", "inputs:refraction:absorptionDistance"),
        ("float inputs:refraction:IOR = 2", "inputs:refraction:ior"),
        ("color3f inputs:refraction:transmitanceColor = (1, 1, 1)", "inputs:refraction:transmittanceColor"),
        ('token inputs:refraction:model = "thin"', "refraction:model"),
        ('token probe:mod = "baked"', "probe:mode"),
        ("float3 probe:influnce:size = (1, 1, 1)", "probe:influence:size"),
        ("int refract:sample = 4", "refract:samples"),
        ("float[] primvars:refraction:thicknes = [1]", "primvars:refraction:thickness"),
    ],
)
def test_a_misspelt_name_is_an_error_that_says_what_was_meant(authored: str, meant: str) -> None:
    ((rule, path, text),) = names(MATERIAL.format(body=authored))
    assert (rule, path) == ("misspelt-name", "/M")
    assert f"did you mean {meant}?" in text
    assert RULES["refract.misspelt-name"].severity == ERROR


def test_names_of_every_prim_are_looked_at_also_of_shaders_and_in_instances() -> None:
    inside = 'def Shader "S" { \n float inputs:refraction:thicknes = 1 }'
    assert [(rule, path) for rule, path, _ in names(MATERIAL.format(body=inside))] == [("misspelt-name", "/M/S")]
    proto = 'class Xform "P" { \n def Xform "X" { \n float refraction:ior = 1 } }'
    placed = "".join(f'def Xform "I{n}" (\n instanceable = true\n inherits = </P>\n) {{ }}' for n in range(3))
    assert len(names(proto + placed)) == 1  # said once for all of them


def test_a_name_like_none_of_ours_is_a_warning_that_lists_them() -> None:
    ((rule, _, text),) = names(MATERIAL.format(body="float inputs:refraction:sparkle = 1"))
    assert rule == "unknown-name"
    assert "inputs:refraction:ior" in text
    assert RULES["refract.unknown-name"].severity == WARNING


@pytest.mark.parametrize(
    "text",
    [
        'def Material "M" { \n float inputs:refraction:ior = 1.3 }',  # without the schema nobody asks for it
        'def Shader "S" { \n float inputs:refraction:ior = 1.3 }',
        'def Xform "X" { \n token probe:mode = "baked" }',
    ],
)
def test_a_right_name_where_nobody_reads_it_is_told(text: str) -> None:
    assert [rule for rule, _, _ in names(text)] == ["misplaced-name"]


def test_right_names_in_their_places_and_everybody_else_s_are_left_alone() -> None:
    body = "float inputs:refraction:ior = 1.3\n float inputs:thicknes = 1\n float userProperties:refraction = 1"
    probe = 'def RefractProbe "P" { \n token probe:mode = "realtime"\n rel probe:proxy:prim = </M> }'
    settings = 'def RenderSettings "R" { \n int refract:samples = 4 }'  # which are read with or without the schema
    mesh = 'def Sphere "B" { \n float primvars:refraction:thickness = 1\n float primvars:refraction:tint = 1 }'
    assert names(MATERIAL.format(body=body) + probe + settings + mesh) == []


@pytest.mark.parametrize(
    "name", ["refraction:ior", "inputs:refraction:thicknes", "inputs:refraction:absorbtionDistance"]
)
def test_what_passed_once_as_0_errors_does_not(name: str) -> None:
    found = stage_findings(stage_of(MATERIAL.format(body=f"float {name} = 2")))
    assert any(finding.severity == ERROR for finding in found)


# --- many files -----------------------------------------------------------------------------------------------------


def test_a_folder_means_every_stage_below_it(tmp_path: Path) -> None:
    for place in ("b.usda", "a/c.usda", "a/d/e.USDA"):
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).write_text('#usda 1.0\n(\n metersPerUnit = 1\n upAxis = "Y"\n)\n')
    (tmp_path / "notes.txt").write_text("no stage")
    said = json.loads(refract(tmp_path, "--json").stdout)
    assert [os.path.relpath(one["stage"], tmp_path) for one in said["stages"]] == ["a/c.usda", "a/d/e.USDA", "b.usda"]
    assert said["format"] == "refract.validate-many/1"


def test_a_damaged_file_is_an_error_and_the_others_are_checked() -> None:
    result = refract(DAMAGED, WARNS, SAMPLES / "no_such.usda", ERRS, "--json")
    said = json.loads(result.stdout)
    errors = [[one["rule"] for one in stage["findings"] if one["severity"] == "error"] for stage in said["stages"]]
    assert errors == [["refract.unreadable"], [], ["refract.unreadable"], ["refract.misspelt-name"]]
    assert (result.exit_code, said["errors"]) == (1, 3)


def test_a_file_that_ends_its_process_is_an_error_and_the_others_are_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    """As damaged crate files do to USD."""
    monkeypatch.setattr(validate_many, "_verdict", _dies_over)
    first, second, third = validate_each(["a.usda", "deadly.usda", "b.usda"])
    assert (first, third) == (Verdict("a.usda", ()), Verdict("b.usda", ()))
    ((rule, text),) = [(finding.rule, finding.text) for finding in second.findings]
    assert rule == "refract.unreadable"
    assert "ended its process" in text


def _dies_over(stage: str, _opening: object) -> Verdict:
    if stage.startswith("deadly"):
        os.abort()
    return Verdict(stage, ())


def test_text_of_many_ends_with_a_summary() -> None:
    lines = refract(good(), DAMAGED).stdout.splitlines()
    assert lines[0] == f"{good()}: nothing to complain about"
    assert lines[-1].startswith("2 stages, 1 of them with errors: 1 error, ")


@pytest.mark.parametrize(
    "words",
    [
        [ERRS, WARNS, "--fix", "out.usda"], [ERRS, "--format", "yaml"], [ERRS, "--json", "--format", "sarif"], []
    ],
    ids=["fix", "format", "both", "none"],
)  # fmt: skip
def test_wrong_usage_is_2(words: list[object], tmp_path: Path) -> None:
    assert refract(*words).exit_code == 2
    assert refract(tmp_path).exit_code == 2  # a folder with no stage in it


@pytest.mark.parametrize(("stage", "strict", "code"), [(WARNS, False, 0), (WARNS, True, 1), (ERRS, False, 1)])
@pytest.mark.parametrize("form", ["text", "json", "junit", "sarif"])
def test_strict_lets_warnings_fail_in_every_form(stage: Path, strict: bool, code: int, form: str) -> None:
    assert refract(stage, "--format", form, *(["--strict"] if strict else [])).exit_code == code


# --- forms ----------------------------------------------------------------------------------------------------------


def test_an_asset_without_a_camera_is_not_at_fault(tmp_path: Path) -> None:
    """It stands in other stages, which have theirs. What is wrong with it is told as ever."""
    asset = tmp_path / "asset.usda"
    asset.write_text(
        """#usda 1.0
        (
            defaultPrim = "A"
            metersPerUnit = 1
            upAxis = "Y"
        )
        def Xform "A" (kind = "component")
        {
            def Sphere "S"
            {
                float3[] extent = [(-1, -1, -1), (1, 1, 1)]
            }
        }
        """
    )
    assert refract(asset, "--strict").exit_code == 0
    asset.write_text(asset.read_text().replace("float3[]", "float refraction:ior = 2\nfloat3[]"))
    assert refract(asset, "--strict").exit_code == 1


def test_json_by_either_name_is_the_same() -> None:
    assert refract(ERRS, "--json").stdout == refract(ERRS, "--format", "json").stdout


def sarif(*words: object) -> dict[str, Any]:
    return json.loads(refract(*words, "--format", "sarif").stdout)


def test_sarif_keeps_the_rules_of_its_standard() -> None:
    """SARIF 2.1.0: 3.13 (log), 3.14 (run), 3.19 (driver), 3.27 (result), 3.28 (location), 3.49 (rule)."""
    log = sarif(ERRS, WARNS, DAMAGED, SAMPLES / "bad" / "validate" / "probe_texture_missing.usda")
    assert log["version"] == "2.1.0"
    assert log["$schema"].endswith("sarif-schema-2.1.0.json")
    (run,) = log["runs"]
    driver = run["tool"]["driver"]
    assert driver["name"]
    rules = [rule["id"] for rule in driver["rules"]]
    assert len(set(rules)) == len(rules)
    assert all(rule["shortDescription"]["text"] for rule in driver["rules"])
    levels = {"none", "note", "warning", "error"}
    assert {rule["defaultConfiguration"]["level"] for rule in driver["rules"]} <= levels
    assert run["results"]
    for result in run["results"]:
        assert rules[result["ruleIndex"]] == result["ruleId"]
        assert result["level"] in levels
        assert result["message"]["text"]
        (location,) = result["locations"]
        uri = location["physicalLocation"]["artifactLocation"]["uri"]
        assert re.fullmatch(r"[A-Za-z0-9\-._~:/?#\[\]@!$&'()*+,;=%]+", uri)  # RFC 3986
    assert set(log) <= {"$schema", "version", "runs", "inlineExternalProperties", "properties"}


def test_sarif_says_which_file_and_which_prim() -> None:
    (result,) = [one for one in sarif(ERRS)["runs"][0]["results"] if one["ruleId"] == "refract.misspelt-name"]
    (location,) = result["locations"]
    assert location["physicalLocation"]["artifactLocation"]["uri"] == ERRS.as_uri()
    assert [one["fullyQualifiedName"] for one in location["logicalLocations"]] == ["/World/Material"]


@pytest.mark.parametrize(
    ("stage", "uri"),
    [
        ("a b.usda", "a%20b.usda"),
        ("sub/ü.usda", "sub/%C3%BC.usda"),
        ("/tmp/a b.usda", "file:///tmp/a%20b.usda"),
        ("a.usdz[b.usda]", "a.usdz"),
        ("50%.usda", "50%25.usda"),
    ],
)
def test_files_are_uris(stage: str, uri: str) -> None:
    assert uri_of(stage) == uri


def test_junit_has_a_suite_a_stage_and_counts_that_add_up() -> None:
    root = ElementTree.fromstring(refract(good(), ERRS, DAMAGED, "--format", "junit").stdout)
    assert root.tag == "testsuites"
    suites = list(root)
    assert [suite.get("name") for suite in suites] == [str(good()), str(ERRS), str(DAMAGED)]
    for suite in suites:
        cases = suite.findall("testcase")
        assert suite.get("tests") == str(len(cases))
        assert suite.get("failures") == str(sum(case.find("failure") is not None for case in cases))
        assert all(case.get("name") and case.get("classname") for case in cases)
        assert len({case.get("name") for case in cases}) == len(cases)
    assert [suite.get("failures") for suite in suites] == ["0", "1", "1"]
    assert root.get("failures") == "2"
    assert root.get("tests") == str(sum(len(suite) for suite in suites))


def test_junit_tells_warnings_without_failing_unless_it_is_strict() -> None:
    verdict = Verdict("a.usda", (Finding("refract.x", WARNING, "/A", "is odd", ""),))
    for strict, failures in ((False, "0"), (True, "1")):
        (suite,) = ElementTree.fromstring(to_junit([verdict], strict=strict))
        (case,) = [one for one in suite.findall("testcase") if one.get("name") == "refract.x"]
        assert suite.get("failures") == failures
        assert "is odd" in "".join(case.itertext())


def test_what_xml_cannot_hold_does_not_break_it() -> None:
    text = 'a\x00b\x1b[31m<&>"\ud800'
    verdict = Verdict("a.usda", (Finding("refract.x", ERROR, "/A", text, ""),))
    root = ElementTree.fromstring(to_junit([verdict]).encode("utf-8"))
    assert "<&>" in "".join(root.itertext())
    assert json.loads(to_sarif([verdict]))["runs"][0]["results"]


# --- text -----------------------------------------------------------------------------------------------------------


def test_our_verdict_comes_first_and_each_of_usd_s_validators_takes_one_line() -> None:
    stock = [Finding("usdX:A.B", WARNING, f"/P{n}", f"text {n}", "") for n in range(500)]
    more = [Finding("usdX:A.C", ERROR, "/Q", "other", "")]
    mine = [Finding("refract.misspelt-name", ERROR, "/M", "wrong", "rename it")]
    lines = to_text(Verdict("s.usda", tuple([*more, *mine, *stock]))).splitlines()
    assert lines[0] == "s.usda: 1 error, 0 warnings, 0 infos"
    assert lines[1].split() == ["error", "refract.misspelt-name", "/M"]
    head = lines.index("USD's own validators: 1 error, 500 warnings, 0 infos")
    theirs = lines[head + 1 :]
    assert theirs == ["error    usdX:A.C  /Q: other", "warning  usdX:A.B  500 times, /P0, /P1, /P2, ...: text 0"]
    assert not any("usdX" in line for line in lines[:head])


def test_what_a_validator_lists_at_length_is_cut_between_words() -> None:
    text = "duplicate " + " ".join(f"</Mesh/index_{n}>" for n in range(5000))
    (line,) = to_text(Verdict("s.usda", (Finding("usdX:A.B", ERROR, "/P", text, ""),))).splitlines()[2:]
    assert len(line) < 400
    assert line.endswith("> ...")
