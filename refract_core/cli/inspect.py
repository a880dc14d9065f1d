"""`refract inspect`."""

from __future__ import annotations

import os
from typing import Annotated

import typer

from ..errors import RefractError, UsageError
from .app import Mask, SessionLayer, Variant, app, opening_of, outcome

Stages = Annotated[
    list[str],
    typer.Argument(
        metavar="STAGE",
        help="The .usd, .usda, .usdc or .usdz files to look at. A folder means every such file below it.",
    ),
]
Form = Annotated[
    str,
    typer.Option(
        "--format", metavar="text|json", help="json has everything; the text is cut to one screen for each stage."
    ),
]
Json = Annotated[bool, typer.Option("--json", help="The same as --format json.")]


@app.command()
def inspect(
    stages: Stages,
    form: Form = "text",
    json: Json = False,
    variant: Variant = None,
    session_layer: SessionLayer = "",
    mask: Mask = "",
) -> None:
    """Show what a stage has in it, on one screen: its units, cameras, glass and probes, and what is suspicious.

    A * after a model means that the surface shader made it glass, without RefractMaterialAPI. Of several stages, one
    that cannot be read is told on stderr, and makes the exit code 1 in the end; JSON is then an array.
    """
    from ..verbs import inspect as room
    from ..verbs.validate_many import stages_named

    opening = opening_of(variant, session_layer, mask)
    reports: list[room.Report] = []
    failed = False
    with outcome("none") as (report, cancel):
        if form not in ("text", "json"):
            raise UsageError(f"--format is '{form}', not known; choose from text, json")
        as_json = json or form == "json"
        named = stages_named(stages)
        alone = len(stages) == 1 and not os.path.isdir(stages[0])
        for stage in named:
            try:
                reports.append(room.inspect(stage, cancel, opening))
            except RefractError as error:
                if alone or error.exit_code != 1:
                    raise
                report.error(str(error))
                failed = True
                continue
            if not as_json:
                typer.echo(("\n" if len(reports) > 1 else "") + room.to_text(reports[-1]))
    if as_json:
        typer.echo(room.to_json(reports[0]) if alone else room.to_json_of_many(reports))
    if failed:
        raise typer.Exit(1)
