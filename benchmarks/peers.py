"""Error against time, beside a path tracer: refract and Mitsuba 3 draw the same two rooms, by turns.

    python -m benchmarks.peers [--rooms emissive,lit] [--size 640] [--levels NAMES] [--mitsuba 1,4,16,64,256,1024]
                               [--reference-samples 4096] [--repeat 3] [--jobs 0] [--cache FOLDER] [--plots FOLDER]

The rooms are those of `benchmarks.two_rooms`, handed to each program from the same numbers. The truth is Mitsuba's own
picture with 4,096 samples a pixel, kept in the cache (`benchmarks.truth`); its own noise is printed, for nothing can be
measured beyond it. Every number in dB is the PSNR of sRGB pictures, clipped as they would be shown, within one region:

    glass       pixels in which glass is met first, its silhouette included
    elsewhere   the others, where nothing is lit
    untouched   of the others in the lit room, those that no caustic touches: seen through a window of 5 x 5 pixels, the
                picture is the same to 1/255 whether glass lets light straight through or does with it what glass does
    touched     the rest: shadows and caustics of glass

In the lit room matt surfaces do not light each other, in either program (`benchmarks.in_mitsuba`), and the truth is all
that glass does to light: shadows, caustics, and the lamp seen through glass, which the engine shows in mirror pictures,
but not straight through. A second truth, in which light goes straight through, tells which pixels caustics touch.
"Mitsuba path" is Mitsuba as anybody would use it, with light between surfaces, too, against its own converged picture.

Seconds are the median of the repeats, after a first time that is not counted, both programs by turns on all cores. Ours
build the scene's tables and its hierarchy in every frame; Mitsuba's scene is loaded before, but it goes through its
integrator's Python again in every frame. What that is, a picture of 16 x 9 pixels tells.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import refract_core as rc
from refract_core.errors import UsageError
from refract_core.scene import F32, F64
from refract_core.settings import named_settings
from refract_core.verbs.compare import Mask, Picture, displayed, psnr

from .curves import Needed, Point, needed, svg, times_faster
from .in_mitsuba import Light, Loaded, draw, library, load
from .in_refract import scene_of
from .truth import Truth, converged
from .two_rooms import ROOMS, Room

OURS, THEIRS, PATH = "refract", "Mitsuba", "Mitsuba path"
LEVELS: dict[str, dict[str, Any]] = {level: named_settings(level) for level in ("draft", "good", "best")}
"""What is measured of ours: the name in the table, and the settings beyond size and threads."""
BEST: tuple[str, dict[str, Any]] = ("reference", {**named_settings("reference"), "samples": 64})
"""The nearest to the truth that ours can come; drawn once, and not timed by turns."""
DECIBELS = (31, 33, 37, 43, 45, 49)
CACHE = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "refract-benchmarks"
"""Where the truth is kept if nobody says otherwise."""
_WINDOW = 5
SAME = 1.0 / 255.0
_ENOUGH = 20.0
"""Seconds of counted turns after which more would say nothing new."""


class Entrant(NamedTuple):
    """A program with its settings."""

    program: str
    name: str
    picture: Callable[[int], F32]
    """turn -> shape (H, W, 3), linear. Where there is noise it is another one in every turn."""
    truth: Picture
    """What it would be with samples without end, linear; as `scores`"""


class Run(NamedTuple):
    """What came of an entrant: medians over the turns."""

    program: str
    name: str
    seconds: float
    scores: dict[str, float]
    """region -> PSNR [dB]"""


class Options(NamedTuple):
    """What the command line says."""

    size: int = 640
    """width [pixels]; 16:9"""
    levels: tuple[str, ...] = tuple(LEVELS)
    mitsuba: tuple[int, ...] = (1, 4, 16, 64, 256, 1024)
    """samples a pixel"""
    reference_samples: int = 4096
    repeat: int = 3
    jobs: int = 0
    cache: Path = Path()


class Measured(NamedTuple):
    """Everything about one room."""

    runs: list[Run]
    best: Run
    truth: Truth
    regions: dict[str, Mask]
    smallest: dict[str, float]
    """program -> seconds of a picture of 16 x 9 pixels with one sample"""


def ours(room: Room, options: Options, level: dict[str, Any]) -> Callable[[int], F32]:
    """Draws a room with a level's settings."""
    scene = scene_of(room)
    settings = rc.RenderSettings(image_width=options.size, jobs=options.jobs, **level)

    def picture(turn: int) -> F32:
        return rc.render(scene, settings).planes["beauty"][..., :3]

    return picture


def theirs(loaded: Loaded, samples: int, light: Light = Light.STRAIGHT) -> Callable[[int], F32]:
    """Draws a loaded room with another seed in every turn."""
    return partial(draw, loaded, light, samples)


def regions_of(share: F32, straight: F64, world: F64 | None) -> dict[str, Mask]:
    """Which pixels are measured together. `share`: of glass; the others: the truths, linear, shape (H, W, 3)."""
    glass = share > 0.0
    if world is None:
        return {"glass": glass, "elsewhere": ~glass}
    apart = np.abs(blurred(displayed(straight)) - blurred(displayed(world))).max(-1)
    touched = apart > SAME
    return {"glass": glass, "untouched": ~glass & ~touched, "touched": ~glass & touched}


def blurred(picture: Picture) -> F64:
    """Means over windows of 5 x 5 pixels, at the borders over what there is of them."""
    edge = _WINDOW // 2
    padded = np.pad(np.asarray(picture, np.float64), ((edge, edge), (edge, edge), (0, 0)), mode="edge")
    return np.asarray(np.lib.stride_tricks.sliding_window_view(padded, (_WINDOW, _WINDOW), (0, 1)).mean((-2, -1)))


def scores(linear: Picture, truth: Picture, regions: dict[str, Mask]) -> dict[str, float]:
    """PSNR by region [dB]; nan where a region is empty.

    Args:
        truth: shape (H, W, 3); or (2, H, W, 3), two independent halves of it. The mean product of what parts the
            picture from each is free of the truth's own noise, which is in each half another.
    """
    if truth.ndim == 3:
        pair = displayed(linear), displayed(truth)
        return {name: psnr(*pair, mask) if mask.any() else math.nan for name, mask in regions.items()}
    shown = displayed(linear).astype(np.float64)
    products = np.prod([shown - displayed(half) for half in truth], axis=0)
    means = {name: products[mask].mean() if mask.any() else math.nan for name, mask in regions.items()}
    return {name: math.inf if mean <= 0.0 else -10.0 * math.log10(mean) for name, mean in means.items()}


def race(entrants: Sequence[Entrant], regions: dict[str, Mask], repeat: int) -> list[Run]:
    """Let all draw by turns. The first turn compiles, and is not counted; who has drawn long enough drops out."""
    times: list[list[float]] = [[] for _ in entrants]
    errors: list[list[dict[str, float]]] = [[] for _ in entrants]
    for turn in range(repeat + 1):
        for k, entrant in enumerate(entrants):
            if sum(times[k]) > _ENOUGH:
                continue
            start = time.perf_counter()
            picture = entrant.picture(turn)
            if turn > 0:
                times[k].append(time.perf_counter() - start)
                errors[k].append(scores(picture, entrant.truth, regions))
    return [
        Run(entrant.program, entrant.name, statistics.median(took), _medians(found))
        for entrant, took, found in zip(entrants, times, errors, strict=True)
    ]


def _medians(found: list[dict[str, float]]) -> dict[str, float]:
    return {name: statistics.median(one[name] for one in found) for name in found[0]}


def _timed(picture: Callable[[int], F32]) -> tuple[F32, float]:
    """The second picture, and its seconds."""
    picture(0)
    start = time.perf_counter()
    return picture(1), time.perf_counter() - start


def measure(mi: Any, room: Room, options: Options) -> Measured:
    """Find the truth, let all draw, and compare.

    Raises:
        UsageError: this variant of Mitsuba cannot draw the room.
    """
    loaded = load(mi, room, options.size)
    wanted = (Light.STRAIGHT, Light.WORLD, Light.PATH) if room.lamp is not None else (Light.STRAIGHT,)
    truths = {
        light: converged(room, light, loaded, options.reference_samples, options.cache, tell) for light in wanted
    }
    straight, drawn = truths[Light.STRAIGHT], Light.STRAIGHT if room.lamp is None else Light.WORLD
    truth = truths[drawn]
    regions = regions_of(straight.share, straight.linear, None if room.lamp is None else truth.linear)
    entrants = [Entrant(OURS, name, ours(room, options, LEVELS[name]), truth.linear) for name in options.levels]
    for program, light in ((THEIRS, drawn), (PATH, Light.PATH)):
        if light in truths:
            own = truths[light].linear
            entrants += [Entrant(program, f"{n} spp", theirs(loaded, n, light), own) for n in options.mitsuba]
    runs = race(entrants, regions, options.repeat)
    picture, seconds = _timed(ours(room, options, BEST[1]))
    best = Run(OURS, f"{BEST[0]} (best)", seconds, scores(picture, truth.linear, regions))
    tiny = options._replace(size=16)
    smallest = {
        OURS: _timed(ours(room, tiny, LEVELS[options.levels[0]]))[1],
        THEIRS: _timed(theirs(load(mi, room, 16), 1))[1],
    }
    return Measured(runs, best, truth, regions, smallest)


def tell(fraction: float, what: str) -> None:
    print(f"\r{what} {100.0 * fraction:3.0f} %", end="" if fraction < 1.0 else "\n", file=sys.stderr, flush=True)


# ------------------------------------------------------------------------------------------------ what is printed


def curves_of(runs: Sequence[Run], region: str) -> dict[str, list[Point]]:
    """program -> its pictures, as error against time."""
    found: dict[str, list[Point]] = {}
    for run in runs:
        found.setdefault(run.program, []).append(Point(run.name, run.seconds, run.scores[region]))
    return found


def table(found: Measured) -> list[str]:
    """Lines: every entrant, then what bounds what can be said."""
    head = f"{'':<28}{'seconds':>10}" + "".join(f"{name:>12}" for name in found.regions)
    lines = [head, "-" * len(head)]
    for run in (*found.runs, found.best):
        lines.append(f"{run.program + ', ' + run.name:<28}{run.seconds:10.3f}" + _cells(run.scores))
    noise = {name: found.truth.noise(mask) if mask.any() else math.nan for name, mask in found.regions.items()}
    lines.append(f"{'noise of the truth itself':<38}" + _cells(noise))
    shares = {name: 100.0 * float(mask.mean()) for name, mask in found.regions.items()}
    lines.append(f"{'share of the picture [%]':<38}" + _cells(shares))
    return lines


def _cells(values: dict[str, float]) -> str:
    return "".join(f"{'-' if math.isnan(value) else f'{value:.1f}':>12}" for value in values.values())


def ratios(found: Measured) -> list[str]:
    """Lines: how many times faster ours are, by region and error."""
    lines = [f"{'times faster, to reach dB':<28}" + "".join(f"{decibels:>8}" for decibels in DECIBELS)]
    for region in found.regions:
        times = {name: [needed(curve, d) for d in DECIBELS] for name, curve in curves_of(found.runs, region).items()}
        for name, their in times.items():
            if name != OURS:
                pairs = zip(times[OURS], their, strict=True)
                lines.append(f"{region + ', than ' + name:<28}" + "".join(f"{times_faster(*p):>8}" for p in pairs))
        for name, seconds in times.items():
            lines.append(f"  {name + ', seconds':<26}" + "".join(f"{_seconds(one):>8}" for one in seconds))
    return lines


def _seconds(of: Needed) -> str:
    return "-" if math.isnan(of.seconds) else f"{'<' if of.at_most else ''}{of.seconds:.2g}"


def report(room: Room, found: Measured, options: Options) -> list[str]:
    """All lines about a room."""
    title = f"{room.name} room, {options.size} x {options.size * 9 // 16}, {options.jobs or os.cpu_count()} threads"
    smallest = ", ".join(f"{name} {1000.0 * seconds:.0f} ms" for name, seconds in found.smallest.items())
    samples = f"the truth has {found.truth.samples} samples a pixel; PSNR in dB"
    return [f"{title}; {samples}", *table(found), "", *ratios(found), "", f"a picture of 16 x 9 pixels: {smallest}", ""]


def plot(folder: Path, room: Room, found: Measured) -> list[Path]:
    """Write a chart for every region."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for region in found.regions:
        path = folder / f"peers-{room.name}-{region}.svg"
        chart = svg(f"{room.name} room, {region}: PSNR in dB", curves_of(found.runs, region))
        path.write_text(chart, encoding="utf-8")
        written.append(path)
    return written


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(word) for word in text.split(","))


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split(","))


def mitsuba(variant: str, jobs: int) -> Any:
    """Mitsuba, slower where LLVM is not to be had.

    Raises:
        UsageError: it is not installed, or this variant is not.
    """
    try:
        return library(variant, jobs)
    except UsageError as error:
        if not variant.startswith("llvm") or "mitsuba" not in sys.modules:
            raise
        print(f"{error}. Using scalar_rgb, which is many times slower: say nothing of its seconds", file=sys.stderr)
        return library("scalar_rgb", jobs)


def main() -> None:
    """Print the tables and write the charts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rooms", type=_names, default=tuple(ROOMS))
    parser.add_argument("--size", type=int, default=640, help="width of the picture [pixels]; 16:9")
    parser.add_argument("--levels", type=_names, default=tuple(LEVELS), help="of ours, by name")
    parser.add_argument("--mitsuba", type=_numbers, default=Options().mitsuba, help="samples a pixel: squares")
    parser.add_argument("--reference-samples", type=int, default=4096, help="of the truth")
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=0)
    parser.add_argument("--cache", type=Path, default=CACHE, help="where the truth is kept")
    parser.add_argument("--plots", type=Path, help="where the charts are written; default: the cache")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="of Mitsuba")
    chosen = parser.parse_args()
    for flag, names, known in (("--rooms", chosen.rooms, ROOMS), ("--levels", chosen.levels, LEVELS)):
        if unknown := [name for name in names if name not in known]:
            parser.error(f"{flag} has {', '.join(unknown)}; choose from {', '.join(known)}")
    options = Options(
        chosen.size, chosen.levels, chosen.mitsuba, chosen.reference_samples, max(1, chosen.repeat), chosen.jobs,
        chosen.cache,
    )  # fmt: skip
    try:
        mi = mitsuba(chosen.variant, chosen.jobs)
    except UsageError as error:
        parser.error(str(error))
    for name in chosen.rooms:
        room = ROOMS[name]()
        try:
            found = measure(mi, room, options)
        except UsageError as error:
            print(f"{room.name} room left out: {error}", file=sys.stderr)
            continue
        print("\n".join(report(room, found, options)))
        for path in plot(chosen.plots or chosen.cache, room, found):
            print(f"wrote {path}")
        print()


if __name__ == "__main__":
    main()
