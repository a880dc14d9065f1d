"""Parts of one picture as the picture they were cut from, with the very numbers that they hold."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import ImageError, UsageError
from ..files import write_whole
from .codec import STRAIGHT_ALPHA, encoded_parts, extension_of, open_picture, reason
from .pictures import PLACE

JOINED = (".exr", ".png")
_OWN = (PLACE, "refract:rays", "refract:seconds", "openexr:chunkCount")
"""What the file of a part says of itself alone."""


_NAMES = "/manifest"
"""End of the name of an attribute that says what the ids of mattes stand for, as JSON."""


class _Image(NamedTuple):
    """One part of an .exr, or the only picture of a file."""

    pixels: NDArray[Any]
    spec: Any


class _Piece(NamedTuple):
    path: str
    images: list[_Image]
    place: tuple[int, int, int, int]


def join_parts(out: str, parts: Sequence[str]) -> tuple[int, int]:
    """Write the picture that some files are parts of, in one step.

    Args:
        out: of the same format as the parts, .exr or .png.
        parts: files that say where they belong, as `Frame.save` writes them. Where two hold the same pixel it must be
            the same in both.

    Returns:
        Width and height of the picture.

    Raises:
        UsageError: a format that holds no place, or no parts.
        ImageError: a file is unreadable or no part, or they are not parts of one picture, or some are missing.
    """
    if not parts:
        raise UsageError("no parts are named; give the files of --tile-count or --crop")
    for path in (out, *parts):
        if extension_of(path) not in JOINED:
            raise UsageError(f"{path}: parts of pictures are joined from and to {' or '.join(JOINED)}")
        if extension_of(path) != extension_of(out):
            raise UsageError(f"{path}: is no {extension_of(out)}, as {out} is; the joined picture is like its parts")
    first = _read(parts[0])
    width, height = first.place[2:]
    shapes = [(height, width, image.pixels.shape[2]) for image in first.images]
    whole = [np.zeros(shape, image.pixels.dtype) for shape, image in zip(shapes, first.images, strict=True)]
    known = np.zeros((height, width), np.bool_)
    names: dict[str, dict[str, str]] = {}
    for k, path in enumerate(parts):
        piece = first if k == 0 else _read(path)
        _add(whole, known, piece, first)
        _add_names(names, piece)
    if not known.all():
        y, x = (int(at[0]) for at in np.nonzero(~known))
        share = 100.0 * (1.0 - float(known.mean()))
        raise ImageError(f"{out}: parts are missing: {share:.1f} % of the picture, pixel {x},{y} first")
    specs = [_whole_spec(image.spec, out, width, height, names) for image in first.images]
    write_whole(out, encoded_parts(out, list(zip(whole, specs, strict=True))), ImageError)
    return width, height


def _add(whole: list[NDArray[Any]], known: NDArray[np.bool_], piece: _Piece, first: _Piece) -> None:
    x, y, width, height = piece.place
    if (width, height) != first.place[2:]:
        raise ImageError(f"{piece.path}: is part of {width} x {height} pixels, {first.path} of {_size(first)}")
    if [image.spec.channelnames for image in piece.images] != [image.spec.channelnames for image in first.images]:
        raise ImageError(f"{piece.path}: holds other channels than {first.path}; render all parts with the same --aovs")
    if any(a.pixels.dtype != b.pixels.dtype for a, b in zip(piece.images, first.images, strict=True)):
        raise ImageError(f"{piece.path}: has numbers of other precision than {first.path}; leave that AOV out")
    pixels = piece.images[0].pixels
    rows, columns = slice(y, y + pixels.shape[0]), slice(x, x + pixels.shape[1])
    if whole[0][rows, columns].shape != pixels.shape:
        raise ImageError(f"{piece.path}: lies outside of its picture of {width} x {height} pixels")
    again = known[rows, columns]
    for target, image in zip(whole, piece.images, strict=True):
        if again.any() and target[rows, columns][again].tobytes() != image.pixels[again].tobytes():
            raise ImageError(f"{piece.path}: has other pixels than a part before it; they are not of one picture")
        target[rows, columns] = image.pixels
    known[rows, columns] = True


def _add_names(names: dict[str, dict[str, str]], piece: _Piece) -> None:
    """What the mattes of a piece say of names, beside what those before it did: each knows but what it shows."""
    for image in piece.images:
        for attribute in image.spec.extra_attribs:
            if attribute.name.startswith("cryptomatte/") and attribute.name.endswith(_NAMES):
                names.setdefault(attribute.name, {}).update(json.loads(attribute.value))


def _size(piece: _Piece) -> str:
    return f"{piece.place[2]} x {piece.place[3]}"


def _read(path: str) -> _Piece:
    """Pixels as they are stored: 8 bits, halves, or floats that halves are in exactly."""
    if not Path(path).is_file():
        text = "there is no such file; draw that part first, or correct the path (OUT comes before the parts)"
        raise ImageError(f"{path}: {text}")
    with open_picture(path, path, as_stored=True) as file:
        words = str(file.spec().getattribute(PLACE) or "").split()
        if len(words) != 4 or not all(word.isdigit() for word in words):
            raise ImageError(f"{path}: does not say where in a picture it belongs; it is no part that refract drew")
        images: list[_Image] = []
        while file.seek_subimage(len(images), 0):
            spec = file.spec()
            same = len({str(kind) for kind in spec.channelformats}) <= 1
            pixels = file.read_image(len(images), 0, 0, spec.nchannels, spec.format if same else "float")
            if pixels is None:
                raise ImageError(f"{path}: damaged image: {reason(file.geterror(), path)}")
            images.append(_Image(pixels.reshape(spec.height, spec.width, spec.nchannels), spec))
        x, y, width, height = (int(word) for word in words)
        return _Piece(path, images, (x, y, width, height))


def _whole_spec(spec: Any, out: str, width: int, height: int, names: dict[str, dict[str, str]]) -> Any:
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(spec)
    spec.x = spec.y = spec.full_x = spec.full_y = 0
    spec.width, spec.height = spec.full_width, spec.full_height = width, height
    for name in _OWN:
        spec.erase_attribute(name)
    for name, known in names.items():
        if spec.getattribute(name) is not None:
            spec.attribute(name, json.dumps(known, sort_keys=True, separators=(",", ":"), ensure_ascii=False))
    spec.attribute("DateTime", "")
    if extension_of(out) == ".png":
        spec.attribute(STRAIGHT_ALPHA, 1)
    return spec
