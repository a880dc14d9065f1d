"""The Refract node as shipped, dispersion, thin walls and roughness against outside numbers."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from refract_core.optics import arrays as optics
from refract_core.optics import interface as scalar

UP = np.array([0.0, 0.0, 1.0])
UNTIMED = settings(deadline=None)  # the first example may compile


def towards(angle: float) -> NDArray[np.float64]:
    """Unit vector at `angle` [deg] from UP, towards the viewer."""
    return np.array([math.sin(math.radians(angle)), 0.0, math.cos(math.radians(angle))])


# --- The Refract node -----------------------------------------------------------------------------------------------


def test_node_intensity_of_the_fact_sheet() -> None:
    entering = optics.refract_node(-np.stack([towards(a) for a in (0, 30, 45, 60, 80)]), UP)
    assert entering.intensity == pytest.approx([0.96, 0.95996, 0.95793, 0.93, 0.59009], abs=1e-5)
    leaving = optics.refract_node(-np.stack([towards(a) for a in (0, 30, 41, 41.8)]), UP, 1.5, 1.0)
    assert leaving.intensity == pytest.approx([0.04, 0.05519, 0.37975, 0.89077], abs=1e-5)


@pytest.mark.parametrize(("critical", "intensity"), [(False, 0.0), (True, 1.0)])
def test_node_at_total_internal_reflection(critical: bool, intensity: float) -> None:
    i = -towards(45.0)
    node = optics.refract_node(i, UP, 1.5, 1.0, critical_angle=critical)
    assert node.intensity == intensity
    assert node.reflectance == 1.0
    assert node.transmittance == 0.0
    expected = [i[0], 0.0, -i[2]] if critical else [1.5 * i[0], 0.0, 0.0]
    assert node.refracted == pytest.approx(expected, abs=1e-12)
    null = optics.refract_node(i, UP, 1.5, 1.0, critical_angle=critical, null_on_tir=True)
    assert np.all(null.refracted == 0.0)
    assert null.intensity == intensity


def test_node_null_vector_changes_nothing_below_the_critical_angle() -> None:
    i = -np.stack([towards(a) for a in (0.0, 20.0, 41.8)])
    plain = optics.refract_node(i, UP, 1.5, 1.0)
    null = optics.refract_node(i, UP, 1.5, 1.0, null_on_tir=True)
    assert np.array_equal(plain.refracted, null.refracted)
    assert plain.refracted == pytest.approx(optics.refract(i, UP, 1.5).direction, abs=1e-12)


def test_node_shares_are_physical_on_both_sides() -> None:
    cosines = np.linspace(0.05, 1.0, 50)
    i = np.column_stack([np.sqrt(1.0 - cosines**2), 0.0 * cosines, -cosines])
    for source, medium in ((1.0, 1.5), (1.5, 1.0), (1.33, 1.33)):
        node = optics.refract_node(i, UP, source, medium)
        assert node.reflectance == pytest.approx(optics.fresnel_dielectric(cosines, source / medium), abs=1e-12)
        assert node.reflectance + node.transmittance == pytest.approx(1.0, abs=1e-12)


def test_node_clamps_iors_and_passes_nothing_through_a_wrong_normal() -> None:
    i = -towards(30.0)
    assert optics.refract_node(i, UP, 0.2, 1.5).refracted == pytest.approx(optics.refract_node(i, UP).refracted)
    assert optics.refract_node(i, -UP).intensity == 0.0


# --- Dispersion, thin walls, roughness ------------------------------------------------------------------------------


def test_dispersion_of_two_catalogue_glasses() -> None:
    # Crown n_d 1.52, V 59 and diamond 2.417, V 55: n_C, n_d, n_F.
    assert scalar.channel_iors(1.52, 59.0) == pytest.approx((1.51735, 1.52, 1.52616), abs=2e-5)
    assert scalar.channel_iors(2.417, 55.0) == pytest.approx((2.40925, 2.417, 2.43501), abs=2e-5)
    assert scalar.channel_iors(1.5, 0.0) == (1.5, 1.5, 1.5)


@UNTIMED
@given(ior=st.floats(1.0, 3.0), abbe=st.floats(10.0, 100.0))
def test_dispersion_keeps_the_abbe_number(ior: float, abbe: float) -> None:
    red, green, blue = scalar.channel_iors(ior, abbe)
    assert green == ior
    assert 1.0 <= red <= green <= blue
    assert (blue - red) * abbe == pytest.approx(ior - 1.0, abs=1e-9)


def test_transmitted_lobe_is_the_measured_width() -> None:
    assert scalar.transmitted_roughness(1.0, 1.5, False) == pytest.approx(0.408, abs=1e-3)
    # alpha_t / alpha behind two interfaces of n = 1.5, from the Monte Carlo of benchmarks/lobe.py
    for roughness, ratio in ((0.1, 0.4178), (0.3, 0.4136), (0.5, 0.3872), (0.7, 0.3216)):
        found = (scalar.transmitted_roughness(roughness, 1.5, True) / roughness) ** 2
        assert found == pytest.approx(ratio, rel=0.01)
    for two in (False, True):
        assert scalar.transmitted_roughness(0.7, 1.0, two) == 0.0
        assert scalar.transmitted_roughness(1.0, 4.0, two) <= 1.0


def test_hdrp_levels_of_the_fact_sheet() -> None:
    roughness = [0.0, 0.1, 0.25, 0.5, 0.75, 1.0]
    probe = [scalar.probe_lod_hdrp(r) for r in roughness]
    assert probe == pytest.approx([0.0, 0.978, 2.2875, 4.05, 5.2875, 6.0])
    screen = [scalar.screen_lod_hdrp(r, 10) for r in roughness]
    assert screen == pytest.approx([0.0, 0.4511, 1.4844, 3.6551, 6.1919, 9.0], abs=1e-4)
    assert scalar.screen_lod_hdrp(0.5, 0) == 0.0
    assert [scalar.probe_roughness_hdrp(lod) for lod in probe] == pytest.approx(roughness, abs=1e-9)
