"""All that light does once: a table under three lights, in refract and in Mitsuba 3 kept to the same paths, by turns.

    python -m benchmarks.light [--width 640] [--truth-samples 4096] [--levels NAMES] [--knobs] [--mitsuba 1,4,16,64]
                               [--repeat 3] [--jobs 0] [--cache FOLDER] [--pictures FOLDER] [--write]

The room is `two_rooms.table_room`, handed to both from the same numbers: a ball, a cube, a lens and a hollow, tinted
bottle of glass and a matt ball, under a square lamp, a globe and a sun of 12 degrees, without a sky. The truth is what
an integrator of Mitsuba's parts finds (`in_mitsuba`) that goes where ours goes, and nowhere else: camera, glass, one
matt surface, glass, lamp. What glass brings to the floor and the wall is thrown from the lamps, and kept in squares of
2.5 mm (`Light.THROWN`): from the eye's side alone it would take a hundred times as long. Its own noise is a line of the
table; it is not counted as anybody's error (`peers.scores`), but what is far below it is not known well.

    receivers   what is not glass, and what glass does not light or shade: seen through a window of 5 x 5 pixels, the
                picture is the same to 1/255 if light goes straight through all glass
    shadow      what is darker than that
    caustic     what is brighter
    glass       pixels in which glass is met first

"Mitsuba" is that integrator from the eye's side alone (`Light.ONCE`), against the same truth. "Mitsuba path" is its
own, against its own converged picture: matt surfaces light each other, lamps are seen through glass and hide each
other, and the bottle is clear, as `path` knows no absorption. It has the same number of samples for its truth.

`--knobs` draws with one setting after the other changed: what each brings to `good`, and what it costs.

PSNR is that of sRGB pictures, clipped as they would be shown. Seconds are the median of the repeats after a first time
that is not counted, on all cores; ours build tables, hierarchy and caustics in every frame.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from refract_core.errors import UsageError
from refract_core.scene import F32, F64
from refract_core.settings import QUALITIES, named_settings
from refract_core.verbs.compare import Mask, displayed

from . import pages, peers
from .in_mitsuba import Light, load
from .peers import OURS, PATH, THEIRS, Entrant, Run
from .truth import Truth, converged
from .two_rooms import table_room

PAGE = pages.ROOT / "docs" / "performance.md"
KNOBS: dict[str, dict[str, Any]] = {
    "4 times the photons": {"caustics": 1 << 18},
    "16 times the photons": {"caustics": 1 << 20},
    "cut 0.002": {"cut": 0.002},
    "128 light samples": {"light_samples": 128},
    "tolerance 0.01": {"tolerance": 0.01},
    "64 samples": {"samples": 64},
    "256 samples, tolerance 0.005": {"samples": 256, "tolerance": 0.005},
    "by rays alone": {"tiers": ("ray", "sky")},
}
"""name -> settings beyond those of `good`"""
ALL = "all of these"


class Options(NamedTuple):
    """What the command line says."""

    width: int = 640
    """[pixels]; 16:9"""
    truth_samples: int = 4096
    levels: tuple[str, ...] = ("draft", "good", "best")
    knobs: bool = False
    mitsuba: tuple[int, ...] = (1, 4, 16, 64)
    """samples a pixel"""
    repeat: int = 3
    jobs: int = 0
    cache: Path = peers.CACHE
    pictures: Path | None = None


class Found(NamedTuple):
    """What came of it."""

    runs: list[Run]
    truth: Truth
    regions: dict[str, Mask]


def regions_of(share: F32, straight: F64, once: F64) -> dict[str, Mask]:
    """Which pixels are measured together.

    Args:
        share: of a pixel in which glass is met first, shape (H, W).
        straight: picture with light that goes straight through glass; so is `once`, with all that glass does to it;
            linear, shape (H, W, 3).
    """
    apart = peers.blurred(displayed(once)) - peers.blurred(displayed(straight))
    largest = np.take_along_axis(apart, np.abs(apart).argmax(-1)[..., None], -1)[..., 0]
    glass, same = share > 0.0, np.abs(largest) <= peers.SAME
    return {
        "receivers": ~glass & same,
        "shadow": ~glass & ~same & (largest < 0.0),
        "caustic": ~glass & ~same & (largest > 0.0),
        "glass": glass,
    }


def settings_of(options: Options) -> dict[str, dict[str, Any]]:
    """What is measured of ours: name -> settings."""
    found = {level: named_settings(level) for level in options.levels}
    if options.knobs:
        good = QUALITIES["good"]
        found |= {f"good, {name}": {**good, **change} for name, change in KNOBS.items()}
        found[f"good, {ALL}"] = {**good, **{key: value for change in KNOBS.values() for key, value in change.items()}}
    return found


def measure(mi: Any, options: Options) -> Found:
    """Find the truths, let all draw by turns, and compare.

    Raises:
        UsageError: this variant of Mitsuba cannot draw the room.
    """
    room = table_room()
    loaded = load(mi, room, options.width)
    wanted = [Light.STRAIGHT, Light.THROWN, *([Light.PATH] if options.mitsuba else [])]
    truths = {
        light: converged(room, light, loaded, options.truth_samples, options.cache, peers.tell) for light in wanted
    }
    truth = truths[Light.THROWN]
    regions = regions_of(truth.share, truths[Light.STRAIGHT].linear, truth.linear)
    same_size = peers.Options(size=options.width, jobs=options.jobs)
    entrants = [
        Entrant(OURS, name, peers.ours(room, same_size, settings), truth.halves)
        for name, settings in settings_of(options).items()
    ]
    for n in options.mitsuba:
        entrants.append(Entrant(THEIRS, f"{n} spp", peers.theirs(loaded, n, Light.ONCE), truth.halves))
        entrants.append(Entrant(PATH, f"{n} spp", peers.theirs(loaded, n, Light.PATH), truths[Light.PATH].halves))
    runs = peers.race(entrants, regions, options.repeat)
    if options.pictures is not None:
        _show(options.pictures, {"truth": truth.linear, **{e.name: e.picture(0) for e in entrants}}, truth.linear)
    return Found(runs, truth, regions)


def _show(folder: Path, pictures: Mapping[str, Any], truth: F64) -> None:
    """Write pictures, and beside each eight times what parts it from the truth, around grey."""
    from PIL import Image

    folder.mkdir(parents=True, exist_ok=True)
    for name, linear in pictures.items():
        shown = displayed(linear)
        apart = 0.5 + 8.0 * (shown - displayed(truth))
        both = np.concatenate([shown, np.clip(apart, 0.0, 1.0)], 1)
        Image.fromarray((255.0 * both + 0.5).astype(np.uint8)).save(folder / f"{name.replace(' ', '-')}.png")


# ------------------------------------------------------------------------------------------------ what is printed


def table(found: Found) -> str:
    """Markdown: every entrant, then what bounds what can be said."""
    rows = [[f"{run.program}, {run.name}", f"{run.seconds:.2f}", *_cells(run.scores)] for run in found.runs]
    noise = {name: found.truth.noise(mask) if mask.any() else math.nan for name, mask in found.regions.items()}
    rows.append(["noise of the truth itself", "", *_cells(noise)])
    shares = {name: 100.0 * float(mask.mean()) for name, mask in found.regions.items()}
    rows.append(["share of the picture [%]", "", *_cells(shares)])
    return pages.table(["", "seconds", *found.regions], rows)


def _cells(values: Mapping[str, float]) -> Sequence[str]:
    return ["-" if math.isnan(value) else f"{value:.1f}" for value in values.values()]


def block(found: Found, options: Options) -> str:
    """What the page gets."""
    width = options.width
    asked = (" --knobs" if options.knobs else "") + (f" --width {width}" if width != Options().width else "")
    how = f"`python -m benchmarks.light{asked}` on {pages.machine()}"
    size = f"{width} x {width * 9 // 16}, {options.jobs or os.cpu_count()} threads"
    truth = f"the truth has {found.truth.samples} samples a pixel"
    return f"{how}, {size}, medians of {options.repeat}; {truth}; dB:\n\n{table(found)}"


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(word) for word in text.split(",") if word)


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split(","))


def main() -> None:
    """Print the table, and write it into the page where asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = Options()
    parser.add_argument("--width", type=int, default=default.width, help="of the picture [pixels]; 16:9")
    parser.add_argument("--truth-samples", type=int, default=default.truth_samples, help="a pixel, of each truth")
    parser.add_argument("--levels", type=_names, default=default.levels, help="of ours, by name")
    parser.add_argument("--knobs", action="store_true", help="what each setting brings to `good`")
    parser.add_argument("--mitsuba", type=_numbers, default=default.mitsuba, help="samples a pixel: squares; '' none")
    parser.add_argument("--repeat", type=int, default=default.repeat)
    parser.add_argument("--jobs", type=int, default=0)
    parser.add_argument("--cache", type=Path, default=default.cache, help="where the truth is kept")
    parser.add_argument("--pictures", type=Path, help="where pictures and differences are written; needs Pillow")
    parser.add_argument("--variant", default="llvm_ad_rgb", help="of Mitsuba")
    parser.add_argument("--write", action="store_true", help=f"into {PAGE.relative_to(pages.ROOT)}")
    chosen = parser.parse_args()
    if unknown := [name for name in chosen.levels if name not in QUALITIES]:
        parser.error(f"--levels has {', '.join(unknown)}; choose from {', '.join(QUALITIES)}")
    options = Options(
        chosen.width, chosen.truth_samples, chosen.levels, chosen.knobs, chosen.mitsuba, max(1, chosen.repeat),
        chosen.jobs, chosen.cache, chosen.pictures,
    )  # fmt: skip
    try:
        found = measure(peers.mitsuba(chosen.variant, chosen.jobs), options)
    except UsageError as error:
        parser.error(str(error))
    text = block(found, options)
    print(text)
    if chosen.write:
        pages.write(PAGE, {"light": text})


if __name__ == "__main__":
    main()
