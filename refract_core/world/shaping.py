"""Lights that do not shine evenly: cones, focus, measured profiles, and pictures on rectangles.

`lights` knows what an even light brings, exactly. Here is the mean of what is left of its radiance, by what its parts
bring: a sum over a grid of them, which is without noise. A cone's edge is averaged over a cell of the grid, so that a
light that is cut by it fades as it should. Formulas are those of UsdLux (ShapingAPI, `scene.Shaping`).

Shares are colours, 0 or more; directions unit, lengths metres, angles radians, in engine world. Nothing here raises.
"""

from __future__ import annotations

import math

from ..kernels.arrays import F32_1D
from ..kernels.compile import inlined
from ..kernels.vec import Vec, along, cross, dot, frame, length, lerp, normalize, scale, sub
from ..scene import LightKind
from .lights import Lamp, LightTable, ShapeTable, across, lamp_of, nearest_to, target_on

_RECT, _DISK = LightKind.RECT.value, LightKind.DISK.value
_SPHERE, _CYLINDER = LightKind.SPHERE.value, LightKind.CYLINDER.value
_WHITE = (1.0, 1.0, 1.0)
_BLACK = (0.0, 0.0, 0.0)


@inlined
def shape_matt(lights: LightTable, which: int, p: Vec, n: Vec) -> Vec:
    """What is left of a light's irradiance at `p` on a surface with normal `n`, on an average."""
    kind, shapes = lights.kind[which], lights.shapes
    lamp, face = _shown(kind, lamp_of(lights, which), p)
    to = sub(lamp.centre, p)
    distance = max(length(to), 1e-9)
    reach = _half_extent(kind, lamp)
    plain = shapes.focus[which] <= 0.0 and shapes.profile[which, 1] == 0 and shapes.picture[which, 0] < 0
    crossed = shapes.cone[which, 1] < math.pi
    if reach < distance:
        off = _angle(dot(to, lamp.face) / -distance)
        wide = math.asin(reach / distance)
        if off - wide > shapes.cone[which, 1]:
            return _BLACK
        if plain and off + wide <= shapes.cone[which, 0]:
            return _WHITE
        crossed = crossed and off + wide > shapes.cone[which, 0]
    sharp = crossed and shapes.cone[which, 1] - shapes.cone[which, 0] < reach / distance
    firsts, seconds = _grid(kind, lamp, distance, 2 if sharp else 1)
    level = 0
    if shapes.picture[which, 0] >= 0:
        while 1 << level < max(firsts, seconds):
            level += 1
        firsts = seconds = 1 << level
    blur = _cell(kind, lamp, firsts, seconds) / distance
    flat_kind, flat = _flat(kind, lamp, face)
    total, weights = _BLACK, 0.0
    for i in range(firsts):
        for j in range(seconds):
            u, v = (i + 0.5) / firsts, (j + 0.5) / seconds
            d, away = target_on(flat_kind, flat, p, n, u, v)
            weight = max(0.0, dot(d, n)) * max(0.0, dot(d, face)) / (away * away)
            if weight <= 0.0:
                continue
            share = _leaving(lights, which, lamp, scale(d, -1.0), blur)
            if shapes.picture[which, 0] >= 0:
                tint = _texel(shapes, which, level, 1.0 - u, 1.0 - v)
                share = (share[0] * tint[0], share[1] * tint[1], share[2] * tint[2])
            total = along(total, share, weight)
            weights += weight
    return scale(total, 1.0 / weights) if weights > 0.0 else _WHITE


@inlined
def shape_mirrored(lights: LightTable, which: int, p: Vec, n: Vec, wo: Vec, alpha: float) -> Vec:
    """What is left of a light's highlight (`lights.highlight`): where it is seen, about as wide as the lobe."""
    kind, shapes = lights.kind[which], lights.shapes
    lamp = lamp_of(lights, which)
    point, _, _, radius = nearest_to(kind, lamp, p, sub(scale(n, 2.0 * dot(n, wo)), wo))
    share = _leaving(lights, which, lamp, scale(normalize(point), -1.0), min(alpha, radius))
    if shapes.picture[which, 0] < 0:
        return share
    off = sub(point, sub(lamp.centre, p))
    s, t = 0.5 - 0.5 * dot(off, lamp.x) / lamp.a, 0.5 - 0.5 * dot(off, lamp.y) / lamp.b
    finest = float(shapes.picture[which, 1])
    wide = alpha * length(point) / max(lamp.a, lamp.b)
    level = min(finest, max(0.0, -math.log2(wide))) if wide * 2.0**finest > 1.0 else finest
    low = int(level)
    tint = _texel(shapes, which, low, s, t)
    if level > low:
        tint = lerp(tint, _texel(shapes, which, low + 1, s, t), level - low)
    return (share[0] * tint[0], share[1] * tint[1], share[2] * tint[2])


@inlined
def shape_drawn(lights: LightTable, which: int, p: Vec, direction: Vec, distance: float) -> Vec:
    """What is left of the radiance that comes to `p` from one point of a light, as `lights.shadow_ray` draws it."""
    lamp, shapes = lamp_of(lights, which), lights.shapes
    share = _leaving(lights, which, lamp, scale(direction, -1.0), 0.0)
    if shapes.picture[which, 0] < 0:
        return share
    off = sub(along(p, direction, distance), lamp.centre)
    s, t = 0.5 - 0.5 * dot(off, lamp.x) / lamp.a, 0.5 - 0.5 * dot(off, lamp.y) / lamp.b
    tint = _texel(shapes, which, int(shapes.picture[which, 1]), s, t)
    return (share[0] * tint[0], share[1] * tint[1], share[2] * tint[2])


# --- the grid -------------------------------------------------------------------------------------------------------


@inlined
def _shown(kind: int, lamp: Lamp, p: Vec) -> tuple[Lamp, Vec]:
    """The flat shape that fills the directions a light fills as `p` sees it, and the unit normal of its far side: of a
    sphere the circle along which it is touched from `p`; of a cylinder a strip, as far before its axis as its near half
    is on an average."""
    if kind == _SPHERE:
        to = sub(lamp.centre, p)
        distance = max(length(to), 1e-9)
        face, sine = scale(to, 1.0 / distance), min(lamp.a / distance, 1.0)
        middle, half = along(lamp.centre, face, -lamp.a * sine), lamp.a * math.sqrt(1.0 - sine * sine)
    elif kind == _CYLINDER:
        _, distance, face = across(lamp, p)
        sine, before = min(lamp.a / distance, 1.0), 0.25 * math.pi * lamp.a
        middle = along(lamp.centre, face, -before)
        half = (distance - before) * sine / math.sqrt(max(1.0 - sine * sine, 1e-4))
    else:
        return lamp, scale(lamp.face, -1.0)
    return Lamp(lamp.x, lamp.y, lamp.face, middle, half, lamp.b), face


@inlined
def _flat(kind: int, shown: Lamp, face: Vec) -> tuple[int, Lamp]:
    """What `_shown` gives, as a disk or a rectangle."""
    if kind == _SPHERE:
        x, y = frame(scale(face, -1.0))
        return _DISK, Lamp(x, y, shown.face, shown.centre, shown.a, 0.0)
    if kind == _CYLINDER:
        return _RECT, Lamp(shown.x, cross(shown.x, face), shown.face, shown.centre, shown.b, shown.a)
    return kind, shown


@inlined
def _half_extent(kind: int, lamp: Lamp) -> float:
    """Distance of a light's farthest point from its middle."""
    return math.sqrt(lamp.a * lamp.a + lamp.b * lamp.b) if kind in (_RECT, _CYLINDER) else lamp.a


@inlined
def _pieces(half: float, distance: float, times: int) -> int:
    """Along a side of a light: more the wider it is seen, and `times` as many where an edge crosses it."""
    wide = 2.0 * half / distance
    if wide <= 0.0:
        return 1
    return times * (1 if wide < 0.04 else 2 if wide < 0.1 else 4 if wide < 0.3 else 8 if wide < 1.0 else 16)


@inlined
def _grid(kind: int, lamp: Lamp, distance: float, times: int) -> tuple[int, int]:
    """Pieces along both coordinates of `lights.target_on`; round lights have rings, and twice as many sectors."""
    if kind == _RECT:
        return _pieces(lamp.a, distance, times), _pieces(lamp.b, distance, times)
    if kind == _CYLINDER:
        return _pieces(lamp.b, distance, times), min(4 * times, _pieces(lamp.a, distance, times))
    count = _pieces(lamp.a, distance, times)
    return (count + 1) // 2, 2 * count if count > 1 else 1


@inlined
def _cell(kind: int, lamp: Lamp, firsts: int, seconds: int) -> float:
    """Half the width of a cell [m]."""
    if kind in (_RECT, _CYLINDER):
        a, b = (lamp.a, lamp.b) if kind == _RECT else (lamp.b, lamp.a)
        return 0.7 * math.sqrt((a / firsts) ** 2 + (b / seconds) ** 2)
    return 0.886 * lamp.a / math.sqrt(firsts * seconds)


# --- one direction --------------------------------------------------------------------------------------------------


@inlined
def _angle(cosine: float) -> float:
    return math.acos(min(1.0, max(-1.0, cosine)))


@inlined
def _leaving(lights: LightTable, which: int, lamp: Lamp, d: Vec, blur: float) -> Vec:
    """What leaves a light in direction `d`. `blur`: half width over which a cone's edge is averaged."""
    shapes = lights.shapes
    cosine = dot(d, lamp.face)
    off = _angle(cosine)
    share = _in_cone(off, shapes.cone[which, 0], shapes.cone[which, 1], blur)
    if share > 0.0 and shapes.profile[which, 1] > 0:
        share *= _profile(shapes, which, off, math.atan2(dot(d, lamp.y), dot(d, lamp.x)))
    if shapes.focus[which] <= 0.0:
        return (share, share, share)
    tint = (shapes.tint[which, 0], shapes.tint[which, 1], shapes.tint[which, 2])
    return scale(lerp(tint, _WHITE, abs(cosine) ** shapes.focus[which]), share)


@inlined
def _in_cone(off: float, start: float, end: float, blur: float) -> float:
    """1 - smoothstep from `start` to `end`, averaged over `blur` to either side."""
    if end >= math.pi:
        return 1.0
    width = max(end - start, 1e-6)
    low, high = (off - blur - start) / width, (off + blur - start) / width
    if blur <= 0.0:
        x = min(1.0, max(0.0, low))
        return 1.0 - x * x * (3.0 - 2.0 * x)
    return 1.0 - (_smooth_sum(high) - _smooth_sum(low)) / (high - low)


@inlined
def _smooth_sum(x: float) -> float:
    """Integral of smoothstep from 0 on."""
    if x >= 1.0:
        return x - 0.5
    x = max(x, 0.0)
    return x * x * x * (1.0 - 0.5 * x)


@inlined
def _profile(shapes: ShapeTable, which: int, off: float, around: float) -> float:
    """Linear between the values of a measured profile."""
    first, rows, columns = shapes.profile[which, 0], shapes.profile[which, 1], shapes.profile[which, 2]
    y = off / math.pi * (rows - 1)
    x = (around / (2.0 * math.pi) + (1.0 if around < 0.0 else 0.0)) * (columns - 1)
    above, left = min(int(y), rows - 2), min(int(x), max(columns - 2, 0))
    right = min(left + 1, columns - 1)
    upper, lower = first + above * columns, first + (above + 1) * columns
    t, s = y - above, x - left
    pool: F32_1D = shapes.pool
    top = (1.0 - s) * pool[upper + left] + s * pool[upper + right]
    bottom = (1.0 - s) * pool[lower + left] + s * pool[lower + right]
    return (1.0 - t) * top + t * bottom


@inlined
def _texel(shapes: ShapeTable, which: int, level: int, s: float, t: float) -> Vec:
    """The texel of a picture at (s, t), 0 .. 1 from column 0 and row 0; of the finest level where there is none so
    fine."""
    level = min(level, shapes.picture[which, 1])
    side = 1 << level
    x, y = min(int(s * side), side - 1), min(int(t * side), side - 1)
    at = shapes.picture[which, 0] + 3 * (((1 << (2 * level)) - 1) // 3 + max(y, 0) * side + max(x, 0))
    return (float(shapes.pool[at]), float(shapes.pool[at + 1]), float(shapes.pool[at + 2]))
