"""Planar probes: what a window shows is what rays would have found."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import ROOM, camera, draw, glass, position_room, quad, scene, turned, view_rays, wall_hit, where

from refract_core.scene import Camera, Model, Probe, Scene, Volume

F64 = NDArray[np.float64]

PANE = 1.2
"""Half size of the pane [m]."""


def pane(turn: F64, height: float = 0.0) -> Any:
    """A thin pane in the plane z = height of a turned frame."""
    corners = np.array([[-PANE, -PANE, height], [PANE, -PANE, height], [PANE, PANE, height], [-PANE, PANE, height]])
    return quad("/pane", corners @ turn.T, 1)


def window(turn: F64, half: tuple[float, float, float] = (PANE, PANE, 0.5), **fields: Any) -> Probe:
    frame = np.eye(4)
    frame[:3, :3] = turn
    room = Volume(np.eye(4), False, (ROOM,) * 3)
    chosen = {"resolution": 256, "clipping": (0.01, 100.0), "planar": True, **fields}
    return Probe("/window", "realtime", (0.0, 0.0, 0.0), Volume(frame, False, half), room, **chosen)


def in_room(probe: Probe | None, turn: F64, lens: Camera, model: Model = Model.THIN) -> Scene:
    walls, materials = position_room()
    probes = (probe,) if probe else ()
    return scene([*walls, pane(turn)], [*materials, glass(model, 1.5)], cameras=(lens,), probes=probes)


TURNS = {"table": turned((1, 0, 0), -90), "leaning": turned((1, 0.3, 0), -60)}
LENSES = {
    "perspective": camera((0.3, 1.4, 2.4), (0, -0.2, 0), 0.5),
    "orthographic": camera((0.3, 1.4, 2.4), (0, -0.2, 0), 1.0, orthographic=True),
}


@pytest.mark.parametrize("turn", TURNS.values(), ids=TURNS.keys())
@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES.keys())
@pytest.mark.parametrize("part", ["reflection", "refraction"])
def test_a_window_shows_what_a_ray_finds(turn: F64, lens: Camera, part: str) -> None:
    """A flat pane in the window's plane: both the mirrored and the transmitted picture are the ray tier's own.
    The room's colour is linear in place, so a texel is right to its size seen from the wall: a few mm of 3 m."""
    by_window = draw(in_room(window(turn), turn, lens), 96, 96, tiers=("probe",))
    by_ray = draw(in_room(None, turn, lens), 96, 96, tiers=("ray",))
    here = by_window["weight.probe"] > 0.999
    assert here.mean() > 0.08
    error = np.abs(by_window[part] - by_ray[part]).max(-1)[here]
    scale = by_ray[part].max()
    assert np.median(error) < 2e-4 * scale
    assert np.quantile(error, 0.98) < 0.02 * scale  # a texel across an edge of the room may be off


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_eye_may_be_on_either_side(side: float) -> None:
    turn = TURNS["table"]
    lens = camera((0.2, side * 1.8, 1.6), (0, 0, 0), 0.5)
    by_window = draw(in_room(window(turn), turn, lens), 64, 64, tiers=("probe",))
    by_ray = draw(in_room(None, turn, lens), 64, 64, tiers=("ray",))
    here = by_window["weight.probe"] > 0.999
    assert here.mean() > 0.08
    for part in ("reflection", "refraction"):
        assert np.median(np.abs(by_window[part] - by_ray[part]).max(-1)[here]) < 2e-4


def test_things_before_the_plane_are_not_in_the_way() -> None:
    """The near plane is the window's own: a card between eye and pane hides the room from the camera, not from the
    window, and the mirrored picture sees the card where it is."""
    turn = TURNS["table"]
    lens = camera((0.0, 2.4, 1.6), (0, 0, 0), 0.4)
    below = quad("/below", [(-0.4, -1, -0.4), (0.4, -1, -0.4), (0.4, -1, 0.4), (-0.4, -1, 0.4)], 0)
    what = in_room(window(turn), turn, lens)
    hidden = draw(replace(what, meshes=(*what.meshes, replace(below, double_sided=True))), 64, 64, tiers=("probe",))
    clear = draw(what, 64, 64, tiers=("probe",))
    here = (clear["weight.probe"] > 0.999) & (hidden["weight.probe"] > 0.999)
    np.testing.assert_allclose(hidden["reflection"][here], clear["reflection"][here], atol=1e-6)
    assert np.abs(hidden["refraction"] - clear["refraction"])[here].max() > 0.05


def test_beyond_the_window_the_next_tier_is_asked() -> None:
    """Only a part of the pane has the window; where it does not answer, the ray tier does, whole."""
    turn = TURNS["table"]
    lens = LENSES["perspective"]
    picture = draw(in_room(window(turn, (0.5, 0.5, 0.3)), turn, lens), 96, 96, tiers=("probe", "ray"))
    here = picture["mask"] > 0
    probe, ray = picture["weight.probe"][here], picture["weight.ray"][here]
    np.testing.assert_allclose(probe + ray, 1.0, atol=1e-5)
    assert (probe > 0.99).mean() > 0.05
    assert (ray > 0.99).mean() > 0.3


def test_a_mirrored_picture_stands_where_the_mirror_says() -> None:
    """Straight reflection by hand: the colour tells the place on the wall where the mirrored view ray ends."""
    turn, lens = TURNS["table"], LENSES["perspective"]
    picture = draw(in_room(window(turn), turn, lens), 64, 64, tiers=("probe",))
    origin, d = view_rays(lens, 64, 64)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -origin[..., 1] / d[..., 1]
        met = origin + t[..., None] * d
    mirrored = d * np.array([1.0, -1.0, 1.0])
    with np.errstate(invalid="ignore"):
        expected = wall_hit(met, mirrored)
    here = (picture["weight.probe"] > 0.999) & (picture["mask"] > 0)
    cosine = np.abs(d[..., 1])
    eta = 1 / 1.5
    cos_t = np.sqrt(1 - eta**2 * (1 - cosine**2))
    rs, rp = (cosine - 1.5 * cos_t) / (cosine + 1.5 * cos_t), (1.5 * cosine - cos_t) / (1.5 * cosine + cos_t)
    f = (rs**2 + rp**2) / 2
    seen = where(picture["reflection"] / f[..., None])
    error = np.abs(seen - expected).max(-1)[here]
    assert here.mean() > 0.08
    assert np.median(error) < 0.01
