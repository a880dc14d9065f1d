"""MaterialX files by reference, in the place of references that USD cannot open."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from material_reading import write_png
from pxr import Usd, UsdShade
from test_convert import block, material, run

from refract_core.errors import StageError
from refract_core.scene import Material, Model, Param, Scene
from refract_core.usd.layers import mtlx
from refract_core.usd.layers.assets import files_of
from refract_core.usd.layers.mtlx_file import ELEMENTS, LARGEST, read_document
from refract_core.usd.prim_count import count_prims
from refract_core.usd.rules.stage import stock_findings
from refract_core.usd.stage import load_stage, open_stage
from service import precheck

pytest.importorskip("MaterialX")

GLASS = """
  <standard_surface name="Blue" type="surfaceshader">
    <input name="transmission" type="float" value="1" />
    <input name="transmission_color" type="color3" value="0.2 0.4 0.8" />
    <input name="transmission_depth" type="float" value="2" />
    <input name="specular_roughness" type="float" nodegraph="Graph" output="rough" />
  </standard_surface>
  <surfacematerial name="Glass" type="material">
    <input name="surfaceshader" type="surfaceshader" nodename="Blue" />
  </surfacematerial>
  <nodegraph name="Graph" fileprefix="pictures/">
    <input name="strength" type="float" value="0.5" />
    <image name="picture" type="float">
      <input name="file" type="filename" value="rough.png" />
    </image>
    <multiply name="weaker" type="float">
      <input name="in1" type="float" nodename="picture" />
      <input name="in2" type="float" interfacename="strength" />
    </multiply>
    <output name="rough" type="float" nodename="weaker" />
  </nodegraph>
"""


def document(inside: str = GLASS, *, head: str = 'version="1.39" colorspace="lin_rec709"') -> str:
    return f'<?xml version="1.0"?>\n<materialx {head}>{inside}</materialx>\n'


def write(folder: Path, text: str | None = None, *, more: str = "", instances: bool = False) -> str:
    """A stage of two balls; each refers to an asset that refers to a MaterialX file."""
    (folder / "pictures").mkdir(exist_ok=True)
    write_png(folder / "pictures" / "rough.png", [[(128, 128, 128, 255)]])
    (folder / "glass.mtlx").write_text(document() if text is None else text)
    looks = f'def Scope "Looks" (references = @./glass.mtlx@</MaterialX/Materials>)\n{{\n{more}\n}}'
    bound = block('def Sphere "Ball" (prepend apiSchemas = ["MaterialBindingAPI"])',
                  "rel material:binding = </Asset/Looks/Glass>")  # fmt: skip
    asset = block('def Xform "Asset"', looks, bound)
    (folder / "asset.usda").write_text(f'#usda 1.0\n(\n    defaultPrim = "Asset"\n)\n{asset}\n')
    instance = "instanceable = true\n" if instances else ""
    prims = "\n".join(f'def "{name}" ({instance}references = @./asset.usda@)\n{{\n}}' for name in ("A", "B"))
    path = folder / "stage.usda"
    path.write_text(f"#usda 1.0\n(\n    metersPerUnit = 0.1\n)\n{prims}\n")
    return str(path)


def glass(scene: Scene) -> Any:
    return scene.materials[scene.spheres[0].material if scene.spheres else int(scene.meshes[0].materials[0])]


def texts(scene: Scene) -> str:
    return "\n".join(f"{notice.path}: {notice.text}" for notice in scene.notices)


@pytest.mark.parametrize("instances", [False, True])
def test_a_reference_to_materialx_composes_as_any_other(tmp_path: Path, instances: bool) -> None:
    found = glass(scene := load_stage(write(tmp_path, instances=instances)))
    assert found.model is Model.TRACED
    assert found.inputs[Param.TRANSMITTANCE].value[:3] == pytest.approx((0.2, 0.4, 0.8))
    assert found.absorption_distance == pytest.approx(0.2)
    rough = found.inputs[Param.ROUGHNESS]
    assert scene.textures[rough.texture].name.startswith(str(tmp_path / "pictures" / "rough.png"))
    assert rough.scale[0] == pytest.approx(0.5)
    assert "MaterialX" not in texts(scene)
    assert "missing" not in texts(scene)


def test_stronger_opinions_win_over_the_file(tmp_path: Path) -> None:
    more = 'over "Glass"\n{\nover "Blue"\n{\nfloat inputs:transmission_depth = 5\n}\n}'
    assert glass(load_stage(write(tmp_path, more=more))).absorption_distance == pytest.approx(0.5)


def test_no_file_is_changed_and_all_are_known(tmp_path: Path) -> None:
    path = write(tmp_path)
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    everything = sorted(str(file) for file in before)
    assert files_of(path) == everything
    stage = open_stage(path)
    assert files_of(path) == everything
    del stage
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == before


@pytest.mark.parametrize("flatten", [False, True])
@pytest.mark.parametrize("name", ["out.usda", "out.usdz"])
def test_what_is_written_over_it_finds_it_again(tmp_path: Path, flatten: bool, name: str) -> None:
    path = write(tmp_path)
    (tmp_path / "far").mkdir()
    out = tmp_path / "far" / name
    run(path, out, flatten=flatten, model="traced")
    if name.endswith("z"):  # all of it is in the package
        for part in ("glass.mtlx", "pictures/rough.png"):
            (tmp_path / part).unlink()
    found = glass(scene := load_stage(out))
    assert found.model is Model.TRACED
    assert found.inputs[Param.TRANSMITTANCE].value[:3] == pytest.approx((0.2, 0.4, 0.8))
    assert found.inputs[Param.ROUGHNESS].texture >= 0
    assert "anon:" not in texts(scene)
    assert b"anon:" not in out.read_bytes()


def test_a_changed_file_shows_its_new_content(tmp_path: Path) -> None:
    path = write(tmp_path)
    kept = open_stage(path)  # USD keeps its layers in memory
    (tmp_path / "glass.mtlx").write_text(document().replace("0.2 0.4 0.8", "0.9, 0.9, 0.9"))
    assert glass(load_stage(path)).inputs[Param.TRANSMITTANCE].value[0] == pytest.approx(0.9)
    asset = tmp_path / "asset.usda"
    asset.write_text(asset.read_text().replace('"Ball"', '"Sphere"'))
    assert load_stage(path).meshes[0].path.endswith("/Sphere")
    assert glass(load_stage(path)).inputs[Param.TRANSMITTANCE].value[0] == pytest.approx(0.9)
    del kept


def test_colour_spaces_of_values_and_pictures(tmp_path: Path) -> None:
    text = document(
        GLASS.replace('value="0.2 0.4 0.8"', 'value="0.5, 0.5, 0.5" colorspace="srgb_texture"')
        .replace('type="float" nodegraph="Graph" output="rough"', 'type="float" value="0.1"')
        .replace("</standard_surface>", '<input name="base_color" type="color3" nodename="Wood" /></standard_surface>')
        + '<image name="Wood" type="color3"><input name="file" type="filename" value="pictures/rough.png" '
        'colorspace="srgb_texture" /></image>'
    )
    scene = load_stage(write(tmp_path, text))
    found = glass(scene)
    # IEC 61966-2-1: 0.5 encoded is 0.2140 in linear light
    assert found.inputs[Param.TRANSMITTANCE].value[0] == pytest.approx(0.21404, abs=1e-5)
    assert scene.textures[found.inputs[Param.DIFFUSE].texture].srgb
    raw = load_stage(write(tmp_path, text.replace('png" colorspace="srgb_texture"', 'png"')))
    assert not raw.textures[glass(raw).inputs[Param.DIFFUSE].texture].srgb  # the document's own is linear


def test_acescg_is_brought_to_rec_709(tmp_path: Path) -> None:
    """White stays white, and ACEScg's red primary (0.713, 0.293) is outside of Rec. 709's triangle."""
    text = document(GLASS.replace('value="0.2 0.4 0.8"', 'value="0.5 0.5 0.5" colorspace="lin_ap1"'))
    assert glass(load_stage(write(tmp_path, text))).inputs[Param.TRANSMITTANCE].value[:3] == pytest.approx(
        (0.5, 0.5, 0.5), abs=1e-3
    )


def test_older_versions_are_brought_up(tmp_path: Path) -> None:
    """1.38 had `swizzle`, which is `separate3` since."""
    text = document(
        GLASS.replace('nodegraph="Graph" output="rough"', 'nodename="Red"')
        + '<image name="P" type="color3"><input name="file" type="filename" value="pictures/rough.png" /></image>'
        '<swizzle name="Red" type="float"><input name="in" type="color3" nodename="P" />'
        '<input name="channels" type="string" value="g" /></swizzle>',
        head='version="1.38"',
    )
    scene = load_stage(write(tmp_path, text))
    assert glass(scene).inputs[Param.ROUGHNESS].channel == 1
    assert "MaterialX" not in texts(scene)


def test_what_is_not_followed_is_told_once(tmp_path: Path) -> None:
    text = document(GLASS.replace("<image", "<noise2d").replace("</image", "</noise2d"))
    scene = load_stage(write(tmp_path, text))
    told = [notice for notice in scene.notices if "MaterialX" in notice.text]
    assert len(told) == 1
    assert "ND_noise2d_float" in told[0].text


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>'


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (document().replace("<materialx", f"{BOMB}<materialx"), "document type"),
        (document("<nodegraph>" * 40 + "</nodegraph>" * 40), "nested deeper"),
        (document("<a/>" * (ELEMENTS + 1)), "more than"),
        (" " * (LARGEST + 1), "bytes"),
        ("no XML at all", "not XML"),
        ("<materialx", "not XML"),
        ("", "not XML"),
    ],
    ids=["entities", "deep", "many", "large", "text", "cut", "empty"],
)
def test_a_hostile_or_damaged_file_is_named_and_the_rest_is_drawn(tmp_path: Path, content: str, said: str) -> None:
    scene = load_stage(write(tmp_path, content))
    told = [notice.text for notice in scene.notices if "MaterialX" in notice.text]
    assert len(told) == 1
    assert said in told[0]
    assert len(scene.spheres) + len(scene.meshes) == 2


def test_nothing_is_included_and_nothing_fetched(tmp_path: Path) -> None:
    (tmp_path / "other.mtlx").write_text(document(GLASS.replace("Glass", "Secret")))
    text = document('<xi:include href="other.mtlx" />' + GLASS.replace("rough.png", "//host/share/x.png"),
                    head='version="1.39" xmlns:xi="http://www.w3.org/2001/XInclude"')  # fmt: skip
    path = write(tmp_path, text)
    stage = open_stage(path)
    assert stage.GetPrimAtPath("/A/Looks/Glass")
    assert not stage.GetPrimAtPath("/A/Looks/Secret")
    assert glass(load_stage(path)).inputs[Param.ROUGHNESS].texture < 0


def test_graphs_in_a_circle_end(tmp_path: Path) -> None:
    text = document(GLASS.replace('nodename="picture"', 'nodename="weaker"'))
    scene = load_stage(write(tmp_path, text))
    assert glass(scene).model is Model.TRACED
    assert scene.notices


def test_materials_of_a_file_are_counted_before_it_is_composed(tmp_path: Path) -> None:
    many = "".join(
        f'<surfacematerial name="M{n}" type="material"><input name="surfaceshader" type="surfaceshader" '
        'nodename="Blue" /></surfacematerial>' for n in range(50)
    )  # fmt: skip
    path = write(tmp_path, document(GLASS + many))
    stage = Usd.Stage.Open(path)
    del stage
    assert count_prims(path).prims >= len(list(open_stage(path).TraverseAll())) > 500


def test_without_the_wheel_the_notice_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "MaterialX", None)
    read_document.cache_clear()  # another test may have read the same content
    told = [notice.text for notice in load_stage(write(tmp_path)).notices if "MaterialX" in notice.text]
    assert len(told) == 1
    assert "pip install 'usd-refract[mtlx]'" in told[0]


def test_a_file_alone_is_shown_on_balls(tmp_path: Path) -> None:
    write(tmp_path)
    scene = load_stage(tmp_path / "glass.mtlx")
    assert glass_named(scene, "Glass").model is Model.TRACED
    assert scene.cameras
    (tmp_path / "none.mtlx").write_text(document(""))
    with pytest.raises(StageError, match="no material"):
        load_stage(tmp_path / "none.mtlx")
    (tmp_path / "bad.mtlx").write_text("no XML")
    with pytest.raises(StageError, match="not XML"):
        load_stage(tmp_path / "bad.mtlx")


def glass_named(scene: Scene, name: str) -> Any:
    return material(scene, name)


@pytest.mark.parametrize("name", ["../outside.png", "/etc/hostname", "http://example.com/x.png"])
def test_the_service_refuses_a_file_that_names_what_is_outside(tmp_path: Path, name: str) -> None:
    inside = tmp_path / "in"
    inside.mkdir()
    path = write(inside)
    assert precheck.check_stage(path, str(inside), layers=10, unpacked_bytes=1 << 20)
    text = document(GLASS.replace('fileprefix="pictures/"', "").replace("rough.png", name))
    (inside / "glass.mtlx").write_text(text)
    with pytest.raises(precheck.Refused, match=r"path|outside|folder"):
        precheck.check_stage(path, str(inside), layers=10, unpacked_bytes=1 << 20)


def test_validate_finds_nothing_wrong_with_what_usd_cannot_know(tmp_path: Path) -> None:
    stage = open_stage(write(tmp_path))
    said = [one for one in stock_findings(stage) if "Glass" in one.path or "anon:" in f"{one.path} {one.text}"]
    assert not said


# --- files of other people

PAIRS = ("clearcoat", "default", "emissive", "metallic", "opacity", "workflow")


DIFFERENT = {f"USDClearcoat0{n}" for n in (6, 7, 8)}
"""Whose files say another clearcoatRoughness."""


def short(one: Material) -> str:
    return one.name.rsplit("/", 1)[-1].replace("_", "")


@pytest.mark.parametrize("name", PAIRS)
def test_openusds_materialx_stages_read_as_their_native_twins(assets: Path, name: str) -> None:
    folder = assets / "openusd_material_native"
    if not folder.is_dir():
        pytest.skip("no such assets")
    ours = load_stage(folder / f"materialX{name}.usda")
    twins = load_stage(folder / f"native{name.capitalize()}.usda")
    found = {short(one): one for one in ours.materials}
    assert len(twins.materials) > 2
    for twin in twins.materials:
        if short(twin) in DIFFERENT:
            continue
        one = found[short(twin)]
        assert one.model is twin.model
        for param in Param:
            assert one.inputs[param].value[:3] == pytest.approx(twin.inputs[param].value[:3], abs=1e-6), param


def test_the_chess_pawn_has_marble_and_a_glass_head(assets: Path) -> None:
    path = assets / "chess_pawn" / "Pawn" / "Pawn.usd"
    if not path.is_file():
        pytest.skip("no such asset")
    scene = load_stage(path)
    head, body = glass_named(scene, "M_Pawn_Top_B"), glass_named(scene, "M_Pawn_Body_B")
    assert head.model is Model.TRACED
    assert head.inputs[Param.TRANSMITTANCE].value[:3] == pytest.approx((0.2995, 0.5, 0.450276))
    assert scene.textures[body.inputs[Param.DIFFUSE].texture].srgb
    assert not scene.textures[body.inputs[Param.ROUGHNESS].texture].srgb
    assert body.inputs[Param.NORMAL].texture >= 0


def test_every_materialx_example_is_a_material(assets: Path) -> None:
    files = sorted(assets.glob("mtlx_examples/*/*.mtlx"))
    if not files:
        pytest.skip("no such assets")
    for file in files:
        scene = load_stage(file)
        stage = Usd.Stage.Open(mtlx.materials_of(str(file)))
        names = [prim.GetName() for prim in stage.Traverse() if prim.IsA(UsdShade.Material)]
        assert names
        for name in names:
            found = glass_named(scene, name)
            assert found.refractive == ("glass" in file.name or file.stem.endswith(("honey", "soapbubble"))), file
