"""What is seen between the corners of pixels and in none of them: wires, rails, narrow sides of bodies. Where such a
thing is found, its neighbours are looked at, and so on along it. `behind` does the same for what glass shows."""

from __future__ import annotations

from ..kernels.compile import inlined
from ..kernels.lanes import BLOCK_HEIGHT, BLOCK_WIDTH, LANES
from ..kernels.vec import dot, row
from ..view.camera import View
from ..view.gbuffer import add_view_ray
from ..world.embree import COHERENT, EVERYTHING, clear, has_hit
from ..world.surface import NOTHING, facing_in, hit_in, surface_of
from ..world.tables import World
from ..world.tracing import intersect_world
from .patch import ALL_SAMPLES, PATCH, ROW, CornerScratch, Refining, corner
from .tree import TreeScratch

_UNKNOWN, _LOOKED_AT, THIN = 0, 1, 2
_SAME_SIDE = 0.5
"""Cosine of normals above which two rays have met the same side of a surface, though it may be curved."""


@inlined
def look_between(
    scratch: TreeScratch, own: CornerScratch, world: World, refining: Refining, view: View,
    x0: int, y0: int, width: int, height: int,
) -> None:  # fmt: skip
    """Find the pixels of a patch that show what none of their corners does: what is thin may pass between them all. One
    ray looks in the middle of each; where it finds something, more look around in the pixels beside, and so on."""
    packet = scratch.packet
    found = 0
    for by in range(0, height, BLOCK_HEIGHT):
        for bx in range(0, width, BLOCK_WIDTH):
            clear(packet)
            for lane in range(LANES):
                i, j = bx + lane % BLOCK_WIDTH, by + lane // BLOCK_WIDTH
                if i < width and j < height:
                    scratch.far[lane] = add_view_ray(packet, view, lane, x0 + i + 0.5, y0 + j + 0.5, EVERYTHING)
            intersect_world(packet, world, scratch.far, COHERENT)
            for lane in range(LANES):
                i, j = bx + lane % BLOCK_WIDTH, by + lane // BLOCK_WIDTH
                if i < width and j < height:
                    own.thin[j * PATCH + i] = _UNKNOWN
                    if _shows_more(scratch, world, lane, j * ROW + i):
                        own.thin[j * PATCH + i] = THIN
                        own.queue[found] = j * PATCH + i
                        found += 1
    looked = 0
    while looked < found:
        x, y = own.queue[looked] % PATCH, own.queue[looked] // PATCH
        looked += 1
        for j in range(max(0, y - 1), min(height, y + 2)):
            for i in range(max(0, x - 1), min(width, x + 2)):
                if own.thin[j * PATCH + i] != _UNKNOWN:
                    continue
                own.thin[j * PATCH + i] = _LOOKED_AT
                if _is_thin(scratch, world, refining, view, x0 + i, y0 + j, j * ROW + i):
                    own.thin[j * PATCH + i] = THIN
                    own.queue[found] = j * PATCH + i
                    found += 1


@inlined
def _is_thin(
    scratch: TreeScratch, world: World, refining: Refining, view: View, x: int, y: int, slot: int
) -> bool:
    """Some of eight of a pixel's samples show what its corners do not."""
    packet = scratch.packet
    first, samples = refining.sets[ALL_SAMPLES], refining.sets[ALL_SAMPLES + 1] - refining.sets[ALL_SAMPLES]
    looks = min(LANES, samples)
    clear(packet)
    for lane in range(looks):
        offset = refining.offsets[first + lane * samples // looks]
        scratch.far[lane] = add_view_ray(packet, view, lane, x + 0.5 + offset[0], y + 0.5 + offset[1], EVERYTHING)
    intersect_world(packet, world, scratch.far, COHERENT)
    more = False
    for lane in range(looks):
        more = more or _shows_more(scratch, world, lane, slot)
    return more


@inlined
def _shows_more(scratch: TreeScratch, world: World, lane: int, slot: int) -> bool:
    """The view ray in a lane has met what none of the four corners has: another surface, or another side of it."""
    seen, packet, met = scratch.cell.part, scratch.packet, has_hit(scratch.packet, lane)
    surface, facing = NOTHING, (0.0, 0.0, 0.0)
    if met:
        surface = surface_of(world.geometry, hit_in(packet, lane, world.geometry))
        facing = facing_in(packet, lane, world.geometry)
    for k in range(4):
        i = corner(slot, k)
        if seen[i] == surface and (not met or abs(dot(facing, row(scratch.cell.facing, i))) >= _SAME_SIDE):
            return False
    return True
