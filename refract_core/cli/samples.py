"""`refract samples`."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Sequence
from typing import Annotated

import typer

from ..errors import UsageError
from .app import app, outcome


def _known(begun: str) -> list[str]:
    """For a shell that completes a name."""
    from ..verbs.samples import names

    return [name for name in names() if name.startswith(begun)]


Names = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[NAME]...", show_default=False, autocompletion=_known, help="Samples to show or to copy; else all."
    ),
]
To = Annotated[
    str,
    typer.Option(
        metavar="DIR",
        help="Copy them into this folder, with all they refer to, and print the paths of the copies. It is made where "
        "it is not there.",
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace files in DIR that differ.")]
Json = Annotated[bool, typer.Option("--json", help="Print an array of name, path and text.")]

_WIDTH = 100


@app.command()
def samples(name: Names = None, to: To = "", overwrite: Overwrite = False, as_json: Json = False) -> None:
    """List the sample stages that come with refract, print where they are, or copy them anywhere.

    With a NAME the path of its stage is printed: refract render "$(refract samples marble)" marble.png.
    """
    from ..verbs import samples as room

    with outcome("none"):
        chosen = name or []
        if overwrite and not to:
            raise UsageError("--overwrite: is for --to DIR, where copies go; name the folder, or leave it out")
        if to:
            for path in room.copy_samples(chosen, to, overwrite=overwrite):
                typer.echo(path)
        elif as_json:
            typer.echo(json.dumps([one._asdict() for one in room.described(chosen)], indent=2))
        elif chosen:
            for one in chosen:
                typer.echo(room.sample(one))
        else:
            typer.echo(_listed(room.described()))


def _listed(found: Sequence[tuple[str, str, str]]) -> str:
    """A name and its sentence a row, on lines that a terminal holds."""
    column = max(len(name) for name, _, _ in found) + 2
    rows = []
    for name, _, text in found:
        first, *rest = textwrap.wrap(" ".join(text.split()), _WIDTH - column) or [""]
        rows += [f"{name:{column}}{first}", *(" " * column + line for line in rest)]
    return "\n".join([*rows, "", "refract samples NAME --to DIR copies one, with all it refers to."])
