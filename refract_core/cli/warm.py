"""`refract warm`."""

from __future__ import annotations

import typer

from .app import ProgressMode, Quiet, Verbose, app, outcome


@app.command()
def warm(progress: ProgressMode = "auto", quiet: Quiet = False, verbose: Verbose = False) -> None:
    """Compile the kernels now, not at the first render.

    For images and CI. A package built with a C compiler brings its kernels compiled, and nothing is done.
    """
    from ..verbs import warm as room

    with outcome(progress, quiet, verbose) as (report, _cancel):
        warmth = room.warm(report)
    if not quiet:
        typer.echo(room.to_text(warmth))
