"""Maps of a dome in other forms than latlong, as latlong ones.

UsdLux names the forms and leaves open which way they look. Here the middle of each looks where that of a latlong map
does, along the dome's +Z, with +Y up. A latlong, an angular map and a cross are seen from within (+X at the left); a
mirrored ball is a photograph of one, in which its middle shows who takes it (+X at the right).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ...scene import F32, F64

_FINE = 2
"""Places along each side of a pixel of the new map that are looked up."""


def format_of(pixels: F32, said: str) -> str:
    """What `inputs:texture:format` says, or, where that is `automatic`, what the sides tell."""
    if said != "automatic":
        return said
    height, width = pixels.shape[:2]
    if 3 * height == 4 * width:
        return "cubeMapVerticalCross"
    return "angular" if height == width and height > 1 else "latlong"


def as_latlong(pixels: F32, form: str) -> F32:
    """A map as a latlong one, about as fine.

    Args:
        pixels: shape (H, W, 3).
        form: a key of `FORMS`, or `latlong`.
    """
    if form == "latlong":
        return pixels
    place = FORMS[form]
    columns = 4 * (pixels.shape[1] // 3) if form == "cubeMapVerticalCross" else max(pixels.shape[:2])
    rows = max(columns // 2, 2)
    columns = 2 * rows
    out = np.empty((rows, columns, 3), np.float32)
    for row in range(rows):
        theta = (row + (np.arange(_FINE) + 0.5) / _FINE)[:, None] * (math.pi / rows)
        phi = (0.5 - (np.arange(columns * _FINE) + 0.5)[None, :] / (columns * _FINE)) * (2.0 * math.pi)
        sine = np.sin(theta)
        x, y, z = sine * np.sin(phi), np.cos(theta) + 0.0 * phi, sine * np.cos(phi)
        found = place(pixels, np.stack([x, y, z], axis=-1))
        weight = np.sin(theta)[..., None]
        means = (found * weight).sum(0) / weight.sum(0)
        out[row] = means.reshape(columns, _FINE, 3).mean(1)
    return out


def _angular(pixels: F32, d: F64) -> F64:
    """A disk whose radius is the angle from +Z (Debevec 1998, light probes)."""
    off = np.arccos(np.clip(d[..., 2], -1.0, 1.0)) / math.pi
    return _on_disk(pixels, -d[..., 0], d[..., 1], off)


def _mirrored_ball(pixels: F32, d: F64) -> F64:
    """An orthogonal picture of a mirror: its normal is half way to the eye, along +Z."""
    off = np.sqrt(np.clip(0.5 - 0.5 * d[..., 2], 0.0, 1.0))
    return _on_disk(pixels, d[..., 0], d[..., 1], off)


def _on_disk(pixels: F32, right: F64, up: F64, radius: F64) -> F64:
    """Lookup at a radius, 1 at the edge of the picture, towards (right, up) of any length."""
    height, width = pixels.shape[:2]
    away = np.maximum(np.hypot(right, up), 1e-12)
    u, v = right / away * radius, up / away * radius
    return _bilinear(pixels, (0.5 + 0.5 * u) * width, (0.5 - 0.5 * v) * height, (0, 0, height, width))


# Faces of a vertical cross: column, row, and the direction of its middle, of its right and of its upper edge.
_FACES = (
    (1, 0, (0, 1, 0), (-1, 0, 0), (0, 0, -1)),
    (0, 1, (1, 0, 0), (0, 0, 1), (0, 1, 0)),
    (1, 1, (0, 0, 1), (-1, 0, 0), (0, 1, 0)),
    (2, 1, (-1, 0, 0), (0, 0, -1), (0, 1, 0)),
    (1, 2, (0, -1, 0), (-1, 0, 0), (0, 0, 1)),
    (1, 3, (0, 0, -1), (-1, 0, 0), (0, -1, 0)),
)


def _cross(pixels: F32, d: F64) -> F64:
    """Six faces: +Y above the middle, +X, +Z and -X from left to right, -Y below, -Z below that, upside down."""
    height, width = pixels.shape[0] // 4, pixels.shape[1] // 3
    largest = np.abs(d).max(-1)
    out = np.zeros(d.shape)
    for column, row, middle, right, up in _FACES:
        ahead = d @ np.array(middle, np.float64)
        here = ahead >= largest
        u, v = (d[here] @ np.array(axis, np.float64) / ahead[here] for axis in (right, up))
        x, y = (column + 0.5 + 0.5 * u) * width, (row + 0.5 - 0.5 * v) * height
        out[here] = _bilinear(pixels, x, y, (row * height, column * width, height, width))
    return out


def _bilinear(pixels: F32, x: F64, y: F64, part: tuple[int, int, int, int]) -> F64:
    """Lookup at (x, y) in pixels from the corner, within a part: its first row and column, its height and width."""
    top, left, height, width = part
    x, y = x - 0.5, y - 0.5
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    s, t = (x - column)[..., None], (y - row)[..., None]
    c0, c1 = (np.clip(column + k, left, left + width - 1) for k in (0, 1))
    r0, r1 = (np.clip(row + k, top, top + height - 1) for k in (0, 1))
    upper = pixels[r0, c0] * (1.0 - s) + pixels[r0, c1] * s
    lower = pixels[r1, c0] * (1.0 - s) + pixels[r1, c1] * s
    return np.asarray(upper * (1.0 - t) + lower * t, np.float64)


FORMS: dict[str, Callable[[F32, F64], F64]] = {
    "mirroredBall": _mirrored_ball,
    "angular": _angular,
    "cubeMapVerticalCross": _cross,
}
"""Lookups (pixels, unit directions in the dome's frame) -> colours."""
