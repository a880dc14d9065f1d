"""How far one picture is from another: PSNR, and FLIP as a person would see it.

Pictures here are display-encoded: sRGB, shape (H, W, 3), values 0 .. 1, as they would be shown. `displayed` makes one
from scene-linear light. FLIP is computed by NVIDIA's own library, which is an extra.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import UsageError
from ..images.srgb import srgb_encode
from ..scene import F32

Picture = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]

PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * math.pi / 180.0
"""A 4K monitor, 0.7 m wide, seen from 0.7 m: what FLIP assumes (Andersson et al. 2020)."""


def displayed(linear: Picture) -> F32:
    """Scene-linear RGB as a picture shows it: clipped to 0 .. 1, sRGB-encoded.

    Args:
        linear: shape (H, W, 3), radiance.
    """
    return srgb_encode(np.clip(linear, 0.0, 1.0).astype(np.float32))


def psnr(test: Picture, truth: Picture, mask: Mask | None = None) -> float:
    """Peak signal-to-noise ratio [dB] over all channels, for a peak of 1; infinite where nothing differs.

    Args:
        test: shape (H, W, 3), display-encoded, 0 .. 1.
        truth: the same.
        mask: shape (H, W): the pixels that count; None means all.

    Raises:
        UsageError: the pictures do not match, hold values out of range, or the mask is empty.
    """
    chosen = _checked(test, truth, mask)
    error = np.asarray(test, np.float64)[chosen] - np.asarray(truth, np.float64)[chosen]
    mean = float(np.mean(error * error))
    return math.inf if mean == 0.0 else -10.0 * math.log10(mean)


def flip_map(test: Picture, truth: Picture, pixels_per_degree: float = PIXELS_PER_DEGREE) -> F32:
    """LDR-FLIP of every pixel: 0 looks the same, 1 could not look more different (Andersson et al. 2020).

    Args:
        test: shape (H, W, 3), display-encoded, 0 .. 1.
        truth: the same.
        pixels_per_degree: pixels of the display in one degree of the viewer's eye, > 0.

    Returns:
        shape (H, W), float32.

    Raises:
        UsageError: as `psnr`, or the extra is not installed.
    """
    _checked(test, truth, None)
    if not (math.isfinite(pixels_per_degree) and pixels_per_degree > 0.0):
        raise UsageError(f"pixels_per_degree is {pixels_per_degree}; it must be above 0")
    try:
        import flip_evaluator
    except ImportError as error:
        raise UsageError("FLIP needs the package 'flip-evaluator'; pip install 'usd-refract[bench]'") from error
    pair = [np.ascontiguousarray(picture, np.float32) for picture in (truth, test)]
    found, _, _ = flip_evaluator.evaluate(
        *pair, "LDR", applyMagma=False, computeMeanError=False, parameters={"ppd": pixels_per_degree}
    )
    return np.asarray(found, np.float32).reshape(test.shape[:2])


def flip(
    test: Picture, truth: Picture, mask: Mask | None = None, pixels_per_degree: float = PIXELS_PER_DEGREE
) -> float:
    """Mean LDR-FLIP, 0 .. 1. The map is made of the whole pictures; `mask` says which of its pixels are averaged.

    Raises:
        UsageError: as `flip_map` and `psnr`.
    """
    chosen = _checked(test, truth, mask)
    return float(np.mean(flip_map(test, truth, pixels_per_degree)[chosen], dtype=np.float64))


def _checked(test: Picture, truth: Picture, mask: Mask | None) -> Mask:
    """The mask as an array, after looking at everything that could make a number meaningless."""
    if test.ndim != 3 or test.shape[2] != 3 or 0 in test.shape:
        raise UsageError(f"a picture of shape {test.shape} cannot be compared; give (height, width, 3)")
    if test.shape != truth.shape:
        raise UsageError(f"pictures of shapes {test.shape} and {truth.shape} cannot be compared; make them the same")
    for name, picture in (("test", test), ("truth", truth)):
        if not (np.min(picture) >= 0.0 and np.max(picture) <= 1.0):  # NaN fails too
            raise UsageError(f"{name} has values outside 0 .. 1; pass scene-linear light through compare.displayed")
    if mask is None:
        return np.ones(test.shape[:2], np.bool_)
    if mask.shape != test.shape[:2] or mask.dtype != np.bool_:
        raise UsageError(f"mask is {mask.dtype} of shape {mask.shape}; it must be bool of shape {test.shape[:2]}")
    if not mask.any():
        raise UsageError("mask is empty: no pixel is to be compared; choose a view that shows something")
    return mask
