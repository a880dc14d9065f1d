"""Finite and distant lights: unoccluded irradiance in closed form, a highlight from the point nearest to the mirror
direction, and the point a shadow is asked of."""

from __future__ import annotations

import math
from typing import NamedTuple

from refract_core.scene import LightKind, Scene, Shadow, Shaping

from . import shaping
from .vec import Vec, add, at, basis, clamp, cross, dot, length, mix, mul, scaled, sub, unit, vec

_DISK_CORNERS = 12
"""A disk's diffuse light is that of the regular polygon with its area."""
_ARC_PIECES = 8
"""The seen half of a cylinder's end is so many straight pieces."""


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
    shaping: Shaping = Shaping()
    shadows: bool = True
    shadow: Shadow = Shadow()
    lit: tuple[str, ...] | None = None
    casters: tuple[str, ...] | None = None


def lamps_of(scene: Scene, eye: Vec) -> list[Lamp]:
    lamps = []
    for light in scene.lights:
        m = light.world_from_light
        half = 0.5 if light.kind in (LightKind.RECT, LightKind.DISTANT) else 1.0
        x, y, z, centre = (vec(m[:3, c]) for c in range(4))
        size = (light.size[0] * half, light.size[1] * half)
        if light.kind is LightKind.CYLINDER:
            size = (light.size[0], light.size[1] / 2.0)
        lamps.append(
            Lamp(light.kind, x, y, scaled(z, -1.0), centre, size, light.radiance, light.diffuse, light.specular,
                 light.shaping, light.casts_shadow, light.shadow, light.lit, light.casters)
        )  # fmt: skip
    if scene.camera_light:
        white = (math.pi,) * 3
        lamps.append(Lamp(None, (1, 0, 0), (0, 1, 0), (0, 0, -1), eye, (0.0, 0.0), white, 1.0, 1.0, shadows=False))
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
    elif lamp.kind is LightKind.CYLINDER:  # the rectangle through its axis that faces the place
        _, rho, w = _beside(lamp, p)
        sine = s / rho if s < rho else 0.0
        half = s * math.sqrt(1.0 - sine * sine)
        target = at(at(target, lamp.x, (2 * u1 - 1) * lamp.size[1]), cross(lamp.x, w), (2 * u2 - 1) * half)
        target = at(target, w, -s * sine)
    else:  # a disk as it is; of a sphere, the disk around which rays touch it
        x, y = lamp.x, lamp.y
        if lamp.kind is LightKind.SPHERE:
            w, far = unit(sub(p, lamp.centre)), length(sub(p, lamp.centre))
            x, y = basis(w)
            sine = s / far if s < far else 0.0
            target, s = at(target, w, s * sine), s * math.sqrt(1.0 - sine * sine)
        target = at(at(target, x, s * disk[0]), y, s * disk[1])
    to = sub(target, p)
    return unit(to), length(to)


def picked_target(lamp: Lamp, p: Vec, n: Vec, u1: float, u2: float, pick: float) -> tuple[Vec, float]:
    """Of sixteen points of a light that is near, one, each as likely as what it brings is part of all."""
    size = math.hypot(*lamp.size)
    if lamp.kind is LightKind.DISTANT or lamp.size[0] <= 0.0 or length(sub(lamp.centre, p)) > 8.0 * size:
        return shadow_target(lamp, p, u1, u2)
    points = [shadow_target(lamp, p, (u1 + k / 16) % 1.0, (u2 + 7 * k / 16) % 1.0) for k in range(16)]
    brings = [max(1e-30, _facing(lamp, p, d) * dot(d, n) / (distance * distance)) for d, distance in points]
    # From the last to the first: each is it with its share of all up to it, of what `pick` has left.
    chosen = 0
    for k in range(16):
        share = brings[k] / sum(brings[: k + 1])
        if pick < share:
            chosen, pick = k, pick / share
        else:
            pick = (pick - share) / (1.0 - share)
    return points[chosen]


def _facing(lamp: Lamp, p: Vec, d: Vec) -> float:
    """Cosine at the light, or at what stands in its place: a disk or a rectangle that is turned to `p`."""
    if lamp.kind is LightKind.SPHERE:
        return dot(d, unit(sub(lamp.centre, p)))
    return dot(d, _beside(lamp, p)[2]) if lamp.kind is LightKind.CYLINDER else -dot(d, lamp.face)


def _beside(lamp: Lamp, p: Vec) -> tuple[float, float, Vec]:
    """Of a cylinder from `p`: distance to its middle along it, to its axis across, and the unit way across."""
    to = sub(lamp.centre, p)
    ahead = dot(to, lamp.x)
    off = at(to, lamp.x, -ahead)
    return ahead, length(off), unit(off)


# --- Shaping --------------------------------------------------------------------------------------------------------


def tint(lamp: Lamp, p: Vec, n: Vec) -> Vec:
    """What shaping leaves of the irradiance."""
    if lamp.kind in (None, LightKind.DISTANT) or shaping.is_even(lamp.shaping):
        return shaping.WHITE
    assert lamp.kind is not None
    a, b = lamp.size
    if lamp.kind is LightKind.CYLINDER:
        _, rho, w = _beside(lamp, p)
        near = rho - math.pi / 4.0 * a  # a strip as far as its near half is on an average, seen as wide as it is
        half = near * math.tan(math.asin(min(a / rho, 0.99995)))
        place = shaping.Place(
            False, at(lamp.centre, w, near - rho), scaled(lamp.x, b), scaled(cross(lamp.x, w), half), w
        )
    elif lamp.kind is LightKind.SPHERE:
        w = unit(sub(lamp.centre, p))
        sine = min(a / length(sub(lamp.centre, p)), 1.0)  # of the circle on which rays from `p` touch it
        middle, radius = at(lamp.centre, w, -a * sine), a * math.sqrt(1.0 - sine * sine)
        x, y = basis(scaled(w, -1.0))
        place = shaping.Place(True, middle, scaled(x, radius), scaled(y, radius), w)
    else:
        b = b if lamp.kind is LightKind.RECT else a
        away = scaled(lamp.face, -1.0)
        place = shaping.Place(
            lamp.kind is LightKind.DISK, lamp.centre, scaled(lamp.x, a), scaled(lamp.y, b), away
        )
    return shaping.mean(lamp.shaping, lamp.kind, place, (lamp.x, lamp.y, lamp.face), p, n)


def mirrored_tint(lamp: Lamp, p: Vec, n: Vec, wo: Vec, alpha: float) -> Vec:
    """And of the highlight."""
    if lamp.kind in (None, LightKind.DISTANT) or shaping.is_even(lamp.shaping):
        return shaping.WHITE
    near = _nearest(lamp, p, sub(scaled(n, 2.0 * dot(n, wo)), wo))
    half = (scaled(lamp.x, lamp.size[0]), scaled(lamp.y, lamp.size[1]))
    axes = (lamp.x, lamp.y, lamp.face)
    off = sub(near.to, sub(lamp.centre, p))
    return shaping.mirrored(lamp.shaping, half, axes, near.to, off, alpha, near.radius)


def distance_to(lamp: Lamp, p: Vec, d: Vec) -> float:
    """Where a ray meets the shape of a lamp that has a size, on the side that shines; inf where it does not."""
    if lamp.kind is None or lamp.size[0] == 0.0:
        return math.inf
    if lamp.kind is LightKind.DISTANT:
        return 1e29 if dot(d, lamp.face) < 0.0 and length(cross(d, lamp.face)) <= math.sin(lamp.size[0]) else math.inf
    if lamp.kind is LightKind.CYLINDER:
        near = _nearest_of_cylinder(lamp, p, d)
        return length(near.to) if near.inside else math.inf
    c = sub(lamp.centre, p)
    if lamp.kind is LightKind.SPHERE:
        return dot(c, d) if dot(c, d) > 0.0 and length(cross(c, d)) <= lamp.size[0] else math.inf
    slope = dot(d, lamp.face)
    if slope >= -1e-6 or dot(c, lamp.face) >= 0.0:
        return math.inf
    t = dot(c, lamp.face) / slope
    off = sub(scaled(d, t), c)
    a, b = dot(off, lamp.x), dot(off, lamp.y)
    on_it = abs(a) <= lamp.size[0] and abs(b) <= lamp.size[1]
    if lamp.kind is LightKind.DISK:
        on_it = math.hypot(a, b) <= lamp.size[0]
    return t if on_it else math.inf


def seen(lamp: Lamp, p: Vec, d: Vec) -> Vec:
    """The radiance that a ray from `p` meets there."""
    return scaled(mul(lamp.radiance, mirrored_tint(lamp, p, d, d, 0.0)), lamp.specular)


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
    if lamp.kind is LightKind.CYLINDER:
        return _of_cylinder(lamp, p, n)
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


def _of_cylinder(lamp: Lamp, p: Vec, n: Vec) -> float:
    radius, half = lamp.size
    ahead, rho, w = _beside(lamp, p)
    if radius == 0.0:  # a line: cos_receiver sine / d^2 along what is above the horizon, by hand
        up, lean = dot(w, n), dot(lamp.x, n)
        ends = [ahead - half, ahead + half]
        if abs(lean) > 0.0:
            horizon = -rho * up / lean
            ends = [max(ends[0], horizon), ends[1]] if lean > 0.0 else [ends[0], min(ends[1], horizon)]
        if ends[0] >= ends[1] or (lean == 0.0 and up <= 0.0):
            return 0.0

        def below(t: float) -> float:
            d2 = rho * rho + t * t
            return up * (t / d2 + math.atan(t / rho) / rho) / 2.0 - lean * rho / d2 / 2.0

        return max(0.0, below(ends[1]) - below(ends[0]))
    if rho <= radius:
        return 0.0
    side, widest = cross(lamp.x, w), math.acos(radius / rho)
    arc = []
    for k in range(_ARC_PIECES + 1):  # of the circle around the axis, from where it is touched to where it is again
        phi = widest * (2.0 * k / _ARC_PIECES - 1.0)
        arc.append(at(scaled(w, rho - radius * math.cos(phi)), side, radius * math.sin(phi)))
    one = [at(c, lamp.x, ahead + half) for c in arc]
    return _of_polygon(one + [at(c, lamp.x, ahead - half) for c in reversed(arc)], n)


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
    if lamp.kind is LightKind.CYLINDER:
        return _nearest_of_cylinder(lamp, p, r)
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


def _nearest_of_cylinder(lamp: Lamp, p: Vec, r: Vec) -> _Nearest:
    """From the axis' place nearest to the ray towards it (Karis 2013, tube lights)."""
    radius, half = lamp.size
    c = sub(lamp.centre, p)
    ahead, rho, w = _beside(lamp, p)
    if rho <= radius:
        return _Nearest(c, False, 0.0, 0.0)
    slope = dot(r, lamp.x)
    bend = max(1.0 - slope * slope, 1e-9)
    axis = at(c, lamp.x, clamp((dot(r, c) * slope - ahead) / bend, -half, half))
    off = sub(scaled(r, dot(axis, r)), axis)
    point = at(axis, off, min(1.0, radius / max(length(off), 1e-12)))
    middle = rho * dot(w, r)
    root = middle * middle - bend * (rho * rho - radius * radius)
    meets = root >= 0.0 and middle > 0.0 and abs((middle - math.sqrt(root)) / bend * slope - ahead) <= half
    d = math.hypot(rho, ahead)
    solid = 2.0 * half * rho / d**3 * (2.0 * radius or 1.0)
    return _Nearest(point, meets, solid, math.sqrt(solid / math.pi) if radius > 0.0 else 0.0)
