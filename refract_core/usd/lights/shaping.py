"""What UsdLux authors beside a light's emission: ShapingAPI, the texture of a RectLight, ShadowAPI, and links."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pxr import Usd, UsdLux

from ...errors import ImageError
from ...scene import F32, LightKind, Shadow, Shaping
from ..materials.textures import file_of, light_texture, resolve_asset
from .context import Context, note, number, value
from .domes import finite, linear
from .ies import parse, profile

_MOST_SIDE = 1024
"""Pixels along the longer side of a light's texture that are kept."""


def read_shaping(context: Context, prim: Usd.Prim, kind: LightKind, mirrored: bool) -> Shaping:
    """How a light's radiance hangs on direction and place.

    Args:
        context: The frame.
        prim: The light.
        kind: What is flat shines to one side by itself; a sun shines all alike (which UsdLux leaves open).
        mirrored: Its +X is -X of `scene.Light`'s frame.
    """
    if kind is LightKind.DISTANT:
        return Shaping()
    flat = kind in (LightKind.RECT, LightKind.DISK)
    degrees = number(context, prim, "inputs:shaping:cone:angle", 180.0)
    tint = np.clip(np.array(value(context, prim, "inputs:shaping:focusTint", (0.0, 0.0, 0.0)), np.float64), 0.0, 1.0)
    r, g, b = (float(c) if math.isfinite(c) else 0.0 for c in tint)
    measured, picture = _profile(context, prim), _picture(context, prim) if kind is LightKind.RECT else None
    if mirrored:
        measured = None if measured is None else _turned(measured)
        picture = None if picture is None else picture[:, ::-1]
    return Shaping(
        focus=_least(context, prim, "inputs:shaping:focus"),
        focus_tint=(r, g, b),
        cone=math.pi if degrees >= (90.0 if flat else 180.0) else math.radians(degrees),
        softness=min(_least(context, prim, "inputs:shaping:cone:softness"), 1.0),
        profile=measured,
        picture=picture,
    )


def _least(context: Context, prim: Usd.Prim, name: str) -> float:
    """A number; UsdLux says that below 0 it counts as 0."""
    given = float(value(context, prim, name, 0.0))
    return max(given, 0.0) if math.isfinite(given) else number(context, prim, name, 0.0)


def _profile(context: Context, prim: Usd.Prim) -> F32 | None:
    asset = prim.GetAttribute("inputs:shaping:ies:file")
    file = resolve_asset(asset, context.time) if asset else ""
    if not file:
        return None
    scale = float(value(context, prim, "inputs:shaping:ies:angleScale", 0.0))
    try:
        found = file_of(file)
        data = found if isinstance(found, bytes) else Path(found).read_bytes()
        ies = parse(data.decode("latin-1"))
    except (ImageError, ValueError, OSError) as error:
        note(context, prim, f"inputs:shaping:ies:file cannot be read: {error}; the light shines without it")
        return None
    normalize = bool(value(context, prim, "inputs:shaping:ies:normalize", False))
    return profile(ies, scale if math.isfinite(scale) else 0.0, normalize)


def _turned(measured: F32) -> F32:
    """For an X that points the other way: what was at an angle is at its rest to half a turn."""
    columns = measured.shape[1] - 1
    return measured if columns == 0 else measured[:, (columns // 2 - np.arange(columns + 1)) % columns]


def _picture(context: Context, prim: Usd.Prim) -> F32 | None:
    """The texture, of which the first pixel is at +X and +Y (UsdLuxRectLight)."""
    asset = prim.GetAttribute("inputs:texture:file")
    file = resolve_asset(asset, context.time) if asset else ""
    if not file:
        return None
    try:
        pixels = linear(light_texture(asset, file))
    except ImageError as error:
        note(context, prim, f"light texture cannot be read: {error}; the light shines without it")
        return None
    pixels = finite(pixels, str(prim.GetPath()), context.notices, "light texture")
    step = -(-max(pixels.shape[:2]) // _MOST_SIDE)
    if step == 1:
        return pixels
    height, width = (max(side // step, 1) for side in pixels.shape[:2])
    blocks = pixels[: height * step, : width * step].reshape(height, min(step, pixels.shape[0]), width, -1, 3)
    return np.asarray(blocks.mean(axis=(1, 3)), np.float32)


def read_shadow(context: Context, prim: Usd.Prim) -> tuple[bool, Shadow]:
    """Whether the light casts shadows, and how."""
    if not value(context, prim, "inputs:shadow:enable", True):
        return False, Shadow()
    color = np.array(value(context, prim, "inputs:shadow:color", (0.0, 0.0, 0.0)), np.float64)
    if not np.isfinite(color).all() or (color < 0.0).any():
        note(context, prim, f"inputs:shadow:color is {tuple(color.tolist())}; shadows are black; author at least 0")
        color = np.zeros(3)
    unit = context.metres_per_unit
    distance = float(value(context, prim, "inputs:shadow:distance", -1.0)) * unit
    distance = distance if distance >= 0.0 else math.inf  # -1, and NaN
    falloff = float(value(context, prim, "inputs:shadow:falloff", -1.0)) * unit
    gamma = float(value(context, prim, "inputs:shadow:falloffGamma", 1.0))
    if not (math.isfinite(gamma) and gamma > 0.0):
        note(context, prim, f"inputs:shadow:falloffGamma is {gamma}; it must be above 0; 1 is used")
        gamma = 1.0
    r, g, b = (float(c) for c in color)
    fades = distance < math.inf and falloff > 0.0
    return True, Shadow((r, g, b), distance, min(falloff, distance) if fades else 0.0, gamma)


def read_link(context: Context, prim: Usd.Prim, name: str, drawn: Sequence[str]) -> tuple[str, ...] | None:
    """Those paths of `drawn` that the collection `lightLink` or `shadowLink` of a light holds; None for all of them."""
    if not is_linked(prim, name):
        return None
    light = UsdLux.LightAPI(prim)
    collection = light.GetLightLinkCollectionAPI() if name == "lightLink" else light.GetShadowLinkCollectionAPI()
    query = collection.ComputeMembershipQuery()
    held = tuple(path for path in drawn if query.IsPathIncluded(path))
    return None if len(held) == len(drawn) else held


def is_linked(prim: Usd.Prim, name: str) -> bool:
    """Somebody says something about what a light's collection holds."""
    ends = ("includeRoot", "includes", "excludes", "membershipExpression")
    return any((p := prim.GetProperty(f"collection:{name}:{end}")) and p.IsAuthored() for end in ends)
