"""What a kernel can ask about a hit: its point, its normals and the material inputs there."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..kernels.arrays import F32_2D
from ..kernels.compile import inlined
from ..kernels.lanes import Scalars, Words
from ..kernels.vec import Vec, add, along, cross, dot, flip_towards, length, normalize, row, scale, sub
from ..optics.models import on_open_mesh
from ..scene import Channel, Param
from .embree import GEOM, HIT_U, HIT_V, INST, INST_PRIM, NG_X, NG_Y, NG_Z, PRIM, Packet, hit_distance
from .tables import Geometry, World
from .textures import Rgba, sample

NOTHING = -1
"""`part` of a hit that is none."""


class Ray(NamedTuple):
    """A half line in engine world. `direction` is a unit vector."""

    origin: Vec
    """[m]"""
    direction: Vec


class Hit(NamedTuple):
    """Where a ray met a surface: all that Embree tells, and the material, looked up once. Outlives the packet."""

    part: int
    """as `Geometry` numbers them; `NOTHING` where nothing was met"""
    primitive: int
    """triangle within the part"""
    instance: int
    """which of the part's places; 0 where it has one"""
    material: int
    u: float
    """barycentric weight of the triangle's second corner"""
    v: float
    """of its third"""
    t: float
    """hit distance [m]"""


class HitLanes(NamedTuple):
    """Eight hits that outlive their packet."""

    part: Words
    primitive: Words
    instance: Words
    material: Words
    u: Scalars
    v: Scalars
    t: Scalars


class Interaction(NamedTuple):
    """A hit looked at: where it is, and which way the surface faces."""

    hit: Hit
    point: Vec
    """[m]"""
    ng: Vec
    """unit geometric normal, outward"""
    ns: Vec
    """unit shading normal, on the side of ng"""
    footprint: float
    """width of the ray's cone on the surface [m]"""


# --- hits ---------------------------------------------------------------------------------------------------------


@inlined
def hit_in(packet: Packet, lane: int, geometry: Geometry) -> Hit:
    """The hit in a lane of a traced packet; the lane must have one (`embree.has_hit`)."""
    rays, words = packet.rays, packet.words
    part, primitive, instance = words[GEOM, lane], words[PRIM, lane], words[INST_PRIM, lane]
    if words[INST, lane] >= 0:  # what stands in many places has a scene of its own, whose only geometry is 0
        part = words[INST, lane]
    elif geometry.ball[part] >= 0:  # each of many spheres is a place
        instance, primitive = primitive, instance & 0
    else:
        instance &= 0
    return Hit(
        part,
        primitive,
        instance,
        geometry.material[geometry.first[part] + primitive],
        np.float64(rays[HIT_U, lane]),
        np.float64(rays[HIT_V, lane]),
        hit_distance(packet, lane),
    )


@inlined
def keep_hit(hits: HitLanes, lane: int, hit: Hit) -> None:
    """Note a hit in a lane."""
    hits.part[lane], hits.primitive[lane], hits.instance[lane] = hit.part, hit.primitive, hit.instance
    hits.material[lane] = hit.material
    hits.u[lane], hits.v[lane], hits.t[lane] = hit.u, hit.v, hit.t


@inlined
def kept_hit(hits: HitLanes, lane: int) -> Hit:
    """The hit noted in a lane."""
    return Hit(
        hits.part[lane], hits.primitive[lane], hits.instance[lane], hits.material[lane],
        hits.u[lane], hits.v[lane], hits.t[lane],
    )  # fmt: skip


@inlined
def thing_of(geometry: Geometry, hit: Hit) -> int:
    """Number of the thing that was hit: a prim, or one of its instances."""
    return geometry.thing[hit.part] + hit.instance


@inlined
def surface_of(geometry: Geometry, hit: Hit) -> int:
    """Number of the surface that was hit: a part, in one of its places."""
    return geometry.surface[hit.part] + hit.instance


@inlined
def is_round(geometry: Geometry, part: int) -> bool:
    """A part is exact spheres, or one."""
    return geometry.sphere[part, 3] > 0.0 or geometry.ball[part] >= 0


@inlined
def ball_of(geometry: Geometry, part: int, instance: int) -> tuple[Vec, float]:
    """Centre and radius [m] of a sphere."""
    k = geometry.ball[part]
    if k >= 0:
        return row(geometry.balls, k + instance), np.float64(geometry.balls[k + instance, 3])
    return row(geometry.sphere, part), np.float64(geometry.sphere[part, 3])


@inlined
def corners_of(geometry: Geometry, part: int, instance: int, primitive: int) -> tuple[Vec, Vec, Vec]:
    """The three corners of a triangle [m], in the order of the mesh: clockwise from outside where the place mirrors."""
    t = geometry.first[part] + primitive
    a = row(geometry.points, geometry.triangles[t, 0])
    b = row(geometry.points, geometry.triangles[t, 1])
    c = row(geometry.points, geometry.triangles[t, 2])
    if geometry.place[part] >= 0:
        at = geometry.transforms[geometry.place[part] + instance]
        return _moved(at, a), _moved(at, b), _moved(at, c)
    return a, b, c


@inlined
def sense_of(geometry: Geometry, part: int, instance: int) -> float:
    """-1 where the place of a part mirrors it, else 1."""
    k = geometry.place[part]
    if k < 0:
        return 1.0
    at = geometry.transforms[k + instance]
    return -1.0 if dot(_linear(at, 0), cross(_linear(at, 1), _linear(at, 2))) < 0.0 else 1.0


@inlined
def _linear(at: F32_2D, r: int) -> Vec:
    """A row of the linear part of a transform."""
    return (np.float64(at[r, 0]), np.float64(at[r, 1]), np.float64(at[r, 2]))


@inlined
def _moved(at: F32_2D, p: Vec) -> Vec:
    """A point of the mesh, where a transform takes it [m]."""
    return (
        dot(_linear(at, 0), p) + at[0, 3],
        dot(_linear(at, 1), p) + at[1, 3],
        dot(_linear(at, 2), p) + at[2, 3],
    )


@inlined
def _turned(at: F32_2D, n: Vec) -> Vec:
    """A normal of the mesh, where a transform takes it, by its cofactors; of any length, and reversed by one that
    mirrors."""
    x, y, z = _linear(at, 0), _linear(at, 1), _linear(at, 2)
    return (dot(cross(y, z), n), dot(cross(z, x), n), dot(cross(x, y), n))


@inlined
def facing_in(packet: Packet, lane: int, geometry: Geometry) -> Vec:
    """Unit geometric normal of the hit in a lane of a traced packet, as Embree has it: to one side or the other."""
    rays, words = packet.rays, packet.words
    n: Vec = (np.float64(rays[NG_X, lane]), np.float64(rays[NG_Y, lane]), np.float64(rays[NG_Z, lane]))
    if words[INST, lane] >= 0:
        n = _turned(geometry.transforms[geometry.place[words[INST, lane]] + words[INST_PRIM, lane]], n)
    return normalize(n)


@inlined
def drawn_model(world: World, hit: Hit) -> int:
    """As `scene.Model`: what the glass at a hit is drawn as."""
    model = world.materials.drawn[hit.material]
    return on_open_mesh(model) if world.geometry.sheet[hit.part] != 0 else int(model)


@inlined
def _exact_normal(centre: Vec, radius: float, ray: Ray, t: float) -> Vec:
    """Where a ray meets a sphere near a distance: a droplet is so small that the distance alone, rounded to float32,
    would turn its normal."""
    to = sub(ray.origin, centre)
    near = -dot(to, ray.direction)
    beside = along(to, ray.direction, near)
    left = radius * radius - dot(beside, beside)
    if left <= 0.0:
        return normalize(beside)
    half = math.sqrt(left)
    return normalize(along(beside, ray.direction, half if t > near else -half))


@inlined
def interaction(geometry: Geometry, hit: Hit, ray: Ray, footprint: float) -> Interaction:
    """Point and normals of a hit. `footprint`: width of the ray's cone there [m], for texture filtering.

    The point of a triangle is taken from its corners, not from the ray: that is exact to the rounding of the corners,
    where origin plus distance is only as good as the distance.
    """
    part, u, v = hit.part, hit.u, hit.v
    if is_round(geometry, part):
        centre, radius = ball_of(geometry, part, hit.instance)
        ng = normalize(sub(along(ray.origin, ray.direction, hit.t), centre))
        if geometry.ball[part] >= 0:
            ng = _exact_normal(centre, radius, ray, hit.t)
        point = along(centre, ng, radius)
        ns = ng
    else:
        a, b, c = corners_of(geometry, part, hit.instance, hit.primitive)
        ab, ac = sub(b, a), sub(c, a)
        ng = normalize(cross(ab, ac))
        place = geometry.place[part]
        if place >= 0:
            ng = scale(ng, sense_of(geometry, part, hit.instance))
        point = (
            a[0] + u * ab[0] + v * ac[0],
            a[1] + u * ab[1] + v * ac[1],
            a[2] + u * ab[2] + v * ac[2],
        )
        ns = ng
        k = geometry.first_normal[part]
        if k >= 0:
            n = geometry.normals[k + hit.primitive]
            w = 1.0 - u - v
            n0, n1, n2 = row(n, 0), row(n, 1), row(n, 2)
            if place >= 0:  # each corner's first, and of length 1, as of a mesh that stands there; reversed or not
                at = geometry.transforms[place + hit.instance]
                n0, n1, n2 = normalize(_turned(at, n0)), normalize(_turned(at, n1)), normalize(_turned(at, n2))
            ns = normalize(along(along(scale(n0, w), n1, u), n2, v))
            if dot(ns, ns) == 0.0:
                ns = ng
            ns = flip_towards(ns, ng)
    return Interaction(hit, point, ng, ns, footprint)


# --- primvars -----------------------------------------------------------------------------------------------------


@inlined
def _primvar2(geometry: Geometry, hit: Hit, slot: int) -> tuple[bool, float, float]:
    """(found, s, t) of a float2 primvar at a hit."""
    first = geometry.primvar_first[hit.part, slot]
    if first < 0 or geometry.primvar_size[hit.part, slot] < 2:
        return False, 0.0, 0.0
    stride = geometry.primvar_stride[hit.part, slot]
    size = geometry.primvar_size[hit.part, slot]
    p = geometry.primvars
    k = first + hit.primitive * stride + hit.instance * geometry.primvar_step[hit.part, slot]
    if stride == 0:
        return True, np.float64(p[k]), np.float64(p[k + 1])
    w = 1.0 - hit.u - hit.v
    s = w * p[k] + hit.u * p[k + size] + hit.v * p[k + 2 * size]
    t = w * p[k + 1] + hit.u * p[k + size + 1] + hit.v * p[k + 2 * size + 1]
    return True, s, t


@inlined
def _primvar4(geometry: Geometry, hit: Hit, slot: int) -> tuple[bool, Rgba]:
    """(found, (r, g, b, a)) of any primvar: scalars repeat, a missing alpha is 1."""
    first = geometry.primvar_first[hit.part, slot]
    if first < 0:
        return False, (0.0, 0.0, 0.0, 1.0)
    stride = geometry.primvar_stride[hit.part, slot]
    size = geometry.primvar_size[hit.part, slot]
    p = geometry.primvars
    k = first + hit.primitive * stride + hit.instance * geometry.primvar_step[hit.part, slot]
    b, c = (0, 0) if stride == 0 else (size, 2 * size)
    w = 1.0 - hit.u - hit.v
    x = w * p[k] + hit.u * p[k + b] + hit.v * p[k + c]
    if size == 1:
        return True, (x, x, x, x)
    y = w * p[k + 1] + hit.u * p[k + 1 + b] + hit.v * p[k + 1 + c]
    z = 0.0
    alpha = 1.0
    if size > 2:
        z = w * p[k + 2] + hit.u * p[k + 2 + b] + hit.v * p[k + 2 + c]
    if size > 3:
        alpha = w * p[k + 3] + hit.u * p[k + 3 + b] + hit.v * p[k + 3 + c]
    return True, (x, y, z, alpha)


@inlined
def _uv_density(geometry: Geometry, hit: Hit, slot: int) -> float:
    """Texture lengths per metre on the hit triangle: the square root of the ratio of areas."""
    stride = geometry.primvar_stride[hit.part, slot]
    if stride == 0 or is_round(geometry, hit.part):
        return 0.0
    a, b, c = corners_of(geometry, hit.part, hit.instance, hit.primitive)
    area = length(cross(sub(b, a), sub(c, a)))
    k = geometry.primvar_first[hit.part, slot] + hit.primitive * stride
    size = geometry.primvar_size[hit.part, slot]
    p = geometry.primvars
    s0, t0 = p[k], p[k + 1]
    s1, t1 = p[k + size] - s0, p[k + size + 1] - t0
    s2, t2 = p[k + 2 * size] - s0, p[k + 2 * size + 1] - t0
    uv_area = abs(s1 * t2 - s2 * t1)
    return math.sqrt(uv_area / area) if area > 0.0 else 0.0


# --- material inputs ----------------------------------------------------------------------------------------------


@inlined
def _textured(world: World, at: Interaction, i: int) -> Rgba:
    """The texture of input `i`, before its scale and bias; a channel other than RGB repeats in all four."""
    materials, m = world.materials, at.hit.material
    slot = materials.uv_slot[m, i]
    s: float = np.float64(materials.uv_value[m, i, 0])
    t: float = np.float64(materials.uv_value[m, i, 1])
    footprint = 0.0
    if slot >= 0:
        found, x, y = _primvar2(world.geometry, at.hit, slot)
        if found:
            s, t = x, y
            footprint = at.footprint * _uv_density(world.geometry, at.hit, slot)
    matrix = materials.uv_matrix[m, i]
    x = matrix[0] * s + matrix[1] * t + matrix[2]
    y = matrix[3] * s + matrix[4] * t + matrix[5]
    grow = math.sqrt(abs(matrix[0] * matrix[4] - matrix[1] * matrix[3]))
    wrap = materials.wrap[m, i]
    r, g, b, a = sample(world.textures, materials.texture[m, i], x, y, footprint * grow, wrap[0], wrap[1])
    channel = materials.channel[m, i]
    if channel == Channel.R.value:
        return (r, r, r, r)
    if channel == Channel.G.value:
        return (g, g, g, g)
    if channel == Channel.B.value:
        return (b, b, b, b)
    if channel == Channel.A.value:
        return (a, a, a, a)
    return (r, g, b, a)


@inlined
def color_input(world: World, at: Interaction, i: int) -> Vec:
    """Value of input `i` (a `Param`) of the hit's material there, as three floats."""
    materials, m = world.materials, at.hit.material
    if (materials.driven[m] >> i) & 1 == 0:
        value = materials.value[m, i]
        return (np.float64(value[0]), np.float64(value[1]), np.float64(value[2]))
    return _driven_color(world, at, i)


@inlined
def _driven_color(world: World, at: Interaction, i: int) -> Vec:
    materials, m = world.materials, at.hit.material
    value = materials.value[m, i]
    if materials.texture[m, i] >= 0:
        c = _textured(world, at, i)
        channel = materials.channel[m, i]
        if channel <= Channel.A.value:  # one channel drives all three colours, scaled and biased as that channel
            x = c[0] * materials.scale[m, i, channel] + materials.bias[m, i, channel]
            return (x, x, x)
    elif materials.primvar_slot[m, i] >= 0:
        found, c = _primvar4(world.geometry, at.hit, materials.primvar_slot[m, i])
        if not found:
            return (np.float64(value[0]), np.float64(value[1]), np.float64(value[2]))
    else:
        return (np.float64(value[0]), np.float64(value[1]), np.float64(value[2]))
    s, b = materials.scale[m, i], materials.bias[m, i]
    return (c[0] * s[0] + b[0], c[1] * s[1] + b[1], c[2] * s[2] + b[2])


@inlined
def float_input(world: World, at: Interaction, i: int) -> float:
    """Value of a scalar input `i` (a `Param`) of the hit's material there."""
    materials, m = world.materials, at.hit.material
    if (materials.driven[m] >> i) & 1 == 0:
        return np.float64(materials.value[m, i, 0])
    return _driven_color(world, at, i)[0]


@inlined
def share_input(world: World, at: Interaction, i: int) -> float:
    """A scalar input that is a share, brought into 0 .. 1: textures and primvars may hold anything."""
    return min(1.0, max(0.0, float_input(world, at, i)))


@inlined
def normal_input(world: World, at: Interaction) -> Vec:
    """Shading normal with the material's normal map on it, on the side of ng.

    The tangent follows the triangle's uv (its direction of growing s), made square to the shading normal; the
    bitangent's sign is that of the uv area, so that mirrored uv keep the map's handedness.
    """
    geometry, materials, hit = world.geometry, world.materials, at.hit
    i = Param.NORMAL.value
    m = hit.material
    slot = materials.uv_slot[m, i]
    if materials.texture[m, i] < 0 or slot < 0 or is_round(geometry, hit.part):
        return at.ns
    stride = geometry.primvar_stride[hit.part, slot]
    if geometry.primvar_first[hit.part, slot] < 0 or stride == 0:
        return at.ns
    a, b, c = corners_of(geometry, hit.part, hit.instance, hit.primitive)
    k = geometry.primvar_first[hit.part, slot] + hit.primitive * stride
    size = geometry.primvar_size[hit.part, slot]
    p = geometry.primvars
    s1, t1 = p[k + size] - p[k], p[k + size + 1] - p[k + 1]
    s2, t2 = p[k + 2 * size] - p[k], p[k + 2 * size + 1] - p[k + 1]
    area = s1 * t2 - s2 * t1
    if area == 0.0:
        return at.ns
    tangent = scale(sub(scale(sub(b, a), t2), scale(sub(c, a), t1)), 1.0 / area)
    tangent = normalize(sub(tangent, scale(at.ns, dot(at.ns, tangent))))
    hand = area * sense_of(geometry, hit.part, hit.instance)
    bitangent = scale(cross(at.ns, tangent), 1.0 if hand > 0.0 else -1.0)
    n = color_input(world, at, i)
    mapped = add(add(scale(tangent, n[0]), scale(bitangent, n[1])), scale(at.ns, n[2]))
    if dot(mapped, mapped) == 0.0:
        return at.ns
    return flip_towards(normalize(mapped), at.ng)
