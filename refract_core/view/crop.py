"""Part of a picture: which pixels are asked for, and what of the rest of the picture they need.

A pixel of a part is the same, bit by bit, as in the whole picture. So nothing is left out that reaches from afar: light
through glass, light between surfaces and what probes see are made for the whole picture always; the picture without
glass wherever glass may ask it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from ..errors import UsageError
from ..scene import F32, F64, Camera, Mesh, Scene
from ..settings import RenderSettings
from .camera import Tile, View

MARGIN = 4
"""Pixels around a part within which its own samples look at the picture without glass: twice what they do."""
_ALIGNED = 64
"""Pixels on which the parts of `--tile-count` begin, in pictures that are large enough: those that work is cut into."""


def window_of(settings: RenderSettings, width: int, height: int) -> Tile:
    """The pixels that the settings ask for, of a picture of this size.

    Shares are rounded up to pixels at both ends, as pbrt and Hydra have it, so that parts that touch share no pixel.

    Raises:
        UsageError: there are none, or they are not in the picture.
    """
    if settings.tile_count != (1, 1):
        columns, rows = settings.tile_count
        if columns > width or rows > height:
            raise UsageError(f"tile_count is {columns} by {rows}, but the picture has {width} x {height} pixels")
        x, y = _cuts(width, columns), _cuts(height, rows)
        i, j = settings.tile_index % columns, settings.tile_index // columns
        return x[i], y[j], x[i + 1], y[j + 1]
    if not settings.crop:
        return 0, 0, width, height
    x0, y0, x1, y1 = settings.crop
    if max(settings.crop) <= 1.0:
        x0, y0, x1, y1 = (math.ceil(at * side) for at, side in zip((x0, y0, x1, y1), (width, height) * 2, strict=True))
    found = int(x0), int(y0), int(x1), int(y1)
    if found != (x0, y0, x1, y1):
        raise UsageError(f"crop is {_said(settings)}; give shares of the picture, 0 to 1, or whole pixels")
    if found[2] > width or found[3] > height:
        raise UsageError(f"crop is {_said(settings)}, but the picture has {width} x {height} pixels")
    if found[0] >= found[2] or found[1] >= found[3]:
        raise UsageError(f"crop is {_said(settings)}, which holds no pixel of a picture of {width} x {height}")
    return found


def _said(settings: RenderSettings) -> str:
    return ",".join(f"{at:g}" for at in settings.crop)


def _cuts(side: int, count: int) -> list[int]:
    step = _ALIGNED if side >= _ALIGNED * count else 1
    return [min(side, round(k * side / count / step) * step) if k < count else side for k in range(count + 1)]


def meeting(tiles: list[Tile], window: Tile) -> list[Tile]:
    """Those that have a pixel of the window."""
    x0, y0, x1, y1 = window
    return [tile for tile in tiles if tile[0] < x1 and tile[2] > x0 and tile[1] < y1 and tile[3] > y0]


def part_of(plane: F32, window: Tile) -> F32:
    """The window of a plane, shape (H, W) or (H, W, C); the plane itself where it is all of it."""
    x0, y0, x1, y1 = window
    part = plane[y0:y1, x0:x1]
    return plane if part.shape == plane.shape else part.copy()


def looked_at(window: Tile, patch: int, more: int = 0) -> Tile:
    """What patches that have pixels of a window see of the picture without glass, by their own samples and corners;
    `more`: pixels around that are patches of the window, too."""
    x0, y0, x1, y1 = window[0] - more, window[1] - more, window[2] + more, window[3] + more
    return (
        x0 // patch * patch - MARGIN, y0 // patch * patch - MARGIN,
        -(-x1 // patch) * patch + 1 + MARGIN, -(-y1 // patch) * patch + 1 + MARGIN,
    )  # fmt: skip


def glass_in(scene: Scene, camera: Camera, view: View, part: Tile) -> bool:
    """Glass may be seen in a part of the picture; False only where no box around any glass reaches into it."""
    if camera.lens_radius > 0.0:  # seen from all over the lens
        return any(material.refractive for material in scene.materials)
    return any(_is_seen(corners, view, part) for corners in _glass(scene))


def _glass(scene: Scene) -> Iterator[F64]:
    """Corners of boxes around all glass, shape (8, 3) [m]."""
    from ..world.instances import bounds_of

    refractive = np.array([material.refractive for material in scene.materials], np.bool_)

    def is_glass(mesh: Mesh) -> bool:
        return bool(len(mesh.points)) and bool(refractive[np.unique(mesh.materials)].any())

    for mesh in scene.meshes:
        if is_glass(mesh):
            yield _corners(mesh.points.min(axis=0), mesh.points.max(axis=0))
    for ball in scene.spheres:
        if refractive[ball.material]:
            yield _corners(np.array(ball.centre) - ball.radius, np.array(ball.centre) + ball.radius)
    for many in scene.instances:
        if len(many) and is_glass(many.mesh):
            yield _corners(*bounds_of(many))
    for balls in scene.balls:
        if len(balls) and refractive[balls.material]:
            radii = balls.radii[:, None]
            yield _corners((balls.centres - radii).min(axis=0), (balls.centres + radii).max(axis=0))


def _corners(low: np.ndarray, high: np.ndarray) -> F64:
    ends = np.array([low, high], np.float64)
    return np.array([(ends[i, 0], ends[j, 1], ends[k, 2]) for i in (0, 1) for j in (0, 1) for k in (0, 1)])


def _is_seen(corners: F64, view: View, part: Tile) -> bool:
    at = corners - view.axes[3]
    z = at @ view.axes[2]
    if not view.orthographic and (z <= 1e-6 * max(1.0, float(np.abs(at).max()))).any():
        return True  # a box that reaches behind the eye may be anywhere
    w = np.ones(len(z)) if view.orthographic else z
    left, right, bottom, top = view.window
    x = (at @ view.axes[0] / w - left) / (right - left) * view.size[0]
    y = (at @ view.axes[1] / w - top) / (bottom - top) * view.size[1]
    x0, y0, x1, y1 = part
    inside_x = x.min() < x1 + MARGIN and x.max() > x0 - MARGIN
    return bool(inside_x and y.min() < y1 + MARGIN and y.max() > y0 - MARGIN)
