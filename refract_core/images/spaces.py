"""Colour spaces by the names that USD, MaterialX and OpenColorIO have for them, and the way to linear Rec. 709.

A space is a set of primaries with a white point, and a curve. Primaries are those of the standards: ITU-R BT.709-6,
BT.2020-2, SMPTE EG 432-1 (P3), Adobe RGB (1998), SMPTE ST 2065-1 and S-2014-004 (ACES); logarithms those of S-2014-003
(ACEScc) and S-2016-001 (ACEScct); white points other than D65 are
adapted by Bradford's cone responses, as OpenColorIO's ACES configurations do.
"""

from __future__ import annotations

import re
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..scene import F32, F64
from .srgb import as_floats, srgb_decode

AUTO, RAW, SRGB = "auto", "raw", "sRGB"
"""What a picture's own format says, numbers as they are (linear Rec. 709 too), and sRGB's curve."""
_ENCODED = -1.0
"""The curve of sRGB, in the place of an exponent."""
_CC, _CCT = -2.0, -3.0
"""Likewise those of ACEScc and ACEScct."""
_LOGARITHMS = (_CC, _CCT)

_Pair = tuple[float, float]


class _Gamut(NamedTuple):
    """Chromaticities."""

    red: _Pair
    green: _Pair
    blue: _Pair
    white: _Pair


_D65, _D60 = (0.3127, 0.3290), (0.32168, 0.33767)
_REC709 = _Gamut((0.64, 0.33), (0.30, 0.60), (0.15, 0.06), _D65)
_REC2020 = _Gamut((0.708, 0.292), (0.170, 0.797), (0.131, 0.046), _D65)
_P3 = _Gamut((0.680, 0.320), (0.265, 0.690), (0.150, 0.060), _D65)
_ADOBE = _Gamut((0.64, 0.33), (0.21, 0.71), (0.15, 0.06), _D65)
_AP0 = _Gamut((0.7347, 0.2653), (0.0, 1.0), (0.0001, -0.0770), _D60)
_AP1 = _Gamut((0.713, 0.293), (0.165, 0.830), (0.128, 0.044), _D60)
LINEAR_REC709 = "lin_rec709_scene"
"""The space that the renderer computes in, by the name of the Color Interop Forum."""
CHROMATICITIES_REC709 = (*_REC709.red, *_REC709.green, *_REC709.blue, *_REC709.white)
"""Its primaries and its white, as OpenEXR has them."""
_TOP = (np.log2(65504.0) + 9.72) / 17.52
_XYZ = _Gamut((1.0, 0.0), (0.0, 1.0), (0.0, 0.0), _D65)
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


class _Space(NamedTuple):
    gamut: _Gamut
    exponent: float
    """1: linear; _ENCODED, _CC, _CCT: a curve of its own"""
    others: tuple[str, ...] = ()
    """More names, as `_plain` has them."""


_SPACES: dict[str, _Space] = {
    RAW: _Space(_REC709, 1.0, (
        "linear", "data", "identity", "unknown", "none", "utilityraw", "linrec709", "linrec709scene", "linsrgb",
        "linearrec709", "linearrec709srgb", "linearsrgb", "utilitylinearsrgb", "utilitylinearrec709",
        "scenelinearrec709srgb",
    )),
    SRGB: _Space(_REC709, _ENCODED, (
        "srgbtexture", "srgbrec709", "srgbrec709scene", "srgbencodedrec709srgb", "utilitysrgbtexture",
        "inputgenericsrgbtexture", "srgbencodedrec709srgbtexture", "srgbdisplay", "outputsrgb",
    )),
    "g18_rec709": _Space(_REC709, 1.8, ("g18rec709scene", "gamma18", "gamma18encodedrec709", "gamma18rec709texture")),
    "g22_rec709": _Space(_REC709, 2.2, (
        "g22rec709scene", "gamma22", "gamma22encodedrec709", "gamma22rec709texture", "utilitygamma22rec709texture",
    )),
    "g24_rec709": _Space(_REC709, 2.4, ("g24rec709scene", "gamma24", "gamma24encodedrec709", "rec709display")),
    "lin_ap1": _Space(_AP1, 1.0, ("linap1scene", "acescg", "acesacescg", "linearap1", "linacescg")),
    "srgb_ap1": _Space(_AP1, _ENCODED, ("srgbap1scene", "srgbencodedap1", "srgbencodedap1texture")),
    "g22_ap1": _Space(_AP1, 2.2, ("g22ap1scene", "gamma22encodedap1", "gamma22ap1texture")),
    "acescc": _Space(_AP1, _CC, ("acesacescc", "acesccap1scene")),
    "acescct": _Space(_AP1, _CCT, ("acesacescct", "acescctap1scene")),
    "lin_ap0": _Space(_AP0, 1.0, ("linap0scene", "aces20651", "acesaces20651", "linearap0")),
    "lin_p3d65": _Space(_P3, 1.0, (
        "linp3d65scene", "linearp3d65", "lindisplayp3", "lindisplayp3scene", "utilitylinearp3d65", "lineardisplayp3",
    )),
    "srgb_p3d65": _Space(_P3, _ENCODED, (
        "srgbp3d65scene", "srgbencodedp3d65", "srgbdisplayp3", "displayp3", "srgbdisplayp3scene", "displayp3display",
    )),
    "lin_rec2020": _Space(_REC2020, 1.0, ("linrec2020scene", "linearrec2020", "utilitylinearrec2020")),
    "lin_adobergb": _Space(_ADOBE, 1.0, ("linadobergbscene", "linearadobergb", "utilitylinearadobergb")),
    "g22_adobergb": _Space(_ADOBE, 563.0 / 256.0, (
        "g22adobergbscene", "adobergb", "gamma22encodedadobergb", "utilityadobergb", "adobergbdisplay",
    )),
    "lin_ciexyzd65": _Space(_XYZ, 1.0, ("linciexyzd65scene", "ciexyzd65scenereferred", "ciexyz")),
}  # fmt: skip
NAMES = (AUTO, *_SPACES)
"""Every space, by the name that it has here."""


def _plain(name: str) -> str:
    return re.sub("[^a-z0-9]", "", name.lower())


@cache
def _by_name() -> dict[str, str]:
    return {_plain(one): name for name, space in _SPACES.items() for one in (name, *space.others)}


def canonical(name: str) -> str:
    """One of `NAMES` for what a file calls a space; '' for one that is not known."""
    return AUTO if name in ("", AUTO) else _by_name().get(_plain(name), "")


def told(name: str) -> str:
    """That a space is not known, and which are: the end of a sentence about something."""
    return f"colour space '{name[:60]}' is not known ({', '.join(NAMES)} and their usual names are)"


@cache
def to_rec709(space: str) -> F64:
    """Linear Rec. 709 from the linear light of a space, shape (3, 3).

    Args:
        space: one of `NAMES`, but not auto.
    """
    gamut = _SPACES[space].gamut
    if gamut is _REC709:
        return np.eye(3)
    adapted = _adapted(gamut.white, _D65) @ _to_xyz(gamut)
    return np.asarray(np.linalg.solve(_to_xyz(_REC709), adapted), np.float64)


def _xyz(at: _Pair) -> F64:
    """Tristimulus values of a chromaticity, at a luminance of 1."""
    x, y = at
    return np.array([x / y, 1.0, (1.0 - x - y) / y])


def _to_xyz(gamut: _Gamut) -> F64:
    """CIE XYZ from linear light: the primaries in the amounts that make white (SMPTE RP 177). Of CIE XYZ itself none
    are weighed: its numbers are what they are."""
    if gamut is _XYZ:
        return np.eye(3)
    primaries = np.array([(x, y, 1.0 - x - y) for x, y in gamut[:3]]).T
    return np.asarray(primaries * np.linalg.solve(primaries, _xyz(gamut.white)), np.float64)


def _adapted(white: _Pair, to: _Pair) -> F64:
    """Bradford's chromatic adaptation in CIE XYZ."""
    if white == to:
        return np.eye(3)
    before, after = _BRADFORD @ _xyz(white), _BRADFORD @ _xyz(to)
    return np.asarray(np.linalg.solve(_BRADFORD, (after / before)[:, None] * _BRADFORD), np.float64)


def decoded(values: F32, space: str) -> F32:
    """The curve of a space taken off: linear light in its own primaries.

    Args:
        values: any shape, float32.
        space: one of `NAMES`, but not auto.
    """
    exponent = _SPACES[space].exponent
    if exponent == 1.0:
        return values
    if exponent == _ENCODED:
        return srgb_decode(values)
    if exponent in _LOGARITHMS:
        return _power(values, toe=exponent == _CCT)
    return (np.sign(values) * np.abs(values) ** exponent).astype(np.float32)


def _power(values: F32, *, toe: bool) -> F32:
    """ACEScc taken off, or with its straight toe ACEScct: S-2014-003 and S-2016-001, 4.4.2 each. Never over what half
    numbers hold."""
    code = values.astype(np.float64)
    light = np.exp2(np.minimum(code, _TOP) * 17.52 - 9.72)
    if toe:
        dark, low = code <= 0.155251141552511, (code - 0.0729055341958355) / 10.5402377416545
    else:
        dark, low = code <= (9.72 - 15.0) / 17.52, (light - 2.0**-16) * 2.0
    return np.where(dark, low, light).astype(np.float32)


def _keeps_curve(space: str) -> bool:
    """Half and float files in it carry its curve, too: nobody calls linear light a logarithm."""
    return _SPACES[space].exponent in _LOGARITHMS


def is_rec709(space: str) -> bool:
    """Its primaries are those that the renderer computes in."""
    return _SPACES[space].gamut is _REC709


def linear(values: tuple[float, ...], space: str) -> tuple[float, ...]:
    """A colour in linear Rec. 709; what comes after three numbers stays.

    Args:
        space: one of `NAMES`; auto is linear Rec. 709 itself, as values without a space are.
    """
    if space in (AUTO, RAW):
        return values
    rgb = to_rec709(space) @ decoded(np.asarray(values[:3], np.float32), space).astype(np.float64)
    return (*map(float, rgb), *values[3:])


def picture(pixels: NDArray[np.uint8] | F32, space: str, *, encoded: bool) -> F32:
    """A picture in linear Rec. 709; alpha stays.

    Args:
        pixels: shape (H, W, 4); bytes are taken to 0 .. 1.
        space: one of `NAMES`, but not auto.
        encoded: its numbers carry the curve of the space, which those of half and float files do not, but for
            logarithms.
    """
    out = as_floats(pixels)
    matrix = to_rec709(space).T.astype(np.float32)
    for row in out:  # row by row: of the whole picture, each step would be one more copy
        rgb = decoded(row[:, :3], space) if encoded or _keeps_curve(space) else row[:, :3]
        row[:, :3] = rgb if is_rec709(space) else rgb @ matrix
    return out
