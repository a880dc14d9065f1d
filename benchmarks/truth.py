"""Converged pictures of the rooms by Mitsuba, kept on disk: sums of chunks, so that more samples can be added later.

A picture is kept as two sums, of the even chunks and of the odd ones. How far these two are from each other says how
far their mean still is from the truth, so that nobody takes the reference's own noise for an error of what is compared.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from refract_core.scene import F32, F64
from refract_core.verbs.compare import Mask, displayed

from .in_mitsuba import Light, Loaded, draw, glass_share
from .two_rooms import Room

Tell = Callable[[float, str], None]
"""Told a fraction done, 0 .. 1, and of what."""
CHUNK = 64
"""Samples of one call, a square"""
_FIRST_SEED = 1_000_000
"""Of the chunks: what is compared draws other samples than the truth does."""


class Truth(NamedTuple):
    """A picture that is as good as converged."""

    halves: F64
    """shape (2, H, W, 3): two independent means, linear"""
    share: F32
    """shape (H, W): share of a pixel in which glass is met first"""
    samples: int
    """of both halves together"""

    @property
    def linear(self) -> F64:
        return np.asarray(self.halves.mean(0), np.float64)

    def noise(self, mask: Mask) -> float:
        """PSNR that its own noise leaves it [dB]: the mean of two has a quarter of the square of what parts them."""
        even, odd = (displayed(half).astype(np.float64)[mask] for half in self.halves)
        mean = float(np.mean((even - odd) ** 2)) / 4.0
        return math.inf if mean == 0.0 else -10.0 * math.log10(mean)


class _Sums(NamedTuple):
    """What a file holds."""

    sums: F64
    """shape (2, H, W, 3)"""
    chunks: int
    share: F32


def converged(room: Room, light: Light, loaded: Loaded, samples: int, cache: Path, tell: Tell) -> Truth:
    """The picture with at least `samples` samples, from the cache as far as it is there.

    Args:
        samples: rounded up to an even number of chunks.
        cache: folder, made where it is missing.
        tell: called with a fraction and a name after every chunk.
    """
    wanted = 2 * math.ceil(samples / (2 * CHUNK))
    height, width = draw(loaded, light, 1, 0).shape[:2]
    path = cache / f"{room.name}-{light}-{width}x{height}-{room.digest()}.npz"
    kept = _read(path) or _Sums(np.zeros((2, height, width, 3)), 0, glass_share(loaded, CHUNK))
    while kept.chunks < wanted:
        tell(kept.chunks / wanted, path.name)
        for _ in range(2):  # an even and an odd one
            kept.sums[kept.chunks % 2] += draw(loaded, light, CHUNK, _FIRST_SEED + kept.chunks)
            kept = kept._replace(chunks=kept.chunks + 1)
        if kept.chunks % 8 == 0 or kept.chunks >= wanted:
            _write(path, kept)
    return Truth(kept.sums / (kept.chunks / 2), kept.share, kept.chunks * CHUNK)


def _read(path: Path) -> _Sums | None:
    if not path.exists():
        return None
    with np.load(path) as file:
        return _Sums(file["sums"], int(file["chunks"]), file["share"])


def _write(path: Path, kept: _Sums) -> None:
    """In one step: a run that is stopped leaves the last whole file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".part.npz")
    np.savez(partial, sums=kept.sums, chunks=kept.chunks, share=kept.share)
    os.replace(partial, path)
