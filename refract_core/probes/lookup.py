"""The probe tier: pictures taken in the scene, looked up with local correction where their influence reaches.

A picture keeps colour, coverage (0 where the sky is seen) and distance. Where a texel shows the sky, the probe hands
its share on to the sky tier, which knows the direction exactly (Arm, "Combining reflections from a distant
environment"); where no sky tier follows, the probe adds the sky itself.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.arrays import F32_1D, F64_1D, F64_2D, F64_3D, I64_1D, I64_2D, U8_1D
from ..kernels.compile import inlined
from ..kernels.vec import Vec, along, length, row, scale, sub, transform_direction, transform_point
from ..optics.interface import probe_lod_hdrp
from ..optics.lobes import Cone
from ..scene import Camera, Probe
from ..world.environment import EnvironmentTable, prefiltered
from .depth import Depths, empty_depths, meet_depths
from .faces import CUBE, WINDOW, Picture, Texel, direction_face, layout, level_at, level_count
from .planar import window_of, window_weight
from .reach import Reach, reach_of
from .volumes import INFINITE_DISTANCE, distance_fade, influence_box, influence_sphere, ray_box, ray_sphere

_AVERAGE_MEDIAN = 0.59
"""Median radius of a level-0 texel looked up bilinearly, in texels; it doubles with every level of averages."""


class ProbeTable(NamedTuple):
    """All probes in the order in which they are asked: importance, then smaller volume (HDRP, 4.7)."""

    texels: F32_1D
    """flat pool of every picture's levels (see `faces`)"""
    first: I64_2D
    """shape (K, L): offset of each level in the pool"""
    side: I64_2D
    """shape (K, L): texels on a side of each level"""
    last: I64_1D
    """shape (K,): highest level"""
    planar: U8_1D
    capture: F64_2D
    """shape (K, 3) [m]"""
    eye: F64_2D
    """shape (K, 4): the camera in the influence volume's frame, homogeneous: a point [m] and 1, or for an orthographic
    camera the direction towards it and 0"""
    reach: Reach
    """of the influence volumes of those that serve everything"""
    influence: F64_3D
    """shape (K, 4, 4) volume_from_world"""
    influence_sphere: U8_1D
    influence_extents: F64_2D
    """shape (K, 3) [m]"""
    proxy: F64_3D
    """shape (K, 4, 4) volume_from_world"""
    proxy_kind: U8_1D
    """shape (K,): 0 box, 1 sphere, 2 infinite"""
    proxy_extents: F64_2D
    depths: Depths
    """of those that march their own distances instead"""
    blend: F64_2D
    """shape (K, 6) [m]"""
    blend_normal: F64_2D
    face_fade: F64_2D
    weight: F64_1D
    """shape (K,): weight with the fade by distance to the camera in it"""
    multiplier: F64_1D
    sharp_near: U8_1D
    """shape (K,): HDRP's distance-based roughness"""


class ProbeLight(NamedTuple):
    """What a probe shows to one ray. It lives as long as that ray is asked for."""

    color: Vec
    """radiance, already weighted by coverage"""
    coverage: float
    """0 .. 1: the share of it that is not sky"""
    fits: float
    """factor on the probe's weight: 0 where the picture does not show the place at all"""
    confidence: float
    """0 .. 1: how far the proxy's guess of the distance can be trusted"""


def camera_weight(probe: Probe, eye: NDArray[np.float64]) -> float:
    """The probe's weight with its fade by the distance of its origin to the camera at `eye`."""
    distance = float(np.linalg.norm(probe.influence.world_from_volume[:3, 3] - eye))
    return probe.weight * distance_fade(distance, max(probe.fade_distance, 1e-6))


def bounds_of(probe: Probe) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Low and high corner of the influence volume in engine world [m]."""
    m, extents = probe.influence.world_from_volume, np.array(probe.influence.extents)
    half = extents if probe.influence.sphere else np.abs(m[:3, :3]) @ extents
    return m[:3, 3] - half, m[:3, 3] + half


def empty_table(probes: list[Probe], drawn: list[bool], camera: Camera, rough: bool) -> ProbeTable:
    """A table with room for every level of every probe; `capture` fills the texels."""
    count = len(probes)
    faces = [WINDOW if p.planar else CUBE for p in probes]
    sizes = [p.cubemap.resolution if p.cubemap else p.resolution for p in probes]
    levels = [level_count(n, f, rough) for n, f in zip(sizes, faces, strict=True)]
    first = np.full((count, max(levels, default=1)), -1, np.int64)
    side = np.ones_like(first)
    total = 0
    for k in range(count):
        where, total = layout(sizes[k], levels[k], faces[k], total)
        first[k, : levels[k]], side[k, : levels[k]] = where
    eye = camera.world_from_camera[:3, 3]
    towards = np.array([*camera.world_from_camera[:3, 2], 0.0]) if camera.orthographic else np.array([*eye, 1.0])

    def each(get: Any, dtype: Any, shape: tuple[int, ...] = ()) -> NDArray[Any]:
        return np.array([get(p) for p in probes], dtype).reshape((count, *shape))

    def kind(p: Probe) -> int:
        return 2 if p.proxy is None else int(p.proxy.sphere)

    inverse = each(lambda p: np.linalg.inv(p.influence.world_from_volume), np.float64, (4, 4))
    bounds = np.array([bounds_of(p) for p in probes], np.float64).reshape(count, 2, 3)
    bounds[~np.array(drawn, bool)] = np.inf  # out of everybody's reach
    return ProbeTable(
        texels=np.zeros(total, np.float32),
        first=first,
        side=side,
        last=np.array(levels, np.int64) - 1,
        planar=each(lambda p: p.planar, np.uint8),
        capture=each(lambda p: p.capture_point, np.float64, (3,)),
        eye=np.ascontiguousarray(inverse @ towards),
        reach=reach_of(bounds[:, 0], bounds[:, 1]),
        influence=inverse,
        influence_sphere=each(lambda p: p.influence.sphere, np.uint8),
        influence_extents=each(lambda p: p.influence.extents, np.float64, (3,)),
        proxy=each(lambda p: np.linalg.inv((p.proxy or p.influence).world_from_volume), np.float64, (4, 4)),
        proxy_kind=each(kind, np.uint8),
        proxy_extents=each(lambda p: (p.proxy or p.influence).extents, np.float64, (3,)),
        depths=empty_depths(sizes, [p.marched and seen for p, seen in zip(probes, drawn, strict=True)]),
        blend=each(lambda p: p.blend_distance, np.float64, (6,)),
        blend_normal=each(lambda p: p.blend_normal_distance, np.float64, (6,)),
        face_fade=each(lambda p: p.face_fade, np.float64, (6,)),
        weight=each(lambda p: camera_weight(p, eye), np.float64),
        multiplier=each(lambda p: p.multiplier, np.float64),
        sharp_near=each(lambda p: p.distance_roughness, np.uint8),
    )


# ------------------------------------------------------------------------------------------------ volumes


@inlined
def picture_of(table: ProbeTable, k: int) -> Picture:
    """The levels of probe `k`, to be looked up."""
    return Picture(table.texels, table.first[k], table.side[k], table.last[k])


@inlined
def proxy_distance(table: ProbeTable, k: int, p: Vec, d: Vec) -> float:
    """Distance from `p` along unit `d` to the proxy volume of probe `k`, at least 0 [m]."""
    if table.proxy_kind[k] == 2:
        return INFINITE_DISTANCE
    m = table.proxy[k]
    o, v = transform_point(m, p), transform_direction(m, d)
    e = row(table.proxy_extents, k)
    # The volume's frame is turned and moved but not scaled, so a distance in it is one in the world.
    s = ray_sphere(o, v, e[0]) if table.proxy_kind[k] == 1 else ray_box(o, v, e)
    return max(s, 0.0)


@inlined
def influence(table: ProbeTable, k: int, p: Vec, n: Vec, d: Vec) -> float:
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


# ------------------------------------------------------------------------------------------------ lookup


@inlined
def cube_at(table: ProbeTable, k: int, d: Vec, lod: float) -> Texel:
    """Trilinear texel of cube `k` in a direction, which need not be unit."""
    face, x, y = direction_face(d)
    return level_at(picture_of(table, k), face, x, y, lod)


@inlined
def _cube_roughness(table: ProbeTable, k: int, ray: Cone, hdrp: bool, s: float, far: float) -> float:
    """Perceptual roughness of the lobe that the cube shall be looked up with.

    The cone of half angle atan(`blur`) is blur s wide where it meets the proxy, and the capture sees that from `far`
    away: nothing has to be guessed about distance. HDRP's own way takes the material's roughness as it is, or lowered
    by its distance-based roughness (LightEvaluation.hlsl).

    Args:
        s: distance from the ray's origin to the proxy [m].
        far: from the capture point to the same place [m].
    """
    if not hdrp:
        # The cone's tangent is twice the median slope of GGX, which is alpha, and alpha is roughness squared.
        return math.sqrt(min(1.0, 0.5 * ray.blur * s / max(far, 1e-9)))
    if table.sharp_near[k] == 0 or table.proxy_kind[k] == 2:
        return ray.roughness
    lowered = min(ray.roughness, s / max(far, 1e-9) * ray.roughness)
    return lowered + (ray.roughness - lowered) * ray.roughness


@inlined
def probe_light(
    table: ProbeTable, k: int, ray: Cone, hdrp: bool, environment: EnvironmentTable, sky_follows: bool, guesses: bool
) -> ProbeLight:
    """What probe `k` shows to a ray.

    Args:
        hdrp: roughness goes to levels by HDRP's mapping.
        sky_follows: a later tier will add the sky.
        guesses: whether it is asked for what it does not know, which is then by its proxy, or for what it knows.
    """
    # A picture knows what lies in a direction from the place it was taken at, not from the ray's origin. Its own
    # distances say where the ray ends, or the proxy stands for the scene: there the picture is asked.
    marches, known, s = table.depths.first[k] >= 0, True, 0.0
    if marches:
        met = meet_depths(table.depths, k, table.side[k, 0], row(table.capture, k), ray.origin, ray.direction)
        known, s = met.known, met.distance
    if known == guesses:
        return ProbeLight((0.0, 0.0, 0.0), 1.0, 0.0, 0.0)
    if guesses or not marches:
        s = proxy_distance(table, k, ray.origin, ray.direction)
    meets = along(ray.origin, ray.direction, s)
    if table.planar[k] != 0:
        eye, m, e = table.eye[k], table.influence[k], row(table.influence_extents, k)
        seen = window_of(eye, transform_point(m, meets), e, s * ray.blur)
        fits = 0.0
        if seen.face >= 0:
            fits = window_weight(eye, transform_point(m, ray.origin), e, seen)
        if fits <= 0.0:
            return ProbeLight((0.0, 0.0, 0.0), 1.0, 0.0, 0.0)
        # Averages are no lobes: level l has texels of 2^l, and the level is chosen whose texel blurs by the same
        # median radius; the sum of squares is 1 at level 0, which has some blur of its own.
        texels = seen.width / _AVERAGE_MEDIAN * table.side[k, 0]
        lod = 0.5 * math.log2(1.0 + texels * texels)
        r, g, b, coverage, distance = level_at(picture_of(table, k), seen.face, seen.x, seen.y, lod)
        sky, gloss, far = ray.direction, math.sqrt(min(1.0, 0.5 * ray.blur)), seen.distance
    else:
        fits = 1.0
        sky = sub(meets, row(table.capture, k))
        far = length(sky)
        gloss = _cube_roughness(table, k, ray, hdrp, s, far)
        r, g, b, coverage, distance = cube_at(table, k, sky, probe_lod_hdrp(gloss))
    # The picture tells how far away the thing in it was; the nearer that is to the proxy, the better the guess.
    confidence = 0.0
    if distance > 0.0 and far > 0.0 and not guesses:
        confidence = min(distance, far) / max(distance, far)
    # Where the picture is open the sky shows; without a sky nobody knows what is there, and the share is left open.
    if coverage < 1.0 and environment.present and not sky_follows:
        light = prefiltered(environment, sky, gloss)
        left = 1.0 - coverage
        r, g, b = r + light[0] * left, g + light[1] * left, b + light[2] * left
        coverage = 1.0
    return ProbeLight(scale((r, g, b), table.multiplier[k]), coverage, fits, confidence)
