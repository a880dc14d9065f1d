"""What suits a mesh: shapes whose answer is known by construction."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from refract_core.scene import Model
from refract_core.thickness.fit import Fit, alike, fit, together
from refract_core.usd.geometry.gprims import Solid, _unit_cube, _unit_plane, _unit_tapered, unit_sphere

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Shape = tuple[F64, I64]


def shape(solid: Solid, scale: ArrayLike = 1.0) -> Shape:
    return solid.points.astype(np.float64) * np.asarray(scale), solid.triangles.astype(np.int64)


def turned(points: F64) -> F64:
    """By an odd angle about an odd axis, and away from the origin."""
    q, _ = np.linalg.qr(np.random.default_rng(7).normal(size=(3, 3)))
    moved: F64 = points @ (q * np.sign(np.linalg.det(q))).T + (30.0, -20.0, 5.0)
    return moved


def both(a: Shape, b: Shape) -> Shape:
    return np.vstack((a[0], b[0])), np.vstack((a[1], b[1] + len(a[0])))


def revolved(profile: list[tuple[float, float]], segments: int = 48) -> Shape:
    """A closed solid of revolution about z from a loop of (radius, z), counter-clockwise in (r, z)."""
    outline = np.array(profile)
    turn = np.arange(segments) * 2.0 * np.pi / segments
    points = np.stack(
        (
            np.outer(np.cos(turn), outline[:, 0]),
            np.outer(np.sin(turn), outline[:, 0]),
            np.broadcast_to(outline[:, 1], (segments, len(outline))),
        ),
        axis=-1,
    ).reshape(-1, 3)
    i, j = np.divmod(np.arange(segments * len(outline)), len(outline))
    a, b = i * len(outline) + j, (i + 1) % segments * len(outline) + j
    c = (i + 1) % segments * len(outline) + (j + 1) % len(outline)
    d = i * len(outline) + (j + 1) % len(outline)
    return points, np.concatenate((np.stack((a, b, c), 1), np.stack((a, c, d), 1)))


def torus(ring: float, tube: float) -> Shape:
    around = np.arange(32) * 2.0 * np.pi / 32
    return revolved([(ring + tube * np.cos(t), tube * np.sin(t)) for t in around], 64)


def test_a_ball_is_a_sphere_of_its_diameter() -> None:
    points, triangles = shape(unit_sphere(), 0.25)
    found = fit(turned(points), triangles)
    assert found.model is Model.SPHERE
    assert found.closed
    assert found.convex
    assert found.thickness == pytest.approx(0.5, rel=1e-5)


@pytest.mark.parametrize("sides", [(1.0, 1.0, 1.0), (4.0, 0.01, 2.0), (1.0, 2.0, 30.0)])
def test_a_box_however_turned_has_its_smallest_side(sides: tuple[float, float, float]) -> None:
    points, triangles = shape(_unit_cube(), np.array(sides) / 2.0)
    found = fit(turned(points), triangles)
    assert found.model is Model.BOX
    assert found.thickness == pytest.approx(min(sides), rel=1e-5)


def test_a_pane_without_a_back_is_thin() -> None:
    assert fit(*shape(_unit_plane())).model is Model.THIN


def test_a_ball_with_a_hole_is_open() -> None:
    points, triangles = shape(unit_sphere())
    found = fit(points, triangles[3:])
    assert not found.closed
    assert found.model is Model.THIN


def test_vertices_split_along_seams_still_close() -> None:
    points, triangles = shape(_unit_cube())
    found = fit(points[triangles.ravel()], np.arange(triangles.size).reshape(-1, 3))
    assert found.closed
    assert found.model is Model.BOX


def test_a_ball_inside_out_is_still_a_ball() -> None:
    points, triangles = shape(unit_sphere())
    assert fit(points, triangles[:, ::-1]).model is Model.SPHERE


def test_a_shell_is_hollow_and_two_balls_side_by_side_are_not() -> None:
    outer, (points, triangles) = shape(unit_sphere()), shape(unit_sphere(), 0.9)
    hollow = fit(*both(outer, (points, triangles[:, ::-1])))
    assert hollow.model is Model.TRACED  # thin would be a pane at either wall, and lose what stands in it
    assert hollow.why.startswith("hollow")
    assert fit(*both(outer, (points + 5.0, triangles))).model is Model.SPHERE


TUMBLER = [(0.0, 0.0), (1.0, 0.0), (1.1, 3.0), (1.03, 3.0), (0.93, 0.3), (0.0, 0.3)]
DISH = [(0.0, 0.0), (2.0, 0.0), (3.0, 0.6), (2.95, 0.65), (1.98, 0.06), (0.0, 0.06)]


@pytest.mark.parametrize("profile", [TUMBLER, DISH])
def test_a_vessel_of_one_closed_surface_is_hollow(profile: list[tuple[float, float]]) -> None:
    points, triangles = revolved(profile)
    found = fit(turned(points), triangles)
    assert found.closed
    assert found.model is Model.TRACED
    assert found.why.startswith("hollow")


@pytest.mark.parametrize(("ring", "tube"), [(3.0, 1.0), (1.0, 0.2), (1.0, 0.03)])
def test_a_ring_is_traced_however_slim(ring: float, tube: float) -> None:
    assert fit(*torus(ring, tube)).model is Model.TRACED


def test_convex_shapes_that_are_neither_are_traced() -> None:
    for one in (shape(_unit_tapered(1.0, 0.0)), shape(unit_sphere(), (1.0, 1.0, 1.6))):
        found = fit(*one)
        assert found.convex
        assert found.model is Model.TRACED


def test_no_triangles_at_all() -> None:
    assert fit(np.zeros((0, 3)), np.zeros((0, 3), np.int64)).thickness == 0.0


def test_together_is_what_suits_all() -> None:
    ball, other = Fit(Model.SPHERE, 1.0, True, True, "a"), Fit(Model.SPHERE, 3.0, True, True, "b")
    pane = Fit(Model.THIN, 0.0, False, False, "open")
    assert together([ball, other]).model is Model.SPHERE
    assert together([ball, other]).thickness == 2.0
    assert together([ball, pane]).model is Model.TRACED
    assert not together([ball, pane]).closed


def test_alike_allows_five_percent() -> None:
    assert alike([])
    assert alike([1.0, 0.96])
    assert not alike([1.0, 0.9])
