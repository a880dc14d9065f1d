"""Compile what has to be compiled on this machine, before somebody waits for it: for images and CI."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from ..kernels import ahead, build, store
from ..progress import Report
from ..world import embree


class Warmth(NamedTuple):
    """What is ready."""

    built: int
    """kernels that came with the package"""
    found: int
    """kernels that had been compiled and kept before"""
    compiled: int
    """kernels compiled now"""
    why: str
    """why not all came with the package"""
    folder: Path
    """where the others are kept"""


def warm(report: Report) -> Warmth:
    """Compile every kernel that did not come with the package and is not kept yet.

    Raises:
        EmbreeError: Embree, which kernels call, is not installed.
    """
    embree.library()
    kernels = build.kernels()
    left = {name: one for name, one in kernels.items() if one.native is None}
    compiled = 0
    for done, (name, one) in enumerate(left.items()):
        report.progress(done / len(left), name.rpartition(".")[2].strip("_"))
        compiled += one.warm()
    return Warmth(len(kernels) - len(left), len(left) - compiled, compiled, ahead.state()[1], store.folder())


def to_text(warmth: Warmth) -> str:
    """One sentence for a person."""
    if warmth.built and not warmth.found + warmth.compiled:
        return f"{warmth.built} kernels came compiled with the package; there is nothing to do"
    kept = f"{warmth.compiled} kernels compiled, {warmth.found} had been before; they are in {warmth.folder}"
    return f"{kept} ({warmth.why})"
