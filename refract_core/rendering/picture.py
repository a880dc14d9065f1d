"""One picture: a scene made ready, samples drawn by an integrator, sums made into a frame.

stage -> Scene -> tables and BVH -> probes -> per sample: the integrator's passes over the tiles -> Frame
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..images.frame import Frame
from ..kernels.lanes import by_address
from ..models import BY_TOKEN, SHEET, Behind
from ..probes.capture import Over, face_camera, paste_face
from ..probes.lookup import empty_table
from ..probes.plan import seen_things
from ..progress import COMPILING
from ..scene import F32, Camera, Notice, Probe, Scene, prim_of
from ..settings import RenderSettings
from ..version import __version__
from ..view.camera import image_size, view_of
from ..view.planes import by_name, finish_of, finish_tile, new_planes
from ..world.embree import Bvh
from ..world.instances import settled, thing_count, within
from ..world.tables import World
from .branching import Tree, needs_compiling, sample_views
from .ready import PROBE_SAMPLES, Ready, choose_camera, prepare, prepare_bare
from .session import Session
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
) -> Frame:
    """Render one picture of a scene.

    Args:
        progress: called with a fraction 0 .. 1 and the name of the stage of work.
        cancel: asked between tiles; True stops the render.
        executor: where tiles run; must share this process's memory. None makes `settings.jobs` threads.
        session: has what earlier pictures needed, and keeps what this one does; the picture is the same without it.

    Raises:
        UsageError: no such camera, or a camera without a field of view.
        SceneError: a record of the scene is malformed.
        Cancelled: `cancel` said so.
    """
    settings = settings or RenderSettings()
    if not settings.camera_light:
        scene = replace(scene, camera_light=False)
    scene = settled(scene)
    camera = choose_camera(scene, settings.camera)
    width, height = image_size(camera, settings.image_width, settings.image_height)
    with working(executor, settings.jobs, progress, cancel) as work:
        if needs_compiling(_as_drawn(settings, camera)):
            work.progress(0.0, COMPILING)
        ready = prepare(scene, camera, settings, work, glass_over(scene, camera, settings, work), session)
        planes, rays = _draw(ready, scene, camera, settings, (width, height), work)
        work.progress(1.0, "done")
    metadata: dict[str, str | float] = {
        "software": f"refract {__version__}",
        "refract:stage": _file_name(scene.name),
        "refract:camera": camera.path,
        "refract:timeCode": scene.time_code,
        "refract:samples": float(settings.samples),
        "refract:tiers": ",".join(settings.tiers),
        "refract:screen": settings.screen,
        "refract:metersPerUnit": scene.metres_per_unit,
        "refract:rays": float(rays + ready.rays),
    }
    notices = scene.notices + camera_light(scene) + open_meshes(scene, settings.model) + glass_twice(scene, settings)
    notices += ready.notices + lens_of_few(camera, settings) + nothing_seen(scene, camera, planes)
    return Frame(width, height, planes, metadata, notices)


def camera_light(scene: Scene) -> tuple[Notice, ...]:
    """Say that a light was added that the stage does not have."""
    text = "no light, no dome and nothing that glows, so the camera lights it; --disable-camera-light leaves that out"
    return (Notice("/", text),) if scene.camera_light else ()


NOTHING_SEEN = "no pixel of the picture shows anything of the stage"
"""How the notice about a picture of nothing begins."""


def nothing_seen(scene: Scene, camera: Camera, planes: dict[str, NDArray[np.float32]]) -> tuple[Notice, ...]:
    """Say that the camera looks past everything: no pixel has a depth, glass, or, where no sky covers all, an alpha."""
    covered = scene.environment is None and (planes["beauty"][..., 3] > 0.0).any()
    if covered or (planes["Z"] < np.inf).any() or (planes["mask"] > 0.0).any():
        return ()
    text = "; look at the camera's place, its clippingRange, what is visible, and the purposes"
    return (Notice(camera.path or "/", NOTHING_SEEN + text),)


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
    ready: Ready, scene: Scene, camera: Camera, settings: RenderSettings, size: tuple[int, int], work: Work
) -> tuple[dict[str, NDArray[np.float32]], int]:
    """All samples, averaged into planes. Returns the planes by AOV name, and rays traced."""
    settings = _as_drawn(settings, camera)
    tiles = tiles_of(*size, settings.tile_size)
    planes = new_planes(*size)
    rays, done = 0, 0.2
    for step in Tree(ready, scene, camera, settings, tiles, planes).passes():
        share = 0.8 * step.share
        rays += sum(work.run(step.draw, step.items, _told(work, done, share)))
        done += share
    finish = by_address(finish_of(scene, settings.samples, camera.exposure_scale * 2.0**settings.exposure))
    # Data of the picture are of one place in each pixel: its middle, or the first sample's.
    place = view_of(camera, *size) if settings.by_corners else next(sample_views(camera, size, settings.samples))
    first, target = by_address(place), by_address(planes)
    work.run(lambda tile: finish_tile(target, first, finish, tile), tiles)
    return by_name(planes), rays


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
                planes, traced = _draw(ready, seen, face_camera(probe, face), asked, (side, side), quiet)
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
