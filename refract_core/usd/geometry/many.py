"""Prims that are drawn in many places: which of them stay one mesh with many transforms, and how those are read.

All places of a prim, and of all its proxies that look the same, are one record: what the engine keeps of each is its
transform, its path's numbers, and what the instancer says of it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Hashable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf

from ...errors import StageError
from ...scene import F32, F64, Balls, Instances, Mesh, Paths
from .parts import Part, Tables
from .place import BEYOND, FLAT, NOTHING_LEFT, ROUND, of_instances
from .primvars import LARGEST, spread
from .shapes import Shape
from .traverse import Placement, stays_one, told_of
from .triangulate import Index

_FEW_BALLS = 64
"""Places from which on spheres are one record."""
MOST_APART = 100_000
"""Places with a mesh of their own that instances may have: what is flattened has no inside to be shared."""
_SOME = 1 << 13
"""Places that are looked at together."""
_LOOKED_AT = 1024
"""Places whose bounds are measured together."""


class Group(NamedTuple):
    """A part in many places, in metres and Y up, not yet moved to the scene's centre."""

    part: Part
    static: bool
    paths: Paths
    middle: F64
    """shape (3,): of its points, in shape space; the record's own frame is about it"""
    matrices: F64
    """shape (N, 3, 4), metres from that frame"""
    primvars: dict[str, F32]
    """name -> shape (N, D): what the instancer says of each"""


class Cloud(NamedTuple):
    """Exact spheres of one material, in metres and Y up, not yet moved to the scene's centre."""

    material: int
    static: bool
    paths: Paths
    centres: F64
    """shape (N, 3)"""
    radii: F64
    """shape (N,)"""
    primvars: dict[str, F32]
    """name -> shape (N, D), or (1, 1, D)"""


def shared(
    placements: list[Placement], parts: Mapping[Sdf.Path, Part | None], own: Collection[str], metres_from_stage: F64,
    tables: Tables,
) -> tuple[list[Placement], list[Group], list[Cloud]]:  # fmt: skip
    """What is to have a mesh, or be a sphere, of its own for every place, one place each; and what is not.

    Args:
        parts: by the paths of their prims
        own: prims that something will be said of one by one
        metres_from_stage: shape (4, 4), column vectors: turns Y up and scales

    Raises:
        StageError: more than `MOST_APART` instances cannot share a mesh.
    """
    alone: list[tuple[int, Placement]] = []
    together: dict[Hashable, list[tuple[int, Placement]]] = {}
    for number, placement in enumerate(placements):
        part = parts[placement.prim.GetPath()]
        if part is None:
            continue
        many = len(placement.worlds) > 1 or placement.prim.IsInstanceProxy() or placement.stands_in is not None
        if many and str(placement.prim.GetPath()) not in own:
            together.setdefault(_likeness(part, placement, tables), []).append((number, placement))
        else:
            alone.append((number, placement))
    groups: list[Group] = []
    clouds: list[Cloud] = []
    for found in together.values():
        part = parts[found[0][1].prim.GetPath()]
        assert part is not None
        if part.is_ball:
            if sum(len(placement.worlds) for _, placement in found) < _FEW_BALLS:
                alone.extend(found)
                continue
            cloud, found = _cloud(part, found, metres_from_stage, tables)
            clouds.extend(cloud)
        count = sum(len(placement.worlds) for _, placement in found)
        if not stays_one(count, len(part.shape.triangles)):
            alone.extend(found)
            continue
        group, left = _group(part, found, metres_from_stage, tables)
        groups.extend(group)
        alone.extend(left)
    alone.sort(key=lambda one: one[0])
    apart = sum(len(placement.worlds) for _, placement in alone if placement.instance is not None)
    if apart > MOST_APART:
        path = next(placement.path for _, placement in alone if placement.instance is not None)
        text = f"{apart} instances, from this one on, cannot share a mesh"
        raise StageError(f"{path}: {text}; at most {MOST_APART} can be rendered. Deactivate some of them")
    every = (placement.at(np.array([row])) for _, placement in alone for row in range(len(placement.worlds)))
    return list(every), groups, clouds


def _likeness(part: Part, placement: Placement, tables: Tables) -> Hashable:
    """The same for placements that one record may hold."""
    number = int(part.materials[0]) if len(part.materials) else -1
    of_materials: Hashable = number
    if part.materials is not tables.uniform.get((len(part.materials), number)):
        of_materials = hashlib.sha256(part.materials.tobytes()).digest()
    values = [(name, v.shape, hashlib.sha256(v.tobytes()).digest()) for name, v in part.primvars.items()]
    says = None if placement.instance is None else str(placement.instance[0].GetPath())
    return id(part.shape), of_materials, tuple(values), part.wanted, placement.static, says


def _group(
    part: Part, found: list[tuple[int, Placement]], metres_from_stage: F64, tables: Tables
) -> tuple[list[Group], list[tuple[int, Placement]]]:
    """One record, and what of it has to stand alone. What is nowhere, or nothing, is left out with a notice. A million
    places are held once: where they were in the stage's world is written over."""
    points = part.shape.points
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    middle, half = (low + high) / 2, (high - low) / 2
    frame = metres_from_stage, part.shape.prim_from_shape, middle
    finite, sense = _judged(_worlds([placement for _, placement in found]), frame, half)
    runs, rest = _parted(found, finite & (sense != 0))
    left = []
    lost: list[str] = []
    gone: list[str] = []
    for number, placement in rest:
        sheets, _ = _judged(placement.worlds, frame, half)
        lost += [placement.run.path(row) for row in np.flatnonzero(~sheets).tolist()]
        flat = np.flatnonzero(sheets)
        sheets[flat] = _rank(in_metres(placement.worlds[flat], *frame)) > 1
        gone += [placement.run.path(row) for row in flat[~sheets[flat]].tolist()]
        if sheets.any():
            left.append((number, placement.at(np.flatnonzero(sheets))))
    for paths, text in ((lost, BEYOND), (gone, NOTHING_LEFT)):
        if paths:
            tables.notices.append(told_of(paths, text))
    if not runs:
        return [], left
    static = runs[0].static and not part.shape.varying
    where = in_metres(_worlds(runs), *frame, over=True)
    where_drawn = Paths(tuple(placement.paths for placement in runs))
    return [Group(part, static, where_drawn, middle, where, _said(part, runs, tables))], left


def _cloud(
    part: Part, found: list[tuple[int, Placement]], metres_from_stage: F64, tables: Tables
) -> tuple[list[Cloud], list[tuple[int, Placement]]]:
    """One record of the places in which a sphere stays one, and the others."""
    worlds = _worlds([placement for _, placement in found])
    matrices = in_metres(worlds, metres_from_stage, part.shape.prim_from_shape, np.zeros(3))
    radii = even_scales(matrices)
    kept = (radii > 0.0) & (radii + np.abs(matrices[:, :, 3]).max(axis=1) < LARGEST)
    runs, left = _parted(found, kept)
    if not runs:
        return [], left
    static = runs[0].static and not part.shape.varying
    paths = Paths(tuple(placement.paths for placement in runs))
    primvars = part.primvars | _said(part, runs, tables)
    centres = np.ascontiguousarray(matrices[kept, :, 3])
    return [Cloud(int(part.materials[0]), static, paths, centres, radii[kept], primvars)], left


def _worlds(placements: list[Placement]) -> F64:
    """All places of several; of one, the array itself."""
    if len(placements) == 1:
        return placements[0].worlds
    return np.concatenate([placement.worlds for placement in placements])


def _parted(
    found: list[tuple[int, Placement]], kept: NDArray[np.bool_]
) -> tuple[list[Placement], list[tuple[int, Placement]]]:
    """Placements cut down to the places that are kept, and to the others. `kept`: shape (N,), of all places."""
    if kept.all():
        return [placement for _, placement in found], []
    runs, rest, start = [], [], 0
    for number, placement in found:
        here = kept[start : start + len(placement.worlds)]
        start += len(here)
        if here.any():
            runs.append(placement if here.all() else placement.at(np.flatnonzero(here)))
        if not here.all():
            rest.append((number, placement.at(np.flatnonzero(~here))))
    return runs, rest


def _said(part: Part, runs: list[Placement], tables: Tables) -> dict[str, F32]:
    """What the instancer says of all places of placements that are alike, which have the same one or none."""
    instance = runs[0].instance
    if instance is None:
        return {}
    numbers = np.concatenate([placement.instance[1] for placement in runs if placement.instance is not None])
    return of_instances(part, runs[0]._replace(instance=(instance[0], numbers)), tables)


def even_scales(matrices: F64) -> F64:
    """Scales of transforms that only turn, mirror and scale evenly; 0 for others. Shape (N,)."""
    found = np.zeros(len(matrices))
    with np.errstate(all="ignore"):
        for start in range(0, len(matrices), _SOME):
            linear = matrices[start : start + _SOME, :, :3]
            squared = linear.transpose(0, 2, 1) @ linear
            scale = np.trace(squared, axis1=1, axis2=2) / 3.0
            off = np.abs(squared - scale[:, None, None] * np.eye(3)).max(axis=(1, 2))
            found[start : start + _SOME] = np.where(np.isfinite(scale) & (off <= ROUND * scale), np.sqrt(scale), 0.0)
    return found


def in_metres(
    worlds: F64, metres_from_stage: F64, prim_from_shape: F64, middle: F64, *, over: bool = False
) -> F64:
    """Shape (N, 3, 4): metres from a frame about the middle of a shape. `over`: write it over `worlds`."""
    turned = prim_from_shape.copy()
    turned[:3, 3] += prim_from_shape[:3, :3] @ middle
    found = worlds if over else np.empty_like(worlds)
    with np.errstate(all="ignore"):
        for start in range(0, len(worlds), _SOME):
            some = metres_from_stage[:3, :3] @ worlds[start : start + _SOME] @ turned
            some[:, :, 3] += metres_from_stage[:3, 3]
            found[start : start + _SOME] = some
    return found


def _judged(worlds: F64, frame: tuple[F64, F64, F64], half: F64) -> tuple[NDArray[np.bool_], NDArray[np.int8]]:
    """Whether a box about the frame's origin stays within `LARGEST`; 1, -1 where a transform mirrors, 0 where it
    flattens. Each of shape (N,). `frame`: as `in_metres` is told."""
    finite, sense = np.zeros(len(worlds), bool), np.zeros(len(worlds), np.int8)
    with np.errstate(all="ignore"):
        for start in range(0, len(worlds), _SOME):
            some = in_metres(worlds[start : start + _SOME], *frame)
            linear = some[:, :, :3]
            reach = np.abs(some[:, :, 3]) + np.abs(linear) @ half
            volume = (linear[:, 0] * np.cross(linear[:, 1], linear[:, 2])).sum(axis=1)
            edges = np.linalg.norm(linear, axis=1).prod(axis=1)
            finite[start : start + _SOME] = (reach < LARGEST).all(axis=1)
            sense[start : start + _SOME] = np.where(np.abs(volume) > FLAT * edges, np.sign(volume), 0)
    return finite, sense


def _rank(matrices: F64) -> Index:
    """How many dimensions transforms leave; a line and a point have no area to draw."""
    sizes = np.linalg.svd(matrices[:, :, :3], compute_uv=False)
    return np.asarray((sizes > 1e-12 * np.maximum(sizes[:, :1], 1e-300)).sum(axis=1) * (sizes[:, 0] > 0.0))


# --- bounds and records ---------------------------------------------------------------------------------------------


def bounds_of_group(group: Group) -> tuple[F64, F64]:
    """Lowest and highest corner [m] of all places, exactly: only those whose boxes stand out are measured."""
    points = group.part.shape.points.astype(np.float64) - group.middle
    half = np.abs(points).max(axis=0)
    low, high = np.empty(3), np.empty(3)
    for axis in range(3):
        rows = group.matrices[:, axis]
        reach = np.abs(rows[:, :3]) @ half
        high[axis] = _highest(rows, rows[:, 3] + reach, points)
        low[axis] = -_highest(-rows, reach - rows[:, 3], points)
    return low, high


def _highest(rows: F64, at_most: F64, points: F64) -> float:
    """The largest coordinate along one axis. `rows`: shape (N, 4) of transforms; `at_most`: shape (N,), of boxes."""
    best = -np.inf
    order = np.argsort(-at_most)
    for start in range(0, len(order), _LOOKED_AT):
        some = order[start : start + _LOOKED_AT]
        some = some[at_most[some] > best]
        if not len(some):
            break
        best = max(best, float(((rows[some, :3] @ points.T).max(axis=1) + rows[some, 3]).max()))
    return best


class Bodies:
    """Meshes in frames of their own, each array made once, so that all records of a shape share it."""

    def __init__(self) -> None:
        self._shapes: dict[int, Shape] = {}
        """Which keeps their addresses their own"""
        self._points: dict[int, F32] = {}
        self._normals: dict[int, F32 | None] = {}

    def instances(self, group: Group, centre: F64) -> Instances:
        """A group in engine world."""
        shape = group.part.shape
        if id(shape) not in self._shapes:
            self._shapes[id(shape)] = shape
            self._points[id(shape)] = (shape.points.astype(np.float64) - group.middle).astype(np.float32)
            self._normals[id(shape)] = None if shape.normals is None else spread(shape.normals)
        transforms = np.empty(group.matrices.shape, np.float32)
        transforms[:, :, :3] = group.matrices[:, :, :3]
        transforms[:, :, 3] = group.matrices[:, :, 3] - centre
        mesh = Mesh(
            path=group.paths[0],
            points=self._points[id(shape)],
            triangles=shape.triangles,
            materials=group.part.materials,
            normals=self._normals[id(shape)],
            primvars=group.part.primvars,
            double_sided=shape.double_sided,
            closed=shape.closed,
            static=group.static,
            inside_out=shape.inside_out,
        )
        return Instances(mesh, transforms, group.paths, group.primvars)


def bounds_of_cloud(cloud: Cloud) -> tuple[F64, F64]:
    """Lowest and highest corner [m]."""
    low: F64 = (cloud.centres - cloud.radii[:, None]).min(axis=0)
    high: F64 = (cloud.centres + cloud.radii[:, None]).max(axis=0)
    return low, high


def to_balls(cloud: Cloud, centre: F64) -> Balls:
    """Spheres in engine world."""
    return Balls(
        (cloud.centres - centre).astype(np.float32), cloud.radii.astype(np.float32), cloud.material, cloud.paths,
        cloud.primvars, cloud.static,
    )  # fmt: skip

