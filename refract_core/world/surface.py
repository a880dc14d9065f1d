"""What a kernel can ask about a hit: its point, its normals and the material inputs there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..kernels.compile import inlined
from ..kernels.vec import add, along, cross, dot, flip_towards, length, normalize, row, scale, sub
from ..scene import Channel, Param
from .textures import sample


class Hit(NamedTuple):
    """Where a ray met a surface."""

    part: int
    primitive: int
    u: float
    v: float
    point: tuple[float, float, float]
    """[m]"""
    ng: tuple[float, float, float]
    """unit geometric normal, outward"""
    ns: tuple[float, float, float]
    """unit shading normal, on the side of ng"""
    footprint: float
    """width of the ray's cone on the surface [m]"""



@inlined
def _corners(geometry, t):  # type: ignore[no-untyped-def]
    a = row(geometry.points, geometry.triangles[t, 0])
    b = row(geometry.points, geometry.triangles[t, 1])
    c = row(geometry.points, geometry.triangles[t, 2])
    return a, b, c


@inlined
def hit_at(geometry, part, primitive, u, v, origin, direction, distance, spread):  # type: ignore[no-untyped-def]
    """Point and normals of a hit. `spread`: growth of the ray's cone per metre, for texture filtering."""
    if geometry.sphere[part, 3] > 0.0:
        centre = row(geometry.sphere, part)
        ng = normalize(sub(along(origin, direction, distance), centre))
        point = along(centre, ng, np.float64(geometry.sphere[part, 3]))
        ns = ng
    else:
        a, b, c = _corners(geometry, geometry.first[part] + primitive)
        ab, ac = sub(b, a), sub(c, a)
        ng = normalize(cross(ab, ac))
        point = (
            a[0] + u * ab[0] + v * ac[0],
            a[1] + u * ab[1] + v * ac[1],
            a[2] + u * ab[2] + v * ac[2],
        )
        ns = ng
        k = geometry.first_normal[part]
        if k >= 0:
            n = geometry.normals[k + primitive]
            w = 1.0 - u - v
            ns = normalize(
                (
                    w * n[0, 0] + u * n[1, 0] + v * n[2, 0],
                    w * n[0, 1] + u * n[1, 1] + v * n[2, 1],
                    w * n[0, 2] + u * n[1, 2] + v * n[2, 2],
                )
            )
            if dot(ns, ns) == 0.0:
                ns = ng
            ns = flip_towards(ns, ng)
    return Hit(part, primitive, u, v, point, ng, ns, spread * distance)


@inlined
def primvar2(geometry, hit, slot):  # type: ignore[no-untyped-def]
    """(found, s, t) of a float2 primvar at a hit."""
    first = geometry.primvar_first[hit.part, slot]
    if first < 0 or geometry.primvar_size[hit.part, slot] < 2:
        return False, 0.0, 0.0
    stride = geometry.primvar_stride[hit.part, slot]
    size = geometry.primvar_size[hit.part, slot]
    p = geometry.primvars
    k = first + hit.primitive * stride
    if stride == 0:
        return True, np.float64(p[k]), np.float64(p[k + 1])
    w = 1.0 - hit.u - hit.v
    s = w * p[k] + hit.u * p[k + size] + hit.v * p[k + 2 * size]
    t = w * p[k + 1] + hit.u * p[k + size + 1] + hit.v * p[k + 2 * size + 1]
    return True, s, t


@inlined
def _primvar4(geometry, hit, slot):  # type: ignore[no-untyped-def]
    """(found, r, g, b, a) of any primvar: scalars repeat, a missing alpha is 1."""
    first = geometry.primvar_first[hit.part, slot]
    if first < 0:
        return False, (0.0, 0.0, 0.0, 1.0)
    stride = geometry.primvar_stride[hit.part, slot]
    size = geometry.primvar_size[hit.part, slot]
    p = geometry.primvars
    k = first + hit.primitive * stride
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
def _uv_density(geometry, hit, slot):  # type: ignore[no-untyped-def]
    """Texture lengths per metre on the hit triangle: the square root of the ratio of areas."""
    stride = geometry.primvar_stride[hit.part, slot]
    if stride == 0 or geometry.sphere[hit.part, 3] > 0.0:
        return 0.0
    a, b, c = _corners(geometry, geometry.first[hit.part] + hit.primitive)
    area = length(cross(sub(b, a), sub(c, a)))
    k = geometry.primvar_first[hit.part, slot] + hit.primitive * stride
    size = geometry.primvar_size[hit.part, slot]
    p = geometry.primvars
    s0, t0 = p[k], p[k + 1]
    s1, t1 = p[k + size] - s0, p[k + size + 1] - t0
    s2, t2 = p[k + 2 * size] - s0, p[k + 2 * size + 1] - t0
    uv_area = abs(s1 * t2 - s2 * t1)
    return np.sqrt(uv_area / area) if area > 0.0 else 0.0


@inlined
def _textured(geometry, materials, textures, hit, m, i):  # type: ignore[no-untyped-def]
    slot = materials.uv_slot[m, i]
    s, t = np.float64(materials.uv_value[m, i, 0]), np.float64(materials.uv_value[m, i, 1])
    footprint = 0.0
    if slot >= 0:
        found, x, y = primvar2(geometry, hit, slot)
        if found:
            s, t = x, y
            footprint = hit.footprint * _uv_density(geometry, hit, slot)
    matrix = materials.uv_matrix[m, i]
    x = matrix[0] * s + matrix[1] * t + matrix[2]
    y = matrix[3] * s + matrix[4] * t + matrix[5]
    grow = np.sqrt(abs(matrix[0] * matrix[4] - matrix[1] * matrix[3]))
    wrap = materials.wrap[m, i]
    r, g, b, a = sample(textures, materials.texture[m, i], x, y, footprint * grow, wrap[0], wrap[1])
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
def color_input(geometry, materials, textures, hit, m, i):  # type: ignore[no-untyped-def]
    """Value of input `i` of material `m` at a hit, as three floats."""
    if (materials.driven[m] >> i) & 1 == 0:
        return (np.float64(materials.value[m, i, 0]), np.float64(materials.value[m, i, 1]), np.float64(materials.value[m, i, 2]))
    return _driven_color(geometry, materials, textures, hit, m, i)


@inlined
def _driven_color(geometry, materials, textures, hit, m, i):  # type: ignore[no-untyped-def]
    value = materials.value[m, i]
    if materials.texture[m, i] >= 0:
        c = _textured(geometry, materials, textures, hit, m, i)
    elif materials.primvar_slot[m, i] >= 0:
        found, c = _primvar4(geometry, hit, materials.primvar_slot[m, i])
        if not found:
            return (np.float64(value[0]), np.float64(value[1]), np.float64(value[2]))
    else:
        return (np.float64(value[0]), np.float64(value[1]), np.float64(value[2]))
    s, b = materials.scale[m, i], materials.bias[m, i]
    return (c[0] * s[0] + b[0], c[1] * s[1] + b[1], c[2] * s[2] + b[2])


@inlined
def float_input(geometry, materials, textures, hit, m, i):  # type: ignore[no-untyped-def]
    """Value of a scalar input `i` of material `m` at a hit."""
    if (materials.driven[m] >> i) & 1 == 0:
        return np.float64(materials.value[m, i, 0])
    return _driven_float(geometry, materials, textures, hit, m, i)


@inlined
def _driven_float(geometry, materials, textures, hit, m, i):  # type: ignore[no-untyped-def]
    channel = materials.channel[m, i]
    if materials.texture[m, i] >= 0 and channel == Channel.A.value:
        c = _textured(geometry, materials, textures, hit, m, i)
        return c[3] * materials.scale[m, i, 3] + materials.bias[m, i, 3]
    if materials.texture[m, i] >= 0 and channel < Channel.A.value:
        c = _textured(geometry, materials, textures, hit, m, i)
        return c[0] * materials.scale[m, i, channel] + materials.bias[m, i, channel]
    return _driven_color(geometry, materials, textures, hit, m, i)[0]


@inlined
def material_of(geometry, part, primitive):  # type: ignore[no-untyped-def]
    return geometry.material[geometry.first[part] + primitive]


@inlined
def normal_input(geometry, materials, textures, hit, m):  # type: ignore[no-untyped-def]
    """Shading normal with the material's normal map on it, on the side of ng."""
    i = Param.NORMAL.value
    slot = materials.uv_slot[m, i]
    if materials.texture[m, i] < 0 or slot < 0 or geometry.sphere[hit.part, 3] > 0.0:
        return hit.ns
    stride = geometry.primvar_stride[hit.part, slot]
    if geometry.primvar_first[hit.part, slot] < 0 or stride == 0:
        return hit.ns
    a, b, c = _corners(geometry, geometry.first[hit.part] + hit.primitive)
    k = geometry.primvar_first[hit.part, slot] + hit.primitive * stride
    size = geometry.primvar_size[hit.part, slot]
    p = geometry.primvars
    s1, t1 = p[k + size] - p[k], p[k + size + 1] - p[k + 1]
    s2, t2 = p[k + 2 * size] - p[k], p[k + 2 * size + 1] - p[k + 1]
    area = s1 * t2 - s2 * t1
    if area == 0.0:
        return hit.ns
    tangent = scale(sub(scale(sub(b, a), t2), scale(sub(c, a), t1)), 1.0 / area)
    tangent = normalize(sub(tangent, scale(hit.ns, dot(hit.ns, tangent))))
    bitangent = scale(cross(hit.ns, tangent), 1.0 if area > 0.0 else -1.0)
    n = color_input(geometry, materials, textures, hit, m, i)
    mapped = add(add(scale(tangent, n[0]), scale(bitangent, n[1])), scale(hit.ns, n[2]))
    if dot(mapped, mapped) == 0.0:
        return hit.ns
    return flip_towards(normalize(mapped), hit.ng)
