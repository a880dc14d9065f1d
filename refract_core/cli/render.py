"""`refract render`."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from ..errors import UsageError
from ..models import MODELS, explained
from ..settings import PRESETS, QUALITIES
from ..verbs.executors import crew_at
from ..verbs.override import COLORS, RANGES
from ..verbs.render_files import Order, render_files
from .app import Jobs, Mask, ProgressMode, SessionLayer, Variant, app, opening_of, outcome, words

Stage = Annotated[
    str, typer.Argument(metavar="STAGE", help="The .usd, .usda, .usdc or .usdz file to render, or a .mtlx file.")
]
Out = Annotated[
    str,
    typer.Argument(
        metavar="[OUT]",
        show_default=False,
        help="The picture to write: .exr holds all AOVs, .png, .jpg, .webp and .tif hold one. With several --frames "
        "the file name has one ### group, such as shot.###.png, or shot.###.##.png for fractions of a frame. Without "
        "OUT, the RenderProducts of the stage's RenderSettings are written, each under its productName.",
    ),
]
Camera = Annotated[
    str | None,
    typer.Option(help="Prim path or name of the camera. Without it the stage's choice is taken, as usdrecord does."),
]
Frames = Annotated[
    str,
    typer.Option(
        "--frames",
        "-f",
        metavar="FRAMESPEC",
        help="Frames to render: 101, 101:110, 101:110x2, with commas between several. Without it the stage's start.",
    ),
]
ImageWidth = Annotated[
    int | None, typer.Option("--image-width", "-w", help="Width in pixels. The default is 960.", show_default=False)
]
ImageHeight = Annotated[int | None, typer.Option(help="Height in pixels. Without it the camera's aspect decides.")]
Samples = Annotated[
    int | None,
    typer.Option(
        help="Samples of a pixel whose corners differ, 1 to 4096; 1 stands in its middle. The default is 16."
    ),
]
Quality = Annotated[
    str | None,
    typer.Option(
        metavar="|".join(QUALITIES),
        help="How much work goes into a picture: samples, tolerance, light samples and how faint a branch of light is "
        "followed. The default is good; settings by name win over it.",
    ),
]
Preset = Annotated[
    str | None,
    typer.Option(
        metavar="|".join(PRESETS),
        help="hdrp draws what Unity's HDRP would: the screen by proxy, then probes and sky, and one layer of glass. "
        "arm draws what Arm's local cubemaps would: one refraction at the surface, then probes and sky, one layer.",
    ),
]
Cut = Annotated[
    float | None,
    typer.Option(help="Weight below which a branch of light is not followed for itself, 0 to 1. The default is 0.02."),
]
Tolerance = Annotated[
    float | None,
    typer.Option(
        help="Difference of a pixel's corners, as the eye sees it, up to which they make the pixel, 0 to 1; beyond it "
        "samples are drawn. 0 draws all samples of every pixel. The default is 0.03."
    ),
]
LightSamples = Annotated[
    int | None,
    typer.Option(
        help="Rays to a light or to the sky from a pixel's corner that sees a part of it, 1 to 4096. The default is 16."
    ),
]
Caustics = Annotated[
    str | None,
    typer.Option(
        metavar="on|off|INTEGER",
        help="Photons that carry light through glass, and off it, to other surfaces, 0 to 16777216. off, which draft "
        "has, lets light go straight through glass, tinted. The default is 65536, at best 262144.",
    ),
]
Indirect = Annotated[
    str | None,
    typer.Option(
        metavar="off|one|full",
        help="Light that opaque surfaces send each other: none, which is the default, what they send on once, or all. "
        "A room whose light comes by its walls is dark without it.",
    ),
]
Tiers = Annotated[
    str | None,
    typer.Option(
        metavar="LIST",
        help="Where refraction and reflection look for their colour, in this order, out of screen, ray, probe and "
        "sky. The default is screen,probe,ray,sky.",
    ),
]
Screen = Annotated[
    str | None,
    typer.Option(
        metavar="traced|march|proxy",
        help="How the screen tier finds its pixel: traced sends the ray, and asks whether the picture shows what it "
        "meets (the default); march follows it through the depth buffer; proxy does exactly what HDRP does.",
    ),
]
ModelName = Annotated[
    str | None,
    typer.Option(
        "--model",
        metavar="|".join(MODELS),
        help=f"Use this refraction model for every refractive material, whatever the stage says: {explained()}.",
    ),
]
Override = Annotated[
    list[str] | None,
    typer.Option(
        "--override",
        metavar="PATH.FIELD=VALUE",
        help="Change one value of one material, such as /World/Marble.ior=1.33; may be repeated. PATH is a material, "
        "or a mesh or sphere bound to it. FIELD is model, ior (1 to 10), thickness, roughness (0 to 1), "
        "transmittanceColor (red,green,blue, each 0 to 1) or absorptionDistance; lengths are in the stage's units.",
    ),
]
MaxLayers = Annotated[
    int | None,
    typer.Option(
        help="Refractive surfaces that a ray may enter before it sees no more glass, 1 to 32. The default is 16; 1 is "
        "HDRP."
    ),
]
Aovs = Annotated[
    str,
    typer.Option(
        metavar="LIST", help="AOVs to write, with commas between. Without it .exr gets all, other formats the picture."
    ),
]
Purposes = Annotated[
    str | None,
    typer.Option(
        metavar="LIST", help="Purposes to draw besides default, out of render, proxy and guide. The default is render."
    ),
]
Complexity = Annotated[
    str,
    typer.Option(
        metavar="low|medium|high|veryhigh",
        help="How fine subdivision surfaces are: a face of a cage becomes 4 x 4 quads with low, 8 x 8, 16 x 16, and "
        "32 x 32 with veryhigh, all on the limit surface; more where a cage has few faces, fewer where many. And "
        "curves: a tube has 24, 32, 48 or 64 sides, and its pieces half as many segments, fewer where curves are many.",
    ),
]
ColorCorrection = Annotated[
    str,
    typer.Option(
        "--color-correction-mode",
        metavar="disabled|sRGB|openColorIO",
        help="What colours go through on their way into an 8-bit file. An .exr always holds linear light.",
    ),
]
Exposure = Annotated[float | None, typer.Option(help="Stops of light added to the camera's own exposure.")]
DisableCameraLight = Annotated[
    bool,
    typer.Option(
        "--disable-camera-light",
        help="Add no light where the stage has none. Without it one shines from the camera if nothing else shines.",
    ),
]
DisableEmissionLight = Annotated[
    bool,
    typer.Option(
        "--disable-emission-light",
        help="Let what glows be seen, but light nothing else, as real-time engines have it.",
    ),
]
SettingsPrim = Annotated[
    str,
    typer.Option(
        "--render-settings-prim-path",
        metavar="PATH",
        help="RenderSettings prim to take settings from. Without it the one that the stage names; flags win over it.",
    ),
]
TileSize = Annotated[int | None, typer.Option(hidden=True)]
Executor = Annotated[
    str,
    typer.Option(
        metavar="dask://HOST:PORT",
        help="Render the frames on the workers of this Dask cluster. Without it they are rendered here.",
    ),
]
SkipExisting = Annotated[bool, typer.Option("--skip-existing", help="Leave pictures that exist as they are.")]
Strict = Annotated[
    bool,
    typer.Option(
        "--strict", help="Fail where a picture shows nothing of the stage. It is written, and the rest is rendered."
    ),
]


@app.command()
def render(
    stage: Stage,
    out: Out = "",
    camera: Camera = None,
    frames: Frames = "",
    image_width: ImageWidth = None,
    image_height: ImageHeight = None,
    quality: Quality = None,
    preset: Preset = None,
    samples: Samples = None,
    tolerance: Tolerance = None,
    light_samples: LightSamples = None,
    caustics: Caustics = None,
    indirect: Indirect = None,
    cut: Cut = None,
    tiers: Tiers = None,
    screen: Screen = None,
    model: ModelName = None,
    override: Override = None,
    max_layers: MaxLayers = None,
    aovs: Aovs = "",
    purposes: Purposes = None,
    complexity: Complexity = "low",
    color_correction_mode: ColorCorrection = "sRGB",
    exposure: Exposure = None,
    disable_camera_light: DisableCameraLight = False,
    disable_emission_light: DisableEmissionLight = False,
    render_settings_prim_path: SettingsPrim = "",
    variant: Variant = None,
    session_layer: SessionLayer = "",
    mask: Mask = "",
    jobs: Jobs = None,
    executor: Executor = "",
    tile_size: TileSize = None,
    skip_existing: SkipExisting = False,
    strict: Strict = False,
    progress: ProgressMode = "auto",
) -> None:
    """Render a stage to a picture, or to one picture per frame."""
    with outcome(progress) as (report, cancel), crew_at(executor) as crew:
        given = {
            "camera": camera,
            "image_width": image_width,
            "image_height": image_height,
            "quality": quality,
            "preset": preset,
            "samples": samples,
            "tolerance": tolerance,
            "light_samples": light_samples,
            "caustics": None if caustics is None else _photons(caustics, quality or ""),
            "indirect": indirect,
            "cut": cut,
            "tiers": None if tiers is None else words(tiers),
            "screen": screen,
            "model": model,
            "max_layers": max_layers,
            "purposes": None if purposes is None else _purposes(purposes),
            "exposure": exposure,
            "camera_light": False if disable_camera_light else None,
            "emission_light": False if disable_emission_light else None,
            "jobs": jobs,
            "tile_size": tile_size,
        }
        order = Order(
            stage=stage,
            out=out,
            frames=frames,
            overrides={name: value for name, value in given.items() if value is not None},
            materials=_materials(override or []),
            settings_prim=render_settings_prim_path,
            aovs=words(aovs),
            color_correction=color_correction_mode,
            complexity=complexity,
            skip_existing=skip_existing,
            strict=strict,
            opening=opening_of(variant, session_layer, mask),
        )
        render_files(order, report, cancel, crew)


def _photons(text: str, quality: str) -> int:
    """`on` is what the quality has, or good where that has none. Raises UsageError."""
    if text in ("on", "off"):
        usual = QUALITIES["good"]["caustics"]
        return max(usual, QUALITIES.get(quality, {}).get("caustics", 0)) if text == "on" else 0
    try:
        return int(text)
    except ValueError:
        raise UsageError(f"--caustics is '{text}'; it must be on, off, or a number of photons") from None


def _purposes(text: str) -> tuple[str, ...]:
    """usdrecord's rule: default is always drawn."""
    return ("default", *(word for word in words(text) if word != "default"))


def _materials(given: list[str]) -> dict[str, dict[str, Any]]:
    """`PATH.FIELD=VALUE` words by path and field; of two about the same, the last counts."""
    found: dict[str, dict[str, Any]] = {}
    for word in given:
        place, sign, value = word.partition("=")
        path, dot, field = place.rpartition(".")
        if not (sign and dot and field and path.startswith("/")):
            raise UsageError(f"--override is '{word}'; write PATH.FIELD=VALUE, such as /World/Marble.ior=1.33")
        found.setdefault(path, {})[field] = _value(field, value)
    return found


def _value(field: str, text: str) -> Any:
    """A text as its field wants it; one that cannot be so stays a text, and is refused with the field's range."""
    try:
        if field in COLORS:
            return tuple(float(part) for part in text.split(","))
        return float(text) if field in RANGES else text
    except ValueError:
        return text
