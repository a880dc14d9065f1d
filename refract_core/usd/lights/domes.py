"""Dome lights, summed into one latlong environment.

Latlong orientation is that of OpenEXR (UsdLuxDomeLight): longitude 0 is the image centre and looks along +Z of the
dome, longitude +pi/2 is +X, and the left edge is longitude +pi. That is `scene.Environment`'s own convention, so a
single dome's pixels are kept as they are.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdGeom, UsdLux

from ...errors import ImageError
from ...scene import F32, F64, Environment, Notice, Texture
from ..materials.textures import light_texture, resolve_asset
from .formats import FORMS, as_latlong, format_of

_FORMATS = ("automatic", "latlong", *FORMS)
_ROWS_AT_ONCE = 64


@dataclass(frozen=True)
class Dome:
    """One dome light, ready to be summed."""

    radiance: F32
    """shape (3,): factor on the pixels, or the radiance itself where there are none"""
    pixels: F32 | None
    """shape (H, W, 3) linear"""
    world_from_dome: F64
    """shape (3, 3), orthogonal"""
    hidden: bool = False
    """Not to be seen by the camera"""


def read_dome(
    light: UsdLux.LightAPI,
    time: Usd.TimeCode,
    *,
    radiance: tuple[float, float, float],
    world_from_light: F64,
    notices: list[Notice],
) -> Dome:
    """Read DomeLight or DomeLight_1. One whose texture cannot be read keeps its colour, and a notice says so.

    Args:
        light: The light.
        time: Time code of the frame.
        radiance: Color times intensity, before the texture.
        world_from_light: shape (4, 4), light space to engine world, any scale.
        notices: What was ignored or replaced is added here.
    """
    prim = light.GetPrim()
    path = str(prim.GetPath())
    texture_format = str(prim.GetAttribute("inputs:texture:format").Get(time) or "automatic")
    asset = prim.GetAttribute("inputs:texture:file")
    file = resolve_asset(asset, time) if asset else ""
    pixels = None
    if file:
        if texture_format not in _FORMATS:
            notices.append(Notice(path, f"inputs:texture:format '{texture_format}' is none of {', '.join(_FORMATS)}; "
                                        "automatic is used"))  # fmt: skip
            texture_format = "automatic"
        try:
            pixels = linear(light_texture(asset, file))
        except ImageError as error:
            text = "the light has its own colour everywhere, as a dome without a texture"
            notices.append(Notice(path, f"dome texture cannot be read: {error}; {text}"))
    if pixels is not None:
        pixels = finite(pixels, path, notices, "dome texture")
        form = format_of(pixels, texture_format)
        if texture_format == "automatic" and form != "latlong":
            height, width = pixels.shape[:2]
            text = f"a dome texture of {width} x {height} is read as {form}; author inputs:texture:format if it is not"
            notices.append(Notice(path, text))
        pixels = as_latlong(pixels, form)
    turned = rotation(world_from_light[:3, :3]) @ _pole(prim, notices)
    return Dome(np.asarray(radiance, np.float32), pixels, turned)


def linear(texture: Texture) -> F32:
    """RGB of a texture as linear float32, shape (H, W, 3); sRGB is decoded by IEC 61966-2-1."""
    if texture.pixels.dtype != np.uint8:
        return np.ascontiguousarray(texture.pixels[..., :3], np.float32)
    levels = np.arange(256, dtype=np.float64) / 255.0
    if texture.srgb:
        levels = np.where(levels <= 0.04045, levels / 12.92, ((levels + 0.055) / 1.055) ** 2.4)
    return levels.astype(np.float32)[texture.pixels[..., :3]]


def rotation(matrix: F64) -> F64:
    """The orthogonal matrix nearest to a 3x3: its scale and shear removed, a mirroring kept."""
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ vt, np.float64)


def sum_domes(domes: list[Dome]) -> Environment | None:
    """All domes as one map, in the frame of the first with a texture, at the largest resolution.

    Domes turned otherwise are sampled bilinearly at every pixel's direction. They are hidden where all of them are.
    """
    if not domes:
        return None
    textured = [dome for dome in domes if dome.pixels is not None]
    frame = (textured or domes)[0].world_from_dome
    height = max((dome.pixels.shape[0] for dome in textured if dome.pixels is not None), default=2)
    width = max((dome.pixels.shape[1] for dome in textured if dome.pixels is not None), default=4)
    total = np.zeros((height, width, 3), np.float32)
    for dome in domes:
        if dome.pixels is None:
            total += dome.radiance
        elif dome.pixels.shape == total.shape and np.allclose(dome.world_from_dome, frame, atol=1e-9):
            total += dome.pixels * dome.radiance
        else:
            _add_turned(total, dome.pixels, dome.world_from_dome.T @ frame, dome.radiance)
    return Environment(total, np.ascontiguousarray(frame.T), hidden=all(dome.hidden for dome in domes))


def directions(rows: slice, height: int, width: int) -> F64:
    """Unit directions of pixel centres in the dome's frame, shape (rows, W, 3)."""
    colatitude = (np.arange(height)[rows, None] + 0.5) / height * math.pi
    longitude = (0.5 - (np.arange(width)[None, :] + 0.5) / width) * 2.0 * math.pi
    sine = np.sin(colatitude)
    return np.stack(
        [sine * np.sin(longitude), np.broadcast_to(np.cos(colatitude), (*sine.shape[:1], width)),
         sine * np.cos(longitude)], axis=-1,
    )  # fmt: skip


def lookup(pixels: F32, direction: F64) -> F32:
    """Bilinear latlong lookup, wrapping in longitude and clamped at the poles; shapes (H, W, 3), (..., 3)."""
    height, width = pixels.shape[:2]
    x = (0.5 - np.arctan2(direction[..., 0], direction[..., 2]) / (2.0 * math.pi)) * width - 0.5
    y = np.arccos(np.clip(direction[..., 1], -1.0, 1.0)) / math.pi * height - 0.5
    x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = (x - x0).astype(np.float32)[..., None], (y - y0).astype(np.float32)[..., None]
    left, right = x0 % width, (x0 + 1) % width
    top, bottom = np.clip(y0, 0, height - 1), np.clip(y0 + 1, 0, height - 1)
    upper = pixels[top, left] * (1.0 - fx) + pixels[top, right] * fx
    lower = pixels[bottom, left] * (1.0 - fx) + pixels[bottom, right] * fx
    return np.asarray(upper * (1.0 - fy) + lower * fy, np.float32)


def _add_turned(total: F32, pixels: F32, source_from_target: F64, radiance: F32) -> None:
    height, width = total.shape[:2]
    for start in range(0, height, _ROWS_AT_ONCE):
        rows = slice(start, min(start + _ROWS_AT_ONCE, height))
        turned = directions(rows, height, width) @ source_from_target.T
        total[rows] += lookup(pixels, turned) * radiance


def _pole(prim: Usd.Prim, notices: list[Notice]) -> F64:
    """light_from_dome, shape (3, 3): DomeLight is Y-up whatever the stage; DomeLight_1 asks its poleAxis.

    Under a Z pole the dome's +Y becomes +Z and its +Z becomes -Y (UsdLuxDomeLight_1).
    """
    if prim.GetTypeName() != "DomeLight_1":
        return np.eye(3)
    axis = str(prim.GetAttribute("poleAxis").Get() or "scene")
    if axis not in ("scene", "Y", "Z"):
        notices.append(Notice(str(prim.GetPath()), f"poleAxis is '{axis}'; it must be scene, Y or Z; scene is used"))
        axis = "scene"
    if axis == "scene":
        axis = str(UsdGeom.GetStageUpAxis(prim.GetStage()))
    if axis == "Y":
        return np.eye(3)
    return np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def finite(pixels: F32, path: str, notices: list[Notice], what: str) -> F32:
    """NaN becomes black and infinity the largest finite value of the map."""
    bad = ~np.isfinite(pixels)
    if not bad.any():
        return pixels
    count = int(bad.any(axis=-1).sum())
    notices.append(Notice(path, f"{what} has {count} pixel(s) that are NaN or infinite; they are replaced"))
    largest = float(pixels[~bad].max(initial=0.0))
    return np.nan_to_num(pixels, nan=0.0, posinf=largest, neginf=0.0)
