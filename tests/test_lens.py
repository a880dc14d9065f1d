"""Pictures through a lens: the disc that a point makes, what is in focus, and that a pinhole changes no bit."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import camera, draw, glass, material, quad, scene

import refract_core as rc
from refract_core.errors import StageError
from refract_core.progress import Report
from refract_core.rendering.picture import NOTHING_SEEN
from refract_core.scene import Camera, Environment, Model, Scene, Sphere
from refract_core.verbs.render_files import Order, render_files

pytestmark = pytest.mark.draws

FOCUS, RADIUS = 4.0, 0.1
EYE = camera((0, 0, 4), (0, 0, 0), 0.25)
LENS = replace(EYE, lens_radius=RADIUS, focus_distance=FOCUS)


def seen(what: Scene, of: Camera, **settings: object) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    return draw(replace(what, cameras=(of,)), 160, 160, **{"samples": 256, **settings})["beauty"]


def ball(depth: float, radius: float = 0.02) -> Scene:
    """Something small that glows on the axis, so far before the camera, in the dark."""
    glow = material("/glow", EMISSIVE=(1.0, 1.0, 1.0))
    return scene([], [glow], [Sphere("/ball", (0.0, 0.0, 4.0 - depth), radius, 0)])


@pytest.mark.parametrize("depth", [2.0, 3.0, 6.0, 12.0])
def test_a_point_out_of_focus_makes_the_disc_of_a_thin_lens(depth: float) -> None:
    """By second moments: a disc of radius c has c^2 / 2, and that of the ball adds up. The disc is as wide as
    A |d - f| / (d f), in a window at distance 1."""
    light = seen(ball(depth), LENS)[..., 0].astype(np.float64)
    y, x = np.mgrid[:160, :160] + 0.5 - 80.0
    assert (light * x).sum() / light.sum() == pytest.approx(0.0, abs=0.3)
    spread = (light * (x**2 + y**2)).sum() / light.sum()
    pixels = 160 / (2 * 0.25)
    disc = RADIUS * abs(depth - FOCUS) / (depth * FOCUS) * pixels
    own = 0.02 / depth * pixels
    assert spread == pytest.approx(disc**2 / 2 + own**2 / 2 + 1.0 / 6.0, rel=0.05)
    assert np.hypot(x, y)[light > 0.0].max() <= disc + own + 1.5
    sharp = seen(ball(depth), EYE)[..., 0].astype(np.float64)
    assert light.sum() == pytest.approx(sharp.sum(), rel=0.03)  # a lens spreads light, and loses none


def test_what_is_in_focus_is_sharp() -> None:
    light, sharp = (seen(ball(FOCUS, 0.3), of)[..., 0] for of in (LENS, EYE))
    assert np.abs(light - sharp).max() < 0.12  # at the rim, a lens looks a little around
    assert np.abs(light - sharp).mean() < 2e-3


def test_a_pinhole_and_one_sample_give_the_same_bits_with_and_without_a_focus() -> None:
    what = scene([quad("/wall", [(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1)], 0)],
                 [material("/wall", EMISSIVE=(0.3, 0.5, 0.7)), glass(Model.TRACED)],
                 [Sphere("/glass", (0.0, 0.0, 0.5), 0.4, 1)])  # fmt: skip
    for settings in ({"samples": 8}, {"samples": 8, "tolerance": 0.0}, {"samples": 1}):
        plain = seen(what, EYE, **settings)
        assert np.array_equal(plain, seen(what, replace(EYE, focus_distance=7.0), **settings))
    assert np.array_equal(seen(what, EYE, samples=1), seen(what, LENS, samples=1))
    assert not np.array_equal(seen(what, EYE, samples=8), seen(what, LENS, samples=8))


def test_glass_is_seen_through_a_lens() -> None:
    """A pane of glass of ior 1 is nothing: what stands behind it is blurred as if it were not there."""
    nothing = glass(Model.TRACED, 1.0)
    behind = ball(12.0, 0.2)
    before = replace(behind, materials=(*behind.materials, nothing),
                     spheres=(*behind.spheres, Sphere("/glass", (0.0, 0.0, 2.0), 0.6, 1)))  # fmt: skip
    plain, through = seen(behind, LENS, samples=64), seen(before, LENS, samples=64)
    assert np.abs(plain - through)[..., :3].max() <= 2.0 / 64  # at an edge a sample may fall to the other side
    assert np.abs(plain - through)[..., :3].mean() < 1e-4


def test_few_samples_through_a_lens_are_told() -> None:
    def said(of: Camera, samples: int) -> str:
        what = replace(ball(2.0), cameras=(of,))
        frame = rc.render(what, rc.RenderSettings(image_width=8, image_height=8, samples=samples, caustics=0))
        return " ".join(notice.text for notice in frame.notices)

    assert "from 16 points" in said(LENS, 16)
    assert "everything is in focus" in said(LENS, 1)
    assert not said(LENS, 64)
    assert not said(EYE, 16)


def test_a_picture_of_nothing_says_so() -> None:
    away = replace(EYE, world_from_camera=EYE.world_from_camera @ np.diag([-1.0, 1.0, -1.0, 1.0]))

    def said(of: Camera) -> bool:
        what = replace(ball(2.0, 0.5), cameras=(of,))
        frame = rc.render(what, rc.RenderSettings(image_width=16, image_height=16, samples=1, caustics=0))
        return any(notice.text.startswith(NOTHING_SEEN) for notice in frame.notices)

    assert said(away)
    assert not said(EYE)


def test_a_picture_far_above_white_says_what_exposure_shows_it() -> None:
    """As of files that count lights in watts. At the exposure that is named nothing is said, and the middle is grey."""
    for radiance in (0.5, 1e4):
        what = replace(ball(2.0), environment=Environment(np.full((4, 8, 3), radiance, np.float32)))

        def drawn(stops: float, what: Scene = what) -> rc.Frame:
            return rc.render(what, rc.RenderSettings(image_width=16, samples=1, caustics=0, exposure=stops))

        said = [notice.text for notice in drawn(0.0).notices if "--exposure" in notice.text]
        assert bool(said) == (radiance > 3.0)
        for text in said:
            seen = drawn(float(text.split("--exposure ")[1].split()[0]))
            assert not any("--exposure" in notice.text for notice in seen.notices)
            assert 0.1 < np.median(seen.planes["beauty"][..., :3]) < 1.0


def test_strict_fails_on_a_picture_of_nothing_and_writes_it_all_the_same(tmp_path: Path) -> None:
    """One camera has the ball behind it, the other before it."""
    stage = tmp_path / "away.usda"
    text = """#usda 1.0
        (
            metersPerUnit = 1
            upAxis = "Y"
        )
        def Sphere "Ball"
        {
        }
        def Camera "Cam"
        {
            double3 xformOp:translate = (0, 0, %s)
            uniform token[] xformOpOrder = ["xformOp:translate"]
        }
        """
    heard: list[str] = []
    report = Report(lambda *_: None, lambda _, said: heard.append(said), lambda *_: None, lambda _: None)
    for place, empty in (("-9", True), ("9", False)):
        stage.write_text(text % place, encoding="utf-8")
        for strict in (False, True):
            out = tmp_path / f"{place}{strict}.png"
            asked = Order(stage=str(stage), out=str(out), overrides={"image_width": 16, "samples": 1}, strict=strict)
            with pytest.raises(StageError, match="--strict") if strict and empty else nullcontext():
                render_files(asked, report, lambda: False)
            assert out.exists()
        assert any(said.startswith(NOTHING_SEEN) for said in heard) == empty
        heard.clear()
