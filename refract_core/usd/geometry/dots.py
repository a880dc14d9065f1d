"""UsdGeomPoints as exact spheres, many in one record.

A point is a sphere whose diameter is its width. Where a transform stretches a sphere unevenly it is an ellipsoid, which
is drawn as instances of a globe of triangles.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom

from ...errors import StageError
from ...scene import F32, F64, Notice, Paths, Run
from .gprims import unit_sphere
from .many import Cloud, Group, even_scales, in_metres
from .moving import FLIGHT, points_at
from .parts import Bound, Part, Tables, assemble
from .place import BEYOND, NOTHING_LEFT, of_instances
from .primvars import LARGEST, Topology, Unusable, as_values, read_primvar
from .shapes import Shape, varies
from .traverse import Placement, told_of
from .triangulate import Index

MOST = 8_000_000
"""Points that a stage may draw, counted wherever they are drawn."""
WIDTH = 1.0
"""Of points without widths, which the schema leaves open; usdview draws them so."""
_MOVES = ("points", "widths", "primvars:widths", *FLIGHT)


class Dots(NamedTuple):
    """Points of one prim, before they are put anywhere."""

    part: Part
    """Of a unit sphere; primvars have a row per point"""
    points: F64
    """shape (N, 3)"""
    radii: F64
    """shape (N,)"""
    numbers: Index
    """shape (N,): which of the prim's points they are"""
    varying: bool


def read_dots(prim: Usd.Prim, bound: Bound, tables: Tables) -> Dots | None:
    """The points of a prim; None, with a notice that says why, where nothing is left to draw."""
    path, told = str(prim.GetPath()), tables.notices
    dots = UsdGeom.Points(prim)
    value = points_at(prim, tables.time)
    points = np.zeros((0, 3)) if value is None else np.asarray(value, np.float64).reshape(-1, 3)
    if not len(points):
        told.append(Notice(path, "skipped: it has no points at this time"))
        return None
    if len(points) > MOST:
        raise StageError(f"{path}: it has {len(points)} points; at most {MOST} can be rendered")
    topology = _topology(len(points))
    try:
        radii = _radii(dots, topology, tables)
    except Unusable as reason:
        told.append(Notice(path, f"skipped: {reason}"))
        return None
    good = (np.abs(points) < LARGEST).all(axis=1) & (radii > 0.0) & np.isfinite(radii)
    if not good.all():
        text = f"{int((~good).sum())} of its points are skipped: they have no width above 0, or no finite place"
        told.append(Notice(path, text))
    if not good.any():
        return None
    part = assemble(prim, replace(_unit_ball(), topology=topology), bound, tables)
    primvars = {name: v if v.shape[:2] == (1, 1) else v[good, 0] for name, v in part.primvars.items()}
    numbers = np.flatnonzero(good)
    return Dots(part._replace(primvars=primvars), points[good], radii[good], numbers, varies(prim, _MOVES))


def _topology(count: int) -> Topology:
    """Primvars of points, as if each were a triangle with all its corners there; there is one uniform value."""
    each = np.broadcast_to(np.arange(count)[:, None], (count, 3))
    return Topology(each, each, np.zeros(count, np.int64), count, count, 1)


@lru_cache(maxsize=1)
def _unit_ball() -> Shape:
    solid = unit_sphere()
    return Shape(
        points=solid.points, triangles=solid.triangles, normals=solid.normals, closed=True, is_sphere=True
    )  # fmt: skip


def _radii(dots: UsdGeom.Points, topology: Topology, tables: Tables) -> F64:
    """Half the widths, shape (N,).

    Raises:
        Unusable: they are not as many as their interpolation asks for.
    """
    prim, count = dots.GetPrim(), topology.point_count
    primvar = UsdGeom.PrimvarsAPI(prim).GetPrimvar("widths")
    if primvar and primvar.HasValue():
        found = read_primvar(prim, "widths", tables.time, topology, tables.notices)
        if found is None:
            raise Unusable("its primvars:widths cannot be used")
        rows = np.zeros(count, np.int64) if found.rows is None else found.rows[:, 0]
        return found.values[rows, 0].astype(np.float64) / 2.0
    values = as_values(dots.GetWidthsAttr().Get(tables.time))
    if values is None or not len(values):
        text = f"its points have no widths; they are drawn {WIDTH:g} scene unit wide"
        tables.notices.append(Notice(str(prim.GetPath()), text))
        return np.full(count, WIDTH / 2.0)
    if len(values) not in (1, count):
        raise Unusable(f"it has {len(values)} widths for {count} points")
    return np.broadcast_to(values[:, 0].astype(np.float64) / 2.0, (count,))


# --- where they are drawn -------------------------------------------------------------------------------------------


def spread_dots(
    dots: Dots, placement: Placement, metres_from_stage: F64, tables: Tables
) -> Iterator[Cloud | Group]:
    """Points at all of their places: spheres, or ellipsoids where a transform stretches them.

    Raises:
        StageError: they are more than `MOST`.
    """
    count, places = len(dots.radii), len(placement.worlds)
    if count * places > MOST:
        raise StageError(f"{placement.path}: {count * places} points are drawn; at most {MOST} can be rendered")
    matrices = in_metres(placement.worlds, metres_from_stage, np.eye(4), np.zeros(3))
    finite = _stay_near(matrices, dots)
    solid = np.abs(np.linalg.det(np.where(finite[:, None, None], matrices[:, :, :3], 0.0))) > 0.0
    for gone, text in ((~finite, BEYOND), (finite & ~solid, NOTHING_LEFT)):
        if gone.any():
            tables.notices.append(told_of([placement.run.path(row) for row in np.flatnonzero(gone).tolist()], text))
    scales = np.where(solid, even_scales(matrices), -1.0)
    static = placement.static and not dots.varying
    if len(rows := np.flatnonzero(scales > 0.0)):
        paths, centres, primvars = _multiplied(dots, placement.at(rows), matrices[rows], tables)
        radii = (scales[rows, None] * dots.radii).ravel()
        yield Cloud(int(dots.part.materials[0]), static, paths, centres, radii, primvars)
    if len(rows := np.flatnonzero(scales == 0.0)):
        paths, centres, primvars = _multiplied(dots, placement.at(rows), matrices[rows], tables)
        linear = (matrices[rows, None, :, :3] * dots.radii[:, None, None]).reshape(-1, 3, 3)
        same = {name: v for name, v in primvars.items() if v.ndim == 3}
        part = dots.part._replace(shape=_unit_ball(), primvars=same)
        values = {name: v for name, v in primvars.items() if v.ndim == 2}
        yield Group(part, static, paths, np.zeros(3), np.concatenate([linear, centres[:, :, None]], axis=2), values)


def _stay_near(matrices: F64, dots: Dots) -> NDArray[np.bool_]:
    """Which places take all points to within `LARGEST`, shape (N,)."""
    with np.errstate(all="ignore"):
        most = np.abs(dots.points).max(axis=0) + dots.radii.max()
        reach = np.abs(matrices[:, :, :3]) @ most + np.abs(matrices[:, :, 3])
    return np.asarray((reach < LARGEST).all(axis=1))


def _multiplied(
    dots: Dots, placement: Placement, matrices: F64, tables: Tables
) -> tuple[Paths, F64, dict[str, F32]]:
    """Paths, centres and primvars of all points in some places, point after point, place after place."""
    places, each = len(matrices), len(dots.radii)
    linear, origin = matrices[:, :, :3], matrices[:, :, 3]
    centres = (dots.points @ linear.transpose(0, 2, 1) + origin[:, None]).reshape(-1, 3)
    outer = np.repeat(placement.run.numbers, each, axis=0)
    numbers = np.concatenate([outer, np.tile(dots.numbers.astype(np.int32), places)[:, None]], axis=1)
    *first, last = placement.run.pieces
    own = {name: np.repeat(values, each, axis=0) for name, values in of_instances(dots.part, placement, tables).items()}
    primvars = {name: v if v.ndim == 3 else np.tile(v, (places, 1)) for name, v in dots.part.primvars.items()}
    return Paths((Run((*first, f"{last}/[", "]"), numbers),)), centres, primvars | own
