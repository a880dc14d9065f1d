"""The pages are true: what is made from the code is as the code is, and every code block of README and docs runs."""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import pytest
from service_server import Server, running
from typer.testing import CliRunner

from refract_core.cli import app
from service.metrics import Metrics
from service.models import Convert, Override, Render

ROOT = Path(__file__).parents[1]
PAGES = [page for part in ("*.md", "docs/**/*.md", "usd_samples/**/*.md") for page in sorted(ROOT.glob(part))]
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
# What a page may ask a reader to type that `.ci/run`, the benchmarks or a fixture do, not these tests.
_ELSEWHERE = (
    "refract serve",
    "python3 -m venv",
    "pip install",
    "pytest",
    ".ci/run",
    "python -m benchmarks.",
    "python docs/",
    "python -m schemas.generate",
)
_SMALL = {
    "render": ["--image-width", "32", "--samples", "1"],
    "bake probes": ["--samples", "1"],
    "compare stage.usda": ["--image-width", "32", "--samples", "1", "--reference-samples", "1"],
}


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


def maker(module: str) -> ModuleType:
    """A program that makes a page of docs, or part of it."""
    spec = importlib.util.spec_from_file_location(module, ROOT / "docs" / f"{module}.py")
    assert spec
    assert spec.loader
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


def test_the_page_of_the_command_line_is_what_the_commands_say() -> None:
    text = "run `python docs/make_cli_page.py`"
    assert (ROOT / "docs" / "cli.md").read_text("utf-8") == maker("make_cli_page").page(), text


def test_the_gallery_is_what_the_table_of_samples_says_and_has_every_sample() -> None:
    gallery = maker("make_gallery_page")
    assert (ROOT / "docs" / "gallery.md").read_text("utf-8") == gallery.page(), "run `python docs/make_gallery_page.py`"
    shown = [(row.name, row.picture) for row in gallery.rows()]
    there = {path.stem for path in (ROOT / "usd_samples" / "good").glob("*.usda")}
    assert sorted(shown) == sorted((name, f"good/{name}.png") for name in there)
    assert all(f"usd_samples/good/{row.name}.usda" in row.command for row in gallery.rows())


def test_the_page_of_the_service_has_its_limits_and_problems() -> None:
    text = (ROOT / "docs" / "service.md").read_text("utf-8")
    assert text == maker("make_service_tables").page(text), "run `python docs/make_service_tables.py`"


def test_the_page_of_the_service_names_every_setting_option_and_metric() -> None:
    text = (ROOT / "docs" / "service.md").read_text("utf-8")
    settings = {*Render.model_fields, *Convert.model_fields, *Override.model_fields} - {"stage"}
    told = re.findall(r"^# TYPE (\w+)", Metrics().text().decode(), re.MULTILINE)
    metrics = {one for one in told if not one.endswith("_created")}
    said = CliRunner().invoke(app, ["serve", "--help"], terminal_width=200).output
    options = set(re.findall(r"^\W*(--[a-z-]+)", said, re.MULTILINE)) - {"--help"}
    assert len(options) > 8
    assert {one for one in settings | metrics if f"`{one}`" not in text} == set()
    assert {one for one in options if one not in text} == set()


def test_links_inside_the_pages_lead_somewhere() -> None:
    """Files, and headings of the same page."""
    lost = []
    for page in PAGES:
        text = page.read_text("utf-8")
        headings = {re.sub(r"[^\w -]", "", line.lower()).strip().replace(" ", "-")
                    for line in re.findall(r"^#+ (.*)$", text, re.MULTILINE)}  # fmt: skip
        for link in re.findall(r"\]\(([^)\s]+)\)", _FENCE.sub("", text)):
            file, _, part = link.partition("#")
            if "://" in link or ((page.parent / file).exists() and (file or part in headings)):
                continue
            lost.append(f"{page.name}: {link}")
    assert lost == []


def test_the_description_of_the_wheel_is_the_readme_without_links_to_files_beside_it() -> None:
    """A package index has no such files. Words of links, code and everything else stay."""
    from hatchling.metadata.core import ProjectMetadata
    from hatchling.plugin.manager import PluginManager

    readme = (ROOT / "README.md").read_text("utf-8")
    told = ProjectMetadata(str(ROOT), PluginManager()).core.readme
    pictures, links = (re.findall(rf"{mark}\[([^\]]*)\]\((?!https)[^)]*\)", readme) for mark in ("!", "(?<!!)"))
    assert pictures
    assert links
    assert not re.search(r"\]\((?!https?://|#)", told)
    assert [words for words in links if words not in told] == []
    assert [words for words in pictures if words in told] == []
    plain = [line for line in readme.splitlines() if line and "](" not in line]
    assert [line for line in told.splitlines() if line in plain] == plain


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
    """A folder with the samples in it, a stage with a time range under the name that pages use, and a sky."""
    (tmp_path / "usd_samples").symlink_to(ROOT / "usd_samples", target_is_directory=True)
    for part in ("parts", "textures"):
        (tmp_path / part).symlink_to(ROOT / "usd_samples" / "good" / part, target_is_directory=True)
    for stage, sample in (("stage.usda", "two_probes"), ("table.usda", "planar_table")):
        (tmp_path / stage).write_text((ROOT / "usd_samples" / "good" / f"{sample}.usda").read_text("utf-8"), "utf-8")
    shutil.copy(ROOT / "usd_samples" / "good" / "textures" / "studio.exr", tmp_path / "sky.exr")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def commands(text: str) -> list[str]:
    """Lines to type, without comments and continuations."""
    lines = text.replace("\\\n", " ").splitlines()
    return [line.strip().removeprefix("$ ") for line in lines if line.strip() and not line.lstrip().startswith("#")]


def asks_the_service(block: Block) -> bool:
    return re.search(r"\bcurl ", block.text) is not None


@pytest.mark.slow
@pytest.mark.parametrize("block", [block for block in blocks("sh") if not asks_the_service(block)], ids=name)
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


# --- blocks that ask the service --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """What the pages start with `refract serve`."""
    found = re.match(r"curl (\d+)\.(\d+)", _output("curl", "--version")) if shutil.which("curl") else None
    if not shutil.which("bash") or not found or (int(found[1]), int(found[2])) < (7, 84):
        pytest.skip("bash and curl 7.84 or newer are not here")
    with running(tmp_path_factory.mktemp("pages") / "data", "--stage-root", "usd_samples/good") as started:
        yield started


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`marble.usdz`, which the first block makes and the others send."""
    path = tmp_path_factory.mktemp("packed") / "marble.usdz"
    done = CliRunner().invoke(app, ["convert", str(ROOT / "usd_samples" / "good" / "marble.usda"), str(path)])
    assert done.exit_code == 0, done.output
    return path


def _output(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


@pytest.mark.slow
@pytest.mark.parametrize("block", [block for block in blocks("sh") if asks_the_service(block)], ids=name)
def test_a_block_that_asks_the_service_runs(block: Block, desk: Path, server: Server, package: Path) -> None:
    """As bash runs it, with the server on another port; an answer of 400 or more fails."""
    if "refract convert" not in block.text:
        shutil.copy(package, desk)
    typed = [line for line in block.text.splitlines() if not line.startswith("refract serve")]
    host, port = server.address
    script = "\n".join(
        [
            "set -euo pipefail",
            'curl() { command curl --no-progress-meter --fail-with-body --max-time 600 "$@"; }',
            f'refract() {{ {shlex.quote(sys.executable)} -m refract_core.cli "$@"; }}',
            f'python() {{ {shlex.quote(sys.executable)} "$@"; }}',
            *typed,
        ]
    ).replace("localhost:8000", f"{host}:{port}")
    variables = {**os.environ, "PYTHONPATH": str(ROOT), "no_proxy": "*"}
    done = subprocess.run(["bash", "-c", script], cwd=desk, env=variables, capture_output=True, timeout=1800)
    assert done.returncode == 0, f"{block.text}\n{(done.stdout + done.stderr).decode('utf-8', 'replace')}"
    for file in re.findall(r"-o ([^\s\"$]+\.(?:png|exr|usdz))", block.text):
        assert (desk / file).stat().st_size > 500, file
