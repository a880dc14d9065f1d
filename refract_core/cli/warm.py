"""`refract warm`."""

from __future__ import annotations

import typer

from .app import ProgressMode, app, outcome


@app.command()
def warm(progress: ProgressMode = "auto") -> None:
    """Compile the kernels now, not at the first render.

    For images and CI. A package built with a C compiler brings its kernels compiled, and nothing is done.
    """
    from ..verbs import warm as room

    with outcome(progress) as (report, _cancel):
        warmth = room.warm(report)
    typer.echo(room.to_text(warmth))
