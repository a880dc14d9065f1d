"""Today's integrator: the opaque picture, then refractive layers over it, far to near, each from what is behind it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ..kernels.lanes import by_address, scratch
from ..models import BY_TOKEN
from ..scene import Scene
from ..settings import TIERS, RenderSettings
from ..transport.layers import LayerScratch, new_layer_result, put_tile, refract_tile
from ..transport.tiers import Asking
from ..view.camera import Tile, View
from ..view.gbuffer import (
    OpaqueLayer,
    RefractiveLayer,
    ViewScratch,
    new_refractive_layer,
    opaque_tile,
    peel_tile,
)
from ..view.planes import Planes, add_tile
from ..view.pyramid import Screen, blur_level, fill_depth_levels, new_blur_scratch, new_screen_buffers
from .integrator import Pass
from .session import Session, is_rough


class Layered:
    """An `Integrator`. Holds the buffers that every sample draws into anew; `planes` take the sums."""

    def __init__(
        self, session: Session, scene: Scene, settings: RenderSettings, tiles: list[Tile], planes: Planes
    ) -> None:
        height, width = planes.mask.shape
        self.session, self.tiles, self.planes = session, tiles, planes
        self.order = np.array([TIERS.index(t) for t in settings.tiers], np.int32)
        self.by_proxy = settings.screen == "proxy"
        self.model = int(BY_TOKEN[settings.model]) if settings.model else -1
        self.max_layers = settings.max_layers
        self.screen = new_screen_buffers(width, height, is_rough(scene))
        self.blurring = by_address(new_blur_scratch(self.screen.color_level))
        # The opaque layer is level 0 of the screen's pyramids.
        self.opaque = OpaqueLayer(
            self.screen.color[: width * height].reshape(height, width, 4),
            self.screen.depth[: width * height].reshape(height, width),
            self.screen.normal,
        )
        self.layers = [new_refractive_layer(width, height)]
        self.result = new_layer_result(width, height)

    def passes(self, view: View, sample: int) -> Iterator[Pass]:
        world, camera = self.session.world, by_address(view)
        behind, first, target = by_address(self.opaque), by_address(self.layers[0]), by_address(self.planes)
        busy: list[Tile] = []
        """tiles with glass in them"""
        inside: list[Tile] = []
        """tiles where the eye is in glass, or looks at an inner side"""

        def look(tile: Tile) -> int:
            rays, entered, left = opaque_tile(world, camera, scratch(ViewScratch), tile, sample, behind, first)
            if entered:
                busy.append(tile)
            if left:
                inside.append(tile)
            return int(rays)

        yield Pass(look, self.tiles)
        if sample == 0:
            self.planes.z_depth[:] = self.opaque.depth
            self.planes.normal[:] = self.opaque.normal
        if inside:  # go on to the first surface entered
            yield Pass(self._peeling(camera, first, first, [], inside=True), inside)
        used = 1
        while busy and used < self.max_layers:
            if used == len(self.layers):
                self.layers.append(new_refractive_layer(*(int(n) for n in view.size)))
            found: list[int] = []
            previous, here = by_address(self.layers[used - 1]), by_address(self.layers[used])
            yield Pass(self._peeling(camera, previous, here, found), busy)
            if not any(found):
                break
            used += 1
        if sample == 0:
            for layer in self.layers[:used]:
                np.add(self.planes.layers, layer.part >= 0, out=self.planes.layers)
        for k in reversed(range(used if busy else 0)):
            yield from self._composited(view, sample, k, busy)
        yield Pass(lambda tile: _without_rays(lambda: add_tile(target, behind, view.size, tile)), self.tiles)

    def _peeling(
        self, camera: View, previous: RefractiveLayer, here: RefractiveLayer, found: list[int], *, inside: bool = False
    ) -> Callable[[Tile], int]:
        """Finds the layer behind `previous`; how many pixels have one goes to `found`, tile by tile."""

        def peel(tile: Tile) -> int:
            rays, pixels = peel_tile(
                self.session.world, camera, scratch(ViewScratch), tile, self.opaque.depth, previous, here, inside
            )
            found.append(int(pixels))
            return int(rays)

        return peel

    def _composited(self, view: View, sample: int, k: int, busy: list[Tile]) -> Iterator[Pass]:
        """Draw layer `k` from the picture as it is behind it, then put it into the picture."""
        screen, session = self.screen, self.session
        if TIERS.index("screen") in self.order:
            blurs = range(1, len(screen.color_level))

            def levels() -> None:
                fill_depth_levels(screen.depth, screen.farthest, screen.depth_level)

            def blur() -> None:
                for level in blurs:
                    blur_level(screen.color, screen.color_level, level, self.blurring)

            yield Pass(_without_rays, [levels, blur])
        asking = by_address(
            Asking(self.order, self.by_proxy, Screen(view, *screen), session.probes, session.thing_probe)
        )
        layer, result, planes = by_address(self.layers[k]), by_address(self.result), by_address(self.planes)

        def refract(tile: Tile) -> int:
            return int(
                refract_tile(
                    session.world, asking, self.model, scratch(LayerScratch), tile, sample, layer, result, planes,
                    k == 0,
                )
            )  # fmt: skip

        yield Pass(refract, busy)
        picture = by_address(self.opaque)
        yield Pass(lambda tile: _without_rays(lambda: put_tile(layer, result, picture, view.size, tile)), busy)


def _without_rays(job: Callable[[], Any]) -> int:
    job()
    return 0
