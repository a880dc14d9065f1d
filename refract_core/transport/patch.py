"""A patch of a picture: the records of `corners`, and where things stand in them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..kernels.arrays import F64_1D, F64_2D, I32_1D, I64_1D, I64_2D, U8_2D
from ..kernels.compile import inlined
from .tree import CELL, SLOTS

PATCH = 32
"""Pixels along the side of a patch, a tile that is done at once."""
ROW = PATCH + 1
"""Corners along it."""
ALL_SAMPLES = 2
"""The set of samples of a pixel that takes all."""


class Refining(NamedTuple):
    """Which pixels are drawn with samples of their own, and with which."""

    tolerance: float
    """largest difference between corners that is passed, of the square root of light; above 1, of half its logarithm"""
    exposure: float
    """of the picture: what light is multiplied with before it is looked at"""
    offsets: F64_2D
    """shape (S, 2): of the samples, from the pixel's middle [pixels]: few, more and most of them, set after set"""
    sets: I64_1D
    """shape (4,): where in `offsets` each set begins, and the last one ends"""
    samples: int
    """by which `planes` will be divided"""
    corner_rays: int
    """to each light and to the sky, from strong leaves of a corner"""
    sample_rays: int
    """the same, of a sample at an edge"""


class Ways(NamedTuple):
    """What `behind` knows of a picture."""

    at: I64_2D
    """shape (H + 1, W + 1): of each corner, as `Cell.ways`"""
    state: U8_2D
    """shape (H, W): of each pixel, as `behind.OPEN`"""


class CornerScratch(NamedTuple):
    """What one thread needs besides a tree's."""

    thin: I32_1D
    """of each pixel of the patch, what `between` has found out: THIN where it shows what none of its corners does"""
    queue: I32_1D
    """such pixels, whose neighbours have to be looked at"""
    edges: I64_1D
    """pixels that are edges, row by row through the picture"""
    sets: I32_1D
    """which samples each of them takes"""
    contrast: F64_1D
    """of its corners"""
    places: I32_1D
    """row of `Refining.offsets` of each slot"""
    times: F64_1D
    """for how many samples each slot stands"""
    found: I64_1D
    """shape (4,): the rows of four answers that match"""
    used: I64_1D
    """shape (4,): bits of the answers that have found their like, corner by corner"""
    filtered: F64_2D
    """shape (2, 3): emission and albedo over a pixel"""
    alone: F64_2D
    """shape (4, 3): light that each corner alone has"""
    shared: F64_2D
    """shape (4, 3): light that all have, without what textures do to it"""
    light: F64_2D
    """shape (3, 3): what the pixel gets, by the side of the leaves"""

    @staticmethod
    def fresh() -> CornerScratch:
        """All of it at zero."""
        return CornerScratch(
            np.zeros(PATCH * PATCH, np.int32), np.zeros(PATCH * PATCH, np.int32), np.zeros(PATCH * PATCH, np.int64),
            np.zeros(PATCH * PATCH, np.int32), np.zeros(PATCH * PATCH),
            np.zeros(CELL, np.int32), np.zeros(CELL),
            np.zeros(4, np.int64), np.zeros(4, np.int64),
            np.zeros((2, 3)), np.zeros((4, 3)), np.zeros((4, 3)), np.zeros((3, 3)),
        )  # fmt: skip


@inlined
def corner(slot: int, k: int) -> int:
    """The slot of corner `k` of the pixel whose first corner is `slot`: along x first."""
    return slot + k % 2 + k // 2 * ROW


assert SLOTS == ROW * ROW
