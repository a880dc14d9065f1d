"""Pictures for compositing: planes of a frame as the parts of an OpenEXR file, and what its head says of them.

Each AOV is a part of its own, named after it, unless somebody wants a single part: a reader that wants one plane reads
that one, colours may be compressed with loss while depth is not, and each part has one type of number, so that nothing
is converted on its way into the file. The first part is the picture: readers that know of one part see that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import UsageError
from ..scene import F32
from .aovs import AOVS, channels_of
from .codec import HALF_MAX, exr_spec
from .cryptomatte import Matte
from .spaces import CHROMATICITIES_REC709, LINEAR_REC709

COMPRESSIONS = ("zip", "zips", "dwaa", "piz", "none")
PARTS = ("many", "one")
FULL = ("Z", "P")
"""Data that half floats would move: a depth of 100 by 0.05. Of the rest they have three digits, which is enough."""
_LOSSLESS = "zips"
_DWA_LEVEL = 45.0
"""OpenEXR's own default: no difference is seen"""

Attribute = str | float | tuple[float, ...]


class Layout(NamedTuple):
    """How an .exr file is written."""

    compression: str = "zip"
    """zip (16 lines at once) and zips (line by line, what compositing reads fastest) lose nothing, nor do piz (small
    where there is grain) and none; dwaa does, of colours alone: what is no colour is zips then"""
    parts: str = "many"
    """`many`: one for each AOV; `one`: all channels in one part, for readers that know nothing else"""


USUAL = Layout()
"""What is written where nobody says."""


def check_layout(layout: Layout, planes: Sequence[str], mattes: bool) -> None:
    """Refuse, before any work, what no file can be.

    Raises:
        UsageError: a compression or a way of parts is not known, or data would be compressed with loss.
    """
    if layout.compression not in COMPRESSIONS:
        raise UsageError(f"EXR compression is '{layout.compression}', not known; choose from {', '.join(COMPRESSIONS)}")
    if layout.parts not in PARTS:
        raise UsageError(f"EXR parts is '{layout.parts}', which is not known; choose from {', '.join(PARTS)}")
    data = [name for name in planes if not AOVS[name].color] + ["Cryptomatte"] * mattes
    if layout.compression == "dwaa" and layout.parts == "one" and data:
        text = f"dwaa in one part would change {data[0]}, which is no colour"
        raise UsageError(f"{text}; choose zips, parts 'many', or AOVs that are colours")


class Part(NamedTuple):
    """One part of a file, ready to be written."""

    pixels: NDArray[Any]
    """shape (H, W, C), as the file has them"""
    spec: Any
    """OpenImageIO's description"""


class _Group(NamedTuple):
    """Channels that belong together."""

    name: str
    channels: tuple[str, ...]
    values: F32
    """shape (H, W, C)"""
    color: bool
    half: bool
    attributes: Mapping[str, Attribute]


def parts_of(
    planes: Mapping[str, F32],
    mattes: Sequence[Matte],
    attributes: Mapping[str, Attribute],
    titles: Mapping[str, str],
    layout: Layout,
) -> list[Part]:
    """The parts of a file.

    Args:
        planes: AOV name -> float32, shapes as `aovs.shape_of`; at least one, or a matte.
        attributes: of the picture. Sixteen numbers are a matrix for row vectors, row by row, as OpenEXR has them.
        titles: AOV -> what its channels are called, where that is another name.

    Raises:
        UsageError: see `check_layout`.
    """
    check_layout(layout, tuple(planes), bool(mattes))
    groups = [_plane(name, plane, titles.get(name, name)) for name, plane in planes.items()]
    groups += [_Group(m.name, m.channels, m.ranks, False, False, m.attributes) for m in mattes]
    groups.sort(key=lambda group: group.channels[0] != "R")  # viewers show the first part
    # Programs look for what describes the mattes in the head of the file, which is the first part's.
    described = {key: value for m in mattes for key, value in m.attributes.items()}
    if layout.parts == "one" or len(groups) == 1:
        return [_one(groups, {**attributes, **described}, layout.compression)]
    parts = []
    for k, group in enumerate(groups):
        compression = layout.compression if group.color or layout.compression != "dwaa" else _LOSSLESS
        part = _one([group], {**attributes, **(group.attributes if k else described)}, compression)
        part.spec.attribute("oiio:subimagename", group.name)
        parts.append(part)
    return parts


def _plane(name: str, plane: F32, title: str) -> _Group:
    aov = AOVS[name]
    values = plane.reshape(*plane.shape[:2], len(aov.channels))
    half = name not in FULL and (aov.color or _fits_half(values))
    return _Group(title, channels_of(name, title), values, aov.color, half, {})


def _fits_half(values: F32) -> bool:
    """No number is beyond what half floats reach: a length in millimetres may be."""
    return not values.size or float(max(values.max(), -values.min())) <= HALF_MAX


def _one(groups: Sequence[_Group], attributes: Mapping[str, Attribute], compression: str) -> Part:
    """Groups of channels side by side in one part."""
    channels = [channel for group in groups for channel in group.channels]
    formats = ["half" if group.half else "float" for group in groups for _ in group.channels]
    height, width = groups[0].values.shape[:2]
    planes = [_within_half(group.values) if group.half and group.color else group.values for group in groups]
    pixels = planes[0] if len(planes) == 1 else np.concatenate(planes, axis=-1)  # the writer makes halves of them
    spec = exr_spec(width, height, channels, formats, {}, compression)
    for key, value in attributes.items():
        _describe(spec, key, value)
    _describe(spec, "chromaticities", CHROMATICITIES_REC709)
    spec.attribute("colorInteropID", LINEAR_REC709 if any(group.color for group in groups) else "data")
    return Part(pixels, spec)


def _within_half(values: F32) -> F32:
    """A colour beyond the largest half would become infinity, which no viewer averages well."""
    return np.clip(values, -HALF_MAX, HALF_MAX)


def _describe(spec: Any, key: str, value: Attribute) -> None:
    import OpenImageIO as oiio

    if not isinstance(value, tuple):
        spec.attribute(key, value)
    elif len(value) == 16:
        spec.attribute(key, oiio.TypeMatrix, value)
    else:
        spec.attribute(key, oiio.TypeDesc(f"float[{len(value)}]"), value)
