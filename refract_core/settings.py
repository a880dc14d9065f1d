"""What a person may choose about a render. One record, used by the command line, Python and the service."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from .errors import UsageError
from .models import MODELS as MODELS

TIERS = ("screen", "ray", "probe", "sky")
SCREEN_METHODS = ("march", "proxy", "traced")
INDIRECT = ("off", "one", "full")
QUALITIES: dict[str, dict[str, Any]] = {
    "draft": {"samples": 4, "tolerance": 0.1, "cut": 0.05, "light_samples": 16, "caustics": 0},
    "good": {"samples": 16, "tolerance": 0.03, "cut": 0.02, "light_samples": 16, "caustics": 1 << 16},
    "best": {"samples": 32, "tolerance": 0.015, "cut": 0.005, "light_samples": 64, "caustics": 1 << 18},
    "reference": {"samples": 256, "tolerance": 0.0, "cut": 0.0005, "tiers": ("ray", "sky"), "max_layers": 32,
                  "caustics": 1 << 21},
}
"""What each level of quality stands for; each setting may also be chosen by its own name. The last one draws all
samples of every pixel, and leaves out what the picture lends its glass, and what probes do."""
PRESETS: dict[str, dict[str, Any]] = {
    "hdrp": {"screen": "proxy", "tiers": ("screen", "probe", "sky"), "max_layers": 1, "caustics": 0,
             "emission_light": False},
    "arm": {"model": "single", "tiers": ("probe", "sky"), "max_layers": 1, "caustics": 0, "emission_light": False},
}
"""Settings that make other renderers' pictures."""
PURPOSES = ("default", "render", "proxy", "guide")
MAX_PIXELS = 1 << 28
MAX_PHOTONS = 1 << 24


def named_settings(quality: str = "", preset: str = "") -> dict[str, Any]:
    """Fields of `RenderSettings` that a level of quality and a preset stand for; where both do, the preset wins.

    Raises:
        UsageError: there is no such level or preset.
    """
    found: dict[str, Any] = {}
    for field, name, table in (("quality", quality, QUALITIES), ("preset", preset, PRESETS)):
        if name:
            _tokens(field, (name,), tuple(table))
            found |= table[name]
    return found


@dataclass(frozen=True, kw_only=True)
class Opening:
    """What a person changes about a stage as it is opened; no file of it is."""

    variants: tuple[str, ...] = ()
    """`/Prim{set=name}`, chosen one after the other"""
    session_layer: str = ""
    """Path of a layer whose opinions are stronger than all of the stage"""
    mask: tuple[str, ...] = ()
    """Prim paths: they, what is below them and above them is all that the stage then has, and the materials of it"""


AS_IT_IS = Opening()
"""Nothing is changed."""


@dataclass(frozen=True, kw_only=True)
class RenderSettings:
    """Settings of one frame. Checked when made; an error names the field."""

    camera: str = ""
    """Prim path or name of the camera; '' chooses as usdrecord does."""
    image_width: int = 960
    """[pixels]"""
    image_height: int = 0
    """[pixels]; 0 follows the camera's aspect."""
    samples: int = 16
    """Samples of a pixel, 1 .. 4096, where its corners differ; 1 stands in its middle, and corners are left alone."""
    tolerance: float = 0.03
    """Difference of a pixel's corners, as the eye sees it, up to which they make the pixel, 0 .. 1. Beyond it is an
    edge, which takes samples, most where the difference is large. 0: every pixel takes all."""
    light_samples: int = 16
    """Rays to a light or to the sky where a pixel's corner sees a part of it, 1 .. 4096."""
    tiers: tuple[str, ...] = ("screen", "probe", "ray", "sky")
    """Order in which refraction and reflection look for their colour."""
    screen: str = "traced"
    """`traced`: the opaque picture answers where it shows the very surface that the ray meets. `march` its depth, or
    `proxy` exactly as HDRP."""
    model: str = ""
    """Overrides every refractive material's model where not ''."""
    max_layers: int = 16
    """Refractive surfaces that a ray may enter before it sees no more glass, 1 .. 32; 1 is HDRP."""
    cut: float = 0.02
    """Weight below which a branch of light is not followed for itself, but given to its stronger sibling, 0 .. 1."""
    caustics: int = 1 << 16
    """Photons that bring light through traced glass, and off it, to what is opaque, 0 .. 16777216. 0: light goes
    straight through glass on its way, as it does through panes and all other models."""
    indirect: str = "off"
    """Light that opaque surfaces send each other: `off`, `one` for the first time that it is, `full` for all."""
    exposure: float = 0.0
    """Stops added to the camera's own exposure, -64 .. 64."""
    purposes: tuple[str, ...] = ("default", "render")
    camera_light: bool = True
    """Light from the camera where a stage has no light, no dome and nothing that glows."""
    emission_light: bool = True
    """What glows lights other things. Otherwise it is seen, and no more."""
    jobs: int = 0
    """Threads; 0 means all cores."""
    tile_size: int = 64
    """Pixels along a tile's side; rounded up to a multiple of 8. Never changes the picture."""

    @property
    def by_corners(self) -> bool:
        """Pixels are made from their corners, and sampled where these differ. HDRP's proxies tell a pixel by its place,
        so with them each sample is a picture of its own."""
        return self.samples > 1 and self.tolerance > 0.0 and self.screen != "proxy"

    def __post_init__(self) -> None:
        _in_range("image_width", self.image_width, 1, MAX_PIXELS)
        _in_range("image_height", self.image_height, 0, MAX_PIXELS)
        if self.image_width * max(self.image_height, 1) > MAX_PIXELS:
            raise UsageError(
                f"image size {self.image_width} x {self.image_height} is over {MAX_PIXELS} pixels; make it smaller"
            )
        _in_range("samples", self.samples, 1, 4096)
        _in_range("light_samples", self.light_samples, 1, 4096)
        _in_range("max_layers", self.max_layers, 1, 32)
        _in_range("cut", self.cut, 0.0, 1.0)
        _in_range("caustics", self.caustics, 0, MAX_PHOTONS)
        _in_range("tolerance", self.tolerance, 0.0, 1.0)
        _in_range("jobs", self.jobs, 0, 4096)
        _in_range("tile_size", self.tile_size, 1, 65536)
        _in_range("exposure", self.exposure, -64.0, 64.0)
        _tokens("tiers", self.tiers, TIERS)
        _tokens("purposes", self.purposes, PURPOSES)
        _tokens("screen", (self.screen,), SCREEN_METHODS)
        _tokens("indirect", (self.indirect,), INDIRECT)
        if self.model:
            _tokens("model", (self.model,), MODELS)


def _in_range(name: str, value: float, low: float, high: float) -> None:
    if isinstance(value, bool) or not math.isfinite(value) or not low <= value <= high:
        raise UsageError(f"{name} is {value}; it must be between {low} and {high}")


def _tokens(name: str, chosen: tuple[str, ...], allowed: tuple[str, ...]) -> None:
    if not chosen:
        raise UsageError(f"{name} is empty; choose from {', '.join(allowed)}")
    for token in chosen:
        if token not in allowed:
            raise UsageError(f"{name} has '{token}', which is not known; choose from {', '.join(allowed)}")
    if len(set(chosen)) != len(chosen):
        raise UsageError(f"{name} names something twice: {','.join(chosen)}")
