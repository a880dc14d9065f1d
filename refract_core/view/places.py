"""Places that the camera sees, with glass left out."""

from __future__ import annotations

from ..kernels.arrays import F64_2D
from ..kernels.compile import kernel
from ..kernels.lanes import LANES
from ..world.embree import COHERENT, OPAQUE, clear
from ..world.gathering import GatherScratch, note_hits
from ..world.tables import World
from ..world.tracing import intersect_world
from .camera import View
from .gbuffer import add_view_ray


@kernel
def seen_places(
    world: World, view: View, scratch: GatherScratch, first: int, last: int, point: F64_2D, normal: F64_2D
) -> None:
    """Fill rows of `point` [m] and `normal`, a row for each pixel of the picture's lines `first` to before `last`; a
    normal is zero where nothing is."""
    width = view.size[0]
    for start in range(first * width, last * width, LANES):
        clear(scratch.packet)
        count = min(LANES, last * width - start)
        for lane in range(count):
            x, y = (start + lane) % width, (start + lane) // width
            scratch.far[lane] = add_view_ray(scratch.packet, view, lane, x + 0.5, y + 0.5, OPAQUE)
        intersect_world(scratch.packet, world, scratch.far, COHERENT)
        note_hits(scratch.block, scratch.packet, world, start, count, point, normal)
