"""Today's integrator: the opaque picture, then refractive layers over it, far to near, each from what is behind it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ..kernels.lanes import scratch
from ..kernels.pointer import Pointer
from ..models import BY_TOKEN
from ..scene import Scene
from ..settings import TIERS, RenderSettings
from ..transport.layers import LayerScratch, new_layer_result, put_tile, refract_tile
from ..transport.tiers import Asking
from ..view.camera import View
from ..view.gbuffer import (
    OpaqueLayer,
    ViewScratch,
    new_refractive_layer,
    opaque_tile,
    peel_tile,
)
from ..view.planes import Planes, add_tile
from ..view.pyramid import Screen, blur_level, fill_depth_levels, new_screen_buffers
from .integrator import Pass
from .session import Session, is_rough
from .work import Tile


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
        # The opaque layer is level 0 of the screen's pyramids.
        self.opaque = OpaqueLayer(
            self.screen.color[: width * height].reshape(height, width, 3),
            self.screen.depth[: width * height].reshape(height, width),
            self.screen.normal,
            np.zeros((height, width), np.float32),
        )
        self.layers = [new_refractive_layer(width, height)]
        self.result = new_layer_result(width, height)

    def passes(self, view: View, sample: int) -> Iterator[Pass]:
        world, camera = self.session.world, Pointer(view)
        behind, first, target = Pointer(self.opaque), Pointer(self.layers[0]), Pointer(self.planes)
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
            yield Pass(self._peeling(camera, Pointer(self.layers[used - 1]), Pointer(self.layers[used]), found), busy)
            if not any(found):
                break
            used += 1
        if sample == 0:
            for layer in self.layers[:used]:
                np.add(self.planes.layers, layer.part >= 0, out=self.planes.layers)
        for k in reversed(range(used if busy else 0)):
            yield from self._composited(view, sample, k, busy)
        yield Pass(lambda tile: add_tile(target, behind, view.size, tile) or 0, self.tiles)

    def _peeling(
        self, camera: Pointer, previous: Pointer, here: Pointer, found: list[int], *, inside: bool = False
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
                    blur_level(screen.color, screen.color_level, level)

            yield Pass(_without_rays, [levels, blur])
        asking = Pointer(
            Asking(self.order, self.by_proxy, Screen(view, *screen), session.probes.record, session.thing_probe)
        )
        layer, result, planes = Pointer(self.layers[k]), Pointer(self.result), Pointer(self.planes)

        def refract(tile: Tile) -> int:
            return int(
                refract_tile(
                    session.world, asking, self.model, scratch(LayerScratch), tile, sample, layer, result, planes,
                    k == 0,
                )
            )  # fmt: skip

        yield Pass(refract, busy)
        picture = Pointer(self.opaque)
        yield Pass(lambda tile: put_tile(layer, result, picture, view.size, tile) or 0, busy)


def _without_rays(job: Callable[[], Any]) -> int:
    job()
    return 0
