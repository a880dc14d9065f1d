"""Pictures before they are finished: what is drawn so far, for who wants to see it, and a time by which to stop."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..images.frame import Frame
from ..kernels.lanes import by_address
from ..scene import F32
from ..view.camera import Tile, View
from ..view.planes import Finish, Planes, by_name, finish_tile, new_planes
from .integrator import Pass

FINISHED = "refract:finished"
"""Attribute of an unfinished picture: share of it that is as it was asked for."""


def _never() -> bool:
    return False


@dataclass(frozen=True)
class Watch:
    """Who wants a picture before it is finished."""

    deadline: float = math.inf
    """`time.monotonic()` at which to stop [s]. Every pixel is then drawn with one sample first, so that what is there
    in the end is a whole picture, parts of which are as good as asked."""
    wanted: Callable[[], bool] = _never
    """Asked a few times a second: somebody wants to see what is finished so far."""
    take: Callable[[Frame], None] = field(default=lambda _frame: None)
    """Gets that; what is not drawn yet is clear."""

    def is_over(self) -> bool:
        return time.monotonic() >= self.deadline


class Drawn:
    """Which tiles of a picture hold how many samples, while other threads draw."""

    def __init__(self, planes: Planes, view: View, finish: Callable[[int], Finish]) -> None:
        """
        Args:
            view: that the planes' data are of.
            finish: what makes values of so many samples.
        """
        self._planes, self._view, self._finish = planes, view, finish
        self._samples: dict[Tile, int] = {}

    def noting(self, step: Pass) -> Callable[[Any], int]:
        """How the step draws, with a note of each item that is done."""
        if not step.samples:
            return step.draw

        def draw(tile: Tile) -> int:
            rays = step.draw(tile)
            self._samples[tile] = step.samples
            return rays

        return draw

    def least(self, tiles: int) -> int:
        """Samples that every one of so many tiles has."""
        return min(self._samples.values()) if 0 < tiles == len(self._samples) else 0

    def count(self, samples: int) -> int:
        """Tiles that have so many samples."""
        return list(self._samples.values()).count(samples)

    def so_far(self, window: Tile, below: dict[str, F32] | None = None) -> dict[str, F32]:
        """Planes of the window by AOV name: what is drawn, over something else or nothing."""
        height, width = self._planes.mask.shape
        copy = new_planes(width, height)
        done = dict(self._samples)
        known = np.zeros((height, width), np.bool_)
        for (x0, y0, x1, y1), samples in done.items():
            rows, columns = slice(y0, min(y1, height)), slice(x0, min(x1, width))
            for target, source in zip(copy, self._planes, strict=True):
                target[rows, columns] = source[rows, columns]
            known[rows, columns] = True
            tile = x0, y0, x1, y1
            finish_tile(by_address(copy), by_address(self._view), by_address(self._finish(samples)), tile)
        rows, columns = slice(window[1], window[3]), slice(window[0], window[2])
        found = {name: np.ascontiguousarray(plane[rows, columns]) for name, plane in by_name(copy).items()}
        if below is not None:
            for name, plane in found.items():
                plane[~known[rows, columns]] = below[name][~known[rows, columns]]
        return found
