"""Render settings that a stage carries: UsdRenderSettings and RefractSettingsAPI to fields of `RenderSettings`."""

from __future__ import annotations

from typing import Any

from pxr import Sdf, Usd, UsdRender

from ..errors import StageError, UsageError
from ..scene import Notice
from ..settings import RenderSettings

FLAG = "--render-settings-prim-path"

# Standard attributes that change a picture elsewhere and nothing here.
_IGNORED = (
    "aspectRatioConformPolicy",
    "dataWindowNDC",
    "materialBindingPurposes",
    "pixelAspectRatio",
    "renderingColorSpace",
)
_STILL = ("disableMotionBlur", "instantaneousShutter")
"""The older of the two is the second."""


def read_settings(
    stage: Usd.Stage, prim_path: str = "", notices: list[Notice] | None = None, *, products: bool = False
) -> dict[str, object]:
    """Fields of `RenderSettings` that a RenderSettings prim of the stage authors; what is not authored is not there.

    Args:
        prim_path: which prim; '' takes the one that the stage's metadata `renderSettingsPrimPath` names, if any
        notices: grows by what is authored but not used, and by a path in the metadata that names nothing
        products: the caller draws its products (`products.read_products`), so that they are used

    Raises:
        StageError: `prim_path` names no RenderSettings, or one of its values is out of range.
    """
    prim = settings_prim(stage, prim_path, [] if notices is None else notices)
    if prim is None:
        return {}
    found = frame_of(prim)
    for name, field in (("includedPurposes", "purposes"), ("refract:tiers", "tiers")):
        tokens = authored_value(prim, name)
        if tokens is not None:
            found[field] = tuple(str(token) for token in tokens)
    for name, field in (("refract:samples", "samples"), ("refract:maxLayers", "max_layers")):
        number = authored_value(prim, name)
        if number is not None:
            found[field] = int(number)
    _check(prim, found)
    if notices is not None:
        tell_ignored(prim, notices)
        if not products and UsdRender.Settings(prim).GetProductsRel().HasAuthoredTargets():
            text = "products is authored but not used here; refract render writes them"
            notices.append(Notice(str(prim.GetPath()), text))
    return found


def frame_of(prim: Usd.Prim) -> dict[str, object]:
    """What a RenderSettings or RenderProduct prim authors of camera, resolution and motion blur, as fields of
    `RenderSettings`.

    Raises:
        StageError: a resolution that no picture can have.
    """
    found: dict[str, object] = {}
    camera = [target for target in UsdRender.SettingsBase(prim).GetCameraRel().GetForwardedTargets()
              if target.IsPrimPath()]  # fmt: skip
    if camera:
        found["camera"] = str(camera[0])
    size = authored_value(prim, "resolution")
    if size is not None:
        found["image_width"], found["image_height"] = (int(length) for length in size)
        if min(size) < 1:
            raise StageError(f"{prim.GetPath()}: resolution is {size}; both numbers must be 1 or more")
    stills = [authored_value(prim, name) for name in _STILL]
    if any(still is not None for still in stills):
        found["motion_blur"] = not any(stills)
    return found


def settings_prim(stage: Usd.Stage, prim_path: str, notices: list[Notice]) -> Usd.Prim | None:
    """The prim asked for, else the one the stage names, if any; None, with a notice, where the stage names none.

    Raises:
        StageError: `prim_path` names none.
    """
    path = prim_path or str(stage.GetMetadata("renderSettingsPrimPath") or "")
    if not path:
        return None
    absolute = path if path.startswith("/") else f"/{path}"
    prim = stage.GetPrimAtPath(absolute) if Sdf.Path.IsValidPathString(absolute) else None
    if prim and prim.IsA(UsdRender.Settings):
        return prim
    known = [str(other.GetPath()) for other in stage.Traverse() if other.IsA(UsdRender.Settings)]
    problem = f"is a {prim.GetTypeName() or 'prim without type'}, not a RenderSettings" if prim else "does not exist"
    choice = f"choose from {', '.join(known)}" if known else "the stage has no RenderSettings prim"
    if not prim_path:
        text = f"renderSettingsPrimPath names {path}, which {problem}; the defaults are used ({choice}, with {FLAG})"
        notices.append(Notice("/", text))
        return None
    raise StageError(f"{FLAG} names {path}, which {problem}; {choice}, or pass another path with {FLAG}")


def authored_value(prim: Usd.Prim, name: str) -> Any:
    """Value of an attribute where one is authored, else None. Settings hold for a whole render, not for a time."""
    attribute = prim.GetAttribute(name)
    return attribute.Get(Usd.TimeCode.EarliestTime()) if attribute and attribute.HasAuthoredValue() else None


def _check(prim: Usd.Prim, found: dict[str, object]) -> None:
    try:
        RenderSettings(**found)  # type: ignore[arg-type]
    except UsageError as error:
        raise StageError(f"{prim.GetPath()}: {error}") from error


def tell_ignored(prim: Usd.Prim, notices: list[Notice]) -> None:
    """Name what a RenderSettings or RenderProduct authors and no picture here follows."""
    for name in _IGNORED:
        spec = prim.GetProperty(name)
        if spec and spec.IsAuthored() and _differs(prim, name):
            notices.append(Notice(str(prim.GetPath()), f"{name} is authored but not used; remove it to silence this"))


def _differs(prim: Usd.Prim, name: str) -> bool:
    """Whether an authored attribute says anything but its fallback."""
    value = authored_value(prim, name)
    return value is None or value != prim.GetPrimDefinition().GetAttributeFallbackValue(name)
