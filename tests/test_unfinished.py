"""Pictures before they are finished: the same in the end, true as far as they are, and whole when time is up."""

from __future__ import annotations

import math
import os
import signal
import threading
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import refract_core as rc
from refract_core.cli import app
from refract_core.cli.looks import shown_on_signal
from refract_core.errors import UsageError
from refract_core.images.frame import Frame
from refract_core.images.pictures import read_planes
from refract_core.rendering import unfinished
from refract_core.rendering.unfinished import FINISHED, Watch
from refract_core.scene import Scene
from refract_core.verbs.looks import check_unfinished, part_path

GOOD = Path(__file__).parents[1] / "usd_samples" / "good"
CORNERS: dict[str, Any] = {"image_width": 160, "caustics": 0, "samples": 4, "jobs": 1}
SAMPLES: dict[str, Any] = {**CORNERS, "tolerance": 0.0}


@cache
def marble() -> Scene:
    return rc.load_stage(GOOD / "marble.usda")


@cache
def whole(**how: Any) -> Frame:
    return rc.render(marble(), rc.RenderSettings(**how))


def same(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Where every number of a pixel is the same, to the bit; shape (H, W)."""
    equal = np.ascontiguousarray(a).view(np.uint32) == np.ascontiguousarray(b).view(np.uint32)
    return np.asarray(equal if equal.ndim == 2 else equal.all(axis=2))


@pytest.fixture
def stops_after_two(monkeypatch: pytest.MonkeyPatch) -> None:
    """Time is up when the first tile of the picture as asked is done; the second is still drawn."""
    over, seen, count = threading.Event(), threading.Event(), [0]
    noting = unfinished.Drawn.noting

    def is_over(_watch: Watch) -> bool:
        if over.is_set():
            seen.set()
        return over.is_set()

    def slowly(drawn: unfinished.Drawn, step: Any) -> Callable[[Any], int]:
        draw = noting(drawn, step)

        def one(item: Any) -> int:
            if step.samples == CORNERS["samples"]:
                count[0] += 1
                if count[0] == 2:
                    over.set()
                    assert seen.wait(60.0)
            return draw(item)

        return one

    monkeypatch.setattr(Watch, "is_over", is_over)
    monkeypatch.setattr(unfinished.Drawn, "noting", slowly)


@pytest.mark.parametrize("how", [CORNERS, SAMPLES], ids=["corners", "samples"])
def test_who_looks_changes_nothing_and_sees_what_will_be_there(how: dict[str, Any]) -> None:
    seen: list[Frame] = []
    watched = rc.render(marble(), rc.RenderSettings(**how), watch=Watch(wanted=lambda: True, take=seen.append))
    done = whole(**how)
    for name, plane in done.planes.items():
        assert same(watched.planes[name], plane).all(), name
    assert FINISHED not in watched.metadata
    assert seen
    for frame in seen:
        assert 0.0 <= float(frame.metadata[FINISHED]) < 1.0
        alpha = frame.planes["beauty"][..., 3]
        if how is CORNERS:  # as it will be, or not yet at all, but for lines behind glass, which are drawn last
            there = same(frame.planes["beauty"], done.planes["beauty"]) | (done.planes["mask"] > 0.0)
            assert (there | ~frame.planes["beauty"].any(axis=2)).all()
        else:
            assert (alpha == done.planes["beauty"][..., 3]).mean() > 0.9


def test_when_time_is_up_every_pixel_is_as_asked_or_of_one_sample(stops_after_two: None) -> None:
    frame = rc.render(marble(), rc.RenderSettings(**CORNERS), watch=Watch(deadline=1e18))
    assert any("stopped by its time limit" in notice.text for notice in frame.notices)
    assert 0.0 < float(frame.metadata[FINISHED]) < 1.0
    asked, once = whole(**CORNERS), whole(**{**CORNERS, "samples": 1})
    for name, plane in frame.planes.items():
        good = same(plane, asked.planes[name]) | (asked.planes["mask"] > 0.0)  # lines behind glass are drawn last
        assert (good | same(plane, once.planes[name])).all(), name
    patch = same(frame.planes["beauty"], asked.planes["beauty"])[:32, :32]
    assert patch.all()


def test_when_time_is_up_samples_that_are_there_are_the_picture(stops_after_two: None) -> None:
    frame = rc.render(marble(), rc.RenderSettings(**SAMPLES), watch=Watch(deadline=1e18))
    text = " ".join(notice.text for notice in frame.notices)
    done = whole(**SAMPLES)
    assert "it has 3 of the 4 samples asked for" in text
    assert float(frame.metadata[FINISHED]) == 0.75
    off = np.abs(frame.planes["beauty"] - done.planes["beauty"])
    assert off.mean() < 0.1 * done.planes["beauty"].mean()
    weights = sum(frame.planes[f"weight.{tier}"] for tier in ("screen", "ray", "probe", "sky", "none"))
    assert np.asarray(weights)[frame.planes["mask"] > 0.0] == pytest.approx(1.0, abs=1e-4)


def test_when_time_is_up_before_anything_is_as_asked_the_picture_has_one_sample(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[int] = []
    drawn = unfinished.Drawn.__init__

    def begun(self: unfinished.Drawn, *arguments: Any) -> None:
        made.append(1)
        drawn(self, *arguments)

    monkeypatch.setattr(unfinished.Drawn, "__init__", begun)
    monkeypatch.setattr(Watch, "is_over", lambda _watch: bool(made))
    frame = rc.render(marble(), rc.RenderSettings(**CORNERS), watch=Watch(deadline=1e18))
    once = whole(**{**CORNERS, "samples": 1})
    assert all(same(plane, once.planes[name]).all() for name, plane in frame.planes.items())
    assert float(frame.metadata[FINISHED]) == 0.0


def test_without_time_for_every_pixel_there_is_no_picture() -> None:
    with pytest.raises(rc.TimeUp, match="before every pixel"):
        rc.render(marble(), rc.RenderSettings(**CORNERS), watch=Watch(deadline=-math.inf))


# --- on the command line -----------------------------------------------------------------------------------------

MARBLE = GOOD / "marble.usda"
SMALL = ("-w", "160", "--samples", "4", "--caustics", "off", "--jobs", "1")


def refract(*words: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, [str(word) for word in words])
    return done.exit_code, done.output


def test_snapshots_lie_beside_the_picture_and_go_when_it_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    saved: list[tuple[str, list[str]]] = []
    save = Frame.save

    def noted(frame: Frame, path: Any, **how: Any) -> None:
        save(frame, path, **how)
        saved.append((Path(path).name, sorted(one.name for one in tmp_path.iterdir())))

    monkeypatch.setattr(Frame, "save", noted)
    code, said = refract("render", MARBLE, tmp_path / "shot.exr", "--snapshot", "1e-6", *SMALL)
    assert code == 0, said
    assert saved[0] == ("shot_part.exr", ["shot_part.exr"])
    assert saved[-1] == ("shot.exr", ["shot.exr", "shot_part.exr"])
    assert [one.name for one in tmp_path.iterdir()] == ["shot.exr"]
    assert part_path("a.b/c.d.exr") == "a.b/c.d_part.exr"


def test_a_stopped_picture_is_written_and_strict_fails(tmp_path: Path, stops_after_two: None) -> None:
    code, said = refract("render", MARBLE, tmp_path / "shot.exr", "--time-limit", "1e6", "--strict", *SMALL)
    assert code == 1
    assert "stopped by its time limit" in said
    assert "--strict does not let pass" in said
    assert np.isfinite(read_planes(str(tmp_path / "shot.exr"))["beauty"]).all()


def test_a_picture_without_time_leaves_nothing(tmp_path: Path) -> None:
    code, said = refract("render", MARBLE, tmp_path / "shot.png", "--time-limit", "1e-9", *SMALL)
    assert code == 1
    assert said.count("error") == 1
    assert "give it more time" in said
    assert list(tmp_path.iterdir()) == []


def test_a_signal_is_a_wish_to_look_once() -> None:
    with shown_on_signal() as asked:
        assert asked is not None
        assert not asked()
        os.kill(os.getpid(), signal.SIGUSR1)
        assert asked()
        assert not asked()
    assert signal.getsignal(signal.SIGUSR1) == signal.SIG_DFL


@pytest.mark.parametrize("seconds", [-1.0, math.nan, math.inf])
def test_seconds_that_cannot_be(seconds: float) -> None:
    with pytest.raises(UsageError, match="--time-limit is"):
        check_unfinished(seconds, 0.0, False)
    with pytest.raises(UsageError, match="--snapshot is"):
        check_unfinished(0.0, seconds, False)
    with pytest.raises(UsageError, match="leave --executor out"):
        check_unfinished(0.0, 1.0, True)
