"""What `--denoise` does to how near a picture comes to the reference.

    python -m benchmarks.denoise [--stages NAMES] [--image-width 320] [--reference-samples 64] [--assets FOLDER]
                                 [--write]

Each stage is drawn with `--quality draft` and `good`, as a picture of four samples that every pixel takes for itself
(`--tolerance 0 --samples 4 --light-samples 1`), and with `--quality reference`. PSNR is that of `refract compare`.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import refract_core as rc
from refract_core.images.frame import Frame
from refract_core.usd.settings import read_settings
from refract_core.usd.stage import open_stage, scene_from_stage
from refract_core.verbs.compare import displayed, psnr
from refract_core.verbs.render_files import chosen_settings

from . import pages
from .accuracy import ASSETS, SAMPLES

PAGE = pages.ROOT / "docs" / "decisions" / "denoise.md"
WAYS: dict[str, dict[str, Any]] = {
    "`draft`": {"quality": "draft"},
    "`good`": {"quality": "good"},
    "4 of each pixel's own": {"samples": 4, "tolerance": 0.0, "light_samples": 1},
}
"""What is asked for, by what the table calls it."""
STAGES = ("glass_behind_glass", "marble", "ice_cube", "room_of_checkers")
OTHERS = ("cornell_box/usdpreviewsurface/cornell-box.usda", "chess_pawn/Pawn/Pawn.usd")
"""In the folder of other people's stages."""


class Score(NamedTuple):
    """One picture, without and with `--denoise`."""

    raw: float
    """PSNR [dB]"""
    quiet: float


class Row(NamedTuple):
    """Everything about one stage."""

    name: str
    scores: dict[str, Score]
    """by the names of `WAYS`"""


def measure(name: str, path: Path, width: int, samples: int) -> Row:
    """Draw a stage in every way, and compare."""
    stage = open_stage(str(path))
    authored = {**read_settings(stage), "image_height": 0}

    def drawn(denoise: bool, **asked: Any) -> Frame:
        settings = replace(chosen_settings(authored, {**asked, "image_width": width}), denoise=denoise)
        scene = scene_from_stage(stage, purposes=settings.purposes, camera=settings.camera)
        return rc.render(scene, settings)

    reference = drawn(False, quality="reference", samples=samples)
    scores = {}
    for way, asked in WAYS.items():
        raw, quiet = drawn(False, **asked), drawn(True, **asked)
        scores[way] = Score(_psnr(raw, reference), _psnr(quiet, reference))
    return Row(name, scores)


def _psnr(frame: Frame, reference: Frame) -> float:
    picture, truth = (displayed(one.planes["beauty"][..., :3]) for one in (frame, reference))
    return psnr(picture, truth)


def table(rows: Sequence[Row]) -> str:
    """Markdown: a row for each stage."""
    cells = [
        [f"`{row.name}`", *(f"{_decibels(one.raw)} / {_decibels(one.quiet)}" for one in row.scores.values())]
        for row in rows
    ]
    return pages.table(["stage", *WAYS], cells)


def _decibels(value: float) -> str:
    return "same" if math.isinf(value) else f"{value:.2f}"


def main() -> None:
    """Print the table, and write it into the page where asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stages", default="", help="names, with commas; default: all")
    parser.add_argument("--image-width", type=int, default=320)
    parser.add_argument("--reference-samples", type=int, default=64)
    parser.add_argument("--assets", type=Path, default=ASSETS, help="folder of other people's stages")
    parser.add_argument("--write", action="store_true", help=f"into {PAGE.relative_to(pages.ROOT)}")
    chosen = parser.parse_args()
    paths = {name: SAMPLES / f"{name}.usda" for name in STAGES}
    paths |= {name: chosen.assets / name for name in OTHERS if (chosen.assets / name).exists()}
    names = chosen.stages.split(",") if chosen.stages else list(paths)
    measure("warm", SAMPLES / "marble.usda", 16, 4)  # so that no stage pays for compiling
    rows = []
    for name in names:
        rows.append(measure(name, paths[name], chosen.image_width, chosen.reference_samples))
        print(table(rows[-1:]).splitlines()[-1], file=sys.stderr, flush=True)
    made = f"{chosen.image_width} pixels wide, against {chosen.reference_samples} samples a pixel"
    block = f"Pictures are {made}; dB without / with `--denoise`.\n\n{table(rows)}"
    print(block)
    if chosen.write:
        pages.write(PAGE, {"denoise": block})


if __name__ == "__main__":
    main()
