"""Square faces of texels in levels: how a probe's picture is kept and looked up.

A picture is six faces of a cube, or the two of a window (`planar`). A face of n x n texels is kept as (n + 2)^2: one
texel of border on every side, so that bilinear lookups never leave it. The border of a cube's face repeats the texels
of its neighbours, and its corners are the mean of the three texels that meet there: both sides of an edge then compute
the same value, and no seam shows on any level, however coarse.

Level m has n = max(1, resolution >> m) texels on a side. A cube's levels above 0 are blurred by GGX lobes
(`filter_face`); a window's are averages.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.compile import inlined, kernel
from ..kernels.vec import add, frame, normalize, scale
from ..optics.interface import probe_roughness_hdrp
from ..scene import CUBE_LEVELS

TEXEL = 5
"""Floats per texel: red, green, blue (premultiplied by coverage), coverage, distance [m]."""
CUBE, WINDOW = 6, 2
"""Number of faces."""
_LOBE_SAMPLES = 24
"""Doubled on every level: lobes get wider, texels fewer."""
_COARSER = 0.5
"""Levels by which averages are read coarser than a sample's share of the lobe, so that shares overlap and hide."""


class Levels(NamedTuple):
    """Where the levels of one picture lie in a pool of floats."""

    first: NDArray[np.int64]
    """shape (L,): offset of each level in the pool; -1 for none"""
    side: NDArray[np.int64]
    """shape (L,): texels on a side, without the border"""


def side_of(resolution: int, level: int) -> int:
    """Texels on a side of a level, without the border."""
    return max(1, resolution >> level)


def layout(resolution: int, count: int, faces: int, start: int = 0) -> tuple[Levels, int]:
    """Room for `count` levels from `start` in a pool, and where the pool goes on."""
    first, side = [], []
    for level in range(count):
        n = side_of(resolution, level)
        first.append(start)
        side.append(n)
        start += faces * (n + 2) ** 2 * TEXEL
    return Levels(np.array(first, np.int64), np.array(side, np.int64)), start


def view_of_level(pool: NDArray[np.float32], levels: Levels, level: int, faces: int) -> NDArray[np.float32]:
    """A level's texels as shape (faces, n + 2, n + 2, TEXEL), sharing memory with the pool."""
    n, first = int(levels.side[level]), int(levels.first[level])
    return pool[first : first + faces * (n + 2) ** 2 * TEXEL].reshape(faces, n + 2, n + 2, TEXEL)


# ------------------------------------------------------------------------------------------------ the cube


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


# ------------------------------------------------------------------------------------------------ lookup


@inlined
def texel_at(pool, first, n, face, x, y):  # type: ignore[no-untyped-def]
    """Bilinear texel (r, g, b, coverage, distance) at face coordinates in [-1, 1]."""
    stride = n + 2
    px = (x + 1.0) * 0.5 * n + 0.5
    py = (y + 1.0) * 0.5 * n + 0.5
    x0 = min(max(int(px), 0), stride - 2)
    y0 = min(max(int(py), 0), stride - 2)
    fx, fy = min(max(px - x0, 0.0), 1.0), min(max(py - y0, 0.0), 1.0)
    a = first + ((face * stride + y0) * stride + x0) * TEXEL
    b = a + stride * TEXEL
    wa, wb, wc, wd = (1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy
    return (
        wa * pool[a] + wb * pool[a + 5] + wc * pool[b] + wd * pool[b + 5],
        wa * pool[a + 1] + wb * pool[a + 6] + wc * pool[b + 1] + wd * pool[b + 6],
        wa * pool[a + 2] + wb * pool[a + 7] + wc * pool[b + 2] + wd * pool[b + 7],
        wa * pool[a + 3] + wb * pool[a + 8] + wc * pool[b + 3] + wd * pool[b + 8],
        wa * pool[a + 4] + wb * pool[a + 9] + wc * pool[b + 4] + wd * pool[b + 9],
    )


@inlined
def level_at(pool, first, side, last, face, x, y, lod):  # type: ignore[no-untyped-def]
    """Trilinear texel; `first` and `side` are indexed by level, `last` is the highest level there is."""
    lod = min(max(lod, 0.0), float(last))
    low = int(lod)
    r, g, b, a, s = texel_at(pool, first[low], side[low], face, x, y)
    f = lod - low
    if f > 0.0 and low < last:
        r1, g1, b1, a1, s1 = texel_at(pool, first[low + 1], side[low + 1], face, x, y)
        return r + (r1 - r) * f, g + (g1 - g) * f, b + (b1 - b) * f, a + (a1 - a) * f, s + (s1 - s) * f
    return r, g, b, a, s


# ------------------------------------------------------------------------------------------------ borders and averages


@kernel
def fill_cube_border(pool, first, n):  # type: ignore[no-untyped-def]
    """Border texels of one level of a cube, from the inner texels of the neighbouring faces."""
    stride = n + 2
    for face in range(CUBE):
        for y in range(stride):
            for x in range(stride):
                across, down = x == 0 or x == stride - 1, y == 0 or y == stride - 1
                if across == down:  # inside, or a corner
                    continue
                d = face_direction(face, (x - 0.5) / n * 2.0 - 1.0, (y - 0.5) / n * 2.0 - 1.0)
                other, u, v = direction_face(d)
                ix = min(max(int((u + 1.0) * 0.5 * n), 0), n - 1) + 1
                iy = min(max(int((v + 1.0) * 0.5 * n), 0), n - 1) + 1
                for c in range(TEXEL):
                    pool[first + ((face * stride + y) * stride + x) * TEXEL + c] = pool[
                        first + ((other * stride + iy) * stride + ix) * TEXEL + c
                    ]
        for corner in range(4):
            x, y = (stride - 1) * (corner % 2), (stride - 1) * (corner // 2)
            ix, iy = min(max(x, 1), n), min(max(y, 1), n)
            for c in range(TEXEL):
                inner = pool[first + ((face * stride + iy) * stride + ix) * TEXEL + c]
                beside = pool[first + ((face * stride + iy) * stride + x) * TEXEL + c]
                above = pool[first + ((face * stride + y) * stride + ix) * TEXEL + c]
                pool[first + ((face * stride + y) * stride + x) * TEXEL + c] = (inner + beside + above) / 3.0


@kernel
def fill_window_border(pool, first, n):  # type: ignore[no-untyped-def]
    """Border texels of one level of a window: the nearest inner texel."""
    stride = n + 2
    for face in range(WINDOW):
        for y in range(stride):
            for x in range(stride):
                ix, iy = min(max(x, 1), n), min(max(y, 1), n)
                for c in range(TEXEL):
                    pool[first + ((face * stride + y) * stride + x) * TEXEL + c] = pool[
                        first + ((face * stride + iy) * stride + ix) * TEXEL + c
                    ]


@kernel
def halve(source, from_first, m, target, to_first, n, faces):  # type: ignore[no-untyped-def]
    """Average faces of m x m texels into faces of n x n, n = m // 2; where m is odd the middle counts on both sides."""
    wide, stride = m + 2, n + 2
    for face in range(faces):
        for y in range(n):
            ya, yb = y * m // n, ((y + 1) * m + n - 1) // n
            for x in range(n):
                xa, xb = x * m // n, ((x + 1) * m + n - 1) // n
                i = to_first + ((face * stride + y + 1) * stride + x + 1) * TEXEL
                for c in range(TEXEL):
                    total = 0.0
                    for sy in range(ya, yb):
                        for sx in range(xa, xb):
                            total += source[from_first + ((face * wide + sy + 1) * wide + sx + 1) * TEXEL + c]
                    target[i + c] = total / ((yb - ya) * (xb - xa))


# ------------------------------------------------------------------------------------------------ prefilter


def lobe_samples(level: int, resolution: int) -> NDArray[np.float64]:
    """Directions of the GGX lobe that a level is blurred by, seen along the normal, for filtered importance sampling.

    The lobe is D(h) cos(l) (Karis 2013), alpha the square of HDRP's roughness of the level. Each sample stands for the
    solid angle 4 / (count D), and reads the average over about that angle (Krivanek & Colbert 2008).

    Returns:
        shape (S, 5): x, y, z in the frame of the lobe's axis, weight (sums to 1), level of averages to read.
    """
    roughness = float(probe_roughness_hdrp(float(level)))
    a2 = max(roughness, 1e-3) ** 4
    count = _LOBE_SAMPLES << level
    ring = np.arange(count) // 2  # two opposite samples on each, so that the lobe does not lean to one side
    u = (ring + 0.5) / (count // 2)
    phi = 2.0 * np.pi * ((ring * 0.6180339887498949) % 1.0) + np.pi * (np.arange(count) % 2)
    cos2 = (1.0 - u) / (1.0 + (a2 - 1.0) * u)
    density = a2 / (np.pi * (cos2 * (a2 - 1.0) + 1.0) ** 2)
    cos_h, sin_h = np.sqrt(cos2), np.sqrt(1.0 - cos2)
    z = 2.0 * cos2 - 1.0
    texel = 4.0 * np.pi / (6.0 * resolution * resolution)
    lod = 0.5 * np.log2(4.0 / (count * density) / texel) + _COARSER
    samples = np.stack(
        [2.0 * cos_h * sin_h * np.cos(phi), 2.0 * cos_h * sin_h * np.sin(phi), z, np.maximum(z, 0.0), lod], 1
    )
    samples = samples[z > 0.0]
    samples[:, 3] /= samples[:, 3].sum()
    return np.ascontiguousarray(samples)


@kernel
def filter_face(source, first, side, target, to_first, n, face, samples):  # type: ignore[no-untyped-def]
    """Blur averages (`source`, `first`, `side`: every level of them) into one face of n x n texels of `target`."""
    stride = n + 2
    last = side.shape[0] - 1
    for y in range(n):
        for x in range(n):
            axis = normalize(face_direction(face, (x + 0.5) / n * 2.0 - 1.0, (y + 0.5) / n * 2.0 - 1.0))
            across, up = frame(axis)
            r = g = b = a = s = 0.0
            for k in range(samples.shape[0]):
                d = add(add(scale(across, samples[k, 0]), scale(up, samples[k, 1])), scale(axis, samples[k, 2]))
                other, u, v = direction_face(d)
                r1, g1, b1, a1, s1 = level_at(source, first, side, last, other, u, v, samples[k, 4])
                w = samples[k, 3]
                r += w * r1
                g += w * g1
                b += w * b1
                a += w * a1
                s += w * s1
            i = to_first + ((face * stride + y + 1) * stride + x + 1) * TEXEL
            target[i] = r
            target[i + 1] = g
            target[i + 2] = b
            target[i + 3] = a
            target[i + 4] = s


def averages(pool: NDArray[np.float32], first: int, resolution: int) -> tuple[NDArray[np.float32], Levels]:
    """Every halving of a cube's level 0, down to single texels, in a pool of their own."""
    count = int(math.log2(resolution)) + 1
    levels, size = layout(resolution, count, CUBE)
    own = np.empty(size, np.float32)
    n = resolution + 2
    own[: CUBE * n * n * TEXEL] = pool[first : first + CUBE * n * n * TEXEL]
    for level in range(1, count):
        m, n = int(levels.side[level - 1]), int(levels.side[level])
        halve(own, int(levels.first[level - 1]), m, own, int(levels.first[level]), n, CUBE)
        fill_cube_border(own, int(levels.first[level]), n)
    return own, levels


def level_count(resolution: int, faces: int, rough: bool) -> int:
    """How many levels a picture keeps: one where nothing is going to look at it blurred."""
    if not rough:
        return 1
    return CUBE_LEVELS if faces == CUBE else int(math.log2(resolution)) + 1
