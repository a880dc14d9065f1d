"""The seam between a frame and how light is found for it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple, Protocol


class Pass(NamedTuple):
    """One pass over the picture. Its items (tiles, as a rule) may be drawn in any order and side by side."""

    draw: Callable[[Any], int]
    """draws one item, and returns the rays it traced"""
    items: Sequence[Any]
    share: float
    """of the whole work, about"""
    samples: int = 0
    """that the planes hold of an item once it is drawn; 0 for a pass that draws something else. Its items are tiles"""


class Integrator(Protocol):
    """Finds the light of every pixel, and adds it to the planes it was made with.

    What it is made with is its own affair (`branching.Tree` shows it).
    """

    def passes(self) -> Iterator[Pass]:
        """The passes that draw the picture.

        Each is finished on all its items before the next is asked for, so a pass may read what the ones before it left
        anywhere in the picture, and which passes there are may depend on that.
        """
        ...
