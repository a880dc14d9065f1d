"""Make docs/cli.md from the commands' own help: `python docs/make_cli_page.py`."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import typer

from refract_core.cli import app

PAGE = Path(__file__).with_name("cli.md")
_WIDTH = 100
_HEAD = """# The command line

This page is made from the commands' own help by `python docs/make_cli_page.py`.

Exit codes: 0 done, 1 failed, 2 wrong usage, 3 cancelled. Files are written whole or not at all; what goes wrong is said
in one sentence on stderr. [On a farm](farm.md) has the rest: what is said on the way, defaults in the environment,
files of words, and what to do after each exit code.
"""


def page() -> str:
    """The page as it should be."""
    command = typer.main.get_command(app)
    root = _context(command, "refract")
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
            yield from _contexts(_context(inner, name, context))


def _context(command: Any, name: str, parent: click.Context | None = None) -> click.Context:
    how = {**command.context_settings, "max_content_width": _WIDTH, "terminal_width": _WIDTH}
    return click.Context(command, parent, info_name=name, **how)


if __name__ == "__main__":
    PAGE.write_text(page(), "utf-8")
