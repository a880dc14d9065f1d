"""Names and archives of uploads: what is laid out, and what is refused by its name."""

from __future__ import annotations

import io
import json
import os
import stat
import struct
import zipfile
from pathlib import Path
from typing import Any

import pytest
from service_server import BALL, InProcess

from service import precheck, uploads
from service.app import Settings, create_app
from service.gltf_parts import parts_of
from service.limits import Limits
from service.problems import Problem

LIMITS = {"upload_files": 5, "stage_bytes": 3 << 20, "upload_ratio": 50}


def refusal(work: Any, *arguments: Any) -> Problem:
    with pytest.raises(Problem) as caught:
        work(*arguments)
    assert caught.value.detail
    return caught.value


# --- names


@pytest.mark.parametrize("name", ["a.usda", "shots/a.usda", "a b/ü/日本.png", "..a/b..usda", ".hidden/x", "e\u0301.png",
                                  "½.png"])  # fmt: skip
def test_honest_names_stay_as_they_are(name: str) -> None:
    assert uploads.checked_name(name) == name


@pytest.mark.parametrize("name", [
    "", "/etc/passwd", "//host/share", "~/x", "../x", "a/../../x", "a/..", "./a", "a//b", "a/", "C:/x", "c:x", "a\\b",
    "..\\x", "\\\\host\\x", "a\0b", "a\nb", "\u202egnp.exe", "a\u2066b", "\uff0e\uff0e/x", "\u2025/x", "a\uff0fb",
    "\uff0fetc", "a\uff3cb", "\u2100", "x" * 256, "/".join("a" * 40), "/".join(["b" * 200] * 6), "a\ud800b", "a\u2028b",
])  # fmt: skip
def test_names_that_lead_elsewhere_or_hide_something_are_refused_by_name(name: str) -> None:
    problem = refusal(uploads.checked_name, name)
    assert problem.slug == "stage-refused"
    assert problem.detail.isprintable()


@pytest.mark.parametrize("names", [
    ("a.png", "A.PNG"), ("straße", "STRASSE"), ("e\u0301.png", "\u00e9.png"), ("a.png", "a\u200d.png"),
    ("a", "a/b"), ("a/b", "a"), ("a/b", "A/c"), ("ﬁ.png", "fi.png"), ("a", "a"), ("x/a/b", "x/A"),
])  # fmt: skip
def test_names_that_are_one_to_some_system_are_refused(names: tuple[str, ...]) -> None:
    assert refusal(uploads.check_together, names).slug == "stage-refused"


def test_names_that_differ_go_together() -> None:
    uploads.check_together(["a/b.png", "a/c.png", "b/a.png", "a/b/c.png"])


# --- archives


def zipped(entries: dict[str, bytes], *, compress: int = zipfile.ZIP_DEFLATED, mode: int = 0) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compress) as archive:
        for name, content in entries.items():
            info = zipfile.ZipInfo(name)
            info.compress_type, info.external_attr, info.create_system = compress, mode << 16, 3
            archive.writestr(info, content)
    return stream.getvalue()


def unpacked(content: bytes, folder: Path) -> list[str]:
    (folder / "x.zip").write_bytes(content)
    (folder / "out").mkdir()
    try:
        return uploads.unpack(str(folder / "x.zip"), str(folder / "out"), LIMITS)
    finally:
        assert {path.name for path in folder.iterdir()} == {"x.zip", "out"}


def test_an_archive_is_laid_out_without_what_a_file_manager_adds(tmp_path: Path) -> None:
    content = zipped({"a/": b"", "a/b.usda": b"1", "__MACOSX/a/._b.usda": b"2", "a/.DS_Store": b"3", "t/c.png": b"4"})
    assert sorted(unpacked(content, tmp_path)) == ["a/b.usda", "t/c.png"]
    assert (tmp_path / "out" / "a" / "b.usda").read_bytes() == b"1"
    assert not (tmp_path / "out" / "__MACOSX").exists()
    assert stat.S_IMODE((tmp_path / "out" / "a").stat().st_mode) & 0o077 == 0


@pytest.mark.parametrize(("slug", "name", "content"), [
    ("stage-refused", "link", zipped({"link": b"/etc/passwd"}, mode=stat.S_IFLNK | 0o777)),
    ("stage-refused", "fifo", zipped({"fifo": b""}, mode=stat.S_IFIFO | 0o600)),
    ("stage-refused", "../x", zipped({"../x": b""})), ("stage-refused", "/x", zipped({"/x": b""})),
    ("stage-refused", "b/../../x/", zipped({"b/../../x/": b""})),
    ("stage-refused", "A.usda", zipped({"a.usda": b"", "A.usda": b""})),
    ("stage-refused", "a.usda", zipped({"a.usda": b"x" * 99}, compress=zipfile.ZIP_LZMA)),
    ("limit-exceeded", "6 files", zipped({str(number): b"" for number in range(6)})),
    ("limit-exceeded", "3145729", zipped({"a": bytes((3 << 20) + 1)}, compress=zipfile.ZIP_STORED)),
    ("limit-exceeded", "times", zipped({"a": bytes(2 << 20)})),
    ("stage-invalid", "damaged", b"PK\x03\x04" + bytes(100)),
    ("stage-invalid", "damaged", zipped({"a.usda": b"x" * 500})[:-30]),
])  # fmt: skip
def test_what_an_archive_must_not_hold_is_refused_by_name(tmp_path: Path, slug: str, name: str, content: bytes) -> None:
    problem = refusal(unpacked, content, tmp_path)
    assert problem.slug == slug
    assert name.rstrip("/") in problem.detail
    assert not any((tmp_path / "out").iterdir())


def test_an_archive_that_says_too_little_ends_where_it_is_found_out(tmp_path: Path) -> None:
    content = bytearray(zipped({"a": bytes(4 << 20)}, compress=zipfile.ZIP_STORED))
    directory = content.rindex(b"PK\x01\x02")
    struct.pack_into("<II", content, directory + 20, 4 << 20, 10)  # packed, unpacked
    assert refusal(unpacked, bytes(content), tmp_path).slug in ("stage-invalid", "limit-exceeded")
    assert sum(path.stat().st_size for path in (tmp_path / "out").iterdir()) <= LIMITS["stage_bytes"]


def test_an_encrypted_archive_is_refused(tmp_path: Path) -> None:
    content = bytearray(zipped({"secret.usda": b"x" * 50}))
    for magic, place in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        content[content.index(magic) + place] |= 1
    assert "password" in refusal(unpacked, bytes(content), tmp_path).detail


def test_equal_files_are_an_equal_archive(tmp_path: Path) -> None:
    one = {"b/x": io.BytesIO(b"1"), "a": io.BytesIO(b"2")}
    uploads.pack(one, tmp_path / "one.zip")
    uploads.pack(dict(reversed(one.items())), tmp_path / "two.zip")
    assert (tmp_path / "one.zip").read_bytes() == (tmp_path / "two.zip").read_bytes()


@pytest.mark.parametrize(("names", "wanted", "found"), [
    (["a.usda", "t/x.png"], "", "a.usda"), (["s/a.usda", "s/p/b.usda", "t.png"], "", "s/a.usda"),
    (["a.usda", "b.usda"], "b.usda", "b.usda"), (["a.glb"], "", "a.glb"), (["._a.usda", "a.usda"], "", "a.usda"),
])  # fmt: skip
def test_the_stage_is_the_one_on_top_or_the_one_that_is_named(names: list[str], wanted: str, found: str) -> None:
    assert uploads.stage_among(names, wanted) == found


@pytest.mark.parametrize(("names", "wanted", "word"), [
    (["a.usda", "b.usda"], "", "a.usda, b.usda"), (["x.png"], "", ".usda"), (["a.usda"], "../a.usda", "a.usda"),
    (["a.usda", "t.png"], "t.png", "a.usda"),
])  # fmt: skip
def test_no_stage_or_two_are_told(names: list[str], wanted: str, word: str) -> None:
    problem = refusal(uploads.stage_among, names, wanted)
    assert (problem.slug, problem.errors[0]["pointer"]) == ("invalid-settings", "/stage")
    assert word in problem.detail


# --- glTF


def gltf(*uris: str) -> dict[str, Any]:
    return {"asset": {"version": "2.0"}, "buffers": [{"uri": uri, "byteLength": 1} for uri in uris], "images": [{}]}


def binary(document: dict[str, Any]) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text


@pytest.mark.parametrize("uri", ["/etc/passwd", "../x.bin", "a/../../x.bin", "file:///etc/passwd", "%2e%2e/x.bin",
                                 "%2Fetc/passwd", "\\\\host\\x", "C:/x", "~/x"])  # fmt: skip
@pytest.mark.parametrize("name", ["a.gltf", "a.glb", "A.GLB"])
def test_no_gltf_reaches_out_of_its_folder(tmp_path: Path, uri: str, name: str) -> None:
    document = gltf(uri)
    content = binary(document) if name.lower().endswith("glb") else json.dumps(document).encode()
    (tmp_path / name).write_bytes(content)
    with pytest.raises(precheck.Refused):
        precheck.check_stage(str(tmp_path / name), str(tmp_path), layers=5, unpacked_bytes=1000)


def test_parts_of_gltf_inside_its_folder_pass(tmp_path: Path) -> None:
    (tmp_path / "a.gltf").write_text(json.dumps(gltf("b/c%20d.bin", "data:;base64,AA==")))
    assert parts_of(tmp_path / "a.gltf") == ["b/c d.bin"]
    precheck.check_stage(str(tmp_path / "a.gltf"), str(tmp_path), layers=5, unpacked_bytes=1000)


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b'{"buffers": 7, "images": [3, {"uri": 4}]}', b"[" * 100_000])
def test_what_is_no_gltf_has_no_parts(tmp_path: Path, content: bytes) -> None:
    for name in ("a.gltf", "a.glb"):
        (tmp_path / name).write_bytes(content)
        assert parts_of(tmp_path / name) == []


# --- forms, in a service whose workers are not started


def form(*names: str, stage: str = "") -> list[tuple[str, tuple[str, bytes]]]:
    files = [("file", (name, BALL.encode())) for name in names]
    return [("stage", (stage, BALL.encode())), *files] if stage else files


@pytest.mark.parametrize(("files", "settings", "slug", "word"), [
    (form("../a.usda"), {}, "stage-refused", "../a.usda"), (form("/a.usda"), {}, "stage-refused", "/a.usda"),
    (form("a.usda", "A.USDA"), {}, "stage-refused", "A.USDA"),
    (form("a.png", stage="b/../c.usda"), {}, "stage-refused", "b/../c.usda"),
    (form("a.png", stage="a.txt"), {}, "unsupported-media-type", "glb"),
    (form("a.png", stage="a.usda"), {"stage": "a.usda"}, "invalid-settings", "uploaded already"),
    (form(stage="a.usda"), {"stage": "a.usda"}, "invalid-settings", "uploaded already"),
    ([], {}, "invalid-settings", "stage"),
    (form(*(f"{number}.usda" for number in range(40))), {}, "limit-exceeded", "30 files"),
    (form("a.usda", "b.usda", "c.usda"), {}, "too-large", "1000"),
])  # fmt: skip
def test_forms_that_are_wrong_are_refused_and_leave_nothing(
    tmp_path: Path, files: Any, settings: Any, slug: str, word: str
) -> None:  # fmt: skip
    limits = Limits(upload_files=30, stage_bytes=1000 if slug == "too-large" else 1 << 20)
    client = InProcess(create_app(Settings(data=str(tmp_path / "data"), limits=limits)))
    parts = [*files, ("settings", (None, json.dumps(settings).encode()))]
    document = client.post("/v1/render", files=parts, headers={"Prefer": "respond-async"}).json()
    assert document["type"] == f"/problems/{slug}", document
    assert word in document["detail"]
    assert os.listdir(tmp_path / "data" / "work") == []


def test_the_document_tells_how_several_files_are_sent(tmp_path: Path) -> None:
    client = InProcess(create_app(Settings(data=str(tmp_path / "data"))))
    body = client.get("/openapi.json").json()["paths"]["/v1/render"]["post"]["requestBody"]["content"]
    schema = body["multipart/form-data"]["schema"]
    assert schema["properties"]["file"]["items"]["format"] == "binary"
    assert schema["anyOf"] == [{"required": ["stage"]}, {"required": ["file"]}]


