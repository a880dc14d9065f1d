"""Light of what glows: triangles that shine, in a tree whose nodes stand for all below them, and exact spheres.

A row of the light table is one such tree (`LightTable.root`). What arrives of it, if nothing is in the way, is a sum
over a cut through the tree: a node that is far away and nearly flat is a point, one that is not flat has a table of
what it sends in each direction (`world.glow_views`), a triangle that is near is Lambert's polygon. Points for shadow
rays are drawn down the tree by what each side brings (Estevez and Kulla, "Importance Sampling of Many Lights with
Adaptive Tree Splitting", 2018), so that the share of rays that get through is the share of the light that arrives.
`world.emitters` builds the trees.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..kernels.arrays import F32_2D, F64_1D, F64_2D, F64_3D, I32_1D
from ..kernels.compile import inlined
from ..kernels.vec import Vec, add, along, dot, length, normalize, row, scale, sub
from ..optics.lobes import ggx, smith_visibility
from ..scene import Light
from .glow_views import irradiance_from, shown, solid_angle_of
from .polygon import corner, polygon_irradiance

_FAR = 8.0
"""Radii of a node away from which on it is a point: then that is right to half a percent, nearly everywhere."""
_FAR_OF_ROUND = 16.0
"""The same for a node that is not flat."""
FLAT = 0.985
"""Length of the mean of a node's normals from which on it is nearly flat."""
_TILT = 0.3
"""Sine of the angle by which normals of a nearly flat node may differ from their mean, and a bit."""


_PART_OF_LOBE, _PART_OF_WAY = 0.5, 0.35
"""How wide the parts of a highlight are at most [rad], beside the lobe's alpha, and beside how far they are from its
middle."""
_MOST_LEVELS = 6
"""At each of which a triangle is cut into four for that."""


class GlowTree(NamedTuple):
    """Nodes of all trees, each before those below it, the left one right behind it; M of them, and T triangles."""

    node: F64_2D
    """shape (M, 4): middle and radius of a sphere around it [m]"""
    facing: F64_2D
    """shape (M, 3): sum of the triangles' unit normals, times area and weight [m^2]"""
    power: F64_1D
    """shape (M,): sum of areas times weights [m^2]"""
    area: F64_1D
    """shape (M,) [m^2]"""
    right: I32_1D
    """shape (M,): node on the right below it; 0 in a leaf"""
    after: I32_1D
    """shape (M,): the first node that is not below it"""
    triangle: I32_1D
    """shape (M,): that a leaf is; -1 of an empty one"""
    corner: F64_3D
    """shape (T, 3, 3): middle of a triangle, and two axes, as `polygon.corner` has them [m]"""
    table: I32_1D
    """shape (M,): where a node's table begins; -1 of those that have none: flat ones, and small ones far down"""
    tables: F32_2D
    """shape (V, 5): tables, as `glow_views.tables_of` makes them"""


class Glow(NamedTuple):
    """What glows, as lights."""

    lights: tuple[Light, ...]
    roots: tuple[int, ...]
    """node of the tree that each light is; -1 of a sphere"""
    tree: GlowTree


def no_glow() -> GlowTree:
    """Without any tree."""
    numbers, words = np.zeros(0), np.zeros(0, np.int32)
    return GlowTree(
        np.zeros((0, 4)), np.zeros((0, 3)), numbers, numbers, words, words, words, np.zeros((0, 3, 3)), words,
        np.zeros((0, 5), np.float32),
    )  # fmt: skip


@inlined
def _above(height: float, radius: float) -> float:
    """Mean height of what lies within a radius of a height, below the horizon counted as 0."""
    if height >= radius:
        return max(0.0, height)
    if height <= -radius:
        return 0.0
    return (height + radius) * (height + radius) / (4.0 * radius)


@inlined
def glow_irradiance(glow: GlowTree, root: int, p: Vec, n: Vec) -> float:
    """Unoccluded irradiance at `p` on a surface with normal `n`, per radiance that triangles of weight 1 have [sr]."""
    total = 0.0
    i, end = root, glow.after[root]
    while i < end:
        power, radius = glow.power[i], glow.node[i, 3]
        to = sub(row(glow.node, i), p)
        height = dot(to, n)
        if power <= 0.0 or height <= -radius:
            i = glow.after[i]
            continue
        facing = row(glow.facing, i)
        flat = length(facing)
        toward = -dot(facing, to)
        d2 = dot(to, to)
        if flat >= FLAT * power:
            if toward <= -flat * (radius + _TILT * math.sqrt(d2)):  # turned away
                i = glow.after[i]
                continue
            if d2 >= _FAR * _FAR * radius * radius and height >= radius:
                bent = math.sqrt(max(0.0, 1.5 * (1.0 - (flat / power) ** 2)))
                d = math.sqrt(d2)
                total += flat * _above(toward / (flat * d), bent) * height / (d2 * d)
                i = glow.after[i]
                continue
        elif glow.table[i] >= 0 and d2 >= _FAR_OF_ROUND * _FAR_OF_ROUND * radius * radius and height >= radius:
            d = math.sqrt(d2)
            w = scale(to, -1.0 / d)
            total += irradiance_from(shown(glow.tables, glow.table[i], w), w, d, height, n)
            i = glow.after[i]
            continue
        if glow.right[i] == 0:
            if toward > 0.0:
                axes = glow.corner[glow.triangle[i]]
                c = sub(row(axes, 0), p)
                total += polygon_irradiance(c, n, row(axes, 1), row(axes, 2), 3) * power / glow.area[i]
            i = glow.after[i]
        else:
            i += 1
    return total


@inlined
def glow_highlight(glow: GlowTree, root: int, p: Vec, n: Vec, wo: Vec, alpha: float) -> float:
    """Reflected radiance, without Fresnel and shadow, of a GGX surface of width alpha, per radiance that triangles of
    weight 1 have: the lobe, summed over what is small in it. A node counts as a point where the lobe hardly changes
    across it, so in the middle of the lobe it is small beside alpha, and far from there beside its way to the middle.
    """
    n_dot_v = dot(n, wo)
    if n_dot_v <= 0.0:
        return 0.0
    r = sub(scale(n, 2.0 * n_dot_v), wo)
    total = 0.0
    i, end = root, glow.after[root]
    while i < end:
        power, radius = glow.power[i], glow.node[i, 3]
        to = sub(row(glow.node, i), p)
        if power <= 0.0 or dot(to, n) <= -radius:
            i = glow.after[i]
            continue
        facing = row(glow.facing, i)
        flat = length(facing)
        toward = -dot(facing, to)
        d2 = max(dot(to, to), 1e-12)
        d = math.sqrt(d2)
        if glow.right[i] == 0:
            if toward > 0.0:
                total += _gleam_of_triangle(glow, i, p, n, wo, r, alpha)
            i = glow.after[i]
            continue
        if flat >= FLAT * power:
            if toward <= -flat * (radius + _TILT * d):  # turned away
                i = glow.after[i]
                continue
            if d2 >= _FAR * _FAR * radius * radius and radius <= _smallness(scale(to, 1.0 / d), r, alpha) * d:
                bent = math.sqrt(max(0.0, 1.5 * (1.0 - (flat / power) ** 2)))
                solid = flat * _above(toward / (flat * d), bent) / d2
                total += solid * _lobe(scale(to, 1.0 / d), n, wo, n_dot_v, alpha)
                i = glow.after[i]
                continue
        elif glow.table[i] >= 0 and d2 >= _FAR_OF_ROUND * _FAR_OF_ROUND * radius * radius:
            wi = scale(to, 1.0 / d)
            if radius <= _smallness(wi, r, alpha) * d:
                w = scale(wi, -1.0)
                solid = solid_angle_of(shown(glow.tables, glow.table[i], w), w, d)
                total += solid * _lobe(wi, n, wo, n_dot_v, alpha)
                i = glow.after[i]
                continue
        i += 1
    return total


@inlined
def _lobe(wi: Vec, n: Vec, wo: Vec, n_dot_v: float, alpha: float) -> float:
    """Reflected radiance per radiance and solid angle of what lies in a direction [1 / sr], without Fresnel."""
    n_dot_l = dot(n, wi)
    if n_dot_l <= 0.0:
        return 0.0
    h = normalize(add(wi, wo))
    return ggx(dot(n, h), alpha) * smith_visibility(n_dot_v, n_dot_l, alpha) * n_dot_l


@inlined
def _smallness(direction: Vec, r: Vec, alpha: float) -> float:
    """How wide [rad] what lies in a direction may be to count as a point in a lobe about `r`."""
    return max(_PART_OF_LOBE * alpha, _PART_OF_WAY * length(sub(direction, r)))


@inlined
def _gleam_of_triangle(glow: GlowTree, i: int, p: Vec, n: Vec, wo: Vec, r: Vec, alpha: float) -> float:
    """`glow_highlight` of the triangle in a leaf: into four, and those again, until each part is small in the lobe."""
    axes = glow.corner[glow.triangle[i]]
    m, x, y = row(axes, 0), row(axes, 1), row(axes, 2)
    first = corner(m, x, y, 0, 3)
    ab, ac = sub(corner(m, x, y, 1, 3), first), sub(corner(m, x, y, 2, 3), first)
    facing, n_dot_v = row(glow.facing, i), dot(n, wo)
    total = 0.0
    level, digits = 0, 0  # which of the four, two bits for each level
    while level >= 0:
        a, size = sub(first, p), 1.0
        for k in range(level):
            which = (digits >> 2 * (level - 1 - k)) & 3
            half = 0.5 * size
            if which == 1 or which == 3:
                a = along(a, ab, half)
            if which == 2 or which == 3:
                a = along(a, ac, half)
            size = -half if which == 3 else half
        to = along(along(a, ab, size / 3.0), ac, size / 3.0)
        radius, area = abs(size) * glow.node[i, 3], size * size * glow.area[i]
        # What lies on the receiver is no nearer than its own size: it fills no more than the hemisphere.
        d2 = max(dot(to, to), area / (2.0 * math.pi), 1e-12)
        d = math.sqrt(d2)
        wi = scale(to, 1.0 / d)
        if radius > _smallness(wi, r, alpha) * d and level < _MOST_LEVELS:
            level, digits = level + 1, digits << 2
            continue
        total += size * size * -dot(facing, wi) / d2 * _lobe(wi, n, wo, n_dot_v, alpha)
        while level > 0 and digits & 3 == 3:
            level, digits = level - 1, digits >> 2
        level, digits = (level, digits + 1) if level > 0 else (-1, 0)
    return max(0.0, total)


@inlined
def _worth(glow: GlowTree, i: int, p: Vec, n: Vec) -> float:
    """What a node brings, about."""
    power, radius = glow.power[i], glow.node[i, 3]
    if power <= 0.0:
        return 0.0
    to = sub(row(glow.node, i), p)
    facing = row(glow.facing, i)
    d2 = max(dot(to, to), 0.25 * radius * radius)
    d = math.sqrt(d2)
    flat = length(facing)
    # What of its area faces the receiver: of a flat one that much, of a ball a quarter.
    wide = radius if glow.right[i] != 0 else 0.0
    seen = flat * _above(-dot(facing, to) / max(flat, 1e-30), wide) / d + 0.25 * (power - flat)
    return seen * _above(dot(to, n), radius) / d / (d2 + glow.area[i] / math.pi)


@inlined
def _is_even(glow: GlowTree, i: int, p: Vec, n: Vec) -> bool:
    """All that is below a node brings the same per area, about: it is flat, far away and over the horizon."""
    to, radius = sub(row(glow.node, i), p), glow.node[i, 3]
    far = dot(to, to) >= _FAR * _FAR * radius * radius and dot(to, n) >= radius
    return far and length(row(glow.facing, i)) >= FLAT * glow.power[i]


@inlined
def glow_target(glow: GlowTree, root: int, p: Vec, n: Vec, u1: float, u2: float) -> tuple[Vec, float]:
    """A point on what glows [m], drawn by what it brings to a surface at `p` with normal `n`, about; and what the point
    stands for: the solid angle that it makes of all [sr], per radiance that triangles of weight 1 have. `u1`, `u2`:
    0 .. 1."""
    i, chance, even = root, 1.0, False
    while glow.right[i] != 0:
        even = even or _is_even(glow, i, p, n)
        left = right = 0.0
        if not even:
            left, right = _worth(glow, i + 1, p, n), _worth(glow, glow.right[i], p, n)
        if left + right <= 0.0:
            left, right = glow.power[i + 1], glow.power[glow.right[i]]
        share = left / (left + right)
        if u1 < share:
            i, u1, chance = i + 1, u1 / share, chance * share
        else:
            i, u1, chance = glow.right[i], min((u1 - share) / (1.0 - share), 0.9999999), chance * (1.0 - share)
    axes, r = glow.corner[glow.triangle[i]], math.sqrt(u1)
    m, x, y = row(axes, 0), row(axes, 1), row(axes, 2)
    a, b, c = corner(m, x, y, 0, 3), corner(m, x, y, 1, 3), corner(m, x, y, 2, 3)
    point = add(scale(a, 1.0 - r), add(scale(b, r * (1.0 - u2)), scale(c, r * u2)))
    to = sub(point, p)
    d2 = max(dot(to, to), 1e-12)
    return point, max(0.0, -dot(row(glow.facing, i), to)) / (d2 * math.sqrt(d2) * chance)
