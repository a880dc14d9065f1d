"""Subdivision surfaces by the rules of OpenSubdiv, which are USD's: one step finer, for points and for anything else.

Catmull and Clark (Computer-Aided Design 10(6), 1978) for polygons, Loop (thesis, Utah 1987) for triangles; creases and
corners that are sharp for some steps by DeRose, Kass and Truong (SIGGRAPH 1998), each for as many as it says, which is
OpenSubdiv's "uniform". numpy only, no USD.

A step keeps the numbers of the points: those of a finer mesh are the old points, then one for each edge, then, for
Catmull-Clark, one for each face. So neighbours share their points by construction, and what is closed stays closed.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...scene import F64
from .triangulate import Index

Flags = NDArray[np.bool_]

INFINITE = 10.0
"""Sharpness that lasts for ever; the same in USD (SHARPNESS_INFINITE) and in OpenSubdiv."""
_SMOOTH_TRIANGLE = 0.470
"""Weight of a triangle's middle for a point on its edge, where `triangleSubdivisionRule` is `smooth`."""


class Scheme(Enum):
    """How a mesh is made finer."""

    CATMULL_CLARK = "catmullClark"
    LOOP = "loop"


@dataclass(frozen=True)
class Level:
    """The topology of a mesh at one step, seen from its face corners. Corners of a face follow each other."""

    scheme: Scheme
    points: int
    vertices: Index
    """shape (C,): point of each corner"""
    owner: Index
    """shape (C,): face of each corner, ascending"""
    following: Index
    """shape (C,): the next corner of the face; the edge of a corner runs from its point to that one's"""
    preceding: Index
    """shape (C,)"""
    edge: Index
    """shape (C,): the edge that each corner begins"""
    ends: Index
    """shape (E, 2): points of each edge"""
    edge_sharpness: F64
    """shape (E,): 0 .. INFINITE"""
    sharpness: F64
    """shape (V,): of points, 0 .. INFINITE"""
    root: Index
    """shape (F,): face of the cage that each face came from"""
    smooth_triangles: bool = False
    """Triangles of the cage pull less on their edges."""

    @property
    def faces(self) -> int:
        return len(self.root)

    @cached_property
    def first(self) -> Index:
        """shape (E,): some corner that begins each edge, and `last` another one where there are two"""
        corner = np.zeros(len(self.ends), np.int64)
        corner[self.edge[::-1]] = np.arange(len(self.edge))[::-1]
        return corner

    @cached_property
    def last(self) -> Index:
        corner = np.zeros(len(self.ends), np.int64)
        corner[self.edge] = np.arange(len(self.edge))
        return corner

    @cached_property
    def mate(self) -> Index:
        """shape (C,): the corner that begins the same edge at its other end, on the face across; -1 where there is
        none, or where more than two faces meet, or two that are wound against each other."""
        across = self.first[self.edge] + self.last[self.edge] - np.arange(len(self.edge))
        paired = np.bincount(self.edge, minlength=len(self.ends)) == 2
        paired &= self.vertices[self.first] != self.vertices[self.last]
        return np.where(paired[self.edge], across, -1)

    @cached_property
    def faces_at(self) -> Index:
        """shape (V,)"""
        return np.bincount(self.vertices, minlength=self.points)

    @cached_property
    def edges_at(self) -> Index:
        """shape (V,)"""
        return np.bincount(self.ends.ravel(), minlength=self.points)

    @cached_property
    def corners_of(self) -> Index | None:
        """Corners a face has where all have as many; None: they differ."""
        counts = np.bincount(self.owner, minlength=self.faces)
        return counts[0] if len(counts) and (counts == counts[0]).all() else None

    @cached_property
    def rules(self) -> _Rules:
        return _rules(self)

    @cached_property
    def fans(self) -> Fans:
        return _fans(self)


class _Rules(NamedTuple):
    """Weights of one step for points; rows of `points` count in `at_creases` and `ends` only."""

    smooth: F64
    """shape (V,): of the rule for smooth points"""
    fixed: F64
    """shape (V,): of the point as it is, all rules together"""
    crease_from: Index
    """shape (K,): points along creases ..."""
    crease_to: Index
    """shape (K,): ... each takes something of these"""
    crease_weight: F64
    """shape (K,)"""


def levels(base: Level, count: int) -> list[Level]:
    """A mesh and its topology after each of `count` steps."""
    found = [base]
    for _ in range(count):
        found.append(_finer(found[-1]))
    return found


def base_level(
    scheme: Scheme,
    points: int,
    indices: Index,
    counts: Index,
    creases: tuple[Index, F64],
    corners: tuple[Index, F64],
    *,
    smooth_triangles: bool = False,
) -> tuple[Level, int]:
    """The topology of a cage. What is no manifold is sharp: edges of three faces, points where surfaces only touch.

    Args:
        indices: shape (C,), all in 0 .. points - 1, faces of at least 3 corners one after the other
        counts: shape (F,)
        creases: pairs of points (K, 2), and the sharpness of each
        corners: points (K,), and the sharpness of each

    Returns:
        The topology, and how many creases run along no edge.
    """
    ends = np.cumsum(counts)
    starts = ends - counts
    owner = np.repeat(np.arange(len(counts)), counts)
    following, preceding = np.arange(len(indices)) + 1, np.arange(len(indices)) - 1
    following[ends - 1] = starts
    preceding[starts] = ends - 1
    keys, edge = np.unique(_keys(indices, indices[following], points), return_inverse=True)
    edge = edge.reshape(-1)
    edge_sharpness = np.zeros(len(keys))
    asked = _keys(creases[0][:, 0], creases[0][:, 1], points)
    place = np.minimum(np.searchsorted(keys, asked), len(keys) - 1)
    known = keys[place] == asked
    np.maximum.at(edge_sharpness, place[known], _sharp(creases[1][known]))
    sharpness = np.zeros(points)
    np.maximum.at(sharpness, corners[0], _sharp(corners[1]))
    pairs = np.stack((keys // points, keys % points), axis=1)
    found = Level(
        scheme, points, indices, owner, following, preceding, edge, pairs, edge_sharpness, sharpness,
        np.arange(len(counts)), smooth_triangles,
    )  # fmt: skip
    edge_sharpness[edge[found.mate < 0]] = INFINITE
    crowded = np.bincount(edge, minlength=len(keys)) > 2
    crowded |= (np.bincount(edge[found.mate < 0], minlength=len(keys)) == 2)
    sharpness[pairs[crowded].ravel()] = INFINITE
    sharpness[np.bincount(found.fans.points, minlength=points) > 1] = INFINITE
    return found, int((~known).sum())


def _sharp(values: F64) -> F64:
    return np.where(np.isfinite(values), np.clip(values, 0.0, INFINITE), INFINITE)


def _keys(a: Index, b: Index, points: int) -> Index:
    return np.minimum(a, b) * points + np.maximum(a, b)


class Fans(NamedTuple):
    """Faces around points. A point inside of a surface has one that is closed, a point on its boundary an open one, a
    point where surfaces only touch several."""

    points: Index
    """shape (N,)"""
    starts: Index
    """shape (N,): corner of the first face; the others follow counter-clockwise"""
    sizes: Index
    """shape (N,): number of faces"""
    closed: Flags
    """shape (N,)"""
    after: Index
    """shape (C,): the corner at the same point on the next face, -1: none"""


def _fans(level: Level) -> Fans:
    """The fans of all points; each corner is in one."""
    after = level.mate[level.preceding]
    fresh = np.ones(len(after), bool)
    begin = np.flatnonzero(level.mate < 0)  # open ones first: what is left then goes round and round
    starts, sizes, closed = [begin], [_walk(begin, after, fresh)], [np.zeros(len(begin), bool)]
    while len(rest := np.flatnonzero(fresh)):
        begin = rest[np.unique(level.vertices[rest], return_index=True)[1]]
        starts.append(begin)
        sizes.append(_walk(begin, after, fresh))
        closed.append(np.ones(len(begin), bool))
    first = np.concatenate(starts)
    return Fans(level.vertices[first], first, np.concatenate(sizes), np.concatenate(closed), after)


def _walk(begin: Index, after: Index, fresh: Flags) -> Index:
    """Goes round from each corner of `begin` until there is no other; takes those on the way out of `fresh`.

    Returns:
        shape (N,): corners on each way
    """
    sizes = np.zeros(len(begin), np.int64)
    walking, at = np.arange(len(begin)), begin
    while len(walking):
        fresh[at] = False
        sizes[walking] += 1
        at = after[at]
        going = (at >= 0) & (at != begin[walking])
        walking, at = walking[going], at[going]
    return sizes


def _finer(level: Level) -> Level:
    """One step: each corner becomes a face; with Loop, each face one more in its middle."""
    corners, edges = len(level.vertices), len(level.ends)
    of_edge = level.points + level.edge
    to_next, to_last = of_edge, of_edge[level.preceding]
    # Half of an edge: that at its first end is 2 e, the other one 2 e + 1.
    out_half = 2 * level.edge + (level.ends[level.edge, 0] != level.vertices)
    before = level.edge[level.preceding]
    in_half = 2 * before + (level.ends[before, 0] != level.vertices)
    middle = level.points + np.arange(edges)
    halves = np.stack((level.ends, np.stack((middle, middle), axis=1)), axis=2).reshape(-1, 2)
    own = np.arange(corners)
    if level.scheme is Scheme.CATMULL_CLARK:
        of_face = level.points + edges + level.owner
        vertices = np.stack((level.vertices, to_next, of_face, to_last), axis=1).ravel()
        edge = np.stack((out_half, 2 * edges + own, 2 * edges + level.preceding, in_half), axis=1).ravel()
        inner = np.stack((of_edge, of_face), axis=1)
        count, sides, root = level.points + edges + level.faces, 4, level.root[level.owner]
    else:
        cut = 2 * edges + own  # from the edge that leaves a corner to the edge that comes to it
        vertices = np.concatenate((np.stack((level.vertices, to_next, to_last), axis=1).ravel(), of_edge))
        edge = np.concatenate((np.stack((out_half, cut, in_half), axis=1).ravel(), 2 * edges + level.following))
        inner = np.stack((to_next, to_last), axis=1)
        count, sides = level.points + edges, 3
        root = np.concatenate((level.root[level.owner], level.root))
    total = len(vertices)
    loops = np.arange(total).reshape(-1, sides)
    sharpness = np.zeros(count)
    sharpness[: level.points] = worn(level.sharpness)
    return Level(
        level.scheme,
        count,
        vertices,
        np.repeat(np.arange(total // sides), sides),
        np.roll(loops, -1, axis=1).ravel(),
        np.roll(loops, 1, axis=1).ravel(),
        edge,
        np.concatenate((halves, inner)),
        np.concatenate((np.repeat(worn(level.edge_sharpness), 2), np.zeros(corners))),
        sharpness,
        root,
    )


def worn(sharpness: F64) -> F64:
    """What is left of sharpness after a step, any shape."""
    return np.where(sharpness < INFINITE, np.maximum(sharpness - 1.0, 0.0), INFINITE)


def refine(level: Level, values: F64) -> F64:
    """Values of points, shape (V, D), one step finer."""
    a, b = values[level.ends[:, 0]], values[level.ends[:, 1]]
    middle = 0.5 * (a + b)
    sharp = np.minimum(level.edge_sharpness, 1.0)[:, None]
    if level.scheme is Scheme.CATMULL_CLARK:
        inner = face_means(level, values)
        left, right = inner[level.owner[level.first]], inner[level.owner[level.last]]
        weight: F64 | float = 0.25
        if level.smooth_triangles:
            pull = np.where(np.bincount(level.owner, minlength=level.faces) == 3, _SMOOTH_TRIANGLE, 0.25)
            weight = 0.5 * (pull[level.owner[level.first]] + pull[level.owner[level.last]])[:, None]
        smooth = (1.0 - 2.0 * weight) * middle + weight * (left + right)
    else:
        inner = values[:0]
        opposite = values[level.vertices[level.preceding]]
        smooth = 0.75 * middle + 0.125 * (opposite[level.first] + opposite[level.last])
    edges = smooth + sharp * (middle - smooth)
    return np.concatenate((_points(level, values, inner), edges, inner))


def refine_linear(level: Level, values: F64) -> F64:
    """Values of points one step finer, each halfway between its neighbours."""
    middle = 0.5 * (values[level.ends[:, 0]] + values[level.ends[:, 1]])
    inner = face_means(level, values) if level.scheme is Scheme.CATMULL_CLARK else values[:0]
    return np.concatenate((values, middle, inner))


def face_means(level: Level, values: F64) -> F64:
    """Mean of the values at the corners of each face, shape (F, D)."""
    at = values[level.vertices]
    if level.corners_of is not None:
        return at.reshape(level.faces, int(level.corners_of), -1).mean(axis=1)
    counts = np.bincount(level.owner, minlength=level.faces)
    return np.add.reduceat(at, np.cumsum(counts) - counts, axis=0) / counts[:, None]


def _points(level: Level, values: F64, inner: F64) -> F64:
    """Where the old points go."""
    rules = level.rules
    n = np.maximum(level.edges_at, 1).astype(np.float64)
    around = _sum_at(level.ends[:, 0], values[level.ends[:, 1]], level.points)
    around += _sum_at(level.ends[:, 1], values[level.ends[:, 0]], level.points)
    if level.scheme is Scheme.CATMULL_CLARK:
        around += _sum_at(level.vertices, inner[level.owner], level.points)
        keep, take = (n - 2.0) / n, 1.0 / (n * n)
    else:
        take = loop_beta(n)
        keep = 1.0 - n * take
    out = (rules.fixed + rules.smooth * keep)[:, None] * values + (rules.smooth * take)[:, None] * around
    if len(rules.crease_from):
        pulled = values[rules.crease_to] * rules.crease_weight[:, None]
        rows, places = np.unique(rules.crease_from, return_inverse=True)
        out[rows] += _sum_at(places.reshape(-1), pulled, len(rows))
    return out


def loop_beta(valence: F64) -> F64:
    """Weight of each neighbour of a smooth point (Loop 1987)."""
    return (0.625 - (0.375 + 0.25 * np.cos(2.0 * np.pi / valence)) ** 2) / valence


def _sum_at(places: Index, values: F64, count: int) -> F64:
    """Sums of rows by place, shape (count, D)."""
    return np.stack([np.bincount(places, column, count) for column in values.T], axis=1).astype(np.float64, copy=False)


def _rules(level: Level) -> _Rules:
    """Which rule each point follows: that of its sharpness now, partly that of its sharpness one step later where the
    last of it goes."""
    now, later = level.edge_sharpness, worn(level.edge_sharpness)
    end = level.ends
    sharp_ends = np.flatnonzero(now > 0.0)
    count = lambda some: np.bincount(end[some].ravel(), minlength=level.points)  # noqa: E731
    here, there = count(sharp_ends), count(np.flatnonzero(later > 0.0))
    point, point_later = level.sharpness, worn(level.sharpness)
    going = np.flatnonzero((now > 0.0) & (later <= 0.0))
    goes = np.bincount(end[going].ravel(), minlength=level.points).astype(np.float64)
    rest = np.bincount(end[going].ravel(), np.repeat(now[going], 2), level.points).astype(np.float64)  # int if empty
    point_goes = (point > 0.0) & (point_later <= 0.0)
    goes += point_goes
    rest += np.where(point_goes, point, 0.0)
    weight = np.where(goes > 0.0, np.minimum(rest / np.maximum(goes, 1.0), 1.0), 1.0)
    lone = level.edges_at == 0
    kinds_now = _kind(here, point) | lone * 2
    kinds_later = _kind(there, point_later) | lone * 2
    weight = np.where(kinds_now == kinds_later, 1.0, weight)
    smooth = weight * (kinds_now == 0) + (1.0 - weight) * (kinds_later == 0)
    creased_now, creased_later = weight * (kinds_now == 1), (1.0 - weight) * (kinds_later == 1)
    fixed = weight * (kinds_now == 2) + (1.0 - weight) * (kinds_later == 2) + 0.75 * (creased_now + creased_later)
    sides = np.concatenate((end[sharp_ends], end[sharp_ends][:, ::-1]))
    pull = creased_now[sides[:, 0]] + creased_later[sides[:, 0]] * np.tile(later[sharp_ends] > 0.0, 2)
    used = pull > 0.0
    return _Rules(smooth, fixed, sides[used, 0], sides[used, 1], 0.125 * pull[used])


def _kind(sharp_edges: Index, sharpness: F64) -> Index:
    """0 smooth (also where one crease ends), 1 on a crease, 2 a corner."""
    return np.where((sharpness > 0.0) | (sharp_edges > 2), 2, (sharp_edges == 2).astype(np.int64))
