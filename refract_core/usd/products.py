"""The pictures that a stage wants of itself: UsdRenderProduct and UsdRenderVar as files, AOVs and names in them."""

from __future__ import annotations

import re
from typing import NamedTuple

from pxr import Usd, UsdRender

from ..images.aovs import AOVS
from ..scene import Notice
from .settings import authored_value, frame_of, settings_prim, tell_ignored

_RASTER = "raster"
# What other renderers call what we draw, in small letters.
_RAW = {
    "beauty": ("c", "ci", "color", "rgb", "rgba", "beauty", "combined"),
    "N": ("n", "normal", "normals"),
    "P": ("p", "position"),
    "Z": ("z", "depth", "cameradepth"),
}
_BY_SOURCE = {word: name for name, words in _RAW.items() for word in words} | {name.lower(): name for name in AOVS}
_EVERYTHING = ("C.*", "C.*[LO]", "C.*[OL]", "C[DS]*[LO]", "C[DS]*[OL]", "C.*O", "C.*L")
"""Light path expressions of all light that reaches the camera."""
_NAME = "driver:parameters:aov:name"
_FRAME = re.compile(r"\$F(\d*)|<F(\d*)>|%0?(\d*)d")


class Product(NamedTuple):
    """One picture."""

    path: str
    """of the prim"""
    file: str
    """As `productName` has it, with #### for the frame, whichever of the usual ways it is written in"""
    settings: dict[str, object]
    """Fields of `RenderSettings` that it authors over those of its settings"""
    names: dict[str, str]
    """AOV -> what its channels are called in a file that has several; in the order of its variables"""

    @property
    def aovs(self) -> tuple[str, ...]:
        """() where it has no variables, and the format decides."""
        return tuple(self.names)


def read_products(stage: Usd.Stage, prim_path: str = "", notices: list[Notice] | None = None) -> list[Product]:
    """The raster products of the stage's RenderSettings, in their order.

    Args:
        prim_path: of the settings, as `settings.read_settings` takes it
        notices: grows by what is authored but not drawn

    Raises:
        StageError: there is no such prim, or a value is out of range.
    """
    told = [] if notices is None else notices
    prim = settings_prim(stage, prim_path, [])  # what is to be said of it, `read_settings` says
    if prim is None:
        return []
    found = []
    for target in UsdRender.Settings(prim).GetProductsRel().GetForwardedTargets():
        product = stage.GetPrimAtPath(target)
        if not product or not product.IsA(UsdRender.Product):
            text = f"products names {target}, which is no RenderProduct; it is left out"
            told.append(Notice(str(prim.GetPath()), text))
            continue
        kind = str(UsdRender.Product(product).GetProductTypeAttr().Get() or _RASTER)
        if kind != _RASTER:
            text = f"RenderProduct of productType '{kind}' is not written; only {_RASTER} ones are"
            told.append(Notice(str(target), text))
            continue
        tell_ignored(product, told)
        names = _variables(product, told)
        found.append(Product(str(target), _file(product), frame_of(product), names))
    return found


def _file(product: Usd.Prim) -> str:
    name = str(authored_value(product, "productName") or f"{product.GetName()}.exr")
    return _FRAME.sub(lambda found: "#" * max(1, int(next(filter(None, found.groups()), "1"))), name)


def _variables(product: Usd.Prim, notices: list[Notice]) -> dict[str, str]:
    """AOVs in their order, with their names in the file."""
    names: dict[str, str] = {}
    targets = UsdRender.Product(product).GetOrderedVarsRel().GetForwardedTargets()
    for target in targets:
        prim = product.GetStage().GetPrimAtPath(target)
        if not prim or not prim.IsA(UsdRender.Var):
            text = f"orderedVars names {target}, which is no RenderVar; it is left out"
            notices.append(Notice(str(product.GetPath()), text))
            continue
        source = str(authored_value(prim, "sourceName") or "")
        kind = str(UsdRender.Var(prim).GetSourceTypeAttr().Get() or "raw")
        aov = _aov(source or prim.GetName(), kind)
        name = str(authored_value(prim, _NAME) or prim.GetName())
        if aov is None:
            text = f"RenderVar of {kind} '{source}' is not drawn; refract has {', '.join(AOVS)}, and C.* as lpe"
            notices.append(Notice(str(target), text))
        elif aov in names or name in names.values():
            text = f"RenderVar is left out: another of the product is {aov}, or has the name {name}, too"
            notices.append(Notice(str(target), text))
        else:
            names[aov] = name
    if targets and not names:
        names["beauty"] = "beauty"
    return names


def _aov(source: str, kind: str) -> str | None:
    """What we call a source; None where we do not draw it."""
    if kind == "lpe":
        return "beauty" if "".join(source.removeprefix("lpe:").split()) in _EVERYTHING else None
    return _BY_SOURCE.get(source.lower()) if kind in ("raw", "intrinsic") else None
