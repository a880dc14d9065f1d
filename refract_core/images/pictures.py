"""Flat image files in and out: textures of a stage, planes of a frame, maps of one number per texel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ImageError, UsageError
from ..files import check_place, write_whole
from ..scene import F32, F64, Texture
from .aovs import AOVS, check_names, shape_of
from .codec import (
    HALF_MAX,
    STRAIGHT_ALPHA,
    encoded,
    encoded_parts,
    exr_spec,
    extension_of,
    named_file,
    read_matrix,
    read_parts,
    read_pixels,
    read_size,
    reason,
)
from .cryptomatte import Matte
from .exr import USUAL, Attribute, Layout, check_layout, parts_of
from .spaces import AUTO, NAMES, RAW, SRGB, picture
from .srgb import as_floats, srgb_decode, srgb_encode

COLOR_CORRECTIONS = ("disabled", "sRGB", "openColorIO")
PLACE = "refract:place"
"""Attribute of a part: column and row of its first pixel, width and height of the whole picture."""
LAYERED = (".exr",)
EIGHT_BIT = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".avif")
_PNG_LEVEL, _PNG_SUB = 4, 0x10
"""zlib's level, and libpng's flag for differences to the left neighbour: written in half the time the defaults take, at
about the same size."""


# --- reading -----------------------------------------------------------------------------------------------------


def read_texture(source: str | bytes, *, name: str, color_space: str) -> Texture:
    """Decode an image file into RGBA.

    Missing channels are filled as UsdUVTexture does: one channel is grey, two are grey and alpha, and alpha is 1
    where the file has none. Values stay as the file has them, never premultiplied. 8-bit files stay uint8; 16-bit
    integers become float32 in [0, 1], and with them whatever has a space that bytes cannot be kept in. Half and float
    files hold linear light, so of their colour space the primaries count alone, unless it is a logarithm.

    Args:
        source: a path, or the bytes of a file (from inside a package).
        name: what messages call it.
        color_space: one of `spaces.NAMES`. `auto` is sRGB where the file has 8 bits and 3 or 4 channels, else raw.

    Raises:
        ImageError: unreadable, damaged, too large, or an unknown colour space.
    """
    if color_space not in NAMES:
        raise ImageError(f"{name}: colour space is '{color_space}'; choose from {', '.join(NAMES)}")
    with named_file(source, name) as path:
        pixels, channels, integer, _ = read_pixels(path, name)
    if color_space == AUTO:
        color_space = SRGB if pixels.dtype == np.uint8 and channels >= 3 else RAW
    if pixels.dtype == np.uint8 and color_space in (RAW, SRGB):
        return Texture(name, pixels, color_space == SRGB)
    if color_space == RAW or (color_space == SRGB and not integer):
        return Texture(name, pixels)
    return Texture(name, picture(pixels, color_space, encoded=integer))


def texture_size(source: str | bytes, name: str) -> tuple[int, int, bool]:
    """Width and height of an image file, and whether its colours have 8 bits, by its head alone.

    Raises:
        ImageError: unreadable, or too large.
    """
    with named_file(source, name) as path:
        return read_size(path, name)


def world_to_screen(source: str | bytes, name: str) -> F64:
    """The matrix that a picture was projected by, shape (4, 4), row vectors: to -1 .. 1 across and upwards. Files
    that older OpenImageIO wrote have it as worldToNDC.

    Raises:
        ImageError: unreadable, or the file has none.
    """
    with named_file(source, name) as path:
        return read_matrix(path, name, ("worldtoscreen", "worldtondc"))


def read_planes(path: str) -> dict[str, F32]:
    """A picture file as the planes of a frame: what `write_frame` wrote, or `beauty` of anybody's picture.

    Args:
        path: an .exr holds scene-linear light and whatever AOVs its channels are named after; of other formats 8-bit
            and 16-bit colours are taken as sRGB.

    Returns:
        AOV name -> float32, shapes as `aovs.shape_of`; `beauty` is there always, scene-linear with premultiplied alpha.

    Raises:
        UsageError: the extension is unknown.
        ImageError: unreadable, damaged, too large, or an .exr without R, G and B.
    """
    extension = _extension(path)
    with named_file(path, path) as file:
        if extension not in LAYERED:
            rgba, _, integer, straight = read_pixels(file, path)
            return {"beauty": _linear_premultiplied(rgba, integer, straight)}
        found = read_parts(file, path, {channel for aov in AOVS.values() for channel in aov.channels})
    lacking = [name for name in "RGB" if name not in found]
    if lacking:
        raise ImageError(f"{path}: has no channel {lacking[0]}; give a picture with R, G and B")
    found.setdefault("A", np.ones_like(found["R"]))
    planes = {}
    for name, aov in AOVS.items():
        if all(channel in found for channel in aov.channels):
            plane = np.dstack([found[channel] for channel in aov.channels])
            planes[name] = np.ascontiguousarray(plane[..., 0] if aov.scalar else plane, np.float32)
    return planes


def _linear_premultiplied(rgba: NDArray[Any], integer: bool, straight: bool) -> F32:
    """Pixels of a file as `beauty`, shape (H, W, 4)."""
    out = as_floats(rgba)
    if integer:
        out[..., :3] = srgb_decode(out[..., :3])
    if straight:
        out[..., :3] *= out[..., 3:]
    return out


# --- writing -----------------------------------------------------------------------------------------------------


def png_bytes(rgb: NDArray[np.uint8]) -> bytes:
    """A PNG file in memory.

    Args:
        rgb: shape (H, W, 3), as shown, or (H, W, 4) with straight alpha.

    Raises:
        ImageError: it cannot be encoded.
    """
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(rgb.shape[1], rgb.shape[0], rgb.shape[2], "uint8")
    spec.attribute(STRAIGHT_ALPHA, 1)
    spec.attribute("DateTime", "")
    spec.attribute("png:compressionLevel", _PNG_LEVEL)
    spec.attribute("png:filter", _PNG_SUB)
    return encoded("picture.png", np.ascontiguousarray(rgb), spec)


def layered(path: str) -> bool:
    """The format holds many planes."""
    return _extension(path) in LAYERED


def default_aovs(path: str, available: Sequence[str]) -> tuple[str, ...]:
    """What a file holds when nobody says: everything in an EXR, the picture elsewhere."""
    return tuple(available) if _extension(path) in LAYERED else ("beauty",)


def check_output(
    path: str, aovs: Sequence[str], color_correction: str, layout: Layout = USUAL, mattes: bool = False
) -> None:
    """Refuse, before any work, what `write_frame` could not write.

    Raises:
        UsageError: the extension, an AOV, the correction or something of the layout is unknown, or the format cannot
            hold these AOVs, or no mattes.
    """
    extension = _extension(path)
    check_names(aovs)
    if color_correction not in COLOR_CORRECTIONS:
        raise UsageError(
            f"color correction mode is '{color_correction}', which is not known; "
            f"choose from {', '.join(COLOR_CORRECTIONS)}"
        )
    if extension in LAYERED:
        check_layout(layout, aovs, mattes)
        return
    if mattes:
        raise UsageError(f"{path}: Cryptomatte is ids, which {extension} cannot hold; write a .exr file")
    if layout != USUAL:
        raise UsageError(f"{path}: is no .exr file, so EXR compression and parts mean nothing; leave them out")
    if len(aovs) > 1:
        raise UsageError(
            f"{path}: {extension} holds one AOV, but {', '.join(aovs)} are asked for; name one, or write a .exr file"
        )
    if "P" in aovs:
        raise UsageError(f"{path}: AOV 'P' is positions, which {extension} cannot hold; write a .exr file")


def check_writable(path: str) -> None:
    """Refuse, before any work, a place where no file can be written.

    Raises:
        UsageError: the extension is unknown, the folder does not exist, or `path` is one.
        ImageError: the folder cannot be written.
    """
    _extension(path)
    check_place(path, ImageError)


def write_frame(
    path: str,
    planes: Mapping[str, F32],
    metadata: Mapping[str, str | float],
    *,
    color_correction: str = "sRGB",
    names: Mapping[str, str] | None = None,
    layout: Layout = USUAL,
    mattes: Sequence[Matte] = (),
    attributes: Mapping[str, Attribute] | None = None,
    place: tuple[int, int, int, int] | None = None,
) -> None:
    """Write planes to a file, in one step: the file appears whole, or not at all.

    Args:
        path: `.exr` takes any planes as scene-linear channels, Z and P as float32 and the rest as half, but for data
            that is larger than halfs get; the 8-bit formats take exactly one.
        planes: AOV name -> float32, shapes as `aovs.shape_of`.
        metadata: attributes of the file, where the format has a place for them (EXR; PNG as text).
        color_correction: `sRGB`, `disabled` or `openColorIO`; colours in 8-bit files only.
        names: AOV -> what its channels are called in an .exr, where that is another name; see `aovs.channels_of`.
        layout: how an .exr is cut up and compressed.
        mattes: for an .exr, as more parts of it.
        attributes: more that the head of an .exr says, see `exr.parts_of`.
        place: column and row of the first pixel in a larger picture, and its width and height: the file's data window
            and display window, or a text in a PNG. Other formats hold that part of the picture alone.

    Raises:
        UsageError: see `check_output`.
        ImageError: the file cannot be written.
    """
    check_output(path, tuple(planes), color_correction, layout, bool(mattes))
    if not planes:
        raise UsageError(f"{path}: no AOV is chosen; name at least one")
    height, width = next(iter(planes.values())).shape[:2]
    for name, plane in planes.items():
        if plane.shape != shape_of(name, height, width):
            raise ImageError(f"{path}: plane '{name}' has shape {plane.shape}, not {shape_of(name, height, width)}")
    if _extension(path) in LAYERED:
        parts = parts_of(planes, mattes, {**metadata, **(attributes or {})}, names or {}, layout)
        if place is not None:
            for part in parts:
                set_place(part.spec, place)
        write_whole(path, encoded_parts(path, parts), ImageError)
        return
    ((name, plane),) = planes.items()
    pixels, spec = _eight_bit(path, name, plane, metadata, color_correction)
    if place is not None:
        set_place(spec, place)
    write_whole(path, encoded(path, pixels, spec), ImageError)


def set_place(spec: Any, place: tuple[int, int, int, int]) -> None:
    """Say in OpenImageIO's description of a file where in a larger picture its pixels are."""
    spec.x, spec.y, spec.full_width, spec.full_height = place
    spec.full_x = spec.full_y = 0
    spec.attribute(PLACE, "{} {} {} {}".format(*place))


def write_map(path: str, plane: F32, metadata: Mapping[str, str | float]) -> None:
    """Write one number per texel as half floats in the one channel Y of an .exr, in one step. Equal input, equal bytes.

    Args:
        plane: shape (H, W), row 0 on top.
        metadata: attributes of the file.

    Raises:
        UsageError: not an .exr file.
        ImageError: the file cannot be written.
    """
    if _extension(path) not in LAYERED:
        raise UsageError(f"{path}: a map is written as .exr; change the extension")
    spec = exr_spec(plane.shape[1], plane.shape[0], ("Y",), ("half",), metadata)
    pixels = np.ascontiguousarray(np.clip(plane, -HALF_MAX, HALF_MAX))[..., None]
    write_whole(path, encoded(path, pixels, spec), ImageError)


def _extension(path: str) -> str:
    extension = extension_of(path)
    if extension not in LAYERED + EIGHT_BIT:
        known = ", ".join(LAYERED + EIGHT_BIT)
        raise UsageError(f"{path}: '{extension}' is not a known image extension; use one of {known}")
    return extension


def _eight_bit(
    path: str, name: str, plane: F32, metadata: Mapping[str, str | float], color_correction: str
) -> tuple[NDArray[np.uint8], Any]:
    """One plane as 8 bits, and OpenImageIO's description of the file."""
    import OpenImageIO as oiio

    extension = _extension(path)
    pixels = display(name, plane, color_correction)
    if pixels.shape[2] == 4 and extension in (".jpg", ".jpeg"):  # no alpha there: the picture over black
        over_black = plane.copy()
        over_black[..., 3] = 1.0
        pixels = np.ascontiguousarray(display(name, over_black, color_correction)[..., :3])
    height, width, channels = pixels.shape
    spec = oiio.ImageSpec(width, height, channels, "uint8")
    spec.attribute(STRAIGHT_ALPHA, 1)
    spec.attribute("DateTime", "")
    if AOVS[name].color and color_correction == "sRGB":
        spec.attribute("oiio:ColorSpace", "srgb_rec709_scene")
    if extension in (".jpg", ".jpeg"):
        spec.attribute("Compression", "jpeg:95")
    if extension == ".webp":
        spec.attribute("Compression", "webp:90")
    if extension == ".png":
        spec.attribute("png:compressionLevel", _PNG_LEVEL)
        spec.attribute("png:filter", _PNG_SUB)
        for key, value in metadata.items():
            spec.attribute(key, str(value))
    return pixels, spec


def display(name: str, plane: F32, color_correction: str = "sRGB") -> NDArray[np.uint8]:
    """8-bit picture of one AOV, as a PNG holds it.

    Args:
        name: the AOV.
        plane: float32, shape as `aovs.shape_of`; `beauty` is premultiplied.
        color_correction: applied to colours; data is never corrected.

    Returns:
        uint8, shape (H, W, 1), (H, W, 3), or (H, W, 4) with straight alpha.
    """
    aov = AOVS[name]
    values = plane.reshape(*plane.shape[:2], len(aov.channels)).astype(np.float32)
    if name in ("N", "denoising_normal"):
        values = values * 0.5 + 0.5
    if aov.color:
        if values.shape[2] == 4:
            alpha = values[..., 3:]
            np.divide(values[..., :3], alpha, out=values[..., :3], where=alpha > 0.0)
        values[..., :3] = _corrected(np.ascontiguousarray(values[..., :3]), color_correction)
    clamped = np.clip(np.nan_to_num(values, nan=0.0), 0.0, 1.0)
    return np.asarray(clamped * 255.0 + 0.5).astype(np.uint8)


def _corrected(rgb: F32, color_correction: str) -> F32:
    """Colours as a screen takes them, shape (H, W, 3). Raises UsageError where OpenColorIO has no view."""
    if color_correction == "disabled":
        return rgb
    if color_correction == "sRGB":
        return srgb_encode(np.clip(rgb, 0.0, 1.0))
    import OpenImageIO as oiio

    shown = oiio.ImageBufAlgo.ociodisplay(oiio.ImageBuf(rgb), "", "", "lin_rec709_scene")
    if shown.has_error:
        raise UsageError(
            f"color correction mode openColorIO: {reason(shown.geterror())}; "
            "set OCIO to a config with a default view, unset it, or use sRGB"
        )
    return np.asarray(shown.get_pixels(oiio.FLOAT), np.float32).reshape(rgb.shape)
