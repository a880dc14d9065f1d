"""PSNR, SSIM and FLIP against what their definitions say, and what they refuse."""

from __future__ import annotations

import builtins
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from refract_core import UsageError
from refract_core.verbs.compare import displayed, flip, flip_map, psnr, ssim, ssim_map

F32 = NDArray[np.float32]


def grey(level: float, height: int = 24, width: int = 32) -> F32:
    return np.full((height, width, 3), level, np.float32)


def test_psnr_of_a_constant_difference_is_its_logarithm() -> None:
    """-20 log10(d) for a peak of 1."""
    assert psnr(grey(0.5), grey(0.6)) == pytest.approx(20.0, abs=1e-5)
    assert psnr(grey(0.25), grey(0.26)) == pytest.approx(40.0, abs=1e-4)
    assert psnr(grey(0.0), grey(1.0)) == pytest.approx(0.0)


def test_psnr_of_the_same_picture_is_infinite() -> None:
    assert psnr(grey(0.3), grey(0.3)) == math.inf


def test_psnr_averages_squares_before_the_logarithm() -> None:
    """A quarter of the pixels off by 0.2 is as much as all of them off by 0.1."""
    test = grey(0.5)
    test[:12, :16] += 0.2
    assert psnr(test, grey(0.5)) == pytest.approx(20.0, abs=1e-5)


def test_the_mask_says_which_pixels_count() -> None:
    test, mask = grey(0.5), np.zeros((24, 32), np.bool_)
    test[:12] = 1.0
    mask[:12] = True
    assert psnr(test, grey(0.5), mask) == pytest.approx(-20 * math.log10(0.5), abs=1e-5)
    assert psnr(test, grey(0.5), ~mask) == math.inf


def test_displayed_clips_and_encodes() -> None:
    """IEC 61966-2-1: linear 0.2140 is shown as 0.5."""
    shown = displayed(np.array([[[-1.0, 0.21404, 7.0]]], np.float32))
    np.testing.assert_allclose(shown[0, 0], [0.0, 0.5, 1.0], atol=1e-4)


@pytest.mark.parametrize(
    ("test", "truth", "mask", "word"),
    [
        (grey(0.5), grey(0.5, 24, 16), None, "make them the same"),
        (grey(0.5)[..., 0], grey(0.5)[..., 0], None, "height, width, 3"),
        (grey(1.5), grey(0.5), None, "test has values outside"),
        (grey(0.5), grey(math.nan), None, "truth has values outside"),
        (grey(0.5), grey(0.5), np.zeros((24, 32), np.bool_), "mask is empty"),
        (grey(0.5), grey(0.5), np.ones((24, 32), np.float32), "must be bool"),
        (grey(0.5), grey(0.5), np.ones((24, 31), np.bool_), "shape"),
    ],
)
@pytest.mark.parametrize("measure", [psnr, ssim, flip])
def test_what_makes_no_number_is_refused(measure: Any, test: F32, truth: F32, mask: Any, word: str) -> None:
    with pytest.raises(UsageError, match=word):
        measure(test, truth, mask)


def noise(seed: int = 0, height: int = 24, width: int = 32) -> F32:
    return np.random.default_rng(seed).uniform(0.2, 0.8, (height, width, 3)).astype(np.float32)


def test_ssim_of_the_same_picture_is_one() -> None:
    assert ssim(noise(), noise()) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(ssim_map(noise(), noise()), 1.0, atol=1e-9)


@pytest.mark.parametrize(("a", "b"), [(0.5, 0.6), (0.1, 0.9), (0.0, 1.0)])
def test_ssim_of_even_pictures_is_what_is_left_of_their_means(a: float, b: float) -> None:
    """Without structure (2 ab + C1) / (a^2 + b^2 + C1) is left, C1 = 0.01^2 (Wang et al. 2004, equation 6)."""
    expected = (2 * a * b + 1e-4) / (a * a + b * b + 1e-4)
    assert ssim(grey(a), grey(b)) == pytest.approx(expected, abs=1e-6)


def test_ssim_of_a_fainter_pattern_is_what_is_left_of_its_contrast() -> None:
    """For y = m + k (x - m) the second factor is (2 k v + C2) / ((1 + k^2) v + C2), v the window's variance and C2 =
    0.03^2 (Wang et al. 2004, equation 13). Stripes of one pixel have the same v and m in every window.
    """
    signs = np.where(np.arange(32) % 2 == 0, 1.0, -1.0)
    at = np.arange(-5, 6)
    weights = np.exp(-0.5 * (at / 1.5) ** 2)
    tilt = float((weights / weights.sum()) @ np.where(at % 2 == 0, 1.0, -1.0))  # of the window's mean, +- by parity
    amplitude, k = 0.3, 0.25
    stripes = np.broadcast_to(signs[None, :, None], (24, 32, 3))
    x, y = (0.5 + a * stripes for a in (amplitude, amplitude * k))
    v = amplitude**2 * (1.0 - tilt**2)
    contrast = (2 * k * v + 9e-4) / ((1 + k * k) * v + 9e-4)
    found = ssim_map(x, y)[:, 5:-5]
    assert abs(tilt) < 1e-3
    np.testing.assert_allclose(found, contrast, rtol=1e-4)


def test_ssim_takes_both_pictures_alike_and_stays_within_its_bounds() -> None:
    test, truth = noise(1), 1.0 - noise(1)
    np.testing.assert_allclose(ssim_map(test, truth), ssim_map(truth, test), atol=1e-12)
    assert -1.0 <= ssim_map(test, truth).min() < 0.0  # a negative: the structure is turned over


def test_the_mask_says_where_ssim_is_averaged() -> None:
    test, mask = noise(), np.zeros((24, 32), np.bool_)
    test[:, 16:] = 0.0
    mask[:, :10] = True  # further from what was changed than half a window
    assert ssim(test, noise(), mask) == pytest.approx(1.0, abs=1e-9)
    assert ssim(test, noise(), ~mask) < 0.9


def test_flip_without_its_library_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    load = builtins.__import__

    def refuse(name: str, *rest: Any) -> Any:
        if name == "flip_evaluator":
            raise ImportError(name)
        return load(name, *rest)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(UsageError, match=r"usd-refract\[bench\]"):
        flip(grey(0.5), grey(0.5))


def test_flip_is_zero_for_the_same_and_nearly_one_for_blue_against_green() -> None:
    """FLIP is scaled by the two primaries that look most unlike (Andersson et al. 2020, section 4.1)."""
    pytest.importorskip("flip_evaluator")
    blue, green = grey(0.0, 64, 64), grey(0.0, 64, 64)
    blue[..., 2], green[..., 1] = 1.0, 1.0
    assert flip(blue, blue) == 0.0
    assert flip(blue, green) > 0.95


def test_flip_is_local_and_the_mask_averages_its_map() -> None:
    pytest.importorskip("flip_evaluator")
    truth = grey(0.5, 48, 96)
    test = truth.copy()
    test[:, :16] = 1.0
    found = flip_map(test, truth)
    assert found.shape == (48, 96)
    assert found.dtype == np.float32
    assert found[:, :8].min() > 0.2
    assert found[:, 64:].max() < 1e-3
    left = np.zeros((48, 96), np.bool_)
    left[:, :8] = True
    assert flip(test, truth, left) == pytest.approx(float(found[:, :8].mean()), rel=1e-5)
    assert flip(test, truth) == pytest.approx(float(found.mean()), rel=1e-5)


def test_flip_sees_less_from_farther_away() -> None:
    """A fine checker against its mean: more pixels in a degree, less to be seen."""
    pytest.importorskip("flip_evaluator")
    y, x = np.mgrid[:64, :64]
    fine = np.repeat(((x + y) % 2)[..., None], 3, 2).astype(np.float32)
    near, far = (flip(fine, grey(0.735, 64, 64), pixels_per_degree=ppd) for ppd in (15.0, 120.0))
    assert near > far + 0.05


@pytest.mark.parametrize("ppd", [0.0, -3.0, math.nan, math.inf])
def test_flip_refuses_an_impossible_viewer(ppd: float) -> None:
    with pytest.raises(UsageError, match="pixels_per_degree"):
        flip_map(grey(0.5), grey(0.5), ppd)
