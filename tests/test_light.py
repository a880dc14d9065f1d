"""The benchmark of all that light does once: its table, regions and arithmetic, and, where Mitsuba is, its truths."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import in_mitsuba, light, peers
from benchmarks.in_mitsuba import Light
from benchmarks.in_refract import scene_of
from benchmarks.truth import CHUNK
from benchmarks.two_rooms import table_room
from refract_core.errors import UsageError
from refract_core.scene import LightKind

pytestmark = pytest.mark.draws

SIZE = 64


def test_all_glass_on_the_table_is_closed_and_smooth() -> None:
    """Every edge has a partner the other way; a bent surface's normals lean by no more than its triangles are long."""
    for solid in (one for one in table_room().solids if one.finish.glass):
        order = solid.triangles.astype(np.int64)
        edges = np.concatenate([order[:, [0, 1]], order[:, [1, 2]], order[:, [2, 0]]])
        codes, back = (edge[:, 0] * len(solid.points) + edge[:, 1] for edge in (edges, edges[:, ::-1]))
        assert len(np.unique(codes)) == len(codes)
        assert set(codes.tolist()) == set(back.tolist())
        a, b, c = np.moveaxis(solid.points[solid.triangles].astype(np.float64), 1, 0)
        across = np.cross(b - a, c - a)
        assert (a * np.cross(b, c)).sum() > 0.0
        if solid.normals is not None:
            across /= np.linalg.norm(across, axis=1, keepdims=True)
            assert np.einsum("ti,tki->tk", across, solid.normals[solid.triangles]).min() > 0.98


def test_the_scene_has_three_kinds_of_lights_and_no_sky() -> None:
    scene = scene_of(table_room())
    assert [one.kind for one in scene.lights] == [LightKind.RECT, LightKind.SPHERE, LightKind.DISTANT]
    assert scene.environment is None


def test_regions_are_told_by_what_glass_does_to_light() -> None:
    straight = np.full((40, 40, 3), 0.3)
    once = straight.copy()
    once[:15, :15], once[:15, 25:] = 0.2, 0.5
    share = np.zeros((40, 40), np.float32)
    share[30:] = 0.5
    found = light.regions_of(share, straight, once)
    assert (np.sum([*found.values()], axis=0) == 1).all()
    assert found["shadow"][:15, :15].all()
    assert found["caustic"][:15, 25:].all()
    assert found["glass"][30:].all()
    assert found["receivers"][18:29].all()


def test_the_noise_of_a_truth_is_nobodys_error() -> None:
    """A picture 0.01 too bright as displayed, before two halves with noise of 0.02 each: 40 dB."""
    rng = np.random.default_rng(3)

    def linear(shown: Any) -> Any:
        return ((shown + 0.055) / 1.055) ** 2.4

    halves = linear(0.5 + rng.normal(0.0, 0.02, (2, 300, 300, 3)))
    picture = linear(np.full((300, 300, 3), 0.51))
    every = {"all": np.ones((300, 300), np.bool_), "none": np.zeros((300, 300), np.bool_)}
    found = peers.scores(picture, halves, every)
    assert found["all"] == pytest.approx(40.0, abs=0.3)
    assert math.isnan(found["none"])
    assert peers.scores(picture, halves.mean(0), every)["all"] < 36.0  # with it


# --- Beside Mitsuba -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mi() -> Any:
    """Mitsuba compiled by LLVM."""
    if importlib.util.find_spec("mitsuba") is None:
        pytest.skip("mitsuba is not installed")
    try:
        return in_mitsuba.library()
    except UsageError as error:
        pytest.skip(str(error))


def test_light_thrown_is_light_found(mi: Any) -> None:
    """From the lamps' side and from the eye's: what glass brings is the same, block by block, but for noise."""
    loaded = in_mitsuba.load(mi, table_room(), SIZE)
    found, thrown = (
        np.mean([in_mitsuba.draw(loaded, one, 256, seed) for seed in range(4)], 0) for one in (Light.ONCE, Light.THROWN)
    )
    np.testing.assert_allclose(thrown.mean((0, 1)), found.mean((0, 1)), rtol=4e-3)
    blocks = (found - thrown)[4:].reshape(4, 8, 8, 8, 3).mean((1, 3))
    assert np.abs(blocks).max() < 0.03


def test_a_small_run_prints_everything(mi: Any, tmp_path: Path) -> None:
    options = light.Options(
        SIZE, CHUNK, ("draft",), mitsuba=(1, 4), repeat=1, jobs=1, cache=tmp_path, pictures=tmp_path
    )
    found = light.measure(mi, options)
    rows = light.block(found, options).splitlines()
    names = [row.split("|")[1].split(",")[0].strip() for row in rows[4:-2]]
    assert names == ["refract", *["Mitsuba", "Mitsuba path"] * 2]
    assert (tmp_path / "draft.png").exists()
