"""Which probes serve a picture, and drawing the ones that have no texture.

A stage's own probes come in HDRP's order. Where the stage has none, glass gets its own: captured at its centre, with
the scene's bounds as proxy (Arm's preparation steps: stand in the object, hide it, draw six faces).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .embree import FIRST_CAPTURED_BIT, OPAQUE, OPAQUE_STATIC
from .pointer import Pointer
from .probes import TEXEL, ProbeTable, capture_rows, empty_table, face_direction, fill_levels, in_order
from .scene import Camera, Probe, Scene, Texture, Volume
from .scratch import scratch
from .srgb import srgb_decode
from .tables import prim_of

_MAX_OWN = 8
"""Glass beyond this many things shares capture points with its neighbours."""
_MAX_SETS = 31 - FIRST_CAPTURED_BIT
_EVERYWHERE = 1e9  # half size of an influence without limits [m]
_ROWS = 32  # rows of a face that one task draws; a multiple of 4


class Entry(NamedTuple):
    """One probe of the picture."""

    probe: Probe
    owned: bool
    """it serves only the things that `Plan.thing_probe` gives it"""
    mask: int
    """what it sees"""
    drawn: bool
    """False: it lends its proxy to the screen tier and shows nothing"""


class Plan(NamedTuple):
    """What to capture, decided before the BVH is built, because masks depend on it."""

    entries: list[Entry]
    thing_probe: NDArray[np.int32]
    """shape (things,): the entry whose proxy serves a thing, -1 for opaque things"""
    captured_sets: list[frozenset[str] | None]


def plan(scene: Scene, height: int, wanted: bool) -> Plan:
    """Choose the probes. `height`: of the picture [pixels], to which the resolution of own probes is fitted."""
    glass = _glass(scene)
    count = len(scene.meshes) + len(scene.spheres)
    thing_probe = np.full(count, -1, np.int32)
    if not wanted or not glass:
        return Plan([], thing_probe, [])
    entries: list[Entry] = []
    sets: list[frozenset[str] | None] = []
    for probe in in_order(list(scene.probes)):
        entries.append(Entry(probe, False, _mask_of(scene, probe, sets), True))
    for k, entry in reversed(list(enumerate(entries))):
        for thing, (low, high) in glass.items():
            if contains(entry.probe.influence, (low + high) / 2):
                thing_probe[thing] = k
    alone = {thing: box for thing, box in glass.items() if thing_probe[thing] < 0}
    _add_own(entries, alone, thing_probe, scene, height, drawn=not scene.probes)
    return Plan(entries, thing_probe, sets)


def _glass(scene: Scene) -> dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Bounds of every thing with a refractive material, by its number."""
    refractive = np.array([m.refractive for m in scene.materials], bool)
    found = {}
    for thing, mesh in enumerate(scene.meshes):
        keep = refractive[mesh.materials]
        if keep.any():
            points = mesh.points[mesh.triangles[keep].ravel()].astype(np.float64)
            found[thing] = (points.min(0), points.max(0))
    for i, ball in enumerate(scene.spheres):
        if refractive[ball.material]:
            centre = np.array(ball.centre, np.float64)
            found[len(scene.meshes) + i] = (centre - ball.radius, centre + ball.radius)
    return found


def _mask_of(scene: Scene, probe: Probe, sets: list[frozenset[str] | None]) -> int:
    baked = probe.mode != "realtime"
    if probe.captured is None or len(sets) >= _MAX_SETS:
        return int(OPAQUE_STATIC if baked else OPAQUE)
    wanted = set(probe.captured)
    things = [(m.path, m.static) for m in scene.meshes] + [(s.path, s.static) for s in scene.spheres]
    seen = frozenset(prim_of(path) for path, static in things if prim_of(path) in wanted and (static or not baked))
    if seen not in sets:
        sets.append(seen)
    return 1 << (FIRST_CAPTURED_BIT + sets.index(seen))


def contains(volume: Volume, point: NDArray[np.float64]) -> bool:
    """The point is inside the box or sphere."""
    m = np.linalg.inv(volume.world_from_volume)
    p = m[:3, :3] @ point + m[:3, 3]
    if volume.sphere:
        return bool(np.linalg.norm(p) <= volume.extents[0])
    return bool((np.abs(p) <= np.array(volume.extents)).all())


def _add_own(
    entries: list[Entry], alone: dict[int, Any], thing_probe: NDArray[np.int32], scene: Scene, height: int, drawn: bool
) -> None:
    """Give every thing in `alone` a probe at its centre; many things share the nearest of a few, spread widely."""
    if not alone:
        return
    things = sorted(alone, key=lambda thing: -float(np.prod(alone[thing][1] - alone[thing][0] + 1e-9)))
    centres = np.array([(alone[thing][0] + alone[thing][1]) / 2 for thing in things])
    chosen = [0]
    while len(chosen) < min(_MAX_OWN, len(things)):
        away = np.min(np.linalg.norm(centres[:, None] - centres[chosen][None], axis=2), axis=1)
        chosen.append(int(np.argmax(away)))
    nearest = np.argmin(np.linalg.norm(centres[:, None] - centres[chosen][None], axis=2), axis=1)
    base = len(entries)
    for i in chosen:
        proxy = scene.bounds if drawn else tuple(tuple(side) for side in alone[things[i]])
        entries.append(Entry(_own_probe(centres[i], proxy, height), True, int(OPAQUE), drawn))
    for thing, group in zip(things, nearest, strict=True):
        thing_probe[thing] = base + group


def _own_probe(centre: NDArray[np.float64], proxy: Any, height: int) -> Probe:
    low, high = np.array(proxy[0], np.float64), np.array(proxy[1], np.float64)
    frame = np.eye(4)
    frame[:3, 3] = (low + high) / 2
    half = np.maximum((high - low) / 2, 1e-3) * 1.0005
    here = np.eye(4)
    here[:3, 3] = centre
    return Probe(
        path="",
        mode="realtime",
        capture_point=(float(centre[0]), float(centre[1]), float(centre[2])),
        influence=Volume(here, False, (_EVERYWHERE,) * 3),
        proxy=Volume(frame, False, (float(half[0]), float(half[1]), float(half[2]))),
        resolution=1 << min(9, max(5, round(math.log2(max(height, 1) / 5)))),
        clipping=(1e-4, 1e9),
    )


def capture(plan: Plan, world: Pointer, camera: Camera, run: Any, samples: int) -> tuple[ProbeTable, int]:
    """Fill the table: textures are resampled, the rest is drawn on all cores.

    Args:
        run: `run(function, items)` maps over tasks and returns their results in order.
        samples: rays per texel.

    Returns:
        The table and the number of rays traced.
    """
    table = empty_table([(e.probe, e.owned) for e in plan.entries], camera.world_from_camera[:3, 3])
    pointer = Pointer(table)
    tasks = []
    for k, entry in enumerate(plan.entries):
        if not entry.drawn:
            table.weight[k] = 0.0
        elif entry.probe.texture is not None:
            _resample(table, k, entry.probe.texture)
        else:
            rows = range(0, entry.probe.resolution + 2, _ROWS)
            tasks += [(k, face, y) for face in range(6) for y in rows]

    def draw(task: tuple[int, int, int]) -> int:
        k, face, y = task
        entry = plan.entries[k]
        stop = min(y + _ROWS, entry.probe.resolution + 2)
        near, far = entry.probe.clipping
        return int(capture_rows(world, pointer, scratch(), k, face, y, stop, entry.mask, near, far, samples))

    rays = sum(run(draw, tasks))
    run(lambda k: fill_levels(pointer, k), [k for k, entry in enumerate(plan.entries) if entry.drawn])
    return table, rays


def _resample(table: ProbeTable, k: int, texture: Texture) -> None:
    """A latlong or a strip of six faces into the probe's texels. World axes, as HDRP: the capture is not rotated."""
    pixels = texture.pixels.astype(np.float32)
    if texture.pixels.dtype == np.uint8:
        pixels = pixels / 255.0
        if texture.srgb:
            pixels[..., :3] = srgb_decode(pixels[..., :3])
    h, w = pixels.shape[:2]
    res = int(table.resolution[k])
    stride = res + 2
    out = table.texels[table.first[k, 0] : table.first[k, 0] + 6 * stride * stride * TEXEL]
    faces = out.reshape(6, stride, stride, TEXEL)
    for face in range(6):
        for j in range(stride):
            x = (np.arange(stride) - 0.5) / res * 2 - 1
            y = (j - 0.5) / res * 2 - 1
            d = np.array([face_direction(face, xi, y) for xi in x])
            d /= np.linalg.norm(d, axis=1, keepdims=True)
            u = (0.5 - np.arctan2(d[:, 0], d[:, 2]) / (2 * np.pi)) % 1.0
            v = np.arccos(np.clip(d[:, 1], -1, 1)) / np.pi
            faces[face, j, :, :3] = pixels[np.minimum((v * h).astype(int), h - 1), (u * w).astype(int) % w, :3]
    faces[..., 3] = 1.0
    faces[..., 4] = np.linalg.norm(table.proxy_extents[k])
