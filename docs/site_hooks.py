"""What mkdocs.yml needs beyond the pages: links lead to the same places in the repository and on the site.

The pages link to each other, and to README, samples and sources beside this folder, as the repository has them.
Here README becomes the first page, files beside this folder that are linked become files of the site, a folder that is
linked becomes a list of what is in it, and the public names of `refract_core` a reference.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

import refract_core

ROOT = Path(__file__).parents[1]
DOCS = "docs/"
API = "api.md"
_LINK = re.compile(r"(\]\()([^)\s]+)(\))")
_FENCED = re.compile(r"(^```.*?^```$)", re.MULTILINE | re.DOTALL)


def on_files(files: Files, config: MkDocsConfig, **_: Any) -> Files:
    """Add what is made or lies outside of docs, for as long as pages link to more of it."""
    files.append(File.generated(config, API, content=reference()))
    files.append(File.generated(config, "index.md", abs_src_path=str(ROOT / "README.md")))
    seen: set[str] = set()
    while todo := [file for file in files if file.is_documentation_page() and file.src_uri not in seen]:
        for page in todo:
            seen.add(page.src_uri)
            for _, place in links(page.content_string, page.src_uri):
                if files.get_file_from_path(site_path(place)) is not None:
                    continue
                if (ROOT / place).is_dir():
                    files.append(File.generated(config, site_path(place), content=listing(place)))
                elif (ROOT / place).is_file():
                    files.append(File.generated(config, site_path(place), abs_src_path=str(ROOT / place)))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Links as the site has them."""
    here = posixpath.dirname(page.file.src_uri)

    def moved(found: re.Match[str]) -> str:
        for link, place in links(found[0], page.file.src_uri):
            _, hash_mark, part = link.partition("#")
            return f"{found[1]}{posixpath.relpath(site_path(place), here or '.')}{hash_mark}{part}{found[3]}"
        return found[0]

    parts = _FENCED.split(markdown)
    return "".join(part if part.startswith("```") else _LINK.sub(moved, part) for part in parts)


def links(markdown: str, source: str) -> list[tuple[str, str]]:
    """Every link to a file, as it is written and as a path from the top of the repository."""
    beside = posixpath.dirname(in_repository(source))
    found = [link for _, link, _ in _LINK.findall(_FENCED.sub("", markdown))]
    return [
        (link, posixpath.normpath(posixpath.join(beside, link.partition("#")[0])))
        for link in found
        if "://" not in link and not link.startswith(("#", "mailto:"))
    ]


def site_path(place: str) -> str:
    """Where a path of the repository is in the site's sources."""
    if place == "README.md":
        return "index.md"
    if (ROOT / place).is_dir():
        place = f"{place}/index.md"
    return place.removeprefix(DOCS)


def in_repository(source: str) -> str:
    """The inverse of `site_path` for pages."""
    if source == "index.md":
        return "README.md"
    return DOCS + source if (ROOT / DOCS / source).exists() or not (ROOT / source).exists() else source


def listing(place: str) -> str:
    """What is in a folder: pages by their titles, the rest by name."""
    lines = [f"# {posixpath.basename(place).replace('-', ' ').capitalize()}", ""]
    for path in sorted((ROOT / place).iterdir()):
        if path.is_file() and path.suffix not in (".py", ".pyc"):
            title = path.read_text("utf-8").partition("\n")[0].lstrip("# ") if path.suffix == ".md" else path.name
            lines.append(f"- [{title}]({path.name})")
    return "\n".join(lines) + "\n"


def reference() -> str:
    """A section for each public name, where it is defined."""
    head = "# Python reference\n\nWhat `import refract_core as rc` has; [From Python](python.md) shows it at work.\n"
    options = "    options:\n      heading_level: 2\n"
    names = sorted(refract_core._ROOMS, key=lambda name: (name[0].isupper(), name))
    return head + "".join(
        f"\n::: {refract_core.__name__}.{refract_core._ROOMS[name]}.{name}\n{options}" for name in names
    )
