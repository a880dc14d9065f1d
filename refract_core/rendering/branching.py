"""The integrator: the opaque picture, then a tree of rays for every pixel that sees glass."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ..kernels.lanes import by_address, scratch
from ..models import BY_TOKEN
from ..scene import Camera, Scene
from ..settings import SCREEN_METHODS, TIERS, RenderSettings
from ..transport.crossing import Rules
from ..transport.eye import view_ray
from ..transport.pixels import tree_tile
from ..transport.tiers import Asking
from ..transport.tree import TreeScratch
from ..view.camera import Tile, View
from ..view.gbuffer import OpaqueLayer, ViewScratch, opaque_tile
from ..view.planes import Planes
from ..view.pyramid import Screen, blur_level, fill_depth_levels, new_blur_scratch, new_screen_buffers
from .integrator import Pass
from .session import Session, is_rough


class Tree:
    """An `Integrator`. Holds the buffers that every sample draws into anew; `planes` take the sums."""

    def __init__(
        self, session: Session, scene: Scene, camera: Camera, settings: RenderSettings, tiles: list[Tile],
        planes: Planes,
    ) -> None:  # fmt: skip
        height, width = planes.mask.shape
        self.session, self.tiles, self.planes = session, tiles, planes
        self.order = np.array([TIERS.index(t) for t in settings.tiers], np.int32)
        self.method = SCREEN_METHODS.index(settings.screen)
        model = int(BY_TOKEN[settings.model]) if settings.model else -1
        self.rules = Rules(model, settings.max_layers, settings.cut, settings.screen != "proxy")
        self.view_ray = view_ray(scene, camera, settings.model)
        self.screen = new_screen_buffers(width, height, is_rough(scene))
        self.blurring = by_address(new_blur_scratch(self.screen.color_level))
        # The opaque layer is level 0 of the screen's pyramids.
        self.opaque = OpaqueLayer(
            self.screen.color[: width * height].reshape(height, width, 4),
            self.screen.depth[: width * height].reshape(height, width),
            self.screen.normal,
            self.screen.irradiance,
            self.screen.gloss,
            np.zeros((height, width), np.uint8),
        )

    def passes(self, view: View, sample: int) -> Iterator[Pass]:
        world, camera = self.session.world, by_address(view)
        opaque, target = by_address(self.opaque), by_address(self.planes)
        glassy: list[Tile] = []

        def look(tile: Tile) -> int:
            rays, glass = opaque_tile(world, camera, scratch(ViewScratch), tile, sample, opaque)
            if glass:
                glassy.append(tile)
            return int(rays)

        yield Pass(look, self.tiles)
        if TIERS.index("screen") in self.order and glassy:
            yield Pass(_without_rays, self._levels())
        session = self.session
        traces = TIERS.index("ray") in self.order
        asking = by_address(
            Asking(self.order, self.method, traces, Screen(view, *self.screen), session.probes, session.thing_probe)
        )
        rules, ray = by_address(self.rules), by_address(self.view_ray)

        def grow(tile: Tile) -> int:
            return int(tree_tile(world, asking, rules, ray, scratch(TreeScratch), tile, sample, opaque, target))

        yield Pass(grow, self.tiles)

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
