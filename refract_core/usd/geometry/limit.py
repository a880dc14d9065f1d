"""Where the points of a subdivision surface end after endless steps, and the normals there, in closed form.

Positions and tangents are the left eigenvectors of a step around a point: Halstead, Kass and DeRose (SIGGRAPH 1993) for
Catmull-Clark, Hoppe et al. (SIGGRAPH 1994) for Loop, and the same analysis of half a ring for boundaries and creases.
A point whose creases are sharp for some steps yet takes these steps first, on its ring alone, which is all that a step
needs. Where an endless crease ends the eigenvectors are found by steps, and normals at corners too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...scene import F64
from .subdivision import INFINITE, Flags, Level, Scheme, loop_beta, worn
from .triangulate import Index

_STEPS = 24
"""Steps at corners, until float32 no longer tells the difference."""
_ENDLESS = 400
"""Steps of weights, which have no rounding to lose."""
_WIDE = 64
"""Faces at a point beyond which one crease among its edges is overlooked, as the weights would be a large matrix."""


class _Rings(NamedTuple):
    """Points of one number of faces with what is around them, counter-clockwise."""

    closed: bool
    corners: Index
    """shape (N, k): the corner of each face at the point"""
    centre: F64
    """shape (N, D)"""
    spokes: F64
    """shape (N, m, D): the other ends of the edges; m = k, or k + 1 where open"""
    across: F64
    """shape (N, k, D): the opposite corners of the faces, Catmull-Clark; else shape (N, 0, D)"""
    sharp: F64
    """shape (N, m): of the edges"""
    pinned: F64
    """shape (N,): sharpness of the point"""

    def only(self, rows: Flags | Index) -> _Rings:
        return _Rings(
            self.closed, self.corners[rows], self.centre[rows], self.spokes[rows], self.across[rows], self.sharp[rows],
            self.pinned[rows],
        )  # fmt: skip


def limit(level: Level, values: F64) -> F64:
    """Values of points, shape (V, D), at the limit. Faces are quads (Catmull-Clark) or triangles (Loop)."""
    return _limit(level, values, None)


def limit_surface(level: Level, values: F64) -> tuple[F64, F64]:
    """The same of values whose first three columns are positions, and unit normals per face corner, shape (C, 3).

    Normals are of the side of a crease that the corner is on; (0, 0, 0) where there is none.
    """
    normals = np.zeros((len(level.vertices), 3))
    return _limit(level, values, normals), normals


def _limit(level: Level, values: F64, normals: F64 | None) -> F64:
    found = values.copy()
    around = level.fans
    kinds = 2 * around.sizes + around.closed
    for kind in np.unique(kinds).tolist():
        some = np.flatnonzero(kinds == kind)
        points = around.points[some]
        rings = _rings(level, values, around.starts[some], around.after, kind // 2, bool(kind % 2))
        while len(points):
            soft = ((rings.sharp > 0.0) & (rings.sharp < INFINITE)).any(axis=1)
            soft |= (rings.pinned > 0.0) & (rings.pinned < INFINITE)
            creases = (rings.sharp > 0.0).sum(axis=1)
            free = rings.pinned <= 0.0
            for rows, one in (
                (free & (creases == 0), _smooth),
                (free & (creases == 1), _ended),
                (free & (creases == 2), _creased),
                (~free | (creases > 2), _pointed),
            ):
                ready = rows & ~soft
                if ready.any():
                    found[points[ready]] = one(level.scheme, rings.only(ready), normals)
            points = points[soft]
            if len(points):
                rings = _step(level.scheme, rings.only(soft))
    return found


def _rings(level: Level, values: F64, starts: Index, after: Index, size: int, closed: bool) -> _Rings:
    corners = np.empty((len(starts), size), np.int64)
    at = starts
    for place in range(size):
        corners[:, place] = at
        at = after[at]
    following = level.following[corners]
    spokes, edges = level.vertices[following], level.edge[corners]
    if not closed:
        last = level.preceding[corners[:, -1:]]
        spokes = np.concatenate((spokes, level.vertices[last]), axis=1)
        edges = np.concatenate((edges, level.edge[last]), axis=1)
    quads = level.scheme is Scheme.CATMULL_CLARK
    across = values[level.vertices[level.following[following]]] if quads else values[corners[:, :0]]
    centre = level.vertices[starts]
    return _Rings(
        closed, corners, values[centre], values[spokes], across, level.edge_sharpness[edges], level.sharpness[centre]
    )


def _smooth(scheme: Scheme, rings: _Rings, normals: F64 | None) -> F64:
    """Points inside of smooth surface."""
    n = rings.corners.shape[1]
    turn = 2.0 * np.pi * np.arange(n) / n
    if normals is not None:
        weights = np.stack([_ring_wave(scheme, wave) for wave in (np.cos(turn), np.sin(turn))])
        along = weights[:, 1 : n + 1] @ rings.spokes[..., :3]
        if scheme is Scheme.CATMULL_CLARK:
            along += weights[:, n + 1 :] @ rings.across[..., :3]
        normals[rings.corners] = _unit(np.cross(along[:, 0], along[:, 1]))[:, None]
    if scheme is Scheme.CATMULL_CLARK:
        total = n * n * rings.centre + 4.0 * rings.spokes.sum(axis=1) + rings.across.sum(axis=1)
        return total / (n * (n + 5.0))
    share = 1.0 / (n + 0.375 / float(loop_beta(np.array([float(n)]))[0]))
    return (1.0 - n * share) * rings.centre + share * rings.spokes.sum(axis=1)


def _creased(scheme: Scheme, rings: _Rings, normals: F64 | None) -> F64:
    """Points along an endless crease, or on a boundary: a cubic B-spline, with a surface on one side or on both."""
    n = rings.corners.shape[1]
    sides = np.nonzero(rings.sharp > 0.0)[1].reshape(-1, 2)
    rows = np.arange(len(sides))
    ends = rings.spokes[rows, sides[:, 0]] + rings.spokes[rows, sides[:, 1]]
    if normals is not None and not rings.closed:
        normals[rings.corners] = _beside_crease(scheme, rings.centre, rings.spokes, rings.across)[:, None]
    if normals is not None and rings.closed:
        for span in np.unique(sides[:, 1] - sides[:, 0]).tolist():
            some = rings.only(sides[:, 1] - sides[:, 0] == span)
            begin = sides[sides[:, 1] - sides[:, 0] == span, 0]
            order = (begin[:, None] + np.arange(n + 1)) % n
            spokes = np.take_along_axis(some.spokes, order[:, :, None], axis=1)
            corners = np.take_along_axis(some.corners, order[:, :n], axis=1)
            across = some.across
            if across.shape[1]:
                across = np.take_along_axis(across, order[:, :n, None], axis=1)
            for low, high in ((0, span), (span, n)):
                beside = _beside_crease(scheme, some.centre, spokes[:, low : high + 1], across[:, low:high])
                normals[corners[:, low:high]] = beside[:, None]
    return (4.0 * rings.centre + ends) / 6.0


def _beside_crease(scheme: Scheme, centre: F64, spokes: F64, across: F64) -> F64:
    """Unit normals of one side of a crease, shape (N, 3), whose first and last spokes it runs along."""
    v, e, f = centre[:, :3], spokes[..., :3], across[..., :3]
    n = e.shape[1] - 1
    along = e[:, 0] - e[:, -1]
    if n == 1:  # the last eigenvalue is double, and its only vector is the curve's own bend
        inwards = e[:, 0] + e[:, 1] - 2.0 * v
        straight = (inwards**2).sum(axis=1) <= 1e-12 * (along**2).sum(axis=1)
        corner = f[:, 0] if scheme is Scheme.CATMULL_CLARK else e[:, 0]
        inwards = np.where(straight[:, None], corner - v, inwards)
    else:
        at_centre, at_ends, inner = _from_crease(scheme, n)
        turn = np.sin(np.pi * np.arange(n + 1) / n)
        inwards = at_centre * v + at_ends * (e[:, 0] + e[:, -1])
        inwards += inner * np.einsum("i,nid->nd", turn[1:-1], e[:, 1:-1])
        if scheme is Scheme.CATMULL_CLARK:
            inwards += np.einsum("i,nid->nd", turn[:-1] + turn[1:], f)
    return _unit(np.cross(along, inwards))


def _from_crease(scheme: Scheme, n: int) -> tuple[float, float, float]:
    """Weights of the derivative away from a crease with `n` > 1 faces on that side: of the point, of both ends of the
    crease, and of spoke i before the factor sin(i pi / n); opposite corners have sin(i pi / n) + sin((i + 1) pi / n).

    The left eigenvector of a step with the rules for creases: what it has on the spokes and opposite corners is that of
    a whole ring, and the rest follows from two linear equations, of the column of the point and of that of an end.
    """
    c, s, total = np.cos(np.pi / n), np.sin(np.pi / n), 1.0 / np.tan(0.5 * np.pi / n)
    if scheme is Scheme.CATMULL_CLARK:
        value = (5.0 + c + np.sqrt((9.0 + c) * (1.0 + c))) / 16.0
        inner = 16.0 * value - 4.0
        of_end, of_point = s * value, total * (0.375 * inner + 0.5)
    else:
        value, inner = 0.375 + 0.25 * c, 1.0
        of_end, of_point = 0.125 * s, 0.375 * total
    # (value - 1/2) ends - centre / 8 = of_end and -ends + (value - 3/4) centre = of_point
    determinant = (value - 0.5) * (value - 0.75) - 0.125
    ends = (of_end * (value - 0.75) + 0.125 * of_point) / determinant
    centre = ((value - 0.5) * of_point + of_end) / determinant
    return centre, ends, inner


def _ended(scheme: Scheme, rings: _Rings, normals: F64 | None) -> F64:
    """Points inside of a surface where an endless crease ends. A step is its own mirror picture in the crease: what is
    odd there does not know of it; of what is even, steps without end leave one combination."""
    n = rings.corners.shape[1]
    if n > _WIDE:
        return _smooth(scheme, rings, normals)
    begin = np.argmax(rings.sharp > 0.0, axis=1)
    order = (begin[:, None] + np.arange(n)) % n
    spokes = np.take_along_axis(rings.spokes, order[:, :, None], axis=1)
    across = rings.across
    if across.shape[1]:
        across = np.take_along_axis(across, order[:, :, None], axis=1)
    ring = np.concatenate((rings.centre[:, None], spokes, across), axis=1)
    step = _matrix(scheme, n)
    turn = 2.0 * np.pi * np.arange(n) / n
    even, odd = (_ring_wave(scheme, wave(turn)) for wave in (np.cos, np.sin))
    stays = np.eye(len(step))[0]
    for _ in range(_ENDLESS):
        stays = stays @ step
    for _ in range(_ENDLESS):
        even = (even - even.sum() * stays) @ step  # rounding brings back a little of what stays, and that would win
        even /= np.abs(even).max()
    if normals is not None:
        tangents = np.cross(np.einsum("i,nid->nd", even, ring[..., :3]), np.einsum("i,nid->nd", odd, ring[..., :3]))
        normals[rings.corners] = _unit(tangents)[:, None]
    return np.einsum("i,nid->nd", stays, ring)


def _ring_wave(scheme: Scheme, wave: F64) -> F64:
    """The tangent of a smooth point that goes with a wave around it, as weights of point, spokes, opposite corners."""
    n = len(wave)
    if scheme is Scheme.LOOP:
        return np.concatenate(([0.0], wave))
    return np.concatenate(([0.0], _spoke_weight(n) * wave, wave + np.roll(wave, -1)))


def _spoke_weight(n: int) -> float:
    """Weight of a spoke in the tangents of a smooth point with `n` faces, against that of an opposite corner."""
    c = np.cos(2.0 * np.pi / n)
    return float(1.0 + c + np.cos(np.pi / n) * np.sqrt(2.0 * (9.0 + c)))


def _matrix(scheme: Scheme, n: int) -> F64:
    """One step of a ring whose first spoke is an endless crease: point, spokes, opposite corners."""
    size = 1 + n + (n if scheme is Scheme.CATMULL_CLARK else 0)
    unit = np.eye(size)[None]
    sharp = np.zeros((1, n))
    sharp[0, 0] = INFINITE
    ring = _Rings(
        True, np.zeros((1, n), np.int64), unit[:, 0], unit[:, 1 : n + 1], unit[:, n + 1 :], sharp, np.zeros(1)
    )
    done = _step(scheme, ring)
    return np.concatenate((done.centre, done.spokes[0], done.across[0]))


def _pointed(scheme: Scheme, rings: _Rings, normals: F64 | None) -> F64:
    """Corners, which stay where they are. Faces between two creases share their normal; those of a cone have each its
    own."""
    if normals is None:
        return rings.centre
    n = rings.corners.shape[1]
    at = rings.centre  # a step moves with its points, so near to 0 it loses nothing
    near = rings._replace(
        centre=np.zeros_like(at), spokes=rings.spokes - at[:, None], across=rings.across - at[:, None]
    )
    for _ in range(_STEPS):
        near = _step(scheme, near)
    spokes = near.spokes[..., :3]
    flat = _unit(np.cross(spokes[:, np.arange(n)], spokes[:, (np.arange(n) + 1) % spokes.shape[1]]))
    sharp = rings.sharp[:, :n] > 0.0
    part: Index = np.cumsum(sharp, axis=1, dtype=np.int64)
    if rings.closed:
        part %= np.maximum(sharp.sum(axis=1, keepdims=True), 1)
    part[~sharp.any(axis=1)] = np.arange(n)
    place = (np.arange(len(part))[:, None] * (n + 1) + part).ravel()
    total = np.zeros((len(part) * (n + 1), 3))
    for axis in range(3):
        total[:, axis] = np.bincount(place, flat[..., axis].ravel(), len(total))
    normals[rings.corners] = _unit(total)[place].reshape(flat.shape)
    return rings.centre


def _step(scheme: Scheme, rings: _Rings) -> _Rings:
    """One step of the point and its ring, by the rules of `subdivision.refine`."""
    v, e, f = rings.centre[:, None], rings.spokes, rings.across
    n = rings.corners.shape[1]
    edges = e.shape[1]
    here, there = np.arange(n), (np.arange(n) + 1) % edges
    if scheme is Scheme.CATMULL_CLARK:
        inner = 0.25 * (v + f + e[:, here] + e[:, there])
        left, right = inner[:, np.arange(edges) % n], inner[:, np.arange(edges) - 1]
        smooth = 0.25 * (v + e + left + right)
        total = e.sum(axis=1) + inner.sum(axis=1)
        keep, take = (n - 2.0) / n, 1.0 / (n * n)
    else:
        inner = f
        smooth = 0.375 * (v + e) + 0.125 * (e[:, (np.arange(edges) + 1) % edges] + e[:, np.arange(edges) - 1])
        total = e.sum(axis=1)
        take = float(loop_beta(np.array([float(n)]))[0])
        keep = 1.0 - n * take
    middle = 0.5 * (v + e)
    sharp, pinned = worn(rings.sharp), worn(rings.pinned)
    spokes = smooth + np.minimum(rings.sharp, 1.0)[..., None] * (middle - smooth)
    going = (rings.sharp > 0.0) & (sharp <= 0.0)
    point_goes = (rings.pinned > 0.0) & (pinned <= 0.0)
    rest = np.where(going, rings.sharp, 0.0).sum(axis=1) + np.where(point_goes, rings.pinned, 0.0)
    goes = going.sum(axis=1) + point_goes
    weight = np.where(goes > 0, np.minimum(rest / np.maximum(goes, 1), 1.0), 1.0)[:, None]
    by_smooth = keep * rings.centre + take * total
    now = _by_kind(rings, rings.sharp > 0.0, rings.pinned, by_smooth)
    later = _by_kind(rings, sharp > 0.0, pinned, by_smooth)
    return _Rings(rings.closed, rings.corners, weight * now + (1.0 - weight) * later, spokes, inner, sharp, pinned)


def _by_kind(rings: _Rings, sharp: Flags, pinned: F64, smooth: F64) -> F64:
    """Where the point goes by the rule for its number of sharp edges."""
    creases = sharp.sum(axis=1)
    ends = np.einsum("ni,nid->nd", sharp.astype(np.float64), rings.spokes)
    crease = 0.75 * rings.centre + 0.125 * ends
    fixed = (pinned > 0.0) | (creases > 2)
    kept = np.where((creases == 2)[:, None], crease, smooth)
    return np.where(fixed[:, None], rings.centre, kept)


def _unit(vectors: F64) -> F64:
    length = np.sqrt((vectors**2).sum(axis=-1, keepdims=True))
    return vectors / np.where(length > 0.0, length, np.inf)
