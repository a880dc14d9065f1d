"""Narrow things that glass shows, between the corners of pixels and in none of them: the side of a pane in its own
front, a wire behind a window. A corner that shows what hardly any of its neighbours does is on such a line; around it,
and from there on along the line, pixels are looked at by a few samples. All over the picture, round by round: a line
that leans little passes between corners for longer than a patch is high.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..kernels.arrays import I64_1D, U8_2D
from ..kernels.compile import flag, inlined, kernel
from ..kernels.lanes import LANES
from ..view.camera import View
from ..view.planes import Planes
from ..world.tables import World
from .answers import keep_answers
from .crossing import Rules
from .edges import draw_edges, start_sample
from .patch import ALL_SAMPLES, CornerScratch, Refining, Ways
from .pixels import forget_pixel
from .rays import Rays
from .tiers import Asking
from .tree import CELL, SLOTS, TreeScratch, follow

OPEN, EDGE, _LOOKED_AT, _THIN = 0, 1, 2, 3
"""What is known of a pixel: nothing that matters here; that it has samples of its own; that it shows no line; that it
does."""
_CROSSING = 3
"""Edges among a pixel and its neighbours where a line of them is one pixel wide."""
_ALL = flag(True)


@kernel
def mark_lines(ways: Ways, first: int, last: int, near: U8_2D) -> None:
    """Mark pixels of rows `first` to before `last` with a corner on a line, or beside one. `near`: as `ways.state`."""
    height, width = near.shape
    for y in range(first, last):
        for x in range(width):
            near[y, x] = 0
            for cy in range(max(0, y - 1), min(height, y + 2) + 1):
                for cx in range(max(0, x - 1), min(width, x + 2) + 1):
                    if near[y, x] == 0 and ways.at[cy, cx] != 0 and _is_line(ways, cx, cy):
                        near[y, x] = 1


@inlined
def _is_line(ways: Ways, x: int, y: int) -> bool:
    """A corner shows something that no more than two of its eight neighbours do."""
    rows, columns = ways.at.shape
    once = twice = more = ways.at[y, x] & 0
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            if dx != 0 or dy != 0:  # beyond the picture all is as on its border
                there = ways.at[min(max(y + dy, 0), rows - 1), min(max(x + dx, 0), columns - 1)]
                more |= twice & there
                twice |= once & there
                once |= there
    return bool(ways.at[y, x] & ~more != 0)


@kernel
def look_behind(
    world: World,
    asking: Asking,
    rules: Rules,
    view_ray: Rays,
    refining: Refining,
    scratch: TreeScratch,
    pixels: I64_1D,
    view: View,
    ways: Ways,
) -> int:
    """Look at pixels by some of their samples: whether they show what none of their corners does goes to `ways.state`.

    Args:
        pixels: shape (N,), row by row through the picture.

    Returns:
        Rays traced.
    """
    scratch.packet.tally[0] = scratch.work.packet.tally[0] = 0
    keep_answers(scratch.answers, False)
    begin, width = refining.sets[ALL_SAMPLES], view.size[0]
    samples = refining.sets[ALL_SAMPLES + 1] - begin
    looks = min(LANES, samples)
    for first in range(0, pixels.shape[0], CELL // looks):
        last = min(pixels.shape[0], first + CELL // looks)
        count = 0
        for k in range(first, last):
            for n in range(looks):
                place = begin + n * samples // looks
                x, y = pixels[k] % width, pixels[k] // width
                count = start_sample(scratch, view, view_ray, refining, count, x, y, place, begin)
        follow(scratch, world, asking, rules, view, count, _ALL, refining.sample_rays)
        for k in range(first, last):
            x, y = pixels[k] % width, pixels[k] // width
            known = ways.at[y, x] | ways.at[y, x + 1] | ways.at[y + 1, x] | ways.at[y + 1, x + 1]
            seen = known & 0
            for n in range(looks):
                seen |= scratch.cell.ways[SLOTS + (k - first) * looks + n]
            ways.state[y, x] = _THIN if seen & ~known != 0 else _LOOKED_AT
    return scratch.packet.tally[0] + scratch.work.packet.tally[0]


@kernel
def draw_behind(
    world: World,
    asking: Asking,
    rules: Rules,
    view_ray: Rays,
    refining: Refining,
    scratch: TreeScratch,
    own: CornerScratch,
    pixels: I64_1D,
    view: View,
    planes: Planes,
) -> int:
    """Draw pixels, no more than a patch has, by all their samples, in place of what their corners have made of them.
    Returns rays traced."""
    scratch.packet.tally[0] = scratch.work.packet.tally[0] = 0
    keep_answers(scratch.answers, False)
    for k in range(pixels.shape[0]):
        own.edges[k], own.sets[k], own.contrast[k] = pixels[k], ALL_SAMPLES, 1.0
        forget_pixel(planes, pixels[k] % view.size[0], pixels[k] // view.size[0])
    draw_edges(scratch, own, world, asking, rules, view_ray, refining, view, planes, pixels.shape[0])
    return scratch.packet.tally[0] + scratch.work.packet.tally[0]


def beside(ways: Ways, pixels: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Of pixels that have been looked at, those that show a line; and of their neighbours those to look at next: where
    the corners have told all, or where another line crosses. Where all is edges, there are no lines to follow."""
    state = ways.state.ravel()
    thin = pixels[state[pixels] == _THIN]
    near = np.unique(_around(ways, thin))
    crossed = near[state[near] == EDGE]
    lonely = (state[_around(ways, crossed)] == EDGE).reshape(-1, 9).sum(axis=1) <= _CROSSING
    return thin, np.sort(np.concatenate([near[state[near] == OPEN], crossed[lonely]]))


def _around(ways: Ways, pixels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pixels and their neighbours, nine for each; at the border of the picture some more than once."""
    height, width = ways.state.shape
    y, x = np.divmod(pixels, width)
    step = np.arange(-1, 2)
    ny, nx = np.clip(y[:, None, None] + step[:, None], 0, height - 1), np.clip(x[:, None, None] + step, 0, width - 1)
    around: NDArray[np.int64] = (ny * width + nx).ravel()
    return around
