"""The bad samples: each breaks one rule, and gets one clear error or one clear warning that names the place."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from typer.testing import CliRunner

import refract_core as rc
from refract_core.cli import app

FOLDER = Path(__file__).parents[1] / "usd_samples" / "bad"
MATERIAL = "/World/Material"


class Said(NamedTuple):
    """What is expected of one file."""

    path: str
    """Prim path; '' is the file itself."""
    words: tuple[str, ...]
    """All of them are in the message: the field, what is wrong, what happens."""


ERRORS = {
    "not_usd": Said("", ("cannot be read as .usd, .usda, .usdc or .usdz",)),
    "unknown_model": Said(MATERIAL, ("refraction:model", "banana", "none, sphere, box, thin, traced")),
    "unknown_probe_clear": Said("/World/Probe", ("probe:clear", "fog", "sky, color")),
    "unknown_probe_mode": Said("/World/Probe", ("probe:mode", "sometimes", "baked, realtime, custom")),
}
WARNINGS = {
    "absorption_distance_negative": Said(MATERIAL, ("absorptionDistance", "-0.5", "above 0")),
    "flattened_camera": Said("/World/Camera", ("skipped", "singular")),
    "index_out_of_range": Said("/World/Quad", ("1 faces", "indices outside 0 .. 3")),
    "ior_below_one": Said(MATERIAL, ("ior", "0.8", "at least 1")),
    "ior_nan": Said(MATERIAL, ("ior", "nan", "1.5 is used")),
    "light_nan": Said("/World/Sun", ("intensity nan", "skipped", "at least 0")),
    "missing_reference": Said("/World/Chair", ("no_such_chair.usda", "missing")),
    "missing_texture": Said(f"{MATERIAL}/Texture", ("no_such_picture.png", "no such file", "fallback")),
    "nan_points": Said("/World/Quad", ("1 faces", "NaN")),
    "no_area": Said("/World/Quad", ("1 faces without area",)),
    "no_camera": Said("/", ("no camera", "frames everything")),
    "no_faces_left": Said("/World/Quad", ("skipped", "none of its 2 faces")),
    "no_unit": Said("", ("metersPerUnit is 0", "above 0")),
    "nothing_visible": Said("/", ("nothing is visible", "empty")),
    "planar_probe_texture": Said("/World/Probe", ("planar", "every picture", "probe:texture is ignored")),
    "probe_background_negative": Said("/World/Probe", ("probe:backgroundColor", "-0.5", "0 or more")),
    "thickness_zero": Said(MATERIAL, ("inputs:refraction:thickness", "is 0;", "clamped")),
    "transmittance_above_one": Said(MATERIAL, ("transmittanceColor", "1.5", "0 to 1")),
    "unknown_shader": Said(MATERIAL, ("NoSuchShader", "UsdPreviewSurface")),
    "unknown_up_axis": Said("", ("upAxis", "'X'", "Y or Z")),
}
FOLLOWS = {"flattened_camera": "/"}
"""Where a second warning about this path is the consequence of the first."""


def stage_path(name: str) -> str:
    return str(FOLDER / f"{name}.usda")


def refract(*words: object) -> tuple[int, list[str]]:
    """Exit code and lines on stderr; stdout stays empty."""
    result = CliRunner().invoke(app, ["render", *map(str, words)])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    assert result.stdout == ""
    return result.exit_code, result.stderr.splitlines()


def test_every_file_is_expected_and_in_the_readme() -> None:
    names = {path.stem for path in FOLDER.glob("*.usda")}
    assert names == {*ERRORS, *WARNINGS}
    readme = (FOLDER / "README.md").read_text(encoding="utf-8")
    for name in names:
        (line,) = [line for line in readme.splitlines() if f"`{name}.usda`" in line]
        assert ("error, exit code 1" in line) is (name in ERRORS)


@pytest.mark.parametrize("name", ERRORS)
def test_an_error_is_one_line_exit_code_1_and_no_picture(name: str, tmp_path: Path) -> None:
    expected = ERRORS[name]
    code, lines = refract(stage_path(name), tmp_path / "out.png")
    assert code == 1
    assert len(lines) == 1
    assert lines[0].startswith(f"error: {expected.path or stage_path(name)}:")
    for word in expected.words:
        assert word in lines[0]
    assert not list(tmp_path.iterdir())
    with pytest.raises(rc.StageError):
        rc.load_stage(stage_path(name))


@pytest.mark.parametrize("name", WARNINGS)
def test_a_warning_names_place_and_remedy_and_the_scene_stays_sound(name: str) -> None:
    expected = WARNINGS[name]
    scene = rc.load_stage(stage_path(name))
    notices = [notice for notice in scene.notices if notice.path != FOLLOWS.get(name)]
    (notice,) = notices
    assert len(scene.notices) - len(notices) == (name in FOLLOWS)
    if expected.path:
        assert notice.path == expected.path
    else:
        assert os.path.basename(notice.path) == f"{name}.usda"
    for word in expected.words:
        assert word in notice.text
    for mesh in scene.meshes:
        assert np.isfinite(mesh.points).all()
        assert mesh.triangles.max() < len(mesh.points)


@pytest.mark.parametrize("name", WARNINGS)
def test_a_warning_does_not_stop_the_picture(name: str) -> None:
    settings = rc.RenderSettings(image_width=16, image_height=9, samples=1)
    frame = rc.render(rc.load_stage(stage_path(name)), settings)
    assert np.isfinite(frame.planes["beauty"]).all()
    if name != "nothing_visible":
        # Glass whose ior was raised to 1 is there, and invisible.
        assert max(frame.planes["beauty"][..., 3].max(), frame.planes["mask"].max()) > 0.0


def test_warnings_reach_stderr_through_the_command(tmp_path: Path) -> None:
    out = tmp_path / "out.png"
    code, lines = refract(stage_path("ior_below_one"), out, "-w", 16, "--samples", 1)
    assert code == 0
    assert len([line for line in lines if line.startswith(f"warning: {MATERIAL}: ")]) == 1
    assert out.is_file()


@pytest.mark.parametrize("name", ["no_such_stage.usda", "no_such_folder/stage.usdz"])
def test_a_missing_stage_is_named(name: str, tmp_path: Path) -> None:
    code, lines = refract(tmp_path / name, tmp_path / "out.png")
    assert (code, len(lines)) == (1, 1)
    assert str(tmp_path / name) in lines[0]
    assert "no such file" in lines[0]


@pytest.mark.parametrize("flags", [("-w", "0"), ("-w", "-5"), ("--image-height", "-1"), ("-w", str(1 << 40))])
def test_an_image_of_no_or_absurd_size_is_wrong_usage(flags: tuple[str, str], tmp_path: Path) -> None:
    code, lines = refract(stage_path("no_camera"), tmp_path / "out.png", *flags)
    assert code == 2
    assert lines[-1].startswith("error: ")
    assert "--image-" in lines[-1]
    assert flags[1] in lines[-1]
    assert not list(tmp_path.iterdir())


def test_a_place_that_cannot_be_written_is_one_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    (tmp_path / "folder.png").mkdir()
    for out in (tmp_path / "missing" / "out.png", tmp_path / "file" / "out.png", tmp_path / "folder.png"):
        code, lines = refract(stage_path("no_camera"), out)
        assert code == 2
        assert len(lines) == 1
        assert lines[0].startswith("error: ")
        assert str(out) in lines[0]
