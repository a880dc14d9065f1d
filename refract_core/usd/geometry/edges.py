"""Edges that normals hide. Where an exporter averages them over the two sides of an edge, it looks round. Glass bends
light by them, so a wall that ends in a rim is not flat any more, up to its next row of points
(docs/decisions/edges-of-glass.md)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...scene import F64
from .primvars import Corners
from .shapes import Shape
from .triangulate import Index, weld

_EDGE = 0.5 - 1e-3
"""Cosine of the angle between faces, 60 degrees, above which they meet in an edge; a tube of six sides is round."""
_SUSPECT = 0.87
"""Cosine of the angle from a face to its normal, just under 30 degrees: where an edge is hidden, one face at least is
off by half of it."""
_ONE = 0.999
"""Cosine between normals that are one."""
_MOST_ROUND = 64
"""Corners that meet at a place at most; where there are more, as at the tip of a cone, no edge is looked for."""
_AT_ONCE = 1 << 20
"""Pairs of corners that are looked at together."""

HIDDEN = "glass: normals are averaged over edges sharper than 60 degrees, as if they were round; there its faces decide"


def with_edges(shape: Shape) -> Shape:
    """The shape, with normals of its faces where those it has are averaged over an edge; itself where there are none.

    A corner has such a normal if a face that meets it at its place, at more than 60 degrees, has the same one. It gets
    the mean of the faces there that are within 60 degrees of its own, weighted by their angles.
    """
    normals = shape.normals
    if normals is None or normals.rows is None or not len(shape.triangles):
        return shape
    corners = shape.points[shape.triangles].astype(np.float64)
    sides = np.roll(corners, -1, axis=1) - corners
    across = np.cross(sides[:, 0], sides[:, 1])
    doubled = np.linalg.norm(across, axis=1)
    faces = across / np.where(doubled > 0.0, doubled, np.inf)[:, None]
    given = normals.values.astype(np.float64)
    lean = np.einsum("fkc,fc->fk", given[normals.rows], faces)
    suspect = (lean < _SUSPECT) & (doubled > 0.0)[:, None]
    if not suspect.any():
        return shape
    place = weld(shape.points)[shape.triangles]
    chosen = np.zeros(int(place.max()) + 1, np.bool_)
    chosen[place[suspect]] = True
    # Corners at those places, those of one place together; those of what has no area decide nothing.
    which = np.flatnonzero((chosen[place] & (doubled > 0.0)[:, None]).ravel())
    which = which[np.argsort(place.ravel()[which], kind="stable")]
    _, counts = np.unique(place.ravel()[which], return_counts=True)
    kept = np.repeat(counts <= _MOST_ROUND, counts)
    which, counts = which[kept], counts[counts <= _MOST_ROUND]
    angles = np.arctan2(doubled[:, None], -(sides * np.roll(sides, 1, axis=1)).sum(axis=2)).ravel()
    rows = normals.rows.copy()
    values = [normals.values]
    height = len(normals.values)
    for some, sizes in _portions(which, counts):
        hidden, found = _looked_at(some, sizes, faces[some // 3], given[rows.ravel()[some]], angles[some])
        rows.ravel()[some[hidden]] = height + np.arange(len(found))
        values.append(found.astype(np.float32))
        height += len(found)
    if height == len(normals.values):
        return shape
    return replace(shape, normals=Corners(np.concatenate(values), rows))


def _portions(which: Index, counts: Index) -> list[tuple[Index, Index]]:
    """Corners of whole places, and how many each place has: as many as make about `_AT_ONCE` pairs."""
    cuts = np.flatnonzero(np.diff(np.cumsum(counts * counts) // _AT_ONCE)) + 1
    ends = np.cumsum(counts)[cuts - 1]
    return list(zip(np.split(which, ends), np.split(counts, cuts), strict=True))


def _looked_at(
    some: Index, sizes: Index, faces: F64, given: F64, angles: F64
) -> tuple[NDArray[np.bool_], F64]:
    """Which corners have a normal that hides an edge, and what they get for it.

    Args:
        some: shape (C,): corners, place by place; `sizes`: of the places.
        faces, given: shape (C, 3): unit normals of their faces, and those that they have.
        angles: shape (C,): of their faces there.
    """
    meets = np.repeat(sizes, sizes)
    one = np.repeat(np.arange(len(some)), meets)
    first = np.repeat(np.cumsum(meets) - meets, meets)
    other = np.repeat(np.repeat(np.cumsum(sizes) - sizes, sizes), meets) + np.arange(len(one)) - first
    apart = (faces[one] * faces[other]).sum(axis=1) < _EDGE
    alike = (given[one] * given[other]).sum(axis=1) > _ONE
    begins = np.cumsum(meets) - meets
    hidden = np.logical_or.reduceat(apart & alike, begins)
    weight = np.where(apart, 0.0, angles[other])
    total = np.add.reduceat(weight[:, None] * faces[other], begins, axis=0)[hidden]
    return hidden, total / np.linalg.norm(total, axis=1, keepdims=True)
