"""What is authored on one probe prim: tokens, flags and numbers, brought into their ranges with a notice."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pxr import Usd

from ...errors import StageError
from ...scene import Notice
from .. import ours
from ..values import finite, listed, numbers

INF = math.inf


@dataclass(frozen=True)
class ProbePrim:
    """One probe prim and where to complain about it."""

    prim: Usd.Prim
    time: Usd.TimeCode
    notices: list[Notice]

    @property
    def path(self) -> str:
        return str(self.prim.GetPath())

    def say(self, text: str) -> None:
        self.notices.append(Notice(self.path, text))

    def get(self, name: str) -> Any:
        """What USD has for an attribute; None where that is nothing."""
        return ours.value(self.prim, name, self.time)


def fallback(probe: ProbePrim, name: str) -> tuple[float, ...]:
    """What the schema says where nothing is authored."""
    return numbers(ours.fallback(probe.prim, name)) or ()


def floats(
    probe: ProbePrim, name: str, low: Sequence[float], high: Sequence[float], *, above: bool = False
) -> tuple[float, ...]:
    """Value of an attribute in the schema's units, brought into its range.

    Args:
        low: the least value of each component; its length is how many there must be
        high: the largest value of each component
        above: `low` itself is out of range
    """
    value = probe.get(name)
    found = fallback(probe, name) if value is None else numbers(value)
    limits = list(zip(low, high, strict=True))
    used = _within(found, limits, above) or fallback(probe, name)
    if used != found:
        probe.say(f"{name} is {value}; it must be {_range_text(limits, above)}; {listed(used)} is used")
    return used


def positive(probe: ProbePrim, name: str, count: int) -> tuple[float, ...]:
    """As many finite numbers above 0."""
    return floats(probe, name, (0.0,) * count, (INF,) * count, above=True)


def token(probe: ProbePrim, name: str, allowed: tuple[str, ...]) -> str:
    """One of the allowed words.

    Raises:
        StageError: it is another one.
    """
    value = probe.get(name)
    if value not in allowed:
        raise StageError(f"{probe.path}: {name} is '{value}'; choose from {', '.join(allowed)}")
    return str(value)


def flag(probe: ProbePrim, name: str) -> bool:
    """A truth value; the schema's own, with a notice, where it is something else."""
    value = probe.get(name)
    if isinstance(value, bool | int):
        return bool(value)
    used = any(fallback(probe, name))
    if value is not None:
        probe.say(f"{name} is {value}; it must be true or false; {str(used).lower()} is used")
    return used


def forced(probe: ProbePrim, name: str, used: tuple[float, ...], reason: str) -> tuple[float, ...]:
    """What is used whatever the author says; a notice where that is something else."""
    value = probe.get(name)
    if value is not None and numbers(value) != used:
        probe.say(f"{name} is {value}, which is ignored: {reason}; {listed(used)} is used. Remove it")
    return used


def _within(
    found: tuple[float, ...] | None, limits: list[tuple[float, float]], above: bool
) -> tuple[float, ...] | None:
    """The numbers, clamped to their limits; None where that gives nothing sensible."""
    if found is None or len(found) != len(limits) or not finite(found):
        return None
    pairs = [(number, *limit) for number, limit in zip(found, limits, strict=True)]
    if above and any(number <= low for number, low, _ in pairs):
        return None
    return tuple(min(max(number, low), high) for number, low, high in pairs)


def _range_text(limits: list[tuple[float, float]], above: bool) -> str:
    count = {1: "a number", 2: "two numbers", 3: "three numbers", 6: "six numbers"}[len(limits)]
    low, high = limits[0][0], [most for _, most in limits]
    if above:
        return f"{count} above {low:g}"
    if math.isinf(low):
        return f"{count}, all finite"
    if len(set(high)) == 1:
        return f"{count} of {low:g} or more" if math.isinf(high[0]) else f"{count} between {low:g} and {high[0]:g}"
    return f"{count} between {low:g} and {listed(high)}"
