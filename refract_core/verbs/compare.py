"""How far one picture is from another: PSNR, SSIM, and FLIP as a person would see it.

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
from ..scene import F32, F64

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


_LUMA = np.array([0.2126, 0.7152, 0.0722])
"""Of display-encoded red, green and blue (ITU-R BT.709)."""
_SSIM_WINDOW, _SSIM_SIGMA, _SSIM_K = 11, 1.5, (0.01, 0.03)


def ssim_map(test: Picture, truth: Picture) -> F64:
    """Structural similarity of every pixel's neighbourhood: 1 where nothing differs, -1 at the least.

    On luma, with a window of 11 x 11 pixels under a Gaussian of 1.5 pixels, K1 = 0.01, K2 = 0.03 and a peak of 1 (Wang,
    Bovik, Sheikh, Simoncelli: Image Quality Assessment: From Error Visibility to Structural Similarity, IEEE TIP 13(4),
    2004). Beyond its edges a picture is mirrored.

    Args:
        test: shape (H, W, 3), display-encoded, 0 .. 1.
        truth: the same.

    Returns:
        shape (H, W), float64.

    Raises:
        UsageError: as `psnr`.
    """
    _checked(test, truth, None)
    x, y = (np.asarray(picture, np.float64) @ _LUMA for picture in (test, truth))
    mean_x, mean_y, xx, yy, xy = (_windowed(plane) for plane in (x, y, x * x, y * y, x * y))
    c1, c2 = (k * k for k in _SSIM_K)
    luminance = (2.0 * mean_x * mean_y + c1) / (mean_x * mean_x + mean_y * mean_y + c1)
    structure = (2.0 * (xy - mean_x * mean_y) + c2) / (xx - mean_x * mean_x + yy - mean_y * mean_y + c2)
    found: F64 = luminance * structure
    return found


def ssim(test: Picture, truth: Picture, mask: Mask | None = None) -> float:
    """Mean structural similarity. The map is made of the whole pictures; `mask` says which pixels are averaged.

    Raises:
        UsageError: as `psnr`.
    """
    chosen = _checked(test, truth, mask)
    return float(np.mean(ssim_map(test, truth)[chosen]))


def _windowed(plane: F64) -> F64:
    """Mean of every pixel's window, shape (H, W)."""
    reach = _SSIM_WINDOW // 2
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / _SSIM_SIGMA) ** 2)
    weights /= weights.sum()
    for axis in (0, 1):
        around = [(reach, reach) if one == axis else (0, 0) for one in (0, 1)]
        wide = np.pad(plane, around, mode="symmetric")
        count = plane.shape[axis]
        plane = sum(weights[k] * np.take(wide, range(k, k + count), axis) for k in range(_SSIM_WINDOW))
    return plane


def flip_lacks() -> str:
    """Why FLIP cannot be computed here, and what to do; '' where it can."""
    try:
        import flip_evaluator  # noqa: F401
    except ImportError:
        return "FLIP needs the package 'flip-evaluator'; pip install 'usd-refract[bench]'"
    return ""


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
    if lacks := flip_lacks():
        raise UsageError(lacks)
    import flip_evaluator

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
