"""Pictures in and out: what a file says is what is read, and what is written is whole or absent.

Files to read are made with the standard library, so that a mistake shared by reading and writing shows.
"""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from refract_core.errors import ImageError, SceneError, UsageError
from refract_core.images.aovs import AOVS, shape_of
from refract_core.images.frame import Frame
from refract_core.images.pictures import check_writable, read_texture, write_frame

HEIGHT, WIDTH = 3, 5


def png(pixels: NDArray[Any]) -> bytes:
    """A PNG file by the letter of its specification: (H, W, 1..4), uint8 or uint16."""
    height, width, channels = pixels.shape
    depth = 8 * pixels.dtype.itemsize
    kind = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    rows = b"".join(b"\0" + row.astype(pixels.dtype.newbyteorder(">")).tobytes() for row in pixels)

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    header = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def unpng(path: Path) -> NDArray[np.uint8]:
    """Pixels of an 8-bit PNG file, by the letter of its specification."""
    data = path.read_bytes()
    at, body, header = 8, b"", b""
    while at < len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        name, content = data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        header = content if name == b"IHDR" else header
        body += content if name == b"IDAT" else b""
        at += length + 12
    width, height, depth, kind = struct.unpack(">IIBB", header[:10])
    assert depth == 8
    channels = {0: 1, 4: 2, 2: 3, 6: 4}[kind]
    lines = np.frombuffer(zlib.decompress(body), np.uint8).reshape(height, 1 + width * channels)
    out = np.zeros((height, width, channels), np.uint8)
    for y in range(height):
        for x in range(width):
            for c in range(channels):
                left = int(out[y, x - 1, c]) if x else 0
                up = int(out[y - 1, x, c]) if y else 0
                corner = int(out[y - 1, x - 1, c]) if x and y else 0
                guess = left + up - corner
                paeth = min((left, up, corner), key=lambda v, g=guess: abs(g - v))  # type: ignore[misc]
                predicted = (0, left, up, (left + up) // 2, paeth)[lines[y, 0]]
                out[y, x, c] = (int(lines[y, 1 + x * channels + c]) + predicted) % 256
    return out


def random_bytes(channels: int, dtype: Any = np.uint8) -> NDArray[Any]:
    top = np.iinfo(dtype).max
    return np.random.default_rng(3).integers(0, top, (HEIGHT, WIDTH, channels), dtype, endpoint=True)


def plane(name: str, value: float = 0.25) -> NDArray[np.float32]:
    return np.full(shape_of(name, HEIGHT, WIDTH), value, np.float32)


def full_frame() -> Frame:
    rng = np.random.default_rng(5)
    planes = {name: rng.random(shape_of(name, HEIGHT, WIDTH), np.float32) for name in AOVS}
    return Frame(WIDTH, HEIGHT, planes, {"refract:tiers": "screen,sky", "refract:samples": 4.0})


# --- reading


@pytest.mark.parametrize("as_bytes", [False, True])
@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_channels_are_filled_as_usd_says(tmp_path: Path, channels: int, as_bytes: bool) -> None:
    pixels = random_bytes(channels)
    path = tmp_path / "a.png"
    path.write_bytes(png(pixels))
    texture = read_texture(path.read_bytes() if as_bytes else str(path), name="a", color_space="raw")
    assert texture.pixels.dtype == np.uint8
    assert not texture.srgb
    rgb = pixels[..., :3] if channels >= 3 else pixels[..., [0, 0, 0]]
    alpha = pixels[..., -1] if channels in (2, 4) else np.full((HEIGHT, WIDTH), 255)
    np.testing.assert_array_equal(texture.pixels[..., :3], rgb)  # transparent texels keep their colour
    np.testing.assert_array_equal(texture.pixels[..., 3], alpha)


@pytest.mark.parametrize(
    ("channels", "color_space", "srgb"),
    [(1, "auto", False), (2, "auto", False), (3, "auto", True), (4, "auto", True)]
    + [(c, space, space == "sRGB") for c in (1, 3) for space in ("raw", "sRGB")],
)
def test_auto_is_srgb_for_three_or_four_8_bit_channels(channels: int, color_space: str, srgb: bool) -> None:
    assert read_texture(png(random_bytes(channels)), name="a", color_space=color_space).srgb is srgb


def test_16_bit_integers_keep_their_precision_and_auto_leaves_them_raw() -> None:
    pixels = random_bytes(4, np.uint16)
    for color_space in ("auto", "raw"):
        texture = read_texture(png(pixels), name="a", color_space=color_space)
        assert texture.pixels.dtype == np.float32
        np.testing.assert_allclose(texture.pixels, pixels / 65535.0, atol=1e-6)


def test_16_bit_srgb_is_decoded_but_for_alpha() -> None:
    pixels = np.full((1, 1, 4), round(0.5 * 65535), np.uint16)
    texture = read_texture(png(pixels), name="a", color_space="sRGB")
    assert not texture.srgb
    np.testing.assert_allclose(texture.pixels[0, 0], [0.21404, 0.21404, 0.21404, 0.5], atol=2e-5)


@pytest.mark.parametrize("color_space", ["auto", "raw", "sRGB"])
def test_radiance_files_are_linear_whatever_is_said(color_space: str) -> None:
    """RGBE of one pixel: mantissas 128, 64, 32 with exponent 129 are 1, 1/2 and 1/4 (Ward, "Real Pixels" 1991)."""
    data = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 1\n" + bytes([128, 64, 32, 129])
    texture = read_texture(data, name="a.hdr", color_space=color_space)
    assert texture.pixels.dtype == np.float32
    np.testing.assert_allclose(texture.pixels[0, 0], [1.0, 0.5, 0.25, 1.0], rtol=0.01)


@pytest.mark.parametrize("data", [b"", b"hello", png(random_bytes(3))[:30]], ids=["empty", "text", "cut"])
def test_what_is_no_image_is_refused_by_name(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(data)
    for source in (data, str(path)):
        with pytest.raises(ImageError, match="stone"):
            read_texture(source, name="stone", color_space="auto")


def test_a_png_cut_in_its_pixels_is_refused() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    whole = png(noise)
    with pytest.raises(ImageError, match="stone: damaged"):
        read_texture(whole[: len(whole) // 2], name="stone", color_space="auto")


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    for source in (tmp_path / "none.png", tmp_path):
        with pytest.raises(ImageError, match="does not exist"):
            read_texture(str(source), name="x", color_space="auto")


def test_an_unknown_colour_space_is_refused() -> None:
    with pytest.raises(ImageError, match=r"LogC.*auto, raw, sRGB"):
        read_texture(png(random_bytes(3)), name="x", color_space="LogC")


def test_a_bomb_is_refused_by_its_header() -> None:
    small = png(np.zeros((1, 1, 1), np.uint8))
    header = struct.pack(">IIBBBBB", 20000, 20000, 8, 0, 0, 0, 0)
    chunk = b"IHDR" + header
    bomb = small[:8] + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk)) + small[33:]
    with pytest.raises(ImageError, match="20000 x 20000"):
        read_texture(bomb, name="x", color_space="auto")


# --- writing


def test_exr_holds_every_aov_under_its_name(tmp_path: Path) -> None:
    frame = full_frame()
    path = tmp_path / "a.exr"
    frame.save(path)
    found = exr_planes(path)
    assert set(found) == {channel for aov in AOVS.values() for channel in aov.channels}
    for name, aov in AOVS.items():
        values = frame.planes[name].reshape(HEIGHT, WIDTH, -1)
        for i, channel in enumerate(aov.channels):
            expected = values[..., i] if name in ("Z", "P") else values[..., i].astype(np.float16)
            np.testing.assert_array_equal(found[channel], expected)


def exr_planes(path: Path) -> dict[str, NDArray[np.float32]]:
    """Channels of all parts of an EXR file, each with the precision it has in the file."""
    import OpenImageIO as oiio

    file = oiio.ImageInput.open(str(path))
    assert file is not None
    found: dict[str, NDArray[np.float32]] = {}
    part = 0
    while file.seek_subimage(part, 0):
        spec = file.spec()
        pixels = file.read_image(part, 0, 0, spec.nchannels, oiio.FLOAT)
        assert pixels is not None
        assert not found.keys() & set(spec.channelnames)
        found |= {name: pixels[..., i] for i, name in enumerate(spec.channelnames)}
        part += 1
    file.close()
    return found


def test_exr_metadata_and_chosen_aovs(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    full_frame().save(path, aovs=("Z", "beauty"))
    assert set(exr_planes(path)) == {"R", "G", "B", "A", "Z"}
    header = path.read_bytes()[:2000]
    assert b"refract:tiers\0string\0" in header
    assert b"screen,sky" in header
    assert b"refract:samples\0float\0" in header


def test_colours_beyond_half_stay_finite_in_exr(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    write_frame(str(path), {"beauty": plane("beauty", 1e9), "Z": plane("Z", 1e9)}, {})
    found = exr_planes(path)
    assert found["R"].max() == 65504.0
    assert found["Z"].max() == 1e9


def test_equal_frames_make_equal_files_whatever_the_clock_says(tmp_path: Path) -> None:
    extensions = (".exr", ".png", ".tif", ".jpg")
    for extension in extensions:
        full_frame().save(tmp_path / f"a{extension}")
    time.sleep(1.1)  # file formats tell seconds
    for extension in extensions:
        full_frame().save(tmp_path / f"b{extension}")
        assert (tmp_path / f"a{extension}").read_bytes() == (tmp_path / f"b{extension}").read_bytes()


def test_png_is_srgb_with_straight_alpha(tmp_path: Path) -> None:
    """Linear 0.5 is 188 in sRGB (IEC 61966-2-1); premultiplied 0.25 at alpha 0.5 is the same colour."""
    beauty = np.zeros((1, 4, 4), np.float32)
    beauty[0, 0] = (0.5, 0.5, 0.5, 1.0)
    beauty[0, 1] = (0.25, 0.25, 0.25, 0.5)
    beauty[0, 2] = (9.0, -1.0, np.nan, 1.0)
    beauty[0, 3] = (0.0, 0.0, 0.0, 0.0)
    path = tmp_path / "a.png"
    Frame(4, 1, {"beauty": beauty}).save(path)
    expected = [[188, 188, 188, 255], [188, 188, 188, 128], [255, 0, 0, 255], [0, 0, 0, 0]]
    np.testing.assert_array_equal(unpng(path)[0], expected)


def test_png_without_correction_is_linear(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Frame(WIDTH, HEIGHT, {"beauty": plane("beauty", 1.0) * 0.5}).save(path, color_correction="disabled")
    assert (unpng(path)[..., :3] == 255).all()  # 0.5 premultiplied by alpha 0.5
    assert (unpng(path)[..., 3] == 128).all()


def test_open_color_io_shows_black_as_black_and_keeps_the_order_of_greys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OCIO", raising=False)
    ramp = np.zeros((1, 5, 4), np.float32)
    ramp[0, :, :3] = np.array([0.0, 0.05, 0.18, 0.6, 2.0])[:, None]
    ramp[0, :, 3] = 1.0
    path = tmp_path / "a.png"
    Frame(5, 1, {"beauty": ramp}).save(path, color_correction="openColorIO")
    shown = unpng(path)[0].astype(int)
    assert (shown[0, :3] <= 2).all()
    assert (np.diff(shown[:, 0]) > 0).all()
    assert np.ptp(shown[:, :3], axis=1).max() <= 1  # greys stay grey
    assert shown[3, 0] != 202  # a view, not the sRGB curve, which makes 0.6 into 202


def test_jpeg_is_the_picture_over_black(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    Frame(16, 16, {"beauty": np.full((16, 16, 4), 0.5, np.float32)}).save(path)
    pixels = read_texture(str(path), name="a", color_space="auto").pixels
    np.testing.assert_allclose(pixels[..., :3], 188, atol=2)


def test_png_of_a_normal_and_of_a_scalar(tmp_path: Path) -> None:
    normal = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    normal[...] = (-1.0, 0.0, 1.0)
    mask = np.linspace(-1, 2, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
    frame = Frame(WIDTH, HEIGHT, {"N": normal, "mask": mask})
    frame.save(tmp_path / "n.png", aovs=("N",))
    np.testing.assert_array_equal(unpng(tmp_path / "n.png")[0, 0], [0, 128, 255])
    frame.save(tmp_path / "m.png", aovs=("mask",))
    np.testing.assert_array_equal(unpng(tmp_path / "m.png")[..., 0], np.floor(np.clip(mask, 0, 1) * 255 + 0.5))


@pytest.mark.parametrize(
    ("name", "aovs", "correction", "message"),
    [
        ("a.gif", (), "sRGB", r"'\.gif'.*\.exr, \.png"),
        ("a", (), "sRGB", "extension"),
        ("a.png", ("N", "Z"), "sRGB", "one AOV"),
        ("a.png", ("P",), "sRGB", r"\.exr"),
        ("a.exr", ("depth",), "sRGB", "'depth'.*beauty"),
        ("a.exr", ("Z", "Z"), "sRGB", "twice"),
        ("a.png", (), "rec709", "rec709.*openColorIO"),
    ],
)
def test_wrong_words_are_refused(
    tmp_path: Path, name: str, aovs: tuple[str, ...], correction: str, message: str
) -> None:
    with pytest.raises(UsageError, match=message):
        full_frame().save(tmp_path / name, aovs=aovs, color_correction=correction)
    assert not list(tmp_path.iterdir())


def test_an_aov_that_was_not_rendered_is_refused(tmp_path: Path) -> None:
    frame = Frame(WIDTH, HEIGHT, {"beauty": plane("beauty")})
    with pytest.raises(UsageError, match=r"'Z' is not in this frame; it has beauty"):
        frame.save(tmp_path / "a.exr", aovs=("Z",))


@pytest.mark.parametrize("failing", ["writing", "renaming"])
def test_a_failure_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(b"old")

    def no_space(*_: object) -> None:
        raise OSError(28, "No space left on device")

    if failing == "writing":
        monkeypatch.setattr(Path, "write_bytes", no_space)
    else:
        monkeypatch.setattr(os, "replace", no_space)
    with pytest.raises(ImageError, match=r"a\.png.*No space left"):
        full_frame().save(path)
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
    assert path.read_bytes() == b"old"


def test_an_interrupt_while_writing_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(path: Path, data: bytes) -> None:
        path.open("wb").close()
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_bytes", interrupted)
    with pytest.raises(KeyboardInterrupt):
        full_frame().save(tmp_path / "a.exr")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("extension", [".png", ".exr", ".tif"])
def test_a_file_that_may_not_be_whole_is_an_error(tmp_path: Path, extension: str) -> None:
    """In a child, as the limit on file sizes is the process's."""
    code = """
import resource, signal, sys
import numpy as np
from refract_core.errors import ImageError
from refract_core.images.pictures import write_frame
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, 20000))
noise = np.random.default_rng(0).random((400, 400, 4), np.float32)
try:
    write_frame(sys.argv[1], {"beauty": noise}, {})
except ImageError as error:
    print(error)
"""
    path = tmp_path / f"a{extension}"
    arguments = [sys.executable, "-c", code, str(path)]
    ended = subprocess.run(arguments, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[1])
    assert str(path) in ended.stdout
    assert not list(tmp_path.iterdir())


def test_check_writable_knows_before_the_render(tmp_path: Path) -> None:
    good = tmp_path / "a.png"
    check_writable(str(good))
    assert not list(tmp_path.iterdir())
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(UsageError, match="is a folder"):
        check_writable(str(tmp_path / "folder.png"))
    with pytest.raises(UsageError, match=r"missing does not exist; make it"):
        check_writable(str(tmp_path / "missing" / "a.png"))
    with pytest.raises(UsageError, match="extension"):
        check_writable(str(tmp_path / "a.docx"))
    with pytest.raises(ImageError, match="cannot be written"):
        check_writable("/proc/a.png")


def test_a_frame_refuses_planes_of_the_wrong_shape_or_type() -> None:
    with pytest.raises(SceneError, match=r"'N'.*float64"):
        Frame(WIDTH, HEIGHT, {"N": plane("N").astype(np.float64)})
    with pytest.raises(SceneError, match="'mask'"):
        Frame(HEIGHT, WIDTH, {"mask": plane("mask")})
    with pytest.raises(UsageError, match="'shadow'"):
        Frame(WIDTH, HEIGHT, {"shadow": plane("mask")})
