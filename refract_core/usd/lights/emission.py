"""How much a UsdLux light emits, before its shape is known."""

from __future__ import annotations

import math

import numpy as np
from pxr import Usd, UsdLux

from ...scene import F64
from .context import Context, note, value


def emission(context: Context, light: UsdLux.LightAPI) -> tuple[float, float, float] | None:
    """color * intensity * 2^exposure * colour temperature (UsdLuxLightAPI); None with a notice where it is no number.

    `normalize` is not in it: it needs the light's shape.
    """
    prim = light.GetPrim()
    intensity = float(value(context, prim, "inputs:intensity", 1.0))
    exposure = float(value(context, prim, "inputs:exposure", 0.0))
    color = np.array(value(context, prim, "inputs:color", (1.0, 1.0, 1.0)), np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        emission = color * intensity * np.exp2(exposure) * _temperature(context, prim)
    if not np.isfinite(emission).all() or (emission < 0.0).any() or float(emission.max()) > 1e30:
        shown = tuple(color.tolist())
        note(context, prim, f"intensity {intensity}, exposure {exposure}, color {shown} is no finite positive "
                             "emission; the light is skipped; author values of at least 0")  # fmt: skip
        return None
    return (float(emission[0]), float(emission[1]), float(emission[2]))


def _temperature(context: Context, prim: Usd.Prim) -> F64:
    """Colour of a black body [linear BT.709], shape (3,), 1 where the light does not ask for one."""
    if not value(context, prim, "inputs:enableColorTemperature", False):
        return np.ones(3)
    kelvin = float(value(context, prim, "inputs:colorTemperature", 6500.0))
    low, high = 1000.0, 10000.0  # as UsdLux has it
    if not low <= kelvin <= high:  # usd-core 26.11 crashes on NaN
        used = min(max(kelvin, low), high) if math.isfinite(kelvin) else 6500.0
        note(context, prim, f"inputs:colorTemperature is {kelvin}; the valid range is {low:g} to {high:g} K; "
                             f"{used:g} is used")  # fmt: skip
        kelvin = used
    return np.array(UsdLux.BlackbodyTemperatureAsRgb(kelvin), np.float64)
