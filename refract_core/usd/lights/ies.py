"""Measured light distributions: ANSI/IES LM-63 files (1986 to 2002), type C photometry.

Vertical angles count from straight down, which is where a UsdLux light looks (-Z); horizontal ones turn from +X by +Y.
"""

from __future__ import annotations

import math
import re
from typing import NamedTuple

import numpy as np

from ...scene import F32, F64

ROWS, COLUMNS = 721, 145
"""Angles of a `profile`: every quarter of a degree from -Z to +Z, every 2.5 degrees around."""
_MOST_ANGLES = 100_000


class Ies(NamedTuple):
    """What a file says."""

    vertical: F64
    """shape (V,), rising [degrees]"""
    horizontal: F64
    """shape (H,), rising [degrees]; 0 .. 360, or one alone"""
    candela: F64
    """shape (V, H), >= 0"""


def parse(text: str) -> Ies:
    """Read an LM-63 file, and unfold the symmetry that its horizontal angles stand for.

    Raises:
        ValueError: it is no such file, or of another photometry than type C; one sentence says why.
    """
    head = re.search(r"^[ \t]*TILT[ \t]*=[ \t]*(\S*).*$", text, re.MULTILINE)
    if head is None:
        raise ValueError("it has no line TILT=, so it is no IES file")
    words = iter(text[head.end() :].replace(",", " ").split())

    def number() -> float:
        try:
            value = float(next(words))
        except StopIteration:
            raise ValueError("it ends too soon") from None
        if not math.isfinite(value):
            raise ValueError("it holds a number that is not finite")
        return value

    def count(what: str) -> int:
        value = number()
        if value != int(value) or not 1 <= value <= _MOST_ANGLES:
            raise ValueError(f"it says that it has {value:g} {what}")
        return int(value)

    if head[1].upper() == "INCLUDE":  # how bright lamps are that hang askew: a light is as its transform says
        number()
        for _ in range(2 * count("tilt angles")):
            number()
    number(), number()  # lamps, lumens of each
    factor = number()
    rows, columns = count("vertical angles"), count("horizontal angles")
    if (kind := number()) != 1:
        raise ValueError(f"its photometry is of type {'?CBA'[int(kind)] if kind in (2, 3) else kind}, not C")
    for _ in range(4):  # units and sizes of the luminous opening
        number()
    factor *= number()  # ballast
    factor *= number()  # ballast and lamp together; later editions keep it for the future, as 1
    number()  # watts
    if rows * columns > _MOST_ANGLES * 10:
        raise ValueError(f"it says that it has {rows} times {columns} angles")
    vertical = np.array([number() for _ in range(rows)])
    horizontal = np.array([number() for _ in range(columns)])
    candela = np.array([number() for _ in range(rows * columns)]).reshape(columns, rows).T * factor
    if (np.diff(vertical) <= 0.0).any() or (np.diff(horizontal) <= 0.0).any():
        raise ValueError("its angles do not rise")
    if (candela < 0.0).any():
        raise ValueError("it holds intensities below 0")
    return Ies(vertical, *_unfolded(horizontal, candela))


def _unfolded(horizontal: F64, candela: F64) -> tuple[F64, F64]:
    """All around: one plane stands for all, a quarter for all four, and a half for the other one."""
    if len(horizontal) == 1:
        return horizontal, candela
    first, last = float(horizontal[0]), float(horizontal[-1])
    if (first, last) == (0.0, 90.0):
        horizontal, candela = _mirrored(horizontal, candela, 90.0)
        last = 180.0
    if (first, last) == (0.0, 180.0):
        return _mirrored(horizontal, candela, 180.0)
    if (first, last) == (90.0, 270.0):
        around, values = _mirrored(horizontal, candela, 270.0)  # 90 .. 450
        turned = np.append(around[:-1] % 360.0, 360.0)
        order = np.argsort(turned[:-1])
        return np.append(turned[order], 360.0), values[:, np.append(order, order[0])]
    if first == 0.0 and last < 360.0:  # the last plane is the first one, and left out
        return np.append(horizontal, 360.0), np.concatenate([candela, candela[:, :1]], axis=1)
    if (first, last) != (0.0, 360.0):
        raise ValueError(f"its horizontal angles go from {first:g} to {last:g} degrees, which is no symmetry of LM-63")
    return horizontal, candela


def _mirrored(horizontal: F64, candela: F64, about: float) -> tuple[F64, F64]:
    """The same again, mirrored at the plane of the last angle."""
    back = 2.0 * about - horizontal[-2::-1]
    return np.append(horizontal, back), np.concatenate([candela, candela[:, -2::-1]], axis=1)


def profile(ies: Ies, angle_scale: float, normalize: bool) -> F32:
    """`scene.Shaping.profile` by UsdLux: intensities by direction in candela, or over their mean with `normalize`.

    The mean is over the sphere, or the half of it where the file has no more (which is what renderers agree on; the
    schema's text leaves it open). Where the file says nothing, no light leaves.
    """
    off = np.linspace(0.0, 180.0, ROWS)
    around = np.linspace(0.0, 360.0, COLUMNS) if len(ies.horizontal) > 1 else ies.horizontal
    values = _sampled(ies, _scaled(off, angle_scale), around)
    if normalize:
        whole = ies.vertical[-1] - ies.vertical[0] > 90.0 + math.degrees(0.1)
        mean = _power(_sampled(ies, off, around)) / (4.0 * math.pi if whole else 2.0 * math.pi)
        values = values / mean if mean > 0.0 else values
    return np.asarray(values, np.float32)


def _scaled(off: F64, angle_scale: float) -> F64:
    """UsdLuxShapingAPI, inputs:shaping:ies:angleScale [degrees]."""
    if angle_scale > 0.0:
        return off / angle_scale
    return (off - 180.0) / -angle_scale + 180.0 if angle_scale < 0.0 else off


def _sampled(ies: Ies, off: F64, around: F64) -> F64:
    """Linear between the file's angles, shape (off, around); nothing outside of its vertical ones."""
    rows = np.array([np.interp(off, ies.vertical, column, left=0.0, right=0.0) for column in ies.candela.T]).T
    if len(ies.horizontal) == 1:
        return rows
    return np.array([np.interp(around, ies.horizontal, row) for row in rows])


def _power(values: F64) -> float:
    """Integral over the sphere of what is linear between rows and columns [lm]."""
    edges = np.radians(np.linspace(0.0, 180.0, len(values)))
    bands = np.cos(edges[:-1]) - np.cos(edges[1:])
    around = values[:, 0] if values.shape[1] == 1 else 0.5 * (values[:, :-1] + values[:, 1:]).mean(axis=1)
    return float((0.5 * (around[:-1] + around[1:]) * bands).sum() * 2.0 * math.pi)
