"""What a denoiser is told of a picture beside its light: the albedo and the normal of what a pixel shows.

Glass itself has neither that would help: what counts is what is seen through it and in it. So each view ray grows its
tree of rays as it does for light (`tree`), but nothing is shaded, and branches are cut earlier. At a leaf stands what
is opaque, or the sky. A leaf's albedo counts by its share of the pixel's light, tinted by the glass on its way; its
normal by the share without the tint, so that dark glass has normals as long as clear glass. Rough glass shows no edges
of what is behind it, and ends a ray as if it were white and opaque.

Nothing of this is done for a picture that is not asked for it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from ..kernels.arrays import F32_3D
from ..kernels.compile import inlined, kernel
from ..kernels.lanes import LANES, put
from ..kernels.sampling import Key
from ..kernels.vec import Vec, add, flip_towards, mul, row, scale
from ..scene import Model, Param
from ..view.camera import Tile, View
from ..world.environment import radiance
from ..world.surface import NOTHING, Interaction, Ray, color_input, interaction, kept_hit, normal_input
from ..world.tables import World
from .crossing import PASSED, Rules, cross, meet, send_mirrored, send_out, send_past, send_through
from .rays import Rays, absorb, copy_ray
from .tree import TreeScratch, start, trace

SIDE = 8
"""Pixels along the side of a cell."""
_FROSTED = 0.2
"""Roughness from which on glass ends a ray."""

# What becomes of a ray of a packet.
_ENDED, _CROSSES, _PASSES, _LEAVES_MODEL = 0, 1, 2, 3


class Features(NamedTuple):
    """Planes of a picture, sums over samples until somebody divides them."""

    albedo: F32_3D
    """shape (H, W, 3): 0 .. 1 of each sample"""
    normal: F32_3D
    """shape (H, W, 3): engine world, unit of each sample where one surface is all it sees"""


@kernel
def features_tile(
    world: World, view: View, rules: Rules, view_ray: Rays, scratch: TreeScratch, tile: Tile, sample: int,
    sums: Features,
) -> int:  # fmt: skip
    """Add one sample of a tile. Returns rays traced.

    Args:
        view: through whose pixels' middles the sample looks.
        view_ray: one row, what every view ray starts as (`eye.view_ray`).
    """
    scratch.packet.tally[0] = 0
    cell = scratch.cell
    for y0 in range(tile[1], tile[3], SIDE):
        for x0 in range(tile[0], tile[2], SIDE):
            count = 0
            for slot in range(SIDE * SIDE):
                x, y = x0 + slot % SIDE, y0 + slot // SIDE
                if x < view.size[0] and y < view.size[1]:
                    cell.spread[slot] = view.spread
                    count = start(scratch, view, view_ray, count, slot, x + 0.5, y + 0.5, Key(x, y, 0, sample))
            _follow(scratch, world, rules, count)
            for slot in range(SIDE * SIDE):
                x, y = x0 + slot % SIDE, y0 + slot // SIDE
                if x < view.size[0] and y < view.size[1]:
                    for c in range(3):
                        sums.albedo[y, x, c] += min(1.0, cell.color[slot, c])
                        sums.normal[y, x, c] += cell.normal[slot, c]
    return scratch.packet.tally[0]


@inlined
def _follow(scratch: TreeScratch, world: World, rules: Rules, count: int) -> None:
    """Follow the `count` rays on the stack, and what becomes of them. A slot's `color` takes its albedo."""
    stack, now, meeting = scratch.stack, scratch.now, scratch.meeting
    while count > 0:
        taken = min(LANES, count)
        count -= taken
        for lane in range(taken):
            copy_ray(now, lane, stack, count + lane)
        trace(scratch, world, rules, taken)
        for lane in range(taken):
            scratch.state[lane] = _look(scratch, world, rules, lane)
        for lane in range(taken):
            if scratch.state[lane] == _CROSSES:
                count = send_mirrored(stack, count, now, lane, meeting)
        for lane in range(taken):
            if scratch.state[lane] == _CROSSES:
                count = send_through(stack, count, now, lane, meeting, rules)
            elif scratch.state[lane] == _PASSES:
                count = send_past(stack, count, now, lane, scratch.met.t[lane])
            elif scratch.state[lane] == _LEAVES_MODEL:
                count = send_out(stack, count, now, lane)


@inlined
def _look(scratch: TreeScratch, world: World, rules: Rules, lane: int) -> int:
    """Add what the ray of a lane has met, and say what becomes of it."""
    now, meeting, hit = scratch.now, scratch.meeting, kept_hit(scratch.met, lane)
    direction = row(now.direction, lane)
    if hit.part == NOTHING:
        if now.inner[lane] != 0:
            absorb(now, lane, now.end[lane])
            return _LEAVES_MODEL
        if world.environment.present:
            _add(scratch, lane, _as_share(radiance(world.environment, direction, 0.0)), (0.0, 0.0, 0.0), 1.0)
        return _ENDED
    wide = scratch.cell.spread[now.pixel[lane]] * (now.travelled[lane] + hit.t)
    at = interaction(world.geometry, hit, Ray(row(now.origin, lane), direction), wide)
    if world.materials.model[hit.material] == Model.NONE.value:
        absorb(now, lane, hit.t)
        back = scale(direction, -1.0)
        _add(scratch, lane, _albedo(world, at), flip_towards(normal_input(world, at), flip_towards(at.ng, back)), 1.0)
        return _ENDED
    meet(meeting, lane, now, at, world)
    if meeting.kind[lane] == PASSED:
        return _PASSES
    share = meeting.opacity[lane]
    if meeting.roughness[lane] >= _FROSTED:
        white = scale((1.0, 1.0, 1.0), 1.0 - share)
        _add(scratch, lane, add(white, scale(_albedo(world, at), share)), row(meeting.n, lane), 1.0)
        return _ENDED
    cross(meeting, lane, now, rules)
    if share > 0.0:
        # The part of the surface that is not clear: as much of the light as is neither mirrored nor goes through.
        r = row(meeting.reflectance, lane)
        enters = (1.0 - r[0], 1.0 - r[1], 1.0 - r[2])
        mean = (enters[0] + enters[1] + enters[2]) / 3.0
        _add(scratch, lane, mul(_albedo(world, at), enters), scale(row(meeting.n, lane), mean), share)
    return _CROSSES


@inlined
def _add(scratch: TreeScratch, lane: int, albedo: Vec, normal: Vec, share: float) -> None:
    """Add what a ray sees to its slot, by its weight."""
    cell, now = scratch.cell, scratch.now
    i = now.pixel[lane]
    put(cell.color, i, add(row(cell.color, i), scale(mul(row(now.weight, lane), albedo), share)))
    clear = row(now.clear, lane)
    part = share * (clear[0] + clear[1] + clear[2]) / 3.0
    put(cell.normal, i, add(row(cell.normal, i), scale(normal, part)))


@inlined
def _albedo(world: World, at: Interaction) -> Vec:
    """What a surface is coloured like, whatever lights it: its diffuse reflectance, of a metal what it mirrors, and
    its own light, all together at most 1."""
    found = color_input(world, at, Param.DIFFUSE.value)
    if world.materials.specular_workflow[at.hit.material]:
        found = add(found, color_input(world, at, Param.SPECULAR.value))
    return _as_share(add(found, color_input(world, at, Param.EMISSIVE.value)))


@inlined
def _as_share(color: Vec) -> Vec:
    return (_unit(color[0]), _unit(color[1]), _unit(color[2]))


@inlined
def _unit(x: float) -> float:
    return min(1.0, max(0.0, x)) if math.isfinite(x) else 1.0
