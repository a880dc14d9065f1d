"""`refract inspect`: what it says of stages whose contents are known by construction."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from scene_reading import CUBE, solid
from typer.testing import CliRunner, Result

from benchmarks.big_stage import make, usd_alone
from refract_core.cli import app
from refract_core.errors import StageError
from refract_core.usd.rules.glass import glass_of
from refract_core.usd.stage import load_stage
from refract_core.verbs.inspect import WIDTH, inspect, to_json, to_text
from refract_core.verbs.validate import ValidateOrder, validate
from refract_core.verbs.validate import to_text as verdict_text

SAMPLES = Path(__file__).parents[1] / "usd_samples"
GOOD = sorted((SAMPLES / "good").glob("*.usda"))
LINES = 50

HEAD = """#usda 1.0
(
    fallbackPrimTypes = {
        token[] RefractProbe = ["Xform"]
    }
    metersPerUnit = %s
    upAxis = "%s"
)
"""
MATERIAL = """
def Material "%s" (
    prepend apiSchemas = ["RefractMaterialAPI"]
) {
    uniform token refraction:model = "%s"
    %s }
"""
CAMERA = """def Camera "Eye" { double3 xformOp:translate = (0, 0, 20)
    uniform token[] xformOpOrder = ["xformOp:translate"] }
"""


def ball(name: str, material: str, x: float = 0.0, z: float = 0.0, *, extra: str = "") -> str:
    return f"""def Sphere "{name}" (
        prepend apiSchemas = ["MaterialBindingAPI"]
    ) {{
        rel material:binding = </{material}>
        {extra}
        double3 xformOp:translate = ({x}, 0, {z})
        uniform token[] xformOpOrder = ["xformOp:translate"] }}
"""


def report(folder: Path, text: str, *, unit: float = 1.0, up: str = "Y") -> dict[str, Any]:
    path = folder / "stage.usda"
    path.write_text(HEAD % (unit, up) + text.replace("{", "{\n").replace("}", "\n}\n"))
    return inspect(str(path))


def refract(*words: object) -> Result:
    result = CliRunner().invoke(app, ["inspect", *map(str, words)])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


# --- the screen -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", GOOD, ids=lambda path: path.stem)
def test_one_screen_and_the_same_in_json(path: Path) -> None:
    text, said = refract(path), json.loads(refract(path, "--json").stdout)
    lines = text.stdout.splitlines()
    assert text.exit_code == 0
    assert len(lines) <= LINES
    assert max(map(len, lines)) <= WIDTH
    cut = any("glass" in line.split()[:1] for line in lines) and any("--json lists all" in line for line in lines)
    for piece in said["glass"]:
        found = [line for line in lines if line.split()[:1] == [piece["path"]] and piece["model"] in line]
        assert len(found) == 1 or (cut and not found)
        assert all(("convex" in line) is piece["convex"] for line in found)
    assert said["suspicious"] == [] or {entry["severity"] for entry in said["suspicious"]} == {"info"}


def test_a_long_list_is_cut_and_counted(tmp_path: Path) -> None:
    text = "".join(ball(f"B{i}", "M", 3.0 * i) for i in range(40)) + MATERIAL % ("M", "sphere", "")
    said = report(tmp_path, text)
    lines = to_text(said).splitlines()
    assert len(lines) <= LINES
    assert len(said["glass"]) == 40
    assert "  ... and 30 more; --json lists all" in lines


def test_a_missing_stage_is_one_line(tmp_path: Path) -> None:
    result = refract(tmp_path / "nothing.usda")
    assert (result.exit_code, result.stdout, len(result.stderr.splitlines())) == (1, "", 1)


def test_json_has_the_shape_that_is_promised(tmp_path: Path) -> None:
    said = report(tmp_path, ball("B", "M") + MATERIAL % ("M", "box", "") + 'def RefractProbe "P" { }')
    assert said["format"] == "refract.inspect/1"
    assert set(said) == {
        "format", "stage", "engine", "up_axis", "metres_per_unit", "metres_per_unit_authored", "time", "prims",
        "settings", "cameras", "environment", "glass", "probes", "unsupported", "suspicious",
    }  # fmt: skip
    assert set(said["glass"][0]) == {
        "path", "material", "by", "model", "ior", "roughness", "transmittance_color", "absorption_distance",
        "thickness", "closed", "convex", "size", "layers", "tiers", "probes",
    }  # fmt: skip
    assert set(said["probes"][0]) == {"path", "mode", "planar", "texture", "resolution", "covers"}
    assert set(said["time"]) == {"start", "end", "authored", "frames_per_second"}
    assert json.loads(to_json(said)) == said


# --- glass ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", GOOD, ids=lambda path: path.stem)
def test_glass_is_what_the_renderer_takes_for_glass(path: Path) -> None:
    """`inspect` reads glass alone; a full reading finds the same."""
    full = glass_of(load_stage(path))
    said = inspect(str(path))["glass"]
    expected = [(piece.path, piece.model.name.lower(), piece.closed) for piece in full]
    assert [(piece["path"], piece["model"], piece["closed"]) for piece in said] == expected


@pytest.mark.parametrize(("unit", "up"), [(1.0, "Y"), (0.01, "Z")])
def test_where_a_thickness_comes_from(unit: float, up: str, tmp_path: Path) -> None:
    typed = "float inputs:refraction:thickness = 2"
    primvar = 'float primvars:refraction:thickness = 1.5 (\n interpolation = "constant"\n )'
    text = (
        ball("Typed", "T") + ball("Default", "D") + ball("Measured", "T", extra=primvar) + ball("Thin", "P")
        + ball("Traced", "R") + MATERIAL % ("T", "sphere", typed) + MATERIAL % ("D", "box", "")
        + MATERIAL % ("P", "thin", "") + MATERIAL % ("R", "traced", "")
    )  # fmt: skip
    said = {piece["path"]: piece["thickness"] for piece in report(tmp_path, text, unit=unit, up=up)["glass"]}
    how = {path: row["how"] for path, row in said.items()}
    assert how == {
        "/Typed": "typed", "/Default": "default", "/Measured": "measured", "/Thin": "fixed", "/Traced": "unused",
    }  # fmt: skip
    assert [said[path]["most"] for path in ("/Typed", "/Default", "/Measured")] == pytest.approx(
        [2 * unit, unit, 1.5 * unit]
    )
    assert said["/Thin"]["most"] == pytest.approx(0.005)


@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_what_the_file_says_of_the_body_is_said(unit: float, tmp_path: Path) -> None:
    """Everything that a person may override starts from what is authored."""
    said = """token outputs:surface.connect = </A/Shader.outputs:surface>
    def Shader "Shader" { uniform token info:id = "UsdPreviewSurface"
        float inputs:roughness = 0.25
        token outputs:surface }
    color3f inputs:refraction:transmittanceColor = (0.5, 0.25, 1)
    float inputs:refraction:absorptionDistance = 3"""
    looks = MATERIAL % ("A", "sphere", said) + MATERIAL % ("P", "sphere", "")
    text = ball("Amber", "A") + ball("Plain", "P") + looks
    amber, plain = report(tmp_path, text, unit=unit)["glass"]
    assert amber["transmittance_color"] == {"value": [0.5, 0.25, 1.0], "by": "constant"}
    assert amber["absorption_distance"] == pytest.approx(3 * unit)
    assert plain["transmittance_color"]["value"] == [1.0, 1.0, 1.0]  # clear, as the schema's fallback
    assert amber["roughness"] == {"value": 0.25, "by": "constant"}


def test_closed_and_convex(tmp_path: Path) -> None:
    bound = "rel material:binding = </M>"
    counts, *corners = str([4] * 6), *map(str, solid("cube")[1])
    open_cube = CUBE(name="Open", extra=bound).replace(counts, str([4] * 5))
    open_cube = open_cube.replace(f", {corners[-1][1:]}", "]")
    dent = CUBE(name="Dent", extra=bound).replace("(-1, -1, -1)", "(-0.1, -0.1, -0.1)")
    text = CUBE(name="Cube", extra=bound) + dent + open_cube + MATERIAL % ("M", "thin", "")
    said = {piece["path"]: (piece["closed"], piece["convex"]) for piece in report(tmp_path, text)["glass"]}
    assert said == {"/Cube": (True, True), "/Dent": (True, False), "/Open": (False, False)}


def test_glass_by_its_shader_alone() -> None:
    said = inspect(str(SAMPLES / "good" / "preview_surface.usda"))
    assert {piece["by"] for piece in said["glass"]} == {"surface shader"}
    assert "* glass by its surface shader" in to_text(said)
    said = inspect(str(SAMPLES / "good" / "marble.usda"))
    assert {piece["by"] for piece in said["glass"]} == {"RefractMaterialAPI"}


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_layers_are_counted_along_view_rays(projection: str, tmp_path: Path) -> None:
    """Balls in a row, seen along it: the ray through all enters each solid once, each thin shell twice."""
    camera = CAMERA.replace("double3", f'token projection = "{projection}"\n double3')
    row = "".join(ball(name, "M", 0.0, -4.0 * i) for i, name in enumerate("ABC"))
    apart = ball("D", "M", 40.0)
    text = camera + row + apart + ball("Shell", "S", -40.0)
    text += MATERIAL % ("M", "traced", "") + MATERIAL % ("S", "thin", "")
    said = {piece["path"]: piece["layers"] for piece in report(tmp_path, text)["glass"]}
    assert said == {"/A": 3, "/B": 3, "/C": 3, "/D": 1, "/Shell": 2}


def test_layers_of_meshes_count_outer_sides(tmp_path: Path) -> None:
    boxes = "".join(
        CUBE(name=name, extra=f"rel material:binding = </M>\n double3 xformOp:translate = (0, 0, {z})\n"
             'uniform token[] xformOpOrder = ["xformOp:translate"]')
        for name, z in ((f"B{k}", -4 * k) for k in range(17))
    )  # fmt: skip
    said = report(tmp_path, CAMERA + boxes + MATERIAL % ("M", "traced", ""))
    assert {piece["layers"] for piece in said["glass"]} == {17}
    (entry,) = said["suspicious"]
    assert (entry["rule"], entry["fix"]) == ("refract.too-many-layers", "render with --max-layers 17")


# --- probes and the stage -------------------------------------------------------------------------------------------


def test_probes_and_what_they_cover(tmp_path: Path) -> None:
    probe = 'def RefractProbe "P" {{ uniform token probe:mode = "{}"\n float3 probe:influence:size = (3, 3, 3) }}'
    text = ball("In", "M") + ball("Out", "M", 9.0) + MATERIAL % ("M", "traced", "")
    said = report(tmp_path, text + probe.format("realtime"))
    assert [(p["covers"], p["texture"]) for p in said["probes"]] == [(["/In"], "realtime")]
    tiers = {piece["path"]: piece["tiers"] for piece in said["glass"]}
    assert tiers == {"/In": ["screen", "probe", "ray"], "/Out": ["screen", "ray"]}
    assert [entry["path"] for entry in said["suspicious"]] == ["/Out"]
    assert report(tmp_path, text)["glass"][1]["tiers"] == ["screen", "ray"]  # none is invented
    for mode, state in (("baked", "none"), ("custom", "missing")):
        assert report(tmp_path, text + probe.format(mode))["probes"][0]["texture"] == state


def test_the_stage_itself(tmp_path: Path) -> None:
    said = report(tmp_path, CAMERA + CUBE() + 'def DomeLight "Sky" { }', unit=0.01, up="Z")
    assert (said["up_axis"], said["metres_per_unit"], said["environment"]) == ("Z", 0.01, True)
    assert said["cameras"] == [{"path": "/Eye", "used": True, "orthographic": False}]
    assert (said["glass"], said["unsupported"]) == ([], [])
    assert said["prims"]["lights"] == 1


def test_an_empty_stage_says_so_and_a_full_one_without_glass_does_not(tmp_path: Path) -> None:
    for text, empty in (("", True), (CUBE(), False)):
        notes = [entry["text"] for entry in report(tmp_path, text)["unsupported"]]
        assert any("nothing is visible" in note for note in notes) is empty


def test_a_stage_with_an_unknown_token_is_shown_all_the_same() -> None:
    said = inspect(str(SAMPLES / "bad" / "unknown_model.usda"))
    assert [piece["path"] for piece in said["glass"]] == ["/World/Ball"]
    assert said["suspicious"][0]["rule"] == "refract.unknown-token"


def test_looking_changes_no_file(tmp_path: Path) -> None:
    path = tmp_path / "unknown_probe_mode.usda"
    shutil.copy(SAMPLES / "bad" / path.name, path)
    before = path.read_bytes()
    inspect(str(path))
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


# --- many stages, and large ones ------------------------------------------------------------------------------------


@pytest.mark.draws
def test_real_stages_go_through_inspect_and_validate(assets: Path) -> None:
    stages = [path for path in sorted(assets.rglob("*")) if path.suffix in (".usd", ".usda", ".usdc", ".usdz")]
    refused: list[str] = []
    for path in stages:
        try:
            said = inspect(str(path))
        except StageError:  # framesPerSecond of 0 or less: USD itself refuses
            refused.append(path.stem)
            continue
        lines = to_text(said).splitlines()
        assert len(lines) <= LINES
        assert max(map(len, lines)) <= WIDTH
        assert verdict_text(validate(ValidateOrder(stage=str(path))))
    assert refused == ["framesPerSecond_-1", "framesPerSecond_0"]
    assert len(stages) > 200


def test_the_benchmark_stage_is_what_it_says(tmp_path: Path) -> None:
    path = tmp_path / "big.usdc"
    make(path, 20, 242, 10)
    said = inspect(str(path))
    assert (said["prims"]["all"], said["prims"]["materials"], said["prims"]["meshes"]) == (242, 20, 100)
    assert len(said["glass"]) == 10
    assert {piece["closed"] for piece in said["glass"]} == {True}
    assert set(usd_alone(path)) == {"open", "prims", "bindings", "materials", "geometry"}
