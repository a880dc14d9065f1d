"""From a stage on disk to picture files: one frame or many, with the settings that a person and the stage chose."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import zip_longest
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import ImageError, RefractError, StageError, UsageError
from ..files import write_whole
from ..images.exr import USUAL, Layout
from ..probes.digest import stale_bakes
from ..progress import Report
from ..scene import Notice, Scene
from ..settings import AS_IT_IS, NO_ORBIT, USUAL_PIXELS, Opening, RenderSettings, named_settings
from .executors import Bench, Crew, file_bytes, patience, sent_stage, spread
from .looks import Looks, check_unfinished
from .orders import peak_memory, stop_if
from .override import OverrideError, Overrides, check_overrides, override, override_notes

if TYPE_CHECKING:
    from ..images.frame import Frame
    from ..rendering.session import Session
    from ..rendering.unfinished import Watch
    from ..usd.products import Product
    from ..usd.time_codes import FrameJob

CAMERA_GROUP = "{camera}"
"""Where the name of a camera goes in that of a file."""
COMPLEXITIES = ("low", "medium", "high", "veryhigh")
_STATE = "no unfinished file was left"
_READING = "reading the stage"


@dataclass(frozen=True, kw_only=True)
class Order:
    """What to render, and where to."""

    stage: str
    """Path of the stage."""
    out: str = ""
    """Path of the picture; with `frames`, a pattern with a ### group; with {aov} in it one file for each of `aovs`.
    '' writes the products of the stage."""
    cameras: tuple[str, ...] = ()
    """Prim paths or names; of several each has a picture, and `out` has `{camera}` where the name goes."""
    frames: str = ""
    """USD frame specs with commas between; '' is the stage's start."""
    turn: int = 0
    """Pictures of one turn around the thing, numbered from 1 in the ### group of `out`; 0 is no turn."""
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
    """A picture that shows nothing of the stage, or was stopped early, is a failure, told when all are written."""
    time_limit: float = 0.0
    """[s] for each picture, from when it is begun to be drawn; it is then what it is. 0 is no limit."""
    snapshot: float = 0.0
    """[s] between two looks at what is finished so far, written beside the picture; 0 is none."""
    opening: Opening = AS_IT_IS
    """Session layer, variants and mask."""
    layout: Layout = USUAL
    """How an .exr is cut up and compressed."""


def render_files(
    order: Order, report: Report, cancel: Callable[[], bool], crew: Crew | None = None,
    asked: Callable[[], bool] | None = None,
) -> None:  # fmt: skip
    """Render every picture of an order and write it.

    Args:
        order: checked completely before the first ray, as far as that is possible.
        report: told about progress, notices and files.
        cancel: True stops the work; files that are complete stay.
        crew: renders the frames; None renders them here, one after the other.
        asked: somebody wants to see now what is finished so far.

    Raises:
        RefractError: whatever goes wrong.
    """
    from ..images.denoise import check_installed
    from ..images.pictures import check_writable

    check_unfinished(order.time_limit, order.snapshot, crew is not None)
    outs = [out for _, out in outs_of(order)]
    if chosen_settings({}, order.overrides).denoise and crew is None:
        check_installed()
    if order.complexity not in COMPLEXITIES:
        raise UsageError(f"--complexity is '{order.complexity}', not known; choose from {', '.join(COMPLEXITIES)}")
    with _flag():
        check_overrides(order.materials)
    if order.out:
        if parted(order.out) and not order.aovs:
            raise UsageError(f"{order.out}: {AOV} stands for the name of each of --aovs; name some, such as beauty,N,Z")
        if parted(order.out) and order.overrides.get("cryptomatte"):
            raise UsageError(f"{order.out}: Cryptomatte is parts of one .exr; leave {AOV} out of its name")
        for path, aovs in files_of(order.out, order.aovs).items():
            _check_file(order, path, aovs)
            check_writable(path)
        if not _left(order, [job for out in outs for job in _jobs(order, out)], report):
            return
    _render_jobs(order, report, cancel, crew, asked)


AOV = "{aov}"
"""In the name of a file, the place of an AOV's name: each has a file of its own."""


def parted(path: str) -> bool:
    """Each AOV has a file of its own."""
    return AOV in os.path.basename(path)


def files_of(path: str, aovs: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """The files of one picture, and the AOVs in each; () are those that its format has when nobody says."""
    if not parted(path) or not aovs:
        return {path: aovs}
    folder, name = os.path.split(path)
    return {os.path.join(folder, name.replace(AOV, aov)): (aov,) for aov in aovs}


def _check_file(order: Order, path: str, aovs: tuple[str, ...]) -> None:
    """Refuse a file that could not be written as the order has it. Raises UsageError."""
    from ..images.pictures import check_output

    check_output(path, aovs, order.color_correction, order.layout, bool(order.overrides.get("cryptomatte")))


def outs_of(order: Order) -> list[tuple[str, str]]:
    """The cameras of an order, and where the picture of each goes; '' is the stage's choice.

    Raises:
        UsageError: OUT does not say where several pictures go, or where no camera is named.
    """
    folder, name = os.path.split(order.out)
    cameras = tuple(dict.fromkeys(order.cameras))
    if not cameras:
        if CAMERA_GROUP in name:
            raise UsageError(f"{order.out}: {CAMERA_GROUP} in the name needs --camera, once or more often")
        return [("", order.out)]
    if len(cameras) > 1 and CAMERA_GROUP not in name:
        what = f"{order.out}: one name" if order.out else "OUT is missing"
        how = f"put {CAMERA_GROUP} where the camera's name goes, such as shot.{CAMERA_GROUP}.png"
        raise UsageError(f"{what} for the pictures of {len(cameras)} cameras; {how}")
    short = [camera.rpartition("/")[2] for camera in cameras]
    if len(set(short)) < len(short):
        short = [camera.strip("/").replace("/", "_") for camera in cameras]
    return [(camera, os.path.join(folder, name.replace(CAMERA_GROUP, word)) if order.out else "")
            for camera, word in zip(cameras, short, strict=True)]  # fmt: skip


def _jobs(order: Order, out: str) -> list[FrameJob]:
    """The pictures of one camera."""
    from ..usd.time_codes import FrameJob, frame_jobs, frame_path, parse_frames

    if not order.turn:
        return frame_jobs(order.frames, out)
    time_code = parse_frames(order.frames)[0] if order.frames else None
    return [FrameJob(time_code, frame_path(out, k + 1)) for k in range(order.turn)]


def _left(order: Order, jobs: Sequence[FrameJob], report: Report) -> list[FrameJob]:
    """Without those whose pictures are to be left as they are; tells which."""
    skipped = [job for job in jobs if order.skip_existing and _exists(job.path, order.aovs)]
    for job in skipped:
        report.done(job.path, "exists, skipped")
    if skipped and len(jobs) > 1:
        report.closing(f"{len(skipped)} of {len(jobs)} pictures exist, skipped")
    return [job for job in jobs if job not in skipped]


def _exists(path: str, aovs: tuple[str, ...]) -> bool:
    return all(os.path.exists(file) for file in files_of(path, aovs))


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
    layout: Layout


class _Picture(NamedTuple):
    """A shot that a worker has made."""

    files: tuple[bytes, ...]
    """as `files_of` names them"""
    width: int
    height: int
    notices: tuple[Notice, ...]
    seconds: float
    memory: int
    """[bytes]"""


def _render_jobs(
    order: Order, report: Report, cancel: Callable[[], bool], crew: Crew | None, asked: Callable[[], bool] | None
) -> None:
    """Read what holds for all frames, and draw them here or elsewhere. Each notice is told once."""
    from ..rendering.picture import NOTHING_SEEN, STOPPED
    from ..usd.products import read_products
    from ..usd.settings import read_settings
    from ..usd.stage import open_stage, scene_from_stage
    from .gltf import as_usd

    told: set[Notice] = set()
    empty = stopped = False

    def tell(notices: Sequence[Notice]) -> None:
        nonlocal empty, stopped
        for notice in notices:
            empty = empty or notice.text.startswith(NOTHING_SEEN)
            stopped = stopped or notice.text.startswith(STOPPED)
            if notice not in told:
                told.add(notice)
                report.warning(notice.path, notice.text)

    report.progress(0.0, _READING)
    stage = open_stage(as_usd(order.stage, report.warning), order.opening)
    found: list[Notice] = []
    authored = read_settings(stage, order.settings_prim, found, products=True)
    products = read_products(stage, order.settings_prim, found)
    wanted = _wanted(order, stage, products, found)
    tell(found)
    rows: list[list[_Shot]] = []
    for one in wanted:
        settings = chosen_settings({**authored, **one.settings}, {**order.overrides, **one.asked})
        settings = with_features(settings, one.aovs)
        if order.turn and not one.asked:
            settings = replace(settings, camera="")  # what a stage shows from one side is no start of a turn
        choices = settings, order.materials, one.aovs, order.color_correction, order.complexity
        jobs = one.jobs if order.out else _left(order, one.jobs, report)
        rows.append([_Shot(job.time_code, job.path, *choices, False, one.names, order.layout) for job in jobs])
    if len(order.cameras) > 1:  # frame by frame, as what moves is made ready once for all cameras
        rows = [[shot for shot in of_frame if shot] for of_frame in zip_longest(*rows)]
    shots = [shot for row in rows for shot in row]
    if not shots:
        return
    started = time.perf_counter()
    read = _read_once(partial(scene_from_stage, stage))
    if order.turn:
        shots = _turned(order, read, shots)
    shots[0] = shots[0]._replace(first=True)
    if crew is None:
        _render_here(read, shots, tell, report, cancel, Looks(order.time_limit, order.snapshot, asked, report))
    else:
        _render_elsewhere(order, stage, shots, tell, report, cancel, crew)
    if len(shots) > 1:
        seconds = time.perf_counter() - started
        report.closing(f"{len(shots)} pictures, {seconds:.1f} s, {seconds / len(shots):.2f} s each")
    if order.strict and empty:
        raise StageError(f"{order.stage}: a picture shows nothing of the stage, which --strict does not let pass")
    if order.strict and stopped:
        raise StageError(f"{order.stage}: a picture was stopped by --time-limit, which --strict does not let pass")


def _turned(order: Order, read: Callable[..., Scene], shots: Sequence[_Shot]) -> list[_Shot]:
    """Shots from all around: the same lens from the same distance, so that nothing grows and shrinks as it turns."""
    from ..rendering.ready import camera_of
    from ..view.orbit import round_trip

    scene = read(**{**_how(shots[0]), "orbits": True})
    settings = shots[0].settings
    around = round_trip(scene, settings, camera_of(scene, replace(settings, **NO_ORBIT)), order.turn)
    number = {job.path: k for k, job in enumerate(_jobs(order, outs_of(order)[0][1]))}
    return [shot._replace(settings=around[number[shot.path]]) for shot in shots]


class _Wanted(NamedTuple):
    """One picture for each frame."""

    jobs: Sequence[FrameJob]
    settings: Mapping[str, object]
    """What its product says over the stage's settings"""
    aovs: tuple[str, ...]
    names: Mapping[str, str]
    asked: Mapping[str, object]
    """The camera that was asked for, which wins over all"""


def _wanted(order: Order, stage: Any, products: Sequence[Product], notices: list[Notice]) -> list[_Wanted]:
    """The picture of OUT, as the first product has it, or the picture of every product.

    Raises:
        UsageError: there is neither, or a product's file cannot be written.
    """
    from ..images.pictures import LAYERED, check_writable

    asked: list[dict[str, object]] = [{"camera": camera} if camera else {} for camera, _ in outs_of(order)]
    if order.out:
        every = [[job for job in _jobs(order, out) if not (order.skip_existing and _exists(job.path, order.aovs))]
                 for _, out in outs_of(order)]  # fmt: skip
        if not products:
            return [_Wanted(some, {}, order.aovs, {}, mine) for some, mine in zip(every, asked, strict=True)]
        if len(products) > 1:
            text = f"only the first of {len(products)} RenderProducts is drawn, for OUT is one picture; leave OUT out"
            notices.append(Notice(products[0].path, text))
        first = products[0]
        layered = os.path.splitext(order.out)[1].lower() in LAYERED and not parted(order.out)
        aovs = order.aovs or (first.aovs if layered else ())
        return [_Wanted(some, first.settings, aovs, first.names, mine) for some, mine in zip(every, asked, strict=True)]
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
            _check_file(order, product.file, aovs)
            check_writable(product.file)
            jobs = _frames(order, stage, product.file)
        except RefractError as error:
            raise UsageError(f"{product.path}: productName {error}") from error
        found.append(_Wanted(jobs, product.settings, aovs, product.names, asked[0]))
    return found


def _frames(order: Order, stage: Any, file: str) -> list[FrameJob]:
    """The jobs of a product, whose name may have a place for the frame though only one is drawn."""
    from ..usd.stage import time_range
    from ..usd.time_codes import FrameJob, frame_jobs, frame_path

    if order.frames.strip() or "#" not in os.path.basename(file):
        return frame_jobs(order.frames, file)
    return [FrameJob(None, frame_path(file, time_range(stage)[0]))]


Tell = Callable[[Sequence[Notice]], None]


def _render_here(
    read: Callable[..., Scene], shots: Sequence[_Shot], tell: Tell, report: Report, cancel: Callable[[], bool],
    looks: Looks,
) -> None:  # fmt: skip
    from ..rendering.session import Session

    session = Session() if len(shots) > 1 else None
    for done, shot in enumerate(shots):
        started = time.perf_counter()
        progress = _frame_progress(report, done, len(shots))
        progress(0.0, _READING)
        files = files_of(shot.path, shot.aovs)
        shown, planes = next(iter(files.items()))
        with looks.at(shown, {"aovs": planes, **_saving(shot)}) as watch:
            frame = _draw(read, shot, tell, progress, cancel, session, watch)
            stop_if(cancel, _STATE)
            progress(1.0, "writing")
            for path, aovs in files.items():
                frame.save(path, aovs=aovs, **_saving(shot))
        _say_done(report, shot, frame.width, frame.height, time.perf_counter() - started, peak_memory())


def _read_once(read: Callable[..., Scene]) -> Callable[..., Scene]:
    """`read`, of which the last scene is kept: all sides of a turn show the same one."""
    kept: dict[Any, Scene] = {}

    def again(**how: Any) -> Scene:
        key = tuple(sorted(how.items()))
        if key not in kept:
            kept.clear()
            kept[key] = read(**how)
        return kept[key]

    return again


def _draw(
    read: Callable[..., Scene],
    shot: _Shot,
    tell: Tell,
    progress: Callable[[float, str], None],
    cancel: Callable[[], bool],
    session: Session | None,
    watch: Callable[[], Watch] | None = None,
) -> Frame:
    """Read the stage at the shot's time and render it.

    Args:
        read: `scene_from_stage` of a stage.
        session: of all shots of that stage that are drawn here; None where this is the only one.
        watch: who wants to see it before it is finished, from when it is begun to be drawn.
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
    eyes: dict[str, Any] = {"watch": watch()} if watch else {}

    def scene_at(time_code: float) -> Scene:
        return changed(**{**_how(shot), "time_code": time_code})

    frame = render(
        scene, settings, progress=progress, cancel=cancel, session=session, scene_at=scene_at, **eyes
    )
    tell(frame.notices)
    return replace(frame, metadata={**frame.metadata, **override_notes(shot.materials)})


def _how(shot: _Shot) -> dict[str, Any]:
    """What of a stage to read for a shot."""
    chosen = {"purposes": shot.settings.purposes, "camera": shot.settings.camera, "complexity": shot.complexity}
    own = {"orbits": True} if shot.settings.orbits else {}
    return {"time_code": shot.time_code, "pixels": shot.settings.longer_side, **chosen, **own}


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
        for path, data in zip(files_of(shot.path, shot.aovs), picture.files, strict=True):
            write_whole(path, data, ImageError)
        report.progress(done / len(shots), f"frame {done} of {len(shots)} done")
        _say_done(report, shot, picture.width, picture.height, picture.seconds, picture.memory)


def _picture(bench: Bench, shot: _Shot) -> _Picture:
    """One frame, on a worker."""
    started = time.perf_counter()
    notices: dict[Notice, None] = {}
    tell = lambda some: notices.update(dict.fromkeys(some))  # noqa: E731
    frame = _draw(bench.read, shot, tell, _unheard, bench.cancel, bench.session())
    files = []
    for path, aovs in files_of(shot.path, shot.aovs).items():
        save = partial(frame.save, aovs=aovs, **_saving(shot))
        files.append(file_bytes(save, path))
    seconds = time.perf_counter() - started
    return _Picture(tuple(files), frame.width, frame.height, tuple(notices), seconds, peak_memory())


def _saving(shot: _Shot) -> dict[str, Any]:
    """How its files are written."""
    how: dict[str, Any] = {"color_correction": shot.color_correction}
    if shot.layout != USUAL:
        how |= {"exr_compression": shot.layout.compression, "exr_parts": shot.layout.parts}
    return {**how, "names": shot.names} if shot.names else how


def _unheard(_fraction: float, _stage: str) -> None:
    """Progress within a frame, which nobody far away listens to."""


def _say_done(report: Report, shot: _Shot, width: int, height: int, seconds: float, memory: int) -> None:
    """`out.png 960x540, 16 samples, 1.9 s, 310 MB`, and with --verbose where the seconds went.

    Args:
        memory: most that the process which drew it has had so far [bytes].
    """
    count = f"{shot.settings.samples} sample{'s' if shot.settings.samples > 1 else ''}"
    facts = [f"{width}x{height}", count, f"{seconds:.1f} s", f"{memory / 1e6:.0f} MB"]
    if parts := report.parts():
        facts[-1] += f" ({parts})"
    for path in files_of(shot.path, shot.aovs):
        report.done(path, ", ".join(facts))


def _stale(read: Callable[..., Scene], scene: Scene, shot: _Shot) -> list[Notice]:
    """Baked probes that no longer show what is there; each is asked about the time it was baked at, and about surfaces
    as coarse as they were then."""
    if not any(probe.bake for probe in scene.probes):
        return []
    usual = shot.complexity == COMPLEXITIES[0] and shot.settings.longer_side <= USUAL_PIXELS

    def scene_at(time_code: float) -> Scene:
        as_baked = shot.settings.purposes == RenderSettings().purposes and usual
        if time_code == scene.time_code and as_baked:
            return scene
        return read(time_code=time_code)

    return stale_bakes(scene.probes, scene_at)


def chosen_settings(authored: Mapping[str, object], overrides: Mapping[str, object]) -> RenderSettings:
    """Defaults, then what the stage authors, then what the caller says: a quality, a preset, and settings by name."""
    asked: dict[str, Any] = dict(overrides)
    named = named_settings(asked.pop("quality", ""), asked.pop("preset", ""))
    chosen: dict[str, Any] = {**authored, **named, **asked}
    if NO_ORBIT.keys() & asked.keys() and "camera" not in asked:
        chosen.pop("camera", None)  # a camera of its own starts from one that is named, not from the stage's choice
    if "image_width" in overrides and "image_height" not in overrides:
        chosen["image_height"] = 0  # a width alone keeps the camera's aspect, whatever the stage's resolution is
    return RenderSettings(**chosen)


def with_features(settings: RenderSettings, aovs: Sequence[str]) -> RenderSettings:
    """The settings, and planes that are drawn only on request with them where they are requested."""
    from ..images.aovs import FEATURES

    return replace(settings, features=True) if any(name in aovs for name in FEATURES) else settings


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
