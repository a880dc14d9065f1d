"""Colour and depth pyramids of the opaque layer: what the screen tier reads.

Colour: HDRP's chain (fact: MipGenerator and ColorPyramid.compute): each level is a 2x2 average of the one before, then
a separable 9-tap binomial blur, sizes halved and floored, until both sides of a level are below 8 pixels.
Depth: the nearest z_depth of each 2x2 cell, and the farthest that is not background, sizes halved and *ceiled*, so that
no pixel is ever outside its cell.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.arrays import F32_1D, F32_2D, F32_3D, I64_2D
from ..kernels.compile import inlined, kernel
from ..world.textures import Rgba, mix
from .camera import View

F32 = NDArray[np.float32]
Levels = NDArray[np.int64]
"""shape (L, 3): of each level the first row in the pool, width, height"""

_TAPS = np.array([1.0, 8.0, 28.0, 56.0, 70.0, 56.0, 28.0, 8.0, 1.0]) / 256.0
"""Binomial weights: the blur of eight averages of neighbours."""


class ScreenBuffers(NamedTuple):
    """Level 0 and its pyramids, in flat pools."""

    color: F32_2D
    """shape (N, 4): radiance, premultiplied by coverage, and coverage (0 where the picture is open); all levels, row by
    row"""
    color_level: I64_2D
    depth: F32_1D
    """shape (N,): z_depth [m], nearest of each cell; level 0 is the depth itself"""
    farthest: F32_1D
    """shape (N,): farthest of each cell and the pixels next to it, background left out (0 where there is nothing else);
    level 0 is not used"""
    depth_level: I64_2D
    normal: F32_3D
    """shape (H, W, 3): geometric, towards the viewer"""
    irradiance: F32_3D
    """shape (H, W, 3): as `gbuffer.OpaqueLayer`; so is the next"""
    gloss: F32_3D
    seen: F32_3D


class Screen(NamedTuple):
    """The buffers and the camera that filled them, for one layer of one sample: what the screen tier reads."""

    camera: View
    color: F32_2D
    color_level: I64_2D
    depth: F32_1D
    farthest: F32_1D
    depth_level: I64_2D
    normal: F32_3D
    irradiance: F32_3D
    gloss: F32_3D
    seen: F32_3D


class BlurScratch(NamedTuple):
    """Where a colour level is on its way from the one below it: made once per picture size, of use to one thread. A
    kernel finds nothing in it and leaves nothing to be used."""

    half: F32_2D
    """shape (N, 4): averages of 2x2; N is the number of texels of level 1, the largest that is made"""
    across: F32_2D
    """shape (N, 4): those, blurred along the rows"""


def color_levels(width: int, height: int, blurred: bool) -> Levels:
    """Table of the colour levels; level 0 alone where nothing is going to be blurred."""
    levels = [(0, width, height)]
    while blurred and max(levels[-1][1:]) >= 8:
        first, w, h = levels[-1]
        levels.append((first + w * h, max(1, w // 2), max(1, h // 2)))
    return np.array(levels, np.int64)


def depth_levels(width: int, height: int) -> Levels:
    """Table of the depth levels, down to a single cell."""
    levels = [(0, width, height)]
    while max(levels[-1][1:]) > 1:
        first, w, h = levels[-1]
        levels.append((first + w * h, (w + 1) // 2, (h + 1) // 2))
    return np.array(levels, np.int64)


def new_screen_buffers(w: int, h: int, blurred: bool, quiet: bool = False) -> ScreenBuffers:
    """Empty pools of the right size; the opaque layer is drawn straight into their level 0. `quiet`: with shares."""
    colors, depths = color_levels(w, h, blurred), depth_levels(w, h)

    def total(levels: Levels) -> int:
        return int((levels[:, 1] * levels[:, 2]).sum())

    return ScreenBuffers(
        np.zeros((total(colors), 4), np.float32),
        colors,
        np.zeros(total(depths), np.float32),
        np.zeros(total(depths), np.float32),
        depths,
        np.zeros((h, w, 3), np.float32),
        np.zeros((h, w, 3), np.float32),
        np.zeros((h, w, 3), np.float32),
        np.zeros((h, w, 4) if quiet else (0, 0, 4), np.float32),
    )


def new_blur_scratch(levels: Levels) -> BlurScratch:
    """Room for every level of a table of colour levels."""
    texels = int(levels[1, 1] * levels[1, 2]) if len(levels) > 1 else 0
    return BlurScratch(np.zeros((texels, 4), np.float32), np.zeros((texels, 4), np.float32))


@inlined
def _average_row(source: F32, w: int, y: int, target: F32, tw: int) -> None:
    """2x2 averages of row `y` of a level, tw texels wide; a missing odd column or row repeats the edge."""
    h = source.shape[0] // w
    ya, yb = min(2 * y, h - 1), min(2 * y + 1, h - 1)
    for x in range(tw):
        xa, xb = min(2 * x, w - 1), min(2 * x + 1, w - 1)
        for c in range(4):
            total = source[ya * w + xa, c] + source[ya * w + xb, c] + source[yb * w + xa, c] + source[yb * w + xb, c]
            target[y * tw + x, c] = 0.25 * total


@kernel
def blur_level(color: F32_2D, levels: I64_2D, level: int, scratch: BlurScratch) -> None:
    """Make colour level `level` from the one below it."""
    half, across = scratch.half, scratch.across
    first, w, h = levels[level - 1]
    source = color[first : first + w * h]
    first, tw, th = levels[level]
    target = color[first : first + tw * th]
    for y in range(th):
        _average_row(source, w, y, half, tw)
    # The filter is a product of one along the rows and one down the columns: 18 taps in place of 81.
    for y in range(th):
        for x in range(tw):
            for c in range(4):
                s = 0.0
                for k in range(9):
                    s += _TAPS[k] * half[y * tw + min(tw - 1, max(0, x + k - 4)), c]
                across[y * tw + x, c] = s
    for y in range(th):
        for x in range(tw):
            for c in range(4):
                s = 0.0
                for k in range(9):
                    s += _TAPS[k] * across[min(th - 1, max(0, y + k - 4)) * tw + x, c]
                target[y * tw + x, c] = s


@kernel
def fill_depth_levels(depth: F32_1D, farthest: F32_1D, levels: I64_2D) -> None:
    """Fill every level above 0 of the two depth pyramids from level 0 of `depth`."""
    for level in range(1, levels.shape[0]):
        first, w, h = levels[level - 1]
        target, tw, th = levels[level]
        for y in range(th):
            ya, yb = first + 2 * y * w, first + min(2 * y + 1, h - 1) * w
            for x in range(tw):
                xa, xb = 2 * x, min(2 * x + 1, w - 1)
                i = target + y * tw + x
                depth[i] = min(min(depth[ya + xa], depth[ya + xb]), min(depth[yb + xa], depth[yb + xb]))
                if level == 1:
                    farthest[i] = _farthest_around(depth, w, h, 2 * x, 2 * y)
                    continue
                a, b = farthest[ya + xa], farthest[ya + xb]
                farthest[i] = max(max(a, b), max(farthest[yb + xa], farthest[yb + xb]))


@inlined
def _farthest_around(depth: F32, w: int, h: int, x: int, y: int) -> np.float32:
    """Farthest of the 2x2 pixels from (x, y) and the ring around them, background left out: a surface inside a pixel
    may lie deeper than at its centre, but not deeper than at its neighbour's."""
    found = np.float32(0.0)
    for j in range(max(0, y - 1), min(h, y + 3)):
        for i in range(max(0, x - 1), min(w, x + 3)):
            z = depth[j * w + i]
            if z < np.inf:
                found = max(found, z)
    return found


@inlined
def _bilinear(color: F32, first: int, w: int, h: int, x: float, y: float) -> Rgba:
    """Bilinear value at pixel coordinates (texel centres at +0.5), clamped to the edge."""
    x = min(max(x - 0.5, 0.0), w - 1.0)
    y = min(max(y - 0.5, 0.0), h - 1.0)
    x0, y0 = int(x), int(y)
    x1, y1 = min(x0 + 1, w - 1), min(y0 + 1, h - 1)
    fx, fy = x - x0, y - y0
    wa, wb, wc, wd = (1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy
    a, b, c, d = first + y0 * w + x0, first + y0 * w + x1, first + y1 * w + x0, first + y1 * w + x1
    return (
        wa * color[a, 0] + wb * color[b, 0] + wc * color[c, 0] + wd * color[d, 0],
        wa * color[a, 1] + wb * color[b, 1] + wc * color[c, 1] + wd * color[d, 1],
        wa * color[a, 2] + wb * color[b, 2] + wc * color[c, 2] + wd * color[d, 2],
        wa * color[a, 3] + wb * color[b, 3] + wc * color[c, 3] + wd * color[d, 3],
    )


@inlined
def color_at(screen: Screen, px: float, py: float, lod: float) -> Rgba:
    """Trilinear colour and coverage at a pixel coordinate of level 0."""
    # Sizes are floored, so a level is not a power of two smaller: places are found by their share of the picture.
    last = screen.color_level.shape[0] - 1
    lod = min(max(lod, 0.0), float(last))
    low = int(lod)
    first, w, h = screen.color_level[low, 0], screen.color_level[low, 1], screen.color_level[low, 2]
    u, v = px / screen.camera.size[0], py / screen.camera.size[1]
    finer = _bilinear(screen.color, first, w, h, u * w, v * h)
    f = lod - low
    if f > 0.0 and low < last:
        first, w, h = screen.color_level[low + 1, 0], screen.color_level[low + 1, 1], screen.color_level[low + 1, 2]
        return mix(finer, _bilinear(screen.color, first, w, h, u * w, v * h), f)
    return finer
