"""`refract turntable`."""

from __future__ import annotations

from typing import Annotated

import typer

from ..verbs.executors import crew_at
from ..verbs.render_files import Order
from ..verbs.turntable import turntable as turn
from .app import Jobs, Mask, ProgressMode, Quiet, SessionLayer, Variant, Verbose, app, opening_of, outcome, words
from .orbit import Azimuth, Distance, Elevation, Fit, FocalLength, Fov, LookAt, orbit_of
from .render import (
    Aovs,
    Background,
    Caustics,
    ColorCorrection,
    Complexity,
    Denoise,
    DisableCameraLight,
    Environment,
    Executor,
    Exposure,
    ImageHeight,
    ImageWidth,
    Indirect,
    ModelName,
    Override,
    Preset,
    Purposes,
    Quality,
    Samples,
    SettingsPrim,
    SkipExisting,
    Stage,
    Studio,
    materials_of,
    photons_of,
    purposes_of,
)

Out = Annotated[
    str,
    typer.Argument(
        metavar="OUT",
        help="A name with one ### group, such as turn.####.png, for a picture of each side, numbered from 1; or a "
        ".gif, .webp or .mp4 that holds all of them. .mp4 needs the extra `video`.",
    ),
]
Frames = Annotated[int, typer.Option(help="Pictures of one turn.")]
Fps = Annotated[float, typer.Option(help="Pictures a second in a .gif, .webp or .mp4.")]
TimeCode = Annotated[str, typer.Option(metavar="NUMBER", help="Time of the stage. Without it the stage's start.")]
Camera = Annotated[
    str | None,
    typer.Option(help="Prim path or name of the camera to start from. Without it the turn is by a camera of its own."),
]


@app.command()
def turntable(
    stage: Stage,
    out: Out,
    frames: Frames = 36,
    fps: Fps = 12.0,
    time_code: TimeCode = "",
    camera: Camera = None,
    azimuth: Azimuth = None,
    elevation: Elevation = None,
    distance: Distance = None,
    fit: Fit = None,
    fov: Fov = None,
    focal_length: FocalLength = None,
    look_at: LookAt = "",
    image_width: ImageWidth = None,
    image_height: ImageHeight = None,
    quality: Quality = None,
    preset: Preset = None,
    samples: Samples = None,
    caustics: Caustics = None,
    indirect: Indirect = None,
    model: ModelName = None,
    override: Override = None,
    aovs: Aovs = "",
    purposes: Purposes = None,
    complexity: Complexity = "low",
    color_correction_mode: ColorCorrection = "sRGB",
    exposure: Exposure = None,
    denoise: Denoise = False,
    disable_camera_light: DisableCameraLight = False,
    studio: Studio = None,
    environment: Environment = None,
    background: Background = None,
    render_settings_prim_path: SettingsPrim = "",
    variant: Variant = None,
    session_layer: SessionLayer = "",
    mask: Mask = "",
    jobs: Jobs = None,
    executor: Executor = "",
    skip_existing: SkipExisting = False,
    progress: ProgressMode = "auto",
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Render a stage from all sides, as one picture each or as one file that turns.

    The first looks from --azimuth, the others follow at equal angles to the right. All are taken from one distance: the
    least from which none of them cuts what it frames, where --distance says nothing else.
    """
    with outcome(progress, quiet, verbose) as (report, cancel), crew_at(executor) as crew:
        given = {
            **orbit_of(azimuth, elevation, distance, fit, fov, focal_length, look_at),
            "image_width": image_width,
            "image_height": image_height,
            "quality": quality,
            "preset": preset,
            "samples": samples,
            "caustics": None if caustics is None else photons_of(caustics, quality or ""),
            "indirect": indirect,
            "model": model,
            "purposes": None if purposes is None else purposes_of(purposes),
            "exposure": exposure,
            "denoise": denoise or None,
            "camera_light": False if disable_camera_light else None,
            "studio": studio,
            "environment": environment,
            "background": background,
            "jobs": jobs,
        }
        order = Order(
            stage=stage,
            out=out,
            cameras=(camera,) if camera else (),
            frames=time_code,
            turn=frames,
            overrides={name: value for name, value in given.items() if value is not None},
            materials=materials_of(override or []),
            settings_prim=render_settings_prim_path,
            aovs=words(aovs),
            color_correction=color_correction_mode,
            complexity=complexity,
            skip_existing=skip_existing,
            opening=opening_of(variant, session_layer, mask),
        )
        turn(order, fps, report, cancel, crew)
