"""Make docs/cli.md from the commands' own help: `python docs/make_cli_page.py`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import click
import typer

from refract_core.cli import app

PAGE = Path(__file__).with_name("cli.md")
_WIDTH = 100
_HEAD = """# The command line

This page is made from the commands' own help by `python docs/make_cli_page.py`.

Exit codes: 0 done, 1 failed, 2 wrong usage, 3 cancelled. Files are written whole or not at all; what goes wrong is said
in one sentence on stderr. `--progress json` tells progress, warnings and results as one JSON object per line.
"""


def page() -> str:
    """The page as it should be."""
    command = typer.main.get_command(app)
    root = click.Context(command, info_name="refract", max_content_width=_WIDTH, terminal_width=_WIDTH)
    parts = [_HEAD]
    for context in _contexts(root):
        text = context.command.get_help(context).rstrip()
        parts.append(f"## {context.command_path}\n\n```text\n{text}\n```\n")
    return "\n".join(parts)


def _contexts(context: click.Context) -> Iterator[click.Context]:
    """A command and everything below it, by name."""
    yield context
    for name, inner in sorted(getattr(context.command, "commands", {}).items()):
        if not inner.hidden:
            yield from _contexts(
                click.Context(inner, context, info_name=name, max_content_width=_WIDTH, terminal_width=_WIDTH)
            )


if __name__ == "__main__":
    PAGE.write_text(page(), "utf-8")
