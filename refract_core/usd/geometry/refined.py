"""A subdivision surface as triangles on its limit, and everything that its cage carries, brought there: no USD."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from ...scene import F32, F64
from .limit import limit, limit_surface
from .subdivision import INFINITE, Flags, Level, Scheme, base_level, levels, refine, refine_linear
from .triangulate import Index

MOST_TRIANGLES = 2_000_000
"""Of one mesh; a cage that a single step takes beyond it is drawn as it is."""
MORE_STEPS = 2
_SMALL = 512
"""Corners of a cage up to which its topology is kept."""


class Fineness(NamedTuple):
    """How fine surfaces are to be."""

    steps: int
    """Every step makes four faces of one; limit positions come after the last."""
    triangles: int
    """Of one mesh, beyond which fewer steps are taken"""
    few: int = 0
    """Of one mesh, under which up to `more` steps more are taken: a face of a cube is a large part of its outline"""
    more: int = MORE_STEPS


class Edges(NamedTuple):
    """What authored text says of sharpness."""

    creases: tuple[Index, F64]
    """pairs of points (K, 2), and a sharpness for each"""
    corners: tuple[Index, F64]
    """points (K,), and a sharpness for each"""


class Cage(NamedTuple):
    """A polygon mesh with the rules for its surface."""

    scheme: Scheme
    indices: Index
    """shape (C,): point of each corner, faces one after the other"""
    counts: Index
    """shape (F,)"""
    places: Index
    """shape (C,): the corners' numbers in the prim"""
    edges: Edges
    boundary: str
    """none, edgeOnly or edgeAndCorner"""
    face_varying: str
    """none, cornersOnly, cornersPlus1, cornersPlus2, boundaries or all"""
    smooth_triangles: bool


def steps_for(cage_faces: int, cage_corners: int, quads: bool, scheme: Scheme, fineness: Fineness) -> int:
    """Steps that a cage is to take; -1 where even the fewest make too many triangles.

    Args:
        quads: every face is one; others take a first step to become quads, with Catmull-Clark
    """
    least = 0 if quads or scheme is Scheme.LOOP else 1
    steps = max(fineness.steps, least)
    for _ in range(fineness.more):
        steps += triangles_after(cage_faces, cage_corners, scheme, steps) < fineness.few
    while steps > least and triangles_after(cage_faces, cage_corners, scheme, steps) > fineness.triangles:
        steps -= 1
    return steps if triangles_after(cage_faces, cage_corners, scheme, steps) <= MOST_TRIANGLES else -1


def triangles_after(cage_faces: int, cage_corners: int, scheme: Scheme, steps: int) -> int:
    """How many there will be."""
    if scheme is Scheme.LOOP:
        return int(cage_faces * 4**steps)
    return int(2 * cage_corners * 4 ** (steps - 1)) if steps else 2 * cage_faces


@dataclass(frozen=True)
class Refinement:
    """The way from a cage to its surface, which everything on it takes too."""

    cage: Cage
    stack: tuple[Level, ...]
    """Of the points: the cage's, and one more for each step"""

    @property
    def last(self) -> Level:
        return self.stack[-1]

    @cached_property
    def cage_corners(self) -> Index:
        """shape (C,): the prim's face corner that each corner of the last level stands at; -1: at none"""
        at = self.cage.places
        for level in self.stack[1:]:
            sides = 3 if level.scheme is Scheme.LOOP else 4
            finer = np.full(len(level.vertices), -1)
            finer[: sides * len(at) : sides] = at
            at = finer
        return at

    def corners(self, values: F32, interpolation: str) -> tuple[F32, Index]:
        """Values at the prim's points (`vertex`, `varying`) or face corners (`faceVarying`), brought to the surface.

        Returns:
            Values, shape (K, D), and which of them each corner of the last level takes, shape (C,).
        """
        exact = values.astype(np.float64)
        if interpolation == "faceVarying":
            return self._face_varying(exact[self.cage.places])
        exact = _carried(self.stack, exact, smooth=interpolation == "vertex")
        return exact.astype(np.float32), self.last.vertices

    def _face_varying(self, at_corners: F64) -> tuple[F32, Index]:
        """Values are one surface of their own, cut open where they differ at a point or along an edge."""
        rows = _same(self.stack[0].vertices, at_corners)
        of_point, first = np.unique(rows, return_index=True)
        assert len(of_point) == rows.max() + 1
        values, points = at_corners[first], self.stack[0].vertices[first]
        base = self._cut_open(rows, points)
        smooth = self.cage.face_varying != "all"
        stack = tuple(levels(base, len(self.stack) - 1))
        return _carried(stack, values, smooth=smooth).astype(np.float32), stack[-1].vertices

    def _cut_open(self, rows: Index, points: Index) -> Level:
        """The topology of face-varying values.

        Args:
            rows: shape (C,): value at each corner
            points: shape (K,): point of each value
        """
        geometry, cage = self.stack[0], self.cage
        sharpness = geometry.edge_sharpness[geometry.edge]
        creased = np.flatnonzero(sharpness > 0.0)
        pairs = np.stack((rows[creased], rows[geometry.following[creased]]), axis=1)
        of_point = np.zeros(geometry.points)
        np.maximum.at(of_point, cage.edges.corners[0], cage.edges.corners[1])
        pinned = np.flatnonzero(of_point[points] > 0.0)
        base, _ = base_level(
            cage.scheme, len(points), rows, cage.counts, (pairs, sharpness[creased]),
            (pinned, of_point[points[pinned]]), smooth_triangles=cage.smooth_triangles,
        )  # fmt: skip
        base.sharpness[_pinned(base, points, cage.face_varying, geometry)] = INFINITE
        return base


def _pinned(base: Level, points: Index, rule: str, geometry: Level) -> Flags:
    """Which face-varying values stay where they are, by `faceVaryingLinearInterpolation`."""
    on_edge = np.zeros(base.points, bool)
    if rule == "none":
        return on_edge
    on_edge[base.ends[base.edge[base.mate < 0]].ravel()] = True
    if rule == "boundaries":
        return on_edge
    found: Flags = on_edge & (base.faces_at == 1)
    if rule == "cornersOnly":
        return found
    meeting = np.bincount(points)[points]
    single = np.bincount(points, found)[points] > 0.0
    found |= on_edge & (meeting > 2)
    if rule == "cornersPlus2":  # what is opposite to a corner, and where a seam ends
        inside = np.ones(geometry.points, bool)
        inside[geometry.ends[geometry.edge[geometry.mate < 0]].ravel()] = False
        found |= on_edge & (((meeting == 2) & single) | ((meeting == 1) & inside[points]))
    return found


def _same(points: Index, values: F64) -> Index:
    """One number for each different value at each point, shape (C,), from 0 on."""
    rows = np.unique(points, return_inverse=True)[1].reshape(-1)
    for column in values.T:
        kinds, kind = np.unique(column, return_inverse=True)
        rows = np.unique(rows * len(kinds) + kind.reshape(-1), return_inverse=True)[1].reshape(-1)
    return rows


def _carried(stack: tuple[Level, ...], values: F64, *, smooth: bool) -> F64:
    """Values at points of the first level, at those of the last: to the limit where `smooth`, else in between."""
    for level in stack[:-1]:
        values = refine(level, values) if smooth else refine_linear(level, values)
    return limit(stack[-1], values) if smooth else values


class Surface(NamedTuple):
    """Triangles on the limit of a cage."""

    points: F64
    """shape (V, 3)"""
    normals: F64
    """shape (C, 3), per corner of the last level; unit, or 0"""
    corners: Index
    """shape (T, 3): corners of the last level"""
    refinement: Refinement
    lost: int
    """Creases that run along no edge"""
    closed: bool
    """By topology alone"""


def surface(points: F32, cage: Cage, holes: Flags, steps: int) -> Surface:
    """The limit of a cage after so many steps.

    Args:
        points: shape (V, 3), finite where they are used
        holes: shape (F,): faces that are part of the surface but not drawn
    """
    stack, lost = _stack_of(cage, len(points), steps)
    exact = points.astype(np.float64)
    exact[~np.isfinite(exact)] = 0.0  # of points that no face uses
    for level in stack[:-1]:
        exact = refine(level, exact)
    last = stack[-1]
    at, normals = limit_surface(last, exact)
    hidden = holes | _boundary_faces(stack[0]) if cage.boundary == "none" else holes
    drawn = np.flatnonzero(~hidden[last.root])
    if last.scheme is Scheme.LOOP:
        corners = 3 * drawn[:, None] + np.arange(3)
    else:
        corners = (4 * drawn[:, None] + np.array([0, 1, 2, 0, 2, 3])).reshape(-1, 3)
    closed = bool((stack[0].mate >= 0).all()) and not hidden.any()
    return Surface(at, _mended(last, at, normals), corners, Refinement(cage, stack), lost, closed)


def _stack_of(cage: Cage, points: int, steps: int) -> tuple[tuple[Level, ...], int]:
    """The cage's topology and that of each step; those of small cages are kept, for many are the same few shapes."""
    if len(cage.indices) > _SMALL:
        return _make_stack(cage, points, steps)
    arrays = cage.indices, cage.counts, *cage.edges.creases, *cage.edges.corners
    rules = cage.scheme, cage.boundary, cage.smooth_triangles
    return _kept_stack(tuple(array.tobytes() for array in arrays), *rules, points, steps)


@lru_cache(maxsize=32)
def _kept_stack(
    arrays: tuple[bytes, ...], scheme: Scheme, boundary: str, smooth_triangles: bool, points: int, steps: int
) -> tuple[tuple[Level, ...], int]:
    indices, counts, pairs, corners = (np.frombuffer(arrays[place], np.int64) for place in (0, 1, 2, 4))
    sharp, pinned = (np.frombuffer(arrays[place], np.float64) for place in (3, 5))
    edges = Edges((pairs.reshape(-1, 2), sharp), (corners, pinned))
    return _make_stack(Cage(scheme, indices, counts, indices, edges, boundary, "", smooth_triangles), points, steps)


def _make_stack(cage: Cage, points: int, steps: int) -> tuple[tuple[Level, ...], int]:
    base, lost = base_level(
        cage.scheme, points, cage.indices, cage.counts, *cage.edges, smooth_triangles=cage.smooth_triangles
    )
    if cage.boundary == "edgeAndCorner":
        base.sharpness[_on_boundary(base) & (base.faces_at == 1)] = INFINITE
    return tuple(levels(base, steps)), lost


def _on_boundary(base: Level) -> Flags:
    """Points at an edge of one face, shape (V,)."""
    found = np.zeros(base.points, bool)
    found[base.ends[np.bincount(base.edge, minlength=len(base.ends)) == 1].ravel()] = True
    return found


def _boundary_faces(base: Level) -> Flags:
    """Faces with a point on a boundary, shape (F,)."""
    found = np.zeros(base.faces, bool)
    found[base.owner[_on_boundary(base)[base.vertices]]] = True
    return found


def _mended(level: Level, at: F64, normals: F64) -> F64:
    """Where a surface has no tangents, the mean of what its faces say."""
    bad = np.flatnonzero((normals**2).sum(axis=1) < 0.25)
    if not len(bad):
        return normals
    sides = 3 if level.scheme is Scheme.LOOP else 4
    loops = at[level.vertices.reshape(-1, sides)]
    flat = np.cross(loops[:, 2] - loops[:, 0], loops[:, sides - 1] - loops[:, 1])
    total = np.zeros_like(at)
    for axis in range(3):
        total[:, axis] = np.bincount(level.vertices, flat[level.owner, axis], level.points)
    total /= np.maximum(np.sqrt((total**2).sum(axis=1, keepdims=True)), 1e-300)
    normals = normals.copy()
    normals[bad] = total[level.vertices[bad]]
    return normals
