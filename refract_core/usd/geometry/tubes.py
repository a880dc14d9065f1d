"""Round tubes and flat ribbons along many curves at once, as triangles: numpy only, no USD.

A *ring* is a place on a curve where the tube has corners, a *segment* what lies between two rings. Nothing here loops
over curves: a groom has a hundred thousand of them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...scene import F32, F64
from .triangulate import Index

SHARP = math.cos(math.radians(30.0))
"""Bends by more than this show their edge; others are shaded smooth."""
_MITRE = 4.0
"""How far the corner of a sharp bend may stand out, in radii."""


class Rings(NamedTuple):
    """Places along curves, one curve after the other. No two that follow each other are at the same place."""

    centres: F64
    """shape (N, 3)"""
    before: F64
    """shape (N, 3): unit direction in which the curve comes in"""
    after: F64
    """shape (N, 3): unit direction in which it goes on; another one at a corner"""
    starts: Index
    """shape (C,): first ring of each curve"""
    counts: Index
    """shape (C,)"""
    periodic: bool
    """The last ring of every curve is followed by its first."""

    @property
    def owner(self) -> Index:
        """shape (N,): the curve of each ring"""
        return np.repeat(np.arange(len(self.counts)), self.counts)

    @property
    def place(self) -> Index:
        """shape (N,): number of each ring in its curve"""
        return np.arange(len(self.centres)) - np.repeat(self.starts, self.counts)

    @property
    def segments(self) -> tuple[Index, Index]:
        """shape (S,) each: the ring a segment begins with, and the one it ends with"""
        following = np.arange(len(self.centres)) + 1
        last = self.starts + self.counts - 1
        if self.periodic:
            following[last] = self.starts
            return np.arange(len(following)), following
        goes_on = np.ones(len(following), bool)
        goes_on[last] = False
        first = np.flatnonzero(goes_on)
        return first, following[first]

    @property
    def along(self) -> F64:
        """shape (N, 3): unit direction that every ring is square to, between `before` and `after`"""
        total = self.before + self.after
        length = _length(total)
        back = length < 1e-6  # a full turn back has no middle
        return np.where(back[:, None], self.after, total / np.where(back, 1.0, length)[:, None])


class Sides(NamedTuple):
    """The triangles of tubes or ribbons."""

    points: F32
    """shape (V, 3)"""
    triangles: NDArray[np.uint32]
    """shape (T, 3), counter-clockwise seen from outside, or from where a ribbon faces"""
    normals: F32
    """shape (K, 3), unit"""
    normal_rows: Index
    """shape (T, 3): the normal of each corner"""
    rings: Index
    """shape (T, 3): the ring of each corner"""


def directions(values: F64, fallback: F64) -> F64:
    """Unit vectors (N, 3); those of a fallback where there is no length to speak of."""
    length = _length(values)
    short = ~(length > 1e-9 * _length(fallback))
    chosen = np.where(short[:, None], fallback, values)
    found: F64 = chosen / np.maximum(_length(chosen), 1e-300)[:, None]
    return found


def tubes(rings: Rings, radii: F64, sides: int) -> Sides:
    """Closed solids around curves: polygons of so many sides, whose perimeter is that of the circle, so that side
    area and mean width are those of a round tube; flat ends, none where a tube ends in a point or runs into itself.

    Args:
        radii: shape (N,), >= 0
    """
    round_by = math.pi / (sides * math.sin(math.pi / sides))
    radii = radii * round_by
    along, owner = rings.along, rings.owner
    across = carried_along(rings)
    turn = np.arange(sides) * (2.0 * math.pi / sides)
    other = np.cross(along, across)
    spokes = np.cos(turn)[:, None] * across[:, None] + np.sin(turn)[:, None] * other[:, None]
    points = rings.centres[:, None] + radii[:, None, None] * _mitred(rings, spokes)
    first, last = rings.segments
    side = np.arange(sides)
    following = (side + 1) % sides
    a, b = first[:, None] * sides, last[:, None] * sides
    lower = np.stack((a + side, a + following, b + following), axis=2)
    upper = np.stack((a + side, b + following, b + side), axis=2)
    ends = 2 * sides * np.arange(len(first))[:, None]  # rows of the normals: a segment's beginning, then its end
    of_lower = np.stack((ends + side, ends + following, ends + sides + following), axis=2)
    of_upper = np.stack((ends + side, ends + sides + following, ends + sides + side), axis=2)
    wide = radii > 0.0
    corners = np.concatenate((lower[wide[first]], upper[wide[last]])).reshape(-1, 3)
    rows = np.concatenate((of_lower[wide[first]], of_upper[wide[last]])).reshape(-1, 3)
    normals = _side_normals(rings, spokes, radii).reshape(-1, 3)
    if not rings.periodic:
        caps, cap_rows, cap_normals = _caps(rings, wide, sides, along, len(normals))
        corners, rows = np.concatenate((corners, caps)), np.concatenate((rows, cap_rows))
        normals = np.concatenate((normals, cap_normals))
    order = np.argsort(owner[corners[:, 0] // sides], kind="stable")  # what is near in space is near in memory
    corners, rows = corners[order], rows[order]
    flat = points.reshape(-1, 3).astype(np.float32)
    return Sides(flat, corners.astype(np.uint32), normals.astype(np.float32), rows, corners // sides)


def ribbons(rings: Rings, widths: F64, facing: F64) -> Sides:
    """Flat strips that face along `facing`, shape (N, 3), as far as that is square to the curve."""
    along = rings.along
    up = facing - (facing * along).sum(axis=1, keepdims=True) * along
    lost = ~(_length(up) > 1e-6 * _length(facing))
    if lost.any():  # a normal along the curve says nothing: as a tube's side would lie there
        up[lost] = carried_along(rings)[lost]
    up /= _length(up)[:, None]
    across = np.cross(along, up)[:, None]
    half = 0.5 * widths[:, None, None] * _mitred(rings, across)
    points = np.concatenate((rings.centres[:, None] - half, rings.centres[:, None] + half), axis=1)
    first, last = rings.segments
    a, b = 2 * first, 2 * last
    lower, upper = np.stack((a, a + 1, b + 1), axis=1), np.stack((a, b + 1, b), axis=1)
    wide = widths > 0.0
    corners = np.stack((lower, upper), axis=1)[np.stack((wide[first], wide[last]), axis=1)]
    return Sides(
        points.reshape(-1, 3).astype(np.float32), corners.astype(np.uint32), up.astype(np.float32), corners // 2,
        corners // 2,
    )  # fmt: skip


def carried_along(rings: Rings) -> F64:
    """A unit vector square to the curve at every ring that turns about it as little as may be, shape (N, 3); around a
    closed curve, what is left to turn is spread over all of it.

    Every step turns it by the shortest way from a ring's direction to the segment's, and on to the next ring's, so that
    the sides of a segment run along it. Steps are rotations: they are multiplied up along all curves at once, in as
    many rounds as the longest has doublings.
    """
    along, place, owner = rings.along, rings.place, rings.owner
    first, last = rings.segments
    steps = np.zeros((len(along), 4))
    steps[:, 0] = 1.0
    closing = place[last] == 0
    step = _shortest_ways(rings.centres[last] - rings.centres[first], along[first], along[last])
    steps[last[~closing]] = step[~closing]
    turned = steps.copy()
    reach, longest = 1, int(rings.counts.max())
    while reach < longest:
        rows = np.flatnonzero(place >= reach)
        turned[rows] = _product(turned[rows], turned[rows - reach])
        reach *= 2
    turned /= np.sqrt((turned**2).sum(axis=1, keepdims=True))
    begin = _square_to(along[rings.starts])
    vectors = _turned(turned, begin[owner])
    vectors -= (vectors * along).sum(axis=1, keepdims=True) * along
    vectors /= _length(vectors)[:, None]
    if rings.periodic:
        arrived = _turned(step[closing], vectors[first[closing]])  # in order of the curves
        side = np.cross(along[rings.starts], begin)
        angle = np.arctan2((arrived * side).sum(axis=1), (arrived * begin).sum(axis=1))
        angle = -angle[owner] * place / rings.counts[owner]
        vectors = np.cos(angle)[:, None] * vectors + np.sin(angle)[:, None] * np.cross(along, vectors)
    return vectors


def _shortest_ways(chord: F64, leaving: F64, arriving: F64) -> F64:
    """Quaternions (S, 4), real part first, that take a frame from one ring to the next.

    The shortest way from a to b is a mirror square to a, then one square to a + b; or one square to a + b, then one
    square to b. The two mirrors square to the chord undo each other.
    """
    unit = chord / _length(chord)[:, None]
    first, second = leaving + unit, unit + arriving
    back = np.minimum(_length(first), _length(second)) < 1e-6  # a full turn has no shortest way
    first[back], second[back] = leaving[back], arriving[back]
    first /= _length(first)[:, None]
    second /= _length(second)[:, None]
    return np.concatenate((-(second * first).sum(axis=1, keepdims=True), np.cross(second, first)), axis=1)


def _product(later: F64, earlier: F64) -> F64:
    """Quaternions: one rotation after another."""
    a, b = later[:, :1], earlier[:, :1]
    u, v = later[:, 1:], earlier[:, 1:]
    real = a * b - (u * v).sum(axis=1, keepdims=True)
    return np.concatenate((real, a * v + b * u + np.cross(u, v)), axis=1)


def _turned(by: F64, vectors: F64) -> F64:
    twice = 2.0 * np.cross(by[:, 1:], vectors)
    found: F64 = vectors + by[:, :1] * twice + np.cross(by[:, 1:], twice)
    return found


def _square_to(along: F64) -> F64:
    """Some unit vector square to each of (N, 3)."""
    least = np.eye(3)[np.abs(along).argmin(axis=1)]
    found = np.cross(along, least)
    unit: F64 = found / _length(found)[:, None]
    return unit


def _mitred(rings: Rings, spokes: F64) -> F64:
    """Spokes (N, n, 3) of rings, made longer in the plane of a bend so that the sides before and after stay as wide as
    they are."""
    half = 0.5 * _length(rings.before + rings.after)  # cosine of half the angle
    bent = np.flatnonzero((half < 1.0 - 1e-9) & (half > 1e-6))
    if not len(bent):
        return spokes
    inward = rings.after[bent] - rings.before[bent]
    inward /= _length(inward)[:, None]
    longer = np.minimum(1.0 / half[bent], _MITRE) - 1.0
    there = np.einsum("nsk,nk->ns", spokes[bent], inward) * longer[:, None]
    found = spokes.copy()
    found[bent] += there[:, :, None] * inward[:, None]
    return found


def _side_normals(rings: Rings, spokes: F64, radii: F64) -> F64:
    """Unit normals at the beginning and the end of every segment, shape (S, 2, n, 3): smooth along a curve but for
    sharp bends."""
    first, last = rings.segments
    lengths = _length(rings.centres[last] - rings.centres[first])
    rise = (radii[last] - radii[first]) / lengths
    smooth = (rings.before * rings.after).sum(axis=1) > SHARP
    total, meeting = np.zeros(len(radii)), np.zeros(len(radii))
    for ends in (first, last):
        total += np.bincount(ends, rise, len(radii))
        meeting += np.bincount(ends, minlength=len(radii))
    even = total / np.maximum(meeting, 1.0)
    along = rings.along
    found = np.empty((len(first), 2, *spokes.shape[1:]))
    for place, (ends, own) in enumerate(((first, rings.after), (last, rings.before))):
        sharp = ~smooth[ends]
        to, slope = along[ends], even[ends]
        out = spokes[ends]
        if sharp.any():
            to[sharp], slope[sharp] = own[ends][sharp], rise[sharp]
            out[sharp] -= np.einsum("nsk,nk->ns", out[sharp], to[sharp])[:, :, None] * to[sharp][:, None]
            out[sharp] /= np.maximum(np.sqrt((out[sharp] ** 2).sum(axis=2, keepdims=True)), 1e-300)
        out = out - slope[:, None, None] * to[:, None]
        found[:, place] = out / np.sqrt((out**2).sum(axis=2, keepdims=True))
    return found


def _caps(rings: Rings, wide: NDArray[np.bool_], sides: int, along: F64, known: int) -> tuple[Index, Index, F64]:
    """Flat ends: points (T, 3), rows of normals (T, 3) counted on from those `known`, and the normals."""
    middle = np.arange(1, sides - 1)
    fan = np.stack((np.zeros_like(middle), middle, middle + 1), axis=1)
    back, front = rings.starts, rings.starts + rings.counts - 1
    back, front = back[wide[back]], front[wide[front]]
    at_back, at_front = back[:, None, None] * sides + fan[:, [0, 2, 1]], front[:, None, None] * sides + fan
    corners = np.concatenate((at_back, at_front)).reshape(-1, 3)
    rows = np.repeat(known + np.arange(len(back) + len(front)), sides - 2)[:, None] + np.zeros(3, np.int64)
    return corners, rows, np.concatenate((-along[back], along[front]))


def _length(vectors: F64) -> F64:
    found: F64 = np.sqrt((vectors**2).sum(axis=-1))
    return found
