"""Layers over a stage: nothing of it is lost, nothing of it is touched, and the file is whole or not there."""

from __future__ import annotations

import os
import shutil
import stat
import zipfile
from pathlib import Path

import pytest
from layer_writing import EXTENSIONS, content, opinions, package_of, stage_in, write
from pxr import Sdf, Usd

from refract_core.errors import StageError, UsageError
from refract_core.usd.layers.write import RECORD, check_out, overlay, save


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    return stage_in(tmp_path)


@pytest.fixture
def package(stage: Path) -> Path:
    return package_of(stage)


# --- what stays


@pytest.mark.parametrize("extension", EXTENSIONS)
@pytest.mark.parametrize("kind", ["layer", "package"])
def test_every_opinion_of_the_stage_is_still_there(stage: Path, package: Path, kind: str, extension: str) -> None:
    source = stage if kind == "layer" else package
    before = opinions(Usd.Stage.Open(str(source)))
    assert before["/World.size"][2][0] == 5.0
    assert before["/World.below"][1] == [5.0, 25.0]
    assert before["/World.picture"][2][0] == b"parts/tex/a.png"
    assert before["/World{look}"] == (["blue", "red"], "red")
    assert opinions(write(source, stage.parents[1] / "out" / f"a{extension}")) == before


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_stage_metadata_is_the_stages_own(stage: Path, extension: str) -> None:
    before = Usd.Stage.Open(str(stage))
    after = write(stage, stage.parents[1] / "out" / f"a{extension}")
    for key in (
        "upAxis", "metersPerUnit", "kilogramsPerUnit", "defaultPrim", "startTimeCode", "endTimeCode", "framePrecision",
        "timeCodesPerSecond", "framesPerSecond", "fallbackPrimTypes", "renderSettingsPrimPath", "comment",
    ):  # fmt: skip
        assert before.HasAuthoredMetadata(key), key
        assert after.GetMetadata(key) == before.GetMetadata(key), key
    layer = after.GetRootLayer()
    assert len(layer.subLayerPaths) == 1
    assert layer.subLayerOffsets[0] == Sdf.LayerOffset()
    data = layer.customLayerData
    assert data["owner"] == "somebody"
    assert data[RECORD]["made"] == "test"
    for found in (layer.colorConfiguration, data["pictures"][0]):
        resolved = Sdf.ComputeAssetPathRelativeToLayer(layer, found.path)
        expected = b"looks/studio.ocio" if "ocio" in found.path else b"tex/a.png"
        assert content(Sdf.AssetPath(found.path, resolved)) == expected


def test_an_opinion_in_the_layer_wins_and_the_stage_is_not_touched(stage: Path) -> None:
    before = {path: path.read_bytes() for path in stage.parent.rglob("*") if path.is_file()}
    layer = overlay(str(stage), made="test")
    size = Sdf.AttributeSpec(Sdf.CreatePrimInLayer(layer, "/World"), "size", Sdf.ValueTypeNames.Double)
    size.default = 9.0
    out = stage.parents[1] / "out" / "a.usda"
    save(layer, str(out))
    opened = Usd.Stage.Open(str(out))
    prim = opened.GetPrimAtPath("/World")
    assert prim.GetAttribute("size").Get() == 9.0
    assert prim.GetAttribute("picture").Get().resolvedPath
    assert {path: path.read_bytes() for path in stage.parent.rglob("*") if path.is_file()} == before


def test_a_changed_stage_is_read_afresh(stage: Path) -> None:
    kept = Sdf.Layer.FindOrOpen(str(stage))
    text = stage.read_text().replace("metersPerUnit = 0.1", "metersPerUnit = 0.5")
    os.utime(stage, (1, 1))
    kept.Reload()
    stage.write_text(text)
    assert overlay(str(stage), made="test").pseudoRoot.GetInfo("metersPerUnit") == 0.5


# --- where paths lead


def test_paths_are_relative_so_that_the_folder_can_move(stage: Path) -> None:
    out = stage.parents[1] / "out" / "a.usda"
    before = opinions(write(stage, out))
    text = out.read_text()
    assert "@../in/stage.usda@" in text
    assert str(stage.parents[1]) not in text
    elsewhere = stage.parents[1] / "elsewhere"
    elsewhere.mkdir()
    for folder in ("in", "out"):
        shutil.move(str(stage.parents[1] / folder), elsewhere / folder)
    assert opinions(Usd.Stage.Open(str(elsewhere / "out" / "a.usda"))) == before


def test_a_neighbour_is_named_with_a_dot_so_that_no_search_path_is_asked(stage: Path) -> None:
    write(stage, stage.parent / "a.usda")
    assert "@./stage.usda@" in (stage.parent / "a.usda").read_text()


def test_a_package_is_named_as_it_is(package: Path) -> None:
    out = package.parent / "a.usda"
    assert opinions(write(package, out)) == opinions(Usd.Stage.Open(str(package)))
    assert "@./stage.usdz@" in out.read_text()


def test_a_layer_inside_a_package_can_be_the_stage(package: Path) -> None:
    inner = next(name for name in zipfile.ZipFile(package).namelist() if name.endswith("part.usda"))
    for extension in (".usda", ".usdz"):
        stage = write(f"{package}[{inner}]", package.parent / f"a{extension}")
        assert content(stage.GetPrimAtPath("/Part").GetAttribute("picture").Get()) == b"parts/tex/a.png"


def test_a_package_knows_a_stage_of_another_tree_and_tells_no_folder_of_it(tmp_path: Path) -> None:
    stage, out = Path(__file__).parents[1] / "usd_samples" / "good" / "marble.usda", tmp_path / "a.usdz"
    save(overlay(str(stage), made="test"), str(out))
    record = Sdf.Layer.FindOrOpen(str(out)).customLayerData[RECORD]
    assert str(stage.parent) not in record["stage"]
    check_out(str(stage), str(out), overwrite=False, ours="test")
    with pytest.raises(UsageError, match="exists already"):
        check_out(str(stage.with_name("window.usda")), str(out), overwrite=False, ours="test")


def test_formats_follow_the_extension(stage: Path) -> None:
    starts = {}
    for extension in EXTENSIONS:
        out = stage.parents[1] / "out" / f"a{extension}"
        write(stage, out)
        starts[extension] = out.read_bytes()[:8]
    assert starts == {".usda": b"#usda 1.", ".usdc": b"PXR-USDC", ".usd": b"PXR-USDC", ".usdz": starts[".usdz"]}
    assert starts[".usdz"][:4] == b"PK\x03\x04"
    assert os.listdir(stage.parents[1] / "out") == sorted(f"a{e}" for e in EXTENSIONS) or len(starts) == 4


# --- refused before any work


@pytest.mark.parametrize("name", ["a.png", "a", "a.usdx", ""])
def test_other_extensions_are_refused(stage: Path, name: str) -> None:
    with pytest.raises(UsageError, match=r"\.usd, \.usda, \.usdc, \.usdz"):
        check_out(str(stage), name and str(stage.parent / name), overwrite=True)


def test_a_folder_that_is_not_there_is_named(stage: Path) -> None:
    with pytest.raises(UsageError, match="make it first"):
        check_out(str(stage), str(stage.parent / "missing" / "a.usda"), overwrite=True)
    (stage.parent / "a.usda").mkdir()
    with pytest.raises(UsageError, match="is a folder"):
        check_out(str(stage), str(stage.parent / "a.usda"), overwrite=True)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_folder_is_named(stage: Path) -> None:
    (stage.parents[1] / "out").chmod(stat.S_IRUSR | stat.S_IXUSR)
    with pytest.raises(StageError, match="cannot be written"):
        check_out(str(stage), str(stage.parents[1] / "out" / "a.usda"), overwrite=True)


@pytest.mark.parametrize(
    "name", ["stage.usda", "parts/part.usda", "parts/below.usda", "parts/../stage.usda", "link.usda"]
)
def test_the_stage_and_its_layers_are_never_replaced(stage: Path, name: str) -> None:
    (stage.parent / "link.usda").symlink_to("parts/part.usda")
    with pytest.raises(UsageError, match="never changed"):
        check_out(str(stage), str(stage.parent / name), overwrite=True, ours="test")


def test_a_package_is_not_replaced_by_what_is_made_of_its_layer(package: Path) -> None:
    for source in (str(package), f"{package}[0/part.usda]"):
        with pytest.raises(UsageError, match="never changed"):
            check_out(source, str(package), overwrite=True)


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_an_existing_file_is_replaced_only_if_it_is_ours_or_asked_for(stage: Path, extension: str) -> None:
    out = stage.parents[1] / "out" / f"a{extension}"
    write(stage, out)
    check_out(str(stage), str(out), overwrite=False, ours="test")
    check_out(str(stage), str(out), overwrite=True)
    os.chdir(stage.parent)
    check_out("stage.usda", f"../out/a{extension}", overwrite=False, ours="test")
    other = stage.parent / "other.usda"
    shutil.copy(stage, other)
    for source, ours in ((stage, ""), (stage, "convert"), (other, "test")):
        with pytest.raises(UsageError, match="--overwrite"):
            check_out(str(source), str(out), overwrite=False, ours=ours)


def test_a_strange_existing_file_is_not_ours(stage: Path) -> None:
    out = stage.parents[1] / "out" / "a.usda"
    for text in ("no usd", "#usda 1.0\n", "#usda 1.0\n(\n    customLayerData = {\n        int refract = 1\n    }\n)\n"):
        out.write_text(text)
        with pytest.raises(UsageError, match="--overwrite"):
            check_out(str(stage), str(out), overwrite=False, ours="test")


def test_an_unreadable_stage_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.usda").write_text("no usd")
    for name in ("a.usda", "missing.usda"):
        with pytest.raises(StageError, match=name):
            overlay(str(tmp_path / name), made="test")


# --- failures


@pytest.mark.parametrize("extension", EXTENSIONS)
def test_a_failure_leaves_the_old_file_and_nothing_else(
    stage: Path, monkeypatch: pytest.MonkeyPatch, extension: str
) -> None:
    out = stage.parents[1] / "out" / f"a{extension}"
    out.write_bytes(b"old")

    def refused(_source: str, _target: str) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(os, "replace", refused)
    with pytest.raises(StageError, match="Read-only"):
        save(overlay(str(stage), made="test"), str(out))
    monkeypatch.undo()
    assert os.listdir(out.parent) == [out.name]
    assert out.read_bytes() == b"old"


def test_usd_says_nothing_on_stderr(stage: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (stage.parent / "tex" / "a.png").unlink()
    for extension in EXTENSIONS:
        out = str(stage.parents[1] / "out" / f"a{extension}")
        for _ in range(2):
            check_out(str(stage), out, overwrite=True)
            save(overlay(str(stage), made="test"), out)
    assert capfd.readouterr() == ("", "")
