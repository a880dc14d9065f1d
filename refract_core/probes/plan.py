"""Which probes serve a picture, decided before the BVH is built, because what they see is marked in it.

Only probes that the stage authors are drawn, in HDRP's order; those that cannot reach any glass are left out. None is
invented: a picture taken at the centre of a glass knows nothing of what stands around it where nothing does, or where
the centre lies inside a candle. Glass that no probe reaches has no probe tier; what it still needs under `--screen
proxy` is a volume to guess distances by, and gets one that shows nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..scene import Camera, Material, Notice, Param, Probe, Scene, Volume, prim_of
from ..world.embree import CASTER_SHIFTS, FIRST_CAPTURED_BIT, OPAQUE, OPAQUE_STATIC
from ..world.instances import boxes, numbered, thing_count
from ..world.tables import caster_sets
from .lookup import bounds_of, camera_weight

_MOST_PROXIES = 4096
"""Things that have a box to guess by for themselves."""


class Entry(NamedTuple):
    """One probe of the picture."""

    probe: Probe
    mask: int
    """what it sees"""
    drawn: bool
    """False: it lends its proxy to the screen tier and shows nothing"""


class Plan(NamedTuple):
    """What to capture."""

    entries: list[Entry]
    thing_probe: NDArray[np.int32]
    """shape (things,): the entry whose proxy serves a thing, -1 for none"""
    captured_sets: list[frozenset[str] | None]
    notices: tuple[Notice, ...] = ()


def in_order(probes: list[Probe]) -> list[Probe]:
    """Higher importance first, then smaller influence volume, then as given."""

    def volume(probe: Probe) -> float:
        low, high = bounds_of(probe)
        return float(np.prod(high - low))

    return sorted(probes, key=lambda probe: (-probe.importance, volume(probe)))


def plan_capture(scene: Scene, probes: list[Probe]) -> Plan:
    """A plan that draws these probes, whatever they serve."""
    sets: list[frozenset[str] | None] = []
    notices: list[Notice] = []
    entries = [Entry(probe, _mask_of(scene, probe, sets, notices), True) for probe in probes]
    return Plan(entries, np.full(thing_count(scene), -1, np.int32), sets, tuple(notices))


def plan_picture(scene: Scene, camera: Camera, *, drawn: bool, proxies: bool) -> Plan:
    """Choose the probes of a picture.

    Args:
        drawn: the probe tier is going to be asked.
        proxies: the screen tier is going to guess by proxies, of which every piece of glass needs one.
    """
    thing_probe = np.full(thing_count(scene), -1, np.int32)
    asked = proxies or (drawn and scene.probes)
    if not asked or not len((glass := _glass(scene)).thing):
        return Plan([], thing_probe, [])
    serving = [p for p in in_order(list(scene.probes)) if _serves(p, camera, glass)]
    plan = plan_capture(scene, serving)
    entries = [entry._replace(drawn=drawn) for entry in plan.entries]
    for k, entry in reversed(list(enumerate(entries))):
        thing_probe[glass.thing[contains(entry.probe.influence, (glass.low + glass.high) / 2)]] = k
    if proxies:
        _lend_proxies(scene, glass, thing_probe, entries)
    return plan._replace(entries=entries, thing_probe=thing_probe)


def _lend_proxies(scene: Scene, glass: _Glass, thing_probe: NDArray[np.int32], entries: list[Entry]) -> None:
    """A box to guess by for all glass that no probe serves. Things beyond `_MOST_PROXIES` share one around them all."""
    bare = np.flatnonzero(thing_probe[glass.thing] < 0)
    for rows in (*bare[:_MOST_PROXIES, None], bare[_MOST_PROXIES:]):
        if len(rows):
            thing_probe[glass.thing[rows]] = len(entries)
            box = (glass.low[rows].min(axis=0), glass.high[rows].max(axis=0)) if scene.probes else scene.bounds
            entries.append(Entry(_bare_proxy(box), 0, False))


def _serves(probe: Probe, camera: Camera, glass: _Glass) -> bool:
    """Some glass, widened by how far its rays may travel inside, lies within the probe's influence."""
    if camera_weight(probe, camera.world_from_camera[:3, 3]) <= 0.0:
        return False
    low, high = bounds_of(probe)
    margin = (np.linalg.norm(glass.high - glass.low, axis=1) + glass.thickness)[:, None]
    return bool(((glass.low - margin <= high) & (glass.high + margin >= low)).all(axis=1).any())


def _longest_thickness(scene: Scene, used: Iterable[int]) -> float:
    return max((_thickness_bound(scene.materials[int(m)]) for m in used), default=0.0)


def _thickness_bound(material: Material) -> float:
    source = material.inputs[Param.THICKNESS]
    if source.primvar:
        return math.inf
    return max(source.value[0], abs(source.scale[0]) + abs(source.bias[0]) if source.texture >= 0 else 0.0)


class _Glass(NamedTuple):
    """Every thing with a refractive material: K rows, by their numbers."""

    thing: NDArray[np.int64]
    low: NDArray[np.float64]
    """shape (K, 3): bounds of what of it is glass [m]"""
    high: NDArray[np.float64]
    thickness: NDArray[np.float64]
    """shape (K,): the most that it may have [m]"""


def _glass(scene: Scene) -> _Glass:
    refractive = np.array([m.refractive for m in scene.materials], bool)
    found: list[tuple[Any, Any, Any, Any]] = [(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))]

    def add(first: int, low: NDArray[np.float64], high: NDArray[np.float64], used: Iterable[int]) -> None:
        count = len(low)
        found.append((first + np.arange(count), low, high, np.full(count, _longest_thickness(scene, used))))

    for thing, mesh in enumerate(scene.meshes):
        keep = refractive[mesh.materials]
        if keep.any():
            points = mesh.points[mesh.triangles[keep].ravel()].astype(np.float64)
            add(thing, points.min(0)[None], points.max(0)[None], np.unique(mesh.materials))
    for thing, ball in enumerate(scene.spheres, len(scene.meshes)):
        if refractive[ball.material]:
            centre = np.array([ball.centre], np.float64)
            add(thing, centre - ball.radius, centre + ball.radius, [ball.material])
    instances, clouds = numbered(scene)
    for first, many in instances:
        keep = refractive[many.mesh.materials]
        if keep.any() and len(many):
            corners = np.unique(many.mesh.triangles[keep])
            low, high = boxes(many, many.mesh.points[corners].astype(np.float64))
            add(first, low, high, np.unique(many.mesh.materials))
    for first, balls in clouds:
        if refractive[balls.material]:
            centres, radii = balls.centres.astype(np.float64), balls.radii[:, None].astype(np.float64)
            add(first, centres - radii, centres + radii, [balls.material])
    return _Glass(*(np.concatenate(column) for column in zip(*found, strict=True)))


def seen_things(scene: Scene, probe: Probe) -> frozenset[str]:
    """Prim paths of what a probe's `captured` collection leaves it, glass included."""
    baked = probe.mode != "realtime"
    here = {prim_of(mesh.path) for mesh in scene.meshes if mesh.static or not baked}
    here |= {prim_of(ball.path) for ball in scene.spheres if ball.static or not baked}
    for many in scene.instances:
        if many.mesh.static or not baked:
            here.update(owner for owner, _ in many.paths.owners())
    for balls in scene.balls:
        if balls.static or not baked:
            here.update(owner for owner, _ in balls.paths.owners())
    return frozenset(here if probe.captured is None else here & set(probe.captured))


def _mask_of(scene: Scene, probe: Probe, sets: list[frozenset[str] | None], notices: list[Notice]) -> int:
    everything = int(OPAQUE_STATIC if probe.mode != "realtime" else OPAQUE)
    if probe.captured is None:
        return everything
    seen = seen_things(scene, probe)
    if seen not in sets:
        most = min([31, *CASTER_SHIFTS[: len(caster_sets(scene))]]) - FIRST_CAPTURED_BIT
        if len(sets) >= most:
            text = f"more than {most} different collections 'captured' in one stage; this probe sees everything"
            notices.append(Notice(probe.path, f"{text}. Let several probes share one collection, or bake them apart"))
            return everything
        sets.append(seen)
    return 1 << (FIRST_CAPTURED_BIT + sets.index(seen))


def contains(volume: Volume, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points, shape (K, 3), are inside the box or sphere."""
    m = np.linalg.inv(volume.world_from_volume)
    p = points @ m[:3, :3].T + m[:3, 3]
    if volume.sphere:
        return np.asarray(np.linalg.norm(p, axis=1) <= volume.extents[0])
    return np.asarray((np.abs(p) <= np.array(volume.extents)).all(axis=1))


def _bare_proxy(box: Any) -> Probe:
    """A box to guess distances by, from low to high corner [m]: HDRP's default proxy where no probe is near (its page
    'Create a refractive Material'). It is never drawn and never asked."""
    low, high = np.array(box[0], np.float64), np.array(box[1], np.float64)
    frame = np.eye(4)
    frame[:3, 3] = (low + high) / 2
    half = np.maximum((high - low) / 2, 1e-3) * 1.0005
    volume = Volume(frame, False, (float(half[0]), float(half[1]), float(half[2])))
    centre = (float(frame[0, 3]), float(frame[1, 3]), float(frame[2, 3]))
    return Probe("", "realtime", centre, influence=volume, proxy=volume, resolution=1)

