"""Pixels that their corners do not tell: edges, each with samples of its own (docs/decisions/corners.md)."""

from __future__ import annotations

import math

from ..kernels.compile import flag, inlined
from ..kernels.sampling import Key
from ..kernels.vec import dot, row, sub
from ..view.camera import View, pixel_point, pixel_ray
from ..view.planes import Planes
from ..world.tables import World
from .crossing import Rules
from .patch import ALL_SAMPLES, CornerScratch, Refining
from .pixels import add_glass, add_light, keep_glass, keep_place
from .rays import Rays
from .tiers import Asking
from .tree import CELL, SLOTS, Cell, TreeScratch, follow, start

_ALL = flag(True)
_PER_TOLERANCE = 0.8
"""Samples, to the power of 3/4, for each tolerance that corners differ by."""
_EDGE_ON = 0.1
"""Cosine below which a surface is seen too slantingly to say where it is elsewhere."""


@inlined
def expected_error(contrast: float, samples: int) -> float:
    """By how much a pixel is off, to the eye, that is made of so many samples or corners.

    The error of n samples spread evenly over a pixel that an edge cuts falls with n^(3/4) (Mitchell, "Consequences of
    stratified sampling in graphics", SIGGRAPH 1996).
    """
    return _PER_TOLERANCE * contrast / samples**0.75


@inlined
def set_for(refining: Refining, contrast: float) -> int:
    """The smallest set of samples that is enough for an edge of this contrast."""
    for k in range(ALL_SAMPLES):
        if expected_error(contrast, refining.sets[k + 1] - refining.sets[k]) <= refining.tolerance:
            return k
    return ALL_SAMPLES


@inlined
def draw_edges(
    scratch: TreeScratch, own: CornerScratch, world: World, asking: Asking, rules: Rules, view_ray: Rays,
    refining: Refining, view: View, planes: Planes, edges: int,
) -> None:  # fmt: skip
    """Draw the pixels of `own.edges`, all samples of one after the other."""
    count = 0
    for k in range(edges):
        first, end = refining.sets[own.sets[k]], refining.sets[own.sets[k] + 1]
        x, y = own.edges[k] % view.size[0], own.edges[k] // view.size[0]
        for place in range(first, end):
            own.places[count], own.times[count] = place, refining.samples / (end - first)
            count = start_sample(scratch, view, view_ray, refining, count, x, y, place, first)
            if count == CELL:
                _draw_samples(scratch, own, world, asking, rules, refining, view, planes, count)
                count = 0
    if count > 0:
        _draw_samples(scratch, own, world, asking, rules, refining, view, planes, count)
    for k in range(edges):
        taken = refining.sets[own.sets[k] + 1] - refining.sets[own.sets[k]]
        x, y = own.edges[k] % view.size[0], own.edges[k] // view.size[0]
        planes.confidence[y, x] *= 1.0 - min(1.0, expected_error(own.contrast[k], taken))


@inlined
def start_sample(
    scratch: TreeScratch, view: View, view_ray: Rays, refining: Refining, count: int, x: int, y: int, place: int,
    first: int,
) -> int:  # fmt: skip
    """Put a sample of a pixel on the stack of `count` rays; its slot comes after those of the corners. `place`: row of
    `refining.offsets`, and `first` that of its set."""
    px, py = x + 0.5 + refining.offsets[place, 0], y + 0.5 + refining.offsets[place, 1]
    scratch.cell.spread[SLOTS + count] = view.spread / math.sqrt(refining.samples)
    return start(scratch, view, view_ray, count, SLOTS + count, px, py, Key(x, y, 0, place - first))


@inlined
def _depth_in_middle(view: View, cell: Cell, slot: int, px: float, py: float, dx: float, dy: float) -> float:
    """z_depth in the middle of a pixel of the surface that a sample beside it has met, as if it were flat [m]."""
    z = cell.z_depth[slot]
    if z == math.inf:
        return z
    point, normal = pixel_point(view, px + dx, py + dy, z), row(cell.normal, slot)
    origin, direction, cosine = pixel_ray(view, px, py)
    facing = dot(direction, normal)
    if abs(facing) < _EDGE_ON:
        return z
    return dot(sub(point, origin), normal) / facing * cosine


@inlined
def _draw_samples(
    scratch: TreeScratch, own: CornerScratch, world: World, asking: Asking, rules: Rules, refining: Refining,
    view: View, planes: Planes, count: int,
) -> None:  # fmt: skip
    """Follow the samples on the stack, and add them to their pixels."""
    follow(scratch, world, asking, rules, view, count, _ALL, refining.sample_rays)
    cell = scratch.cell
    for k in range(count):
        slot = SLOTS + k
        x, y = cell.x[slot], cell.y[slot]
        add_light(planes, cell, slot, x, y, own.times[k])
        if cell.glass[slot] != 0:
            add_glass(planes, cell, slot, x, y, own.times[k])
        if cell.sample[slot] == 0:
            offset = refining.offsets[own.places[k]]
            cell.z_depth[slot] = _depth_in_middle(view, cell, slot, x + 0.5, y + 0.5, offset[0], offset[1])
            keep_place(planes, cell, slot, x, y)
            if cell.glass[slot] != 0:
                keep_glass(planes, cell, slot, x, y)

