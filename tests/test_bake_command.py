"""`refract bake probes`: how it stops, what it refuses, and how a bake is found stale."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bake_studio import LEFT, RIGHT, Studio, probe_of, studio_in
from typer.testing import CliRunner

import refract_core as rc
from refract_core.cli import app
from refract_core.errors import Cancelled, ImageError, StageError
from refract_core.images.cubemaps import read_notes
from refract_core.probes.digest import probe_digest, stale_bakes
from refract_core.scene import Bake, Scene
from refract_core.usd.stage import load_stage
from refract_core.verbs import bake_probes as bake
from refract_core.verbs.bake_probes import Task, batches
from refract_core.version import __version__


@pytest.fixture
def studio(tmp_path: Path) -> Studio:
    return studio_in(tmp_path)


# --- stops


def test_cancel_leaves_out_as_it_was_and_the_next_run_goes_on(studio: Studio, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("refract_core.verbs.bake_probes._BATCH", 1)

    def stop() -> None:
        studio.cancelled = len(studio.captured) == 1

    studio.before = stop
    with pytest.raises(Cancelled):
        studio.bake()
    assert os.listdir(studio.folder / "out.probes") == ["World_Left.exr"]
    assert not studio.out().exists()
    studio.cancelled, studio.before = False, lambda: None
    studio.bake()
    assert studio.captured == [RIGHT]
    assert probe_of(studio.out(), LEFT).bake is not None


@pytest.mark.parametrize("extension", [".usda", ".usdz"])
def test_a_failure_leaves_nothing_behind(studio: Studio, extension: str) -> None:
    def fail() -> None:
        raise ImageError("no light")

    studio.before = fail
    with pytest.raises(ImageError, match="no light"):
        studio.bake(extension)
    assert os.listdir(studio.folder) == ["stage.usda"]


def test_many_probes_are_captured_a_few_at_a_time(studio: Studio) -> None:
    probe = probe_of(studio.stage, LEFT)
    for resolution, most in ((64, 16), (1024, 2), (4096, 1)):
        tasks = [Task(replace(probe, resolution=resolution), "", "") for _ in range(33)]
        sizes = [len(batch) for batch in batches(tasks)]
        assert max(sizes) == most
        assert sum(sizes) == 33


# --- stale


def test_each_time_code_is_read_once(studio: Studio) -> None:
    scene = load_stage(studio.stage)
    left = probe_of(studio.stage, LEFT)
    true = Bake(probe_digest(scene, left), __version__, 7.0)
    asked: list[float] = []

    def scene_at(when: float) -> Scene:
        asked.append(when)
        return scene

    probes = [
        replace(left, bake=one) for one in (true, true, replace(true, digest="0"), replace(true, time_code=9.0), None)
    ]
    assert [notice.path for notice in stale_bakes(probes, scene_at)] == [LEFT]
    assert asked == [7.0, 9.0]


SMOOTH = """def Mesh "Smooth" {
        int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
        int[] faceVertexIndices = [1, 3, 7, 5, 2, 0, 4, 6, 3, 2, 6, 7, 0, 1, 5, 4, 4, 5, 7, 6, 2, 3, 1, 0]
        point3f[] points = [(4, 0, 0), (5, 0, 0), (4, 1, 0), (5, 1, 0), (4, 0, 1), (5, 0, 1), (4, 1, 1), (5, 1, 1)]
    }
    """


def test_a_large_picture_has_finer_surfaces_and_its_bakes_are_still_true(
    studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    studio.stage.write_text(studio.stage.read_text().replace('def Cube "Box"', f'{SMOOTH}def Cube "Box"', 1))
    studio.bake()
    probe = probe_of(studio.out(), LEFT)
    assert probe_digest(load_stage(studio.out()), probe) != probe_digest(load_stage(studio.out(), pixels=2048), probe)
    planes = {"beauty": np.zeros((1, 1, 4), np.float32)}
    drawn: list[int] = []

    def render(scene: Scene, *_: Any, **__: Any) -> rc.Frame:
        drawn.append(max(len(mesh.triangles) for mesh in scene.meshes))
        return rc.Frame(1, 1, planes)

    monkeypatch.setattr("refract_core.rendering.picture.render", render)
    for width in (960, 2048):
        ended = CliRunner().invoke(app, ["render", str(studio.out()), str(studio.folder / "a.png"), "-w", str(width)])
        assert ended.exit_code == 0, ended.stderr
        assert LEFT not in ended.stderr
    assert drawn == [3072, 4 * 3072]


# --- the command


def run(*words: object) -> Any:
    return CliRunner().invoke(app, ["bake", "probes", *map(str, words)])


def test_the_command_bakes(studio: Studio, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bake, "capture_probes", studio.capture)
    ended = run(studio.stage, studio.out(), "--only", LEFT, "--resolution", 8, "--samples", 2, "--progress", "json")
    assert ended.exit_code == 0, ended.output
    assert '"path": "/World/Left"' in ended.stderr
    assert read_notes(str(studio.texture(LEFT)), "a")["samples"] == 2
    assert probe_of(studio.out(), LEFT).resolution == 8


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["--resolution", 4], 2, "between 8 and 4096"),
        (["--resolution", 0], 2, "between 8 and 4096"),
        (["--samples", 0], 2, "between 1 and 4096"),
        (["--jobs", -1], 2, "--jobs"),
        (["--layout", "dice"], 2, "strip, cross, latlong"),
        (["--force", "--skip-existing"], 2, "give one"),
        (["--only", "/Nowhere"], 2, "no such probe"),
    ],
)
def test_wrong_words_are_refused_before_anything_is_written(
    studio: Studio, words: list[object], code: int, message: str
) -> None:
    ended = run(studio.stage, studio.out(), *words)
    assert (ended.exit_code, message in ended.stderr) == (code, True), ended.stderr
    assert os.listdir(studio.folder) == ["stage.usda"]


def test_places_that_will_not_do(studio: Studio) -> None:
    assert run(studio.stage, studio.stage).exit_code == 2
    assert run(studio.stage, studio.folder / "missing" / "out.usda").exit_code == 2
    assert run(studio.folder / "missing.usda", studio.out()).exit_code == 1
    studio.out().write_text("#usda 1.0\n")
    ended = run(studio.stage, studio.out())
    assert ended.exit_code == 2
    assert "--overwrite" in ended.stderr
    studio.out().unlink()
    (studio.folder / "out.probes").write_text("a file")
    with pytest.raises(StageError, match=r"out\.probes"):
        studio.bake()
