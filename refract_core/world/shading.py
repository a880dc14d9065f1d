"""Light leaving opaque surfaces, eight hits at a time.

A `Block` holds what a 4x2 block of pixels (or eight rays of any kind) hit. `shade` gives its radiance: emission,
lights with shadows, the environment, and one mirror bounce where a surface is smooth enough to show it.
Every room that needs the colour of an opaque hit calls it: the picture, probes, the ray tier and the reference.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.compile import inlined
from ..kernels.lanes import LANES, Flags, Pairs, Rows, Scalars, Vectors, put
from ..kernels.sampling import unit_pair
from ..kernels.vec import add, dot, flip_towards, frame, lerp, mul, normalize, row, scale, sub
from ..optics.lobes import MIRROR_ALPHA, sample_half_vector, specular_albedo
from ..scene import Param
from .embree import GEOM, HIT_U, HIT_V, PRIM, SCATTERED, T_FAR, clear, set_ray
from .environment import irradiance, prefiltered, sample_direction
from .lights import CAMERA_LIGHT, highlight, irradiance_factor, shadow_ray
from .surface import color_input, float_input, hit_at, material_of, normal_input
from .tracing import add_shadow_ray, intersect_world, off_surface, visible

_REFLECTED_ROUGHNESS = 0.5
_POLISHED_ROUGHNESS = 0.2
"""Mirrors up to the first roughness, and dielectrics up to the second, reflect the scene by a ray of their own; others
take their reflection from the environment map alone."""
_SKY_CANDIDATES = 2
# Purposes of the sampling sequence; lights use 16 + their number.
_SKY, _MIRROR = 1, 2


class Block(NamedTuple):
    """Eight opaque hits and the light they send back."""

    on: Flags
    """1 where the lane holds a hit"""
    pixel: Pairs
    """keys of the sampling sequence"""
    point: Vectors
    """[m]"""
    ng: Vectors
    """geometric normal, on the viewer's side"""
    ns: Vectors
    """shading normal, on the side of ng"""
    wo: Vectors
    """towards the viewer"""
    albedo: Vectors
    """diffuse reflectance"""
    f0: Vectors
    emissive: Vectors
    roughness: Scalars
    coat: Scalars
    coat_roughness: Scalars
    occlusion: Scalars
    diffuse: Vectors
    """irradiance that arrived"""
    specular: Vectors
    """radiance of the lights' highlights"""
    color: Vectors
    """the result: radiance towards wo"""
    distance: Scalars
    """hit distance [m]; inf where nothing was hit"""
    scratch: Annotated[NDArray[np.float64], Rows(4)]
    """shape (4, 8)"""


@inlined
def load_hits(block, packet, world, spread):  # type: ignore[no-untyped-def]
    """Look at every hit of a traced packet and note its surface in the block."""
    rays, words = packet.rays, packet.words
    for lane in range(LANES):
        block.on[lane] = 0
        block.distance[lane] = math.inf
        if packet.valid[lane] == 0 or words[GEOM, lane] < 0:
            continue
        direction = (np.float64(rays[4, lane]), np.float64(rays[5, lane]), np.float64(rays[6, lane]))
        origin = (np.float64(rays[0, lane]), np.float64(rays[1, lane]), np.float64(rays[2, lane]))
        t = np.float64(rays[T_FAR, lane])
        u, v = np.float64(rays[HIT_U, lane]), np.float64(rays[HIT_V, lane])
        hit = hit_at(world.geometry, words[GEOM, lane], words[PRIM, lane], u, v, origin, direction, t, spread)
        block.on[lane] = 1
        block.distance[lane] = t
        load_surface(block, lane, hit, world, scale(direction, -1.0))


@inlined
def load_surface(block, lane, hit, world, wo):  # type: ignore[no-untyped-def]
    """Evaluate a UsdPreviewSurface at a hit (UsdPreviewSurface specification 2.5, shading model)."""
    g, mt, tx = world.geometry, world.materials, world.textures
    m = material_of(g, hit.part, hit.primitive)
    ng = flip_towards(hit.ng, wo)
    ns = flip_towards(normal_input(g, mt, tx, hit, m), ng)
    base = color_input(g, mt, tx, hit, m, Param.DIFFUSE.value)
    metallic = 0.0
    if mt.specular_workflow[m]:
        f0 = color_input(g, mt, tx, hit, m, Param.SPECULAR.value)
    else:
        metallic = min(1.0, max(0.0, float_input(g, mt, tx, hit, m, Param.METALLIC.value)))
        ior = float_input(g, mt, tx, hit, m, Param.IOR.value)
        dielectric = ((ior - 1.0) / (ior + 1.0)) ** 2
        f0 = lerp((dielectric, dielectric, dielectric), base, metallic)
    roughness = min(1.0, max(0.0, float_input(g, mt, tx, hit, m, Param.ROUGHNESS.value)))
    sent_back = specular_albedo(f0, roughness, abs(dot(ns, wo)))
    kept = scale(base, 1.0 - metallic)
    diffuse = (
        kept[0] * (1.0 - min(1.0, sent_back[0])),
        kept[1] * (1.0 - min(1.0, sent_back[1])),
        kept[2] * (1.0 - min(1.0, sent_back[2])),
    )
    put(block.point, lane, hit.point)
    put(block.ng, lane, ng)
    put(block.ns, lane, ns)
    put(block.wo, lane, wo)
    put(block.albedo, lane, diffuse)
    put(block.f0, lane, f0)
    put(block.emissive, lane, color_input(g, mt, tx, hit, m, Param.EMISSIVE.value))
    block.roughness[lane] = roughness
    block.coat[lane] = min(1.0, max(0.0, float_input(g, mt, tx, hit, m, Param.CLEARCOAT.value)))
    block.coat_roughness[lane] = min(1.0, max(0.0, float_input(g, mt, tx, hit, m, Param.CLEARCOAT_ROUGHNESS.value)))
    block.occlusion[lane] = min(1.0, max(0.0, float_input(g, mt, tx, hit, m, Param.OCCLUSION.value)))


@inlined
def _fresnel(f0, roughness, cosine):  # type: ignore[no-untyped-def]
    """Schlick with its grazing value lowered for rough surfaces (Lagarde 2011) and for those that hardly reflect."""
    x = (1.0 - min(1.0, cosine)) ** 5
    top = (1.0 - roughness) * min(1.0, 50.0 * max(f0[0], f0[1], f0[2]))
    return (
        f0[0] + (max(top, f0[0]) - f0[0]) * x,
        f0[1] + (max(top, f0[1]) - f0[1]) * x,
        f0[2] + (max(top, f0[2]) - f0[2]) * x,
    )


@inlined
def _gather_lights(block, packet, world, sample, mask):  # type: ignore[no-untyped-def]
    """Add every light's irradiance to `diffuse` and its highlights to `specular`, with shadows."""
    lights = world.lights
    light_d, light_s, seen = block.scratch[0], block.scratch[1], block.scratch[2]
    for lane in range(LANES):
        for c in range(3):
            block.diffuse[lane, c] = 0.0
            block.specular[lane, c] = 0.0
    for l in range(lights.kind.shape[0]):  # noqa: E741
        clear(packet)
        for lane in range(LANES):
            light_d[lane] = light_s[lane] = 0.0
            seen[lane] = 1.0
            if block.on[lane] == 0:
                continue
            p, n, wo = row(block.point, lane), row(block.ns, lane), row(block.wo, lane)
            light_d[lane] = irradiance_factor(lights, l, p, n) * lights.diffuse[l]
            gloss = block.roughness[lane]
            light_s[lane] = highlight(lights, l, p, n, wo, gloss * gloss) * lights.specular[l]
            if light_d[lane] + light_s[lane] > 0.0 and lights.kind[l] != CAMERA_LIGHT:
                u1, u2 = unit_pair(block.pixel[lane, 0], block.pixel[lane, 1], sample, 16 + l)
                direction, distance = shadow_ray(lights, l, p, u1, u2)
                add_shadow_ray(packet, lane, p, row(block.ng, lane), direction, distance)
        if lights.kind[l] != CAMERA_LIGHT:
            visible(packet, world, mask, seen)
        _add_light(block, lights, l, light_d, light_s, seen)


@inlined
def _add_light(block, lights, l, light_d, light_s, seen):  # type: ignore[no-untyped-def] # noqa: E741
    radiance = row(lights.radiance, l)
    for lane in range(LANES):
        if block.on[lane] == 0 or seen[lane] == 0.0:
            continue
        n, wo, p = row(block.ns, lane), row(block.wo, lane), row(block.point, lane)
        f = _fresnel(row(block.f0, lane), block.roughness[lane], max(0.0, dot(n, wo)))
        coat = block.coat[lane]
        coat_light = 0.0
        if coat > 0.0:
            gloss = block.coat_roughness[lane]
            fc = coat * (0.04 + 0.96 * (1.0 - min(1.0, max(0.0, dot(n, wo)))) ** 5)
            coat_light = fc * highlight(lights, l, p, n, wo, gloss * gloss) * lights.specular[l]
        for c in range(3):
            block.diffuse[lane, c] += radiance[c] * light_d[lane]
            block.specular[lane, c] += radiance[c] * (light_s[lane] * f[c] + coat_light)


@inlined
def _gather_sky(block, packet, world, sample, mask):  # type: ignore[no-untyped-def]
    """Add the environment's irradiance to `diffuse`. Its unoccluded value is exact; how much of it arrives is asked
    along one direction, chosen among candidates in proportion to what it would bring (resampled importance sampling,
    Talbot et al. 2005). The same answer is left in scratch row 3 for the environment's highlight."""
    environment = world.environment
    seen = block.scratch[3]
    for lane in range(LANES):
        seen[lane] = 1.0
    if not environment.present:
        return
    clear(packet)
    for lane in range(LANES):
        if block.on[lane] == 0:
            continue
        x, y = block.pixel[lane, 0], block.pixel[lane, 1]
        n = row(block.ns, lane)
        direction = n
        total = 0.0
        pick = unit_pair(x, y, sample, _SKY + 4)[0]
        for k in range(_SKY_CANDIDATES):
            u1, u2 = unit_pair(x, y, sample * _SKY_CANDIDATES + k, _SKY + 5)
            candidate, _ = sample_direction(environment, u1, u2)
            w = max(0.0, dot(candidate, n))
            if w > 0.0:
                total += w
                chance = w / total
                if pick < chance:
                    direction = candidate
                    pick /= chance
                else:
                    pick = (pick - chance) / max(1.0 - chance, 1e-9)
        if total == 0.0:  # all candidates were below the horizon
            a, b = unit_pair(x, y, sample, _SKY)
            direction = _cosine_direction(n, a, b)
        add_shadow_ray(packet, lane, row(block.point, lane), row(block.ng, lane), direction, math.inf)
    visible(packet, world, mask, seen)
    for lane in range(LANES):
        if block.on[lane] == 0:
            continue
        seen[lane] *= block.occlusion[lane]
        if seen[lane] > 0.0:
            e = irradiance(environment, row(block.ns, lane))
            for c in range(3):
                block.diffuse[lane, c] += e[c] * seen[lane]


@inlined
def _cosine_direction(n, u1, u2):  # type: ignore[no-untyped-def]
    x, y = frame(n)
    r = math.sqrt(u1)
    phi = 2.0 * math.pi * u2
    z = math.sqrt(max(0.0, 1.0 - u1))
    return add(add(scale(x, r * math.cos(phi)), scale(y, r * math.sin(phi))), scale(n, z))


@inlined
def gather(block, packet, world, sample, mask):  # type: ignore[no-untyped-def]
    """What arrives at every hit: irradiance into `diffuse`, the lights' highlights into `specular`."""
    _gather_lights(block, packet, world, sample, mask)
    _gather_sky(block, packet, world, sample, mask)


@inlined
def _shade_without_bounce(block, packet, world, sample, mask):  # type: ignore[no-untyped-def]
    """Emission, lights and environment of every hit in the block."""
    gather(block, packet, world, sample, mask)
    for lane in range(LANES):
        if block.on[lane] == 0:
            continue
        lit = scale(mul(row(block.albedo, lane), row(block.diffuse, lane)), 1.0 / math.pi)
        put(block.color, lane, add(add(row(block.emissive, lane), lit), row(block.specular, lane)))


@inlined
def _environment_gloss(block, lane, world, f0, roughness, weight):  # type: ignore[no-untyped-def]
    """Add the environment's mirror lobe, dimmed by the visibility found for its diffuse light."""
    if not world.environment.present or block.scratch[3, lane] == 0.0:
        return
    n, wo = row(block.ns, lane), row(block.wo, lane)
    cosine = min(1.0, max(1e-3, dot(n, wo)))
    r = sub(scale(n, 2.0 * dot(n, wo)), wo)
    light = scale(prefiltered(world.environment, r, roughness), weight * block.scratch[3, lane])
    put(block.color, lane, add(row(block.color, lane), mul(light, specular_albedo(f0, roughness, cosine))))


@inlined
def shade(block, second, packet, world, sample, mask):  # type: ignore[no-untyped-def]
    """Radiance of every hit in `block` into `block.color`. `second` is another block, used for the mirror bounce.

    `mask`: what reflections and shadows may meet. The packet is overwritten.
    """
    _shade_without_bounce(block, packet, world, sample, mask)
    clear(packet)
    bounces = False
    for lane in range(LANES):
        if block.on[lane] == 0:
            continue
        f0, roughness = row(block.f0, lane), block.roughness[lane]
        strength = max(f0[0], f0[1], f0[2])
        limit = _REFLECTED_ROUGHNESS if strength > 0.2 else _POLISHED_ROUGHNESS
        if roughness < limit and strength > 0.02:
            bounces = True
            _add_mirror_ray(block, lane, packet, sample, mask)
        else:
            _environment_gloss(block, lane, world, f0, roughness, 1.0)
        if block.coat[lane] > 0.0:
            _environment_gloss(block, lane, world, (0.04, 0.04, 0.04), block.coat_roughness[lane], block.coat[lane])
    if not bounces:
        return
    far = block.scratch[0]
    for lane in range(LANES):
        far[lane] = math.inf
        second.pixel[lane, 0] = block.pixel[lane, 0] + 7919
        second.pixel[lane, 1] = block.pixel[lane, 1]
        # Where the mirror ray of a lane goes is needed after the packet has been reused.
        block.scratch[1, lane] = packet.valid[lane]
        put(block.specular, lane, (packet.rays[4, lane], packet.rays[5, lane], packet.rays[6, lane]))
    intersect_world(packet, world, far, SCATTERED)
    load_hits(second, packet, world, 0.0)
    _shade_without_bounce(second, packet, world, sample, mask)
    for lane in range(LANES):
        if block.scratch[1, lane] == 0.0:
            continue
        if second.on[lane] != 0:
            _environment_gloss(second, lane, world, row(second.f0, lane), second.roughness[lane], 1.0)
            light = row(second.color, lane)
        elif world.environment.present:
            light = prefiltered(world.environment, row(block.specular, lane), 0.0)
        else:
            continue
        cosine = min(1.0, max(1e-3, dot(row(block.ns, lane), row(block.wo, lane))))
        reflectance = specular_albedo(row(block.f0, lane), block.roughness[lane], cosine)
        put(block.color, lane, add(row(block.color, lane), mul(light, reflectance)))


@inlined
def _add_mirror_ray(block, lane, packet, sample, mask):  # type: ignore[no-untyped-def]
    n, wo = row(block.ns, lane), row(block.wo, lane)
    alpha = block.roughness[lane] ** 2
    h = n
    if alpha > MIRROR_ALPHA:
        u1, u2 = unit_pair(block.pixel[lane, 0], block.pixel[lane, 1], sample, _MIRROR)
        h = sample_half_vector(n, wo, alpha, u1, u2)
    r = normalize(sub(scale(h, 2.0 * dot(h, wo)), wo))
    ng = row(block.ng, lane)
    below = dot(r, ng)
    if below < 0.0:
        r = normalize(sub(r, scale(ng, 2.0 * below)))
    set_ray(packet, lane, off_surface(row(block.point, lane), ng, r), r, 0.0, math.inf, mask)
