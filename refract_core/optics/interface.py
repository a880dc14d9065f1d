"""Optics of one ray: the only definition of every formula, as scalar functions over (x, y, z) tuples.

Kernels call these directly; `arrays` runs the same functions over arrays. Directions are unit vectors, `i` travels
towards the surface, `wo` away from it towards the viewer, `n` stands on the side the light comes from. Lengths are
metres. `eta_i_over_t` is the ior of the medium the ray is in over that of the medium it enters.
Nothing here raises: a ray that cannot be refracted says so in its result.
"""

from __future__ import annotations

import math

from ..kernels.compile import inlined
from ..kernels.vec import Vec, along, dot, scale

LOG_EPSILON = 2.0**-24
"""Keeps the logarithm of a black transmittance colour finite (HDRP, VolumeRendering.hlsl)."""
PROBE_LAST_LOD = 6.0
"""Last GGX level of a probe's mip chain (HDRP, ImageBasedLighting.hlsl)."""

# Fraunhofer lines C, d and F [nm]: those the Abbe number is defined on, here for red, green and blue. Green then
# keeps the authored ior, and F to C spans within 3 % of what the primaries of BT.709 (611, 549, 464 nm) would.
LINES_C_D_F = (656.27, 587.56, 486.13)


@inlined
def saturate(x: float) -> float:
    return min(max(x, 0.0), 1.0)


@inlined
def reflect(i: Vec, n: Vec) -> Vec:
    """Mirror direction i - 2 (n.i) n (Snell's law of reflection); `n` may stand on either side."""
    return along(i, n, -2.0 * dot(i, n))


@inlined
def refract(i: Vec, n: Vec, eta_i_over_t: float) -> tuple[bool, Vec]:
    """Direction behind the interface by Snell's law in vector form (GLSL specification 4.60, section 8.5).

    Returns:
        (True, unit direction), or (False, zero vector) at total internal reflection.
    """
    c = dot(n, i)
    k = 1.0 - eta_i_over_t * eta_i_over_t * (1.0 - c * c)
    if k < 0.0:
        return False, (0.0, 0.0, 0.0)
    return True, along(scale(i, eta_i_over_t), n, -(eta_i_over_t * c + math.sqrt(k)))


@inlined
def fresnel_dielectric(cos_i: float, eta_i_over_t: float) -> float:
    """Exact reflectance of unpolarised light, 1 at total internal reflection (Fresnel; Born & Wolf, section 1.5.2).

    Args:
        cos_i: Cosine of the angle of incidence, 0 .. 1.
        eta_i_over_t: Ratio of iors, > 0.
    """
    if eta_i_over_t == 1.0:
        return 0.0
    c = saturate(cos_i)
    k = 1.0 - eta_i_over_t * eta_i_over_t * (1.0 - c * c)
    if k <= 0.0:
        return 1.0
    cos_t = math.sqrt(k)
    rs = (eta_i_over_t * c - cos_t) / (eta_i_over_t * c + cos_t)
    rp = (c - eta_i_over_t * cos_t) / (c + eta_i_over_t * cos_t)
    return 0.5 * (rs * rs + rp * rp)


@inlined
def f0_from_ior(ior: float) -> float:
    """Reflectance at normal incidence seen from vacuum, ((n - 1) / (n + 1))^2 (Fresnel)."""
    r = (ior - 1.0) / (ior + 1.0)
    return r * r


@inlined
def transmittance(color: Vec, absorption_distance: float, path_length: float) -> Vec:
    """Beer-Lambert: color^(path_length / absorption_distance), per channel, at most 1 (HDRP, VolumeRendering.hlsl).

    Args:
        color: What is left of white light after `absorption_distance`, 0 .. 1.
        absorption_distance: [m], > 0; infinite means a medium that absorbs nothing.
        path_length: [m], >= 0
    """
    distances = path_length / max(absorption_distance, LOG_EPSILON)
    return (_attenuate(color[0], distances), _attenuate(color[1], distances), _attenuate(color[2], distances))


@inlined
def _attenuate(color: float, distances: float) -> float:
    return min(math.exp(distances * math.log(max(color, 0.0) + LOG_EPSILON)), 1.0)


@inlined
def _node_intensity(cos_i: float, k: float, source: float, medium: float, critical_angle: bool) -> float:
    """Intensity slot of Unity's Refract node: a transmittance on entering, a reflectance on leaving."""
    if source <= medium:
        f0 = ((medium - source) / (medium + source)) ** 2
        return saturate((1.0 - f0) * (1.0 - (1.0 - cos_i) ** 5))
    if k < 0.0:
        return 1.0 if critical_angle else 0.0
    ratio = medium / source
    g = math.sqrt(max(ratio * ratio + cos_i * cos_i - 1.0, 0.0))
    a = (g - cos_i) / (g + cos_i)
    b = ((g + cos_i) * cos_i - 1.0) / ((g - cos_i) * cos_i + 1.0)
    f = 0.5 * a * a * (1.0 + b * b)
    # The shader's 1 - saturate(1 - f) turns an undefined value into 1, and so does this comparison.
    return f if f < 1.0 else 1.0


@inlined
def refract_node(
    incident: Vec, normal: Vec, ior_source: float, ior_medium: float, critical_angle: bool, null_on_tir: bool
) -> tuple[Vec, float, float, float]:
    """Unity's Refract node as shipped (RefractNode.cs), with the physical shares of the light beside it.

    Shipped are `refracted` and `intensity`, iors clamped to >= 1, nothing flipped or normalised. At total internal
    reflection mode Safe gives the tangential vector eta (i - (i.n) n), longer than 1, and intensity 0; mode
    CriticalAngle gives the mirror direction and 1. Intensity is a transmittance (Schlick) on entering a denser or
    equal medium and a reflectance (exact) on leaving it.

    Args:
        incident: Unit direction towards the surface.
        normal: Unit normal, against `incident`.
        ior_source: Medium the ray is in.
        ior_medium: Medium it enters.
        critical_angle: Mode CriticalAngle instead of Safe.
        null_on_tir: Zero vector as `refracted` at total internal reflection, as the node's page promises for Safe.

    Returns:
        refracted, intensity, and exact unpolarised reflectance and transmittance, which sum to 1.
    """
    source, medium = max(ior_source, 1.0), max(ior_medium, 1.0)
    eta_i_over_t = source / medium
    c = dot(incident, normal)
    k = 1.0 - eta_i_over_t * eta_i_over_t * (1.0 - c * c)
    if k < 0.0 and null_on_tir:
        refracted = (0.0, 0.0, 0.0)
    elif k < 0.0 and critical_angle:
        refracted = reflect(incident, normal)
    else:
        refracted = along(scale(incident, eta_i_over_t), normal, -(eta_i_over_t * c + math.sqrt(max(k, 0.0))))
    reflectance = fresnel_dielectric(abs(c), eta_i_over_t)
    return refracted, _node_intensity(-c, k, source, medium, critical_angle), reflectance, 1.0 - reflectance


@inlined
def channel_iors(ior: float, abbe: float) -> tuple[float, float, float]:
    """Ior for red, green and blue, at the Fraunhofer lines C, d and F; `abbe` 0 means no dispersion.

    Cauchy's n = A + B / wavelength^2 through n_d and the Abbe number V = (n_d - 1) / (n_F - n_C), as in
    KHR_materials_dispersion. So (n_g - 1) / (n_b - n_r) is the Abbe number and n_g the authored ior.
    """
    if abbe <= 0.0:
        return ior, ior, ior
    c, d, f = LINES_C_D_F
    slope = (ior - 1.0) / (abbe * (1.0 / (f * f) - 1.0 / (c * c)))
    red = ior + slope * (1.0 / (c * c) - 1.0 / (d * d))
    blue = ior + slope * (1.0 / (f * f) - 1.0 / (d * d))
    return max(red, 1.0), ior, max(blue, 1.0)


@inlined
def transmitted_roughness(roughness: float, ior: float, two_interfaces: bool) -> float:
    """Perceptual roughness of the reflection lobe that is as wide as the transmitted one.

    Fitted to a GGX Monte Carlo at normal incidence (microfacet model of Walter et al. 2007, median angle; it is
    `benchmarks/lobe.py`): alpha_t = alpha (1 - 1 / n) / 2 behind one rough interface, and behind two
    0.835 (n - 1) alpha / (1 + 2.5 (n - 1) alpha^2), for masking and total reflection narrow wide lobes; alpha is
    roughness squared. At n = 1.5 within 1 % up to roughness 0.7. Never more than 1.
    """
    n = max(ior, 1.0)
    alpha = roughness * roughness
    factor = 0.835 * (n - 1.0) / (1.0 + 2.5 * (n - 1.0) * alpha * alpha) if two_interfaces else 0.5 * (1.0 - 1.0 / n)
    return min(roughness * math.sqrt(factor), 1.0)


@inlined
def screen_lod_hdrp(perceptual_roughness: float, lod_count: int) -> float:
    """Level of a colour pyramid of `lod_count` levels, r^1.3 (lod_count - 1) (HDRP, Lit.hlsl)."""
    return math.pow(max(perceptual_roughness, 0.0), 1.3) * max(lod_count - 1.0, 0.0)


@inlined
def probe_lod_hdrp(perceptual_roughness: float) -> float:
    """Level of a probe's seven mips, 6 r (1.7 - 0.7 r) (HDRP, ImageBasedLighting.hlsl)."""
    return PROBE_LAST_LOD * perceptual_roughness * (1.7 - 0.7 * perceptual_roughness)


@inlined
def probe_roughness_hdrp(lod: float) -> float:
    """Perceptual roughness a probe's level is filtered for: the inverse of `probe_lod_hdrp`."""
    return saturate((1.7 - math.sqrt(max(1.7 * 1.7 - 2.8 * saturate(lod / PROBE_LAST_LOD), 0.0))) / 1.4)
