"""The light of view rays that see glass: a tree of rays for each, packet by packet (docs/decisions/one-tree.md).

View rays are followed in cells of at most 64; `pixels` and `corners` say which. The rays of a cell wait on a stack: the
eight on top travel as a packet, what goes on from them is put back on top, mirrored rays below those that go through.
So the stack stays short however long the paths, and the rays of a packet are neighbours. Rays that end are leaves; they
wait in a list, and ask the tiers in packets of their own. What a view ray comes to does not depend on its cell.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ..kernels.arrays import F64_1D, F64_2D, I32_1D, I64_1D
from ..kernels.compile import inlined
from ..kernels.lanes import LANES, Flags, Scalars, new_lanes, put
from ..kernels.sampling import Key, set_key
from ..kernels.vec import Vec, add, along, dot, flip_towards, mul, row, scale
from ..scene import Model
from ..view.camera import View, pixel_ray
from ..world.embree import COHERENT, EVERYTHING, OPAQUE, SCATTERED, Packet, clear, has_hit, set_ray
from ..world.environment import TEXEL_LUMINANCE, background
from ..world.lights import lamp_ahead
from ..world.offsets import tie
from ..world.shading import LOBES, Block, gather, load_surface
from ..world.shaping import shape_drawn
from ..world.surface import NOTHING, Hit, HitLanes, Ray, hit_in, interaction, keep_hit, kept_hit, surface_of
from ..world.tables import World
from ..world.tracing import belongs_to, intersect_world
from .answers import Answers, add_answer, add_glow, new_answers, way_to
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
from .tiers import NONE, PROXY, Asking, Query, TierScratch, ask

CELL = 64
"""View rays that are followed together."""
# A packet takes eight rays off the stack and puts back two for each, or four where one splits into its colours, which
# happens once on a way. It does so at most as often as rays may meet glass, which bounds the stack.
_STACK = CELL + 4 * LANES * (MOST_MET + 2)
SLOTS = 33 * 33
"""As many as a patch of 32x32 pixels has corners. Behind them a cell has slots for samples."""
_LEAVES = 256
_STRONG = 0.1
"""Weight of a leaf above which its light is worth rays of its own."""
_FULL = 0.4
"""Weight from which on it is worth all of them; below it sends fewer, in proportion. A cone, which sees much, is worth
them as soon as it is strong."""

# What a ray of a packet has come to.
_ENDED, _MET, _PASSED_OUT, _NO_RAY = 0, 1, 2, 3


class Cell(NamedTuple):
    """What N view rays have come to: sums over their leaves. Each has a slot."""

    x: I32_1D
    """of the pixel, or corner, whose sampling sequence a view ray follows"""
    y: I32_1D
    sample: I32_1D
    spread: F64_1D
    """growth of a view ray's cone per metre along it; set before it starts"""
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
    chance: I32_1D
    """1 where something that one of its rays met is there by chance, or is not"""
    part: I32_1D
    """of the first surface, glass or not; NOTHING where there is none"""
    facing: F64_2D
    """shape (N, 3): its unit geometric normal"""
    ways: I64_1D
    """by which strong leaves behind glass came, and what they met: two of 64 bits for each"""
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

    answers: Answers
    """what the leaves of each slot were answered; kept for `corners` alone"""
    block_of_one: Block
    """a surface that is looked up for itself"""

    @staticmethod
    def fresh() -> TreeScratch:
        """All of it at zero."""
        kinds: list[Any] = [np.int32] * 4 + [np.float64] * 3
        return TreeScratch(
            new_lanes(TierScratch), new_lanes(Packet), new_lanes(Block), new_lanes(Meeting), new_lanes(HitLanes),
            np.zeros(LANES, np.int32), np.zeros(LANES), new_lanes(Query), new_rays(LANES), new_rays(_STACK),
            new_rays(_LEAVES), HitLanes(*(np.zeros(_LEAVES, kind) for kind in kinds)), _new_cell(SLOTS + CELL),
            new_answers(SLOTS), new_lanes(Block),
        )  # fmt: skip


def _new_cell(count: int) -> Cell:
    vectors = ("color", "refraction", "reflection", "weight", "clear", "facing", "normal")
    columns = dict.fromkeys(vectors, 3) | {"tiers": 5}

    def array(name: str) -> Any:
        if name in ("x", "y", "sample", "entered", "glass", "chance", "part"):
            return np.zeros(count, np.int32)
        if name == "ways":
            return np.zeros(count, np.int64)
        return np.zeros((count, columns[name])) if name in columns else np.zeros(count)

    return Cell(*(array(name) for name in Cell._fields))


# --- following ----------------------------------------------------------------------------------------------------


@inlined
def start(
    scratch: TreeScratch, view: View, view_ray: Rays, count: int, slot: int, px: float, py: float, key: Key
) -> int:
    """Put the view ray through a pixel coordinate on the stack of `count` rays, and clear its slot.

    Args:
        view_ray: one row, what every view ray starts as (`eye.view_ray`).

    Returns:
        The stack's new height.
    """
    stack, cell = scratch.stack, scratch.cell
    clear_slot(cell, slot)
    cell.x[slot], cell.y[slot], cell.sample[slot] = key.x, key.y, key.sample
    origin, direction, cosine = pixel_ray(view, px, py)
    copy_ray(stack, count, view_ray, 0)
    put(stack.origin, count, origin)
    put(stack.direction, count, direction)
    stack.start[count] = view.clipping[0] / cosine
    stack.end[count] = view.clipping[1] / cosine
    stack.pixel[count] = slot
    if view_ray.media.depth[0] > 0:
        cell.glass[slot] = 1
    return count + 1


@inlined
def clear_slot(cell: Cell, i: int) -> None:
    """Nothing seen yet."""
    for c in range(3):
        cell.color[i, c] = cell.refraction[i, c] = cell.reflection[i, c] = 0.0
        cell.weight[i, c] = cell.clear[i, c] = cell.normal[i, c] = 0.0
    for k in range(5):
        cell.tiers[i, k] = 0.0
    cell.missing[i] = cell.confidence[i] = cell.share[i] = cell.largest[i] = cell.path[i] = 0.0
    cell.entered[i] = cell.glass[i] = cell.chance[i] = 0
    cell.ways[i] = 0
    cell.part[i] = NOTHING
    cell.z_depth[i] = math.inf
    cell.thickness[i] = 0.0


@inlined
def follow(
    scratch: TreeScratch, world: World, asking: Asking, rules: Rules, view: View, count: int, alone: bool,
    times: int,
) -> None:  # fmt: skip
    """Follow the `count` rays on the stack, and what becomes of them, to their leaves, and ask those.

    Args:
        view: whose rays they are.
        alone: draw what is opaque and seen without any glass, too; otherwise somebody else has drawn that.
        times: rays that a strong leaf sends to each light and to the sky, or into its cone; weak ones send fewer.
    """
    stack = scratch.stack
    leaves = 0
    while count > 0:
        taken = min(LANES, count)
        count -= taken
        for lane in range(taken):
            copy_ray(scratch.now, lane, stack, count + lane)
        trace(scratch, world, rules, taken)
        _meet_all(scratch, world, view, rules, taken)
        _shine(scratch, world, taken)
        for lane in range(taken):
            if scratch.state[lane] == _ENDED:
                copy_ray(scratch.leaves, leaves, scratch.now, lane)
                keep_hit(scratch.leaf_hits, leaves, kept_hit(scratch.met, lane))
                leaves += 1
        count = _send_all(scratch, rules, count, taken)
        if leaves > _LEAVES - LANES:
            _ask_all(scratch, world, asking, view, leaves, alone, times)
            leaves = 0
    _ask_all(scratch, world, asking, view, leaves, alone, times)


@inlined
def trace(scratch: TreeScratch, world: World, rules: Rules, taken: int) -> None:
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
        _belongs(scratch, lane)
        together = together and now.met[lane] <= 1 and now.side[lane] == now.side[0]
    intersect_world(packet, world, scratch.far, COHERENT if together else SCATTERED)
    again = False
    for lane in range(taken):
        found = has_hit(packet, lane)
        packet.valid[lane] = 0
        if packet.chance[lane] != 0:
            scratch.cell.chance[now.pixel[lane]] = 1
        if not found:
            continue
        hit = hit_in(packet, lane, world.geometry)
        keep_hit(met, lane, hit)
        if world.materials.model[hit.material] == Model.NONE.value or world.geometry.touched[hit.part] == 0:
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
        _belongs(scratch, lane)
        again = True
    if again:
        intersect_world(packet, world, scratch.far, SCATTERED)
        for lane in range(taken):
            if has_hit(packet, lane):
                keep_hit(met, lane, hit_in(packet, lane, world.geometry))


@inlined
def _belongs(scratch: TreeScratch, lane: int) -> None:
    cell, i = scratch.cell, scratch.now.pixel[lane]
    belongs_to(scratch.packet, lane, cell.x[i], cell.y[i], cell.sample[i])


@inlined
def _meet_all(scratch: TreeScratch, world: World, view: View, rules: Rules, taken: int) -> None:
    """Say what has become of the packet's rays: the end, an interface, something to pass, a model's exit."""
    now, met, meeting, cell = scratch.now, scratch.met, scratch.meeting, scratch.cell
    for lane in range(LANES):
        scratch.state[lane] = _NO_RAY
        scratch.block.on[lane] = 0
    for lane in range(taken):
        hit = kept_hit(met, lane)
        if now.lamps[lane] != 0 and now.blur[lane] <= 0.0 and _see_lamp(scratch, world, lane, hit):
            continue
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
            if now.side[lane] == VIEW:
                _note_opaque(scratch, world, view, lane)
            continue
        first = now.side[lane] == VIEW
        direction = row(now.direction, lane)
        wide = cell.spread[now.pixel[lane]] * (now.travelled[lane] + hit.t)
        at = interaction(world.geometry, hit, Ray(row(now.origin, lane), direction), wide)
        if first and now.met[lane] == 0:  # even what it passes: the ray to the pixel's middle sees that, too
            cell.part[now.pixel[lane]] = surface_of(world.geometry, hit)
            put(cell.facing, now.pixel[lane], at.ng)
        meet(meeting, lane, now, at, world)
        scratch.state[lane] = _MET
        if meeting.kind[lane] == PASSED:
            continue
        if first:
            i = now.pixel[lane]
            cell.glass[i] = 1
            cell.z_depth[i] = hit.t * dot(direction, row(view.axes, 2))
            cell.thickness[i] = meeting.thickness[lane]
            put(cell.normal, i, row(meeting.n, lane))
        if meeting.kind[lane] != LEFT and (meeting.opacity[lane] > 0.0 or world.gleams):
            block = scratch.block
            load_surface(block, lane, at, world, scale(direction, -1.0))
            put(block.ns, lane, row(meeting.n, lane))
            block.on[lane] = 1
            block.matte[lane] = 1 if meeting.opacity[lane] > 0.0 else 0
        cross(meeting, lane, now, rules)
        if scratch.block.on[lane] != 0:
            put(scratch.block.fresnel, lane, row(meeting.reflectance, lane))  # of lamps, too, exactly


@inlined
def _see_lamp(scratch: TreeScratch, world: World, lane: int, hit: Hit) -> bool:
    """End a ray at the first lamp that it meets before anything else, and add its light. Whether there is one."""
    now, lights = scratch.now, world.lights
    p, d = row(now.origin, lane), row(now.direction, lane)
    nearest, which = now.end[lane] if hit.part == NOTHING else hit.t, -1
    for l in range(lights.kind.shape[0]):  # noqa: E741
        t = lamp_ahead(lights, l, p, d)
        lit = lights.link[l] < 0 or lights.linked[lights.link[l], now.thing[lane]] != 0
        if now.start[lane] < t < nearest and lights.specular[l] > 0.0 and lit:
            nearest, which = t, l
    if which < 0:
        return False
    absorb(now, lane, nearest)
    light = scale(mul(row(now.weight, lane), row(lights.radiance, which)), lights.specular[which])
    if lights.even[which] == 0:
        light = mul(light, shape_drawn(lights, which, p, d, nearest))
    _glow(scratch, now.pixel[lane], light, now.side[lane], now.way[lane], 3 + which)
    return True


@inlined
def _note_opaque(scratch: TreeScratch, world: World, view: View, lane: int) -> None:
    """Where a view ray ends without having met any interface."""
    now, hit = scratch.now, kept_hit(scratch.met, lane)
    direction, i = row(now.direction, lane), now.pixel[lane]
    scratch.cell.z_depth[i] = hit.t * dot(direction, row(view.axes, 2))
    at = interaction(world.geometry, hit, Ray(row(now.origin, lane), direction), 0.0)
    if now.met[lane] == 0:
        scratch.cell.part[i] = surface_of(world.geometry, hit)
        put(scratch.cell.facing, i, at.ng)
    put(scratch.cell.normal, i, flip_towards(at.ng, scale(direction, -1.0)))


@inlined
def _shine(scratch: TreeScratch, world: World, taken: int) -> None:
    """Add what the entered surfaces send out themselves: the part of them that is not clear, and lights' highlights."""
    now, block, cell, opacities = scratch.now, scratch.block, scratch.cell, scratch.meeting.opacity
    some = False
    for lane in range(taken):
        if block.on[lane] != 0:
            some = True
            i = now.pixel[lane]
            set_key(block.key, lane, Key(cell.x[i], cell.y[i], now.branch[lane], cell.sample[i]))
    if not some:
        return
    gather(block, scratch.packet, world, OPAQUE)
    for lane in range(taken):
        if block.on[lane] == 0:
            continue
        i, side = now.pixel[lane], now.side[lane]
        w, share = row(now.weight, lane), opacities[lane]
        gloss = mul(w, row(block.specular, lane)) if world.gleams else (0.0, 0.0, 0.0)
        lit = scale(mul(row(block.albedo, lane), row(block.diffuse, lane)), 1.0 / math.pi)
        body = scale(mul(w, add(row(block.emissive, lane), lit)), share)
        _glow(scratch, i, gloss, MIRRORED_SIDE if side == VIEW else side, now.way[lane], 1)
        _glow(scratch, i, body, side, now.way[lane], 2)


@inlined
def _glow(scratch: TreeScratch, i: int, light: Vec, side: int, way: int, what: int) -> None:
    """Add light that a surface of glass sends out itself."""
    if light[0] == 0.0 and light[1] == 0.0 and light[2] == 0.0:
        return
    cell = scratch.cell
    for c in range(3):
        cell.color[i, c] += light[c]
        if side == THROUGH_SIDE:
            cell.refraction[i, c] += light[c]
        elif side == MIRRORED_SIDE:
            cell.reflection[i, c] += light[c]
    add_glow(scratch.answers, i, light, side, way, what)


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
    scratch: TreeScratch, world: World, asking: Asking, view: View, leaves: int, alone: bool, times: int
) -> None:
    """Ask the tiers for the light of the leaves in the list, and add it to their slots."""
    query = scratch.query
    for first in range(0, leaves, LANES):
        for lane in range(LANES):
            query.on[lane] = 0
            if first + lane < leaves:
                _load_query(scratch, world, asking, view, first + lane, lane, alone, times)
        ask(query, asking, scratch.work, world)
        for lane in range(min(LANES, leaves - first)):
            if query.on[lane] != 0:
                _add_leaf(scratch, world, first + lane, lane, view)


@inlined
def _load_query(
    scratch: TreeScratch, world: World, asking: Asking, view: View, k: int, lane: int, alone: bool, times: int
) -> None:
    query, leaves, cell = scratch.query, scratch.leaves, scratch.cell
    i = leaves.pixel[k]
    seen = scratch.leaf_hits.part[k] != NOTHING
    direct = cell.glass[i] == 0  # it met nothing but what it passed
    if direct and not alone:
        return
    if direct and not seen:
        _add_background(cell, i, world, row(leaves.direction, k))
        return
    query.on[lane] = 1
    set_key(query.key, lane, Key(cell.x[i], cell.y[i], leaves.branch[k], cell.sample[i]))
    query.z_self[lane] = cell.z_depth[i]
    put(query.origin, lane, row(leaves.origin, k))
    put(query.direction, lane, row(leaves.direction, k))
    put(query.normal, lane, row(leaves.normal, k))
    query.blur[lane] = leaves.blur[k]
    query.roughness[lane] = leaves.roughness[k]
    query.thing[lane] = leaves.thing[k]
    query.width[lane] = cell.spread[i] * (leaves.travelled[k] + scratch.leaf_hits.t[k])
    keep_hit(query.met, lane, kept_hit(scratch.leaf_hits, k))
    # A ray that nothing has mirrored and that still goes ahead sees, through the glass, what is behind it.
    ahead = dot(row(leaves.direction, k), row(view.axes, 2)) > 0.0
    query.through[lane] = 1 if ahead and leaves.mirrored[k] == 0 else 0
    inside = leaves.media.depth[k] > 0 and seen
    query.direct[lane] = 1 if direct else 0
    query.embedded[lane] = 1 if inside or direct else 0
    strongest = max(leaves.weight[k, 0], leaves.weight[k, 1], leaves.weight[k, 2])
    query.strong[lane] = 1 if strongest > _STRONG else 0
    full = _FULL if leaves.blur[k] <= 0.0 else _STRONG
    query.rays[lane] = max(1, math.ceil(times * min(1.0, strongest / full)))
    # Those of a corner are one of four that a pixel has; samples, which come few at first, must not know less.
    query.lobes[lane] = query.rays[lane] if alone else max(1, query.rays[lane] // LOBES)
    query.by_proxy[lane] = 1 if asking.method == PROXY and leaves.side[k] != MIRRORED_SIDE else 0


@inlined
def _add_background(cell: Cell, i: int, world: World, direction: Vec) -> None:
    """The sky as a view ray sees it, or nothing."""
    sky, covered = background(world.environment, direction)
    cell.missing[i] = 1.0 - covered
    put(cell.color, i, add(row(cell.color, i), sky))


@inlined
def _bits_of(way: int) -> int:
    """Two bits of 64 that stand for a way."""
    return int((np.int64(1) << np.int64(way & 63)) | (np.int64(1) << np.int64((way >> 6) & 63)))


@inlined
def _add_leaf(scratch: TreeScratch, world: World, k: int, lane: int, view: View) -> None:
    cell, leaves, query = scratch.cell, scratch.leaves, scratch.query
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
        elif cell.glass[i] != 0:
            cell.refraction[i, c] += light
            cell.weight[i, c] += w
            cell.clear[i, c] += leaves.clear[k, c]
    if dot(row(leaves.direction, k), row(view.axes, 2)) > 0.0:  # it would have seen a background
        cell.missing[i] += mean * unanswered
    add_answer(scratch.answers, i, leaves, k, query, lane, world)
    if share > _STRONG and cell.glass[i] != 0 and leaves.blur[k] <= 0.0:
        cell.ways[i] |= _bits_of(way_to(leaves, k, query, lane, world))
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
