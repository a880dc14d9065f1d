"""Options of a camera of its own, which `render` and `turntable` share."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from ..errors import UsageError

Azimuth = Annotated[
    float | None,
    typer.Option(
        help="Side from which a camera of its own looks, in degrees: 0 is the front (+Z, or -Y where Z is up), 90 the "
        "right (+X). This and the next six make one, whatever cameras the stage has; with --camera it starts from that "
        "one, and turns around what that looks at. The default is 30.",
        show_default=False,
    ),
]
Elevation = Annotated[
    float | None,
    typer.Option(help="How high it stands, in degrees: 90 is above, -90 below. The default is 20.", show_default=False),
]
Distance = Annotated[
    float | None, typer.Option(help="From what it looks at, in the stage's units.", show_default=False)
]
Fit = Annotated[
    float | None,
    typer.Option(
        help="How much larger the frame is than what it frames: 1 touches the picture's edges. The default is 1.1, as "
        "usdview's.",
        show_default=False,
    ),
]
Fov = Annotated[
    float | None, typer.Option(help="Angle that the picture's width spans, in degrees.", show_default=False)
]
FocalLength = Annotated[
    float | None,
    typer.Option(
        help="The same as a lens before a film 20.955 mm wide, in mm. The default is 50.", show_default=False
    ),
]
LookAt = Annotated[
    str,
    typer.Option(
        metavar="X,Y,Z|PATH",
        help="What is in the middle of the picture: a point in the stage's units, or a prim, which is then framed. "
        "The default is the middle of everything.",
        show_default=False,
    ),
]


def orbit_of(
    azimuth: float | None, elevation: float | None, distance: float | None, fit: float | None, fov: float | None,
    focal_length: float | None, look_at: str,
) -> dict[str, Any]:  # fmt: skip
    """What the options say, as fields of `RenderSettings`. Raises UsageError."""
    given = {
        "azimuth": azimuth, "elevation": elevation, "distance": distance, "fit": fit, "fov": fov,
        "focal_length": focal_length, "look_at": _place(look_at) if look_at else None,
    }  # fmt: skip
    return {name: value for name, value in given.items() if value is not None}


def _place(text: str) -> str | tuple[float, ...]:
    """A path as it is, else a point."""
    if text.startswith("/"):
        return text
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"--look-at is '{text}'; it must be a point, x,y,z, or the path of a prim") from None
