"""How near the tiers come to one ray per pixel into the scene: PSNR, FLIP and milliseconds, by order and by proxy.

    python -m benchmarks.tiers [--size 640] [--samples 4] [--shapes sphere,cube] [--resolution 256] [--repeat 3]

Five things of glass, one at a time, in a furnished room (`benchmarks.room`). The truth is `--tiers ray,sky` with the
same traced glass: what is measured is the tiers, not the model. Only what comes through the glass is compared, inside
the glass; its reflection is taken off. Every number is PSNR in dB / mean LDR-FLIP of sRGB pictures.

HDRP's own row is HDRP whole: proxy reprojection, its typed models, one surface of glass. For every shape it gets
that of sphere, box and thin which comes out best, with the thickness an author would type, and the room itself as
proxy.

Milliseconds are those of `render` in a warm process, the best of the repeats and the median of the shapes. In rows
with a probe they hold its capture, which a baked probe saves; what that takes is also printed by itself.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import refract_core as rc
from refract_core.scene import F32, Volume
from refract_core.verbs.compare import displayed, flip, psnr

from .room import ROOM, SHAPES, Shape, box_volume, probe, room, sphere_volume

PROXIES: dict[str, Volume | None] = {
    "box": box_volume(ROOM),
    "sphere": sphere_volume(sum(ROOM) / 3.0),
    "infinite": None,
    "volume": box_volume((1.25 * ROOM[0], 1.25 * ROOM[1], 1.25 * ROOM[2])),
}
"""box: the room itself, which is also the influence; sphere: of the room's mean half size; volume: a box of its own,
a quarter too large."""
TYPED = ("sphere", "box", "thin")


class Arrangement(NamedTuple):
    """One row of the table."""

    tiers: str
    proxy: str = ""
    """name in PROXIES; '' where nothing uses a probe"""
    screen: str = "traced"
    models: tuple[str, ...] = ("traced",)
    """the best of these counts"""
    max_layers: int = 16
    name: str = ""

    @property
    def label(self) -> str:
        return self.name or self.tiers


TRUTH = Arrangement("ray,sky")
SCREEN = Arrangement("screen,probe,sky", "box")
RAY = Arrangement("screen,ray,sky")
MARCH = Arrangement("screen,probe,sky", "box", "march", name="screen by march")
REPROJECTED = Arrangement("screen,probe,sky", "box", "proxy", name="HDRP's tiers, traced")
HDRP = Arrangement("screen,probe,sky", "box", "proxy", TYPED, 1, "HDRP")
ROWS = (
    *(SCREEN._replace(proxy=name) for name in PROXIES),
    *(Arrangement("probe,sky", name) for name in PROXIES),
    Arrangement("screen,sky"),
    RAY,
    Arrangement("probe,ray,sky", "box"),
    MARCH,
    REPROJECTED,
    HDRP,
)
GAINS = (
    ("screen over reprojection", SCREEN, REPROJECTED),
    ("screen over its own march", SCREEN, MARCH),
    ("screen, traced glass, over HDRP", SCREEN, HDRP),
    ("screen, then ray, over HDRP", RAY, HDRP),
)


class Picture(NamedTuple):
    """What comes through the glass, in its surroundings."""

    shown: F32
    """shape (H, W, 3), display-encoded"""
    inside: NDArray[np.bool_]
    """shape (H, W): pixels that are all glass"""


class Score(NamedTuple):
    """One cell of the table."""

    psnr: float
    """[dB]"""
    flip: float
    seconds: float
    model: str


class Measured(NamedTuple):
    """Everything about one shape."""

    scores: dict[Arrangement, Score]
    truth_seconds: float
    capture_seconds: float
    """of the probe, which is in the scores too"""


class Options(NamedTuple):
    """What the command line says."""

    size: int = 640
    """width of the picture [pixels]; 16:9"""
    samples: int = 4
    resolution: int = 256
    """of a face of the probe [pixels]"""
    repeat: int = 3
    jobs: int = 0


def settings_of(row: Arrangement, model: str, options: Options) -> rc.RenderSettings:
    """What `render` is told for a row."""
    return rc.RenderSettings(
        image_width=options.size, samples=options.samples, tiers=tuple(row.tiers.split(",")), screen=row.screen,
        model=model, max_layers=row.max_layers, jobs=options.jobs,
    )  # fmt: skip


def scene_of(row: Arrangement, shape: Shape, options: Options) -> rc.Scene:
    """The room, with the row's probe."""
    return room(shape, (probe(PROXIES[row.proxy], options.resolution),) if row.proxy else ())


def picture_of(frame: rc.Frame) -> Picture:
    """Take the reflection off the glass, and encode for display."""
    through = frame.planes["beauty"][..., :3] - frame.planes["reflection"]
    return Picture(displayed(through), frame.planes["mask"] > 1.0 - 1e-4)


def drawn(scene: rc.Scene, settings: rc.RenderSettings, repeat: int) -> tuple[Picture, float]:
    """The picture, and the best of the seconds after a first time."""
    frame = rc.render(scene, settings)
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        rc.render(scene, settings)
        times.append(time.perf_counter() - start)
    return picture_of(frame), min(times) if times else math.nan


def capture_seconds(shape: Shape, options: Options) -> float:
    """What the probe costs: a tiny picture of the same samples with it, less the same without."""
    tiny = options._replace(size=16)
    asked, spared = Arrangement("probe,sky", "box"), Arrangement("sky", "box")
    both = [drawn(scene_of(row, shape, tiny), settings_of(row, "traced", tiny), 3)[1] for row in (asked, spared)]
    return max(0.0, both[0] - both[1])


def score(row: Arrangement, shape: Shape, truth: Picture, options: Options) -> Score:
    """Draw a row with each of its models; the best by PSNR counts."""
    scene = scene_of(row, shape, options)
    found = []
    for model in row.models:
        picture, seconds = drawn(scene, settings_of(row, model, options), options.repeat)
        near = psnr(picture.shown, truth.shown, truth.inside)
        unlike = flip(picture.shown, truth.shown, truth.inside)
        found.append(Score(near, unlike, seconds, model))
    return max(found)


def measure(name: str, options: Options, rows: Sequence[Arrangement] = ROWS) -> Measured:
    """Scores of every row for one shape."""
    shape = SHAPES[name]
    truth, seconds = drawn(scene_of(TRUTH, shape, options), settings_of(TRUTH, "traced", options), options.repeat)
    capture = capture_seconds(shape, options) if options.repeat else math.nan
    return Measured({row: score(row, shape, truth, options) for row in rows}, seconds, capture)


def table(results: dict[str, Measured]) -> list[str]:
    """Lines of the table and of the gains. `results`: by name of the shape."""
    columns = [found.scores for found in results.values()]
    rows = list(columns[0])
    head = f"{'tiers':<22}{'proxy':<10}" + "".join(f"{name:>12}" for name in results) + f"{'ms':>7}"
    seconds = statistics.median(found.truth_seconds for found in results.values())
    lines = [head, "-" * len(head)]
    lines.append(f"{TRUTH.label:<22}{'':<10}" + f"{'truth':>12}" * len(results) + f"{1000 * seconds:7.0f}")
    for row in rows:
        cells = "".join(f"{f'{scores[row].psnr:.1f}/{scores[row].flip:.3f}':>12}" for scores in columns)
        seconds = statistics.median(scores[row].seconds for scores in columns)
        lines.append(f"{row.label:<22}{row.proxy:<10}{cells}{1000 * seconds:7.0f}")
    if HDRP in rows:
        lines.append(f"{'HDRP, best model':<32}" + "".join(f"{scores[HDRP].model:>12}" for scores in columns))
    lines += ["", "gain [dB]"]
    for text, better, base in GAINS:
        if better in rows and base in rows:
            gains = "".join(f"{scores[better].psnr - scores[base].psnr:+12.1f}" for scores in columns)
            lines.append(f"{text:<32}{gains}")
    return lines


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=640, help="width of the picture [pixels]; 16:9")
    parser.add_argument("--samples", type=int, default=4)
    parser.add_argument("--shapes", default=",".join(SHAPES))
    parser.add_argument("--resolution", type=int, default=256, help="of a face of the probe [pixels]")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=0)
    arguments = parser.parse_args()
    names = arguments.shapes.split(",")
    if unknown := [name for name in names if name not in SHAPES]:
        parser.error(f"--shapes has {', '.join(unknown)}; choose from {', '.join(SHAPES)}")
    options = Options(arguments.size, arguments.samples, arguments.resolution, max(1, arguments.repeat), arguments.jobs)
    results = {name: measure(name, options) for name in names}
    threads = options.jobs or os.cpu_count()
    print(f"{options.size} x {options.size * 9 // 16}, {options.samples} samples, probe {options.resolution}, "
          f"{threads} threads; PSNR dB / FLIP inside the glass")  # fmt: skip
    print("\n".join(table(results)))
    capture = statistics.median(found.capture_seconds for found in results.values())
    print(f"\ncapturing the probe: {1000 * capture:.0f} ms of every row with a proxy")


if __name__ == "__main__":
    main()
