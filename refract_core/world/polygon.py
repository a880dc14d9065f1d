"""One edge of a polygon in Lambert's formula for the light of flat things (Lambert, "Photometria", 1760)."""

from __future__ import annotations

import math

from ..kernels.compile import inlined
from ..kernels.vec import Vec, cross, dot, length


@inlined
def _angle_over_sine(x: float) -> float:
    """acos(x) / sqrt(1 - x * x) for x in 0 .. 1, where it is 1 at the end, to 1e-7 of it: a Chebyshev fit, in an order
    without a long chain. A call of acos takes longer than all the rest of an edge."""
    x2 = x * x
    low = (1.5707962222 - 0.99998225999 * x) + (0.78489625578 - 0.66108945254 * x) * x2
    high = (0.55702205608 - 0.4245661869 * x) + (0.25323847676 - 0.097968704053 * x) * x2
    return low + (high + 0.017653667906 * (x2 * x2)) * (x2 * x2)


@inlined
def polygon_edge(a: Vec, b: Vec, n: Vec) -> float:
    """One edge of Lambert's formula for two unit directions and the receiver's normal: the angle between the two, times
    the cosine of the receiver to the plane that they span."""
    cosine = min(1.0, max(-1.0, dot(a, b)))
    axis = cross(a, b)
    across = dot(axis, n)
    angle = _angle_over_sine(abs(cosine))
    if cosine >= 0.0:
        return angle * across
    sine = length(axis)  # past a right angle: acos(-x) = pi - acos(x)
    return (math.pi / sine - angle) * across if sine > 1e-9 else 0.0
