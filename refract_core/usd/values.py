"""A value as USD gives it, as plain numbers; and a number or name as it is written into a stage or told to a person.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterable
from typing import Any


def numbers(value: Any) -> tuple[float, ...] | None:
    """A number gives one, a vector, colour or array its components, anything else (a text, nothing) None."""
    if isinstance(value, str):
        return None
    try:
        return tuple(float(part) for part in value) if hasattr(value, "__len__") else (float(value),)
    except (TypeError, ValueError):
        return None


def finite(values: Iterable[float]) -> bool:
    """None of them is NaN or infinite."""
    return all(math.isfinite(value) for value in values)


def triple(vector: Iterable[Any]) -> tuple[float, float, float]:
    """A vector of any library as three plain floats."""
    x, y, z = (float(part) for part in vector)
    return x, y, z


def listed(values: Iterable[float]) -> str:
    """As a message shows them: `2`, or `(1, 2, 3)`."""
    words = [f"{value:g}" for value in values]
    return words[0] if len(words) == 1 else f"({', '.join(words)})"


def neat(value: float) -> float:
    """Six digits: what float32 holds, and a person can read."""
    return float(f"{value:.6g}")


def free_name(name: str, taken: Container[str]) -> str:
    """A name, with a number after it where it is taken already."""
    unique, count = name, 1
    while unique in taken:
        unique, count = f"{name}_{count}", count + 1
    return unique


_LONGEST = 80


def short(path: str) -> str:
    """A file's path as a message shows it: of a name longer than any file has, its two ends; of a URI that holds data,
    what comes before them."""
    if path.startswith("data:"):
        return f"{path.partition(',')[0][:_LONGEST]},..."
    folder, slash, name = path.rpartition("/")
    if len(name) <= 2 * _LONGEST:
        return path
    return f"{folder}{slash}{name[:_LONGEST]}...{name[-_LONGEST // 4 :]}"
