"""Sphere, Cube, Cylinder, Cone, Capsule and Plane as triangles with exact normals, wound outward.

The axis of everything here is +Z; `axis_matrix` turns it to where the prim wants it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from pxr import Usd

from ...scene import F32, F64, U32
from .primvars import Corners, Unusable
from .triangulate import Index

AROUND = 128
"""Segments of a full turn: a chord is 0.03 % of the radius inside the true surface."""
QUARTER = AROUND // 4


@dataclass(frozen=True)
class Solid:
    """One primitive in its own frame."""

    points: F32
    """shape (V, 3)"""
    triangles: U32
    """shape (T, 3)"""
    st: Corners
    normals: Corners | None = None
    """None: flat"""
    closed: bool = True


@dataclass(frozen=True)
class Gprim:
    """A primitive and how it lies in the prim's space."""

    solid: Solid
    prim_from_solid: F64
    """shape (4, 4), column vectors"""
    is_sphere: bool = False
    """The solid is the unit sphere, so an exact one may stand for it."""


@dataclass(frozen=True)
class _Strip:
    """A smooth part of the outline of a solid of revolution, from its lower end to its upper."""

    outline: F64
    """shape (M, 4): radius, z, and the normal's radial and z part"""
    disc: bool = False
    """st lies on it as on a plate (True), or is wrapped around it"""


# The attributes each type is made of.
ATTRIBUTES = {
    "Sphere": ("radius",),
    "Cube": ("size",),
    "Cylinder": ("radius", "height", "axis"),
    "Cylinder_1": ("radiusTop", "radiusBottom", "height", "axis"),
    "Cone": ("radius", "height", "axis"),
    "Capsule": ("radius", "height", "axis"),
    "Capsule_1": ("radiusTop", "radiusBottom", "height", "axis"),
    "Plane": ("width", "length", "axis"),
}


def read_gprim(prim: Usd.Prim, time: Usd.TimeCode) -> Gprim:
    """The primitive a gprim stands for.

    Raises:
        Unusable: where a size is not a positive number or the axis is not X, Y or Z.
    """
    kind = prim.GetTypeName()
    named = {name: prim.GetAttribute(name).Get(time) for name in ATTRIBUTES[kind]}
    axis = str(named.pop("axis", "Z"))
    if axis not in ("X", "Y", "Z"):
        raise Unusable(f"its axis is '{axis}'; it must be X, Y or Z")
    sizes = {name: math.nan if value is None else float(value) for name, value in named.items()}
    for name, size in sizes.items():
        may_be_zero = name in ("radiusTop", "radiusBottom") or (name == "height" and kind.startswith("Capsule"))
        if not (math.isfinite(size) and (size > 0.0 or (may_be_zero and size == 0.0))):
            raise Unusable(f"its {name} is {size:g}; it must be a positive number")
    if sizes.get("radiusTop", 1.0) <= 0.0 and sizes.get("radiusBottom", 1.0) <= 0.0:
        raise Unusable("its radiusTop and radiusBottom are both 0; at least one must be positive")
    return _MAKERS[kind](axis, **sizes)


def axis_matrix(axis: str) -> F64:
    """Rotation that takes +Z to `axis`, shape (4, 4), column vectors."""
    turned = np.eye(4)
    turned[:3, :3] = np.roll(np.eye(3), {"Z": 0, "X": 1, "Y": 2}[axis], axis=0)
    return turned


def _sphere(axis: str, radius: float) -> Gprim:
    return Gprim(unit_sphere(), np.diag([radius, radius, radius, 1.0]), is_sphere=True)


def _cube(axis: str, size: float) -> Gprim:
    return Gprim(_unit_cube(), np.diag([size / 2, size / 2, size / 2, 1.0]))


def _plane(axis: str, width: float, length: float) -> Gprim:
    # UsdGeomPlane: width lies along x, for axis X along z; length along y, for axis Y along z. The minus signs keep
    # the frame right-handed, so that the normal is +axis.
    across = {"Z": (width, 0, 0), "Y": (width, 0, 0), "X": (0, 0, -width)}[axis]
    along = {"Z": (0, length, 0), "Y": (0, 0, -length), "X": (0, length, 0)}[axis]
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack((across, along, axis_matrix(axis)[:3, 2]), axis=1)
    return Gprim(_unit_plane(), matrix)


def _cylinder(axis: str, radius: float, height: float) -> Gprim:
    return _tapered(axis, radius, radius, height)


def _cone(axis: str, radius: float, height: float) -> Gprim:
    return _tapered(axis, 0.0, radius, height)


# Parameter names below are the attribute names of the USD schema.
def _tapered(axis: str, radiusTop: float, radiusBottom: float, height: float) -> Gprim:
    widest = max(radiusTop, radiusBottom)
    solid = _unit_tapered(radiusBottom / widest, radiusTop / widest)
    return Gprim(solid, axis_matrix(axis) @ np.diag([widest, widest, height, 1.0]))


def _capsule(axis: str, radius: float, height: float) -> Gprim:
    return _pill(axis, radius, radius, height)


def _pill(axis: str, radiusTop: float, radiusBottom: float, height: float) -> Gprim:
    widest = max(radiusTop, radiusBottom)
    solid = _unit_pill(radiusBottom / widest, radiusTop / widest, height / widest)
    return Gprim(solid, axis_matrix(axis) @ np.diag([widest, widest, widest, 1.0]))


_MAKERS: dict[str, Callable[..., Gprim]] = {
    "Sphere": _sphere,
    "Cube": _cube,
    "Cylinder": _cylinder,
    "Cylinder_1": _tapered,
    "Cone": _cone,
    "Capsule": _capsule,
    "Capsule_1": _pill,
    "Plane": _plane,
}


@lru_cache(maxsize=1)
def unit_sphere() -> Solid:
    """Radius 1."""
    return _revolve((_Strip(_arc(1.0, 0.0, -90.0, 90.0)),))


@lru_cache(maxsize=64)
def _unit_tapered(bottom: float, top: float) -> Solid:
    """A cylinder or truncated cone of height 1 about the origin; no cap where a radius is 0."""
    strips = [_Strip(_line(bottom, -0.5, top, 0.5))]
    if bottom > 0.0:
        strips.insert(0, _Strip(np.array([[0.0, -0.5, 0.0, -1.0], [bottom, -0.5, 0.0, -1.0]]), disc=True))
    if top > 0.0:
        strips.append(_Strip(np.array([[top, 0.5, 0.0, 1.0], [0.0, 0.5, 0.0, 1.0]]), disc=True))
    return _revolve(tuple(strips))


@lru_cache(maxsize=64)
def _unit_pill(bottom: float, top: float, height: float) -> Solid:
    """A tapered side of the given height between two half spheres."""
    strips = []
    if bottom > 0.0:
        strips.append(_Strip(_arc(bottom, -height / 2, -90.0, 0.0)))
    if height > 0.0:
        strips.append(_Strip(_line(bottom, -height / 2, top, height / 2)))
    if top > 0.0:
        strips.append(_Strip(_arc(top, height / 2, 0.0, 90.0)))
    return _revolve(tuple(strips))


def _arc(radius: float, z: float, low: float, high: float) -> F64:
    """Circle about (0, z) between two latitudes [degrees]."""
    steps = round((high - low) / 90.0) * QUARTER
    latitude = np.radians(np.linspace(low, high, steps + 1))
    across, up = np.cos(latitude), np.sin(latitude)
    across[np.abs(across) < 1.0e-12] = 0.0
    return np.stack((radius * across, z + radius * up, across, up), axis=1)


def _line(r0: float, z0: float, r1: float, z1: float) -> F64:
    slope = np.array([z1 - z0, r0 - r1]) / math.hypot(z1 - z0, r0 - r1)
    return np.array([[r0, z0, *slope], [r1, z1, *slope]])


def _revolve(strips: tuple[_Strip, ...]) -> Solid:
    """Turns an outline, given from the bottom upwards, about +Z."""
    rings: list[F64] = []
    starts: list[int] = []  # first point of every ring; a ring on the axis is one point
    triangles, normals, st, picks = [], [], [], []
    made = 0
    lengths = [np.hypot(*np.diff(strip.outline[:, :2], axis=0).T).sum() for strip in strips if not strip.disc]
    total, wrapped = float(sum(lengths)), 0.0
    for strip in strips:
        for row, (r, z, _, _) in enumerate(strip.outline):
            if row or not rings:  # the first row of a later strip is the last of the one before
                rings.append(_ring(r, z))
                starts.append(sum(map(len, rings[:-1])))
        travelled = np.concatenate(([0.0], np.hypot(*np.diff(strip.outline[:, :2], axis=0).T).cumsum()))
        height = (wrapped + travelled) / total
        wrapped += 0.0 if strip.disc else float(travelled[-1])
        first = len(rings) - len(strip.outline)
        for row in range(len(strip.outline) - 1):
            places, table = _band([rings[first + row], rings[first + row + 1]], starts[first + row : first + row + 2])
            triangles.append(places)
            picks.append(table + made)
            pair = strip.outline[row : row + 2]
            normals.append(_band_normals(pair))
            st.append(_band_st(pair, height[row : row + 2], disc=strip.disc))
            made += len(st[-1])
    index = np.concatenate(picks)
    return Solid(
        points=np.concatenate(rings).astype(np.float32),
        triangles=np.concatenate(triangles).astype(np.uint32),
        st=Corners(np.concatenate(st).astype(np.float32), index),
        normals=Corners(np.concatenate(normals).astype(np.float32), index),
    )


def _ring(r: float, z: float) -> F64:
    if r == 0.0:
        return np.array([[0.0, 0.0, z]])
    turn = np.arange(AROUND) * (2.0 * math.pi / AROUND)
    return np.stack((r * np.cos(turn), r * np.sin(turn), np.full(AROUND, z)), axis=1)


def _band(rings: list[F64], starts: list[int]) -> tuple[Index, Index]:
    """Triangles between two rings: (T, 3) points, and (T, 3) rows of the band's own table of 2 x (AROUND + 1)."""
    column = np.arange(AROUND)
    low, high = column, column + AROUND + 1
    table = np.concatenate((np.stack((low, low + 1, high + 1), 1), np.stack((low, high + 1, high), 1)))
    row, place = table // (AROUND + 1), table % (AROUND + 1)
    on_axis = np.array([len(ring) == 1 for ring in rings])
    points = np.array(starts)[row] + np.where(on_axis[row], 0, place % AROUND)
    keep = (points[:, 0] != points[:, 1]) & (points[:, 1] != points[:, 2]) & (points[:, 2] != points[:, 0])
    return points[keep], table[keep]


def _turns(pair: F64) -> F64:
    """Angle of every column of a band, shape (2, AROUND + 1). On the axis, the middle of the one triangle there."""
    turns = np.tile(np.arange(AROUND + 1) * (2.0 * math.pi / AROUND), (2, 1))
    # The lower triangle of column c meets the axis above it with column c + 1, the upper one below it with column c.
    turns[0] += math.pi / AROUND * (pair[0, 0] == 0.0)
    turns[1] -= math.pi / AROUND * (pair[1, 0] == 0.0)
    return turns


def _band_normals(pair: F64) -> F64:
    turns = _turns(pair)
    across, up = pair[:, 2:3], np.broadcast_to(pair[:, 3:4], turns.shape)
    return np.stack((across * np.cos(turns), across * np.sin(turns), up), axis=2).reshape(-1, 3)


def _band_st(pair: F64, height: F64, *, disc: bool) -> F64:
    turns = _turns(pair)
    if not disc:
        return np.stack((turns / (2.0 * math.pi), np.broadcast_to(height[:, None], turns.shape)), axis=2).reshape(-1, 2)
    widest = pair[:, 0].max()
    x, y = pair[:, :1] / widest * np.cos(turns), pair[:, :1] / widest * np.sin(turns)
    facing = math.copysign(1.0, pair[0, 3])  # the lower cap is looked at from below
    return np.stack((0.5 + 0.5 * x, 0.5 + 0.5 * facing * y), axis=2).reshape(-1, 2)


def _quads(points: F64, loops: Index) -> tuple[F32, U32, Corners]:
    split = np.array([[0, 1, 2], [0, 2, 3]])
    triangles = loops[:, split].reshape(-1, 3).astype(np.uint32)
    st = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    return points.astype(np.float32), triangles, Corners(st, np.tile(split, (len(loops), 1)))


@lru_cache(maxsize=1)
def _unit_cube() -> Solid:
    """Corners at +-1. Each face reads its st upright when Z is up."""
    points = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], np.float64)
    loops = np.array([[1, 3, 7, 5], [2, 0, 4, 6], [3, 2, 6, 7], [0, 1, 5, 4], [4, 5, 7, 6], [2, 3, 1, 0]])
    return Solid(*_quads(points, loops))


@lru_cache(maxsize=1)
def _unit_plane() -> Solid:
    """From -0.5 to 0.5 in x and y, facing +Z."""
    points = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    return Solid(*_quads(points, np.array([[0, 1, 2, 3]])), closed=False)
