"""A rendered picture: planes of floats, what was said while making them, and how to save them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..errors import SceneError, UsageError
from ..scene import F32, Notice
from .aovs import check_names, shape_of
from .pictures import check_output, default_aovs, write_frame


@dataclass(frozen=True)
class Frame:
    """One rendered image. Row 0 is the top."""

    width: int
    """[pixels]"""
    height: int
    """[pixels]"""
    planes: dict[str, F32]
    """AOV name (`aovs.AOVS`) -> float32. `beauty` has shape (H, W, 4), scene-linear with premultiplied
    alpha; colours and vectors (H, W, 3); scalars (H, W). `N` and `P` are in the stage's world."""
    metadata: dict[str, str | float] = field(default_factory=dict)
    """Written into the file: what made the picture."""
    notices: tuple[Notice, ...] = ()

    def __post_init__(self) -> None:
        check_names(tuple(self.planes))
        for name, plane in self.planes.items():
            expected = shape_of(name, self.height, self.width)
            if plane.shape != expected or plane.dtype != np.float32:
                raise SceneError(
                    f"plane '{name}' is {plane.dtype} of shape {plane.shape}; it must be float32 of shape {expected}"
                )

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        aovs: Sequence[str] = (),
        color_correction: str = "sRGB",
        names: Mapping[str, str] | None = None,
    ) -> None:
        """Write the picture to `path`; its extension chooses the format.

        EXR holds scene-linear values of all chosen planes. PNG, JPEG, TIFF, WebP and AVIF hold one plane as 8 bits:
        colours go through `color_correction`, the normal is mapped from [-1, 1] to [0, 1], scalars are grey clamped to
        [0, 1].

        Args:
            path: file to write; a file of that name is replaced in one step, or not at all.
            aovs: names of the planes; empty means all of them for EXR and `beauty` for the other formats.
            color_correction: `sRGB`, `disabled` or `openColorIO` (the default view of $OCIO or the built-in config).
            names: AOV -> what an .exr is to call it, where that is not its own name; the picture stays R, G, B, A.

        Raises:
            UsageError: an unknown extension, AOV or correction, or several AOVs for a format that holds one.
            ImageError: the file cannot be written.
        """
        target = os.fspath(path)
        chosen = tuple(aovs) or default_aovs(target, tuple(self.planes))
        check_output(target, chosen, color_correction)
        for name in chosen:
            if name not in self.planes:
                raise UsageError(f"AOV '{name}' is not in this frame; it has {', '.join(self.planes)}")
        planes = {name: self.planes[name] for name in chosen}
        write_frame(target, planes, self.metadata, color_correction=color_correction, names=names)
