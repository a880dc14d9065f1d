"""A turn: each picture is that of `render` from its side, made from what is prepared once; and files that turn."""

from __future__ import annotations

import gc
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageSequence
from scene_reading import CUBE, read
from typer.testing import CliRunner

import refract_core as rc
from refract_core.cli import app
from refract_core.images.pictures import read_planes
from refract_core.rendering import ready
from refract_core.rendering.ready import camera_of
from refract_core.usd import stage as reading
from refract_core.view.orbit import round_trip
from refract_core.world import tables

STAGE = """#usda 1.0
(
    metersPerUnit = 0.01
    upAxis = "Z"
)
def Cube "Long"
{
    color3f[] primvars:displayColor = [(0.2, 0.5, 0.9)]
    double3 xformOp:translate = (3, 4, 5)
    double3 xformOp:scale = (9, 1, 2)
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]
}
def Camera "Low"
{
    double3 xformOp:translate = (3, -60, 5)
    float xformOp:rotateX = 90
    uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:rotateX"]
}
"""
SMALL = ("-w", "33", "--samples", "1")


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    path = tmp_path / "stage.usda"
    path.write_text(STAGE)
    return path


def refract(*words: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, [str(word) for word in words])
    return done.exit_code, done.output


@pytest.mark.parametrize("how", [(), ("--camera", "Low"), ("--azimuth", "100", "--elevation", "50", "--fov", "30")])
def test_each_picture_is_that_of_render_from_its_side(stage: Path, how: tuple[str, ...]) -> None:
    folder = stage.parent
    code, said = refract("turntable", stage, folder / "t.##.exr", "--frames", 5, *how, *SMALL)
    assert code == 0, said
    assert len(list(folder.glob("t.*.exr"))) == 5
    start = {(): 30.0, ("--camera", "Low"): 0.0}.get(how, 100.0)
    scene = rc.load_stage(stage, camera="Low" if "--camera" in how else "")
    given = {"camera": "Low"} if "--camera" in how else {}
    if "--fov" in how:
        given |= {"azimuth": 100.0, "elevation": 50.0, "fov": 30.0}  # type: ignore[dict-item]
    settings: Any = {"image_width": 33, "samples": 1, **given}
    around = round_trip(scene, rc.RenderSettings(**settings), scene.cameras[0], 5)
    rest = [word for k, word in enumerate(how) if "--azimuth" not in how[max(0, k - 1) : k + 1]]
    for k, wanted in enumerate(around):
        assert wanted.azimuth == pytest.approx(start + 72.0 * k, abs=1e-6)
        away = () if wanted.distance is None else ("--distance", repr(wanted.distance))
        code, said = refract(
            "render", stage, folder / "one.exr", *rest, "--azimuth", repr(wanted.azimuth), *away, *SMALL
        )
        assert code == 0, said
        assert (folder / "one.exr").read_bytes() == (folder / f"t.{k + 1:02}.exr").read_bytes()
    seen = [read_planes(str(folder / f"t.{k:02}.exr"))["beauty"] for k in (1, 2)]
    assert (seen[0] != seen[1]).any()


def test_nothing_grows_as_it_turns_and_nothing_is_cut() -> None:
    scene = read(CUBE(extra='double3 xformOp:scale = (9, 1, 2)\nuniform token[] xformOpOrder = ["xformOp:scale"]'))
    settings = rc.RenderSettings(fit=1.0)
    around = round_trip(scene, settings, scene.cameras[0], 24)
    assert len({wanted.distance for wanted in around}) == 1
    points, most = scene.meshes[0].points.astype(np.float64), []
    for wanted in around:
        camera = camera_of(scene, wanted)
        at = (points - camera.world_from_camera[:3, 3]) @ camera.world_from_camera[:3, :3]
        most.append(np.abs(at[:, :2] / -at[:, 2:] / (camera.window[1], camera.window[3])).max())
    assert max(most) == pytest.approx(1.0, abs=1e-6)


def test_geometry_is_read_and_made_ready_once(stage: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = {"read": 0, "made": 0}

    def counted(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def counting(*arguments: Any, **named: Any) -> Any:
            calls[name] += 1
            return function(*arguments, **named)

        return counting

    monkeypatch.setattr(reading, "scene_from_stage", counted("read", reading.scene_from_stage))
    monkeypatch.setattr(ready, "pack_geometry", counted("made", tables.pack_geometry))
    assert refract("turntable", stage, stage.parent / "t.#.png", "--frames", 3, *SMALL)[0] == 0
    assert calls["made"] == 1
    assert calls["read"] <= 2  # to see how far away it must be, and to draw


@pytest.mark.parametrize("extension", ["gif", "webp"])
def test_one_file_turns(stage: Path, extension: str) -> None:
    out = stage.parent / f"t.{extension}"
    code, said = refract("turntable", stage, out, "--frames", 7, "--fps", 9, "--progress", "json", *SMALL)
    assert code == 0, said
    assert sorted(path.name for path in stage.parent.iterdir()) == ["stage.usda", out.name]
    assert said.count('"done"') == 1
    assert refract("turntable", stage, stage.parent / "t.#.png", "--frames", 7, *SMALL)[0] == 0
    with Image.open(out) as file:
        shown = [frame.convert("RGBA") for frame in ImageSequence.Iterator(file)]
        lengths = []
        for k in range(len(shown)):
            file.seek(k)
            file.load()
            lengths.append(file.info["duration"])
    assert len(shown) == 7
    assert sum(lengths) == pytest.approx(7000 / 9, abs=6)
    for k, frame in enumerate(shown):
        with Image.open(stage.parent / f"t.{k + 1}.png") as file:
            whole = np.asarray(file.convert("RGBA")).astype(float)
        got = np.asarray(frame).astype(float)
        there = whole[..., 3] >= 128
        assert ((got[..., 3] >= 128) == there).mean() > 0.98
        assert np.abs(got - whole)[there].mean() < 8.0


def test_a_video_turns(stage: Path) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    out = stage.parent / "t.mp4"
    code, said = refract("turntable", stage, out, "--frames", 6, *SMALL, "--image-height", 21)
    assert code == 0, said
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # of the package that reads it here
        frames = ffmpeg.read_frames(str(out))
        told = next(frames)
        count = len(list(frames))
        gc.collect()
    assert told["size"] == (34, 22)  # sides are even
    assert told["codec"] == "h264"
    assert count == 6


def test_without_its_extra_a_video_is_one_sentence(stage: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    code, said = refract("turntable", stage, stage.parent / "t.mp4", *SMALL)
    assert code == 2
    assert "pip install 'usd-refract[video]'" in said
    assert not (stage.parent / "t.mp4").exists()


@pytest.mark.parametrize(
    ("out", "words", "said"),
    [
        ("t.png", (), "one name for 36 pictures; put a #### group in it"),
        ("t.#.#.png", (), "needs one ### group; it has 2"),
        ("t.#.txt", (), "'.txt' is not a known image extension"),
        ("t.#.png", ("--frames", "0"), "--frames is 0; it must be between 1 and 10000"),
        ("t.gif", ("--fps", "0"), "--fps is 0.0; it must be between 1.0 and 50.0"),
        ("none/t.gif", (), "the folder"),
        ("t.#.png", ("--camera", "Nobody"), "camera 'Nobody' does not exist"),
        ("t.#.png", ("--time-code", "x"), "'x'"),
    ],
)
def test_what_cannot_be_is_said_in_one_sentence(stage: Path, out: str, words: tuple[str, ...], said: str) -> None:
    code, output = refract("turntable", stage, stage.parent / out, *words, *SMALL)
    assert code in (1, 2)
    assert said in output
    assert output.count("error") == 1
    assert [path.name for path in stage.parent.iterdir()] == ["stage.usda"]
