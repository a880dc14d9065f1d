"""What a command says while it works, on stderr: a bar on a terminal, JSON lines for programs, or only warnings."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

from .errors import UsageError

MODES = ("auto", "json", "none")

COMPILING = "compiling kernels (first run only, about half a minute)"
"""The one stage of work that is told without a terminal too: whoever waits for so long must know why."""
_STEP = 0.01
"""Smallest advance worth a line of JSON."""


class Report(NamedTuple):
    """Where a command's words go."""

    progress: Callable[[float, str], None]
    """Fraction done, 0 .. 1, and the stage of work."""
    warning: Callable[[str, str], None]
    """Prim path, file or flag, and one sentence."""
    done: Callable[[str, str], None]
    """A file, and what became of it."""
    error: Callable[[str], None]
    """Why the command fails."""


@contextmanager
def reporting(mode: str) -> Iterator[Report]:
    """Open the place where words go.

    Args:
        mode: `auto` is a bar where stderr is a terminal; `json` one object per line; `none` warnings and errors only.

    Raises:
        UsageError: an unknown mode.
    """
    if mode not in MODES:
        raise UsageError(f"--progress is '{mode}', which is not known; choose from {', '.join(MODES)}")
    if mode == "json":
        yield _json_lines()
    elif mode == "auto" and sys.stderr.isatty():
        with _bar() as report:
            yield report
    else:
        progress = _nothing if mode == "none" else _tell_compiling()
        yield Report(progress, _print_warning, lambda _path, _text: None, _print_error)


def _nothing(_fraction: float, _stage: str) -> None:
    pass


def _tell_compiling() -> Callable[[float, str], None]:
    said: list[str] = []

    def progress(_fraction: float, stage: str) -> None:
        if stage.endswith(COMPILING) and not said:
            said.append(stage)
            print(COMPILING, file=sys.stderr, flush=True)

    return progress


def _print_warning(path: str, text: str) -> None:
    print(f"warning: {path}: {text}", file=sys.stderr, flush=True)


def _print_error(text: str) -> None:
    print(f"error: {text}", file=sys.stderr, flush=True)


def _json_lines() -> Report:
    last: tuple[float, str] = (-1.0, "")

    def say(event: str, **fields: str | float) -> None:
        print(json.dumps({"event": event, **fields}), file=sys.stderr, flush=True)

    def progress(fraction: float, stage: str) -> None:
        nonlocal last
        if stage != last[1] or abs(fraction - last[0]) >= _STEP:
            last = (fraction, stage)
            say("progress", fraction=round(fraction, 4), stage=stage)

    return Report(
        progress,
        lambda path, text: say("warning", path=path, text=text),
        lambda path, text: say("done", path=path, text=text),
        lambda text: say("error", text=text),
    )


@contextmanager
def _bar() -> Iterator[Report]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

    console = Console(stderr=True, highlight=False)
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())

    def line(text: str) -> None:
        console.print(text, markup=False, soft_wrap=True)

    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("reading", total=1.0)
        yield Report(
            lambda fraction, stage: bar.update(task, completed=fraction, description=stage),
            lambda path, text: line(f"warning: {path}: {text}"),
            lambda path, text: line(f"{path}: {text}"),
            lambda text: line(f"error: {text}"),
        )
