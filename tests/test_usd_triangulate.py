"""Polygons to triangles, whether they close a volume, smooth normals: laws and closed formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scene_reading import areas, solid

from refract_core.usd.geometry.triangulate import fans, fans_fit, is_closed, smooth_normals, triangulate, weld

Points = NDArray[np.float32]

# --- cutting polygons -----------------------------------------------------------------------------------------------


def cut(outline: list[tuple[float, float]]) -> tuple[Points, NDArray[np.int64]]:
    """One polygon in a tilted plane."""
    flat = np.array(outline, np.float64)
    tilt = np.array([[0.8, 0.36, 0.48], [0.0, 0.8, -0.6]])  # two unit vectors at right angles
    points = (flat @ tilt).astype(np.float32)
    count = len(points)
    one = np.array([0]), np.array([count]), np.array([7])
    found = triangulate(points, np.arange(count), *one)
    assert (found.faces == 7).all()
    return points, found.corners


def shoelace(outline: list[tuple[float, float]]) -> float:
    x, y = np.array(outline, np.float64).T
    return float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2)


SHAPES = {
    "triangle": [(0, 0), (2, 0), (0, 1)],
    "quad": [(0, 0), (2, 0), (2, 1), (0, 1)],
    "arrowhead, hollow corner first": [(1, 1), (0, 3), (-3, -1), (4, 0)],
    "arrowhead, hollow corner second": [(4, 0), (1, 1), (0, 3), (-3, -1)],
    "quad with three corners in a line": [(0, 0), (1, 0), (2, 0), (1, 2)],
    "L": [(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (0, 3)],
    "comb": [(0, 0), (7, 0), (7, 3), (6, 3), (6, 1), (4, 1), (4, 3), (3, 3), (3, 1), (1, 1), (1, 3), (0, 3)],
    "points along its edges": [(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2), (0, 1)],
    "spiral": [(0, 0), (6, 0), (6, 6), (1, 6), (1, 2), (4, 2), (4, 4), (3, 4), (3, 3), (2, 3), (2, 5), (5, 5), (5, 1),
               (0, 1)],
}  # fmt: skip


@pytest.mark.parametrize("name", SHAPES)
def test_triangles_cover_a_polygon_once_and_keep_its_winding(name: str) -> None:
    outline = [(float(x), float(y)) for x, y in SHAPES[name]]
    if shoelace(outline) < 0:
        outline.reverse()
    for turned in (outline, outline[1:] + outline[:1], outline[::-1]):
        points, corners = cut(turned)
        vectors = areas(points, corners)
        axis = np.cross([0.8, 0.36, 0.48], [0.0, 0.8, -0.6]) * math.copysign(1.0, shoelace(turned))
        along = vectors @ axis
        # All face the polygon's way, and their areas add up to its own: no overlap, nothing missing.
        assert (along > 0).all()
        assert along.sum() == pytest.approx(abs(shoelace(turned)), rel=1e-5)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(0.2, 3.0), min_size=4, max_size=40), st.integers(0, 40))
def test_star_shaped_polygons_of_any_size_are_covered_once(radii: list[float], first: int) -> None:
    turn = 2 * math.pi / len(radii)
    outline = [(r * math.cos(i * turn), r * math.sin(i * turn)) for i, r in enumerate(radii)]
    outline = outline[first % len(outline) :] + outline[: first % len(outline)]
    points, corners = cut(outline)
    along = areas(points, corners) @ np.cross([0.8, 0.36, 0.48], [0.0, 0.8, -0.6])
    assert (along > 0).all()
    assert along.sum() == pytest.approx(shoelace(outline), rel=1e-4)


def test_faces_of_different_sizes_stay_in_order() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 2, 0]], np.float32)
    indices = np.array([0, 1, 2, 0, 1, 2, 3, 0, 2, 3, 0, 1, 4, 3])
    counts = np.array([3, 4, 3, 4])
    starts = np.array([0, 3, 7, 10])
    found = triangulate(points, indices, starts, counts, np.arange(4))
    assert found.faces.tolist() == [0, 1, 1, 2, 3, 3]
    for face, (start, count) in enumerate(zip(starts, counts, strict=True)):
        of_face = found.corners[found.faces == face]
        assert set(of_face.ravel()) == set(range(start, start + count))


# --- closed or open -------------------------------------------------------------------------------------------------


def closed(points: list[tuple[int, int, int]], faces: list[list[int]]) -> bool:
    counts = np.array([len(face) for face in faces])
    flat = np.array([index for face in faces for index in face])
    return is_closed(np.array(points, np.float32), flat, np.cumsum(counts) - counts, counts)


@pytest.mark.parametrize(("inward", "convex"), [(0.0, True), (0.4, True), (0.5, False), (0.6, False)])
def test_the_short_way_for_small_meshes_is_taken_only_where_it_cuts_as_the_long_way(
    inward: float, convex: bool
) -> None:
    """A triangle and a unit square whose last corner moves along the diagonal: past the middle its fan is no more."""
    points = np.array([(1, 0), (1, 1), (0, 1), (inward, inward), (3, 0), (4, 0), (3, 1)], np.float32)
    points = np.pad(points, ((0, 0), (0, 1)))
    indices, counts = np.array([4, 5, 6, 0, 1, 2, 3]), np.array([3, 4])
    starts = np.cumsum(counts) - counts
    long = triangulate(points, indices, starts, counts, np.arange(2))
    short, loops = fans(starts, counts)
    assert fans_fit(points, indices, loops) == convex
    assert np.array_equal(long.corners, short.corners) == convex


def test_a_triangle_without_area_is_not_taken_the_short_way() -> None:
    points = np.array([(0, 0, 0), (1, 1, 1), (2, 2, 2)], np.float32)
    _, loops = fans(np.array([0]), np.array([3]))
    assert not fans_fit(points, np.arange(3), loops)


def test_a_cube_is_closed_until_a_face_is_missing_turned_or_doubled() -> None:
    points, faces = solid("cube")
    assert closed(points, faces)
    assert not closed(points, faces[1:])
    assert not closed(points, [faces[0][::-1], *faces[1:]])
    assert not closed(points, [*faces, faces[0]])


def test_a_cube_whose_faces_share_no_points_is_closed_by_position() -> None:
    points, faces = solid("cube")
    soup = [points[index] for face in faces for index in face]
    apart = [list(range(4 * face, 4 * face + 4)) for face in range(6)]
    assert closed(soup, apart)
    soup[5] = (9, 9, 9)
    assert not closed(soup, apart)


def test_a_large_closed_surface_takes_the_same_answer_as_a_small_one() -> None:
    """A torus of n x n quads has no border; without one quad it has."""
    for n in (5, 40):
        faces = [
            [i * n + j, i * n + (j + 1) % n, (i + 1) % n * n + (j + 1) % n, (i + 1) % n * n + j]
            for i in range(n)
            for j in range(n)
        ]
        points = [(i, j, 0) for i in range(n) for j in range(n)]
        assert closed(points, faces)
        assert not closed(points, faces[:-1])
        assert not closed(points, [*faces[:-1], faces[-1][::-1]])


def test_quads_collapsed_to_triangles_at_a_pole_do_not_open_a_surface() -> None:
    points, faces = solid("cube")
    apex = [[4, 5, 8, 8], [5, 7, 8, 8], [7, 6, 8, 8], [6, 4, 8, 8]]  # a pyramid on the top face
    rest = [face for face in faces if sorted(face) != [4, 5, 6, 7]]
    assert closed([*points, (0, 0, 5)], [*rest, *apex])


def test_welding_tells_positions_apart_exactly_and_zero_has_no_sign() -> None:
    points = np.array([[0.0, 1, 2], [-0.0, 1, 2], [np.nextafter(np.float32(0), np.float32(1)), 1, 2]], np.float32)
    numbers = weld(points)
    assert numbers[0] == numbers[1] != numbers[2]


def test_smooth_normals_are_undecided_only_where_no_triangle_is() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]], np.float32)
    assert smooth_normals(points, np.array([[0, 1, 2]])).tolist() == [[0, 0, 1]] * 3 + [[0, 0, 0]]
