"""`refract validate`."""

from __future__ import annotations

from typing import Annotated

import typer

from ..errors import UsageError
from .app import AsJson, Mask, SessionLayer, Variant, app, format_of, opening_of, outcome, stages_argument

Stages = Annotated[list[str], stages_argument("check")]
Fix = Annotated[
    str,
    typer.Option(
        metavar="OUT",
        help="Write a layer over STAGE that mends what is safe to mend: values that cannot have been meant become what "
        "the renderer takes them for, and glass that is inside out is turned. Nothing is removed. OUT is then checked.",
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace OUT if it exists.")]
Strict = Annotated[bool, typer.Option("--strict", help="Let warnings fail, too.")]
Form = Annotated[
    str,
    typer.Option(
        "--format",
        metavar="text|json|junit|sarif",
        help="json has every finding with rule, severity, path, text, fix; junit and sarif (2.1.0) are for CI systems.",
    ),
]


@app.command()
def validate(
    stages: Stages,
    fix: Fix = "",
    overwrite: Overwrite = False,
    strict: Strict = False,
    form: Form = "text",
    json: AsJson = False,
    variant: Variant = None,
    session_layer: SessionLayer = "",
    mask: Mask = "",
) -> None:
    """Check stages: glass, probes, names in our namespaces, and what USD's own validators find.

    Of several stages, one that cannot be read is an error, and the others are checked all the same.

    Exit codes: 0 nothing fails, 1 errors are found (with --strict also warnings), or the only stage cannot be opened,
    2 wrong usage, 3 cancelled.
    """
    from ..verbs import validate as room
    from ..verbs import validate_forms as forms
    from ..verbs import validate_many as many

    opening = opening_of(variant, session_layer, mask)
    verdicts: list[room.Verdict] = []
    with outcome("none") as (_report, cancel):
        shape = format_of(form, json, forms.FORMATS)
        named = many.stages_named(stages)
        alone = many.names_one(stages)
        if fix and not alone:
            raise UsageError("--fix writes one layer over one stage; name one file")
        if alone and (fix or shape in ("text", "json")):
            order = room.ValidateOrder(stage=named[0], fix=fix, overwrite=overwrite, opening=opening)
            verdicts.append(room.validate(order, cancel))
        else:
            for verdict in many.validate_each(named, opening, cancel):
                verdicts.append(verdict)
                if shape == "text":
                    typer.echo(room.to_text(verdict))
    if shape == "text":
        typer.echo(room.to_text(verdicts[0]) if alone else room.summary(verdicts))
    elif shape == "json":
        typer.echo(room.to_json(verdicts[0]) if alone else forms.to_json_of_many(verdicts))
    else:
        typer.echo(forms.to_junit(verdicts, strict=strict) if shape == "junit" else forms.to_sarif(verdicts))
    if any(forms.fails(finding, strict=strict) for verdict in verdicts for finding in verdict.findings):
        raise typer.Exit(1)
