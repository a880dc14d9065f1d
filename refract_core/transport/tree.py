"""The light of pixels that see glass: a tree of rays for each, followed packet by packet (docs/decisions/one-tree.md).

A tile is done in cells of 8x8 pixels. The rays of a cell wait on a stack: the eight on top travel as a packet, what
goes on from them is put back on top, mirrored rays below those that go through. So the stack stays short however long
the paths, and the rays of a packet are neighbours. Rays that end are leaves; they wait in a list, and ask the tiers in
packets of their own. Nothing depends on the tile, so its size does not show.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ..kernels.arrays import F64_1D, F64_2D, I32_1D
from ..kernels.compile import inlined, kernel
from ..kernels.lanes import BLOCK_HEIGHT, BLOCK_WIDTH, LANES, Flags, Scalars, new_lanes, put
from ..kernels.sampling import Key, set_key
from ..kernels.vec import along, dot, row, scale
from ..scene import Model
from ..view.camera import Tile, View, pixel_ray
from ..view.gbuffer import OpaqueLayer
from ..view.planes import Planes
from ..world.embree import COHERENT, EVERYTHING, OPAQUE, SCATTERED, Packet, clear, has_hit, set_ray
from ..world.environment import TEXEL_LUMINANCE
from ..world.offsets import tie
from ..world.shading import Block, gather, load_surface
from ..world.surface import NOTHING, HitLanes, Ray, hit_in, interaction, keep_hit, kept_hit
from ..world.tables import World
from ..world.tracing import intersect_world
from .crossing import (
    LEFT,
    PASSED,
    Meeting,
    Rules,
    cross,
    meet,
    send_mirrored,
    send_out,
    send_past,
    send_through,
)
from .rays import MIRRORED_SIDE, MOST_MET, THROUGH_SIDE, VIEW, Rays, absorb, copy_ray, is_lost, new_rays
from .tiers import NONE, PROBE, PROXY, RAY, SCREEN, SKY, Asking, Query, TierScratch, ask

CELL = 8
"""Pixels along the side of a cell."""
_PIXELS = CELL * CELL
# A packet takes eight rays off the stack and puts back two for each, or four where one splits into its colours, which
# happens once on a way. It does so at most as often as rays may meet glass, which bounds the stack.
_STACK = _PIXELS + 4 * LANES * (MOST_MET + 2)
_LEAVES = 256
_STRONG = 0.1
"""Weight of a leaf above which its light is worth rays of its own."""

# What a ray of a packet has come to.
_ENDED, _MET, _PASSED_OUT, _NO_RAY = 0, 1, 2, 3


class Cell(NamedTuple):
    """Sums of one sample over a cell; N is 64 pixels, row by row."""

    color: F64_2D
    """shape (N, 3)"""
    missing: F64_1D
    """share of the light that comes from ahead and that nobody answered"""
    refraction: F64_2D
    """shape (N, 3)"""
    reflection: F64_2D
    """shape (N, 3)"""
    weight: F64_2D
    """shape (N, 3): of the leaves of rays that went through; so are the next"""
    clear: F64_2D
    """shape (N, 3)"""
    tiers: F64_2D
    """shape (N, 5): screen, ray, probe, sky, none"""
    confidence: F64_1D
    share: F64_1D
    """sum of their shares"""
    largest: F64_1D
    """clear weight of the brightest of them"""
    path: F64_1D
    """its way inside media [m]"""
    entered: I32_1D
    """and how many surfaces it entered"""
    glass: I32_1D
    """1 where the view ray met an interface, or is in a medium"""
    z_depth: F64_1D
    """of the first surface [m]"""
    normal: F64_2D
    """shape (N, 3): there"""
    thickness: F64_1D
    """authored there [m]"""


class TreeScratch(NamedTuple):
    """What one thread needs to draw a cell."""

    work: TierScratch
    packet: Packet
    block: Block
    """surfaces of glass that shine themselves"""
    meeting: Meeting
    met: HitLanes
    """what the rays of the packet have met"""
    state: Flags
    far: Scalars
    """T_FAR of the rays"""
    query: Query
    now: Rays
    """the packet's rays"""
    stack: Rays
    leaves: Rays
    leaf_hits: HitLanes
    """what is opaque that each leaf has met"""
    cell: Cell

    @staticmethod
    def fresh() -> TreeScratch:
        """All of it at zero."""
        kinds: list[Any] = [np.int32] * 4 + [np.float64] * 3
        return TreeScratch(
            new_lanes(TierScratch), new_lanes(Packet), new_lanes(Block), new_lanes(Meeting), new_lanes(HitLanes),
            np.zeros(LANES, np.int32), np.zeros(LANES), new_lanes(Query), new_rays(LANES), new_rays(_STACK),
            new_rays(_LEAVES), HitLanes(*(np.zeros(_LEAVES, kind) for kind in kinds)), _new_cell(),
        )  # fmt: skip


def _new_cell() -> Cell:
    columns = {"color": 3, "refraction": 3, "reflection": 3, "weight": 3, "clear": 3, "tiers": 5, "normal": 3}

    def array(name: str) -> Any:
        if name in ("entered", "glass"):
            return np.zeros(_PIXELS, np.int32)
        return np.zeros((_PIXELS, columns[name])) if name in columns else np.zeros(_PIXELS)

    return Cell(*(array(name) for name in Cell._fields))


# --- a tile -------------------------------------------------------------------------------------------------------


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
    for y0 in range(tile[1], tile[3], CELL):
        for x0 in range(tile[0], tile[2], CELL):
            count = _start(scratch, view, view_ray, opaque, x0, y0)
            if count > 0:
                _follow_all(scratch, world, asking, rules, sample, x0, y0, count)
            _add_cell(planes, scratch.cell, opaque, view, x0, y0, sample)
    return scratch.packet.tally[0] + scratch.work.packet.tally[0]


@inlined
def _start(scratch: TreeScratch, view: View, view_ray: Rays, opaque: OpaqueLayer, x0: int, y0: int) -> int:
    """Put the view rays of a cell that see glass on the stack, block by block. Returns how many."""
    cell, stack = scratch.cell, scratch.stack
    _clear(cell)
    count = 0
    for k in range(_PIXELS):
        block, lane = k // LANES, k % LANES
        i = block % (CELL // BLOCK_WIDTH) * BLOCK_WIDTH + lane % BLOCK_WIDTH
        j = block // (CELL // BLOCK_WIDTH) * BLOCK_HEIGHT + lane // BLOCK_WIDTH
        x, y = x0 + i, y0 + j
        if x >= view.size[0] or y >= view.size[1]:
            continue
        submerged = view_ray.media.depth[0] > 0
        if opaque.glass[y, x] == 0 and not submerged:
            continue
        origin, direction, cosine = pixel_ray(view, x + 0.5, y + 0.5)
        copy_ray(stack, count, view_ray, 0)
        put(stack.origin, count, origin)
        put(stack.direction, count, direction)
        stack.start[count] = view.clipping[0] / cosine
        stack.end[count] = view.clipping[1] / cosine
        stack.pixel[count] = j * CELL + i
        if submerged:
            cell.glass[j * CELL + i] = 1
            cell.z_depth[j * CELL + i] = opaque.depth[y, x]
            put(cell.normal, j * CELL + i, row(opaque.normal[y], x))
        count += 1
    return count


@inlined
def _clear(cell: Cell) -> None:
    for i in range(_PIXELS):
        for c in range(3):
            cell.color[i, c] = cell.refraction[i, c] = cell.reflection[i, c] = 0.0
            cell.weight[i, c] = cell.clear[i, c] = 0.0
        for k in range(5):
            cell.tiers[i, k] = 0.0
        cell.missing[i] = cell.confidence[i] = cell.share[i] = cell.largest[i] = cell.path[i] = 0.0
        cell.entered[i] = cell.glass[i] = 0
        cell.z_depth[i] = math.inf
        cell.thickness[i] = 0.0


@inlined
def _follow_all(
    scratch: TreeScratch, world: World, asking: Asking, rules: Rules, sample: int, x0: int, y0: int, count: int
) -> None:
    """Follow the rays on the stack, and what becomes of them, to their leaves, and ask those."""
    stack = scratch.stack
    leaves = 0
    while count > 0:
        taken = min(LANES, count)
        count -= taken
        for lane in range(taken):
            copy_ray(scratch.now, lane, stack, count + lane)
        _trace(scratch, world, rules, taken)
        _meet_all(scratch, world, asking, rules, taken)
        _shine(scratch, world, asking, sample, x0, y0, taken)
        for lane in range(taken):
            if scratch.state[lane] == _ENDED:
                copy_ray(scratch.leaves, leaves, scratch.now, lane)
                keep_hit(scratch.leaf_hits, leaves, kept_hit(scratch.met, lane))
                leaves += 1
        count = _send_all(scratch, rules, count, taken)
        if leaves > _LEAVES - LANES:
            _ask_all(scratch, world, asking, sample, x0, y0, leaves)
            leaves = 0
    _ask_all(scratch, world, asking, sample, x0, y0, leaves)


@inlined
def _trace(scratch: TreeScratch, world: World, rules: Rules, taken: int) -> None:
    """Find what the packet's rays meet: into `met`, as much of it as matters in a medium."""
    packet, now, met = scratch.packet, scratch.now, scratch.met
    clear(packet)
    together = True
    for lane in range(taken):
        met.part[lane] = NOTHING
        lost = is_lost(now, lane)
        if lost:  # as if there were no glass at all
            now.media.depth[lane] = 0
            if now.inner[lane] != 0:
                now.inner[lane], now.end[lane] = 0, math.inf
        blind = now.media.depth[lane] == 0 and (now.entered[lane] >= rules.max_layers or lost)
        scratch.far[lane] = now.end[lane]
        set_ray(
            packet, lane, row(now.origin, lane), row(now.direction, lane), now.start[lane], now.end[lane],
            OPAQUE if blind else EVERYTHING,
        )  # fmt: skip
        together = together and now.met[lane] <= 1 and now.side[lane] == now.side[0]
    intersect_world(packet, world, scratch.far, COHERENT if together else SCATTERED)
    again = False
    for lane in range(taken):
        found = has_hit(packet, lane)
        packet.valid[lane] = 0
        if not found:
            continue
        hit = hit_in(packet, lane, world.geometry)
        keep_hit(met, lane, hit)
        if world.materials.model[hit.material] == Model.NONE.value:
            continue
        # Where glass touches an opaque object, as on a table, the two surfaces tie, and the ray could come out on the
        # far side of the table: from inside, an opaque surface within rounding of the glass takes it. "Inside" is in a
        # medium, or behind a model's exit, before the wall of the real body.
        p, d = row(now.origin, lane), row(now.direction, lane)
        if now.media.depth[lane] == 0 and (
            now.entered[lane] == 0 or dot(interaction(world.geometry, hit, Ray(p, d), 0.0).ng, d) <= 0.0
        ):
            continue
        near = tie(along(p, d, hit.t))
        scratch.far[lane] = hit.t + near
        set_ray(packet, lane, p, d, max(0.0, hit.t - near), hit.t + near, OPAQUE)
        again = True
    if again:
        intersect_world(packet, world, scratch.far, SCATTERED)
        for lane in range(taken):
            if has_hit(packet, lane):
                keep_hit(met, lane, hit_in(packet, lane, world.geometry))


@inlined
def _meet_all(scratch: TreeScratch, world: World, asking: Asking, rules: Rules, taken: int) -> None:
    """Say what has become of the packet's rays: the end, an interface, something to pass, a model's exit."""
    now, met, meeting, cell = scratch.now, scratch.met, scratch.meeting, scratch.cell
    view = asking.screen.camera
    for lane in range(LANES):
        scratch.state[lane] = _NO_RAY
        scratch.block.on[lane] = 0
    for lane in range(taken):
        hit = kept_hit(met, lane)
        if hit.part == NOTHING:
            if now.inner[lane] != 0:
                absorb(now, lane, now.end[lane])
                scratch.state[lane] = _PASSED_OUT
            else:
                scratch.state[lane] = _ENDED
            continue
        if world.materials.model[hit.material] == Model.NONE.value:
            absorb(now, lane, hit.t)
            scratch.state[lane] = _ENDED
            continue
        first = now.side[lane] == VIEW
        direction = row(now.direction, lane)
        at = interaction(
            world.geometry, hit, Ray(row(now.origin, lane), direction), view.spread * (now.travelled[lane] + hit.t)
        )
        meet(meeting, lane, now, at, world, rules)
        scratch.state[lane] = _MET
        if meeting.kind[lane] == PASSED:
            continue
        if first:
            i = now.pixel[lane]
            cell.glass[i] = 1
            cell.z_depth[i] = hit.t * dot(direction, row(view.axes, 2))
            cell.thickness[i] = meeting.thickness[lane]
            put(cell.normal, i, row(meeting.n, lane))
        if meeting.kind[lane] != LEFT and (meeting.opacity[lane] > 0.0 or world.lights.kind.shape[0] > 0):
            block = scratch.block
            load_surface(block, lane, at, world, scale(direction, -1.0))
            put(block.ns, lane, row(meeting.n, lane))
            block.on[lane] = 1
            block.matte[lane] = 1 if meeting.opacity[lane] > 0.0 else 0
        cross(meeting, lane, now, rules)


@inlined
def _shine(
    scratch: TreeScratch, world: World, asking: Asking, sample: int, x0: int, y0: int, taken: int
) -> None:
    """Add what the entered surfaces send out themselves: the part of them that is not clear, and lights' highlights."""
    now, block, cell, opacities = scratch.now, scratch.block, scratch.cell, scratch.meeting.opacity
    some = False
    for lane in range(taken):
        if block.on[lane] != 0:
            some = True
            i = now.pixel[lane]
            set_key(block.key, lane, Key(x0 + i % CELL, y0 + i // CELL, now.branch[lane]))
    if not some:
        return
    gather(block, scratch.packet, world, sample, OPAQUE)
    for lane in range(taken):
        if block.on[lane] == 0:
            continue
        i, side = now.pixel[lane], now.side[lane]
        for c in range(3):
            w = now.weight[lane, c]
            gloss = w * block.specular[lane, c]
            body = block.emissive[lane, c] + block.albedo[lane, c] * block.diffuse[lane, c] / math.pi
            body *= w * opacities[lane]
            cell.color[i, c] += gloss + body
            if side == THROUGH_SIDE:
                cell.refraction[i, c] += gloss + body
            else:
                cell.reflection[i, c] += gloss if side == VIEW else gloss + body


@inlined
def _send_all(scratch: TreeScratch, rules: Rules, count: int, taken: int) -> int:
    """Put what goes on from the packet's rays on the stack. Returns its new height."""
    stack, now, meeting = scratch.stack, scratch.now, scratch.meeting
    for lane in range(taken):
        if scratch.state[lane] == _MET and meeting.kind[lane] != PASSED:
            count = send_mirrored(stack, count, now, lane, meeting)
    for lane in range(taken):
        if scratch.state[lane] == _PASSED_OUT:
            count = send_out(stack, count, now, lane)
        elif scratch.state[lane] == _MET:
            if meeting.kind[lane] == PASSED:
                count = send_past(stack, count, now, lane, scratch.met.t[lane])
            else:
                count = send_through(stack, count, now, lane, meeting, rules)
    return count


# --- leaves -------------------------------------------------------------------------------------------------------


@inlined
def _ask_all(
    scratch: TreeScratch, world: World, asking: Asking, sample: int, x0: int, y0: int, leaves: int
) -> None:
    """Ask the tiers for the light of the leaves in the list, and add it to their pixels."""
    query = scratch.query
    for first in range(0, leaves, LANES):
        for lane in range(LANES):
            query.on[lane] = 0
            if first + lane < leaves:
                _load_query(scratch, asking, x0, y0, first + lane, lane)
        ask(query, asking, scratch.work, world, sample)
        for lane in range(min(LANES, leaves - first)):
            if query.on[lane] != 0:
                _add_leaf(scratch.cell, scratch.leaves, query, first + lane, lane, asking.screen.camera)


@inlined
def _load_query(scratch: TreeScratch, asking: Asking, x0: int, y0: int, k: int, lane: int) -> None:
    query, leaves, cell = scratch.query, scratch.leaves, scratch.cell
    i = leaves.pixel[k]
    if cell.glass[i] == 0:  # it met nothing but what it passed: the opaque picture has it
        return
    query.on[lane] = 1
    set_key(query.key, lane, Key(x0 + i % CELL, y0 + i // CELL, leaves.branch[k]))
    query.z_self[lane] = cell.z_depth[i]
    put(query.origin, lane, row(leaves.origin, k))
    put(query.direction, lane, row(leaves.direction, k))
    put(query.normal, lane, row(leaves.normal, k))
    query.blur[lane] = leaves.blur[k]
    query.roughness[lane] = leaves.roughness[k]
    query.thing[lane] = leaves.thing[k]
    query.width[lane] = asking.screen.camera.spread * (leaves.travelled[k] + scratch.leaf_hits.t[k])
    keep_hit(query.met, lane, kept_hit(scratch.leaf_hits, k))
    inside = leaves.media.depth[k] > 0 and scratch.leaf_hits.part[k] != NOTHING
    query.embedded[lane] = 1 if inside else 0
    strongest = max(leaves.weight[k, 0], leaves.weight[k, 1], leaves.weight[k, 2])
    query.strong[lane] = 1 if strongest > _STRONG else 0
    query.by_proxy[lane] = 1 if asking.method == PROXY and leaves.side[k] != MIRRORED_SIDE else 0


@inlined
def _add_leaf(cell: Cell, leaves: Rays, query: Query, k: int, lane: int, view: View) -> None:
    i = leaves.pixel[k]
    unanswered = max(0.0, query.weight[lane, NONE])
    mean = share = 0.0
    for c in range(3):
        w = leaves.weight[k, c]
        mean += w / 3.0
        share += leaves.clear[k, c] / 3.0
        light = w * query.color[lane, c]
        cell.color[i, c] += light
        if leaves.side[k] == MIRRORED_SIDE:
            cell.reflection[i, c] += light
        else:
            cell.refraction[i, c] += light
            cell.weight[i, c] += w
            cell.clear[i, c] += leaves.clear[k, c]
    if dot(row(leaves.direction, k), row(view.axes, 2)) > 0.0:  # it would have seen a background
        cell.missing[i] += mean * unanswered
    if leaves.side[k] == MIRRORED_SIDE:
        return
    for tier in range(4):
        cell.tiers[i, tier] += share * query.weight[lane, tier]
    cell.tiers[i, NONE] += share * unanswered
    if not is_lost(leaves, k):
        cell.confidence[i] += share * query.confidence[lane]
    cell.share[i] += share
    # By luminance: the three colours that a dispersive glass lets out often have the same weight, but for rounding.
    bright = dot(row(leaves.clear, k), TEXEL_LUMINANCE)
    if bright > cell.largest[i]:
        cell.largest[i] = bright
        cell.path[i] = leaves.path[k]
        cell.entered[i] = leaves.entered[k]


# --- pixels -------------------------------------------------------------------------------------------------------


@inlined
def _add_cell(planes: Planes, cell: Cell, opaque: OpaqueLayer, view: View, x0: int, y0: int, sample: int) -> None:
    """Add a cell's sums to the planes, and the opaque picture where there is no glass."""
    for i in range(_PIXELS):
        x, y = x0 + i % CELL, y0 + i // CELL
        if x >= view.size[0] or y >= view.size[1]:
            continue
        if sample == 0:
            planes.z_depth[y, x] = opaque.depth[y, x]
            for c in range(3):
                planes.normal[y, x, c] = opaque.normal[y, x, c]
        if cell.glass[i] == 0:
            for c in range(4):
                planes.beauty[y, x, c] += opaque.color[y, x, c]
        else:
            _add_glass(planes, cell, i, x, y, sample)


@inlined
def _add_glass(planes: Planes, cell: Cell, i: int, x: int, y: int, sample: int) -> None:
    share = cell.share[i]
    for c in range(3):
        planes.beauty[y, x, c] += cell.color[i, c]
        planes.refraction[y, x, c] += cell.refraction[i, c]
        planes.reflection[y, x, c] += cell.reflection[i, c]
        planes.transmittance[y, x, c] += cell.weight[i, c] / cell.clear[i, c] if cell.clear[i, c] > 0.0 else 1.0
    planes.beauty[y, x, 3] += 1.0 - cell.missing[i]
    planes.mask[y, x] += 1.0
    if share > 0.0:
        planes.screen[y, x] += cell.tiers[i, SCREEN] / share
        planes.ray[y, x] += cell.tiers[i, RAY] / share
        planes.probe[y, x] += cell.tiers[i, PROBE] / share
        planes.sky[y, x] += cell.tiers[i, SKY] / share
        planes.none[y, x] += cell.tiers[i, NONE] / share
        planes.confidence[y, x] += cell.confidence[i] / share
    if sample == 0:
        planes.thickness[y, x] = cell.thickness[i]
        planes.path_length[y, x] = cell.path[i]
        planes.layers[y, x] = cell.entered[i]
        planes.z_depth[y, x] = cell.z_depth[i]
        for c in range(3):
            planes.normal[y, x, c] = cell.normal[i, c]
