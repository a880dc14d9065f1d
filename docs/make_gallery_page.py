"""Make docs/gallery.md from the table of usd_samples/README.md: `python docs/make_gallery_page.py`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

PAGE = Path(__file__).with_name("gallery.md")
SAMPLES = Path(__file__).parents[1] / "usd_samples"
_ROW = re.compile(r"^\| !\[([^\]]+)\]\(([^)]+)\) \| (.+)<br>`(refract [^`]+)` \|$", re.MULTILINE)
_HEAD = """# Gallery

Every sample with its picture, what to look at, its stage and its command. This page is made from
[the table of the samples](../usd_samples/README.md) by `python docs/make_gallery_page.py`.
`refract samples NAME --to .` copies a stage with all that it needs; the pictures here are larger and have more samples,
as that table says.
"""


class Row(NamedTuple):
    """A line of the table."""

    name: str
    picture: str
    """below usd_samples"""
    text: str
    command: str


def rows() -> list[Row]:
    """What the table has, in its order."""
    return [Row(*found) for found in _ROW.findall((SAMPLES / "README.md").read_text("utf-8"))]


def page() -> str:
    """The page as it should be."""
    return "\n".join([_HEAD, *(_section(row) for row in rows())])


def _section(row: Row) -> str:
    stage = f"[{row.name}.usda](../usd_samples/good/{row.name}.usda)"
    return (
        f"## {row.name}\n\n![{row.name}](../usd_samples/{row.picture})\n\n{row.text} Stage: {stage}.\n\n"
        f"```sh\n{row.command}\n```\n"
    )


if __name__ == "__main__":
    PAGE.write_text(page(), "utf-8")
