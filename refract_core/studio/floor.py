"""A floor under what is drawn: a disc that fades, with distance, into what the dome shows below its horizon."""

from __future__ import annotations

import math

import numpy as np

from ..scene import Material, Mesh, Model, Param, Source

_AIR = 2e-4
"""Of the thing's size, between it and the floor, so that their surfaces do not fall together."""
_FADE = (0.8, 4.0)
"""Sizes of the thing between which the floor becomes what it is far away."""
_RINGS, _SECTORS = 24, 64
_SHADE = "shade"

_MATT = {
    Param.ROUGHNESS: 1.0, Param.OPACITY: 1.0, Param.IOR: 1.0, Param.OCCLUSION: 1.0, Param.THICKNESS: 1.0,
    Param.TRANSMITTANCE: 1.0,
}  # fmt: skip


def floor_material(name: str) -> Material:
    """Matt, in the greys of `floor_mesh`."""
    sources = []
    for param in Param:
        value = _MATT.get(param, 0.0)
        source = Source(value=(value, value, value, 1.0))
        if param is Param.DIFFUSE:
            source = Source(primvar=_SHADE)
        elif param is Param.NORMAL:
            source = Source(value=(0.0, 0.0, 1.0, 1.0))
        sources.append(source)
    return Material(name, tuple(sources), Model.NONE)


def floor_mesh(
    path: str,
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]],
    material: int,
    albedo: tuple[float, float],
) -> Mesh:
    """The disc right under some bounds.

    Args:
        bounds: lowest and highest corner [m]
        material: index of `floor_material`
        albedo: under the thing, and far away
    """
    low, high = np.array(bounds, np.float64)
    size = float((high - low).max()) or 1.0
    middle = (low + high) / 2.0
    radii = np.concatenate([[0.0], np.linspace(_FADE[0], _FADE[1], _RINGS)]) * size
    turns = np.arange(_SECTORS) * (2.0 * math.pi / _SECTORS)
    rings = radii[1:, None, None] * np.stack([np.sin(turns), 0.0 * turns, np.cos(turns)], axis=-1)
    centre = np.array([middle[0], low[1] - _AIR * size, middle[2]])
    points = centre + np.concatenate([np.zeros((1, 3)), rings.reshape(-1, 3)])
    k = np.arange(_SECTORS)
    after = (k + 1) % _SECTORS
    faces = [np.stack([0 * k, 1 + k, 1 + after], axis=1)]
    for ring in range(_RINGS - 1):
        a, b = 1 + ring * _SECTORS, 1 + (ring + 1) * _SECTORS
        faces += [np.stack([a + k, b + k, b + after], axis=1), np.stack([a + k, b + after, a + after], axis=1)]
    triangles = np.concatenate(faces).astype(np.uint32)
    t = np.clip((radii / size - _FADE[0]) / (_FADE[1] - _FADE[0]), 0.0, 1.0)
    grey = albedo[0] + (albedo[1] - albedo[0]) * t * t * (3.0 - 2.0 * t)
    at = np.concatenate([grey[:1], np.repeat(grey[1:], _SECTORS)]).astype(np.float32)
    shade = np.repeat(at[triangles][..., None], 3, axis=-1)
    return Mesh(
        path, points.astype(np.float32), triangles, np.full(len(triangles), material, np.int32), None,
        {_SHADE: shade}, double_sided=True,
    )  # fmt: skip
