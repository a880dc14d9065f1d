"""Vectors as tuples of three floats."""

from __future__ import annotations

import math
from collections.abc import Iterable

Vec = tuple[float, float, float]

ZERO: Vec = (0.0, 0.0, 0.0)


def vec(a: Iterable[float]) -> Vec:
    """Three numbers of any sequence, such as a row of an array."""
    x, y, z = a
    return (float(x), float(y), float(z))


def add(a: Vec, b: Vec) -> Vec:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


def sub(a: Vec, b: Vec) -> Vec:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def mul(a: Vec, b: Vec) -> Vec:
    """Channel by channel."""
    return (a[0] * b[0], a[1] * b[1], a[2] * b[2])


def scaled(a: Vec, s: float) -> Vec:
    return (a[0] * s, a[1] * s, a[2] * s)


def at(origin: Vec, direction: Vec, t: float) -> Vec:
    """Point of a ray."""
    return (origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2])


def mix(a: Vec, b: Vec, t: float) -> Vec:
    return (a[0] * (1 - t) + b[0] * t, a[1] * (1 - t) + b[1] * t, a[2] * (1 - t) + b[2] * t)


def dot(a: Vec, b: Vec) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vec, b: Vec) -> Vec:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def length(a: Vec) -> float:
    return math.sqrt(dot(a, a))


def unit(a: Vec) -> Vec:
    """The zero vector stays zero."""
    size = length(a)
    return scaled(a, 1.0 / size) if size > 0.0 else ZERO


def facing(n: Vec, w: Vec) -> Vec:
    """`n` or its opposite, on the side of `w`."""
    return n if dot(n, w) >= 0.0 else scaled(n, -1.0)


def basis(n: Vec) -> tuple[Vec, Vec]:
    """Two axes that make a right-handed frame with unit `n` (Duff et al., JCGT 6(1) 2017): the sampling sequence is
    laid out in them, so a sampled direction is only found again in this very frame."""
    sign = math.copysign(1.0, n[2])
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    return (1.0 + sign * n[0] ** 2 * a, sign * b, -sign * n[0]), (b, sign + n[1] ** 2 * a, -n[1])


def clamp(x: float, low: float = 0.0, high: float = 1.0) -> float:
    return min(high, max(low, x))
