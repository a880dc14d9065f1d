"""`refract render`."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from ..errors import UsageError
from ..images.exr import COMPRESSIONS, PARTS, USUAL, Layout
from ..models import MODELS, explained
from ..settings import PRESETS, QUALITIES, STUDIOS
from ..verbs.executors import crew_at
from ..verbs.override import COLORS, RANGES
from ..verbs.render_files import Order, render_files
from .app import Jobs, Mask, ProgressMode, Quiet, SessionLayer, Variant, Verbose, app, opening_of, outcome, words
from .looks import shown_on_signal
from .orbit import Azimuth, Distance, Elevation, Fit, FocalLength, Fov, LookAt, orbit_of
from .stdout import STDOUT, written_to

Stage = Annotated[
    str,
    typer.Argument(metavar="STAGE", help="The .usd, .usda, .usdc, .usdz, .glb, .gltf or .mtlx file to render."),
]
Out = Annotated[
    str,
    typer.Argument(
        metavar="[OUT]",
        show_default=False,
        help="The picture to write: .exr holds all AOVs, .png, .jpg, .webp and .tif hold one. With several --frames "
        "the file name has one ### group, such as shot.###.png, or shot.###.##.png for fractions of a frame. Without "
        "OUT, the RenderProducts of the stage's RenderSettings are written, each under its productName. With {aov} in "
        "the file name, as in shot.{aov}.png, each of --aovs has a file of its own. - is one picture on stdout.",
    ),
]
Camera = Annotated[
    list[str] | None,
    typer.Option(
        help="Prim path or name of the camera. Without it the stage's choice is taken, as usdrecord does. May be "
        "repeated, for one picture each: OUT then has {camera} where its name goes, such as shot.{camera}.png."
    ),
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
Crop = Annotated[
    str,
    typer.Option(
        metavar="X0,Y0,X1,Y1",
        help="Draw this part of the picture alone, from the upper left: shares of its sides where none is above 1, "
        "else pixels. Its pixels are those of the whole picture; an .exr has it as data window in the display window.",
        show_default=False,
    ),
]
TileCount = Annotated[
    tuple[int, int] | None,
    typer.Option(
        metavar="COLUMNS ROWS",
        help="Cut the picture into so many parts, and draw one of them; `refract join` makes them one picture again.",
        show_default=False,
    ),
]
TileIndex = Annotated[
    int | None,
    typer.Option(help="Which of them: row by row, from 0 on the upper left.", show_default=False),
]
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
        "transmittanceColor (red,green,blue, each 0 to 1), absorptionDistance or abbeNumber (0 is no dispersion); "
        "lengths are in the stage's units.",
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
        metavar="LIST",
        help="AOVs to write, with commas between. Without it .exr gets all but albedo and denoising_normal, which are "
        "drawn only where they are named; other formats get the picture.",
    ),
]
PipeFormat = Annotated[
    str,
    typer.Option(
        "--format", metavar="png|exr|jpg|tif|webp|avif", help="What a picture on stdout (OUT -) is. The default is png."
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
Denoise = Annotated[
    bool,
    typer.Option(
        "--denoise",
        help="Take the noise out of the picture with Open Image Denoise, which the extra denoise brings. It is told "
        "albedo and normal of what is seen, also through glass. All other AOVs stay as they are drawn.",
    ),
]
Exposure = Annotated[float | None, typer.Option(help="Stops of light added to the camera's own exposure.")]
DisableCameraLight = Annotated[
    bool,
    typer.Option(
        "--disable-camera-light",
        help="Add no light where the stage has none: no studio by itself, and none from the camera.",
    ),
]
DisableMotionBlur = Annotated[
    bool,
    typer.Option(
        "--disable-motion-blur",
        help="Let everything stand still at the time of the frame, however long the camera's shutter is open.",
    ),
]
DisableEmissionLight = Annotated[
    bool,
    typer.Option(
        "--disable-emission-light",
        help="Let what glows be seen, but light nothing else, as real-time engines have it.",
    ),
]
Studio = Annotated[
    str | None,
    typer.Option(
        metavar="|".join(STUDIOS),
        help="Put lamps, a dome and a floor around what is drawn, whatever light the stage has. Without it softbox is "
        "used where a thing has no light at all; none leaves it out.",
    ),
]
Environment = Annotated[
    str | None,
    typer.Option(
        metavar="FILE", help="A latlong .hdr or .exr picture that lights the stage in place of its domes. It excludes "
        "--studio."
    ),
]
Background = Annotated[
    str | None,
    typer.Option(
        metavar="transparent|#rrggbb|environment",
        help="What is seen past everything, and through glass: nothing, which is left open in the picture's alpha, one "
        "colour, or the dome and a studio's floor. Light and reflections stay as they are. The default is environment.",
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
Cryptomatte = Annotated[
    str | None,
    typer.Option(
        metavar="LIST",
        help="Mattes to write into an .exr, out of object and material: whose each part of a pixel is, by the first "
        "surface seen (Cryptomatte 1.2).",
    ),
]
ExrCompression = Annotated[
    str,
    typer.Option(
        metavar="|".join(COMPRESSIONS),
        help="How an .exr is compressed: zips is what compositing reads fastest; dwaa is small and loses what no eye "
        "sees, of colours alone.",
    ),
]
ExrParts = Annotated[
    str,
    typer.Option(
        metavar="|".join(PARTS),
        help="many writes each AOV as a part of its own, the picture first; one writes all channels into one part, for "
        "programs that know nothing else.",
    ),
]
Strict = Annotated[
    bool,
    typer.Option(
        "--strict",
        help="Fail where a picture shows nothing of the stage, or was stopped by --time-limit. It is written, and the "
        "rest is rendered.",
    ),
]
TimeLimit = Annotated[
    float,
    typer.Option(
        metavar="SECONDS",
        help="Stop a picture after this time, and write what it is then: every pixel is drawn with one sample first, "
        "so that it is whole. A warning says how much is as asked. If not even that was done in time, nothing is "
        "written and the exit code is 1.",
        show_default=False,
    ),
]
SnapshotEvery = Annotated[
    float,
    typer.Option(
        "--snapshot",
        metavar="SECONDS",
        help="Write what is finished so far this often, as OUT with _part before its extension, and whenever the "
        "process gets SIGUSR1. It goes when the picture is there.",
        show_default=False,
    ),
]


@app.command()
def render(
    stage: Stage,
    out: Out = "",
    camera: Camera = None,
    azimuth: Azimuth = None,
    elevation: Elevation = None,
    distance: Distance = None,
    fit: Fit = None,
    fov: Fov = None,
    focal_length: FocalLength = None,
    look_at: LookAt = "",
    frames: Frames = "",
    image_width: ImageWidth = None,
    image_height: ImageHeight = None,
    crop: Crop = "",
    tile_count: TileCount = None,
    tile_index: TileIndex = None,
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
    form: PipeFormat = "",
    purposes: Purposes = None,
    complexity: Complexity = "low",
    color_correction_mode: ColorCorrection = "sRGB",
    denoise: Denoise = False,
    cryptomatte: Cryptomatte = None,
    exr_compression: ExrCompression = USUAL.compression,
    exr_parts: ExrParts = USUAL.parts,
    exposure: Exposure = None,
    disable_motion_blur: DisableMotionBlur = False,
    disable_camera_light: DisableCameraLight = False,
    disable_emission_light: DisableEmissionLight = False,
    studio: Studio = None,
    environment: Environment = None,
    background: Background = None,
    render_settings_prim_path: SettingsPrim = "",
    variant: Variant = None,
    session_layer: SessionLayer = "",
    mask: Mask = "",
    jobs: Jobs = None,
    executor: Executor = "",
    tile_size: TileSize = None,
    skip_existing: SkipExisting = False,
    strict: Strict = False,
    time_limit: TimeLimit = 0.0,
    snapshot: SnapshotEvery = 0.0,
    progress: ProgressMode = "auto",
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Render a stage to a picture, or to one picture per frame."""
    with (
        outcome(progress, quiet, verbose) as (report, cancel),
        written_to(out, form, frames, words(aovs), report) as (file, report),
        crew_at(executor) as crew,
        shown_on_signal() as asked,
    ):
        if skip_existing and out == STDOUT:
            raise UsageError("--skip-existing: a picture on stdout (OUT -) is never there before; name a file")
        given = {
            **orbit_of(azimuth, elevation, distance, fit, fov, focal_length, look_at),
            "image_width": image_width,
            "image_height": image_height,
            **part_of(crop, tile_count, tile_index),
            "quality": quality,
            "preset": preset,
            "samples": samples,
            "tolerance": tolerance,
            "light_samples": light_samples,
            "caustics": None if caustics is None else photons_of(caustics, quality or ""),
            "indirect": indirect,
            "cut": cut,
            "tiers": None if tiers is None else words(tiers),
            "screen": screen,
            "model": model,
            "max_layers": max_layers,
            "purposes": None if purposes is None else purposes_of(purposes),
            "denoise": denoise or None,
            "cryptomatte": None if cryptomatte is None else words(cryptomatte),
            "exposure": exposure,
            "motion_blur": False if disable_motion_blur else None,
            "camera_light": False if disable_camera_light else None,
            "emission_light": False if disable_emission_light else None,
            "studio": studio,
            "environment": environment,
            "background": background,
            "jobs": jobs,
            "tile_size": tile_size,
        }
        order = Order(
            stage=stage,
            out=file,
            cameras=tuple(camera or ()),
            frames=frames,
            overrides={name: value for name, value in given.items() if value is not None},
            materials=materials_of(override or []),
            settings_prim=render_settings_prim_path,
            aovs=words(aovs),
            color_correction=color_correction_mode,
            complexity=complexity,
            skip_existing=skip_existing,
            strict=strict,
            time_limit=time_limit,
            snapshot=snapshot,
            opening=opening_of(variant, session_layer, mask),
            layout=Layout(exr_compression, exr_parts),
        )
        render_files(order, report, cancel, crew, asked)


def part_of(crop: str, count: tuple[int, int] | None, index: int | None) -> dict[str, Any]:
    """Which part of the picture is drawn. Raises UsageError."""
    if (count is None) != (index is None):
        raise UsageError("--tile-count and --tile-index go together: into how many parts, and which of them")
    try:
        part = tuple(float(word) for word in crop.split(",")) if crop else None
    except ValueError:
        raise UsageError(f"--crop is '{crop}'; it must be four numbers, x0,y0,x1,y1") from None
    return {"crop": part, "tile_count": count, "tile_index": index}


def photons_of(text: str, quality: str) -> int:
    """`on` is what the quality has, or good where that has none. Raises UsageError."""
    if text in ("on", "off"):
        usual = QUALITIES["good"]["caustics"]
        return max(usual, QUALITIES.get(quality, {}).get("caustics", 0)) if text == "on" else 0
    try:
        return int(text)
    except ValueError:
        raise UsageError(f"--caustics is '{text}'; it must be on, off, or a number of photons") from None


def purposes_of(text: str) -> tuple[str, ...]:
    """usdrecord's rule: default is always drawn."""
    return ("default", *(word for word in words(text) if word != "default"))


def materials_of(given: list[str]) -> dict[str, dict[str, Any]]:
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
