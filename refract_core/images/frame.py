"""A rendered picture: planes of floats, what was said while making them, and how to save them."""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import SceneError, UsageError
from ..scene import F32, Notice
from .aovs import AOVS, check_names, shape_of
from .cryptomatte import Matte
from .exr import Layout
from .pictures import check_output, default_aovs, display, layered, png_bytes, write_frame
from .shown import show

if TYPE_CHECKING:
    from PIL.Image import Image


class Place(NamedTuple):
    """Where a part of a picture lies in it [pixels]."""

    x: int
    """from the left; of its first column"""
    y: int
    """from the top; of its first row"""
    width: int
    """of the whole picture; so is the next"""
    height: int


@dataclass(frozen=True)
class Frame:
    """One rendered image. Row 0 is the top."""

    width: int
    """[pixels]"""
    height: int
    """[pixels]"""
    planes: dict[str, F32]
    """AOV name (`aovs.AOVS`) -> float32. `beauty` has shape (H, W, 4), scene-linear with premultiplied
    alpha; colours and vectors (H, W, 3); scalars (H, W). `N`, `P` and `denoising_normal` are in the stage's
    world. The planes of `aovs.FEATURES` are there only where the settings ask for them."""
    metadata: dict[str, str | float] = field(default_factory=dict)
    """Written into the file: what made the picture."""
    notices: tuple[Notice, ...] = ()
    camera: dict[str, tuple[float, ...] | float] = field(default_factory=dict)
    """What an .exr says of the camera, by OpenEXR's names: `worldToCamera` and `worldToNDC` (16 numbers: a matrix for
    row vectors, row by row; from the stage's world and units), `near`, `far` [stage units]."""
    mattes: tuple[Matte, ...] = ()
    """Cryptomatte, for an .exr; as `RenderSettings.cryptomatte` asks."""
    seconds: float = 0.0
    """How long it took; 0 where nobody looked. In an .exr, unless the environment has SOURCE_DATE_EPOCH, by which
    people ask for files that are equal whenever they are made."""
    place: Place | None = None
    """Of a part of a picture; None is a whole one. An .exr has it as its data window within the display window."""

    def __post_init__(self) -> None:
        check_names(tuple(self.planes))
        for name, plane in self.planes.items():
            expected = shape_of(name, self.height, self.width)
            if plane.shape != expected or plane.dtype != np.float32:
                raise SceneError(
                    f"plane '{name}' is {plane.dtype} of shape {plane.shape}; it must be float32 of shape {expected}"
                )

    def __repr__(self) -> str:
        samples = f", {self.metadata['refract:samples']:g} samples" if "refract:samples" in self.metadata else ""
        return f"<Frame {self.width}x{self.height}{samples}: {', '.join(self.planes)}>"

    def _repr_png_(self) -> bytes:
        """For a notebook: the picture."""
        return png_bytes(self.to_srgb())

    def to_srgb(self, aov: str = "beauty") -> NDArray[np.uint8]:
        """A plane as a PNG holds it, shape (H, W, 4) with straight alpha for `beauty`, (H, W, 3), or (H, W, 1).

        Raises:
            UsageError: the frame has no such plane.
        """
        return display(aov, self.plane(aov))

    def plane(self, aov: str) -> F32:
        """A plane by name. Raises UsageError where the frame has none of it."""
        if aov not in self.planes:
            raise UsageError(f"AOV '{aov}' is not in this frame; it has {', '.join(self.planes)}")
        return self.planes[aov]

    def show(self, aov: str = "beauty", *, low: float | None = None, high: float | None = None) -> Image:
        """A plane as a Pillow image to look at: colours as a screen has them, a number a pixel in false colours with a
        bar that says what they mean. What only glass has, such as a thickness, is grey where there is none.

        Args:
            low: what the lower end of the bar means; None is the least in the picture.
            high: the same of the upper end, and of the most.

        Raises:
            UsageError: the frame has no such plane, or the ends are no range.
        """
        plane, mask = self.plane(aov), self.planes.get("mask")
        return show(aov, plane, low, high, None if mask is None or aov in ("Z", "mask") else mask > 0.0)

    def to_xarray(self) -> Any:
        """The planes as an `xarray.Dataset`: dimensions y and x (pixels, row 0 on top) and one for the channels of
        each plane, a variable for each AOV, and the metadata as attributes. It shares the frame's memory.

        Raises:
            UsageError: xarray is not installed.
        """
        try:
            xarray = importlib.import_module("xarray")
        except ImportError as missing:
            text = "to_xarray needs xarray; install it with pip install usd-refract[xarray]"
            raise UsageError(text) from missing
        variables = {}
        for name, plane in self.planes.items():
            own = () if AOVS[name].scalar else (f"{name}_channel",)
            variables[name] = xarray.Variable(("y", "x", *own), plane)
        letters = {name: [one.rpartition(".")[2] for one in AOVS[name].channels] for name in self.planes}
        places = {f"{name}_channel": letters[name] for name in self.planes if not AOVS[name].scalar}
        rows = {"y": np.arange(self.height) + 0.5, "x": np.arange(self.width) + 0.5}
        return xarray.Dataset(variables, {**rows, **places}, dict(self.metadata))

    def diff(self, other: Frame) -> Frame:
        """How far each number of each plane that both have is from the other's; where both are infinite that is 0.
        `beauty` keeps an alpha of 1, so that the difference can be looked at: `a.diff(b).show()`.

        Raises:
            UsageError: the sizes differ, or no plane is in both.
        """
        if (self.width, self.height) != (other.width, other.height):
            sizes = f"{self.width} x {self.height} and {other.width} x {other.height}"
            raise UsageError(f"the frames have {sizes} pixels; only those of one size can be compared")
        names = [name for name in self.planes if name in other.planes]
        if not names:
            raise UsageError("the frames have no AOV in common; render both with the same ones")
        planes = {name: _distance(self.planes[name], other.planes[name]) for name in names}
        if "beauty" in planes:
            planes["beauty"][..., 3] = 1.0
        return Frame(self.width, self.height, planes)

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        aovs: Sequence[str] = (),
        color_correction: str = "sRGB",
        names: Mapping[str, str] | None = None,
        exr_compression: str = "zip",
        exr_parts: str = "many",
    ) -> None:
        """Write the picture to `path`; its extension chooses the format.

        EXR holds scene-linear values of all chosen planes, and the frame's mattes. PNG, JPEG, TIFF,
        WebP and AVIF hold one plane as 8 bits: colours go through `color_correction`, the normal is mapped from [-1, 1]
        to [0, 1], scalars are grey clamped to [0, 1].

        Args:
            path: file to write; a file of that name is replaced in one step, or not at all.
            aovs: names of the planes; empty means all of them for EXR and `beauty` for the other formats.
            color_correction: `sRGB`, `disabled` or `openColorIO` (the default view of $OCIO or the built-in config).
            names: AOV -> what an .exr is to call it, where that is not its own name; the picture stays R, G, B, A.
            exr_compression: of an .exr: `zip`, `zips`, `piz` and `none` lose nothing, `dwaa` does of colours.
            exr_parts: of an .exr: `many` (one for each AOV) or `one`.

        Raises:
            UsageError: an unknown extension, AOV, correction, compression, or several AOVs for a format that holds one.
            ImageError: the file cannot be written.
        """
        target = os.fspath(path)
        chosen = tuple(aovs) or default_aovs(target, tuple(self.planes))
        layout = Layout(exr_compression, exr_parts)
        check_output(target, chosen, color_correction, layout)
        planes = {name: self.plane(name) for name in chosen}
        taken = {"refract:seconds": self.seconds} if self.seconds and "SOURCE_DATE_EPOCH" not in os.environ else {}
        write_frame(
            target,
            planes,
            self.metadata,
            color_correction=color_correction,
            names=names,
            layout=layout,
            mattes=self.mattes if layered(target) else (),
            attributes={**self.camera, **taken},
            place=self.place,
        )


def _distance(a: F32, b: F32) -> F32:
    """|a - b|, and 0 where they are equal, infinite ones too."""
    with np.errstate(invalid="ignore"):
        return np.where(a == b, np.float32(0.0), np.abs(a - b)).astype(np.float32)
