"""Primvars and normals of a prim as values per triangle corner."""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom, Vt

from ...scene import F32, Notice
from .triangulate import Index, turned_over

CHANNELS = 4
LARGEST = 1.0e15
"""Coordinates and lengths beyond it are taken for garbage: their squares still fit float32."""
WHOLE = "elementSize is the number of all values, as some exporters write it, which would be one element; 1 is used"
"""Said of a prim whose primvar has that mistake."""


class Finer(Protocol):
    """The way from what a prim authors to what is drawn, where that has more points: `Refinement`, `Along`."""

    def corners(self, values: F32, interpolation: str) -> tuple[F32, Index]:
        """Values (K, D) of an interpolation that is neither constant nor uniform, brought there, and which of them
        each corner takes."""


class Topology(NamedTuple):
    """Where the corners of the triangles come from, so that a value of any interpolation finds them."""

    corners: Index
    """shape (T, 3): place in the prim's face corners; with a refinement, in those of its last level"""
    vertices: Index
    """shape (T, 3): place in the prim's points; with a refinement, in those of its last level, which begin with them"""
    faces: Index
    """shape (T,): place in the prim's faces"""
    corner_count: int
    """of the prim, as the next two"""
    point_count: int
    face_count: int
    refinement: Finer | None = None
    """Of a subdivision surface, and of curves"""
    varying_count: int | None = None
    """Of curves, whose `varying` values are not as many as their points"""

    def turned_over(self) -> Topology:
        """The same of triangles whose last two corners have changed places."""
        return self._replace(corners=turned_over(self.corners), vertices=turned_over(self.vertices))


class Corners(NamedTuple):
    """Values and which of them each triangle corner takes."""

    values: F32
    """shape (K, D)"""
    rows: Index | None
    """shape (T, 3), into `values`; None where one value holds everywhere"""


class Unusable(Exception):
    """Why authored values cannot be used; becomes a `Notice` of the prim they stand on."""


def as_values(value: Any) -> F32 | None:
    """A number, vector or array of either as shape (K, D) with D from 1 to 4; None for anything else."""
    if isinstance(value, (str, bool)) or value is None:
        return None
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):
        return None
    if array.dtype.kind not in "fiu":
        return None
    is_array = array.ndim > 0 and (type(value).__module__ == Vt.__name__ or isinstance(value, list))
    array = array.reshape(len(array), math.prod(array.shape[1:])) if is_array else array.reshape(1, -1)
    if not 1 <= array.shape[1] <= CHANNELS:
        return None
    return np.ascontiguousarray(array, np.float32)


def to_corners(values: F32, picks: Index | None, interpolation: str, topology: Topology | None) -> Corners:
    """Applies an interpolation and, for indexed primvars, the indices `picks`. Of a constant the first value counts.

    Raises:
        Unusable: where the number of values is not what the interpolation asks for.
    """
    count = len(values) if picks is None else len(picks)
    if not count:
        raise Unusable("it is empty")
    if picks is not None and not (picks.min() >= 0 and picks.max() < len(values)):
        raise Unusable(f"its indices run from {picks.min()} to {picks.max()} but it has {len(values)} values")
    if interpolation == UsdGeom.Tokens.constant or (topology is None and count == 1):
        return Corners(values[:1] if picks is None else values[picks[:1]], None)
    if topology is None:
        raise Unusable(f"it is {interpolation}, and on a primitive without faces and points only constant is defined")
    places, expected = _places(interpolation, topology)
    if count != expected:
        raise Unusable(f"it is {interpolation}, which takes {expected} values here, but has {count}")
    if topology.refinement is not None and interpolation != UsdGeom.Tokens.uniform:
        flat = values if picks is None else values[picks]
        flat = np.where(np.isfinite(flat), flat, np.float32(0.0))  # one that is no number would reach its neighbours
        refined, of_corner = topology.refinement.corners(flat, interpolation)
        return Corners(refined, of_corner[topology.corners])
    return Corners(values, places if picks is None else picks[places])


def _places(interpolation: str, topology: Topology) -> tuple[Index, int]:
    if interpolation == UsdGeom.Tokens.uniform:
        return np.broadcast_to(topology.faces[:, None], topology.corners.shape), topology.face_count
    if interpolation == UsdGeom.Tokens.varying and topology.varying_count is not None:
        return topology.vertices, topology.varying_count
    if interpolation in (UsdGeom.Tokens.vertex, UsdGeom.Tokens.varying):
        return topology.vertices, topology.point_count
    if interpolation == UsdGeom.Tokens.faceVarying:
        return topology.corners, topology.corner_count
    raise Unusable(f"its interpolation '{interpolation}' is not one of constant, uniform, varying, vertex, faceVarying")


def spread(corners: Corners, *, mirrored: bool = False) -> F32:
    """Values per triangle corner, shape (T, 3, D), or (1, 1, D) where constant.

    Args:
        mirrored: triangles were turned over, so their last two corners changed places
    """
    if corners.rows is None:
        return corners.values.reshape(1, 1, -1)
    rows = turned_over(corners.rows) if mirrored else corners.rows
    return np.take(corners.values, rows, axis=0)


def evaluate(primvar: UsdGeom.Primvar, time: Usd.TimeCode, topology: Topology | None) -> Corners | None:
    """One primvar, or None where it holds no numbers.

    Raises:
        Unusable: where the authored values do not fit the prim.
    """
    values = as_values(primvar.Get(time))
    if values is None:
        return None
    picks: NDArray[np.int64] | None = None
    if primvar.IsIndexed():
        picks = np.asarray(primvar.GetIndices(time), np.int64)
    size = primvar.GetElementSize()
    if size != 1 and size not in (len(values), len(values if picks is None else picks)):
        raise Unusable(f"its elementSize is {size}; only 1 can be used")
    return to_corners(values, picks, primvar.GetInterpolation(), topology)


def read_primvar(
    prim: Usd.Prim, name: str, time: Usd.TimeCode, topology: Topology | None, notices: list[Notice]
) -> Corners | None:
    """The primvar `name` (without `primvars:`) of a prim, constant ones inherited; None where there is none of use."""
    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(name)
    if not primvar or not primvar.HasValue():
        return None
    try:
        corners = evaluate(primvar, time, topology)
        if corners is None:
            raise Unusable(f"its type {primvar.GetTypeName()} holds no vector of 1 to 4 numbers")
    except Unusable as reason:
        notices.append(Notice(str(prim.GetPath()), f"primvars:{name} is ignored: {reason}"))
        return None
    if primvar.GetElementSize() != 1:
        notices.append(Notice(str(prim.GetPath()), WHOLE))
    if primvar.GetInterpolation() == UsdGeom.Tokens.constant and (count := _authored(primvar, time)) > 1:
        text = f"primvars:{name} is constant, which takes one value, but has {count}; the first is used"
        notices.append(Notice(str(prim.GetPath()), text))
    refined = topology is not None and topology.refinement is not None
    authored = as_values(primvar.Get(time)) if refined else corners.values
    finite = np.isfinite(corners.values if authored is None else authored)
    if finite.all():
        return corners
    text = f"primvars:{name} has {int((~finite).sum())} values that are NaN or infinite; 0 is used in their place"
    notices.append(Notice(str(prim.GetPath()), text))
    return corners._replace(values=np.where(np.isfinite(corners.values), corners.values, np.float32(0.0)))


def _authored(primvar: UsdGeom.Primvar, time: Usd.TimeCode) -> int:
    values = as_values(primvar.Get(time))
    return len(primvar.GetIndices(time)) if primvar.IsIndexed() else len(() if values is None else values)
