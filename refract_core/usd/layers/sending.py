"""A stage as something to send: where it is, which files it is made of, and all of them in one."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from pxr import Sdf, Tf, UsdUtils

from .edit import outer_of, quiet
from .write import overlay, save

MADE = "send"


def absolute(stage: str) -> str:
    """Path of a stage, which may be inside a package, as every folder of this machine knows it."""
    outer = outer_of(stage)
    return os.path.abspath(outer) + stage[len(outer) :]


def files_of(stage: str) -> list[str]:
    """Absolute paths of every file that a stage is made of, as far as they exist: layers, packages, textures."""
    paths = [stage]
    with quiet():
        try:
            layers, assets, _ = UsdUtils.ComputeAllDependencies(Sdf.AssetPath(stage))
            paths += [*(layer.realPath for layer in layers), *assets]
        except Tf.ErrorException:  # a damaged part; opening the stage tells about it
            pass
    files = {os.path.abspath(outer_of(path)) for path in paths if path}
    return sorted(file for file in files if os.path.isfile(file))


def packed(stage: str) -> bytes:
    """A .usdz with everything in it that a stage is made of. Raises StageError where something cannot be packed."""
    if stage.lower().endswith(".usdz"):
        return Path(stage).read_bytes()
    with tempfile.TemporaryDirectory(prefix="refract-send-") as folder:
        file = os.path.join(folder, "stage.usdz")
        save(overlay(stage, made=MADE), file)
        return Path(file).read_bytes()
