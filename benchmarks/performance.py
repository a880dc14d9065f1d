"""What docs/performance.md says, measured again: a frame, a cold start, loading, lights, threads, and a path
tracer beside it.

    python -m benchmarks.performance [--parts frame,cold,loading,lights,threads,peers] [--width 1280] [--repeat 5]
                                     [--jobs 0] [--cache FOLDER] [--peers-size 640] [--reference-samples 4096]
                                     [--mitsuba 1,4,16,64] [--write]

`--write` puts each part that was measured into its place in the page, and its short form into README; the other parts
stay as they are. Give it a quiet machine.

    frame       `benchmarks.frame`: warm frames against bare Embree of their own number of rays
    cold        fresh processes, from their start to the written picture
    loading     `benchmarks.loading`, and a million places of one mesh by `benchmarks.instanced`
    lights      the lit room of `benchmarks.two_rooms`, its lamp cut into smaller ones that shine alike, by turns
    threads     one thread and all of them, by turns
    peers       `benchmarks.peers`; needs the extra `bench`, and takes minutes the first time, for the truth
"""

from __future__ import annotations

import argparse
import os
import statistics
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import refract_core as rc
from refract_core.errors import UsageError
from refract_core.kernels import ahead
from refract_core.scene import Light, Scene

from . import instanced, loading, pages, peers
from .frame import Warm, cold_seconds, warm
from .in_refract import scene_of
from .two_rooms import ROOMS

PAGE = pages.ROOT / "docs" / "performance.md"
PICTURES = pages.ROOT / "docs" / "pictures"
GOOD = pages.ROOT / "usd_samples" / "good"
STAGES = {
    "glass_behind_glass": "three pieces of glass, two area lights, a dome",
    "room_of_checkers": "a glass ball in an emissive room",
}
"""sample -> what is in it"""
QUALITIES: dict[str, dict[str, Any]] = {"1 sample": {"samples": 1}, "`good`": {}}
CUTS = (1, 4, 8)
"""Lamps along a side of the one that is cut"""
WIDTHS = (320, 1280)
"""Of the pictures that a cold process draws [pixels]"""
PLACES = 1_000_000
"""Of one mesh"""


class Options(NamedTuple):
    """What the command line says."""

    width: int = 1280
    """of warm frames [pixels]"""
    repeat: int = 5
    jobs: int = 0
    rooms: peers.Options = peers.Options()

    @property
    def threads(self) -> int:
        return self.jobs or os.cpu_count() or 1


class Part(NamedTuple):
    """What a measurement gives the pages."""

    page: str
    readme: str = ""
    """'' where README says nothing of it"""


def by_turns(things: Mapping[str, Callable[[], object]], repeat: int) -> dict[str, float]:
    """Median seconds of each; all take their turns, and the first turn is not counted."""
    times: dict[str, list[float]] = {name: [] for name in things}
    for turn in range(repeat + 1):
        for name, call in things.items():
            start = time.perf_counter()
            call()
            if turn > 0:
                times[name].append(time.perf_counter() - start)
    return {name: statistics.median(took) for name, took in times.items()}


def _stage(name: str) -> Path:
    return GOOD / f"{name}.usda"


# ------------------------------------------------------------------------------------------------ a frame


def frame(options: Options) -> Part:
    """Warm frames against bare Embree."""
    found = {}
    for name in STAGES:
        scene = rc.load_stage(_stage(name))
        for quality, settings in QUALITIES.items():
            asked = rc.RenderSettings(image_width=options.width, jobs=options.threads, **settings)
            found[name, quality] = warm(scene, asked, options.repeat)
    return Part(*(frame_table(found, short=short) for short in (False, True)))


def frame_table(found: Mapping[tuple[str, str], Warm], *, short: bool) -> str:
    """Markdown: (sample, quality) -> its frames. `short` is README's."""
    head = ["stage", "quality", "size", "warm frame", "rays", "rays a second", "warm / bare Embree"]
    rows = [
        [
            f"`{name}.usda`: {STAGES[name]}", quality, "{} x {}".format(*one.size), f"{one.seconds:.2f} s",
            f"{one.rays / 1e6:.1f} M", f"{one.rays / one.seconds / 1e6:.1f} M", f"{one.ratio:.1f}",
        ]
        for (name, quality), one in found.items()
    ]  # fmt: skip
    wanted = (0, 1, 3, 6) if short else range(len(head))
    return pages.table([head[k] for k in wanted], [[row[k] for k in wanted] for row in rows])


# ------------------------------------------------------------------------------------------------ a cold start


def cold(options: Options) -> Part:
    """Fresh processes that draw `marble.usda` at the default quality."""
    jobs = ["--jobs", str(options.threads)]
    found = {
        width: tuple(
            cold_seconds(str(_stage("marble")), ["--image-width", str(width), *jobs], options.repeat, suffix)
            for suffix in (".png", ".exr")
        )
        for width in WIDTHS
    }
    return Part(cold_table(found, ahead.state()[1]), cold_sentence(found))


def cold_table(found: Mapping[int, tuple[float, ...]], lacks: str) -> str:
    """Markdown: width -> seconds with a PNG and with an EXR. `lacks`: why kernels are not those of a wheel, or ''."""
    rows = [[f"{width} pixels wide", *(f"{one:.2f} s" for one in seconds)] for width, seconds in found.items()]
    kernels = f"by numba, in an earlier process, and kept ({lacks})" if lacks else "when the package was built"
    return f"{pages.table(['`marble.usda`', 'to a PNG', 'to an EXR'], rows)}\n\nKernels were compiled {kernels}."


def cold_sentence(found: Mapping[int, tuple[float, ...]]) -> str:
    """README's."""
    told = " and ".join(f"{seconds[0]:.1f} s at {width} pixels" for width, seconds in found.items())
    return f"A fresh process draws `marble.usda` at the default quality in {told}, from its start to the PNG."


# ------------------------------------------------------------------------------------------------ loading


def load(options: Options) -> Part:
    """Many meshes, with normals and texture coordinates and bare; few large ones; and one mesh in a million places."""
    sizes = {"": (1000, 1000, False), ", points alone": (1000, 1000, True), ", large": (10, 100_000, False)}
    found = {
        f"{meshes:,} meshes{name}": loading.loaded(meshes, triangles, bare=bare, repeat=options.repeat)
        for name, (meshes, triangles, bare) in sizes.items()
    }
    return Part(f"{loading_table(found)}\n\n{places_table(instanced.measured(PLACES, 'leaf', 32))}")


def loading_table(found: Mapping[str, loading.Loaded]) -> str:
    """Markdown: what it is -> how it was loaded."""
    head = ["stage", "triangles", "USD alone", "a scene, with USD's part", "tables", "Embree", "bytes a triangle",
            "at the peak"]  # fmt: skip
    rows = [
        [name, f"{one.triangles:,}", *(f"{one.steps[step].seconds:.2f} s" for step in loading.STEPS),
         f"{one.grown['embree']:.0f}", f"{one.grown['peak']:.0f}"]
        for name, one in found.items()
    ]  # fmt: skip
    return pages.table(head, rows)


def places_table(found: instanced.Many) -> str:
    """Markdown: its steps, with what each place costs."""
    told = {"load": "load", "tables": "tables and Embree", "first": "first picture", "second": "second picture"}
    grown = {name: f"{size:.0f}" for name, size in found.grown.items()}
    rows = [
        [told[name], f"{mark.seconds:.2f} s", f"{mark.held / 2**20:.0f} MiB", f"{mark.peak / 2**20:.0f} MiB",
         grown.get(name, "")]
        for name, mark in found.steps.items()
    ]  # fmt: skip
    head = [f"{found.places:,} places of {found.triangles} triangles", "seconds", "held", "peak", "bytes a place"]
    return pages.table(head, rows)


# ------------------------------------------------------------------------------------------------ many lights


def cut(light: Light, count: int) -> list[Light]:
    """A rectangular light as `count` by `count` that fill the same place and shine alike."""
    wide, high = light.size
    steps = (np.arange(count) + 0.5) / count - 0.5
    parts = []
    for row, y in enumerate(steps * high):
        for column, x in enumerate(steps * wide):
            placed = light.world_from_light.copy()
            placed[:3, 3] += placed[:3, 0] * x + placed[:3, 1] * y
            name = f"{light.path}_{row}_{column}"
            parts.append(replace(light, path=name, world_from_light=placed, size=(wide / count, high / count)))
    return parts


def lamps(count: int) -> Scene:
    """The lit room, its lamp cut into `count` by `count`."""
    scene = scene_of(ROOMS["lit"]())
    return replace(scene, lights=tuple(part for light in scene.lights for part in cut(light, count)))


def lights(options: Options) -> Part:
    """Many lights against one, at the default quality."""
    settings = rc.RenderSettings(image_width=options.width, jobs=options.threads)

    def drawing(count: int) -> Callable[[], object]:
        scene = lamps(count)
        return lambda: rc.render(scene, settings)

    seconds = by_turns({str(count * count): drawing(count) for count in CUTS}, options.repeat)
    return Part(lights_table(seconds))


def lights_table(seconds: Mapping[str, float]) -> str:
    """Markdown: number of lights -> seconds; the first is what the others are measured by."""
    first = next(iter(seconds.values()))
    rows = [[count, f"{took:.2f} s", f"{took / first:.1f}"] for count, took in seconds.items()]
    return pages.table(["lights", "frame", "times one"], rows)


# ------------------------------------------------------------------------------------------------ threads


def threads(options: Options) -> Part:
    """All threads against one, at the default quality."""

    def drawing(scene: Scene, jobs: int) -> Callable[[], object]:
        return lambda: rc.render(scene, rc.RenderSettings(image_width=options.width, jobs=jobs))

    found = {}
    for name in STAGES:
        scene = rc.load_stage(_stage(name))
        pair = {str(jobs): drawing(scene, jobs) for jobs in (1, options.threads)}
        found[name] = by_turns(pair, options.repeat)
    return Part(threads_table(found))


def threads_table(found: Mapping[str, Mapping[str, float]]) -> str:
    """Markdown: sample -> threads -> seconds."""
    counts = list(next(iter(found.values())))
    head = ["stage", *(f"{count} thread{'s' if count != '1' else ''}" for count in counts), "times faster"]
    rows = []
    for name, seconds in found.items():
        took = list(seconds.values())
        rows.append([f"`{name}.usda`", *(f"{one:.2f} s" for one in took), f"{took[0] / took[-1]:.2f}"])
    return pages.table(head, rows)


# ------------------------------------------------------------------------------------------------ a path tracer


def beside(options: Options) -> Part:
    """`benchmarks.peers`, and its charts.

    Raises:
        UsageError: Mitsuba is not there, or cannot draw a room.
    """
    mi = peers.mitsuba("llvm_ad_rgb", options.rooms.jobs)
    found = {name: (room := make(), peers.measure(mi, room, options.rooms)) for name, make in ROOMS.items()}
    reports = [line for room, one in found.values() for line in peers.report(room, one, options.rooms)]
    charts = [chart for room, one in found.values() for chart in peers.plot(PICTURES, room, one)]
    shown = "\n".join(f"![Error against time, {chart.stem}](pictures/{chart.name})" for chart in charts)
    text = "\n".join(line.rstrip() for line in reports).rstrip()
    return Part(f"Mitsuba {mi.__version__}.\n\n```text\n{text}\n```\n\n{shown}",
                peers_table({name: (*one.runs, one.best) for name, (_, one) in found.items()}))  # fmt: skip


def peers_table(found: Mapping[str, Iterable[peers.Run]]) -> str:
    """Markdown, README's: room -> what all have drawn; dB in the glass, and seconds."""
    rows: dict[str, list[str]] = {}
    for runs in found.values():
        for run in runs:
            if run.program != peers.PATH:  # what it draws is not in the emissive room
                told = f"{run.scores['glass']:.1f} dB, {run.seconds:.2g} s"
                rows.setdefault(f"{run.program}, {run.name}", []).append(told)
    return pages.table(["", *(f"{name} room" for name in found)], [[name, *cells] for name, cells in rows.items()])


# ------------------------------------------------------------------------------------------------ all of them


PARTS: dict[str, Callable[[Options], Part]] = {
    "frame": frame,
    "cold": cold,
    "loading": load,
    "lights": lights,
    "threads": threads,
    "peers": beside,
}
"""What is measured: by the name of its place in the page, and in README where it has one there."""


def made(name: str, options: Options) -> str:
    """One line on how a part was measured."""
    rooms = options.rooms
    size = rooms.size if name == "peers" else options.width
    wide = "" if name in ("cold", "loading") else f", {size} pixels wide"
    turns = rooms.repeat if name == "peers" else options.repeat
    return f"`python -m benchmarks.performance --parts {name}` on {pages.machine()}{wide}, medians of {turns}:"


def put(found: Mapping[str, Part], options: Options, page: Path = PAGE, readme: Path = pages.README) -> None:
    """Write what was measured into its places."""
    for path, told in ((page, lambda part: part.page), (readme, lambda part: part.readme)):
        texts = {name: told(part) for name, part in found.items()}
        pages.write(path, {name: f"{made(name, options)}\n\n{text}" for name, text in texts.items() if text})


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split(","))


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(word) for word in text.split(","))


def main() -> None:
    """Print what the page says, and write it there where asked to."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", type=_names, default=tuple(PARTS))
    parser.add_argument("--width", type=int, default=Options().width, help="of warm frames [pixels]")
    parser.add_argument("--repeat", type=int, default=Options().repeat)
    parser.add_argument("--jobs", type=int, default=0)
    parser.add_argument("--cache", type=Path, default=peers.CACHE, help="where the truth of the rooms is kept")
    parser.add_argument("--peers-size", type=int, default=peers.Options().size, help="width of the rooms [pixels]")
    parser.add_argument("--reference-samples", type=int, default=peers.Options().reference_samples, help="of the truth")
    parser.add_argument("--mitsuba", type=_numbers, default=(1, 4, 16, 64), help="samples a pixel: squares")
    parser.add_argument("--write", action="store_true", help=f"into {PAGE.relative_to(pages.ROOT)} and README.md")
    chosen = parser.parse_args()
    if unknown := [name for name in chosen.parts if name not in PARTS]:
        parser.error(f"--parts has {', '.join(unknown)}; choose from {', '.join(PARTS)}")
    repeat = max(1, chosen.repeat)
    rooms = peers.Options(
        size=chosen.peers_size, mitsuba=chosen.mitsuba, reference_samples=chosen.reference_samples, repeat=repeat,
        jobs=chosen.jobs, cache=chosen.cache,
    )  # fmt: skip
    options = Options(chosen.width, repeat, chosen.jobs, rooms)
    left_out = []
    for name in chosen.parts:
        try:
            part = PARTS[name](options)
        except UsageError as error:
            left_out.append(f"{name} is left out: {error}")
            continue
        print(f"{made(name, options)}\n\n{part.page}\n", flush=True)
        if chosen.write:
            put({name: part}, options)
    if left_out:
        raise SystemExit("\n".join(left_out))


if __name__ == "__main__":
    main()
