"""What rules are, what is found against them, and repairs of it written into a layer.

A rule is *safe* to fix where the value as it is cannot have been meant: what is written over it is what the renderer
uses in its place, or the one word or orientation that was meant. Nothing is guessed, and no opinion is removed.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

from pxr import Sdf, Usd

from .. import ours

ERROR, WARNING, INFO = "error", "warning", "info"


class Repair(NamedTuple):
    """One attribute with other values; the path `/` and the name of a field stand for metadata of the stage."""

    path: str
    name: str
    values: tuple[tuple[float | None, Any], ...] = ()
    """By time code; None is the default value."""


class Finding(NamedTuple):
    """A place where a rule is broken."""

    rule: str
    severity: str
    path: str
    """Prim path, or the stage's file."""
    text: str
    """One sentence: what is wrong, and the range it should be in."""
    fix: str
    """What to do: a command, or what to author."""
    about: str = ""
    """The attribute; '' where it is the prim as a whole."""
    repairs: tuple[Repair, ...] = ()
    """Empty where it is not safe to repair without a person."""


class Rule(NamedTuple):
    """What a stage should keep."""

    id: str
    severity: str
    says: str
    """The rule in one sentence."""
    safe: bool = False
    """`--fix` repairs it."""

    def broken(
        self, path: str, text: str, fix: str = "", about: str = "", repairs: tuple[Repair, ...] = ()
    ) -> Finding:
        """A place where it is; see the fields of `Finding`."""
        return Finding(self.id, self.severity, path, text, fix, about, repairs)


def apply_repairs(layer: Sdf.Layer, repairs: Iterable[Repair]) -> None:
    """Write repairs into a layer that lies over the stage they were found on."""
    stage = Usd.Stage.Open(layer)
    stage.SetEditTarget(layer)
    for repair in repairs:
        if repair.path == "/":
            ours.write_fallback_types(stage)
            continue
        attribute = stage.GetPrimAtPath(repair.path).GetAttribute(repair.name)
        for time, value in repair.values:
            attribute.Set(value, Usd.TimeCode.Default() if time is None else Usd.TimeCode(time))
