"""Lights that are not even (UsdLux ShapingAPI, a picture on a rectangle): what is left of them, on an average over a
grid of their parts for the light that falls, and at one place for a highlight."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from refract_core.scene import LightKind, Shaping

from .vec import Vec, add, at, clamp, dot, length, mix, mul, scaled, sub, unit, vec

WHITE = (1.0, 1.0, 1.0)


class Place(NamedTuple):
    """A light as a flat shape: corners of a grid are given by two numbers in 0 .. 1."""

    round: bool
    centre: Vec
    x: Vec
    """half of its extent along the first of its axes [m]"""
    y: Vec
    across: Vec
    """unit normal of its far side"""


def is_even(shaping: Shaping) -> bool:
    bent = shaping.cone < math.pi or shaping.focus > 0.0
    return not bent and shaping.profile is None and shaping.picture is None


def mean(shaping: Shaping, kind: LightKind, place: Place, axes: tuple[Vec, Vec, Vec], p: Vec, n: Vec) -> Vec:
    """Over the parts of a light, by what they bring to `p` facing `n`. `axes`: x, y and where it looks."""
    far = length(sub(place.centre, p))
    a, b = length(place.x), length(place.y)
    reach = a if place.round else math.hypot(a, b)
    plain = shaping.focus == 0.0 and shaping.profile is None and shaping.picture is None
    start = shaping.cone * (1.0 - shaping.softness)
    crossed = shaping.cone < math.pi
    if reach < far:
        off = math.acos(clamp(dot(sub(p, place.centre), axes[2]) / far, -1.0, 1.0))
        wide = math.asin(reach / far)
        if off - wide > shaping.cone:
            return (0.0, 0.0, 0.0)
        if plain and off + wide <= start:
            return WHITE
        crossed = crossed and off + wide > start
    finer = 2 if crossed and shaping.cone - start < reach / far else 1
    m, k = finer * _parts(a / far), finer * _parts(b / far)
    if kind is LightKind.CYLINDER:
        k = min(k, 4 * finer)
    if place.round:
        m, k = ((m + 1) // 2, 2 * m) if a > 0.0 and m > 1 else (1, 1)
    if a == 0.0:
        m = 1
    if b == 0.0 and not place.round:
        k = 1
    if shaping.picture is not None:
        m = k = 2 ** math.ceil(math.log2(max(m, k)))
    cell = 0.886 * a / math.sqrt(m * k) if place.round else 0.7 * math.hypot(a / m, b / k)
    total, weights = (0.0, 0.0, 0.0), 0.0
    for i in range(m):
        for j in range(k):
            u, v = (i + 0.5) / m, (j + 0.5) / k
            if place.round:
                s, t = math.sqrt(u) * math.cos(2 * math.pi * v), math.sqrt(u) * math.sin(2 * math.pi * v)
            else:
                s, t = 2.0 * u - 1.0, 2.0 * v - 1.0
            to = sub(at(at(place.centre, place.x, s), place.y, t), p)
            d = unit(to)
            weight = max(0.0, dot(d, n)) * max(0.0, dot(d, place.across)) / dot(to, to)
            share = leaving(shaping, axes, scaled(d, -1.0), cell / far)
            if shaping.picture is not None:
                share = mul(share, _texel(shaping, m, 1.0 - u, 1.0 - v))
            total, weights = add(total, scaled(share, weight)), weights + weight
    return scaled(total, 1.0 / weights) if weights > 0.0 else WHITE


def _parts(half_angle: float) -> int:
    return next((count for limit, count in ((0.04, 1), (0.1, 2), (0.3, 4), (1.0, 8)) if 2.0 * half_angle < limit), 16)


def leaving(shaping: Shaping, axes: tuple[Vec, Vec, Vec], d: Vec, blur: float) -> Vec:
    """In one direction; a cone's edge is the mean over `blur` to either side."""
    cosine = dot(d, axes[2])
    off = math.acos(clamp(cosine, -1.0, 1.0))
    share = _cone(shaping, off, blur)
    if shaping.profile is not None:
        around = math.atan2(dot(d, axes[1]), dot(d, axes[0])) / (2.0 * math.pi) % 1.0
        rows, columns = shaping.profile.shape
        y, x = off / math.pi * (rows - 1), around * (columns - 1)
        j, i = min(int(y), rows - 2), min(int(x), max(columns - 2, 0))
        four = [[float(shaping.profile[j + e, min(i + f, columns - 1)]) for f in (0, 1)] for e in (0, 1)]
        upper, lower = (one[0] + (one[1] - one[0]) * (x - i) for one in four)
        share *= upper + (lower - upper) * (y - j)
    tint = mix(shaping.focus_tint, WHITE, abs(cosine) ** shaping.focus) if shaping.focus > 0.0 else WHITE
    return scaled(tint, share)


def _cone(shaping: Shaping, off: float, blur: float) -> float:
    if shaping.cone >= math.pi:
        return 1.0
    width = max(shaping.cone * shaping.softness, 1e-6)
    start = shaping.cone * (1.0 - shaping.softness)
    if blur <= 0.0:
        x = clamp((off - start) / width)
        return 1.0 - x * x * (3.0 - 2.0 * x)

    def below(x: float) -> float:  # the integral of smoothstep
        return x - 0.5 if x > 1.0 else max(x, 0.0) ** 3 - max(x, 0.0) ** 4 / 2.0

    low, high = (off - blur - start) / width, (off + blur - start) / width
    return 1.0 - (below(high) - below(low)) / (high - low)


def _texel(shaping: Shaping, side: int, s: float, t: float) -> Vec:
    """The mean of a picture over the cell of `side` by `side` in which (s, t) is."""
    assert shaping.picture is not None
    height, width = shaping.picture.shape[:2]
    side = min(side, _finest(shaping))
    i, j = (min(max(int(x * side), 0), side - 1) for x in (s, t))
    across = _overlap(i / side * width, (i + 1) / side * width, width)
    down = _overlap(j / side * height, (j + 1) / side * height, height)
    r, g, b = np.einsum("y,x,yxc->c", down, across, shaping.picture.astype(np.float64))
    return (float(r), float(g), float(b))


def _overlap(low: float, high: float, count: int) -> np.ndarray:
    """Share of each of `count` unit pieces in an interval's length."""
    return np.array([max(0.0, min(high, k + 1.0) - max(low, float(k))) for k in range(count)]) / (high - low)


def _finest(shaping: Shaping) -> int:
    assert shaping.picture is not None
    return int(2 ** math.ceil(math.log2(max(shaping.picture.shape[:2]))))


def mirrored(shaping: Shaping, half: tuple[Vec, Vec], axes: tuple[Vec, Vec, Vec], to: Vec, from_centre: Vec,
             alpha: float, radius: float) -> Vec:  # fmt: skip
    """At the place that a highlight shows, `to` away, as wide as the lobe. `half`: half extents of a rectangle."""
    share = leaving(shaping, axes, scaled(unit(to), -1.0), min(alpha, radius))
    if shaping.picture is None:
        return share
    a, b = length(half[0]), length(half[1])
    s, t = 0.5 - dot(from_centre, axes[0]) / a / 2.0, 0.5 - dot(from_centre, axes[1]) / b / 2.0
    wide = alpha * length(to) / max(a, b)
    finest = math.log2(_finest(shaping))
    level = clamp(-math.log2(wide), 0.0, finest) if wide > 0.0 else finest
    low = int(level)
    tint = _texel(shaping, 2**low, s, t)
    if level > low:
        tint = mix(tint, _texel(shaping, 2 ** (low + 1), s, t), level - low)
    return vec(mul(share, tint))
