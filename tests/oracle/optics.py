"""What one interface, one stretch of glass and one closed model do to light. Who follows what is `tree`'s business."""

from __future__ import annotations

import math
from typing import NamedTuple

from .vec import Vec, add, at, basis, clamp, dot, facing, scaled, sub, unit, vec

THIN = 0.005
"""Thickness and absorption distance of everything thin [m]."""
_EPSILON = 2.0**-24
_LINES = (656.27, 587.56, 486.13)  # Fraunhofer C, d, F [nm]


def mirrored(d: Vec, n: Vec) -> Vec:
    return sub(d, scaled(n, 2.0 * dot(d, n)))


def bent(d: Vec, n: Vec, eta: float) -> Vec | None:
    """Snell's law by the angle itself: the part along the surface grows by `eta` (ior here over ior there). `n` stands
    against `d`. None at total reflection."""
    tangent = scaled(sub(d, scaled(n, dot(d, n))), eta)
    sine2 = dot(tangent, tangent)
    if sine2 > 1.0:
        return None
    return sub(tangent, scaled(n, math.sqrt(1.0 - sine2)))


def fresnel(cosine: float, eta: float) -> float:
    """Reflectance of unpolarised light that comes in under that cosine; `eta`: ior here over ior there. By the angles
    (Fresnel's sine and tangent laws, as ratios of the sides of the two triangles). 1 at total reflection."""
    if eta == 1.0:
        return 0.0
    sine_t = math.sqrt(max(0.0, 1.0 - cosine * cosine)) * eta
    if sine_t >= 1.0:
        return 1.0
    inner = math.sqrt(1.0 - sine_t * sine_t)
    s = (eta * cosine - inner) / (eta * cosine + inner)
    p = (cosine - eta * inner) / (cosine + eta * inner)
    return (s * s + p * p) / 2.0


def absorbed(tint: Vec, distance: float, path: float) -> Vec:
    """Beer-Lambert: what `path` leaves where `distance` leaves `tint`. A black tint is not quite black, as in HDRP."""
    power = path / max(distance, _EPSILON)
    return vec([min(1.0, (max(c, 0.0) + _EPSILON) ** power) for c in tint])


def iors(ior: float, abbe: float) -> tuple[float, float, float]:
    """At the lines C, d and F, for red, green and blue: Cauchy's A + B / wavelength^2 through n_d with
    (n_d - 1) / (n_F - n_C) = abbe."""
    if abbe <= 0.0:
        return (ior,) * 3
    c, d, f = (1.0 / line**2 for line in _LINES)
    b = (ior - 1.0) / abbe / (f - c)
    return max(1.0, ior + b * (c - d)), ior, max(1.0, ior + b * (f - d))


def transmitted_roughness(roughness: float, ior: float) -> float:
    """Roughness of the reflection lobe that is as wide as the one behind two rough interfaces: the engine's fit."""
    alpha, step = roughness * roughness, ior - 1.0
    return min(1.0, roughness * math.sqrt(0.835 * step / (1.0 + 2.5 * step * alpha * alpha)))


# --- Interfaces of a mesh -------------------------------------------------------------------------------------------


class Split(NamedTuple):
    """What an interface does with one channel."""

    transmitted: Vec | None
    """None at total reflection"""
    reflectance: float


def crossing(d: Vec, n: Vec, ng: Vec, eta: float) -> Split:
    """Into a body or out of one, `n` (shading, facing the ray) and `ng` on the ray's side."""
    through = bent(d, n, eta)
    if through is None or dot(through, ng) >= 0.0:
        return Split(None, 1.0)
    return Split(through, fresnel(clamp(abs(dot(d, n))), eta))


def glanced(d: Vec, n: Vec, ng: Vec) -> Vec:
    """A reflection that stays on its side: by the true normal where the shading normal fails."""
    r = mirrored(d, n)
    return r if dot(r, ng) > 0.0 else mirrored(d, ng)


# --- Closed models ----------------------------------------------------------------------------------------------------


class Passage(NamedTuple):
    """Through an object in one step."""

    path: float
    point: Vec
    direction: Vec


def through_sphere(p: Vec, n: Vec, wo: Vec, ior: float, thickness: float) -> Passage:
    """A ball of that diameter, which touches the surface from inside (HDRP, Refraction.hlsl)."""
    n = facing(n, wo)
    inside = _unless_none(bent(scaled(wo, -1.0), n, 1.0 / ior))
    centre = at(p, n, -thickness / 2.0)
    path = -dot(inside, n) * thickness
    leave = at(p, inside, path)
    inward = unit(sub(centre, leave))
    # The ball is met from inside as it was from outside, so this is never total reflection but by the last bit.
    out = bent(inside, inward, ior) or sub(scaled(inside, ior), scaled(inward, dot(scaled(inside, ior), inward)))
    return Passage(path, leave, unit(out))


def through_slab(p: Vec, n: Vec, wo: Vec, ior: float, thickness: float) -> Passage:
    """Between parallel faces: shifted, not turned."""
    n = facing(n, wo)
    inside = _unless_none(bent(scaled(wo, -1.0), n, 1.0 / ior))
    path = thickness / max(-dot(inside, n), 1e-5)
    return Passage(path, at(p, inside, path), scaled(wo, -1.0))


def through_surface(p: Vec, n: Vec, wo: Vec, ior: float) -> Passage:
    """One interface, without a way inside (Arm): the ray goes on from the surface's own point."""
    return Passage(0.0, p, _unless_none(bent(scaled(wo, -1.0), facing(n, wo), 1.0 / ior)))


def _unless_none(v: Vec | None) -> Vec:
    assert v is not None, "nothing is totally reflected on its way into the denser medium"
    return v


def scattered(d: Vec, blur: float, u1: float, u2: float) -> Vec:
    """A direction of the rough lobe around `d`: GGX slopes of width `blur`, cut at 85 degrees."""
    x, y = basis(d)
    slope = min(11.0, blur * math.sqrt(u1 / max(1e-6, 1.0 - u1)))
    phi = 2.0 * math.pi * u2
    return unit(add(d, add(scaled(x, slope * math.cos(phi)), scaled(y, slope * math.sin(phi)))))
