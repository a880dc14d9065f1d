"""`refract bake probes` and `refract bake thickness`."""

from __future__ import annotations

from typing import Annotated

import typer

from ..verbs.executors import crew_at
from .app import (
    Jobs,
    Mask,
    ProgressMode,
    Quiet,
    SessionLayer,
    StagePath,
    Variant,
    Verbose,
    app,
    only_option,
    opening_of,
    outcome,
    words,
)
from .shell import Commands

bake = Commands(help="Work something out once and keep it in a layer over the stage.", no_args_is_help=True)
app.add_typer(bake, name="bake", rich_help_panel=None)

Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace OUT even if it is not an earlier bake of the same stage.")
]

# --- probes ---------------------------------------------------------------------------------------------------------

ProbesOut = Annotated[
    str,
    typer.Argument(
        metavar="OUT",
        help="The layer over STAGE to write. Textures go into the folder OUT.probes beside it (OUT without its "
        "extension), or into OUT itself where that is a .usdz.",
    ),
]
Probes = Annotated[str, only_option("probes")]
Resolution = Annotated[
    int | None, typer.Option(help="Texels on a side of each face, 8 to 4096, instead of each probe's own.")
]
Layout = Annotated[
    str,
    typer.Option(metavar="strip|cross|latlong", help="How the faces lie in the file. A strip is read back exactly."),
]
Samples = Annotated[int, typer.Option(help="Rays per texel, 1 to 4096.")]
Executor = Annotated[
    str,
    typer.Option(
        metavar="dask://HOST:PORT",
        help="Bake on the workers of this Dask cluster, a probe at a time. Without it they are baked here.",
    ),
]
Force = Annotated[bool, typer.Option("--force", help="Bake all, also what is up to date.")]
SkipExisting = Annotated[
    bool, typer.Option("--skip-existing", help="Leave textures that exist as they are, up to date or not.")
]


@bake.command("probes")
def bake_probes_command(
    stage: StagePath,
    out: ProbesOut,
    only: Probes = "",
    resolution: Resolution = None,
    layout: Layout = "strip",
    samples: Samples = 16,
    force: Force = False,
    skip_existing: SkipExisting = False,
    overwrite: Overwrite = False,
    variant: Variant = None,
    session_layer: SessionLayer = "",
    mask: Mask = "",
    jobs: Jobs = None,
    executor: Executor = "",
    progress: ProgressMode = "auto",
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Bake reflection probes to EXR cubemaps, and write a layer over STAGE that uses them.

    Probes of mode baked are baked; realtime, custom and planar ones are named and left alone. What is up to date is
    kept: the scene it shows, its settings and the version of refract are the same. Run again after a change, or to go
    on after an interruption.
    """
    from ..verbs.bake_probes import BakeOrder, bake_probes

    order = BakeOrder(
        stage=stage,
        out=out,
        only=words(only),
        resolution=resolution,
        layout=layout,
        samples=samples,
        jobs=jobs or 0,
        force=force,
        skip_existing=skip_existing,
        overwrite=overwrite,
        opening=opening_of(variant, session_layer, mask),
    )
    with outcome(progress, quiet, verbose) as (report, cancel), crew_at(executor) as crew:
        bake_probes(order, report, cancel, crew=crew)


# --- thickness ------------------------------------------------------------------------------------------------------

ThicknessOut = Annotated[
    str,
    typer.Argument(
        metavar="OUT",
        help="The layer over STAGE to write. Pictures go into the folder OUT.thickness beside it (OUT without its "
        "extension), or into OUT itself where that is a .usdz.",
    ),
]
Prims = Annotated[str, only_option("prims")]
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
        metavar="N", help="Write pictures of N x N texels in each object's own uv, 16 to 8192, instead of primvars. "
        "With the extra unwrap, a mesh without uv gets one: primvars:refraction:st."
    ),
]


@bake.command("thickness")
def bake_thickness_command(
    stage: StagePath,
    out: ThicknessOut,
    only: Prims = "",
    along: Along = "normal",
    texture: Texture = 0,
    overwrite: Overwrite = False,
    variant: Variant = None,
    session_layer: SessionLayer = "",
    mask: Mask = "",
    jobs: Jobs = None,
    progress: ProgressMode = "auto",
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Measure how thick glass is in its own geometry, and write a layer over STAGE that says so.

    The thickness becomes primvars:refraction:thickness of each prim, in scene units, or with --texture a picture in a
    material of its own. Meshes that are open or not manifold are named and left alone, as is what is drawn in several
    sizes. Spheres, cubes and the like carry one value.
    """
    from ..verbs.bake_thickness import ThicknessOrder, bake_thickness

    with outcome(progress, quiet, verbose) as (report, cancel):
        order = ThicknessOrder(
            stage=stage, out=out, only=words(only), along=along, texture=texture, jobs=jobs or 0, overwrite=overwrite,
            opening=opening_of(variant, session_layer, mask),
        )
        bake_thickness(order, report, cancel)
