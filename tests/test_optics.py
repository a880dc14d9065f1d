"""Optics against outside numbers, closed forms and an oracle that works with angles instead of vectors."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from refract_core.errors import UsageError
from refract_core.optics import arrays as optics
from refract_core.optics import interface as scalar
from refract_core.optics.models import single_model

F64 = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])
GLASS = 1.5
UNTIMED = settings(deadline=None)  # the first example may compile
Model = Callable[..., optics.Exit]


def towards(angle: float) -> F64:
    """Unit vector at `angle` [deg] from UP, towards the viewer."""
    return np.array([math.sin(math.radians(angle)), 0.0, math.cos(math.radians(angle))])


def unit_vectors(count: int, seed: int) -> F64:
    v = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def facing(normals: F64, directions: F64) -> F64:
    """The normals, each turned against its direction."""
    sign = np.where(np.sum(normals * directions, axis=1, keepdims=True) > 0.0, -1.0, 1.0)
    return normals * sign


# --- The oracle: one ray, angles and trigonometry, no vector form of Snell's law ------------------------------------


def oracle_refract(i: F64, n: F64, eta: float) -> F64 | None:
    """Build the refracted direction in the plane of incidence from asin(eta sin theta)."""
    tangent = i - np.dot(i, n) * n
    sine = float(np.linalg.norm(tangent))
    if eta * sine > 1.0:
        return None
    angle = math.asin(eta * sine)
    side = tangent / sine if sine > 0.0 else tangent
    return np.asarray(math.sin(angle) * side - math.cos(angle) * n)


def oracle_shares(angle_i: float, eta: float) -> tuple[float, float]:
    """Reflectance and transmittance by the sine and tangent laws, each from its own amplitudes [angles in rad]."""
    angle_t = math.asin(eta * math.sin(angle_i))
    total, gap = angle_i + angle_t, angle_i - angle_t
    rs, rp = math.sin(gap) / math.sin(total), math.tan(gap) / math.tan(total)
    ts = 2.0 * math.sin(angle_t) * math.cos(angle_i) / math.sin(total)
    tp = ts / math.cos(gap)
    flux = math.cos(angle_t) / (eta * math.cos(angle_i))
    return 0.5 * (rs * rs + rp * rp), 0.5 * flux * (ts * ts + tp * tp)


def oracle_ball(p: F64, d: F64, centre: F64, radius: float, ior: float) -> tuple[float, F64, F64]:
    """Follow a ray that stands on a ball through it: chord by the quadratic, normals from the centre."""
    inside = oracle_refract(d, (p - centre) / radius, 1.0 / ior)
    assert inside is not None
    chord = -2.0 * float(np.dot(p - centre, inside))
    end = p + chord * inside
    leaving = oracle_refract(inside, (centre - end) / radius, ior)
    assert leaving is not None
    return chord, end, leaving


# --- Snell ----------------------------------------------------------------------------------------------------------


def test_reflect_keeps_length_and_angle_and_is_its_own_inverse() -> None:
    i, n = unit_vectors(500, 1), unit_vectors(500, 2)
    r = optics.reflect(i, n)
    assert np.linalg.norm(r, axis=1) == pytest.approx(1.0, abs=1e-12)
    assert np.sum(r * n, axis=1) == pytest.approx(-np.sum(i * n, axis=1), abs=1e-12)
    assert optics.reflect(r, n) == pytest.approx(i, abs=1e-12)


@pytest.mark.parametrize("eta", [1 / 2.41, 1 / 1.5, 1 / 1.33, 1.0, 1.33, 1.5, 2.41])
def test_refract_obeys_snell_and_agrees_with_the_oracle(eta: float) -> None:
    i = unit_vectors(1000, 3)
    n = facing(unit_vectors(1000, 4), i)
    ok, t = optics.refract(i, n, eta)
    assert ok.any()
    snell = np.cross(t[ok], n[ok]) - eta * np.cross(i[ok], n[ok])
    assert np.abs(snell).max() < 1e-12
    assert np.linalg.norm(t[ok], axis=1) == pytest.approx(1.0, abs=1e-12)
    for k in range(len(i)):
        expected = oracle_refract(i[k], n[k], eta)
        assert ok[k] == (expected is not None)
        if expected is not None:
            assert t[k] == pytest.approx(expected, abs=1e-9)
        else:
            assert np.all(t[k] == 0.0)


def test_refraction_is_reversible() -> None:
    i = unit_vectors(1000, 5)
    n = facing(unit_vectors(1000, 6), i)
    _, t = optics.refract(i, n, 1 / GLASS)
    back_ok, back = optics.refract(-t, -n, GLASS)
    assert back_ok.all()
    assert back == pytest.approx(-i, abs=1e-9)


def test_critical_angle_of_glass() -> None:
    ok, _ = optics.refract(-np.stack([towards(41.8103), towards(41.8104)]), UP, GLASS)
    assert ok.tolist() == [True, False]


def test_equal_media_do_nothing() -> None:
    i = unit_vectors(200, 7)
    n = facing(unit_vectors(200, 8), i)
    ok, t = optics.refract(i, n, 1.0)
    assert ok.all()
    assert t == pytest.approx(i, abs=1e-12)
    assert np.all(optics.fresnel_dielectric(np.linspace(0.0, 1.0, 11), 1.0) == 0.0)


def test_total_internal_reflection_does_not_leak_into_other_rows() -> None:
    i = -np.stack([towards(a) for a in np.tile([10.0, 80.0, 30.0, 60.0], 25)])
    ok, t = optics.refract(i, UP, GLASS)
    assert ok.tolist() == [True, False, True, False] * 25
    alone = [optics.refract(row, UP, GLASS) for row in i]
    assert np.array_equal(t, np.stack([one.direction for one in alone]))
    assert np.isfinite(t).all()


@UNTIMED
@given(ior=st.floats(1.0001, 4.0), nudge=st.floats(-1e-6, 1e-6))
def test_around_the_critical_angle(ior: float, nudge: float) -> None:
    sine = min(max(1.0 / ior + nudge, 0.0), 1.0)
    i = np.array([sine, 0.0, -math.sqrt(1.0 - sine * sine)])
    ok, t = optics.refract(i, UP, ior)
    reflectance = optics.fresnel_dielectric(-i[2], ior)
    assert 0.0 <= reflectance <= 1.0
    if abs(ior * sine - 1.0) > 1e-12:
        assert bool(ok) == (ior * sine < 1.0)
    if ok:
        assert np.linalg.norm(t) == pytest.approx(1.0, abs=1e-9)
        assert t[0] == pytest.approx(ior * sine, abs=1e-12)
    else:
        assert np.all(t == 0.0)
        assert reflectance == pytest.approx(1.0, abs=1e-4)


@UNTIMED
@given(ior=st.floats(1.0, 4.0), cosine=st.floats(0.0, 1.0), thickness=st.floats(0.0, 1e3))
def test_models_are_finite_and_unit_everywhere(ior: float, cosine: float, thickness: float) -> None:
    wo = np.array([math.sqrt(1.0 - cosine * cosine), 0.0, cosine])
    for model in (optics.sphere_model, optics.box_model):
        path_length, point, direction = model(np.zeros(3), UP, wo, ior, thickness)
        assert np.isfinite(path_length)
        assert path_length >= 0.0
        assert np.isfinite(point).all()
        assert np.linalg.norm(direction) == pytest.approx(1.0, abs=1e-9)


def test_prism_of_60_degrees_turns_by_37_1808() -> None:
    first = np.array([-math.cos(math.radians(30)), math.sin(math.radians(30)), 0.0])
    second = first * [-1.0, 1.0, 1.0]
    angles = np.radians(np.linspace(28.5, 89.0, 20001))
    along_face = np.array([first[1], -first[0], 0.0])
    i = -np.cos(angles)[:, None] * first + np.sin(angles)[:, None] * along_face
    entered, inside = optics.refract(i, first, 1 / GLASS)
    left, out = optics.refract(inside, -second, GLASS)
    deviation = np.degrees(np.arccos(np.sum(i * out, axis=1)[entered & left]))
    assert deviation.min() == pytest.approx(37.1808, abs=1e-4)


# --- Fresnel --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("eta", [1 / 2.41, 1 / 1.5, 1 / 1.33, 1.33, 1.5, 2.41])
def test_fresnel_and_the_oracles_transmittance_sum_to_one(eta: float) -> None:
    last = math.asin(min(1.0, 1.0 / eta)) - 1e-4
    for angle in np.linspace(1e-3, last, 200):
        reflectance, passed = oracle_shares(angle, eta)
        found = float(optics.fresnel_dielectric(math.cos(angle), eta))
        assert found == pytest.approx(reflectance, abs=1e-9)
        assert found + passed == pytest.approx(1.0, abs=1e-9)


def test_fresnel_at_outside_numbers() -> None:
    assert optics.fresnel_dielectric(1.0, 1 / GLASS) == pytest.approx(0.04, abs=1e-12)
    assert optics.fresnel_dielectric([0.0, 0.5], [1 / GLASS, GLASS]) == pytest.approx([1.0, 1.0])
    assert scalar.f0_from_ior(1.5) == pytest.approx(0.04)
    assert scalar.f0_from_ior(1.33) == pytest.approx(0.02006, abs=1e-5)


def test_brewster_angle_of_glass_reflects_only_s_polarised_light() -> None:
    # At Brewster's angle r_p = 0, so the mean is half of r_s^2 = ((n^2 - 1) / (n^2 + 1))^2.
    half_rs2 = 0.5 * ((GLASS**2 - 1.0) / (GLASS**2 + 1.0)) ** 2
    assert optics.fresnel_dielectric(math.cos(math.radians(56.3099)), 1 / GLASS) == pytest.approx(half_rs2, abs=1e-6)


def test_fresnel_is_the_same_from_both_sides() -> None:
    cos_i = np.linspace(0.01, 1.0, 100)
    cos_t = np.sqrt(1.0 - (1.0 - cos_i**2) / GLASS**2)
    entering = optics.fresnel_dielectric(cos_i, 1 / GLASS)
    assert optics.fresnel_dielectric(cos_t, GLASS) == pytest.approx(entering, abs=1e-9)


# --- Absorption -----------------------------------------------------------------------------------------------------


def test_transmittance_is_the_colour_at_its_distance_and_squares_when_doubled() -> None:
    color = np.array([[0.8, 0.5, 0.02], [1.0, 0.0, 0.3]])
    once = optics.transmittance(color, [0.4, 2.0], [0.4, 2.0])
    assert once == pytest.approx(color, abs=1e-6)
    path_length = np.array([0.1, 3.0])
    single = optics.transmittance(color, 0.4, path_length)
    assert optics.transmittance(color, 0.4, 2.0 * path_length) == pytest.approx(single**2, abs=1e-12)


def test_transmittance_never_exceeds_one_and_is_one_without_a_path() -> None:
    assert np.all(optics.transmittance([1.0, 1.0, 1.0], 1e-3, np.array([0.0, 1.0, 1e6])) == 1.0)
    assert np.all(optics.transmittance([0.0, 0.3, 1.0], 1.0, 0.0) == 1.0)
    assert np.all(optics.transmittance([0.0, 0.3, 1.0], math.inf, 5.0) == 1.0)
    black = optics.transmittance([0.0, 0.0, 0.0], 1.0, 1.0)
    assert black == pytest.approx(2.0**-24, rel=1e-6)


# --- Models ---------------------------------------------------------------------------------------------------------

# The fact sheet's table: n, angle | sphere: path, P1.x, P1.z, R2.x, R2.z, deviation [deg] | box: path, P1.x
MODELS = np.array(
    [
        [1.0, 30, 0.86603, -0.43301, -0.75000, -0.50000, -0.86603, 0.000, 1.15470, -0.57735],
        [1.33, 30, 0.92664, -0.34836, -0.85867, -0.24471, -0.96960, 15.835, 1.07916, -0.40570],
        [1.33, 60, 0.75895, -0.49419, -0.57601, -0.36254, -0.93197, 38.744, 1.31761, -0.85796],
        [1.5, 0, 1.00000, 0.00000, -1.00000, 0.00000, -1.00000, 0.000, 1.00000, 0.00000],
        [1.5, 30, 0.94281, -0.31427, -0.88889, -0.15544, -0.98784, 21.058, 1.06066, -0.35355],
        [1.5, 60, 0.81650, -0.47140, -0.66667, -0.18273, -0.98316, 49.471, 1.22474, -0.70711],
        [1.5, 85, 0.74762, -0.49651, -0.55893, 0.03087, -0.99952, 86.769, 1.33758, -0.88833],
        [2.41, 60, 0.93320, -0.33534, -0.87087, 0.30702, -0.95170, 77.880, 1.07158, -0.38507],
    ]
)


@pytest.mark.parametrize("row", MODELS)
def test_one_interface_turns_light_as_the_sphere_does_on_its_way_in(row: F64) -> None:
    """By the fact sheet's table: from the entry at 0 the ball's light comes to P1, and one interface sends it there."""
    ior, angle, path, x, z = row[:5]
    wo = (math.sin(math.radians(angle)), 0.0, math.cos(math.radians(angle)))
    length, leave, out = single_model((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), wo, ior, 1.0)
    assert (length, leave) == (0.0, (0.0, 0.0, 0.0))
    assert np.array(out) * path == pytest.approx([x, 0.0, z], abs=2e-5)


def test_model_vectors_of_the_fact_sheet() -> None:
    wo = np.stack([towards(a) for a in MODELS[:, 1]])
    ball = optics.sphere_model(np.zeros(3), UP, wo, MODELS[:, 0], 1.0)
    found = np.column_stack([ball.path_length, ball.point[:, [0, 2]], ball.direction[:, [0, 2]]])
    assert found == pytest.approx(MODELS[:, 2:7], abs=1e-5)
    deviation = np.degrees(np.arccos(np.clip(-np.sum(wo * ball.direction, axis=1), -1.0, 1.0)))
    assert deviation == pytest.approx(MODELS[:, 7], abs=1e-3)
    slab = optics.box_model(np.zeros(3), UP, wo, MODELS[:, 0], 1.0)
    assert np.column_stack([slab.path_length, slab.point[:, 0]]) == pytest.approx(MODELS[:, 8:], abs=1e-5)
    assert slab.point[:, 2] == pytest.approx(-1.0)
    assert slab.direction == pytest.approx(-wo)


@pytest.mark.parametrize("ior", [1.0, 1.33, 1.5, 2.41])
def test_sphere_model_is_a_true_ball(ior: float) -> None:
    centre, radius = np.array([0.3, -2.0, 1.0]), 0.35
    wo = unit_vectors(300, 9)
    normals = facing(unit_vectors(300, 10), -wo)
    points = centre + radius * normals
    path_length, point, direction = optics.sphere_model(points, normals, wo, ior, 2.0 * radius)
    for k in range(len(wo)):
        chord, end, leaving = oracle_ball(points[k], -wo[k], centre, radius, ior)
        assert path_length[k] == pytest.approx(chord, abs=1e-9)
        assert point[k] == pytest.approx(end, abs=1e-9)
        # asin in the oracle loses half the digits where the ray grazes.
        assert direction[k] == pytest.approx(leaving, abs=1e-6)


def test_sphere_model_is_exact_at_grazing_angles() -> None:
    wo = np.stack([towards(a) for a in (89.0, 89.99, 89.99999, 90.0)])
    ball = optics.sphere_model(np.zeros(3), UP, wo, GLASS, 1.0)
    turned = 2.0 * (np.radians([89.0, 89.99, 89.99999, 90.0]) - np.arcsin(wo[:, 0] / GLASS))
    assert -np.sum(wo * ball.direction, axis=1) == pytest.approx(np.cos(turned), abs=1e-9)


def test_ball_lens_focuses_three_quarters_of_its_diameter_from_its_centre() -> None:
    height, diameter = 1e-4, 2.0
    normal = np.array([height, 0.0, math.sqrt(1.0 - height * height)])
    _, point, direction = optics.sphere_model(normal, normal, UP, GLASS, diameter)
    focus = point[2] - point[0] * direction[2] / direction[0]
    assert -focus == pytest.approx(0.75 * diameter, rel=1e-6)


@pytest.mark.parametrize("angle", [0.0, 20.0, 45.0, 75.0])
def test_slab_shifts_by_the_closed_form(angle: float) -> None:
    thickness, wo = 0.3, towards(angle)
    _, point, direction = optics.box_model(np.zeros(3), UP, wo, GLASS, thickness)
    theta_i = math.radians(angle)
    theta_t = math.asin(math.sin(theta_i) / GLASS)
    shift = np.linalg.norm(np.cross(point, direction))
    assert shift == pytest.approx(thickness * math.sin(theta_i - theta_t) / math.cos(theta_t), abs=1e-12)
    assert direction == pytest.approx(-wo)


def test_thin_is_a_slab_of_five_millimetres() -> None:
    wo = np.stack([towards(a) for a in (0.0, 40.0, 80.0)])
    thin = optics.thin_model(np.ones(3), UP, wo, GLASS)
    assert thin.point[:, 2] == pytest.approx(1.0 - 0.005)
    assert thin.path_length[0] == pytest.approx(0.005)
    assert thin.direction == pytest.approx(-wo)


@pytest.mark.parametrize("model", [optics.sphere_model, optics.box_model])
def test_models_turn_the_normal_and_clamp_the_ior(model: Model) -> None:
    wo = np.stack([towards(a) for a in (10.0, 60.0)])
    for (turn, low), clean in (((-1.0, GLASS), GLASS), ((1.0, 0.5), 1.0)):
        found, expected = model(np.zeros(3), turn * UP, wo, low, 1.0), model(np.zeros(3), UP, wo, clean, 1.0)
        for a, b in zip(found, expected, strict=True):
            assert np.array_equal(a, b)


@pytest.mark.parametrize("model", [optics.sphere_model, optics.box_model])
def test_ior_one_goes_straight_through(model: Model) -> None:
    wo = unit_vectors(200, 11)
    path_length, point, direction = model(np.zeros(3), unit_vectors(200, 12), wo, 1.0, 1.0)
    assert direction == pytest.approx(-wo, abs=1e-12)
    assert point == pytest.approx(-wo * path_length[:, None], rel=1e-9, abs=1e-12)


# --- Shapes ---------------------------------------------------------------------------------------------------------


def test_leading_shapes_broadcast() -> None:
    wo = unit_vectors(6, 13).reshape(2, 3, 3)
    ball = optics.sphere_model(np.zeros(3), wo, wo, np.array([[1.2], [1.5]]), 1.0)
    assert (ball.path_length.shape, ball.point.shape) == ((2, 3), (2, 3, 3))
    assert optics.reflect(-UP, UP).shape == (3,)
    assert optics.refract(np.empty((0, 3)), UP, 1.5).direction.shape == (0, 3)


def test_wrong_shapes_name_the_argument() -> None:
    with pytest.raises(UsageError, match=r"normal has shape \(2,\)"):
        optics.reflect(UP, np.zeros(2))
    with pytest.raises(UsageError, match="numbers of rays disagree"):
        optics.refract(np.zeros((4, 3)), UP, np.ones(3))
