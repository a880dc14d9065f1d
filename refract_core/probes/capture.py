"""Drawing the pictures of probes: rays, borders, blurred levels; or the levels that a file brought along."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.arrays import F64_1D, F64_2D
from ..kernels.compile import inlined, kernel
from ..kernels.lanes import BLOCK_HEIGHT, BLOCK_WIDTH, LANES, Scalars, by_address, scratch
from ..kernels.sampling import Key, pixel_offsets, set_key
from ..kernels.vec import along, length, normalize, row, scale, transform_direction, transform_point
from ..scene import Camera, Cubemap, Probe
from ..world.embree import COHERENT, Packet, clear, set_ray
from ..world.shading import Block, load_hits, shade
from ..world.tables import World
from ..world.tracing import intersect_world
from .depth import fill_depths
from .faces import (
    CUBE,
    TEXEL,
    WINDOW,
    Level,
    Levels,
    Picture,
    averages,
    face_direction,
    fill_cube_border,
    fill_window_border,
    filter_face,
    halve,
    level_of,
    lobe_samples,
    view_of_level,
)
from .lookup import ProbeTable
from .plan import Entry
from .planar import seen_from

_ROWS = 32  # rows of a face that one task draws; a multiple of 4
_PROBE_STRIDE = 4099  # rows of the sampling sequence from one probe to the next: a prime above 4096 texels
_BEFORE_WINDOW = 1e-4  # rays start this much before the window, so that what lies in its plane is seen [m]


Run = Callable[[Callable[[Any], Any], Sequence[Any]], list[Any]]
"""`run(function, items)` maps over items, side by side as it likes, and returns the results in their order."""


Over = Callable[[Probe, NDArray[np.float32]], int]
"""`over(probe, texels)` draws over a cube's picture, shape (6, n, n, TEXEL), what rays into the opaque scene do not
show, and returns rays traced."""


class CaptureScratch(NamedTuple):
    """What one thread needs to draw a block of texels. Nothing in it outlives a block."""

    packet: Packet
    block: Block
    second: Block
    far: Scalars
    """T_FAR that each lane started with"""


class Shot(NamedTuple):
    """How the picture of one probe is taken. Made once, it serves every task that draws a part of that picture."""

    probe: int
    """row of the table"""
    volume: F64_2D
    """shape (4, 4): world_from_volume of its influence, in whose frame a window lies"""
    mask: int
    """what it sees"""
    near: float
    """along the axis of a cube's face [m]; a window has its plane for a near plane"""
    far: float
    """the same [m]; along the ray behind a window"""
    background: F64_1D
    """shape (4,): radiance where nothing is met, and 1; or zeros, so that the sky is left to whoever looks up"""
    jitter: F64_2D
    """shape (S, 2): place of each sample within its texel, -0.5 .. 0.5"""
    seed: int
    """of the sampling sequence"""


@kernel
def capture_rows(
    world: World, table: ProbeTable, shot: Shot, scratch: CaptureScratch, face: int, y0: int, y1: int
) -> int:
    """Draw rows y0 .. y1 (y0 a multiple of 2, border not counted) of one face. Returns rays traced."""
    packet, block, second, limit = scratch.packet, scratch.block, scratch.second, scratch.far
    packet.tally[0] = 0
    k = shot.probe
    n = table.side[k, 0]
    planar = table.planar[k] != 0
    for by in range(y0, y1, BLOCK_HEIGHT):
        for bx in range(0, n, BLOCK_WIDTH):
            for sample in range(shot.jitter.shape[0]):
                clear(packet)
                spread = 2.0 / n  # radians between a face's texels in its middle, where they are farthest apart
                for lane in range(LANES):
                    x, y = bx + lane % BLOCK_WIDTH, by + lane // BLOCK_WIDTH
                    if x >= n or y >= y1:
                        continue
                    # Faces lie side by side, and every probe is a branch of its own: no two texels share a sequence.
                    set_key(block.key, lane, Key(x + n * face, y, shot.seed, sample))
                    u = (x + 0.5 + shot.jitter[sample, 0]) / n * 2.0 - 1.0
                    v = (y + 0.5 + shot.jitter[sample, 1]) / n * 2.0 - 1.0
                    if planar:
                        spread = _add_window_ray(packet, lane, table, shot, face, u, v)
                        limit[lane] = shot.far
                        continue
                    # Near and far are planes before the face: further along the ray the more it slants.
                    d = face_direction(face, u, v)
                    stretch = length(d)
                    limit[lane] = shot.far * stretch
                    centre = row(table.capture, k)
                    start = shot.near * stretch
                    set_ray(packet, lane, centre, scale(d, 1.0 / stretch), start, limit[lane], shot.mask)
                intersect_world(packet, world, limit, COHERENT)
                load_hits(block, packet, world, spread)
                shade(block, second, packet, world, shot.mask)
                _keep_texels(table, shot, face, block, bx, by, y1)
    return packet.tally[0]


@inlined
def _add_window_ray(
    packet: Packet, lane: int, table: ProbeTable, shot: Shot, face: int, u: float, v: float
) -> float:
    """The ray through one place of a planar probe's window. Returns the spread of a texel's rays [rad]."""
    k = shot.probe
    ex, ey = table.influence_extents[k, 0], table.influence_extents[k, 1]
    c = seen_from(table.eye[k], face)
    q = (u * ex, -v * ey, 0.0)
    # From a camera at a point rays spread; those of an orthographic one, whose c points back at it, are parallel.
    towards = (q[0] - c[0], q[1] - c[1], -c[2]) if c[3] != 0.0 else (-c[0], -c[1], -c[2])
    d = normalize(transform_direction(shot.volume, towards))
    start = along(transform_point(shot.volume, q), d, -_BEFORE_WINDOW)
    set_ray(packet, lane, start, d, 0.0, shot.far, shot.mask)
    if c[3] == 0.0:
        return 0.0
    return 2.0 * max(ex, ey) / table.side[k, 0] / max(length(towards), 1e-6)


@inlined
def _keep_texels(table: ProbeTable, shot: Shot, face: int, block: Block, x0: int, y0: int, y1: int) -> None:
    """Add one sample of a block of texels, whose first is (x0, y0), to level 0 of the picture."""
    k = shot.probe
    n = table.side[k, 0]
    stride = n + 2
    share = 1.0 / shot.jitter.shape[0]
    for lane in range(LANES):
        x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
        if x >= n or y >= y1:
            continue
        i = table.first[k, 0] + ((face * stride + y + 1) * stride + x + 1) * TEXEL
        if block.on[lane] == 0:
            # A background counts as covered, so that no sky is added to it; it is at no distance that could be trusted.
            for c in range(4):
                table.texels[i + c] += shot.background[c] * share
            continue
        for c in range(3):
            table.texels[i + c] += block.color[lane, c] * share
        table.texels[i + 3] += share
        table.texels[i + 4] += block.distance[lane] * share


def fill_table(
    table: ProbeTable, entries: list[Entry], world: World, run: Run, samples: int, over: Over | None = None
) -> int:
    """Draw every picture that no file brought, and make the levels of all.

    Args:
        world: by address.
        samples: rays per texel.
        over: what draws glass for the probes that see it; None leaves it out.

    Returns:
        Rays traced.
    """
    probes = by_address(table)
    jitter = np.array(pixel_offsets(samples), np.float64)
    tasks: list[tuple[Shot, int, int, int]] = []
    for k, entry in enumerate(entries):
        if not entry.drawn:
            table.weight[k] = 0.0
        elif entry.probe.cubemap is not None:
            _copy_levels(table, k, entry.probe.cubemap)
        else:
            shot, n = by_address(_shot_of(entry, k, jitter)), int(table.side[k, 0])
            faces = WINDOW if entry.probe.planar else CUBE
            tasks += [(shot, face, y, min(y + _ROWS, n)) for face in range(faces) for y in range(0, n, _ROWS)]

    def draw(task: tuple[Shot, int, int, int]) -> int:
        shot, face, y0, y1 = task
        return int(capture_rows(world, probes, shot, scratch(CaptureScratch), face, y0, y1))

    rays = sum(run(draw, tasks))
    for k, entry in enumerate(entries):
        if over and entry.drawn and entry.probe.sees_glass:
            levels = Levels(table.first[k], table.side[k])
            rays += over(entry.probe, view_of_level(table.texels, levels, 0, CUBE)[:, 1:-1, 1:-1])
    _fill_levels(table, [k for k, entry in enumerate(entries) if entry.drawn], entries, run)
    return rays


def _shot_of(entry: Entry, k: int, jitter: NDArray[np.float64]) -> Shot:
    probe = entry.probe
    near, far = probe.clipping
    return Shot(
        probe=k,
        volume=np.ascontiguousarray(probe.influence.world_from_volume, np.float64),
        mask=entry.mask,
        near=float(near),
        far=float(far),
        background=np.array([*probe.background, 1.0] if probe.background else [0.0] * 4),
        jitter=jitter,
        # By name, not by number: a probe's picture is the same alone and among others.
        seed=1 + zlib.crc32(probe.path.encode()) % 65521,
    )


def _level(table: ProbeTable, k: int, level: int) -> Level:
    """One level of a probe's picture, by address."""
    return by_address(level_of(table.texels, Levels(table.first[k], table.side[k]), level))


def _fill_levels(table: ProbeTable, drawn: list[int], entries: list[Entry], run: Run) -> None:
    """Borders everywhere, and the levels above 0 of those that need them."""

    def start(k: int) -> list[tuple[int, int, int, Picture]]:
        """Border of level 0; what is left to be done for the levels above."""
        if table.planar[k]:
            _average_window(table, k)
            return []
        fill_cube_border(_level(table, k, 0))
        if table.depths.first[k] >= 0:
            fill_depths(table.depths, k, view_of_level(table.texels, Levels(table.first[k], table.side[k]), 0, CUBE))
        cubemap = entries[k].probe.cubemap
        if table.last[k] == 0 or (cubemap is not None and len(cubemap.levels) > 1):
            return []
        source = by_address(averages(level_of(table.texels, Levels(table.first[k], table.side[k]), 0)))
        return [(k, level, face, source) for level in range(1, int(table.last[k]) + 1) for face in range(CUBE)]

    def blur(task: tuple[int, int, int, Picture]) -> None:
        k, level, face, source = task
        filter_face(source, _level(table, k, level), face, lobe_samples(level, int(table.side[k, 0])))

    def finish(k: int) -> None:
        for level in range(1, int(table.last[k]) + 1):
            fill_cube_border(_level(table, k, level))

    run(blur, [task for tasks in run(start, drawn) for task in tasks])
    run(finish, [k for k in drawn if not table.planar[k]])


def _average_window(table: ProbeTable, k: int) -> None:
    for level in range(int(table.last[k]) + 1):
        if level > 0:
            halve(_level(table, k, level - 1), _level(table, k, level), WINDOW)
        fill_window_border(_level(table, k, level))


def _copy_levels(table: ProbeTable, k: int, cubemap: Cubemap) -> None:
    levels = Levels(table.first[k], table.side[k])
    for level, faces in enumerate(cubemap.levels[: int(table.last[k]) + 1]):
        view_of_level(table.texels, levels, level, CUBE)[:, 1:-1, 1:-1] = faces


def cubemap_of(table: ProbeTable, k: int) -> Cubemap:
    """The picture of a cube probe, out of the table."""
    levels = Levels(table.first[k], table.side[k])
    count = int(table.last[k]) + 1
    return Cubemap(tuple(view_of_level(table.texels, levels, m, CUBE)[:, 1:-1, 1:-1].copy() for m in range(count)))


def face_camera(probe: Probe, face: int) -> Camera:
    """Looks through one face of a cube; `paste_face` knows that its picture lies the other way round."""
    # The faces of a cube are seen mirrored (`scene.Cubemap`), which no camera can be.
    ahead = np.array(face_direction(face, 0.0, 0.0))
    right, up = ahead - face_direction(face, 1.0, 0.0), face_direction(face, 0.0, -1.0) - ahead
    frame = np.eye(4)
    frame[:3, :3] = np.stack([right, up, -ahead], 1)
    frame[:3, 3] = probe.capture_point
    return Camera(probe.path, frame, (-1.0, 1.0, -1.0, 1.0), clipping=probe.clipping)


def paste_face(
    texels: NDArray[np.float32],
    where: NDArray[np.bool_],
    beauty: NDArray[np.float32],
    depth: NDArray[np.float32],
    background: tuple[float, float, float] | None,
) -> None:
    """Put parts of the picture that a face's camera took over that face.

    Args:
        texels: shape (n, n, TEXEL): written to.
        where: shape (n, n): the pixels that are taken.
        beauty: shape (n, n, 4): radiance and alpha.
        depth: shape (n, n): z_depth of what the texel shall be said to show [m]; inf for nothing.
        background: of the probe; None leaves open what is open.
    """
    n = len(texels)
    where, beauty, depth = where[:, ::-1], beauty[:, ::-1], depth[:, ::-1]
    cover = np.clip(beauty[..., 3:], 0.0, 1.0)
    centre = (np.arange(n) + 0.5) / n * 2.0 - 1.0
    far = np.where(np.isfinite(depth), depth, 0.0) * np.sqrt(1.0 + centre[:, None] ** 2 + centre**2)
    distance, colour = far[..., None] * cover, beauty[..., :3]
    if background is not None:
        colour, cover = colour + (1.0 - cover) * np.array(background), np.ones_like(cover)
    texels[where] = np.concatenate([colour, cover, distance], axis=-1)[where]
