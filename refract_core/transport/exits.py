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
from ..kernels.lanes import LANES, Flags, Pairs, Scalars, Vectors, Words, put
from ..kernels.vec import along, dot, flip_towards, mul, normalize, row, scale, sub
from ..optics.interface import THIN_THICKNESS, box_model, reflect, refract, sphere_model, thin_model, transmittance
from ..scene import Model, Param
from ..world.embree import (
    COHERENT,
    GEOM,
    HIT_U,
    HIT_V,
    OPAQUE,
    PRIM,
    REFRACTIVE,
    SCATTERED,
    T_FAR,
    clear,
    set_ray,
)
from ..world.surface import color_input, float_input, hit_at, material_of, normal_input
from ..world.tracing import intersect_world, off_surface

MAX_EVENTS = 24
"""Interfaces that one walked ray may meet."""
MIN_THICKNESS = 1e-4
"""[m] (HDRP, Lit.hlsl)"""

# What became of a lane's ray.
LEFT, EMBEDDED, LOST = 0, 1, 2


class Exits(NamedTuple):
    """Eight rays on their way out."""

    on: Flags
    model: Words
    ior: Scalars
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
    """T_FAR to start with"""
    hit: Vectors
    """u, v and distance of the interface a walk has met"""
    met: Pairs
    """its part, -1 for none, and primitive"""
    unanswered: Scalars
    """the share of the light from the exit that no tier knew"""


@inlined
def load_medium(exits, lane, hit, world, override):  # type: ignore[no-untyped-def]
    """Look up the refraction attributes at an entry. `override`: a `Model` for every material, or -1."""
    g, mt, tx = world.geometry, world.materials, world.textures
    m = material_of(g, hit.part, hit.primitive)
    model = mt.model[m] if override < 0 else override
    if model == Model.TRACED.value and g.sheet[hit.part] != 0:
        model = Model.THIN.value  # an open mesh has no far side to find; `open_meshes` says so to the user
    thickness = max(MIN_THICKNESS, float_input(g, mt, tx, hit, m, Param.THICKNESS.value))
    distance = np.float64(mt.absorption_distance[m])
    if model == Model.THIN.value:
        thickness = distance = THIN_THICKNESS
    exits.on[lane] = 1
    exits.model[lane] = model
    exits.ior[lane] = max(1.0, float_input(g, mt, tx, hit, m, Param.IOR.value))
    exits.thickness[lane] = thickness
    exits.absorption_distance[lane] = distance
    put(exits.color, lane, color_input(g, mt, tx, hit, m, Param.TRANSMITTANCE.value))


@inlined
def find_exits(exits, block, hits, packet, world, ior, measured):  # type: ignore[no-untyped-def]
    """Fill point, direction, path_length, transmittance and status of every lane that is on.

    Args:
        measured: look for opaque objects between a model's entry and exit, which HDRP does not.
        block: the entries: point, ng, ns (on the viewer's side), wo.
        hits: shape (8,) part numbers of the entries.
        ior: shape (8,), the index to use (a colour channel's, under dispersion).
    """
    walks = False
    for lane in range(LANES):
        exits.status[lane] = LEFT
        if exits.on[lane] == 0:
            continue
        p, n, wo = row(block.point, lane), row(block.ns, lane), row(block.wo, lane)
        model = exits.model[lane]
        if model == Model.TRACED.value:
            walks = True
            _start_walk(exits, lane, block, hits[lane], p, n, wo, ior[lane])
            continue
        if model == Model.SPHERE.value:
            length, point, direction = sphere_model(p, n, wo, ior[lane], exits.thickness[lane])
        elif model == Model.BOX.value:
            length, point, direction = box_model(p, n, wo, ior[lane], exits.thickness[lane])
        elif model == Model.THIN.value:
            length, point, direction = thin_model(p, n, wo, ior[lane])
        else:
            length, point, direction = 0.0, p, scale(wo, -1.0)
        put(exits.point, lane, point)
        put(exits.direction, lane, direction)
        exits.path_length[lane] = length
        t = transmittance(row(exits.color, lane), exits.absorption_distance[lane], length)
        put(exits.transmittance, lane, t)
    if measured:
        _stop_at_opaque(exits, block, packet, world)
    if walks:
        _walk(exits, packet, world, ior)


@inlined
def _stop_at_opaque(exits, block, packet, world):  # type: ignore[no-untyped-def]
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
        if packet.valid[lane] == 0 or packet.words[GEOM, lane] < 0:
            continue
        t = np.float64(packet.rays[T_FAR, lane])
        rays = packet.rays
        exits.status[lane] = EMBEDDED
        put(exits.point, lane, (np.float64(rays[0, lane]), np.float64(rays[1, lane]), np.float64(rays[2, lane])))
        put(exits.direction, lane, (np.float64(rays[4, lane]), np.float64(rays[5, lane]), np.float64(rays[6, lane])))
        exits.path_length[lane] = t
        put(exits.transmittance, lane, transmittance(row(exits.color, lane), exits.absorption_distance[lane], t))


@inlined
def _start_walk(exits, lane, block, part, p, n, wo, ior):  # type: ignore[no-untyped-def]
    _, inside = refract(scale(wo, -1.0), n, 1.0 / ior)
    ng = row(block.ng, lane)
    if dot(inside, ng) >= 0.0:  # a steep shading normal must not send the ray back out
        _, inside = refract(scale(wo, -1.0), ng, 1.0 / ior)
    put(exits.point, lane, off_surface(p, ng, inside))
    put(exits.direction, lane, inside)
    exits.path_length[lane] = 0.0
    put(exits.transmittance, lane, (1.0, 1.0, 1.0))
    exits.inside[lane] = part
    exits.status[lane] = LOST


@inlined
def _walk(exits, packet, world, ior):  # type: ignore[no-untyped-def]
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
        intersect_world(packet, world, exits.segment, np.bool_(event == 0))
        _note_interfaces(exits, packet, world)
        for lane in range(LANES):
            if exits.on[lane] != 0 and exits.status[lane] == LOST:
                _meet(exits, lane, world, ior)


@inlined
def _note_interfaces(exits, packet, world):  # type: ignore[no-untyped-def]
    """Keep what a walk's rays have met. Where glass touches an opaque object, as on a table, the two surfaces tie and
    the ray could come out on the far side of the table: an opaque surface within rounding of the hit takes it."""
    for lane in range(LANES):
        exits.met[lane, 0] = -1
        if packet.valid[lane] == 0:
            continue
        _keep_interface(exits, packet, lane)
        t = exits.hit[lane, 2]
        packet.valid[lane] = 0
        if exits.met[lane, 0] >= 0 and exits.inside[lane] >= 0:
            p, d = row(exits.point, lane), row(exits.direction, lane)
            end = along(p, d, t)
            near = 4e-5 * max(abs(end[0]), abs(end[1]), abs(end[2])) + 4e-6
            exits.segment[lane] = t + near
            set_ray(packet, lane, p, d, max(0.0, t - near), t + near, OPAQUE)
    intersect_world(packet, world, exits.segment, SCATTERED)
    for lane in range(LANES):
        if packet.valid[lane] != 0 and packet.words[GEOM, lane] >= 0:
            _keep_interface(exits, packet, lane)


@inlined
def _keep_interface(exits, packet, lane):  # type: ignore[no-untyped-def]
    exits.met[lane, 0], exits.met[lane, 1] = packet.words[GEOM, lane], packet.words[PRIM, lane]
    exits.hit[lane, 0], exits.hit[lane, 1] = packet.rays[HIT_U, lane], packet.rays[HIT_V, lane]
    exits.hit[lane, 2] = packet.rays[T_FAR, lane]


@inlined
def _meet(exits, lane, world, ior):  # type: ignore[no-untyped-def]
    """One interface of a walk."""
    part, primitive = exits.met[lane, 0], exits.met[lane, 1]
    inside = exits.inside[lane]
    if part < 0:
        exits.status[lane] = LEFT
        return
    g, mt, tx = world.geometry, world.materials, world.textures
    m = material_of(g, part, primitive)
    t = exits.hit[lane, 2]
    p, d = row(exits.point, lane), row(exits.direction, lane)
    if mt.model[m] == Model.NONE.value:
        exits.status[lane] = LEFT if inside < 0 else EMBEDDED
        if inside >= 0:
            _absorb(exits, lane, t)
        return
    hit = hit_at(g, part, primitive, exits.hit[lane, 0], exits.hit[lane, 1], p, d, t, 0.0)
    leaving = dot(hit.ng, d) > 0.0
    same = inside >= 0 and g.thing[part] == g.thing[inside]
    if inside >= 0 and same and leaving:
        _absorb(exits, lane, t)
        n = scale(flip_towards(normal_input(g, mt, tx, hit, m), hit.ng), -1.0)
        ok, out = refract(d, n, ior[lane])
        if ok and dot(out, hit.ng) > 0.0:
            exits.inside[lane] = -1
        else:
            out = reflect(d, n)
            if dot(out, hit.ng) > 0.0:
                out = reflect(d, scale(hit.ng, -1.0))
        _go_on(exits, lane, hit, out)
    elif inside < 0 and not leaving and g.sheet[part] == 0 and mt.model[m] != Model.THIN.value:
        ior[lane] = max(1.0, float_input(g, mt, tx, hit, m, Param.IOR.value))
        exits.absorption_distance[lane] = mt.absorption_distance[m]
        put(exits.color, lane, color_input(g, mt, tx, hit, m, Param.TRANSMITTANCE.value))
        n = flip_towards(normal_input(g, mt, tx, hit, m), hit.ng)
        _, within = refract(d, n, 1.0 / ior[lane])
        if dot(within, hit.ng) >= 0.0:
            _, within = refract(d, hit.ng, 1.0 / ior[lane])
        exits.inside[lane] = part
        _go_on(exits, lane, hit, within)
    else:
        if inside >= 0:
            _absorb(exits, lane, t)
        elif mt.model[m] == Model.THIN.value or g.sheet[part] != 0:
            cosine = max(1e-3, abs(dot(hit.ng, d)))
            tint = color_input(g, mt, tx, hit, m, Param.TRANSMITTANCE.value)
            through = transmittance(tint, THIN_THICKNESS, THIN_THICKNESS / cosine)
            put(exits.transmittance, lane, mul(row(exits.transmittance, lane), through))
        _go_on(exits, lane, hit, d)


@inlined
def _absorb(exits, lane, length):  # type: ignore[no-untyped-def]
    exits.path_length[lane] += length
    through = transmittance(row(exits.color, lane), exits.absorption_distance[lane], length)
    put(exits.transmittance, lane, mul(row(exits.transmittance, lane), through))


@inlined
def _go_on(exits, lane, hit, direction):  # type: ignore[no-untyped-def]
    put(exits.point, lane, off_surface(hit.point, hit.ng, direction))
    put(exits.direction, lane, direction)
