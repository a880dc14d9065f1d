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
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from ..settings import AS_IT_IS, Opening
from ..usd.layers.write import check_out, overlay, save
from ..usd.rules.findings import Finding, apply_repairs
from ..usd.rules.stage import stage_findings, stock_findings
from ..usd.stage import open_stage
from ..version import __version__
from .gltf import as_usd
from .orders import stop_if

FORMAT = "refract.validate/1"
MADE = "validate --fix"
SEVERITIES = ("error", "warning", "info")
OURS = "refract."
"""How the ids of our own rules begin."""
_SHOWN = 10
"""Findings of one rule of ours that the plain text lists."""
_PLACES = 3
"""Places of one of USD's validators that it names."""
_LETTERS = 300
"""Of what one of them says."""


@dataclass(frozen=True, kw_only=True)
class ValidateOrder:
    """What to look at, and where to put what is mended."""

    stage: str
    fix: str = ""
    """Path of the layer to write; '' writes nothing."""
    overwrite: bool = False
    opening: Opening = AS_IT_IS
    """Session layer, variants and mask."""


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
    found = _check(order.stage if order.fix else as_usd(order.stage), order.opening, cancel)
    if not order.fix:
        return Verdict(order.stage, found)
    layer = overlay(order.stage, made=MADE)
    apply_repairs(layer, (repair for finding in found for repair in finding.repairs))
    stop_if(cancel)
    save(layer, order.fix)
    left = _check(order.fix, order.opening, cancel)
    still = Counter(_key(finding) for finding in left)
    fixed = [finding for finding in found if finding.repairs and not still[_key(finding)]]
    return Verdict(order.stage, left, tuple(fixed), order.fix)


def _check(stage: str, opening: Opening, cancel: Callable[[], bool]) -> tuple[Finding, ...]:
    opened = open_stage(stage, opening)
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


def counts_of(findings: Iterable[Finding]) -> Counter[str]:
    """How many there are of each severity."""
    return Counter(finding.severity for finding in findings)


def record_of(verdict: Verdict) -> dict[str, Any]:
    """See the head of this module."""
    counts = counts_of(verdict.findings)
    return {
        "format": FORMAT,
        "stage": verdict.stage,
        "engine": __version__,
        "fixed_in": verdict.fixed_in or None,
        **{f"{severity}s": counts[severity] for severity in SEVERITIES},
        "fixed": [finding_record(finding, verdict.stage) for finding in verdict.fixed],
        "findings": [finding_record(finding, verdict.fixed_in or verdict.stage) for finding in verdict.findings],
    }


def to_json(verdict: Verdict) -> str:
    """See the head of this module."""
    return json.dumps(record_of(verdict), indent=2)


def to_text(verdict: Verdict) -> str:
    """For a person: our own verdict first, then USD's validators, a line each."""
    subject = verdict.fixed_in or verdict.stage
    mine = [finding for finding in verdict.findings if finding.rule.startswith(OURS)]
    others = [finding for finding in verdict.findings if not finding.rule.startswith(OURS)]
    lines = [f"fixed    {finding.rule}  {finding.path}" for finding in verdict.fixed]
    lines.append(f"{subject}: {_counted(mine) if mine else 'nothing to complain about'}")
    lines += _listed(mine, subject, fixing=not verdict.fixed_in)
    if others:
        lines.append(f"USD's own validators: {_counted(others)}")
        lines += _grouped(others)
    return "\n".join(lines)


def summary(verdicts: Sequence[Verdict]) -> str:
    """The last line about many stages."""
    bad = sum(not verdict.passed for verdict in verdicts)
    return f"{len(verdicts)} stages, {bad} of them with errors: " + _counted(
        finding for verdict in verdicts for finding in verdict.findings
    )


def _counted(findings: Iterable[Finding]) -> str:
    counts = counts_of(findings)
    return ", ".join(f"{counts[severity]} {severity}{'' if counts[severity] == 1 else 's'}" for severity in SEVERITIES)


def _grouped(findings: Iterable[Finding]) -> Iterator[str]:
    """One line for each validator and severity: how often, the first places, and what it says of the first."""
    groups: dict[tuple[str, str], list[Finding]] = {}
    for finding in findings:
        groups.setdefault((finding.severity, finding.rule), []).append(finding)
    for (severity, rule), same in groups.items():
        paths = list(dict.fromkeys(finding.path for finding in same))
        where = ", ".join(paths[:_PLACES]) + (", ..." if len(paths) > _PLACES else "")
        often = f"{len(same)} times, " if len(same) > 1 else ""
        yield f"{severity:<8} {rule}  {often}{where}: {_short(same[0].text)}"


def _short(text: str) -> str:
    """Cut between two words: some validators list every index of a mesh."""
    if len(text) <= _LETTERS:
        return text
    return f"{text[: text.rfind(' ', 0, _LETTERS)]} ..." if " " in text[:_LETTERS] else text


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
