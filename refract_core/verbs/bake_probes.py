"""Baking probes: their pictures as files, and a layer over the stage that says which belongs to which."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import ImageError, StageError, UsageError
from ..files import folder_beside, write_whole
from ..images.cubemaps import read_notes, write_cubemap
from ..images.layouts import LAYOUTS
from ..probes.digest import probe_digest
from ..progress import Report
from ..rendering.ready import capture_probes
from ..scene import Cubemap, Probe, Scene
from ..settings import AS_IT_IS, Opening
from ..usd.layers.write import check_out, save
from ..usd.probes.pictures import MADE, Baked, earlier, instanced, is_packed, layer_of, own_texture, read_asset
from ..usd.stage import open_stage, scene_from_stage
from ..version import __version__
from .executors import Bench, Crew, file_bytes, patience, sent_stage, spread
from .orders import JOBS, check_range, file_names, select, size_text, stop_if

RESOLUTION = (8, 4096)
SAMPLES = (1, 4096)
_RECORD = {"digest": str, "engine": str, "timeCode": float, "stage": str, "samples": int}
"""What OUT and the texture itself keep of a bake."""
_BATCH = 16
"""Probes captured together, which share one BVH; their collections must also fit into the masks of one scene."""
_BATCH_TEXELS = 1 << 21
"""... and texels on one face of each, together: what is held in memory at once."""


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
    opening: Opening = AS_IT_IS
    """Session layer, variants and mask."""


_STATE = "textures that were finished stay, and OUT is as it was"

Capture = Callable[..., list[Cubemap]]
"""`rendering.ready.capture_probes`, or what stands in for it."""


class Task(NamedTuple):
    """A probe to bake."""

    probe: Probe
    file: str
    """the texture to write"""
    digest: str


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
    _check(order)
    check_out(order.stage, order.out, overwrite=order.overwrite, ours=MADE)
    report.progress(0.0, "reading the stage")
    stage = open_stage(order.stage, order.opening)
    scene = scene_from_stage(stage)
    for notice in scene.notices:
        report.warning(notice.path, notice.text)
    with _texture_folder(order.out) as folder:
        bakes, tasks = _plan(order, stage, scene, folder, report)
        if crew is None:
            baking = _baked(order, scene, tasks, report, cancel, capture)
        else:
            baking = _baked_elsewhere(order, scene, tasks, report, cancel, crew)
        for task, baked in baking:
            bakes[task.probe.path] = baked
        stop_if(cancel, _STATE)
        report.progress(1.0, "writing")
        save(layer_of(order.stage, bakes), order.out)
    report.done(order.out, f"{len(bakes)} of {len(scene.probes)} probes have a texture in it, {len(tasks)} baked now")


def _plan(
    order: BakeOrder, stage: Any, scene: Scene, folder: str, report: Report
) -> tuple[dict[str, Baked], list[Task]]:
    """What OUT keeps, by prim path, and what there is to bake. Tells what is left alone, and why."""
    chosen = [
        replace(probe, resolution=order.resolution or probe.resolution)
        for probe in select(scene.probes, order.only, lambda probe: (probe.path,), "probe")
    ]
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
        check_range("--resolution", order.resolution, RESOLUTION)
    check_range("--samples", order.samples, SAMPLES)
    check_range("--jobs", order.jobs, JOBS)
    if order.force and order.skip_existing:
        raise UsageError("--force bakes what exists and --skip-existing leaves it; give one of them")


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


# --- pictures


@contextmanager
def _texture_folder(out: str) -> Iterator[str]:
    """Where textures are written, tried before the work. Not left behind empty."""
    with folder_beside(out, "probes") as place:
        folder = Path(place)
        try:
            folder.mkdir(exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError as error:
            raise StageError(f"{folder}: is not a folder that textures can be written to: {error.strerror}") from error
        try:
            yield place
        finally:
            if not any(folder.iterdir()):
                folder.rmdir()


def batches(tasks: list[Task]) -> Iterator[list[Task]]:
    """The tasks, a few at a time."""
    batch: list[Task] = []
    texels = 0
    for task in tasks:
        more = task.probe.resolution**2
        if batch and (len(batch) == _BATCH or texels + more > _BATCH_TEXELS):
            yield batch
            batch, texels = [], 0
        batch.append(task)
        texels += more
    if batch:
        yield batch


def _baked(
    order: BakeOrder,
    scene: Scene,
    tasks: list[Task],
    report: Report,
    cancel: Callable[[], bool],
    capture: Capture | None,
) -> Iterator[tuple[Task, Baked]]:
    """Capture and write, a few probes at a time."""
    done = 0
    for batch in batches(tasks):
        stop_if(cancel, _STATE)
        started = time.perf_counter()
        cubemaps = (capture or capture_probes)(
            scene,
            [task.probe for task in batch],
            samples=order.samples,
            jobs=order.jobs,
            progress=_batch_progress(report, done, len(batch), len(tasks)),
            cancel=cancel,
        )
        seconds = (time.perf_counter() - started) / len(batch)
        for task, cubemap in zip(batch, cubemaps, strict=True):
            stop_if(cancel, _STATE)
            record = _record(order, scene, task)
            write_cubemap(task.file, cubemap, order.layout, _to_notes(record, task.probe))
            _say_baked(report, task, seconds)
            yield task, Baked(task.file, record, order.resolution)
        done += len(batch)


def _batch_progress(report: Report, done: int, some: int, count: int) -> Callable[[float, str], None]:
    """Progress of a few probes as progress of all."""
    last = f" to {done + some}" if some > 1 else ""
    text = f"probe {done + 1}{last} of {count}"
    return lambda fraction, _stage: report.progress((done + fraction * some) / count, text)


def _say_baked(report: Report, task: Task, seconds: float) -> None:
    size = size_text(os.path.getsize(task.file))
    text = f"baked: {os.path.basename(task.file)}, {task.probe.resolution}, {size}, {seconds:.1f} s"
    report.done(task.probe.path, text)


# --- pictures that others take


class Errand(NamedTuple):
    """What to bake. The same errand over the same stage gives the same bytes, wherever it is done."""

    number: int
    path: str
    time_code: float
    digest: str
    """`probe_digest` in the process that gives the order"""
    resolution: int
    """[texels]"""
    samples: int
    jobs: int
    layout: str
    notes: Mapping[str, str | float]
    """attributes of the file"""


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
    sent = sent_stage(order.stage, scene.name, order.opening)
    results = spread(crew, _bake_one, errands, sent, stop=partial(stop_if, cancel, _STATE), waiting=patience(report))
    for done, (errand, (data, seconds)) in enumerate(results, 1):
        task = tasks[errand.number]
        write_whole(task.file, data, ImageError)
        report.progress(done / len(tasks), f"probe {done} of {len(tasks)} done")
        _say_baked(report, task, seconds)
        yield task, Baked(task.file, records[errand.number], order.resolution)


def _bake_one(bench: Bench, errand: Errand) -> tuple[bytes, float]:
    """Bake a probe on a worker.

    Returns:
        The texture's file, and the seconds it took.
    """
    started = time.perf_counter()
    scene = bench.read(time_code=errand.time_code)
    found = [probe for probe in scene.probes if probe.path == errand.path]
    probe = replace(found[0], resolution=errand.resolution) if found else None
    if probe is None or probe_digest(scene, probe) != errand.digest:
        raise StageError(f"{errand.path}: a worker reads the stage differently; is the same usd-core installed there?")
    (cubemap,) = capture_probes(scene, [probe], samples=errand.samples, jobs=errand.jobs, cancel=bench.cancel)
    data = file_bytes(lambda path: write_cubemap(path, cubemap, errand.layout, errand.notes), "probe.exr")
    return data, time.perf_counter() - started


# --- what is written about a bake


def _record(order: BakeOrder, scene: Scene, task: Task) -> dict[str, Any]:
    """What the picture was made from."""
    name = os.path.basename(order.stage)  # a folder would say where somebody works
    values = (task.digest, __version__, float(scene.time_code), name, int(order.samples))
    return dict(zip(_RECORD, values, strict=True))


def _to_notes(record: Mapping[str, Any], probe: Probe) -> dict[str, str | float]:
    """A record as attributes of an image, whose own floats are of single precision."""
    notes = {f"refract:{key}": repr(value) if isinstance(value, float) else value for key, value in record.items()}
    return {"software": f"refract {__version__}", "refract:probe": probe.path, **notes}


def _from_notes(notes: Mapping[str, Any]) -> dict[str, Any]:
    """The record in a texture's notes; empty where it is not all there."""
    try:
        return {key: kind(notes[key]) for key, kind in _RECORD.items()}
    except (KeyError, TypeError, ValueError):
        return {}
