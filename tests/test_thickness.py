"""Measured thickness against closed forms: ball, slab, torus, shell; and its pictures in uv."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from refract_core.thickness.measure import VIEWS, Places, corner_places, measure, mended, middle_places, views
from refract_core.thickness.picture import draw, texels

F64 = NDArray[np.float64]
U32 = NDArray[np.uint32]
Solid = tuple[F64, U32, F64]
"""Points (V, 3), triangles (T, 3), normals (T, 3, 3)."""

NORMAL = views(False, 1.5, "normal")


def patch(columns: int, rows: int, at: Callable[[F64, F64], tuple[F64, F64]]) -> Solid:
    """A closed smooth surface over two angles, as quads cut in two. `at` gives points and normals."""
    u, v = (np.arange(n) * (2 * np.pi / n) for n in (columns, rows))
    points, normals = at(*(a.ravel() for a in np.meshgrid(u, v)))
    i, j = (a.ravel() for a in np.meshgrid(np.arange(columns), np.arange(rows)))
    a, b = j * columns + i, j * columns + (i + 1) % columns
    c, d = (j + 1) % rows * columns + (i + 1) % columns, (j + 1) % rows * columns + i
    triangles = np.concatenate((np.stack((a, b, c), 1), np.stack((a, c, d), 1))).astype(np.uint32)
    return points, triangles, normals[triangles]


def torus(ring: float, tube: float, columns: int = 200, rows: int = 120) -> Solid:
    def at(u: F64, v: F64) -> tuple[F64, F64]:
        normals = np.stack((np.cos(v) * np.cos(u), np.cos(v) * np.sin(u), np.sin(v)), axis=1)
        circle = np.stack((np.cos(u), np.sin(u), 0 * u), axis=1)
        return ring * circle + tube * normals, normals

    return patch(columns, rows, at)


def ball(radius: float, *, outward: float = 1.0, count: int = 4) -> Solid:
    """An octahedron, every triangle cut in four `count` times and blown up."""
    points = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]], np.float64)
    triangles = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]])
    for _ in range(count):
        at = points[triangles]
        middles = (at + at[:, [1, 2, 0]]) / 2
        every, places = np.unique(np.concatenate((at, middles)).reshape(-1, 3).round(12), axis=0, return_inverse=True)
        (a, b, c), (ab, bc, ca) = (part.T for part in places.reshape(2, -1, 3))
        triangles = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
        points = every / np.linalg.norm(every, axis=1, keepdims=True)
    if outward < 0:
        triangles = triangles[:, ::-1]
    return points * radius, triangles.astype(np.uint32), points[triangles] * outward


def box(*sides: float) -> Solid:
    """Flat faces, two triangles each."""
    points = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)]) * sides
    loops = np.array([[1, 3, 7, 5], [2, 0, 4, 6], [3, 2, 6, 7], [0, 1, 5, 4], [4, 5, 7, 6], [2, 3, 1, 0]])
    triangles = loops[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3).astype(np.uint32)
    at = points[triangles]
    normals = np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return points, triangles, np.repeat(normals[:, None], 3, axis=1)


def both(a: Solid, b: Solid) -> Solid:
    triangles = np.concatenate((a[1], b[1] + np.uint32(len(a[0]))))
    return np.concatenate((a[0], b[0])), triangles, np.concatenate((a[2], b[2]))


def at_corners(solid: Solid, rays: F64 = NORMAL, *, jobs: int = 0) -> F64:
    """Thickness at every triangle corner, shape (T, 3)."""
    places, picks = corner_places(solid[1], solid[2])
    return measure(solid[0], solid[1], places, rays, jobs=jobs)[picks]


# --- along -N -------------------------------------------------------------------------------------------------------


def test_a_ball_is_everywhere_as_thick_as_its_diameter() -> None:
    values = at_corners(ball(3.0))
    np.testing.assert_allclose(values, 6.0, rtol=1e-5)  # opposite every point lies another


def test_between_the_points_of_a_ball_only_its_facets_are_missing() -> None:
    points, triangles, normals = ball(1.0)
    values = measure(points, triangles, middle_places(normals), NORMAL)
    sagitta = 1.0 - np.linalg.norm(points[triangles].mean(axis=1), axis=1).min()
    assert values.max() <= 2.0
    assert values.min() >= 2.0 - 2.5 * sagitta


def test_a_torus_is_as_thick_as_its_tube_inside_and_outside() -> None:
    points, triangles, normals = torus(2.0, 0.5)
    places, _ = corner_places(triangles, normals)
    values = measure(points, triangles, places, NORMAL)
    around = np.hypot(*points[:, :2].T)
    for equator in (np.isclose(around, 2.5), np.isclose(around, 1.5)):
        assert equator.sum() == 200
        np.testing.assert_allclose(values[equator], 1.0, rtol=1e-5)
    np.testing.assert_allclose(values, 1.0, rtol=2e-3)


def test_the_hollow_of_a_shell_is_its_far_side() -> None:
    values = at_corners(both(ball(1.0), ball(0.9, outward=-1.0)))
    np.testing.assert_allclose(values, 0.1, rtol=2e-2)


@pytest.mark.parametrize("sides", [(1.0, 1.0, 1.0), (4.0, 3.0, 0.01), (1000.0, 1.0, 2.0)])
def test_each_face_of_a_box_has_the_way_to_the_one_opposite(sides: tuple[float, float, float]) -> None:
    solid = box(*sides)
    expected = np.abs(solid[2]) @ np.array(sides)
    np.testing.assert_allclose(at_corners(solid), expected, rtol=1e-4)


def test_a_point_with_one_normal_is_measured_once_and_a_corner_once_for_every_face() -> None:
    assert len(corner_places(*ball(1.0)[1:])[0].triangle) == len(ball(1.0)[0])
    assert len(corner_places(*box(1.0, 2.0, 3.0)[1:])[0].triangle) == 8 * 3


@pytest.mark.parametrize(("scale", "shift"), [(1e-4, 0.0), (1e4, 0.0), (1.0, 1e6)])
def test_neither_unit_nor_place_matters(scale: float, shift: float) -> None:
    points, triangles, normals = torus(2.0, 0.5, 40, 30)
    here = at_corners((points, triangles, normals))
    there = at_corners((points * scale + shift, triangles, normals)) / scale
    np.testing.assert_allclose(there, here, rtol=1e-4)


def test_a_shading_normal_that_points_into_the_glass_sends_no_ray_out() -> None:
    points, triangles, normals = box(2.0, 2.0, 2.0)
    values = at_corners((points, triangles, -normals))
    np.testing.assert_allclose(values, 2.0, rtol=1e-4)


def test_the_number_of_threads_changes_nothing() -> None:
    solid, rays = torus(2.0, 0.5), views(False, 1.5, "refracted")
    np.testing.assert_array_equal(at_corners(solid, rays, jobs=1), at_corners(solid, rays, jobs=3))


def test_where_there_is_no_far_side_the_neighbours_say() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float64)
    triangles = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    normals = np.broadcast_to([0.0, 0.0, 1.0], (2, 3, 3))
    assert np.isnan(at_corners((points, triangles, np.array(normals)))).all()
    values = mended(np.array([np.nan, 1.0, np.nan, 3.0]), triangles.astype(np.int64))
    np.testing.assert_array_equal(values, [2.0, 1.0, 2.0, 3.0])


# --- along refracted rays -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ior", [1.0, 1.33, 1.5, 2.4])
def test_the_sphere_model_is_true_of_a_ball(ior: float) -> None:
    values = at_corners(ball(1.0, count=5), views(False, ior, "refracted"))
    np.testing.assert_allclose(values, 2.0, rtol=2e-3)


def slab_middle(rays: F64) -> float:
    """Thickness of a wide slab of 1, in the middle of its upper face."""
    points, triangles, normals = box(100.0, 100.0, 1.0)
    upper = int(np.flatnonzero(normals[:, 0, 2] > 0.5)[0])
    places = Places(np.array([upper]), np.full((1, 2), 0.4), np.array([[0.0, 0.0, 1.0]]))
    return float(measure(points, triangles, places, rays)[0])


@pytest.mark.parametrize("ior", [1.33, 1.5, 2.4])
def test_the_box_model_is_true_of_a_slab_and_the_sphere_model_takes_what_fits_best(ior: float) -> None:
    assert slab_middle(views(True, ior, "refracted")) == pytest.approx(1.0, rel=1e-4)
    # L = 1 / cos t against cos t: 1 / mean(cos^2 t), and sin^2 i is even over 0 .. 1, so that is 1 - 1 / (2 n^2).
    assert slab_middle(views(False, ior, "refracted")) == pytest.approx(1.0 / (1.0 - 0.5 / ior**2), rel=1e-4)


def test_views_are_even_in_projected_area() -> None:
    rays = views(False, 1.0, "refracted")
    assert rays.shape == (VIEWS, 4)
    np.testing.assert_allclose(np.linalg.norm(rays[:, :3], axis=1), 1.0)
    assert (rays[:, 0] ** 2 + rays[:, 1] ** 2).mean() == pytest.approx(0.5)  # of cos i over the hemisphere
    np.testing.assert_allclose(rays[:, :2].mean(axis=0), 0.0, atol=0.06)


# --- pictures -------------------------------------------------------------------------------------------------------

SQUARE = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]], np.float64)
UP = np.broadcast_to([0.0, 0.0, 1.0], (2, 3, 3)).copy()


def across(uv: F64) -> Callable[[Places], F64]:
    """A thickness that is the place's u."""

    def thickness(places: Places) -> F64:
        second, third = places.weights.T
        corners = uv[places.triangle, :, 0]
        out: F64 = corners[:, 0] * (1 - second - third) + corners[:, 1] * second + corners[:, 2] * third
        return out

    return thickness


@pytest.mark.parametrize("size", [16, 37, 64])
def test_a_square_covers_every_texel_once_and_the_middle_of_a_texel_counts(size: int) -> None:
    seen = np.zeros(size * size, int)
    for texel, _ in texels(SQUARE, UP, size):
        np.add.at(seen, texel, 1)
    assert (seen == 1).all()
    picture, overlap = draw(SQUARE, UP, size, across(SQUARE))
    np.testing.assert_allclose(picture, np.tile((np.arange(size) + 0.5) / size, (size, 1)), atol=1e-6)
    assert overlap == 0.0


def test_v_runs_upwards() -> None:
    lower = SQUARE * (1.0, 0.5)
    (covered,) = (texel for texel, _ in texels(lower, UP, 16))
    assert set((covered // 16).tolist()) == set(range(8, 16))


def test_a_mirrored_island_is_as_good_as_another() -> None:
    turned = SQUARE[:, [0, 2, 1]]
    picture, overlap = draw(turned, UP, 32, across(turned))
    np.testing.assert_allclose(picture[0], (np.arange(32) + 0.5) / 32, atol=1e-6)
    assert overlap == 0.0


def test_gutters_go_on_as_the_island_ends() -> None:
    island = SQUARE * 0.5 + 0.25
    picture, _ = draw(island, UP, 64, across(island))
    assert picture.min() >= 0.25
    assert picture.max() <= 0.75
    np.testing.assert_allclose(picture[20:40, 12:16], 16.5 / 64, atol=0.002)
    np.testing.assert_allclose(picture[20:40, 48:52], 47.5 / 64, atol=0.002)


def test_a_uv_of_other_tiles_repeats() -> None:
    moved = SQUARE + np.array([2.0, -1.0])
    picture, _ = draw(moved, UP, 32, lambda places: across(moved)(places) - 2.0)
    np.testing.assert_allclose(picture[5], (np.arange(32) + 0.5) / 32, atol=1e-6)


def test_overlap_is_told_and_averaged() -> None:
    twice = np.concatenate((SQUARE, SQUARE))
    picture, overlap = draw(twice, np.concatenate((UP, UP)), 16, lambda places: np.where(places.triangle < 2, 1.0, 3.0))
    assert overlap == 1.0
    np.testing.assert_array_equal(picture, 2.0)


def test_a_picture_of_nothing_is_empty() -> None:
    picture, _ = draw(SQUARE * 0.0 + 0.3, UP, 16, lambda places: np.ones(len(places.triangle)))
    assert picture.max() == 0.0
