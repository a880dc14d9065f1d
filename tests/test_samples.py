"""The good samples: each renders without a warning, is valid USD, and is shown in the folder's README."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdValidation

import refract_core as rc
from refract_core.images.pictures import read_texture

pytestmark = pytest.mark.draws

FOLDER = Path(__file__).parents[1] / "usd_samples" / "good"
STAGES = sorted(FOLDER.glob("*.usda"))
WEIGHTS = ("weight.screen", "weight.ray", "weight.probe", "weight.sky", "weight.none")
MEGABYTE = 1 << 20
ALONE = "bottle"
"""A product and nothing else, whose camera and light are added, and said to be"""

each_stage = pytest.mark.parametrize("stage", STAGES, ids=lambda path: path.stem)


def small(stage: Path, width: int = 48, height: int = 27, **choices: object) -> rc.Frame:
    """The sample at one sample per pixel."""
    settings = rc.RenderSettings(image_width=width, image_height=height, samples=1, **choices)  # type: ignore[arg-type]
    return rc.render(rc.load_stage(str(stage)), settings)


def test_there_are_at_least_eight_and_they_stay_small() -> None:
    assert len(STAGES) >= 8
    assert sum(path.stat().st_size for path in FOLDER.rglob("*") if path.is_file()) < 6 * MEGABYTE


@each_stage
def test_it_renders_without_a_warning_and_glass_is_in_the_picture(stage: Path) -> None:
    frame = small(stage)
    if stage.stem == ALONE:
        assert len(frame.notices) == 2
        assert "no camera" in frame.notices[0].text
        assert "no light" in frame.notices[1].text
    else:
        assert frame.notices == ()
    for name, plane in frame.planes.items():
        if name != "Z":  # where nothing is hit the depth is infinite
            assert np.isfinite(plane).all(), name
    assert (frame.planes["beauty"] >= 0.0).all()
    assert frame.planes["beauty"][..., :3].max() > 0.1
    glass = frame.planes["mask"] > 0.0
    assert 0.02 < glass.mean() < 0.9
    total = sum(frame.planes[name].astype(np.float64) for name in WEIGHTS)
    assert np.asarray(total)[glass] == pytest.approx(1.0, abs=1e-5)
    assert (frame.planes["transmittance"][glass] <= 1.0 + 1e-6).all()


@each_stage
def test_it_is_valid_usd_that_says_what_it_shows(stage: Path) -> None:
    opened = Usd.Stage.Open(str(stage))
    root = opened.GetDefaultPrim()
    assert root
    assert opened.GetRootLayer().documentation
    assert UsdGeom.StageHasAuthoredMetersPerUnit(opened)
    assert opened.HasAuthoredMetadata(UsdGeom.Tokens.upAxis)
    assert any(prim.IsA(UsdGeom.Camera) for prim in opened.Traverse()) or stage.stem == ALONE
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(validators).Validate(opened)
    errors = [error.GetMessage() for error in found if error.GetType() == UsdValidation.ValidationErrorType.Error]
    assert errors == []


@each_stage
def test_its_picture_exists_and_the_readme_shows_both(stage: Path) -> None:
    picture = stage.with_suffix(".png")
    pixels = read_texture(str(picture), name=picture.name, color_space="raw").pixels
    assert pixels.shape == (360, 640, 4)
    readme = (FOLDER.parent / "README.md").read_text(encoding="utf-8")
    assert f"good/{stage.name}" in readme
    assert f"(good/{picture.name})" in readme


def test_several_units_and_up_axes_are_among_them() -> None:
    stages = [Usd.Stage.Open(str(path)) for path in STAGES]
    assert {str(UsdGeom.GetStageUpAxis(stage)) for stage in stages} == {"Y", "Z"}
    assert len({UsdGeom.GetStageMetersPerUnit(stage) for stage in stages}) > 1


def test_the_sphere_model_is_the_traced_exit_of_a_true_sphere() -> None:
    stage = FOLDER / "room_of_checkers.usda"
    size = {"width": 192, "height": 108, "tiers": ("ray", "sky"), "cut": 1.0}  # the model has no reflections inside
    modelled, traced = small(stage, **size), small(stage, **size, model="traced")  # type: ignore[arg-type]
    glass = modelled.planes["mask"] > 0.0
    assert np.array_equal(glass, traced.planes["mask"] > 0.0)
    same = np.abs(modelled.planes["path_length"] - traced.planes["path_length"])[glass]
    assert same.max() < 1e-3  # of 1.2 m
    apart = np.abs(modelled.planes["beauty"] - traced.planes["beauty"])[glass].max(axis=-1)
    # The texture's edges are one texel wide, so a ray that lands on one may differ by more.
    assert (apart < 1.0 / 255.0).mean() > 0.99


@pytest.mark.parametrize("screen", ["march", "proxy"])
def test_a_marble_turns_the_room_upside_down(screen: str) -> None:
    """Floor and left wall are warm, ceiling and right wall blue: along the rim they have changed sides."""
    frame = small(FOLDER / "room_of_checkers.usda", 192, 108, screen=screen)
    glass = frame.planes["mask"] > 0.0
    rows, columns = np.nonzero(glass)
    x, y = columns - columns.mean(), rows.mean() - rows
    radius = np.hypot(x, y) / np.hypot(x, y).max()
    warmth = (frame.planes["refraction"][..., 0] - frame.planes["refraction"][..., 2])[glass]
    rim = (radius > 0.94) & (radius < 0.99)  # farther in, the glass shows the wall behind it
    horizontal, vertical = rim & (np.abs(y) < 0.5 * np.abs(x)), rim & (np.abs(x) < 0.5 * np.abs(y))
    assert warmth[horizontal & (x > 0)].mean() > warmth[horizontal & (x < 0)].mean() + 0.1
    assert warmth[vertical & (y > 0)].mean() > warmth[vertical & (y < 0)].mean() + 0.1


def test_each_doubling_of_the_thickness_squares_what_is_left() -> None:
    frame = small(FOLDER / "absorption.usda", 320, 180)
    thickness, through = frame.planes["thickness"], frame.planes["transmittance"].astype(np.float64)
    path = frame.planes["path_length"].astype(np.float64)
    rates = []
    for slab in (0.05, 0.1, 0.2, 0.4, 0.8):
        chosen = (np.abs(thickness - slab) < 1e-4) & (frame.planes["layers"] == 1.0) & (frame.planes["mask"] == 1.0)
        assert chosen.sum() > 20
        rates.append(np.median(np.log(through[chosen]) / path[chosen][:, None], axis=0))
    assert np.ptp(rates, axis=0) / np.abs(rates[0]) == pytest.approx(0.0, abs=1e-3)
    assert rates[0] == pytest.approx(np.log((0.80, 0.42, 0.13)) / 0.2, rel=1e-3)


def test_only_with_layers_is_there_glass_behind_glass() -> None:
    stage = FOLDER / "glass_behind_glass.usda"
    whole, single = small(stage, 96, 54), small(stage, 96, 54, max_layers=1)
    assert whole.planes["layers"].max() >= 3.0
    assert single.planes["layers"].max() == 1.0
    overlap = whole.planes["layers"] > 1.0
    apart = np.abs(whole.planes["beauty"] - single.planes["beauty"]).max(axis=-1)
    assert apart[overlap].max() > 0.05
    alone = whole.planes["layers"] == 0.0
    assert apart[alone].max() == 0.0
