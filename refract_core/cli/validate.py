"""`refract validate`."""

from __future__ import annotations

from typing import Annotated

import typer

from .app import app, outcome

Stage = Annotated[str, typer.Argument(metavar="STAGE", help="The .usd, .usda, .usdc or .usdz file to check.")]
Fix = Annotated[
    str,
    typer.Option(
        metavar="OUT",
        help="Write a layer over STAGE that mends what is safe to mend: values that cannot have been meant become what "
        "the renderer takes them for, and glass that is inside out is turned. Nothing is removed. OUT is then checked.",
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace OUT if it exists.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON: every finding with rule, severity, path, text, fix.")]


@app.command()
def validate(stage: Stage, fix: Fix = "", overwrite: Overwrite = False, json: Json = False) -> None:
    """Check a stage: glass, probes, and what USD's own validators find.

    Exit code 1 when errors remain; warnings do not fail.
    """
    from ..verbs import validate as room

    with outcome("none") as (_report, cancel):
        verdict = room.validate(room.ValidateOrder(stage=stage, fix=fix, overwrite=overwrite), cancel)
    typer.echo(room.to_json(verdict) if json else room.to_text(verdict))
    if not verdict.passed:
        raise typer.Exit(1)
