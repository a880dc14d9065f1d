"""Pictures that no file system could hold: one sentence that names the prim, from every command."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from refract_core.cli import app
from refract_core.usd.stage import load_stage

LONG = "a" * 4000
NAMES = {
    "too long": f"./{LONG}.png",
    "too long, in tiles": f"./{LONG}.<UDIM>.png",
    "a URI": f"data:image/png;base64,{'iVBORw0KGgo' * 400}",
    "a URI in tiles": f"data:image/png;base64,<UDIM>{'iVBORw0KGgo' * 400}",
    "a folder": ".",
}


def stage(folder: Path, name: str) -> Path:
    path = folder / "in.usda"
    path.write_text(f"""#usda 1.0
(
    defaultPrim = "W"
    metersPerUnit = 1
    upAxis = "Y"
)
def Xform "W"
{{
    def Sphere "Ball" (prepend apiSchemas = ["MaterialBindingAPI"])
    {{
        rel material:binding = </W/M>
    }}
    def Material "M"
    {{
        token outputs:surface.connect = </W/M/S.outputs:surface>
        def Shader "S"
        {{
            uniform token info:id = "UsdPreviewSurface"
            color3f inputs:diffuseColor.connect = </W/M/T.outputs:rgb>
            float inputs:opacity = 0
            token outputs:surface
        }}
        def Shader "T"
        {{
            uniform token info:id = "UsdUVTexture"
            asset inputs:file = @{name}@
            float3 outputs:rgb
        }}
    }}
    def DomeLight "Dome"
    {{
        asset inputs:texture:file = @{name}@
        color3f inputs:color = (1, 0.5, 0.25)
        float inputs:intensity = 2
    }}
    def RectLight "Panel" (prepend apiSchemas = ["ShapingAPI"])
    {{
        asset inputs:texture:file = @{name}@
        asset inputs:shaping:ies:file = @{name}@
    }}
}}
""")
    return path


@pytest.mark.parametrize("what", NAMES)
@pytest.mark.parametrize("command", ["render", "inspect", "validate", "convert", "bake thickness"])
def test_no_command_falls_over_a_name(tmp_path: Path, command: str, what: str) -> None:
    path, out = stage(tmp_path, NAMES[what]), tmp_path / "out.usda"
    more = {
        "render": [str(tmp_path / "out.png"), "-w", "8", "--samples", "1", "--caustics", "off", "--jobs", "1"],
        "convert": [str(out), "--to", "openpbr"], "bake thickness": [str(out)],
    }  # fmt: skip
    result = CliRunner().invoke(app, [*command.split(), str(path), *more.get(command, [])])
    assert result.exception is None or isinstance(result.exception, SystemExit)
    assert result.exit_code == (1 if command == "validate" and what != "a folder" else 0)  # by USD's own validators
    assert "Traceback" not in result.output
    assert ("/W/M" if command in ("convert", "bake thickness") else "/W/M/T") in result.output


@pytest.mark.parametrize("what", NAMES)
def test_the_sentence_names_the_prim_and_is_short(tmp_path: Path, what: str) -> None:
    notices = load_stage(stage(tmp_path, NAMES[what])).notices
    about = {one.path: one.text for one in notices if "cannot be read" in one.text}
    assert set(about) == {"/W/M/T", "/W/Dome", "/W/Panel"}
    for text in about.values():
        assert len(text) < 400
        assert "\n" not in text


def test_a_dome_whose_picture_is_missing_keeps_its_own_colour(tmp_path: Path) -> None:
    """UsdLuxDomeLight: the texture is multiplied by color times intensity; without one that is what shines."""
    scene = load_stage(stage(tmp_path, "./gone.hdr"))
    assert scene.environment is not None
    assert (scene.environment.pixels == np.array([2.0, 1.0, 0.5], np.float32)).all()
    (text,) = [one.text for one in scene.notices if one.path == "/W/Dome"]
    assert "gone.hdr" in text
    assert "its own colour" in text
