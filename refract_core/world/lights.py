"""Finite and distant lights for kernels: where a shadow ray goes, and what would arrive if nothing were in the way.

The unoccluded diffuse light of a shape is taken in closed form and multiplied by the visibility of one point of it, so
an unshadowed surface has no noise at all and only penumbras need samples. The highlight comes from the point of the
shape nearest to the mirror direction (Karis, "Real Shading in Unreal Engine 4", 2013, area lights), and from the shape
itself where the surface is a mirror.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.compile import inlined
from ..kernels.vec import add, cross, dot, frame, length, lerp, normalize, row, scale, sub
from ..optics.lobes import ggx, smith_visibility
from ..scene import LightKind, Scene

CAMERA_LIGHT = 4
"""Kind of the light that stands in where a stage has none: at the eye, without falloff or shadow."""
_DISK_SIDES = 12
_SMALLEST_POINT_LOBE = 0.02  # a light without size would be an infinitely bright dot on a mirror
_DISTANT, _SPHERE, _RECT, _DISK = (int(k) for k in LightKind)


class LightTable(NamedTuple):
    """One row per light."""

    kind: NDArray[np.int32]
    axes: NDArray[np.float64]
    """shape (L, 4, 3): unit x, unit y, unit direction it faces (its -Z), position [m]"""
    size: NDArray[np.float64]
    """shape (L, 2): Rect half width, half height [m]; Disk, Sphere radius [m]; Distant half angle [rad]"""
    radiance: NDArray[np.float64]
    """shape (L, 3); the limit quantity where size is 0 (see `scene.Light`)"""
    diffuse: NDArray[np.float64]
    specular: NDArray[np.float64]


def pack_lights(scene: Scene, eye: NDArray[np.float64]) -> LightTable:
    """Lights of a scene; with none at all, one at the eye that lights a white surface facing it to 1."""
    kinds = [int(light.kind) for light in scene.lights]
    frames: list[Any] = []
    for light in scene.lights:
        m = light.world_from_light
        frames.append([m[:3, 0], m[:3, 1], -m[:3, 2], m[:3, 3]])
    # Rect sizes are full widths and Distant sizes full angles in the scene; kernels want halves.
    half = {_RECT: 0.5, _DISTANT: 0.5}
    sizes = [tuple(s * half.get(int(light.kind), 1.0) for s in light.size) for light in scene.lights]
    radiance = [light.radiance for light in scene.lights]
    if scene.camera_light:
        kinds.append(CAMERA_LIGHT)
        frames.append([[1, 0, 0], [0, 1, 0], [0, 0, -1], eye])
        sizes.append((0.0, 0.0))
        radiance.append((math.pi, math.pi, math.pi))
    n = len(kinds)
    return LightTable(
        kind=np.array(kinds, np.int32),
        axes=np.array(frames, np.float64).reshape(n, 4, 3),
        size=np.array(sizes, np.float64).reshape(n, 2),
        radiance=np.array(radiance, np.float64).reshape(n, 3),
        diffuse=np.array([*(light.diffuse for light in scene.lights), 1.0], np.float64)[:n],
        specular=np.array([*(light.specular for light in scene.lights), 1.0], np.float64)[:n],
    )


@inlined
def shadow_ray(lights, l, p, u1, u2):  # type: ignore[no-untyped-def] # noqa: E741
    """(direction, distance) from `p` to one point of light `l`; distance is along the unit direction."""
    kind = lights.kind[l]
    axes = lights.axes[l]
    x, y, face, centre = row(axes, 0), row(axes, 1), row(axes, 2), row(axes, 3)
    s0, s1 = lights.size[l, 0], lights.size[l, 1]
    if kind == _DISTANT:
        to = scale(face, -1.0)
        if s0 > 0.0:
            r = math.sin(s0) * math.sqrt(u1)
            phi = 2.0 * math.pi * u2
            to = normalize(add(to, add(scale(x, r * math.cos(phi)), scale(y, r * math.sin(phi)))))
        return to, math.inf
    target = centre
    if kind == _RECT:
        target = add(centre, add(scale(x, (2.0 * u1 - 1.0) * s0), scale(y, (2.0 * u2 - 1.0) * s1)))
    elif s0 > 0.0 and (kind in (_DISK, _SPHERE)):
        if kind == _SPHERE:  # the disk the sphere shows to p
            x, y = frame(normalize(sub(p, centre)))
        r = s0 * math.sqrt(u1)
        phi = 2.0 * math.pi * u2
        target = add(centre, add(scale(x, r * math.cos(phi)), scale(y, r * math.sin(phi))))
    d = sub(target, p)
    distance = length(d)
    return scale(d, 1.0 / max(distance, 1e-12)), distance


@inlined
def _angle_over_sine(x):  # type: ignore[no-untyped-def]
    """acos(x) / sqrt(1 - x * x) for x in 0 .. 1, where it is 1 at the end, to 1e-7 of it: a Chebyshev fit, in an order
    without a long chain. A call of acos takes longer than all the rest of an edge."""
    x2 = x * x
    low = (1.5707962222 - 0.99998225999 * x) + (0.78489625578 - 0.66108945254 * x) * x2
    high = (0.55702205608 - 0.4245661869 * x) + (0.25323847676 - 0.097968704053 * x) * x2
    return low + (high + 0.017653667906 * (x2 * x2)) * (x2 * x2)


@inlined
def _polygon_edge(a, b, n):  # type: ignore[no-untyped-def]
    """One edge of Lambert's formula for two unit directions and the receiver's normal."""
    cosine = min(1.0, max(-1.0, dot(a, b)))
    axis = cross(a, b)
    across = dot(axis, n)
    angle = _angle_over_sine(abs(cosine))
    if cosine >= 0.0:
        return angle * across
    sine = length(axis)
    return (math.pi / sine - angle) * across if sine > 1e-9 else 0.0


@inlined
def _corner(c, x, y, k, sides):  # type: ignore[no-untyped-def]
    """Corner `k` of the parallelogram with half axes x, y, or of the regular polygon with the area of their ellipse."""
    if sides == 4:
        sx = 1.0 if k % 4 == 1 or k % 4 == 2 else -1.0
        sy = 1.0 if k % 4 == 2 or k % 4 == 3 else -1.0
        return add(add(c, scale(x, sx)), scale(y, sy))
    step = 2.0 * math.pi / sides
    grow = math.sqrt(step / math.sin(step))
    return add(add(c, scale(x, grow * math.cos(step * k))), scale(y, grow * math.sin(step * k)))


@inlined
def _polygon_irradiance(p, n, centre, x, y, sides):  # type: ignore[no-untyped-def]
    """Irradiance per radiance of a flat light, clipped at the receiver's horizon
    (Lambert 1760; Baum, Rushmeier and Winget 1989)."""
    c = sub(centre, p)
    total = 0.0
    leaving = entering = c
    cut = False
    a = normalize(_corner(c, x, y, 0, sides))
    for k in range(sides):
        b = normalize(_corner(c, x, y, k + 1, sides))
        ha, hb = dot(a, n), dot(b, n)
        start, end = a, b
        if (ha > 0.0) != (hb > 0.0):
            crossing = normalize(lerp(a, b, ha / (ha - hb)))
            cut = True
            if ha > 0.0:
                end = leaving = crossing
            else:
                start = entering = crossing
        if ha > 0.0 or hb > 0.0:
            total += _polygon_edge(start, end, n)
        a = b
    if cut:
        total += _polygon_edge(leaving, entering, n)
    return abs(total) * 0.5


@inlined
def _sphere_irradiance(p, n, centre, radius):  # type: ignore[no-untyped-def]
    """Irradiance per radiance of a sphere, horizon included (Snyder 1996; Lagarde and de Rousiers 2014, listing 7)."""
    c = sub(centre, p)
    d2 = dot(c, c)
    if d2 <= radius * radius:
        return math.pi
    cos_t = dot(c, n) / math.sqrt(d2)
    h2 = d2 / (radius * radius)
    if cos_t * cos_t * h2 > 1.0:
        return math.pi * max(cos_t, 0.0) / h2
    sin_t = math.sqrt(max(1e-12, 1.0 - cos_t * cos_t))
    a = math.sqrt(h2 - 1.0)
    b = -a * cos_t / sin_t
    b = min(1.0, max(-1.0, b))
    side = math.sqrt(1.0 - b * b)
    return max(0.0, (cos_t * math.acos(b) - a * sin_t * side) / h2 + math.atan(sin_t * side / a))


@inlined
def irradiance_factor(lights, l, p, n):  # type: ignore[no-untyped-def] # noqa: E741
    """Unoccluded irradiance at `p` on a surface with normal `n`, per radiance of light `l` [sr]."""
    kind = lights.kind[l]
    axes = lights.axes[l]
    face, centre = row(axes, 2), row(axes, 3)
    s0 = lights.size[l, 0]
    if kind == _DISTANT:
        cosine = max(0.0, -dot(face, n))
        return cosine * (math.pi * math.sin(s0) ** 2 if s0 > 0.0 else 1.0)
    to = sub(centre, p)
    d2 = max(dot(to, to), 1e-12)
    cosine = max(0.0, dot(to, n)) / math.sqrt(d2)
    if kind == CAMERA_LIGHT:
        return cosine
    if kind == _SPHERE:
        return _sphere_irradiance(p, n, centre, s0) if s0 > 0.0 else cosine / d2
    if dot(to, face) >= 0.0:
        return 0.0  # behind a one-sided light
    if s0 > 0.0:
        sides = 4 if kind == _RECT else _DISK_SIDES
        s1 = lights.size[l, 1] if kind == _RECT else s0
        return _polygon_irradiance(p, n, centre, scale(row(axes, 0), s0), scale(row(axes, 1), s1), sides)
    return cosine * -dot(to, face) / math.sqrt(d2) / d2


@inlined
def _nearest_to_mirror(lights, l, p, r):  # type: ignore[no-untyped-def] # noqa: E741
    """(vector to the light's point nearest to ray (p, r), mirror ray hits the light, its projected solid angle,
    its angular radius)."""
    kind = lights.kind[l]
    axes = lights.axes[l]
    x, y, face, centre = row(axes, 0), row(axes, 1), row(axes, 2), row(axes, 3)
    s0, s1 = lights.size[l, 0], lights.size[l, 1]
    if kind == _DISTANT:
        to = scale(face, -1.0)
        off = sub(r, scale(to, dot(r, to)))
        away = length(off)
        inside = dot(r, to) > 0.0 and away <= math.sin(s0)
        point = r if inside else add(to, scale(off, math.tan(s0) / max(away, 1e-12)))
        return point, inside, math.pi * math.sin(s0) ** 2 if s0 > 0.0 else 1.0, s0
    c = sub(centre, p)
    d2 = max(dot(c, c), 1e-12)
    if kind == _SPHERE:
        off = sub(scale(r, dot(c, r)), c)
        away = length(off)
        inside = away <= s0 and dot(c, r) > 0.0
        point = add(c, scale(off, min(1.0, s0 / max(away, 1e-12))))
        return point, inside, math.pi * s0 * s0 / d2 if s0 > 0.0 else 1.0 / d2, s0 / math.sqrt(d2)
    if kind == CAMERA_LIGHT:
        return c, False, 1.0, 0.0
    facing = -dot(c, face)
    if facing <= 0.0:
        return c, False, 0.0, 0.0
    hit = c
    toward = -dot(r, face)
    if toward > 1e-6:
        hit = scale(r, facing / toward)
    off = sub(hit, c)
    a, b = dot(off, x), dot(off, y)
    if kind == _RECT:
        inside = toward > 1e-6 and abs(a) <= s0 and abs(b) <= s1
        a, b = min(s0, max(-s0, a)), min(s1, max(-s1, b))
        area = 4.0 * s0 * s1
    else:
        away = math.sqrt(a * a + b * b)
        inside = toward > 1e-6 and away <= s0
        shrink = min(1.0, s0 / max(away, 1e-12))
        a, b = a * shrink, b * shrink
        area = math.pi * s0 * s0
    point = add(c, add(scale(x, a), scale(y, b)))
    solid = facing / math.sqrt(d2) / d2 * (area if area > 0.0 else 1.0)
    return point, inside, solid, math.sqrt(area / math.pi / d2)


@inlined
def highlight(lights, l, p, n, wo, alpha):  # type: ignore[no-untyped-def] # noqa: E741
    """Reflected radiance per radiance of light `l`, without Fresnel and shadow, for a GGX surface of width alpha."""
    n_dot_v = dot(n, wo)
    if n_dot_v <= 0.0:
        return 0.0
    r = sub(scale(n, 2.0 * n_dot_v), wo)
    point, inside, solid, radius = _nearest_to_mirror(lights, l, p, r)
    if solid <= 0.0:
        return 0.0
    # Sharp surfaces show the light's own shape, rough ones its blur; in between both, so that there is no step.
    sharp = 1.0 - min(1.0, max(0.0, (alpha - 0.005) / 0.045)) if radius > 0.0 else 0.0
    value = sharp if inside else 0.0
    if sharp < 1.0:
        a = max(alpha, _SMALLEST_POINT_LOBE if radius == 0.0 else 0.002)
        wi = normalize(point)
        n_dot_l = dot(n, wi)
        if n_dot_l > 0.0:
            h = normalize(add(wi, wo))
            wide = min(1.0, a + 0.5 * radius)
            lobe = ggx(dot(n, h), a) * (a / wide) ** 2 * smith_visibility(n_dot_v, n_dot_l, a)
            value += (1.0 - sharp) * lobe * n_dot_l * solid
    return value
