"""Rays that know about materials: cut-outs let them through, shadows ask only whether something is in the way."""

from __future__ import annotations

import math

import numpy as np

from ..kernels.compile import inlined
from ..kernels.lanes import LANES, Scalars, Vectors, put
from ..kernels.sampling import chance_of_bits, hash32
from ..kernels.vec import Vec, along, dot, mul, row, scale, towards
from ..optics.interface import fresnel_dielectric, transmittance
from ..optics.models import absorption_distance_of, exit_of, is_sheet, thickness_of
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
    REFRACTIVE,
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
from .surface import Ray, color_input, drawn_model, float_input, hit_in, interaction, share_input, surface_of
from .tables import World

_MAX_CUTOUTS = 64
"""Holes that one ray may go through; behind so many it meets whatever comes next."""
_GOLDEN = 0.6180339887498949
_MAX_WALLS = 64
"""Walls of glass that light is looked at through; behind so many it goes on unchanged."""


@inlined
def ray_of(packet: Packet, lane: int) -> Ray:
    """The ray of a lane; its direction must have been unit."""
    return Ray(ray_origin(packet, lane), ray_direction(packet, lane))


@inlined
def _cover(world: World, packet: Packet, lane: int) -> float:
    """How much of the place hit in a lane is there: 0 or 1 of a cut-out material, its opacity of a `presence` one."""
    hit = hit_in(packet, lane, world.geometry)
    m = hit.material
    if world.materials.cutout[m] == 0:
        return 1.0
    at = interaction(world.geometry, hit, ray_of(packet, lane), 0.0)
    opacity = float_input(world, at, Param.OPACITY.value)
    threshold = world.materials.threshold[m]
    if threshold > 0.0:
        return 0.0 if opacity < threshold else 1.0
    return min(max(opacity, 0.0), 1.0)


@inlined
def _toss(world: World, packet: Packet, lane: int) -> float:
    """What decides for a ray how far it comes through what is there by a share, in [0, 1); after its first such hit.

    The samples of a pixel take turns, so that together they see as much as is there; a ray that belongs to none goes by
    its own bits, so that it is the same wherever it is traced.
    """
    surface = surface_of(world.geometry, hit_in(packet, lane, world.geometry))
    if packet.sample[lane] >= 0:
        pixel = int(np.int32(hash32(packet.x[lane], packet.y[lane], 0)))
        return (chance_of_bits(pixel, surface, 0) + packet.sample[lane] * _GOLDEN) % 1.0
    words = packet.words
    return chance_of_bits(words[DIR_X, lane] ^ words[ORG_X, lane], words[DIR_Y, lane], words[DIR_Z, lane] ^ surface)


@inlined
def belongs_to(packet: Packet, lane: int, x: int, y: int, sample: int) -> None:
    """Say whose the ray in a lane is: one of a pixel's samples, which take turns a golden section apart."""
    packet.x[lane], packet.y[lane], packet.sample[lane] = x, y, sample


@inlined
def _is_absent(world: World, packet: Packet, lane: int) -> bool:
    """The hit in a lane is a hole of a cut-out material, or the ray comes through a `presence` one.

    One toss is for all layers on a ray: it ends where less light than that has been left. So each layer stops what it
    covers of what came through those before, and of n samples that take turns the right number sees what is behind all.
    """
    cover = _cover(world, packet, lane)
    if cover == 0.0 or cover == 1.0:
        return cover == 0.0
    if packet.chance[lane] == 0:
        packet.chance[lane] = 1
        packet.toss[lane] = _toss(world, packet, lane)
    packet.through[lane] *= 1.0 - cover
    return 1.0 - packet.toss[lane] <= packet.through[lane]


@inlined
def intersect_world(packet: Packet, world: World, far: Scalars, coherent: bool) -> None:
    """Nearest present hit of every active lane; and `packet.chance`, where it is there, or others are not, by chance.

    Args:
        far: the T_FAR each lane started with.
    """
    handle = world.geometry.handle
    for lane in range(LANES):
        packet.chance[lane], packet.through[lane] = 0, 1.0
    intersect(packet, handle, coherent)
    if not world.cutouts:
        return
    for lane in range(LANES):
        packet.asked[lane] = packet.valid[lane]
    for _ in range(_MAX_CUTOUTS):
        again = False
        for lane in range(LANES):
            absent = packet.valid[lane] != 0 and has_hit(packet, lane) and _is_absent(world, packet, lane)
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
    """Put the segment from a surface to a light into a lane. `distance` [m] may be infinite.

    From where it starts, off the surface, it goes to where it was meant to end: with the direction from the surface it
    would meet what glows before that, where the two are near each other, and be stopped by the light itself.
    """
    start = off_surface(point, ng, direction)
    if distance < math.inf:
        direction, distance = towards(start, along(point, direction, distance))
    set_ray(packet, lane, start, direction, 0.0, short_of(distance), SOLID)


@inlined
def visible(packet: Packet, world: World, mask: int, seen: Vectors) -> None:
    """How much light reaches each active lane from its T_FAR, colour by colour, into `seen`; 1 for inactive lanes.

    All that may be in the way is asked at once. Only where something is do cut-outs have to be looked at, and glass
    looked through: straight on, for light on its way to an opaque surface is bent by photons alone (`world.caustics`).
    """
    _visible(packet, world, mask & ~CUTOUT, mask & CUTOUT, seen)


@inlined
def lamp_visible(packet: Packet, world: World, mask: int, which: int, seen: Vectors) -> None:
    """The same for rays to a light, whose shadows not everything may cast; but glass always does. A probe's own set
    goes before that."""
    shift = world.lights.caster_shift[which] if mask & OPAQUE != 0 else 0
    _visible(packet, world, (mask & ~CUTOUT) << shift, (mask & CUTOUT) << shift, seen)


@inlined
def _visible(packet: Packet, world: World, solid: int, cutout: int, seen: Vectors) -> None:
    """`visible`, with a mask of its own for cut-outs."""
    handle = world.geometry.handle
    stops = solid if world.glass.walked else solid | REFRACTIVE
    for lane in range(LANES):
        packet.ends[lane] = packet.rays[T_FAR, lane]
        packet.shadowed[lane] = packet.valid[lane]
        put(seen, lane, (1.0, 1.0, 1.0))
        packet.words[MASK, lane] = stops
    occluded(packet, handle, COHERENT)
    _leave_out_blocked(packet, seen)
    if world.cutouts:
        for lane in range(LANES):
            packet.words[MASK, lane] = cutout
        _pass_cutouts(packet, world, seen)
    if world.glass.walked:
        _look_through_glass(packet, world, seen)
    for lane in range(LANES):
        packet.valid[lane] = packet.shadowed[lane]


@inlined
def _pass_cutouts(packet: Packet, world: World, seen: Vectors) -> None:
    """Let each cut-out on the segments take the share of light that it covers: of a shadow the mean is wanted, and that
    is known, so nothing is tossed for and it has no grain."""
    handle = world.geometry.handle
    for lane in range(LANES):
        packet.asked[lane] = packet.valid[lane]
    intersect(packet, handle, SCATTERED)
    for _ in range(_MAX_CUTOUTS):
        again = False
        for lane in range(LANES):
            cover = _cover(world, packet, lane) if packet.valid[lane] != 0 and has_hit(packet, lane) else 1.0
            packet.valid[lane] = 0
            if cover < 1.0:
                put(seen, lane, scale(row(seen, lane), 1.0 - cover))
                restart(packet, lane, past(hit_distance(packet, lane)), packet.ends[lane])
                again = True
        if not again:
            break
        intersect(packet, handle, SCATTERED)
    for lane in range(LANES):
        packet.valid[lane] = packet.asked[lane]
    _leave_out_blocked(packet, seen)


@inlined
def _leave_out_blocked(packet: Packet, seen: Vectors) -> None:
    """Lanes with something in the way are dark, and not asked again; the others are as they were."""
    for lane in range(LANES):
        if is_blocked(packet, lane) or has_hit(packet, lane):
            put(seen, lane, (0.0, 0.0, 0.0))
            packet.valid[lane] = 0


@inlined
def _look_through_glass(packet: Packet, world: World, seen: Vectors) -> None:
    """Let the glass on each free segment take its part of the light: Fresnel at every interface, as if it were air on
    the other side, and what the body absorbs along its real length. What throws caustics stops light altogether."""
    handle, some = world.geometry.handle, False
    for lane in range(LANES):
        packet.words[MASK, lane] = REFRACTIVE
        if packet.valid[lane] != 0:  # from where it began: behind a hole of a cut-out it is further on
            restart(packet, lane, 0.0, packet.ends[lane])
    occluded(packet, handle, COHERENT)
    for lane in range(LANES):
        packet.begun[lane] = 0.0
        packet.valid[lane] = packet.valid[lane] if is_blocked(packet, lane) else 0
        if packet.valid[lane] != 0:
            restart(packet, lane, 0.0, packet.ends[lane])
            some = True
    if not some:
        return
    for _ in range(_MAX_WALLS):
        intersect_world(packet, world, packet.ends, COHERENT)
        again = False
        for lane in range(LANES):
            found = has_hit(packet, lane)
            packet.valid[lane] = 0
            if found and _pass_wall(packet, lane, world, seen):
                restart(packet, lane, past(hit_distance(packet, lane)), packet.ends[lane])
                again = True
        if not again:
            break


@inlined
def _pass_wall(packet: Packet, lane: int, world: World, seen: Vectors) -> bool:
    """Take from `seen` what the wall of glass that was hit takes. Whether any light is left."""
    hit, ray = hit_in(packet, lane, world.geometry), ray_of(packet, lane)
    if world.glass.casts[hit.part] != 0:
        put(seen, lane, (0.0, 0.0, 0.0))
        return False
    at, model = interaction(world.geometry, hit, ray, 0.0), drawn_model(world, hit)
    ior, cosine = max(1.0, float_input(world, at, Param.IOR.value)), abs(dot(at.ng, ray.direction))
    share = 1.0 - fresnel_dielectric(cosine, 1.0 / ior)
    length = 0.0
    enters = dot(at.ng, ray.direction) < 0.0
    if is_sheet(model):
        length = exit_of(model, at.point, at.ng, scale(ray.direction, -1.0), ior, thickness_of(model, 0.0))[0]
    elif enters:
        packet.begun[lane] = hit.t
    else:
        length = hit.t - packet.begun[lane]
        packet.begun[lane] = hit.t
    if is_sheet(model) or enters:
        share *= 1.0 - share_input(world, at, Param.OPACITY.value)
    left = row(seen, lane)
    if length > 0.0:
        distance: float = np.float64(world.materials.absorption_distance[hit.material])
        color = color_input(world, at, Param.TRANSMITTANCE.value)
        left = mul(left, transmittance(color, absorption_distance_of(model, distance), length))
    put(seen, lane, scale(left, share))
    return share > 0.0
