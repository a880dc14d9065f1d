"""The physics of one ray at one interface, as free functions: Snell, Fresnel, the models, absorption, lobes.
Knows no scene.
"""

from __future__ import annotations

import importlib
from typing import Any

__all__ = ["arrays", "interface", "lobes", "models"]


def __getattr__(name: str) -> Any:
    """The formulas on arrays, `rc.optics.refract(...)`: loaded when first used (PEP 562)."""
    if name.startswith("_"):
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"{__name__}.arrays"), name)
