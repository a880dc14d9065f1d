"""Where light leaves a refractive object: HDRP's models from the entry alone, or the real mesh by Embree.

`walk` follows the refracted ray through the geometry: total internal reflection, re-entry of concave and hollow
objects, other glass in the way, opaque things inside. It follows the transmitted path only, so it makes one exit per
ray, as the models do; Fresnel is applied once, at the entry, the same for every model.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..kernels.compile import inlined
from ..kernels.lanes import LANES, Flags, Scalars, Vectors, Words, put
from ..kernels.vec import Vec, along, dot, flip_towards, mul, normalize, row, scale, sub
from ..optics.interface import reflect, refract, transmittance
from ..optics.models import (
    BOX_MIN_COS,
    WALL,
    absorption_distance_of,
    cosine_inside,
    exit_of,
    is_sheet,
    is_walked,
    on_open_mesh,
    thickness_of,
)
from ..scene import Model, Param
from ..world.embree import (
    COHERENT,
    OPAQUE,
    REFRACTIVE,
    SCATTERED,
    Packet,
    clear,
    has_hit,
    hit_distance,
    ray_direction,
    ray_origin,
    set_ray,
)
from ..world.offsets import off_surface, tie
from ..world.shading import Block
from ..world.surface import (
    NOTHING,
    HitLanes,
    Interaction,
    Ray,
    color_input,
    float_input,
    hit_in,
    interaction,
    keep_hit,
    kept_hit,
    normal_input,
)
from ..world.tables import World
from ..world.tracing import intersect_world

MAX_EVENTS = 24
"""Interfaces that one walked ray may meet."""

# What became of a lane's ray.
LEFT, EMBEDDED, LOST = 0, 1, 2


class Exits(NamedTuple):
    """Eight rays on their way out."""

    on: Flags
    model: Words
    ior: Scalars
    """authored, >= 1"""
    ior_now: Scalars
    """ior of the medium the ray is in: the authored one, or a colour channel's under dispersion"""
    thickness: Scalars
    """authored [m]"""
    color: Vectors
    """transmittance colour"""
    absorption_distance: Scalars
    """[m]"""
    point: Vectors
    """[m]"""
    direction: Vectors
    path_length: Scalars
    """[m] inside any medium"""
    transmittance: Vectors
    status: Words
    """LEFT: point and direction are the exit. EMBEDDED: the ray from point along direction meets an opaque object
    inside. LOST: no exit found within MAX_EVENTS."""
    inside: Words
    """part number of the medium the ray is in, or -1"""
    segment: Scalars
    """T_FAR of the rays in the packet, to start with [m]"""
    met: HitLanes
    """the interface a walk has met, until it has been dealt with"""
    unanswered: Scalars
    """the share of the light from the exit that no tier knew"""


@inlined
def load_medium(exits: Exits, lane: int, at: Interaction, world: World, override: int) -> None:
    """Look up the refraction attributes at an entry. `override`: a `Model` for every material, or -1."""
    m = at.hit.material
    model = world.materials.model[m] if override < 0 else override
    if world.geometry.sheet[at.hit.part] != 0:
        model = on_open_mesh(model)  # `open_meshes` says so to the user
    exits.on[lane] = 1
    exits.model[lane] = model
    exits.ior[lane] = max(1.0, float_input(world, at, Param.IOR.value))
    exits.thickness[lane] = thickness_of(model, float_input(world, at, Param.THICKNESS.value))
    distance: float = np.float64(world.materials.absorption_distance[m])
    exits.absorption_distance[lane] = absorption_distance_of(model, distance)
    put(exits.color, lane, color_input(world, at, Param.TRANSMITTANCE.value))


@inlined
def find_exits(exits: Exits, block: Block, parts: Words, packet: Packet, world: World, measured: bool) -> None:
    """Fill point, direction, path_length, transmittance and status of every lane that is on.

    Args:
        measured: look for opaque objects between a model's entry and exit, which HDRP does not.
        block: the entries: point, ng, ns (on the viewer's side), wo.
        parts: of the entries.
    """
    walks = False
    for lane in range(LANES):
        exits.status[lane] = LEFT
        if exits.on[lane] == 0:
            continue
        p, n, wo = row(block.point, lane), row(block.ns, lane), row(block.wo, lane)
        model = exits.model[lane]
        if is_walked(model):
            walks = True
            _start_walk(exits, lane, block, parts[lane])
            continue
        length, point, direction = exit_of(model, p, n, wo, exits.ior_now[lane], exits.thickness[lane])
        put(exits.point, lane, point)
        put(exits.direction, lane, direction)
        exits.path_length[lane] = length
        t = transmittance(row(exits.color, lane), exits.absorption_distance[lane], length)
        put(exits.transmittance, lane, t)
    if measured:
        _stop_at_opaque(exits, block, packet, world)
    if walks:
        _walk(exits, packet, world)


@inlined
def _stop_at_opaque(exits: Exits, block: Block, packet: Packet, world: World) -> None:
    """A typed thickness may reach through the floor the glass stands on: such rays are EMBEDDED, as in a walk."""
    clear(packet)
    for lane in range(LANES):
        if exits.on[lane] == 0 or exits.status[lane] != LEFT or exits.path_length[lane] <= 0.0:
            continue
        p = row(block.point, lane)
        inside = normalize(sub(row(exits.point, lane), p))
        exits.segment[lane] = exits.path_length[lane]
        set_ray(packet, lane, off_surface(p, row(block.ng, lane), inside), inside, 0.0, exits.segment[lane], OPAQUE)
    intersect_world(packet, world, exits.segment, COHERENT)
    for lane in range(LANES):
        if not has_hit(packet, lane):
            continue
        t = hit_distance(packet, lane)
        exits.status[lane] = EMBEDDED
        put(exits.point, lane, ray_origin(packet, lane))
        put(exits.direction, lane, ray_direction(packet, lane))
        exits.path_length[lane] = t
        put(exits.transmittance, lane, transmittance(row(exits.color, lane), exits.absorption_distance[lane], t))


@inlined
def _start_walk(exits: Exits, lane: int, block: Block, part: int) -> None:
    """Enter the medium of `part` at the block's surface."""
    n, ng, wo = row(block.ns, lane), row(block.ng, lane), row(block.wo, lane)
    eta_i_over_t = 1.0 / exits.ior_now[lane]
    _, inside = refract(scale(wo, -1.0), n, eta_i_over_t)
    if dot(inside, ng) >= 0.0:  # a steep shading normal must not send the ray back out
        _, inside = refract(scale(wo, -1.0), ng, eta_i_over_t)
    put(exits.point, lane, off_surface(row(block.point, lane), ng, inside))
    put(exits.direction, lane, inside)
    exits.path_length[lane] = 0.0
    put(exits.transmittance, lane, (1.0, 1.0, 1.0))
    exits.inside[lane] = part
    exits.status[lane] = LOST


@inlined
def _walk(exits: Exits, packet: Packet, world: World) -> None:
    """Follow every lane whose status is LOST until it leaves for good."""
    for event in range(MAX_EVENTS):
        clear(packet)
        waiting = False
        for lane in range(LANES):
            exits.segment[lane] = math.inf
            if exits.on[lane] == 0 or exits.status[lane] != LOST:
                continue
            waiting = True
            p, d = row(exits.point, lane), row(exits.direction, lane)
            set_ray(packet, lane, p, d, 0.0, math.inf, REFRACTIVE | OPAQUE)
        if not waiting:
            break
        intersect_world(packet, world, exits.segment, COHERENT if event == 0 else SCATTERED)
        _note_interfaces(exits, packet, world)
        for lane in range(LANES):
            if exits.on[lane] != 0 and exits.status[lane] == LOST:
                _meet(exits, lane, world)


@inlined
def _note_interfaces(exits: Exits, packet: Packet, world: World) -> None:
    """Keep what a walk's rays have met. Where glass touches an opaque object, as on a table, the two surfaces tie and
    the ray could come out on the far side of the table: an opaque surface within rounding of the hit takes it."""
    for lane in range(LANES):
        exits.met.part[lane] = NOTHING
        found = has_hit(packet, lane)
        packet.valid[lane] = 0
        if not found:
            continue
        hit = hit_in(packet, lane, world.geometry)
        keep_hit(exits.met, lane, hit)
        if exits.inside[lane] >= 0:
            p, d = row(exits.point, lane), row(exits.direction, lane)
            near = tie(along(p, d, hit.t))
            exits.segment[lane] = hit.t + near
            set_ray(packet, lane, p, d, max(0.0, hit.t - near), hit.t + near, OPAQUE)
    intersect_world(packet, world, exits.segment, SCATTERED)
    for lane in range(LANES):
        if has_hit(packet, lane):
            keep_hit(exits.met, lane, hit_in(packet, lane, world.geometry))


@inlined
def _meet(exits: Exits, lane: int, world: World) -> None:
    """One interface of a walk: out of the medium, into another, past what is neither, or onto something opaque."""
    inside = exits.inside[lane]
    hit = kept_hit(exits.met, lane)
    if hit.part == NOTHING:
        exits.status[lane] = LEFT
        return
    model = world.materials.model[hit.material]
    if model == Model.NONE.value:
        exits.status[lane] = LEFT if inside < 0 else EMBEDDED
        if inside >= 0:
            _absorb(exits, lane, hit.t)
        return
    d = row(exits.direction, lane)
    at = interaction(world.geometry, hit, Ray(row(exits.point, lane), d), 0.0)
    leaving = dot(at.ng, d) > 0.0
    thing, sheet = world.geometry.thing, world.geometry.sheet
    if inside >= 0 and thing[hit.part] == thing[inside] and leaving:
        _absorb(exits, lane, hit.t)
        _leave(exits, lane, at, world)
    elif inside < 0 and not leaving and sheet[hit.part] == 0 and not is_sheet(model):
        _enter(exits, lane, at, world)
    else:  # another thing's surface within this one, a pane, a sheet: the ray goes straight on
        if inside >= 0:
            _absorb(exits, lane, hit.t)
        elif is_sheet(model) or sheet[hit.part] != 0:
            # The ray is not bent on its way, but what it loses is what it would lose bent: the slant inside counts.
            ior = max(1.0, float_input(world, at, Param.IOR.value))
            cosine = max(BOX_MIN_COS, cosine_inside(abs(dot(at.ng, d)), ior))
            tint = color_input(world, at, Param.TRANSMITTANCE.value)
            through = transmittance(tint, WALL, WALL / cosine)
            put(exits.transmittance, lane, mul(row(exits.transmittance, lane), through))
        _go_on(exits, lane, at, d)


@inlined
def _leave(exits: Exits, lane: int, at: Interaction, world: World) -> None:
    """From the medium out into the air, or back into it by total internal reflection."""
    d = row(exits.direction, lane)
    n = scale(flip_towards(normal_input(world, at), at.ng), -1.0)
    ok, out = refract(d, n, exits.ior_now[lane])
    if ok and dot(out, at.ng) > 0.0:
        exits.inside[lane] = NOTHING
    else:
        out = reflect(d, n)
        if dot(out, at.ng) > 0.0:  # a steep shading normal must not send it out all the same
            out = reflect(d, scale(at.ng, -1.0))
    _go_on(exits, lane, at, out)


@inlined
def _enter(exits: Exits, lane: int, at: Interaction, world: World) -> None:
    """From the air into the medium of what was hit, whose absorption and ior count from here on."""
    d = row(exits.direction, lane)
    exits.ior_now[lane] = max(1.0, float_input(world, at, Param.IOR.value))
    exits.absorption_distance[lane] = world.materials.absorption_distance[at.hit.material]
    put(exits.color, lane, color_input(world, at, Param.TRANSMITTANCE.value))
    n = flip_towards(normal_input(world, at), at.ng)
    _, within = refract(d, n, 1.0 / exits.ior_now[lane])
    if dot(within, at.ng) >= 0.0:
        _, within = refract(d, at.ng, 1.0 / exits.ior_now[lane])
    exits.inside[lane] = at.hit.part
    _go_on(exits, lane, at, within)


@inlined
def _absorb(exits: Exits, lane: int, length: float) -> None:
    """`length` metres of the medium the ray is in (Beer-Lambert)."""
    exits.path_length[lane] += length
    through = transmittance(row(exits.color, lane), exits.absorption_distance[lane], length)
    put(exits.transmittance, lane, mul(row(exits.transmittance, lane), through))


@inlined
def _go_on(exits: Exits, lane: int, at: Interaction, direction: Vec) -> None:
    """Restart the ray at a surface."""
    put(exits.point, lane, off_surface(at.point, at.ng, direction))
    put(exits.direction, lane, direction)
