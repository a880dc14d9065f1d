"""docs/probes.md: it explains every attribute of a probe, and each of its pictures is there and shows something."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pxr import Sdf

import refract_core as rc
from refract_core.images.pictures import read_texture

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGE = (DOCS / "probes.md").read_text(encoding="utf-8")
SECTIONS = re.split(r"^#+ ", PAGE, flags=re.MULTILINE)
REFERENCED = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", PAGE)
STAGES = sorted(path for path in (DOCS / "stages").glob("*.usda") if path.stem != "glass")
"""Those with probes; `glass.usda` is of docs/materials.md."""
PANEL = (200, 360)
GAP = 6
WHOLE = ("baked.png", "levels.png", "baked_and_realtime.png", "planar_table.png", "two_probes.png")
"""Pictures that are not made of panels of that size."""

each_picture = pytest.mark.parametrize("name", sorted(set(REFERENCED)))


def attributes() -> list[str]:
    """Names of the attributes and relationships of RefractProbeAPI."""
    schema = Sdf.Layer.FindOrOpen(str(ROOT / "schemas" / "schema.usda"))
    assert schema
    return [spec.name for spec in schema.GetPrimAtPath("/RefractProbeAPI").properties]


def pixels(name: str) -> NDArray[np.float64]:
    return read_texture(str(DOCS / name), name=name, color_space="raw").pixels[..., :3].astype(np.float64) / 255.0


def test_the_lists_below_are_not_empty() -> None:
    assert len(attributes()) > 20
    assert len(REFERENCED) > 20
    assert len(STAGES) >= 4


@pytest.mark.parametrize("attribute", attributes())
def test_every_attribute_is_explained_in_a_section_with_a_picture(attribute: str) -> None:
    named = re.compile(rf"`{re.escape(attribute)}(?![\w:])")
    assert any(named.search(section) and "![" in section for section in SECTIONS)


def test_each_picture_is_shown_once_and_none_lies_about() -> None:
    assert len(REFERENCED) == len(set(REFERENCED))
    pages = [path.read_text("utf-8") for path in DOCS.glob("*.md")]
    referenced = [name for page in pages for name in re.findall(r"!\[[^\]]+\]\((pictures/[^)]+)\)", page)]
    assert len(referenced) == len(set(referenced))
    own = set(referenced)
    assert own == {f"pictures/{path.name}" for path in (DOCS / "pictures").iterdir()}


@each_picture
def test_a_picture_exists_and_is_not_one_flat_colour(name: str) -> None:
    shown = pixels(name)
    assert np.ptp(shown, axis=(0, 1)).max() > 0.2
    assert shown.std(axis=(0, 1)).max() > 0.05


@pytest.mark.parametrize("name", [name for name in sorted(set(REFERENCED)) if Path(name).name not in WHOLE])
def test_the_first_two_panels_are_not_the_same(name: str) -> None:
    height, width = PANEL
    shown = pixels(name)
    first, second = shown[:height, :width], shown[:height, width + GAP : 2 * width + GAP]
    assert (np.abs(first - second).max(axis=-1) > 0.1).mean() > 0.002


@pytest.mark.parametrize("link", sorted(set(re.findall(r"(?<!!)\[[^\]]+\]\(([^)]+)\)", PAGE))))
def test_links_lead_somewhere(link: str) -> None:
    if not link.startswith("#"):
        assert (DOCS / link).exists()
        return
    titles = re.findall(r"^#+ (.+)$", PAGE, flags=re.MULTILINE)
    anchors = {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}
    assert link[1:] in anchors


@pytest.mark.parametrize("stage", STAGES, ids=lambda path: path.stem)
def test_its_stages_can_be_read_and_have_probes(stage: Path) -> None:
    scene = rc.load_stage(str(stage))
    assert scene.probes
    told = [notice.text for notice in scene.notices if "name another to change" not in notice.text]
    assert told == []
