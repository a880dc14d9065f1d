"""Pictures of all directions: six faces to and from the flat layouts in which files keep them.

Faces are those of `scene.Cubemap`, stored as they are there unless a layout says otherwise:

- strip: one under the other, +x -x +y -y +z -z, n x 6n pixels (read also side by side, 6n x n);
- cross: 4n x 3n pixels, every edge joined as in the world around +z (read also upright, 3n x 4n)

        .  +y  .  .            .  +y  .
       -x  +z  +x -z          -x  +z  +x
        .  -y  .  .            .  -y  .
                               .  -z  .      (-z turned by 180 degrees)

- latlong: 4n x 2n pixels, OpenEXR's convention: row 0 looks up (+Y), the middle looks along +Z, and u grows towards -X.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import ImageError
from ..scene import F32, F64

LAYOUTS = ("strip", "cross", "latlong")

_FACES = 6
# Row and column, in faces, of +x -x +y -y +z -z.
_CROSS = ((1, 2), (1, 0), (0, 1), (2, 1), (1, 1), (1, 3))
_UPRIGHT = ((1, 2), (1, 0), (0, 1), (2, 1), (1, 1), (3, 1))
_FINEST = 16  # latlong pixels across a texel beyond which they are averaged in pairs first


def faces_of(pixels: F32, resolution: int) -> F32:
    """Six faces out of a flat picture, whose shape tells its layout.

    A strip or cross of the same resolution is copied exactly; anything else is averaged over each texel's area where
    the picture is finer, and interpolated where it is coarser.

    Args:
        pixels: shape (H, W, C)
        resolution: of the faces [texels]

    Returns:
        shape (6, n, n, C)

    Raises:
        ImageError: the shape fits no layout.
    """
    height, width = pixels.shape[:2]
    if height == 0 or width == 0:
        raise ImageError("the picture is empty; give one with pixels")
    if width == 2 * height:
        return _from_latlong(pixels, resolution)
    if height == _FACES * width:
        faces = pixels.reshape(_FACES, width, width, -1)
    elif width == _FACES * height:
        faces = pixels.reshape(height, _FACES, height, -1).swapaxes(0, 1)
    elif 3 * width == 4 * height and height % 3 == 0:
        faces = _cut(pixels, height // 3, _CROSS)
    elif 4 * width == 3 * height and width % 3 == 0:
        faces = _cut(pixels, width // 3, _UPRIGHT)
        faces[5] = faces[5, ::-1, ::-1].copy()
    else:
        raise ImageError(
            f"{width} x {height} pixels fit no layout of a picture of all directions; it must be a latlong (2:1), a "
            "strip of six faces (1:6 or 6:1) or a cross (4:3 or 3:4)"
        )
    return _resized(np.ascontiguousarray(faces, np.float32), resolution)


def arrange(faces: F32, layout: str) -> F32:
    """Six faces as one flat picture: the inverse of `faces_of`, exact for strip and cross.

    Args:
        faces: shape (6, n, n, C)
        layout: one of `LAYOUTS`

    Returns:
        shape (6n, n, C), (3n, 4n, C) with zeros in the empty squares, or (2n, 4n, C)
    """
    n, channels = faces.shape[1], faces.shape[3]
    if layout == "strip":
        return np.ascontiguousarray(faces.reshape(_FACES * n, n, channels), np.float32)
    if layout == "latlong":
        return _sampled(faces, latlong_directions(2 * n, 4 * n))
    cross = np.zeros((3 * n, 4 * n, channels), np.float32)
    for face, (row, column) in zip(faces, _CROSS, strict=True):
        cross[row * n : (row + 1) * n, column * n : (column + 1) * n] = face
    return cross


def face_directions(resolution: int, across: float = 0.5, down: float = 0.5, *, border: int = 0) -> F64:
    """Directions of a cube's texels, not normalised (`scene.Cubemap`).

    Args:
        across, down: place within each texel, 0 .. 1
        border: texels added around each face, outside of it

    Returns:
        shape (6, n + 2 border, n + 2 border, 3)
    """
    steps = np.arange(-border, resolution + border, dtype=np.float64)
    x = np.broadcast_to((steps + across) / resolution * 2 - 1, (steps.size, steps.size))
    y = np.broadcast_to(((steps + down) / resolution * 2 - 1)[:, None], x.shape)
    one = np.ones_like(x)
    faces = ((one, -y, -x), (-one, -y, x), (x, one, y), (x, -one, -y), (x, -y, one), (-x, -y, -one))
    return np.stack([np.stack(axes, axis=-1) for axes in faces])


def latlong_directions(height: int, width: int) -> F64:
    """Unit directions of a latlong's pixels, shape (H, W, 3)."""
    around = 2 * np.pi * (0.5 - (np.arange(width) + 0.5) / width)
    down = np.pi * (np.arange(height)[:, None] + 0.5) / height
    x, y, z = np.sin(down) * np.sin(around), np.cos(down), np.sin(down) * np.cos(around)
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1)


def _cut(pixels: F32, n: int, squares: tuple[tuple[int, int], ...]) -> F32:
    return np.stack([pixels[row * n : (row + 1) * n, column * n : (column + 1) * n] for row, column in squares])


# --- faces of another size


def _resized(faces: F32, resolution: int) -> F32:
    n = faces.shape[1]
    if n == resolution:
        return faces
    if n < resolution:
        return _sampled(faces, face_directions(resolution))
    share = _shares(n, resolution)
    return np.einsum("ij,fjkc,lk->filc", share, faces, share, optimize=True).astype(np.float32)


def _shares(n: int, fewer: int) -> F64:
    """Part of each of `fewer` equal pieces of a line that each of `n` pieces fills, shape (fewer, n)."""
    edges = np.arange(fewer + 1) * (n / fewer)
    starts = np.arange(n)
    overlap = np.minimum(edges[1:, None], starts + 1) - np.maximum(edges[:-1, None], starts)
    return np.maximum(overlap, 0.0) * (fewer / n)


def halved(pixels: F32) -> F32:
    """The next level of a flat picture by averages, at least one pixel on a side; shape (H // 2, W // 2, C)."""
    height, width = pixels.shape[:2]
    down, across = _shares(height, max(1, height // 2)), _shares(width, max(1, width // 2))
    return np.einsum("ij,jkc,lk->ilc", down, pixels, across, optimize=True).astype(np.float32)


# --- lookups


def _sampled(faces: F32, directions: F64) -> F32:
    """Bilinear lookup without seams, shape (..., C) for directions of shape (..., 3)."""
    n = faces.shape[1]
    padded = _padded(faces)
    face, x, y = _face_coordinates(directions)
    return _bilinear(padded, face, (x + 1) * 0.5 * n + 0.5, (y + 1) * 0.5 * n + 0.5)


def _padded(faces: F32) -> F32:
    """Faces with one texel of border, which comes from their neighbours; shape (6, n + 2, n + 2, C)."""
    n = faces.shape[1]
    face, x, y = _face_coordinates(face_directions(n, border=1))
    column = np.clip(((x + 1) * 0.5 * n).astype(np.intp), 0, n - 1)
    row = np.clip(((y + 1) * 0.5 * n).astype(np.intp), 0, n - 1)
    padded = faces[face, row, column]
    padded[:, 1:-1, 1:-1] = faces
    return padded


def _face_coordinates(directions: F64) -> tuple[NDArray[np.intp], F64, F64]:
    """Face, and its coordinates x (right) and y (down) in [-1, 1]: the inverse of `face_directions`."""
    x, y, z = np.moveaxis(directions, -1, 0)
    size = np.abs(directions)
    axis = np.argmax(size, axis=-1)
    largest = np.take_along_axis(size, axis[..., None], axis=-1)[..., 0]
    negative = np.take_along_axis(directions, axis[..., None], axis=-1)[..., 0] < 0.0
    sign = np.where(negative, -1.0, 1.0)
    across = np.choose(axis, (-sign * z, x, sign * x)) / largest
    down = np.choose(axis, (-y, sign * z, -y)) / largest
    return (2 * axis + negative).astype(np.intp), across, down


def _bilinear(planes: F32, plane: NDArray[np.intp], x: F64, y: F64) -> F32:
    """Lookup in planes (P, H, W, C) at pixel coordinates whose whole numbers are pixel centres."""
    height, width = planes.shape[1:3]
    left, top = np.clip(np.floor(x), 0, width - 2).astype(np.intp), np.clip(np.floor(y), 0, height - 2).astype(np.intp)
    fx = np.clip(x - left, 0.0, 1.0).astype(np.float32)[..., None]
    fy = np.clip(y - top, 0.0, 1.0).astype(np.float32)[..., None]
    above = planes[plane, top, left] * (1 - fx) + planes[plane, top, left + 1] * fx
    below = planes[plane, top + 1, left] * (1 - fx) + planes[plane, top + 1, left + 1] * fx
    return np.asarray(above * (1 - fy) + below * fy, np.float32)


def _from_latlong(pixels: F32, resolution: int) -> F32:
    """Faces as means over each texel's area: rows of rays through it, each a bilinear lookup."""
    pixels = np.asarray(pixels, np.float32)
    while pixels.shape[1] > _FINEST * resolution and pixels.shape[0] % 2 == 0:
        pixels = halved(pixels)
    height, width = pixels.shape[:2]
    # One row and column more on every side: over a pole the picture goes on half a turn away.
    turned = np.roll(pixels, width // 2, axis=1)
    tall = np.concatenate([turned[:1], pixels, turned[-1:]])
    padded = np.concatenate([tall[:, -1:], tall, tall[:, :1]], axis=1)[None]
    # Samples across the widest texel, which covers 2 / n radians in the middle of a face.
    steps = max(1, round(width / (np.pi * resolution)))
    total = np.zeros((_FACES, resolution, resolution, pixels.shape[2]), np.float64)
    for down in range(steps):
        for across in range(steps):
            directions = face_directions(resolution, (across + 0.5) / steps, (down + 0.5) / steps)
            x, y, z = np.moveaxis(directions, -1, 0)
            u = (0.5 - np.arctan2(x, z) / (2 * np.pi)) % 1.0
            v = np.arctan2(np.hypot(x, z), y) / np.pi
            total += _bilinear(padded, np.zeros(u.shape, np.intp), u * width + 0.5, v * height + 0.5)
    return np.asarray(total / steps**2, np.float32)
