"""The screen tier as HDRP has it: one guess at a proxy volume, found again in the opaque picture (Lit.hlsl,
ScreenSpaceTracing.hlsl). Smooth glass only: rough glass reads blurred levels of the picture. What marches through the
depth is not known here."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from refract_core.scene import Volume

from .vec import ZERO, Vec, add, at, clamp, dot, scaled, vec

_FADE = 0.1
"""Screen Weight Distance."""
_INFINITE = 65504.0

Look = Callable[[int, int], tuple[Vec, float, float]]
"""Colour, depth and coverage of a pixel of the opaque picture."""
Project = Callable[[Vec], tuple[float, float, float]]
"""Pixel coordinates and depth of a point."""


class Found(NamedTuple):
    color: Vec
    weight: float
    confidence: float
    coverage: float = 1.0
    """of the weight, the share that is answered; the colour has it in it"""


NOTHING = Found(ZERO, 0.0, 0.0)


def by_proxy(
    origin: Vec, d: Vec, proxy: Volume | None, size: tuple[int, int], own: tuple[float, float, float],
    look: Look, project: Project,
) -> Found:  # fmt: skip
    """`own`: pixel coordinates and depth of the glass itself."""
    px, py, z = project(at(origin, d, proxy_distance(origin, d, proxy)))
    width, height = size
    weight = edge_fade(px / width) * edge_fade(py / height)
    if z <= 0.0 or weight <= 0.0:
        return NOTHING
    _, there, _ = look(min(int(px), width - 1), min(int(py), height - 1))
    if there <= own[2]:  # in front of the glass: the pixel itself is shown instead
        color, covered = _bilinear(look, size, own[0], own[1])
        return Found(color, weight, 0.0, covered)
    right = min(z, there) / max(z, there) if there < math.inf else 0.0
    color, covered = _bilinear(look, size, px, py)
    return Found(color, weight, right, covered)


def proxy_distance(origin: Vec, d: Vec, proxy: Volume | None) -> float:
    """To where the ray leaves the volume; 0 where it does not meet it."""
    if proxy is None:
        return _INFINITE
    m = np.asarray(proxy.world_from_volume)
    axes, centre = [vec(m[:3, c]) for c in range(3)], vec(m[:3, 3])
    away = add(origin, scaled(centre, -1.0))
    o, v = vec(dot(a, away) for a in axes), vec(dot(a, d) for a in axes)
    if proxy.sphere:
        middle = -dot(o, v)
        squared = proxy.extents[0] ** 2 - dot(o, o) + middle * middle
        return max(0.0, middle + math.sqrt(squared)) if squared >= 0.0 else 0.0
    near, far = 0.0, math.inf
    for c in range(3):
        sides = sorted((s * proxy.extents[c] - o[c]) / v[c] for s in (-1.0, 1.0))
        near, far = max(near, sides[0]), min(far, sides[1])
    return far if far >= near else 0.0


def edge_fade(u: float) -> float:
    """1 inside, 0 at the edge of the screen, half the fade's length on each side (HDRP, EdgeOfScreenFade)."""
    x = clamp((1.0 - abs(2.0 * u - 1.0)) / _FADE)
    return x * x * (3.0 - 2.0 * x)


def _bilinear(look: Look, size: tuple[int, int], px: float, py: float) -> tuple[Vec, float]:
    x, y = clamp(px - 0.5, 0.0, size[0] - 1.0), clamp(py - 0.5, 0.0, size[1] - 1.0)
    i, j = int(x), int(y)
    total, covered = ZERO, 0.0
    for column, u in ((i, 1.0 - x + i), (min(i + 1, size[0] - 1), x - i)):
        for row, v in ((j, 1.0 - y + j), (min(j + 1, size[1] - 1), y - j)):
            color, _, coverage = look(column, row)
            total, covered = add(total, scaled(color, u * v)), covered + coverage * u * v
    return total, covered
