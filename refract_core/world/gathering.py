"""What a place gets from the surfaces around it: rays to all sides, each of which brings back what it meets, lit."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..kernels.arrays import F64_1D, F64_2D
from ..kernels.compile import inlined, kernel
from ..kernels.lanes import LANES, Scalars, new_lanes
from ..kernels.sampling import Key, chance_of_bits, set_key
from ..kernels.vec import Vec, add, along, dot, frame, row, scale
from .bounced import Places
from .embree import OPAQUE, SCATTERED, Packet, clear, set_ray
from .environment import TEXEL_LUMINANCE
from .offsets import off_surface
from .shading import Block, gather, load_hits
from .tables import World
from .tracing import intersect_world

RINGS = 12
"""Of rays around a normal; each has as many as `SECTORS`."""
SECTORS = 36
_BRANCH = 1 << 17
"""Branch of the sequences of what these rays meet."""
_FAR = 1e30
_LEAST_TRUST = 1e-4
"""So that a place that speaks for much more than it knows still counts where there is no other."""


class GatherScratch(NamedTuple):
    """What one thread needs to look around."""

    packet: Packet
    block: Block
    far: Scalars
    """T_FAR that each lane started with"""
    light: F64_2D
    """shape (RINGS * SECTORS, 3): radiance by ray, ring after ring"""
    away: F64_1D
    """shape (RINGS * SECTORS,): how far each went [m]"""
    slope: F64_1D
    """shape (RINGS * SECTORS,): tangent of its angle to the normal"""

    @staticmethod
    def fresh() -> GatherScratch:
        """All of it at zero."""
        count = RINGS * SECTORS
        first = new_lanes(Packet), new_lanes(Block), np.zeros(LANES)
        return GatherScratch(*first, np.zeros((count, 3)), np.zeros(count), np.zeros(count))


@kernel
def gather_places(
    world: World, scratch: GatherScratch, places: Places, first: int, last: int, nearest: F64_1D, farthest: F64_1D,
    share: float,
) -> int:  # fmt: skip
    """Find the light of places `first` to before `last`, and how far they reach. Returns rays traced.

    Args:
        nearest, farthest: shape (R,): bounds of that [m].
        share: of the mean distance of what a place sees, that it reaches.
    """
    scratch.packet.tally[0] = 0
    for i in range(first, last):
        _look_around(world, scratch, row(places.point, i), row(places.normal, i), i)
        _sum_up(scratch, places, i)
        lowest = _mean_distance(scratch)
        light = dot(row(places.irradiance, i), TEXEL_LUMINANCE)
        change = 0.0
        for axis in range(3):
            along_axis = 0.0
            for c in range(3):
                along_axis += TEXEL_LUMINANCE[c] * places.shift[i, c, axis]
            change += along_axis * along_axis
        if change > 0.0:  # where light changes faster than distances say (Krivanek et al., EGSR 2005)
            lowest = min(lowest, light / math.sqrt(change))
        places.reach[i] = min(max(share * lowest, nearest[i]), farthest[i])
        places.trust[i] = 1.0
        if places.reach[i] > share * lowest:  # it speaks for more than it knows, so not by its slope
            known = share * lowest / places.reach[i]
            places.trust[i] = max(_LEAST_TRUST, known * known)
            for c in range(3):
                for axis in range(3):
                    places.shift[i, c, axis] *= known
    return int(scratch.packet.tally[0])


@inlined
def _look_around(world: World, scratch: GatherScratch, p: Vec, n: Vec, i: int) -> None:
    """Send the rays of a place: strata of equal shares of the cosine, a ray somewhere in each."""
    packet, block = scratch.packet, scratch.block
    x, y = frame(n)
    for begin in range(0, RINGS * SECTORS, LANES):
        clear(packet)
        for lane in range(LANES):
            block.on[lane] = 0
            k = begin + lane
            if k >= RINGS * SECTORS:
                continue
            ring, sector = k // SECTORS, k % SECTORS
            up = (ring + chance_of_bits(i, k, _BRANCH)) / RINGS  # square of the sine
            phi = 2.0 * math.pi * (sector + chance_of_bits(i, k, _BRANCH + 1)) / SECTORS
            sine, cosine = math.sqrt(up), math.sqrt(max(1e-6, 1.0 - up))
            d = add(add(scale(x, sine * math.cos(phi)), scale(y, sine * math.sin(phi))), scale(n, cosine))
            scratch.slope[k] = sine / cosine
            scratch.far[lane] = math.inf
            set_ray(packet, lane, off_surface(p, n, d), d, 0.0, math.inf, OPAQUE)
            set_key(block.key, lane, Key(i, 0, _BRANCH, k))
        intersect_world(packet, world, scratch.far, SCATTERED)
        # Each ray stands for a cone of the half sphere; what it meets is looked at as finely.
        load_hits(block, packet, world, math.sqrt(2.0 * math.pi / (RINGS * SECTORS)))
        gather(block, packet, world, OPAQUE)
        for lane in range(min(LANES, RINGS * SECTORS - begin)):
            k = begin + lane
            scratch.away[k] = _FAR
            for c in range(3):
                scratch.light[k, c] = 0.0
            if block.on[lane] != 0:
                scratch.away[k] = max(block.distance[lane], 1e-9)
                for c in range(3):
                    light = block.albedo[lane, c] * block.diffuse[lane, c] / math.pi
                    scratch.light[k, c] = light if math.isfinite(light) else 0.0


@inlined
def _mean_distance(scratch: GatherScratch) -> float:
    """The harmonic mean of what the rays met [m]."""
    total = 0.0
    for k in range(RINGS * SECTORS):
        total += 1.0 / scratch.away[k]
    return RINGS * SECTORS / total


@inlined
def _sum_up(scratch: GatherScratch, places: Places, i: int) -> None:
    """Irradiance and its gradients (Ward and Heckbert 1992, section 3)."""
    n = row(places.normal, i)
    x, y = frame(n)
    for c in range(3):
        total = 0.0
        turn, shift = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        for sector in range(SECTORS):
            middle, edge = 2.0 * math.pi * (sector + 0.5) / SECTORS, 2.0 * math.pi * sector / SECTORS
            u = add(scale(x, math.cos(middle)), scale(y, math.sin(middle)))
            v = add(scale(x, -math.sin(middle)), scale(y, math.cos(middle)))
            v_edge = add(scale(x, -math.sin(edge)), scale(y, math.cos(edge)))
            before = (sector + SECTORS - 1) % SECTORS
            tilted = outwards = around = 0.0
            for ring in range(RINGS):
                k, beside = ring * SECTORS + sector, ring * SECTORS + before
                light = scratch.light[k, c]
                total += light
                tilted -= scratch.slope[k] * light
                lower, upper = math.sqrt(ring / RINGS), math.sqrt((ring + 1) / RINGS)
                if ring > 0:
                    inner = k - SECTORS
                    step = lower * (1.0 - ring / RINGS) / min(scratch.away[k], scratch.away[inner])
                    outwards += step * (light - scratch.light[inner, c])
                near = min(scratch.away[k], scratch.away[beside])
                around += (upper - lower) / near * (light - scratch.light[beside, c])
            turn = along(turn, v, tilted)
            shift = along(along(shift, u, 2.0 * math.pi / SECTORS * outwards), v_edge, around)
        scaled = math.pi / (RINGS * SECTORS)
        places.irradiance[i, c] = scaled * total
        for axis in range(3):
            places.turn[i, c, axis] = scaled * turn[axis]
            places.shift[i, c, axis] = shift[axis]


@kernel
def look_from(
    world: World, scratch: GatherScratch, point: F64_2D, normal: F64_2D, first: int, last: int, rays: int,
    met: F64_2D, facing: F64_2D,
) -> None:  # fmt: skip
    """What `rays` from each of places `first` to before `last` meet: `met` and `facing`, shape (N * rays, 3), with
    normals of zero where that is nothing."""
    packet, block = scratch.packet, scratch.block
    for start in range(first * rays, last * rays, LANES):
        clear(packet)
        for lane in range(min(LANES, last * rays - start)):
            k = start + lane
            i = k // rays
            n = row(normal, i)
            if dot(n, n) == 0.0:
                continue
            x, y = frame(n)
            up, phi = (k % rays + chance_of_bits(k, 0, _BRANCH)) / rays, 2.0 * math.pi * chance_of_bits(k, 1, _BRANCH)
            sine, cosine = math.sqrt(up), math.sqrt(max(1e-6, 1.0 - up))
            d = add(add(scale(x, sine * math.cos(phi)), scale(y, sine * math.sin(phi))), scale(n, cosine))
            scratch.far[lane] = math.inf
            set_ray(packet, lane, off_surface(row(point, i), n, d), d, 0.0, math.inf, OPAQUE)
        intersect_world(packet, world, scratch.far, SCATTERED)
        note_hits(block, packet, world, start, min(LANES, last * rays - start), met, facing)


@inlined
def note_hits(
    block: Block, packet: Packet, world: World, start: int, count: int, met: F64_2D, facing: F64_2D
) -> None:
    """Write down where the rays of a packet have ended, and which way that looks."""
    load_hits(block, packet, world, 0.0)
    for lane in range(count):
        for c in range(3):
            met[start + lane, c] = facing[start + lane, c] = 0.0
        if block.on[lane] != 0 and block.spreads[lane] != 0 and packet.valid[lane] != 0:
            n = row(block.ng, lane)
            for c in range(3):
                met[start + lane, c] = block.point[lane, c]
                facing[start + lane, c] = n[c]
