"""From a stage on disk to picture files: one frame or many, with the settings that a person and the stage chose."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import ImageError, RefractError, StageError, UsageError
from ..files import write_whole
from ..probes.digest import stale_bakes
from ..progress import Report
from ..scene import Notice, Scene
from ..settings import AS_IT_IS, Opening, RenderSettings, named_settings
from .executors import Bench, Crew, file_bytes, patience, sent_stage, spread
from .orders import size_text, stop_if
from .override import OverrideError, Overrides, check_overrides, override, override_notes

if TYPE_CHECKING:
    from ..images.frame import Frame
    from ..rendering.session import Session
    from ..usd.products import Product
    from ..usd.time_codes import FrameJob

COMPLEXITIES = ("low", "medium", "high", "veryhigh")
_STATE = "no unfinished file was left"


@dataclass(frozen=True, kw_only=True)
class Order:
    """What to render, and where to."""

    stage: str
    """Path of the stage."""
    out: str = ""
    """Path of the picture; with `frames`, a pattern with a ### group. '' writes the products of the stage."""
    frames: str = ""
    """USD frame specs with commas between; '' is the stage's start."""
    overrides: Mapping[str, object] = field(default_factory=dict)
    """Fields of `RenderSettings` that win over what the stage authors."""
    materials: Overrides = field(default_factory=dict)
    """Values that win over what single materials author, see `override`."""
    settings_prim: str = ""
    """RenderSettings prim whose authored values win over the defaults; '' is the one the stage names, if any."""
    aovs: tuple[str, ...] = ()
    color_correction: str = "sRGB"
    complexity: str = "low"
    skip_existing: bool = False
    strict: bool = False
    """A picture that shows nothing of the stage is a failure, told when all are written."""
    opening: Opening = AS_IT_IS
    """Session layer, variants and mask."""


def render_files(order: Order, report: Report, cancel: Callable[[], bool], crew: Crew | None = None) -> None:
    """Render every picture of an order and write it.

    Args:
        order: checked completely before the first ray, as far as that is possible.
        report: told about progress, notices and files.
        cancel: True stops the work; files that are complete stay.
        crew: renders the frames; None renders them here, one after the other.

    Raises:
        RefractError: whatever goes wrong.
    """
    from ..images.pictures import check_output, check_writable
    from ..usd.time_codes import frame_jobs

    chosen_settings({}, order.overrides)
    if order.complexity not in COMPLEXITIES:
        raise UsageError(f"--complexity is '{order.complexity}', not known; choose from {', '.join(COMPLEXITIES)}")
    with _flag():
        check_overrides(order.materials)
    if order.out:
        check_output(order.out, order.aovs, order.color_correction)
        check_writable(order.out)
        if not _left(order, frame_jobs(order.frames, order.out), report):
            return
    _render_jobs(order, report, cancel, crew)


def _left(order: Order, jobs: Sequence[FrameJob], report: Report) -> list[FrameJob]:
    """Without those whose pictures are to be left as they are; tells which."""
    skipped = [job for job in jobs if order.skip_existing and os.path.exists(job.path)]
    for job in skipped:
        report.done(job.path, "exists, skipped")
    return [job for job in jobs if job not in skipped]


class _Shot(NamedTuple):
    """One picture to make. The same shot of the same stage gives the same bytes, wherever it is rendered."""

    time_code: float | None
    path: str
    settings: RenderSettings
    materials: Overrides
    aovs: tuple[str, ...]
    color_correction: str
    complexity: str
    first: bool
    """Looks for stale probes as well, and for overrides that name nothing."""
    names: Mapping[str, str]
    """AOV -> what an .exr calls it"""


class _Picture(NamedTuple):
    """A shot that a worker has made."""

    data: bytes
    """the file"""
    width: int
    height: int
    notices: tuple[Notice, ...]
    seconds: float


def _render_jobs(order: Order, report: Report, cancel: Callable[[], bool], crew: Crew | None) -> None:
    """Read what holds for all frames, and draw them here or elsewhere. Each notice is told once."""
    from ..rendering.picture import NOTHING_SEEN
    from ..usd.products import read_products
    from ..usd.settings import read_settings
    from ..usd.stage import open_stage

    told: set[Notice] = set()
    empty = False

    def tell(notices: Sequence[Notice]) -> None:
        nonlocal empty
        for notice in notices:
            empty = empty or notice.text.startswith(NOTHING_SEEN)
            if notice not in told:
                told.add(notice)
                report.warning(notice.path, notice.text)

    report.progress(0.0, "reading the stage")
    stage = open_stage(order.stage, order.opening)
    found: list[Notice] = []
    authored = read_settings(stage, order.settings_prim, found, products=True)
    products = read_products(stage, order.settings_prim, found)
    wanted = _wanted(order, stage, products, found)
    tell(found)
    shots: list[_Shot] = []
    for one in wanted:
        settings = chosen_settings({**authored, **one.settings}, order.overrides)
        choices = settings, order.materials, one.aovs, order.color_correction, order.complexity
        jobs = one.jobs if order.out else _left(order, one.jobs, report)
        shots += [_Shot(job.time_code, job.path, *choices, False, one.names) for job in jobs]
    if not shots:
        return
    shots[0] = shots[0]._replace(first=True)
    if crew is None:
        _render_here(stage, shots, tell, report, cancel)
    else:
        _render_elsewhere(order, stage, shots, tell, report, cancel, crew)
    if order.strict and empty:
        raise StageError(f"{order.stage}: a picture shows nothing of the stage, which --strict does not let pass")


class _Wanted(NamedTuple):
    """One picture for each frame."""

    jobs: Sequence[FrameJob]
    settings: Mapping[str, object]
    """What its product says over the stage's settings"""
    aovs: tuple[str, ...]
    names: Mapping[str, str]


def _wanted(order: Order, stage: Any, products: Sequence[Product], notices: list[Notice]) -> list[_Wanted]:
    """The picture of OUT, as the first product has it, or the picture of every product.

    Raises:
        UsageError: there is neither, or a product's file cannot be written.
    """
    from ..images.pictures import LAYERED, check_output, check_writable
    from ..usd.time_codes import frame_jobs

    if order.out:
        jobs = [job for job in frame_jobs(order.frames, order.out)
                if not (order.skip_existing and os.path.exists(job.path))]  # fmt: skip
        if not products:
            return [_Wanted(jobs, {}, order.aovs, {})]
        if len(products) > 1:
            text = f"only the first of {len(products)} RenderProducts is drawn, for OUT is one picture; leave OUT out"
            notices.append(Notice(products[0].path, text))
        first = products[0]
        layered = os.path.splitext(order.out)[1].lower() in LAYERED
        return [_Wanted(jobs, first.settings, order.aovs or (first.aovs if layered else ()), first.names)]
    if not products:
        raise UsageError("OUT is missing, and the stage's RenderSettings have no RenderProduct; name a picture")
    found = []
    taken: dict[str, str] = {}
    for product in products:
        other = taken.setdefault(os.path.abspath(product.file), product.path)
        if other != product.path:
            raise UsageError(f"{product.path}: productName {product.file} is that of {other}, too; change one of them")
        aovs = order.aovs or product.aovs
        try:
            if os.path.splitext(product.file)[1].lower() not in LAYERED:
                aovs = aovs[:1]
            check_output(product.file, aovs, order.color_correction)
            check_writable(product.file)
            jobs = _frames(order, stage, product.file)
        except RefractError as error:
            raise UsageError(f"{product.path}: productName {error}") from error
        found.append(_Wanted(jobs, product.settings, aovs, product.names))
    return found


def _frames(order: Order, stage: Any, file: str) -> list[FrameJob]:
    """The jobs of a product, whose name may have a place for the frame though only one is drawn."""
    from ..usd.stage import time_range
    from ..usd.time_codes import FrameJob, frame_jobs, frame_path

    if order.frames.strip() or "#" not in os.path.basename(file):
        return frame_jobs(order.frames, file)
    return [FrameJob(None, frame_path(file, time_range(stage)[0]))]


Tell = Callable[[Sequence[Notice]], None]


def _render_here(stage: Any, shots: Sequence[_Shot], tell: Tell, report: Report, cancel: Callable[[], bool]) -> None:
    from ..rendering.session import Session
    from ..usd.stage import scene_from_stage

    read = partial(scene_from_stage, stage)
    session = Session() if len(shots) > 1 else None
    for done, shot in enumerate(shots):
        started = time.perf_counter()
        frame = _draw(read, shot, tell, _frame_progress(report, done, len(shots)), cancel, session)
        stop_if(cancel, _STATE)
        frame.save(shot.path, **_saving(shot))
        _say_done(report, shot, frame.width, frame.height, time.perf_counter() - started)


def _draw(
    read: Callable[..., Scene],
    shot: _Shot,
    tell: Tell,
    progress: Callable[[float, str], None],
    cancel: Callable[[], bool],
    session: Session | None,
) -> Frame:
    """Read the stage at the shot's time and render it.

    Args:
        read: `scene_from_stage` of a stage.
        session: of all shots of that stage that are drawn here; None where this is the only one.
    """
    from ..rendering.picture import render

    stop_if(cancel, _STATE)
    settings = shot.settings

    def changed(*, strict: bool = False, **how: Any) -> Scene:
        """What is read, with the order's values in it. At other times than the first a named thing may be hidden."""
        with _flag():
            return override(read(**how), shot.materials, strict=strict)

    scene = changed(strict=shot.first, **_how(shot))
    tell(scene.notices)
    if shot.first:
        tell(_stale(changed, scene, shot))
    stop_if(cancel, _STATE)
    frame = render(scene, settings, progress=progress, cancel=cancel, session=session)
    tell(frame.notices)
    return replace(frame, metadata={**frame.metadata, **override_notes(shot.materials)})


def _how(shot: _Shot) -> dict[str, Any]:
    """What of a stage to read for a shot."""
    chosen = {"purposes": shot.settings.purposes, "camera": shot.settings.camera, "complexity": shot.complexity}
    return {"time_code": shot.time_code, **chosen}


def _render_elsewhere(
    order: Order,
    stage: Any,
    shots: Sequence[_Shot],
    tell: Tell,
    report: Report,
    cancel: Callable[[], bool],
    crew: Crew,
) -> None:
    """Frames as pieces of work for a crew; what comes back is written here, so that each is written once and whole."""
    from ..usd.stage import scene_from_stage

    if order.materials:  # before anybody draws a frame: the first one alone would notice
        with _flag():
            override(scene_from_stage(stage, **_how(shots[0])), order.materials)
    root = stage.GetRootLayer()
    sent = sent_stage(order.stage, root.realPath or root.identifier, order.opening)
    report.progress(0.0, "waiting for the first frame")
    results = spread(crew, _picture, shots, sent, stop=partial(stop_if, cancel, _STATE), waiting=patience(report))
    for done, (shot, picture) in enumerate(results, 1):
        tell(picture.notices)
        write_whole(shot.path, picture.data, ImageError)
        report.progress(done / len(shots), f"frame {done} of {len(shots)} done")
        _say_done(report, shot, picture.width, picture.height, picture.seconds)


def _picture(bench: Bench, shot: _Shot) -> _Picture:
    """One frame, on a worker."""
    started = time.perf_counter()
    notices: dict[Notice, None] = {}
    tell = lambda some: notices.update(dict.fromkeys(some))  # noqa: E731
    frame = _draw(bench.read, shot, tell, _unheard, bench.cancel, bench.session())
    data = file_bytes(lambda path: frame.save(path, **_saving(shot)), shot.path)
    return _Picture(data, frame.width, frame.height, tuple(notices), time.perf_counter() - started)


def _saving(shot: _Shot) -> dict[str, Any]:
    """How its file is written."""
    how = {"aovs": shot.aovs, "color_correction": shot.color_correction}
    return {**how, "names": shot.names} if shot.names else how


def _unheard(_fraction: float, _stage: str) -> None:
    """Progress within a frame, which nobody far away listens to."""


def _say_done(report: Report, shot: _Shot, width: int, height: int, seconds: float) -> None:
    size = os.path.getsize(shot.path)
    report.done(shot.path, f"{width} x {height}, {size_text(size)}, {seconds:.1f} s")


def _stale(read: Callable[..., Scene], scene: Scene, shot: _Shot) -> list[Notice]:
    """Baked probes that no longer show what is there; each is asked about the time it was baked at, and about surfaces
    as coarse as they were then."""
    if not any(probe.bake for probe in scene.probes):
        return []
    def scene_at(time_code: float) -> Scene:
        as_baked = shot.settings.purposes == RenderSettings().purposes and shot.complexity == COMPLEXITIES[0]
        if time_code == scene.time_code and as_baked:
            return scene
        return read(time_code=time_code)

    return stale_bakes(scene.probes, scene_at)


def chosen_settings(authored: Mapping[str, object], overrides: Mapping[str, object]) -> RenderSettings:
    """Defaults, then what the stage authors, then what the caller says: a quality, a preset, and settings by name."""
    asked: dict[str, Any] = dict(overrides)
    named = named_settings(asked.pop("quality", ""), asked.pop("preset", ""))
    chosen: dict[str, Any] = {**authored, **named, **asked}
    if "image_width" in overrides and "image_height" not in overrides:
        chosen["image_height"] = 0  # a width alone keeps the camera's aspect, whatever the stage's resolution is
    return RenderSettings(**chosen)


def _frame_progress(report: Report, done: int, count: int) -> Callable[[float, str], None]:
    """Progress of one frame as progress of all."""
    prefix = f"frame {done + 1} of {count}: " if count > 1 else ""
    return lambda fraction, stage: report.progress((done + fraction) / count, prefix + stage)


@contextmanager
def _flag() -> Iterator[None]:
    """What is wrong with an override, said with its flag."""
    try:
        yield
    except OverrideError as error:
        raise UsageError(f"--override {error}") from error
