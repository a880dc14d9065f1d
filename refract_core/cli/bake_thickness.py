"""`refract bake thickness`."""

from __future__ import annotations

from typing import Annotated

import typer

from ..verbs.bake_thickness import ThicknessOrder, bake_thickness
from .app import Jobs, ProgressMode, outcome, words
from .bake import bake

Stage = Annotated[str, typer.Argument(metavar="STAGE", help="The .usd, .usda, .usdc or .usdz file. It is not changed.")]
Out = Annotated[
    str,
    typer.Argument(
        metavar="OUT",
        help="The layer over STAGE to write. Pictures go into the folder OUT.thickness beside it (OUT without its "
        "extension), or into OUT itself where that is a .usdz.",
    ),
]
Only = Annotated[
    str,
    typer.Option(
        metavar="PATH,...", help="Only these prims, or those below these paths; * and ? stand for any characters."
    ),
]
Along = Annotated[
    str,
    typer.Option(
        metavar="normal|refracted",
        help="What to measure: normal is the way straight in to the far side, as glTF has it; refracted is the "
        "thickness with which the model's way through comes nearest to the real one, over views from all sides.",
    ),
]
Texture = Annotated[
    int,
    typer.Option(
        metavar="N", help="Write pictures of N x N texels in each object's own uv, 16 to 8192, instead of primvars."
    ),
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace OUT even if it is not an earlier bake of the same stage.")
]


@bake.command("thickness")
def bake_thickness_command(
    stage: Stage,
    out: Out,
    only: Only = "",
    along: Along = "normal",
    texture: Texture = 0,
    overwrite: Overwrite = False,
    jobs: Jobs = None,
    progress: ProgressMode = "auto",
) -> None:
    """Measure how thick glass is in its own geometry, and write a layer over STAGE that says so.

    The thickness becomes primvars:refraction:thickness of each prim, in scene units, or with --texture a picture in a
    material of its own. Meshes that are open or not manifold are named and left alone, as is what is drawn in several
    sizes. Spheres, cubes and the like carry one value.
    """
    with outcome(progress) as (report, cancel):
        order = ThicknessOrder(
            stage=stage, out=out, only=words(only), along=along, texture=texture, jobs=jobs or 0, overwrite=overwrite
        )
        bake_thickness(order, report, cancel)
