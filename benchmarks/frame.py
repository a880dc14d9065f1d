"""Seconds for one frame, cold and warm, against the same number of rays through bare Embree.

    python -m benchmarks.frame [STAGE] [--width 1280] [--height 720] [--samples 1] [--repeat 7] [--jobs 0]

Cold is a fresh process from its start to the written PNG, with the kernels compiled before. Warm is `render` alone,
second and later calls in one process, median. Bare is the frame's number of rays traced as the camera's own rays,
which are the most coherent of all: packets of eight, COHERENT, 4x2 blocks, no shading, the same threads, best run.
So the ratio counts everything but tracing against us, and incoherence too.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import refract_core as rc
from refract_core.kernels.compile import kernel
from refract_core.kernels.lanes import LANES, by_address, scratch
from refract_core.rendering.work import tiles_of
from refract_core.view.camera import image_size, view_of
from refract_core.view.gbuffer import ViewScratch, add_view_ray
from refract_core.world.embree import EVERYTHING, T_FAR, clear, intersect
from refract_core.world.tables import pack_geometry

DEFAULT_STAGE = Path(__file__).parents[1] / "usd_samples" / "good" / "glass_behind_glass.usda"


@kernel
def bare_tile(handle, view, work, tile):  # type: ignore[no-untyped-def]
    """The camera's rays over a tile and nothing else. Returns the number traced and a checksum."""
    packet = work.packet
    packet.tally[0] = 0
    total = 0.0
    for y0 in range(tile[1], tile[3], 2):
        for x0 in range(tile[0], tile[2], 4):
            clear(packet)
            for lane in range(LANES):
                add_view_ray(packet, view, lane, x0 + lane % 4, y0 + lane // 4, EVERYTHING)
            intersect(packet, handle, True)
            total += packet.rays[T_FAR, 0]
    return packet.tally[0], total


def bare_seconds_per_ray(scene: rc.Scene, width: int, height: int, jobs: int, repeat: int) -> float:
    """Best run of the camera's rays alone on `jobs` threads."""
    geometry, bvh, _slots = pack_geometry(scene)
    view = by_address(view_of(scene.cameras[0], width, height))
    tiles = tiles_of(width, height, 64)
    best = float("inf")
    with ThreadPoolExecutor(jobs) as pool:
        for _ in range(repeat + 1):
            start = time.perf_counter()
            counts = list(pool.map(lambda tile: bare_tile(geometry.handle, view, scratch(ViewScratch), tile)[0], tiles))
            best = min(best, (time.perf_counter() - start) / sum(counts))
    bvh.close()
    return best


def cold_seconds(stage: str, options: list[str], repeat: int, suffix: str = ".png") -> float:
    """Median of fresh processes that render the stage to a picture."""
    with tempfile.TemporaryDirectory() as folder:
        out = str(Path(folder) / f"out{suffix}")
        command = [sys.executable, "-m", "refract_core.cli", "render", stage, out, *options]
        subprocess.run(command, check=True)  # compiles what is not compiled yet
        times = []
        for _ in range(repeat):
            start = time.perf_counter()
            subprocess.run(command, check=True)
            times.append(time.perf_counter() - start)
    return statistics.median(times)


class Warm(NamedTuple):
    """Frames of one stage in one process, and bare Embree."""

    size: tuple[int, int]
    """[pixels]"""
    times: tuple[float, ...]
    """seconds of each frame"""
    rays: int
    """of a frame"""
    bare: float
    """seconds of as many rays of the camera alone, on the same threads"""

    @property
    def seconds(self) -> float:
        return statistics.median(self.times)

    @property
    def ratio(self) -> float:
        return self.seconds / self.bare


def warm(scene: rc.Scene, settings: rc.RenderSettings, repeat: int) -> Warm:
    """Draw a scene again and again."""
    jobs = settings.jobs or os.cpu_count() or 1
    frame = rc.render(scene, settings)
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        rc.render(scene, settings)
        times.append(time.perf_counter() - start)
    rays = int(frame.metadata["refract:rays"])
    size = image_size(scene.cameras[0], settings.image_width, settings.image_height)
    return Warm(size, tuple(times), rays, bare_seconds_per_ray(scene, *size, jobs, repeat) * rays)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stage", nargs="?", default=str(DEFAULT_STAGE))
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--height", type=int, default=720)
    parser.add_argument("--samples", type=int, default=1)
    parser.add_argument("--repeat", type=int, default=7)
    parser.add_argument("--jobs", type=int, default=0)
    parser.add_argument("--tiers", default=",".join(rc.RenderSettings().tiers))
    arguments = parser.parse_args()
    jobs = arguments.jobs or os.cpu_count() or 1
    options = ["--image-width", arguments.width, "--image-height", arguments.height, "--samples", arguments.samples,
               "--jobs", jobs, "--tiers", arguments.tiers]  # fmt: skip
    cold = cold_seconds(arguments.stage, [str(option) for option in options], max(3, arguments.repeat // 2))
    scene = rc.load_stage(arguments.stage)
    settings = rc.RenderSettings(
        image_width=arguments.width, image_height=arguments.height, samples=arguments.samples, jobs=jobs,
        tiers=tuple(arguments.tiers.split(",")),
    )  # fmt: skip
    found = warm(scene, settings, arguments.repeat)
    width, height = found.size
    print(f"{Path(arguments.stage).name}, {width}x{height}, {arguments.samples} sample(s), {jobs} threads")
    print(f"cold process            {cold:8.3f} s")
    print(f"warm frame              {found.seconds:8.3f} s   (min {min(found.times):.3f}, max {max(found.times):.3f})")
    print(f"rays                    {found.rays:8d}     {found.rays / found.seconds / 1e6:.1f} Mray/s in the frame")
    print(f"bare Embree, same count {found.bare:8.3f} s   {found.rays / found.bare / 1e6:.1f} Mray/s")
    print(f"warm / bare             {found.ratio:8.2f}")


if __name__ == "__main__":
    main()
