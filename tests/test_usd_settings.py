"""Render settings that a stage carries: what is authored, and nothing else, reaches the renderer."""

from __future__ import annotations

import pytest
from pxr import Usd

from refract_core.errors import StageError
from refract_core.scene import Notice
from refract_core.settings import RenderSettings
from refract_core.usd.settings import read_settings

FULL = """#usda 1.0
(
    renderSettingsPrimPath = "/Render/Final"
)
def Scope "Render"
{
    def RenderSettings "Final" (prepend apiSchemas = ["RefractSettingsAPI"])
    {
        rel camera = </Cameras/Front>
        uniform int2 resolution = (320, 200)
        uniform token[] includedPurposes = ["default", "proxy"]
        uniform int refract:samples = 16
        uniform token[] refract:tiers = ["ray", "sky"]
        uniform int refract:maxLayers = 2
    }
    def RenderSettings "Draft" {}
}
def Scope "Cameras" {}
"""


def stage_of(text: str) -> Usd.Stage:
    stage = Usd.Stage.CreateInMemory()
    stage.GetRootLayer().ImportFromString(text)
    return stage


def one(body: str) -> Usd.Stage:
    return stage_of(f'#usda 1.0\ndef RenderSettings "R" {{\n{body}\n}}\n')


def test_every_authored_value_arrives() -> None:
    assert read_settings(stage_of(FULL)) == {
        "camera": "/Cameras/Front",
        "image_width": 320,
        "image_height": 200,
        "purposes": ("default", "proxy"),
        "samples": 16,
        "tiers": ("ray", "sky"),
        "max_layers": 2,
    }


def test_what_arrives_are_fields_of_the_settings() -> None:
    settings = RenderSettings(**read_settings(stage_of(FULL)))  # type: ignore[arg-type]
    assert (settings.image_width, settings.tiers) == (320, ("ray", "sky"))


def test_fallbacks_do_not_arrive() -> None:
    assert read_settings(stage_of(FULL), "/Render/Draft") == {}


def test_stage_without_settings() -> None:
    assert read_settings(stage_of("#usda 1.0\n")) == {}


@pytest.mark.parametrize("path", ["/Render/Nope", "/Cameras", "not a path", "/"])
def test_unknown_path_names_the_flag_and_the_choices(path: str) -> None:
    with pytest.raises(StageError, match=r"^--render-settings-prim-path names .*/Render/Final, /Render/Draft"):
        read_settings(stage_of(FULL), path)


@pytest.mark.parametrize(("path", "why"), [("/Gone", "does not exist"), ("/S", "is a Scope, not a RenderSettings")])
def test_a_path_in_the_metadata_that_names_nothing_is_a_warning(path: str, why: str) -> None:
    """usdrecord draws such a stage, too."""
    notices: list[Notice] = []
    stage = stage_of(f'#usda 1.0\n(\n    renderSettingsPrimPath = "{path}"\n)\ndef Scope "S" {{}}\n')
    assert read_settings(stage, "", notices) == {}
    ((where, text),) = [(notice.path, notice.text) for notice in notices]
    assert where == "/"
    assert text.startswith(f"renderSettingsPrimPath names {path}, which {why}; the defaults are used")


@pytest.mark.parametrize(
    ("body", "word"),
    [
        ("uniform int2 resolution = (0, 100)", "resolution"),
        ("uniform int2 resolution = (100, 0)", "resolution"),
        ("uniform int refract:samples = 0", "samples"),
        ('uniform token[] refract:tiers = ["screen", "banana"]', "banana"),
        ("uniform int refract:maxLayers = 99", "max_layers"),
        ('uniform token[] includedPurposes = ["banana"]', "purposes"),
    ],
)
def test_value_out_of_range_names_the_prim_and_the_field(body: str, word: str) -> None:
    with pytest.raises(StageError, match=rf"^/R: .*{word}"):
        read_settings(one(body), "/R")


def test_what_is_authored_but_not_used_is_told() -> None:
    notices: list[Notice] = []
    stage = one('uniform float pixelAspectRatio = 2\nuniform token aspectRatioConformPolicy = "expandAperture"')
    assert read_settings(stage, "/R", notices) == {}
    assert [(notice.path, notice.text.split()[0]) for notice in notices] == [("/R", "pixelAspectRatio")]
