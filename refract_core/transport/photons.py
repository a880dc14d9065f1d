"""Photons: light followed from the glass that it falls on to the opaque surfaces that it ends on.

A photon starts on a surface of glass, at a place drawn in proportion to what the lights bring there (nothing stands in
the way: closed form). One ray to the light says how much of it arrives; then the same tree that view rays grow
(`tree`, `crossing`) takes it through the glass, with all its flux, and every leaf on something opaque is a landing.
Starting on the glass wastes no photon beside it, asks each light what a matte surface would ask, and works for every
shape of glass and of light. What the leaves bring is kept in `world.caustics`.

Photons follow one sequence of four dimensions, R4 (Roberts, "The unreasonable effectiveness of quasirandom sequences",
2018): two for the place, along the lights' flux, and two for a point of the light. So they are the same in every run.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..kernels.arrays import F64_1D, F64_2D, I32_1D
from ..kernels.compile import inlined, kernel
from ..kernels.lanes import LANES, Vectors, put
from ..kernels.sampling import Key, Purpose, unit_pair
from ..kernels.vec import Vec, add, cross, dot, flip_towards, mul, normalize, row, scale, sub
from ..optics.lobes import MIRROR_ALPHA, sample_cosine, sample_half_vector
from ..scene import Model
from ..world.caustics import Landings
from ..world.embree import OPAQUE, clear
from ..world.environment import TEXEL_LUMINANCE, direction_pdf, irradiance, radiance, sample_direction
from ..world.lights import drawn_ray, irradiance_factor, is_flat
from ..world.offsets import off_surface
from ..world.shaping import shape_drawn, shape_matt
from ..world.surface import NOTHING, Interaction, Ray, ball_of, corners_of, interaction, is_round, kept_hit, sense_of
from ..world.tables import World
from ..world.tracing import add_shadow_ray, visible
from .crossing import PASSED, Rules, meet, send_mirrored, send_out, send_past, send_through
from .crossing import cross as split
from .rays import Rays, absorb, copy_ray
from .tree import CELL, TreeScratch, clear_slot, trace

BANDS, SECTORS = 16, 32
"""Patches of equal area that stand for the triangles of an exact sphere."""
_STEPS = (0.8566748838545029, 0.733891856627126, 0.6287067210378087, 0.5385972572236101)
"""1/g .. 1/g^4 for the g with g^5 = g + 1."""


class Sources(NamedTuple):
    """Pieces of glass as each light sees them: E rows."""

    light: I32_1D
    """shape (E,): row of the light table; one more than the last is the sky"""
    part: I32_1D
    instance: I32_1D
    """which of the part's places"""
    primitive: I32_1D
    """triangle within the part; patch of a sphere"""
    side: F64_1D
    """1: outside of the surface; -1: its inside, where a body has a light in it"""
    area: F64_1D
    """shape (E,): that the row stands for [m^2]"""
    flux: F64_1D
    """shape (E,): its flux if nothing stands in the way, by luminance, about; `weigh_sources` fills it"""


class PhotonScratch(NamedTuple):
    """What one thread needs for a cell of photons."""

    flux: F64_2D
    """shape (64, 3)"""
    source: I32_1D
    """shape (64,): row of `Sources`"""
    point: Vectors
    """where the eight photons start that are asked for their light [m]"""
    normal: Vectors
    to_light: Vectors
    """unit direction"""
    brought: Vectors
    """flux if nothing stands in the way"""
    arrives: Vectors
    """share of it, colour by colour"""

    @staticmethod
    def fresh() -> PhotonScratch:
        """All of it at zero."""
        return PhotonScratch(
            np.zeros((CELL, 3)), np.zeros(CELL, np.int32), np.zeros((LANES, 3)), np.zeros((LANES, 3)),
            np.zeros((LANES, 3)), np.zeros((LANES, 3)), np.zeros((LANES, 3)),
        )  # fmt: skip


# --- where photons start --------------------------------------------------------------------------------------------


@kernel
def weigh_sources(world: World, sources: Sources, first: int, last: int) -> None:
    """Fill `sources.flux` of rows `first` to before `last`: the mean over the corners and the middle of each piece."""
    for e in range(first, last):
        total = 0.0
        for k in range(4):
            # Corners a little inwards, and the middle.
            a, b = (0.04, 0.04) if k == 0 else ((0.92, 0.04) if k == 1 else ((0.04, 0.92) if k == 2 else (0.33, 0.33)))
            p, n = _place_at(world, sources, e, a, b)
            total += dot(_unoccluded(world, sources.light[e], p, n), TEXEL_LUMINANCE)
        sources.flux[e] = 0.25 * total * sources.area[e]


@inlined
def _unoccluded(world: World, light: int, p: Vec, n: Vec) -> Vec:
    """Irradiance of a light, or of the sky, if nothing stands before it [radiance * sr]."""
    if light == world.lights.kind.shape[0]:
        return irradiance(world.environment, n)
    share = irradiance_factor(world.lights, light, p, n) * world.lights.diffuse[light]
    brought = scale(row(world.lights.radiance, light), share)
    if world.lights.even[light] != 0 or share <= 0.0:
        return brought
    return mul(brought, shape_matt(world.lights, light, p, n))


@inlined
def _from_point(world: World, light: int, p: Vec, n: Vec, direction: Vec, distance: float, share: float) -> Vec:
    """What one point of a light brings, that `drawn_ray` has drawn [radiance * sr]."""
    lights = world.lights
    brought = scale(row(lights.radiance, light), share * lights.diffuse[light])
    if lights.even[light] != 0 or share <= 0.0:
        return brought
    if is_flat(lights, light):
        return mul(brought, shape_drawn(lights, light, p, direction, distance))
    return mul(brought, shape_matt(lights, light, p, n))


@inlined
def _place_at(world: World, sources: Sources, e: int, a: float, b: float) -> tuple[Vec, Vec]:
    """Place and normal of a piece; `a`, `b` >= 0 are barycentric, a + b <= 1. Of a sphere's patch, they fill half."""
    geometry, part, side = world.geometry, sources.part[e], sources.side[e]
    if is_round(geometry, part):
        band, sector = sources.primitive[e] // SECTORS, sources.primitive[e] % SECTORS
        z = 2.0 * (band + a) / BANDS - 1.0
        phi = 2.0 * math.pi * (sector + b) / SECTORS
        r = math.sqrt(max(0.0, 1.0 - z * z))
        n = (r * math.cos(phi), r * math.sin(phi), z)
        centre, radius = ball_of(geometry, part, sources.instance[e])
        return add(centre, scale(n, radius)), scale(n, side)
    p, q, last = corners_of(geometry, part, sources.instance[e], sources.primitive[e])
    side *= sense_of(geometry, part, sources.instance[e])
    pq, pr = sub(q, p), sub(last, p)
    return add(p, add(scale(pq, a), scale(pr, b))), scale(normalize(cross(pq, pr)), side)


@inlined
def _draw_place(world: World, sources: Sources, e: int, u1: float, u2: float) -> tuple[Vec, Vec]:
    """A place spread evenly over a piece."""
    if is_round(world.geometry, sources.part[e]):
        return _place_at(world, sources, e, u1, u2)
    r = math.sqrt(u1)
    return _place_at(world, sources, e, 1.0 - r, u2 * r)


@inlined
def _find(cdf: F64_1D, x: float) -> int:
    """Row e with cdf[e] <= x < cdf[e + 1], whose interval is not empty."""
    low, high = 0, cdf.shape[0] - 2
    while low < high:
        middle = (low + high + 1) // 2
        if cdf[middle] <= x:
            low = middle
        else:
            high = middle - 1
    return low


@inlined
def _direction_of_sky(world: World, n: Vec, k: int, u1: float, u2: float) -> tuple[Vec, Vec]:
    """A direction to the sky, every other one by the cosine, the rest by radiance, and the irradiance it stands for
    (Veach's balance heuristic)."""
    sky = world.environment
    d = sample_cosine(n, u1, u2) if sky.even or k % 2 == 0 else sample_direction(sky, u1, u2)[0]
    cosine = dot(d, n)
    if cosine <= 0.0:
        return n, (0.0, 0.0, 0.0)
    density = cosine / math.pi
    if not sky.even:
        density = 0.5 * density + 0.5 * direction_pdf(sky, d)[0]
    return d, scale(radiance(sky, d, 0.0), cosine / density)


# --- following ----------------------------------------------------------------------------------------------------


@kernel
def photon_batch(
    world: World, sources: Sources, cdf: F64_1D, rules: Rules, in_air: Rays, scratch: TreeScratch, own: PhotonScratch,
    first: int, last: int, total: int, landings: Landings,
) -> int:  # fmt: skip
    """Follow photons `first` to before `last` of `total`.

    Args:
        cdf: shape (E + 1,): running sum of the chances of the sources, 0 .. 1.
        in_air: one row, a ray of the whole light in air, without place or direction.

    Returns:
        Landings, which may be more than there was room for; then those are missing.
    """
    landed = 0
    for start in range(first, last, CELL):
        count = 0
        for begin in range(start, min(start + CELL, last), LANES):
            end = min(begin + LANES, last)
            count = _start(world, sources, cdf, in_air, scratch, own, begin, end, start, total, count)
        landed = _follow(world, sources, rules, scratch, own, count, start, landings, landed)
    return landed


@inlined
def _start(
    world: World, sources: Sources, cdf: F64_1D, in_air: Rays, scratch: TreeScratch, own: PhotonScratch,
    first: int, last: int, cell: int, total: int, count: int,
) -> int:  # fmt: skip
    """Put photons on the stack that light arrives at. Returns its new height."""
    packet, lights = scratch.packet, world.lights
    clear(packet)
    for lane in range(last - first):
        k = first + lane
        u1, u2 = (0.5 + k * _STEPS[0]) % 1.0, (0.5 + k * _STEPS[1]) % 1.0
        u3, u4 = (0.5 + k * _STEPS[2]) % 1.0, (0.5 + k * _STEPS[3]) % 1.0
        e = _find(cdf, u1)
        chance = cdf[e + 1] - cdf[e]
        p, n = _draw_place(world, sources, e, min(1.0, (u1 - cdf[e]) / chance), u2)
        light = sources.light[e]
        if light == lights.kind.shape[0]:
            direction, brought = _direction_of_sky(world, n, k, u3, u4)
            distance = math.inf
        else:
            direction, distance, share = drawn_ray(lights, light, p, n, u3, u4)
            brought = _from_point(world, light, p, n, direction, distance, share)
        put(own.point, lane, p)
        put(own.normal, lane, n)
        put(own.to_light, lane, direction)
        put(own.brought, lane, scale(brought, sources.area[e] / (chance * total)))
        own.source[k - cell] = e
        if max(brought[0], brought[1], brought[2]) > 0.0 and dot(direction, n) > 0.0:
            add_shadow_ray(packet, lane, p, n, direction, distance)
    visible(packet, world, OPAQUE, own.arrives)
    for lane in range(last - first):
        flux = mul(row(own.brought, lane), row(own.arrives, lane))
        if packet.valid[lane] == 0 or max(flux[0], flux[1], flux[2]) <= 0.0:
            continue
        slot = first + lane - cell
        put(own.flux, slot, flux)
        clear_slot(scratch.cell, slot)
        # What is there by chance is so for each photon by itself: as for a pixel of its own.
        scratch.cell.x[slot], scratch.cell.y[slot], scratch.cell.sample[slot] = first + lane, 0, 0
        stack, direction = scratch.stack, row(own.to_light, lane)
        copy_ray(stack, count, in_air, 0)
        put(stack.origin, count, off_surface(row(own.point, lane), row(own.normal, lane), direction))
        put(stack.direction, count, scale(direction, -1.0))
        stack.pixel[count] = slot
        count += 1
    return count


@inlined
def _follow(
    world: World, sources: Sources, rules: Rules, scratch: TreeScratch, own: PhotonScratch, count: int, first: int,
    landings: Landings, landed: int,
) -> int:  # fmt: skip
    """Follow the `count` photons on the stack, and what becomes of them. Returns the number of landings."""
    stack, now, met, meeting = scratch.stack, scratch.now, scratch.met, scratch.meeting
    while count > 0:
        taken = min(LANES, count)
        count -= taken
        for lane in range(taken):
            copy_ray(now, lane, stack, count + lane)
        trace(scratch, world, rules, taken)
        for lane in range(taken):
            hit = kept_hit(met, lane)
            if hit.part == NOTHING:
                if now.inner[lane] != 0:
                    absorb(now, lane, now.end[lane])
                    count = send_out(stack, count, now, lane)
                continue
            at = interaction(world.geometry, hit, Ray(row(now.origin, lane), row(now.direction, lane)), 0.0)
            if world.materials.model[hit.material] == Model.NONE.value:
                absorb(now, lane, hit.t)
                if landed < landings.part.shape[0]:
                    _land(landings, landed, world, sources, own, now, lane, at)
                landed += 1
                continue
            meet(meeting, lane, now, at, world)
            if meeting.kind[lane] == PASSED:
                count = send_past(stack, count, now, lane, hit.t)
                continue
            alpha = meeting.roughness[lane] ** 2
            if alpha > MIRROR_ALPHA:  # one of the microfacets of a rough interface, for what goes both ways
                u1, u2 = unit_pair(Key(first + now.pixel[lane], 1, now.branch[lane], 0), Purpose.ROUGH_LEAF.value)
                n, back = row(meeting.n, lane), scale(row(now.direction, lane), -1.0)
                put(meeting.n, lane, sample_half_vector(n, back, alpha, u1, u2))
            split(meeting, lane, now, rules)
            count = send_mirrored(stack, count, now, lane, meeting)
            count = send_through(stack, count, now, lane, meeting, rules)
    return landed


@inlined
def _land(
    landings: Landings, k: int, world: World, sources: Sources, own: PhotonScratch, now: Rays, lane: int,
    at: Interaction,
) -> None:  # fmt: skip
    slot = now.pixel[lane]
    e = own.source[slot]
    put(landings.point, k, at.point)
    put(landings.normal, k, flip_towards(at.ng, scale(row(now.direction, lane), -1.0)))
    put(landings.flux, k, mul(row(own.flux, slot), row(now.weight, lane)))
    landings.part[k] = sources.part[e]
    landings.kind[k] = 1 if sources.light[e] == world.lights.kind.shape[0] else 0

