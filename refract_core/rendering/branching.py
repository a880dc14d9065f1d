"""The integrator: the opaque picture, then a tree of rays for every pixel that sees glass."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ..kernels.compile import is_compiled
from ..kernels.lanes import by_address, scratch
from ..kernels.sampling import pixel_offsets
from ..scene import Camera, Scene
from ..settings import SCREEN_METHODS, TIERS, RenderSettings
from ..transport.corners import PATCH, CornerScratch, Refining, corner_tile
from ..transport.crossing import Rules
from ..transport.eye import view_ray
from ..transport.pixels import tree_tile
from ..transport.tiers import Asking
from ..transport.tree import TreeScratch
from ..view.camera import Tile, View, corners_of, lens_points, view_of
from ..view.gbuffer import OpaqueLayer, ViewScratch, new_hits, opaque_tile
from ..view.planes import Planes
from ..view.pyramid import Screen, blur_level, fill_depth_levels, new_blur_scratch, new_screen_buffers
from ..view.quiet import SIDE as QUIET_SIDE
from ..view.quiet import Care, QuietScratch, quiet_tile
from .integrator import Pass
from .ready import Ready, is_rough
from .work import tiles_of

_SKY_STEP = 3.0
"""Of the tolerance: by how much the share of the sky may change over a cell."""
_SKY_NOISE = 0.8
"""Times the number of rays to the power of -3/4: by how much it may change by chance. Cells that noise cuts in four get
nodes with fewer rays, and more noise."""


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
        self, ready: Ready, scene: Scene, camera: Camera, settings: RenderSettings, tiles: list[Tile],
        planes: Planes,
    ) -> None:  # fmt: skip
        height, width = planes.mask.shape
        self.ready, self.camera, self.settings, self.tiles, self.planes = ready, camera, settings, tiles, planes
        self.order = np.array([TIERS.index(t) for t in settings.tiers], np.int32)
        self.method = SCREEN_METHODS.index(settings.screen)
        self.rules = by_address(Rules(settings.max_layers, settings.cut, settings.screen != "proxy"))
        self.view_ray = by_address(view_ray(scene, camera, settings.model))
        self.by_corners = settings.by_corners
        self.size = (width, height)
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
        samples = self.settings.samples
        for sample, view in enumerate(sample_views(self.camera, self.size, samples)):
            yield from self._sample_passes(view, sample, 1.0 / samples)

    def _corner_passes(self) -> Iterator[Pass]:
        settings, (width, height) = self.settings, self.size
        view = view_of(self.camera, width, height)
        corners = corners_of(view)
        yield from self._quiet_passes(corners, 0.3)
        exposure = self.camera.exposure_scale * 2.0**settings.exposure
        few, rays = max(2, settings.samples // 4), settings.light_samples
        sets = [pixel_offsets(n) for n in (few, max(few, settings.samples // 2), settings.samples)]
        refining = by_address(
            Refining(
                settings.tolerance, exposure, np.concatenate(sets), np.cumsum([0, *map(len, sets)]), settings.samples,
                rays, max(1, rays // few),
            )
        )  # fmt: skip
        world, asking, samples_view = self.ready.world, by_address(self._asking(corners)), by_address(view)
        opaque, target = by_address(self.opaque), by_address(self.planes)

        def draw(tile: Tile) -> int:
            own, tree = scratch(CornerScratch), scratch(TreeScratch)
            return int(
                corner_tile(
                    world, asking, self.rules, self.view_ray, refining, tree, own, tile, samples_view, opaque, target
                )
            )

        yield Pass(draw, tiles_of(width, height, PATCH), 0.7)

    def _sample_passes(self, view: View, sample: int, share: float) -> Iterator[Pass]:
        world, asking, camera = self.ready.world, by_address(self._asking(view)), by_address(view)
        opaque, target = by_address(self.opaque), by_address(self.planes)

        def look(tile: Tile) -> tuple[int, int]:
            return opaque_tile(world, camera, scratch(ViewScratch), tile, sample, opaque)

        yield from self._looking(look, self.tiles, 0.3 * share)

        def grow(tile: Tile) -> int:
            tree = scratch(TreeScratch)
            return int(tree_tile(world, asking, self.rules, self.view_ray, tree, tile, sample, opaque, target))

        yield Pass(grow, self.tiles, 0.7 * share)

    def _quiet_passes(self, view: View, share: float) -> Iterator[Pass]:
        """Draw the corners' picture without glass."""
        world, camera, opaque = self.ready.world, by_address(view), by_address(self.opaque)
        rays = self.settings.light_samples
        step = max(_SKY_STEP * self.settings.tolerance, _SKY_NOISE / rays**0.75)
        care = by_address(Care(rays, min(0.5, step)))
        width, height = self.size

        def look(tile: Tile) -> tuple[int, int]:
            return quiet_tile(world, camera, scratch(QuietScratch), care, tile, opaque)

        yield from self._looking(look, tiles_of(width + 1, height + 1, QUIET_SIDE), share)

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


def _without_rays(job: Callable[[], Any]) -> int:
    job()
    return 0
