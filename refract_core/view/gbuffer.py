"""First hits of the camera's rays: the opaque layer with its lit colour, and refractive layers nearest first."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.compile import inlined, kernel
from ..kernels.lanes import BLOCK_HEIGHT, BLOCK_WIDTH, LANES, Scalars
from ..kernels.vec import dot
from ..scene import Model
from ..world.embree import (
    COHERENT,
    EVERYTHING,
    GEOM,
    HIT_U,
    HIT_V,
    OPAQUE,
    PRIM,
    REFRACTIVE,
    T_FAR,
    Packet,
    clear,
    keep_valid,
    set_ray,
)
from ..world.environment import radiance
from ..world.shading import Block, load_hits, shade
from ..world.surface import hit_at, material_of
from ..world.tracing import intersect_world
from .camera import pixel_ray

_MAX_SKIPS = 64


class ViewScratch(NamedTuple):
    """What one thread needs to look at a block of pixels."""

    packet: Packet
    block: Block
    second: Block
    far: Scalars
    """T_FAR that each lane started with"""


class OpaqueLayer(NamedTuple):
    """What the camera would see without refractive objects. One sample per pixel."""

    color: NDArray[np.float32]
    """shape (H, W, 3) radiance; the environment where nothing was hit"""
    depth: NDArray[np.float32]
    """shape (H, W) z_depth [m]; inf where nothing was hit"""
    normal: NDArray[np.float32]
    """shape (H, W, 3): geometric normal on the camera's side"""
    alpha: NDArray[np.float32]
    """shape (H, W): 1 on surfaces and on a visible environment, else 0"""


class RefractiveLayer(NamedTuple):
    """The n-th refractive surface that each view ray enters. `part` is -1 where there is none."""

    part: NDArray[np.int32]
    primitive: NDArray[np.int32]
    u: NDArray[np.float32]
    v: NDArray[np.float32]
    distance: NDArray[np.float32]
    """hit distance along the view ray [m]"""


def new_refractive_layer(width: int, height: int) -> RefractiveLayer:
    """A layer with nothing in it."""
    shape = (height, width)
    return RefractiveLayer(
        np.full(shape, -1, np.int32),
        np.zeros(shape, np.int32),
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
        np.zeros(shape, np.float32),
    )


@inlined
def _enters(world, packet, lane):  # type: ignore[no-untyped-def]
    """The ray in a lane meets a refractive surface from outside: any side of a sheet, the outer side of a solid."""
    part, primitive = packet.words[GEOM, lane], packet.words[PRIM, lane]
    m = material_of(world.geometry, part, primitive)
    if world.geometry.sheet[part] != 0 or world.materials.model[m] == Model.THIN.value:
        return True
    rays = packet.rays
    origin = (np.float64(rays[0, lane]), np.float64(rays[1, lane]), np.float64(rays[2, lane]))
    direction = (np.float64(rays[4, lane]), np.float64(rays[5, lane]), np.float64(rays[6, lane]))
    u, v = np.float64(rays[HIT_U, lane]), np.float64(rays[HIT_V, lane])
    hit = hit_at(world.geometry, part, primitive, u, v, origin, direction, np.float64(rays[T_FAR, lane]), 0.0)
    return dot(hit.ng, direction) < 0.0


@inlined
def _is_refractive(world, packet, lane):  # type: ignore[no-untyped-def]
    m = material_of(world.geometry, packet.words[GEOM, lane], packet.words[PRIM, lane])
    return world.materials.model[m] != Model.NONE.value


@inlined
def _note(layer, x, y, packet, lane):  # type: ignore[no-untyped-def]
    layer.part[y, x] = packet.words[GEOM, lane]
    layer.primitive[y, x] = packet.words[PRIM, lane]
    layer.u[y, x] = packet.rays[HIT_U, lane]
    layer.v[y, x] = packet.rays[HIT_V, lane]
    layer.distance[y, x] = packet.rays[T_FAR, lane]


@inlined
def add_view_ray(packet, view, lane, x, y, near, far, mask):  # type: ignore[no-untyped-def]
    """Put the view ray of a pixel into a lane, from distance `near` (or the near plane) to `far`; keeps no state."""
    origin, direction, cosine = pixel_ray(view, x + 0.5, y + 0.5)
    start = max(near, view.clipping[0] / cosine)
    stop = min(far, view.clipping[1] / cosine)
    set_ray(packet, lane, origin, direction, start, stop, mask)
    return stop


@kernel
def opaque_tile(world, view, scratch, tile, sample, layer, first):  # type: ignore[no-untyped-def]
    """Fill `layer` (OpaqueLayer) and `first` (RefractiveLayer 0) over a tile (x0, y0, x1, y1), in pixels.

    Returns:
        (rays traced, refractive pixels, refractive pixels whose first surface is not one that they enter).
    """
    packet, block, second, far = scratch.packet, scratch.block, scratch.second, scratch.far
    packet.tally[0] = 0
    width, height = view.size[0], view.size[1]
    spread = (view.window[1] - view.window[0]) / width * (0.0 if view.orthographic else 1.0)
    entered = left = 0
    for y0 in range(tile[1], tile[3], BLOCK_HEIGHT):
        for x0 in range(tile[0], tile[2], BLOCK_WIDTH):
            clear(packet)
            for lane in range(LANES):
                x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
                if x < width and y < height:
                    far[lane] = add_view_ray(packet, view, lane, x, y, 0.0, math.inf, EVERYTHING)
                    block.pixel[lane, 0], block.pixel[lane, 1] = x, y
            intersect_world(packet, world, far, COHERENT)
            behind = False
            for lane in range(LANES):
                x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
                if packet.valid[lane] == 0:
                    continue
                first.part[y, x] = -1
                if packet.words[GEOM, lane] >= 0 and _is_refractive(world, packet, lane):
                    behind = True
                    _note(first, x, y, packet, lane)
                    entered += 1
                    if not _enters(world, packet, lane):
                        first.part[y, x] = -2
                        left += 1
            if behind:
                _trace_behind_glass(packet, world, view, x0, y0, far, block, spread)
            else:
                load_hits(block, packet, world, spread)
            shade(block, second, packet, world, sample, OPAQUE)
            _write_opaque(layer, block, world, view, x0, y0)
    return packet.tally[0], entered, left


@inlined
def _trace_behind_glass(packet, world, view, x0, y0, far, block, spread):  # type: ignore[no-untyped-def]
    """Trace again, glass left out, the lanes that met glass first; the others keep the hits they have."""
    keep_valid(packet, 2)
    kept = packet.kept[2]
    for lane in range(LANES):
        packet.valid[lane] = 0
        if kept[lane] != 0 and packet.words[GEOM, lane] >= 0 and _is_refractive(world, packet, lane):
            x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
            far[lane] = add_view_ray(packet, view, lane, x, y, 0.0, math.inf, OPAQUE)
    intersect_world(packet, world, far, COHERENT)
    for lane in range(LANES):
        packet.valid[lane] = kept[lane]
    load_hits(block, packet, world, spread)


@inlined
def _write_opaque(layer, block, world, view, x0, y0):  # type: ignore[no-untyped-def]
    for lane in range(LANES):
        x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
        if x >= view.size[0] or y >= view.size[1]:
            continue
        _, direction, cosine = pixel_ray(view, x + 0.5, y + 0.5)
        if block.on[lane] != 0:
            for c in range(3):
                layer.color[y, x, c] = block.color[lane, c]
                layer.normal[y, x, c] = block.ng[lane, c]
            layer.depth[y, x] = block.distance[lane] * cosine
            layer.alpha[y, x] = 1.0
            continue
        layer.depth[y, x] = math.inf
        sky = radiance(world.environment, direction, 0.0) if world.environment.present else (0.0, 0.0, 0.0)
        for c in range(3):
            layer.color[y, x, c] = sky[c]
            layer.normal[y, x, c] = 0.0
        layer.alpha[y, x] = 1.0 if world.environment.present else 0.0


@kernel
def peel_tile(world, view, scratch, tile, depth, previous, layer, inside):  # type: ignore[no-untyped-def]
    """Fill `layer` with the next refractive surface entered behind `previous` and before the opaque `depth`.

    `previous.part` of -2 means that the ray starts inside: it must leave before it can enter.
    `inside`: go on in those pixels only and leave the others as they are; `layer` is then `previous` itself.
    Returns (rays traced, pixels found).
    """
    packet, far = scratch.packet, scratch.far
    packet.tally[0] = 0
    entered = 0
    for y0 in range(tile[1], tile[3], BLOCK_HEIGHT):
        for x0 in range(tile[0], tile[2], BLOCK_WIDTH):
            clear(packet)
            for lane in range(LANES):
                x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
                if x >= view.size[0] or y >= view.size[1]:
                    continue
                if inside and previous.part[y, x] != -2:
                    continue
                if previous.part[y, x] != -1:
                    start = previous.distance[y, x] * (1.0 + 1e-5) + 1e-6
                    _, _, cosine = pixel_ray(view, x + 0.5, y + 0.5)
                    far[lane] = add_view_ray(packet, view, lane, x, y, start, depth[y, x] / cosine, REFRACTIVE)
                layer.part[y, x] = -1
            entered += _peel_block(world, packet, far, layer, x0, y0)
    return packet.tally[0], entered


@inlined
def _peel_block(world, packet, far, layer, x0, y0):  # type: ignore[no-untyped-def]
    entered = 0
    for _ in range(_MAX_SKIPS):
        intersect_world(packet, world, far, COHERENT)
        again = False
        for lane in range(LANES):
            if packet.valid[lane] == 0:
                continue
            packet.valid[lane] = 0
            if packet.words[GEOM, lane] < 0:
                continue
            if _enters(world, packet, lane):
                _note(layer, x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH, packet, lane)
                entered += 1
                continue
            packet.rays[3, lane] = packet.rays[T_FAR, lane] * (1.0 + 1e-5) + 1e-6
            packet.rays[T_FAR, lane] = far[lane]
            packet.words[GEOM, lane] = -1
            packet.valid[lane] = -1
            again = True
        if not again:
            break
    return entered


@inlined
def view_point(view, layer, world, x, y):  # type: ignore[no-untyped-def]
    """(hit, direction, z_depth) of a refractive layer at a pixel."""
    origin, direction, cosine = pixel_ray(view, x + 0.5, y + 0.5)
    t = np.float64(layer.distance[y, x])
    spread = 0.0 if view.orthographic else (view.window[1] - view.window[0]) / view.size[0]
    hit = hit_at(
        world.geometry, layer.part[y, x], layer.primitive[y, x], np.float64(layer.u[y, x]), np.float64(layer.v[y, x]),
        origin, direction, t, spread,
    )  # fmt: skip
    return hit, direction, t * cosine


