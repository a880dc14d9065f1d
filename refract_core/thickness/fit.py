"""Which refraction model suits a mesh: what its triangles enclose, and how near that is to a ball or a box.

    open                                   thin     a pane or a single-walled shell: light leaves where it entered
    closed and convex, like a ball         sphere   thickness is the ball's diameter
    closed and convex, like a box          box      thickness is the box's smallest side
    closed, one shell inside another,
      or walls thin against the whole      traced   a bottle, a bulb, a drinking glass: whatever stands in it is seen
    anything else                          traced   the real mesh

What is hollow has two walls, and each bends light. `thin` makes a pane of every one of them, and what the vessel holds
is gone from the picture.

Pure numpy on plain arrays, in whatever unit the points have.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..models import Behind, Model, model_for
from ..scene import F64
from ..world.solid import across, crossings, is_convex, mean_way, signed_volume

SPHERE_RESIDUAL = 0.05
"""A ball: root mean square distance of the surface from the best sphere, against its radius."""
BOX_RESIDUAL = 0.04
"""A box: root mean square distance of the surface from the nearest side of its box, against the smallest side."""
CAVITY_WALL = 0.3
"""Hollow: the median wall, measured along the inward normal, is under this part of the smallest side, ..."""
CAVITY_SHARE = 0.25
"""... and from this part of the surface the way inwards crosses a gap wider than the wall; ..."""
SHEET_WALL = 0.1
"""... or the median wall is under this part of the smallest side, ..."""
SHEET = 0.75
"""... and twice the volume over the area is at least this part of it: 1 for a sheet, 1/2 for a rod, 1/3 for a ball."""
SAME_THICKNESS = 0.05
"""Relative difference up to which two thicknesses count as one."""

_WELD = 1.0e-6
"""Points nearer than this, against the diagonal, are one."""
_PARTS = 64
"""Of more separate parts than this, as many are looked at, spread over all."""
_RAYS = 256
_TESTS = 4_000_000
"""Ray-triangle tests spent on one part."""

_BALL, _BOX, _WALL, _ANY = map(model_for, (Behind.BALL, Behind.SLAB, Behind.SHEET, Behind.MESH))
"""The models that suit."""

Index = NDArray[np.int64]


@dataclass(frozen=True)
class Fit:
    """What suits a mesh."""

    model: Model
    thickness: float
    """sphere: diameter; box: smallest side; otherwise the smallest side of the box around it. 0 for nothing at all."""
    closed: bool
    convex: bool
    why: str
    """A few words for a person."""
    way: float = 0.0
    """Mean way through it (`solid.mean_way`); 0 where it is open."""


def fit(points: F64, triangles: NDArray[np.integer]) -> Fit:
    """The model that suits a mesh of one or more parts.

    Args:
        points: shape (V, 3).
        triangles: shape (T, 3), counter-clockwise seen from outside; if a closed part is inside out, so is its volume.
    """
    points, corners = _welded(np.asarray(points, np.float64), np.asarray(triangles, np.int64))
    if not len(corners):
        return Fit(_WALL, 0.0, False, False, "no triangles")
    found = _fit(points, corners)
    return replace(found, way=mean_way(points, corners)) if found.closed else found


def _fit(points: F64, corners: Index) -> Fit:
    """The same of points that are one where they touch, and triangles that have an area."""
    if not _is_closed(corners):
        return Fit(_WALL, _smallest_side(points[np.unique(corners)]), False, False, "open")
    parts = _parts(corners, len(points))
    if len(parts) > _PARTS:
        parts = [parts[int(place)] for place in np.linspace(0, len(parts) - 1, _PARTS)]
    volumes = [signed_volume(points, part) for part in parts]
    largest = max(volumes, key=abs)
    outer = parts[volumes.index(largest)]
    turned = [part for part, volume in zip(parts, volumes, strict=True) if volume * largest < 0.0]
    if any(_inside(points, part, outer) for part in turned):
        side = _smallest_side(points[np.unique(corners)])
        return Fit(_ANY, side, True, False, "hollow: a shell inside a shell")
    return together([_fit_part(points, part) for part in parts])


def together(fits: Sequence[Fit]) -> Fit:
    """The one model that suits all: theirs where they agree, else traced. Thickness is their median."""
    if len(fits) == 1:
        return fits[0]
    models = {one.model for one in fits}
    thickness = float(np.median([one.thickness for one in fits])) if fits else 0.0
    closed, convex = all(one.closed for one in fits), all(one.convex for one in fits)
    if len(models) == 1:
        whys = list(dict.fromkeys(one.why for one in fits))
        worst = max(whys, key=lambda why: (len(why), why))
        why = worst if len(whys) == 1 else f"{len(fits)} shapes, the worst of which: {worst}"
        return Fit(fits[0].model, thickness, closed, convex, why)
    counts = {model: sum(one.model is model for one in fits) for model in sorted(models)}
    named = ", ".join(f"{count} {model.token}" for model, count in counts.items())
    return Fit(_ANY, thickness, closed, convex, f"its shapes differ: {named}")


def alike(thicknesses: Sequence[float]) -> bool:
    """All of them may be written as one number."""
    return not thicknesses or max(thicknesses) - min(thicknesses) <= SAME_THICKNESS * max(thicknesses)


# --- topology -------------------------------------------------------------------------------------------------------


def _welded(points: F64, corners: Index) -> tuple[F64, Index]:
    """Points at the same place made one, and triangles without area left out."""
    if not len(corners):
        return points, corners
    used = points[corners.ravel()]
    low = used.min(axis=0)
    diagonal = float(np.linalg.norm(used.max(axis=0) - low))
    cells = np.round((points - low) / (max(diagonal, 1.0e-300) * _WELD)).astype(np.int64)
    cells = np.clip(cells, 0, 1 << 20) @ np.array([1 << 42, 1 << 21, 1])  # points outside are not used
    _, first, number = np.unique(cells, return_index=True, return_inverse=True)
    merged = number.reshape(-1)[corners]
    flat = (merged[:, 0] == merged[:, 1]) | (merged[:, 1] == merged[:, 2]) | (merged[:, 2] == merged[:, 0])
    return points[first], merged[~flat]


def _is_closed(corners: Index) -> bool:
    """Every edge is used as often in one direction as in the other."""
    starts = corners.ravel()
    ends = np.roll(corners, -1, axis=1).ravel()
    low, high = np.minimum(starts, ends), np.maximum(starts, ends)
    edges, number = np.unique(low * (corners.max() + 1) + high, return_inverse=True)
    balance = np.zeros(len(edges), np.int64)
    np.add.at(balance, number.reshape(-1), np.where(starts < ends, 1, -1))
    return not balance.any()


def _parts(corners: Index, count: int) -> list[Index]:
    """Triangles by connected part, in the order of their first triangle."""
    labels = np.arange(count)
    while True:
        lowest = labels[corners].min(axis=1)
        before = labels.copy()
        for side in range(3):
            np.minimum.at(labels, corners[:, side], lowest)
        labels = labels[labels]
        if np.array_equal(labels, before):
            break
    of_triangle = labels[corners[:, 0]]
    order = np.argsort(of_triangle, kind="stable")
    cuts = np.flatnonzero(np.diff(of_triangle[order])) + 1
    return np.split(corners[order], cuts)


def _inside(points: F64, inner: Index, outer: Index) -> bool:
    """By bounding boxes: the first part lies within the second."""
    a, b = points[inner.ravel()], points[outer.ravel()]
    return bool((a.min(axis=0) >= b.min(axis=0)).all() and (a.max(axis=0) <= b.max(axis=0)).all())


# --- one closed part ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Surface:
    """One closed part, facing outwards."""

    points: F64
    """shape (V, 3)"""
    corners: Index
    """shape (T, 3)"""
    normals: F64
    """shape (T, 3): unit"""
    areas: F64
    """shape (T,)"""
    samples: F64
    """shape (T, 4, 3): the corners of every triangle, and its middle"""


def _surface(points: F64, corners: Index) -> _Surface:
    """A closed part about its own middle, turned outwards, without triangles of no area."""
    used, number = np.unique(corners, return_inverse=True)
    corners = number.reshape(-1, 3)
    points = points[used] - points[used].mean(axis=0)
    if signed_volume(points, corners) < 0.0:
        corners = corners[:, ::-1]
    around = points[corners]
    normals = across(around)
    lengths = np.linalg.norm(normals, axis=1)
    keep = lengths > 0.0
    around, corners = around[keep], corners[keep]
    samples = np.concatenate((around, around.mean(axis=1, keepdims=True)), axis=1)
    return _Surface(points, corners, normals[keep] / lengths[keep, None], lengths[keep] / 2.0, samples)


def _fit_part(points: F64, corners: Index) -> Fit:
    """What suits one closed part: convex ones may be balls or boxes, others hollow."""
    part = _surface(points, corners)
    if not len(part.corners):
        return Fit(_WALL, 0.0, True, False, "closed, but without a volume")
    if is_convex(part.points, part.corners):
        diameter, round_off = _sphere(part)
        if round_off <= SPHERE_RESIDUAL:
            return Fit(_BALL, diameter, True, True, f"closed, convex, a ball within {_percent(round_off)}")
        side, box_off = _box(part)
        if box_off <= BOX_RESIDUAL:
            return Fit(_BOX, side, True, True, f"closed, convex, a box within {_percent(box_off)}")
        off = f"ball {_percent(round_off)}, box {_percent(box_off)} off"
        return Fit(_ANY, side, True, True, f"closed, convex, neither a ball nor a box ({off})")
    side, _ = _box(part)
    wall, share = _walls(part)
    sheet = 2.0 * signed_volume(part.points, part.corners) / float(part.areas.sum()) >= SHEET * wall
    if (wall <= SHEET_WALL * side and sheet) or (wall <= CAVITY_WALL * side and share >= CAVITY_SHARE):
        return Fit(_ANY, side, True, False, f"hollow: walls of {_percent(wall / side)} of its smallest side")
    return Fit(_ANY, side, True, False, "closed, not convex")


def _percent(value: float) -> str:
    return f"{100.0 * value:.1f} %"


def _weights(part: _Surface) -> F64:
    """Area of each of the four samples of a triangle, shape (T, 4), summing to 1."""
    spread = np.repeat(part.areas[:, None] / 4.0, 4, axis=1)
    weights: F64 = spread / spread.sum()
    return weights


def _sphere(part: _Surface) -> tuple[float, float]:
    """Diameter of the least-squares sphere, and the rms distance of the surface from it against its radius."""
    samples, weights = part.samples.reshape(-1, 3), _weights(part).ravel()
    root = np.sqrt(weights)
    system = np.column_stack((2.0 * samples, np.ones(len(samples)))) * root[:, None]
    answer, *_ = np.linalg.lstsq(system, (samples**2).sum(axis=1) * root, rcond=None)
    radius = math.sqrt(max(float(answer[3] + answer[:3] @ answer[:3]), 0.0))
    if radius == 0.0:
        return 0.0, math.inf
    away = np.linalg.norm(samples - answer[:3], axis=1) - radius
    # The corners of a tessellated ball lie on it, its faces inside: the ball meant is the one through the corners.
    outer = float(np.linalg.norm(part.points - answer[:3], axis=1).mean())
    return 2.0 * outer, math.sqrt(float(weights @ away**2)) / radius


def _box(part: _Surface) -> tuple[float, float]:
    """Smallest side of the box along the surface's own directions, and the rms distance of the surface from it."""
    axes = _axes(part.normals, part.areas)
    along = part.samples.reshape(-1, 3) @ axes.T
    low, high = along.min(axis=0), along.max(axis=0)
    side = float((high - low).min())
    if side <= 0.0:
        return 0.0, math.inf
    away = np.minimum(along - low, high - along).min(axis=1)
    return side, math.sqrt(float(_weights(part).ravel() @ away**2)) / side


def _axes(normals: F64, areas: F64) -> F64:
    """Three directions at right angles, shape (3, 3): the one most area looks along, then the next at a right angle."""
    first = _commonest(normals, areas)
    flat = normals - np.outer(normals @ first, first)
    lengths = np.linalg.norm(flat, axis=1)
    across = lengths > 0.5
    if across.any():
        second = _commonest(flat[across] / lengths[across, None], areas[across])
        second -= (second @ first) * first
    else:
        second = np.cross(first, np.eye(3)[int(np.argmin(np.abs(first)))])
    second /= np.linalg.norm(second)
    return np.stack((first, second, np.cross(first, second)))


def _commonest(normals: F64, areas: F64) -> F64:
    """The direction, up to its sign, that most area shares."""
    signs = np.where(normals[np.arange(len(normals)), np.abs(normals).argmax(axis=1)] < 0.0, -1.0, 1.0)
    cells = np.round(normals * signs[:, None] * 50.0 + 64.0).astype(np.int64) @ np.array([1 << 14, 1 << 7, 1])
    number = np.unique(cells, return_inverse=True)[1].reshape(-1)
    chosen = number == int(np.bincount(number, areas).argmax())
    mean = (normals[chosen] * (signs[chosen] * areas[chosen])[:, None]).sum(axis=0)
    direction: F64 = mean / np.linalg.norm(mean)
    return direction


def _smallest_side(points: F64) -> float:
    return float(np.ptp(points, axis=0).min()) if len(points) else 0.0


# --- walls ----------------------------------------------------------------------------------------------------------


def _walls(part: _Surface) -> tuple[float, float]:
    """Median wall along the inward normal, and the part of the surface from where a gap wider than the wall follows."""
    count = int(min(_RAYS, max(32, _TESTS // len(part.corners))))
    # Even steps through the summed area: every ray stands for the same share of the surface.
    sums = np.cumsum(part.areas)
    chosen = np.minimum(np.searchsorted(sums, (np.arange(count) + 0.5) / count * sums[-1]), len(sums) - 1)
    # The middle of a triangle often looks at the middle or an edge of the one opposite: stand a little beside it.
    origins = np.einsum("rcx,c->rx", part.samples[chosen, :3], np.array([0.34, 0.35, 0.31]))
    middles = part.samples[:, 3]
    reach = ((part.samples[:, :3] - middles[:, None]) ** 2).sum(axis=2).max(axis=1)
    squares = (middles**2).sum(axis=1)
    walls: list[float] = []
    gaps = 0
    for face, origin in zip(chosen.tolist(), origins, strict=True):
        direction = -part.normals[face]
        # Only triangles whose bounding sphere the ray meets; the slack covers rounding.
        away = squares - 2.0 * (middles @ origin) + origin @ origin
        along = middles @ direction - origin @ direction
        near = np.flatnonzero(away - along**2 <= reach * 1.001 + 1.0e-9 * squares)
        hits, _ = crossings(part.samples[near[near != face], :3], origin, direction)
        if not len(hits):
            continue
        walls.append(float(hits[0]))
        gaps += len(hits) > 1 and float(hits[1] - hits[0]) > walls[-1]
    return (float(np.median(walls)), gaps / count) if walls else (math.inf, 0.0)
