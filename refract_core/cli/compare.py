"""`refract compare`."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..errors import UsageError
from .app import Jobs, Mask, ProgressMode, Quiet, SessionLayer, Variant, Verbose, app, opening_of, outcome, words
from .render import (
    Camera,
    DisableCameraLight,
    DisableMotionBlur,
    Exposure,
    ImageHeight,
    ImageWidth,
    ModelName,
    Samples,
    Screen,
    SettingsPrim,
    Tiers,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..progress import Report
    from ..verbs.compare_report import Account

SAMPLES = 64
"""Of the reference, where nobody says."""
STAGES = (".usd", ".usda", ".usdc", ".usdz", ".glb", ".gltf")

First = Annotated[
    str, typer.Argument(metavar="STAGE|A", help="A stage to draw, or a picture: .exr with its AOVs, .png, .jpg, .tif.")
]
Second = Annotated[
    str,
    typer.Argument(metavar="OUTDIR|B", help="The folder to write, or with a picture the one to compare it with."),
]
Third = Annotated[
    str, typer.Argument(metavar="OUTDIR", help="With two pictures, the folder to write. Without it nothing is.")
]
Frame = Annotated[float | None, typer.Option(help="Time code to draw. Without it the stage's start.")]
ReferenceSamples = Annotated[int, typer.Option(help="Samples per pixel of the reference, 1 to 4096.")]
Suggest = Annotated[
    bool,
    typer.Option(
        "--suggest",
        help="Try each model, with typed and with measured thickness, on each glass material, and say which comes "
        "nearest to the reference in the pixels that show it.",
    ),
]
Write = Annotated[
    str, typer.Option(metavar="OUT", help="Write a layer over STAGE that has what --suggest finds to be best.")
]
FailUnder = Annotated[
    float | None,
    typer.Option(metavar="DB", help="Exit code 1 where the PSNR of the glass (without glass, of all) is lower."),
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Use OUTDIR even if it holds other files, and replace the file of --write.")
]
Json = Annotated[bool, typer.Option("--json", help="Print report.json instead of the tables.")]


@app.command("compare")
def compare_command(
    ctx: typer.Context,
    first: First,
    second: Second,
    third: Third = "",
    camera: Camera = None,
    frame: Frame = None,
    image_width: ImageWidth = None,
    image_height: ImageHeight = None,
    samples: Samples = None,
    reference_samples: ReferenceSamples = SAMPLES,
    tiers: Tiers = None,
    screen: Screen = None,
    model: ModelName = None,
    exposure: Exposure = None,
    disable_motion_blur: DisableMotionBlur = False,
    disable_camera_light: DisableCameraLight = False,
    render_settings_prim_path: SettingsPrim = "",
    variant: Variant = None,
    session_layer: SessionLayer = "",
    mask: Mask = "",
    suggest: Suggest = False,
    write: Write = "",
    fail_under: FailUnder = None,
    overwrite: Overwrite = False,
    jobs: Jobs = None,
    as_json: Json = False,
    progress: ProgressMode = "auto",
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Measure a picture against the truth: PSNR, SSIM and FLIP of all, of the glass, of each prim and each tier.

    With a STAGE the picture is drawn, and its reference too: the real way through every mesh, and rays for what is
    behind. OUTDIR gets both, the FLIP heat map, report.json, and report.html, one page with a slider. With two pictures
    A is measured against B, and nothing is drawn.
    """
    from ..verbs.compare_report import to_json, to_text

    drawing = {
        "camera": camera[0] if camera else None,
        "image_width": image_width,
        "image_height": image_height,
        "samples": samples,
        "tiers": None if tiers is None else words(tiers),
        "screen": screen,
        "model": model,
        "exposure": exposure,
        "motion_blur": False if disable_motion_blur else None,
        "camera_light": False if disable_camera_light else None,
        "jobs": jobs,
    }
    given = {name: value for name, value in drawing.items() if value is not None}
    how = {"fail_under": fail_under, "overwrite": overwrite}
    with outcome(progress, quiet, verbose) as (report, cancel):
        if camera and len(camera) > 1:
            raise UsageError("--camera may be given once: what is compared is one picture")
        if _is_stage(first):
            if third:
                raise UsageError(f"{third}: is one word too many; a stage takes one folder, as in STAGE OUTDIR")
            draws = {
                "settings_prim": render_settings_prim_path, "time_code": frame, "reference_samples": reference_samples,
                "suggest": suggest, "write": write, "opening": opening_of(variant, session_layer, mask),
            }  # fmt: skip
            account = _of_stage(first, second, {**how, **draws, "overrides": given}, report, cancel)
            out = second
        else:
            flags = {
                "--suggest": suggest, "--write": write, "--frame": frame is not None,
                "--reference-samples": reference_samples != SAMPLES, "--disable-camera-light": disable_camera_light,
                "--disable-motion-blur": disable_motion_blur,
                "--render-settings-prim-path": render_settings_prim_path,
                "--variant": variant, "--session-layer": session_layer, "--mask": mask,
            }  # fmt: skip
            switches = ("camera_light", "motion_blur", "jobs")
            named = [f"--{name.replace('_', '-')}" for name in given if name not in switches]
            _refuse(first, [flag for flag in (*named, *filter(flags.get, flags)) if _typed(ctx, flag)])
            account = _of_pictures(first, second, third, how)
            out = third
        typer.echo(to_json(account) if as_json else to_text(account, out))
        if account.verdict:
            report.error(account.verdict)
            raise typer.Exit(1)


def _is_stage(path: str) -> bool:
    """By its name; a package may name a layer inside, as in `a.usdz[b.usda]`."""
    return os.path.splitext(path.partition("[")[0])[1].lower() in STAGES


def _typed(ctx: typer.Context, flag: str) -> bool:
    """It was asked for here and now; a default in the environment is for those comparisons that can use it."""
    source = ctx.get_parameter_source(flag.lstrip("-").replace("-", "_"))
    return source is not None and source.name == "COMMANDLINE"


def _refuse(picture: str, flags: list[str]) -> None:
    if flags:
        raise UsageError(f"{flags[0]}: says how to draw, and {picture} is a picture already; leave it out")


def _of_stage(
    stage: str, out: str, how: dict[str, Any], report: Report, cancel: Callable[[], bool]
) -> Account:
    from ..verbs.compare_renders import CompareOrder, compare_stage

    return compare_stage(CompareOrder(stage=stage, out=out, **how), report, cancel)


def _of_pictures(picture: str, reference: str, out: str, how: dict[str, Any]) -> Account:
    from ..verbs.compare_pictures import PicturesOrder, compare_pictures

    return compare_pictures(PicturesOrder(picture=picture, reference=reference, out=out, **how))
