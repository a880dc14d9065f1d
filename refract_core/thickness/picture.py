"""Thickness as a picture in an object's own uv: which texels its triangles cover, and what the others get."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from ..kernels.arrays import F64_2D, F64_3D, I64_1D
from ..kernels.compile import inlined, kernel
from ..kernels.lanes import by_address
from ..scene import F32
from .measure import F64, Index, Places

TILES = 4.0
"""A uv further than so many tiles from 0 .. 1 is taken for garbage."""
OVERLAP = 0.03
"""Part of the covered texels that may stand for several places before a person is told."""

_GUTTER = 4
_PIECE = 1 << 21  # texels looked at together
_INSIDE = 1.0e-4


class Covered(NamedTuple):
    """Texels and the places they stand for, in the order in which triangles cover them."""

    texel: I64_1D
    """shape (N,): row by row from the top"""
    triangle: I64_1D
    """shape (N,)"""
    weights: F64_2D
    """shape (N, 2): barycentric weights of the triangle's second and third corner"""


def is_tiled(uv: F64) -> bool:
    """The uv leaves 0 .. 1, so that its picture repeats."""
    return bool(uv.min() < -_INSIDE or uv.max() > 1.0 + _INSIDE)


def texels(uv: F64, normals: F64, size: int) -> Iterator[tuple[Index, Places]]:
    """The texels whose middle lies in a triangle, and the places they stand for, a few triangles at a time.

    Args:
        uv: shape (T, 3, 2), v upwards.
        normals: shape (T, 3, 3), unit, per triangle corner.
        size: texels on a side.

    Yields:
        Shape (N,): texel numbers, row by row from the top; and the places. A texel may come more than once.
    """
    at = uv * (size, -size) + (-0.5, size - 0.5)  # x to the right, y down, whole numbers in the middle of texels
    tiled = is_tiled(uv)
    counts = np.zeros(len(at), np.int64)
    _count(at, size, tiled, counts)
    ends = np.cumsum(counts)
    first = 0
    while first < len(at):
        before = int(ends[first - 1]) if first else 0
        last = max(int(np.searchsorted(ends, before + _PIECE, side="right")), first + 1)
        count = int(ends[last - 1]) - before
        if count:
            found = Covered(np.zeros(count, np.int64), np.zeros(count, np.int64), np.zeros((count, 2)))
            _list(at, first, last, size, tiled, by_address(found))
            texel, triangle, weights = found
            third = weights[:, 1:]
            corners = normals[triangle]
            mixed = corners[:, 0] * (1.0 - weights[:, :1] - third) + corners[:, 1] * weights[:, :1]
            mixed += corners[:, 2] * third
            mixed /= np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-12)
            yield texel, Places(triangle, weights, mixed)
        first = last


def draw(uv: F64, normals: F64, size: int, thickness: Callable[[Places], F64]) -> tuple[F32, float]:
    """The picture of an object's thickness.

    Args:
        uv, normals, size: as for `texels`.
        thickness: values (N,) at places; NaN where there is none.

    Returns:
        Shape (size, size), row 0 on top; around what is covered lie gutters, so that neither filtering nor mips draw in
        a border. And the part of the covered texels that stand for several places, whose mean they hold.
    """
    total, count = np.zeros(size * size), np.zeros(size * size)
    for texel, places in texels(uv, normals, size):
        values = thickness(places)
        known = np.isfinite(values)
        total += np.bincount(texel[known], values[known], len(total))
        count += np.bincount(texel[known], minlength=len(count))
    covered = count > 0
    overlap = float((count > 1).sum() / max(covered.sum(), 1))
    plane = np.divide(total, count, out=total, where=covered).reshape(size, size)
    weight = covered.reshape(size, size).astype(np.float64)
    for _ in range(_GUTTER):
        plane, weight = _grown(plane, weight, is_tiled(uv))
    return _filled(plane, weight).astype(np.float32), overlap


def _grown(values: F64, weight: F64, tiled: bool) -> tuple[F64, F64]:
    """One ring of texels more: the mean of their known neighbours."""
    total, count = (np.pad(a, 1, mode="wrap") if tiled else np.pad(a, 1) for a in (values * weight, weight))
    total = total[:, :-2] + total[:, 1:-1] + total[:, 2:]
    count = count[:, :-2] + count[:, 1:-1] + count[:, 2:]
    total = total[:-2] + total[1:-1] + total[2:]
    count = count[:-2] + count[1:-1] + count[2:]
    fresh = (weight == 0.0) & (count > 0.0)
    return np.where(fresh, total / np.maximum(count, 1.0), values), np.where(fresh, 1.0, weight)


def _filled(values: F64, weight: F64) -> F64:
    """What is not known yet from ever coarser means (pull-push: Gortler et al., The Lumigraph, SIGGRAPH 1996)."""
    if (weight > 0.0).all() or values.size == 1:
        return values
    height, width = values.shape
    around = ((0, height % 2), (0, width % 2))
    shape = ((height + 1) // 2, 2, (width + 1) // 2, 2)
    count = np.pad(weight, around).reshape(shape).sum(axis=(1, 3))
    total = np.pad(values * weight, around).reshape(shape).sum(axis=(1, 3))
    coarse = _filled(total / np.maximum(count, 1e-300), np.minimum(count, 1.0))
    spread = np.repeat(np.repeat(coarse, 2, axis=0), 2, axis=1)[:height, :width]
    return np.where(weight > 0.0, values, spread)


@inlined
def _edge(at: F64, triangle: int, a: int, b: int, x: float, y: float) -> float:
    """Twice the area between an edge and a point, computed from the same end whichever way the edge is asked for.

    Two triangles that share an edge so get the same number with opposite signs, to the last bit: no texel on their
    seam is lost or counted twice by rounding.
    """
    ax, ay = at[triangle, a, 0], at[triangle, a, 1]
    bx, by = at[triangle, b, 0], at[triangle, b, 1]
    if ax < bx or (ax == bx and ay < by):
        return (bx - ax) * (y - ay) - (by - ay) * (x - ax)
    return -((ax - bx) * (y - by) - (ay - by) * (x - bx))


@inlined
def _owns(value: float, at: F64, triangle: int, a: int, b: int, sign: float) -> bool:
    """The point is on the inner side of an edge, or on the edge and it is a left or a top one."""
    if value != 0.0:
        return value > 0.0
    dx = sign * (at[triangle, b, 0] - at[triangle, a, 0])
    dy = sign * (at[triangle, b, 1] - at[triangle, a, 1])
    return dy < 0.0 or (dy == 0.0 and dx > 0.0)


@inlined
def _sense(at: F64, t: int) -> float:
    """1 or -1 by the way a triangle turns in the picture (uv may be mirrored); 0 where it has no area."""
    area = _edge(at, t, 0, 1, at[t, 2, 0], at[t, 2, 1])
    if area == 0.0:
        return 0.0
    return 1.0 if area > 0.0 else -1.0


@inlined
def _texels_around(at: F64, t: int, size: int, tiled: bool) -> tuple[int, int, int, int]:
    """First and last column, first and last row of the texels that a triangle may cover."""
    low_x = int(np.ceil(min(at[t, 0, 0], at[t, 1, 0], at[t, 2, 0])))
    high_x = int(np.floor(max(at[t, 0, 0], at[t, 1, 0], at[t, 2, 0])))
    low_y = int(np.ceil(min(at[t, 0, 1], at[t, 1, 1], at[t, 2, 1])))
    high_y = int(np.floor(max(at[t, 0, 1], at[t, 1, 1], at[t, 2, 1])))
    if tiled:
        return low_x, high_x, low_y, high_y
    return max(low_x, 0), min(high_x, size - 1), max(low_y, 0), min(high_y, size - 1)


@inlined
def _areas(at: F64, t: int, sign: float, x: int, y: int) -> tuple[bool, float, float, float]:
    """Whether a triangle covers the middle of a texel, and its barycentric weights there, not yet divided by their
    sum."""
    w0 = sign * _edge(at, t, 1, 2, x, y)
    w1 = sign * _edge(at, t, 2, 0, x, y)
    w2 = sign * _edge(at, t, 0, 1, x, y)
    covers = _owns(w0, at, t, 1, 2, sign) and _owns(w1, at, t, 2, 0, sign) and _owns(w2, at, t, 0, 1, sign)
    return covers, w0, w1, w2


@kernel
def _count(at: F64_3D, size: int, tiled: bool, counts: I64_1D) -> None:
    """How many texels each triangle covers. `at`: shape (T, 3, 2), whole numbers in the middle of texels."""
    for t in range(len(at)):
        sign = _sense(at, t)
        if sign == 0.0:
            continue
        low_x, high_x, low_y, high_y = _texels_around(at, t, size, tiled)
        for y in range(low_y, high_y + 1):
            for x in range(low_x, high_x + 1):
                if _areas(at, t, sign, x, y)[0]:
                    counts[t] += 1


@kernel
def _list(at: F64_3D, first: int, last: int, size: int, tiled: bool, found: Covered) -> None:
    """Write down the texels of triangles `first` .. `last`; `found` has room for as many as `_count` says."""
    filled = 0
    for t in range(first, last):
        sign = _sense(at, t)
        if sign == 0.0:
            continue
        low_x, high_x, low_y, high_y = _texels_around(at, t, size, tiled)
        for y in range(low_y, high_y + 1):
            for x in range(low_x, high_x + 1):
                covers, w0, w1, w2 = _areas(at, t, sign, x, y)
                if not covers:
                    continue
                found.texel[filled] = (y % size) * size + x % size
                found.triangle[filled] = t
                found.weights[filled, 0] = w1 / (w0 + w1 + w2)
                found.weights[filled, 1] = w2 / (w0 + w1 + w2)
                filled += 1
