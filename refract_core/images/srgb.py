"""The sRGB transfer function, both ways."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene import F32, Texture


def srgb_decode(encoded: F32) -> F32:
    """sRGB-encoded values to linear light (IEC 61966-2-1).

    Args:
        encoded: any shape, float32, [0, 1].
    """
    high = ((np.maximum(encoded, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= 0.04045, encoded / 12.92, high).astype(np.float32)


def srgb_encode(linear: F32) -> F32:
    """Linear light to sRGB-encoded values (IEC 61966-2-1).

    Args:
        linear: any shape, float32, [0, 1].
    """
    high = 1.055 * np.maximum(linear, 0.0031308) ** (1.0 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, linear * 12.92, high).astype(np.float32)


def as_floats(pixels: NDArray[Any]) -> F32:
    """A copy of pixels as float32; bytes become 0 .. 1, still with the curve that they have."""
    out = pixels.astype(np.float32)
    return out / np.float32(255.0) if pixels.dtype == np.uint8 else out


def linear_pixels(texture: Texture) -> F32:
    """A copy of a texture's pixels in linear light, shape (H, W, 4)."""
    out = as_floats(texture.pixels)
    if texture.srgb:
        out[..., :3] = srgb_decode(out[..., :3])
    return out
