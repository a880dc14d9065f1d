"""Reflection probes: their pictures, how many there may be, and what becomes of values that are out of range."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from probe_reading import cubemap, open_text, planar, probe, read, read_one, read_only, to_engine
from pxr import Sdf, Usd, UsdUtils

from refract_core.errors import ImageError, StageError
from refract_core.images.cubemaps import write_cubemap
from refract_core.scene import CUBE_LEVELS, Bake, Cubemap, Notice
from refract_core.usd.probes import pictures as probe_pictures
from refract_core.usd.probes.read import read_probes
from refract_core.usd.stage import load_stage

# ---- pictures

CUSTOM = 'uniform token probe:mode = "custom"'
SKY = "asset probe:texture = @/sky.exr@"


@pytest.mark.parametrize("mode", ["baked", "custom"])
def test_given_picture_is_read_at_the_probes_resolution(mode: str) -> None:
    found, notices = read_one(f'uniform token probe:mode = "{mode}"\nuniform int probe:resolution = 16\n{SKY}')
    assert notices == []
    assert found.cubemap is not None
    assert found.cubemap.resolution == 16
    assert found.cubemap.levels[0].max() == len("/sky.exr")


def test_a_file_that_several_probes_share_is_read_once() -> None:
    asked = []

    def counted(path: str, resolution: int) -> Cubemap:
        asked.append((path, resolution))
        return cubemap(path, resolution)

    half = f"{SKY}\nuniform int probe:resolution = 64"
    text = probe(SKY, name="A") + probe(SKY, name="B") + probe(half, name="C")
    found, _ = read(text, read_cubemap=counted)
    assert asked == [("/sky.exr", 128), ("/sky.exr", 64)]
    assert found[0].cubemap is found[1].cubemap


def test_picture_may_change_in_time() -> None:
    body = "asset probe:texture.timeSamples = { 0: @/a.exr@, 5: @/longer.exr@ }"
    lengths = []
    for time in (0.0, 5.0):
        (found,), _ = read(probe(body), time=time)
        assert found.cubemap is not None
        lengths.append(found.cubemap.levels[0].max())
    assert lengths == [len("/a.exr"), len("/longer.exr")]


def test_realtime_probe_never_uses_a_picture() -> None:
    found, notices = read_one('uniform token probe:mode = "realtime"\nasset probe:texture = @/missing.exr@')
    assert (found.cubemap, found.bake, notices) == (None, None, [])


@pytest.mark.parametrize(
    ("body", "word"),
    [
        (CUSTOM, "probe:texture is not set"),
        ("asset probe:texture = @/missing.exr@", "/missing.exr does not exist"),
        (f"{CUSTOM}\nasset probe:texture = @/missing.exr@", "/missing.exr does not exist"),
    ],
)
def test_probe_without_its_picture_is_captured_instead(body: str, word: str) -> None:
    found, notices = read_one(body, data=BAKED)
    assert (found.cubemap, found.bake) == (None, None)
    assert [word in text and "captured instead" in text for text in notices] == [True]


def test_picture_is_found_from_the_layer_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "sky.exr").write_bytes(b"sky")
    part = open_text(probe("asset probe:texture = @./sky.exr@"))
    part.GetRootLayer().Export(str(tmp_path / "parts" / "part.usda"))
    root = Sdf.Layer.CreateNew(str(tmp_path / "root.usda"))
    root.subLayerPaths.append("parts/part.usda")
    root.Save()
    assert opened(str(tmp_path / "root.usda")) == [str(tmp_path / "parts" / "sky.exr")]


def opened(stage: str) -> list[str]:
    """Which picture files reading the probes of a stage asks for."""
    paths: list[str] = []

    def noted(path: str, resolution: int) -> Cubemap:
        paths.append(path)
        return cubemap(path, resolution)

    notices: list[Notice] = []
    frame = {"engine_from_stage": to_engine(), "metres_per_unit": 1.0, "notices": notices}
    read_probes(Usd.Stage.Open(stage), Usd.TimeCode(0), read_cubemap=noted, **frame)  # type: ignore[arg-type]
    assert notices == []
    return paths


@pytest.mark.parametrize(
    ("body", "ignored"),
    [
        (SKY, "; probe:texture is ignored"),
        (CUSTOM, "; probe:mode 'custom' is ignored"),
        (f"{CUSTOM}\n{SKY}", "; probe:mode 'custom' and probe:texture are ignored"),
        (f'uniform token probe:mode = "realtime"\n{SKY}', "; probe:texture is ignored"),
    ],
)
def test_planar_probe_is_drawn_for_every_picture(body: str, ignored: str) -> None:
    found, notices = read_only(planar(body))
    assert (found.cubemap, found.bake) == (None, None)
    (text,) = notices
    assert text.startswith("a planar probe is drawn for every picture")
    assert ignored in text


# ---- picture files: what is handed to the decoder


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str | bytes, str, int]]:
    """Stands for the decoder; lists what it was given."""
    given: list[tuple[str | bytes, str, int]] = []

    def decode(source: str | bytes, name: str, resolution: int) -> Cubemap:
        given.append((source, name, resolution))
        return cubemap(name, resolution)

    monkeypatch.setattr("refract_core.images.cubemaps.read_cubemap", decode)
    return given


def test_file_is_decoded_by_its_path(tmp_path: Path, decoded: list[tuple[str | bytes, str, int]]) -> None:
    path = str(tmp_path / "sky.exr")
    Path(path).write_bytes(b"sky")
    assert probe_pictures.read_cubemap(path, 32).resolution == 32
    assert decoded == [(path, path, 32)]
    with pytest.raises(ImageError, match=r"none\.exr: no such file"):
        probe_pictures.read_cubemap(str(tmp_path / "none.exr"), 32)


def test_file_in_a_package_is_decoded_by_its_bytes(tmp_path: Path, decoded: list[tuple[str | bytes, str, int]]) -> None:
    (tmp_path / "sky.exr").write_bytes(b"the sky")
    stage = open_text(probe("asset probe:texture = @./sky.exr@"))
    stage.GetRootLayer().Export(str(tmp_path / "stage.usda"))
    package = str(tmp_path / "stage.usdz")
    assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "stage.usda"), package)
    (path,) = opened(package)
    assert path == f"{package}[sky.exr]"
    probe_pictures.read_cubemap(path, 8)
    assert decoded == [(b"the sky", path, 8)]
    with pytest.raises(ImageError, match=r"stage\.usdz holds no file 'none\.exr'"):
        probe_pictures.read_cubemap(f"{package}[none.exr]", 8)


# ---- what the picture was baked from

FIELDS = {
    "digest": 'string digest = "d1"',
    "engine": 'string engine = "1.2"',
    "timeCode": "double timeCode = 7.5",
    "stage": 'string stage = "room.usda"',
    "samples": "int samples = 16",
}


def record(**changed: str) -> str:
    """customData with the record; a field that is changed to '' is left out."""
    lines = "\n".join((FIELDS | changed).values())
    return f"dictionary refractBake = {{\n{lines}\n}}"


BAKED = record()


def test_record_of_a_bake_is_read() -> None:
    found, notices = read_one(SKY, data=BAKED)
    assert notices == []
    assert found.bake == Bake(digest="d1", engine="1.2", time_code=7.5)
    assert read_one(SKY)[0].bake is None


@pytest.mark.parametrize("packed", [False, True])
def test_baked_file_comes_back_with_all_levels(tmp_path: Path, packed: bool) -> None:
    sizes = [max(1, 64 >> level) for level in range(CUBE_LEVELS)]
    # Multiples of 1/64 below 16, so that 16-bit floats hold them.
    values = [np.arange(30 * n * n).reshape(6, n, n, 5) % 997 / 64 for n in sizes]
    levels = tuple(value.astype(np.float32) for value in values)
    write_cubemap(str(tmp_path / "sky.exr"), Cubemap(levels))
    stage = open_text(probe("uniform int probe:resolution = 64\nasset probe:texture = @./sky.exr@", data=BAKED))
    path = str(tmp_path / "stage.usda")
    stage.GetRootLayer().Export(path)
    if packed:
        assert UsdUtils.CreateNewUsdzPackage(path, f"{path[:-1]}z")
        path = f"{path[:-1]}z"
        (tmp_path / "sky.exr").unlink()
    scene = load_stage(path)
    assert [notice.text for notice in scene.notices if notice.path == "/P"] == []
    (found,) = scene.probes
    assert found.cubemap is not None
    assert found.bake == Bake(digest="d1", engine="1.2", time_code=7.5)
    assert [level.shape for level in found.cubemap.levels] == [level.shape for level in levels]
    assert all(np.array_equal(level, given) for level, given in zip(found.cubemap.levels, levels, strict=True))


@pytest.mark.parametrize(
    "data", [record(timeCode="int timeCode = 7"), record(stage="", samples=""), record(samples='string more = "x"')]
)
def test_record_needs_only_what_staleness_is_told_from(data: str) -> None:
    found, notices = read_one(SKY, data=data)
    assert notices == []
    assert found.bake is not None


@pytest.mark.parametrize(
    ("data", "word"),
    [
        (record(digest=""), "has no digest, which must be a text"),
        (record(digest='string digest = ""'), "has no digest"),
        (record(digest="int digest = 5"), "has no digest"),
        (record(engine=""), "has no engine, which must be a text"),
        (record(engine="double engine = 1.2"), "has no engine"),
        (record(timeCode=""), "has no timeCode, which must be a finite number"),
        (record(timeCode='string timeCode = "7"'), "has no timeCode"),
        (record(timeCode="bool timeCode = 1"), "has no timeCode"),
        (record(timeCode="double timeCode = nan"), "has no timeCode"),
        ('string refractBake = "yes"', "is not a dictionary"),
    ],
)
def test_malformed_record_is_told_and_the_picture_still_used(data: str, word: str) -> None:
    found, notices = read_one(SKY, data=data)
    assert found.cubemap is not None
    assert found.bake is None
    (text,) = notices
    assert text.startswith(f"customData refractBake {word}")
    assert "Bake it again" in text


def test_custom_picture_was_not_baked() -> None:
    found, notices = read_one(f"{CUSTOM}\n{SKY}", data=BAKED)
    assert found.cubemap is not None
    assert (found.bake, notices) == (None, [])


# ---- where nothing is met, and nearness


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("", None),
        ("color3f probe:backgroundColor = (1, 2, 3)", None),
        ('uniform token probe:clear = "sky"\ncolor3f probe:backgroundColor = (1, 2, 3)', None),
        ('uniform token probe:clear = "color"', (0.0, 0.0, 0.0)),
        ('uniform token probe:clear = "color"\ncolor3f probe:backgroundColor = (0.5, 2, 30)', (0.5, 2.0, 30.0)),
    ],
)
def test_background(body: str, expected: tuple[float, ...] | None) -> None:
    found, notices = read_one(body, metres=0.01)
    assert notices == []
    assert found.background == expected


@pytest.mark.parametrize(
    ("colour", "used"), [("(1, -2, 3)", (1, 0, 3)), ("(1, nan, 3)", (0, 0, 0)), ("(1, inf, 3)", (0, 0, 0))]
)
def test_impossible_background_is_replaced_and_told(colour: str, used: tuple[float, ...]) -> None:
    found, notices = read_one(f'uniform token probe:clear = "color"\ncolor3f probe:backgroundColor = {colour}')
    assert found.background == used
    assert ["three numbers of 0 or more" in text for text in notices] == [True]


def test_distance_based_roughness() -> None:
    found, notices = read_one("uniform bool probe:distanceBasedRoughness = 1")
    assert found.distance_roughness is True
    assert notices == []


@pytest.mark.parametrize(("mode", "kind", "sees"), [
    ("realtime", "RefractProbe", True), ("baked", "RefractProbe", False), ("custom", "RefractProbe", False),
    ("realtime", "RefractPlanarProbe", False),
])  # fmt: skip
def test_only_realtime_cubes_see_glass(mode: str, kind: str, sees: bool) -> None:
    body = f'uniform bool probe:captureRefraction = 1\nuniform token probe:mode = "{mode}"'
    found, notices = read_only(probe(body + ("\n" + SKY if mode == "custom" else ""), kind=kind))
    assert found.sees_glass == sees
    assert ["probe:captureRefraction is ignored" in text for text in notices] == [True] * (not sees)


# ---- how many


def crowd(count: int, first: str = "") -> str:
    """Probes /P0, /P1 ... and before them what `first` says."""
    return first + "".join(probe(name=f"P{i}") for i in range(count))


def test_as_many_probes_as_hdrp_considers() -> None:
    found, notices = read(crowd(256))
    assert notices == []
    assert [one.path for one in found] == [f"/P{i}" for i in range(256)]


def test_the_least_important_probes_beyond_that_are_dropped() -> None:
    low = probe("int probe:importance = 0", name="Low")
    large = probe("float3 probe:influence:size = (10, 10, 10.5)", name="Large")
    last = probe("int probe:importance = 2\nfloat3 probe:influence:size = (99, 99, 99)", name="Last")
    found, notices = read(crowd(255, first=low + large) + last)
    assert [one.path for one in found] == [*(f"/P{i}" for i in range(255)), "/Last"]
    assert [notice.path for notice in notices] == ["/Large"]
    for word in ("258 probes", "256 at most", "2 are ignored"):
        assert word in notices[0].text


def test_of_equals_the_last_are_dropped_and_their_pictures_not_opened() -> None:
    found, notices = read(crowd(256) + probe("asset probe:texture = @/missing.exr@", name="Z"))
    assert len(found) == 256
    assert [(notice.path, "257 probes" in notice.text) for notice in notices] == [("/Z", True)]


# ---- values out of range


@pytest.mark.parametrize("name", ["mode", "shape", "proxy", "clear"])
def test_unknown_token_is_an_error_that_lists_the_known_ones(name: str) -> None:
    with pytest.raises(StageError, match=rf"^/P: probe:{name} is 'banana'; choose from \w+, \w+"):
        read(probe(f'uniform token probe:{name} = "banana"'))


@pytest.mark.parametrize(
    ("authored", "field", "used"),
    [
        ("uniform int probe:resolution = 7", "resolution", 8),
        ("uniform int probe:resolution = 5000", "resolution", 4096),
        ("float2 probe:clippingRange = (5, 5)", "clipping", (0.1, 1000)),
        ("float2 probe:clippingRange = (0, 5)", "clipping", (0.1, 1000)),
        ("float2 probe:clippingRange = (1, inf)", "clipping", (0.1, 1000)),
        ("float3 probe:captureOffset = (nan, 0, 0)", "capture_point", (0, 0, 0)),
        ("float probe:fadeDistance = 0", "fade_distance", 10000),
        ("float probe:weight = 2", "weight", 1),
        ("float probe:weight = nan", "weight", 1),
        ("float probe:multiplier = -1", "multiplier", 0),
        ('uniform string probe:distanceBasedRoughness = "yes"', "distance_roughness", False),
        ('uniform string probe:captureRefraction = "yes"', "sees_glass", False),
        ("int probe:importance = -3", "importance", 0),
        ("float[] probe:influence:blendDistance = [1]", "blend_distance", (0,) * 6),
        ("float[] probe:influence:blendDistance = [-1, 9, 1, 1, 1, 1]", "blend_distance", (0, 5, 1, 1, 1, 1)),
        ("float[] probe:influence:blendNormalDistance = [6, 0, 0, 0, 0, 0]", "blend_normal_distance", (5,) + (0,) * 5),
        ("float[] probe:influence:faceFade = [0, 2, 0, 0, 0, 0]", "face_fade", (0, 1, 0, 0, 0, 0)),
    ],
)
def test_values_out_of_range_are_replaced_and_told(authored: str, field: str, used: float | tuple[float, ...]) -> None:
    found, notices = read_one(authored)
    assert getattr(found, field) == pytest.approx(used)
    name = authored.split(" = ")[0].split()[-1]
    assert [text.startswith(f"{name} is ") and "used" in text for text in notices] == [True]


@pytest.mark.parametrize("size", ["(0, 1, 1)", "(1, -1, 1)", "(1, 1, inf)", "(nan, 1, 1)"])
def test_impossible_box_falls_back_to_the_schemas_size(size: str) -> None:
    found, notices = read_one(f"float3 probe:influence:size = {size}")
    assert found.influence.extents == (5.0, 5.0, 5.0)
    assert ["three numbers above 0" in text for text in notices] == [True]
    assert all(math.isfinite(extent) for extent in found.influence.extents)
