"""A camera conformed to an image: pixels to rays and points to pixels.

Pixel coordinates are continuous, x to the right and y down; the sample of pixel (i, j) stands at (i + 0.5, j + 0.5)
of a window that already holds the sub-pixel jitter. `z_depth` is along the camera axis, positive in front.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..errors import UsageError
from ..kernels.arrays import F64_1D, F64_2D, I64_1D
from ..kernels.compile import inlined
from ..kernels.vec import Vec, dot, normalize, row, sub
from ..scene import Camera

Tile = tuple[int, int, int, int]
"""x0, y0, x1, y1 [pixels]: from the first pixel to the one after the last. May reach beyond the picture."""


class View(NamedTuple):
    """What kernels need of a camera."""

    axes: F64_2D
    """shape (4, 3): right, up, forward (unit, engine world), eye [m]"""
    window: F64_1D
    """shape (4,): left, right, bottom, top at z_depth 1 (perspective) or in metres (orthographic)"""
    size: I64_1D
    """shape (2,): width, height [pixels]"""
    clipping: F64_1D
    """shape (2,): near, far z_depth [m]"""
    orthographic: bool
    spread: float
    """growth of a sample's cone per metre along its ray; its width at the eye is left out"""


class PixelPoint(NamedTuple):
    """A point as the camera sees it."""

    x: float
    """pixel coordinate, to the right"""
    y: float
    """pixel coordinate, downwards"""
    z_depth: float
    """[m]"""


def image_size(camera: Camera, width: int, height: int) -> tuple[int, int]:
    """Fill in the height that follows from the camera's aspect where `height` is 0."""
    left, right, bottom, top = camera.window
    if height == 0:
        height = max(1, round(width * (top - bottom) / (right - left)))
    return width, height


def view_of(
    camera: Camera, width: int, height: int, jitter: tuple[float, float] = (0.0, 0.0), samples: int = 1,
    lens: tuple[float, float] = (0.0, 0.0),
) -> View:  # fmt: skip
    """Conform `camera` to an image of square pixels by expanding its window, and shift it by `jitter` pixels.

    Args:
        samples: that share a pixel; each has that part of it for its own.
        lens: from where on the lens to look, in the unit disc. The window moves the other way, so that what is in
            focus stays in its place: a picture by a thin lens is the mean of those from all over it.

    Raises:
        UsageError: the camera has no field of view.
    """
    left, right, bottom, top = camera.window
    w, h = right - left, top - bottom
    if not (np.isfinite([left, right, bottom, top]).all() and w > 0 and h > 0):
        raise UsageError(f"camera {camera.path} has an empty field of view {camera.window}; check its apertures")
    grow_x = max(1.0, (width / height) / (w / h))
    grow_y = max(1.0, (w / h) / (width / height))
    cx, cy = (left + right) / 2, (bottom + top) / 2
    w, h = w * grow_x, h * grow_y
    dx, dy = jitter[0] * w / width, -jitter[1] * h / height
    m = camera.world_from_camera
    axes = np.stack([m[:3, 0], m[:3, 1], -m[:3, 2], m[:3, 3]]).astype(np.float64)
    if camera.lens_radius > 0.0 and not camera.orthographic:
        right_by, up_by = lens[0] * camera.lens_radius, lens[1] * camera.lens_radius
        axes[3] += right_by * axes[0] + up_by * axes[1]
        cx, cy = cx - right_by / camera.focus_distance, cy - up_by / camera.focus_distance
    window = np.array([cx - w / 2 + dx, cx + w / 2 + dx, cy - h / 2 + dy, cy + h / 2 + dy])
    size, clipping = np.array([width, height]), np.array(camera.clipping, np.float64)
    spread = 0.0 if camera.orthographic else w / width / math.sqrt(samples)
    return View(axes, window, size, clipping, camera.orthographic, spread)


def lens_points(samples: int) -> list[tuple[float, float]]:
    """Where on a lens the samples of every pixel look from, in the unit disc; a single one from its middle.

    A spiral by the golden angle, which fills the disc evenly with any number of points (Vogel 1979), taken in an order
    that has nothing to do with that of `kernels.sampling.pixel_offsets`.
    """
    if samples == 1:
        return [(0.0, 0.0)]
    stride = next(s for s in range(max(1, round(0.618 * samples)), 2 * samples) if math.gcd(s, samples) == 1)
    turn = math.pi * (3.0 - math.sqrt(5.0))
    points = []
    for k in range(samples):
        i = k * stride % samples
        radius = math.sqrt((i + 0.5) / samples)
        points.append((radius * math.cos(turn * i), radius * math.sin(turn * i)))
    return points


def corners_of(view: View) -> View:
    """The view whose pixels have their middles in the corners of the pixels of `view`: one more along each side."""
    left, right, bottom, top = view.window
    width, height = view.size
    dx, dy = 0.5 * (right - left) / width, 0.5 * (top - bottom) / height
    window = np.array([left - dx, right + dx, bottom - dy, top + dy])
    return view._replace(window=window, size=view.size + 1)


@inlined
def pixel_ray(view: View, px: float, py: float) -> tuple[Vec, Vec, float]:
    """Ray through a pixel coordinate: origin [m], unit direction, cosine to the camera axis."""
    left, right, bottom, top = view.window[0], view.window[1], view.window[2], view.window[3]
    x = left + (right - left) * px / view.size[0]
    y = top + (bottom - top) * py / view.size[1]  # rows go down, the window's y goes up
    r, u, f, eye = row(view.axes, 0), row(view.axes, 1), row(view.axes, 2), row(view.axes, 3)
    if view.orthographic:
        origin = (eye[0] + r[0] * x + u[0] * y, eye[1] + r[1] * x + u[1] * y, eye[2] + r[2] * x + u[2] * y)
        return origin, f, 1.0
    d = normalize((f[0] + r[0] * x + u[0] * y, f[1] + r[1] * x + u[1] * y, f[2] + r[2] * x + u[2] * y))
    return eye, d, dot(d, f)


@inlined
def project(view: View, p: Vec) -> PixelPoint:
    """Where a world point [m] is seen. Its pixel means nothing where z_depth <= 0 under perspective."""
    left, right, bottom, top = view.window[0], view.window[1], view.window[2], view.window[3]
    v = sub(p, row(view.axes, 3))
    z = dot(v, row(view.axes, 2))
    w = 1.0 if view.orthographic else z
    x = dot(v, row(view.axes, 0)) / w
    y = dot(v, row(view.axes, 1)) / w
    return PixelPoint((x - left) / (right - left) * view.size[0], (y - top) / (bottom - top) * view.size[1], z)


@inlined
def pixel_point(view: View, px: float, py: float, z: float) -> Vec:
    """The world point [m] at a pixel coordinate and z_depth [m]: the inverse of `project`."""
    grow = 1.0 if view.orthographic else z
    x = (view.window[0] + (view.window[1] - view.window[0]) * px / view.size[0]) * grow
    y = (view.window[3] + (view.window[2] - view.window[3]) * py / view.size[1]) * grow
    r, u, f, eye = row(view.axes, 0), row(view.axes, 1), row(view.axes, 2), row(view.axes, 3)
    return (
        eye[0] + f[0] * z + r[0] * x + u[0] * y,
        eye[1] + f[1] * z + r[1] * x + u[1] * y,
        eye[2] + f[2] * z + r[2] * x + u[2] * y,
    )


@inlined
def pixel_width(view: View, z: float) -> float:
    """Width of a pixel at a z_depth [m]; pixels are square."""
    w = (view.window[1] - view.window[0]) / view.size[0]
    return w if view.orthographic else w * z
