"""`refract inspect`."""

from __future__ import annotations

from typing import Annotated

import typer

from .app import app, outcome

Stage = Annotated[str, typer.Argument(metavar="STAGE", help="The .usd, .usda, .usdc or .usdz file to look at.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON with everything; the text is cut to one screen.")]


@app.command()
def inspect(stage: Stage, json: Json = False) -> None:
    """Show what a stage has in it, on one screen: its units, cameras, glass and probes, and what is suspicious.

    A * after a model means that the surface shader made it glass, without RefractMaterialAPI.
    """
    from ..verbs import inspect as room

    with outcome("none") as (_report, cancel):
        report = room.inspect(stage, cancel)
    typer.echo(room.to_json(report) if json else room.to_text(report))
