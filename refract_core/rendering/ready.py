"""A scene made ready: tables, the BVH they point into, and the pictures of the probes that serve a picture."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import UsageError
from ..kernels.lanes import by_address
from ..probes.capture import Over, Run, cubemap_of, fill_table
from ..probes.lookup import ProbeTable, empty_table
from ..probes.plan import Entry, Plan, plan_capture, plan_picture
from ..scene import Camera, Cubemap, Notice, Param, Probe, Scene
from ..settings import NO_CROP, NO_ORBIT, RenderSettings
from ..view.orbit import orbit
from ..world import environment, textures
from ..world.embree import Bvh
from ..world.emitters import what_glows
from ..world.instances import settled
from ..world.lamps import pack_lights
from ..world.tables import (
    Geometry,
    MaterialTable,
    World,
    caster_sets,
    pack_geometry,
    pack_materials,
    primvar_slots,
    world_of,
)
from .caustics import caustics_of, plan_caustics, with_caustics
from .indirect import indirect_of
from .session import Session
from .work import Cancel, Progress, Work, working

PROBE_SAMPLES = 16
"""Most rays per probe texel; more samples of the picture do not make probes finer."""


class Ready(NamedTuple):
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


def camera_of(scene: Scene, settings: RenderSettings) -> Camera:
    """The camera that takes the picture: one of the scene's, or one of its own by the model of `view.orbit`.

    Raises:
        UsageError: no such camera, or nothing to look at.
    """
    if settings.orbits and not settings.camera:
        return orbit(scene, settings)
    chosen = choose_camera(scene, settings.camera)
    if settings.orbits:
        return orbit(scene, settings, chosen)
    return orbit(scene, settings) if chosen.framing else chosen


def prepare(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings,
    work: Work,
    over: Callable[[World, Bvh], Over] | None = None,
    session: Session | None = None,
) -> Ready:
    """Pack tables, build the BVH, send light through glass, capture probes.

    Args:
        over: given the packed scene, what draws the glass that probes see (`picture.glass_over`); None leaves it out.
        session: has what earlier pictures needed, and keeps what this one does.
    """
    proxies = "screen" in settings.tiers and settings.screen == "proxy"
    chosen = plan_picture(scene, camera, drawn="probe" in settings.tiers, proxies=proxies)
    # Where pixels are made from corners, most of them are seen four times, however many samples edges take.
    samples = min(max(1, settings.samples // 4) if settings.by_corners else settings.samples, PROBE_SAMPLES)
    if session is None:
        return _prepare(scene, camera, chosen, settings, is_rough(scene), samples, work, (0.1, 0.2), over)
    with session.held(work.cancel):
        return _from_parts(session, scene, camera, chosen, settings, samples, work, (0.1, 0.2), over)


def prepare_bare(scene: Scene, camera: Camera, settings: RenderSettings, work: Work) -> Ready:
    """A scene made ready to be drawn without any probes, caustics and indirect light."""
    bare = replace(settings, caustics=0, indirect="off")
    return _prepare(scene, camera, plan_capture(scene, []), bare, False, 1, work, (0.0, 0.0))


def _prepare(
    scene: Scene,
    camera: Camera,
    chosen: Plan,
    settings: RenderSettings,
    rough: bool,
    samples: int,
    work: Work,
    span: tuple[float, float],
    over: Callable[[World, Bvh], Over] | None = None,
) -> Ready:
    work.progress(0.0, "building")
    geometry, bvh, slots = pack_geometry(scene, chosen.captured_sets)
    images, sky = textures.pack(scene.textures), environment.pack(scene.environment)
    plain = _lit(scene, camera, settings, geometry, pack_materials(scene.materials, slots, settings.model), images, sky)
    _tell_caustics(work, settings, span)
    thrown = caustics_of(plain, scene, plan_caustics(plain, camera, settings), work)
    lit = with_caustics(plain, thrown)
    _tell_indirect(work, settings, span)
    world = by_address(lit._replace(bounced=indirect_of(lit, camera, settings, work)))
    entries = chosen.entries
    table = empty_table([e.probe for e in entries], [e.drawn for e in entries], camera, rough)
    work.progress(span[0], "probes")
    rays = fill_table(table, entries, world, _runner(work, span), samples, over and over(world, bvh))
    return Ready(world, bvh, table, chosen.thing_probe, rays, chosen.notices)


def _lit(
    scene: Scene,
    camera: Camera,
    settings: RenderSettings,
    geometry: Geometry,
    materials: MaterialTable,
    images: textures.TextureTable,
    sky: environment.EnvironmentTable,
) -> World:
    """The tables together, with what the stage's own surfaces emit among the lights, if any surface spreads light: what
    mirrors sees what glows itself."""
    eye = camera.world_from_camera[:3, 3]
    unlit = pack_lights(replace(scene, lights=(), camera_light=False), eye)
    glow = None
    if settings.emission_light and materials.spreads[geometry.material].any():
        glow = what_glows(world_of(geometry, materials, images, unlit, sky), scene, eye)
    return world_of(geometry, materials, images, pack_lights(scene, eye, glow), sky)


def _tell_caustics(work: Work, settings: RenderSettings, span: tuple[float, float]) -> None:
    if settings.caustics:
        work.progress(0.2 * span[0], "caustics")


def _tell_indirect(work: Work, settings: RenderSettings, span: tuple[float, float]) -> None:
    if settings.indirect != "off":
        work.progress(0.6 * span[0], "light between surfaces")


def _runner(work: Work, span: tuple[float, float]) -> Run:
    """How probes are drawn, and what share of the picture that is said to be."""
    return lambda function, items: work.run(
        function, items, lambda share: work.progress(span[0] + (span[1] - span[0]) * share, "probes")
    )


# --- with parts that are there ------------------------------------------------------------------------------------


class _Capture(NamedTuple):
    """The picture of one probe, in a table of its own."""

    table: ProbeTable
    rays: int


def _from_parts(
    session: Session,
    scene: Scene,
    camera: Camera,
    chosen: Plan,
    settings: RenderSettings,
    samples: int,
    work: Work,
    span: tuple[float, float],
    over: Callable[[World, Bvh], Over] | None,
) -> Ready:
    """As `_prepare`, part by part. The tables of materials and lights are made anew: they cost less than to compare."""
    work.progress(0.0, "building")
    hierarchy = session.part(
        "geometry", _geometry_source(scene, chosen), lambda: pack_geometry(scene, chosen.captured_sets)
    )
    images = session.part("textures", scene.textures, lambda: textures.pack(scene.textures))
    sky = session.part("environment", scene.environment, lambda: environment.pack(scene.environment))
    geometry, bvh, slots = hierarchy.made
    materials = pack_materials(scene.materials, slots, settings.model)
    plain = _lit(scene, camera, settings, geometry, materials, images.made, sky.made)
    _tell_caustics(work, settings, span)
    wanted_light = plan_caustics(plain, camera, settings)
    seen = hierarchy.number, images.number, sky.number, tuple(plain.lights), scene.materials, settings.model
    thrown = session.part("caustics", (*seen, wanted_light), lambda: caustics_of(plain, scene, wanted_light, work))
    lit = with_caustics(plain, thrown.made)
    _tell_indirect(work, settings, span)
    looked_at: Any = None
    if settings.indirect != "off":
        looked_at = *seen, thrown.number, camera, settings.image_width, settings.image_height, settings.indirect
    sent_on = session.part("indirect", looked_at, lambda: indirect_of(lit, camera, settings, work))
    world = by_address(lit._replace(bounced=sent_on.made))

    rough = is_rough(scene)
    drawn = [entry for entry in chosen.entries if entry.drawn]
    # Probes that do not see glass still see what has come through it.
    shown = *seen, thrown.number, sent_on.number, rough, samples
    # A probe that sees glass is drawn as a picture is, from the scene itself; how the work is cut up never changes it,
    # nor what is done to the picture afterwards.
    asked = replace(settings, jobs=0, tile_size=64, denoise=False, features=False, **NO_ORBIT, **NO_CROP)
    glassy = asked, scene.bounds, scene.metres_per_unit
    wanted: dict[Hashable, tuple[Any, Callable[[], _Capture]]] = {}
    for k, entry in enumerate(drawn):
        alone = empty_table([entry.probe], [True], camera, rough)
        by_eye = alone.eye if entry.probe.planar else None
        step = (span[1] - span[0]) / len(drawn)
        run = _runner(work, (span[0] + k * step, span[0] + (k + 1) * step))

        def capture(entry: Entry = entry, alone: ProbeTable = alone, run: Run = run) -> _Capture:
            return _Capture(alone, fill_table(alone, [entry], world, run, samples, over and over(world, bvh)))

        # Nobody promises that two probes have two paths.
        same_path = sum(before.probe.path == entry.probe.path for before in drawn[:k])
        source = entry, shown, glassy if entry.probe.sees_glass else None, by_eye
        wanted[entry.probe.path, same_path] = source, capture
    work.progress(span[0], "probes")
    captures = [part.made for part in session.parts("probes", wanted)]
    table = _joined(chosen.entries, captures, camera, rough)
    return Ready(world, bvh, table, chosen.thing_probe, sum(one.rays for one in captures), chosen.notices)


def _joined(entries: Sequence[Entry], captures: Sequence[_Capture], camera: Camera, rough: bool) -> ProbeTable:
    """One table of all probes, as `fill_table` would have filled it.

    Args:
        captures: of the entries that are drawn, in their order.
    """
    table = empty_table([e.probe for e in entries], [e.drawn for e in entries], camera, rough)
    left = iter(captures)
    for k, entry in enumerate(entries):
        if entry.drawn:
            _paste(table, k, next(left).table)
        else:
            table.weight[k] = 0.0
    return table


def _geometry_source(scene: Scene, chosen: Plan) -> Any:
    """All that `pack_geometry` reads."""
    kinds = tuple((material.refractive, material.cutout) for material in scene.materials)
    slots = primvar_slots(scene.materials)
    things = scene.meshes, scene.spheres, scene.instances, scene.balls
    return things, kinds, slots, tuple(chosen.captured_sets), tuple(caster_sets(scene))


def _paste(table: ProbeTable, k: int, alone: ProbeTable) -> None:
    """Put the picture of one probe into a table of many, which has the same levels for it."""
    first = int(table.first[k, 0])
    table.texels[first : first + len(alone.texels)] = alone.texels
    if (start := int(table.depths.first[k])) >= 0:
        size = len(alone.depths.inverse)
        table.depths.inverse[start : start + size] = alone.depths.inverse
        table.depths.torn[start : start + size] = alone.depths.torn
        table.depths.nearest[k] = alone.depths.nearest[0]


# --- for a file ---------------------------------------------------------------------------------------------------


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
    scene = settled(scene)
    with working(executor, jobs, progress, cancel) as work:
        chosen = plan_capture(scene, [replace(probe, cubemap=None) for probe in probes])
        ready = _prepare(scene, choose_camera(scene, ""), chosen, RenderSettings(), True, samples, work, (0.0, 1.0))
    return [cubemap_of(ready.probes, k) for k in range(len(probes))]


def is_rough(scene: Scene) -> bool:
    """Some refractive material may be rough, so the colour pyramid will be read above level 0."""
    for material in scene.materials:
        source = material.inputs[Param.ROUGHNESS]
        if material.refractive and (source.value[0] > 0.0 or source.driven):
            return True
    return False
