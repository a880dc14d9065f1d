"""Image files as bytes and pixels: what reading and writing pictures and cubemaps share.

OpenImageIO is loaded with the first file, never with this module.
"""

from __future__ import annotations

import io
import os
import tempfile
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import ImageError
from ..scene import F64

MAX_TEXTURE_PIXELS = 1 << 28
HALF_MAX = 65504.0

STRAIGHT_ALPHA = "oiio:UnassociatedAlpha"


def extension_of(path: str) -> str:
    """`.exr` of `Shot.EXR`: the part that chooses a format."""
    return os.path.splitext(path)[1].lower()


# --- reading -----------------------------------------------------------------------------------------------------


@contextmanager
def named_file(source: str | bytes, name: str) -> Iterator[str]:
    """A path OpenImageIO can open: its Python binding reads no bytes."""
    if isinstance(source, bytes):
        with memory_file() as path:
            Path(path).write_bytes(source)
            yield path
    elif os.path.isfile(source):
        yield source
    else:
        raise ImageError(f"{name}: the file does not exist; correct the path or add the file")


@contextmanager
def memory_file() -> Iterator[str]:
    """Path of an empty file in memory (where the system has and allows that), which also works where nothing may be
    written; else in the folder for temporary files."""
    try:
        descriptor = os.memfd_create("image")
    except (AttributeError, OSError):
        descriptor = -1
    if descriptor >= 0:
        try:
            yield f"/proc/self/fd/{descriptor}"
        finally:
            os.close(descriptor)
    else:
        with tempfile.TemporaryDirectory() as folder:
            yield os.path.join(folder, "image")


class Pixels(NamedTuple):
    """The first image of a file."""

    rgba: NDArray[Any]
    """shape (H, W, 4), uint8 or float32"""
    channels: int
    """how many the file itself has"""
    integer: bool
    straight: bool
    """colours are not multiplied by alpha"""


class Channels(NamedTuple):
    """The first image of a file, channel by channel."""

    pixels: NDArray[Any]
    """shape (H, W, C), uint8 or float32: the display window"""
    spec: Any
    """OpenImageIO's description of the file"""


def read_pixels(path: str, name: str) -> Pixels:
    """Decode the first image in a file; see `pictures.read_texture`."""
    import OpenImageIO as oiio

    pixels, spec = read_channels(path, name)
    integer = spec.format.basetype not in (oiio.HALF, oiio.FLOAT, oiio.DOUBLE)
    return Pixels(_rgba(pixels, spec), spec.nchannels, integer, is_straight(spec))


def is_straight(spec: Any) -> bool:
    """Colours are not multiplied by alpha, by OpenImageIO's description of a file."""
    return bool(spec.get_int_attribute(STRAIGHT_ALPHA, 0))


@contextmanager
def open_picture(path: str, name: str, *, as_stored: bool = False) -> Iterator[Any]:
    """OpenImageIO's reader of a file, closed afterwards.

    Args:
        as_stored: colours are not multiplied by an alpha that they are kept without.

    Raises:
        ImageError: unreadable.
    """
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    if as_stored:
        config.attribute(STRAIGHT_ALPHA, 1)
    file = oiio.ImageInput.open(path, config)
    if file is None:
        raise ImageError(f"{name}: not a readable image: {reason(oiio.geterror(), path)}")
    try:
        yield file
    finally:
        file.close()


def read_channels(path: str, name: str) -> Channels:
    """Decode the first image in a file with all its channels; 8-bit integers stay so, the rest becomes float32.

    Raises:
        ImageError: unreadable, damaged or too large.
    """
    import OpenImageIO as oiio

    with open_picture(path, name, as_stored=True) as file:
        spec = file.spec()
        check_size(spec, name)
        small = spec.format.basetype in (oiio.UINT8, oiio.INT8)
        pixels = file.read_image(0, 0, 0, spec.nchannels, oiio.UINT8 if small else oiio.FLOAT)
        if pixels is None:
            raise ImageError(f"{name}: damaged image: {reason(file.geterror(), path)}")
        return Channels(_display_window(pixels.reshape(spec.height, spec.width, spec.nchannels), spec), spec)


def read_parts(path: str, name: str, wanted: Collection[str]) -> dict[str, NDArray[np.float32]]:
    """Channels of all parts of an .exr file, by name; of two that are called the same, the first.

    Args:
        wanted: names of the channels that are read; parts without any of them are passed over, and those that have
            another size than the first.

    Returns:
        Name -> shape (H, W) float32: the display window.

    Raises:
        ImageError: unreadable, damaged or too large.
    """
    import OpenImageIO as oiio

    found: dict[str, NDArray[np.float32]] = {}
    with open_picture(path, name) as file:
        size, part = (0, 0), 0
        while file.seek_subimage(part, 0):
            spec = file.spec()
            check_size(spec, name)
            size = size if part else (spec.full_width, spec.full_height)
            mine = [k for k, one in enumerate(spec.channelnames) if one in wanted and one not in found]
            if mine and (spec.full_width, spec.full_height) == size:
                first, last = mine[0], mine[-1] + 1
                pixels = file.read_image(part, 0, first, last, oiio.FLOAT)
                if pixels is None:
                    raise ImageError(f"{name}: damaged image: {reason(file.geterror(), path)}")
                shown = _display_window(pixels.reshape(spec.height, spec.width, last - first), spec)
                found |= {spec.channelnames[k]: shown[..., k - first] for k in mine}
            part += 1
        return found


def read_size(path: str, name: str) -> tuple[int, int, bool]:
    """Width and height of the display window of a file's first image, and whether it has 8 bits.

    Raises:
        ImageError: unreadable or too large.
    """
    import OpenImageIO as oiio

    with open_picture(path, name) as file:
        spec = file.spec()
        check_size(spec, name)
        return spec.full_width, spec.full_height, spec.format.basetype in (oiio.UINT8, oiio.INT8)


def read_matrix(path: str, name: str, wanted: Sequence[str]) -> F64:
    """A 4 x 4 matrix in the head of a file, shape (4, 4), row vectors, under the first of some names it has.

    Args:
        wanted: names in lower case

    Raises:
        ImageError: the file is unreadable, or has no such matrix.
    """
    with open_picture(path, name) as file:
        attributes: dict[str, Any] = {str(one.name).lower(): one.value for one in file.spec().extra_attribs}
    for known in wanted:
        if known in attributes and np.shape(attributes[known]) == (16,):
            return np.asarray(attributes[known], np.float64).reshape(4, 4)
    raise ImageError(f"{name}: its head has no matrix of 16 numbers named {' or '.join(wanted)}")


def check_size(spec: Any, name: str) -> None:
    """Refuse, before its pixels are read, an image that is no flat picture or too large."""
    if spec.depth > 1 or spec.nchannels < 1:
        raise ImageError(f"{name}: a volume or an empty image cannot be a texture; give a flat picture")
    pixel_count = max(spec.width * spec.height, spec.full_width * spec.full_height)
    if pixel_count * max(spec.nchannels, 4) > MAX_TEXTURE_PIXELS * 4:
        raise ImageError(
            f"{name}: {spec.width} x {spec.height} x {spec.nchannels} channels is over {MAX_TEXTURE_PIXELS} RGBA "
            "pixels; give a smaller image"
        )


def reason(message: str, path: str = "") -> str:
    """First line of a library's message, which may be empty or long, without the path it knows."""
    lines = (message.replace(path, "the file") if path else message).strip().splitlines()
    return lines[0] if lines else "no reason given"


def _display_window(pixels: NDArray[Any], spec: Any) -> NDArray[Any]:
    """Pixels of the display window; what the data window lacks is 0 (OpenEXR, "Technical Introduction")."""
    if (spec.x, spec.y, spec.width, spec.height) == (spec.full_x, spec.full_y, spec.full_width, spec.full_height):
        return pixels
    shown = np.zeros((spec.full_height, spec.full_width, pixels.shape[2]), pixels.dtype)
    x, y = spec.x - spec.full_x, spec.y - spec.full_y
    left, right = max(x, 0), min(x + spec.width, spec.full_width)
    top, bottom = max(y, 0), min(y + spec.height, spec.full_height)
    if left < right and top < bottom:
        shown[top:bottom, left:right] = pixels[top - y : bottom - y, left - x : right - x]
    return shown


def _rgba(pixels: NDArray[Any], spec: Any) -> NDArray[Any]:
    """Four channels out of however many the file has, found by their names where it names them."""
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
    for channel, column in enumerate(rgb):  # one by one: all three at once would be a copy of a large picture
        out[..., channel] = pixels[..., column]
    out[..., 3] = pixels[..., alpha] if alpha >= 0 else opaque
    return out


# --- writing -----------------------------------------------------------------------------------------------------


_LEVELS = {"zip": "zip:2"}
"""Level 2 of zlib's nine: files are a hundredth larger than at OpenEXR's own 4, and written a tenth sooner."""


def exr_spec(
    width: int,
    height: int,
    channels: Sequence[str],
    formats: Sequence[str],
    metadata: Mapping[str, str | float],
    compression: str = "zip",
) -> Any:
    """OpenImageIO's description of an EXR file whose bytes depend on nothing but what is written.

    Args:
        channels: names, in the order of the pixels' last axis.
        formats: `half` or `float` for each channel.
        metadata: attributes of the file.
        compression: OpenEXR's name of it.
    """
    import OpenImageIO as oiio

    alike = len(set(formats)) == 1  # then pixels that have this type go into the file as they are
    spec = oiio.ImageSpec(width, height, len(channels), formats[0] if alike else "float")
    spec.channelnames = tuple(channels)
    if not alike:
        spec.channelformats = tuple(oiio.TypeDesc(one) for one in formats)
    spec.attribute("compression", _LEVELS.get(compression, compression))
    spec.attribute("DateTime", "")  # else the writer stamps the time, and equal pictures make unequal files
    for key, value in metadata.items():
        spec.attribute(key, value)
    return spec


def encoded(path: str, pixels: NDArray[Any], spec: Any) -> bytes:
    """The whole file in memory: on a full disk some writers say nothing, and one ends the process.

    Args:
        path: whose extension says which format.
        spec: OpenImageIO's description of it.
    """
    if extension_of(path) == ".avif":
        return _avif(path, pixels)
    return encoded_parts(path, [(pixels, spec)])


def encoded_parts(path: str, parts: Sequence[tuple[NDArray[Any], Any]]) -> bytes:
    """The whole file in memory, part by part: pixels, and OpenImageIO's description of them. Only an .exr has many."""
    import OpenImageIO as oiio

    with memory_file() as name:
        file = oiio.ImageOutput.create(extension_of(path)[1:])
        if file is None:
            raise ImageError(f"{path}: cannot be encoded: {reason(oiio.geterror())}")
        specs = tuple(spec for _, spec in parts)
        written = opened = file.open(name, specs if len(specs) > 1 else specs[0])
        for k, (pixels, spec) in enumerate(parts):
            written = written and (k == 0 or file.open(name, spec, "AppendSubimage")) and file.write_image(pixels)
        closed = opened and file.close()
        if not (written and closed):
            raise ImageError(f"{path}: cannot be encoded: {reason(file.geterror(), name)}")
        data = Path(name).read_bytes()
    if extension_of(path) == ".png" and not data.endswith(b"IEND\xaeB`\x82"):  # the last chunk of every PNG
        raise ImageError(f"{path}: cannot be encoded: out of memory, or over the limit on file sizes")
    return data


def _avif(path: str, pixels: NDArray[np.uint8]) -> bytes:
    """By Pillow: OpenImageIO's packages are built without the library for it."""
    from PIL import Image

    data = io.BytesIO()
    whole = pixels[..., 0] if pixels.shape[2] == 1 else pixels
    try:
        Image.fromarray(np.ascontiguousarray(whole)).save(data, "AVIF", quality=90, max_threads=1)
    except (OSError, ValueError, RuntimeError, KeyError) as error:
        raise ImageError(f"{path}: cannot be encoded: {error}") from None
    return data.getvalue()
