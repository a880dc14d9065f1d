"""The two planes that a denoiser reads beside a picture, and that picture denoised."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..images.denoise import denoised
from ..kernels.lanes import by_address, scratch
from ..scene import F32, Camera, Scene
from ..settings import RenderSettings
from ..transport.crossing import Rules
from ..transport.eye import view_ray
from ..transport.features import Features, features_tile
from ..transport.tree import TreeScratch
from ..view.camera import Tile, View
from ..view.crop import meeting, part_of
from ..view.planes import finish_of
from .branching import sample_views
from .ready import Ready
from .work import Work, tiles_of

_SAMPLES, _LENS_SAMPLES = 8, 32
"""Most samples of a pixel: edges are as smooth as they are in the picture; with a lens, as blurred."""
_CUT = 0.1
"""Weight below which a branch of light tells nothing that a denoiser would miss."""


class Found(NamedTuple):
    """Planes of a whole picture."""

    albedo: F32
    """shape (H, W, 3), 0 .. 1"""
    normal: F32
    """shape (H, W, 3), the stage's world"""
    rays: int


def features_of(
    ready: Ready, scene: Scene, camera: Camera, settings: RenderSettings, size: tuple[int, int], work: Work,
    window: Tile, of_picture: Sequence[int] = (),
) -> Found:  # fmt: skip
    """Draw the planes `albedo` and `denoising_normal`, of a window of the picture.

    Args:
        of_picture: which of the picture's own samples to draw; () is as many of their own as edges and lens need.
    """
    width, height = size
    if of_picture:
        every = list(sample_views(camera, size, settings.samples))
        views = {sample: every[sample] for sample in of_picture}
    else:
        samples = min(settings.samples, _LENS_SAMPLES if camera.lens_radius > 0.0 else _SAMPLES)
        views = dict(enumerate(sample_views(camera, size, samples)))
    sums = Features(np.zeros((height, width, 3), np.float32), np.zeros((height, width, 3), np.float32))
    rules = by_address(Rules(settings.max_layers, max(settings.cut, _CUT), settings.screen != "proxy"))
    start, target = by_address(view_ray(scene, camera, settings.model)), by_address(sums)
    tiles = meeting(tiles_of(width, height, settings.tile_size), window)
    rays = 0
    for sample, view in views.items():
        seen = by_address(view)

        def look(tile: Tile, seen: View = seen, sample: int = sample) -> int:
            return int(features_tile(ready.world, seen, rules, start, scratch(TreeScratch), tile, sample, target))

        rays += sum(work.run(look, tiles))
    turn = finish_of(scene, len(views), 1.0).stage_rotation
    share = np.float32(1.0 / len(views))
    sums = Features(*(part_of(plane, window) for plane in sums))
    normal = (sums.normal * share) @ turn.T.astype(np.float32)
    return Found(sums.albedo * share, np.ascontiguousarray(normal, np.float32), rays)


def without_noise(beauty: F32, found: Found, settings: RenderSettings, camera: Camera) -> F32:
    """`beauty`, shape (H, W, 4), with its noise taken out; its alpha is untouched."""
    # A corner belongs to four pixels, so neighbours share their noise.
    shared = settings.by_corners and camera.lens_radius == 0.0
    quiet = beauty.copy()
    quiet[..., :3] = denoised(
        np.ascontiguousarray(beauty[..., :3]), found.albedo, found.normal, settings.jobs, shared=shared
    )
    return quiet
