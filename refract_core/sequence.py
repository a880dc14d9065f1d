"""From a stage on disk to picture files: one frame or many, with the settings that a person and the stage chose."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from .errors import Cancelled, UsageError
from .progress import Report
from .scene import Notice, Scene
from .settings import RenderSettings

COMPLEXITIES = ("low", "medium", "high", "veryhigh")


@dataclass(frozen=True, kw_only=True)
class Order:
    """What to render, and where to."""

    stage: str
    """Path of the stage."""
    out: str
    """Path of the picture; with `frames`, a pattern with a ### group."""
    frames: str = ""
    """USD frame specs with commas between; '' is the stage's start."""
    overrides: Mapping[str, object] = field(default_factory=dict)
    """Fields of `RenderSettings` that win over what the stage authors."""
    settings_prim: str = ""
    """RenderSettings prim whose authored values win over the defaults; '' is the one the stage names, if any."""
    aovs: tuple[str, ...] = ()
    color_correction: str = "sRGB"
    complexity: str = "low"
    skip_existing: bool = False


def render_files(order: Order, report: Report, cancel: Callable[[], bool]) -> None:
    """Render every picture of an order and write it.

    Args:
        order: checked completely before the first ray, as far as that is possible.
        report: told about progress, notices and files.
        cancel: True stops the work; files that are complete stay.

    Raises:
        RefractError: whatever goes wrong.
    """
    from .image import check_output, check_writable
    from .usd.frames import frame_jobs

    _settings({}, order.overrides)
    if order.complexity not in COMPLEXITIES:
        raise UsageError(f"--complexity is '{order.complexity}', not known; choose from {', '.join(COMPLEXITIES)}")
    check_output(order.out, order.aovs, order.color_correction)
    check_writable(order.out)
    jobs = frame_jobs(order.frames, order.out)
    for job in jobs:
        if order.skip_existing and os.path.exists(job.path):
            report.done(job.path, "exists, skipped")
    jobs = [job for job in jobs if not (order.skip_existing and os.path.exists(job.path))]
    if jobs:
        _render_jobs(order, jobs, report, cancel)


def _render_jobs(order: Order, jobs: Sequence[Any], report: Report, cancel: Callable[[], bool]) -> None:
    from .render import render
    from .usd.settings import read_settings
    from .usd.stage import open_stage, scene_from_stage

    told: set[Notice] = set()

    def tell(notices: Sequence[Notice]) -> None:
        for notice in notices:
            if notice not in told:
                told.add(notice)
                report.warning(notice.path, notice.text)

    report.progress(0.0, "reading the stage")
    stage = open_stage(order.stage)
    found: list[Notice] = []
    if order.complexity != "low":
        found.append(Notice("--complexity", "subdivision is not done yet, so every complexity draws the same"))
    settings = _settings(read_settings(stage, order.settings_prim, found), order.overrides)
    tell(found)
    for done, job in enumerate(jobs):
        started = time.perf_counter()
        _stop_if(cancel)
        scene = scene_from_stage(stage, time_code=job.time_code, purposes=settings.purposes, camera=settings.camera)
        tell(scene.notices)
        if done == 0:
            tell(_stale(stage, scene, settings))
        _stop_if(cancel)
        frame = render(scene, settings, progress=_part(report, done, len(jobs)), cancel=cancel)
        tell(frame.notices)
        _stop_if(cancel)
        frame.save(job.path, aovs=order.aovs, color_correction=order.color_correction)
        seconds = time.perf_counter() - started
        size = os.path.getsize(job.path)
        report.done(job.path, f"{frame.width} x {frame.height}, {_bytes(size)}, {seconds:.1f} s")


def _stale(stage: Any, scene: Scene, settings: RenderSettings) -> list[Notice]:
    """Baked probes that no longer show what is there; each is asked about the time it was baked at."""
    if not any(probe.bake for probe in scene.probes):
        return []
    from .bake import stale_bakes
    from .usd.stage import scene_from_stage

    def scene_at(time_code: float) -> Scene:
        if time_code == scene.time_code and settings.purposes == RenderSettings().purposes:
            return scene
        return scene_from_stage(stage, time_code=time_code)

    return stale_bakes(scene.probes, scene_at)


def _settings(authored: Mapping[str, object], overrides: Mapping[str, object]) -> RenderSettings:
    """Defaults, then what the stage authors, then what the caller says."""
    chosen: dict[str, Any] = {**authored, **overrides}
    if "image_width" in overrides and "image_height" not in overrides:
        chosen["image_height"] = 0  # a width alone keeps the camera's aspect, whatever the stage's resolution is
    return RenderSettings(**chosen)


def _part(report: Report, done: int, count: int) -> Callable[[float, str], None]:
    """Progress of one frame as progress of all."""
    prefix = f"frame {done + 1} of {count}: " if count > 1 else ""
    return lambda fraction, stage: report.progress((done + fraction) / count, prefix + stage)


def _stop_if(cancel: Callable[[], bool]) -> None:
    if cancel():
        raise Cancelled("cancelled; no unfinished file was left")


def _bytes(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1_000_000 else f"{max(count // 1000, 1)} kB"
