"""Light that glass has bent or mirrored onto opaque surfaces: irradiance in sparse texels of the world.

Photons (`transport.photons`) end on opaque surfaces. Each leaves its flux in texels of a grid that is looked at along
an axis of the world, the one that the surface faces most; so a texel is a square on that side of things, and a surface
in space has texels without being unwrapped. They are kept in a hash table: key (level, axis and sign, layer, column,
row). What arrives at a place is the flux around it over the area of the texels on the surface.

A photon's flux is spread over as many texels as there are few photons around it: where light is focused the texels are
fine, and elsewhere they are large and quiet (a sample-point estimator: Silverman, "Density Estimation", 1986, 5.3).
Every photon is counted once and with all of its flux, so energy is kept whatever the sizes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..kernels.arrays import F32_1D, F32_2D, F64_1D, F64_2D, I32_1D, I64_1D
from ..kernels.compile import inlined, kernel
from ..kernels.vec import Vec, along, dot, length, row
from ..scene import F32
from .environment import TEXEL_LUMINANCE
from .hashing import EMPTY, claim, is_full, slot_of

LEVELS = 12
"""Sizes of texels, each half of the one before."""
_MARK = 15
"""Level of the keys of marks."""
_AXIS_SHARE = 0.4
"""Cosine to an axis from which on a photon is written for those who look along it, and a place looks along it; of three
one always has .57."""
_COLUMNS = 19
"""Bits of a column's or row's number, of which 21 bits are left to a layer, a side and a level."""
_LAYERS = 16
_FLAT, _BENT = 0.99, 0.95
"""Length of the mean of unit normals below which a texel is large for what it lies on: that bends, or has an edge. And
below which it turns."""
_UNEVEN, _EVEN = 3.0, 4.0
"""How many times as much as by chance the light of nine texels varies where it is not even; and how many times as many
photons a texel has to have before its light is looked at closer where it is."""
_FILTER = np.array([0.25, 0.5, 0.25])


class Caustics(NamedTuple):
    """A hash table of texels, of H slots, a power of two."""

    keys: I64_1D
    """shape (H,); -1 where a slot is free"""
    flux: F32_2D
    """shape (H, 3) [radiance * sr * m^2]"""
    marks: I32_1D
    """shape (H,): of a largest texel, the levels that a place in it has to look at, a bit for each"""
    texel: F64_1D
    """shape (K,): their sizes [m], the largest first; none where there are no caustics"""
    low: F64_1D
    """shape (3,): bounds of all texels [m]"""
    high: F64_1D


def no_caustics() -> Caustics:
    """A table without any light."""
    return new_caustics(1, np.zeros(0))


def new_caustics(slots: int, texel: F64_1D) -> Caustics:
    """An empty table. `slots`: a power of two."""
    flux: F32 = np.zeros((slots, 3), np.float32)
    keys, marks = np.full(slots, EMPTY, np.int64), np.zeros(slots, np.int32)
    return Caustics(keys, flux, marks, texel, np.full(3, math.inf), np.full(3, -math.inf))


class Landings(NamedTuple):
    """Where photons have ended: as many rows as there was room for."""

    point: F64_2D
    """[m]"""
    normal: F64_2D
    """unit geometric normal, on the side that it came from"""
    flux: F64_2D
    """[radiance * sr * m^2]"""
    part: I32_1D
    """of the glass that it came by first"""
    kind: I32_1D
    """0 from a lamp, 1 from the sky"""


class Tally(NamedTuple):
    """What has come to the texels of one level, kind by kind: a hash table as `Caustics` is."""

    keys: I64_1D
    light: F32_1D
    """shape (H,): sum of luminances of flux; the next of their squares"""
    squares: F32_1D
    number: F32_1D
    """of photons"""
    normal: F32_2D
    """shape (H, 3): sum of theirs"""


def new_tally(slots: int) -> Tally:
    """An empty one. `slots`: a power of two."""
    light, squares, number = (np.zeros(slots, np.float32) for _ in range(3))
    return Tally(np.full(slots, EMPTY, np.int64), light, squares, number, np.zeros((slots, 3), np.float32))


# --- addresses ----------------------------------------------------------------------------------------------------


@inlined
def _coordinates(p: Vec, axis: int, texel: float) -> tuple[float, float, float]:
    """Column, row and layer of a place as it is seen along an axis, not rounded; a layer is two texels thick."""
    u = p[1] if axis == 0 else p[0]
    v = p[1] if axis == 2 else p[2]
    return u / texel, v / texel, p[axis] / (2.0 * texel)


@inlined
def _key(level: int, side: int, column: int, line: int, layer: int) -> int:
    """`side`: an axis and a sign, 0 .. 5, and perhaps a kind of photon, above. Numbers run around after some 500,000
    texels."""
    most, layers = (1 << _COLUMNS) - 1, (1 << _LAYERS) - 1
    head = np.int64(level) * 16 + side
    return int(((head << _LAYERS | (layer & layers)) << _COLUMNS | (column & most)) << _COLUMNS | (line & most))


@inlined
def _main_axis(n: Vec) -> int:
    x, y, z = abs(n[0]), abs(n[1]), abs(n[2])
    return 0 if x >= y and x >= z else (1 if y >= z else 2)


@inlined
def _side_of(n: Vec, axis: int) -> int:
    return 2 * axis + (1 if n[axis] > 0.0 else 0)


# --- writing ------------------------------------------------------------------------------------------------------


@kernel
def count_photons(tally: Tally, landings: Landings, texel: float, levels: I32_1D, level: int) -> bool:
    """Sum up the photons that have come to a level in its texels. False if the table became too full.

    Args:
        texel: size of the level's texels [m].
        levels: shape (N,): where photons have come to.
    """
    filled = 0
    for k in range(landings.part.shape[0]):
        if levels[k] != level:
            continue
        n = row(landings.normal, k)
        axis = _main_axis(n)
        u, v, w = _coordinates(row(landings.point, k), axis, texel)
        side = _side_of(n, axis) + 8 * landings.kind[k]
        slot, new = claim(tally.keys, _key(level, side, math.floor(u), math.floor(v), math.floor(w)))
        filled += new
        if is_full(tally.keys, filled):
            return False
        light = dot(row(landings.flux, k), TEXEL_LUMINANCE)
        tally.light[slot] += light
        tally.squares[slot] += light * light
        tally.number[slot] += 1.0
        for c in range(3):
            tally.normal[slot, c] += n[c]
    return True


@kernel
def raise_levels(
    tally: Tally, landings: Landings, texel: float, finest: I32_1D, wanted: float, levels: I32_1D, level: int
) -> int:
    """Let photons of a level go on to the next, whose texels are a quarter as large, where these have `wanted` of them:
    as many of equal flux as would be as even (Kish, "Survey Sampling", 1965: the effective size of a sample). On
    what bends inside of a texel a quarter is enough, or a sixteenth: noise is better than light that has gone astray.
    Where the light of a texel and of those around it varies by no more than what chance makes of so many photons, a
    closer look would show that chance, so there have to be more of them.

    Args:
        tally: of `count_photons`; those of another kind are not counted.
        finest: shape (N,): levels that they may not go beyond.

    Returns:
        How many went on.
    """
    went = 0
    for k in range(landings.part.shape[0]):
        if levels[k] != level or finest[k] <= level:
            continue
        n = row(landings.normal, k)
        axis = _main_axis(n)
        u, v, w = _coordinates(row(landings.point, k), axis, texel)
        side = _side_of(n, axis) + 8 * landings.kind[k]
        column, line, layer = math.floor(u), math.floor(v), math.floor(w)
        light = squares = number = 0.0
        total = total2 = by_chance = 0.0
        mean = (0.0, 0.0, 0.0)
        for i in range(-1, 2):
            for j in range(-1, 2):
                slot = slot_of(tally.keys, _key(level, side, column + i, line + j, layer))
                share = _FILTER[i + 1] * _FILTER[j + 1]
                light += share * tally.light[slot]
                squares += share * tally.squares[slot]
                number += share * tally.number[slot]
                mean = along(mean, row(tally.normal, slot), share)
                total += tally.light[slot]
                total2 += tally.light[slot] * tally.light[slot]
                by_chance += tally.squares[slot]
        enough, one_way = 4.0 * wanted, length(mean)
        if one_way < _FLAT * number:
            enough = wanted if one_way >= _BENT * number else 0.25 * wanted
        # The sum of a number of fluxes, itself by chance (Poisson), varies by the sum of their squares.
        if total2 - total * total / 9.0 < _UNEVEN * 8.0 / 9.0 * by_chance:
            enough *= _EVEN
        if light * light >= enough * squares:
            levels[k] = level + 1
            went += 1
    return went


@kernel
def add_photons(table: Caustics, landings: Landings, levels: I32_1D) -> bool:
    """Write photons into a table. False if it became too full."""
    filled = 0
    for k in range(landings.part.shape[0]):
        n, p = row(landings.normal, k), row(landings.point, k)
        texel = table.texel[levels[k]]
        for axis in range(3):
            table.low[axis] = min(table.low[axis], p[axis] - 3.0 * texel)
            table.high[axis] = max(table.high[axis], p[axis] + 3.0 * texel)
            if abs(n[axis]) < _AXIS_SHARE:
                continue
            u, v, w = _coordinates(p, axis, texel)
            column, line = math.floor(u - 0.5), math.floor(v - 0.5)
            s, t = u - 0.5 - column, v - 0.5 - line
            for corner in range(4):
                i, j = corner % 2, corner // 2
                share = (s if i else 1.0 - s) * (t if j else 1.0 - t)
                key = _key(levels[k], _side_of(n, axis), column + i, line + j, math.floor(w))
                slot, new = claim(table.keys, key)
                if new != 0:
                    filled += 1 + _mark(table, column + i, line + j, w, _side_of(n, axis), levels[k])
                    if is_full(table.keys, filled):
                        return False
                for c in range(3):
                    table.flux[slot, c] += share * landings.flux[k, c]
    return True


@inlined
def _mark(table: Caustics, column: int, line: int, w: float, side: int, level: int) -> int:
    """Note in the largest texels that whoever looks at a place near this new texel has to look at its level. Returns
    how many are new."""
    share = table.texel[level] / table.texel[0]
    u, v, w = (column + 0.5) * share, (line + 0.5) * share, (math.floor(w) + 0.5) * share
    reach = 2.0 * share  # of the filter
    marked = 0
    for i in range(math.floor(u - reach), math.floor(u + reach) + 1):
        for j in range(math.floor(v - reach), math.floor(v + reach) + 1):
            for k in range(math.floor(w - 1.5 * share), math.floor(w + 1.5 * share) + 1):
                slot, new = claim(table.keys, _key(_MARK, side, i, j, k))
                marked += new
                table.marks[slot] |= 1 << level
    return marked


# --- reading ------------------------------------------------------------------------------------------------------


@inlined
def caustic_irradiance(table: Caustics, p: Vec, n: Vec) -> Vec:
    """Irradiance [radiance * sr] that photons brought to a surface.

    Args:
        p: place on it [m].
        n: its unit geometric normal, on the side that is seen.
    """
    light = (0.0, 0.0, 0.0)
    if table.texel.shape[0] == 0 or not _within(table, p):
        return light
    total = 0.0
    for axis in range(3):
        total += max(0.0, n[axis] * n[axis] - _AXIS_SHARE * _AXIS_SHARE)
    for axis in range(3):
        share = max(0.0, n[axis] * n[axis] - _AXIS_SHARE * _AXIS_SHARE)
        if share > 0.0:  # seen along several axes it has no seam where one of them takes over
            light = along(light, _seen_along(table, p, n, axis), share / total)
    return light


@inlined
def _seen_along(table: Caustics, p: Vec, n: Vec, axis: int) -> Vec:
    """What the texels say that are looked at along an axis."""
    r = g = b = 0.0
    side = _side_of(n, axis)
    u, v, w = _coordinates(p, axis, table.texel[0])
    mark = slot_of(table.keys, _key(_MARK, side, math.floor(u), math.floor(v), math.floor(w)))
    for level in range(table.texel.shape[0]):
        if (table.marks[mark] >> level) & 1 == 0:
            continue
        texel = table.texel[level]
        u, v, w = _coordinates(p, axis, texel)
        column, line, layer = math.floor(u - 0.5), math.floor(v - 0.5), math.floor(w)
        s, t = u - 0.5 - column, v - 0.5 - line
        scale = abs(n[axis]) / (texel * texel)
        for i in range(4):
            across = _blur(i, s)
            for j in range(4):
                share = scale * across * _blur(j, t)
                for k in range(-1, 2):
                    slot = slot_of(table.keys, _key(level, side, column + i - 1, line + j - 1, layer + k))
                    if table.keys[slot] != EMPTY:
                        r += share * table.flux[slot, 0]
                        g += share * table.flux[slot, 1]
                        b += share * table.flux[slot, 2]
    return (r, g, b)


@inlined
def _blur(i: int, s: float) -> float:
    """Weight of texel `i` of four around a place that lies `s` between the middle two: 1-2-1, interpolated."""
    left = _FILTER[i] if i < 3 else 0.0
    right = _FILTER[i - 1] if i > 0 else 0.0
    return left * (1.0 - s) + right * s


@inlined
def _within(table: Caustics, p: Vec) -> bool:
    x = table.low[0] <= p[0] <= table.high[0]
    return x and table.low[1] <= p[1] <= table.high[1] and table.low[2] <= p[2] <= table.high[2]
