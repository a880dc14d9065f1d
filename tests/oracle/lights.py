"""Finite and distant lights: unoccluded irradiance in closed form, a highlight from the point nearest to the mirror
direction, and the point a shadow is asked of."""

from __future__ import annotations

import math
from typing import NamedTuple

from refract_core.scene import LightKind, Scene

from .vec import Vec, add, at, basis, clamp, cross, dot, length, mix, scaled, sub, unit, vec

_DISK_CORNERS = 12
"""A disk's diffuse light is that of the regular polygon with its area."""


class Lamp(NamedTuple):
    """A light in halves: half width, half height, radius or half angle."""

    kind: LightKind | None
    """None: the stand-in at the eye, without falloff or shadow"""
    x: Vec
    y: Vec
    face: Vec
    centre: Vec
    size: tuple[float, float]
    radiance: Vec
    diffuse: float
    specular: float


def lamps_of(scene: Scene, eye: Vec) -> list[Lamp]:
    lamps = []
    for light in scene.lights:
        m = light.world_from_light
        half = 0.5 if light.kind in (LightKind.RECT, LightKind.DISTANT) else 1.0
        x, y, z, centre = (vec(m[:3, c]) for c in range(4))
        size = (light.size[0] * half, light.size[1] * half)
        lamps.append(
            Lamp(light.kind, x, y, scaled(z, -1.0), centre, size, light.radiance, light.diffuse, light.specular)
        )
    if scene.camera_light:
        white = (math.pi,) * 3
        lamps.append(Lamp(None, (1, 0, 0), (0, 1, 0), (0, 0, -1), eye, (0.0, 0.0), white, 1.0, 1.0))
    return lamps


# --- Shadow ---------------------------------------------------------------------------------------------------------


def shadow_target(lamp: Lamp, p: Vec, u1: float, u2: float) -> tuple[Vec, float]:
    """Unit direction and distance to a point of the light."""
    r, phi = math.sqrt(u1), 2.0 * math.pi * u2
    disk = (r * math.cos(phi), r * math.sin(phi))
    s = lamp.size[0]
    if lamp.kind is LightKind.DISTANT:
        spread = add(scaled(lamp.x, disk[0]), scaled(lamp.y, disk[1]))
        return unit(at(scaled(lamp.face, -1.0), spread, math.sin(s))), math.inf
    target = lamp.centre
    if lamp.kind is LightKind.RECT:
        target = at(at(target, lamp.x, (2 * u1 - 1) * s), lamp.y, (2 * u2 - 1) * lamp.size[1])
    else:  # a disk as it is; of a sphere, the disk that it shows
        x, y = basis(unit(sub(p, lamp.centre))) if lamp.kind is LightKind.SPHERE else (lamp.x, lamp.y)
        target = at(at(target, x, s * disk[0]), y, s * disk[1])
    to = sub(target, p)
    return unit(to), length(to)


# --- Diffuse --------------------------------------------------------------------------------------------------------


def irradiance(lamp: Lamp, p: Vec, n: Vec) -> float:
    """At `p` facing `n`, nothing in the way, per radiance."""
    s = lamp.size[0]
    if lamp.kind is LightKind.DISTANT:
        return max(0.0, -dot(lamp.face, n)) * (math.pi * math.sin(s) ** 2 if s > 0.0 else 1.0)
    to = sub(lamp.centre, p)
    distance = length(to)
    cosine = max(0.0, dot(to, n) / distance)
    if lamp.kind is None:
        return cosine
    if lamp.kind is LightKind.SPHERE:
        return _of_sphere(cosine_of=dot(to, n) / distance, ratio=distance / s) if s > 0.0 else cosine / distance**2
    if dot(to, lamp.face) >= 0.0:
        return 0.0
    if s == 0.0:
        return cosine * -dot(to, lamp.face) / distance**3
    if lamp.kind is LightKind.RECT:
        a, b = scaled(lamp.x, s), scaled(lamp.y, lamp.size[1])
        corners = [add(scaled(a, i), scaled(b, j)) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    else:
        step = 2.0 * math.pi / _DISK_CORNERS
        grown = s * math.sqrt(step / math.sin(step))  # corners of the polygon with the disk's area
        angles = [step * k for k in range(_DISK_CORNERS)]
        corners = [add(scaled(lamp.x, grown * math.cos(t)), scaled(lamp.y, grown * math.sin(t))) for t in angles]
    return _of_polygon([add(to, c) for c in corners], n)


def _of_polygon(corners: list[Vec], n: Vec) -> float:
    """Lambert 1760: half the sum of the angles of the edges times the cosine of their planes, above the horizon."""
    above: list[Vec] = []
    for a, b in zip(corners, corners[1:] + corners[:1], strict=True):  # Sutherland and Hodgman 1974
        ha, hb = dot(a, n), dot(b, n)
        if ha >= 0.0:
            above.append(a)
        if (ha >= 0.0) != (hb >= 0.0):
            above.append(mix(a, b, ha / (ha - hb)))
    total = 0.0
    for a, b in zip(above, above[1:] + above[:1], strict=True):
        a, b = unit(a), unit(b)
        across = cross(a, b)
        sine = length(across)
        if sine > 1e-12:
            total += math.atan2(sine, dot(a, b)) * dot(across, n) / sine
    return abs(total) / 2.0


def _of_sphere(cosine_of: float, ratio: float) -> float:
    """A sphere at `ratio` radii, its centre at an angle from the normal (Snyder 1996: exact, horizon included)."""
    if ratio <= 1.0:
        return math.pi
    if abs(cosine_of) * ratio > 1.0:  # all above, or all below
        return math.pi * max(cosine_of, 0.0) / ratio**2
    sine = math.sqrt(max(1e-12, 1.0 - cosine_of**2))
    root = math.sqrt(ratio**2 - 1.0)
    y = clamp(-root * cosine_of / sine, -1.0, 1.0)
    under = sine * math.sqrt(1.0 - y * y)
    return max(0.0, (cosine_of * math.acos(y) - root * under) / ratio**2 + math.atan(under / root))


# --- Highlight ------------------------------------------------------------------------------------------------------


class _Nearest(NamedTuple):
    to: Vec
    """to the light's point nearest to the mirror ray"""
    inside: bool
    """the mirror ray meets the light"""
    solid: float
    radius: float
    """angular"""


def highlight(lamp: Lamp, p: Vec, n: Vec, wo: Vec, alpha: float) -> float:
    """Reflected radiance per radiance, without Fresnel and shadow (Karis 2013, representative point; GGX of Walter
    et al. 2007, masking of Heitz 2014). Polished surfaces (alpha < 0.005) show the light's own shape, from 0.05 on
    only its blur, and in between both."""
    n_v = dot(n, wo)
    if n_v <= 0.0:
        return 0.0
    near = _nearest(lamp, p, sub(scaled(n, 2.0 * n_v), wo))
    if near.solid <= 0.0:
        return 0.0
    sharp = 1.0 - clamp((alpha - 0.005) / 0.045) if near.radius > 0.0 else 0.0
    value = sharp if near.inside else 0.0
    if sharp < 1.0:
        a = max(alpha, 0.02 if near.radius == 0.0 else 0.002)
        wi = unit(near.to)
        n_l = dot(n, wi)
        if n_l > 0.0:
            wide = min(1.0, a + near.radius / 2.0)
            lobe = _ggx(dot(n, unit(add(wi, wo))), a) * (a / wide) ** 2 * _visibility(n_v, n_l, a)
            value += (1.0 - sharp) * lobe * n_l * near.solid
    return value


def _ggx(n_h: float, a: float) -> float:
    return a * a / (math.pi * (n_h * n_h * (a * a - 1.0) + 1.0) ** 2)


def _visibility(n_v: float, n_l: float, a: float) -> float:
    """G2 / (4 n.v n.l), height-correlated."""
    lit, seen = (math.sqrt(a * a + (1.0 - a * a) * c * c) for c in (n_l, n_v))
    return 0.5 / max(n_l * seen + n_v * lit, 1e-9)


def _nearest(lamp: Lamp, p: Vec, r: Vec) -> _Nearest:
    s, t = lamp.size
    if lamp.kind is LightKind.DISTANT:
        to = scaled(lamp.face, -1.0)
        off = sub(r, scaled(to, dot(r, to)))
        away = length(off)
        inside = dot(r, to) > 0.0 and away <= math.sin(s)
        edge = at(to, off, math.tan(s) / max(away, 1e-12))
        return _Nearest(r if inside else edge, inside, math.pi * math.sin(s) ** 2 if s > 0.0 else 1.0, s)
    c = sub(lamp.centre, p)
    d2 = dot(c, c)
    if lamp.kind is None:
        return _Nearest(c, False, 1.0, 0.0)
    if lamp.kind is LightKind.SPHERE:
        off = sub(scaled(r, dot(c, r)), c)
        away = length(off)
        point = at(c, off, min(1.0, s / max(away, 1e-12)))
        solid = math.pi * s * s / d2 if s > 0.0 else 1.0 / d2
        return _Nearest(point, away <= s and dot(c, r) > 0.0, solid, s / math.sqrt(d2))
    ahead = -dot(c, lamp.face)
    if ahead <= 0.0:
        return _Nearest(c, False, 0.0, 0.0)
    toward = -dot(r, lamp.face)
    off = sub(scaled(r, ahead / toward), c) if toward > 1e-6 else (0.0, 0.0, 0.0)
    a, b = dot(off, lamp.x), dot(off, lamp.y)
    if lamp.kind is LightKind.RECT:
        inside = toward > 1e-6 and abs(a) <= s and abs(b) <= t
        a, b = clamp(a, -s, s), clamp(b, -t, t)
        area = 4.0 * s * t
    else:
        away = math.hypot(a, b)
        inside = toward > 1e-6 and away <= s
        a, b = (x * min(1.0, s / max(away, 1e-12)) for x in (a, b))
        area = math.pi * s * s
    point = at(at(c, lamp.x, a), lamp.y, b)
    return _Nearest(point, inside, ahead / d2**1.5 * (area or 1.0), math.sqrt(area / math.pi / d2))
