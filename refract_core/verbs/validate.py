"""`refract validate`: a stage against the rules, and a layer that mends what is safe to mend.

The JSON of `--json` (its `format` changes when a field does):

    {"format": "refract.validate/1", "stage": STAGE, "engine": VERSION,
     "fixed_in": OUT or null,           the layer written by --fix
     "errors": N, "warnings": N, "infos": N,      of what is left
     "fixed": [FINDING, ...],           mended in that layer
     "findings": [FINDING, ...]}        what is left, errors first

    FINDING = {"rule": ID, "severity": "error" | "warning" | "info", "path": prim, property or file,
               "text": what is wrong, "fix": what to do or "", "safe": whether --fix mends it}

Rules whose id begins with `refract.` are ours; the others are the validators that come with USD.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from ..usd.layers.write import check_out, overlay, save
from ..usd.rules.findings import Finding, apply_repairs
from ..usd.rules.stage import stage_findings, stock_findings
from ..usd.stage import open_stage
from ..version import __version__
from .orders import stop_if

FORMAT = "refract.validate/1"
MADE = "validate --fix"
SEVERITIES = ("error", "warning", "info")
_SHOWN = 10
"""Findings of one rule that the plain text lists."""


@dataclass(frozen=True, kw_only=True)
class ValidateOrder:
    """What to look at, and where to put what is mended."""

    stage: str
    fix: str = ""
    """Path of the layer to write; '' writes nothing."""
    overwrite: bool = False


@dataclass(frozen=True)
class Verdict:
    """What was found."""

    stage: str
    findings: tuple[Finding, ...]
    """What is left, errors first."""
    fixed: tuple[Finding, ...] = ()
    fixed_in: str = ""

    @property
    def passed(self) -> bool:
        return not any(finding.severity == "error" for finding in self.findings)


def validate(order: ValidateOrder, cancel: Callable[[], bool] = lambda: False) -> Verdict:
    """Check a stage; with `fix`, write the mended layer and check that instead.

    Raises:
        StageError: the stage cannot be opened, or the layer cannot be written.
        UsageError: the layer may not be written there.
    """
    if order.fix:
        check_out(order.stage, order.fix, overwrite=order.overwrite, ours=MADE)
    found = _check(order.stage, cancel)
    if not order.fix:
        return Verdict(order.stage, found)
    layer = overlay(order.stage, made=MADE)
    apply_repairs(layer, (repair for finding in found for repair in finding.repairs))
    stop_if(cancel)
    save(layer, order.fix)
    left = _check(order.fix, cancel)
    still = Counter(_key(finding) for finding in left)
    fixed = [finding for finding in found if finding.repairs and not still[_key(finding)]]
    return Verdict(order.stage, left, tuple(fixed), order.fix)


def _check(stage: str, cancel: Callable[[], bool]) -> tuple[Finding, ...]:
    opened = open_stage(stage)
    found = stage_findings(opened)
    stop_if(cancel)
    found += stock_findings(opened)
    stop_if(cancel)
    once = {(finding.rule, finding.path, finding.text): finding for finding in found}
    return tuple(sorted(once.values(), key=lambda finding: SEVERITIES.index(finding.severity)))


def _key(finding: Finding) -> tuple[str, str, str]:
    """The same finding on a layer over the stage."""
    return finding.rule, finding.path if finding.path.startswith("/") else "", finding.about


# --- words ----------------------------------------------------------------------------------------------------------


def finding_record(finding: Finding, stage: str) -> dict[str, Any]:
    """One finding, as JSON has it."""
    return {
        "rule": finding.rule,
        "severity": finding.severity,
        "path": finding.path,
        "text": finding.text,
        "fix": fix_of(finding, stage),
        "safe": bool(finding.repairs),
    }


def fix_of(finding: Finding, stage: str) -> str:
    """What to do, with the stage's own name in the command."""
    return finding.fix.replace("STAGE", stage)


def to_json(verdict: Verdict) -> str:
    """See the head of this module."""
    counts = Counter(finding.severity for finding in verdict.findings)
    record = {
        "format": FORMAT,
        "stage": verdict.stage,
        "engine": __version__,
        "fixed_in": verdict.fixed_in or None,
        **{f"{severity}s": counts[severity] for severity in SEVERITIES},
        "fixed": [finding_record(finding, verdict.stage) for finding in verdict.fixed],
        "findings": [finding_record(finding, verdict.fixed_in or verdict.stage) for finding in verdict.findings],
    }
    return json.dumps(record, indent=2)


def to_text(verdict: Verdict) -> str:
    """For a person."""
    lines: list[str] = []
    if verdict.fixed_in:
        lines += [f"fixed    {finding.rule}  {finding.path}" for finding in verdict.fixed]
    subject = verdict.fixed_in or verdict.stage
    lines += list(_listed(verdict.findings, subject, fixing=not verdict.fixed_in))
    counts = Counter(finding.severity for finding in verdict.findings)
    said = ", ".join(f"{counts[severity]} {severity}{'' if counts[severity] == 1 else 's'}" for severity in SEVERITIES)
    lines.append(f"{subject}: {said}" if verdict.findings else f"{subject}: nothing to complain about")
    return "\n".join(lines)


def _listed(findings: Iterable[Finding], stage: str, *, fixing: bool) -> Iterator[str]:
    """Lines of the findings, the first few of each rule."""
    shown: Counter[str] = Counter()
    every = Counter(finding.rule for finding in findings)
    for finding in findings:
        shown[finding.rule] += 1
        if shown[finding.rule] > _SHOWN:
            continue
        yield f"{finding.severity:<8} {finding.rule}  {finding.path}"
        yield f"         {finding.text}"
        if finding.fix:
            safe = "; --fix OUT does that" if finding.repairs and fixing and "--fix" not in finding.fix else ""
            yield f"         fix: {fix_of(finding, stage)}{safe}"
        if shown[finding.rule] == _SHOWN < every[finding.rule]:
            yield f"         ... and {every[finding.rule] - _SHOWN} more of {finding.rule}; --json lists all"
