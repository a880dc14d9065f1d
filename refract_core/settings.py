"""What a person may choose about a render. One record, used by the command line, Python and the service."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

from .errors import UsageError
from .models import MODELS as MODELS

TIERS = ("screen", "ray", "probe", "sky")
SCREEN_METHODS = ("march", "proxy", "traced")
INDIRECT = ("off", "one", "full")
CRYPTOMATTES = ("object", "material")
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
             "emission_light": False, "studio": "none"},
    "arm": {"model": "single", "tiers": ("probe", "sky"), "max_layers": 1, "caustics": 0, "emission_light": False,
            "studio": "none"},
}
"""Settings that make other renderers' pictures."""
STUDIOS = ("softbox", "daylight", "dark", "none")
PURPOSES = ("default", "render", "proxy", "guide")
_COLOR = re.compile("#[0-9a-fA-F]{6}")
MAX_PIXELS = 1 << 28
USUAL_PIXELS = 1024
"""Longer side of a picture up to which surfaces are as fine as without one, and complexity alone says how fine."""
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
    azimuth: float | None = None
    """Side from which a camera of its own looks [degrees]: 0 is the front, 90 the right. Any of this and of the next
    six makes one (`view.orbit`), that starts from `camera` where that is named."""
    elevation: float | None = None
    """How high it stands [degrees], -90 .. 90: 90 is above."""
    distance: float | None = None
    """From what it looks at [stage units], > 0."""
    fit: float | None = None
    """In place of `distance`: how much larger the frame is than what it frames; 1 touches the picture's edges."""
    fov: float | None = None
    """Angle that the picture's width spans [degrees], 0.1 .. 175."""
    focal_length: float | None = None
    """In place of `fov`, of a lens before a film 20.955 mm wide [mm], 0.1 .. 10000."""
    look_at: str | tuple[float, ...] = ""
    """Prim path or point [stage units] in the picture's middle; '' is the middle of everything. A prim is framed."""
    image_width: int = 960
    """[pixels]"""
    image_height: int = 0
    """[pixels]; 0 follows the camera's aspect."""
    crop: tuple[float, ...] = ()
    """x0, y0, x1, y1 of the part that is drawn, from the upper left: shares of the picture where none is above 1, else
    pixels, from the first to the one after the last. () is all of it."""
    tile_count: tuple[int, ...] = (1, 1)
    """Columns and rows of parts that the picture is cut into, one of which is drawn."""
    tile_index: int = 0
    """Which of them: row by row, from 0 on the upper left."""
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
    denoise: bool = False
    """Noise is taken out of the picture by Open Image Denoise, which the extra `denoise` brings; other planes stay."""
    features: bool = False
    """The frame has the planes `albedo` and `denoising_normal`, too."""
    cryptomatte: tuple[str, ...] = ()
    """Kinds of mattes that are drawn beside the picture, `object` and `material`: whose each part of a pixel is, by the
    first surface seen. For .exr files."""
    exposure: float = 0.0
    """Stops added to the camera's own exposure, -64 .. 64."""
    purposes: tuple[str, ...] = ("default", "render")
    motion_blur: bool = True
    """What moves while the camera's shutter is open is blurred. Otherwise it stands still at the time of the frame."""
    camera_light: bool = True
    """Light is added where a stage has no light, no dome and nothing that glows: a studio, or, where there is none, a
    lamp at the camera."""
    emission_light: bool = True
    """What glows lights other things. Otherwise it is seen, and no more."""
    studio: str = ""
    """Lamps, a dome and a floor around what is drawn: softbox, daylight or dark; none leaves them out. '' is softbox
    where `camera_light` would shine on a thing seen from outside, and none elsewhere."""
    environment: str = ""
    """Path of a latlong picture that takes the place of the stage's domes; '' leaves them."""
    background: str = ""
    """What is seen past everything, and through glass: `transparent`, `#rrggbb`, or `environment`, which is the dome
    and a studio's floor; '' is that, too."""
    jobs: int = 0
    """Threads; 0 means all cores."""
    tile_size: int = 64
    """Pixels along a tile's side; rounded up to a multiple of 8. Never changes the picture."""

    @property
    def by_corners(self) -> bool:
        """Pixels are made from their corners, and sampled where these differ. HDRP's proxies tell a pixel by its place,
        so with them each sample is a picture of its own."""
        return self.samples > 1 and self.tolerance > 0.0 and self.screen != "proxy"

    @property
    def orbits(self) -> bool:
        """The picture is taken by a camera of its own."""
        return any(getattr(self, name) != value for name, value in NO_ORBIT.items())

    @property
    def longer_side(self) -> int:
        """Of the whole picture, as it is asked for [pixels]; where no height is, a camera that is taller makes more."""
        return max(self.image_width, self.image_height)

    def __post_init__(self) -> None:
        _check_orbit(self)
        _check_part(self)
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
        if self.cryptomatte:
            _tokens("cryptomatte", self.cryptomatte, CRYPTOMATTES)
        if self.model:
            _tokens("model", (self.model,), MODELS)
        if self.studio:
            _tokens("studio", (self.studio,), STUDIOS)
        if self.environment and self.studio not in ("", "none"):
            raise UsageError(f"environment and studio '{self.studio}' are both surroundings; choose one")
        if self.background not in ("", "transparent", "environment") and not _COLOR.fullmatch(self.background):
            text = "it must be transparent, environment, or a colour as #rrggbb"
            raise UsageError(f"background is '{self.background[:200]}'; {text}")


NO_ORBIT: dict[str, Any] = {
    name: RenderSettings.__dataclass_fields__[name].default
    for name in ("azimuth", "elevation", "distance", "fit", "fov", "focal_length", "look_at")
}
"""What `RenderSettings` says about a camera of its own where there is none."""
_ORBIT_RANGES = {"azimuth": (-1e6, 1e6), "elevation": (-90.0, 90.0), "distance": (1e-9, 1e12), "fit": (0.01, 1000.0),
                 "fov": (0.1, 175.0), "focal_length": (0.1, 1e4)}  # fmt: skip


NO_CROP: dict[str, Any] = {"crop": (), "tile_count": (1, 1), "tile_index": 0}
"""What `RenderSettings` says where the whole picture is drawn."""


def _check_part(settings: RenderSettings) -> None:
    crop, count = settings.crop, settings.tile_count
    if crop and not (len(crop) == 4 and all(math.isfinite(at) and at >= 0.0 for at in crop)):
        raise UsageError(f"crop is {crop}; it must be four numbers from 0 on: x0,y0,x1,y1")
    if len(count) != 2:
        raise UsageError(f"tile_count is {count}; it must be two numbers, columns and rows")
    for number in count:
        _in_range("tile_count", number, 1, 65536)
    _in_range("tile_index", settings.tile_index, 0, count[0] * count[1] - 1)
    if settings.denoise and (crop or count != (1, 1)):
        raise UsageError("denoise looks at the whole picture, of which only a part is drawn; leave one of them out")
    if crop and count != (1, 1):
        raise UsageError("crop and tile count say both which part is drawn; give one of them")


def _check_orbit(settings: RenderSettings) -> None:
    for name, (low, high) in _ORBIT_RANGES.items():
        if getattr(settings, name) is not None:
            _in_range(name, getattr(settings, name), low, high)
    for one, other in (("distance", "fit"), ("fov", "focal_length")):
        if getattr(settings, one) is not None and getattr(settings, other) is not None:
            raise UsageError(f"{one} says what {other.replace('_', ' ')} says, too; give one of them")
    look_at = settings.look_at
    if isinstance(look_at, str):
        if look_at and not look_at.startswith("/"):
            raise UsageError(f"look_at is '{look_at}'; it must be the path of a prim, or a point: x,y,z")
    elif len(look_at) != 3 or not all(math.isfinite(part) for part in look_at):
        raise UsageError(f"look_at is {look_at}; a point has three finite numbers: x,y,z")


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
