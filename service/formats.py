"""Formats of pictures: what a request calls them, and their media types."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import NamedTuple

from .problems import Problem


class Format(NamedTuple):
    media: str
    extension: str
    """Of the file that a worker writes, without the dot."""
    longest_side: int
    """[pixels] what the format can hold"""


FORMATS = {
    "png": Format("image/png", "png", 1 << 31),
    "jpeg": Format("image/jpeg", "jpg", 65500),
    "webp": Format("image/webp", "webp", 16383),
    "avif": Format("image/avif", "avif", 65536),
    "exr": Format("image/x-exr", "exr", 1 << 31),
}
"""By name, in the order in which a client that takes anything gets them."""
BY_EXTENSION = {one.extension: one for one in FORMATS.values()}
MEDIA = tuple(one.media for one in FORMATS.values())


def format_of(accept: str, asked: str) -> str:
    """Name of the format of an answer.

    Args:
        accept: the header; '' takes anything.
        asked: `format` of the settings; '' leaves it to `accept`.

    Raises:
        Problem: 406, with what can be given.
    """
    possible = [asked] if asked else list(FORMATS)
    media = accepted(accept, [FORMATS[name].media for name in possible])
    if not media:
        raise Problem("not-acceptable", f"this can be given as {' or '.join(FORMATS[name].media for name in possible)}")
    return next(name for name in possible if FORMATS[name].media == media)


def chosen(accept: str, known: Sequence[str]) -> str:
    """The one of the known types that the header prefers. Raises Problem where it takes none of them."""
    found = accepted(accept, known)
    if not found:
        raise Problem("not-acceptable", f"this can be given as {' or '.join(known)}")
    return found


def accepted(accept: str, known: Sequence[str]) -> str:
    """The first of the known types that the client accepts, by its order of q values; '' where it accepts none."""
    best, found = 0.0, ""
    for part in (accept or "*/*").split(","):
        media, *parameters = (word.strip().lower() for word in part.split(";"))
        weight = 1.0
        for parameter in parameters:
            if parameter.startswith("q="):
                with contextlib.suppress(ValueError):
                    weight = float(parameter[2:])
        for one in known:
            if weight > best and media in (one, "*/*", f"{one.partition('/')[0]}/*", one.replace("/x-", "/")):
                best, found = weight, one
                break
    return found
