"""Packages: everything a layer refers to, under names that cannot be mixed up, and out of one again safely."""

from __future__ import annotations

import os
import shutil
import zipfile
from pathlib import Path

import pytest
from layer_writing import content, opinions, package_of, stage_in, write
from pxr import Sdf, Usd, UsdValidation

from refract_core.errors import StageError
from refract_core.usd.layers.write import overlay, save


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    return stage_in(tmp_path)


@pytest.fixture
def package(stage: Path) -> Path:
    return package_of(stage)


# --- in


@pytest.mark.parametrize("kind", ["layer", "package"])
def test_a_package_is_flat_and_whole(stage: Path, package: Path, kind: str) -> None:
    out = stage.parents[1] / "out" / "a.usdz"
    opened = write(stage if kind == "layer" else package, out)
    with zipfile.ZipFile(out) as archive:
        entries = archive.infolist()
    assert entries[0].filename == "a.usdc"
    assert {entry.compress_type for entry in entries} == {zipfile.ZIP_STORED}
    assert not any(entry.filename.endswith(".usdz") for entry in entries)
    assert all(layer.anonymous or str(out) in layer.identifier for layer in opened.GetUsedLayers())
    shutil.rmtree(stage.parent)  # nothing outside is needed
    assert content(Usd.Stage.Open(str(out)).GetPrimAtPath("/World").GetAttribute("also").Get()) == b"parts/tex/a.png"
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    wrong = [str(error.GetMessage()) for error in context.Validate(opened) if "sdz" in str(error.GetIdentifier())]
    assert not wrong


def test_a_file_of_the_packages_name_is_not_mixed_up_with_it(stage: Path) -> None:
    """USD's packer takes a part that is called as the root layer for the root layer."""
    text = stage.read_text().replace("parts/${WHICH}.usda", "parts/a.usdc")
    (stage.parent / "parts" / "part.usda").rename(stage.parent / "parts" / "a.usda")
    Sdf.Layer.FindOrOpen(str(stage.parent / "parts" / "a.usda")).Export(str(stage.parent / "parts" / "a.usdc"))
    stage.write_text(text)
    before = opinions(Usd.Stage.Open(str(stage)))
    assert before["/World.picture"][2][0] == b"parts/tex/a.png"
    assert opinions(write(stage, stage.parents[1] / "out" / "a.usdz")) == before


def test_what_the_stage_lacks_the_package_may_lack(stage: Path) -> None:
    (stage.parent / "tex" / "a.png").unlink()
    out = stage.parents[1] / "out" / "a.usdz"
    assert opinions(write(stage, out))["/World.size"][2][0] == 5.0


def test_textures_of_a_layer_get_into_the_package(stage: Path) -> None:
    layer = overlay(str(stage), made="test")
    texture = Sdf.AttributeSpec(Sdf.CreatePrimInLayer(layer, "/Probe"), "probe:texture", Sdf.ValueTypeNames.Asset)
    picture = stage.parents[1] / "somewhere.exr"
    picture.write_bytes(b"picture")
    texture.default = Sdf.AssetPath(str(picture))
    out = stage.parents[1] / "out" / "a.usdz"
    save(layer, str(out))
    picture.unlink()
    assert content(Usd.Stage.Open(str(out)).GetPrimAtPath("/Probe").GetAttribute("probe:texture").Get()) == b"picture"
    # ... and out of one package into the next one
    again = overlay(str(stage), made="test")
    texture = Sdf.AttributeSpec(Sdf.CreatePrimInLayer(again, "/Probe"), "probe:texture", Sdf.ValueTypeNames.Asset)
    inner = next(name for name in zipfile.ZipFile(out).namelist() if name.endswith("somewhere.exr"))
    texture.default = Sdf.AssetPath(f"{out}[{inner}]")
    save(again, str(out))
    assert content(Usd.Stage.Open(str(out)).GetPrimAtPath("/Probe").GetAttribute("probe:texture").Get()) == b"picture"


def bad_package(path: Path, name: str, compression: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr("root.usda", "#usda 1.0\n")
        archive.writestr(name, "#usda 1.0\n" * 100)
    return path


@pytest.mark.parametrize(
    "name", ["../evil.usda", "/tmp/evil.usda", "a/../../evil.usda", "c:evil.usda", "a\\..\\b.usda"]
)
def test_a_name_that_leads_out_of_the_package_is_refused(tmp_path: Path, name: str) -> None:
    package = bad_package(tmp_path / "bad.usdz", name)
    with pytest.raises(StageError, match="leads out"):
        save(overlay(str(package), made="test"), str(tmp_path / "a.usdz"))
    assert os.listdir(tmp_path) == ["bad.usdz"]


def test_a_compressed_package_is_refused(tmp_path: Path) -> None:
    good = bad_package(tmp_path / "bad.usdz", "b.usda")
    layer = overlay(str(good), made="test")
    bad_package(good, "b.usda", zipfile.ZIP_DEFLATED)
    with pytest.raises(StageError, match="compressed"):
        save(layer, str(tmp_path / "a.usdz"))


def test_a_package_that_refers_to_files_outside_is_not_packed_again(tmp_path: Path) -> None:
    secret = tmp_path / "secret.usda"
    secret.write_text('#usda 1.0\ndef "Secret"\n{\n}\n')
    package = tmp_path / "bad.usdz"
    with zipfile.ZipFile(package, "w") as archive:
        archive.writestr("root.usda", f"#usda 1.0\n(\n    subLayers = [@{secret}@]\n)\n")
    with pytest.raises(StageError, match=r"secret\.usda outside"):
        save(overlay(str(package), made="test"), str(tmp_path / "a.usdz"))
    assert not (tmp_path / "a.usdz").exists()


@pytest.mark.parametrize("kind", ["layer", "package"])
def test_equal_stages_make_equal_packages(stage: Path, package: Path, kind: str) -> None:
    out = stage.parents[1] / "out"
    for name in ("a", "b"):
        (out / name).mkdir()
        write(stage if kind == "layer" else package, out / name / "x.usdz")
        for file in stage.parent.rglob("*"):
            os.utime(file)
    assert (out / "a" / "x.usdz").read_bytes() == (out / "b" / "x.usdz").read_bytes()


def test_contents_lie_on_64_byte_boundaries(stage: Path) -> None:
    (stage.parent / "tex" / "a.png").write_bytes(b"")
    out = stage.parents[1] / "out" / "a.usdz"
    write(stage, out)
    data = out.read_bytes()
    for entry in zipfile.ZipFile(out).infolist():
        name, extra = (
            int.from_bytes(data[entry.header_offset + i : entry.header_offset + i + 2], "little") for i in (26, 28)
        )
        assert (entry.header_offset + 30 + name + extra) % 64 == 0


def test_paths_that_are_absolute_or_searched_for_lead_to_their_files(stage: Path) -> None:
    """... of the same name in two folders."""
    far = stage.parents[1] / "far" / "tex"
    far.mkdir(parents=True)
    (far / "a.png").write_bytes(b"far")
    (stage.parent / "parts" / "near.png").write_bytes(b"near")
    part = stage.parent / "parts" / "part.usda"
    more = f'"Part"\n{{\n    asset far = @{far}/a.png@\n    asset near = @near.png@\n'
    part.write_text(part.read_text().replace('"Part"\n{\n', more))
    before = opinions(Usd.Stage.Open(str(stage)))
    assert [before[f"/World.{name}"][2][0] for name in ("far", "near")] == [b"far", b"near"]
    assert opinions(write(stage, stage.parents[1] / "out" / "a.usdz")) == before


def test_a_package_that_the_stage_refers_to_goes_in_as_it_is(stage: Path, package: Path) -> None:
    top = package.parent / "top.usda"
    top.write_text('#usda 1.0\n(\n    defaultPrim = "Top"\n)\ndef "Top" (\n    references = @./stage.usdz@\n)\n{\n}\n')
    before = opinions(Usd.Stage.Open(str(top)))
    assert before["/Top.size"][2][0] == 5.0
    assert opinions(write(top, stage.parents[1] / "out" / "a.usdz")) == before
