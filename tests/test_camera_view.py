"""Pixels to rays and back, for windows of every kind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import camera, view_rays

from refract_core.errors import UsageError
from refract_core.kernels.compile import kernel
from refract_core.kernels.lanes import by_address
from refract_core.kernels.sampling import pixel_offsets
from refract_core.scene import Camera
from refract_core.view.camera import View, image_size, lens_points, pixel_point, pixel_ray, project, view_of

F64 = NDArray[np.float64]

PERSPECTIVE = replace(camera((1, 2, 3), (-2, 0.5, -1)), window=(-0.3, 0.7, -0.2, 0.4))
ORTHOGRAPHIC = replace(PERSPECTIVE, orthographic=True)
CAMERAS = pytest.mark.parametrize("of", [PERSPECTIVE, ORTHOGRAPHIC], ids=["perspective", "orthographic"])


@kernel
def _rays(view: View, pixels: F64, out: F64) -> None:
    for i in range(pixels.shape[0]):
        o, d, cosine = pixel_ray(view, pixels[i, 0], pixels[i, 1])
        out[i, 0], out[i, 1], out[i, 2] = o[0], o[1], o[2]
        out[i, 3], out[i, 4], out[i, 5], out[i, 6] = d[0], d[1], d[2], cosine


@kernel
def _around(view: View, pixels: F64, out: F64) -> None:
    for i in range(pixels.shape[0]):
        p = pixel_point(view, pixels[i, 0], pixels[i, 1], pixels[i, 2])
        out[i, 0], out[i, 1], out[i, 2] = project(view, p)


def rays(view: View, pixels: F64) -> tuple[F64, F64, F64]:
    out = np.empty((len(pixels), 7))
    _rays(by_address(view), pixels, out)
    return out[:, :3], out[:, 3:6], out[:, 6]


def grid(width: int, height: int) -> F64:
    y, x = np.mgrid[:height, :width] + 0.5
    return np.stack([x.ravel(), y.ravel()], 1)


@CAMERAS
def test_a_pixel_projects_to_itself(of: Camera) -> None:
    rng = np.random.default_rng(1)
    pixels = np.stack([rng.uniform(0, 120, 200), rng.uniform(0, 50, 200), rng.uniform(0.1, 30, 200)], 1)
    out = np.empty_like(pixels)
    _around(by_address(view_of(of, 120, 50)), pixels, out)
    np.testing.assert_allclose(out, pixels, rtol=1e-9, atol=1e-9)


@CAMERAS
def test_rays_are_those_of_a_pinhole_written_out_by_hand(of: Camera) -> None:
    """The window has the aspect 10 : 6 of the image, so nothing is conformed. Axes from the camera's own matrix."""
    origins, directions, cosine = rays(view_of(of, 50, 30), grid(50, 30))
    o, d = view_rays(of, 50, 30)
    np.testing.assert_allclose(origins, o.reshape(-1, 3), atol=1e-12)
    np.testing.assert_allclose(directions, d.reshape(-1, 3), atol=1e-12)
    np.testing.assert_allclose(cosine, -d.reshape(-1, 3) @ of.world_from_camera[:3, 2], atol=1e-12)


def test_the_first_row_is_the_top_and_the_first_column_the_left() -> None:
    _, d, _ = rays(view_of(camera((0, 0, 5)), 4, 4), np.array([[0.5, 0.5], [3.5, 3.5]]))
    assert d[0, 0] < 0 < d[0, 1]
    assert d[1, 1] < 0 < d[1, 0]


@pytest.mark.parametrize(("width", "height"), [(200, 40), (40, 200), (100, 60)])
@CAMERAS
def test_conforming_only_ever_shows_more_and_keeps_pixels_square(of: Camera, width: int, height: int) -> None:
    left, right, bottom, top = of.window
    window = view_of(of, width, height).window
    assert window[0] <= left + 1e-12
    assert window[1] >= right - 1e-12
    assert window[2] <= bottom + 1e-12
    assert window[3] >= top - 1e-12
    assert (window[1] - window[0]) / width == pytest.approx((window[3] - window[2]) / height, rel=1e-12)
    # One direction is filled exactly, and the centre stays.
    assert min((window[1] - window[0]) / (right - left), (window[3] - window[2]) / (top - bottom)) == pytest.approx(1)
    assert window[:2].mean() == pytest.approx((left + right) / 2)
    assert window[2:].mean() == pytest.approx((bottom + top) / 2)


def test_height_follows_the_aspect() -> None:
    assert image_size(PERSPECTIVE, 100, 0) == (100, 60)
    assert image_size(PERSPECTIVE, 100, 7) == (100, 7)


@pytest.mark.parametrize("samples", [1, 2, 4, 5, 9, 16, 64, 100])
def test_samples_fill_the_pixel_evenly_about_its_centre(samples: int) -> None:
    offsets = np.array(pixel_offsets(samples))
    assert np.abs(offsets).max() < 0.5
    np.testing.assert_allclose(offsets.mean(0), 0.0, atol=1e-12)
    for axis in range(2):  # a Latin square: one in each row and in each column
        np.testing.assert_array_equal(np.sort(np.floor((offsets[:, axis] + 0.5) * samples)), np.arange(samples))
    from_centre = np.linalg.norm(offsets, axis=1)
    assert from_centre[0] == from_centre.min()
    if samples in (4, 16, 64):  # a net: as many in every quarter
        quarter = 2 * (offsets[:, 0] < 0) + (offsets[:, 1] < 0)
        assert (np.bincount(quarter, minlength=4) == samples // 4).all()


@CAMERAS
def test_jitter_moves_rays_by_that_many_pixels(of: Camera) -> None:
    pixels = grid(5, 3)
    moved = rays(view_of(of, 5, 3, (0.25, -0.4)), pixels)
    expected = rays(view_of(of, 5, 3), pixels + np.array([0.25, -0.4]))
    for a, b in zip(moved, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


@pytest.mark.parametrize("window", [(0.0, 0.0, -1.0, 1.0), (-1.0, 1.0, 1.0, -1.0), (-1.0, float("nan"), -1.0, 1.0)])
def test_an_empty_window_is_refused(window: tuple[float, float, float, float]) -> None:
    with pytest.raises(UsageError, match="/camera"):
        view_of(replace(PERSPECTIVE, window=window), 4, 4)


# --- lenses ---------------------------------------------------------------------------------------------------------


def test_points_of_a_lens_are_evenly_spread() -> None:
    """Moments of an even disc: mean 0, mean square half of the radius'; no two points are the same, nor leave it."""
    assert lens_points(1) == [(0.0, 0.0)]
    for samples in (2, 4, 16, 61, 128, 256):
        points = np.array(lens_points(samples))
        assert len(np.unique(points.round(9), axis=0)) == samples
        assert (np.linalg.norm(points, axis=1) <= 1.0).all()
        assert (points**2).sum(axis=1).mean() == pytest.approx(0.5)
        assert np.linalg.norm(points.mean(axis=0)) < 1.0 / samples**0.75
        assert abs(np.corrcoef(points[:, 0], np.array(pixel_offsets(samples))[:, 0])[0, 1]) < 0.6 or samples < 16


LENS = replace(PERSPECTIVE, lens_radius=0.05, focus_distance=4.0)


def test_what_is_in_focus_stays_and_the_rest_moves_by_the_thin_lens() -> None:
    """By a thin lens of focal length F at the image distance v = f F / (f - F), a point at a depth d makes a disc
    A F |d - f| / (d (f - F)) wide on the film, for an aperture A and a focus f; over v, which fills the window, it is
    A |d - f| / (d f)."""
    rng = np.random.default_rng(2)
    width, height = 120, 72
    for lens in [(0.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.6, 0.8)]:
        view = view_of(LENS, width, height, lens=lens)
        for depth in (0.5, 2.0, 4.0, 9.0):
            pixels = np.stack([rng.uniform(0, width, 20), rng.uniform(0, height, 20), np.full(20, depth)], axis=1)
            there = np.empty_like(pixels)
            _points_of(by_address(view_of(LENS, width, height)), pixels, there)
            seen = np.empty_like(pixels)
            _seen(by_address(view), there, seen)
            moved = seen[:, :2] - pixels[:, :2]
            window = view.window[1] - view.window[0]
            disc = 2 * LENS.lens_radius * abs(depth - 4.0) / (depth * 4.0) * width / window
            by = np.array([lens[0], -lens[1]]) * disc / 2 * np.sign(depth - 4.0)
            np.testing.assert_allclose(moved, np.broadcast_to(by, moved.shape), atol=1e-9)
            np.testing.assert_allclose(seen[:, 2], depth)


@kernel
def _points_of(view: View, pixels: F64, out: F64) -> None:
    for i in range(pixels.shape[0]):
        p = pixel_point(view, pixels[i, 0], pixels[i, 1], pixels[i, 2])
        out[i, 0], out[i, 1], out[i, 2] = p[0], p[1], p[2]


@kernel
def _seen(view: View, points: F64, out: F64) -> None:
    for i in range(points.shape[0]):
        out[i, 0], out[i, 1], out[i, 2] = project(view, (points[i, 0], points[i, 1], points[i, 2]))


def test_a_lens_without_a_radius_changes_no_bit() -> None:
    for lens in [(0.0, 0.0), (0.3, -0.9)]:
        mine, own = view_of(PERSPECTIVE, 33, 21, (0.1, 0.2), 4, lens), view_of(PERSPECTIVE, 33, 21, (0.1, 0.2), 4)
        assert all(np.array_equal(np.asarray(one), np.asarray(other)) for one, other in zip(mine, own, strict=True))
