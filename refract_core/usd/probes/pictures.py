"""The picture that a probe brings along: its cubemap file, and the note of what that was baked from."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from ...errors import ImageError
from ...scene import Bake, Cubemap
from ..materials.textures import file_of, resolve_asset
from .values import ProbePrim

BAKE_KEY = "refractBake"
"""Dictionary in a probe's customData: digest, engine and timeCode are read; stage and samples are for people."""

ReadCubemap = Callable[[str, int], Cubemap]


def read_cubemap(path: str, resolution: int) -> Cubemap:
    """Read one file as a cubemap.

    Args:
        path: a file, or a file inside a package such as `a.usdz[tex/x.exr]`
        resolution: of its faces [pixels], whatever the file has

    Raises:
        ImageError: the file is absent, or is no picture that makes a cubemap.
    """
    from ...images.cubemaps import read_cubemap as decode

    return decode(file_of(path), path, resolution)


def picture_of(probe: ProbePrim, mode: str, resolution: int, read: ReadCubemap) -> tuple[Cubemap | None, Bake | None]:
    """The cubemap of a baked or custom probe, and what it was baked from; None means capture."""
    path = _texture_path(probe)
    if mode == "realtime":
        return None, None
    if not path:
        if mode == "custom":
            probe.say("probe:mode is 'custom' but probe:texture is not set; the surroundings are captured instead")
        return None, None
    try:
        cubemap = read(path, resolution)
    except ImageError as error:
        probe.say(f"probe:texture cannot be read; the surroundings are captured instead. {error}")
        return None, None
    return cubemap, _bake_of(probe) if mode == "baked" else None


def refuse_picture(probe: ProbePrim, mode: str) -> None:
    """Tell the author of a planar probe that it has no use for a picture."""
    given = ["probe:mode 'custom'"] * (mode == "custom") + ["probe:texture"] * bool(_texture_path(probe))
    if given:
        verb, them = ("are", "them") if len(given) > 1 else ("is", "it")
        probe.say(f"a planar probe is drawn for every picture; {' and '.join(given)} {verb} ignored. Remove {them}")


def _texture_path(probe: ProbePrim) -> str:
    return resolve_asset(probe.prim.GetAttribute("probe:texture"), probe.time)


def _bake_of(probe: ProbePrim) -> Bake | None:
    record = probe.prim.GetCustomDataByKey(BAKE_KEY)
    if record is None:
        return None
    wrong = _what_is_wrong(record)
    if wrong:
        probe.say(f"customData {BAKE_KEY} {wrong}; whether its texture is up to date is not known. Bake it again")
        return None
    return Bake(record["digest"], record["engine"], float(record["timeCode"]))


def _what_is_wrong(record: Any) -> str:
    """'' where the record can be used."""
    if not isinstance(record, dict):
        return "is not a dictionary"
    for name in ("digest", "engine"):
        if not isinstance(record.get(name), str) or not record[name]:
            return f"has no {name}, which must be a text"
    time = record.get("timeCode")
    if isinstance(time, bool) or not isinstance(time, int | float) or not math.isfinite(time):
        return "has no timeCode, which must be a finite number"
    return ""
