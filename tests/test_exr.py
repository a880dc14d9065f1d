"""EXR files for compositing: parts, compression, what the head says, and mattes, read back by what is here alone."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import box, camera, dome, glass, material, scene
from typer.testing import CliRunner

import refract_core as rc
from refract_core.cli import app
from refract_core.errors import ImageError, UsageError
from refract_core.images.aovs import AOVS, shape_of
from refract_core.images.cryptomatte import Matte, hash_of, murmur3_32
from refract_core.images.exr import COMPRESSIONS
from refract_core.images.frame import Frame
from refract_core.images.pictures import read_planes
from refract_core.scene import F32, Instances, Model, Paths, Run, Scene, Sphere
from refract_core.settings import RenderSettings

SAMPLES = Path(__file__).parents[1] / "usd_samples" / "good"
WIDTH, HEIGHT = 40, 24


def frame(scale: float = 1.0) -> Frame:
    rng = np.random.default_rng(5)
    planes = {name: (rng.random(shape_of(name, HEIGHT, WIDTH)) * scale).astype(np.float32) for name in AOVS}
    return Frame(WIDTH, HEIGHT, planes, {"refract:samples": 4.0})


def heads(path: Path) -> list[dict[str, tuple[str, bytes]]]:
    """Attributes of every part of an EXR file: name -> type and value ("OpenEXR File Layout"). Shares nothing with the
    library that wrote them."""
    data = path.read_bytes()
    assert data[:4] == b"\x76\x2f\x31\x01"
    many = bool(data[5] & 0x10)
    at, found = 8, []

    def text(at: int) -> tuple[str, int]:
        end = data.index(b"\0", at)
        return data[at:end].decode(), end + 1

    while True:
        head: dict[str, tuple[str, bytes]] = {}
        while data[at]:
            name, at = text(at)
            kind, at = text(at)
            (size,) = struct.unpack_from("<i", data, at)
            head[name] = kind, data[at + 4 : at + 4 + size]
            at += 4 + size
        found.append(head)
        at += 1
        if not many or not data[at]:
            return found


def channels(head: dict[str, tuple[str, bytes]]) -> dict[str, int]:
    """Channel -> type of its numbers: 1 half, 2 float."""
    kind, data = head["channels"]
    assert kind == "chlist"
    found, at = {}, 0
    while data[at]:
        end = data.index(b"\0", at)
        (found[data[at:end].decode()],) = struct.unpack_from("<i", data, end + 1)
        at = end + 17
    return found


def numbers(head: dict[str, tuple[str, bytes]], name: str, kind: str) -> NDArray[Any]:
    assert head[name][0] == kind
    return np.frombuffer(head[name][1], "<f4")


# --- parts


def test_each_aov_is_a_part_and_the_picture_comes_first(tmp_path: Path) -> None:
    frame().save(tmp_path / "a.exr", aovs=("Z", "N", "beauty"))
    found = heads(tmp_path / "a.exr")
    assert [head["name"][1].decode() for head in found] == ["beauty", "Z", "N"]
    assert [set(channels(head)) for head in found] == [set("RGBA"), {"Z"}, {"N.X", "N.Y", "N.Z"}]
    assert all(head["refract:samples"] for head in found)


def test_one_part_holds_the_same_numbers(tmp_path: Path) -> None:
    for parts in ("one", "many"):
        frame().save(tmp_path / f"{parts}.exr", exr_parts=parts)
    one, many = (read_planes(str(tmp_path / f"{parts}.exr")) for parts in ("one", "many"))
    assert len(heads(tmp_path / "one.exr")) == 1
    assert len(heads(tmp_path / "many.exr")) == len(AOVS)
    assert one.keys() == many.keys() == AOVS.keys()
    for name in AOVS:
        np.testing.assert_array_equal(one[name], many[name])


@pytest.mark.parametrize("parts", ["one", "many"])
def test_numbers_are_half_where_that_is_enough(tmp_path: Path, parts: str) -> None:
    frame().save(tmp_path / "a.exr", exr_parts=parts)
    kinds = {name: kind for head in heads(tmp_path / "a.exr") for name, kind in channels(head).items()}
    assert {name for name, kind in kinds.items() if kind == 2} == {"Z", "P.X", "P.Y", "P.Z"}


def test_lengths_that_half_floats_do_not_reach_stay_float(tmp_path: Path) -> None:
    """A thickness of 100 m in a stage of millimetres; the largest half is 65504."""
    made = frame()
    made.planes["thickness"][0, 0] = 1e5
    made.save(tmp_path / "a.exr")
    assert read_planes(str(tmp_path / "a.exr"))["thickness"][0, 0] == 1e5


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_only_colours_are_ever_changed_by_compression(tmp_path: Path, compression: str) -> None:
    """By its number in the file ("OpenEXR File Layout"): none 0, zips 2, zip 3, piz 4, dwaa 8."""
    code = {"none": 0, "zips": 2, "zip": 3, "piz": 4, "dwaa": 8}
    made = frame()
    made.save(tmp_path / "a.exr", exr_compression=compression)
    made.save(tmp_path / "b.exr", exr_compression="none")
    a, b = (read_planes(str(tmp_path / f"{name}.exr")) for name in "ab")
    for head in heads(tmp_path / "a.exr"):
        name = head["name"][1].decode()
        lossy = compression == "dwaa" and AOVS[name].color
        assert head["compression"][1][0] == code["zips" if compression == "dwaa" and not lossy else compression]
        if not lossy:
            np.testing.assert_array_equal(a[name], b[name])


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"exr_compression": "lzw"}, "zip, zips, dwaa, piz, none"),
        ({"exr_parts": "three"}, "many, one"),
        ({"exr_compression": "dwaa", "exr_parts": "one"}, "would change N, which is no colour"),
    ],
)
def test_what_no_file_can_be_is_refused(tmp_path: Path, how: dict[str, str], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        frame().save(tmp_path / "a.exr", **how)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match=r"is no \.exr file"):
        frame().save(tmp_path / "a.png", exr_parts="one")
    assert not list(tmp_path.iterdir())


def test_dwaa_in_one_part_is_for_colours(tmp_path: Path) -> None:
    frame().save(tmp_path / "a.exr", aovs=("beauty", "reflection"), exr_compression="dwaa", exr_parts="one")
    assert heads(tmp_path / "a.exr")[0]["compression"][1] == b"\x08"


def test_a_file_that_ends_early_is_refused_whatever_part_is_missing(tmp_path: Path) -> None:
    made = frame()
    made.save(tmp_path / "a.exr")
    data = (tmp_path / "a.exr").read_bytes()
    for share in (0.3, 0.6, 0.95):
        (tmp_path / "cut.exr").write_bytes(data[: int(share * len(data))])
        with pytest.raises(ImageError, match=r"cut\.exr"):
            read_planes(str(tmp_path / "cut.exr"))


# --- what the head says


def test_the_head_says_which_colours_these_are(tmp_path: Path) -> None:
    """Primaries and white of ITU-R BT.709-6; the name is that of the Color Interop Forum."""
    frame().save(tmp_path / "a.exr", aovs=("beauty", "Z"))
    picture, depth = heads(tmp_path / "a.exr")
    primaries = numbers(picture, "chromaticities", "chromaticities")
    np.testing.assert_allclose(primaries, [0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329], atol=1e-6)
    assert picture["colorInteropID"][1] == b"lin_rec709_scene"
    assert depth["colorInteropID"][1] == b"data"


@pytest.mark.draws
@pytest.mark.parametrize("orthographic", [False, True])
def test_the_matrices_take_the_picture_s_points_to_their_pixels(tmp_path: Path, orthographic: bool) -> None:
    """OpenEXR's matrices are for row vectors; the points, of a stage in centimetres with Z up, are in its own world."""
    eye = replace(camera((1.5, 0.4, 2.0), (0.2, 0.0, 0.0)), orthographic=orthographic, window=(-0.6, 0.9, -0.5, 0.6))
    turned = np.array([[100.0, 0, 0, 7], [0, 0, -100, 8], [0, 100, 0, 9], [0, 0, 0, 1]])
    made = replace(scene([box("/b", (0.5, 0.4, 0.3), 0)], [material("/m")], cameras=(eye,)),
                   stage_from_engine=turned, metres_per_unit=0.01)  # fmt: skip
    drawn = rc.render(made, RenderSettings(image_width=32, image_height=24, samples=1, jobs=1))
    drawn.save(tmp_path / "a.exr")
    head = heads(tmp_path / "a.exr")[0]
    rows, columns = np.nonzero(np.isfinite(drawn.planes["Z"]))
    assert len(rows) > 40
    points = np.column_stack([drawn.planes["P"][rows, columns], np.ones(len(rows))])
    seen = points @ numbers(head, "worldToCamera", "m44f").reshape(4, 4)
    np.testing.assert_allclose(-seen[:, 2], drawn.planes["Z"][rows, columns], rtol=1e-4)
    clip = points @ numbers(head, "worldToNDC", "m44f").reshape(4, 4)
    ndc = clip[:, :3] / clip[:, 3:]
    np.testing.assert_allclose(ndc[:, 0], (columns + 0.5) / 32 * 2 - 1, atol=1e-3)
    np.testing.assert_allclose(ndc[:, 1], 1 - (rows + 0.5) / 24 * 2, atol=1e-3)
    near, far = (float(numbers(head, name, "float")[0]) for name in ("near", "far"))
    assert (near, far) == pytest.approx([d * 100 for d in eye.clipping])
    for distance, z in ((near, -1.0), (far, 1.0)):
        to_world = np.linalg.inv(numbers(head, "worldToCamera", "m44f").reshape(4, 4).astype(np.float64))
        at = np.array([0, 0, -distance, 1]) @ to_world @ numbers(head, "worldToNDC", "m44f").reshape(4, 4)
        assert at[2] / at[3] == pytest.approx(z, abs=0.01)


@pytest.mark.draws
def test_seconds_are_told_but_for_those_who_want_equal_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = rc.render(still(), RenderSettings(image_width=16, image_height=8, samples=1))
    assert 0.0 < drawn.seconds < 3600.0
    monkeypatch.delenv("SOURCE_DATE_EPOCH", raising=False)
    drawn.save(tmp_path / "a.exr")
    assert numbers(heads(tmp_path / "a.exr")[0], "refract:seconds", "float")[0] == pytest.approx(drawn.seconds)
    assert numbers(heads(tmp_path / "a.exr")[0], "refract:samples", "float")[0] == 1.0
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1577836800")
    drawn.save(tmp_path / "a.exr")
    assert "refract:seconds" not in heads(tmp_path / "a.exr")[0]


# --- Cryptomatte


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"", 0),
        (b"hello", 0x248BFA47),
        (b"hello, world", 0x149BBB7F),
        (b"The quick brown fox jumps over the lazy dog", 0x2E4FF723),
    ],
)
def test_the_hash_is_murmurhash3(data: bytes, expected: int) -> None:
    """Test vectors of MurmurHash3_x86_32 that its many implementations share."""
    assert murmur3_32(data) == expected


def test_the_hash_takes_a_seed() -> None:
    assert (murmur3_32(b"", 1), murmur3_32(b"", 0xFFFFFFFF)) == (0x514E28B7, 0x81F16F39)


@pytest.mark.parametrize(("name", "number"), [("cube", -4.08461912519e15), ("sphere", 2.79018604383e15),
                                              ("plane", 3.66557617593e-11)])  # fmt: skip
def test_ids_are_those_of_psyop_s_own_tests(name: str, number: float) -> None:
    assert float(np.uint32(hash_of(name)).view(np.float32)) == pytest.approx(number, rel=1e-9)


def test_every_id_is_an_ordinary_number() -> None:
    """No zero, denormal, infinity or NaN, of which a 128th of all hashes would be some."""
    bits = np.array([hash_of(f"/World/Thing{k}") for k in range(20000)], np.uint32)
    plain = np.array([murmur3_32(f"/World/Thing{k}".encode()) for k in range(20000)], np.uint32)
    assert np.isin((plain >> 23) & 255, (0, 255)).any(), "the names must meet the case"
    values = np.abs(bits.view(np.float32))
    assert np.isfinite(values).all()
    assert (values >= np.finfo(np.float32).tiny).all()
    assert set(np.unique(bits ^ plain).tolist()) == {0, 1 << 23}


def decoded(path: Path, name: str) -> tuple[dict[str, F32], F32]:
    """Coverage by name, and what is nobody's, of a file with mattes: as whoever knows the specification reads it."""
    import OpenImageIO as oiio

    first = heads(path)[0]
    key = next(key for key, (_, value) in first.items() if key.startswith("cryptomatte/") and value == name.encode())
    place = key.rpartition("/")[0]
    said = {word: first[f"{place}/{word}"][1].decode() for word in ("hash", "conversion", "manifest")}
    assert len(place) == len("cryptomatte/") + 7
    assert (said["hash"], said["conversion"]) == ("MurmurHash3_32", "uint32_to_float32")
    file: Any = oiio.ImageInput.open(str(path))
    ids, shares = [], []
    part = 0
    while file.seek_subimage(part, 0):
        spec = file.spec()
        pixels = file.read_image(part, 0, 0, spec.nchannels, oiio.FLOAT)
        columns = {channel: pixels[..., k] for k, channel in enumerate(spec.channelnames)}
        for level in range(3):
            for one, share in ("RG", "BA"):
                if f"{name}{level:02}.{one}" in columns:
                    ids.append(np.ascontiguousarray(columns[f"{name}{level:02}.{one}"]).view(np.uint32))
                    shares.append(columns[f"{name}{level:02}.{share}"])
        part += 1
    assert len(ids) == 6
    assert all((a >= b).all() for a, b in pairwise(shares)), "the largest first"
    found: dict[str, F32] = {}
    total: F32 = np.zeros_like(shares[0])
    for thing, bits in json.loads(said["manifest"]).items():
        assert int(bits, 16) == hash_of(thing)
        found[thing] = sum(np.where(i == int(bits, 16), s, 0) for i, s in zip(ids, shares, strict=True))  # type: ignore[assignment]
        total += found[thing]
    np.testing.assert_allclose(total, sum(shares), atol=1e-6)
    return found, np.float32(1.0) - total


def still(**changes: Any) -> Scene:
    """A ball of glass before a block, in front of nothing."""
    return scene(
        [box("/World/Block", (0.9, 0.2, 0.2), 1, centre=(0, 0, -2))],
        [glass(Model.TRACED, 1.5), material("/World/Looks/Block")],
        [Sphere("/World/Ball", (0, 0, 0), 0.5, 0)],
        **{"cameras": (camera((0, 0, 4), (0, 0, 0)),), "environment": dome(1.0), **changes},
    )


BOTH = RenderSettings(image_width=96, image_height=96, samples=16, caustics=0, cryptomatte=("object", "material"))


@pytest.fixture(scope="module")
def matted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mattes") / "a.exr"
    rc.render(still(), BOTH).save(path, aovs=("beauty", "mask"))
    return path


@pytest.mark.draws
def test_mattes_are_parts_of_float_beside_the_picture(matted: Path) -> None:
    found = {head["name"][1].decode(): channels(head) for head in heads(matted)}
    assert list(found) == ["beauty", "mask", "CryptoObject", "CryptoMaterial"]
    expected = {f"CryptoObject0{level}.{letter}" for level in range(3) for letter in "RGBA"}
    assert found["CryptoObject"].keys() == expected
    assert set(found["CryptoObject"].values()) == {2}


@pytest.mark.draws
def test_coverage_of_a_ball_is_the_area_of_its_disc(matted: Path) -> None:
    """Seen from a distance d, a ball of radius r fills a disc of the radius r / sqrt(d^2 - r^2) at distance 1."""
    objects, nobody = decoded(matted, "CryptoObject")
    assert objects.keys() == {"/World/Ball", "/World/Block"}
    left, right, *_ = still().cameras[0].window
    radius = 0.5 / np.sqrt(4.0**2 - 0.5**2) / (right - left) * 96
    assert objects["/World/Ball"].sum() == pytest.approx(np.pi * radius**2, rel=0.01)
    assert nobody[0, 0] == 1.0


@pytest.mark.draws
def test_glass_is_what_is_seen_not_what_is_behind_it(matted: Path) -> None:
    objects, _ = decoded(matted, "CryptoObject")
    assert objects["/World/Ball"][48, 48] == 1.0
    assert objects["/World/Block"][48, 48] == 0.0


@pytest.mark.draws
def test_coverage_is_that_of_the_picture_s_own_samples() -> None:
    """With all samples drawn, the mask counts those that met glass: the one ball."""
    drawn = rc.render(still(), replace(BOTH, tolerance=0.0))
    ranks = drawn.mattes[0].ranks
    ids = np.ascontiguousarray(ranks[..., ::2]).view(np.uint32)
    ball = np.where(ids == hash_of("/World/Ball"), ranks[..., 1::2], 0).sum(2)
    np.testing.assert_allclose(ball, drawn.planes["mask"], atol=1e-6)


@pytest.mark.draws
def test_materials_have_mattes_of_their_own(matted: Path) -> None:
    materials, _ = decoded(matted, "CryptoMaterial")
    objects, _ = decoded(matted, "CryptoObject")
    assert materials.keys() == {one.name for one in still().materials}
    np.testing.assert_allclose(materials["/World/Looks/Block"], objects["/World/Block"], atol=1e-6)


@pytest.mark.draws
def test_mattes_do_not_change_the_picture_nor_hang_on_how_work_is_cut_up() -> None:
    one = rc.render(still(), replace(BOTH, jobs=1, tile_size=16))
    two = rc.render(still(), replace(BOTH, jobs=3, tile_size=40))
    plain = rc.render(still(), replace(BOTH, cryptomatte=()))
    assert plain.mattes == ()
    for name, plane in plain.planes.items():
        np.testing.assert_array_equal(plane, one.planes[name])
    for a, b in zip(one.mattes, two.mattes, strict=True):
        np.testing.assert_array_equal(a.ranks.view(np.uint32), b.ranks.view(np.uint32))
        assert a.manifest == b.manifest


@pytest.mark.draws
def test_every_instance_is_an_object_and_rows_of_one_material_are_one() -> None:
    places = np.tile(np.eye(4, dtype=np.float32)[:3], (2, 1, 1))
    places[:, 0, 3] = (-0.5, 0.5)
    paths = Paths((Run(("/World/Many/[", "]"), np.array([[3], [8]], np.int32)),))
    many = Instances(box("/World/Many", (0.3, 0.3, 0.3), 0), places, paths)
    alone = box("/World/Alone", (0.2, 0.2, 0.2), 1, centre=(0, 0.8, 0))
    looks = [material("/Looks/Red", DIFFUSE=(1, 0, 0)), material("/Looks/Red", DIFFUSE=(1, 0, 0))]
    made = replace(scene([alone], looks, cameras=(camera((0, 0, 4), (0, 0, 0)),)), instances=(many,))
    drawn = rc.render(made, BOTH)
    objects, materials = drawn.mattes
    assert objects.manifest.keys() == {"/World/Many/[3]", "/World/Many/[8]", "/World/Alone"}
    assert materials.manifest.keys() == {"/Looks/Red"}
    assert materials.ranks[..., 3::2].max() == 0.0, "one material needs one rank"


def test_names_of_any_language_are_in_the_manifest() -> None:
    name = "/World/Glaß_\u7389"
    said = Matte("CryptoObject", np.zeros((1, 1, 12), np.float32), {name: hash_of(name)}).attributes
    (manifest,) = (value for key, value in said.items() if key.endswith("/manifest"))
    assert json.loads(manifest) == {name: f"{murmur3_32(name.encode()):08x}"}


# --- on the command line


def test_a_matte_wants_an_exr(tmp_path: Path) -> None:
    stage = str(SAMPLES / "marble.usda")
    for out, words, said in [
        ("a.png", ["--cryptomatte", "object"], "write a .exr file"),
        ("a.exr", ["--cryptomatte", "colour"], "object, material"),
        ("a.exr", ["--exr-compression", "lzw"], "zip, zips, dwaa, piz, none"),
        ("a.exr", ["--exr-parts", "two"], "many, one"),
        ("a.png", ["--exr-parts", "one"], "is no .exr file"),
    ]:
        done = CliRunner().invoke(app, ["render", stage, str(tmp_path / out), *words])
        assert done.exit_code == 2, done.output
        assert said in " ".join(done.output.replace("│", " ").split())
    assert not list(tmp_path.iterdir())


@pytest.mark.draws
def test_the_command_writes_what_it_is_asked_for(tmp_path: Path) -> None:
    out = tmp_path / "a.exr"
    words = ["--cryptomatte", "material", "--exr-compression", "dwaa", "-w", "32", "--quality", "draft"]
    done = CliRunner().invoke(app, ["render", str(SAMPLES / "marble.usda"), str(out), *words])
    assert done.exit_code == 0, done.output
    materials, _ = decoded(out, "CryptoMaterial")
    assert "/World/Looks/Amber" in materials
    picture, matte = heads(out)[0], heads(out)[-1]
    assert (picture["compression"][1], matte["compression"][1]) == (b"\x08", b"\x02")
