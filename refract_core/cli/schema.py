"""`refract schema`."""

from __future__ import annotations

from typing import Annotated

import typer

from ..errors import UsageError
from .app import app, outcome

Path = Annotated[bool, typer.Option("--path", help="Print the folder of the schemas alone.")]
Install = Annotated[
    bool, typer.Option("--install", help="Print the environment line alone, for a shell's profile or for eval.")
]


@app.command()
def schema(path: Path = False, install: Install = False) -> None:
    """Say how usdview, Houdini, Omniverse and other programs come to know the schemas, and where they are.

    eval "$(refract schema --install)" before usdview is all it takes. Nothing is copied and no file is changed.
    """
    from ..verbs import schema as room

    with outcome("none"):
        if path and install:
            raise UsageError("--path and --install each print one line alone; give one of them")
        typer.echo(room.folder() if path else room.export_line() if install else room.to_text())
