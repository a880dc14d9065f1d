"""Sums of view rays into the planes of a picture; and a picture drawn sample by sample, the same everywhere."""

from __future__ import annotations

from ..kernels.compile import flag, inlined, kernel, word
from ..kernels.lanes import BLOCK_HEIGHT, BLOCK_WIDTH, LANES
from ..kernels.sampling import Key
from ..view.camera import Tile, View
from ..view.gbuffer import OpaqueLayer
from ..view.planes import Planes
from ..world.tables import World
from .answers import keep_answers
from .crossing import Rules
from .rays import Rays
from .tiers import NONE, PROBE, RAY, SCREEN, SKY, Asking
from .tree import Cell, TreeScratch, clear_slot, follow, start

SIDE = 8
"""Pixels along the side of a cell."""
_GLASS_ONLY, _ONE_RAY = flag(False), word(1)


@kernel
def tree_tile(
    world: World,
    asking: Asking,
    rules: Rules,
    view_ray: Rays,
    scratch: TreeScratch,
    tile: Tile,
    sample: int,
    opaque: OpaqueLayer,
    planes: Planes,
) -> int:
    """Add one sample of a tile to `planes`: trees where there is glass, the opaque picture elsewhere.

    Args:
        view_ray: one row, what every view ray starts as (`eye.view_ray`).

    Returns:
        Rays traced.
    """
    view = asking.screen.camera
    scratch.packet.tally[0] = scratch.work.packet.tally[0] = 0
    keep_answers(scratch.answers, False)
    for y0 in range(tile[1], tile[3], SIDE):
        for x0 in range(tile[0], tile[2], SIDE):
            count = _start_cell(scratch, view, view_ray, opaque, x0, y0, sample)
            if count > 0:
                follow(scratch, world, asking, rules, view, count, _GLASS_ONLY, _ONE_RAY)
            _add_cell(planes, scratch.cell, opaque, view, x0, y0, sample)
    return scratch.packet.tally[0] + scratch.work.packet.tally[0]


@inlined
def _start_cell(
    scratch: TreeScratch, view: View, view_ray: Rays, opaque: OpaqueLayer, x0: int, y0: int, sample: int
) -> int:
    """Put the view rays of a cell that see glass on the stack, block by block. Returns how many."""
    count = 0
    for k in range(SIDE * SIDE):
        block, lane = k // LANES, k % LANES
        i = block % (SIDE // BLOCK_WIDTH) * BLOCK_WIDTH + lane % BLOCK_WIDTH
        j = block // (SIDE // BLOCK_WIDTH) * BLOCK_HEIGHT + lane // BLOCK_WIDTH
        x, y, slot = x0 + i, y0 + j, j * SIDE + i
        if x >= view.size[0] or y >= view.size[1]:
            continue
        if opaque.glass[y, x] == 0 and view_ray.media.depth[0] == 0:
            clear_slot(scratch.cell, slot)
        else:
            scratch.cell.spread[slot] = view.spread
            count = start(scratch, view, view_ray, count, slot, x + 0.5, y + 0.5, Key(x, y, 0, sample))
    return count


@inlined
def _add_cell(planes: Planes, cell: Cell, opaque: OpaqueLayer, view: View, x0: int, y0: int, sample: int) -> None:
    """Add a cell's sums to the planes, and the opaque picture where there is no glass."""
    for i in range(SIDE * SIDE):
        x, y = x0 + i % SIDE, y0 + i // SIDE
        if x >= view.size[0] or y >= view.size[1]:
            continue
        if cell.glass[i] != 0:
            add_light(planes, cell, i, x, y, 1.0)
            add_glass(planes, cell, i, x, y, 1.0)
            if sample == 0:
                keep_glass(planes, cell, i, x, y)
                keep_place(planes, cell, i, x, y)
            continue
        for c in range(4):
            planes.beauty[y, x, c] += opaque.color[y, x, c]
        if sample == 0:
            planes.z_depth[y, x] = opaque.depth[y, x]
            for c in range(3):
                planes.normal[y, x, c] = opaque.normal[y, x, c]


@inlined
def forget_pixel(planes: Planes, x: int, y: int) -> None:
    """Nothing is known of a pixel yet."""
    for c in range(3):
        planes.beauty[y, x, c] = planes.refraction[y, x, c] = planes.reflection[y, x, c] = 0.0
        planes.transmittance[y, x, c] = planes.normal[y, x, c] = 0.0
    planes.beauty[y, x, 3] = planes.mask[y, x] = planes.confidence[y, x] = 0.0
    planes.screen[y, x] = planes.ray[y, x] = planes.probe[y, x] = planes.sky[y, x] = planes.none[y, x] = 0.0
    planes.z_depth[y, x] = planes.thickness[y, x] = planes.path_length[y, x] = planes.layers[y, x] = 0.0


@inlined
def add_light(planes: Planes, cell: Cell, i: int, x: int, y: int, times: float) -> None:
    """Add what a view ray has seen to a pixel, `times` over."""
    for c in range(3):
        planes.beauty[y, x, c] += times * cell.color[i, c]
        planes.refraction[y, x, c] += times * cell.refraction[i, c]
        planes.reflection[y, x, c] += times * cell.reflection[i, c]
    planes.beauty[y, x, 3] += times * (1.0 - cell.missing[i])


@inlined
def add_glass(planes: Planes, cell: Cell, i: int, x: int, y: int, times: float) -> None:
    """Add what a view ray has found out about glass to a pixel, `times` over."""
    for c in range(3):
        left = cell.weight[i, c] / cell.clear[i, c] if cell.clear[i, c] > 0.0 else 1.0
        planes.transmittance[y, x, c] += times * left
    planes.mask[y, x] += times
    if cell.share[i] > 0.0:
        part = times / cell.share[i]
        planes.screen[y, x] += part * cell.tiers[i, SCREEN]
        planes.ray[y, x] += part * cell.tiers[i, RAY]
        planes.probe[y, x] += part * cell.tiers[i, PROBE]
        planes.sky[y, x] += part * cell.tiers[i, SKY]
        planes.none[y, x] += part * cell.tiers[i, NONE]
        planes.confidence[y, x] += part * cell.confidence[i]


@inlined
def keep_glass(planes: Planes, cell: Cell, i: int, x: int, y: int) -> None:
    """Leave the numbers of one view ray through glass in a pixel."""
    planes.thickness[y, x] = cell.thickness[i]
    planes.path_length[y, x] = cell.path[i]
    planes.layers[y, x] = cell.entered[i]


@inlined
def keep_place(planes: Planes, cell: Cell, i: int, x: int, y: int) -> None:
    """Leave depth and normal of what a view ray met first in a pixel."""
    planes.z_depth[y, x] = cell.z_depth[i]
    for c in range(3):
        planes.normal[y, x, c] = cell.normal[i, c]
