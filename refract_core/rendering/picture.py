"""One picture: a scene made ready, samples drawn by an integrator, sums made into a frame.

stage -> Scene -> tables and BVH -> probes -> per sample: the integrator's passes over the tiles -> Frame
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..errors import Cancelled, TimeUp
from ..images.denoise import check_installed
from ..images.frame import Frame, Place
from ..kernels.lanes import by_address
from ..models import BY_TOKEN, SHEET, Behind
from ..probes.capture import Over, face_camera, paste_face
from ..probes.lookup import empty_table
from ..probes.plan import seen_things
from ..progress import COMPILING
from ..scene import F32, Camera, Notice, Probe, Scene, prim_of
from ..settings import RenderSettings
from ..studio.compose import dressed
from ..version import __version__
from ..view.camera import Tile, View, image_size, view_of
from ..view.crop import meeting, part_of, window_of
from ..view.planes import Planes, by_name, finish_of, finish_tile, new_planes
from ..world.embree import Bvh
from ..world.instances import settled, thing_count, within
from ..world.tables import World
from .branching import Tree, needs_compiling, sample_views
from .features import Found, features_of, without_noise
from .integrator import Pass
from .mattes import draw_mattes
from .ready import PROBE_SAMPLES, Ready, camera_of, prepare, prepare_bare
from .session import Session
from .shutter import Instant, Moment, moments_of, shutter_of_few
from .unfinished import FINISHED, Drawn, Watch
from .work import Cancel, Progress, Work, tiles_of, working


def _file_name(stage: str) -> str:
    """A stage's name without its folders, which are nobody's business: pictures are handed around."""
    file, bracket, inside = stage.partition("[")
    return os.path.basename(file) + bracket + inside


def render(
    scene: Scene,
    settings: RenderSettings | None = None,
    *,
    progress: Progress | None = None,
    cancel: Cancel | None = None,
    executor: Executor | None = None,
    session: Session | None = None,
    watch: Watch | None = None,
    scene_at: Callable[[float], Scene] | None = None,
) -> Frame:
    """Render one picture of a scene.

    Args:
        progress: called with a fraction 0 .. 1 and the name of the stage of work.
        cancel: asked between tiles; True stops the render.
        executor: where tiles run; must share this process's memory. None makes `settings.jobs` threads.
        session: has what earlier pictures needed, and keeps what this one does; the picture is the same without it.
        watch: who wants to see it before it is finished, and when to stop.
        scene_at: reads the stage at another time code, for what moves while the camera's shutter is open; None draws
            what the scene shows, as at one instant.

    Raises:
        UsageError: no such camera, or a camera without a field of view; or it is to be denoised, and that extra is
            not installed.
        SceneError: a record of the scene is malformed.
        ImageError: the file of surroundings cannot be read.
        Cancelled: `cancel` said so.
        TimeUp: the watch's deadline has come before every pixel was drawn.
    """
    started = time.perf_counter()
    settings = settings or RenderSettings()
    if settings.denoise:
        check_installed()
    time_code, camera = scene.time_code, camera_of(scene, settings)
    moments: list[Moment] = []
    if scene_at is not None and (moments := moments_of(camera, settings, time_code)):
        # Samples of other instants are other pictures: corners of pixels would all be alike.
        settings = replace(settings, tolerance=0.0, camera=camera.path)
        session = session or Session()
        if moments[0].time_code != time_code:
            scene = replace(scene_at(moments[0].time_code), notices=scene.notices)
    blurred = shutter_of_few(camera, settings, moments, readable=scene_at is not None)
    scene, camera, around = _set_up(scene, settings)
    width, height = image_size(camera, settings.image_width, settings.image_height)
    window = window_of(settings, width, height)
    whole = window == (0, 0, width, height)
    with working(executor, settings.jobs, progress, cancel) as work:
        if needs_compiling(_as_drawn(settings, camera)):
            work.progress(0.0, COMPILING)
        limited = work._replace(cancel=lambda: work.cancel() or (watch is not None and watch.is_over()))

        def made(scene: Scene, camera: Camera, work: Work) -> Ready:
            over = glass_over(scene, camera, settings, work)
            return prepare(scene, camera, settings, work, over, session)

        with _time_up(work, watch):
            ready = made(scene, camera, limited)
        guides: list[Found] = []
        other_rays: list[int] = []

        def instants() -> Iterator[Instant]:
            """The stage at one moment after the other, made ready; and what a denoiser reads, drawn of each."""
            one = Instant(ready, scene, camera, ())
            for number, moment in enumerate(moments):
                if number and scene_at is not None:
                    unheard = limited._replace(progress=lambda _share, _stage: None)
                    then, eye, _ = _set_up(scene_at(moment.time_code), settings)
                    one = Instant(made(then, eye, unheard), then, eye, ())
                    other_rays.append(one.ready.rays)
                yield one._replace(samples=moment.samples)
                if settings.denoise or settings.features:
                    first = moment.samples[:1]
                    seen = features_of(*one[:3], settings, (width, height), limited, window, first)
                    guides.append(seen)
            if not moments:
                yield one

        x0, y0, x1, y1 = window
        place = None if whole else Place(x0, y0, width, height)
        metadata: dict[str, str | float] = {
            "software": f"refract {__version__}",
            "refract:stage": _file_name(scene.name),
            "refract:camera": camera.path,
            "refract:timeCode": time_code,
            "refract:samples": float(settings.samples),
            "refract:tiers": ",".join(settings.tiers),
            "refract:screen": settings.screen,
            "refract:metersPerUnit": scene.metres_per_unit,
        }
        seen_by = camera_attributes(scene, camera, (width, height))

        def so_far(planes: dict[str, F32], finished: float) -> Frame:
            """What is drawn, for who wants to see it."""
            return Frame(x1 - x0, y1 - y0, planes, {**metadata, FINISHED: finished}, (), seen_by, place=place)

        stopped: tuple[Notice, ...] = ()
        if watch is None:
            planes, rays = _draw(instants(), scene, camera, settings, (width, height), work, window)
        else:
            drawn = _watched(instants, scene, camera, settings, (width, height), work, window, watch, so_far)
            planes, rays, finished, stopped = drawn
            if finished < 1.0:
                metadata[FINISHED] = finished
        if settings.denoise or settings.features:
            work.progress(1.0, "denoising" if settings.denoise else "image")
            if not guides:
                guides = [features_of(ready, scene, camera, settings, (width, height), work, window)]
            rays += _guide(planes, guides, camera, settings)
        mattes, matte_rays = draw_mattes(ready, scene, camera, settings, (width, height), work, window)
        work.progress(1.0, "done")
    metadata["refract:rays"] = float(rays + ready.rays + sum(other_rays) + matte_rays)
    if settings.denoise:
        metadata["refract:denoised"] = "Open Image Denoise"
    notices = scene.notices + around + camera_light(scene) + open_meshes(scene, settings.model)
    notices += glass_twice(scene, settings)
    notices += ready.notices + lens_of_few(camera, settings) + blurred
    notices += out_of_range(camera, settings, planes) + stopped
    if whole:
        notices += nothing_seen(scene, camera, planes)
    seconds = time.perf_counter() - started
    return Frame(x1 - x0, y1 - y0, planes, metadata, notices, seen_by, mattes, seconds, place)


def camera_attributes(scene: Scene, camera: Camera, size: tuple[int, int]) -> dict[str, tuple[float, ...] | float]:
    """What a picture says of its camera, by OpenEXR's names: see `Frame.camera`.

    `worldToCamera` goes from the stage's world to a camera that looks along -Z with +Y up, in the stage's units, as USD
    has it. `worldToNDC` goes on to where x and y are -1 .. 1 over the picture, to the right and up, and z from -1 at
    the near plane to 1 at the far one, all to be divided by w. Both are for row vectors.
    """
    unit = scene.metres_per_unit
    metres = np.diag([unit, unit, unit, 1.0])  # of the camera's frame, from stage units
    to_camera = np.linalg.inv(scene.stage_from_engine @ camera.world_from_camera @ metres)
    left, right, bottom, top = view_of(camera, *size).window.tolist()
    near, far = (distance / unit for distance in camera.clipping)
    if camera.orthographic:
        left, right, bottom, top = left / unit, right / unit, bottom / unit, top / unit
        z_row, w_row = (0.0, 0.0, -2 / (far - near), -(far + near) / (far - near)), (0.0, 0.0, 0.0, 1.0)
        shift_x, shift_y, place = -(right + left) / (right - left), -(top + bottom) / (top - bottom), 3
    else:
        z_row, w_row = (0.0, 0.0, -(far + near) / (far - near), -2 * far * near / (far - near)), (0.0, 0.0, -1.0, 0.0)
        shift_x, shift_y, place = (right + left) / (right - left), (top + bottom) / (top - bottom), 2
    project = np.array([np.zeros(4), np.zeros(4), z_row, w_row])
    project[0, 0], project[1, 1] = 2 / (right - left), 2 / (top - bottom)
    project[0, place], project[1, place] = shift_x, shift_y
    rows = {"worldToCamera": to_camera.T, "worldToNDC": (project @ to_camera).T}
    return {**{name: tuple(map(float, matrix.ravel())) for name, matrix in rows.items()}, "near": near, "far": far}


def _set_up(scene: Scene, settings: RenderSettings) -> tuple[Scene, Camera, tuple[Notice, ...]]:
    """The scene with what the settings put around it, who takes the picture, and what is to be said of it."""
    if not settings.camera_light:
        scene = replace(scene, camera_light=False)
    if not settings.emission_light:
        scene = _unseen(scene)
    scene = settled(scene)
    camera = camera_of(scene, settings)
    scene, notices = dressed(scene, camera, settings)
    return scene, camera, notices


def _unseen(scene: Scene) -> Scene:
    """The scene, whose lights shine themselves, and not by the bodies that stand for those that the camera sees."""
    seen = {light.path for light in scene.lights if light.seen}
    if not seen:
        return scene
    return replace(
        scene, lights=tuple(replace(light, seen=False) for light in scene.lights),
        meshes=tuple(mesh for mesh in scene.meshes if mesh.path not in seen),
        spheres=tuple(ball for ball in scene.spheres if ball.path not in seen),
    )  # fmt: skip


def _guide(planes: dict[str, F32], guides: Sequence[Found], camera: Camera, settings: RenderSettings) -> int:
    """Let a denoiser read what was drawn for it, and keep that where it is asked for. Returns rays traced for it.

    Args:
        guides: of every instant.
    """
    found = guides[0]
    if len(guides) > 1:
        share = np.float32(1.0 / len(guides))
        albedo, normal = (sum(plane * share for plane in planes) for planes in list(zip(*guides, strict=True))[:2])
        found = Found(albedo, normal, sum(one.rays for one in guides))
    if settings.denoise:
        planes["beauty"] = without_noise(planes["beauty"], found, settings, camera)
    if settings.features:
        planes["albedo"], planes["denoising_normal"] = found.albedo, found.normal
    return found.rays


def camera_light(scene: Scene) -> tuple[Notice, ...]:
    """Say that a light was added that the stage does not have."""
    text = "no light, no dome and nothing that glows, so the camera lights it; --disable-camera-light leaves that out"
    return (Notice("/", text),) if scene.camera_light else ()


STOPPED = "the picture was stopped by its time limit"
"""How the notice about a picture that is whole, but not as good as asked, begins."""
_TOO_EARLY = "the time limit has come before every pixel was drawn, and nothing was written; give it more time"
_NEARLY = 0.9999
"""Share that an unfinished picture says at most."""
NOTHING_SEEN = "no pixel of the picture shows anything of the stage"
"""How the notice about a picture of nothing begins."""


def nothing_seen(scene: Scene, camera: Camera, planes: dict[str, NDArray[np.float32]]) -> tuple[Notice, ...]:
    """Say that the camera looks past everything: no pixel has a depth, glass, or, where no sky covers all, an alpha."""
    covered = scene.environment is None and (planes["beauty"][..., 3] > 0.0).any()
    if covered or (planes["Z"] < np.inf).any() or (planes["mask"] > 0.0).any():
        return ()
    text = "; look at the camera's place, its clippingRange, what is visible, and the purposes"
    return (Notice(camera.path or "/", NOTHING_SEEN + text),)


_WHITE, _GREY, _BLACK = 3.0, 0.4, 0.005
"""Light over which half of a picture, or under which all but its brightest twentieth, shows nothing, and what that
should be instead."""


def out_of_range(
    camera: Camera, settings: RenderSettings, planes: dict[str, NDArray[np.float32]]
) -> tuple[Notice, ...]:
    """Say that most of what is there is far above white, or nearly black, as of files that count lights in watts, and
    by how much. Where no light is at all no exposure shows it."""
    beauty = planes["beauty"]
    there = beauty[..., 3] > 0.0
    found = beauty[..., :3].max(axis=-1)[there]
    light, brightest = np.percentile(found, (50.0, 95.0)).tolist() if found.size else (0.0, 0.0)
    if _WHITE < light < math.inf:
        text = "most of the picture is far above white"
    elif 0.0 < brightest < _BLACK:
        text, light = "the picture is nearly black", brightest
    else:
        return ()
    stops = math.floor(settings.exposure - math.log2(light / _GREY))
    text += f"; --exposure {stops} shows it"
    return (Notice(camera.path or "/", text),)


_LENS_SAMPLES = 64


def lens_of_few(camera: Camera, settings: RenderSettings) -> tuple[Notice, ...]:
    """Say that a lens was seen through from few points."""
    if not camera.lens_radius or settings.samples >= _LENS_SAMPLES:
        return ()
    if settings.samples == 1:
        text = "its lens is left out, because there is one sample: everything is in focus"
    else:
        text = f"what is out of focus is drawn from {settings.samples} points of the lens, and may show as many edges"
    return (Notice(camera.path, f"{text}; --samples {2 * _LENS_SAMPLES} or more is smooth"),)


def open_meshes(scene: Scene, model: str) -> tuple[Notice, ...]:
    """Say which meshes were to be traced but have no inside to trace through."""
    asked = [BY_TOKEN[model] if model else m.model for m in scene.materials]
    walked = [m.refractive and to.behind is Behind.MESH for m, to in zip(scene.materials, asked, strict=True)]
    found = []
    firsts = [replace(many.mesh, path=many.paths[0]) for many in scene.instances if len(many)]
    for mesh in (*scene.meshes, *firsts):
        if not mesh.closed and (mine := {asked[k] for k in np.unique(mesh.materials).tolist() if walked[k]}):
            what = f"the mesh is open, so '{min(mine).token}' finds no far side; drawn as '{SHEET.token}'"
            found.append(Notice(mesh.path, f"{what}. Close the mesh, or set another model"))
    return tuple(found)


def glass_twice(scene: Scene, settings: RenderSettings) -> tuple[Notice, ...]:
    """Say which probes see glass that rays meet by themselves."""
    if "probe" not in settings.tiers or settings.max_layers == 1:
        return ()
    text = "it sees glass (probe:captureRefraction), and rays meet that glass as well, so it may show twice"
    seeing = [probe.path for probe in scene.probes if probe.sees_glass]
    return tuple(Notice(path, f"{text}. Use --max-layers 1, or switch the attribute off") for path in seeing)


def _draw(
    instants: Iterable[Instant], scene: Scene, camera: Camera, settings: RenderSettings, size: tuple[int, int],
    work: Work, window: Tile | None = None,
) -> tuple[dict[str, NDArray[np.float32]], int]:  # fmt: skip
    """All samples, averaged into planes. Returns the planes by AOV name, and rays traced.

    Args:
        instants: what is drawn, one after the other; each has its samples, and none of several has all.
        scene: whose data the planes keep, and `camera` with it.
        window: pixels of the picture that are wanted, whose planes are returned; None is all of it.
    """
    settings = _as_drawn(settings, camera)
    window = window or (0, 0, *size)
    planes = new_planes(*size)
    rays, done = 0, 0.2
    for step in _passes(instants, settings, window, planes):
        share = 0.8 * step.share
        rays += sum(work.run(step.draw, step.items, _told(work, done, share)))
        done += share
    return _finished(scene, camera, settings, planes, window, work), rays


def _passes(instants: Iterable[Instant], settings: RenderSettings, window: Tile, planes: Planes) -> Iterator[Pass]:
    """What draws the samples of one instant after the other into the same sums."""
    done = 0
    for ready, scene, camera, samples in instants:
        yield from Tree(ready, scene, camera, settings, window, planes, samples, done).passes()
        done += len(samples)
        del ready, scene  # gone before the next takes its place


def _finished(
    scene: Scene, camera: Camera, settings: RenderSettings, planes: Planes, window: Tile, work: Work
) -> dict[str, NDArray[np.float32]]:
    """Sums to values, in place; the window of them by AOV name."""
    height, width = planes.mask.shape
    size = width, height
    finish = by_address(finish_of(scene, settings.samples, camera.exposure_scale * 2.0**settings.exposure))
    first, target = by_address(_place(camera, settings, size)), by_address(planes)
    tiles = meeting(tiles_of(*size, settings.tile_size), window)
    work.run(lambda tile: finish_tile(target, first, finish, tile), tiles)
    return {name: part_of(plane, window) for name, plane in by_name(planes).items()}


def _place(camera: Camera, settings: RenderSettings, size: tuple[int, int]) -> View:
    """Data of the picture are of one place in each pixel: its middle, or the first sample's."""
    return view_of(camera, *size) if settings.by_corners else next(sample_views(camera, size, settings.samples))


@contextmanager
def _time_up(work: Work, watch: Watch | None) -> Iterator[None]:
    """What a deadline ends is told as that, not as if a person had done it."""
    try:
        yield
    except Cancelled:
        if work.cancel() or watch is None or not watch.is_over():
            raise
        raise TimeUp(_TOO_EARLY) from None


def _watched(
    instants: Callable[[], Iterable[Instant]], scene: Scene, camera: Camera, settings: RenderSettings,
    size: tuple[int, int], work: Work, window: Tile, watch: Watch, so_far: Callable[[dict[str, F32], float], Frame],
) -> tuple[dict[str, F32], int, float, tuple[Notice, ...]]:  # fmt: skip
    """As `_draw`, for somebody who wants to see it before it is finished: also what share of it is as asked, and a
    notice where that is not all."""
    settings = _as_drawn(settings, camera)
    limited = work._replace(cancel=lambda: work.cancel() or watch.is_over())
    first, rays, done = None, 0, 0.2
    if watch.deadline < math.inf and settings.by_corners:
        quiet = limited._replace(progress=lambda _share, _stage: None)
        with _time_up(work, watch):
            first, rays = _draw(instants(), scene, camera, replace(settings, samples=1), size, quiet, window)
    exposure = camera.exposure_scale * 2.0**settings.exposure
    planes = new_planes(*size)
    drawn = Drawn(planes, _place(camera, settings, size), lambda samples: finish_of(scene, samples, exposure))
    tiles = 0
    try:
        for step in _passes(instants(), settings, window, planes):
            share = 0.8 * step.share
            if step.samples:
                tiles = len(step.items) + (tiles if settings.by_corners else 0)
            tell = _told(work, done, share)
            looking = partial(_look, watch, drawn, settings, tiles, so_far, window)
            told = partial(_tell_both, tell, looking) if settings.by_corners and step.samples else tell
            rays += sum(limited.run(drawn.noting(step), step.items, told))
            done += share
            if not settings.by_corners and 0 < step.samples < settings.samples and watch.wanted():
                watch.take(so_far(drawn.so_far(window), step.samples / settings.samples))
    except Cancelled:
        if work.cancel():
            raise
        least = drawn.least(tiles)
        if first is None and not least:
            raise TimeUp(_TOO_EARLY) from None
        part = drawn.count(settings.samples) / max(1, tiles) if settings.by_corners else least / settings.samples
        part = min(part, _NEARLY)
        how = f"it has {least} of the {settings.samples} samples asked for"
        if settings.by_corners:
            how = f"{100.0 * part:.0f} % of it is as asked, the rest has one sample"
        notice = Notice(camera.path or "/", f"{STOPPED}: {how}")
        return drawn.so_far(window, first), rays, part, (notice,)
    return _finished(scene, camera, settings, planes, window, work), rays, 1.0, ()


def _look(
    watch: Watch, drawn: Drawn, settings: RenderSettings, tiles: int,
    so_far: Callable[[dict[str, F32], float], Frame], window: Tile,
) -> None:  # fmt: skip
    """Show what is finished so far, if there is any and somebody wants to see it."""
    done = drawn.count(settings.samples)
    if done and watch.wanted():
        watch.take(so_far(drawn.so_far(window), min(done / tiles, _NEARLY)))


def _tell_both(tell: Callable[[float], None], look: Callable[[], None], part: float) -> None:
    tell(part)
    look()


def _told(work: Work, done: float, share: float) -> Callable[[float], None]:
    return lambda part: work.progress(done + share * part, "image")


def _as_drawn(settings: RenderSettings, camera: Camera) -> RenderSettings:
    """A lens sees around things, so every sample is a picture of its own: corners of pixels would all be alike."""
    return replace(settings, tolerance=0.0) if camera.lens_radius > 0.0 else settings


# --- what probes see of glass ---------------------------------------------------------------------------------------


def glass_over(
    scene: Scene, camera: Camera, settings: RenderSettings, work: Work
) -> Callable[[World, Bvh], Over]:
    """What draws the glass that a probe sees into its picture: each face of the cube is a picture of its own, of which
    those texels are taken that show glass. Probes do not see one another's pictures: rays answer, and the sky.

    Args:
        camera: of the picture; where a stage has no light it shines.
    """
    quiet = work._replace(progress=lambda _share, _stage: None)
    samples = min(settings.samples, PROBE_SAMPLES)

    def of_world(world: World, bvh: Bvh) -> Over:
        def over(probe: Probe, texels: F32) -> int:
            tiers = ("ray",) if probe.background else ("ray", "sky")
            asked = replace(settings, samples=samples, tiers=tiers, screen="traced", exposure=0.0)
            if probe.captured is None:
                nobody = np.full(thing_count(scene), -1, np.int32)
                ready, seen = Ready(world, bvh, empty_table([], [], camera, False), nobody, 0, ()), scene
            else:
                seen = _part_of(scene, seen_things(scene, probe))
                ready = prepare_bare(seen, camera, settings, quiet)
            side, rays = texels.shape[1], 0
            for face in range(len(texels)):
                eye = face_camera(probe, face)
                planes, traced = _draw([Instant(ready, seen, eye, ())], seen, eye, asked, (side, side), quiet)
                depth = planes["Z"] * scene.metres_per_unit
                paste_face(texels[face], planes["mask"] > 0.0, planes["beauty"], depth, probe.background)
                rays += traced
            return rays

        return over

    return of_world


def _part_of(scene: Scene, prims: frozenset[str]) -> Scene:
    """The scene with these prims alone."""
    return replace(
        scene,
        meshes=tuple(mesh for mesh in scene.meshes if prim_of(mesh.path) in prims),
        spheres=tuple(ball for ball in scene.spheres if prim_of(ball.path) in prims),
        instances=tuple(some for many in scene.instances if len(some := within(many, prims))),
        balls=tuple(left for balls in scene.balls if len(left := within(balls, prims))),
    )
