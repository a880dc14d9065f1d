"""Parts at their places: the stage's world in float64, then engine world in float32."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...scene import F32, F64, Mesh, Notice, Sphere
from .parts import Part, Tables, instance_values
from .primvars import LARGEST, Corners, spread
from .traverse import Placement
from .triangulate import has_area, turned_over

FLAT = 1.0e-12
"""Volume of a transformed cube, relative to its edges, under which the transform flattens."""
BEYOND = "skipped: its transform is not finite or takes it beyond 1e15 m"
NOTHING_LEFT = "skipped: its transform has a scale of 0"
ROUND = 1.0e-6
"""Relative deviation up to which a transform counts as rotation and uniform scale."""


class Placed(NamedTuple):
    """A part at a place, in metres and Y up, not yet moved to the scene's centre."""

    part: Part
    placement: Placement
    points: F64
    """shape (V, 3) [m]; of a sphere, its centre (1, 3)"""
    linear: F64
    """shape (3, 3), metres from shape space"""
    sense: int
    """1, -1 where `linear` mirrors, 0 where it flattens"""
    primvars: dict[str, F32]
    """What the instancer says of this one"""
    radius: float = 0.0
    """[m]; > 0: an exact sphere"""


def place(part: Part, placement: Placement, metres_from_stage: F64, tables: Tables) -> Placed | None:
    """Transforms a part to the one place of a placement; None, with a notice, where that leaves nothing to draw.

    Args:
        metres_from_stage: shape (4, 4), column vectors: turns Y up and scales
    """
    matrix = metres_from_stage @ _square(placement.worlds[0]) @ part.shape.prim_from_shape
    linear, origin = matrix[:3, :3], matrix[:3, 3]
    extra = _of_instance(part, placement, tables)
    if part.is_ball:
        radius = uniform_scale(linear)
        if 0.0 < radius < LARGEST and np.abs(origin).max() < LARGEST:
            return Placed(part, placement, origin[None], linear, 1, extra, radius)
    # An infinite or NaN transform is told by its result.
    with np.errstate(all="ignore"):
        points = part.shape.points @ linear.T + origin
    if not (points.min() > -LARGEST and points.max() < LARGEST):
        tables.notices.append(Notice(placement.path, BEYOND))
        return None
    sense = _sense(linear)
    if sense == 0 and not has_area(points, part.shape.triangles.astype(np.int64)).any():
        tables.notices.append(Notice(placement.path, NOTHING_LEFT))
        return None
    return Placed(part, placement, points, linear, sense, extra)


def _sense(linear: F64) -> int:
    """Whether a matrix keeps handedness (1), mirrors (-1) or flattens (0)."""
    (a, b, c), (d, e, f), (g, h, i) = linear.tolist()
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    edges = math.hypot(a, d, g) * math.hypot(b, e, h) * math.hypot(c, f, i)
    return 0 if abs(determinant) <= FLAT * edges else int(math.copysign(1.0, determinant))


def uniform_scale(linear: F64, tolerance: float = ROUND) -> float:
    """Scale of a (3, 3) matrix that only turns, mirrors and scales evenly, up to a relative `tolerance`; else 0."""
    squared = linear.T @ linear
    scale = float(np.trace(squared)) / 3.0
    if not np.isfinite(scale) or np.abs(squared - scale * np.eye(3)).max() > tolerance * scale:
        return 0.0
    return float(np.sqrt(scale))


def bounds_of(placed: list[Placed]) -> tuple[F64, F64] | None:
    """Lowest and highest corner [m] of everything; None where there is nothing."""
    if not placed:
        return None
    low = np.min([item.points.min(axis=0) - item.radius for item in placed], axis=0)
    high = np.max([item.points.max(axis=0) + item.radius for item in placed], axis=0)
    return low, high


def to_sphere(item: Placed, centre: F64) -> Sphere:
    """An exact sphere in engine world."""
    x, y, z = (item.points[0] - centre).tolist()
    return Sphere(
        path=item.placement.path,
        centre=(x, y, z),
        radius=item.radius,
        material=int(item.part.materials[0]),
        primvars=item.part.primvars | item.primvars,
        static=item.placement.static and not item.part.shape.varying,
    )


def to_mesh(item: Placed, centre: F64) -> Mesh:
    """Triangles in engine world, rounded to float32 only after the move to the centre."""
    shape = item.part.shape
    primvars, triangles = item.part.primvars, shape.triangles
    if item.sense < 0:
        triangles = turned_over(triangles)
        primvars = {
            name: values if values.shape[:2] == (1, 1) else turned_over(values) for name, values in primvars.items()
        }
    return Mesh(
        path=item.placement.path,
        points=(item.points - centre).astype(np.float32),
        triangles=triangles,
        materials=item.part.materials,
        normals=_normals(shape.normals, item),
        primvars=primvars | item.primvars,
        double_sided=shape.double_sided,
        closed=shape.closed,
        static=item.placement.static and not shape.varying,
        inside_out=shape.inside_out,
    )


def _normals(normals: Corners | None, item: Placed) -> F32 | None:
    """Unit normals per corner by the inverse transpose; None (flat) where the transform flattens."""
    if normals is None or item.sense == 0:
        return None
    turned = normals.values.astype(np.float64) @ np.linalg.inv(item.linear)
    turned /= np.sqrt((turned**2).sum(axis=1, keepdims=True))
    return spread(Corners(turned.astype(np.float32), normals.rows), mirrored=item.sense < 0)


def _square(world: F64) -> F64:
    """A transform of shape (3, 4) as (4, 4)."""
    return np.vstack([world, [0.0, 0.0, 0.0, 1.0]])


def _of_instance(part: Part, placement: Placement, tables: Tables) -> dict[str, F32]:
    """Primvars a point instancer gives its instance and the prim has not itself."""
    return {name: values[0].reshape(1, 1, -1) for name, values in of_instances(part, placement, tables).items()}


def of_instances(part: Part, placement: Placement, tables: Tables) -> dict[str, F32]:
    """The same for all places of a placement: name -> shape (N, D). What not all of them have is left out."""
    if placement.instance is None:
        return {}
    instancer, numbers = placement.instance
    found = {}
    for name in part.wanted - part.primvars.keys():
        values = instance_values(instancer, name, tables)
        if values is not None and numbers.max() < len(values):
            found[name] = values[numbers]
    return found
