"""Light leaving opaque surfaces, eight hits at a time.

A `Block` holds what a 4x2 block of pixels (or eight rays of any kind) hit. `shade` gives its radiance: emission,
lights with shadows, the environment, and one mirror bounce where a surface is smooth enough to show it.
Every room that needs the colour of an opaque hit calls it: the picture, probes, the ray tier and the reference.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..kernels.compile import inlined
from ..kernels.lanes import LANES, Flags, Scalars, Vectors, Words, put
from ..kernels.sampling import MIRRORED, Key, Keys, Purpose, branched, hash32, key_of, set_key, unit_pair
from ..kernels.vec import Vec, add, along, dot, flip_towards, lerp, mul, normalize, row, scale, sub
from ..optics.interface import f0_from_ior
from ..optics.lobes import MIRROR_ALPHA, sample_cosine, sample_half_vector, specular_albedo
from ..scene import Param
from .bounced import bounced_light
from .caustics import caustic_irradiance
from .embree import SCATTERED, Packet, clear, has_hit, ray_direction, set_ray
from .environment import TEXEL_LUMINANCE, EnvironmentTable, direction_pdf, irradiance, prefiltered, sample_direction
from .lights import LightTable, any_glows, highlight, irradiance_factor, picked_shadow_ray, rim_ray, shadow_ray
from .offsets import off_surface
from .shaping import shape_matt, shape_mirrored
from .surface import Interaction, color_input, float_input, hit_in, interaction, normal_input, share_input, thing_of
from .tables import World
from .tracing import add_shadow_ray, intersect_world, lamp_visible, ray_of, visible

_REFLECTED_ROUGHNESS = 0.5
_POLISHED_ROUGHNESS = 0.2
"""Mirrors up to the first roughness, and dielectrics up to the second, reflect the scene by a ray of their own; others
take their reflection from the environment map alone."""
_COAT_F0 = 0.04  # a clear coat of ior 1.5 (UsdPreviewSurface)
_MOST_DRAWS = 32
"""Directions to the sky that are tried before one by the cosine alone is taken."""
_LOW = 0.02
"""Sine of a ray's height over a surface below which what it brings is too little to be asked for."""
LOBES = 4
"""Rays to a light for each ray of a rough mirror: what it sees is lit by one more."""


class Block(NamedTuple):
    """Eight opaque hits and the light they send back. A lane holds what its last `load_surface` found."""

    on: Flags
    """1 where the lane holds a hit"""
    key: Keys
    """of the sampling sequence. Set by whoever asks, before anything is loaded"""

    # The surfaces, from `load_surface` until the lane is loaded again.
    point: Vectors
    """[m]"""
    ng: Vectors
    """unit geometric normal, on the viewer's side"""
    ns: Vectors
    """unit shading normal, on the side of ng"""
    wo: Vectors
    """unit, towards the viewer"""
    albedo: Vectors
    """diffuse reflectance, 0 .. 1"""
    f0: Vectors
    """reflectance at normal incidence"""
    fresnel: Vectors
    """and towards wo"""
    emissive: Vectors
    """radiance"""
    roughness: Scalars
    """perceptual, 0 .. 1"""
    coat: Scalars
    """share of the clear coat, 0 .. 1"""
    coat_roughness: Scalars
    """perceptual, 0 .. 1"""
    occlusion: Scalars
    """share of the sky that the material lets in, 0 .. 1"""
    matte: Flags
    """1 where diffuse light is asked for; 0 leaves `diffuse` at nothing, and saves its shadow rays"""
    spreads: Flags
    """1 where the material sends any of it back"""
    rays: Words
    """that go to each light and to the sky; 1, unless somebody wants more"""
    lobes: Words
    """rays that a rough mirror sends; likewise"""
    distance: Scalars
    """hit distance [m]; inf where nothing was hit"""
    thing: Words
    """number of the prim, as `Geometry.thing`"""

    # The light, from `gather` or `shade` until the next of them.
    diffuse: Vectors
    """irradiance that arrived"""
    specular: Vectors
    """radiance towards wo of the lights' highlights"""
    sky_seen: Vectors
    """share of the sky's light that arrives, colour by colour, >= 0; above 1 where one ray that saw a coloured place
    stands for all"""
    sky_asked: Vectors
    """sum of the weights of the rays to the sky"""
    sky_weight: Vectors
    """and that of the last"""
    color: Vectors
    """the result: radiance towards wo"""

    # Within `gather`, for one light.
    lamp_diffuse: Scalars
    """irradiance per radiance of the light, if nothing is in the way [sr]"""
    lamp_specular: Scalars
    """highlight per radiance of the light, without Fresnel, if nothing is in the way"""
    lamp_tint: Vectors
    """share of its radiance that shaping leaves for the first; where it is not even"""
    lamp_gleam: Vectors
    """and for the second"""
    lamp_counts: Flags
    """1 where it would bring anything"""
    lamp_asked: Flags
    """1 where it casts shadows, too"""
    lamp_seen: Vectors
    """share of its light that arrives, colour by colour, 0 .. 1"""
    lamp_weight: Scalars
    """for how much the last ray to it counts, and the sum of all of them"""
    lamp_weights: Scalars
    free: Vectors
    """the same of one point of it, or of the sky"""

    # Within `shade`, for the mirror bounce.
    bounced: Words
    """mirror rays that are sent"""
    mirrored: Vectors
    """mean radiance that they bring"""
    bounce: Vectors
    """its unit direction, needed after the packet has been used again"""
    bounce_end: Scalars
    """T_FAR of the mirror rays [m]"""


@inlined
def load_hits(block: Block, packet: Packet, world: World, spread: float) -> None:
    """Look at every hit of a traced packet and note its surface in the block.

    Args:
        spread: growth of the rays' cones per metre.
    """
    for lane in range(LANES):
        block.on[lane] = 0
        block.distance[lane] = math.inf
        if not has_hit(packet, lane):
            continue
        ray = ray_of(packet, lane)
        hit = hit_in(packet, lane, world.geometry)
        at = interaction(world.geometry, hit, ray, spread * hit.t)
        block.on[lane] = 1
        block.distance[lane] = at.hit.t
        load_surface(block, lane, at, world, scale(ray.direction, -1.0))


@inlined
def load_surface(block: Block, lane: int, at: Interaction, world: World, wo: Vec) -> None:
    """Evaluate a UsdPreviewSurface at a hit (UsdPreviewSurface specification 2.5, shading model)."""
    ng = flip_towards(at.ng, wo)
    ns = flip_towards(normal_input(world, at), ng)
    base = color_input(world, at, Param.DIFFUSE.value)
    metallic = 0.0
    if world.materials.specular_workflow[at.hit.material]:
        f0 = color_input(world, at, Param.SPECULAR.value)
    else:
        metallic = share_input(world, at, Param.METALLIC.value)
        dielectric = f0_from_ior(float_input(world, at, Param.IOR.value))
        f0 = lerp((dielectric, dielectric, dielectric), base, metallic)
    roughness = share_input(world, at, Param.ROUGHNESS.value)
    diffuse = mul(scale(base, 1.0 - metallic), _entering(f0, roughness, abs(dot(ns, wo))))
    block.thing[lane] = thing_of(world.geometry, at.hit)
    put(block.point, lane, at.point)
    put(block.ng, lane, ng)
    put(block.ns, lane, ns)
    put(block.wo, lane, wo)
    put(block.albedo, lane, diffuse)
    put(block.f0, lane, f0)
    put(block.fresnel, lane, _fresnel(f0, roughness, max(0.0, dot(ns, wo))))
    put(block.emissive, lane, color_input(world, at, Param.EMISSIVE.value))
    block.roughness[lane] = roughness
    block.coat[lane] = share_input(world, at, Param.CLEARCOAT.value)
    block.coat_roughness[lane] = share_input(world, at, Param.CLEARCOAT_ROUGHNESS.value)
    block.occlusion[lane] = share_input(world, at, Param.OCCLUSION.value)
    block.matte[lane] = block.rays[lane] = block.lobes[lane] = 1
    block.spreads[lane] = world.materials.spreads[at.hit.material]


@inlined
def _entering(f0: Vec, roughness: float, cosine: float) -> Vec:
    """What the surface mirrors does not enter it: the diffuse part gets what the specular lobe leaves over."""
    sent_back = specular_albedo(f0, roughness, cosine)
    return (1.0 - min(1.0, sent_back[0]), 1.0 - min(1.0, sent_back[1]), 1.0 - min(1.0, sent_back[2]))


@inlined
def is_painted_alone(world: World, m: int) -> bool:
    """Textures and primvars drive no more of a material than its colours, which then say nothing of what it mirrors."""
    materials = world.materials
    colours = (1 << Param.DIFFUSE.value) | (1 << Param.EMISSIVE.value)
    apart = materials.specular_workflow[m] != 0 or materials.value[m, Param.METALLIC.value, 0] == 0.0
    return apart and materials.driven[m] & ~colours == 0


@inlined
def entering(block: Block, lane: int) -> Vec:
    """The share of light that the surface in a lane does not mirror."""
    cosine = abs(dot(row(block.ns, lane), row(block.wo, lane)))
    return _entering(row(block.f0, lane), block.roughness[lane], cosine)


@inlined
def paint(at: Interaction, world: World, share: Vec) -> tuple[Vec, Vec]:
    """Emission and albedo of a material that `is_painted_alone`, so is no metal, and lets that share of light in."""
    return color_input(world, at, Param.EMISSIVE.value), mul(color_input(world, at, Param.DIFFUSE.value), share)


@inlined
def copy_lane(to: Block, i: int, block: Block, lane: int) -> None:
    """A surface, and the light that has been gathered for it, into another block."""
    to.on[i], to.matte[i], to.thing[i] = block.on[lane], block.matte[lane], block.thing[lane]
    to.spreads[i] = block.spreads[lane]
    put(to.point, i, row(block.point, lane))
    put(to.ng, i, row(block.ng, lane))
    put(to.ns, i, row(block.ns, lane))
    put(to.wo, i, row(block.wo, lane))
    put(to.albedo, i, row(block.albedo, lane))
    put(to.f0, i, row(block.f0, lane))
    put(to.fresnel, i, row(block.fresnel, lane))
    put(to.emissive, i, row(block.emissive, lane))
    to.roughness[i], to.coat[i] = block.roughness[lane], block.coat[lane]
    to.coat_roughness[i], to.occlusion[i] = block.coat_roughness[lane], block.occlusion[lane]
    to.distance[i] = block.distance[lane]
    put(to.sky_seen, i, row(block.sky_seen, lane))
    put(to.diffuse, i, row(block.diffuse, lane))
    put(to.specular, i, row(block.specular, lane))


@inlined
def _fresnel(f0: Vec, roughness: float, cosine: float) -> Vec:
    """Schlick with its grazing value lowered for rough surfaces (Lagarde 2011) and for those that hardly reflect."""
    x = (1.0 - min(1.0, cosine)) ** 5
    top = (1.0 - roughness) * min(1.0, 50.0 * max(f0[0], f0[1], f0[2]))
    return (
        f0[0] + (max(top, f0[0]) - f0[0]) * x,
        f0[1] + (max(top, f0[1]) - f0[1]) * x,
        f0[2] + (max(top, f0[2]) - f0[2]) * x,
    )


@inlined
def forget_light(block: Block, lane: int) -> None:
    """Nothing has arrived yet."""
    for c in range(3):
        block.diffuse[lane, c] = block.specular[lane, c] = 0.0
        block.sky_seen[lane, c] = 1.0


@inlined
def _gather_lights(block: Block, packet: Packet, world: World, mask: int) -> None:
    """Add every light's irradiance to `diffuse` and its highlights to `specular`, with shadows."""
    lights = world.lights
    for l in range(lights.kind.shape[0]):  # noqa: E741
        for lane in range(LANES):
            block.lamp_asked[lane] = block.lamp_counts[lane] = 0
            if block.on[lane] == 0 or not aim_light(block, lane, lights, l):
                continue
            block.lamp_counts[lane] = 1
            put(block.lamp_seen, lane, (1.0, 1.0, 1.0))
            if lights.casts_shadow[l] != 0:
                block.lamp_asked[lane] = 1
                block.lamp_weights[lane] = 0.0
                put(block.lamp_seen, lane, (0.0, 0.0, 0.0))
        most = 0
        for lane in range(LANES):
            if block.lamp_asked[lane] != 0:
                most = max(most, block.rays[lane])
        for k in range(most):
            clear(packet)
            for lane in range(LANES):
                if block.lamp_asked[lane] != 0 and k < block.rays[lane]:
                    key = nth(key_of(block.key, lane), k, block.rays[lane])
                    alone = block.rays[lane] == 1
                    block.lamp_weight[lane] = add_light_ray(block, lane, lights, l, packet, lane, key, alone)
            lamp_visible(packet, world, mask, l, block.free)
            for lane in range(LANES):
                if block.lamp_asked[lane] != 0 and k < block.rays[lane]:
                    weight = block.lamp_weight[lane]
                    block.lamp_weights[lane] += weight
                    put(block.lamp_seen, lane, along(row(block.lamp_seen, lane), row(block.free, lane), weight))
        for lane in range(LANES):
            if block.lamp_asked[lane] != 0:
                put(block.lamp_seen, lane, share_of_lamp(row(block.lamp_seen, lane), block.lamp_weights[lane]))
            if block.lamp_counts[lane] != 0:
                add_light(block, lane, lights, l)


@inlined
def share_of_lamp(seen: Vec, weights: float) -> Vec:
    """The share of a light that arrives: what rays have seen of it, each by its weight; all where none counts."""
    return scale(seen, 1.0 / weights) if weights > 0.0 else (1.0, 1.0, 1.0)


@inlined
def nth(key: Key, k: int, times: int) -> Key:
    """The key of ray `k` of the `times` that are sent where others send one."""
    return Key(key.x, key.y, key.branch, key.sample * times + k)


@inlined
def aim_light(block: Block, lane: int, lights: LightTable, l: int) -> bool:  # noqa: E741
    """Note what a light would bring to a hit if nothing were in the way. Whether that is anything."""
    block.lamp_diffuse[lane] = block.lamp_specular[lane] = 0.0
    if not _links(block, lane, lights, l):
        return False
    p, n, wo = row(block.point, lane), row(block.ns, lane), row(block.wo, lane)
    if block.matte[lane] != 0 and block.spreads[lane] != 0:
        block.lamp_diffuse[lane] = irradiance_factor(lights, l, p, n) * lights.diffuse[l]
    gloss = block.roughness[lane]
    if lights.specular[l] > 0.0:
        rays = _sees_what_glows(block, lane)
        block.lamp_specular[lane] = highlight(lights, l, p, n, wo, gloss * gloss, rays) * lights.specular[l]
    if lights.even[l] == 0:
        _shape(block, lane, lights, l)
    # A clear coat has a highlight of its own, where the rest of the surface may have none.
    coated = block.coat[lane] > 0.0 and lights.specular[l] > 0.0
    return block.lamp_diffuse[lane] + block.lamp_specular[lane] > 0.0 or coated


@inlined
def _links(block: Block, lane: int, lights: LightTable, l: int) -> bool:  # noqa: E741
    """The light lights the prim that was hit."""
    link = lights.link[l]
    return link < 0 or lights.linked[link, block.thing[lane]] != 0


@inlined
def _shape(block: Block, lane: int, lights: LightTable, l: int) -> None:  # noqa: E741
    """Note what an uneven light leaves out of its radiance; where that is all, it brings nothing."""
    p, n, wo = row(block.point, lane), row(block.ns, lane), row(block.wo, lane)
    if block.lamp_diffuse[lane] > 0.0:
        tint = shape_matt(lights, l, p, n)
        put(block.lamp_tint, lane, tint)
        if max(tint[0], tint[1], tint[2]) <= 0.0:
            block.lamp_diffuse[lane] = 0.0
    if block.lamp_specular[lane] > 0.0:
        gloss = block.roughness[lane]
        tint = shape_mirrored(lights, l, p, n, wo, gloss * gloss)
        put(block.lamp_gleam, lane, tint)
        if max(tint[0], tint[1], tint[2]) <= 0.0:
            block.lamp_specular[lane] = 0.0


@inlined
def add_light_ray(
    block: Block, i: int, lights: LightTable, l: int, packet: Packet, lane: int, key: Key, alone: bool  # noqa: E741
) -> float:
    """Put a ray from hit `i` to a point of a light into a lane. Returns for how much it counts among others; `alone`:
    there are none."""
    u1, u2 = unit_pair(key, Purpose.LIGHT.value + l)
    p, n = row(block.point, i), row(block.ns, i)
    if alone:
        pick, _ = unit_pair(key, Purpose.LIGHT_PICK.value)
        direction, distance, weight = picked_shadow_ray(lights, l, p, n, u1, u2, pick)
    else:
        direction, distance, weight = shadow_ray(lights, l, p, n, u1, u2)
    if lights.reach[l, 0] < math.inf:
        distance = min(distance, _shadow_length(lights, l, key))
    add_shadow_ray(packet, lane, p, row(block.ng, i), direction, distance)
    return weight


@inlined
def add_rim_ray(
    block: Block, i: int, lights: LightTable, l: int, packet: Packet, lane: int, turn: int  # noqa: E741
) -> None:
    """Put a ray from hit `i` to a point of a light's rim into a lane, unless it would bring nothing."""
    p, n = row(block.point, i), row(block.ns, i)
    direction, distance, _ = rim_ray(lights, l, p, n, lane, turn)
    if dot(direction, n) > _LOW:
        distance = min(distance, lights.reach[l, 0])
        add_shadow_ray(packet, lane, p, row(block.ng, i), direction, distance)


@inlined
def _shadow_length(lights: LightTable, l: int, key: Key) -> float:  # noqa: E741
    """How near what casts a shadow must be to this ray [m]: a length drawn so that as many are longer than a distance
    as there is shadow left at it, ((reach - distance) / falloff) ^ gamma (UsdLux ShadowAPI)."""
    u, _ = unit_pair(key, Purpose.SHADOW_LENGTH.value)
    return lights.reach[l, 0] - lights.reach[l, 1] * u ** lights.reach[l, 2]


@inlined
def add_light(block: Block, lane: int, lights: LightTable, l: int) -> None:  # noqa: E741
    """Add one light, whose share of the hit is known, to its sums."""
    seen, hidden = row(block.lamp_seen, lane), row(lights.hidden, l)
    arrives = add(hidden, mul(sub((1.0, 1.0, 1.0), hidden), seen))
    if max(arrives[0], arrives[1], arrives[2]) <= 0.0 or not _links(block, lane, lights, l):
        return
    matt = gleam = over = mul(row(lights.radiance, l), arrives)
    n, wo, p = row(block.ns, lane), row(block.wo, lane), row(block.point, lane)
    f = row(block.fresnel, lane)
    coat = block.coat[lane]
    coat_light = 0.0
    if coat > 0.0 and lights.specular[l] > 0.0:
        gloss = block.coat_roughness[lane]
        fc = coat * (_COAT_F0 + (1.0 - _COAT_F0) * (1.0 - min(1.0, max(0.0, dot(n, wo)))) ** 5)
        sharp = gloss < _POLISHED_ROUGHNESS
        coat_light = fc * highlight(lights, l, p, n, wo, gloss * gloss, sharp) * lights.specular[l]
        if lights.even[l] == 0 and coat_light > 0.0:
            over = mul(over, shape_mirrored(lights, l, p, n, wo, gloss * gloss))
    if lights.even[l] == 0:
        matt, gleam = mul(matt, row(block.lamp_tint, lane)), mul(gleam, row(block.lamp_gleam, lane))
    for c in range(3):
        block.diffuse[lane, c] += matt[c] * block.lamp_diffuse[lane]
        block.specular[lane, c] += gleam[c] * block.lamp_specular[lane] * f[c] + over[c] * coat_light


@inlined
def _gather_sky(block: Block, packet: Packet, world: World, mask: int) -> None:
    """Add the environment's irradiance to `diffuse`. Its unoccluded value is exact; how much of it arrives is asked
    along directions chosen in proportion to what they would bring (`_sky_direction`). The same answer dims the sky's
    highlight (`_add_gloss_of_sky`)."""
    environment = world.environment
    if not environment.present or environment.dark:
        return
    most = 0
    for lane in range(LANES):
        if block.on[lane] != 0 and block.matte[lane] != 0:
            most = max(most, block.rays[lane])
            for c in range(3):
                block.sky_seen[lane, c] = block.sky_asked[lane, c] = 0.0
    for k in range(most):
        clear(packet)
        for lane in range(LANES):
            if block.on[lane] != 0 and block.matte[lane] != 0 and k < block.rays[lane]:
                key, rays = key_of(block.key, lane), block.rays[lane]
                weight = add_sky_ray(block, lane, environment, packet, lane, key, k, rays)
                put(block.sky_weight, lane, weight)
        visible(packet, world, mask, block.free)
        for lane in range(LANES):
            if block.on[lane] != 0 and block.matte[lane] != 0 and k < block.rays[lane]:
                for c in range(3):
                    block.sky_seen[lane, c] += block.sky_weight[lane, c] * block.free[lane, c]
                    block.sky_asked[lane, c] += block.sky_weight[lane, c]
    for lane in range(LANES):
        if block.on[lane] != 0 and block.matte[lane] != 0:
            share = share_of_sky(row(block.sky_seen, lane), row(block.sky_asked, lane), block.rays[lane])
            put(block.sky_seen, lane, share)
            add_sky(block, lane, environment)


@inlined
def share_of_sky(seen: Vec, asked: Vec, times: int) -> Vec:
    """The share of the sky that arrives, colour by colour: weights of the rays that got through over those of all; the
    weight of one that is alone says it by itself (`add_sky_ray`)."""
    if times == 1:
        return seen
    return (
        seen[0] / asked[0] if asked[0] > 0.0 else 1.0,
        seen[1] / asked[1] if asked[1] > 0.0 else 1.0,
        seen[2] / asked[2] if asked[2] > 0.0 else 1.0,
    )


@inlined
def add_sky_ray(
    block: Block, i: int, environment: EnvironmentTable, packet: Packet, lane: int, key: Key, k: int, times: int
) -> Vec:
    """Put ray `k` of `times` from hit `i` to the sky into a lane. Returns for how much it counts among them, colour by
    colour; of one that is alone, the share of the sky's light that arrives if it gets through."""
    n = row(block.ns, i)
    if environment.even:  # the cosine alone is the density, and keeps the strata of the sequence
        u1, u2 = unit_pair(nth(key, k, times), Purpose.SKY_COSINE.value)
        direction, weight = sample_cosine(n, u1, u2), (1.0, 1.0, 1.0)
    elif times == 1:
        direction, weight = _sky_direction(environment, n, key)
    else:
        direction, weight = _nth_sky_direction(environment, n, key, k, times)
    add_shadow_ray(packet, lane, row(block.point, i), row(block.ng, i), direction, math.inf)
    return weight


@inlined
def _nth_sky_direction(environment: EnvironmentTable, n: Vec, key: Key, k: int, times: int) -> tuple[Vec, Vec]:
    """One of many directions to the sky, and its weight: every other one by the cosine, the rest by the radiance.

    Each half keeps the strata of its sequence; a weight is what comes from there over the density with which both
    halves together draw it (Veach's balance heuristic).
    """
    half = times // 2
    own = nth(key, k // 2, half if k % 2 else times - half)
    if k % 2:
        u1, u2 = unit_pair(own, Purpose.SKY_RADIANCE.value)
        direction, radiance, tint = sample_direction(environment, u1, u2)
    else:
        u1, u2 = unit_pair(own, Purpose.SKY_COSINE.value)
        direction = sample_cosine(n, u1, u2)
        radiance, tint = direction_pdf(environment, direction)
    cosine = dot(direction, n)
    if cosine <= 0.0:
        return n, (0.0, 0.0, 0.0)
    return direction, scale(tint, cosine * radiance / ((times - half) * cosine / math.pi + half * radiance))


@inlined
def add_sky(block: Block, lane: int, environment: EnvironmentTable) -> None:
    """Add the sky, whose share is known but for what the material keeps out."""
    share = scale(row(block.sky_seen, lane), block.occlusion[lane])
    put(block.sky_seen, lane, share)
    if share[0] > 0.0 or share[1] > 0.0 or share[2] > 0.0:
        e = irradiance(environment, row(block.ns, lane))
        put(block.diffuse, lane, add(row(block.diffuse, lane), mul(e, share)))


@inlined
def _sky_direction(environment: EnvironmentTable, n: Vec, key: Key) -> tuple[Vec, Vec]:
    """The only direction to the sky, with the density of what it brings, and what arrives from all the sky's light if
    it gets through.

    Directions by the radiance are refused with the chance that the cosine is small (von Neumann 1951), so that what is
    kept has both in its density, and the mean of what gets through is the share that arrives, however small a sun is.
    (Choosing among a few candidates instead is off by 0.15 where a sun is hidden.) The first sample of a pixel takes
    the share for all colours, so that a picture of one sample has no noise of colour where all of the sky is seen.
    """
    branch = int(np.int64(key.branch))  # whatever width it had
    for k in range(_MOST_DRAWS):
        own = Key(key.x, key.y, branch, key.sample)
        u1, u2 = unit_pair(own, Purpose.SKY_RADIANCE.value)
        direction, _, tint = sample_direction(environment, u1, u2)
        if unit_pair(own, Purpose.SKY_PICK.value)[0] < dot(direction, n):
            return direction, (1.0, 1.0, 1.0) if key.sample == 0 else _beside_all(environment, n, tint)
        branch = int(np.int64(hash32(key.branch, k, 0)))
    u1, u2 = unit_pair(key, Purpose.SKY_COSINE.value)
    return sample_cosine(n, u1, u2), (1.0, 1.0, 1.0)


@inlined
def _beside_all(environment: EnvironmentTable, n: Vec, tint: Vec) -> Vec:
    """The colour of light that comes from one place, over that of all the sky's at a surface, at the same luminance."""
    e = irradiance(environment, n)
    light = dot(e, TEXEL_LUMINANCE)
    return (
        light * tint[0] / e[0] if e[0] > 0.0 else 0.0,
        light * tint[1] / e[1] if e[1] > 0.0 else 0.0,
        light * tint[2] / e[2] if e[2] > 0.0 else 0.0,
    )


@inlined
def gather(block: Block, packet: Packet, world: World, mask: int) -> None:
    """What arrives at every hit: irradiance into `diffuse`, the lights' highlights into `specular`.

    `mask`: what casts shadows. The packet is overwritten.
    """
    for lane in range(LANES):
        forget_light(block, lane)
        if block.on[lane] != 0 and block.matte[lane] != 0:
            add_indirect(block, lane, world)
    _gather_lights(block, packet, world, mask)
    _gather_sky(block, packet, world, mask)


@inlined
def add_indirect(block: Block, lane: int, world: World) -> None:
    """Add the light that comes through glass, or off it, and what opaque surfaces send each other."""
    p, ng = row(block.point, lane), row(block.ng, lane)
    e = caustic_irradiance(world.caustics, p, ng)
    if world.bounced.cell.shape[0] > 0:
        bounced, _ = bounced_light(world.bounced, p, ng, row(block.ns, lane))
        e = along(e, bounced, block.occlusion[lane])
    put(block.diffuse, lane, add(row(block.diffuse, lane), e))


@inlined
def _add_matt(block: Block) -> None:
    """Emission, and the light that has been gathered, of every hit in the block."""
    for lane in range(LANES):
        if block.on[lane] == 0:
            continue
        # A Lambertian surface spreads what arrives evenly: radiance is irradiance times albedo over pi.
        lit = scale(mul(row(block.albedo, lane), row(block.diffuse, lane)), 1.0 / math.pi)
        put(block.color, lane, add(add(row(block.emissive, lane), lit), row(block.specular, lane)))


@inlined
def _add_gloss_of_sky(block: Block, lane: int, world: World, f0: Vec, roughness: float, weight: float) -> None:
    """Add the environment's mirror lobe, dimmed by the visibility found for its diffuse light."""
    seen = row(block.sky_seen, lane)
    if not world.environment.present or (seen[0] == 0.0 and seen[1] == 0.0 and seen[2] == 0.0):
        return
    n, wo = row(block.ns, lane), row(block.wo, lane)
    cosine = min(1.0, max(1e-3, dot(n, wo)))
    r = sub(scale(n, 2.0 * dot(n, wo)), wo)
    light = mul(scale(prefiltered(world.environment, r, roughness), weight), seen)
    put(block.color, lane, add(row(block.color, lane), mul(light, specular_albedo(f0, roughness, cosine))))


@inlined
def gloss(block: Block, lane: int, world: World, lamps: float, sky: Vec) -> Vec:
    """Highlights and what is mirrored of the sky, of a surface that mirrors nothing else, where the shares of lamps and
    sky that arrive are known. The light that has been gathered is lost."""
    lights = world.lights
    forget_light(block, lane)
    block.matte[lane] = 0
    for l in range(lights.kind.shape[0]):  # noqa: E741
        if aim_light(block, lane, lights, l):
            share = lamps if lights.casts_shadow[l] != 0 else 1.0
            put(block.lamp_seen, lane, (share, share, share))
            add_light(block, lane, lights, l)
    put(block.color, lane, row(block.specular, lane))
    put(block.sky_seen, lane, sky)
    _add_gloss_of_sky(block, lane, world, row(block.f0, lane), block.roughness[lane], 1.0)
    _add_coat_of_sky(block, lane, world)
    return row(block.color, lane)


@inlined
def _add_coat_of_sky(block: Block, lane: int, world: World) -> None:
    """Add what a clear coat mirrors of the sky."""
    if block.coat[lane] > 0.0:
        coat = (_COAT_F0, _COAT_F0, _COAT_F0)
        _add_gloss_of_sky(block, lane, world, coat, block.coat_roughness[lane], block.coat[lane])


@inlined
def _reflects_the_scene(f0: Vec, roughness: float) -> bool:
    """The surface is smooth and strong enough for a mirror ray of its own."""
    strength = max(f0[0], f0[1], f0[2])
    limit = _REFLECTED_ROUGHNESS if strength > 0.2 else _POLISHED_ROUGHNESS
    return roughness < limit and strength > 0.02


@inlined
def _sees_what_glows(block: Block, lane: int) -> bool:
    """By its mirror rays, if it sends any: what glows has no highlight on it. Rougher surfaces would meet small things
    that glow with few of their rays, each of them a speck; they have the highlight alone."""
    return block.spreads[lane] == 0 or block.roughness[lane] < _POLISHED_ROUGHNESS


@inlined
def shade(block: Block, second: Block, packet: Packet, world: World, mask: int) -> None:
    """Radiance of every hit in `block` into `block.color`. `second` is another block, for what the mirrors show.

    `mask`: what reflections and shadows may meet. The packet is overwritten.
    """
    gather(block, packet, world, mask)
    look_into_mirrors(block, second, packet, world, mask)
    send_back(block, world)


@inlined
def look_into_mirrors(block: Block, second: Block, packet: Packet, world: World, mask: int) -> None:
    """Send the mirror rays of every hit in the block, into `block.mirrored`. The packet is overwritten."""
    most = 0
    for lane in range(LANES):
        block.bounced[lane] = 0
        block.bounce_end[lane] = math.inf
        put(block.mirrored, lane, (0.0, 0.0, 0.0))
        if block.on[lane] != 0 and _reflects_the_scene(row(block.f0, lane), block.roughness[lane]):
            if block.roughness[lane] ** 2 <= MIRROR_ALPHA:
                block.lobes[lane] = 1
            block.bounced[lane] = block.lobes[lane]
            most = max(most, block.lobes[lane])
    for k in range(most):
        _add_mirrored(block, second, packet, world, mask, k)


@inlined
def send_back(block: Block, world: World) -> None:
    """The rest of `shade`, once the light has been gathered and the mirror rays are back."""
    _add_matt(block)
    for lane in range(LANES):
        if block.on[lane] == 0:
            continue
        f0, roughness = row(block.f0, lane), block.roughness[lane]
        if block.bounced[lane] > 0:
            cosine = min(1.0, max(1e-3, dot(row(block.ns, lane), row(block.wo, lane))))
            light = mul(row(block.mirrored, lane), specular_albedo(f0, roughness, cosine))
            put(block.color, lane, add(row(block.color, lane), light))
        else:
            _add_gloss_of_sky(block, lane, world, f0, roughness, 1.0)
        _add_coat_of_sky(block, lane, world)


@inlined
def _add_mirrored(block: Block, second: Block, packet: Packet, world: World, mask: int, k: int) -> None:
    """Send mirror ray `k` of every hit that has so many, and add what it sees: lit, but without mirrors of its own."""
    clear(packet)
    for lane in range(LANES):
        if k >= block.bounced[lane]:
            continue
        key = nth(key_of(block.key, lane), k, block.bounced[lane])
        set_key(second.key, lane, branched(key, MIRRORED))
        _add_mirror_ray(block, lane, packet, mask, key)
    intersect_world(packet, world, block.bounce_end, SCATTERED)
    load_hits(second, packet, world, 0.0)
    for lane in range(LANES):
        if second.on[lane] != 0:  # rays of a rough mirror share those that its hit may send to each light
            second.rays[lane] = max(1, block.rays[lane] // block.bounced[lane])
    gather(second, packet, world, mask)
    _add_matt(second)
    for lane in range(LANES):
        if k >= block.bounced[lane]:
            continue
        if second.on[lane] != 0:
            if not _sees_what_glows(block, lane) and any_glows(world.lights):
                put(second.color, lane, sub(row(second.color, lane), row(second.emissive, lane)))
            _add_gloss_of_sky(second, lane, world, row(second.f0, lane), second.roughness[lane], 1.0)
            light = row(second.color, lane)
        elif world.environment.present:
            # Each of many rays sees as much of the sky as it stands for (Colbert and Krivanek, GPU Gems 3, chapter 20).
            share = block.bounced[lane]
            wide = block.roughness[lane] / share**0.25 if share > 1 else 0.0
            light = prefiltered(world.environment, row(block.bounce, lane), wide)
        else:
            continue
        put(block.mirrored, lane, along(row(block.mirrored, lane), light, 1.0 / block.bounced[lane]))


@inlined
def _add_mirror_ray(block: Block, lane: int, packet: Packet, mask: int, key: Key) -> None:
    """Put the mirror ray of a hit into the packet: about one microfacet of its lobe where it is not quite smooth."""
    n, wo = row(block.ns, lane), row(block.wo, lane)
    alpha = block.roughness[lane] ** 2
    h = n
    if alpha > MIRROR_ALPHA:
        u1, u2 = unit_pair(key, Purpose.MIRROR.value)
        h = sample_half_vector(n, wo, alpha, u1, u2)
    r = normalize(sub(scale(h, 2.0 * dot(h, wo)), wo))
    ng = row(block.ng, lane)
    below = dot(r, ng)
    if below < 0.0:  # a shading normal may send it into its own surface; there it is thrown back once more
        r = normalize(sub(r, scale(ng, 2.0 * below)))
    set_ray(packet, lane, off_surface(row(block.point, lane), ng, r), r, 0.0, math.inf, mask)
    put(block.bounce, lane, ray_direction(packet, lane))
