"""docs/what-is-read.md against the reader itself: each kind of prim that USD has, put on a stage and read."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import pytest
from pxr import Tf, Usd, UsdGeom, UsdLux

import schemas
from refract_core.scene import Notice
from refract_core.usd.settings import read_settings
from refract_core.usd.stage import scene_from_stage

schemas.register()

PAGE = Path(__file__).parents[1] / "docs" / "what-is-read.md"
SETTINGS = ("pixelAspectRatio = 2", 'aspectRatioConformPolicy = "cropAperture"', "dataWindowNDC = (0, 0, 0.5, 1)",
            'materialBindingPurposes = ["preview"]', 'renderingColorSpace = "lin_ap1_scene"')  # fmt: skip
TYPES = {"pixelAspectRatio": "float", "aspectRatioConformPolicy": "token", "dataWindowNDC": "float4",
         "materialBindingPurposes": "token[]", "renderingColorSpace": "token"}  # fmt: skip


@cache
def rows() -> dict[str, str]:
    """Each word in code in the first column -> yes, partly or no."""
    found: dict[str, str] = {}
    for line in PAGE.read_text("utf-8").splitlines():
        cells = [cell.strip() for cell in line.strip("|").split(" | ")]
        if not line.startswith("| ") or len(cells) < 2 or cells[1] not in ("yes", "partly", "no"):
            continue
        found |= dict.fromkeys(re.findall(r"`([^`]+)`", cells[0]), cells[1])
    return found


def kinds(*bases: type) -> list[str]:
    """Every type of prim below these that a stage may have, by USD's own registry."""
    registry = Usd.SchemaRegistry()
    every = {kind for base in bases for kind in (Tf.Type(base), *Tf.Type(base).GetAllDerivedTypes())}
    return sorted({str(name) for kind in every if (name := registry.GetConcreteSchemaTypeName(kind))})


SHAPES = kinds(UsdGeom.Gprim)
LIGHTS = kinds(UsdLux.BoundableLightBase, UsdLux.NonboundableLightBase, UsdLux.PluginLight)


def refused(kind: str) -> bool:
    """The reader says of a prim of this type that it does nothing with it."""
    stage = Usd.Stage.CreateInMemory()
    stage.DefinePrim("/P", kind)
    said = [notice.text for notice in scene_from_stage(stage).notices]
    return any(re.match(rf"{kind} is (not rendered|ignored|not drawn)", text) for text in said)


def test_the_registry_has_what_a_stage_is_made_of() -> None:
    """Else the tests below would hold for a page without a word."""
    assert {"Mesh", "Sphere", "BasisCurves", "Volume"} <= set(SHAPES)
    assert {"RectLight", "DomeLight", "PortalLight", "PluginLight"} <= set(LIGHTS)


@pytest.mark.parametrize("kind", [*SHAPES, *LIGHTS])
def test_the_page_has_every_shape_and_light_and_says_of_it_what_the_reader_does(kind: str) -> None:
    assert kind in rows(), f"docs/what-is-read.md lacks a row with `{kind}`"
    assert (rows()[kind] == "no") is refused(kind)


@pytest.mark.parametrize("line", SETTINGS)
def test_settings_that_are_told_as_not_used_are_no_in_the_page(line: str) -> None:
    name = line.split()[0]
    stage = Usd.Stage.CreateInMemory()
    body = f'def RenderSettings "R" {{\nuniform {TYPES[name]} {line}\n}}\n'
    assert stage.GetRootLayer().ImportFromString(f'#usda 1.0\n(\nrenderSettingsPrimPath = "/R"\n)\n{body}')
    notices: list[Notice] = []
    read_settings(stage, "", notices)
    told = any(notice.text.startswith(f"{name} is authored but not used") for notice in notices)
    assert (rows()[name] == "no") is told
