"""Probe volumes against the fact sheet's numbers and the laws of weights."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from refract_core.kernels.vec import Vec
from refract_core.probes import volumes

UNTIMED = settings(deadline=None)  # the first example compiles
ZEROS = (0.0,) * 6
ONES = (1.0,) * 6
EXTENTS = (1.0, 2.0, 3.0)
Z = (0.0, 0.0, 1.0)
ORIGIN = (0.0, 0.0, 0.0)

inside = st.tuples(*(st.floats(-e, e) for e in EXTENTS))
anywhere = st.tuples(*(st.floats(-4.0, 4.0) for _ in range(3)))
units = st.tuples(st.floats(-1.0, 1.0), st.floats(0.0, 2.0 * math.pi)).map(
    lambda a: (
        math.sqrt(1.0 - a[0] ** 2) * math.cos(a[1]),
        math.sqrt(1.0 - a[0] ** 2) * math.sin(a[1]),
        a[0],
    )
)


def at(o: Vec, d: Vec, s: float) -> Vec:
    return (o[0] + s * d[0], o[1] + s * d[1], o[2] + s * d[2])


# --- Rays -----------------------------------------------------------------------------------------------------------


@UNTIMED
@given(o=inside, d=units)
def test_ray_from_inside_ends_on_a_face_of_the_box(o: Vec, d: Vec) -> None:
    s = volumes.ray_box(o, d, EXTENTS)
    assert s >= 0.0
    over = [abs(x) / e for x, e in zip(at(o, d, s), EXTENTS, strict=True)]
    assert max(over) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("zero", [0.0, -0.0, 1e-12])
def test_axis_aligned_rays_are_finite(zero: float) -> None:
    o = (0.25, -0.5, 1.0)
    for axis, expected in enumerate([(0.75, 1.25), (2.5, 1.5), (2.0, 4.0)]):
        for sign, distance in zip((1.0, -1.0), expected, strict=True):
            d = [zero, zero, zero]
            d[axis] = sign
            assert volumes.ray_box(o, (d[0], d[1], d[2]), EXTENTS) == pytest.approx(distance)


def test_box_from_outside() -> None:
    assert volumes.ray_box((-5.0, 0.0, 0.0), (1.0, 0.0, 0.0), EXTENTS) == pytest.approx(6.0)
    assert volumes.ray_box((-5.0, 0.0, 0.0), (-1.0, 0.0, 0.0), EXTENTS) == -1.0
    assert volumes.ray_box((0.0, 2.5, 0.0), (1.0, 0.0, 0.0), EXTENTS) == -1.0
    assert volumes.ray_box((-5.0, 0.0, 0.0), (math.sqrt(0.5), math.sqrt(0.5), 0.0), EXTENTS) == -1.0
    assert volumes.ray_box(ORIGIN, ORIGIN, EXTENTS) == -1.0


def test_box_takes_a_row_of_an_array() -> None:
    assert volumes.ray_box(ORIGIN, Z, np.array(EXTENTS, np.float32)) == pytest.approx(3.0)  # type: ignore[arg-type]


@UNTIMED
@given(o=st.tuples(*(st.floats(-1.1, 1.1) for _ in range(3))), d=units)
def test_ray_from_inside_ends_on_the_sphere(o: Vec, d: Vec) -> None:
    s = volumes.ray_sphere(o, d, 2.0)
    assert s >= 0.0
    assert math.hypot(*at(o, d, s)) == pytest.approx(2.0, abs=1e-9)


def test_sphere_from_outside() -> None:
    assert volumes.ray_sphere((0.0, 0.0, -5.0), Z, 2.0) == pytest.approx(7.0)
    assert volumes.ray_sphere((0.0, 0.0, 5.0), Z, 2.0) == -1.0
    assert volumes.ray_sphere((3.0, 0.0, -5.0), Z, 2.0) == -1.0


def test_sphere_is_exact_just_below_its_surface() -> None:
    assert volumes.ray_sphere((0.0, 0.0, 1.0 - 1e-12), Z, 1.0) == pytest.approx(1e-12, rel=1e-3)
    assert volumes.ray_sphere((0.0, 0.0, 1.0), Z, 1.0) == 0.0


# --- Influence ------------------------------------------------------------------------------------------------------

blends = st.tuples(*(st.floats(0.0, 1.0) for _ in range(6)))


@UNTIMED
@given(p=anywhere, n=units, ray=units, blend=blends, normal_blend=blends, fade=blends)
def test_box_weight_is_a_weight_and_nothing_outside(
    p: Vec, n: Vec, ray: Vec, blend: tuple[float, ...], normal_blend: tuple[float, ...], fade: tuple[float, ...]
) -> None:
    w = volumes.influence_box(p, n, ray, p, EXTENTS, blend, normal_blend, fade)
    assert 0.0 <= w <= 1.0
    if any(abs(x) > e for x, e in zip(p, EXTENTS, strict=True)):
        assert w == 0.0


@UNTIMED
@given(p=inside, ray=units, axis=st.integers(0, 2), step=st.floats(-1e-3, 1e-3))
def test_box_weight_is_continuous(p: Vec, ray: Vec, axis: int, step: float) -> None:
    moved = list(p)
    moved[axis] += step
    blend = (0.5, 0.3, 1.0, 0.2, 0.4, 0.8)
    toward = (0.0, 0.0, -1.0)
    a = volumes.influence_box(p, Z, ray, toward, EXTENTS, blend, ZEROS, ONES)
    b = volumes.influence_box((moved[0], moved[1], moved[2]), Z, ray, toward, EXTENTS, blend, ZEROS, ONES)
    assert abs(a - b) <= 1.5 * abs(step) / 0.2 + 1e-9  # smooth01 is at most 1.5 steep, the shortest blend 0.2 m


def box_at(p: Vec, *, n: Vec = Z, ray: Vec = Z, away: Vec = (0.0, 0.0, -1.0), face: int = 0, **six: float) -> float:
    """Weight at `p` with one face's value changed."""
    values = {"blend": list(ZEROS), "normal": list(ZEROS), "fade": list(ONES)}
    for name, value in six.items():
        values[name][face] = value
    blend, normal, fade = (tuple(values[name]) for name in ("blend", "normal", "fade"))
    return volumes.influence_box(p, n, ray, away, EXTENTS, blend, normal, fade)


@pytest.mark.parametrize("face", range(6))
def test_each_face_has_its_own_blend_distance(face: int) -> None:
    def near(side: int, depth: float) -> Vec:
        p = [0.0, 0.0, 0.0]
        p[side // 2] = (EXTENTS[side // 2] - depth) * (1.0 if side % 2 == 0 else -1.0)
        return (p[0], p[1], p[2])

    found = [box_at(near(face, depth), face=face, blend=0.8) for depth in (0.0, 0.2, 0.4, 0.8, 0.9)]
    # A quarter of the way in: smooth01(0.25) = 0.15625; half: 0.5.
    assert found == pytest.approx([0.0, 0.15625, 0.5, 1.0, 1.0])
    assert box_at(near(face ^ 1, 0.2), face=face, blend=0.8) == 1.0


def test_surfaces_that_turn_away_from_the_capture_point_fade() -> None:
    p = (0.5, 0.0, 0.0)
    for dot, expected in ((1.0, 0.0), (0.6, 0.0), (0.4, 0.5), (0.2, 1.0), (-1.0, 1.0)):
        away = (math.sqrt(1.0 - dot * dot), 0.0, dot)
        assert box_at(p, away=away, face=0, normal=0.6) == pytest.approx(expected)
        # Deeper than the blend normal distance the normal does not matter.
        assert box_at(p, away=away, face=0, normal=0.4) == 1.0


def test_a_shut_face_lets_in_only_what_heads_for_another() -> None:
    # Around +x, shut, the cone of +y opens by 4 sin - 1: nothing up to 14.48 degrees, all from 30.
    for angle in (0.0, 14.0, 20.0, 25.0, 31.0):
        ray = (math.cos(math.radians(angle)), math.sin(math.radians(angle)), 0.0)
        opened = min(max(4.0 * ray[1] - 1.0, 0.0), 1.0)
        assert box_at(ORIGIN, ray=ray, face=0, fade=0.0) == pytest.approx(opened**2 * (3.0 - 2.0 * opened))
        assert box_at(ORIGIN, ray=ray, face=3, fade=0.0) == 1.0


def test_all_faces_open_let_every_ray_in() -> None:
    rng = np.random.default_rng(1)
    for v in rng.normal(size=(300, 3)):
        x, y, z = v / np.linalg.norm(v)
        assert volumes.face_weight((x, y, z), ONES) == 1.0


def test_infinite_blend_distance_means_no_border() -> None:
    far = (50.0, -80.0, 3.0)
    assert volumes.influence_box(far, Z, Z, (0.0, 0.0, -1.0), EXTENTS, (math.inf,) * 6, ZEROS, ONES) == 1.0
    assert volumes.influence_sphere(far, Z, (0.0, 0.0, -1.0), 1.0, math.inf, 0.0) == 1.0


@UNTIMED
@given(p=anywhere, n=units, blend=st.floats(0.0, 2.0), normal_blend=st.floats(0.0, 2.0))
def test_sphere_weight_is_a_weight(p: Vec, n: Vec, blend: float, normal_blend: float) -> None:
    w = volumes.influence_sphere(p, n, p, 2.0, blend, normal_blend)
    assert 0.0 <= w <= 1.0
    if math.hypot(*p) > 2.0 + volumes.MIN_BLEND:
        assert w == 0.0


def test_sphere_blends_from_its_surface_inwards() -> None:
    toward = (0.0, 0.0, -1.0)
    found = [volumes.influence_sphere((r, 0.0, 0.0), Z, toward, 3.0, 1.0, 0.0) for r in (0.0, 2.0, 2.25, 2.5, 3.0)]
    assert found == pytest.approx([1.0, 1.0, 0.84375, 0.5, 0.0])
    turned = [volumes.influence_sphere((r, 0.0, 0.0), Z, Z, 3.0, 0.0, 1.0) for r in (1.9, 2.1)]
    assert turned == [1.0, 0.0]


# --- Weights --------------------------------------------------------------------------------------------------------


def test_smooth01_is_clamped_and_odd_about_its_middle() -> None:
    x = np.linspace(0.0, 1.0, 11)
    y = np.array([volumes.smooth01(v) for v in x])
    assert y + y[::-1] == pytest.approx(1.0)
    assert [volumes.smooth01(v) for v in (-1.0, 0.0, 1.0, 2.0)] == [0.0, 0.0, 1.0, 1.0]


def test_edge_fade_of_the_fact_sheet() -> None:
    assert volumes.edge_fade(0.5, 0.5, 0.1) == 1.0
    assert volumes.edge_fade(0.025, 0.5, 0.1) == pytest.approx(0.5)
    assert volumes.edge_fade(0.5, 0.975, 0.1) == pytest.approx(0.5)
    assert volumes.edge_fade(0.975, 0.025, 0.1) == pytest.approx(0.25)
    assert [volumes.edge_fade(u, 0.5, 0.1) for u in (0.0, 1.0, -0.3, 1.7)] == [0.0] * 4
    assert volumes.edge_fade(0.999, 0.5, 0.0) == 1.0


def test_headroom_of_the_fact_sheet() -> None:
    assert volumes.update_headroom(0.8, 0.4) == pytest.approx((1.0, 0.2))
    assert volumes.update_headroom(0.0, 0.3) == pytest.approx((0.3, 0.3))


@UNTIMED
@given(weights=st.lists(st.floats(0.0, 1.0), max_size=8))
def test_spent_weights_never_exceed_one(weights: list[float]) -> None:
    h, total = 0.0, 0.0
    for w in weights:
        h, room = volumes.update_headroom(h, w)
        assert -1e-12 <= room <= w + 1e-12
        total += room
    assert h == pytest.approx(min(sum(weights), 1.0), abs=1e-12)
    assert total == pytest.approx(h, abs=1e-12)


def test_probes_fade_over_the_last_tenth_of_their_distance() -> None:
    found = [volumes.distance_fade(d, 100.0) for d in (0.0, 90.0, 95.0, 100.0, 1e9)]
    assert found == pytest.approx([1.0, 1.0, 0.5, 0.0, 0.0])
    assert volumes.distance_fade(0.0, 0.0) == 0.0
