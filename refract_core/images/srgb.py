"""The sRGB transfer function, both ways."""

from __future__ import annotations

import numpy as np

from ..scene import F32


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
