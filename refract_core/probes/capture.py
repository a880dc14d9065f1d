"""Drawing the pictures of probes: rays, borders, blurred levels; or the levels that a file brought along."""

from __future__ import annotations

import zlib
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.compile import inlined, kernel
from ..kernels.lanes import BLOCK_HEIGHT, BLOCK_WIDTH, LANES, Scalars, scratch
from ..kernels.pointer import Pointer
from ..kernels.sampling import Key, pixel_offset, set_key
from ..kernels.vec import along, length, normalize, row, scale, transform_direction, transform_point
from ..scene import Cubemap
from ..world.embree import COHERENT, Packet, clear, set_ray
from ..world.shading import Block, load_hits, shade
from ..world.tracing import intersect_world
from .faces import (
    CUBE,
    TEXEL,
    WINDOW,
    Levels,
    averages,
    face_direction,
    fill_cube_border,
    fill_window_border,
    filter_face,
    halve,
    lobe_samples,
    view_of_level,
)
from .lookup import ProbeTable
from .plan import Entry
from .planar import seen_from

_ROWS = 32  # rows of a face that one task draws; a multiple of 4
_BEFORE_WINDOW = 1e-4  # rays start this much before the window, so that what lies in its plane is seen [m]


class CaptureScratch(NamedTuple):
    """What one thread needs to draw a block of texels."""

    packet: Packet
    block: Block
    second: Block
    far: Scalars
    """T_FAR that each lane started with"""


@kernel
def capture_rows(world, table, scratch, k, face, y0, y1, volume, mask, near, far, background, jitter, seed):  # type: ignore[no-untyped-def]
    """Draw rows y0 .. y1 (y0 a multiple of 4, border not counted) of one face of probe `k`. Returns rays traced.

    Args:
        volume: shape (4, 4) world_from_volume of its influence.
        near, far: along the axis of a cube's face; a window has its plane for a near plane [m].
        background: shape (4,): radiance where nothing is met, and 1, or zeros for the sky.
        jitter: shape (S, 2): place of each sample within its texel, -0.5 .. 0.5.
        seed: of the sampling sequence.
    """
    packet, block, second, limit = scratch.packet, scratch.block, scratch.second, scratch.far
    packet.tally[0] = 0
    n = table.side[k, 0]
    planar = table.planar[k] != 0
    for by in range(y0, y1, BLOCK_HEIGHT):
        for bx in range(0, n, BLOCK_WIDTH):
            for sample in range(jitter.shape[0]):
                clear(packet)
                spread = 2.0 / n
                for lane in range(LANES):
                    x, y = bx + lane % BLOCK_WIDTH, by + lane // BLOCK_WIDTH
                    if x >= n or y >= y1:
                        continue
                    set_key(block.key, lane, Key(x + n * face, y, seed))
                    u = (x + 0.5 + jitter[sample, 0]) / n * 2.0 - 1.0
                    v = (y + 0.5 + jitter[sample, 1]) / n * 2.0 - 1.0
                    if planar:
                        spread = _add_window_ray(packet, table, lane, k, face, u, v, volume, far, mask)
                        limit[lane] = far
                        continue
                    d = face_direction(face, u, v)
                    stretch = length(d)
                    limit[lane] = far * stretch
                    centre = row(table.capture, k)
                    set_ray(packet, lane, centre, scale(d, 1.0 / stretch), near * stretch, limit[lane], mask)
                intersect_world(packet, world, limit, COHERENT)
                load_hits(block, packet, world, spread)
                shade(block, second, packet, world, sample, mask)
                _keep_texels(table, k, face, bx, by, y1, block, background, 1.0 / jitter.shape[0])
    return packet.tally[0]


@inlined
def _add_window_ray(packet, table, lane, k, face, u, v, volume, far, mask):  # type: ignore[no-untyped-def]
    """The ray through one place of a planar probe's window. Returns the spread of a texel's rays [rad]."""
    ex, ey = table.influence_extents[k, 0], table.influence_extents[k, 1]
    c = seen_from(table.eye[k], face)
    q = (u * ex, -v * ey, 0.0)
    towards = (q[0] - c[0], q[1] - c[1], -c[2]) if c[3] != 0.0 else (-c[0], -c[1], -c[2])
    d = normalize(transform_direction(volume, towards))
    start = along(transform_point(volume, q), d, -_BEFORE_WINDOW)
    set_ray(packet, lane, start, d, 0.0, far, mask)
    if c[3] == 0.0:
        return 0.0
    return 2.0 * max(ex, ey) / table.side[k, 0] / max(length(towards), 1e-6)


@inlined
def _keep_texels(table, k, face, bx, by, y1, block, background, share):  # type: ignore[no-untyped-def]
    n = table.side[k, 0]
    stride = n + 2
    for lane in range(LANES):
        x, y = bx + lane % BLOCK_WIDTH, by + lane // BLOCK_WIDTH
        if x >= n or y >= y1:
            continue
        i = table.first[k, 0] + ((face * stride + y + 1) * stride + x + 1) * TEXEL
        if block.on[lane] == 0:
            for c in range(4):
                table.texels[i + c] += background[c] * share
            continue
        for c in range(3):
            table.texels[i + c] += block.color[lane, c] * share
        table.texels[i + 3] += share
        table.texels[i + 4] += block.distance[lane] * share


def fill_table(table: ProbeTable, entries: list[Entry], world: Pointer, run: Any, samples: int) -> int:
    """Draw every picture that no file brought, and make the levels of all.

    Args:
        run: `run(function, items)` maps over tasks and returns their results in order.
        samples: rays per texel.

    Returns:
        Rays traced.
    """
    pointer = Pointer(table)
    jitter = np.array([pixel_offset(i) for i in range(samples)], np.float64)
    jitter -= jitter.mean(0)  # few samples lean to one side, and the whole picture would stand askew
    tasks: list[tuple[int, int, int]] = []
    for k, entry in enumerate(entries):
        if not entry.drawn:
            table.weight[k] = 0.0
        elif entry.probe.cubemap is not None:
            _copy_levels(table, k, entry.probe.cubemap)
        else:
            faces = WINDOW if entry.probe.planar else CUBE
            tasks += [(k, face, y) for face in range(faces) for y in range(0, int(table.side[k, 0]), _ROWS)]

    def draw(task: tuple[int, int, int]) -> int:
        k, face, y = task
        probe = entries[k].probe
        stop = min(y + _ROWS, int(table.side[k, 0]))
        near, far = probe.clipping
        volume = np.ascontiguousarray(probe.influence.world_from_volume, np.float64)
        background = np.array([*probe.background, 1.0] if probe.background else [0.0] * 4)
        # By name, not by number: a probe's picture is the same alone and among others.
        seed = 1 + zlib.crc32(probe.path.encode()) % 65521
        rays = capture_rows(
            world, pointer, scratch(CaptureScratch), k, face, y, stop, volume, entries[k].mask, near, far, background,
            jitter, seed,
        )  # fmt: skip
        return int(rays)

    rays = sum(run(draw, tasks))
    _fill_levels(table, [k for k, entry in enumerate(entries) if entry.drawn], entries, run)
    return rays


def _fill_levels(table: ProbeTable, drawn: list[int], entries: list[Entry], run: Any) -> None:
    """Borders everywhere, and the levels above 0 of those that need them."""

    def start(k: int) -> list[tuple[Any, ...]]:
        """Border of level 0; what is left to be done for the levels above."""
        if table.planar[k]:
            _average_window(table, k)
            return []
        fill_cube_border(table.texels, int(table.first[k, 0]), int(table.side[k, 0]))
        cubemap = entries[k].probe.cubemap
        if table.last[k] == 0 or (cubemap is not None and len(cubemap.levels) > 1):
            return []
        pool, levels = averages(table.texels, int(table.first[k, 0]), int(table.side[k, 0]))
        return [(k, level, face, pool, levels) for level in range(1, int(table.last[k]) + 1) for face in range(CUBE)]

    def blur(task: tuple[int, int, int, NDArray[np.float32], Levels]) -> None:
        k, level, face, pool, levels = task
        first, n = int(table.first[k, level]), int(table.side[k, level])
        lobe = lobe_samples(level, int(table.side[k, 0]))
        filter_face(pool, levels.first, levels.side, table.texels, first, n, face, lobe)

    def finish(k: int) -> None:
        for level in range(1, int(table.last[k]) + 1):
            fill_cube_border(table.texels, int(table.first[k, level]), int(table.side[k, level]))

    run(blur, [task for tasks in run(start, drawn) for task in tasks])
    run(finish, [k for k in drawn if not table.planar[k]])


def _average_window(table: ProbeTable, k: int) -> None:
    pool = table.texels
    for level in range(int(table.last[k]) + 1):
        first, n = int(table.first[k, level]), int(table.side[k, level])
        if level > 0:
            below, m = int(table.first[k, level - 1]), int(table.side[k, level - 1])
            halve(pool, below, m, pool, first, n, WINDOW)
        fill_window_border(pool, first, n)


def _copy_levels(table: ProbeTable, k: int, cubemap: Cubemap) -> None:
    levels = Levels(table.first[k], table.side[k])
    for level, faces in enumerate(cubemap.levels[: int(table.last[k]) + 1]):
        view_of_level(table.texels, levels, level, CUBE)[:, 1:-1, 1:-1] = faces


def cubemap_of(table: ProbeTable, k: int) -> Cubemap:
    """The picture of a cube probe, out of the table."""
    levels = Levels(table.first[k], table.side[k])
    count = int(table.last[k]) + 1
    return Cubemap(tuple(view_of_level(table.texels, levels, m, CUBE)[:, 1:-1, 1:-1].copy() for m in range(count)))
