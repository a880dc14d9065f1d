"""Blocks of the pages that measurements write: what stands between two comments of one name."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
_CPU_INFO = Path("/proc/cpuinfo")


def put(text: str, name: str, block: str) -> str:
    """A page's text with another block under a name.

    Raises:
        ValueError: the page has no place of this name, or more than one.
    """
    before, _, after = _parts(text, name)
    return f"{before}{block}\n{after}"


def block_of(text: str, name: str) -> str:
    """What stands under a name.

    Raises:
        ValueError: as `put`.
    """
    return _parts(text, name)[1].strip("\n")


def _parts(text: str, name: str) -> tuple[str, str, str]:
    """Before the block, with the comment that begins it; the block; from the comment that ends it on."""
    start, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->\n"
    if text.count(start) != 1 or text.count(end) != 1 or text.index(start) > text.index(end):
        raise ValueError(f"the page has no place for '{name}'; it is between {start.strip()} and {end.strip()}, once")
    first, last = text.index(start) + len(start), text.index(end)
    return text[:first], text[first:last], text[last:]


def write(page: Path, blocks: Mapping[str, str]) -> None:
    """Put blocks into a page on disk; the rest of it stays.

    Raises:
        ValueError: as `put`; nothing is written then.
    """
    text = page.read_text("utf-8")
    for name, block in blocks.items():
        text = put(text, name, block)
    page.write_text(text, "utf-8")


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table: the first column to the left, the others to the right."""
    lines = [head, ["---", *("--:" for _ in head[1:])], *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def machine() -> str:
    """What the numbers were measured on, for people."""
    names = re.findall(r"^model name\s*: (.*)$", _CPU_INFO.read_text("utf-8"), re.MULTILINE)
    cores = len(os.sched_getaffinity(0))
    return f"{cores} core{'s' if cores > 1 else ''} of an {names[0].strip() if names else 'unnamed processor'}"
