"""What a Mesh says of its subdivision surface: the polygons of the cage, creases, corners, and the rules."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from pxr import Usd, UsdGeom

from ...scene import F32, F64, Notice
from ...settings import USUAL_PIXELS
from .refined import MOST_TRIANGLES, Cage, Edges, Fineness, steps_for, triangles_after
from .subdivision import Scheme
from .triangulate import Index, triangulate

SUBDIVISION_ATTRIBUTES = (
    "subdivisionScheme", "creaseIndices", "creaseLengths", "creaseSharpnesses", "cornerIndices", "cornerSharpnesses",
    "interpolateBoundary", "faceVaryingLinearInterpolation", "triangleSubdivisionRule",
)  # fmt: skip
"""What a subdivision surface depends on beside what every mesh does."""
FINENESS = {
    "low": Fineness(2, 1 << 17, 1 << 11), "medium": Fineness(3, 1 << 18, 1 << 13),
    "high": Fineness(4, 1 << 19, 1 << 15), "veryhigh": Fineness(5, MOST_TRIANGLES, 1 << 17),
}  # fmt: skip
"""By complexity. A dense cage is smooth as it is: where it has many faces, fewer steps will do."""


def fineness_for(complexity: str, pixels: int) -> Fineness:
    """How fine surfaces are to be.

    In a larger picture a few faces are not enough for an outline: with two triangles for each pixel of its longer side,
    a round surface that fills its height has chords that lie within a pixel of it.

    Args:
        complexity: of `FINENESS`
        pixels: longer side of the picture; 0 for none in particular
    """
    usual = FINENESS[complexity]
    few = max(usual.few, usual.few * pixels // USUAL_PIXELS)
    return usual._replace(few=few, more=usual.more + math.ceil(math.log(few / usual.few, 4)))


class Loops(NamedTuple):
    """Polygons of a mesh."""

    indices: Index
    """of all face corners of the prim: their points"""
    starts: Index
    """shape (F,)"""
    counts: Index
    """shape (F,)"""
    faces: Index
    """shape (F,): place in the prim's faces"""
    places: Index = np.zeros(0, np.int64)
    """shape (C,): place of each corner in the prim's face corners, one polygon after the other; `starts` means these"""


def is_subdivided(prim: Usd.Prim, time: Usd.TimeCode) -> bool:
    """A Mesh whose faces are the cage of a smooth surface."""
    smooth = (UsdGeom.Tokens.catmullClark, UsdGeom.Tokens.loop)
    return prim.GetTypeName() == "Mesh" and UsdGeom.Mesh(prim).GetSubdivisionSchemeAttr().Get(time) in smooth


def surface_size(mesh: UsdGeom.Mesh, time: Usd.TimeCode, fineness: Fineness) -> int:
    """About as many triangles as a subdivision surface will have."""
    counts = integers(mesh.GetFaceVertexCountsAttr().Get(time)).clip(0)
    scheme = _scheme(mesh, time)
    corners = int(counts.sum())
    faces = max(corners - 2 * len(counts), 0) if scheme is Scheme.LOOP else len(counts)
    steps = steps_for(faces, corners, bool((counts == 4).all()), scheme, fineness)
    return triangles_after(faces, corners, scheme, steps) if steps >= 0 else 2 * len(counts)


def steps_of(cage: Cage, fineness: Fineness) -> int:
    """Steps a cage is to take; -1 where the fewest make too many triangles."""
    quads = bool((cage.counts == 4).all())
    return steps_for(len(cage.counts), len(cage.indices), quads, cage.scheme, fineness)


def without_repeats(polygons: Loops, faults: dict[str, int]) -> Loops:
    """Polygons without corners at the point of the one before; what is no polygon then is left out, and counted."""
    counts = polygons.counts
    before = np.cumsum(counts) - counts
    places = np.arange(int(counts.sum())) + np.repeat(polygons.starts - before, counts)
    at = polygons.indices[places]
    following = np.arange(len(at)) + 1
    following[before + counts - 1] = before
    fresh = at != at[following]
    if not fresh.all():
        owner = np.repeat(np.arange(len(counts)), counts)
        left = np.bincount(owner[fresh], minlength=len(counts))
        good = left >= 3
        if bad := int((~good).sum()):
            faults["faces with fewer than 3 different points"] = bad
        places = places[fresh & good[owner]]
        counts, polygons = left[good], polygons._replace(faces=polygons.faces[good])
    return Loops(polygons.indices, np.cumsum(counts) - counts, counts, polygons.faces, places)


def cut_for_loop(
    mesh: UsdGeom.Mesh, time: Usd.TimeCode, points: F32, polygons: Loops, notices: list[Notice]
) -> Loops:
    """Polygons as triangles where the scheme is `loop`, with a notice."""
    if _scheme(mesh, time) is not Scheme.LOOP or not len(polygons.counts) or polygons.counts.max() == 3:
        return polygons
    text = "subdivisionScheme is loop, which is for triangles; its polygons are cut into triangles first"
    notices.append(Notice(str(mesh.GetPath()), text))
    all_of_them = np.arange(len(polygons.counts))
    at = polygons.indices[polygons.places]
    cut = triangulate(points, at, polygons.starts, polygons.counts, all_of_them)
    places, counts = polygons.places[cut.corners.ravel()], np.full(len(cut.faces), 3)
    return Loops(polygons.indices, np.cumsum(counts) - counts, counts, polygons.faces[cut.faces], places)


def read_cage(mesh: UsdGeom.Mesh, time: Usd.TimeCode, polygons: Loops, points: int, notices: list[Notice]) -> Cage:
    """Polygons with everything a mesh says about its surface; notices tell of what makes no sense.

    Args:
        points: how many the mesh has
    """
    path = str(mesh.GetPath())
    return Cage(
        scheme=_scheme(mesh, time),
        indices=polygons.indices[polygons.places],
        counts=polygons.counts,
        places=polygons.places,
        edges=Edges(_creases(mesh, time, points, path, notices), _corners(mesh, time, points, path, notices)),
        boundary=str(mesh.GetInterpolateBoundaryAttr().Get(time)),
        face_varying=str(mesh.GetFaceVaryingLinearInterpolationAttr().Get(time)),
        smooth_triangles=mesh.GetTriangleSubdivisionRuleAttr().Get(time) == UsdGeom.Tokens.smooth,
    )


def _scheme(mesh: UsdGeom.Mesh, time: Usd.TimeCode) -> Scheme:
    return Scheme.LOOP if mesh.GetSubdivisionSchemeAttr().Get(time) == UsdGeom.Tokens.loop else Scheme.CATMULL_CLARK


def _creases(
    mesh: UsdGeom.Mesh, time: Usd.TimeCode, points: int, path: str, notices: list[Notice]
) -> tuple[Index, F64]:
    """Pairs of points and their sharpness, which is authored for each crease or for each of its edges."""
    indices = integers(mesh.GetCreaseIndicesAttr().Get(time))
    lengths = integers(mesh.GetCreaseLengthsAttr().Get(time))
    sharpness = _reals(mesh.GetCreaseSharpnessesAttr().Get(time))
    edges = int((lengths - 1).sum())
    wrong = ""
    if (len(lengths) and lengths.min() < 2) or lengths.sum() != len(indices):
        wrong = f"creaseLengths must be 2 or more each, and add up to {len(indices)}, the number of creaseIndices"
    elif len(sharpness) not in (len(lengths), edges):
        wrong = f"creaseSharpnesses has {len(sharpness)} values for {len(lengths)} creases of {edges} edges"
    if wrong:
        notices.append(Notice(path, f"its creases are ignored: {wrong}"))
        indices, lengths, sharpness = indices[:0], lengths[:0], sharpness[:0]
    goes_on = np.ones(len(indices), bool)
    goes_on[np.cumsum(lengths) - 1] = False
    first = np.flatnonzero(goes_on)
    pairs = np.stack((indices[first], indices[first + 1]), axis=1)
    if len(sharpness) != len(pairs):
        sharpness = np.repeat(sharpness, lengths - 1)
    return _known(pairs, sharpness, points, "creases", path, notices)


def _corners(
    mesh: UsdGeom.Mesh, time: Usd.TimeCode, points: int, path: str, notices: list[Notice]
) -> tuple[Index, F64]:
    """Points and their sharpness."""
    indices = integers(mesh.GetCornerIndicesAttr().Get(time))
    sharpness = _reals(mesh.GetCornerSharpnessesAttr().Get(time))
    if len(indices) != len(sharpness):
        text = f"its corners are ignored: {len(indices)} cornerIndices, but {len(sharpness)} cornerSharpnesses"
        notices.append(Notice(path, text))
        indices, sharpness = indices[:0], sharpness[:0]
    rows, sharpness = _known(indices[:, None], sharpness, points, "corners", path, notices)
    return rows[:, 0], sharpness


def _known(
    rows: Index, sharpness: F64, points: int, what: str, path: str, notices: list[Notice]
) -> tuple[Index, F64]:
    """Those that name points of the mesh, and a number."""
    good = ((rows >= 0) & (rows < points)).all(axis=1) & ~np.isnan(sharpness)
    if bad := int((~good).sum()):
        text = f"{bad} of its {what} are ignored: points are 0 .. {points - 1}, and sharpness is a number"
        notices.append(Notice(path, text))
    return rows[good], sharpness[good]


def integers(value: Any) -> Index:
    """An array of integers; none where there is no value."""
    return np.zeros(0, np.int64) if value is None else np.asarray(value, np.int64)


def _reals(value: Any) -> F64:
    return np.zeros(0) if value is None else np.asarray(value, np.float64)
