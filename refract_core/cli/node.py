"""`refract node`."""

from __future__ import annotations

from typing import Annotated

import typer

from .app import app, outcome

Incident = Annotated[str, typer.Option(metavar="X,Y,Z", help="Direction in which the ray travels; it is normalised.")]
Normal = Annotated[str, typer.Option(metavar="X,Y,Z", help="The interface's normal, against the ray; normalised.")]
Source = Annotated[float, typer.Option(help="Index of refraction that the ray comes from, 1 or more.")]
Medium = Annotated[float, typer.Option(help="Index of refraction behind the interface, 1 or more.")]
Mode = Annotated[
    str,
    typer.Option(
        metavar="safe|critical",
        help="What the refracted vector is at total internal reflection: safe is Unity's tangent vector, critical the "
        "reflected ray.",
    ),
]
Sweep = Annotated[
    bool, typer.Option("--sweep", help="Print the curve over the angle, 0 to 90 degrees, instead of one ray.")
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]


@app.command()
def node(
    incident: Incident = "0,0,1",
    normal: Normal = "0,0,-1",
    source: Source = 1.0,
    medium: Medium = 1.5,
    mode: Mode = "safe",
    sweep: Sweep = False,
    json: Json = False,
) -> None:
    """Ask Unity's Refract node about one ray: refracted vector, intensity, reflectance, transmittance, angles.

    Unity's intensity is a transmittance into denser media and a reflectance out of them; the two are also given apart.
    """
    from ..verbs import node as room

    with outcome("none") as (report, _cancel):
        asked = room.Interface(source, medium, mode)
        room.check("refract node", asked)
        for flag, value in (("--source", source), ("--medium", medium)):
            if value < 1.0:
                report.warning(flag, f"{value:g} is below 1; 1 is used, as the node does")
        if sweep:
            curve = room.sweep(asked)
            typer.echo(room.to_json(curve, asked) if json else room.sweep_text(curve))
            return
        ray = (room.parse_vector("--incident", incident), room.parse_vector("--normal", normal))
        found = room.answer(*ray, asked)
        typer.echo(room.to_json(found, asked) if json else room.to_text(found, asked))
