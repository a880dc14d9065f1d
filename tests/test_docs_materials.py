"""docs/materials.md: it explains every attribute of glass as the schema has it; its pictures are there and differ."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pxr import Sdf

import refract_core as rc
from refract_core.images.pictures import read_texture
from refract_core.models import MODELS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGE = (DOCS / "materials.md").read_text(encoding="utf-8")
SECTIONS = {text.partition("\n")[0].strip("`"): text for text in re.split(r"^### ", PAGE, flags=re.MULTILINE)}
PICTURES = re.findall(r"!\[[^\]]+\]\((pictures/[^)]+)\)", PAGE)
SIDE, GAP = 152, 4
MOST_BYTES = 120_000


def attributes() -> dict[str, Any]:
    """Names and fallbacks."""
    schema = Sdf.Layer.FindOrOpen(str(ROOT / "schemas" / "schema.usda"))
    assert schema
    return {str(spec.name): spec.default for spec in schema.GetPrimAtPath("/RefractMaterialAPI").attributes}


@pytest.mark.parametrize("name", attributes())
def test_every_attribute_has_a_section_with_a_picture_and_a_row_with_its_fallback(name: str) -> None:
    assert "![" in SECTIONS[name]
    row = next(line for line in PAGE.splitlines() if line.startswith(f"| [`{name}`]"))
    said = row.split("|")[-2].strip(" `")
    fallback = attributes()[name]
    if isinstance(fallback, str):
        assert said == fallback
    else:
        assert [float(number) for number in re.findall(r"[\d.]+", said)] == np.atleast_1d(fallback).tolist()


def test_every_model_is_explained() -> None:
    for token in MODELS:
        assert re.search(rf"^\| `{token}` \|", SECTIONS["refraction:model"], re.MULTILINE), token


def pixels(name: str) -> NDArray[np.float64]:
    return read_texture(str(DOCS / name), name=name, color_space="raw").pixels[..., :3].astype(np.float64) / 255.0


@pytest.mark.parametrize("name", PICTURES)
def test_a_strip_is_small_neither_black_nor_white_and_its_ends_differ(name: str) -> None:
    assert (DOCS / name).stat().st_size < MOST_BYTES
    shown = pixels(name)
    height, width = shown.shape[:2]
    assert (height + GAP) % (SIDE + GAP) == (width + GAP) % (SIDE + GAP) == 0
    panels = [shown[:, x : x + SIDE] for x in range(0, width, SIDE + GAP)]
    assert all(0.05 < panel.mean() < 0.95 for panel in panels)
    assert (np.abs(panels[0] - panels[-1]).max(axis=-1) > 0.1).mean() > 0.01


def test_its_stage_can_be_read() -> None:
    scene = rc.load_stage(str(DOCS / "stages" / "glass.usda"))
    assert [notice.text for notice in scene.notices if "name another to change" not in notice.text] == []


def test_its_example_is_a_ball_of_glass(tmp_path: Path) -> None:
    (block,) = re.findall(r"^```usda\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    (tmp_path / "ball.usda").write_text(block, "utf-8")
    assert [material.refractive for material in rc.load_stage(str(tmp_path / "ball.usda")).materials] == [True]
