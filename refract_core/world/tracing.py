"""Rays that know about materials: cut-outs let them through, shadows ask only whether something is in the way."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..kernels.compile import inlined
from ..kernels.lanes import LANES
from ..kernels.sampling import hash32
from ..kernels.vec import along, dot
from ..scene import Param
from .embree import (
    COHERENT,
    CUTOUT,
    GEOM,
    HIT_U,
    HIT_V,
    PRIM,
    SCATTERED,
    SOLID,
    T_FAR,
    T_NEAR,
    intersect,
    keep_valid,
    occluded,
    set_ray,
)
from .environment import EnvironmentTable
from .lights import LightTable
from .surface import float_input, hit_at, material_of
from .tables import Geometry, MaterialTable
from .textures import TextureTable

_MAX_CUTOUTS = 64
_SKIP = 1e-5  # how far past an absent surface a ray goes on, relative to its distance and in metres


class World(NamedTuple):
    """The whole scene as a kernel sees it."""

    geometry: Geometry
    materials: MaterialTable
    textures: TextureTable
    lights: LightTable
    environment: EnvironmentTable
    cutouts: bool
    """Some material is a cut-out, so that hits must be looked at."""


@inlined
def off_surface(point, ng, direction):  # type: ignore[no-untyped-def]
    """Start of a ray that leaves a surface: moved along the normal to the side it goes to, by more than float32 can
    misplace a hit at that distance from the origin."""
    reach = max(abs(point[0]), abs(point[1]), abs(point[2]))
    step = 1e-5 * reach + 1e-6
    if dot(ng, direction) < 0.0:
        step = -step
    return along(point, ng, step)


@inlined
def _absent(world, packet, lane):  # type: ignore[no-untyped-def]
    """The hit in a lane is a hole of a cut-out material, or the uncovered share of a `presence` one."""
    part, primitive = packet.words[GEOM, lane], packet.words[PRIM, lane]
    m = material_of(world.geometry, part, primitive)
    if world.materials.cutout[m] == 0:
        return False
    rays = packet.rays
    u, v = np.float64(rays[HIT_U, lane]), np.float64(rays[HIT_V, lane])
    origin = (np.float64(rays[0, lane]), np.float64(rays[1, lane]), np.float64(rays[2, lane]))
    direction = (np.float64(rays[4, lane]), np.float64(rays[5, lane]), np.float64(rays[6, lane]))
    hit = hit_at(world.geometry, part, primitive, u, v, origin, direction, np.float64(rays[T_FAR, lane]), 0.0)
    opacity = float_input(world.geometry, world.materials, world.textures, hit, m, Param.OPACITY.value)
    threshold = world.materials.threshold[m]
    if threshold > 0.0:
        return opacity < threshold
    # Coverage as chance: decided by the bits of the ray itself, so it is the same wherever the ray is traced.
    bits = hash32(packet.words[4, lane] ^ packet.words[0, lane], packet.words[5, lane], packet.words[6, lane] ^ part)
    return opacity <= bits * (1.0 / 4294967296.0)


@inlined
def intersect_world(packet, world, far, coherent):  # type: ignore[no-untyped-def]
    """Nearest present hit of every active lane. `far`: shape (8,), the T_FAR each lane started with."""
    handle = world.geometry.handle
    intersect(packet, handle, coherent)
    if not world.cutouts:
        return
    keep_valid(packet, 0)
    traced = packet.kept[0]
    for _ in range(_MAX_CUTOUTS):
        again = False
        for lane in range(LANES):
            if packet.valid[lane] == 0:
                continue
            packet.valid[lane] = 0
            if packet.words[GEOM, lane] >= 0 and _absent(world, packet, lane):
                packet.rays[T_NEAR, lane] = packet.rays[T_FAR, lane] * (1.0 + _SKIP) + _SKIP
                packet.rays[T_FAR, lane] = far[lane]
                packet.words[GEOM, lane] = -1
                packet.valid[lane] = -1
                again = True
        if not again:
            break
        intersect(packet, handle, SCATTERED)
    for lane in range(LANES):
        packet.valid[lane] = traced[lane]


@inlined
def add_shadow_ray(packet, lane, point, ng, direction, distance):  # type: ignore[no-untyped-def]
    """Put the segment from a surface to a light into a lane."""
    reach = distance * (1.0 - 1e-4)
    set_ray(packet, lane, off_surface(point, ng, direction), direction, 0.0, reach, SOLID)


@inlined
def visible(packet, world, mask, result):  # type: ignore[no-untyped-def]
    """Whether each active lane reaches its T_FAR: 1 or 0 into `result` (8,), 1 for inactive lanes.

    Glass does not cast shadows: light on its way to an opaque surface is not bent (no caustics).
    """
    far = result
    for lane in range(LANES):
        far[lane] = packet.rays[T_FAR, lane]
        if packet.valid[lane] != 0:
            packet.words[9, lane] = mask & ~CUTOUT
    occluded(packet, world.geometry.handle, COHERENT)
    if not world.cutouts:
        for lane in range(LANES):
            blocked = packet.valid[lane] != 0 and packet.rays[T_FAR, lane] < 0.0
            result[lane] = 0.0 if blocked else 1.0
        return
    keep_valid(packet, 1)
    traced = packet.kept[1]
    for lane in range(LANES):
        if packet.valid[lane] != 0 and packet.rays[T_FAR, lane] < 0.0:
            packet.valid[lane] = 0
        packet.words[9, lane] = mask & CUTOUT
    intersect_world(packet, world, far, SCATTERED)
    for lane in range(LANES):
        free = packet.valid[lane] != 0 and packet.words[GEOM, lane] < 0
        result[lane] = 1.0 if traced[lane] == 0 or free else 0.0


def world_of(geometry: Any, materials: Any, textures: Any, lights: Any, environment: Any) -> World:
    """Put the tables together."""
    return World(geometry, materials, textures, lights, environment, bool(materials.cutout.any()))
