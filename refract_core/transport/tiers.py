"""The hierarchy: each tier gives colour and weight, in the order asked for, until the weight is spent.

Roughness is one cone for all of them (`blur`, the tangent of its half angle); Fresnel and absorption are applied by
the caller, once. So a room of one colour comes out as that colour whichever tier answers.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.arrays import I32_1D
from ..kernels.compile import flag, inlined
from ..kernels.lanes import LANES, Column, Flags, Scalars, Vectors, Words, put
from ..kernels.sampling import Keys, Purpose, key_of, set_key, unit_pair
from ..kernels.vec import Vec, add, flip_towards, frame, mul, normalize, row, scale
from ..optics.interface import screen_lod_hdrp
from ..optics.lobes import Cone
from ..probes.lookup import ProbeTable, influence, probe_light, proxy_distance
from ..probes.reach import next_of, piece_of
from ..probes.volumes import update_headroom
from ..view.camera import PixelPoint
from ..view.pyramid import Screen
from ..view.screen import light_seen, screen_blurred, screen_march, screen_proxy
from ..world.embree import OPAQUE, SCATTERED, Packet, clear, set_ray
from ..world.environment import background, prefiltered
from ..world.shading import Block, gloss, load_hits, load_surface, nth, shade
from ..world.surface import NOTHING, HitLanes, Ray, interaction, kept_hit
from ..world.tables import World
from ..world.tracing import intersect_world

SCREEN, RAY, PROBE, SKY = 0, 1, 2, 3
"""Codes of `settings.TIERS`, in its order."""
MARCH, PROXY, TRACED = 0, 1, 2
"""How the screen is asked, in the order of `settings.SCREEN_METHODS`."""
NONE = 4
"""Column of the weights for what no tier answered."""
EMBEDDED_ONLY, ALL_RAYS = flag(True), flag(False)
_SPENT = 1.0 - 1e-6


Shares = Annotated[NDArray[np.float64], Column(np.float64, (5,))]
"""shape (8, 5) float64: what each tier answered, and what none did"""


class Query(NamedTuple):
    """Eight rays that want a colour, and what they got."""

    on: Flags
    key: Keys
    """of the pixel that asks"""
    z_self: Scalars
    """its own z_depth [m]"""
    origin: Vectors
    """[m]"""
    direction: Vectors
    normal: Vectors
    """of the entry, on the viewer's side (probes' influence)"""
    blur: Scalars
    """tangent of the half angle of the ray's cone"""
    roughness: Scalars
    """perceptual, for HDRP's own mappings"""
    thing: Words
    embedded: Flags
    """1: the ray is inside a medium, and meets an opaque object there; or it is a view ray"""
    direct: Flags
    """1: it is a view ray that has met no glass"""
    through: Flags
    """1: what it sees past everything is what a picture's background is, not the dome as lamps and mirrors know it"""
    strong: Flags
    """1: much of its pixel's light comes this way, so that a ray of its own is worth its price"""
    rays: Words
    """that it sends to each light and to the sky, or into its cone"""
    lobes: Words
    """that a rough mirror sends, if it meets one"""
    by_proxy: Flags
    """1: it asks the screen by HDRP's proxy, and maps roughness as HDRP does"""
    width: Scalars
    """of the ray's cone where it meets that [m]"""
    met: HitLanes
    """the opaque surface that it meets; `NOTHING` where it meets none"""
    color: Vectors
    weight: Shares
    """screen, ray, probe, sky, none; sums to 1"""
    confidence: Scalars

    # The surface, where it is known; `corners` looks at its texture anew.
    surface_share: Scalars
    """weight with which it has answered by what follows, 0 .. 1"""
    emissive: Vectors
    """radiance"""
    albedo: Vectors
    irradiance: Vectors

    # Sums over the rays of a cone.
    gathered: Vectors
    """radiance"""
    scattered: Scalars
    """share of them that met anything"""


class Asking(NamedTuple):
    """Who is asked, and in which order: the same for every ray of a picture."""

    order: I32_1D
    """tier codes, first asked first"""
    method: int
    """of asking the screen: MARCH, PROXY (reflections march then, as HDRP's own do) or TRACED"""
    traces: bool
    """the ray tier is asked too"""
    quiet: bool
    """the light on the screen is without noise, so that no ray of a leaf would know it better"""
    screen: Screen
    probes: ProbeTable
    thing_probe: I32_1D
    """shape (things,): the probe whose proxy serves each thing, or -1"""


class TierScratch(NamedTuple):
    """What the ray tier draws with: it is overwritten."""

    packet: Packet
    second: Block
    """what the rays meet"""
    third: Block
    """what its mirrors show"""
    far: Scalars
    """T_FAR of the rays"""
    sent: Flags
    """1 where a ray of its own was sent, 2 where the hit is known, 0 where nothing is asked"""


@inlined
def _add(query: Query, lane: int, tier: int, color: Vec, weight: float, confidence: float) -> None:
    """Give a ray a share of its light, and take the share from what is left."""
    for c in range(3):
        query.color[lane, c] += color[c] * weight
    query.weight[lane, tier] += weight
    query.weight[lane, NONE] -= weight
    query.confidence[lane] += weight * confidence


@inlined
def _add_covered(
    query: Query, lane: int, tier: int, color: Vec, coverage: float, weight: float, confidence: float
) -> None:
    """The same for a picture that is open in places: its colour carries the coverage, and only the covered share of the
    weight is used up. What is left goes to the next tier, or is told as nobody's."""
    for c in range(3):
        query.color[lane, c] += color[c] * weight
    answered = weight * coverage
    query.weight[lane, tier] += answered
    query.weight[lane, NONE] -= answered
    query.confidence[lane] += answered * confidence


@inlined
def _headroom(query: Query, lane: int) -> float:
    """Weight that no tier has answered yet."""
    return query.weight[lane, NONE]


@inlined
def ask(query: Query, asking: Asking, work: TierScratch, world: World) -> None:
    """Fill colour, weight and confidence of every lane that is on."""
    inside = False
    for lane in range(LANES):
        for c in range(3):
            query.color[lane, c] = 0.0
        for k in range(5):
            query.weight[lane, k] = 0.0
        query.weight[lane, NONE] = 1.0
        query.confidence[lane] = query.surface_share[lane] = 0.0
        inside = inside or (query.on[lane] != 0 and query.embedded[lane] != 0)
    for lane in range(LANES):
        if asking.quiet and query.on[lane] != 0 and query.direct[lane] != 0:
            _ask_screen_traced(query, lane, asking, work, world)  # it is the eye's own picture
    if inside:  # what lies inside the glass is near, and known to be met: nobody can guess it better than a ray
        _ask_rays(query, EMBEDDED_ONLY, work, world)
    order = asking.order
    for i in range(order.shape[0]):
        tier = order[i]
        if tier == RAY:
            _ask_rays(query, ALL_RAYS, work, world)
            continue
        sky_follows = ray_follows = False
        for j in range(i + 1, order.shape[0]):
            sky_follows = sky_follows or order[j] == SKY
            ray_follows = ray_follows or order[j] == RAY
        for lane in range(LANES):
            if query.on[lane] == 0 or _headroom(query, lane) <= 1.0 - _SPENT:
                continue
            if tier == SCREEN:
                _ask_screen(query, lane, asking, work, world)
            elif tier == PROBE:
                _ask_probes(query, lane, asking, world, sky_follows, False)
                if not ray_follows and asking.probes.depths.inverse.shape[0] > 0:
                    _ask_probes(query, lane, asking, world, sky_follows, True)
            elif tier == SKY and world.environment.present:
                lobe = query.roughness[lane]
                if query.by_proxy[lane] == 0:
                    lobe = math.sqrt(min(1.0, 0.5 * query.blur[lane]))
                if world.environment.hidden and query.through[lane] != 0:
                    light, covered = background(world.environment, row(query.direction, lane))
                    _add_covered(query, lane, SKY, light, covered, _headroom(query, lane), 1.0)
                    continue
                light = prefiltered(world.environment, row(query.direction, lane), lobe)
                _add(query, lane, SKY, light, _headroom(query, lane), 1.0)


@inlined
def _ask_screen(query: Query, lane: int, asking: Asking, work: TierScratch, world: World) -> None:
    screen = asking.screen
    ray = Cone(row(query.origin, lane), row(query.direction, lane), query.blur[lane], query.roughness[lane])
    if query.by_proxy[lane] != 0:
        k = asking.thing_probe[query.thing[lane]]
        if k < 0:
            return
        distance = proxy_distance(asking.probes, k, ray.origin, ray.direction)
        lod = screen_lod_hdrp(query.roughness[lane], screen.color_level.shape[0])
        shaded = PixelPoint(query.key.x[lane] + 0.5, query.key.y[lane] + 0.5, query.z_self[lane])
        color, w, confidence = screen_proxy(screen, ray, distance, shaded, lod)
    elif asking.method == TRACED:
        _ask_screen_traced(query, lane, asking, work, world)
        return
    else:
        color, w, confidence = screen_march(screen, ray)
    _, w = update_headroom(1.0 - _headroom(query, lane), w)
    _add_covered(query, lane, SCREEN, (color[0], color[1], color[2]), color[3], w, confidence)


@inlined
def _ask_screen_traced(query: Query, lane: int, asking: Asking, work: TierScratch, world: World) -> None:
    """Light the surface that the ray is known to meet as the picture shows it to be lit.

    The picture knows that light to a pixel, and highlights as they are for the eye. Where rays are traced, a strong and
    sharp leaf, and a surface that mirrors, are left to them.
    """
    hit = kept_hit(query.met, lane)
    if hit.part == NOTHING:
        return
    sharp = query.blur[lane] <= 0.0
    strong = query.strong[lane] != 0
    if asking.traces and sharp:
        by_ray = (strong and not asking.quiet) or world.materials.gleams[hit.material] != 0 or not world.lit
    else:
        by_ray = strong and asking.quiet
    if asking.traces and by_ray:
        return
    screen, surface = asking.screen, work.second
    d = row(query.direction, lane)
    at = interaction(world.geometry, hit, Ray(row(query.origin, lane), d), query.width[lane])
    seen = light_seen(screen, at.point, flip_towards(at.ng, scale(d, -1.0)), asking.quiet and sharp)
    if not seen.known:
        return
    if not sharp:
        r, g, b, coverage = screen_blurred(screen, seen, query.blur[lane], hit.t)
        _add_covered(query, lane, SCREEN, (r, g, b), coverage, _headroom(query, lane), 1.0)
        return
    load_surface(surface, lane, at, world, scale(d, -1.0))
    _note_surface(query, lane, surface, seen.irradiance)
    lit = scale(mul(row(surface.albedo, lane), seen.irradiance), 1.0 / math.pi)
    gleam = seen.gloss
    if asking.quiet:  # how much light arrives is the place's; what it mirrors is the ray's
        gleam = gloss(surface, lane, world, seen.lamps, seen.sky)
    _add(query, lane, SCREEN, add(add(row(surface.emissive, lane), lit), gleam), _headroom(query, lane), 1.0)


@inlined
def _note_surface(query: Query, lane: int, surface: Block, irradiance: Vec) -> None:
    """Say what the surface is like that answers for all that is left."""
    query.surface_share[lane] = _headroom(query, lane)
    put(query.emissive, lane, row(surface.emissive, lane))
    put(query.albedo, lane, row(surface.albedo, lane))
    put(query.irradiance, lane, irradiance)


@inlined
def _ask_probes(query: Query, lane: int, asking: Asking, world: World, sky_follows: bool, guesses: bool) -> None:
    """Every probe that reaches the ray's origin, in order: those that know what the ray meets, or those that do not."""
    probes = asking.probes
    p = row(query.origin, lane)
    cuts, sets = probes.reach.cuts, probes.reach.sets
    i, j, l = piece_of(cuts, 0, p[0]), piece_of(cuts, 1, p[1]), piece_of(cuts, 2, p[2])  # noqa: E741
    k = next_of(sets, i, j, l, 0)
    while k >= 0 and _headroom(query, lane) > 1.0 - _SPENT:
        _ask_probe(query, lane, k, probes, world, sky_follows, guesses)
        k = next_of(sets, i, j, l, k + 1)


@inlined
def _ask_probe(
    query: Query, lane: int, k: int, probes: ProbeTable, world: World, sky_follows: bool, guesses: bool
) -> None:
    origin, direction, n = row(query.origin, lane), row(query.direction, lane), row(query.normal, lane)
    w = influence(probes, k, origin, n, direction)
    if w <= 0.0:
        return
    ray = Cone(origin, direction, query.blur[lane], query.roughness[lane])
    light, coverage, fits, confidence = probe_light(
        probes, k, ray, query.by_proxy[lane] != 0, world.environment, sky_follows and world.environment.present, guesses
    )
    _, w = update_headroom(1.0 - _headroom(query, lane), w * fits)
    _add_covered(query, lane, PROBE, light, coverage, w, confidence)


@inlined
def _ask_rays(
    query: Query, embedded: bool, work: TierScratch, world: World
) -> None:
    """Light of what every lane with weight left meets; `embedded` lanes only, or all. A cone sends rays of its own, as
    many as a strong leaf sends to a light."""
    packet, second = work.packet, work.second
    some = False
    most = 0
    for lane in range(LANES):
        work.sent[lane] = 0
        if query.on[lane] == 0 or _headroom(query, lane) <= 1.0 - _SPENT:
            continue
        if embedded and query.embedded[lane] == 0:
            continue
        if query.blur[lane] > 0.0:
            most = max(most, query.rays[lane])
            work.sent[lane] = 1
        elif query.met.part[lane] != NOTHING:
            some = True
            work.sent[lane] = 2
    if some:
        _shade_met(query, work, world)
    if most == 0:
        return
    for lane in range(LANES):
        query.scattered[lane] = 0.0
        put(query.gathered, lane, (0.0, 0.0, 0.0))
    for k in range(most):
        clear(packet)
        for lane in range(LANES):
            second.on[lane] = 0
            if work.sent[lane] == 1 and k < query.rays[lane]:
                key = nth(key_of(query.key, lane), k, query.rays[lane])
                set_key(second.key, lane, key)
                u1, u2 = unit_pair(key, Purpose.ROUGH_LEAF.value)
                d = _scatter(row(query.direction, lane), query.blur[lane], u1, u2)
                work.far[lane] = math.inf
                set_ray(packet, lane, row(query.origin, lane), d, 0.0, math.inf, OPAQUE)
        intersect_world(packet, world, work.far, SCATTERED)
        load_hits(second, packet, world, 0.0)
        shade(second, work.third, packet, world, OPAQUE)
        for lane in range(LANES):
            if work.sent[lane] == 1 and second.on[lane] != 0:
                share = 1.0 / query.rays[lane]
                query.scattered[lane] += share
                put(query.gathered, lane, add(row(query.gathered, lane), scale(row(second.color, lane), share)))
    for lane in range(LANES):
        if work.sent[lane] == 1 and query.scattered[lane] > 0.0:  # what met nothing is left to the next tier
            _add_covered(
                query, lane, RAY, row(query.gathered, lane), query.scattered[lane], _headroom(query, lane), 1.0
            )


@inlined
def _shade_met(query: Query, work: TierScratch, world: World) -> None:
    """Light of the lanes whose hit is known."""
    second = work.second
    for lane in range(LANES):
        second.on[lane] = 0
        if work.sent[lane] == 2:
            set_key(second.key, lane, key_of(query.key, lane))
            d = row(query.direction, lane)
            ray = Ray(row(query.origin, lane), d)
            at = interaction(world.geometry, kept_hit(query.met, lane), ray, query.width[lane])
            second.on[lane] = 1
            load_surface(second, lane, at, world, scale(d, -1.0))
            second.rays[lane] = query.rays[lane]
            second.lobes[lane] = query.lobes[lane]
    shade(second, work.third, work.packet, world, OPAQUE)
    for lane in range(LANES):
        if second.on[lane] != 0:
            _note_surface(query, lane, second, row(second.diffuse, lane))
            _add(query, lane, RAY, row(second.color, lane), _headroom(query, lane), 1.0)


@inlined
def _scatter(d: Vec, blur: float, u1: float, u2: float) -> Vec:
    """A direction of the rough lobe around `d`: GGX slopes of width `blur`, cut at 85 degrees."""
    x, y = frame(d)
    slope = min(11.0, blur * math.sqrt(u1 / max(1e-6, 1.0 - u1)))
    phi = 2.0 * math.pi * u2
    return normalize(add(d, add(scale(x, slope * math.cos(phi)), scale(y, slope * math.sin(phi)))))


