"""The planes a frame may hold, and what each is called inside an EXR file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from ..errors import UsageError


class Aov(NamedTuple):
    """One kind of plane."""

    channels: tuple[str, ...]
    """Channel names in an EXR file, in the order of the plane's last axis."""
    color: bool = False
    """Scene-linear light: half floats in EXR, colour-corrected in a PNG. All else is data, kept as float32."""
    scalar: bool = False
    """The plane has shape (H, W), without an axis for its channel."""


AOVS: dict[str, Aov] = {
    "beauty": Aov(("R", "G", "B", "A"), color=True),
    "refraction": Aov(("refraction.R", "refraction.G", "refraction.B"), color=True),
    "reflection": Aov(("reflection.R", "reflection.G", "reflection.B"), color=True),
    "transmittance": Aov(("transmittance.R", "transmittance.G", "transmittance.B"), color=True),
    "albedo": Aov(("albedo.R", "albedo.G", "albedo.B"), color=True),
    "N": Aov(("N.X", "N.Y", "N.Z")),
    "P": Aov(("P.X", "P.Y", "P.Z")),
    "denoising_normal": Aov(("denoising_normal.X", "denoising_normal.Y", "denoising_normal.Z")),
} | {
    name: Aov((name,), scalar=True)
    for name in (
        "Z",
        "mask",
        "thickness",
        "path_length",
        "layers",
        "weight.screen",
        "weight.ray",
        "weight.probe",
        "weight.sky",
        "weight.none",
        "confidence",
    )
}

FEATURES = ("albedo", "denoising_normal")
"""Planes that a frame has only where somebody asks for them: what a denoiser reads beside the picture."""


def shape_of(name: str, height: int, width: int) -> tuple[int, ...]:
    """Shape of the plane `name` in a picture of this size."""
    aov = AOVS[name]
    return (height, width) if aov.scalar else (height, width, len(aov.channels))


def channels_of(name: str, title: str) -> tuple[str, ...]:
    """Channels of an AOV in an EXR file that calls it `title`. The picture itself is always R, G, B, A: viewers look
    for these."""
    aov = AOVS[name]
    if name == "beauty" or title == name:
        return aov.channels
    return tuple(title if aov.scalar else f"{title}.{channel.rpartition('.')[2]}" for channel in aov.channels)


def check_names(names: Sequence[str]) -> None:
    """Refuse AOV names that do not exist or come twice.

    Raises:
        UsageError: with the known names.
    """
    for name in names:
        if name not in AOVS:
            raise UsageError(f"AOV '{name}' is not known; choose from {', '.join(AOVS)}")
    if len(set(names)) != len(names):
        raise UsageError(f"AOVs name something twice: {','.join(names)}")
