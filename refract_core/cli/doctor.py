"""`refract doctor`."""

from __future__ import annotations

from typing import Annotated

import typer

from .app import ProgressMode, Quiet, Verbose, app, outcome

Json = Annotated[bool, typer.Option("--json", help="Print an array of name, state and text.")]


@app.command()
def doctor(
    as_json: Json = False, progress: ProgressMode = "auto", quiet: Quiet = False, verbose: Verbose = False
) -> None:
    """Look whether this machine and this installation can draw, and draw a small picture.

    Versions, the processor's flags, memory, kernels and their cache, schemas, and what the service locks its workers in
    with (Landlock, seccomp). Send what it prints with a report.

    Exit codes: 0 it can draw, 1 something failed, 2 wrong usage, 3 cancelled.
    """
    from ..service import confine
    from ..verbs import doctor as room

    with outcome(progress, quiet, verbose) as (report, cancel):
        available = confine.available()  # first of all: it starts a process, which a thread could hold up
        checks = room.examine(room.locks(available, confine.missing(available)), report, cancel)
    if as_json or not quiet:
        typer.echo(room.to_json(checks) if as_json else room.to_text(checks))
    if any(check.state == room.FAILED for check in checks):
        raise typer.Exit(1)
