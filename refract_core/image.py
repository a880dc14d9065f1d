"""Image files in and out. The only room that knows OpenImageIO, which is loaded with the first file."""

from __future__ import annotations

import os
import secrets
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .aovs import AOVS, check_names, shape_of
from .errors import ImageError, UsageError
from .scene import F32, Texture
from .srgb import srgb_decode, srgb_encode

COLOR_SPACES = ("auto", "raw", "sRGB")
COLOR_CORRECTIONS = ("disabled", "sRGB", "openColorIO")
LAYERED = (".exr",)
EIGHT_BIT = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
MAX_TEXTURE_PIXELS = 1 << 28
HALF_MAX = 65504.0

_PNG_END = b"IEND\xaeB`\x82"
_STRAIGHT_ALPHA = "oiio:UnassociatedAlpha"
_LINEAR_REC709 = "lin_rec709_scene"


# --- reading -----------------------------------------------------------------------------------------------------


def read_texture(source: str | bytes, *, name: str, color_space: str) -> Texture:
    """Decode an image file into RGBA.

    Missing channels are filled as UsdUVTexture does: one channel is grey, two are grey and alpha, and alpha is 1
    where the file has none. Values stay as the file has them, never premultiplied. 8-bit files stay uint8; 16-bit
    integers become float32 in [0, 1], linear after `sRGB`; half and float files are linear whatever `color_space` says.

    Args:
        source: a path, or the bytes of a file (from inside a package).
        name: what messages call it.
        color_space: `raw`, `sRGB`, or `auto`: sRGB where the file has 8 bits and 3 or 4 channels, else raw.

    Raises:
        ImageError: unreadable, damaged, too large, or an unknown colour space.
    """
    if color_space not in COLOR_SPACES:
        raise ImageError(f"{name}: colour space is '{color_space}'; choose from {', '.join(COLOR_SPACES)}")
    with _named_file(source, name) as path:
        pixels, channels, integer = _read_pixels(path, name)
    if pixels.dtype == np.uint8:
        srgb = color_space == "sRGB" or (color_space == "auto" and channels >= 3)
        return Texture(name, pixels, srgb)
    if integer and color_space == "sRGB":
        pixels[..., :3] = srgb_decode(pixels[..., :3])
    return Texture(name, pixels)


@contextmanager
def _named_file(source: str | bytes, name: str) -> Iterator[str]:
    """A path OpenImageIO can open: its Python binding reads no bytes."""
    if isinstance(source, bytes):
        with _memory_file() as path:
            Path(path).write_bytes(source)
            yield path
    elif os.path.isfile(source):
        yield source
    else:
        raise ImageError(f"{name}: the file does not exist; correct the path or add the file")


@contextmanager
def _memory_file() -> Iterator[str]:
    """Path of an empty file in memory (where the system has that), which also works where nothing may be written."""
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("image")
        try:
            yield f"/proc/self/fd/{descriptor}"
        finally:
            os.close(descriptor)
    else:
        with tempfile.TemporaryDirectory() as folder:
            yield os.path.join(folder, "image")


def _read_pixels(path: str, name: str) -> tuple[NDArray[Any], int, bool]:
    """RGBA of the first image in a file, its own channel count, and whether it holds integers."""
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute(_STRAIGHT_ALPHA, 1)
    file = oiio.ImageInput.open(path, config)
    if file is None:
        raise ImageError(f"{name}: not a readable image: {_reason(oiio.geterror(), path)}")
    try:
        spec = file.spec()
        if spec.depth > 1 or spec.nchannels < 1:
            raise ImageError(f"{name}: a volume or an empty image cannot be a texture; give a flat picture")
        pixel_count = max(spec.width * spec.height, spec.full_width * spec.full_height)
        if pixel_count * max(spec.nchannels, 4) > MAX_TEXTURE_PIXELS * 4:
            raise ImageError(
                f"{name}: {spec.width} x {spec.height} x {spec.nchannels} channels is over {MAX_TEXTURE_PIXELS} RGBA "
                "pixels; give a smaller image"
            )
        small = spec.format.basetype in (oiio.UINT8, oiio.INT8)
        integer = spec.format.basetype not in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
        pixels = file.read_image(0, 0, 0, spec.nchannels, oiio.UINT8 if small else oiio.FLOAT)
        if pixels is None:
            raise ImageError(f"{name}: damaged image: {_reason(file.geterror(), path)}")
        pixels = pixels.reshape(spec.height, spec.width, spec.nchannels)
        return _rgba(_display_window(pixels, spec), spec), spec.nchannels, integer
    finally:
        file.close()


def _reason(message: str, path: str = "") -> str:
    """First line of a library's message, which may be empty or long, without the path it knows."""
    lines = (message.replace(path, "the file") if path else message).strip().splitlines()
    return lines[0] if lines else "no reason given"


def _display_window(pixels: NDArray[Any], spec: Any) -> NDArray[Any]:
    """Pixels of the display window; what the data window lacks is 0 (OpenEXR, "Technical Introduction")."""
    if (spec.x, spec.y, spec.width, spec.height) == (spec.full_x, spec.full_y, spec.full_width, spec.full_height):
        return pixels
    shown = np.zeros((spec.full_height, spec.full_width, spec.nchannels), pixels.dtype)
    x, y = spec.x - spec.full_x, spec.y - spec.full_y
    left, right = max(x, 0), min(x + spec.width, spec.full_width)
    top, bottom = max(y, 0), min(y + spec.height, spec.full_height)
    if left < right and top < bottom:
        shown[top:bottom, left:right] = pixels[top - y : bottom - y, left - x : right - x]
    return shown


def _rgba(pixels: NDArray[Any], spec: Any) -> NDArray[Any]:
    names = list(spec.channelnames)
    count = spec.nchannels
    alpha = spec.alpha_channel
    if not 0 <= alpha < count:  # unnamed fourth or second channels are alpha; a depth is not
        alpha = count - 1 if count in (2, 4) and spec.z_channel != count - 1 else -1
    if count > 4 and all(c in names for c in "RGB"):
        rgb = [names.index(c) for c in "RGB"]
    else:
        rgb = [0, 1, 2] if count >= 3 else [0, 0, 0]
    opaque = 255 if pixels.dtype == np.uint8 else 1.0
    if count == 4 and alpha == 3:
        return np.ascontiguousarray(pixels)
    out = np.empty((*pixels.shape[:2], 4), pixels.dtype)
    out[..., :3] = pixels[..., rgb]
    out[..., 3] = pixels[..., alpha] if alpha >= 0 else opaque
    return out


# --- writing -----------------------------------------------------------------------------------------------------


def default_aovs(path: str, available: Sequence[str]) -> tuple[str, ...]:
    """What a file holds when nobody says: everything in an EXR, the picture elsewhere."""
    return tuple(available) if _extension(path) in LAYERED else ("beauty",)


def check_output(path: str, aovs: Sequence[str], color_correction: str) -> None:
    """Refuse, before any work, what `write_frame` could not write.

    Raises:
        UsageError: the extension, an AOV or the correction is unknown, or the format cannot hold these AOVs.
    """
    extension = _extension(path)
    check_names(aovs)
    if color_correction not in COLOR_CORRECTIONS:
        raise UsageError(
            f"color correction mode is '{color_correction}', which is not known; "
            f"choose from {', '.join(COLOR_CORRECTIONS)}"
        )
    if extension in LAYERED:
        return
    if len(aovs) > 1:
        raise UsageError(
            f"{path}: {extension} holds one AOV, but {', '.join(aovs)} are asked for; name one, or write a .exr file"
        )
    if "P" in aovs:
        raise UsageError(f"{path}: AOV 'P' is positions, which {extension} cannot hold; write a .exr file")


def check_writable(path: str) -> None:
    """Refuse, before any work, a place where no file can be written.

    Raises:
        UsageError: the extension is unknown.
        ImageError: the folder does not exist or is read-only, or `path` is a folder.
    """
    _extension(path)
    folder = os.path.dirname(path) or "."
    if os.path.isdir(path):
        raise ImageError(f"{path}: is a folder; name a file")
    if not os.path.isdir(folder):
        raise ImageError(f"{path}: the folder {folder} does not exist; make it first")
    try:  # permission bits do not tell everything (read-only mounts, quotas, network folders), so try
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise ImageError(f"{path}: the folder {folder} cannot be written: {error.strerror}") from error


def write_frame(
    path: str, planes: Mapping[str, F32], metadata: Mapping[str, str | float], *, color_correction: str = "sRGB"
) -> None:
    """Write planes to a file, in one step: the file appears whole, or not at all.

    Args:
        path: `.exr` takes any planes as scene-linear channels, colours as half and data as float32; the 8-bit formats
            take exactly one.
        planes: AOV name -> float32, shapes as `refract_core.aovs.shape_of`.
        metadata: attributes of the file, where the format has a place for them (EXR; PNG as text).
        color_correction: `sRGB`, `disabled` or `openColorIO`; colours in 8-bit files only.

    Raises:
        UsageError: see `check_output`.
        ImageError: the file cannot be written.
    """
    check_output(path, tuple(planes), color_correction)
    if not planes:
        raise UsageError(f"{path}: no AOV is chosen; name at least one")
    height, width = next(iter(planes.values())).shape[:2]
    for name, plane in planes.items():
        if plane.shape != shape_of(name, height, width):
            raise ImageError(f"{path}: plane '{name}' has shape {plane.shape}, not {shape_of(name, height, width)}")
    pixels: NDArray[Any]
    if _extension(path) in LAYERED:
        pixels, spec = _exr(planes, metadata, height, width)
    else:
        ((name, plane),) = planes.items()
        pixels, spec = _eight_bit(path, name, plane, metadata, color_correction)
    data = _encoded(path, pixels, spec)
    with _replacing(path) as temporary:
        Path(temporary).write_bytes(data)


def _extension(path: str) -> str:
    extension = os.path.splitext(path)[1].lower()
    if extension not in LAYERED + EIGHT_BIT:
        known = ", ".join(LAYERED + EIGHT_BIT)
        raise UsageError(f"{path}: '{extension}' is not a known image extension; use one of {known}")
    return extension


@contextmanager
def _replacing(path: str) -> Iterator[str]:
    """A name beside `path` that becomes `path` when the block ends well, and is removed when it does not."""
    folder, base = os.path.split(path)
    stem, extension = os.path.splitext(base)
    temporary = os.path.join(folder, f".{stem[:32]}.{secrets.token_hex(4)}{extension}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise ImageError(f"{path}: cannot be written: {error.strerror}; choose another place") from error
    finally:
        Path(temporary).unlink(missing_ok=True)


def _encoded(path: str, pixels: NDArray[Any], spec: Any) -> bytes:
    """The whole file in memory: on a full disk some writers say nothing, and one ends the process."""
    import OpenImageIO as oiio

    with _memory_file() as name:
        file = oiio.ImageOutput.create(_extension(path)[1:])
        if file is None:
            raise ImageError(f"{path}: cannot be encoded: {_reason(oiio.geterror())}")
        opened = file.open(name, spec)
        written = opened and file.write_image(pixels)
        closed = opened and file.close()
        if not (written and closed):
            raise ImageError(f"{path}: cannot be encoded: {_reason(file.geterror(), name)}")
        data = Path(name).read_bytes()
    if _extension(path) == ".png" and not data.endswith(_PNG_END):
        raise ImageError(f"{path}: cannot be encoded: out of memory, or over the limit on file sizes")
    return data


def _exr(planes: Mapping[str, F32], metadata: Mapping[str, str | float], height: int, width: int) -> tuple[F32, Any]:
    import OpenImageIO as oiio

    names: list[str] = []
    formats: list[str] = []
    columns: list[F32] = []
    for name, plane in planes.items():
        aov = AOVS[name]
        names += aov.channels
        formats += ["half" if aov.color else "float"] * len(aov.channels)
        column = plane.reshape(height, width, len(aov.channels))
        # A colour beyond the largest half would become infinity, which no viewer averages well.
        columns.append(np.clip(column, -HALF_MAX, HALF_MAX) if aov.color else column)
    spec = oiio.ImageSpec(width, height, len(names), "float")
    spec.channelnames = tuple(names)
    spec.channelformats = tuple(oiio.TypeDesc(one) for one in formats)
    spec.attribute("compression", "zip")
    spec.attribute("DateTime", "")  # else the writer stamps the time, and equal pictures make unequal files
    for key, value in metadata.items():
        spec.attribute(key, value)
    return np.ascontiguousarray(np.concatenate(columns, axis=2), dtype=np.float32), spec


def _eight_bit(
    path: str, name: str, plane: F32, metadata: Mapping[str, str | float], color_correction: str
) -> tuple[NDArray[np.uint8], Any]:
    import OpenImageIO as oiio

    extension = _extension(path)
    pixels = display(name, plane, color_correction)
    if pixels.shape[2] == 4 and extension in (".jpg", ".jpeg"):  # no alpha there: the picture over black
        over_black = plane.copy()
        over_black[..., 3] = 1.0
        pixels = np.ascontiguousarray(display(name, over_black, color_correction)[..., :3])
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, "uint8")
    spec.attribute(_STRAIGHT_ALPHA, 1)
    spec.attribute("DateTime", "")
    if AOVS[name].color and color_correction == "sRGB":
        spec.attribute("oiio:ColorSpace", "srgb_rec709_scene")
    if extension in (".jpg", ".jpeg"):
        spec.attribute("Compression", "jpeg:95")
    if extension == ".png":
        for key, value in metadata.items():
            spec.attribute(key, str(value))
    return pixels, spec


def display(name: str, plane: F32, color_correction: str = "sRGB") -> NDArray[np.uint8]:
    """8-bit picture of one AOV, as a PNG holds it.

    Args:
        name: the AOV.
        plane: float32, shape as `refract_core.aovs.shape_of`; `beauty` is premultiplied.
        color_correction: applied to colours; data is never corrected.

    Returns:
        uint8, shape (H, W, 1), (H, W, 3), or (H, W, 4) with straight alpha.
    """
    aov = AOVS[name]
    values = plane.reshape(*plane.shape[:2], len(aov.channels)).astype(np.float32)
    if name == "N":
        values = values * 0.5 + 0.5
    if aov.color:
        if values.shape[2] == 4:
            alpha = values[..., 3:]
            np.divide(values[..., :3], alpha, out=values[..., :3], where=alpha > 0.0)
        values[..., :3] = _corrected(np.ascontiguousarray(values[..., :3]), color_correction)
    clamped = np.clip(np.nan_to_num(values, nan=0.0), 0.0, 1.0)
    return np.asarray(clamped * 255.0 + 0.5).astype(np.uint8)


def _corrected(rgb: F32, color_correction: str) -> F32:
    if color_correction == "disabled":
        return rgb
    if color_correction == "sRGB":
        return srgb_encode(np.clip(rgb, 0.0, 1.0))
    import OpenImageIO as oiio

    shown = oiio.ImageBufAlgo.ociodisplay(oiio.ImageBuf(rgb), "", "", _LINEAR_REC709)
    if shown.has_error:
        raise UsageError(
            f"color correction mode openColorIO: {_reason(shown.geterror())}; "
            "set OCIO to a config with a default view, unset it, or use sRGB"
        )
    return np.asarray(shown.get_pixels(oiio.FLOAT), np.float32).reshape(rgb.shape)
