"""One frame: the rooms in order, tiles on threads, progress and cancel.

stage -> Scene -> tables and BVH -> probes -> per sample: opaque layer, refractive layers far to near -> Frame
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, wait
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import capture, environment, textures
from .camera import View, image_size, view_of
from .embree import Bvh
from .errors import Cancelled, UsageError
from .frame import Frame
from .gbuffer import OpaqueLayer, RefractiveLayer, new_refractive_layer, opaque_tile, peel_tile
from .kernel import is_compiled
from .lights import pack_lights
from .pointer import Pointer
from .pyramid import ScreenBuffers, blur_level, nearest_levels, new_screen_buffers
from .refraction import Choices, LayerResult, new_layer_result, refract_tile
from .sampling import pixel_offset
from .scene import Camera, Model, Param, Scene
from .settings import TIERS, RenderSettings
from .tables import pack_geometry, pack_materials
from .scratch import scratch
from .tracing import world_of
from .version import __version__

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

    def run(self, function: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
        """Map in order; stop early and raise Cancelled when asked to."""
        if self.cancel():
            raise Cancelled("cancelled; nothing was written")
        futures = [self.executor.submit(function, item) for item in items]
        pending = set(futures)
        try:
            while pending:
                _, pending = wait(pending, timeout=0.2)
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
            work.progress(0.0, "compiling kernels (first run only, about a minute)")
        session = prepare(scene, camera, settings, height, work)
        planes, rays = _draw(session, scene, camera, settings, (width, height), work)
    finally:
        if own is not None:
            own.shutdown()
    work.progress(1.0, "done")
    metadata: dict[str, str | float] = {
        "software": f"refract {__version__}",
        "refract:stage": scene.name,
        "refract:camera": camera.path,
        "refract:timeCode": scene.time_code,
        "refract:samples": float(settings.samples),
        "refract:tiers": ",".join(settings.tiers),
        "refract:screen": settings.screen,
        "refract:metersPerUnit": scene.metres_per_unit,
        "refract:rays": float(rays + session.rays),
    }
    return Frame(width, height, planes, metadata, scene.notices)


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
    plan = capture.plan(scene, height, wanted="probe" in settings.tiers or settings.screen == "proxy")
    geometry, bvh, slots = pack_geometry(scene, plan.captured_sets)
    world = Pointer(
        world_of(
            geometry,
            pack_materials(scene.materials, slots),
            textures.pack(scene.textures),
            pack_lights(scene, camera.world_from_camera[:3, 3]),
            environment.pack(scene.environment),
        )
    )
    if "probe" not in settings.tiers:  # their proxies may still serve the screen tier
        plan = plan._replace(entries=[entry._replace(drawn=False) for entry in plan.entries])
    work.progress(0.1, "probes")
    table, rays = capture.capture(plan, world, camera, work.run, min(settings.samples, _PROBE_SAMPLES))
    return Session(world, bvh, Pointer(table), plan.thing_probe, rays)


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
    """All samples, averaged into planes."""
    order = np.array([TIERS.index(t) for t in settings.tiers], np.int32)
    model = int(Model[settings.model.upper()]) if settings.model else -1
    choices = Choices(order, settings.screen == "proxy", model)
    tiles = tiles_of(*size, settings.tile_size)
    exposure = camera.exposure_scale * 2.0**settings.exposure
    total = Accumulator(*size)
    rays = 0
    for sample in range(settings.samples):
        work.progress(0.2 + 0.8 * sample / settings.samples, "image")
        view = view_of(camera, *size, pixel_offset(sample))
        rays += _draw_sample(session, scene, view, choices, settings.max_layers, tiles, sample, total, work)
    return total.planes(settings.samples, exposure, scene, view_of(camera, *size)), rays


def _draw_sample(
    session: Session, scene: Scene, view: View, choices: Choices, max_layers: int, tiles: list[Tile], sample: int,
    total: Accumulator, work: Work,
) -> int:  # fmt: skip
    """One sample of every pixel. Returns rays traced."""
    width, height = int(view.size[0]), int(view.size[1])
    world, camera = session.world, Pointer(view)
    screen = new_screen_buffers(view, _is_rough(scene))
    color = screen.color[: width * height].reshape(height, width, 3)
    depth = screen.depth[: width * height].reshape(height, width)
    opaque = OpaqueLayer(color, depth, screen.normal, np.zeros((height, width), np.float32))
    layers = [new_refractive_layer(width, height)]
    behind, first = Pointer(opaque), Pointer(layers[0])
    counts = work.run(lambda tile: opaque_tile(world, camera, scratch(), tile, sample, behind, first), tiles)
    rays = sum(c[0] for c in counts)
    busy = [tile for tile, c in zip(tiles, counts, strict=True) if c[1]]
    inside = [tile for tile, c in zip(tiles, counts, strict=True) if c[2]]
    if inside:  # the eye is in glass there: go on to the first surface entered
        found = work.run(lambda tile: peel_tile(world, camera, scratch(), tile, depth, first, first), inside)
        rays += sum(c[0] for c in found)
    while busy and len(layers) < max_layers:
        layer = new_refractive_layer(width, height)
        previous, here = Pointer(layers[-1]), Pointer(layer)
        found = work.run(lambda tile: peel_tile(world, camera, scratch(), tile, depth, previous, here), busy)  # noqa: B023
        rays += sum(c[0] for c in found)
        if not any(c[1] for c in found):
            break
        layers.append(layer)
    total.note_opaque(opaque, sample)
    result = new_layer_result(width, height)
    for k in reversed(range(len(layers))):
        if not busy:
            break
        rays += _composite_layer(session, screen, opaque, choices, layers[k], result, busy, sample, work)
    total.note(opaque, layers, result if busy else None, sample)
    return rays


def _composite_layer(
    session: Session, screen: ScreenBuffers, opaque: OpaqueLayer, choices: Choices, layer: RefractiveLayer,
    result: LayerResult, busy: list[Tile], sample: int, work: Work,
) -> int:  # fmt: skip
    """Draw one layer from the screen as it is behind it, then put it into the screen."""
    if 0 in choices.tiers:
        jobs: list[Callable[[], Any]] = [lambda: nearest_levels(screen.depth, screen.depth_level)]
        jobs.append(lambda: [blur_level(screen.color, screen.color_level, k) for k in range(1, len(screen.color_level))])
        work.run(lambda job: job(), jobs)
    buffers, chosen, surface, out = Pointer(screen), Pointer(choices), Pointer(layer), Pointer(result)
    counts = work.run(
        lambda tile: refract_tile(
            session.world, buffers, session.probes, session.thing_probe, chosen, scratch(), tile, sample, surface, out
        ),
        busy,
    )
    here = layer.part >= 0
    np.copyto(opaque.color, result.color, where=here[..., None])
    np.copyto(opaque.depth, result.depth, where=here)
    np.copyto(opaque.normal, result.ng, where=here[..., None])
    np.copyto(opaque.alpha, np.maximum(opaque.alpha, result.alpha), where=here)
    return sum(counts)


def _is_rough(scene: Scene) -> bool:
    """Some refractive material may be rough, so the colour pyramid will be read above level 0."""
    for material in scene.materials:
        source = material.inputs[Param.ROUGHNESS]
        if material.refractive and (source.value[0] > 0.0 or source.texture >= 0 or source.primvar):
            return True
    return False


class Accumulator:
    """Sums of colours over samples; data planes keep sample 0, which stands at the pixel's centre."""

    def __init__(self, width: int, height: int) -> None:
        self.beauty = np.zeros((height, width, 4), np.float32)
        self.mask = np.zeros((height, width), np.float32)
        self.layer = new_layer_result(width, height)
        self.n = np.zeros((height, width, 3), np.float32)
        self.z = np.zeros((height, width), np.float32)
        self.layers = np.zeros((height, width), np.float32)

    def note_opaque(self, opaque: OpaqueLayer, sample: int) -> None:
        """Depth and normal of what lies behind, before glass is drawn over it."""
        if sample == 0:
            self.z[:] = opaque.depth
            self.n[:] = opaque.normal

    def note(
        self, opaque: OpaqueLayer, layers: list[RefractiveLayer], result: LayerResult | None, sample: int
    ) -> None:
        """Add one finished sample."""
        self.beauty[..., :3] += opaque.color
        self.beauty[..., 3] += opaque.alpha
        if result is None:
            return
        here = layers[0].part >= 0
        self.mask += here
        for mine, new in (
            (self.layer.refraction, result.refraction),
            (self.layer.reflection, result.reflection),
            (self.layer.transmittance, result.transmittance),
            (self.layer.weights, result.weights),
        ):
            np.add(mine, new, out=mine, where=here[..., None])
        np.add(self.layer.confidence, result.confidence, out=self.layer.confidence, where=here)
        if sample == 0:
            np.copyto(self.layer.thickness, result.thickness, where=here)
            np.copyto(self.layer.path_length, result.path_length, where=here)
            np.copyto(self.n, result.normal, where=here[..., None])
            np.copyto(self.z, result.depth, where=here)
            for layer in layers:
                self.layers += layer.part >= 0

    def planes(self, samples: int, exposure: float, scene: Scene, view: View) -> dict[str, NDArray[np.float32]]:
        """AOVs by name. Lengths are in the stage's own units; P and N are in its world."""
        unit = np.float32(1.0 / scene.metres_per_unit)
        share = np.float32(1.0 / samples)
        light = np.float32(exposure / samples)
        covered = np.maximum(self.mask, 1.0)
        beauty = self.beauty
        beauty[..., :3] *= light
        beauty[..., 3] *= share
        weights = self.layer.weights / covered[..., None]
        return {
            "beauty": beauty,
            "refraction": self.layer.refraction * light,
            "reflection": self.layer.reflection * light,
            "transmittance": self.layer.transmittance / covered[..., None],
            "N": _stage_normals(self.n, scene),
            "P": _stage_points(self.z, scene, view),
            "Z": self.z * unit,
            "mask": self.mask * share,
            "thickness": self.layer.thickness * unit,
            "path_length": self.layer.path_length * unit,
            "layers": self.layers,
            "weight.screen": np.ascontiguousarray(weights[..., 0]),
            "weight.ray": np.ascontiguousarray(weights[..., 1]),
            "weight.probe": np.ascontiguousarray(weights[..., 2]),
            "weight.sky": np.ascontiguousarray(weights[..., 3]),
            "weight.none": np.ascontiguousarray(weights[..., 4]),
            "confidence": self.layer.confidence / covered,
        }


def _stage_normals(n: NDArray[np.float32], scene: Scene) -> NDArray[np.float32]:
    rotation = scene.stage_from_engine[:3, :3]
    rotation = rotation / np.cbrt(abs(np.linalg.det(rotation)))
    return (n @ rotation.T.astype(np.float32)).astype(np.float32)


def _stage_points(z: NDArray[np.float32], scene: Scene, view: View) -> NDArray[np.float32]:
    """World position of every pixel centre at its z_depth, in the stage's world; 0 where nothing was hit."""
    h, w = z.shape
    left, right, bottom, top = view.window
    x = (left + (right - left) * (np.arange(w) + 0.5) / w)[None, :, None]
    y = (top + (bottom - top) * (np.arange(h) + 0.5) / h)[:, None, None]
    r, u, f, eye = view.axes
    depth = np.where(np.isfinite(z), z, 0.0)[..., None].astype(np.float64)
    points = eye + f * depth + (x * r + y * u) * (1.0 if view.orthographic else depth)
    m = scene.stage_from_engine
    points = points @ m[:3, :3].T + m[:3, 3]
    return np.where(np.isfinite(z)[..., None], points, 0.0).astype(np.float32)
