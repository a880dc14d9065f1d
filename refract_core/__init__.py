"""A still renderer for USD that understands glass.

    import refract_core as rc

    frame = rc.render(rc.load_stage(rc.sample("marble")), rc.RenderSettings(image_width=960))
    frame.save("out.exr")

Names are loaded when first used: importing the package alone loads neither USD nor the kernels.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .version import __version__

if not (Path(__file__).parent / "schemas").is_dir():
    # A checkout keeps schemas/ and service/ beside this package, a wheel inside it. By `refract_core.schemas` they are
    # found in both, and never somebody else's, whatever lies first on sys.path.
    __path__.append(str(Path(__file__).parents[1]))

from .usd.registering import register_with_usd

if TYPE_CHECKING:
    from . import optics as optics
    from .errors import Cancelled, EmbreeError, ImageError, RefractError, SceneError, StageError, TimeUp, UsageError
    from .images.frame import Frame
    from .optics.arrays import refract_node
    from .rendering.picture import render
    from .rendering.session import Session
    from .scene import Notice, Scene
    from .settings import Opening, RenderSettings
    from .verbs.override import OverrideError, override
    from .verbs.samples import sample
    from .verbs.table import bake_probes, bake_thickness, compare, convert, inspect, load_stage, validate

__all__ = [
    "Cancelled",
    "EmbreeError",
    "Frame",
    "ImageError",
    "Notice",
    "Opening",
    "OverrideError",
    "RefractError",
    "RenderSettings",
    "Scene",
    "SceneError",
    "Session",
    "StageError",
    "TimeUp",
    "UsageError",
    "__version__",
    "bake_probes",
    "bake_thickness",
    "compare",
    "convert",
    "inspect",
    "load_stage",
    "override",
    "refract_node",
    "render",
    "sample",
    "validate",
]

_ROOMS = {
    "Cancelled": "errors",
    "EmbreeError": "errors",
    "Frame": "images.frame",
    "ImageError": "errors",
    "Notice": "scene",
    "Opening": "settings",
    "OverrideError": "verbs.override",
    "RefractError": "errors",
    "RenderSettings": "settings",
    "Scene": "scene",
    "SceneError": "errors",
    "Session": "rendering.session",
    "StageError": "errors",
    "TimeUp": "errors",
    "UsageError": "errors",
    "bake_probes": "verbs.table",
    "bake_thickness": "verbs.table",
    "compare": "verbs.table",
    "convert": "verbs.table",
    "inspect": "verbs.table",
    "load_stage": "verbs.table",
    "override": "verbs.override",
    "refract_node": "optics.arrays",
    "render": "rendering.picture",
    "sample": "verbs.samples",
    "validate": "verbs.table",
}


def __getattr__(name: str) -> Any:
    """Load a public name (PEP 562)."""
    if name == "optics":  # a wing, which is there without an import of its own
        return importlib.import_module(f"{__name__}.optics")
    if name not in _ROOMS:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    found = getattr(importlib.import_module(f"{__name__}.{_ROOMS[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_with_usd()
