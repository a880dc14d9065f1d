"""Three-vectors for kernels: plain tuples (x, y, z) of floats, which compile to registers.

Every component is float64. Tables are float32 where that is enough to keep a number, never where one is computed with:
what comes out of a table is widened at the door (`row`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .compile import inlined

Vec = tuple[float, float, float]


@inlined
def add(a: Vec, b: Vec) -> Vec:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@inlined
def sub(a: Vec, b: Vec) -> Vec:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@inlined
def mul(a: Vec, b: Vec) -> Vec:
    """Component by component."""
    return (a[0] * b[0], a[1] * b[1], a[2] * b[2])


@inlined
def scale(a: Vec, s: float) -> Vec:
    return (a[0] * s, a[1] * s, a[2] * s)


@inlined
def along(origin: Vec, direction: Vec, t: float) -> Vec:
    """origin + t * direction"""
    return (origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2])


@inlined
def lerp(a: Vec, b: Vec, t: float) -> Vec:
    return (a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t, a[2] + (b[2] - a[2]) * t)


@inlined
def dot(a: Vec, b: Vec) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def cross(a: Vec, b: Vec) -> Vec:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@inlined
def length(a: Vec) -> float:
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@inlined
def normalize(a: Vec) -> Vec:
    """Unit vector along `a`; the zero vector stays zero."""
    squared = a[0] * a[0] + a[1] * a[1] + a[2] * a[2]
    if squared <= 0.0:
        return (0.0, 0.0, 0.0)
    s = 1.0 / math.sqrt(squared)
    return (a[0] * s, a[1] * s, a[2] * s)


@inlined
def towards(p: Vec, target: Vec) -> tuple[Vec, float]:
    """Unit direction from a point to another, and the way there."""
    d = sub(target, p)
    distance = length(d)
    return scale(d, 1.0 / max(distance, 1e-12)), distance


@inlined
def flip_towards(n: Vec, w: Vec) -> Vec:
    """`n` or its opposite, whichever is on the side of `w`."""
    if dot(n, w) < 0.0:
        return (-n[0], -n[1], -n[2])
    return (n[0], n[1], n[2])


@inlined
def row(a: NDArray[Any], i: int) -> Vec:
    """Row `i` of an (N, 3) array as a tuple of float64."""
    # Not `float()`: numba leaves a float32 what it is there, and every function that follows would be compiled twice.
    return (np.float64(a[i, 0]), np.float64(a[i, 1]), np.float64(a[i, 2]))


@inlined
def frame(n: Vec) -> tuple[Vec, Vec]:
    """Two unit vectors that make a right-handed frame with unit `n` (Duff et al., JCGT 6(1) 2017)."""
    # The sign, rather than a test of n.z, keeps the division away from 0 for every direction, and -0 on its own side.
    sign = math.copysign(1.0, n[2])
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    return (1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), (b, sign + n[1] * n[1] * a, -n[1])


@inlined
def transform_direction(m: NDArray[Any], d: Vec) -> Vec:
    """Upper 3x3 of a matrix array times a vector. A normal comes out right only where the matrix keeps angles."""
    return (
        m[0, 0] * d[0] + m[0, 1] * d[1] + m[0, 2] * d[2],
        m[1, 0] * d[0] + m[1, 1] * d[1] + m[1, 2] * d[2],
        m[2, 0] * d[0] + m[2, 1] * d[1] + m[2, 2] * d[2],
    )


@inlined
def transform_point(m: NDArray[Any], p: Vec) -> Vec:
    """A 4x4 matrix array (column vectors, affine) times a point."""
    return (
        m[0, 0] * p[0] + m[0, 1] * p[1] + m[0, 2] * p[2] + m[0, 3],
        m[1, 0] * p[0] + m[1, 1] * p[1] + m[1, 2] * p[2] + m[1, 3],
        m[2, 0] * p[0] + m[2, 1] * p[1] + m[2, 2] * p[2] + m[2, 3],
    )
