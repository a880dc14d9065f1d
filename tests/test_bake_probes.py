"""`refract bake probes`: what is baked, kept and skipped, what is written, and what a bake says of itself later."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import numpy as np
import pytest
from bake_studio import LEFT, RIGHT, STAGE, Studio, grey, probe_of, studio_in
from pxr import Sdf

from refract_core.errors import UsageError
from refract_core.images.cubemaps import read_cubemap, read_notes
from refract_core.probes.digest import probe_digest, stale_bake
from refract_core.scene import CUBE_LEVELS
from refract_core.usd.stage import load_stage
from refract_core.verbs import bake_probes as bake
from refract_core.verbs.bake_probes import BakeOrder, bake_probes
from refract_core.verbs.orders import file_names
from refract_core.version import __version__


@pytest.fixture
def studio(tmp_path: Path) -> Studio:
    return studio_in(tmp_path)


# --- what is written


def test_baked_probes_get_a_texture_and_the_others_a_reason(studio: Studio) -> None:
    studio.bake()
    assert studio.captured == [LEFT, RIGHT]
    assert studio.said[LEFT].startswith("baked: World_Left.exr, 64")
    for path, why in (("Live", "realtime"), ("Given", "custom"), ("Mirror", "planar")):
        assert why in studio.said[f"/World/{path}"]
        assert "skipped" in studio.said[f"/World/{path}"]
    assert sorted(os.listdir(studio.folder)) == ["out.probes", "out.usda", "stage.usda"]
    assert sorted(os.listdir(studio.folder / "out.probes")) == ["World_Left.exr", "World_Right.exr"]
    assert studio.fractions == sorted(studio.fractions)


def test_the_layer_says_what_was_baked_from_what(studio: Studio) -> None:
    opened = studio.bake(samples=4)
    prim = opened.GetPrimAtPath(LEFT)
    record = prim.GetCustomDataByKey("refractBake")
    digest = probe_digest(load_stage(studio.stage), probe_of(studio.stage, LEFT))
    assert record == {
        "digest": digest, "engine": __version__, "timeCode": 7.0, "stage": "stage.usda", "samples": 4,
    }  # fmt: skip
    assert prim.GetAttribute("probe:texture").Get().path == "./out.probes/World_Left.exr"
    assert not opened.GetRootLayer().GetAttributeAtPath(f"{LEFT}.probe:resolution")
    assert not opened.GetRootLayer().GetPrimAtPath("/World/Live")
    notes = read_notes(str(studio.texture(LEFT)), "a")
    assert (notes["probe"], notes["digest"], notes["timeCode"]) == (LEFT, digest, "7.0")


@pytest.mark.parametrize("extension", [".usda", ".usdc", ".usd", ".usdz"])
def test_the_reader_finds_the_picture_and_where_it_is_from(studio: Studio, extension: str) -> None:
    studio.bake(extension)
    probe = probe_of(studio.out(extension), LEFT)
    assert probe.cubemap is not None
    assert len(probe.cubemap.levels) == CUBE_LEVELS
    assert (probe.cubemap.levels[3] == np.array([1, 1, 1, 1, 7], np.float32)).all()
    assert probe.bake is not None
    assert (probe.bake.engine, probe.bake.time_code) == (__version__, 7.0)
    assert stale_bake(load_stage(studio.out(extension)), probe) is None


def test_a_package_has_everything_inside(studio: Studio) -> None:
    studio.bake(".usdz")
    assert sorted(os.listdir(studio.folder)) == ["out.usdz", "stage.usda"]
    names = zipfile.ZipFile(studio.out(".usdz")).namelist()
    assert names[0] == "out.usdc"
    assert sorted(Path(name).name for name in names[1:]) == ["World_Left.exr", "World_Right.exr", "stage.usda"]
    studio.stage.unlink()
    assert probe_of(studio.out(".usdz"), LEFT).cubemap is not None


def test_a_package_goes_in_and_out(studio: Studio) -> None:
    studio.bake(".usdz")
    studio.stage.unlink()
    order = BakeOrder(stage=str(studio.out(".usdz")), out=str(studio.folder / "again.usdz"), force=True, samples=8)
    bake_probes(order, studio.report(), lambda: False, capture=studio.capture)
    cubemap = probe_of(studio.folder / "again.usdz", RIGHT).cubemap
    assert cubemap is not None
    assert cubemap.levels[0][0, 0, 0, 0] == 0.5
    assert not any(name.endswith(".usdz") for name in zipfile.ZipFile(studio.folder / "again.usdz").namelist())


@pytest.mark.parametrize("layout", ["strip", "cross", "latlong"])
def test_layouts(studio: Studio, layout: str) -> None:
    studio.bake(layout=layout)
    assert read_notes(str(studio.texture(LEFT)), "a")["layout"] == layout
    assert read_cubemap(str(studio.texture(LEFT)), "a", 64).levels[0] == pytest.approx(
        grey(64, 16, load_stage(studio.stage))
    )


def test_a_resolution_is_authored_so_that_the_bake_stays_true(studio: Studio) -> None:
    studio.bake(resolution=128)
    probe = probe_of(studio.out(), LEFT)
    assert probe.resolution == 128
    assert stale_bake(load_stage(studio.out()), probe) is None
    studio.bake()
    assert studio.captured == [LEFT, RIGHT]
    assert probe_of(studio.out(), LEFT).resolution == 64


def test_names_of_textures_are_unique_and_stay() -> None:
    paths = ["/A/B", "/A_B", "/a_b", "/A/B/C", "/" + "x" * 400]
    names = file_names(paths)
    assert names == file_names(reversed(paths))
    assert len({name.lower() for name in names.values()}) == len(paths)
    assert names["/A/B"] == "A_B.exr"
    assert all(len(name.encode()) < 200 for name in names.values())


def test_the_stage_is_not_changed(studio: Studio) -> None:
    studio.bake()
    assert studio.stage.read_text() == STAGE
    assert "@./stage.usda@" in studio.out().read_text()


# --- what is kept


@pytest.mark.parametrize("extension", [".usda", ".usdz"])
def test_what_is_up_to_date_is_kept(studio: Studio, extension: str) -> None:
    studio.bake(extension)
    first = probe_of(studio.out(extension), LEFT)
    studio.bake(extension)
    assert not studio.captured
    assert studio.said[LEFT] == "kept: up to date"
    again = probe_of(studio.out(extension), LEFT)
    assert again.bake == first.bake
    assert again.cubemap is not None


@pytest.mark.parametrize("extension", [".usda", ".usdz"])
def test_a_changed_scene_is_stale_and_baked_again(studio: Studio, extension: str) -> None:
    studio.bake(extension)
    studio.change()
    scene = load_stage(studio.stage)
    if extension == ".usda":  # the package has its own copy of the stage
        notice = stale_bake(load_stage(studio.out()), probe_of(studio.out(), LEFT))
        assert notice is not None
        assert notice.path == LEFT
        assert "changed" in notice.text
        assert "refract bake probes" in notice.text
    studio.bake(extension)
    assert studio.captured == [LEFT, RIGHT]
    probe = probe_of(studio.out(extension), LEFT)
    assert probe.bake is not None
    assert probe.bake.digest == probe_digest(scene, probe)


def test_another_version_is_stale_and_baked_again(studio: Studio, monkeypatch: pytest.MonkeyPatch) -> None:
    studio.bake()
    monkeypatch.setattr(bake, "__version__", "99.0")
    monkeypatch.setattr("refract_core.probes.digest.__version__", "99.0")
    notice = stale_bake(load_stage(studio.out()), probe_of(studio.out(), LEFT))
    assert notice is not None
    assert f"refract {__version__} baked it, this is 99.0" in notice.text
    studio.bake()
    assert studio.captured == [LEFT, RIGHT]


def test_a_missing_or_damaged_texture_is_baked_again(studio: Studio) -> None:
    studio.bake()
    studio.texture(LEFT).unlink()
    studio.bake()
    assert studio.captured == [LEFT]
    studio.texture(LEFT).write_bytes(b"no picture")
    studio.bake()
    assert studio.captured == [LEFT]
    assert probe_of(studio.out(), LEFT).cubemap is not None


def test_more_samples_or_another_layout_are_baked_fewer_are_not(studio: Studio) -> None:
    studio.bake()
    studio.bake(samples=4)
    assert not studio.captured
    opened = studio.bake()
    assert opened.GetPrimAtPath(LEFT).GetCustomDataByKey("refractBake")["samples"] == 16
    studio.bake(samples=32)
    assert studio.captured == [LEFT, RIGHT]
    studio.bake(layout="cross")
    assert studio.captured == [LEFT, RIGHT]


def test_force_bakes_all_and_skip_existing_touches_nothing(studio: Studio) -> None:
    studio.bake()
    studio.bake(force=True, samples=8)
    assert studio.captured == [LEFT, RIGHT]
    studio.texture(RIGHT).unlink()
    studio.change()
    before = studio.texture(LEFT).read_bytes()
    old = probe_of(studio.out(), LEFT).bake
    studio.bake(skip_existing=True)
    assert studio.captured == [RIGHT]
    assert studio.said[LEFT] == "kept: exists"
    assert studio.texture(LEFT).read_bytes() == before
    assert probe_of(studio.out(), LEFT).bake == old  # which is stale, and says so


def test_skip_existing_takes_a_file_that_says_nothing_of_itself(studio: Studio) -> None:
    studio.texture(LEFT).parent.mkdir()
    studio.texture(LEFT).write_bytes(b"anything")
    studio.bake(skip_existing=True, only=(LEFT,))
    assert studio.texture(LEFT).read_bytes() == b"anything"
    assert probe_of(studio.out(), LEFT).bake is None


@pytest.mark.parametrize("extension", [".usda", ".usdz"])
@pytest.mark.parametrize("only", [(RIGHT,), ("*ight",), ("/World/R*", "*/Live")])
def test_only_some_leaves_the_others_as_they_were(studio: Studio, extension: str, only: tuple[str, ...]) -> None:
    studio.bake(extension)
    before = probe_of(studio.out(extension), LEFT)
    studio.change()
    studio.bake(extension, only=only)
    assert studio.captured == [RIGHT]
    after = probe_of(studio.out(extension), LEFT)
    assert after.bake == before.bake
    assert after.cubemap is not None


def test_a_prim_above_stands_for_its_probes(studio: Studio) -> None:
    studio.bake(only=("/World",))
    assert studio.captured == [LEFT, RIGHT]


def test_only_a_probe_that_is_not_there_is_named(studio: Studio) -> None:
    with pytest.raises(UsageError, match=r"/World/Middle.*/World/Left"):
        studio.bake(only=("/World/Middle",))
    assert os.listdir(studio.folder) == ["stage.usda"]


def test_what_the_stage_has_already_is_kept_there(studio: Studio) -> None:
    studio.bake()
    order = BakeOrder(stage=str(studio.out()), out=str(studio.folder / "next.usda"))
    studio.captured.clear()
    bake_probes(order, studio.report(), lambda: False, capture=studio.capture)
    assert not studio.captured
    assert sorted(os.listdir(studio.folder)) == ["next.usda", "out.probes", "out.usda", "stage.usda"]
    assert probe_of(studio.folder / "next.usda", LEFT).cubemap is not None


def test_a_probe_that_is_custom_now_shows_its_own_texture(studio: Studio) -> None:
    studio.bake()
    text = studio.stage.read_text().replace(
        'RefractProbe "Left"\n    {', 'RefractProbe "Left"\n    {\n        uniform token probe:mode = "custom"'
    )
    studio.stage.write_text(text)
    opened = studio.bake()
    assert "custom" in studio.said[LEFT]
    assert not opened.GetRootLayer().GetPrimAtPath(LEFT)


def test_a_probe_of_an_instance_is_named(studio: Studio) -> None:
    layer = Sdf.Layer.FindOrOpen(str(studio.stage))
    instance = Sdf.CreatePrimInLayer(layer, "/Copy")
    instance.specifier = Sdf.SpecifierDef
    instance.referenceList.Prepend(Sdf.Reference(primPath="/World"))
    instance.instanceable = True
    layer.Save()
    studio.bake()
    assert studio.captured == [LEFT, RIGHT]
    assert "instanceable" in studio.said["/Copy/Left"]


def test_a_stage_without_baked_probes_gives_a_layer_and_a_warning(studio: Studio) -> None:
    studio.stage.write_text(STAGE.split("    def RefractProbe")[0] + "}\n")
    studio.bake()
    assert "no probe" in studio.warned[str(studio.stage)]
    assert sorted(os.listdir(studio.folder)) == ["out.usda", "stage.usda"]
