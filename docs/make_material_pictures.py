"""Make the pictures of docs/materials.md: `python -m docs.make_material_pictures [NAME ...]`, from the project's
folder.

A picture is a strip of square panels, and a panel is `stages/glass.usda` with a few opinions over it. `STRIPS`
says which.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image

import refract_core as rc
from docs.make_probe_pictures import PICTURES, RGB, STAGES, Edits, hidden, layer_over, over, shown
from refract_core.images.pictures import display

STAGE = STAGES / "glass.usda"
TEXTURES = STAGES.parents[1] / "usd_samples" / "good" / "textures"
SIDE, GAP = 152, 4
COLORS = 200
"""of the palette of a strip, which keeps it small"""


class Panel(NamedTuple):
    """One square of a strip."""

    edits: Edits
    """opinions over the prims below /World"""
    samples: int = 16


# ------------------------------------------------------------------------------------------------ what is in a panel


def glass(text: str, piece: str = "Ball") -> Panel:
    """A piece of glass alone, with opinions about its material."""
    return Panel((hidden("Ball") + shown(piece) if piece != "Ball" else ()) + over("Looks/Glass", text))


def model(token: str) -> str:
    return f'uniform token refraction:model = "{token}"\n'


def number(name: str, value: float) -> str:
    return f"float inputs:refraction:{name} = {value:g}\n"


def color(*rgb: float) -> str:
    return f"color3f inputs:refraction:transmittanceColor = ({', '.join(f'{value:g}' for value in rgb)})\n"


def reader(attribute: str, kind: str, file: str, port: str, extra: str = "") -> str:
    """A texture that drives an input of the material, by the coordinates `st`."""
    return (
        f"{kind} {attribute}.connect = </World/Looks/Glass/Map.outputs:{port}>\n"
        'def Shader "Map"\n{\nuniform token info:id = "UsdUVTexture"\n'
        f"asset inputs:file = @{(TEXTURES / file).as_posix()}@\n{extra}"
        "float2 inputs:st.connect = </World/Looks/Glass/St.outputs:result>\n"
        f"{'float' if port == 'r' else 'float3'} outputs:{port}\n}}\n"
        'def Shader "St"\n{\nuniform token info:id = "UsdPrimvarReader_float2"\nstring inputs:varname = "st"\n'
        "float2 outputs:result\n}\n"
    )


def lines(abbe: float, piece: str) -> Panel:
    """White lines in the dark through a piece that spreads colours."""
    night = shown("Lines", "Night") + hidden("Wall")
    return Panel(glass(number("abbeNumber", abbe) + number("ior", 1.6), piece).edits + night, samples=64)


def two(left: int, right: int) -> Panel:
    """Two balls that share space; amber left and blue right, with priorities."""
    amber, blue = color(0.95, 0.45, 0.05), color(0.08, 0.35, 0.9)
    far = number("absorptionDistance", 0.5)
    return Panel(
        hidden("Ball") + shown("Left", "Right")
        + over(
            "Looks",
            f'over "Glass"\n{{\n{amber}{far}uniform int refraction:priority = {left}\n}}\n'
            f'over "Other"\n{{\n{blue}{far}uniform int refraction:priority = {right}\n}}',
        )
    )  # fmt: skip


def surface(name: str, value: float, token: str) -> Panel:
    """A ball whose surface shader says something of its own."""
    shown_as = glass(f'{model(token)}{BLUE}over "Surface"\n{{\nfloat inputs:{name} = {value:g}\n}}')
    return shown_as._replace(samples=128)


BLUE = color(0.3, 0.7, 0.9) + number("absorptionDistance", 0.6)
RINGS = "float4 inputs:scale = (0.6, 1, 1, 1)\nfloat4 inputs:bias = (0.02, 0, 0, 0)\n"
RAW, SRGB = 'token inputs:sourceColorSpace = "raw"\n', 'token inputs:sourceColorSpace = "sRGB"\n'
TOKENS = ("none", "sphere", "box", "thin", "traced", "single")
STRIPS: dict[str, list[list[Panel]]] = {
    "model": [
        [
            glass(model(token) + (number("thickness", size) if token in ("sphere", "box") else ""), piece)
            for token in TOKENS
        ]
        for piece, size in (("Ball", 1.0), ("Block", 0.8))
    ],
    "ior": [
        [glass(model(token) + number("ior", ior), piece) for ior in (1.0, 1.1, 1.33, 1.5, 2.42)]
        for token, piece in (("sphere", "Ball"), ("box", "Pane"))
    ],
    "thickness": [
        [glass(model(token) + BLUE + number("thickness", t), piece) for t in (0.01, 0.25, 0.5, 1.0, 2.0)]
        for token, piece in (("sphere", "Ball"), ("box", "Pane"))
    ],
    "thickness-sources": [
        [
            glass(model("box") + BLUE + number("thickness", 0.4), "Pane"),
            glass(model("box") + BLUE + number("thickness", 0.4), "Wedge"),
            glass(
                model("box") + BLUE + reader("inputs:refraction:thickness", "float", "ripples.png", "r", RAW + RINGS),
                "Wedge",
            ),
        ]
    ],
    "thickness-multiplier": [
        [glass(model("box") + BLUE + number("thicknessMultiplier", factor), "Wedge") for factor in (0.25, 0.5, 1, 2, 4)]
    ],
    "transmittance-color": [
        [
            *(
                glass(color(*rgb) + number("absorptionDistance", 0.6))
                for rgb in ((1, 1, 1), (0.75, 0.95, 0.82), (0.95, 0.6, 0.12), (0.75, 0.1, 0.12))
            ),
            glass(
                model("thin")
                + reader("inputs:refraction:transmittanceColor", "color3f", "room.png", "rgb", SRGB),
                "Pane",
            ),
        ]
    ],
    "absorption-distance": [
        [
            glass(color(0.3, 0.7, 0.5) + number("absorptionDistance", distance), piece)
            for distance in (8.0, 2.0, 1.0, 0.5, 0.25)
        ]
        for piece in ("Ball", "Block")
    ],
    "abbe-number": [[lines(abbe, piece) for abbe in (0, 60, 30, 15, 5)] for piece in ("Ball", "Prism")],
    "priority": [[two(1, 0), two(0, 1), two(0, 0)]],
    "roughness": [
        [surface("roughness", rough, token) for rough in (0.0, 0.1, 0.2, 0.3, 0.45)] for token in ("sphere", "traced")
    ],
    "opacity": [[surface("opacity", share, "traced") for share in (0.0, 0.25, 0.5, 0.75, 1.0)]],
}
"""Rows of panels by the name of the picture."""


# ------------------------------------------------------------------------------------------------ pictures


def drawn(panel: Panel, folder: Path) -> RGB:
    """A panel as it is shown."""
    edited = folder / "edited.usda"
    edited.write_text(layer_over(STAGE, panel.edits), encoding="utf-8")
    scene = rc.load_stage(str(edited))
    for notice in scene.notices:
        print(f"{notice.path}: {notice.text}", file=sys.stderr)
    frame = rc.render(scene, rc.RenderSettings(image_width=SIDE, image_height=SIDE, samples=panel.samples))
    return display("beauty", frame.planes["beauty"])[..., :3].astype(np.float32) / 255.0


def strip(rows: list[list[Panel]], folder: Path) -> RGB:
    """Panels side by side, rows below each other, with white between."""
    step = SIDE + GAP
    out = np.ones((len(rows) * step - GAP, len(rows[0]) * step - GAP, 3), np.float32)
    for y, row in enumerate(rows):
        for x, panel in enumerate(row):
            out[y * step : y * step + SIDE, x * step : x * step + SIDE] = drawn(panel, folder)
    return out


def save(name: str, picture: RGB) -> None:
    """A PNG with a palette."""
    whole = Image.fromarray(np.round(picture * 255.0).astype(np.uint8))
    few = whole.quantize(COLORS, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.FLOYDSTEINBERG)
    few.save(PICTURES / f"material-{name}.png", optimize=True)


def main(names: list[str]) -> None:
    """Make these pictures, or all."""
    for name in names or list(STRIPS):
        with tempfile.TemporaryDirectory() as folder:
            save(name, strip(STRIPS[name], Path(folder)))
        print(name, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
