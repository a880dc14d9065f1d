"""What every reader of one light needs."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from pxr import Usd, UsdGeom

from ...scene import F64, Notice


class Context(NamedTuple):
    """The frame that is read."""

    time: Usd.TimeCode
    xforms: UsdGeom.XformCache
    engine_from_stage: F64
    metres_per_unit: float
    notices: list[Notice]


def note(context: Context, prim: Usd.Prim, text: str) -> None:
    """Say something about a light."""
    context.notices.append(Notice(str(prim.GetPath()), text))


def value(context: Context, prim: Usd.Prim, name: str, default: Any) -> Any:
    """Of an attribute; `default` where the prim has none, or it is empty."""
    attribute = prim.GetAttribute(name)
    found = attribute.Get(context.time) if attribute else None
    return default if found is None else found


def number(context: Context, prim: Usd.Prim, name: str, default: float) -> float:
    """A finite number >= 0; anything else becomes `default` with a notice."""
    found = float(value(context, prim, name, default))
    if math.isfinite(found) and found >= 0.0:
        return found
    note(context, prim, f"{name} is {found}; the valid range is at least 0; {default} is used")
    return default
