"""Finite and distant lights for kernels: where a shadow ray goes, and what would arrive if nothing were in the way.

The unoccluded diffuse light of a shape is taken in closed form and multiplied by the visibility of one point of it, so
an unshadowed surface has no noise at all and only penumbras need samples. The highlight comes from the point of the
shape nearest to the mirror direction (Karis, "Real Shading in Unreal Engine 4", 2013, area lights), and from the shape
itself where the surface is a mirror.

Every kind of light is one row of `KINDS`: three functions of a `Lamp`. What a light leaves out by direction or place
(UsdLux ShapingAPI, a picture on a rectangle) is `world.shaping`; here it is even. Directions are unit vectors unless
they are said to be more, lengths metres, all in engine world. Nothing here raises.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from ..kernels.arrays import F32_1D, F64_1D, F64_2D, F64_3D, I32_1D, I64_2D, U8_1D, U8_2D
from ..kernels.choice import choice
from ..kernels.compile import inlined, leaf
from ..kernels.vec import Vec, add, along, cross, dot, frame, length, lerp, normalize, row, scale, sub, towards
from ..optics.lobes import ggx, sample_cosine, smith_visibility, specular_albedo
from ..scene import LightKind
from .glow import GlowTree, glow_highlight, glow_irradiance, glow_target
from .polygon import polygon_edge, polygon_irradiance

_DISK_SIDES = 12
"""A disk's irradiance is that of the regular polygon with as many sides and the disk's area."""
_ARC_SIDES = 8
"""Straight pieces that the seen half of a cylinder's end is made of."""
_SMALLEST_POINT_LOBE = 0.02
"""GGX width [alpha] below which a light without size is not sharpened: it would be an infinitely bright dot."""
_BEYOND = 1e30
"""[m] how far away distant lights are."""
_LEAST = 1e-30
"""Weight of a point of a light that brings nothing: alone, it still says whether the light is hidden."""
_NEAREST2 = 1e-12
"""[m^2] squared distance that a light counts as having at least, so that nothing is divided by 0."""
_INSET = 0.03
"""Part of a light's width by which the points of its rim lie within: the light may fill a hole to its edge."""
_POINTS, _STEP = 16, 7
"""Of a light, among which a single shadow ray picks one; and by how many sixteenths of its height each is higher."""
_FAR2 = 64.0
"""Square of how many times its own size a light is away, from where on all of its points bring as much."""


# --- the table ------------------------------------------------------------------------------------------------------


class ShapeTable(NamedTuple):
    """One row per light: what it leaves out of its radiance (`scene.Shaping`)."""

    focus: F64_1D
    """shape (L,): power"""
    tint: F64_2D
    """shape (L, 3): what focus leaves where it leaves least"""
    cone: F64_2D
    """shape (L, 2): angles to its axis where it begins to fade, and where it is dark [rad]; pi without a cone"""
    profile: I64_2D
    """shape (L, 3): first value in the pool, rows, columns; no rows without one"""
    picture: I64_2D
    """shape (L, 2): first texel in the pool, in threes, and the finest level; -1 without one"""
    pool: F32_1D
    """profiles, and pictures from their mean on: level j has 2^j by 2^j texels"""


class LightTable(NamedTuple):
    """One row per light."""

    kind: I32_1D
    """shape (L,), as `scene.LightKind`"""
    axes: F64_3D
    """shape (L, 4, 3): unit x, unit y, unit direction it faces (its -Z), position [m]"""
    size: F64_2D
    """shape (L, 2): Rect half width, half height [m]; Disk, Sphere radius [m]; Distant half angle [rad];
    Cylinder radius, half length [m]"""
    radiance: F64_2D
    """shape (L, 3); the limit quantity where size is 0 (see `scene.Light`)"""
    diffuse: F64_1D
    """shape (L,): factor of what it brings to diffuse reflection"""
    specular: F64_1D
    """shape (L,): factor of its highlights"""
    casts_shadow: U8_1D
    """shape (L,)"""
    even: U8_1D
    """shape (L,): 1 where its radiance is the same all over it and in all directions"""
    shapes: ShapeTable
    """where it is not"""
    hidden: F64_2D
    """shape (L, 3): share of it that arrives where something stands before it"""
    reach: F64_2D
    """shape (L, 3): how near what stands before it must be [m], over which part of that shadows fade [m], and by which
    power"""
    caster_shift: I32_1D
    """shape (L,): bits from the masks of what casts shadows to the masks of what casts its shadows (`embree`)"""
    link: I32_1D
    """shape (L,): row of `linked`; -1 where it lights everything"""
    linked: U8_2D
    """shape (R, things): 1 where it lights a thing"""
    root: I32_1D
    """shape (L,): the node of `glow` that it is all of; -1 of every other kind"""
    glow: GlowTree


class Lamp(NamedTuple):
    """One light as a kernel holds it."""

    x: Vec
    y: Vec
    face: Vec
    """where it shines"""
    centre: Vec
    """[m]"""
    a: float
    """first of `LightTable.size`"""
    b: float
    """second of `LightTable.size`"""


@leaf
def lamp_of(lights: LightTable, which: int) -> Lamp:
    axes = lights.axes[which]
    x, y, face, centre = row(axes, 0), row(axes, 1), row(axes, 2), row(axes, 3)
    return Lamp(x, y, face, centre, lights.size[which, 0], lights.size[which, 1])


# --- what kernels ask -----------------------------------------------------------------------------------------------


@inlined
def shadow_ray(lights: LightTable, which: int, p: Vec, n: Vec, u1: float, u2: float) -> tuple[Vec, float, float]:
    """(direction, distance, weight) from `p` to one point of a light; distance is along the unit direction [m].

    Points are spread evenly over the light's area as `p` sees it (of a sphere: over the disk it shows), those of what
    glows by what they bring to a surface with normal `n`, about. They weigh what they bring to it, so that the share of
    a light that is hidden is that of its irradiance: of a lamp that is near, or low, one half is not worth the other.
    `u1`, `u2`: 0 .. 1.
    """
    if lights.kind[which] == LightKind.GLOW.value:
        point, worth = glow_target(lights.glow, lights.root[which], p, n, u1, u2)
        direction, distance = towards(p, point)
        return direction, distance, worth * max(0.0, dot(direction, n))
    lamp = lamp_of(lights, which)
    direction, distance = target_on(lights.kind[which], lamp, p, n, u1, u2)
    worth = facing_to(lights.kind[which], lamp, p, direction) * dot(direction, n)
    if lights.kind[which] != LightKind.DISTANT.value:
        worth /= max(distance * distance, _NEAREST2)
    return direction, distance, max(_LEAST, worth)


@inlined
def has_rim(lights: LightTable, which: int) -> bool:
    """It may be seen in part."""
    return lights.kind[which] == LightKind.GLOW.value or max(lights.size[which, 0], lights.size[which, 1]) > 0.0


@inlined
def rim_ray(lights: LightTable, which: int, p: Vec, n: Vec, k: int, turn: int) -> tuple[Vec, float, float]:
    """As `shadow_ray`, to the `k`-th of eight points which tell whether a light is seen in part: most along its rim, a
    little within, where the last of a light lies that sinks behind an edge; some in its middle, which may be seen
    between two edges. `turn`: 0 or 1, two such sets whose points lie between each other's."""
    kind = lights.kind[which]
    if kind == LightKind.GLOW.value:  # all over it
        u1, u2 = (k + 0.5) / 8.0, ((k * _STEP + 4 * turn) / 8.0) % 1.0
    elif kind == LightKind.RECT.value or kind == LightKind.CYLINDER.value:
        # Four corners, in which whatever hides a rectangle from one side ends; four that no row or column has twice.
        right, up = k % 2, k // 2 % 2
        if k < 4:
            u1, u2 = (1.0 - _INSET if right else _INSET), (1.0 - _INSET if up else _INSET)
        elif turn == 0:
            u1, u2 = (0.5, 0.25 + 0.5 * up) if right else (0.25 + 0.5 * up, 0.5)
        else:
            u1, u2 = 0.125 + (0.25 if up else 0.0) + 0.5 * right, 0.375 - (0.25 if right else 0.0) + 0.5 * up
    else:
        angle = (k + 0.5 * turn) / 6.0 if k < 6 else 0.5 * k + 0.25 * turn
        u1, u2 = (1.0 - 2.0 * _INSET if k < 6 else 0.25), angle % 1.0
    return shadow_ray(lights, which, p, n, u1, u2)


@inlined
def picked_shadow_ray(
    lights: LightTable, which: int, p: Vec, n: Vec, u1: float, u2: float, pick: float
) -> tuple[Vec, float, float]:
    """As `shadow_ray`, where no other ray is sent that it could be weighed against: of a few points one is picked by
    what each would bring (Talbot et al. 2005, "Importance resampling for global illumination"). A light that is far
    brings as much from every point, and is not looked at twice.

    `pick`: 0 .. 1.
    """
    a, b = lights.size[which, 0], lights.size[which, 1]
    to = sub(row(lights.axes[which], 3), p)
    kind = lights.kind[which]
    far = kind == LightKind.DISTANT.value or dot(to, to) > _FAR2 * (a * a + b * b)
    if far or kind == LightKind.GLOW.value or a <= 0.0:
        return shadow_ray(lights, which, p, n, u1, u2)
    direction, distance, weight, total = (0.0, 0.0, 0.0), 0.0, 0.0, 0.0
    for k in range(_POINTS):
        # A lattice (Korobov), moved by the one point that is asked for.
        one = shadow_ray(lights, which, p, n, (u1 + k / _POINTS) % 1.0, (u2 + k * _STEP / _POINTS) % 1.0)
        total += one[2]
        chance = one[2] / total
        if pick < chance:
            direction, distance, weight = one
            pick /= chance
        else:
            pick = (pick - chance) / (1.0 - chance)
    return direction, distance, weight


@inlined
def is_flat(lights: LightTable, which: int) -> bool:
    """It shines from a piece of a plane, to one side."""
    flat = lights.kind[which] == LightKind.RECT.value or lights.kind[which] == LightKind.DISK.value
    return flat and lights.size[which, 0] > 0.0


@inlined
def drawn_ray(lights: LightTable, which: int, p: Vec, n: Vec, u1: float, u2: float) -> tuple[Vec, float, float]:
    """As `shadow_ray`, but in the place of the weight the irradiance per radiance [sr] as that one point tells it, of
    which the mean is right: what comes from a flat light, or from what glows, is far from even where it is near. Other
    lights are taken to bring as much from all of theirs."""
    direction, distance, worth = shadow_ray(lights, which, p, n, u1, u2)
    if lights.kind[which] == LightKind.GLOW.value:
        return direction, distance, worth
    if not is_flat(lights, which):
        return direction, distance, irradiance_factor(lights, which, p, n)
    a, b = lights.size[which, 0], lights.size[which, 1]
    area = 4.0 * a * b if lights.kind[which] == LightKind.RECT.value else math.pi * a * a
    facing = max(0.0, -dot(direction, row(lights.axes[which], 2)))
    return direction, distance, area * facing * max(0.0, dot(direction, n)) / (distance * distance)


@inlined
def irradiance_factor(lights: LightTable, which: int, p: Vec, n: Vec) -> float:
    """Unoccluded irradiance at `p` on a surface with normal `n`, per radiance of a light [sr]: the integral of the
    cosine over the directions that the light fills, horizon included. Without size, the limit's own unit."""
    if lights.kind[which] == LightKind.GLOW.value:
        return glow_irradiance(lights.glow, lights.root[which], p, n)
    return _irradiance(lights.kind[which], lamp_of(lights, which), p, n)


@inlined
def any_glows(lights: LightTable) -> bool:
    """Surfaces that glow are among the lights."""
    for l in range(lights.kind.shape[0]):  # noqa: E741
        if lights.kind[l] == LightKind.GLOW.value or lights.kind[l] == LightKind.BALL.value:
            return True
    return False


@inlined
def highlight(lights: LightTable, which: int, p: Vec, n: Vec, wo: Vec, alpha: float, mirrors: bool) -> float:
    """Reflected radiance per radiance of a light, without Fresnel and shadow, for a GGX surface of width alpha. What
    glows has none on a surface that `mirrors` it: there it is seen itself.

    A mirror shows the light's own shape: 1 where the mirrored ray hits it, else 0. A rough surface sees it as one
    direction, that of the light's point nearest to the mirrored ray, with a lobe widened by half the light's angular
    radius and dimmed to the same energy (Karis 2013, "representative point"), times the solid angle it stands for.
    """
    n_dot_v = dot(n, wo)
    if n_dot_v <= 0.0:
        return 0.0
    r = sub(scale(n, 2.0 * n_dot_v), wo)
    kind = lights.kind[which]
    if kind == LightKind.GLOW.value or kind == LightKind.BALL.value:
        if mirrors:
            return 0.0
        if kind == LightKind.GLOW.value:
            return glow_highlight(lights.glow, lights.root[which], p, n, wo, alpha)
        c = sub(row(lights.axes[which], 3), p)
        if dot(c, c) <= lights.size[which, 0] * lights.size[which, 0]:  # inside it everything shines
            return specular_albedo((1.0, 1.0, 1.0), math.sqrt(alpha), n_dot_v)[0]
        kind = LightKind.SPHERE.value
    point, inside, solid, radius = nearest_to(kind, lamp_of(lights, which), p, r)
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


@inlined
def lamp_ahead(lights: LightTable, which: int, p: Vec, d: Vec) -> float:
    """How far away a ray from `p` along unit `d` meets a light's own shape, from the side that it shines to [m]; inf
    where it does not, or the light has no size. A round one stands where the ray is nearest to its middle."""
    if lights.size[which, 0] <= 0.0:
        return math.inf
    point, inside, solid, _ = nearest_to(lights.kind[which], lamp_of(lights, which), p, d)
    if not inside or solid <= 0.0:
        return math.inf
    return _BEYOND if lights.kind[which] == LightKind.DISTANT.value else length(point)


# --- shadow targets -------------------------------------------------------------------------------------------------


@inlined
def _on_disk(centre: Vec, x: Vec, y: Vec, radius: float, u1: float, u2: float) -> Vec:
    """A point spread evenly over a disk's area, for which its distance from the middle grows as a square root."""
    r = radius * math.sqrt(u1)
    phi = 2.0 * math.pi * u2
    return add(centre, add(scale(x, r * math.cos(phi)), scale(y, r * math.sin(phi))))


@inlined
def _distant_target(lamp: Lamp, p: Vec, n: Vec, u1: float, u2: float) -> tuple[Vec, float]:
    """Within the cone of half angle `a`; no point of it is any nearer than another."""
    to = scale(lamp.face, -1.0)
    if lamp.a > 0.0:
        r = math.sin(lamp.a) * math.sqrt(u1)
        phi = 2.0 * math.pi * u2
        to = normalize(add(to, add(scale(lamp.x, r * math.cos(phi)), scale(lamp.y, r * math.sin(phi)))))
    return to, math.inf


@inlined
def _sphere_target(lamp: Lamp, p: Vec, n: Vec, u1: float, u2: float) -> tuple[Vec, float]:
    """On the disk that it shows to `p`, which rays from there touch it around."""
    target = lamp.centre
    if lamp.a > 0.0:
        w, distance = towards(lamp.centre, p)
        x, y = frame(w)
        nearer, share = _touched(lamp.a, distance)
        target = _on_disk(along(lamp.centre, w, nearer), x, y, lamp.a * share, u1, u2)
    return towards(p, target)


@inlined
def _touched(radius: float, distance: float) -> tuple[float, float]:
    """Where rays from a place touch a ball or a tube: how much nearer than its middle that is [m], and the share of the
    radius that is left there. Of a place inside, the middle and all of it."""
    sine = radius / max(distance, 1e-12)
    return (radius * sine, math.sqrt(1.0 - sine * sine)) if sine < 1.0 else (0.0, 1.0)


@inlined
def _rect_target(lamp: Lamp, p: Vec, n: Vec, u1: float, u2: float) -> tuple[Vec, float]:
    across = add(scale(lamp.x, (2.0 * u1 - 1.0) * lamp.a), scale(lamp.y, (2.0 * u2 - 1.0) * lamp.b))
    return towards(p, add(lamp.centre, across))


@inlined
def _disk_target(lamp: Lamp, p: Vec, n: Vec, u1: float, u2: float) -> tuple[Vec, float]:
    target = lamp.centre
    if lamp.a > 0.0:
        target = _on_disk(lamp.centre, lamp.x, lamp.y, lamp.a, u1, u2)
    return towards(p, target)


@inlined
def across(lamp: Lamp, p: Vec) -> tuple[float, float, Vec]:
    """How far the middle of a cylinder is from `p` along its axis [m], how far the axis is across [m], and the unit
    vector that way."""
    to = sub(lamp.centre, p)
    ahead = dot(to, lamp.x)
    off = sub(to, scale(lamp.x, ahead))
    rho = max(length(off), 1e-9)
    return ahead, rho, scale(off, 1.0 / rho)


@inlined
def _cylinder_target(lamp: Lamp, p: Vec, n: Vec, u1: float, u2: float) -> tuple[Vec, float]:
    """On the rectangle that it shows to `p`, between the lines where rays from there touch it."""
    _, rho, w = across(lamp, p)
    side = cross(lamp.x, w)
    nearer, share = _touched(lamp.a, rho)
    off = add(scale(lamp.x, (2.0 * u1 - 1.0) * lamp.b), scale(side, (2.0 * u2 - 1.0) * lamp.a * share))
    off = sub(off, scale(w, nearer))
    return towards(p, add(lamp.centre, off))


@inlined
def _ball_target(lamp: Lamp, p: Vec, n: Vec, u1: float, u2: float) -> tuple[Vec, float]:
    """On the face of a sphere that is there itself: where a ray to the disk that it shows meets it. From within, where
    all shines, by the cosine."""
    c = sub(lamp.centre, p)
    beyond = dot(c, c) - lamp.a * lamp.a
    d = _sphere_target(lamp, p, n, u1, u2)[0] if beyond > 0.0 else sample_cosine(n, u1, u2)
    ahead = dot(c, d)
    root = math.sqrt(max(0.0, ahead * ahead - beyond))
    return d, ahead - root if beyond > 0.0 else ahead + root


@inlined
def _camera_target(lamp: Lamp, p: Vec, n: Vec, u1: float, u2: float) -> tuple[Vec, float]:
    return towards(p, lamp.centre)


# --- how much of a piece of a light faces a place --------------------------------------------------------------------


@inlined
def _flat_facing(lamp: Lamp, p: Vec, d: Vec) -> float:
    return -dot(d, lamp.face) if lamp.a > 0.0 else 1.0


@inlined
def _sphere_facing(lamp: Lamp, p: Vec, d: Vec) -> float:
    """Of the disk that it shows."""
    return dot(d, normalize(sub(lamp.centre, p)))


@inlined
def _ball_facing(lamp: Lamp, p: Vec, d: Vec) -> float:
    """The same, seen from as far as its face is, which is nearer than the disk."""
    w, distance = towards(p, lamp.centre)
    cosine = dot(d, w)
    beyond = distance * distance - lamp.a * lamp.a
    if beyond <= 0.0:
        return cosine
    ahead = distance * cosine
    face = ahead - math.sqrt(max(0.0, ahead * ahead - beyond))
    disk = beyond / max(distance * cosine, 1e-12)
    return cosine * (face / disk) ** 2


@inlined
def _cylinder_facing(lamp: Lamp, p: Vec, d: Vec) -> float:
    """Of the rectangle that it shows."""
    _, _, w = across(lamp, p)
    return dot(d, w)


@inlined
def _all_facing(lamp: Lamp, p: Vec, d: Vec) -> float:
    return 1.0


# --- irradiance -----------------------------------------------------------------------------------------------------


@inlined
def _place(lamp: Lamp, p: Vec, n: Vec) -> tuple[Vec, float, float]:
    """Vector to the middle [m], its square [m^2], and the receiver's cosine to it, 0 below the horizon."""
    to = sub(lamp.centre, p)
    d2 = max(dot(to, to), _NEAREST2)
    return to, d2, max(0.0, dot(to, n)) / math.sqrt(d2)


@inlined
def _distant_irradiance(lamp: Lamp, p: Vec, n: Vec) -> float:
    """A cone of half angle a has the projected solid angle pi sin^2 a cos t. At the horizon it is not clipped: of the
    sun that half is a quarter of a degree."""
    cosine = max(0.0, -dot(lamp.face, n))
    return cosine * (math.pi * math.sin(lamp.a) ** 2 if lamp.a > 0.0 else 1.0)


@inlined
def _sphere_irradiance(lamp: Lamp, p: Vec, n: Vec) -> float:
    """Horizon included (Snyder 1996; Lagarde and de Rousiers 2014, listing 7). Of a point, intensity over distance
    squared."""
    c, d2, cosine = _place(lamp, p, n)
    if lamp.a <= 0.0:
        return cosine / d2
    return _ball_irradiance(c, n, lamp.a)


@inlined
def _ball_irradiance(c: Vec, n: Vec, radius: float) -> float:
    """Irradiance per radiance of a ball whose middle is `c` away [m]."""
    d2 = dot(c, c)
    if d2 <= radius * radius:  # inside it everything shines
        return math.pi
    cos_t = dot(c, n) / math.sqrt(d2)
    h2 = d2 / (radius * radius)
    if cos_t * cos_t * h2 > 1.0:  # the horizon does not cut it: the whole disk that it shows, or nothing of it
        return math.pi * max(cos_t, 0.0) / h2
    sin_t = math.sqrt(max(1e-12, 1.0 - cos_t * cos_t))
    a = math.sqrt(h2 - 1.0)
    b = -a * cos_t / sin_t
    b = min(1.0, max(-1.0, b))
    side = math.sqrt(1.0 - b * b)
    return max(0.0, (cos_t * math.acos(b) - a * sin_t * side) / h2 + math.atan(sin_t * side / a))


@inlined
def _rect_irradiance(lamp: Lamp, p: Vec, n: Vec) -> float:
    return _flat_irradiance(lamp, p, n, lamp.b, 4)


@inlined
def _disk_irradiance(lamp: Lamp, p: Vec, n: Vec) -> float:
    return _flat_irradiance(lamp, p, n, lamp.a, _DISK_SIDES)


@inlined
def _flat_irradiance(lamp: Lamp, p: Vec, n: Vec, half_height: float, sides: int) -> float:
    """A flat light shines to one side. Without size it is a point whose intensity falls with its own cosine."""
    to, d2, cosine = _place(lamp, p, n)
    if dot(to, lamp.face) >= 0.0:  # behind it
        return 0.0
    if lamp.a > 0.0:
        c = sub(lamp.centre, p)
        return polygon_irradiance(c, n, scale(lamp.x, lamp.a), scale(lamp.y, half_height), sides)
    return cosine * -dot(to, lamp.face) / math.sqrt(d2) / d2


@inlined
def _cylinder_irradiance(lamp: Lamp, p: Vec, n: Vec) -> float:
    """Of the half of it that faces `p`, by Lambert's formula around its outline: both lines where it bends away, and
    between them the near halves of both ends. Its ends are dark, and so is its inside."""
    ahead, rho, w = across(lamp, p)
    if lamp.a <= 0.0:
        return _line_irradiance(ahead, rho, lamp.b, dot(lamp.x, n), dot(w, n))
    if rho <= lamp.a:
        return 0.0
    side = cross(lamp.x, w)
    widest = math.acos(lamp.a / rho)
    total = 0.0
    first = leaving = (0.0, 0.0, 0.0)
    entered = left = False
    a = _tube_corner(lamp, ahead, rho, w, side, widest, 0)
    for k in range(2 * _ARC_SIDES + 2):
        b = _tube_corner(lamp, ahead, rho, w, side, widest, (k + 1) % (2 * _ARC_SIDES + 2))
        ha, hb = dot(a, n), dot(b, n)
        start, end = a, b
        if (ha > 0.0) != (hb > 0.0):  # unlike a flat light's, its outline may cross the horizon more than twice
            crossing = normalize(lerp(a, b, ha / (ha - hb)))
            if ha > 0.0:
                end = leaving = crossing
                left = True
            else:
                start = crossing
                if left:
                    total += polygon_edge(leaving, crossing, n)
                else:
                    first, entered = crossing, True
                left = False
        if ha > 0.0 or hb > 0.0:
            total += polygon_edge(start, end, n)
        a = b
    if left and entered:
        total += polygon_edge(leaving, first, n)
    return abs(total) * 0.5


@inlined
def _tube_corner(lamp: Lamp, ahead: float, rho: float, w: Vec, side: Vec, widest: float, k: int) -> Vec:
    """Unit direction to corner `k` of a cylinder's outline: over the near half of one end, and back over the other."""
    near = k <= _ARC_SIDES
    i = k if near else 2 * _ARC_SIDES + 1 - k
    phi = widest * (2.0 * i / _ARC_SIDES - 1.0)
    place = add(scale(w, rho - lamp.a * math.cos(phi)), scale(side, lamp.a * math.sin(phi)))
    return normalize(add(place, scale(lamp.x, ahead + (lamp.b if near else -lamp.b))))


@inlined
def _line_irradiance(ahead: float, rho: float, half: float, along: float, facing: float) -> float:
    """Of a line, per radiance times width: the integral of rho (rho facing + t along) / (rho^2 + t^2)^2 over what of it
    is above the horizon. `along`, `facing`: the normal's cosines to the line, and to the way to it."""
    low, high = ahead - half, ahead + half
    if along > 0.0:
        low = max(low, -rho * facing / along)
    elif along < 0.0:
        high = min(high, -rho * facing / along)
    elif facing <= 0.0:
        return 0.0
    if low >= high:
        return 0.0
    fallen = 0.5 / (rho * rho + low * low) - 0.5 / (rho * rho + high * high)
    turned = 0.5 * (high / (rho * rho + high * high) - low / (rho * rho + low * low))
    turned += 0.5 * (math.atan(high / rho) - math.atan(low / rho)) / rho
    return max(0.0, facing * turned + along * rho * fallen)


@inlined
def _camera_irradiance(lamp: Lamp, p: Vec, n: Vec) -> float:
    """As if it were equally near to everything: the picture of a stage without lights has no bright middle."""
    _, _, cosine = _place(lamp, p, n)
    return cosine


# --- the point of a light for its highlight -------------------------------------------------------------------------


Nearest = tuple[Vec, bool, float, float]
"""Vector to the light's point nearest to the mirrored ray [m] (of a distant light, a direction), whether that ray hits
the light, the solid angle the light fills [sr] (of a flat one, with its own cosine; without size, 1 over what its
limit is divided by), and its angular radius [rad], about."""


@inlined
def _distant_nearest(lamp: Lamp, p: Vec, r: Vec) -> Nearest:
    to = scale(lamp.face, -1.0)
    off = sub(r, scale(to, dot(r, to)))
    away = length(off)
    inside = dot(r, to) > 0.0 and away <= math.sin(lamp.a)
    point = r if inside else add(to, scale(off, math.tan(lamp.a) / max(away, 1e-12)))
    return point, inside, math.pi * math.sin(lamp.a) ** 2 if lamp.a > 0.0 else 1.0, lamp.a


@inlined
def _sphere_nearest(lamp: Lamp, p: Vec, r: Vec) -> Nearest:
    """From its middle towards the ray, as far as the ray or the sphere reaches (Karis 2013)."""
    c = sub(lamp.centre, p)
    d2 = max(dot(c, c), _NEAREST2)
    off = sub(scale(r, dot(c, r)), c)
    away = length(off)
    inside = away <= lamp.a and dot(c, r) > 0.0
    point = add(c, scale(off, min(1.0, lamp.a / max(away, 1e-12))))
    solid = math.pi * lamp.a * lamp.a / d2 if lamp.a > 0.0 else 1.0 / d2
    return point, inside, solid, lamp.a / math.sqrt(d2)


@inlined
def _in_plane(lamp: Lamp, c: Vec, r: Vec) -> tuple[bool, float, float]:
    """Where a ray meets the plane of a flat light whose middle is `c` away: whether it does, and its place along the
    light's axes [m]. A ray that leads away from the plane is answered with the light's middle."""
    hit = c
    toward = -dot(r, lamp.face)
    if toward > 1e-6:
        hit = scale(r, -dot(c, lamp.face) / toward)
    off = sub(hit, c)
    return toward > 1e-6, dot(off, lamp.x), dot(off, lamp.y)


@inlined
def _flat_nearest(lamp: Lamp, c: Vec, a: float, b: float, inside: bool, area: float) -> Nearest:
    """The answer of a flat light for a point at (a, b) along its axes, as seen from its front; behind it, nothing."""
    facing = -dot(c, lamp.face)
    if facing <= 0.0:
        return c, False, 0.0, 0.0
    d2 = max(dot(c, c), _NEAREST2)
    point = add(c, add(scale(lamp.x, a), scale(lamp.y, b)))
    solid = facing / math.sqrt(d2) / d2 * (area if area > 0.0 else 1.0)
    return point, inside, solid, math.sqrt(area / math.pi / d2)


@inlined
def _rect_nearest(lamp: Lamp, p: Vec, r: Vec) -> Nearest:
    c = sub(lamp.centre, p)
    meets, a, b = _in_plane(lamp, c, r)
    inside = meets and abs(a) <= lamp.a and abs(b) <= lamp.b
    a, b = min(lamp.a, max(-lamp.a, a)), min(lamp.b, max(-lamp.b, b))
    return _flat_nearest(lamp, c, a, b, inside, 4.0 * lamp.a * lamp.b)


@inlined
def _disk_nearest(lamp: Lamp, p: Vec, r: Vec) -> Nearest:
    c = sub(lamp.centre, p)
    meets, a, b = _in_plane(lamp, c, r)
    away = math.sqrt(a * a + b * b)
    inside = meets and away <= lamp.a
    shrink = min(1.0, lamp.a / max(away, 1e-12))
    return _flat_nearest(lamp, c, a * shrink, b * shrink, inside, math.pi * lamp.a * lamp.a)


@inlined
def _cylinder_nearest(lamp: Lamp, p: Vec, r: Vec) -> Nearest:
    """From the place on its axis nearest to the ray, towards it as far as the radius (Karis 2013, tube lights)."""
    c = sub(lamp.centre, p)
    ahead, rho, w = across(lamp, p)
    if rho <= lamp.a:
        return c, False, 0.0, 0.0
    slope = dot(r, lamp.x)
    bend = max(1.0 - slope * slope, 1e-9)
    s = (dot(r, c) * slope - ahead) / bend
    nearest = add(c, scale(lamp.x, min(lamp.b, max(-lamp.b, s))))
    off = sub(scale(r, dot(nearest, r)), nearest)
    point = add(nearest, scale(off, min(1.0, lamp.a / max(length(off), 1e-12))))
    # Where the ray meets the round of it, seen along the axis a circle.
    toward = rho * dot(w, r)
    root = toward * toward - bend * (rho * rho - lamp.a * lamp.a)
    inside = False
    if root >= 0.0 and toward > 0.0:
        t = (toward - math.sqrt(root)) / bend
        inside = abs(t * slope - ahead) <= lamp.b
    d2 = rho * rho + ahead * ahead
    solid = 2.0 * lamp.b * rho / (d2 * math.sqrt(d2)) * (2.0 * lamp.a if lamp.a > 0.0 else 1.0)
    return point, inside, solid, math.sqrt(solid / math.pi) if lamp.a > 0.0 else 0.0


@inlined
def _camera_nearest(lamp: Lamp, p: Vec, r: Vec) -> Nearest:
    return sub(lamp.centre, p), False, 1.0, 0.0


@inlined
def _not_near(lamp: Lamp, p: Vec, r: Vec) -> Nearest:
    """It has no highlight: it is there itself, for mirrors to see."""
    return sub(lamp.centre, p), False, 0.0, 0.0


# --- one row per kind -----------------------------------------------------------------------------------------------


class Kind(NamedTuple):
    """How lights of one kind shine."""

    target: Callable[[Lamp, Vec, Vec, float, float], tuple[Vec, float]]
    """as `shadow_ray`"""
    facing: Callable[[Lamp, Vec, Vec], float]
    """(lamp, point, unit direction) -> cosine at the place that a target was drawn on"""
    irradiance: Callable[[Lamp, Vec, Vec], float]
    """as `irradiance_factor`"""
    nearest: Callable[[Lamp, Vec, Vec], Nearest]
    """(lamp, point, mirrored direction) -> as `Nearest`"""
    size_factor: tuple[float, float] = (1.0, 1.0)
    """`LightTable.size` of `scene.Light.size`: rectangles and cones are measured from their middle."""


KINDS = {
    LightKind.DISTANT: Kind(_distant_target, _all_facing, _distant_irradiance, _distant_nearest, (0.5, 0.5)),
    LightKind.SPHERE: Kind(_sphere_target, _sphere_facing, _sphere_irradiance, _sphere_nearest),
    LightKind.RECT: Kind(_rect_target, _flat_facing, _rect_irradiance, _rect_nearest, (0.5, 0.5)),
    LightKind.DISK: Kind(_disk_target, _flat_facing, _disk_irradiance, _disk_nearest),
    LightKind.CYLINDER: Kind(_cylinder_target, _cylinder_facing, _cylinder_irradiance, _cylinder_nearest, (1.0, 0.5)),
    LightKind.CAMERA: Kind(_camera_target, _all_facing, _camera_irradiance, _camera_nearest),
    LightKind.BALL: Kind(_ball_target, _ball_facing, _sphere_irradiance, _not_near),
}
_CAMERA = KINDS[LightKind.CAMERA]
target_on = choice({kind: one.target for kind, one in KINDS.items()}, _CAMERA.target)
facing_to = choice({kind: one.facing for kind, one in KINDS.items()}, _CAMERA.facing)
_irradiance = choice({kind: one.irradiance for kind, one in KINDS.items()}, _CAMERA.irradiance)
nearest_to = choice({kind: one.nearest for kind, one in KINDS.items()}, _CAMERA.nearest)
