"""What `refract validate` found, in the forms that machines take: JSON of many stages, JUnit's XML, SARIF 2.1.0.

JUnit: a suite a stage, and a case for each rule of ours and for each of USD's validators that found something. SARIF:
one run, a result for each finding; its location is the stage's file, and the prim as a logical location.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote
from xml.etree import ElementTree

from ..usd.layers.assets import outer_of
from ..usd.rules.findings import ERROR, WARNING, Finding
from ..usd.rules.stage import RULES
from ..version import __version__
from .validate import SEVERITIES, Verdict, counts_of, fix_of, record_of

FORMATS = ("text", "json", "junit", "sarif")
MANY = "refract.validate-many/1"
SARIF = "2.1.0"
_SCHEMA = "https://docs.oasis-open.org/sarif/sarif/v2.1.0/errata01/os/schemas/sarif-schema-2.1.0.json"
_LEVELS = {"error": "error", "warning": "warning", "info": "note"}
# What XML 1.0 cannot hold, not even escaped.
_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def fails(finding: Finding, *, strict: bool) -> bool:
    """Whether a finding makes the exit code 1."""
    return finding.severity == ERROR or (strict and finding.severity == WARNING)


def to_json_of_many(verdicts: Sequence[Verdict]) -> str:
    """`{"format", "engine", "errors", "warnings", "infos", "stages": [...]}`, each stage as `refract.validate/1`."""
    totals = {f"{name}s": sum(counts_of(one.findings)[name] for one in verdicts) for name in SEVERITIES}
    record = {"format": MANY, "engine": __version__, **totals, "stages": [record_of(one) for one in verdicts]}
    return json.dumps(record, indent=2)


# --- JUnit ----------------------------------------------------------------------------------------------------------


def to_junit(verdicts: Sequence[Verdict], *, strict: bool = False) -> str:
    """XML as CI systems read it. A finding that does not fail is told in the output of its case."""
    root = ElementTree.Element("testsuites", name="refract validate")
    suites = [_suite(root, verdict, strict) for verdict in verdicts]
    for key in ("tests", "failures", "errors"):
        root.set(key, str(sum(int(suite.get(key, "0")) for suite in suites)))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True)


def _suite(root: ElementTree.Element, verdict: Verdict, strict: bool) -> ElementTree.Element:
    stage = _xml(_subject(verdict))
    suite = ElementTree.SubElement(root, "testsuite", name=stage)
    by_rule: dict[str, list[Finding]] = {rule: [] for rule in RULES}
    for finding in verdict.findings:
        by_rule.setdefault(finding.rule, []).append(finding)
    failed = 0
    for rule, found in by_rule.items():
        case = ElementTree.SubElement(suite, "testcase", classname=stage, name=_xml(rule))
        bad = [finding for finding in found if fails(finding, strict=strict)]
        if bad:
            failed += 1
            message = f"{bad[0].path}: {bad[0].text}" + (f" (and {len(bad) - 1} more)" if len(bad) > 1 else "")
            failure = ElementTree.SubElement(case, "failure", type=bad[0].severity, message=_xml(message))
            failure.text = _xml("\n".join(_sentence(finding, verdict) for finding in bad))
        if told := [finding for finding in found if not fails(finding, strict=strict)]:
            lines = (f"{finding.severity}: {_sentence(finding, verdict)}" for finding in told)
            ElementTree.SubElement(case, "system-out").text = _xml("\n".join(lines))
    suite.set("tests", str(len(by_rule)))
    suite.set("failures", str(failed))
    suite.set("errors", "0")
    suite.set("skipped", "0")
    return suite


def _xml(text: str) -> str:
    return _NOT_XML.sub("?", text)


def _sentence(finding: Finding, verdict: Verdict) -> str:
    fix = f" Fix: {fix_of(finding, _subject(verdict))}" if finding.fix else ""
    return f"{finding.path}: {finding.text}.{fix}"


def _subject(verdict: Verdict) -> str:
    """The file that was looked at."""
    return verdict.fixed_in or verdict.stage


# --- SARIF ----------------------------------------------------------------------------------------------------------


def to_sarif(verdicts: Sequence[Verdict]) -> str:
    """A log of one run."""
    every = [(verdict, finding) for verdict in verdicts for finding in verdict.findings]
    names = [*RULES, *sorted({finding.rule for _, finding in every} - set(RULES))]
    results = [_result(verdict, finding, names.index(finding.rule)) for verdict, finding in every]
    driver = {"name": "refract", "version": __version__, "rules": list(_rules(names, (one for _, one in every)))}
    log = {"$schema": _SCHEMA, "version": SARIF, "runs": [{"tool": {"driver": driver}, "results": results}]}
    return json.dumps(log, indent=2)


def _rules(names: Iterable[str], found: Iterable[Finding]) -> Iterator[dict[str, Any]]:
    worst = {finding.rule: finding.severity for finding in sorted(found, key=_gravity, reverse=True)}
    for name in names:
        rule = RULES.get(name)
        says = rule.says if rule else "One of the validators that come with USD, or that are installed beside it."
        level = _LEVELS[rule.severity if rule else worst[name]]
        yield {"id": name, "shortDescription": {"text": says}, "defaultConfiguration": {"level": level}}


def _gravity(finding: Finding) -> int:
    return SEVERITIES.index(finding.severity)


def _result(verdict: Verdict, finding: Finding, place: int) -> dict[str, Any]:
    stage = _subject(verdict)
    location: dict[str, Any] = {"physicalLocation": {"artifactLocation": {"uri": uri_of(stage)}}}
    if finding.path.startswith("/") and not Path(outer_of(finding.path)).exists():  # a prim, not a file
        location["logicalLocations"] = [{"fullyQualifiedName": finding.path}]
    fix = f" Fix: {fix_of(finding, stage)}" if finding.fix else ""
    return {
        "ruleId": finding.rule,
        "ruleIndex": place,
        "level": _LEVELS[finding.severity],
        "message": {"text": f"{finding.text}.{fix}"},
        "locations": [location],
    }


def uri_of(stage: str) -> str:
    """A URI reference (RFC 3986) of a stage's file: relative as it was named, or absolute with `file:`."""
    outer = outer_of(stage)
    if os.path.isabs(outer):
        return Path(outer).as_uri()
    path = quote(Path(outer).as_posix())
    return f"./{path}" if ":" in path.partition("/")[0] else path  # what stands before a colon would be a scheme
