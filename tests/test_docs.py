"""The pages are true: docs/cli.md is what the commands say, and every code block of README and docs runs."""

from __future__ import annotations

import importlib.util
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from typer.testing import CliRunner

from refract_core.cli import app

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *sorted((ROOT / "usd_samples").rglob("*.md"))]
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
# What a page may ask a reader to type that `.ci/run` and the benchmarks do, not these tests.
_ELSEWHERE = (
    "curl",
    "refract serve",
    "pip install",
    "pytest",
    ".ci/run",
    "python -m benchmarks.",
    "python docs/",
    "python -m schemas.generate",
)
_SMALL = {"render": ["--image-width", "32", "--samples", "1"], "bake probes": ["--samples", "1"]}


class Block(NamedTuple):
    page: str
    language: str
    text: str


def blocks(*languages: str) -> Iterator[Block]:
    for page in PAGES:
        for language, text in _FENCE.findall(page.read_text("utf-8")):
            if language in languages:
                yield Block(str(page.relative_to(ROOT)), language, text)


def name(value: object) -> str | None:
    return f"{value.page}:{value.text.splitlines()[0][:40]}" if isinstance(value, Block) else None


def test_the_page_of_the_command_line_is_what_the_commands_say() -> None:
    spec = importlib.util.spec_from_file_location("make_cli_page", ROOT / "docs" / "make_cli_page.py")
    assert spec
    assert spec.loader
    maker = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(maker)
    text = "run `python docs/make_cli_page.py`"
    assert (ROOT / "docs" / "cli.md").read_text("utf-8") == maker.page(), text


def test_every_block_says_what_it_is() -> None:
    """Blocks that run are `sh` or `python`; output and grammar are `text`, stages are `usda`, settings `json`."""
    known = {"sh", "python", "text", "usda", "json", "toml"}
    found = {
        (str(p.relative_to(ROOT)), language) for p in PAGES for language, _ in _FENCE.findall(p.read_text("utf-8"))
    }
    assert {pair for pair in found if pair[1] not in known} == set()
    assert ("README.md", "sh") in found
    assert ("README.md", "python") in found


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the samples in it, and a stage with a time range under the name that pages use."""
    (tmp_path / "usd_samples").symlink_to(ROOT / "usd_samples", target_is_directory=True)
    for part in ("parts", "textures"):
        (tmp_path / part).symlink_to(ROOT / "usd_samples" / "good" / part, target_is_directory=True)
    for stage, sample in (("stage.usda", "two_probes"), ("table.usda", "planar_table")):
        (tmp_path / stage).write_text((ROOT / "usd_samples" / "good" / f"{sample}.usda").read_text("utf-8"), "utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def commands(text: str) -> list[str]:
    """Lines to type, without comments and continuations."""
    lines = text.replace("\\\n", " ").splitlines()
    return [line.strip().removeprefix("$ ") for line in lines if line.strip() and not line.lstrip().startswith("#")]


@pytest.mark.parametrize("block", list(blocks("sh")), ids=name)
def test_a_shell_block_runs(block: Block, desk: Path) -> None:
    """`refract` commands run as they stand, pictures small and quick."""
    for line in commands(block.text):
        if line.startswith(_ELSEWHERE):
            continue
        words = shlex.split(re.sub(r"\s# .*", "", line))
        assert words[0] == "refract", f"{block.page}: '{line}' is not run by anything"
        small = _SMALL.get(words[1], _SMALL.get(" ".join(words[1:3]), []))
        done = CliRunner().invoke(app, [*words[1:], *small])
        assert done.exit_code == 0, f"{line}\n{done.output}"


@pytest.mark.parametrize("block", list(blocks("python")), ids=name)
def test_a_python_block_runs(block: Block, desk: Path) -> None:
    exec(compile(block.text, block.page, "exec"), {"__name__": "__main__"})
