"""Rays that know about materials: cut-outs let them through, shadows ask only whether something is in the way."""

from __future__ import annotations

from ..kernels.compile import inlined
from ..kernels.lanes import LANES, Scalars
from ..kernels.sampling import chance_of_bits
from ..kernels.vec import Vec
from ..scene import Param
from .embree import (
    COHERENT,
    CUTOUT,
    DIR_X,
    DIR_Y,
    DIR_Z,
    MASK,
    OPAQUE,
    ORG_X,
    SCATTERED,
    SOLID,
    T_FAR,
    Packet,
    has_hit,
    hit_distance,
    intersect,
    is_blocked,
    occluded,
    ray_direction,
    ray_origin,
    restart,
    set_ray,
)
from .offsets import off_surface, past, short_of
from .surface import Ray, float_input, hit_in, interaction
from .tables import World

_MAX_CUTOUTS = 64
"""Holes that one ray may go through; behind so many it meets whatever comes next."""


@inlined
def ray_of(packet: Packet, lane: int) -> Ray:
    """The ray of a lane; its direction must have been unit."""
    return Ray(ray_origin(packet, lane), ray_direction(packet, lane))


@inlined
def _absent(world: World, packet: Packet, lane: int) -> bool:
    """The hit in a lane is a hole of a cut-out material, or the uncovered share of a `presence` one."""
    hit = hit_in(packet, lane, world.geometry)
    m = hit.material
    if world.materials.cutout[m] == 0:
        return False
    at = interaction(world.geometry, hit, ray_of(packet, lane), 0.0)
    opacity = float_input(world, at, Param.OPACITY.value)
    threshold = world.materials.threshold[m]
    if threshold > 0.0:
        return opacity < threshold
    # Coverage as chance: decided by the bits of the ray itself, so it is the same wherever the ray is traced.
    words = packet.words
    return opacity <= chance_of_bits(
        words[DIR_X, lane] ^ words[ORG_X, lane], words[DIR_Y, lane], words[DIR_Z, lane] ^ hit.part
    )


@inlined
def _is_by_chance(world: World, packet: Packet, lane: int) -> bool:
    """The hit in a lane is on a `presence` material."""
    m = hit_in(packet, lane, world.geometry).material
    return world.materials.cutout[m] != 0 and world.materials.threshold[m] <= 0.0


@inlined
def intersect_world(packet: Packet, world: World, far: Scalars, coherent: bool) -> None:
    """Nearest present hit of every active lane; and `packet.chance`, where it is there, or others are not, by chance.

    Args:
        far: the T_FAR each lane started with.
    """
    handle = world.geometry.handle
    for lane in range(LANES):
        packet.chance[lane] = 0
    intersect(packet, handle, coherent)
    if not world.cutouts:
        return
    for lane in range(LANES):
        packet.asked[lane] = packet.valid[lane]
    for _ in range(_MAX_CUTOUTS):
        again = False
        for lane in range(LANES):
            absent = has_hit(packet, lane) and _absent(world, packet, lane)
            if has_hit(packet, lane) and _is_by_chance(world, packet, lane):
                packet.chance[lane] = 1
            packet.valid[lane] = 0
            if absent:
                restart(packet, lane, past(hit_distance(packet, lane)), far[lane])
                again = True
        if not again:
            break
        intersect(packet, handle, SCATTERED)
    for lane in range(LANES):
        packet.valid[lane] = packet.asked[lane]


@inlined
def add_shadow_ray(packet: Packet, lane: int, point: Vec, ng: Vec, direction: Vec, distance: float) -> None:
    """Put the segment from a surface to a light into a lane. `distance` [m] may be infinite."""
    set_ray(packet, lane, off_surface(point, ng, direction), direction, 0.0, short_of(distance), SOLID)


@inlined
def visible(packet: Packet, world: World, mask: int, seen: Scalars) -> None:
    """Whether each active lane reaches its T_FAR: 1 or 0 into `seen`, 1 for inactive lanes.

    Solid things are asked first, all at once; only where they leave the way free must cut-outs be looked at.
    Glass does not cast shadows: light on its way to an opaque surface is not bent (no caustics).
    """
    _visible(packet, world, mask & ~CUTOUT, mask & CUTOUT, seen)


@inlined
def lamp_visible(packet: Packet, world: World, mask: int, which: int, seen: Scalars) -> None:
    """The same for rays to a light, whose shadows not everything may cast. A probe's own set goes before that."""
    shift = world.lights.caster_shift[which] if mask & OPAQUE != 0 else 0
    _visible(packet, world, (mask & ~CUTOUT) << shift, (mask & CUTOUT) << shift, seen)


@inlined
def _visible(packet: Packet, world: World, solid: int, cutout: int, seen: Scalars) -> None:
    """`visible`, with a mask of its own for cut-outs."""
    for lane in range(LANES):
        packet.ends[lane] = packet.rays[T_FAR, lane]
        if packet.valid[lane] != 0:
            packet.words[MASK, lane] = solid
    occluded(packet, world.geometry.handle, COHERENT)
    if not world.cutouts:
        for lane in range(LANES):
            seen[lane] = 0.0 if is_blocked(packet, lane) else 1.0
        return
    for lane in range(LANES):
        packet.shadowed[lane] = packet.valid[lane]
        if is_blocked(packet, lane):
            packet.valid[lane] = 0
        packet.words[MASK, lane] = cutout
    intersect_world(packet, world, packet.ends, SCATTERED)
    for lane in range(LANES):
        free = packet.valid[lane] != 0 and not has_hit(packet, lane)
        seen[lane] = 1.0 if packet.shadowed[lane] == 0 or free else 0.0


