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

from ..kernels.arrays import F32_1D, F64_2D, I64_1D
from ..kernels.compile import inlined, kernel
from ..kernels.lanes import by_address
from ..kernels.vec import Vec, add, frame, normalize, scale
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


Texel = tuple[float, float, float, float, float]
"""red, green, blue (premultiplied by coverage), coverage, distance [m]"""


class Levels(NamedTuple):
    """Where the levels of one picture lie in a pool of floats."""

    first: NDArray[np.int64]
    """shape (L,): offset of each level in the pool; -1 for none"""
    side: NDArray[np.int64]
    """shape (L,): texels on a side, without the border"""


class Picture(NamedTuple):
    """All levels of one picture, to be looked up. The pool, which other pictures share, outlives it."""

    texels: F32_1D
    """flat pool"""
    first: I64_1D
    """shape (L,): offset of each level in the pool"""
    side: I64_1D
    """shape (L,): texels on a side of each, without the border"""
    last: int
    """highest level there is; arrays may be longer"""


class Level(NamedTuple):
    """One level of a picture, to be written. The pool outlives it."""

    texels: F32_1D
    """flat pool"""
    first: int
    """offset of the level in the pool"""
    side: int
    """texels on a side, without the border"""


def level_of(texels: NDArray[np.float32], levels: Levels, level: int) -> Level:
    """One level of a picture whose levels lie in the pool `texels`."""
    return Level(texels, int(levels.first[level]), int(levels.side[level]))


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
def face_direction(face: int, x: float, y: float) -> Vec:
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
def direction_face(d: Vec) -> tuple[int, float, float]:
    """(face, x, y) that a direction meets: the inverse of `face_direction`."""
    # The longest component names the face; the ray meets it where that component is 1.
    ax, ay, az = abs(d[0]), abs(d[1]), abs(d[2])
    if ax >= ay and ax >= az:
        return (0, -d[2] / ax, -d[1] / ax) if d[0] > 0.0 else (1, d[2] / ax, -d[1] / ax)
    if ay >= az:
        return (2, d[0] / ay, d[2] / ay) if d[1] > 0.0 else (3, d[0] / ay, -d[2] / ay)
    return (4, d[0] / az, -d[1] / az) if d[2] > 0.0 else (5, -d[0] / az, -d[1] / az)


# ------------------------------------------------------------------------------------------------ lookup


@inlined
def _texel_number(face: int, x: int, y: int, side: int) -> int:
    """Number of a texel within its level; x and y count the border, so that the first inner texel is 1."""
    stride = side + 2
    return (face * stride + y) * stride + x


@inlined
def texel_at(picture: Picture, level: int, face: int, x: float, y: float) -> Texel:
    """Bilinear texel at face coordinates in [-1, 1]."""
    pool, n = picture.texels, picture.side[level]
    # Texel centres lie at halves, and the border shifts them by one: pixel coordinate 0.5 is the face's very edge.
    px = (x + 1.0) * 0.5 * n + 0.5
    py = (y + 1.0) * 0.5 * n + 0.5
    x0 = min(max(int(px), 0), n)
    y0 = min(max(int(py), 0), n)
    fx, fy = min(max(px - x0, 0.0), 1.0), min(max(py - y0, 0.0), 1.0)
    # The four texels around: a and b above, c and d below.
    a = picture.first[level] + _texel_number(face, x0, y0, n) * TEXEL
    c = a + (n + 2) * TEXEL
    b, d = a + TEXEL, c + TEXEL
    wa, wb, wc, wd = (1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy
    return (
        wa * pool[a] + wb * pool[b] + wc * pool[c] + wd * pool[d],
        wa * pool[a + 1] + wb * pool[b + 1] + wc * pool[c + 1] + wd * pool[d + 1],
        wa * pool[a + 2] + wb * pool[b + 2] + wc * pool[c + 2] + wd * pool[d + 2],
        wa * pool[a + 3] + wb * pool[b + 3] + wc * pool[c + 3] + wd * pool[d + 3],
        wa * pool[a + 4] + wb * pool[b + 4] + wc * pool[c + 4] + wd * pool[d + 4],
    )


@inlined
def level_at(picture: Picture, face: int, x: float, y: float, lod: float) -> Texel:
    """Trilinear texel: bilinear in the two levels around `lod`, which is cut to those there are."""
    lod = min(max(lod, 0.0), float(picture.last))
    low = int(lod)
    r, g, b, a, s = texel_at(picture, low, face, x, y)
    f = lod - low
    if f > 0.0 and low < picture.last:
        r1, g1, b1, a1, s1 = texel_at(picture, low + 1, face, x, y)
        return r + (r1 - r) * f, g + (g1 - g) * f, b + (b1 - b) * f, a + (a1 - a) * f, s + (s1 - s) * f
    return r, g, b, a, s


# ------------------------------------------------------------------------------------------------ borders and averages


@inlined
def _copy_texel(level: Level, source: int, target: int) -> None:
    """All floats of a texel, by texel numbers."""
    for c in range(TEXEL):
        level.texels[level.first + target * TEXEL + c] = level.texels[level.first + source * TEXEL + c]


@kernel
def fill_cube_border(level: Level) -> None:
    """Border texels of one level of a cube, from the inner texels of the neighbouring faces."""
    n = level.side
    stride = n + 2
    for face in range(CUBE):
        for y in range(stride):
            for x in range(stride):
                across, down = x == 0 or x == stride - 1, y == 0 or y == stride - 1
                if across == down:  # inside, or a corner
                    continue
                # The centre of a border texel lies beyond the face's edge: in its direction another face is met.
                d = face_direction(face, (x - 0.5) / n * 2.0 - 1.0, (y - 0.5) / n * 2.0 - 1.0)
                other, u, v = direction_face(d)
                ix = min(max(int((u + 1.0) * 0.5 * n), 0), n - 1) + 1
                iy = min(max(int((v + 1.0) * 0.5 * n), 0), n - 1) + 1
                _copy_texel(level, _texel_number(other, ix, iy, n), _texel_number(face, x, y, n))
        # Three faces meet at a corner and none has a texel there: the mean of the three that come nearest.
        for corner in range(4):
            x, y = (stride - 1) * (corner % 2), (stride - 1) * (corner // 2)
            ix, iy = min(max(x, 1), n), min(max(y, 1), n)
            for c in range(TEXEL):
                inner = level.texels[level.first + _texel_number(face, ix, iy, n) * TEXEL + c]
                beside = level.texels[level.first + _texel_number(face, x, iy, n) * TEXEL + c]
                above = level.texels[level.first + _texel_number(face, ix, y, n) * TEXEL + c]
                level.texels[level.first + _texel_number(face, x, y, n) * TEXEL + c] = (inner + beside + above) / 3.0


@kernel
def fill_window_border(level: Level) -> None:
    """Border texels of one level of a window: the nearest inner texel."""
    n = level.side
    for face in range(WINDOW):
        for y in range(n + 2):
            for x in range(n + 2):
                ix, iy = min(max(x, 1), n), min(max(y, 1), n)
                _copy_texel(level, _texel_number(face, ix, iy, n), _texel_number(face, x, y, n))


@kernel
def halve(source: Level, target: Level, faces: int) -> None:
    """Average faces of m x m texels into faces of n x n, n = m // 2; where m is odd the middle counts on both sides."""
    m, n = source.side, target.side
    for face in range(faces):
        for y in range(n):
            ya, yb = y * m // n, ((y + 1) * m + n - 1) // n
            for x in range(n):
                xa, xb = x * m // n, ((x + 1) * m + n - 1) // n
                i = target.first + _texel_number(face, x + 1, y + 1, n) * TEXEL
                for c in range(TEXEL):
                    total = 0.0
                    for sy in range(ya, yb):
                        for sx in range(xa, xb):
                            total += source.texels[
                                source.first + _texel_number(face, sx + 1, sy + 1, m) * TEXEL + c
                            ]
                    target.texels[i + c] = total / ((yb - ya) * (xb - xa))


# ------------------------------------------------------------------------------------------------ prefilter


@kernel
def _roughness_of(level: float) -> float:
    return probe_roughness_hdrp(level)


def lobe_samples(level: int, resolution: int) -> NDArray[np.float64]:
    """Directions of the GGX lobe that a level is blurred by, seen along the normal, for filtered importance sampling.

    The lobe is D(h) cos(l) (Karis 2013), alpha the square of HDRP's roughness of the level. Each sample stands for the
    solid angle 4 / (count D), and reads the average over about that angle (Krivanek & Colbert 2008).

    Returns:
        shape (S, 5): x, y, z in the frame of the lobe's axis, weight (sums to 1), level of averages to read.
    """
    roughness = _roughness_of(float(level))
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
def filter_face(source: Picture, target: Level, face: int, lobe: F64_2D) -> None:
    """Blur a picture's averages, `source`, into one face of a level, by the samples of a lobe (`lobe_samples`)."""
    n = target.side
    for y in range(n):
        for x in range(n):
            # A level cannot know the view, so normal, view and reflection are taken for one (Karis 2013).
            axis = normalize(face_direction(face, (x + 0.5) / n * 2.0 - 1.0, (y + 0.5) / n * 2.0 - 1.0))
            across, up = frame(axis)
            r = g = b = a = s = 0.0
            for k in range(lobe.shape[0]):
                d = add(add(scale(across, lobe[k, 0]), scale(up, lobe[k, 1])), scale(axis, lobe[k, 2]))
                other, u, v = direction_face(d)
                r1, g1, b1, a1, s1 = level_at(source, other, u, v, lobe[k, 4])
                w = lobe[k, 3]
                r += w * r1
                g += w * g1
                b += w * b1
                a += w * a1
                s += w * s1
            i = target.first + _texel_number(face, x + 1, y + 1, n) * TEXEL
            target.texels[i] = r
            target.texels[i + 1] = g
            target.texels[i + 2] = b
            target.texels[i + 3] = a
            target.texels[i + 4] = s


def averages(level: Level) -> Picture:
    """Every halving of a cube's level 0, down to single texels, in a pool of their own."""
    count = int(math.log2(level.side)) + 1
    levels, size = layout(level.side, count, CUBE)
    own = np.empty(size, np.float32)
    floats = CUBE * (level.side + 2) ** 2 * TEXEL
    own[:floats] = level.texels[level.first : level.first + floats]
    for m in range(1, count):
        coarser = by_address(level_of(own, levels, m))
        halve(by_address(level_of(own, levels, m - 1)), coarser, CUBE)
        fill_cube_border(coarser)
    return Picture(own, levels.first, levels.side, count - 1)


def level_count(resolution: int, faces: int, rough: bool) -> int:
    """How many levels a picture keeps: one where nothing is going to look at it blurred."""
    if not rough:
        return 1
    return CUBE_LEVELS if faces == CUBE else int(math.log2(resolution)) + 1
