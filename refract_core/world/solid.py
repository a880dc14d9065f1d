"""Closed meshes and rays through them, in plain numpy: what the eye, fitting, rules and reports ask of a
shape.

Points have shape (V, 3), triangles shape (T, 3); outside is where a triangle's corners run counter-clockwise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..scene import F64

CONVEX_TOLERANCE = 0.005
"""Convex: no vertex lies further than this in front of any face, against the diagonal of the bounding box."""

_NOTHING = 1.0e-14
"""Volume under which a surface encloses nothing, against the cube of its diagonal: what rounding leaves of a sheet that
is folded back onto itself."""
_FACES = 512
"""Faces of a mesh whose planes are looked at for convexity."""


def across(corners: F64) -> F64:
    """Normals of triangles, twice as long as their areas: shape (T, 3), of corners of shape (T, 3, 3)."""
    normals: F64 = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals


def areas(corners: F64) -> F64:
    """Shape (T,), of corners of shape (T, 3, 3)."""
    found: F64 = 0.5 * np.linalg.norm(across(corners), axis=1)
    return found


def signed_volume(points: F64, triangles: NDArray[np.integer]) -> float:
    """[cube of the unit], by the divergence theorem: positive where a closed surface faces outwards."""
    a, b, c = (points[triangles[:, side]] - points[triangles[0, 0]] for side in range(3))
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum()) / 6.0


def mean_way(points: F64, triangles: NDArray[np.integer]) -> float:
    """Mean length of the ways through a closed surface, 4 V / S (Cauchy 1841), in its unit; 0 where it encloses
    nothing."""
    surface = float(areas(points[triangles]).sum())
    return 4.0 * abs(signed_volume(points, triangles)) / surface if surface > 0.0 else 0.0


def looks_inwards(points: F64, triangles: NDArray[np.integer]) -> bool:
    """A closed surface is inside out: as a whole, so the inner shell of something hollow does not make it so."""
    return signed_volume(points, triangles) < -_NOTHING * float(np.linalg.norm(np.ptp(points, axis=0))) ** 3


def is_convex(points: F64, triangles: NDArray[np.integer]) -> bool:
    """No point of a closed surface, which may be inside out, stands in front of a face; of many faces, an even choice
    is looked at."""
    faces = np.unique(np.linspace(0, len(triangles) - 1, _FACES).astype(np.int64))
    at = points[triangles[faces]]
    normals = across(at)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    if signed_volume(points, triangles) < 0.0:
        normals = -normals
    limit = CONVEX_TOLERANCE * float(np.linalg.norm(np.ptp(points, axis=0)))
    for some in np.array_split(np.arange(len(at)), max(1, len(at) * len(points) // 4_000_000)):
        heights = points @ normals[some].T - np.einsum("ij,ij->i", normals[some], at[some, 0])
        if heights.max() > limit:
            return False
    return True


def winding(point: F64, points: F64, triangles: NDArray[np.integer]) -> float:
    """How often a closed surface goes round a point: 1 inside, 0 outside, -1 inside one that is inside out.

    Sum of the triangles' solid angles over 4 pi (Van Oosterom and Strackee, IEEE Trans. Biomed. Eng. 30(2), 1983).
    """
    a, b, c = (points[triangles[:, corner]] - point for corner in range(3))
    la, lb, lc = (np.sqrt((side**2).sum(axis=1)) for side in (a, b, c))
    above = (a * np.cross(b, c)).sum(axis=1)
    below = la * lb * lc + (a * b).sum(axis=1) * lc + (b * c).sum(axis=1) * la + (c * a).sum(axis=1) * lb
    return float(np.arctan2(above, below).sum() / (2.0 * np.pi))


def encloses(points: NDArray[np.floating], triangles: NDArray[np.integer], point: F64) -> bool:
    """A closed surface goes round a point."""
    if (point <= points.min(axis=0)).any() or (point >= points.max(axis=0)).any():  # most are far away
        return False
    return winding(point, points.astype(np.float64), triangles) > 0.5


def along_a_curve(points: F64) -> NDArray[np.int64]:
    """Order of points along Morton's curve: those next to each other are so in space, so that strata are, too."""
    low, size = points.min(axis=0), max(float(np.ptp(points, axis=0).max()), 1e-30)
    return by_halves(((points - low) / size)[:, ::-1])


def by_halves(columns: F64) -> NDArray[np.int64]:
    """Order of rows by Morton's code of their columns, which are from 0 to 1: by the half that the first is in, then
    the second, and so on, then by halves of those. Six columns at most."""
    cells = np.minimum(columns * 1024.0, 1023.0).astype(np.int64)
    code = np.zeros(len(columns), np.int64)
    for bit in range(9, -1, -1):
        for column in cells.T:
            code = code << 1 | (column >> bit & 1)
    return np.argsort(code, kind="stable")


def crossings(corners: F64, origin: F64, direction: F64) -> tuple[F64, NDArray[np.bool_]]:
    """Where a ray meets triangles (Moeller and Trumbore, Journal of Graphics Tools 2(1), 1997).

    Args:
        corners: shape (T, 3, 3): the corners of each triangle.
        origin, direction: shape (3,), in the frame of the corners.

    Returns:
        Shape (N,): distances > 0 in lengths of `direction`, sorted; and whether the ray goes inwards there. A ray
        through an edge meets both of its triangles.
    """
    a = corners[:, 0]
    e1, e2 = corners[:, 1] - a, corners[:, 2] - a
    p = np.cross(direction, e2)
    facing = np.einsum("ij,ij->i", e1, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / facing
        away = origin - a
        u = np.einsum("ij,ij->i", away, p) * inverse
        q = np.cross(away, e1)
        v = (q @ direction) * inverse
        t = np.einsum("ij,ij->i", e2, q) * inverse
        met = np.flatnonzero((u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0))
    met = met[np.argsort(t[met], kind="stable")]
    return t[met], facing[met] > 0.0
