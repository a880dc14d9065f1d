"""The tables of models and lights: every row is complete, and kernels choose by it what the row says."""

from __future__ import annotations

import math

import numpy as np
import pytest

from refract_core.kernels.choice import choice
from refract_core.kernels.compile import inlined, kernel
from refract_core.models import BY_TOKEN, LEAST_THICKNESS, MODELS, SHEET, Behind, Model, model_for
from refract_core.optics import models
from refract_core.scene import LightKind
from refract_core.usd.lights.read import ROWS as READ
from refract_core.world.lights import KINDS

P, N, WO = (0.1, 0.2, 0.3), (0.0, 0.0, 1.0), (0.6, 0.0, 0.8)


@inlined
def _sum(a: float, b: float) -> float:
    return a + b


@inlined
def _product(a: float, b: float) -> float:
    return a * b


@inlined
def _first(a: float, b: float) -> float:
    return a


_chosen = choice({3: _sum, 7: _product}, _first)


@kernel
def _answers(numbers, out):  # type: ignore[no-untyped-def]
    for i in range(len(numbers)):
        out[i] = _chosen(numbers[i], 2.0, 5.0)


def test_a_choice_calls_the_row_of_the_number_and_else_the_last() -> None:
    out = np.empty(5)
    _answers(np.array([7, 3, 0, 4, 7]), out)
    assert out.tolist() == [10.0, 7.0, 2.0, 2.0, 10.0]


def test_numbers_are_places_in_the_table_and_tokens_lead_back() -> None:
    """Kernels look columns up by number."""
    assert [int(model) for model in Model] == list(range(len(Model)))
    assert [BY_TOKEN[token] for token in MODELS] == list(Model)


@pytest.mark.parametrize("model", Model)
def test_every_model_has_a_function_or_follows_the_mesh(model: Model) -> None:
    assert (model in models.EXITS) is (model.behind not in (Behind.NOTHING, Behind.MESH))
    assert model.sized is (model.behind in (Behind.BALL, Behind.SLAB))
    assert models.is_walked(int(model)) is (model.behind is Behind.MESH)
    assert models.is_sheet(int(model)) is (model.behind is Behind.SHEET)


@pytest.mark.parametrize("model", models.EXITS)
def test_a_kernel_leaves_a_model_as_its_own_function_does(model: Model) -> None:
    assert models.exit_of(int(model), P, N, WO, 1.5, 0.3) == models.EXITS[model](P, N, WO, 1.5, 0.3)


def test_a_single_interface_refracts_and_leaves_where_it_is() -> None:
    """R = refract(D, N, n1 / n2) at the surface point (Arm). Sine 0.6 in front, 0.4 behind it."""
    length, leave, out = models.exit_of(int(Model.SINGLE), P, N, WO, 1.5, 0.3)
    assert (length, leave) == (0.0, P)
    assert out == pytest.approx((-0.4, 0.0, -math.sqrt(1 - 0.4**2)), abs=1e-15)


def test_without_a_model_light_goes_straight_on() -> None:
    assert models.exit_of(int(Model.NONE), P, N, WO, 1.5, 0.3) == (0.0, P, (-0.6, 0.0, -0.8))


def test_an_open_mesh_is_a_sheet_to_what_follows_the_mesh_alone() -> None:
    drawn = {model: [*Model][models.on_open_mesh(int(model))] for model in Model}
    assert {model for model in Model if drawn[model] is not model} == {model_for(Behind.MESH)}
    assert drawn[model_for(Behind.MESH)] is SHEET


@pytest.mark.parametrize("model", Model)
@pytest.mark.parametrize("authored", [0.0, 0.3, math.inf])
def test_a_fixed_thickness_wins_and_no_other_is_zero(model: Model, authored: float) -> None:
    thickness, distance = (f(int(model), authored) for f in (models.thickness_of, models.absorption_distance_of))
    if model.fixed_thickness:
        assert thickness == distance == model.fixed_thickness
    else:
        assert (thickness, distance) == (max(authored, LEAST_THICKNESS), authored)


def test_every_kind_of_light_shines_and_all_but_the_cameras_are_read() -> None:
    made = {LightKind.CAMERA, LightKind.GLOW, LightKind.BALL}
    assert set(KINDS) == set(LightKind) - {LightKind.GLOW}  # which is a tree
    assert {row.kind for row in READ.values()} == set(LightKind) - made
    assert {kind for kind in LightKind if not kind.usd_type} == made
    assert [kind for kind in LightKind if not kind.casts_shadow] == [LightKind.CAMERA]
