"""One frame: the rooms in order, tiles on threads, progress and cancel.

stage -> Scene -> tables and BVH -> probes -> per sample: opaque layer, refractive layers far to near -> Frame
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, wait
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import Cancelled, UsageError
from ..images.frame import Frame
from ..kernels.compile import is_compiled
from ..kernels.pointer import Pointer
from ..kernels.sampling import pixel_offset
from ..probes.capture import cubemap_of, fill_table
from ..probes.lookup import empty_table
from ..probes.plan import Plan, plan_capture, plan_picture
from ..progress import COMPILING
from ..scene import Camera, Cubemap, Model, Notice, Param, Probe, Scene
from ..settings import TIERS, RenderSettings
from ..transport.layers import Choices, LayerResult, new_layer_result, put_tile, refract_tile
from ..transport.scratch import scratch
from ..version import __version__
from ..view.camera import View, image_size, view_of
from ..view.gbuffer import OpaqueLayer, RefractiveLayer, new_refractive_layer, opaque_tile, peel_tile
from ..view.planes import Planes, add_tile, by_name, finish_of, finish_tile, new_planes
from ..view.pyramid import Screen, ScreenBuffers, blur_level, fill_depth_levels, new_screen_buffers
from ..world import environment, textures
from ..world.embree import Bvh
from ..world.lights import pack_lights
from ..world.tables import pack_geometry, pack_materials
from ..world.tracing import world_of

_PROBE_SAMPLES = 4
"""Most rays per probe texel; more samples of the picture do not make probes finer."""

Progress = Callable[[float, str], None]
Cancel = Callable[[], bool]
Tile = tuple[int, int, int, int]


class Work(NamedTuple):
    """How tiles get done, and who listens."""

    executor: Executor
    progress: Progress
    cancel: Cancel

    def run(
        self, function: Callable[[Any], Any], items: Sequence[Any], told: Callable[[float], None] | None = None
    ) -> list[Any]:
        """Map in order; stop early and raise Cancelled when asked to. `told`: hears now and then what share is done."""
        if self.cancel():
            raise Cancelled("cancelled; nothing was written")
        futures = [self.executor.submit(function, item) for item in items]
        pending = set(futures)
        try:
            while pending:
                _, pending = wait(pending, timeout=0.2)
                if told:
                    told(1.0 - len(pending) / len(futures))
                if self.cancel():
                    raise Cancelled("cancelled; nothing was written")
        except BaseException:
            for future in pending:
                future.cancel()
            wait(pending)
            raise
        return [future.result() for future in futures]


class Session(NamedTuple):
    """A scene made ready: tables, and the BVH they point into."""

    world: Pointer
    bvh: Bvh
    probes: Pointer
    thing_probe: NDArray[np.int32]
    rays: int
    notices: tuple[Notice, ...]


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
) -> Frame:
    """Render one picture of a scene.

    Args:
        progress: called with a fraction 0 .. 1 and the name of the stage of work.
        cancel: asked between tiles; True stops the render.
        executor: where tiles run; must share this process's memory. None makes `settings.jobs` threads.

    Raises:
        UsageError: no such camera, or a camera without a field of view.
        SceneError: a record of the scene is malformed.
        Cancelled: `cancel` said so.
    """
    settings = settings or RenderSettings()
    camera = choose_camera(scene, settings.camera)
    width, height = image_size(camera, settings.image_width, settings.image_height)
    jobs = settings.jobs or os.cpu_count() or 1
    own = ThreadPoolExecutor(jobs) if executor is None else None
    try:
        work = Work(executor or own, progress or (lambda _f, _s: None), cancel or (lambda: False))  # type: ignore[arg-type]
        if not is_compiled(refract_tile):
            work.progress(0.0, COMPILING)
        session = prepare(scene, camera, settings, height, work)
        planes, rays = _draw(session, scene, camera, settings, (width, height), work)
    finally:
        if own is not None:
            own.shutdown()
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
        "refract:rays": float(rays + session.rays),
    }
    notices = scene.notices + open_meshes(scene, settings.model) + session.notices
    return Frame(width, height, planes, metadata, notices)


def open_meshes(scene: Scene, model: str) -> tuple[Notice, ...]:
    """Say which meshes were to be traced but have no inside to trace through."""
    text = "the mesh is open, so 'traced' finds no far side; drawn as 'thin'. Close the mesh, or set another model"
    traced = np.array([m.refractive and (m.model is Model.TRACED or model == "traced") for m in scene.materials], bool)
    return tuple(Notice(m.path, text) for m in scene.meshes if not m.closed and traced[m.materials].any())


def choose_camera(scene: Scene, name: str) -> Camera:
    """The camera by path or name; the scene's own choice where `name` is ''. Raises UsageError."""
    if not scene.cameras:
        raise UsageError("the scene has no camera; the reader always gives one, so add one to Scene.cameras")
    if not name:
        return scene.cameras[0]
    for camera in scene.cameras:
        if name in (camera.path, camera.path.rpartition("/")[2]):
            return camera
    known = ", ".join(camera.path for camera in scene.cameras)
    raise UsageError(f"--camera {name}: the stage has no such camera; it has {known}")


def prepare(scene: Scene, camera: Camera, settings: RenderSettings, height: int, work: Work) -> Session:
    """Pack tables, build the BVH, capture probes."""
    wanted = "probe" in settings.tiers or settings.screen == "proxy"
    chosen = plan_picture(scene, camera, height, wanted)
    if "probe" not in settings.tiers:  # their proxies may still serve the screen tier
        chosen = chosen._replace(entries=[entry._replace(drawn=False) for entry in chosen.entries])
    samples = min(settings.samples, _PROBE_SAMPLES)
    return _prepare(scene, camera, chosen, _is_rough(scene), samples, work, (0.1, 0.2))


def _prepare(
    scene: Scene, camera: Camera, chosen: Plan, rough: bool, samples: int, work: Work, span: tuple[float, float]
) -> Session:
    geometry, bvh, slots = pack_geometry(scene, chosen.captured_sets)
    world = Pointer(
        world_of(
            geometry,
            pack_materials(scene.materials, slots),
            textures.pack(scene.textures),
            pack_lights(scene, camera.world_from_camera[:3, 3]),
            environment.pack(scene.environment),
        )
    )
    entries = chosen.entries
    table = empty_table([e.probe for e in entries], [e.owned for e in entries], camera, rough)

    def run(function: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
        return work.run(
            function, items, lambda share: work.progress(span[0] + (span[1] - span[0]) * share, "probes")
        )

    work.progress(span[0], "probes")
    rays = fill_table(table, entries, world, run, samples)
    return Session(world, bvh, Pointer(table), chosen.thing_probe, rays, chosen.notices)


def capture_probes(
    scene: Scene,
    probes: Sequence[Probe],
    *,
    samples: int = 16,
    jobs: int = 0,
    progress: Progress | None = None,
    cancel: Cancel | None = None,
    executor: Executor | None = None,
) -> list[Cubemap]:
    """Take the pictures of cube probes, with all their levels, as `refract bake probes` does.

    Args:
        probes: of the scene, or made by hand; what they have for a `cubemap` is ignored. None may be planar.
        samples: rays per texel, 1 .. 4096.
        jobs: threads; 0 means all cores.

    Raises:
        UsageError: a probe is planar: its picture depends on the camera.
        Cancelled: `cancel` said so.
    """
    for probe in probes:
        if probe.planar:
            raise UsageError(f"{probe.path}: a planar probe's picture depends on the camera; leave it to the render")
    own = ThreadPoolExecutor(jobs or os.cpu_count() or 1) if executor is None else None
    try:
        work = Work(executor or own, progress or (lambda _f, _s: None), cancel or (lambda: False))  # type: ignore[arg-type]
        chosen = plan_capture(scene, [replace(probe, cubemap=None) for probe in probes])
        session = _prepare(scene, choose_camera(scene, ""), chosen, True, samples, work, (0.0, 1.0))
    finally:
        if own is not None:
            own.shutdown()
    return [cubemap_of(session.probes.record, k) for k in range(len(probes))]


def tiles_of(width: int, height: int, side: int) -> list[Tile]:
    """Squares that cover the image; their sides are multiples of 4, so that blocks never depend on them."""
    side = (side + 3) // 4 * 4
    return [
        (x, y, min(x + side, (width + 3) // 4 * 4), min(y + side, (height + 3) // 4 * 4))
        for y in range(0, height, side)
        for x in range(0, width, side)
    ]


def _draw(
    session: Session, scene: Scene, camera: Camera, settings: RenderSettings, size: tuple[int, int], work: Work
) -> tuple[dict[str, NDArray[np.float32]], int]:
    """All samples, averaged into planes. Returns the planes by AOV name, and rays traced."""
    order = np.array([TIERS.index(t) for t in settings.tiers], np.int32)
    model = int(Model[settings.model.upper()]) if settings.model else -1
    choices = Choices(order, settings.screen == "proxy", model)
    tiles = tiles_of(*size, settings.tile_size)
    planes = new_planes(*size)
    easel = new_easel(size, _is_rough(scene), planes)
    rays = 0
    for sample in range(settings.samples):
        work.progress(0.2 + 0.8 * sample / settings.samples, "image")
        view = view_of(camera, *size, pixel_offset(sample))
        rays += _draw_sample(session, easel, view, choices, settings.max_layers, tiles, sample, work)
    finish = Pointer(finish_of(scene, settings.samples, camera.exposure_scale * 2.0**settings.exposure))
    centred, target = Pointer(view_of(camera, *size)), Pointer(planes)
    work.run(lambda tile: finish_tile(target, centred, finish, tile), tiles)
    return by_name(planes), rays


class Easel(NamedTuple):
    """Buffers that every sample draws into anew."""

    screen: ScreenBuffers
    opaque: OpaqueLayer
    layers: list[RefractiveLayer]
    result: LayerResult
    planes: Planes


def new_easel(size: tuple[int, int], blurred: bool, planes: Planes) -> Easel:
    """Allocate for one image size. The opaque layer is level 0 of the screen's pyramids."""
    width, height = size
    screen = new_screen_buffers(width, height, blurred)
    opaque = OpaqueLayer(
        screen.color[: width * height].reshape(height, width, 3),
        screen.depth[: width * height].reshape(height, width),
        screen.normal,
        np.zeros((height, width), np.float32),
    )
    return Easel(screen, opaque, [new_refractive_layer(width, height)], new_layer_result(width, height), planes)


def _draw_sample(
    session: Session, easel: Easel, view: View, choices: Choices, max_layers: int, tiles: list[Tile], sample: int,
    work: Work,
) -> int:  # fmt: skip
    """One sample of every pixel. Returns rays traced."""
    world, camera, opaque = session.world, Pointer(view), easel.opaque
    first, behind = Pointer(easel.layers[0]), Pointer(opaque)
    counts = work.run(lambda tile: opaque_tile(world, camera, scratch(), tile, sample, behind, first), tiles)
    rays = sum(c[0] for c in counts)
    busy = [tile for tile, c in zip(tiles, counts, strict=True) if c[1]]
    if sample == 0:
        easel.planes.z_depth[:] = opaque.depth
        easel.planes.normal[:] = opaque.normal
    inside = [tile for tile, c in zip(tiles, counts, strict=True) if c[2]]
    if inside:  # the eye is in glass there: go on to the first surface entered
        found = work.run(lambda tile: peel_tile(world, camera, scratch(), tile, opaque.depth, first, first), inside)
        rays += sum(c[0] for c in found)
    used, peeled = _peel(session, easel, camera, max_layers, busy, work)
    rays += peeled
    if sample == 0:
        for layer in easel.layers[:used]:
            np.add(easel.planes.layers, layer.part >= 0, out=easel.planes.layers)
    for k in reversed(range(used if busy else 0)):
        rays += _composite_layer(session, easel, view, choices, k, busy, sample, work)
    target = Pointer(easel.planes)
    work.run(lambda tile: add_tile(target, behind, view.size, tile), tiles)
    return rays


def _peel(
    session: Session, easel: Easel, camera: Pointer, max_layers: int, busy: list[Tile], work: Work
) -> tuple[int, int]:
    """Find the layers behind the first. Returns how many layers there are, and rays traced."""
    rays = 0
    for k in range(1, max_layers if busy else 1):
        if k == len(easel.layers):
            easel.layers.append(new_refractive_layer(*(int(n) for n in camera.record.size)))
        previous, here = Pointer(easel.layers[k - 1]), Pointer(easel.layers[k])
        depth = easel.opaque.depth
        found = work.run(
            lambda tile: peel_tile(session.world, camera, scratch(), tile, depth, previous, here),  # noqa: B023
            busy,
        )
        rays += sum(c[0] for c in found)
        if not any(c[1] for c in found):
            return k, rays
    return max(1, max_layers), rays


def _composite_layer(
    session: Session, easel: Easel, view: View, choices: Choices, k: int, busy: list[Tile], sample: int, work: Work
) -> int:
    """Draw layer `k` from the picture as it is behind it, then put it into the picture. Returns rays traced."""
    screen = easel.screen
    if TIERS.index("screen") in choices.tiers:
        blurs = range(1, len(screen.color_level))
        jobs: list[Callable[[], Any]] = [
            lambda: fill_depth_levels(screen.depth, screen.farthest, screen.depth_level),
            lambda: [blur_level(screen.color, screen.color_level, i) for i in blurs],
        ]
        work.run(lambda job: job(), jobs)
    buffers, chosen = Pointer(Screen(view, *screen)), Pointer(choices)
    layer, result, planes = Pointer(easel.layers[k]), Pointer(easel.result), Pointer(easel.planes)
    counts = work.run(
        lambda tile: refract_tile(
            session.world, buffers, session.probes, session.thing_probe, chosen, scratch(), tile, sample, layer,
            result, planes, k == 0,
        ),
        busy,
    )
    picture = Pointer(easel.opaque)
    work.run(lambda tile: put_tile(layer, result, picture, view.size, tile), busy)
    return sum(counts)


def _is_rough(scene: Scene) -> bool:
    """Some refractive material may be rough, so the colour pyramid will be read above level 0."""
    for material in scene.materials:
        source = material.inputs[Param.ROUGHNESS]
        if material.refractive and (source.value[0] > 0.0 or source.texture >= 0 or source.primvar):
            return True
    return False
