"""The lights of a scene laid out for kernels: `lights.LightTable`. Nothing here raises."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..scene import F32, Light, LightKind, Scene, Shaping
from .embree import CASTER_SHIFTS
from .glow import Glow, no_glow
from .instances import paths_of, thing_count
from .lights import KINDS, LightTable, ShapeTable
from .tables import caster_sets

_MOST_PICTURE = 512
"""Texels along a side of the picture on a light."""


def pack_lights(scene: Scene, eye: NDArray[np.float64], glow: Glow | None = None) -> LightTable:
    """Lights of a scene that shine; with none at all, one at the eye that lights a white surface facing it to 1.

    A light of radiance 0 is left out: it would cost its shadow rays and bring nothing.

    Args:
        glow: what the stage's own surfaces emit, if that lights anything.
    """
    lights = [light for light in scene.lights if any(light.radiance) and not light.seen]
    roots = [-1] * len(lights) + list(glow.roots if glow else ())
    lights += glow.lights if glow else ()
    lights += [_camera_light(eye)] if scene.camera_light else []
    places = [light.world_from_light for light in lights]
    n = len(lights)
    sets = caster_sets(scene)
    shifts = [0 if x.casters is None else CASTER_SHIFTS[sets.index(frozenset(x.casters))] for x in lights]
    groups = list(dict.fromkeys(light.lit for light in lights if light.lit is not None))
    shadows = [light.shadow for light in lights]
    return LightTable(
        kind=np.array([light.kind for light in lights], np.int32),
        axes=np.array([[m[:3, 0], m[:3, 1], -m[:3, 2], m[:3, 3]] for m in places], np.float64).reshape(n, 4, 3),
        size=np.array([np.multiply(x.size, _size_factor(x.kind)) for x in lights], np.float64).reshape(n, 2),
        radiance=np.array([light.radiance for light in lights], np.float64).reshape(n, 3),
        diffuse=np.array([light.diffuse for light in lights], np.float64),
        specular=np.array([light.specular for light in lights], np.float64),
        casts_shadow=np.array([light.kind.casts_shadow and light.casts_shadow for light in lights], np.uint8),
        even=np.array([_is_even(light.shaping) for light in lights], np.uint8),
        shapes=_pack_shapes([light.shaping for light in lights]),
        hidden=np.array([shadow.color for shadow in shadows], np.float64).reshape(n, 3),
        reach=np.array([(s.distance, s.falloff, 1.0 / s.gamma) for s in shadows], np.float64).reshape(n, 3),
        caster_shift=np.array(shifts, np.int32),
        link=np.array([-1 if light.lit is None else groups.index(light.lit) for light in lights], np.int32),
        linked=_linked(scene, groups),
        root=np.array(roots + [-1] * (n - len(roots)), np.int32),
        glow=glow.tree if glow else no_glow(),
    )


def _linked(scene: Scene, groups: list[tuple[str, ...]]) -> NDArray[np.uint8]:
    """`LightTable.linked` for groups of paths."""
    if not groups:
        return np.zeros((0, 0), np.uint8)
    owners, counts = zip(*paths_of(scene), strict=True) if thing_count(scene) else ((), ())
    lit = [[owner in group for owner in owners] for group in map(frozenset, groups)]
    return np.repeat(np.array(lit, np.uint8).reshape(len(groups), len(owners)), np.array(counts, np.int64), axis=1)


def _size_factor(kind: LightKind) -> tuple[float, float]:
    return KINDS[kind].size_factor if kind in KINDS else (1.0, 1.0)


def _is_even(shaping: Shaping) -> bool:
    whole = shaping.cone >= math.pi and (shaping.focus == 0.0 or min(shaping.focus_tint) == 1.0)
    return whole and shaping.profile is None and shaping.picture is None


def _pack_shapes(shapings: list[Shaping]) -> ShapeTable:
    """Columns, and one pool of all profiles and pictures."""
    n = len(shapings)
    profiles, pictures = np.zeros((n, 3), np.int64), np.full((n, 2), -1, np.int64)
    pool: list[F32] = []
    filled = 0
    for k, shaping in enumerate(shapings):
        if shaping.profile is not None:
            profiles[k] = filled, *shaping.profile.shape
            pool.append(np.ascontiguousarray(shaping.profile, np.float32).reshape(-1))
            filled += pool[-1].size
        if shaping.picture is not None and shaping.picture.size > 0:
            levels = _picture_levels(shaping.picture)
            pictures[k] = filled, len(levels) - 1
            pool += [level.reshape(-1) for level in levels]
            filled += sum(level.size for level in levels)
    cones = [(s.cone * (1.0 - s.softness), s.cone) if s.cone < math.pi else (math.pi, math.pi) for s in shapings]
    return ShapeTable(
        focus=np.array([shaping.focus for shaping in shapings], np.float64),
        tint=np.array([shaping.focus_tint for shaping in shapings], np.float64).reshape(n, 3),
        cone=np.array(cones, np.float64).reshape(n, 2),
        profile=profiles,
        picture=pictures,
        pool=np.concatenate(pool) if pool else np.zeros(1, np.float32),
    )


def _picture_levels(picture: F32) -> list[F32]:
    """A picture as squares of 1, 4, 16 ... texels, each the exact mean of what it covers."""
    side = 1 << min(max(*picture.shape[:2]) - 1, _MOST_PICTURE - 1).bit_length()
    values = np.nan_to_num(picture.astype(np.float64), nan=0.0, posinf=1e30, neginf=0.0)
    levels = [_means(_means(values, side).swapaxes(0, 1), side).swapaxes(0, 1)]
    while len(levels[0]) > 1:
        half = len(levels[0]) // 2
        levels.insert(0, levels[0].reshape(half, 2, half, 2, 3).mean(axis=(1, 3)))
    return [np.ascontiguousarray(level, np.float32) for level in levels]


def _means(values: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Means of `count` equal pieces along the first axis, whose edges may cut rows."""
    sums = np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, axis=0)])
    edges = np.linspace(0.0, len(values), count + 1)
    whole = np.minimum(edges.astype(np.int64), len(values) - 1)
    upto = sums[whole] + values[whole] * (edges - whole).reshape(-1, *[1] * (values.ndim - 1))
    return np.diff(upto, axis=0) * (count / len(values))


def _camera_light(eye: NDArray[np.float64]) -> Light:
    """E = pi on what faces it, so that Lambert's albedo E / pi is the albedo."""
    place = np.eye(4)
    place[:3, 3] = eye
    return Light("", LightKind.CAMERA, (math.pi, math.pi, math.pi), place)
