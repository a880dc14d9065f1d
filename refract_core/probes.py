"""The probe tier: cubemaps captured in the scene, looked up with local correction where their influence reaches.

A capture keeps colour, coverage (0 where the sky is seen) and distance. Where a texel shows the sky, the probe hands
its share on to the sky tier, which knows the direction exactly (Arm, "Combining reflections from a distant
environment"); where no sky tier follows, the sky's colour is in the capture.

Faces are +x -x +y -y +z -z, each `RES + 2` texels wide: one texel beyond the face on every side, captured too, so that
bilinear lookups are seamless.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .embree import BLOCK_HEIGHT, BLOCK_WIDTH, COHERENT, LANES, clear, set_ray
from .environment import radiance
from .kernel import inlined, kernel
from .scene import Probe
from .shading import load_hits, shade
from .tracing import intersect_world
from .vec import along, length, normalize, row, scale, sub, transform_direction, transform_point
from .volumes import INFINITE_DISTANCE, distance_fade, influence_box, influence_sphere, ray_box, ray_sphere

TEXEL = 5
"""Floats per texel: red, green, blue (sky left out), coverage, distance [m]."""


class ProbeTable(NamedTuple):
    """All probes in the order in which they are asked: importance, then smaller volume (HDRP, 4.7)."""

    texels: NDArray[np.float32]
    """flat pool: per probe, level, face, row, column, TEXEL floats"""
    first: NDArray[np.int64]
    """shape (K, L): offset of each level in the pool"""
    resolution: NDArray[np.int64]
    """shape (K,): texels across level 0, without the border"""
    capture: NDArray[np.float64]
    """shape (K, 3) [m]"""
    owned: NDArray[np.uint8]
    """shape (K,): 1 where it serves only the things that are given to it"""
    influence: NDArray[np.float64]
    """shape (K, 4, 4) volume_from_world"""
    influence_sphere: NDArray[np.uint8]
    influence_extents: NDArray[np.float64]
    """shape (K, 3) [m]"""
    proxy: NDArray[np.float64]
    """shape (K, 4, 4) volume_from_world"""
    proxy_kind: NDArray[np.uint8]
    """shape (K,): 0 box, 1 sphere, 2 infinite"""
    proxy_extents: NDArray[np.float64]
    blend: NDArray[np.float64]
    """shape (K, 6) [m]"""
    blend_normal: NDArray[np.float64]
    face_fade: NDArray[np.float64]
    weight: NDArray[np.float64]
    """shape (K,): weight with the fade by distance to the camera in it"""
    multiplier: NDArray[np.float64]


def in_order(probes: list[Probe]) -> list[Probe]:
    """Higher importance first, then smaller influence volume, then as given."""

    def volume(probe: Probe) -> float:
        x, y, z = probe.influence.extents
        return x * y * z

    return sorted(probes, key=lambda probe: (-probe.importance, volume(probe)))


def level_count(resolution: int) -> int:
    return max(1, int(math.log2(resolution)) - 1)


def empty_table(probes: list[tuple[Probe, bool]], eye: NDArray[np.float64]) -> ProbeTable:
    """A table with room for every level of every probe; `capture_tile` and `fill_levels` fill the texels."""
    k = len(probes)
    levels = max([level_count(p.resolution) for p, _ in probes], default=1)
    first = np.full((k, levels), -1, np.int64)
    total = 0
    for i, (probe, _) in enumerate(probes):
        for level in range(level_count(probe.resolution)):
            first[i, level] = total
            total += 6 * ((probe.resolution >> level) + 2) ** 2 * TEXEL

    def each(get: Any, dtype: Any, shape: tuple[int, ...] = ()) -> NDArray[Any]:
        return np.array([get(p) for p, _ in probes], dtype).reshape((k, *shape))

    def kind(p: Probe) -> int:
        return 2 if p.proxy is None else int(p.proxy.sphere)

    def fade(p: Probe) -> float:
        distance = float(np.linalg.norm(p.influence.world_from_volume[:3, 3] - eye))
        return p.weight * distance_fade(distance, max(p.fade_distance, 1e-6))

    return ProbeTable(
        texels=np.zeros(total, np.float32),
        first=first,
        resolution=each(lambda p: p.resolution, np.int64),
        capture=each(lambda p: p.capture_point, np.float64, (3,)),
        owned=np.array([owned for _, owned in probes], np.uint8),
        influence=each(lambda p: np.linalg.inv(p.influence.world_from_volume), np.float64, (4, 4)),
        influence_sphere=each(lambda p: p.influence.sphere, np.uint8),
        influence_extents=each(lambda p: p.influence.extents, np.float64, (3,)),
        proxy=each(lambda p: np.linalg.inv((p.proxy or p.influence).world_from_volume), np.float64, (4, 4)),
        proxy_kind=each(kind, np.uint8),
        proxy_extents=each(lambda p: (p.proxy or p.influence).extents, np.float64, (3,)),
        blend=each(lambda p: p.blend_distance, np.float64, (6,)),
        blend_normal=each(lambda p: p.blend_normal_distance, np.float64, (6,)),
        face_fade=each(lambda p: p.face_fade, np.float64, (6,)),
        weight=each(fade, np.float64),
        multiplier=each(lambda p: p.multiplier, np.float64),
    )


# ------------------------------------------------------------------------------------------------ cube geometry


@inlined
def face_direction(face, x, y):  # type: ignore[no-untyped-def]
    """Unnormalised direction of face coordinates x, y in [-1, 1] (x right, y down, seen from the centre)."""
    if face == 0:
        return (1.0, -y, -x)
    if face == 1:
        return (-1.0, -y, x)
    if face == 2:
        return (x, 1.0, y)
    if face == 3:
        return (x, -1.0, -y)
    if face == 4:
        return (x, -y, 1.0)
    return (-x, -y, -1.0)


@inlined
def direction_face(d):  # type: ignore[no-untyped-def]
    """(face, x, y) that a direction meets: the inverse of `face_direction`."""
    ax, ay, az = abs(d[0]), abs(d[1]), abs(d[2])
    if ax >= ay and ax >= az:
        return (0, -d[2] / ax, -d[1] / ax) if d[0] > 0.0 else (1, d[2] / ax, -d[1] / ax)
    if ay >= az:
        return (2, d[0] / ay, d[2] / ay) if d[1] > 0.0 else (3, d[0] / ay, -d[2] / ay)
    return (4, d[0] / az, -d[1] / az) if d[2] > 0.0 else (5, -d[0] / az, -d[1] / az)


@inlined
def _texel(table, k, level, d):  # type: ignore[no-untyped-def]
    """Bilinear texel of one level: (r, g, b, coverage, distance)."""
    res = table.resolution[k] >> level
    stride = res + 2
    face, x, y = direction_face(d)
    px = (x + 1.0) * 0.5 * res + 0.5
    py = (y + 1.0) * 0.5 * res + 0.5
    x0 = min(max(int(px), 0), stride - 2)
    y0 = min(max(int(py), 0), stride - 2)
    fx, fy = px - x0, py - y0
    base = table.first[k, level] + ((face * stride + y0) * stride + x0) * TEXEL
    below = base + stride * TEXEL
    t = table.texels
    wa, wb, wc, wd = (1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy
    r = wa * t[base] + wb * t[base + 5] + wc * t[below] + wd * t[below + 5]
    g = wa * t[base + 1] + wb * t[base + 6] + wc * t[below + 1] + wd * t[below + 6]
    b = wa * t[base + 2] + wb * t[base + 7] + wc * t[below + 2] + wd * t[below + 7]
    a = wa * t[base + 3] + wb * t[base + 8] + wc * t[below + 3] + wd * t[below + 8]
    s = wa * t[base + 4] + wb * t[base + 9] + wc * t[below + 4] + wd * t[below + 9]
    return r, g, b, a, s


@inlined
def cube_at(table, k, d, lod):  # type: ignore[no-untyped-def]
    """Trilinear (r, g, b, coverage, distance) of probe `k` in a direction, which need not be unit."""
    last = 0
    while last + 1 < table.first.shape[1] and table.first[k, last + 1] >= 0:
        last += 1
    lod = min(max(lod, 0.0), float(last))
    low = int(lod)
    r, g, b, a, s = _texel(table, k, low, d)
    f = lod - low
    if f > 0.0 and low < last:
        r1, g1, b1, a1, s1 = _texel(table, k, low + 1, d)
        return r + (r1 - r) * f, g + (g1 - g) * f, b + (b1 - b) * f, a + (a1 - a) * f, s + (s1 - s) * f
    return r, g, b, a, s


# ------------------------------------------------------------------------------------------------ lookup


@inlined
def proxy_distance(table, k, p, d):  # type: ignore[no-untyped-def]
    """Distance from `p` along unit `d` to the proxy volume of probe `k`, at least 0 [m]."""
    if table.proxy_kind[k] == 2:
        return INFINITE_DISTANCE
    m = table.proxy[k]
    o, v = transform_point(m, p), transform_direction(m, d)
    e = row(table.proxy_extents, k)
    s = ray_sphere(o, v, e[0]) if table.proxy_kind[k] == 1 else ray_box(o, v, e)
    return max(s, 0.0)


@inlined
def influence(table, k, p, n, d):  # type: ignore[no-untyped-def]
    """Weight 0 .. 1 of probe `k` at a point, for a ray along `d` from a surface with normal `n`."""
    m = table.influence[k]
    q = transform_point(m, p)
    from_capture = sub(p, row(table.capture, k))
    e = row(table.influence_extents, k)
    if table.influence_sphere[k] != 0:
        w = influence_sphere(q, n, from_capture, e[0], table.blend[k, 0], table.blend_normal[k, 0])
    else:
        w = influence_box(
            q, n, transform_direction(m, d), from_capture, e, table.blend[k], table.blend_normal[k], table.face_fade[k]
        )
    return w * table.weight[k]


@inlined
def probe_light(table, k, p, d, lod, environment, sky_follows):  # type: ignore[no-untyped-def]
    """Colour of probe `k` for a ray, the share of it that is not sky, and how far the proxy's guess can be trusted.

    The colour is already weighted by that share. `sky_follows`: a later tier will add the sky.
    """
    s = proxy_distance(table, k, p, d)
    to = sub(along(p, d, s), row(table.capture, k))
    r, g, b, coverage, seen = cube_at(table, k, to, lod)
    far = length(to)
    confidence = 0.0
    if seen > 0.0 and far > 0.0:
        confidence = min(seen, far) / max(seen, far)
    color = (r, g, b)
    if coverage < 1.0 and not sky_follows:
        if environment.present:
            sky = radiance(environment, normalize(to), 0.0)
            left = 1.0 - coverage
            color = (r + sky[0] * left, g + sky[1] * left, b + sky[2] * left)
        coverage = 1.0
    return scale(color, table.multiplier[k]), coverage, confidence


# ------------------------------------------------------------------------------------------------ capture


@kernel
def capture_rows(world, table, scratch, k, face, y0, y1, mask, near, far, samples):  # type: ignore[no-untyped-def]
    """Draw rows y0 .. y1 (multiples of 4, border included) of one face of probe `k`. Returns rays traced."""
    packet, block, second, limit = scratch.packet, scratch.block, scratch.second, scratch.far
    packet.tally[0] = 0
    res = table.resolution[k]
    stride = res + 2
    centre = row(table.capture, k)
    for by in range(y0, y1, BLOCK_HEIGHT):
        for bx in range(0, stride, BLOCK_WIDTH):
            for sample in range(samples):
                clear(packet)
                for lane in range(LANES):
                    x, y = bx + lane % BLOCK_WIDTH, by + lane // BLOCK_WIDTH
                    if x >= stride or y >= stride:
                        continue
                    block.pixel[lane, 0], block.pixel[lane, 1] = x + stride * face, y + 4099 * (k + 1)
                    d = face_direction(face, (x - 0.5) / res * 2.0 - 1.0, (y - 0.5) / res * 2.0 - 1.0)
                    stretch = length(d)
                    limit[lane] = far * stretch
                    set_ray(packet, lane, centre, scale(d, 1.0 / stretch), near * stretch, limit[lane], mask)
                intersect_world(packet, world, limit, COHERENT)
                load_hits(block, packet, world, 2.0 / res)
                shade(block, second, packet, world, sample, mask)
                _keep_texels(table, k, face, bx, by, block, 1.0 / samples)
    return packet.tally[0]


@inlined
def _keep_texels(table, k, face, bx, by, block, share):  # type: ignore[no-untyped-def]
    stride = table.resolution[k] + 2
    for lane in range(LANES):
        x, y = bx + lane % BLOCK_WIDTH, by + lane // BLOCK_WIDTH
        if x >= stride or y >= stride or block.on[lane] == 0:
            continue
        i = table.first[k, 0] + ((face * stride + y) * stride + x) * TEXEL
        for c in range(3):
            table.texels[i + c] += block.color[lane, c] * share
        table.texels[i + 3] += share
        table.texels[i + 4] += block.distance[lane] * share


@kernel
def fill_levels(table, k):  # type: ignore[no-untyped-def]
    """Make the levels of probe `k` from level 0: 2x2 averages, borders looked up across the edge."""
    level = 1
    while level < table.first.shape[1] and table.first[k, level] >= 0:
        res, stride = table.resolution[k] >> level, (table.resolution[k] >> level) + 2
        above = table.first[k, level - 1]
        wide = (table.resolution[k] >> (level - 1)) + 2
        for face in range(6):
            for y in range(res):
                for x in range(res):
                    i = table.first[k, level] + ((face * stride + y + 1) * stride + x + 1) * TEXEL
                    j = above + ((face * wide + 2 * y + 1) * wide + 2 * x + 1) * TEXEL
                    for c in range(TEXEL):
                        t = table.texels
                        below = j + wide * TEXEL
                        t[i + c] = 0.25 * (t[j + c] + t[j + TEXEL + c] + t[below + c] + t[below + TEXEL + c])
        _fill_border(table, k, level, res)
        level += 1


@inlined
def _fill_border(table, k, level, res):  # type: ignore[no-untyped-def]
    """Border texels of a level: the nearest inner texel of the neighbouring face."""
    stride = res + 2
    for face in range(6):
        for y in range(stride):
            for x in range(stride):
                if 0 < x < stride - 1 and 0 < y < stride - 1:
                    continue
                d = face_direction(face, (x - 0.5) / res * 2.0 - 1.0, (y - 0.5) / res * 2.0 - 1.0)
                other, u, v = direction_face(d)
                ix = min(max(int((u + 1.0) * 0.5 * res), 0), res - 1) + 1
                iy = min(max(int((v + 1.0) * 0.5 * res), 0), res - 1) + 1
                i = table.first[k, level] + ((face * stride + y) * stride + x) * TEXEL
                j = table.first[k, level] + ((other * stride + iy) * stride + ix) * TEXEL
                for c in range(TEXEL):
                    table.texels[i + c] = table.texels[j + c]
