"""What a body that glows sends to who is far away, direction by direction.

Near a body one sums over its triangles. From far away it is one thing: how large it shows itself hangs on the direction
alone, and so does the first term of what its depth changes about that. Both are kept in a table over the octahedron
(Engelhardt and Dachsbacher, "Octahedron Environment Maps", VMV 2008), one for each node of the tree that is not flat.

With elements of area a (times weight), normal n and place x beside the node's middle, which are seen where n.w > 0, a
direction w to the receiver, and distance d of the middle:

    P = sum a n.w      X = sum a n.w x      S = sum a n.x

A receiver with normal m, above whose horizon the middle stands h high, gets sum a n.(d w - x) (h + m.x) / |d w - x|^4,
and the body covers the solid angle sum a n.(d w - x) / |d w - x|^3. To the first order in x / d these are
(P h + m.X) / d^3 + h (4 w.X - S) / d^4 and P / d^2 + (3 w.X - S) / d^3. Of a ball both terms of the first order of the
irradiance cancel, as they must.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from ..kernels.arrays import F32_2D
from ..kernels.compile import inlined
from ..kernels.vec import Vec, dot
from ..scene import F32, F64

_HALF = 10
"""Cells along each quarter of a table, whose side has twice as many."""
_ACROSS = 2 * _HALF + 1
ROWS = _ACROSS * _ACROSS
"""Of `GlowTree.tables` that each table has."""


class Shown(NamedTuple):
    """A body as it is seen from one direction."""

    size: float
    """P [m^2], times the weights of its triangles; so are the next"""
    place: Vec
    """X [m^3]"""
    depth: float
    """S [m^3]"""


@cache
def _directions() -> F32:
    """Shape (ROWS, 3): the directions of a table's rows, places on the octahedron. They are not unit: P and X are in
    proportion to the length of w, so between the rows they are linear in the place wherever no triangle comes into
    sight."""
    x, y = np.meshgrid(*[np.arange(_ACROSS) / _HALF - 1.0] * 2)
    z = 1.0 - np.abs(x) - np.abs(y)
    under = z < 0.0
    folded = [np.where(under, (1.0 - np.abs(b)) * np.where(a < 0.0, -1.0, 1.0), a) for a, b in ((x, y), (y, x))]
    return np.stack([*folded, z], axis=-1).reshape(-1, 3).astype(np.float32)


def bodies_of(facing: F64, away: F64) -> F32:
    """What bodies show, direction by direction.

    Args:
        facing: shape (K, T, 3): normals of the triangles of each, times area and weight [m^2].
        away: shape (K, T, 3): their middles, from the middle of each body [m].

    Returns:
        Shape (K, ROWS, 7): place, depth, and the sum of `facing` of the triangles that are seen.
    """
    some = facing.astype(np.float32)
    towards = some @ _directions().T
    seen = np.maximum(towards, 0.0).transpose(0, 2, 1) @ away.astype(np.float32)
    deep = (facing * away).sum(axis=2).astype(np.float32)
    there = (towards > 0.0).astype(np.float32).transpose(0, 2, 1) @ np.concatenate([deep[:, :, None], some], axis=2)
    return np.concatenate([seen, there], axis=2)


def joined(bodies: F32, shift: F64) -> F32:
    """Two by two, neighbours as one body. `shift`: shape (2 K, 3): from the middle of both to that of each [m]."""
    by = shift.astype(np.float32)
    place = bodies[:, :, :3] + _sizes(bodies)[:, :, None] * by[:, None]
    depth = bodies[:, :, 3:4] + bodies[:, :, 4:] @ by[:, :, None]
    both = np.concatenate([place, depth, bodies[:, :, 4:]], axis=2)
    return np.asarray(both.reshape(-1, 2, *both.shape[1:]).sum(axis=1), np.float32)


def tables_of(bodies: F32) -> F32:
    """As `GlowTree.tables`, shape (K * ROWS, 5): size, place and depth."""
    return np.concatenate([_sizes(bodies)[:, :, None], bodies[:, :, :4]], axis=2).reshape(-1, 5)


def _sizes(bodies: F32) -> F32:
    return np.asarray((bodies[:, :, 4:] * _directions()).sum(axis=2), np.float32)


@inlined
def shown(tables: F32_2D, first: int, w: Vec) -> Shown:
    """A body as it is seen from the unit direction `w`; `first`: the first row of its table."""
    total = abs(w[0]) + abs(w[1]) + abs(w[2])
    x, y = abs(w[0]) / total, abs(w[1]) / total
    if w[2] < 0.0:
        x, y = 1.0 - y, 1.0 - x
    column, line = min(int(x * _HALF), _HALF - 1), min(int(y * _HALF), _HALF - 1)
    s, t = x * _HALF - column, y * _HALF - line
    # Cells are cut in two where the octahedron has its edge, beyond which other sides of a box come into sight.
    beyond = s + t > 1.0
    size = px = py = pz = depth = 0.0
    for corner in range(3):
        right = 1 if corner == 1 or (beyond and corner == 0) else 0
        down = 1 if corner == 2 or (beyond and corner == 0) else 0
        share = s if corner == 1 else (t if corner == 2 else 1.0 - s - t)
        if beyond:
            share = 1.0 - t if corner == 1 else (1.0 - s if corner == 2 else s + t - 1.0)
        to_x, to_y = column + right, line + down
        r = first + (_HALF + (-to_y if w[1] < 0.0 else to_y)) * _ACROSS + _HALF + (-to_x if w[0] < 0.0 else to_x)
        size += share * tables[r, 0]
        px, py, pz = px + share * tables[r, 1], py + share * tables[r, 2], pz + share * tables[r, 3]
        depth += share * tables[r, 4]
    return Shown(size * total, (px * total, py * total, pz * total), depth)


@inlined
def irradiance_from(seen: Shown, w: Vec, d: float, height: float, n: Vec) -> float:
    """What comes from a body to a receiver [sr], per radiance that triangles of weight 1 have.

    Args:
        w: unit direction from the body's middle to the receiver; `d`: how far that is [m].
        height: of the body's middle above the receiver's horizon [m].
        n: the receiver's unit normal.
    """
    first = dot(seen.place, n) + height * (4.0 * dot(seen.place, w) - seen.depth) / d
    return max(0.0, seen.size * height + first) / (d * d * d)


@inlined
def solid_angle_of(seen: Shown, w: Vec, d: float) -> float:
    """How large a body is seen [sr], times its weight."""
    return max(0.0, seen.size + (3.0 * dot(seen.place, w) - seen.depth) / d) / (d * d)
