"""What every command says and hears: closing lines, seconds, percent, defaults in the environment, words from files."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import test_cli
import typer
from test_cli import ROOT, Engine, files, refract
from typer.testing import CliRunner

import refract_core as rc
from refract_core.cli import app, stdout
from refract_core.cli.shell import variable_of
from refract_core.images.pictures import read_planes, read_texture
from refract_core.progress import COMPILING, reporting
from refract_core.verbs.orders import peak_memory

rooms = test_cli.engine


def lines(text: str) -> list[str]:
    return [line for line in text.splitlines() if not line.startswith("warning: ")]


# --- what it says


def test_a_picture_has_a_closing_line(rooms: Engine, tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    (line,) = lines(refract("render", "a.usda", path, "--samples", 4).err)
    assert re.fullmatch(rf"{re.escape(str(path))} 3x2, 4 samples, \d+\.\d s, \d+ MB", line)


def test_one_sample_is_not_samples(rooms: Engine, tmp_path: Path) -> None:
    (line,) = lines(refract("render", "a.usda", tmp_path / "a.png", "--samples", 1).err)
    assert ", 1 sample, " in line


def test_a_sequence_has_a_line_for_each_frame_and_one_for_all(rooms: Engine, tmp_path: Path) -> None:
    *frames, closing = lines(refract("render", "a.usda", tmp_path / "a.#.png", "-f", "1:3").err)
    assert [Path(line.split()[0]).name for line in frames] == ["a.1.png", "a.2.png", "a.3.png"]
    assert closing.startswith("3 pictures, ")
    assert closing.endswith(" s each")


def test_quiet_says_errors_alone(rooms: Engine, tmp_path: Path) -> None:
    assert refract("render", "a.usda", tmp_path / "a.png", "-q").err == ""
    assert refract("render", "a.usda", tmp_path / "a.png", "--quiet", "--progress", "json").err == ""
    ended = refract("render", "a.usda", tmp_path / "a.png", "-q", "--samples", 0)
    assert ended.err == "error: --samples is 0; it must be between 1 and 4096\n"
    assert ended.code == 2


def test_no_progress_means_warnings_and_errors(rooms: Engine, tmp_path: Path) -> None:
    ended = refract("render", "a.usda", tmp_path / "a.#.png", "-f", "1:2", "--progress", "none")
    assert ended.err == "warning: /World/Glass: is guessed\n"


def test_quiet_and_verbose_exclude_each_other(rooms: Engine, tmp_path: Path) -> None:
    ended = refract("render", "a.usda", tmp_path / "a.png", "-q", "-v")
    assert (ended.code, ended.err) == (2, "error: --quiet says less and --verbose says more; give one of them\n")
    assert not rooms.stages


def test_verbose_tells_the_seconds_of_each_part(rooms: Engine, tmp_path: Path) -> None:
    first, second, _ = lines(refract("render", "a.usda", tmp_path / "a.#.png", "-f", "1:2", "-v").err)
    for line in (first, second):
        parts = [part.split() for part in line.partition("(")[2].rstrip(")").split(", ")]
        assert [name for name, _, _ in parts] == ["reading", "picture", "writing"]
        assert all(float(seconds) >= 0.0 and unit == "s" for _, seconds, unit in parts)


def test_parts_are_timed_from_one_stage_to_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("refract_core.progress._Stopwatch.__init__.__defaults__", (lambda: now[0],))
    with reporting("none", verbose=True) as report:
        heard = (0, "reading the stage"), (2, COMPILING), (3, "frame 1 of 2: caustics"), (7, "image"), (8, "")
        for at, stage in heard:
            now[0] = float(at)
            report.progress(0.5, stage)
        now[0] = 50.0
        assert report.parts() == "reading 3.00 s, caustics 4.00 s, picture 1.00 s"
        assert report.parts() == ""


@pytest.mark.parametrize(
    ("choices", "stages"),
    [
        ({}, ["building", "caustics", "probes", "image", "done"]),
        ({"caustics": 0}, ["building", "probes", "image", "done"]),
        ({"indirect": "one"}, ["building", "caustics", "light between surfaces", "probes", "image", "done"]),
    ],
)
@pytest.mark.parametrize("kept", [False, True])
def test_a_render_tells_its_parts_in_their_order(choices: dict[str, Any], stages: list[str], kept: bool) -> None:
    scene = rc.load_stage(rc.sample("room_of_checkers"))
    heard: dict[str, float] = {}
    settings = rc.RenderSettings(image_width=16, samples=1, **choices)
    session = rc.Session() if kept else None
    rc.render(scene, settings, progress=lambda part, stage: heard.update({stage: part}), session=session)
    assert [stage for stage in heard if stage != COMPILING] == stages
    assert [*heard.values()] == sorted(heard.values())


def test_without_verbose_no_part_is_timed() -> None:
    with reporting("none") as report:
        report.progress(0.5, "image")
        assert report.parts() == ""


def test_a_farm_reads_percent_on_lines(capsys: pytest.CaptureFixture[str]) -> None:
    with reporting("lines") as report:
        for fraction in (0.0, 0.001, 0.424, 0.29, 0.42, 1.0, 2.0):
            report.progress(fraction, "image")
        report.progress(0.0, COMPILING)
        report.done("a.png", "is there")
    assert capsys.readouterr().err.splitlines() == ["0% image", "42% image", "100% image", COMPILING, "a.png is there"]


def test_json_has_the_closing_sentence_too(rooms: Engine, tmp_path: Path) -> None:
    ended = refract("render", "a.usda", tmp_path / "a.#.png", "-f", "1:2", "--progress", "json")
    last = json.loads(ended.err.splitlines()[-1])
    assert last["event"] == "closing"
    assert last["text"].startswith("2 pictures, ")


def test_memory_is_that_of_this_process() -> None:
    """A process that has held an array has had as much."""
    array = np.ones(1 << 22)
    assert array.sum() == 1 << 22
    assert array.nbytes < peak_memory() < 1 << 40


def test_other_commands_tell_their_parts_at_the_end(tmp_path: Path) -> None:
    """Prims that are measured one by one are one part."""
    ended = refract("bake", "thickness", rc.sample("traced"), tmp_path / "thick.usda", "-v")
    assert ended.code == 0
    assert re.fullmatch(r"reading \d+\.\d\d s, measuring \d+\.\d\d s", ended.err.splitlines()[-1])


def test_quiet_leaves_the_table_of_convert_out(tmp_path: Path) -> None:
    ended = refract("convert", rc.sample("preview_surface"), tmp_path / "glass.usda", "-q")
    assert (ended.code, ended.out, ended.err) == (0, "", "")
    assert files(tmp_path) == ["glass.usda"]


# --- where pictures go


def test_each_aov_may_have_a_file_of_its_own(rooms: Engine, tmp_path: Path) -> None:
    ended = refract("render", "a.usda", tmp_path / "a.{aov}.##.png", "-f", "1:2", "--aovs", "beauty,Z")
    assert ended.code == 0
    assert files(tmp_path) == ["a.Z.01.png", "a.Z.02.png", "a.beauty.01.png", "a.beauty.02.png"]
    assert len(rooms.scenes) == 2
    told = [Path(line.split()[0]).name for line in lines(ended.err)[:-1]]
    assert sorted(told) == files(tmp_path)
    depth = read_texture(str(tmp_path / "a.Z.01.png"), name="a", color_space="raw").pixels
    assert (depth[..., :3] == 255).all()
    assert set(read_planes(str(tmp_path / "a.beauty.01.png"))) == {"beauty"}


def test_files_of_aovs_are_skipped_only_where_all_exist(rooms: Engine, tmp_path: Path) -> None:
    words = ("render", "a.usda", tmp_path / "a.{aov}.exr", "--aovs", "beauty,Z", "--skip-existing")
    (tmp_path / "a.Z.exr").write_text("mine")
    assert refract(*words).code == 0
    assert files(tmp_path) == ["a.Z.exr", "a.beauty.exr"]
    assert refract(*words).code == 0
    assert len(rooms.scenes) == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["a.{aov}.png"], "name some, such as beauty,N,Z"),
        (["a.{aov}.png", "--aovs", "beauty,depth"], "depth"),
        (["a.{aov}.png", "--aovs", "beauty,P"], "write a .exr file"),
        (["a.png", "--format", "exr"], "--format exr: is for OUT -"),
        (["-", "--format", "docx"], "not a known image extension"),
        (["-", "-f", "1:2"], "--frames 1:2 are several"),
        (["-", "--aovs", "N,Z"], "one AOV"),
    ],
)
def test_places_that_do_not_fit_are_refused(
    words: list[str], message: str, rooms: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ended = refract("render", "a.usda", *words)
    assert ended.code == 2
    assert message in ended.err
    assert len(ended.err.splitlines()) == 1
    assert not rooms.stages
    assert not files(tmp_path)


@pytest.mark.parametrize(("form", "magic"), [("", b"\x89PNG"), ("exr", b"\x76\x2f\x31\x01"), (".JPG", b"\xff\xd8")])
def test_a_picture_goes_to_stdout(form: str, magic: bytes, rooms: Engine, tmp_path: Path) -> None:
    words = ["render", "a.usda", "-", *(["--format", form] if form else [])]
    ended = CliRunner().invoke(app, words)
    assert ended.exit_code == 0
    assert ended.stdout_bytes.startswith(magic)
    (line,) = lines(ended.stderr)
    assert line.startswith("- 3x2, ")
    assert not files(tmp_path)


def test_nothing_goes_to_stdout_when_the_render_fails(rooms: Engine) -> None:
    def fail(_cancel: object) -> None:
        raise MemoryError

    rooms.during = fail
    ended = CliRunner().invoke(app, ["render", "a.usda", "-"])
    assert (ended.exit_code, ended.stdout_bytes) == (1, b"")


def test_a_terminal_gets_no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", type("Tty", (io.StringIO,), {"isatty": lambda _: True})())
    with reporting("none") as report, pytest.raises(rc.UsageError, match="-: is a terminal"):
        stdout.written_to("-", "", "", (), report).__enter__()


# --- what it hears


def test_every_option_has_a_default_in_the_environment(
    rooms: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"SAMPLES": "9", "MAX_LAYERS": "2", "DISABLE_CAMERA_LIGHT": "1", "TIERS": "ray,sky"}.items():
        monkeypatch.setenv(f"REFRACT_RENDER_{name}", value)
    assert refract("render", "a.usda", tmp_path / "a.png", "--tiers", "sky").code == 0
    (asked,) = rooms.settings
    assert (asked.samples, asked.max_layers, asked.camera_light, asked.tiers) == (9, 2, False, ("sky",))


def test_a_default_for_drawing_does_not_keep_two_pictures_from_being_compared(
    rooms: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Told by a flag it is refused; a default is for those comparisons that can use it."""
    picture = tmp_path / "a.exr"
    assert refract("render", "a.usda", picture, "--aovs", "beauty").code == 0
    monkeypatch.setenv("REFRACT_COMPARE_SAMPLES", "4")
    monkeypatch.setenv("REFRACT_COMPARE_REFERENCE_SAMPLES", "4")
    assert refract("compare", picture, picture).code == 0
    ended = refract("compare", picture, picture, "--samples", 4)
    assert (ended.code, ended.err.partition(" says")[0]) == (2, "error: --samples:")


def test_what_is_wrong_in_the_environment_is_refused(
    rooms: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("REFRACT_RENDER_QUALITY", "splendid")
    assert refract("render", "a.usda", tmp_path / "a.png").code == 2


def test_the_version_of_an_image_is_no_wish(rooms: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Containers set such variables for themselves."""
    monkeypatch.setenv("REFRACT_VERSION", "1")
    assert refract("render", "a.usda", tmp_path / "a.png").code == 0
    assert files(tmp_path) == ["a.png"]


def options(command: Any, prefix: str) -> list[str]:
    """The variables of a command and of all below it."""
    below = getattr(command, "commands", {})
    found = [name for word, inner in below.items() for name in options(inner, f"{prefix}_{word}")]
    return found + [variable_of(prefix, one) for one in command.params if one.param_type_name == "option"]


def test_no_two_options_and_nothing_else_share_a_variable() -> None:
    root = typer.main.get_command(app)
    names = [name for word, inner in root.commands.items() for name in options(inner, f"REFRACT_{word}")]  # type: ignore[attr-defined]
    assert "REFRACT_BAKE_PROBES_SKIP_EXISTING" in names
    assert "REFRACT_RENDER_COLOR_CORRECTION_MODE" in names
    assert "REFRACT_CONVERT_JSON" in names
    assert len(set(names)) == len(names)
    known = {one.envvar for one in root.commands["serve"].params if one.envvar}  # type: ignore[attr-defined]
    others = {"REFRACT_CACHE_DIR", "REFRACT_KERNELS", "REFRACT_TOKEN", *known}
    assert "REFRACT_WORKERS" in known
    assert not others & set(names)
    assert not [name for name in names if name.startswith("REFRACT_LIMIT_")]


def test_the_service_keeps_its_own_names_and_has_the_others_too(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("REFRACT_TOKEN_FILE", "REFRACT_SERVE_TOKEN_FILE"):
        with monkeypatch.context() as patch:
            patch.setenv(name, "/nowhere/tokens")
            ended = refract("serve", "--port", 0)
        assert (ended.code, ended.err) == (2, "error: --token-file /nowhere/tokens: cannot be read\n")


def test_words_come_from_files(rooms: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("more.txt").write_text("--samples 3")
    Path("farm.txt").write_text("# the farm's own\n--image-width 40 'a stage.usda' @more.txt\n")
    assert refract("render", "@farm.txt", "a.png", "--max-layers", 2).code == 0
    assert rooms.stages == ["a stage.usda"]
    (asked,) = rooms.settings
    assert (asked.image_width, asked.samples, asked.max_layers) == (40, 3, 2)
    assert refract("render", "@@a.usda", "a.png").code == 0
    assert refract("render", "--", "@b.usda", "a.png").code == 0
    assert rooms.stages[1:] == ["@a.usda", "@b.usda"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "No such file"),
        (b"\xff\xfe", "it is no text"),
        (b"'a", "close what is quoted"),
        (b"@words.txt", "leads to itself"),
    ],
)
def test_a_file_of_words_that_cannot_be_read_is_refused(
    text: bytes | None, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if text is not None:
        Path("words.txt").write_bytes(text)
    ended = refract("render", "@words.txt")
    assert ended.code == 2
    assert ended.err.startswith("error: @words.txt: ")
    assert message in ended.err
    assert len(ended.err.splitlines()) == 1


@pytest.mark.parametrize("words", [["-h"], ["render", "-h"], ["bake", "probes", "-h"]])
def test_help_has_a_short_name(words: list[str]) -> None:
    ended = refract(*words)
    assert ended.code == 0
    assert ended.out == refract(*words[:-1], "--help").out
    assert "REFRACT_RENDER_SAMPLES" not in ended.out


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("refract ren", ["render"]),
        ("refract render a.usda a.png --quality b", ["best"]),
        ("refract samples mar", ["marble"]),
        ("refract bake thickness --along r", ["refracted"]),
    ],
)
def test_a_shell_completes_commands_and_choices(typed: str, offered: list[str]) -> None:
    asked = {"_REFRACT_COMPLETE": "complete_bash", "COMP_WORDS": typed, "COMP_CWORD": str(len(typed.split()) - 1)}
    command = [sys.executable, "-c", "from refract_core.cli import main; main()"]
    done = subprocess.run(command, env={**os.environ, **asked}, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == offered
