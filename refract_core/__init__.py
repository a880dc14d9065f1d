"""A still renderer for USD that understands glass.

    import refract_core as rc

    frame = rc.render(rc.load_stage("scene.usda"), rc.RenderSettings(image_width=960))
    frame.save("out.exr")

Names are loaded when first used: importing the package alone loads neither USD nor the kernels.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import TYPE_CHECKING, Any

from .version import __version__

if TYPE_CHECKING:
    from .errors import Cancelled, EmbreeError, ImageError, RefractError, SceneError, StageError, UsageError
    from .frame import Frame
    from .override import OverrideError, override
    from .render import render
    from .scene import Notice, Scene
    from .settings import RenderSettings
    from .usd.stage import load_stage

__all__ = [
    "Cancelled",
    "EmbreeError",
    "Frame",
    "ImageError",
    "Notice",
    "OverrideError",
    "RefractError",
    "RenderSettings",
    "Scene",
    "SceneError",
    "StageError",
    "UsageError",
    "__version__",
    "load_stage",
    "override",
    "render",
]

_ROOMS = {
    "Cancelled": "errors",
    "EmbreeError": "errors",
    "Frame": "frame",
    "ImageError": "errors",
    "Notice": "scene",
    "OverrideError": "override",
    "RefractError": "errors",
    "RenderSettings": "settings",
    "Scene": "scene",
    "SceneError": "errors",
    "StageError": "errors",
    "UsageError": "errors",
    "load_stage": "usd.stage",
    "override": "override",
    "render": "render",
}


def __getattr__(name: str) -> Any:
    """Load a public name (PEP 562)."""
    if name not in _ROOMS:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    found = getattr(importlib.import_module(f"{__name__}.{_ROOMS[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Package(ModuleType):
    """A package where `render` and `override` stay functions, although modules of those names are imported too."""

    def __setattr__(self, name: str, value: object) -> None:
        if name in _ROOMS and isinstance(value, ModuleType):
            return
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
