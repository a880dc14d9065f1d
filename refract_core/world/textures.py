"""Textures as kernels see them: one pool of texels with mip chains, and one function that samples it.

The mip chain follows the usual rule (level k+1 has half the texels, rounded down, at least one), filtered in linear
light. 8-bit images stay 8-bit, so a 4k texture costs 90 MB and not 360.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..images.srgb import srgb_decode, srgb_encode
from ..kernels.arrays import BOOL_1D, F32_2D, F32_3D, I32_1D, I64_3D, U8_2D, U8_3D
from ..kernels.compile import kernel, leaf
from ..scene import F32, Texture, Wrap

Rgba = tuple[float, float, float, float]
Texels = tuple[int, int, int, int]
Weights = tuple[float, float, float, float]

MAX_LEVELS = 32
"""More than any image has whose sides are below 2^31."""

LARGEST = 65504.0
"""What an infinite texel becomes (the largest half): infinity times a weight of zero would be NaN."""

_OFFSET, _WIDTH, _HEIGHT = 0, 1, 2
_BLACK, _CLAMP, _REPEAT, _MIRROR = int(Wrap.BLACK), int(Wrap.CLAMP), int(Wrap.REPEAT), int(Wrap.MIRROR)


class TextureTable(NamedTuple):
    """All textures of a scene."""

    bytes_pool: U8_2D
    """shape (N, 4): texels of every 8-bit level, row by row from the top"""
    float_pool: F32_2D
    """shape (M, 4): texels of every float level, linear"""
    levels: I64_3D
    """shape (T, MAX_LEVELS, 3): first texel in the pool, width, height of each level"""
    counts: I32_1D
    """shape (T,): number of levels"""
    is_float: BOOL_1D
    """shape (T,): which pool"""
    srgb: I32_1D
    """shape (T,): row of `decode` for RGB (alpha uses row 0)"""
    decode: F32_2D
    """shape (2, 256): value of a byte, linear (row 0) and sRGB-encoded (row 1)"""


# --- packing -----------------------------------------------------------------------------------------------------


def pack(textures: Sequence[Texture]) -> TextureTable:
    """Put textures and their mip chains into one table. NaN texels become 0, infinite ones `LARGEST`.

    Args:
        textures: in the order of their indices; may be empty.
    """
    count = len(textures)
    levels = np.zeros((max(count, 1), MAX_LEVELS, 3), np.int64)
    counts = np.zeros(max(count, 1), np.int32)
    is_float = np.array([t.pixels.dtype != np.uint8 for t in textures] or [False])
    srgb = np.array([int(t.srgb) for t in textures] or [0], np.int32)
    filled = [0, 0]
    for index, texture in enumerate(textures):
        sizes = _level_sizes(*texture.pixels.shape[:2])
        counts[index] = len(sizes)
        for level, (height, width) in enumerate(sizes):
            pool = int(is_float[index])
            levels[index, level] = filled[pool], width, height
            filled[pool] += width * height
    bytes_as_floats = (np.arange(256) / 255.0).astype(np.float32)
    decode = np.stack([bytes_as_floats, srgb_decode(bytes_as_floats)])
    bytes_pool = np.empty((max(filled[0], 1), 4), np.uint8)
    float_pool = np.empty((max(filled[1], 1), 4), np.float32)
    for index, texture in enumerate(textures):
        pool_of_texels: NDArray[Any] = float_pool if is_float[index] else bytes_pool
        _fill(pool_of_texels, levels[index, : counts[index]], texture, decode)
    return TextureTable(bytes_pool, float_pool, levels, counts, is_float, srgb, decode)


def _level_sizes(height: int, width: int) -> list[tuple[int, int]]:
    sizes = [(height, width)]
    while height > 1 or width > 1:
        height, width = max(height // 2, 1), max(width // 2, 1)
        sizes.append((height, width))
    return sizes


@cache
def _encode_words() -> NDArray[np.uint8]:
    """shape (2, 65536): linear light in 16 bits to a byte, fine enough that every byte comes back; rows as `decode`."""
    linear = (np.arange(65536) / 65535.0).astype(np.float32)
    return np.rint(np.stack([linear, srgb_encode(linear)]) * 255.0).astype(np.uint8)


def _fill(pool: NDArray[Any], levels: NDArray[np.int64], texture: Texture, decode: F32) -> None:
    """Write a texture and its smaller levels into their places."""
    finer: NDArray[Any] = texture.pixels
    curve = int(texture.srgb)
    for level, (offset, width, height) in enumerate(levels):
        place = pool[offset : offset + width * height].reshape(height, width, 4)
        if level == 0 and pool.dtype != np.uint8:
            place[...] = finer
            for row in place:  # in place and row by row: a large texture fits into memory twice, not four times
                np.nan_to_num(row, copy=False, nan=0.0, posinf=LARGEST, neginf=-LARGEST)
            finer = place
        elif level == 0:
            place[...] = finer
        elif pool.dtype == np.uint8:
            coarser = np.empty((height, width, 4), np.float32)
            if level == 1:
                _halve_bytes(np.ascontiguousarray(finer), decode, curve, coarser)
            else:
                _halve_floats(finer, coarser)
            _encode(coarser, _encode_words(), curve, place)
            finer = coarser
        else:
            _halve_floats(finer, place)
            finer = place


@leaf
def _cover(i: int, size: int) -> tuple[int, float, float, float]:
    """How many old texels new texel `i` covers, from 2i on, and the share of each, when `size` is halved.

    With an odd number 2m + 1, a new texel covers 2 + 1/m old ones, so three of them weigh in
    (Guthe and Heckbert, "Non-Power-of-Two Mipmap Creation", NVIDIA 2005).
    """
    if size == 1:
        return 1, 1.0, 0.0, 0.0
    half = size // 2
    if size % 2 == 0:
        return 2, 0.5, 0.5, 0.0
    return 3, (half - i) / size, half / size, (i + 1) / size


@leaf
def _share(cover: tuple[int, float, float, float], tap: int) -> float:
    return cover[1] if tap == 0 else cover[2] if tap == 1 else cover[3]


@kernel
def _halve_floats(finer: F32_3D, coarser: F32_3D) -> None:
    """Fill `coarser` with the mean of what each of its texels covers. Shapes (H, W, 4) and (H/2, W/2, 4)."""
    for y in range(coarser.shape[0]):
        rows = _cover(y, finer.shape[0])
        for x in range(coarser.shape[1]):
            columns = _cover(x, finer.shape[1])
            r, g, b, a = 0.0, 0.0, 0.0, 0.0
            for j in range(rows[0]):
                for i in range(columns[0]):
                    share = _share(rows, j) * _share(columns, i)
                    r += share * finer[2 * y + j, 2 * x + i, 0]
                    g += share * finer[2 * y + j, 2 * x + i, 1]
                    b += share * finer[2 * y + j, 2 * x + i, 2]
                    a += share * finer[2 * y + j, 2 * x + i, 3]
            coarser[y, x, 0], coarser[y, x, 1], coarser[y, x, 2], coarser[y, x, 3] = r, g, b, a


@kernel
def _halve_bytes(finer: U8_3D, decode: F32_2D, curve: int, coarser: F32_3D) -> None:
    """As `_halve_floats`, from bytes to linear light."""
    for y in range(coarser.shape[0]):
        rows = _cover(y, finer.shape[0])
        for x in range(coarser.shape[1]):
            columns = _cover(x, finer.shape[1])
            r, g, b, a = 0.0, 0.0, 0.0, 0.0
            for j in range(rows[0]):
                for i in range(columns[0]):
                    share = _share(rows, j) * _share(columns, i)
                    r += share * decode[curve, finer[2 * y + j, 2 * x + i, 0]]
                    g += share * decode[curve, finer[2 * y + j, 2 * x + i, 1]]
                    b += share * decode[curve, finer[2 * y + j, 2 * x + i, 2]]
                    a += share * decode[0, finer[2 * y + j, 2 * x + i, 3]]
            coarser[y, x, 0], coarser[y, x, 1], coarser[y, x, 2], coarser[y, x, 3] = r, g, b, a


@kernel
def _encode(linear: F32_3D, encode_words: U8_2D, curve: int, out: U8_3D) -> None:
    """Linear light in [0, 1] to bytes; alpha stays linear."""
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            for channel in range(4):
                word = int(min(linear[y, x, channel], 1.0) * 65535.0 + 0.5)
                out[y, x, channel] = encode_words[curve if channel < 3 else 0, word]


# --- sampling ----------------------------------------------------------------------------------------------------


@leaf
def _wrapped(i: int, size: int, wrap: int) -> int:
    """Texel index inside [0, size), or -1 where the wrap mode is black."""
    if 0 <= i < size:
        return i
    if wrap == _REPEAT:
        return i % size
    if wrap == _MIRROR:
        i = i % (2 * size)
        return i if i < size else 2 * size - 1 - i
    if wrap == _CLAMP:
        return 0 if i < 0 else size - 1
    return -1


@leaf
def _reduced(x: float, wrap: int) -> float:
    """A coordinate near the image that shows the same as `x`, so that no integer overflows (np.floor stays a float)."""
    if wrap == _REPEAT:
        return x - np.floor(x)
    if wrap == _MIRROR:
        return x - 2.0 * np.floor(0.5 * x)
    return min(max(x, -1.0), 2.0)


@leaf
def mix(a: Rgba, b: Rgba, t: float) -> Rgba:
    """Between two colours of neighbouring levels: `a` at 0, `b` at 1."""
    return (
        a[0] + (b[0] - a[0]) * t,
        a[1] + (b[1] - a[1]) * t,
        a[2] + (b[2] - a[2]) * t,
        a[3] + (b[3] - a[3]) * t,
    )


@leaf
def _bilinear(table: TextureTable, index: int, level: int, x: float, y: float, wrap_s: int, wrap_t: int) -> Rgba:
    """One level at (x, y) in [image widths, image heights] from the top left corner, already reduced."""
    width = table.levels[index, level, _WIDTH]
    height = table.levels[index, level, _HEIGHT]
    x = x * width - 0.5
    y = y * height - 0.5
    left, top = math.floor(x), math.floor(y)
    c0, c1 = _wrapped(left, width, wrap_s), _wrapped(left + 1, width, wrap_s)
    r0, r1 = _wrapped(top, height, wrap_t), _wrapped(top + 1, height, wrap_t)
    fx, fy = x - left, y - top
    # A texel that is black keeps an index inside the image and loses its weight.
    wx0, wx1 = 0.0 if c0 < 0 else 1.0 - fx, 0.0 if c1 < 0 else fx
    wy0, wy1 = 0.0 if r0 < 0 else 1.0 - fy, 0.0 if r1 < 0 else fy
    above = table.levels[index, level, _OFFSET] + max(r0, 0) * width
    below = table.levels[index, level, _OFFSET] + max(r1, 0) * width
    at = (above + max(c0, 0), above + max(c1, 0), below + max(c0, 0), below + max(c1, 0))
    weights = (wx0 * wy0, wx1 * wy0, wx0 * wy1, wx1 * wy1)
    if table.is_float[index]:
        return _sum_floats(table.float_pool, at, weights)
    return _sum_bytes(table.bytes_pool, table.decode, int(table.srgb[index]), at, weights)


@leaf
def _sum_floats(pool: F32, at: Texels, weights: Weights) -> Rgba:
    a, b, c, d = np.uintp(at[0]), np.uintp(at[1]), np.uintp(at[2]), np.uintp(at[3])
    wa, wb, wc, wd = weights
    return (
        wa * pool[a, 0] + wb * pool[b, 0] + wc * pool[c, 0] + wd * pool[d, 0],
        wa * pool[a, 1] + wb * pool[b, 1] + wc * pool[c, 1] + wd * pool[d, 1],
        wa * pool[a, 2] + wb * pool[b, 2] + wc * pool[c, 2] + wd * pool[d, 2],
        wa * pool[a, 3] + wb * pool[b, 3] + wc * pool[c, 3] + wd * pool[d, 3],
    )


@leaf
def _sum_bytes(pool: NDArray[np.uint8], decode: F32, curve: int, at: Texels, weights: Weights) -> Rgba:
    a, b, c, d = np.uintp(at[0]), np.uintp(at[1]), np.uintp(at[2]), np.uintp(at[3])
    wa, wb, wc, wd = weights
    rgb = decode[curve]
    alpha = decode[0]
    return (
        wa * rgb[pool[a, 0]] + wb * rgb[pool[b, 0]] + wc * rgb[pool[c, 0]] + wd * rgb[pool[d, 0]],
        wa * rgb[pool[a, 1]] + wb * rgb[pool[b, 1]] + wc * rgb[pool[c, 1]] + wd * rgb[pool[d, 1]],
        wa * rgb[pool[a, 2]] + wb * rgb[pool[b, 2]] + wc * rgb[pool[c, 2]] + wd * rgb[pool[d, 2]],
        wa * alpha[pool[a, 3]] + wb * alpha[pool[b, 3]] + wc * alpha[pool[c, 3]] + wd * alpha[pool[d, 3]],
    )


@leaf
def sample(table: TextureTable, index: int, s: float, t: float, footprint: float, wrap_s: int, wrap_t: int) -> Rgba:
    """Filtered colour of a texture: trilinear over the mip chain, linear light.

    Args:
        table: from `pack`.
        index: which texture; one that does not exist gives zeros.
        s: to the right, 0 .. 1 over the image; NaN or infinity gives zeros.
        t: upwards, 0 at the bottom edge of the image.
        footprint: extent of the pixel in st, the larger of both axes; 0 takes the full-size image.
        wrap_s: a `refract_core.scene.Wrap`; BLACK is zero in all four channels.
        wrap_t: likewise.

    Returns:
        red, green, blue, alpha; not premultiplied.
    """
    if index < 0 or index >= table.counts.shape[0] or not (math.isfinite(s) and math.isfinite(t)):
        return (0.0, 0.0, 0.0, 0.0)
    last = table.counts[index] - 1
    if last < 0:
        return (0.0, 0.0, 0.0, 0.0)
    x = _reduced(s, wrap_s)
    y = _reduced(1.0 - t, wrap_t)
    texels = footprint * max(table.levels[index, 0, _WIDTH], table.levels[index, 0, _HEIGHT])
    lod = min(math.log2(texels), float(last)) if texels > 1.0 else 0.0  # 0 for NaN as well
    level = int(lod)
    finer = _bilinear(table, index, level, x, y, wrap_s, wrap_t)
    if lod == level:
        return finer
    coarser = _bilinear(table, index, level + 1, x, y, wrap_s, wrap_t)
    return mix(finer, coarser, lod - level)
