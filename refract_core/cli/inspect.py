"""`refract inspect`."""

from __future__ import annotations

from typing import Annotated

import typer

from ..errors import RefractError
from .app import AsJson, Mask, SessionLayer, Variant, app, format_of, opening_of, outcome, stages_argument

Stages = Annotated[list[str], stages_argument("look at")]
Form = Annotated[
    str,
    typer.Option(
        "--format", metavar="text|json", help="json has everything; the text is cut to one screen for each stage."
    ),
]


@app.command()
def inspect(
    stages: Stages,
    form: Form = "text",
    json: AsJson = False,
    variant: Variant = None,
    session_layer: SessionLayer = "",
    mask: Mask = "",
) -> None:
    """Show what a stage has in it, on one screen: its units, cameras, glass and probes, and what is suspicious.

    A * after a model means that the surface shader made it glass, without RefractMaterialAPI. Of several stages, one
    that cannot be read is told on stderr, and makes the exit code 1 in the end; JSON is then an array.
    """
    from ..verbs import inspect as room
    from ..verbs.validate_many import names_one, stages_named

    opening = opening_of(variant, session_layer, mask)
    reports: list[room.Report] = []
    failed = False
    with outcome("none") as (report, cancel):
        as_json = format_of(form, json, ("text", "json")) == "json"
        named = stages_named(stages)
        alone = names_one(stages)
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
