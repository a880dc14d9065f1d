"""RenderProduct and RenderVar: which pictures a stage wants, of what size, with which AOVs under which names."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from pxr import Usd
from typer.testing import CliRunner, Result

from refract_core.cli import app
from refract_core.images.pictures import read_planes
from refract_core.scene import Notice
from refract_core.usd.products import read_products

SCENE = """#usda 1.0
(
    renderSettingsPrimPath = "/Render/Settings"
    metersPerUnit = 1
)
def Sphere "Ball" {
    color3f[] primvars:displayColor = [(1, 0, 0)]
}
def Camera "Front" {
    double3 xformOp:translate = (0, 0, 8)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
def Camera "Away" {
    double3 xformOp:translate = (0, 0, -80)
    uniform token[] xformOpOrder = ["xformOp:translate"]
}
def Scope "Render" {
    def RenderSettings "Settings" {
        rel camera = </Front>
        uniform int2 resolution = (24, 16)
        rel products = [%s]
    }
    %s
    def RenderVar "Color" {
        uniform string sourceName = "Ci"
    }
    def RenderVar "Distance" {
        uniform string sourceName = "depth"
        uniform token dataType = "float"
    }
    def RenderVar "Facing" {
        uniform string sourceName = "N"
        uniform token dataType = "normal3f"
        string driver:parameters:aov:name = "normals"
    }
    def RenderVar "Everything" {
        uniform string sourceName = "C.*[LO]"
        uniform token sourceType = "lpe"
    }
    def RenderVar "Diffuse" {
        uniform string sourceName = "C<RD>.*L"
        uniform token sourceType = "lpe"
    }
    def RenderVar "St" {
        uniform string sourceName = "st"
        uniform token sourceType = "primvar"
    }
}
"""


def product(name: str, body: str = "", variables: tuple[str, ...] = ()) -> str:
    """A RenderProduct of the scene."""
    ordered = ", ".join(f"</Render/{one}>" for one in variables)
    return f'def RenderProduct "{name}" {{\n{body}\n{f"rel orderedVars = [{ordered}]" if variables else ""}\n}}\n'


def text(*products: str) -> str:
    names = [one.split('"')[1] for one in products]
    return SCENE % (", ".join(f"</Render/{name}>" for name in names), "".join(products))


def stage_of(*products: str) -> Usd.Stage:
    stage = Usd.Stage.CreateInMemory()
    assert stage.GetRootLayer().ImportFromString(text(*products))
    return stage


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refract(folder: Path, *words: str) -> Result:
    result = CliRunner().invoke(app, ["render", str(folder / "s.usda"), *words, "--samples", "1"])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result


def parts(path: Path) -> list[oiio.ImageBuf]:
    """Every part of a file."""
    count = oiio.ImageBuf(str(path)).nsubimages
    return [oiio.ImageBuf(str(path), part, 0) for part in range(count)]


def channels(path: Path) -> list[str]:
    """Names of all channels, in the order of the alphabet."""
    return sorted(name for part in parts(path) for name in part.spec().channelnames)


def channel(path: Path, name: str) -> np.ndarray:
    (part,) = (one for one in parts(path) if name in one.spec().channelnames)
    pixels = part.get_pixels(oiio.FLOAT)
    assert pixels is not None
    return pixels[..., part.spec().channelnames.index(name)]


# --- what is read ---------------------------------------------------------------------------------------------------


def test_a_product_without_anything_is_an_exr_of_its_own_name() -> None:
    (found,) = read_products(stage_of(product("Beauty")))
    assert (found.file, found.settings, found.aovs) == ("Beauty.exr", {}, ())


def test_variables_are_aovs_in_their_order_under_their_names() -> None:
    (found,) = read_products(stage_of(product("P", "", ("Distance", "Color", "Facing"))))
    assert found.aovs == ("Z", "beauty", "N")
    assert found.names == {"Z": "Distance", "beauty": "Color", "N": "normals"}


def test_what_is_not_drawn_is_named_and_the_rest_is() -> None:
    notices: list[Notice] = []
    (found,) = read_products(stage_of(product("P", "", ("Diffuse", "Everything", "St", "Distance"))), "", notices)
    assert found.aovs == ("beauty", "Z")
    assert [notice.path for notice in notices] == ["/Render/Diffuse", "/Render/St"]
    assert all("is not drawn" in notice.text for notice in notices)


def test_only_what_a_product_authors_wins_over_its_settings() -> None:
    wide = product("Wide", "uniform int2 resolution = (40, 10)\nrel camera = </Away>")
    plain, other = read_products(stage_of(product("Plain"), wide))
    assert plain.settings == {}
    assert other.settings == {"image_width": 40, "image_height": 10, "camera": "/Away"}


@pytest.mark.parametrize(
    "name", ["a.$F4.exr", "a.<F4>.exr", "a.%04d.exr", "a.####.exr"]
)  # Houdini's, Houdini's in a token, printf's, usdrecord's
def test_frames_in_names_are_understood_as_people_write_them(name: str) -> None:
    (found,) = read_products(stage_of(product("P", f'token productName = "{name}"')))
    assert found.file == "a.####.exr"


def test_a_deep_product_is_named_and_left_out() -> None:
    notices: list[Notice] = []
    assert read_products(stage_of(product("D", 'uniform token productType = "deepRaster"')), "", notices) == []
    assert "deepRaster" in notices[0].text


# --- what is written ------------------------------------------------------------------------------------------------


def test_without_out_every_product_is_written_as_it_says(folder: Path) -> None:
    first = product("A", 'token productName = "a.exr"', ("Color", "Facing", "Distance"))
    second = product("B", 'token productName = "b.png"\nuniform int2 resolution = (10, 10)\nrel camera = </Away>')
    (folder / "s.usda").write_text(text(first, second))
    assert refract(folder).exit_code == 0
    assert sorted(os.listdir(folder)) == ["a.exr", "b.png", "s.usda"]
    assert sorted(channels(folder / "a.exr")) == sorted(
        ["R", "G", "B", "A", "normals.X", "normals.Y", "normals.Z", "Distance"]
    )
    planes = read_planes(str(folder / "a.exr"))
    assert planes["beauty"].shape == (16, 24, 4)
    assert planes["beauty"][8, 12, 0] > planes["beauty"][8, 12, 1]  # the ball is red
    small = read_planes(str(folder / "b.png"))["beauty"]
    assert small.shape == (10, 10, 4)
    assert not small[..., 3].any()  # that camera looks away


def test_the_names_change_and_the_numbers_do_not(folder: Path) -> None:
    (folder / "s.usda").write_text(text(product("A", 'token productName = "a.exr"', ("Color", "Distance"))))
    assert refract(folder).exit_code == 0
    (folder / "s.usda").write_text(text())
    assert refract(folder, "plain.exr", "--aovs", "beauty,Z").exit_code == 0
    np.testing.assert_array_equal(channel(folder / "a.exr", "Distance"), channel(folder / "plain.exr", "Z"))


def test_out_takes_the_place_of_the_first_product_s_name(folder: Path) -> None:
    first = product("A", 'token productName = "a.exr"\nuniform int2 resolution = (12, 6)', ("Color", "Distance"))
    (folder / "s.usda").write_text(text(first, product("B")))
    result = refract(folder, "mine.exr")
    assert result.exit_code == 0
    assert "only the first of 2 RenderProducts" in result.stderr
    assert sorted(os.listdir(folder)) == ["mine.exr", "s.usda"]
    assert sorted(channels(folder / "mine.exr")) == sorted(["R", "G", "B", "A", "Distance"])
    assert read_planes(str(folder / "mine.exr"))["beauty"].shape == (6, 12, 4)


def test_flags_win_over_products(folder: Path) -> None:
    first = product("A", "uniform int2 resolution = (12, 6)", ("Color", "Distance"))
    (folder / "s.usda").write_text(text(first))
    words = ("mine.exr", "--image-width", "8", "--image-height", "8", "--aovs", "beauty")
    assert refract(folder, *words).exit_code == 0
    assert channels(folder / "mine.exr") == ["A", "B", "G", "R"]
    assert read_planes(str(folder / "mine.exr"))["beauty"].shape == (8, 8, 4)


def test_one_frame_fills_the_place_for_it_and_several_do_too(folder: Path) -> None:
    (folder / "s.usda").write_text(text(product("A", 'token productName = "a.$F3.png"')))
    assert refract(folder).exit_code == 0
    assert refract(folder, "--frames", "5:6").exit_code == 0
    assert sorted(os.listdir(folder)) == ["a.000.png", "a.005.png", "a.006.png", "s.usda"]


@pytest.mark.parametrize(
    ("products", "words"),
    [
        ((), ["OUT is missing", "RenderProduct"]),
        ((product("A", 'token productName = "a.rat"'),), ["/Render/A", "productName", "a.rat", ".exr"]),
        ((product("A", 'token productName = "no/such/a.exr"'),), ["/Render/A", "no/such"]),
        (
            (product("A", 'token productName = "a.png"'), product("B", 'token productName = "./a.png"')),
            ["/Render/A", "/Render/B", "productName"],
        ),
    ],
)
def test_what_cannot_be_written_is_one_sentence(products: tuple[str, ...], words: list[str], folder: Path) -> None:
    (folder / "s.usda").write_text(text(*products))
    result = refract(folder)
    assert result.exit_code == 2
    said = result.stderr.strip().splitlines()[-1]
    assert all(word in said for word in words), said
