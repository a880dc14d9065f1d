"""Polygons to triangles, whether they close a volume, and smooth vertex normals: numpy only, no USD."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from ...scene import F32, F64

Index = NDArray[np.int64]
Scalar = TypeVar("Scalar", bound=np.generic)

# A polygon with more vertices than this is not asked for a fan from every one of its vertices.
MAX_FAN_STARTS = 8
# Squared sine under which two edges count as parallel: about the precision of float32 points.
PARALLEL = 1.0e-14
_YZX, _ZXY = np.array([1, 2, 0]), np.array([2, 0, 1])
# Below so many edges a Python set is quicker than numpy.
FEW = 200


class Triangles(NamedTuple):
    """Triangles cut from polygons, in the order of the polygons."""

    corners: Index
    """shape (T, 3): positions in the array of face corners"""
    faces: Index
    """shape (T,): the polygon each triangle is part of"""


def triangulate(points: F32, indices: Index, starts: Index, counts: Index, faces: Index) -> Triangles:
    """Cuts every polygon into triangles that keep its winding; what has no area is left out.

    A polygon that is star-shaped as seen from one of its vertices (every convex one is) becomes a fan from there,
    preferably from its first; any other is cut by ear clipping in the plane of its Newell normal.

    Args:
        points: shape (V, 3)
        indices: shape (C,), point of every corner
        starts: shape (F,), first corner of each polygon
        counts: shape (F,), corners of each polygon, at least 3
        faces: shape (F,), number under which each polygon is reported back, ascending
    """
    if not len(counts):
        return Triangles(np.zeros((0, 3), np.int64), np.zeros(0, np.int64))
    if counts.min() == counts.max():
        return _cut(points, indices, starts[:, None] + np.arange(counts[0]), faces)
    parts = []
    for count in np.unique(counts):
        chosen = np.flatnonzero(counts == count)
        loops = starts[chosen][:, None] + np.arange(count)
        parts.append(_cut(points, indices, loops, faces[chosen]))
    corners = np.concatenate([part.corners for part in parts])
    owners = np.concatenate([part.faces for part in parts])
    order = np.argsort(owners, kind="stable")
    return Triangles(corners[order], owners[order])


def fans(starts: Index, counts: Index) -> tuple[Triangles, tuple[Index, ...]]:
    """Every polygon as a fan from its first corner, in order, and the corners of the polygons of each size."""
    loops, corners, owners = [], [], []
    for count in np.unique(counts):
        chosen = np.flatnonzero(counts == count)
        loops.append(starts[chosen][:, None] + np.arange(count))
        part = _ordered(_fan(loops[-1]), chosen)
        corners.append(part.corners)
        owners.append(part.faces)
    faces = np.concatenate(owners)
    order = np.argsort(faces, kind="stable")
    return Triangles(np.concatenate(corners)[order], faces[order]), tuple(loops)


def fans_fit(points: F32, indices: Index, loops: tuple[Index, ...]) -> bool:
    """Whether `triangulate` would cut all of these polygons as `fans` does, with nothing left out.

    Says so with few calls to numpy, whose overhead is what counts on a small mesh.
    """
    exact = points.astype(np.float64)
    for group in loops:
        around = exact[indices[group]]
        edges = around[:, 1:] - around[:, :1]
        a, b = edges[:, :-1], edges[:, 1:]
        areas = a[..., _YZX] * b[..., _ZXY] - a[..., _ZXY] * b[..., _YZX]
        if group.shape[1] == 3:
            fits = (areas**2).sum(2) > PARALLEL * (a**2).sum(2) * (b**2).sum(2)
        else:
            normal = areas.sum(1)
            fits = np.einsum("ftk,fk->ft", areas, normal) > 1.0e-9 * (normal**2).sum(1)[:, None]
        if not fits.all():
            return False
    return True


def _cut(points: F32, indices: Index, loops: Index, faces: Index) -> Triangles:
    """Polygons of one size, `loops` shape (F, n) of corners."""
    size = loops.shape[1]
    if size == 3:
        return _with_area(points, indices, Triangles(loops, faces))
    fits = _fan_fits(points, indices, loops)
    if fits.all():
        return _ordered(_fan(loops), faces)
    corners = np.zeros((len(loops), size - 2, 3), np.int64)
    corners[fits] = _fan(loops[fits])
    pending = np.flatnonzero(~fits)
    for start in range(1, min(size, MAX_FAN_STARTS)):
        turned = np.roll(loops[pending], -start, axis=1)
        fits = _fan_fits(points, indices, turned)
        corners[pending[fits]] = _fan(turned[fits])
        pending = pending[~fits]
    corners[pending] = _fan(loops[pending])
    keep = np.ones((len(loops), size - 2), bool)
    for row in pending:
        clipped = _clip_ears(points[indices[loops[row]]].astype(np.float64))
        if len(clipped):
            corners[row, : len(clipped)] = loops[row][clipped]
            keep[row, len(clipped) :] = False
    cut = Triangles(corners[keep], np.broadcast_to(faces[:, None], keep.shape)[keep])
    return _with_area(points, indices, cut)


def _with_area(points: F32, indices: Index, cut: Triangles) -> Triangles:
    wide = has_area(points, indices[cut.corners])
    return cut if wide.all() else Triangles(cut.corners[wide], cut.faces[wide])


def _ordered(corners: Index, faces: Index) -> Triangles:
    return Triangles(corners.reshape(-1, 3), np.repeat(faces, corners.shape[1]))


def _fan(loops: Index) -> Index:
    first = np.broadcast_to(loops[:, :1], loops[:, 2:].shape)
    return np.stack((first, loops[:, 1:-1], loops[:, 2:]), axis=2)


def _fan_fits(points: F32, indices: Index, loops: Index) -> NDArray[np.bool_]:
    """Whether every triangle of the fan from the first corner faces the way the polygon does, shape (F,)."""
    around = _coordinates(points, indices[loops])
    around -= around[:, :, :1].copy()
    areas = _cross(around[:, :, 1:-1], around[:, :, 2:])
    normal = [part.sum(axis=1, keepdims=True) for part in areas]
    along = _dot(areas, normal)
    least = 1.0e-9 * _dot(normal, normal)
    fits: NDArray[np.bool_] = np.all(along > least, axis=1)
    return fits


def _clip_ears(around: F64) -> Index:
    """Ear clipping of one polygon, shape (n, 3); gives (m, 3) places in it, m <= n - 2, or none where it is a line."""
    relative = around - around[0]
    normal = np.cross(relative[1:-1], relative[2:]).sum(axis=0)
    length = float(np.linalg.norm(normal))
    if length <= 0.0 or not np.isfinite(length):
        return np.zeros((0, 3), np.int64)
    normal /= length
    u = np.cross(np.eye(3)[np.argmin(np.abs(normal))], normal)
    u /= np.linalg.norm(u)
    flat = np.ascontiguousarray(relative @ np.stack((u, np.cross(normal, u)), axis=1))
    cut = mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], np.uint32)).reshape(-1, 3).astype(np.int64)
    a, b, c = flat[cut[:, 0]], flat[cut[:, 1]], flat[cut[:, 2]]
    backward = (b - a)[:, 0] * (c - a)[:, 1] < (b - a)[:, 1] * (c - a)[:, 0]
    cut[backward] = cut[backward][:, ::-1]
    return cut


def _coordinates(points: F32 | F64, index: Index) -> F64:
    """x, y and z of many points, shape (3, *index.shape): kept apart because numpy is several times faster that way."""
    return np.take(np.ascontiguousarray(points.T, np.float64), index, axis=1)


def _cross(a: Sequence[F64] | F64, b: Sequence[F64] | F64) -> tuple[F64, F64, F64]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _dot(a: Sequence[F64] | F64, b: Sequence[F64] | F64) -> F64:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def has_area(points: F32 | F64, triangles: Index) -> NDArray[np.bool_]:
    """Which triangles (T, 3) are more than a point or a line, shape (T,)."""
    at = _coordinates(points, triangles.T)
    u, v = at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]
    normal = _cross(u, v)
    wide: NDArray[np.bool_] = _dot(normal, normal) > PARALLEL * _dot(u, u) * _dot(v, v)
    return wide


def turned_over(corners: NDArray[Scalar]) -> NDArray[Scalar]:
    """Values per triangle corner, shape (T, 3, ...), with the last two corners of every triangle exchanged."""
    return np.ascontiguousarray(corners[:, [0, 2, 1]])


def is_closed(points: F32, indices: Index, starts: Index, counts: Index) -> bool:
    """Whether every edge of the polygons is shared by exactly two that run along it in opposite directions.

    The diagonals a triangulation adds are shared so by construction, hence it holds of the triangles as well. Points
    of equal position count as one where the indices alone do not close the surface.

    Args:
        points: shape (V, 3)
        indices: shape (C,), point of every corner
        starts: shape (F,), first corner of each polygon
        counts: shape (F,), corners of each polygon
    """
    if not len(counts):
        return False
    owner = np.repeat(np.arange(len(counts)), counts)
    ends = np.cumsum(counts)
    corner = np.arange(len(owner))
    following = corner + 1
    following[ends - 1] = ends - counts
    shift = (starts - (ends - counts))[owner]
    tail, head = indices[corner + shift], indices[following + shift]
    if _paired(tail, head, owner):
        return True
    same = weld(points)
    if int(same.max()) + 1 == len(points):
        return False
    return _paired(same[tail], same[head], owner)


def _paired(tail: Index, head: Index, owner: Index) -> bool:
    """Every directed edge once, and its opposite once. Polygons that collapsed to a line do not count."""
    moving = tail != head
    if not moving.all():
        sides = np.bincount(owner[moving], minlength=int(owner[-1]) + 1)
        moving &= sides[owner] >= 3
        tail, head = tail[moving], head[moving]
    if not len(tail):
        return False
    if len(tail) < FEW:
        edges = list(zip(tail.tolist(), head.tolist(), strict=True))
        known = set(edges)
        return len(known) == len(edges) and all((end, start) in known for start, end in edges)
    forward, backward = (tail << 32) | head, (head << 32) | tail
    # Equal sets have equal sums; a mixed sum that differs saves sorting a mesh that is open.
    if _mixed_sum(forward) != _mixed_sum(backward):
        return False
    forward.sort()
    backward.sort()
    return not (forward[1:] == forward[:-1]).any() and bool(np.array_equal(forward, backward))


def _mixed_sum(keys: Index) -> int:
    mixed = keys.view(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    mixed ^= mixed >> np.uint64(29)
    mixed *= np.uint64(0xBF58476D1CE4E5B9)
    mixed ^= mixed >> np.uint64(32)
    return int(mixed.sum())


def weld(points: F32) -> Index:
    """One number per position: equal for points (V, 3) whose coordinates are equal, shape (V,)."""
    bits = (np.ascontiguousarray(points, np.float32) + np.float32(0.0)).view(np.uint32)  # -0 becomes 0
    high = (bits[:, 0].astype(np.uint64) << np.uint64(32)) | bits[:, 1]
    order = np.lexsort((bits[:, 2], high))
    fresh = np.ones(len(points), bool)
    fresh[1:] = (high[order[1:]] != high[order[:-1]]) | (bits[order[1:], 2] != bits[order[:-1], 2])
    numbers = np.zeros(len(points), np.int64)
    numbers[order] = np.cumsum(fresh) - 1
    return numbers


def smooth_normals(points: F32, triangles: Index) -> F32:
    """Unit vertex normals, shape (V, 3): face normals weighted by the angle at the vertex (Thuermer and Wuethrich,
    JGT 3(1) 1998), so that how a polygon was cut does not show. Zero where no triangle decides."""
    at = _coordinates(points, triangles.T)
    edges = [at[:, (corner + 1) % 3] - at[:, corner] for corner in range(3)]
    normal = _cross(edges[0], edges[1])
    doubled = np.sqrt(_dot(normal, normal))
    scale = 1.0 / np.where(doubled > 0.0, doubled, np.inf)
    total = np.zeros((len(points), 3))
    for corner in range(3):
        weight = np.arctan2(doubled, -_dot(edges[corner], edges[corner - 1])) * scale
        for axis in range(3):
            total[:, axis] += np.bincount(triangles[:, corner], normal[axis] * weight, len(points))
    length = np.sqrt((total**2).sum(axis=1, keepdims=True))
    unit: F32 = (total / np.where(length > 1.0e-12, length, np.inf)).astype(np.float32)
    return unit
