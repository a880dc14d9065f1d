"""Planes as pictures for the eye: data in false colours with a bar that says what they mean."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import UsageError
from ..scene import F32
from .aovs import AOVS, check_names
from .pictures import display

if TYPE_CHECKING:
    from PIL.Image import Image

_STOPS = np.array(
    [[68, 1, 84], [72, 40, 120], [62, 74, 137], [49, 104, 142], [38, 130, 142], [31, 158, 137], [53, 183, 121],
     [109, 205, 89], [180, 222, 44], [253, 231, 37]], np.float64,
)  # fmt: skip
"""The colour map viridis (van der Walt and Smith 2015) at ten places: lightness grows evenly, for all kinds of eyes."""
_NOTHING = (96, 96, 96)
"""Where there is no number, or no glass to have one."""
_BAR, _MARGIN = 14, 8  # [pixels]


def false_colour(values: F32, low: float, high: float) -> NDArray[np.uint8]:
    """Numbers as colours: `low` and less is dark, `high` and more is light.

    Args:
        values: shape (H, W); what is no finite number is grey.

    Returns:
        shape (H, W, 3).
    """
    finite = np.isfinite(values)
    at = np.clip((np.where(finite, values, low) - low) / max(high - low, 1e-30), 0.0, 1.0)
    places = np.linspace(0.0, 1.0, len(_STOPS))
    colours = np.stack([np.interp(at, places, _STOPS[:, c]) for c in range(3)], axis=-1)
    return np.where(finite[..., None], np.round(colours), _NOTHING).astype(np.uint8)


def show(
    name: str, plane: F32, low: float | None = None, high: float | None = None, where: NDArray[np.bool_] | None = None
) -> Image:
    """A plane as a picture to look at; a number a pixel has a bar beneath it that says what the colours mean.

    Args:
        low, high: what the ends of the bar mean; None is the least and the most there is. For numbers alone.
        where: pixels that count; the others are grey. None is all.

    Raises:
        UsageError: an AOV that is not known, ends that are no range, or ends of what has no bar.
    """
    from PIL import Image

    check_names((name,))
    if not AOVS[name].scalar:
        if low is not None or high is not None:
            raise UsageError(f"show: '{name}' is no single number, so low and high mean nothing; leave them out")
        return Image.fromarray(_positions(plane) if name == "P" else display(name, plane))
    values = plane if where is None else np.where(where, plane, np.float32(np.nan))
    finite = values[np.isfinite(values)]
    least = float(finite.min() if finite.size else 0.0) if low is None else low
    most = float(finite.max() if finite.size else 1.0) if high is None else high
    if not (np.isfinite([least, most]).all() and least <= most):
        raise UsageError(f"show: {least:g} to {most:g} is no range; low must be a number at most high")
    return _with_bar(Image.fromarray(false_colour(values, least, most)), name, least, most)


def _positions(plane: F32) -> NDArray[np.uint8]:
    """Places within the box of all of them; black is nowhere."""
    there = np.asarray(np.isfinite(plane).all(axis=2) & plane.any(axis=2))
    if not there.any():
        return np.zeros(plane.shape, np.uint8)
    low, high = plane[there].min(axis=0), plane[there].max(axis=0)
    share = (np.where(there[..., None], plane, low) - low) / np.maximum(high - low, 1e-30)
    return (share * there[..., None] * 255.0 + 0.5).astype(np.uint8)


def _with_bar(picture: Image, name: str, low: float, high: float) -> Image:
    from PIL import Image, ImageDraw

    width, height = max(picture.width, 160), picture.height
    sheet = Image.new("RGB", (width, height + 2 * _MARGIN + 2 * _BAR), "white")
    sheet.paste(picture, ((width - picture.width) // 2, 0))
    bar = np.linspace(0.0, 1.0, width - 2 * _MARGIN, dtype=np.float32)[None].repeat(_BAR, 0)
    sheet.paste(Image.fromarray(false_colour(bar, 0.0, 1.0)), (_MARGIN, height + _MARGIN))
    draw: Any = ImageDraw.Draw(sheet)
    line = height + _MARGIN + _BAR + 2
    for place, anchor, text in ((_MARGIN, "la", f"{low:.4g}"), (width // 2, "ma", name),
                                (width - _MARGIN, "ra", f"{high:.4g}")):  # fmt: skip
        draw.text((place, line), text, fill="black", anchor=anchor)
    return sheet
