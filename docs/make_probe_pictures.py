"""Make the pictures of docs/probes.md: `python -m docs.make_probe_pictures [NAME ...]`, from the project's folder.

A picture is a row of panels, and a panel is one of the stages with a few opinions over it. `FIGURES` says which.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import refract_core as rc
from refract_core.images.cubemaps import write_cubemap
from refract_core.images.layouts import arrange
from refract_core.images.pictures import display, read_texture, write_frame
from refract_core.images.srgb import srgb_encode
from refract_core.progress import Report
from refract_core.rendering.ready import capture_probes
from refract_core.scene import Cubemap
from refract_core.verbs.bake_probes import BakeOrder, bake_probes

RGB = NDArray[np.float32]
"""shape (H, W, 3), as it is shown, 0 .. 1"""

Edits = tuple[tuple[str, str], ...]
"""path of a prim below /World, and opinions as text"""

HERE = Path(__file__).parent
PICTURES, STAGES = HERE / "pictures", HERE / "stages"
SAMPLES = HERE.parent / "usd_samples" / "good"
WIDTH, HEIGHT, GAP = 360, 200, 6
TIER_COLORS = {
    "weight.screen": (0.86, 0.30, 0.22),
    "weight.ray": (0.95, 0.78, 0.20),
    "weight.probe": (0.25, 0.66, 0.36),
    "weight.sky": (0.30, 0.52, 0.86),
}  # what none answers stays black
PROBE_TIERS = ("probe", "sky")


class Panel(NamedTuple):
    """One rendered stage."""

    stage: str
    edits: Edits = ()
    """opinions over the prims below /World"""
    tiers: tuple[str, ...] = PROBE_TIERS
    camera: str = ""
    show: str = "beauty"
    """`beauty`, `weight.probe` in false colour, or `tiers`: who answered"""
    time_code: float | None = None
    screen: str = "traced"
    samples: int = 16
    max_layers: int = 16


# ------------------------------------------------------------------------------------------------ stages with edits


def over(path: str, text: str) -> Edits:
    """Opinions about one prim below /World."""
    return ((path, text),)


def probe(text: str) -> Edits:
    return over("Probe", text)


def shown(*names: str) -> Edits:
    return tuple((name, 'token visibility = "inherited"') for name in names)


def hidden(*names: str) -> Edits:
    return tuple((name, 'token visibility = "invisible"') for name in names)


def faces(name: str, *values: float) -> str:
    """Six values of a probe, or one for all six."""
    listed = ", ".join(f"{value:g}" for value in (values * 6)[:6])
    return f"float[] probe:influence:{name} = [{listed}]\n"


def layer_over(stage: Path, edits: Edits) -> str:
    """A layer with opinions over a stage of the page, as text."""
    opinions = {path: "\n".join(text for other, text in edits if other == path) for path, _ in edits}
    body = ""
    for path, text in opinions.items():
        names = path.split("/")
        body += "".join(f'over "{name}"\n{{\n' for name in names) + text + "\n" + "}\n" * len(names)
    return (
        f'#usda 1.0\n(\n    defaultPrim = "World"\n    metersPerUnit = 1\n    startTimeCode = 1\n    upAxis = "Y"\n'
        f'    subLayers = [@{stage.as_posix()}@]\n)\n\nover "World"\n{{\n{body}}}\n'
    )


def load(panel: Panel, folder: Path) -> rc.Scene:
    found = next(path for path in (STAGES / panel.stage, SAMPLES / panel.stage) if path.exists())
    edited = folder / "edited.usda"
    edited.write_text(layer_over(found, panel.edits), encoding="utf-8")
    scene = rc.load_stage(str(edited), time_code=panel.time_code, camera=panel.camera)
    for notice in scene.notices:
        if "name another" not in notice.text:
            print(f"{panel.stage}: {notice.path}: {notice.text}", file=sys.stderr)
    return scene


# ------------------------------------------------------------------------------------------------ pictures


def drawn(panel: Panel, folder: Path) -> RGB:
    """Render a panel as it is shown."""
    settings = rc.RenderSettings(
        image_width=WIDTH, image_height=HEIGHT, samples=panel.samples, tiers=panel.tiers, screen=panel.screen,
        max_layers=panel.max_layers,
    )  # fmt: skip
    frame = rc.render(load(panel, folder), settings)
    beauty = display("beauty", frame.planes["beauty"])[..., :3].astype(np.float32) / 255.0
    if panel.show == "beauty":
        return beauty
    mask = frame.planes["mask"][..., None]
    if panel.show == "tiers":
        color = mask * sum(frame.planes[name][..., None] * np.array(rgb) for name, rgb in TIER_COLORS.items())
        around = 0.5 + 0.3 * beauty.mean(axis=2, keepdims=True)
    else:
        color = false_color(frame.planes[panel.show]) * mask
        around = np.full_like(mask, 0.93)
    return (color + around * (1.0 - mask)).astype(np.float32)


def false_color(values: NDArray[np.float32]) -> RGB:
    """0 dark blue, over violet and orange, to 1 yellow."""
    stops = np.array(
        [(0.10, 0.12, 0.33), (0.42, 0.16, 0.50), (0.76, 0.27, 0.36), (0.96, 0.55, 0.20), (0.99, 0.90, 0.42)]
    )
    at = np.linspace(0.0, 1.0, len(stops))
    return np.stack([np.interp(values, at, stops[:, c]) for c in range(3)], axis=-1).astype(np.float32)


def pasted(panels: list[RGB], columns: int) -> RGB:
    """Panels of one size side by side, with white between."""
    height, width = panels[0].shape[:2]
    rows = -(-len(panels) // columns)
    out = np.ones((rows * (height + GAP) - GAP, columns * (width + GAP) - GAP, 3), np.float32)
    for i, panel in enumerate(panels):
        y, x = i // columns * (height + GAP), i % columns * (width + GAP)
        out[y : y + height, x : x + width] = panel
    return out


def save(name: str, picture: RGB) -> None:
    PICTURES.mkdir(exist_ok=True)
    beauty = np.concatenate([picture, np.ones_like(picture[..., :1])], axis=2)
    write_frame(str(PICTURES / f"{name}.png"), {"beauty": beauty}, {}, color_correction="disabled")


# ------------------------------------------------------------------------------------------------ cubemaps


def compass() -> Cubemap:
    """Six faces, each of one colour, with a disc in the middle and its upper left quarter dark."""
    n = 64
    y, x = np.mgrid[0:n, 0:n] * 2.0 / (n - 1) - 1.0
    disc, quarter = np.hypot(x, y) < 0.45, (x < 0.0) & (y < 0.0)
    colors = [
        (0.7, 0.08, 0.05),
        (0.1, 0.55, 0.6),
        (0.85, 0.85, 0.85),
        (0.12, 0.10, 0.09),
        (0.15, 0.2, 0.7),
        (0.8, 0.55, 0.05),
    ]
    texels = np.empty((6, n, n, 5), np.float32)
    for face, color in enumerate(colors):
        shade = np.where(disc, 1.0, 0.45) * np.where(quarter, 0.5, 1.0)
        texels[face, ..., :3] = shade[..., None] * np.array(color)
        texels[face, ..., 3:] = 1.0
    return Cubemap((texels,))


def texture(folder: Path) -> RGB:
    """A cross, and a ball that shows it."""
    cubemap, file = compass(), folder / "compass.exr"
    write_cubemap(str(file), cubemap, "cross")
    cross = srgb_encode(arrange(cubemap.levels[0], "cross")[..., :3])
    edits = 'uniform token probe:mode = "custom"\nuniform token probe:proxy = "infinite"\n'
    ball = drawn(Panel("room.usda", probe(f"{edits}asset probe:texture = @{file.as_posix()}@")), folder)
    return pasted([on_panel(cross, empty=arrange(np.ones_like(cubemap.levels[0]), "cross")[..., :1] == 0.0), ball], 2)


def on_panel(picture: RGB, empty: NDArray[np.bool_]) -> RGB:
    """A picture of the height of a panel, in its middle."""
    rows = np.arange(HEIGHT) * picture.shape[0] // HEIGHT
    columns = np.arange(HEIGHT * picture.shape[1] // picture.shape[0]) * picture.shape[0] // HEIGHT
    fitted = np.where(empty, np.float32(1.0), picture)[rows][:, columns]
    out = np.ones((HEIGHT, WIDTH, 3), np.float32)
    left = (WIDTH - len(columns)) // 2
    out[:, left : left + len(columns)] = fitted
    return out


def levels(folder: Path) -> RGB:
    """One face of all seven levels of a probe."""
    scene = load(Panel("room.usda", probe("uniform int probe:resolution = 64")), folder)
    (cubemap,) = capture_probes(scene, scene.probes, samples=64)
    side = 150
    squares = []
    for level in cubemap.levels:
        face = srgb_encode(level[0, ..., :3])
        at = np.arange(side) * face.shape[0] // side
        squares.append(face[at][:, at])
    return pasted(squares, len(squares))


def baked(folder: Path) -> RGB:
    """The cross that `refract bake probes --layout cross` writes, in half size."""
    silent = Report(lambda _f, _s: None, lambda _p, _t: None, lambda _p, _t: None, lambda _t: None)
    out = folder / "baked.usda"
    bake_probes(BakeOrder(stage=str(STAGES / "room.usda"), out=str(out), layout="cross"), silent, lambda: False)
    (file,) = out.with_suffix(".probes").glob("*.exr")
    pixels = read_texture(str(file), name=file.name, color_space="raw").pixels.astype(np.float32)
    height, width = pixels.shape[0] // 2, pixels.shape[1] // 2
    small = pixels.reshape(height, 2, width, 2, 4).mean(axis=(1, 3))
    return np.where(small[..., 3:] > 0.0, srgb_encode(np.clip(small[..., :3], 0.0, 1.0)), np.float32(1.0))


# ------------------------------------------------------------------------------------------------ what there is


def room(text: str = "", **choices: Any) -> Panel:
    return Panel("room.usda", probe(text), **choices)


def field(text: str, more: Edits = ()) -> Panel:
    return Panel("field.usda", probe(text) + more, show="weight.probe", samples=4)


def two(text: str, other: str) -> Panel:
    blend = faces("blendDistance", 0.5)
    return Panel("field.usda", probe(blend + text) + over("Other", blend + other) + shown("Other"), samples=4)


def mirror(text: str, **choices: Any) -> Panel:
    edits = probe("uniform int probe:resolution = 512\n" + text) + shown("FloorMirror") + hidden("Ball")
    return Panel("room.usda", edits, camera="Low", **choices)


def glass_box(wanted: str) -> Panel:
    """The box made of green glass, and whether the probe sees that."""
    stuff = (
        'uniform token refraction:model = "traced"\ncolor3f inputs:refraction:transmittanceColor = (0.3, 0.8, 0.5)\n'
        'float inputs:refraction:absorptionDistance = 0.5\nover "Surface"\n{\nfloat inputs:roughness = 0\n}'
    )
    see = (
        f'uniform token probe:mode = "realtime"\nuniform bool probe:captureRefraction = {wanted}\n'
        "uniform int probe:resolution = 512\nrel collection:captured:excludes = [</World/Ball>]"
    )
    box = over("Box", "rel material:binding = </World/Looks/Pane>") + over("Looks/Pane", stuff)
    return Panel("room.usda", probe(see) + box, max_layers=1)


def pane(*tiers: str, roughness: float = 0.35, samples: int = 16, more: Edits = ()) -> Panel:
    rough = over("Looks/Pane/Surface", f"float inputs:roughness = {roughness}")
    edits = probe("uniform int probe:resolution = 512") + shown("Pane") + hidden("Ball") + rough + more
    return Panel("room.usda", edits, tiers=tiers, samples=samples)


def table(text: str, *tiers: str) -> Panel:
    return Panel("planar_table.usda", over("TableProbe", text), tiers=tiers or PROBE_TIERS)


WIDE = "float3 probe:influence:size = (30, 8, 30)\n"
NORMALS = shown("Balls") + hidden("Sheet")
NEAR_WALL = over("Pane", "double3 xformOp:translate = (0, 1.2, -1.75)\nfloat3 xformOp:rotateXYZ = (0, 40, 0)")
FIGURES: Mapping[str, tuple[Panel, ...] | Callable[[Path], RGB]] = {
    "hierarchy": (
        Panel("two_probes.usda", tiers=("screen", "probe", "sky")),
        Panel("two_probes.usda", tiers=("screen", "probe", "sky"), show="tiers"),
        Panel("two_probes.usda", tiers=("screen", "sky"), show="tiers"),
        Panel("two_probes.usda", tiers=("screen",), show="tiers"),
    ),
    "mode": tuple(
        room(f'uniform token probe:mode = "{mode}"\n{given}', time_code=12.0)
        for mode, given in (
            ("baked", ""),
            ("realtime", ""),
            ("custom", f"asset probe:texture = @{(SAMPLES / 'textures' / 'studio.exr').as_posix()}@"),
        )
    ),
    "texture": texture,
    "resolution": tuple(room(f"uniform int probe:resolution = {n}") for n in (16, 64, 256)),
    "clipping_range": tuple(
        room(f"float2 probe:clippingRange = {span}") for span in ("(0.1, 1000)", "(2.4, 1000)", "(0.1, 2.4)")
    ),
    "capture_offset": tuple(
        room(f"float3 probe:captureOffset = {at}") for at in ("(0, -0.55, 0)", "(-1.2, -0.55, 1.1)", "(1.75, -1, 0.9)")
    ),
    "clear": tuple(
        Panel(
            "ring.usda",
            probe(f'uniform token probe:clear = "{clear}"\ncolor3f probe:backgroundColor = (0.8, 0.4, 0.1)'),
            samples=64,
        )
        for clear in ("sky", "color")
    ),
    "captured": (
        room(),
        room("rel collection:captured:excludes = [</World/Cone>, </World/Box>]"),
        room(
            "uniform bool collection:captured:includeRoot = 0\n"
            "rel collection:captured:includes = [</World/Cone>, </World/Box>]"
        ),
    ),
    "capture_refraction": (
        glass_box("0"),
        glass_box("1"),
        glass_box("0")._replace(tiers=("ray", "sky"), max_layers=16),
    ),
    "shape": (
        field("float3 probe:influence:size = (6, 3, 3.2)"),
        field("float3 probe:influence:size = (3, 3, 4.4)"),
        field('uniform token probe:shape = "sphere"\nfloat probe:influence:radius = 1'),
        field('uniform token probe:shape = "sphere"\nfloat probe:influence:radius = 2.2'),
    ),
    "blend_distance": (
        field(faces("blendDistance", 0.0)),
        field(faces("blendDistance", 1.0)),
        field(faces("blendDistance", 3.0, 0.2, 0.0, 0.0, 0.8, 0.8)),
    ),
    "blend_normal_distance": tuple(
        field(faces("blendNormalDistance", *distances) + "float3 probe:influence:size = (8.6, 3, 4.6)", NORMALS)
        for distances in ((0.0,), (1.4, 1.4, 0.0, 0.0, 1.4, 1.4), (4.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    ),
    "face_fade": tuple(
        field(WIDE + faces("faceFade", *fade))._replace(camera="Wide")
        for fade in ((1.0, 1.0, 1.0, 0.5, 1.0, 1.0), (1.0, 1.0, 1.0, 0.0, 1.0, 1.0), (1.0, 0.0, 1.0, 0.0, 1.0, 1.0))
    ),
    "proxy": (
        mirror('uniform token probe:proxy = "infinite"'),
        mirror('uniform token probe:proxy = "influence"\nfloat3 probe:influence:size = (4.6, 3, 4.6)'),
        mirror('uniform token probe:proxy = "volume"\nfloat3 probe:proxy:size = (6, 3, 6)'),
        mirror('uniform token probe:proxy = "volume"\nrel probe:proxy:prim = </World/Room>'),
    ),
    "depth": (
        room(
            'uniform token probe:mode = "realtime"\nuniform token probe:proxy = "volume"\n'
            "rel probe:proxy:prim = </World/Room>"
        ),
        room(
            'uniform token probe:mode = "realtime"\nuniform token probe:proxy = "depth"', tiers=("probe", "ray", "sky")
        ),
        room(tiers=("ray", "sky")),
    ),
    "proxy_radius": tuple(
        Panel(
            "ring.usda",
            probe(f'uniform token probe:proxy = "{proxy}"\nfloat probe:proxy:radius = {radius}'),
            samples=64,
        )
        for proxy, radius in (("volume", 3), ("volume", 8), ("infinite", 3))
    ),
    "importance": tuple(
        two(f"int probe:importance = {first}", f"int probe:importance = {second}")
        for first, second in ((2, 1), (1, 2), (1, 1))
    ),
    "weight": tuple(
        two(f"int probe:importance = 2\nfloat probe:weight = {first}", f"float probe:weight = {second}")
        for first, second in ((1, 1), (0.5, 1), (0.5, 0.5))
    ),
    "multiplier": tuple(room(f"float probe:multiplier = {factor}") for factor in (0.4, 1, 2)),
    "fade_distance": tuple(
        Panel("row.usda", over("_Probe", f"float probe:fadeDistance = {distance}")) for distance in (10000, 7, 5.3)
    ),
    "distance_based_roughness": tuple(
        pane("probe", more=NEAR_WALL + probe(f"uniform bool probe:distanceBasedRoughness = {wanted}"))._replace(
            screen="proxy"
        )
        for wanted in (0, 1)
    ),
    "planar": (
        table('token visibility = "invisible"'),
        table("uniform int probe:resolution = 1024"),
        table("uniform int probe:resolution = 64"),
        table("", "ray", "sky")._replace(samples=32),
    ),
    "rough": (
        pane("screen", roughness=0.0),
        pane("screen"),
        pane("probe"),
        pane("ray", samples=128),
    ),
    "levels": levels,
    "baked": baked,
}
COLUMNS = {2: 2, 3: 3, 4: 2}
"""Panels beside each other, by their number."""


def main(names: list[str]) -> None:
    """Make these pictures, or all."""
    for name in names or list(FIGURES):
        figure = FIGURES[name]
        with tempfile.TemporaryDirectory() as folder:
            if callable(figure):
                picture = figure(Path(folder))
            else:
                picture = pasted([drawn(panel, Path(folder)) for panel in figure], COLUMNS[len(figure)])
        save(name, picture)
        print(name, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
