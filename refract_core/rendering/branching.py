"""The integrator: the opaque picture, then a tree of rays for every pixel that sees glass."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..kernels.compile import is_compiled
from ..kernels.lanes import by_address, scratch
from ..kernels.sampling import pixel_offsets
from ..scene import Camera, Scene
from ..settings import SCREEN_METHODS, TIERS, RenderSettings
from ..transport.behind import OPEN, beside, draw_behind, look_behind, mark_lines
from ..transport.corners import corner_tile
from ..transport.crossing import Rules
from ..transport.eye import view_ray
from ..transport.patch import PATCH, CornerScratch, Refining, Ways
from ..transport.pixels import tree_tile
from ..transport.rays import Rays
from ..transport.tiers import Asking
from ..transport.tree import TreeScratch
from ..view.camera import Tile, View, corners_of, lens_points, view_of
from ..view.crop import glass_in, looked_at, meeting
from ..view.gbuffer import OpaqueLayer, ViewScratch, new_hits, opaque_tile
from ..view.planes import Planes
from ..view.pyramid import Screen, blur_level, fill_depth_levels, new_blur_scratch, new_screen_buffers
from ..view.quiet import SIDE as QUIET_SIDE
from ..view.quiet import Care, QuietScratch, quiet_tile
from ..world.tables import World
from .integrator import Pass
from .ready import Ready, is_rough
from .work import tiles_of

_SKY_STEP = 3.0
"""Of the tolerance: by how much the share of the sky may change over a cell."""
_SKY_NOISE = 0.8
"""Times the number of rays to the power of -3/4: by how much it may change by chance. Cells that noise cuts in four get
nodes with fewer rays, and more noise."""


RING = 4
"""Pixels from the border of what is drawn to those by which lines are known to end: what tells a line looks at two of
them around, and so does what follows it."""
_LOOKED_AT_ONCE = 64
"""Pixels on lines behind glass; no more than a patch has."""


def needs_compiling(settings: RenderSettings) -> bool:
    """The largest kernel that these settings ask for is not there yet."""
    return not is_compiled(corner_tile if settings.by_corners else tree_tile)


def sample_views(camera: Camera, size: tuple[int, int], samples: int) -> Iterator[View]:
    """The views of samples that are pictures of their own, each through its place of a pixel and its point of a lens:
    a screen that glass may ask shows what is seen from one point."""
    for offset, lens in zip(pixel_offsets(samples), lens_points(samples), strict=True):
        yield view_of(camera, *size, offset, samples, lens)


class Tree:
    """An `Integrator`. Holds the buffers that pictures are drawn into; `planes` take the sums of all samples.

    Pixels are made from their corners, and samples drawn where these differ (`transport.corners`); or every sample is a
    picture of its own, with an opaque picture to ask: where there is one sample alone, where no difference is passed,
    and for HDRP's proxies, which tell a pixel by its place.
    """

    def __init__(
        self, ready: Ready, scene: Scene, camera: Camera, settings: RenderSettings, window: Tile, planes: Planes,
        samples: Sequence[int] = (), before: int = 0,
    ) -> None:  # fmt: skip
        """
        Args:
            window: pixels that are wanted; of the others the planes get whatever is drawn along with those.
            samples: those of the settings' that are drawn, where each is a picture of its own; () is all of them.
            before: samples that the planes have already.
        """
        self.samples, self.before = samples or range(settings.samples), before
        height, width = planes.mask.shape
        self.ready, self.camera, self.settings, self.planes = ready, camera, settings, planes
        self.window = window
        self.order = np.array([TIERS.index(t) for t in settings.tiers], np.int32)
        self.method = SCREEN_METHODS.index(settings.screen)
        self.rules = by_address(Rules(settings.max_layers, settings.cut, settings.screen != "proxy"))
        self.view_ray = by_address(view_ray(scene, camera, settings.model))
        self.by_corners = settings.by_corners
        self.size = (width, height)
        self.tiles = meeting(tiles_of(width, height, settings.tile_size), window)
        whole = window == (0, 0, width, height)
        self.sees_glass = whole or glass_in(
            scene, camera, view_of(camera, width, height), looked_at(window, PATCH, PATCH)
        )
        asked = "screen" in settings.tiers and self.sees_glass
        self.quiet: set[Tile] = set()
        self.looked_at = (0, 0, width + 1, height + 1) if asked else looked_at(window, PATCH)
        """What of the picture without glass is drawn: all of it where glass may ask it about anything"""
        width, height = (width + 1, height + 1) if self.by_corners else (width, height)
        self.screen = new_screen_buffers(width, height, is_rough(scene), self.by_corners)
        self.blurring = by_address(new_blur_scratch(self.screen.color_level))
        # The opaque layer is level 0 of the screen's pyramids.
        self.opaque = OpaqueLayer(
            self.screen.color[: width * height].reshape(height, width, 4),
            self.screen.depth[: width * height].reshape(height, width),
            self.screen.normal,
            self.screen.irradiance,
            self.screen.gloss,
            self.screen.seen,
            np.zeros((height, width), np.uint8),
            new_hits(width, height) if self.by_corners else new_hits(0, 0),
        )

    def passes(self) -> Iterator[Pass]:
        if self.by_corners:
            yield from self._corner_passes()
            return
        views = list(sample_views(self.camera, self.size, self.settings.samples))
        for done, sample in enumerate(self.samples, self.before + 1):
            yield from self._sample_passes(views[sample], sample, 1.0 / self.settings.samples, done)

    def _corner_passes(self) -> Iterator[Pass]:
        settings, (width, height) = self.settings, self.size
        view = view_of(self.camera, width, height)
        corners = corners_of(view)
        yield from self._quiet_passes(corners, 0.3, self.looked_at)
        exposure = self.camera.exposure_scale * 2.0**settings.exposure
        few, rays = max(2, settings.samples // 4), settings.light_samples
        sets = [pixel_offsets(n) for n in (few, max(few, settings.samples // 2), settings.samples)]
        refining = by_address(
            Refining(
                settings.tolerance, exposure, np.concatenate(sets), np.cumsum([0, *map(len, sets)]), settings.samples,
                rays, max(1, rays // few),
            )
        )  # fmt: skip
        common = self.ready.world, by_address(self._asking(corners)), self.rules, self.view_ray, refining
        opaque, target, pixels = by_address(self.opaque), by_address(self.planes), by_address(view)
        ways = Ways(np.zeros((height + 1, width + 1), np.int64), np.zeros((height, width), np.uint8))
        known = by_address(ways)

        def draw(tile: Tile) -> int:
            own, tree = scratch(CornerScratch), scratch(TreeScratch)
            return int(corner_tile(*common, tree, own, tile, pixels, opaque, target, known))

        def look(some: NDArray[np.int64]) -> int:
            return int(look_behind(*common, scratch(TreeScratch), some, pixels, known))

        def draw_again(some: NDArray[np.int64]) -> int:
            own, tree = scratch(CornerScratch), scratch(TreeScratch)
            return int(draw_behind(*common, tree, own, some, pixels, target))

        inner = np.zeros((height, width), np.bool_)
        for patches in self._regions(ways, inner, common, pixels):
            yield from self._quiet_passes(corners, 0.0, looked_at(_around(patches), PATCH))
            yield Pass(draw, patches, 0.7, settings.samples)
        if not ways.at.any():
            return

        near = np.zeros((height, width), np.uint8)
        yield Pass(lambda y: _without_rays(lambda: mark_lines(known, y, min(y + PATCH, height), near)),
                   range(0, height, PATCH), 0.0)  # fmt: skip
        waiting = np.flatnonzero((near != 0) & (ways.state == OPEN) & inner)
        lines = [waiting[:0]]
        while len(waiting):
            yield Pass(look, _in_parts(waiting, _LOOKED_AT_ONCE), 0.0)
            thin, waiting = beside(ways, waiting)
            lines.append(thin)
        yield Pass(draw_again, _in_parts(np.sort(np.concatenate(lines)), _LOOKED_AT_ONCE), 0.0)

    def _regions(
        self, ways: Ways, inner: NDArray[np.bool_], common: tuple[World, Asking, Rules, Rays, Refining], pixels: View
    ) -> Iterator[list[Tile]]:
        """Patches to draw, some after the other, until no line behind glass leads out of what is drawn.

        A line is followed from pixel to pixel, so whether a pixel is on one may hang on what lies far away. Where none
        crosses a ring of pixels around the window, nothing beyond it matters. Otherwise what lies there is drawn, too.

        Args:
            ways: what has been drawn of them.
            inner: shape (H, W); becomes 1 within the ring and on it.
        """
        width, height = self.size
        patches = tiles_of(width, height, PATCH)
        if self.window == (0, 0, width, height):
            inner[:] = True
            yield patches
            return
        x0, y0, x1, y1 = self.window
        drawn: set[Tile] = set()
        wanted = set(meeting(patches, (x0 - RING, y0 - RING, x1 + RING, y1 + RING)))
        while wanted:
            yield sorted(wanted, key=lambda tile: (tile[1], tile[0]))
            drawn |= wanted
            if not self.sees_glass:
                return
            wanted = set()
            there = np.zeros((height, width), np.bool_)
            for left, top, right, bottom in drawn:
                there[top:bottom, left:right] = True
            inner[:] = _shrunk(there, RING - 1)
            ring = np.flatnonzero(inner & ~_shrunk(there, RING))
            if not len(ring):
                return
            tried = Ways(ways.at, ways.state.copy())
            look_behind(*common, scratch(TreeScratch), ring, pixels, by_address(tried))
            thin, _ = beside(tried, ring)
            for y, x in zip(*np.divmod(thin, width), strict=True):
                at = int(x), int(y)
                wanted |= set(meeting(patches, (at[0] - PATCH, at[1] - PATCH, at[0] + PATCH, at[1] + PATCH)))
            wanted -= drawn

    def _sample_passes(self, view: View, sample: int, share: float, done: int) -> Iterator[Pass]:
        world, asking, camera = self.ready.world, by_address(self._asking(view)), by_address(view)
        opaque, target = by_address(self.opaque), by_address(self.planes)

        def look(tile: Tile) -> tuple[int, int]:
            return opaque_tile(world, camera, scratch(ViewScratch), tile, sample, opaque)

        tiles = meeting(tiles_of(*self.size, self.settings.tile_size), self.looked_at)
        yield from self._looking(look, tiles, 0.3 * share)

        def grow(tile: Tile) -> int:
            tree = scratch(TreeScratch)
            return int(tree_tile(world, asking, self.rules, self.view_ray, tree, tile, sample, opaque, target))

        yield Pass(grow, self.tiles, 0.7 * share, done)

    def _quiet_passes(self, view: View, share: float, part: Tile) -> Iterator[Pass]:
        """Draw a part of the corners' picture without glass, as far as it is not there yet."""
        world, camera, opaque = self.ready.world, by_address(view), by_address(self.opaque)
        rays = self.settings.light_samples
        step = max(_SKY_STEP * self.settings.tolerance, _SKY_NOISE / rays**0.75)
        care = by_address(Care(rays, min(0.5, step)))
        width, height = self.size

        def look(tile: Tile) -> tuple[int, int]:
            return quiet_tile(world, camera, scratch(QuietScratch), care, tile, opaque)

        tiles = meeting(tiles_of(width + 1, height + 1, QUIET_SIDE), part)
        tiles = [tile for tile in tiles if tile not in self.quiet]
        self.quiet.update(tiles)
        if tiles:
            yield from self._looking(look, tiles, share)

    def _looking(self, look: Callable[[Tile], tuple[int, int]], tiles: list[Tile], share: float) -> Iterator[Pass]:
        """Draw the picture without glass, and what the screen tier reads of it.

        Args:
            look: draws a tile; returns rays traced, and pixels with glass before them.
        """
        glassy: list[Tile] = []

        def draw(tile: Tile) -> int:
            rays, glass = look(tile)
            if glass:
                glassy.append(tile)
            return rays

        yield Pass(draw, tiles, share)
        if TIERS.index("screen") in self.order and glassy:
            yield Pass(_without_rays, self._levels(), 0.0)

    def _asking(self, view: View) -> Asking:
        """Whom leaves ask, where `view` has drawn the opaque picture."""
        ready, traces = self.ready, TIERS.index("ray") in self.order
        screen = Screen(view, *self.screen)
        return Asking(self.order, self.method, traces, self.by_corners, screen, ready.probes, ready.thing_probe)

    def _levels(self) -> list[Callable[[], Any]]:
        """What makes the pyramids above the opaque picture, as far as somebody will read them."""
        screen = self.screen

        def depths() -> None:
            fill_depth_levels(screen.depth, screen.farthest, screen.depth_level)

        def colors() -> None:
            for level in range(1, len(screen.color_level)):
                blur_level(screen.color, screen.color_level, level, self.blurring)

        # `proxy` lets reflections march; `traced` needs no depth but the picture's own.
        return [colors] if SCREEN_METHODS[self.method] == "traced" else [depths, colors]


def _around(tiles: list[Tile]) -> Tile:
    """The smallest window that holds them."""
    lefts, tops, rights, bottoms = zip(*tiles, strict=True)
    return min(lefts), min(tops), max(rights), max(bottoms)


def _shrunk(there: NDArray[np.bool_], steps: int) -> NDArray[np.bool_]:
    """Pixels that are farther than so many steps from any that is not there; beyond the picture nothing is missing."""
    for axis in (0, 1):
        kept = there.copy()
        for step in range(1, steps + 1):
            low, high = [slice(None)] * 2, [slice(None)] * 2
            low[axis], high[axis] = slice(step, None), slice(None, -step)
            kept[tuple(high)] &= there[tuple(low)]
            kept[tuple(low)] &= there[tuple(high)]
        there = kept
    return there


def _in_parts(pixels: NDArray[np.int64], most: int) -> list[NDArray[np.int64]]:
    return [pixels[first : first + most] for first in range(0, len(pixels), most)]


def _without_rays(job: Callable[[], Any]) -> int:
    job()
    return 0
