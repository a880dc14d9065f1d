"""Cryptomatte of a picture: rays of their own through every pixel, and hashes of the names of what they meet first."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ..images.cryptomatte import RANKS, Matte, hash_of
from ..kernels.lanes import by_address, scratch
from ..scene import Camera, Scene
from ..settings import RenderSettings
from ..view.camera import Tile
from ..view.crop import meeting, part_of
from ..view.gbuffer import ViewScratch
from ..view.mattes import rank, see_first
from ..world.instances import thing_count
from .branching import sample_views
from .ready import Ready
from .work import Work, tiles_of

SAMPLES = (16, 64)
"""Fewest and most rays of a pixel: an edge of a matte needs at least sixteen steps of coverage."""
_NAMES = {"object": "CryptoObject", "material": "CryptoMaterial"}


def draw_mattes(
    ready: Ready, scene: Scene, camera: Camera, settings: RenderSettings, size: tuple[int, int], work: Work,
    window: Tile,
) -> tuple[tuple[Matte, ...], int]:  # fmt: skip
    """The mattes that the settings ask for, and rays traced. An object is a thing that is drawn, by its path; each
    instance is one. A material is that of the stage, by its path. What has none of either is nobody's.

    The rays are those that the picture's own samples would be: through the same places of a pixel and points of a lens.
    """
    if not settings.cryptomatte:
        return (), 0
    width, height = size
    samples = min(max(settings.samples, SAMPLES[0]), SAMPLES[1])
    views = [by_address(view) for view in sample_views(camera, size, samples)]
    books = {"object": _Hashes(thing_count(scene), _thing_name(scene)),
             "material": _Hashes(len(scene.materials), lambda row: scene.materials[row].name)}  # fmt: skip
    drawn = {kind: np.zeros((height, width, 2 * RANKS), np.float32) for kind in settings.cryptomatte}

    def draw(tile: Tile) -> int:
        shape = samples, min(tile[3], height) - tile[1], min(tile[2], width) - tile[0]
        seen = {"object": np.empty(shape, np.int32), "material": np.empty(shape, np.int32)}
        rays = 0
        for k, view in enumerate(views):
            own = scratch(ViewScratch)
            rays += int(see_first(ready.world, view, own, tile, k, seen["object"], seen["material"]))
        kept, counts = np.empty((2, samples), np.int32)
        for kind, ranks in drawn.items():
            rank(seen[kind], books[kind].of(seen[kind]), tile, kept, counts, ranks.view(np.int32), ranks)
        return rays

    rays = sum(work.run(draw, meeting(tiles_of(width, height, settings.tile_size), window)))
    found = {kind: part_of(ranks, window) for kind, ranks in drawn.items()}
    return tuple(Matte(_NAMES[kind], ranks, books[kind].manifest()) for kind, ranks in found.items()), rays


class _Hashes:
    """Bits of the ids of numbered things, made when a thing is first seen: of a million, few are in a picture."""

    def __init__(self, count: int, name: Callable[[int], str]) -> None:
        self._name = name
        self._bits = np.zeros(max(count, 1), np.int32)
        self._known: dict[int, str] = {}
        self._lock = threading.Lock()

    def of(self, seen: NDArray[np.int32]) -> NDArray[np.int32]:
        """Bits by number, right for all that is seen."""
        rows = np.unique(seen)
        with self._lock:
            for row in rows[(rows >= 0) & (self._bits[rows] == 0)].tolist():
                self._known[row] = self._name(row)
                self._bits[row] = np.uint32(hash_of(self._known[row])).view(np.int32)
        return self._bits

    def manifest(self) -> dict[str, int]:
        """Bits of the ids of the names that were seen."""
        return {name: hash_of(name) for name in self._known.values()}


def _thing_name(scene: Scene) -> Callable[[int], str]:
    """Path of the thing with a number (`world.instances.thing_count`)."""
    alone = [mesh.path for mesh in scene.meshes] + [ball.path for ball in scene.spheres]
    groups: list[Sequence[str]] = [alone]
    groups += [many.paths for many in scene.instances] + [balls.paths for balls in scene.balls]
    firsts = np.cumsum([0, *map(len, groups)])

    def name(number: int) -> str:
        at = int(np.searchsorted(firsts, number, side="right")) - 1
        return groups[at][number - int(firsts[at])]

    return name
