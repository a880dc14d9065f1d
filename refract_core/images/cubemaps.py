"""Cubemaps in files.

What `write_cubemap` writes is a tiled OpenEXR file with MIP levels, which any reader of textures understands:

- Channels R G B (half, scene-linear, multiplied by coverage, at most 65504), A (half, coverage: 0 where the sky is
  seen) and Z (float, distance along the ray in metres, 0 where it is not known).
- Faces +x -x +y -y +z -z of the stage's world as the engine has it (right-handed, Y up, metres), looked at from the
  middle; `scene.Cubemap` says which way each lies, and `layouts` how strip, cross and latlong arrange them.
- MIP level m holds the faces blurred by the GGX lobe that level stands for (`scene.CUBE_LEVELS`), as long as the layout
  halves exactly; `refract:levels` counts them. The levels below, which the format asks for, are plain averages.
- `refract:layout` is the layout, `refract:resolution` the side of a face [texels].
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import ImageError, UsageError
from ..files import write_whole
from ..scene import CUBE_LEVELS, F32, Cubemap
from .codec import (
    HALF_MAX,
    check_size,
    exr_spec,
    extension_of,
    memory_file,
    named_file,
    open_picture,
    read_pixels,
    reason,
)
from .layouts import LAYOUTS, arrange, faces_of, halved
from .srgb import srgb_decode

CHANNELS = ("R", "G", "B", "A", "Z")
_OURS = "refract:"
_LAYOUT, _RESOLUTION, _LEVELS = f"{_OURS}layout", f"{_OURS}resolution", f"{_OURS}levels"


# --- writing -----------------------------------------------------------------------------------------------------


def write_cubemap(
    path: str, cubemap: Cubemap, layout: str = "strip", metadata: Mapping[str, str | float] | None = None
) -> None:
    """Write a cubemap to an .exr file, in one step: the file appears whole, or not at all. Equal input, equal bytes.

    Args:
        layout: one of `layouts.LAYOUTS`.
        metadata: more attributes of the file; `read_notes` gives back those that begin with `refract:`.

    Raises:
        UsageError: an unknown layout, or not an .exr file.
        ImageError: the file cannot be written.
    """
    if layout not in LAYOUTS:
        raise UsageError(f"layout is '{layout}', which is not known; choose from {', '.join(LAYOUTS)}")
    if extension_of(path) != ".exr":
        raise UsageError(f"{path}: a cubemap is written as .exr; change the extension")
    chain, exact = _mip_chain(cubemap, layout)
    notes = {**(metadata or {}), _LAYOUT: layout, _RESOLUTION: cubemap.resolution, _LEVELS: exact}
    write_whole(path, _encoded_levels(path, chain, notes), ImageError)


def _mip_chain(cubemap: Cubemap, layout: str) -> tuple[list[F32], int]:
    """Pictures of every MIP level down to one pixel, and how many of them are the cubemap's own levels."""
    chain = [_arranged(cubemap.levels[0], layout)]
    for level in cubemap.levels[1:]:
        picture = _arranged(level, layout)
        if picture.shape[:2] != tuple(max(1, side // 2) for side in chain[-1].shape[:2]):
            break
        chain.append(picture)
    exact = len(chain)
    while max(chain[-1].shape[:2]) > 1:
        chain.append(_with_distance(halved(_with_share(chain[-1]))))
    return chain, exact


def _arranged(faces: F32, layout: str) -> F32:
    if layout == "latlong":
        return _with_distance(arrange(_with_share(faces), layout))
    return arrange(faces, layout)


def _with_share(texels: F32) -> F32:
    """Ready to be averaged: distances count only where they are known, so a last channel says how much is."""
    known = (texels[..., 4:] > 0.0).astype(np.float32)
    return np.concatenate([texels, known], axis=-1)


def _with_distance(texels: F32) -> F32:
    """Undo `_with_share` after averaging."""
    distance = np.zeros_like(texels[..., 4:5])
    np.divide(texels[..., 4:5], texels[..., 5:], out=distance, where=texels[..., 5:] > 0.0)
    return np.concatenate([texels[..., :4], distance], axis=-1)


def _encoded_levels(path: str, chain: list[F32], metadata: Mapping[str, str | float]) -> bytes:
    """The whole file in memory, as `codec.encoded` does it for flat pictures."""
    import OpenImageIO as oiio

    with memory_file() as name:
        file = oiio.ImageOutput.create("exr")
        if file is None:
            raise ImageError(f"{path}: cannot be encoded: {reason(oiio.geterror())}")
        mode = "Create"
        for picture in chain:
            if not (file.open(name, _spec(picture, metadata), mode) and file.write_image(_storable(picture))):
                raise ImageError(f"{path}: cannot be encoded: {reason(file.geterror(), name)}")
            mode = "AppendMIPLevel"
        if not file.close():
            raise ImageError(f"{path}: cannot be encoded: {reason(file.geterror(), name)}")
        del file  # a file of several levels is complete only now (OpenImageIO 3.2), and nothing tells whether it is
        written = oiio.ImageInput.open(name)
        last = len(chain) - 1
        if written is None or written.read_image(0, last, 0, len(CHANNELS), oiio.FLOAT) is None:
            raise ImageError(f"{path}: cannot be encoded: out of memory, or over the limit on file sizes")
        written.close()
        return Path(name).read_bytes()


def _spec(picture: F32, metadata: Mapping[str, str | float]) -> Any:
    formats = ("half", "half", "half", "half", "float")
    spec = exr_spec(picture.shape[1], picture.shape[0], CHANNELS, formats, metadata)
    spec.tile_width = spec.tile_height = 64
    spec.tile_depth = 1
    spec.attribute("textureformat", "Plain Texture")  # what makes the writer keep MIP levels
    return spec


def _storable(picture: F32) -> F32:
    """A colour beyond the largest half would become infinity, which spoils every average it gets into."""
    stored = np.array(picture, np.float32, order="C")
    np.clip(stored[..., :3], -HALF_MAX, HALF_MAX, out=stored[..., :3])
    return stored


# --- reading -----------------------------------------------------------------------------------------------------


def read_cubemap(source: str | bytes, name: str, resolution: int) -> Cubemap:
    """Read a cubemap: one that `write_cubemap` wrote, or anybody's latlong, strip or cross.

    Our own strip of the same resolution gives all its levels back as they are stored. Anything else gives level 0
    alone: our own files resampled where need be; other pictures with their alpha as coverage (which is multiplied into
    colours that are stored straight) and no distances. 8-bit colours are sRGB, everything else is linear.

    Args:
        source: a path, or the bytes of a file (from inside a package).
        name: what messages call it.
        resolution: of the faces [texels].

    Raises:
        ImageError: unreadable, damaged, too large, or of a shape that is no layout.
    """
    with named_file(source, name) as path:
        levels = _own_levels(path, name, resolution)
        if levels:
            return Cubemap(levels)
        picture = read_pixels(path, name)
    rgba = picture.rgba.astype(np.float32)
    if picture.rgba.dtype == np.uint8:
        rgba /= 255.0
        if picture.channels >= 3:
            rgba[..., :3] = srgb_decode(rgba[..., :3])
    texels = np.concatenate([_finite(rgba), np.zeros_like(rgba[..., :1])], axis=-1)
    texels[..., 3] = np.clip(texels[..., 3], 0.0, 1.0)
    if picture.straight:
        texels[..., :3] *= texels[..., 3:4]
    return Cubemap((_faces(texels, name, resolution),))


def read_notes(source: str | bytes, name: str) -> dict[str, str | int | float]:
    """What `write_cubemap` wrote beside the pixels: attributes that begin with `refract:`, without that.

    Raises:
        ImageError: not a readable image.
    """
    with named_file(source, name) as path, open_picture(path, name) as file:
        attributes: dict[str, Any] = {str(one.name): one.value for one in file.spec().extra_attribs}
    return {key.removeprefix(_OURS): value for key, value in attributes.items() if key.startswith(_OURS)}


def _finite(texels: F32) -> F32:
    return np.nan_to_num(texels, nan=0.0, posinf=HALF_MAX, neginf=0.0)


def _faces(texels: F32, name: str, resolution: int) -> F32:
    try:
        return faces_of(texels, resolution)
    except ImageError as error:
        raise ImageError(f"{name}: {error}") from error


def _own_levels(path: str, name: str, resolution: int) -> tuple[F32, ...]:
    """Levels of a file that `write_cubemap` wrote; none where somebody else did."""
    with open_picture(path, name) as file:
        spec = file.spec()
        if spec.get_string_attribute(_LAYOUT, "") not in LAYOUTS or tuple(spec.channelnames) != CHANNELS:
            return ()
        check_size(spec, name)
        picture = _level(file, 0, path, name)
        if spec.get_string_attribute(_LAYOUT, "") == "strip" and picture.shape[:2] == (6 * resolution, resolution):
            count = spec.get_int_attribute(_LEVELS, 1)
            return _stored_levels(file, picture, count if count == CUBE_LEVELS else 1, path, name)
        return (_with_distance(_faces(_with_share(picture), name, resolution)),)


def _stored_levels(file: Any, first: F32, count: int, path: str, name: str) -> tuple[F32, ...]:
    """The levels of a strip as they are stored; the first alone where one is not as it should be."""
    n = first.shape[1]
    levels = [first.reshape(6, n, n, len(CHANNELS))]
    for level in range(1, count):
        side = n >> level
        spec = file.spec(0, level)
        if (spec.width, spec.height) != (side, 6 * side):
            return (levels[0],)
        levels.append(_level(file, level, path, name).reshape(6, side, side, len(CHANNELS)))
    return tuple(levels)


def _level(file: Any, level: int, path: str, name: str) -> F32:
    import OpenImageIO as oiio

    pixels = file.read_image(0, level, 0, len(CHANNELS), oiio.FLOAT)
    if pixels is None:
        raise ImageError(f"{name}: damaged image: {reason(file.geterror(), path)}")
    return _finite(np.asarray(pixels, np.float32))
