"""Lambert's formula for the light of polygons ("Photometria", 1760): edges, and whole ones."""

from __future__ import annotations

import math

from ..kernels.compile import inlined
from ..kernels.vec import Vec, add, along, cross, dot, length, lerp, normalize, scale

_SIDE = 0.8660254037844386
"""sqrt(3) / 2"""


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


@inlined
def corner(c: Vec, x: Vec, y: Vec, k: int, sides: int) -> Vec:
    """Corner `k` of the parallelogram with half axes x, y; of the triangle about c whose corners are at x, and at -x/2
    with sqrt(3)/2 of y to either side; or of the regular polygon with the area of the axes' ellipse."""
    if sides == 4:
        sx = 1.0 if k % 4 == 1 or k % 4 == 2 else -1.0
        sy = 1.0 if k % 4 == 2 or k % 4 == 3 else -1.0
        return add(add(c, scale(x, sx)), scale(y, sy))
    if sides == 3:
        if k % 3 == 0:
            return add(c, x)
        return add(along(c, x, -0.5), scale(y, _SIDE if k % 3 == 1 else -_SIDE))
    step = 2.0 * math.pi / sides
    grow = math.sqrt(step / math.sin(step))
    return add(add(c, scale(x, grow * math.cos(step * k))), scale(y, grow * math.sin(step * k)))


@inlined
def polygon_irradiance(c: Vec, n: Vec, x: Vec, y: Vec, sides: int) -> float:
    """Irradiance per radiance of a polygon whose middle is `c` away, clipped at the receiver's horizon (Lambert 1760;
    Baum, Rushmeier and Winget 1989). Its corners are those of `corner`."""
    total = 0.0
    leaving = entering = c
    cut = False
    a = normalize(corner(c, x, y, 0, sides))
    for k in range(sides):
        b = normalize(corner(c, x, y, k + 1, sides))
        ha, hb = dot(a, n), dot(b, n)
        start, end = a, b
        if (ha > 0.0) != (hb > 0.0):  # the horizon cuts this edge: the part above it counts
            crossing = normalize(lerp(a, b, ha / (ha - hb)))
            cut = True
            if ha > 0.0:
                end = leaving = crossing
            else:
                start = entering = crossing
        if ha > 0.0 or hb > 0.0:
            total += polygon_edge(start, end, n)
        a = b
    if cut:  # the edge along the horizon, which closes what is left of the polygon
        total += polygon_edge(leaving, entering, n)
    return abs(total) * 0.5
