"""Texture lookup: wrap modes, mip chain in linear light, trilinear filtering."""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from refract_core.scene import Texture, Wrap

Rgba = tuple[float, float, float, float]
Level = list[list[Rgba]]
"""Rows from the top."""

_NOTHING: Rgba = (0.0, 0.0, 0.0, 0.0)
_CHAINS: dict[int, tuple[Texture, list[Level]]] = {}


def sample(texture: Texture, s: float, t: float, footprint: float, wrap: tuple[Wrap, Wrap]) -> Rgba:
    """Colour at st, `footprint` wide in st. t = 0 is the lower edge of the picture."""
    chain = _chain(texture)
    height, width = len(chain[0]), len(chain[0][0])
    texels = footprint * max(width, height)
    lod = min(math.log2(texels), len(chain) - 1.0) if texels > 1.0 else 0.0
    fine = int(lod)
    a = _bilinear(chain[fine], s, 1.0 - t, wrap)
    if lod == fine:
        return a
    b = _bilinear(chain[fine + 1], s, 1.0 - t, wrap)
    part = lod - fine
    return _blend([(a, 1.0 - part), (b, part)])


def _chain(texture: Texture) -> list[Level]:
    """All levels, finest first; made once per texture."""
    if id(texture) not in _CHAINS:
        _CHAINS[id(texture)] = (texture, _levels(texture))
    return _CHAINS[id(texture)][1]


def _levels(texture: Texture) -> list[Level]:
    is_bytes = texture.pixels.dtype == np.uint8
    linear: Level = [[_linear(texel, texture) for texel in row] for row in texture.pixels]
    shown, exact = [linear], linear
    while len(exact) > 1 or len(exact[0]) > 1:
        exact = _halved(exact)
        stored = [[_stored(texel, texture.srgb) for texel in row] for row in exact] if is_bytes else exact
        shown.append(stored)
    return shown


def _linear(texel: object, texture: Texture) -> Rgba:
    r, g, b, a = (float(x) for x in texel)  # type: ignore[attr-defined]
    if texture.pixels.dtype != np.uint8:
        return (r, g, b, a)
    curve = _decoded if texture.srgb else (lambda x: x)
    return (curve(r / 255), curve(g / 255), curve(b / 255), a / 255)


def _decoded(x: float) -> float:
    """IEC 61966-2-1."""
    return x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4


def _encoded(x: float) -> float:
    return x * 12.92 if x <= 0.0031308 else 1.055 * x ** (1 / 2.4) - 0.055


@cache
def _as_byte(word: int, srgb: bool) -> int:
    linear = word / 65535
    return round((_encoded(linear) if srgb else linear) * 255)


def _stored(texel: Rgba, srgb: bool) -> Rgba:
    """A smaller level of an 8-bit picture is 8-bit too; light goes into bytes by way of 16 bits."""
    values = []
    for channel, x in enumerate(texel):
        curved = srgb and channel < 3
        byte = _as_byte(int(min(x, 1.0) * 65535 + 0.5), curved)
        values.append(_decoded(byte / 255) if curved else byte / 255)
    return (values[0], values[1], values[2], values[3])


def _halved(fine: Level) -> Level:
    """Half the texels each way, rounded down; each is the mean of the area it covers (Guthe and Heckbert 2005)."""
    rows, columns = _covers(len(fine)), _covers(len(fine[0]))
    return [
        [_blend([(fine[y][x], v * u) for y, v in row for x, u in column]) for column in columns]
        for row in rows
    ]


def _covers(size: int) -> list[list[tuple[int, float]]]:
    """For each new texel along one axis: the old ones under it, and what share of it each fills."""
    half = max(size // 2, 1)
    step = size / half
    found = []
    for i in range(half):
        low, high = i * step, (i + 1) * step
        inside = [(k, (min(high, k + 1) - max(low, k)) / step) for k in range(int(low), min(math.ceil(high), size))]
        found.append([(k, share) for k, share in inside if share > 1e-12])
    return found


def _blend(parts: list[tuple[Rgba, float]]) -> Rgba:
    r = g = b = a = 0.0
    for texel, share in parts:
        r += texel[0] * share
        g += texel[1] * share
        b += texel[2] * share
        a += texel[3] * share
    return (r, g, b, a)


def _bilinear(level: Level, x: float, y: float, wrap: tuple[Wrap, Wrap]) -> Rgba:
    """Lookup at (x, y) in picture sizes from the top left corner."""
    px, py = x * len(level[0]) - 0.5, y * len(level) - 0.5
    left, top = math.floor(px), math.floor(py)
    u, v = px - left, py - top
    parts = []
    for row, share_y in ((top, 1.0 - v), (top + 1, v)):
        for column, share_x in ((left, 1.0 - u), (left + 1, u)):
            parts.append((_texel(level, column, row, wrap), share_x * share_y))
    return _blend(parts)


def _texel(level: Level, column: int, row: int, wrap: tuple[Wrap, Wrap]) -> Rgba:
    i, j = _wrapped(column, len(level[0]), wrap[0]), _wrapped(row, len(level), wrap[1])
    return _NOTHING if i is None or j is None else level[j][i]


def _wrapped(i: int, size: int, wrap: Wrap) -> int | None:
    if wrap is Wrap.REPEAT:
        return i % size
    if wrap is Wrap.MIRROR:
        return i % size if i // size % 2 == 0 else size - 1 - i % size
    if wrap is Wrap.CLAMP:
        return min(max(i, 0), size - 1)
    return i if 0 <= i < size else None
