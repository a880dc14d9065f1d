"""`refract join`."""

from __future__ import annotations

from typing import Annotated

import typer

from ..verbs.join import join as join_files
from .app import ProgressMode, app, outcome

Out = Annotated[str, typer.Argument(metavar="OUT", help="The picture to write, an .exr or .png as its parts are.")]
Parts = Annotated[
    list[str],
    typer.Argument(metavar="PART...", help="The parts, in any order, as `refract render` wrote them."),
]


@app.command()
def join(out: Out, parts: Parts, progress: ProgressMode = "auto") -> None:
    """Make one picture of the parts that `refract render` drew with --tile-count or --crop.

    It is bit by bit the picture that would have been drawn whole.
    """
    with outcome(progress) as (report, _):
        join_files(out, parts, report)
