"""Pictures in tiles (UDIM): the files that a name with <UDIM> stands for, and one picture made of them all.

Tile 1001 + u + 10 v covers the unit square of the texture coordinates at (u, v), u below 10. The tiles that there are
become one picture over the rectangle that holds them; a source that looks it up moves its coordinates into it. Where a
tile is missing, and outside of all, the picture is black, but for a rim with the colours of the tile beside it: a
lookup at a tile's very edge takes in no black.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import ImageError
from ...images import codec
from ...images.srgb import linear_pixels, srgb_encode
from ...scene import Source, Texture, Wrap
from ..values import short
from .coordinates import Matrix, compose

MARK = "<UDIM>"
FIRST, LAST, COLUMNS = 1001, 1100, 10
LARGEST = 1 << 30
"""Bytes of the picture; beyond, and beyond the pixels that one texture may have, the tiles are made smaller."""
_RIM = 64
"""A rim is the tile's side over this."""

_Cell = tuple[int, int]


class Size(NamedTuple):
    """What the head of a file says."""

    width: int
    height: int
    texel: int
    """bytes of RGBA"""


class Grid(NamedTuple):
    """Where the tiles lie in the picture."""

    cells: tuple[_Cell, ...]
    """(u, v) of each tile there is"""
    low: _Cell
    counts: _Cell
    """columns and rows"""
    side: _Cell
    """width and height of a tile [texels]"""
    rim: _Cell
    """[texels]"""
    step: int
    """The tiles' own sides are so many times as large; 1 where nothing was made smaller."""

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the picture."""
        return self.counts[1] * self.side[1] + 2 * self.rim[1], self.counts[0] * self.side[0] + 2 * self.rim[0]

    def matrix(self) -> Matrix:
        """From texture coordinates to those of the picture, row-major 2x3."""
        height, width = self.shape
        x, y = self.rim[0] - self.low[0] * self.side[0], self.rim[1] - self.low[1] * self.side[1]
        return (self.side[0] / width, 0.0, x / width, 0.0, self.side[1] / height, y / height)

    def inverse(self) -> Matrix:
        """From coordinates of the picture to texture coordinates."""
        a, _, x, _, d, y = self.matrix()
        return (1.0 / a, 0.0, -x / a, 0.0, 1.0 / d, -y / d)

    def place(self, cell: _Cell) -> tuple[slice, slice]:
        """Rows and columns of a tile, row 0 on top."""
        left = self.rim[0] + (cell[0] - self.low[0]) * self.side[0]
        top = self.rim[1] + (self.low[1] + self.counts[1] - 1 - cell[1]) * self.side[1]
        return slice(top, top + self.side[1]), slice(left, left + self.side[0])


_NO_TILES = Grid((), (0, 0), (0, 0), (1, 1), (0, 0), 1)


@dataclass(frozen=True)
class Tiled(Texture):
    """A picture made of tiles."""

    grid: Grid = _NO_TILES

    def parts(self) -> Iterator[NDArray[Any]]:
        """The pixels of each tile."""
        for cell in self.grid.cells:
            yield self.pixels[self.grid.place(cell)]


def moved_out(source: Source, texture: Texture) -> Source:
    """The source of a picture as it was before its coordinates were moved into one made of tiles; else itself."""
    if not isinstance(texture, Tiled):
        return source
    return replace(source, uv_matrix=compose(texture.grid.inverse(), source.uv_matrix))


def moved_in(source: Source, texture: Texture) -> Source:
    """The source of a picture; of one made of tiles, moved to where they lie in it, and black outside."""
    if not isinstance(texture, Tiled):
        return source
    matrix = compose(texture.grid.matrix(), source.uv_matrix)
    return replace(source, wrap=(Wrap.BLACK, Wrap.BLACK), uv_matrix=matrix)


def is_tiled(path: str) -> bool:
    """A file name that stands for many."""
    return MARK in path


def numbered(path: str) -> Iterator[tuple[_Cell, str]]:
    """Every tile that a name may stand for: where it lies, and its path."""
    for number in range(FIRST, LAST + 1):
        v, u = divmod(number - FIRST, COLUMNS)
        yield (u, v), path.replace(MARK, str(number))


def read_tiles(
    path: str, name: str, there: Callable[[str], bool], size: Callable[[str], Size], read: Callable[[str], Texture]
) -> Tiled:
    """One picture of all tiles.

    Args:
        path: with the mark.
        name: of the picture.
        there: whether a tile exists.
        size: what its head says.
        read: decodes it. All tiles are asked for one after the other, so that one at a time is in memory.

    Raises:
        ImageError: there is no tile, or one cannot be decoded.
    """
    files = {cell: file for cell, file in numbered(path) if there(file)}
    if not files:
        raise ImageError(f"{short(path)}: no tile of it is there, {FIRST} to {LAST}; check the path")
    sizes = [size(file) for file in files.values()]
    grid = _grid(tuple(files), sizes)
    as_bytes, srgb = all(one.texel == 4 for one in sizes), False
    pixels: Any = np.zeros((*grid.shape, 4), np.uint8 if as_bytes else np.float32)
    for number, (cell, file) in enumerate(files.items()):
        one = read(file)
        srgb = srgb if number else as_bytes and one.srgb
        _put(pixels, grid, cell, _resized(_alike(one, as_bytes, srgb), grid.side))
    return Tiled(name, pixels, srgb, grid)


def _grid(cells: tuple[_Cell, ...], sizes: list[Size]) -> Grid:
    us, vs = [u for u, _ in cells], [v for _, v in cells]
    low, counts = (min(us), min(vs)), (max(us) - min(us) + 1, max(vs) - min(vs) + 1)
    width, height = max(one.width for one in sizes), max(one.height for one in sizes)
    texel, step = max(one.texel for one in sizes), 1
    while True:
        side = max(width // step, 1), max(height // step, 1)
        grid = Grid(cells, low, counts, side, (max(side[0] // _RIM, 1), max(side[1] // _RIM, 1)), step)
        rows, columns = grid.shape
        if (rows * columns * texel <= LARGEST and rows * columns <= codec.MAX_TEXTURE_PIXELS) or side == (1, 1):
            return grid
        step *= 2


def _alike(tile: Texture, as_bytes: bool, srgb: bool) -> NDArray[Any]:
    """A tile's pixels as all of them are kept: a grey one beside coloured ones may have another curve."""
    if tile.pixels.dtype == np.uint8 and as_bytes and tile.srgb == srgb:
        return tile.pixels
    out = linear_pixels(tile)
    if not as_bytes:
        return out
    if srgb:
        out[..., :3] = srgb_encode(out[..., :3])
    return np.rint(out * 255.0).astype(np.uint8)


def _put(pixels: NDArray[Any], grid: Grid, cell: _Cell, tile: NDArray[Any]) -> None:
    """A tile into its place, and its rim around it where no other tile lies."""
    rows, columns = grid.place(cell)
    pixels[rows, columns] = tile
    x, y = grid.rim
    whole, first, last = slice(None), slice(0, 1), slice(-1, None)
    down = {1: (slice(rows.start - y, rows.start), first), 0: (rows, whole),
            -1: (slice(rows.stop, rows.stop + y), last)}  # fmt: skip
    right = {-1: (slice(columns.start - x, columns.start), first), 0: (columns, whole),
             1: (slice(columns.stop, columns.stop + x), last)}  # fmt: skip
    for dv, (there, edge) in down.items():
        for du, (along, side) in right.items():
            if (cell[0] + du, cell[1] + dv) not in grid.cells:
                pixels[there, along] = tile[edge, side]


def _resized(tile: NDArray[Any], side: _Cell) -> NDArray[Any]:
    """A tile at the side of all: the nearest texel, or the mean of whole blocks of them where it is made smaller."""
    width, height = side
    by = tile.shape[0] // height
    if by > 1 and tile.shape[:2] == (height * by, width * by):
        blocks = tile.reshape(height, by, width, by, 4).mean(axis=(1, 3), dtype=np.float32)
        return np.asarray(np.rint(blocks) if tile.dtype == np.uint8 else blocks).astype(tile.dtype)
    if tile.shape[:2] == (height, width):
        return tile
    rows = ((np.arange(height) + 0.5) * tile.shape[0] / height).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * tile.shape[1] / width).astype(np.int64)
    return tile[rows[:, None], columns]
