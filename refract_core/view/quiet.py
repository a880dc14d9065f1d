"""The opaque picture with quiet light: what stands before a light is asked where that is in doubt, and often there
(docs/decisions/corners.md).

Light that nothing stands before is known in closed form (`world.lights`, `world.environment`); what has to be found by
rays is the share of it that arrives. Of a lamp that is all or nothing nearly everywhere: one ray per place *finds*
where places disagree, and only there, in a penumbra, many are sent. Of the sky it changes slowly: it is asked in the
corners of cells, with many rays, and cells whose corners disagree are cut in four.

A place's rays belong to a net of its 4x4 neighbours, one (0,2)-sequence from which each takes its own run of points. So
neighbours complement each other. What comes out hangs on the place alone, not on how the picture is cut into tiles.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..kernels.arrays import F64_1D, F64_2D, I32_1D, I32_2D
from ..kernels.compile import inlined, kernel, word
from ..kernels.lanes import BLOCK_HEIGHT, BLOCK_WIDTH, LANES, Vectors, new_lanes, put
from ..kernels.sampling import Key, set_key
from ..kernels.vec import Vec, add, along, dot, length, lerp, mul, row, scale, sub
from ..world.embree import COHERENT, EVERYTHING, OPAQUE, clear, has_hit
from ..world.lights import has_rim
from ..world.shading import (
    LOBES,
    Block,
    add_indirect,
    add_light,
    add_light_ray,
    add_rim_ray,
    add_sky,
    add_sky_ray,
    aim_light,
    copy_lane,
    forget_light,
    load_hits,
    look_into_mirrors,
    nth,
    send_back,
    share_of_lamp,
    share_of_sky,
)
from ..world.surface import hit_in, surface_of
from ..world.tables import World
from ..world.tracing import belongs_to, intersect_world, lamp_visible, visible
from .camera import Tile, View
from .gbuffer import OpaqueLayer, ViewScratch, add_view_ray, is_refractive, keep_hits, trace_behind_glass, write_opaque

SIDE = 64
"""Pixels along the side of a tile."""
_MARGIN = 2
"""Pixels around it whose finders' rays matter; the last cells need one, too."""
_SPAN = SIDE + 1 + 2 * _MARGIN
_CELL = 8
"""Pixels between the nodes of the largest cells."""
_LEVELS = 3
_ALIKE = 0.95
"""Cosine of normals between which light is interpolated."""
_STEP_OF_LAMP = 0.05
"""Share of a lamp's light by which neighbours differ that do not see the same of it. Shadows of glass are no steps."""
_FAINT = 1.0 / 32.0
"""Share of what all lights bring up to which the last of one is not looked for: a sixteenth of it would not be seen."""
_FLAT = 0.1
"""Part of their distance by which places may lie outside of each other's plane."""
_GRAIN = 0.2, 0.5
"""Share of a lamp's light, and of the sky's, by which the mean of two places across from each other may be off what
stands between them, where that was asked by 16 rays: some three times what chance makes of them. Edges make more."""
_STEEP = 0.05, 0.25
"""And by which it may grow from pixel to pixel: the shape of a narrow half shadow is worth more than its grain."""
_SHARP, _PIXELS = 0.02, 8.0
"""GGX width from which on neighbours share what they see in mirrors [alpha]; and the angles between two pixels that it
is, at least."""
_FIRST = word(0)
"""The sample that corners are."""
_NET = 1 << 16
"""Branch of the sequences of nets."""


class QuietScratch(NamedTuple):
    """What one thread needs to light a tile; N is the places in it and around it, row by row."""

    looking: ViewScratch
    places: Block
    """N rows: their surfaces, and the light that has been found for them"""
    part: I32_1D
    """shape (N,): as `surface.surface_of`; -1 where there is nothing"""
    arrives: F64_1D
    """shape (N,): irradiance from the lamps, as the sum of its colours"""
    possible: F64_1D
    """shape (N,): the same if nothing stood before them"""
    found: F64_2D
    """shape (N, 3): what of the light the finder's ray brings, 0 .. 1; -1 where the light would bring nothing"""
    share: F64_2D
    """shape (N, 3): and what many rays bring where that is in doubt"""
    rays: I32_1D
    """shape (N,): 1 where rays were sent to the sky"""
    open: F64_2D
    """shape (N, 3): the share of it that is seen, colour by colour"""
    bright: F64_1D
    """shape (N,): what all lights would bring to the corners of cells if nothing stood before them"""
    torn: I32_1D
    """shape (N,): 1 in corners of cells from where a part of the light at hand is seen and a part is not, -1 in others
    that were asked"""
    alone: I32_1D
    """shape (N,): 1 where the share of the light at hand, or of the sky, is known by a place's own few rays; 2 where
    its rim says that it is seen in part"""
    cells: I32_2D
    """shape (64, 4): cells yet to be done: first and last column and row"""
    free: Vectors
    """what comes by each ray of a packet, 0 .. 1"""
    weight: Vectors
    """of the rays to the sky; in its first column, of those to a light"""

    @staticmethod
    def fresh() -> QuietScratch:
        """All of it at zero."""
        count = _SPAN * _SPAN
        return QuietScratch(
            new_lanes(ViewScratch), new_lanes(Block, count), np.zeros(count, np.int32), np.zeros(count),
            np.zeros(count), np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count, np.int32),
            np.zeros((count, 3)), np.zeros(count), np.zeros(count, np.int32), np.zeros(count, np.int32),
            np.zeros((64, 4), np.int32),
            np.zeros((LANES, 3)), np.zeros((LANES, 3)),
        )  # fmt: skip


class Care(NamedTuple):
    """How much is asked."""

    rays: int
    """to a lamp from a place in a penumbra, and to the sky from a node; nodes of large cells send more"""
    step: float
    """share of the sky by which the corners of a cell may differ"""


@kernel
def quiet_tile(
    world: World, view: View, scratch: QuietScratch, care: Care, tile: Tile, layer: OpaqueLayer
) -> tuple[int, int]:
    """Fill `layer` over a tile of at most 64x64 pixels. Returns (rays traced, pixels with glass before them)."""
    packet = scratch.looking.packet
    packet.tally[0] = 0
    x0, y0 = tile[0], tile[1]
    x1, y1 = min(tile[2], view.size[0]), min(tile[3], view.size[1])
    glass = _look(scratch, world, view, layer, x0, y0, x1, y1)
    _add_up(scratch, world, x1 - x0, y1 - y0)
    for l in range(world.lights.kind.shape[0]):  # noqa: E741
        _light(scratch, world, view, care, l, x0, y0, x1, y1)
    if world.environment.present and not world.environment.dark:
        _find_sky(scratch, world, view, care, x0, y0, x1, y1)
        for y in range(y0, y1):
            for x in range(x0, x1):
                i = _place(x - x0, y - y0)
                if scratch.part[i] >= 0:
                    share = row(scratch.open, i)
                    if scratch.alone[i] != 0:
                        share = _mean_around(scratch, scratch.open, i, care.rays, _GRAIN[1], _STEEP[1])
                    put(scratch.places.sky_seen, i, share)
                    add_sky(scratch.places, i, world.environment)
    for y in range(y0, y1):
        for x in range(x0, x1):
            if scratch.part[_place(x - x0, y - y0)] >= 0:
                add_indirect(scratch.places, _place(x - x0, y - y0), world)
    _send(scratch, world, view, care, layer, x0, y0, x1, y1)
    return packet.tally[0], glass


@inlined
def _place(i: int, j: int) -> int:
    """Row of the place in column i and row j of the tile."""
    return (j + _MARGIN) * _SPAN + i + _MARGIN


@inlined
def _look(
    scratch: QuietScratch, world: World, view: View, layer: OpaqueLayer, x0: int, y0: int, x1: int, y1: int
) -> int:
    """Find the surfaces of the tile and of its margin. Returns the pixels of the tile with glass before them."""
    looking, places = scratch.looking, scratch.places
    packet, block, far = looking.packet, looking.block, looking.far
    width, height = view.size[0], view.size[1]
    glass = 0
    for k in range(_SPAN * _SPAN):
        scratch.part[k] = -1
    # The margin on the left and above is as wide as a block, so that blocks stand where those of the tile do.
    for by in range(y0 - BLOCK_HEIGHT, y1 + _MARGIN + 1, BLOCK_HEIGHT):
        for bx in range(x0 - BLOCK_WIDTH, x1 + _MARGIN + 1, BLOCK_WIDTH):
            clear(packet)
            for lane in range(LANES):
                x, y = bx + lane % BLOCK_WIDTH, by + lane // BLOCK_WIDTH
                wanted = x0 - _MARGIN <= x <= x1 + _MARGIN and y0 - _MARGIN <= y <= y1 + _MARGIN
                if wanted and 0 <= x < width and 0 <= y < height:
                    far[lane] = add_view_ray(packet, view, lane, x + 0.5, y + 0.5, EVERYTHING)
                    belongs_to(packet, lane, x, y, _FIRST)
            intersect_world(packet, world, far, COHERENT)
            behind = False
            for lane in range(LANES):
                x, y = bx + lane % BLOCK_WIDTH, by + lane // BLOCK_WIDTH
                if packet.valid[lane] == 0:
                    continue
                refractive = has_hit(packet, lane) and is_refractive(world, hit_in(packet, lane, world.geometry))
                behind = behind or refractive
                if x0 <= x < x1 and y0 <= y < y1:
                    layer.glass[y, x] = 1 if refractive else 0
                    glass += 1 if refractive else 0
            if behind:
                trace_behind_glass(looking, world, view, bx, by, _FIRST)
            if x0 <= bx and y0 <= by:
                keep_hits(layer.hits, packet, world, bx, by, x1, y1)
            load_hits(block, packet, world, view.spread)
            for lane in range(LANES):
                x, y = bx + lane % BLOCK_WIDTH, by + lane // BLOCK_WIDTH
                if block.on[lane] == 0:
                    continue
                i = _place(x - x0, y - y0)
                copy_lane(places, i, block, lane)
                forget_light(places, i)
                scratch.possible[i] = scratch.arrives[i] = 0.0
                scratch.part[i] = surface_of(world.geometry, hit_in(packet, lane, world.geometry))
    return glass


@inlined
def _alike(scratch: QuietScratch, i: int, j: int, cosine: float) -> bool:
    """Two places lie on one smooth piece of a surface."""
    places = scratch.places
    if scratch.part[i] != scratch.part[j] or dot(row(places.ng, i), row(places.ng, j)) < cosine:
        return False
    between = sub(row(places.point, i), row(places.point, j))
    return abs(dot(between, row(places.ng, i))) <= _FLAT * length(between)


@inlined
def _net_key(x: int, y: int) -> Key:
    """The key of what a place sends as one of a net of 4x4."""
    turn = (x & 1) | (y & 1) << 1 | (x & 2) << 1 | (y & 2) << 2
    return Key(x >> 2, y >> 2, _NET, turn)


# --- lamps --------------------------------------------------------------------------------------------------------


@inlined
def _light(
    scratch: QuietScratch, world: World, view: View, care: Care, l: int, x0: int, y0: int, x1: int, y1: int  # noqa: E741
) -> None:
    """Add one light to every place of the tile."""
    lights, places, found = world.lights, scratch.places, scratch.found
    shadows = lights.casts_shadow[l] != 0
    _find(scratch, world, l, x0, y0, x1, y1)
    wide, tall = x1 - x0, y1 - y0
    torn = _find_torn(scratch, world, l, wide, tall)
    some = False
    for j in range(tall):
        for i in range(wide):
            k = _place(i, j)
            doubt = shadows and scratch.part[k] >= 0 and found[k, 0] >= 0.0
            between = doubt and torn and _is_between(scratch, i, j)
            doubt = between or (doubt and _in_doubt(scratch, k))
            scratch.alone[k] = 2 if between else 1 if doubt else 0
            put(scratch.share, k, row(found, k))
            if doubt:
                some = True
                put(scratch.share, k, _share_of_lamp(scratch, world, care.rays, l, k, x0 + i, y0 + j))
    if some:
        for j in range(-_MARGIN, tall + _MARGIN):
            for i in range(-_MARGIN, wide + _MARGIN):
                k = _place(i, j)
                if 0 <= i < wide and 0 <= j < tall:
                    continue
                put(scratch.share, k, row(found, k))
                if found[k, 0] >= 0.0 and _is_asked(scratch, i, j, wide, tall):
                    put(scratch.share, k, _share_of_lamp(scratch, world, care.rays, l, k, x0 + i, y0 + j))
    for y in range(y0, y1):
        for x in range(x0, x1):
            i = _place(x - x0, y - y0)
            if scratch.part[i] < 0 or found[i, 0] < 0.0:
                continue
            share = row(found, i)
            if scratch.alone[i] != 0:
                share = _mean_around(scratch, scratch.share, i, care.rays, _GRAIN[0], _STEEP[0])
            put(places.lamp_seen, i, share)
            add_light(places, i, lights, l)
            for c in range(3):
                possible = lights.radiance[l, c] * places.lamp_diffuse[i]
                scratch.possible[i] += possible
                scratch.arrives[i] += possible * share[c]


@inlined
def _find(scratch: QuietScratch, world: World, l: int, x0: int, y0: int, x1: int, y1: int) -> None:  # noqa: E741
    """Send one ray to a light from every place to which it would bring anything, the margin's too."""
    lights, places, packet = world.lights, scratch.places, scratch.looking.packet
    shadows = lights.casts_shadow[l] != 0
    for by in range(y0 - BLOCK_HEIGHT, y1 + _MARGIN, BLOCK_HEIGHT):
        for bx in range(x0 - BLOCK_WIDTH, x1 + _MARGIN, BLOCK_WIDTH):
            clear(packet)
            some = False
            for lane in range(LANES):
                x, y = bx + lane % BLOCK_WIDTH, by + lane // BLOCK_WIDTH
                if not (x0 - _MARGIN <= x < x1 + _MARGIN and y0 - _MARGIN <= y < y1 + _MARGIN):
                    continue
                i = _place(x - x0, y - y0)
                if scratch.part[i] < 0:
                    continue
                put(scratch.found, i, (-1.0, -1.0, -1.0))
                if aim_light(places, i, lights, l):
                    put(scratch.found, i, (1.0, 1.0, 1.0))
                    if shadows:
                        if add_light_ray(places, i, lights, l, packet, lane, _net_key(x, y), False) > 0.0:
                            some = True
                        else:  # it has found no point that counts
                            packet.valid[lane] = 0
            if not some:
                continue
            lamp_visible(packet, world, OPAQUE, l, scratch.free)
            for lane in range(LANES):
                x, y = bx + lane % BLOCK_WIDTH, by + lane // BLOCK_WIDTH
                if packet.valid[lane] != 0:
                    put(scratch.found, _place(x - x0, y - y0), row(scratch.free, lane))


@inlined
def _worth(scratch: QuietScratch, world: World, l: int, k: int) -> float:  # noqa: E741
    """What a light that has been aimed at a place would bring there."""
    return _largest(row(world.lights.radiance, l)) * (scratch.places.lamp_diffuse[k] + scratch.places.lamp_specular[k])


@inlined
def _add_up(scratch: QuietScratch, world: World, wide: int, tall: int) -> None:
    """Note in the corners of cells what all lights would bring."""
    for j in range(0, tall + 1, _CELL):
        for i in range(0, wide + 1, _CELL):
            k = _place(i, j)
            scratch.bright[k] = 0.0
            if scratch.part[k] < 0:
                continue
            for l in range(world.lights.kind.shape[0]):  # noqa: E741
                if aim_light(scratch.places, k, world.lights, l):
                    scratch.bright[k] += _worth(scratch, world, l, k)


@inlined
def _find_torn(scratch: QuietScratch, world: World, l: int, wide: int, tall: int) -> bool:  # noqa: E741
    """Ask in the corners of all cells whether a light's rim is seen in part, and where it is in those of their
    quarters: a neighbour's single ray finds the last twentieth of a light by chance, and deep half shadows would have
    ragged borders. Whether it is anywhere."""
    if world.lights.casts_shadow[l] == 0 or not has_rim(world.lights, l):
        return False
    for k in range(_SPAN * _SPAN):
        scratch.torn[k] = 0
    torn = False
    for j in range(0, tall + 1, _CELL):
        for i in range(0, wide + 1, _CELL):
            if _worth(scratch, world, l, _place(i, j)) > _FAINT * scratch.bright[_place(i, j)]:
                torn = _ask_rim(scratch, world, l, i, j) or torn
    if not torn:
        return False
    half = _CELL // 2
    for y in range(0, tall, _CELL):
        for x in range(0, wide, _CELL):
            if _is_torn(scratch, _place(x, y), _CELL, -1):
                for part in range(1, 9):
                    i, j = x + part % 3 * half, y + part // 3 * half
                    if (i % _CELL != 0 or j % _CELL != 0) and i <= wide and j <= tall:
                        _ask_rim(scratch, world, l, i, j)
    return True


@inlined
def _ask_rim(scratch: QuietScratch, world: World, l: int, i: int, j: int) -> bool:  # noqa: E741
    """Note and return whether a place sees a part of a light, and a part not."""
    # Corners beside each other, of cells as of quarters, look at other points.
    k, turn = _place(i, j), (i // _CELL + j // _CELL + i // (_CELL // 2) + j // (_CELL // 2)) % 2
    packet, found = scratch.looking.packet, row(scratch.found, k)
    if scratch.part[k] < 0 or found[0] < 0.0 or scratch.torn[k] != 0:
        return scratch.torn[k] > 0
    scratch.torn[k] = -1
    clear(packet)
    for lane in range(LANES):
        add_rim_ray(scratch.places, k, world.lights, l, packet, lane, turn)
    lamp_visible(packet, world, OPAQUE, l, scratch.free)
    for lane in range(LANES):
        if packet.valid[lane] != 0 and _largest(sub(row(scratch.free, lane), found)) > _STEP_OF_LAMP:
            scratch.torn[k] = 1
    return scratch.torn[k] > 0


@inlined
def _is_torn(scratch: QuietScratch, first: int, side: int, part: int) -> bool:
    """From a corner of a cell of so many pixels a side, the upper left one first, a part of the light is seen; `part`:
    from one on this piece of a surface, -1 on any."""
    for corner in range(4):
        k = first + corner % 2 * side + corner // 2 * side * _SPAN
        if scratch.torn[k] > 0 and (part < 0 or scratch.part[k] == part):
            return True
    return False


@inlined
def _is_between(scratch: QuietScratch, i: int, j: int) -> bool:
    """A place lies in a cell, and in a quarter of it, with a corner on its surface that sees a part of the light."""
    half, part = _CELL // 2, scratch.part[_place(i, j)]
    return _is_torn(scratch, _place(i // half * half, j // half * half), half, part) and _is_torn(
        scratch, _place(i // _CELL * _CELL, j // _CELL * _CELL), _CELL, part
    )


@inlined
def _in_doubt(scratch: QuietScratch, i: int) -> bool:
    """A neighbour on the same surface, at most two pixels away, sees another thing of the light."""
    for dy in range(-_MARGIN, _MARGIN + 1):
        for dx in range(-_MARGIN, _MARGIN + 1):
            j = i + dy * _SPAN + dx
            if scratch.part[j] == scratch.part[i] and scratch.found[j, 0] >= 0.0:
                for c in range(3):
                    if abs(scratch.found[j, c] - scratch.found[i, c]) > _STEP_OF_LAMP:
                        return True
    return False


@inlined
def _share_of_lamp(scratch: QuietScratch, world: World, rays: int, l: int, i: int, x: int, y: int) -> Vec:  # noqa: E741
    """The share of a light that a place gets, by many rays."""
    packet, total, weights = scratch.looking.packet, (0.0, 0.0, 0.0), 0.0
    for first in range(0, rays, LANES):
        clear(packet)
        for lane in range(min(LANES, rays - first)):
            key = nth(_net_key(x, y), first + lane, rays)
            scratch.weight[lane, 0] = add_light_ray(scratch.places, i, world.lights, l, packet, lane, key, False)
        lamp_visible(packet, world, OPAQUE, l, scratch.free)
        for lane in range(min(LANES, rays - first)):
            weights += scratch.weight[lane, 0]
            total = along(total, row(scratch.free, lane), scratch.weight[lane, 0])
    return share_of_lamp(total, weights)


# --- the sky ------------------------------------------------------------------------------------------------------


@inlined
def _find_sky(
    scratch: QuietScratch, world: World, view: View, care: Care, x0: int, y0: int, x1: int, y1: int
) -> None:
    """The share of the sky that every place of the tile sees: cells of 8x8 pixels, cut in four where they must be."""
    for k in range(_SPAN * _SPAN):
        scratch.rays[k] = scratch.alone[k] = 0
    last_x, last_y = min(x1, view.size[0] - 1), min(y1, view.size[1] - 1)
    for cy in range(y0, y1, _CELL):
        for cx in range(x0, x1, _CELL):
            cells = scratch.cells
            cells[0, 0], cells[0, 1] = cx - x0, cy - y0
            cells[0, 2], cells[0, 3] = min(cx + _CELL, last_x) - x0, min(cy + _CELL, last_y) - y0
            count = 1
            while count > 0:
                count = _do_cell(scratch, world, care, count - 1, x0, y0)
    wide, tall = x1 - x0, y1 - y0
    for j in range(-_MARGIN, tall + _MARGIN):
        for i in range(-_MARGIN, wide + _MARGIN):
            if not (0 <= i < wide and 0 <= j < tall) and _is_asked(scratch, i, j, wide, tall):
                _node(scratch, world, care, i, j, x0, y0)


@inlined
def _do_cell(scratch: QuietScratch, world: World, care: Care, top: int, x0: int, y0: int) -> int:
    """Fill the cell on top of the stack, or cut it. Returns the stack's new height."""
    cells = scratch.cells
    a, b, c, d = int(cells[top, 0]), int(cells[top, 1]), int(cells[top, 2]), int(cells[top, 3])
    if _fill(scratch, world, care, a, b, c, d, x0, y0):
        return top
    m, n = (a + c) // 2, (b + d) // 2
    for part in range(4):
        left, upper = part % 2 == 0, part // 2 == 0
        if (left and m == a and c > a) or (upper and n == b and d > b):
            continue  # a cell one pixel wide has but one half
        cells[top, 0], cells[top, 1] = (a if left else m), (b if upper else n)
        cells[top, 2], cells[top, 3] = (m if left else c), (n if upper else d)
        top += 1
    return top


@inlined
def _fill(
    scratch: QuietScratch, world: World, care: Care, a: int, b: int, c: int, d: int, x0: int, y0: int
) -> bool:
    """Fill a cell from column a to c and row b to d, if its corners agree and all in it is of one piece."""
    small = c - a <= 1 and d - b <= 1
    first = _place(a, b)
    if not small:
        if scratch.part[first] < 0:
            return False
        for j in range(b, d + 1):
            for i in range(a, c + 1):
                if not _alike(scratch, first, _place(i, j), _ALIKE):
                    return False
    low, high = (math.inf, math.inf, math.inf), (-math.inf, -math.inf, -math.inf)
    for k in range(4):
        i, j = (c if k % 2 else a), (d if k // 2 else b)
        if scratch.part[_place(i, j)] >= 0:
            share = _node(scratch, world, care, i, j, x0, y0)
            low = (min(low[0], share[0]), min(low[1], share[1]), min(low[2], share[2]))
            high = (max(high[0], share[0]), max(high[1], share[1]), max(high[2], share[2]))
    if small:
        for k in range(4):
            scratch.alone[_place(c if k % 2 else a, d if k // 2 else b)] = 1
        return True
    if max(high[0] - low[0], high[1] - low[1], high[2] - low[2]) > care.step:
        return False
    wide, tall = max(1, c - a), max(1, d - b)
    upper_left, upper_right = row(scratch.open, _place(a, b)), row(scratch.open, _place(c, b))
    lower_left, lower_right = row(scratch.open, _place(a, d)), row(scratch.open, _place(c, d))
    for j in range(b, d + 1):
        t = (j - b) / tall
        for i in range(a, c + 1):
            s = (i - a) / wide
            k = _place(i, j)
            if scratch.rays[k] == 0:
                above, below = lerp(upper_left, upper_right, s), lerp(lower_left, lower_right, s)
                put(scratch.open, k, lerp(above, below, t))
    return True


@inlined
def _node(scratch: QuietScratch, world: World, care: Care, i: int, j: int, x0: int, y0: int) -> Vec:
    """The share of the sky that a place sees, by as many rays as cells of its size can be large."""
    k = _place(i, j)
    if scratch.rays[k] != 0:
        return row(scratch.open, k)
    x, y = x0 + i, y0 + j
    rays = care.rays
    for level in range(_LEVELS):
        if (x | y) & ((2 << level) - 1) == 0:
            rays *= 2
    packet, places = scratch.looking.packet, scratch.places
    seen, asked = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for first in range(0, rays, LANES):
        clear(packet)
        taken = min(LANES, rays - first)
        for lane in range(taken):
            weight = add_sky_ray(places, k, world.environment, packet, lane, _net_key(x, y), first + lane, rays)
            put(scratch.weight, lane, weight)
        visible(packet, world, OPAQUE, scratch.free)
        for lane in range(taken):
            weight = row(scratch.weight, lane)
            seen, asked = add(seen, mul(weight, row(scratch.free, lane))), add(asked, weight)
    scratch.rays[k] = 1
    put(scratch.open, k, share_of_sky(seen, asked, rays))
    return row(scratch.open, k)


# --- few rays are grain -------------------------------------------------------------------------------------------


@inlined
def _is_asked(scratch: QuietScratch, i: int, j: int, wide: int, tall: int) -> bool:
    """A place beside the tile stands so near to one of its own that was asked alone that it takes part in its mean."""
    k = _place(i, j)
    if scratch.part[k] < 0:
        return False
    for y in range(max(0, j - _MARGIN), min(tall, j + _MARGIN + 1)):
        for x in range(max(0, i - _MARGIN), min(wide, i + _MARGIN + 1)):
            if scratch.alone[_place(x, y)] != 0 and scratch.part[_place(x, y)] == scratch.part[k]:
                return True
    return False


@inlined
def _largest(v: Vec) -> float:
    return max(abs(v[0]), abs(v[1]), abs(v[2]))


@inlined
def _is_beside(scratch: QuietScratch, shares: F64_2D, k: int) -> bool:
    """A place and its neighbours on the same surface see all of a light, or all see nothing of it. What stands in the
    rows of others is not of this tile: no surface is there, or nobody has asked it."""
    own = row(shares, k)
    if not (_largest(own) < 1e-6 or min(own[0], own[1], own[2]) > 1.0 - 1e-6):
        return False
    for down in range(-1, 2):
        for right in range(-1, 2):
            j = k + down * _SPAN + right
            if scratch.part[j] == scratch.part[k] and _largest(sub(row(shares, j), own)) > 1e-6:
                return False
    return True


@inlined
def _mean_around(scratch: QuietScratch, shares: F64_2D, k: int, rays: int, grain: float, steep: float) -> Vec:
    """The share that a place gets which was asked alone: the mean of the 5x5 around it, as `_mirrored` takes it, but
    two by two, across from each other, so that no slope shifts it. The less the more rays have told, and not where the
    3x3 around it all see all of the light, or nothing: that is beside a half shadow."""
    own = row(shares, k)
    total, weights = own, 1.0
    if scratch.alone[k] == 1 and _is_beside(scratch, shares, k):
        return own
    grain *= min(1.0, 4.0 / math.sqrt(rays))
    # The plane through the 5x5, by least squares: its slopes are sums over the rises from one to the other.
    rightward, downward, squares_right, squares_down = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.0
    for down in range(_MARGIN + 1):
        for right in range(-_MARGIN, _MARGIN + 1):
            if down == 0 and right <= 0:
                continue
            one, other = k + down * _SPAN + right, k - down * _SPAN - right
            if not (_alike(scratch, k, one, _ALIKE) and _alike(scratch, k, other, _ALIKE)):
                continue
            if shares[one, 0] < 0.0 or shares[other, 0] < 0.0:  # where a light brings nothing
                continue
            rise = sub(row(shares, one), row(shares, other))
            rightward, downward = along(rightward, rise, right), along(downward, rise, down)
            squares_right, squares_down = squares_right + 2.0 * right * right, squares_down + 2.0 * down * down
            pair = add(row(shares, one), row(shares, other))
            if _largest(sub(scale(pair, 0.5), own)) > grain:
                continue
            weight = (0.5 if down == _MARGIN else 1.0) * (0.5 if abs(right) == _MARGIN else 1.0)
            total, weights = along(total, pair, weight), weights + 2.0 * weight
    if max(_largest(rightward) / max(squares_right, 1.0), _largest(downward) / max(squares_down, 1.0)) > steep:
        return own
    return scale(total, 1.0 / weights)


# --- what comes back ----------------------------------------------------------------------------------------------


@inlined
def _send(
    scratch: QuietScratch, world: World, view: View, care: Care, layer: OpaqueLayer, x0: int, y0: int, x1: int, y1: int
) -> None:
    """Let every place send back what arrives, and write the picture."""
    looking, places = scratch.looking, scratch.places
    block = looking.block
    _look_into_mirrors(scratch, world, care, x0, y0, x1, y1)
    for by in range(y0, y1, BLOCK_HEIGHT):
        for bx in range(x0, x1, BLOCK_WIDTH):
            for lane in range(LANES):
                x, y = bx + lane % BLOCK_WIDTH, by + lane // BLOCK_WIDTH
                block.on[lane] = 0
                block.distance[lane] = math.inf
                i = _place(x - x0, y - y0)
                if x < x1 and y < y1 and scratch.part[i] >= 0:
                    copy_lane(block, lane, places, i)
                    block.bounced[lane] = places.bounced[i]
                    if block.bounced[lane] > 0:
                        put(block.mirrored, lane, _mirrored(places, scratch.part, view.spread, i))
            send_back(block, world)
            write_opaque(layer, block, world, view, bx, by)
            _keep_shares(scratch, layer, bx, by, x0, y0, x1, y1)


@inlined
def _look_into_mirrors(scratch: QuietScratch, world: World, care: Care, x0: int, y0: int, x1: int, y1: int) -> None:
    """Send the mirror rays of every place, those of the margin too."""
    places, looking = scratch.places, scratch.looking
    block = looking.block
    for by in range(y0 - BLOCK_HEIGHT, y1 + _MARGIN, BLOCK_HEIGHT):
        for bx in range(x0 - BLOCK_WIDTH, x1 + _MARGIN, BLOCK_WIDTH):
            for lane in range(LANES):
                x, y = bx + lane % BLOCK_WIDTH, by + lane // BLOCK_WIDTH
                block.on[lane] = 0
                if not (x0 - _MARGIN <= x < x1 + _MARGIN and y0 - _MARGIN <= y < y1 + _MARGIN):
                    continue
                i = _place(x - x0, y - y0)
                if scratch.part[i] < 0:
                    continue
                copy_lane(block, lane, places, i)
                block.rays[lane], block.lobes[lane] = care.rays, max(1, care.rays // LOBES)
                set_key(block.key, lane, _net_key(x, y))
            look_into_mirrors(block, looking.second, looking.packet, world, OPAQUE)
            for lane in range(LANES):
                x, y = bx + lane % BLOCK_WIDTH, by + lane // BLOCK_WIDTH
                if block.on[lane] != 0:
                    places.bounced[_place(x - x0, y - y0)] = block.bounced[lane]
                    put(places.mirrored, _place(x - x0, y - y0), row(block.mirrored, lane))


@inlined
def _mirrored(places: Block, part: I32_1D, spread: float, i: int) -> Vec:
    """What a rough mirror shows: the mean over the places around that send their rays into nearly the same lobe. With
    half of what is two away, every place of a net counts as much as every other, so their rays are one sequence."""
    alpha = places.roughness[i] * places.roughness[i]
    own = row(places.mirrored, i)
    if alpha <= max(_SHARP, _PIXELS * spread):
        return own
    total, weights = own, 1.0
    for down in range(-_MARGIN, _MARGIN + 1):
        for right in range(-_MARGIN, _MARGIN + 1):
            j = i + down * _SPAN + right
            if j == i or part[j] != part[i] or places.bounced[j] == 0:
                continue
            if abs(places.roughness[j] - places.roughness[i]) > 0.1 * places.roughness[i]:
                continue
            # A normal that is turned by an angle sends the lobe's middle twice as far.
            turned = 8.0 * (1.0 - dot(row(places.ns, i), row(places.ns, j)))
            weight = max(0.0, 1.0 - turned / (alpha * alpha))
            weight *= 0.5 if abs(down) == _MARGIN else 1.0
            weight *= 0.5 if abs(right) == _MARGIN else 1.0
            total, weights = along(total, row(places.mirrored, j), weight), weights + weight
    return scale(total, 1.0 / weights)


@inlined
def _keep_shares(
    scratch: QuietScratch, layer: OpaqueLayer, bx: int, by: int, x0: int, y0: int, x1: int, y1: int
) -> None:
    """Note what part of the light arrives, for those who look at the place from elsewhere."""
    for lane in range(LANES):
        x, y = bx + lane % BLOCK_WIDTH, by + lane // BLOCK_WIDTH
        if x < x1 and y < y1:
            i = _place(x - x0, y - y0)
            layer.seen[y, x, 0] = scratch.arrives[i] / scratch.possible[i] if scratch.possible[i] > 0.0 else 1.0
            for c in range(3):
                layer.seen[y, x, 1 + c] = scratch.places.sky_seen[i, c]
