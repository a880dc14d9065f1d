"""Baking probes: their pictures as files, and a layer over the stage that says which belongs to which."""

from __future__ import annotations

import fnmatch
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from ..errors import Cancelled, ImageError, UsageError
from ..files import replacing
from ..images.bake_files import Baked, Task, batches, file_names, size_text, texture_folder
from ..images.layouts import LAYOUTS
from ..probes.digest import probe_digest
from ..progress import Report
from ..scene import Cubemap, Notice, Probe, Scene
from ..version import __version__
from .bake_errand import Errand, bake_one
from .executors import Crew, patience, sent_stage, spread

RESOLUTION = (8, 4096)
SAMPLES = (1, 4096)
_JOBS = (0, 4096)
_RECORD = ("digest", "engine", "timeCode", "stage", "samples")


@dataclass(frozen=True, kw_only=True)
class BakeOrder:
    """What to bake, and where to."""

    stage: str
    out: str
    """The layer over the stage; textures go into the folder `<stem of out>.probes` beside it, or into a .usdz."""
    only: tuple[str, ...] = ()
    """Prim paths of probes or of prims above them, with * and ? for any characters; () means every probe."""
    resolution: int | None = None
    """[texels]; None is each probe's own. Authored in OUT where it is given."""
    layout: str = "strip"
    samples: int = 16
    """Rays per texel."""
    jobs: int = 0
    force: bool = False
    """Bake what is up to date as well."""
    skip_existing: bool = False
    """Leave every texture file that exists as it is, up to date or not."""
    overwrite: bool = False


class Capture(Protocol):
    """`refract_core.render.capture_probes`, or what stands in for it."""

    def __call__(
        self,
        scene: Scene,
        probes: Sequence[Probe],
        *,
        samples: int,
        jobs: int,
        progress: Callable[[float, str], None],
        cancel: Callable[[], bool],
    ) -> list[Cubemap]: ...


# --- is a bake still true?


def stale_bake(scene: Scene, probe: Probe) -> Notice | None:
    """Say so where a probe's baked texture does not show what the probe sees now.

    Args:
        scene: the stage at `probe.bake.time_code`, read with the default purposes.
        probe: of that scene.
    """
    if probe.bake is None:
        return None
    if probe.bake.engine != __version__:
        why = f"refract {probe.bake.engine} baked it, this is {__version__}"
    elif probe_digest(scene, probe) != probe.bake.digest:
        why = "what it shows has changed since it was baked"
    else:
        return None
    return Notice(probe.path, f"probe:texture is stale: {why}. Run refract bake probes STAGE OUT again")


def stale_bakes(probes: Iterable[Probe], scene_at: Callable[[float], Scene]) -> list[Notice]:
    """`stale_bake` of every probe that has a bake.

    Args:
        scene_at: the stage at a time code, read with the default purposes; asked once per time code.
    """
    notices: list[Notice | None] = []
    scenes: dict[float, Scene] = {}
    for probe in probes:
        if probe.bake is None:
            continue
        when = probe.bake.time_code
        if when not in scenes:
            scenes[when] = scene_at(when)
        then = next((other for other in scenes[when].probes if other.path == probe.path), probe)
        notices.append(stale_bake(scenes[when], replace(then, bake=probe.bake)))
    return [notice for notice in notices if notice is not None]


# --- baking


def bake_probes(
    order: BakeOrder,
    report: Report,
    cancel: Callable[[], bool],
    *,
    capture: Capture | None = None,
    crew: Crew | None = None,
) -> None:
    """Bake the probes of a stage and write a layer over it that uses them.

    Probes of mode `baked` are baked, but planar ones, whose picture depends on the camera. A texture that is up to date
    (same digest, same version, same layout, no fewer samples) is kept. Textures are written as they are finished, OUT
    last: when stopped in between, OUT is as it was, and the next run goes on from the finished textures.

    Args:
        order: checked completely before the first ray, as far as that is possible.
        report: told about progress, notices, and what became of each probe and of OUT.
        cancel: True stops the work.
        capture: takes the pictures, here.
        crew: takes them elsewhere, if given.

    Raises:
        RefractError: whatever goes wrong.
    """
    from ..usd.layers.write import check_out, save
    from ..usd.probes.bakes import MADE, layer_of
    from ..usd.stage import open_stage, scene_from_stage

    _check(order)
    check_out(order.stage, order.out, overwrite=order.overwrite, ours=MADE)
    report.progress(0.0, "reading the stage")
    stage = open_stage(order.stage)
    scene = scene_from_stage(stage)
    for notice in scene.notices:
        report.warning(notice.path, notice.text)
    with texture_folder(order.out) as folder:
        bakes, tasks = _plan(order, stage, scene, folder, report)
        if crew is None:
            baking = _baked(order, scene, tasks, report, cancel, capture)
        else:
            baking = _baked_elsewhere(order, scene, tasks, report, cancel, crew)
        for task, baked in baking:
            bakes[task.probe.path] = baked
        _stop_if(cancel)
        report.progress(1.0, "writing")
        save(layer_of(order.stage, bakes), order.out)
    report.done(order.out, f"{len(bakes)} of {len(scene.probes)} probes have a texture in it, {len(tasks)} baked now")


def _plan(
    order: BakeOrder, stage: Any, scene: Scene, folder: str, report: Report
) -> tuple[dict[str, Baked], list[Task]]:
    """What OUT keeps, by prim path, and what there is to bake. Tells what is left alone, and why."""
    from ..usd.probes.bakes import earlier, instanced, own_texture, read_asset

    chosen = _chosen(scene, order)
    locked = instanced(stage, [probe.path for probe in scene.probes])
    reasons = {probe.path: _why_not(probe, probe.path in locked) for probe in scene.probes}
    if all(reasons.values()):
        report.warning(order.stage, "has no probe that can be baked; OUT is a layer that changes nothing")
    before = earlier(order.stage, order.out)
    bakes = {path: baked for path, baked in before.items() if reasons.get(path) == "" and read_asset(baked.texture)}
    names = file_names(reasons)
    tasks: list[Task] = []
    for probe in chosen:
        if reasons[probe.path]:
            report.done(probe.path, f"skipped: {reasons[probe.path]}")
            continue
        bakes.pop(probe.path, None)
        task = Task(probe, os.path.join(folder, names[probe.path]), probe_digest(scene, probe))
        kept = _kept(order, task, before.get(probe.path), own_texture(stage, probe.path, scene.time_code))
        if kept is None:
            tasks.append(task)
            continue
        if kept.texture:
            bakes[probe.path] = kept
        report.done(probe.path, "kept: up to date" if _is_current(order, task, kept.record) else "kept: exists")
    return bakes, tasks


def _check(order: BakeOrder) -> None:
    if order.layout not in LAYOUTS:
        raise UsageError(f"--layout is '{order.layout}', which is not known; choose from {', '.join(LAYOUTS)}")
    if order.resolution is not None:
        _in_range("--resolution", order.resolution, RESOLUTION)
    _in_range("--samples", order.samples, SAMPLES)
    _in_range("--jobs", order.jobs, _JOBS)
    if order.force and order.skip_existing:
        raise UsageError("--force bakes what exists and --skip-existing leaves it; give one of them")


def _in_range(name: str, value: int, limits: tuple[int, int]) -> None:
    if isinstance(value, bool) or not limits[0] <= value <= limits[1]:
        raise UsageError(f"{name} is {value}; it must be between {limits[0]} and {limits[1]}")


def _chosen(scene: Scene, order: BakeOrder) -> list[Probe]:
    """The probes of the order, at its resolution."""
    probes = list(scene.probes)
    if order.only:
        for pattern in order.only:
            if not any(_matches(probe.path, pattern) for probe in probes):
                known = ", ".join(probe.path for probe in probes[:8]) or "none"
                raise UsageError(f"--only {pattern}: the stage has no such probe; it has {known}")
        probes = [probe for probe in probes if any(_matches(probe.path, pattern) for pattern in order.only)]
    return [replace(probe, resolution=order.resolution or probe.resolution) for probe in probes]


def _matches(path: str, pattern: str) -> bool:
    return fnmatch.fnmatchcase(path, pattern) or fnmatch.fnmatchcase(path, f"{pattern.rstrip('/')}/*")


def _why_not(probe: Probe, locked: bool) -> str:
    """Why a probe is not baked; '' where it is."""
    if probe.planar:
        return "a planar probe's picture depends on the camera"
    if probe.mode == "realtime":
        return "a realtime probe is captured anew for every picture"
    if probe.mode == "custom":
        return "a custom probe shows the texture it was given"
    if locked:
        return "it belongs to an instance, which no layer can change; make the prim above it not instanceable"
    return ""


# --- which textures


def _kept(order: BakeOrder, task: Task, before: Baked | None, own: str) -> Baked | None:
    """What stays as it is instead of a new bake; None where there is nothing to keep.

    Args:
        before: what OUT said of the probe until now, or None.
        own: the texture that the stage gives the probe, or ''.

    Returns:
        Its texture is '' where the stage itself has what is needed.
    """
    from ..usd.probes.bakes import is_packed

    target = task.file
    if before is not None and is_packed(before.texture) and order.out.lower().endswith(".usdz"):
        target = before.texture
    notes = _notes_of(target)
    if notes is not None and (order.skip_existing or (not order.force and _is_current(order, task, notes))):
        return Baked(target, _from_notes(notes), order.resolution)
    notes = _notes_of(own) if own and not order.force and not order.resolution else None
    if notes is not None and _is_current(order, task, notes):
        return Baked("", notes)
    return None


def _notes_of(path: str) -> Mapping[str, Any] | None:
    """What is written in a texture about its making; None where there is no file, {} where it cannot be read."""
    from ..images.cubemaps import read_notes
    from ..usd.probes.bakes import read_asset

    source = read_asset(path)
    if source is None:
        return None
    try:
        return read_notes(source, path)
    except ImageError:
        return {}


def _is_current(order: BakeOrder, task: Task, notes: Mapping[str, Any]) -> bool:
    return (
        notes.get("digest") == task.digest
        and notes.get("engine") == __version__
        and notes.get("layout", order.layout) == order.layout
        and _from_notes(notes).get("samples", 0) >= order.samples
    )


def _baked(
    order: BakeOrder,
    scene: Scene,
    tasks: list[Task],
    report: Report,
    cancel: Callable[[], bool],
    capture: Capture | None,
) -> Iterator[tuple[Task, Baked]]:
    """Capture and write, a few probes at a time."""
    from ..images.cubemaps import write_cubemap

    done = 0
    for batch in batches(tasks):
        _stop_if(cancel)
        started = time.perf_counter()
        cubemaps = (capture or _engine())(
            scene,
            [task.probe for task in batch],
            samples=order.samples,
            jobs=order.jobs,
            progress=_part(report, done, len(batch), len(tasks)),
            cancel=cancel,
        )
        seconds = (time.perf_counter() - started) / len(batch)
        for task, cubemap in zip(batch, cubemaps, strict=True):
            _stop_if(cancel)
            record = _record(order, scene, task)
            write_cubemap(task.file, cubemap, order.layout, _to_notes(record, task.probe))
            _say_baked(report, task, seconds)
            yield task, Baked(task.file, record, order.resolution)
        done += len(batch)


def _say_baked(report: Report, task: Task, seconds: float) -> None:
    size = size_text(os.path.getsize(task.file))
    text = f"baked: {os.path.basename(task.file)}, {task.probe.resolution}, {size}, {seconds:.1f} s"
    report.done(task.probe.path, text)


def _baked_elsewhere(
    order: BakeOrder, scene: Scene, tasks: list[Task], report: Report, cancel: Callable[[], bool], crew: Crew
) -> Iterator[tuple[Task, Baked]]:
    """Probes as pieces of work for a crew; what comes back is written here."""
    records = [_record(order, scene, task) for task in tasks]
    errands = [
        Errand(number, task.probe.path, scene.time_code, task.digest, task.probe.resolution,
               order.samples, order.jobs, order.layout, _to_notes(record, task.probe))
        for number, (task, record) in enumerate(zip(tasks, records, strict=True))
    ]  # fmt: skip
    sent = sent_stage(order.stage, scene.name)
    results = spread(crew, bake_one, errands, sent, stop=partial(_stop_if, cancel), waiting=patience(report))
    for done, (errand, (data, seconds)) in enumerate(results, 1):
        task = tasks[errand.number]
        with replacing(task.file, ImageError) as temporary:
            Path(temporary).write_bytes(data)
        report.progress(done / len(tasks), f"probe {done} of {len(tasks)} done")
        _say_baked(report, task, seconds)
        yield task, Baked(task.file, records[errand.number], order.resolution)


def _engine() -> Capture:
    from ..rendering.session import capture_probes

    return capture_probes


def _record(order: BakeOrder, scene: Scene, task: Task) -> dict[str, Any]:
    """What the picture was made from, as OUT and the texture itself keep it."""
    name = os.path.basename(order.stage)
    values = (task.digest, __version__, float(scene.time_code), name, int(order.samples))
    return dict(zip(_RECORD, values, strict=True))


def _to_notes(record: Mapping[str, Any], probe: Probe) -> dict[str, str | float]:
    """A record as attributes of an image, whose own floats are of single precision."""
    notes = {f"refract:{key}": repr(value) if isinstance(value, float) else value for key, value in record.items()}
    return {"software": f"refract {__version__}", "refract:probe": probe.path, **notes}


def _from_notes(notes: Mapping[str, Any]) -> dict[str, Any]:
    """The record in a texture's notes; empty where it is not all there."""
    kinds = (str, str, float, str, int)
    try:
        return {key: kind(notes[key]) for key, kind in zip(_RECORD, kinds, strict=True)}
    except (KeyError, TypeError, ValueError):
        return {}


def _part(report: Report, done: int, some: int, count: int) -> Callable[[float, str], None]:
    """Progress of a few probes as progress of all."""
    last = f" to {done + some}" if some > 1 else ""
    text = f"probe {done + 1}{last} of {count}"
    return lambda fraction, _stage: report.progress((done + fraction * some) / count, text)


def _stop_if(cancel: Callable[[], bool]) -> None:
    if cancel():
        raise Cancelled("cancelled; textures that were finished stay, and OUT is as it was")
