"""The site of the documentation: it builds without a warning, and fetches nothing from elsewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import refract_core

pytest.importorskip("material", reason="the extra 'docs' is not here")
pytest.importorskip("mkdocstrings_handlers.python", reason="the extra 'docs' is not here")

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-d", str(folder)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


def test_every_page_of_the_repository_is_a_page_of_the_site(site: Path) -> None:
    pages = [path.relative_to(ROOT / "docs").with_suffix("") for path in (ROOT / "docs").rglob("*.md")]
    assert [str(page) for page in pages if not (site / page / "index.html").exists()] == []


def test_every_public_name_is_in_the_reference(site: Path) -> None:
    page = (site / "api" / "index.html").read_text("utf-8")
    names = set(refract_core.__all__) - {"__version__"}
    assert {name for name in names if not re.search(rf'id="refract_core\.[\w.]*\b{name}"', page)} == set()


def test_nothing_is_fetched_from_elsewhere(site: Path) -> None:
    fetched = re.compile(r'<(?:script|link|img|iframe)[^>]+(?:src|href)="(?:https?:)?//[^"]+"')
    found = {hit for path in site.rglob("*.html") for hit in fetched.findall(path.read_text("utf-8"))}
    assert found == set()


def test_links_of_the_site_lead_to_its_files(site: Path) -> None:
    """Also those that leave docs in the repository: README, samples, sources."""
    lost = set()
    for page in site.rglob("index.html"):
        for link in re.findall(r'(?:href|src)="([^"#?:]+)[#?]?[^"]*"', page.read_text("utf-8")):
            target = (page.parent / link).resolve()
            if not link.startswith(("/", "http", "mailto")) and not target.exists():
                lost.add(f"{page.relative_to(site)}: {link}")
    assert lost == set()
