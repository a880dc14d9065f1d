"""The command's words: which calls they become, what is refused before any work, exit codes, and silence elsewhere."""

from __future__ import annotations

import importlib
import json
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import refract_core as rc
from refract_core.cli import app
from refract_core.errors import Cancelled, SceneError, UsageError
from refract_core.images.pictures import read_texture
from refract_core.progress import COMPILING, reporting
from refract_core.scene import Notice

ROOT = Path(__file__).parents[1]


@dataclass
class Engine:
    """Stands for the rooms below: notes what they are asked, and answers with a small grey picture."""

    stages: list[str] = field(default_factory=list)
    scenes: list[dict[str, Any]] = field(default_factory=list)
    settings: list[rc.RenderSettings] = field(default_factory=list)
    settings_prims: list[str] = field(default_factory=list)
    authored: dict[str, object] = field(default_factory=dict)
    during: Callable[[Callable[[], bool]], None] = lambda _cancel: None

    def open_stage(self, path: str, _opening: object = None) -> str:
        self.stages.append(path)
        return path

    def read_settings(
        self, _stage: str, prim_path: str = "", _notices: object = None, *, products: bool = False
    ) -> dict[str, object]:
        assert products
        self.settings_prims.append(prim_path)
        return self.authored

    def scene_from_stage(self, _stage: str, **options: Any) -> rc.Scene:
        self.scenes.append(options)
        return rc.Scene((), (), notices=(Notice("/World/Glass", "is guessed"),))

    def render(
        self,
        scene: rc.Scene,
        settings: rc.RenderSettings | None = None,
        *,
        progress: Callable[[float, str], None] | None = None,
        cancel: Callable[[], bool] | None = None,
        session: rc.Session | None = None,
        watch: object = None,
        scene_at: Callable[[float], rc.Scene] | None = None,
    ) -> rc.Frame:
        assert settings is not None
        assert progress is not None
        assert cancel is not None
        self.settings.append(settings)
        progress(0.5, "image")
        self.during(cancel)
        planes = {"beauty": np.full((2, 3, 4), 0.5, np.float32), "Z": np.ones((2, 3), np.float32)}
        return rc.Frame(3, 2, planes, notices=scene.notices)


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> Engine:
    engine = Engine()
    stage = importlib.import_module("refract_core.usd.stage")
    monkeypatch.setattr(stage, "open_stage", engine.open_stage)
    monkeypatch.setattr(stage, "scene_from_stage", engine.scene_from_stage)
    monkeypatch.setattr(importlib.import_module("refract_core.usd.settings"), "read_settings", engine.read_settings)
    products = importlib.import_module("refract_core.usd.products")
    monkeypatch.setattr(products, "read_products", lambda *_: [])
    monkeypatch.setattr(importlib.import_module("refract_core.rendering.picture"), "render", engine.render)
    return engine


@dataclass(frozen=True)
class Ended:
    code: int
    out: str
    err: str


def refract(*words: object) -> Ended:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return Ended(result.exit_code, result.stdout, result.stderr)


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


# --- words to calls


def test_without_flags_the_defaults_are_rendered(engine: Engine, tmp_path: Path) -> None:
    assert refract("render", "a.usda", tmp_path / "a.png").code == 0
    assert engine.settings == [rc.RenderSettings()]
    assert engine.stages == ["a.usda"]
    plain = {"time_code": None, "purposes": ("default", "render"), "camera": "", "complexity": "low", "pixels": 960}
    assert engine.scenes == [plain]
    assert files(tmp_path) == ["a.png"]


def test_every_flag_reaches_its_setting(engine: Engine, tmp_path: Path) -> None:
    words = "--camera /Cam -w 40 --image-height 30 --samples 9 --tiers ray,sky --screen proxy --model box "
    words += "--max-layers 2 --purposes guide,default --exposure -1.5 --disable-camera-light --jobs 2 --tile-size 32 "
    words += "--disable-motion-blur "
    words += "--render-settings-prim-path /Render/A"
    assert refract("render", "a.usda", tmp_path / "a.png", *words.split()).code == 0
    assert engine.settings == [
        rc.RenderSettings(
            camera="/Cam",
            image_width=40,
            image_height=30,
            samples=9,
            tiers=("ray", "sky"),
            screen="proxy",
            model="box",
            max_layers=2,
            exposure=-1.5,
            motion_blur=False,
            camera_light=False,
            purposes=("default", "guide"),
            jobs=2,
            tile_size=32,
        )
    ]
    assert engine.scenes[0]["camera"] == "/Cam"
    assert engine.scenes[0]["purposes"] == ("default", "guide")
    assert engine.settings_prims == ["/Render/A"]


def test_flags_win_over_the_stage_and_the_stage_over_defaults(engine: Engine, tmp_path: Path) -> None:
    engine.authored = {"samples": 7, "image_width": 200, "image_height": 100, "camera": "/Stage/Cam"}
    assert refract("render", "a.usda", tmp_path / "a.png", "--samples", 2).code == 0
    chosen = engine.settings[0]
    assert (chosen.samples, chosen.image_width, chosen.image_height, chosen.camera) == (2, 200, 100, "/Stage/Cam")
    assert engine.scenes[0]["camera"] == "/Stage/Cam"


def test_a_width_alone_keeps_the_cameras_aspect(engine: Engine, tmp_path: Path) -> None:
    engine.authored = {"image_width": 200, "image_height": 100}
    refract("render", "a.usda", tmp_path / "a.png", "-w", 50)
    assert (engine.settings[0].image_width, engine.settings[0].image_height) == (50, 0)


def test_a_sequence_renders_each_frame_to_its_file(engine: Engine, tmp_path: Path) -> None:
    assert refract("render", "a.usda", tmp_path / "a.###.exr", "-f", "9:11,20").code == 0
    assert files(tmp_path) == ["a.009.exr", "a.010.exr", "a.011.exr", "a.020.exr"]
    assert [scene["time_code"] for scene in engine.scenes] == [9.0, 10.0, 11.0, 20.0]
    assert len(engine.stages) == 1


def test_skip_existing_leaves_files_and_may_leave_nothing_to_do(engine: Engine, tmp_path: Path) -> None:
    (tmp_path / "a.1.png").write_text("mine")
    assert refract("render", "a.usda", tmp_path / "a.#.png", "-f", "1:2", "--skip-existing").code == 0
    assert [scene["time_code"] for scene in engine.scenes] == [2.0]
    assert refract("render", "a.usda", tmp_path / "a.#.png", "-f", "1:2", "--skip-existing").code == 0
    assert len(engine.stages) == 1
    assert (tmp_path / "a.1.png").read_text() == "mine"


def test_how_many_pictures_are_skipped_is_told_once(engine: Engine, tmp_path: Path) -> None:
    (tmp_path / "a.2.png").write_text("mine")
    ended = refract("render", "a.usda", tmp_path / "a.#.png", "-f", "1:3", "--skip-existing")
    assert ended.code == 0
    assert [line for line in ended.err.splitlines() if "pictures exist" in line] == ["1 of 3 pictures exist, skipped"]


def test_a_picture_on_stdout_is_never_there_before(engine: Engine) -> None:
    ended = refract("render", "a.usda", "-", "--skip-existing")
    assert (ended.code, engine.stages) == (2, [])
    assert "--skip-existing" in ended.err


def test_color_correction_and_aovs_reach_the_file(engine: Engine, tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    for mode, byte in (("sRGB", 255), ("disabled", 255)):
        assert refract("render", "a.usda", path, "--color-correction-mode", mode).code == 0
        pixels = read_texture(str(path), name="a", color_space="raw").pixels
        assert pixels[0, 0].tolist() == [byte, byte, byte, 128]  # 0.5 premultiplied by 0.5 is white
    assert refract("render", "a.usda", path, "--aovs", "Z").code == 0
    assert (read_texture(str(path), name="a", color_space="raw").pixels == 255).all()


# --- what it says


def test_warnings_come_once_and_nothing_goes_to_stdout(engine: Engine, tmp_path: Path) -> None:
    ended = refract("render", "a.usda", tmp_path / "a.#.png", "-f", "1:3")
    assert ended.out == ""
    assert ended.err.startswith("warning: /World/Glass: is guessed\n")
    assert ended.err.count("warning:") == 1


def test_without_a_terminal_only_the_long_wait_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with reporting("auto") as report:
        for stage in ("reading the stage", COMPILING, COMPILING, "image"):
            report.progress(0.5, stage)
    assert capsys.readouterr().err == f"{COMPILING}\n"
    with reporting("none") as report:
        report.progress(0.5, COMPILING)
    assert capsys.readouterr().err == ""


def test_json_progress_is_one_object_per_line(engine: Engine, tmp_path: Path) -> None:
    ended = refract("render", "a.usda", tmp_path / "a.#.png", "-f", "1:2", "--progress", "json")
    events = [json.loads(line) for line in ended.err.splitlines()]
    fractions = [event["fraction"] for event in events if event["event"] == "progress"]
    assert fractions == sorted(fractions)
    assert {0.25, 0.75} <= set(fractions)  # half of each of two frames
    assert [e["text"] for e in events if e["event"] == "warning"] == ["is guessed"]
    assert [e["path"] for e in events if e["event"] == "done"] == [str(tmp_path / f"a.{n}.png") for n in (1, 2)]


def test_json_errors_are_objects_too(engine: Engine, tmp_path: Path) -> None:
    ended = refract("render", "a.usda", tmp_path / "a.png", "--progress", "json", "--samples", 0)
    assert ended.code == 2
    assert json.loads(ended.err)["event"] == "error"


def test_complexity_goes_to_the_reader(engine: Engine, tmp_path: Path) -> None:
    assert refract("render", "a.usda", tmp_path / "a.png", "--complexity", "high").code == 0
    assert [how["complexity"] for how in engine.scenes] == ["high"]


# --- refused before any work


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a.png", "--samples", "0"], "--samples is 0"),
        (["a.png", "-w", "0"], "--image-width is 0"),
        (["a.png", "--tiers", "screen,moon"], "moon"),
        (["a.png", "--tiers", ""], "tiers is empty"),
        (["a.png", "--screen", "guess"], "march, proxy, traced"),
        (["a.png", "--model", "ball"], "sphere"),
        (["a.png", "--exposure", "nan"], "exposure"),
        (["a.png", "--purposes", "all"], "guide"),
        (["a.png", "--progress", "loud"], "auto, lines, json, none"),
        (["a.png", "--complexity", "extreme"], "veryhigh"),
        (["a.png", "--color-correction-mode", "gamma"], "openColorIO"),
        (["a.png", "--aovs", "N,Z"], "one AOV"),
        (["a.exr", "--aovs", "depth"], "beauty"),
        (["a.docx"], ".exr, .png"),
        (["a.###.png"], "--frames"),
        (["a.png", "-f", "1:2"], "###"),
        (["a.##.##x#.png", "-f", "1:2"], "exactly one"),
        (["a.###.png", "-f", "1:2x0.5"], "decimals"),
        (["a.###.png", "-f", "one"], "'one' is not a frame range"),
        (["a.png", "--caustics", "some"], "--caustics is 'some'; it must be on, off, or a number of photons"),
        (["a.png", "--caustics", "-5"], "--caustics is -5; it must be between 0 and 16777216"),
    ],
)
def test_wrong_words_are_exit_code_2_before_the_stage_opens(
    engine: Engine, tmp_path: Path, words: list[str], message: str
) -> None:
    ended = refract("render", "a.usda", tmp_path / words[0], *words[1:])
    assert ended.code == 2
    assert ended.err.startswith("error: ")
    assert message in ended.err
    assert len(ended.err.splitlines()) == 1
    assert not engine.stages
    assert not files(tmp_path)


def test_an_unknown_flag_or_command_is_exit_code_2() -> None:
    assert refract("render", "a.usda", "a.png", "--reference").code == 2
    assert refract("paint").code == 2


def test_a_place_that_cannot_be_written_is_found_before_the_stage_opens(engine: Engine, tmp_path: Path) -> None:
    ended = refract("render", "a.usda", tmp_path / "missing" / "a.png")
    assert ended.code == 2
    assert "make it first" in ended.err
    assert not engine.stages


# --- ends


@pytest.mark.parametrize(("error", "code"), [(SceneError, 1), (UsageError, 2), (Cancelled, 3), (MemoryError, 1)])
def test_each_error_has_its_exit_code_and_leaves_no_file(
    engine: Engine, tmp_path: Path, error: type[Exception], code: int
) -> None:
    def fail(_cancel: Callable[[], bool]) -> None:
        raise error("the mesh is bent")

    engine.during = fail
    ended = refract("render", "a.usda", tmp_path / "a.png")
    assert ended.code == code
    assert ended.err.splitlines()[-1].startswith("error: ")
    assert not files(tmp_path)


def test_ctrl_c_asks_first_and_leaves_no_file(engine: Engine, tmp_path: Path) -> None:
    def interrupted(cancel: Callable[[], bool]) -> None:
        assert not cancel()
        signal.raise_signal(signal.SIGINT)
        assert cancel()
        raise Cancelled("cancelled; nothing was written")

    engine.during = interrupted
    before = signal.getsignal(signal.SIGINT)
    ended = refract("render", "a.usda", tmp_path / "a.png")
    assert ended.code == 3
    assert "cancelled" in ended.err
    assert not files(tmp_path)
    assert signal.getsignal(signal.SIGINT) is before


def test_ctrl_c_after_the_last_tile_still_writes_nothing(engine: Engine, tmp_path: Path) -> None:
    engine.during = lambda _cancel: signal.raise_signal(signal.SIGINT)
    assert refract("render", "a.usda", tmp_path / "a.png").code == 3
    assert not files(tmp_path)


def test_a_second_ctrl_c_does_not_wait(engine: Engine, tmp_path: Path) -> None:
    def interrupted(_cancel: Callable[[], bool]) -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        pytest.fail("the second one should have stopped this")

    engine.during = interrupted
    assert refract("render", "a.usda", tmp_path / "a.png").code == 3
    assert not files(tmp_path)


# --- the command and the package in a fresh process


def python(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False, cwd=ROOT)


def test_help_and_version_load_no_engine() -> None:
    for words in ('"--help"', '"render", "--help"', '"--version"'):
        code = (
            "import sys\nfrom refract_core.cli import main\n"
            f"sys.argv = ['refract', {words}]\n"
            "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code\n"
            "loaded = {'pxr', 'numba', 'OpenImageIO'} & set(sys.modules)\nassert not loaded, loaded\n"
        )
        ended = python("-c", code)
        assert ended.returncode == 0, ended.stderr
        assert ended.stdout


def test_the_module_runs_as_the_command() -> None:
    ended = python("-m", "refract_core.cli", "--version")
    assert ended.stdout == f"refract {rc.__version__}\n"
    ended = python("-m", "refract_core.cli", "render", "no-such-stage.usda", "a.png")
    assert ended.returncode == 1
    assert ended.stderr.startswith("error: no-such-stage.usda")


def test_the_package_alone_loads_no_library() -> None:
    code = "import sys, refract_core; print({'pxr', 'numba', 'OpenImageIO'} & set(sys.modules))"
    assert python("-c", code).stdout == "set()\n"


def test_every_public_name_is_there_and_render_stays_the_function() -> None:
    code = """
import refract_core as rc
import refract_core.rendering.picture
assert rc.__all__ == sorted(rc.__all__)
for name in rc.__all__:
    getattr(rc, name)
assert set(rc.__all__) <= set(dir(rc))
assert callable(rc.render) and callable(rc.load_stage)
from refract_core import render
assert render is rc.render
try:
    rc.paint
except AttributeError as error:
    print(error)
"""
    ended = python("-c", code)
    assert ended.stderr == ""
    assert "'paint'" in ended.stdout
