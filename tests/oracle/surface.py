"""What is at a hit: material inputs, normal maps, and a UsdPreviewSurface made of them (specification 2.5)."""

from __future__ import annotations

import math
from typing import NamedTuple

from refract_core.optics.lobes import (  # the fit of a Monte Carlo integral; it has a test of its own
    _ALBEDO_A,
    _ALBEDO_B,
)
from refract_core.scene import Channel, Material, Mesh, Param, Scene, Source, Sphere

from . import textures
from .vec import Vec, add, clamp, cross, dot, facing, mix, scaled, sub, unit, vec
from .world import Hit

Rgba = tuple[float, float, float, float]


class Surface(NamedTuple):
    """An opaque surface, or the skin of a refractive one."""

    point: Vec
    ng: Vec
    """on the viewer's side, as ns"""
    ns: Vec
    wo: Vec
    albedo: Vec
    f0: Vec
    emissive: Vec
    roughness: float
    coat: float
    coat_roughness: float
    occlusion: float
    thing: int
    """number of its prim"""


def surface_at(scene: Scene, hit: Hit, wo: Vec) -> Surface:
    m = scene.materials[hit.face.material]
    ng = facing(hit.ng, wo)
    ns = facing(shading_normal(scene, hit, m), ng)
    base = color(scene, hit, m, Param.DIFFUSE)
    metallic = 0.0
    if m.specular_workflow:
        f0 = color(scene, hit, m, Param.SPECULAR)
    else:
        metallic = clamp(number(scene, hit, m, Param.METALLIC))
        ior = number(scene, hit, m, Param.IOR)
        dielectric = ((1.0 - ior) / (1.0 + ior)) ** 2
        f0 = mix((dielectric,) * 3, base, metallic)
    roughness = clamp(number(scene, hit, m, Param.ROUGHNESS))
    reflected = specular_albedo(f0, roughness, abs(dot(ns, wo)))
    kept = vec([base[c] * (1.0 - metallic) * (1.0 - min(1.0, reflected[c])) for c in range(3)])
    return Surface(
        hit.point, ng, ns, wo, kept, f0, color(scene, hit, m, Param.EMISSIVE), roughness,
        clamp(number(scene, hit, m, Param.CLEARCOAT)), clamp(number(scene, hit, m, Param.CLEARCOAT_ROUGHNESS)),
        clamp(number(scene, hit, m, Param.OCCLUSION)), hit.face.thing,
    )  # fmt: skip


def specular_albedo(f0: Vec, roughness: float, cosine: float) -> Vec:
    """Share of uniform light a GGX lobe sends back, F0 A + B (Karis 2013), from the fitted table: rows by roughness,
    columns by the square root of the cosine. B, the rim, fades below an F0 of 2 % (Lagarde and de Rousiers 2014)."""
    a, b = (_table(t, roughness, math.sqrt(clamp(cosine))) for t in (_ALBEDO_A, _ALBEDO_B))
    rim = b * clamp(max(f0) / 0.02)
    return vec([f * a + rim for f in f0])


def _table(rows: tuple[tuple[float, ...], ...], y: float, x: float) -> float:
    last = len(rows) - 1
    j, i = min(int(y * last), last - 1), min(int(x * last), last - 1)
    v, u = y * last - j, x * last - i
    upper = rows[j][i] * (1 - u) + rows[j][i + 1] * u
    lower = rows[j + 1][i] * (1 - u) + rows[j + 1][i + 1] * u
    return upper * (1 - v) + lower * v


# --- Inputs ---------------------------------------------------------------------------------------------------------


def color(scene: Scene, hit: Hit, material: Material, param: Param) -> Vec:
    source = material.inputs[param]
    value = _driven(scene, hit, source)
    if value is None:
        return vec(source.value[:3])
    return vec(value[:3])


def number(scene: Scene, hit: Hit, material: Material, param: Param) -> float:
    source = material.inputs[param]
    value = _driven(scene, hit, source)
    return float(source.value[0]) if value is None else value[0]


def _driven(scene: Scene, hit: Hit, source: Source) -> Rgba | None:
    """What a texture or primvar gives; None where there is neither, or not on this mesh."""
    if source.texture >= 0:
        value = _texel(scene, hit, source)
    elif source.primvar and (found := _primvar(hit, source.primvar)) is not None:
        value = _rgba(found)
    else:
        return None
    # As UsdUVTexture: scale and bias act on the channels, and then one of them is picked.
    out = [value[c] * source.scale[c] + source.bias[c] for c in range(4)]
    if source.texture >= 0 and source.channel is not Channel.RGB:
        out = [out[int(source.channel)]] * 4
    return (out[0], out[1], out[2], out[3])


def _texel(scene: Scene, hit: Hit, source: Source) -> Rgba:
    st, density = _place(hit, source)
    m = source.uv_matrix
    s = m[0] * st[0] + m[1] * st[1] + m[2]
    t = m[3] * st[0] + m[4] * st[1] + m[5]
    footprint = hit.width * density * math.sqrt(abs(m[0] * m[4] - m[1] * m[3]))
    return textures.sample(scene.textures[source.texture], s, t, footprint, source.wrap)


def _place(hit: Hit, source: Source) -> tuple[tuple[float, float], float]:
    """st before the matrix, and its lengths per metre."""
    found = _primvar(hit, source.uv_primvar) if source.uv_primvar else None
    if found is None or len(found) < 2:
        return source.uv_value, 0.0
    corners = _corners(hit, source.uv_primvar)
    if corners is None:
        return (found[0], found[1]), 0.0
    (s1, t1), (s2, t2) = _edges(corners)
    area = dot(*[cross(hit.face.ab, hit.face.ac)] * 2) ** 0.5
    return (found[0], found[1]), math.sqrt(abs(s1 * t2 - s2 * t1) / area)


def _edges(corners: list[list[float]]) -> tuple[tuple[float, float], tuple[float, float]]:
    o, a, b = corners
    return (a[0] - o[0], a[1] - o[1]), (b[0] - o[0], b[1] - o[1])


def _corners(hit: Hit, name: str) -> list[list[float]] | None:
    """Values at a triangle's corners; None where the primvar is missing or constant."""
    shape = hit.face.shape
    values = shape.primvars.get(name)
    if values is None or values.shape[1] == 1 or isinstance(shape, Sphere):
        return None
    return [[float(x) for x in corner] for corner in values[hit.face.number]]


def _primvar(hit: Hit, name: str) -> list[float] | None:
    values = hit.face.shape.primvars.get(name)
    if values is None:
        return None
    corners = _corners(hit, name)
    if corners is None:
        return [float(x) for x in values[0, 0]]
    weights = (1.0 - hit.u - hit.v, hit.u, hit.v)
    return [sum(w * c[k] for w, c in zip(weights, corners, strict=True)) for k in range(len(corners[0]))]


def _rgba(v: list[float]) -> Rgba:
    if len(v) == 1:
        return (v[0],) * 4
    full = [*v, 0.0] if len(v) == 2 else v
    return (full[0], full[1], full[2], full[3] if len(full) > 3 else 1.0)


# --- Normals --------------------------------------------------------------------------------------------------------


def shading_normal(scene: Scene, hit: Hit, material: Material) -> Vec:
    """The interpolated normal, turned by the normal map: x along growing s, y to its left seen from outside (or right
    where st is mirrored), z along the normal. Only on triangles whose st varies."""
    source = material.inputs[Param.NORMAL]
    if source.texture < 0 or not source.uv_primvar or not isinstance(hit.face.shape, Mesh):
        return hit.ns
    corners = _corners(hit, source.uv_primvar)
    if corners is None:
        return hit.ns
    (s1, t1), (s2, t2) = _edges(corners)
    area = s1 * t2 - s2 * t1
    if area == 0.0:
        return hit.ns
    # dP/ds from P = s-edge and t-edge equations by Cramer's rule.
    along_s = scaled(sub(scaled(hit.face.ab, t2), scaled(hit.face.ac, t1)), 1.0 / area)
    tangent = unit(sub(along_s, scaled(hit.ns, dot(hit.ns, along_s))))
    bitangent = scaled(cross(hit.ns, tangent), math.copysign(1.0, area))
    x, y, z = color(scene, hit, material, Param.NORMAL)
    mapped = add(add(scaled(tangent, x), scaled(bitangent, y)), scaled(hit.ns, z))
    if dot(mapped, mapped) == 0.0:
        return hit.ns
    return facing(unit(mapped), hit.ng)
