"""Faces of texels: the cube's geometry, seams, averages, and the GGX levels against quadrature."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from refract_core.kernels.compile import kernel
from refract_core.kernels.lanes import by_address
from refract_core.optics.interface import probe_roughness_hdrp
from refract_core.probes.faces import (
    CUBE,
    TEXEL,
    Level,
    Levels,
    Picture,
    averages,
    direction_face,
    face_direction,
    fill_cube_border,
    filter_face,
    halve,
    layout,
    level_at,
    level_of,
    lobe_samples,
    side_of,
    view_of_level,
)

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]
UNTIMED = settings(deadline=None)  # the first example compiles


@kernel
def _at(picture: Picture, directions: F64, lod: float, out: F64) -> None:
    for i in range(directions.shape[0]):
        face, x, y = direction_face((directions[i, 0], directions[i, 1], directions[i, 2]))
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4] = level_at(picture, face, x, y, lod)


def at(pool: F32, levels: Levels, directions: F64, lod: float) -> F64:
    """Red of a picture in some directions."""
    out = np.empty((len(directions), TEXEL))
    looked_at = Picture(pool, levels.first, levels.side, len(levels.side) - 1)
    _at(by_address(looked_at), np.ascontiguousarray(directions), lod, out)
    return out[:, 0]


def texel_directions(n: int) -> F64:
    """Unit directions of the texel centres of all faces, shape (6, n, n, 3)."""
    at = (np.arange(n) + 0.5) / n * 2 - 1
    d = np.array([[[face_direction(face, x, y) for x in at] for y in at] for face in range(CUBE)])
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def picture(values: NDArray[np.floating]) -> tuple[F32, Levels]:
    """A cube of red `values` (6, n, n) with all its blurred levels."""
    n = values.shape[1]
    levels, size = layout(n, 7, CUBE)
    pool = np.zeros(size, np.float32)
    view_of_level(pool, levels, 0, CUBE)[:, 1:-1, 1:-1, 0] = values
    fill_cube_border(by_address(Level(pool, 0, n)))
    source = by_address(averages(Level(pool, 0, n)))
    for level in range(1, 7):
        target = by_address(level_of(pool, levels, level))
        for face in range(CUBE):
            filter_face(source, target, face, lobe_samples(level, n))
        fill_cube_border(target)
    return pool, levels


def lobe_mean(level: int, f: Callable[[F64, F64], F64]) -> float:
    """Mean of f(theta, phi) over D(h) cos(l) seen along the normal, by midpoints fine enough for the narrowest lobe."""
    a2 = max(float(probe_roughness_hdrp(float(level))), 1e-3) ** 4
    theta, phi = np.meshgrid(np.pi / 2 * ((np.arange(2000) + 0.5) / 2000) ** 2, (np.arange(90) + 0.5) * np.pi / 45)
    density = a2 / (np.pi * (np.cos(theta / 2) ** 2 * (a2 - 1) + 1) ** 2)
    weight = density * np.cos(theta) * np.sin(theta) * np.sqrt(theta)  # d theta goes with the root of theta
    return float((weight * f(theta, phi)).sum() / weight.sum())


# --- The cube -------------------------------------------------------------------------------------------------------


@UNTIMED
@given(st.integers(0, 5), st.floats(-0.999, 0.999), st.floats(-0.999, 0.999))
def test_faces_and_directions_are_inverse(face: int, x: float, y: float) -> None:
    found, u, v = direction_face(face_direction(face, x, y))
    assert found == face
    assert (u, v) == pytest.approx((x, y), abs=1e-12)


@pytest.mark.parametrize("face", range(6))
def test_each_face_looks_along_its_axis_and_is_right_handed_from_inside(face: int) -> None:
    """Order +x -x +y -y +z -z; x to the right and y down, seen from the centre, so right x down points outward."""
    middle = np.array(face_direction(face, 0.0, 0.0))
    expected = np.zeros(3)
    expected[face // 2] = 1 - 2 * (face % 2)
    np.testing.assert_array_equal(middle, expected)
    right = np.array(face_direction(face, 1.0, 0.0)) - middle
    down = np.array(face_direction(face, 0.0, 1.0)) - middle
    assert abs(np.cross(right, down) @ middle) == 1
    if face not in (2, 3):
        assert down[1] == -1


def test_all_faces_turn_the_same_way() -> None:
    signs = set()
    for face in range(6):
        middle = np.array(face_direction(face, 0.0, 0.0))
        right = np.array(face_direction(face, 1.0, 0.0)) - middle
        down = np.array(face_direction(face, 0.0, 1.0)) - middle
        signs.add(float(np.cross(right, down) @ middle))
    assert len(signs) == 1


# --- Seams ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("resolution", [1, 2, 3, 8, 64])
def test_no_seam_on_edges_and_corners_whatever_the_texels_are(resolution: int) -> None:
    """Noise, looked up on both sides of every edge, a millionth apart: the same to a millionth of its contrast."""
    rng = np.random.default_rng(4)
    levels, size = layout(resolution, 1, CUBE)
    pool = np.zeros(size, np.float32)
    view_of_level(pool, levels, 0, CUBE)[:, 1:-1, 1:-1, 0] = rng.random((CUBE, resolution, resolution))
    fill_cube_border(by_address(Level(pool, 0, resolution)))
    along = rng.uniform(-1, 1, 400)
    along[:40] = np.where(along[:40] > 0, 1, -1)  # corners
    for axes in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        for sx in (-1.0, 1.0):
            for sy in (-1.0, 1.0):
                near, far = np.empty((400, 3)), np.empty((400, 3))
                near[:, axes[0]], near[:, axes[1]], near[:, axes[2]] = sx * (1 + 1e-7), sy, along
                far[:, axes[0]], far[:, axes[1]], far[:, axes[2]] = sx, sy * (1 + 1e-7), along
                assert np.abs(at(pool, levels, near, 0.0) - at(pool, levels, far, 0.0)).max() < 1e-6 * resolution + 1e-6


# --- Levels ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("m", [2, 3, 5, 8])
def test_halving_keeps_a_constant_and_a_symmetric_mean(m: int) -> None:
    n = side_of(m, 1)
    source = np.zeros((CUBE, m + 2, m + 2, TEXEL), np.float32)
    ramp = np.linspace(-1, 1, m)
    source[:, 1:-1, 1:-1, 0] = 0.7
    source[:, 1:-1, 1:-1, 1] = ramp[None, :, None] + 3 * ramp[None, None, :]
    target = np.zeros((CUBE, n + 2, n + 2, TEXEL), np.float32)
    halve(by_address(Level(source.reshape(-1), 0, m)), by_address(Level(target.reshape(-1), 0, n)), CUBE)
    inner = target[:, 1:-1, 1:-1]
    np.testing.assert_allclose(inner[..., 0], 0.7, rtol=1e-6)
    np.testing.assert_allclose(inner[..., 1].mean((1, 2)), 0.0, atol=1e-6)


@pytest.mark.parametrize("level", range(1, 7))
def test_levels_of_a_linear_picture_shrink_it_by_the_lobe(level: int) -> None:
    """Blurring the cosine to an axis by a round lobe scales it by the lobe's mean cosine, everywhere."""
    axis = np.array([0.48, 0.6, 0.64])
    pool, levels = picture(texel_directions(64) @ axis)
    mean = lobe_mean(level, lambda theta, _phi: np.asarray(np.cos(theta)))
    n = int(levels.side[level])
    # Averages of texels are means over flat squares, not over the sphere: they lose up to a texel's own curvature.
    texels = view_of_level(pool, levels, level, CUBE)[:, 1:-1, 1:-1, 0]
    np.testing.assert_allclose(texels, mean * (texel_directions(n) @ axis), atol=0.012)


def beyond_terminator(elevation: float) -> Callable[[F64, F64], F64]:
    """1 where a direction at (theta, phi) around an axis of this elevation lies in the upper half."""

    def lit(theta: F64, phi: F64) -> F64:
        up = np.cos(theta) * np.sin(elevation) + np.sin(theta) * np.cos(phi) * np.cos(elevation)
        return np.asarray(up > 0, np.float64)

    return lit


@pytest.mark.parametrize("level", range(2, 6))
def test_levels_blur_an_edge_as_the_lobe_says(level: int) -> None:
    """Half of the sphere is lit; the picture across the terminator is the lobe's share of the lit half."""
    lit = (texel_directions(64)[..., 2] > 0).astype(np.float64)
    pool, levels = picture(lit)
    angles = np.linspace(-0.6, 0.6, 13)
    found = at(pool, levels, np.stack([np.cos(angles), np.zeros(13), np.sin(angles)], 1), float(level))
    expected = [lobe_mean(level, beyond_terminator(float(a))) for a in angles]
    # A texel of the level is 90 / n degrees wide, and its own average adds to the blur.
    np.testing.assert_allclose(found, expected, atol=0.08)
    assert abs(found[6] - 0.5) < 0.02


def test_level_roughness_follows_hdrp() -> None:
    """Lobes widen with the level by HDRP's mapping: level 6 is roughness 1, whose alpha is 1."""
    assert float(probe_roughness_hdrp(6.0)) == pytest.approx(1.0)
    widths = [float((lobe_samples(level, 64)[:, 2] * lobe_samples(level, 64)[:, 3]).sum()) for level in range(1, 7)]
    assert all(a > b for a, b in pairwise(widths))
    # alpha 1: D is constant, so the lobe is cos(l) over the hemisphere of h folded to l: mean cosine 2/3.
    assert widths[-1] == pytest.approx(2 / 3, abs=0.01)
