"""A scene made ready: tables, the BVH they point into, and the pictures of the probes that serve a picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import UsageError
from ..kernels.lanes import by_address
from ..probes.capture import Over, cubemap_of, fill_table
from ..probes.lookup import ProbeTable, empty_table
from ..probes.plan import Plan, plan_capture, plan_picture
from ..scene import Camera, Cubemap, Notice, Param, Probe, Scene
from ..settings import RenderSettings
from ..world import environment, textures
from ..world.embree import Bvh
from ..world.lights import pack_lights
from ..world.tables import World, pack_geometry, pack_materials, world_of
from .work import Cancel, Progress, Work, working

PROBE_SAMPLES = 16
"""Most rays per probe texel; more samples of the picture do not make probes finer."""


class Session(NamedTuple):
    """A scene made ready: tables, and the BVH they point into."""

    world: World
    """by address"""
    bvh: Bvh
    probes: ProbeTable
    thing_probe: NDArray[np.int32]
    rays: int
    notices: tuple[Notice, ...]


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


def prepare(
    scene: Scene, camera: Camera, settings: RenderSettings, work: Work, over: Callable[[World, Bvh], Over] | None = None
) -> Session:
    """Pack tables, build the BVH, capture probes.

    Args:
        over: given the packed scene, what draws the glass that probes see (`picture.glass_over`); None leaves it out.
    """
    proxies = "screen" in settings.tiers and settings.screen == "proxy"
    chosen = plan_picture(scene, camera, drawn="probe" in settings.tiers, proxies=proxies)
    # Where pixels are made from corners, most of them are seen four times, however many samples edges take.
    samples = min(max(1, settings.samples // 4) if settings.by_corners else settings.samples, PROBE_SAMPLES)
    return _prepare(scene, camera, chosen, is_rough(scene), samples, work, (0.1, 0.2), over)


def prepare_bare(scene: Scene, camera: Camera, work: Work) -> Session:
    """A scene made ready to be drawn without any probes."""
    return _prepare(scene, camera, plan_capture(scene, []), False, 1, work, (0.0, 0.0))


def _prepare(
    scene: Scene,
    camera: Camera,
    chosen: Plan,
    rough: bool,
    samples: int,
    work: Work,
    span: tuple[float, float],
    over: Callable[[World, Bvh], Over] | None = None,
) -> Session:
    geometry, bvh, slots = pack_geometry(scene, chosen.captured_sets)
    world = by_address(
        world_of(
            geometry,
            pack_materials(scene.materials, slots),
            textures.pack(scene.textures),
            pack_lights(scene, camera.world_from_camera[:3, 3]),
            environment.pack(scene.environment),
        )
    )
    entries = chosen.entries
    table = empty_table([e.probe for e in entries], [e.drawn for e in entries], camera, rough)

    def run(function: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
        return work.run(
            function, items, lambda share: work.progress(span[0] + (span[1] - span[0]) * share, "probes")
        )

    work.progress(span[0], "probes")
    rays = fill_table(table, entries, world, run, samples, over and over(world, bvh))
    return Session(world, bvh, table, chosen.thing_probe, rays, chosen.notices)


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
    with working(executor, jobs, progress, cancel) as work:
        chosen = plan_capture(scene, [replace(probe, cubemap=None) for probe in probes])
        session = _prepare(scene, choose_camera(scene, ""), chosen, True, samples, work, (0.0, 1.0))
    return [cubemap_of(session.probes, k) for k in range(len(probes))]


def is_rough(scene: Scene) -> bool:
    """Some refractive material may be rough, so the colour pyramid will be read above level 0."""
    for material in scene.materials:
        source = material.inputs[Param.ROUGHNESS]
        if material.refractive and (source.value[0] > 0.0 or source.texture >= 0 or source.primvar):
            return True
    return False
