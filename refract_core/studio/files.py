"""Surroundings from a file."""

from __future__ import annotations

import os

import numpy as np

from ..errors import ImageError, UsageError
from ..images.codec import read_pixels
from ..scene import F32


def read_environment(path: str) -> F32:
    """Radiance of a latlong picture, shape (H, W, 3), as `scene.Environment` has it; bytes are decoded from sRGB.

    Raises:
        UsageError: there is no such file.
        ImageError: it cannot be read, or is not twice as wide as high.
    """
    if not os.path.isfile(path):
        raise UsageError(f"--environment {path}: there is no such file; name a latlong .hdr or .exr picture")
    try:
        read = read_pixels(path, path).rgba
    except ImageError as error:
        raise ImageError(f"--environment {error}") from error
    height, width = read.shape[:2]
    if width != 2 * height:
        text = f"it is {width} x {height}, and a latlong picture is twice as wide as high"
        raise ImageError(f"--environment {path}: {text}; convert it from its cube or ball first")
    if read.dtype == np.uint8:
        levels = np.arange(256, dtype=np.float64) / 255.0
        levels = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
        return np.ascontiguousarray(levels.astype(np.float32)[read[..., :3]])
    return np.ascontiguousarray(np.nan_to_num(read[..., :3].astype(np.float32), posinf=1e30, neginf=0.0))
