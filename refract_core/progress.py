"""What a command says while it works, on stderr: a bar on a terminal, lines for farms, JSON for programs, or less."""

from __future__ import annotations

import json
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

from .errors import UsageError

MODES = ("auto", "lines", "json", "none")

COMPILING = "compiling kernels (first run only, a minute or two)"
"""The one stage of work that is told without a terminal too: whoever waits for so long must know why."""
_STEP = 0.01
"""Smallest advance worth a line of JSON."""


def _unheard(_text: str) -> None:
    pass


def _unmeasured() -> str:
    return ""


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
    closing: Callable[[str], None] = _unheard
    """A last sentence about files that were told one by one."""
    parts: Callable[[], str] = _unmeasured
    """Seconds of each part of the work since this was last asked; '' where nobody wants to know."""


@contextmanager
def reporting(mode: str, *, quiet: bool = False, verbose: bool = False) -> Iterator[Report]:
    """Open the place where words go.

    Args:
        mode: `auto` is a bar where stderr is a terminal, and elsewhere a line for each file; `lines` has percent on
            lines of their own as well; `json` one object per line; `none` warnings and errors only.
        quiet: nothing but errors, whatever the mode.
        verbose: `Report.parts` tells seconds.

    Raises:
        UsageError: an unknown mode, or quiet and verbose at once.
    """
    if mode not in MODES:
        raise UsageError(f"--progress is '{mode}', which is not known; choose from {', '.join(MODES)}")
    if quiet and verbose:
        raise UsageError("--quiet says less and --verbose says more; give one of them")
    with _voice(mode, quiet) as report:
        yield _measured(report) if verbose else report


@contextmanager
def _voice(mode: str, quiet: bool) -> Iterator[Report]:
    if mode == "json":
        yield _errors_of(_json_lines()) if quiet else _json_lines()
    elif quiet:
        yield _errors_of(_plain(_nothing))
    elif mode == "auto" and sys.stderr.isatty():
        with _bar() as report:
            yield report
    elif mode == "none":
        yield _plain(_nothing)._replace(done=_unsaid, closing=_unheard)
    else:
        yield _plain(_percent_lines() if mode == "lines" else _tell_compiling())


def _plain(progress: Callable[[float, str], None]) -> Report:
    """Sentences, for a log."""
    return Report(
        progress, _print_warning, lambda path, text: _print(f"{path} {text}"), lambda text: _print(f"error: {text}"),
        _print,
    )  # fmt: skip


def _errors_of(report: Report) -> Report:
    return report._replace(progress=_nothing, warning=_unsaid, done=_unsaid, closing=_unheard)


def _nothing(_fraction: float, _stage: str) -> None:
    pass


def _unsaid(_path: str, _text: str) -> None:
    pass


def _percent_lines() -> Callable[[float, str], None]:
    """`42% image`: a line for each percent that is new, which never falls."""
    last, waits = -1, _tell_compiling()

    def progress(fraction: float, stage: str) -> None:
        nonlocal last
        waits(fraction, stage)
        percent = int(100.0 * min(max(fraction, 0.0), 1.0) + 1e-6)
        if percent > last:
            last = percent
            _print(f"{percent}% {stage}")

    return progress


# --- how long each part takes


_FRAME = re.compile(r"^frame \d+ of \d+: ")
_SHORT = {"reading the stage": "reading", "image": "picture"}


class _Stopwatch:
    """Seconds by part of the work, from one stage of progress to the next."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self._seconds: dict[str, float] = {}
        self._part, self._since = "", clock()

    def heard(self, stage: str) -> None:
        """The work is at this stage now. Kernels are compiled on the way, where they are first called."""
        if stage.endswith(COMPILING):
            return
        now = self._clock()
        if self._part:
            self._seconds[self._part] = self._seconds.get(self._part, 0.0) + now - self._since
        name = _FRAME.sub("", stage)
        # Prims are measured one by one; what they are called says their own line.
        self._part, self._since = _SHORT.get(name, name.partition(" /")[0]), now

    def told(self) -> str:
        """What each part has taken since this was last called; the clock stands still until the next stage."""
        self.heard("")
        text = ", ".join(f"{part} {seconds:.2f} s" for part, seconds in self._seconds.items() if part != "done")
        self._seconds.clear()
        return text


def _measured(report: Report) -> Report:
    watch = _Stopwatch()

    def progress(fraction: float, stage: str) -> None:
        watch.heard(stage)
        report.progress(fraction, stage)

    return report._replace(progress=progress, parts=watch.told)


# --- the voices


def _tell_compiling() -> Callable[[float, str], None]:
    say = _once(lambda: _print(COMPILING))

    def progress(_fraction: float, stage: str) -> None:
        if stage.endswith(COMPILING):
            say()

    return progress


def _print_warning(path: str, text: str) -> None:
    _print(f"warning: {path}: {text}")


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


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
        lambda text: say("closing", text=text),
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
        compiling = _once(lambda: line(COMPILING))

        def progress(fraction: float, stage: str) -> None:
            if stage.endswith(COMPILING):  # the work goes on to its next stage, and compiles on the way
                compiling()
            else:
                bar.update(task, completed=fraction, description=stage)

        yield Report(
            progress,
            lambda path, text: line(f"warning: {path}: {text}"),
            lambda path, text: line(f"{path} {text}"),
            lambda text: line(f"error: {text}"),
            line,
        )


def _once(act: Callable[[], None]) -> Callable[[], None]:
    left = [act]
    return lambda: left.pop()() if left else None
