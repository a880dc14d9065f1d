"""First hits of the camera's rays: the opaque layer with its lit colour, and refractive layers nearest first."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..kernels.arrays import F32_2D, F32_3D, I32_2D, U8_2D
from ..kernels.compile import inlined, kernel
from ..kernels.lanes import BLOCK_HEIGHT, BLOCK_WIDTH, LANES, Flags, Scalars
from ..kernels.sampling import Key, set_key
from ..kernels.vec import Vec, dot
from ..optics.models import is_sheet
from ..scene import Model
from ..world.embree import (
    COHERENT,
    EVERYTHING,
    OPAQUE,
    REFRACTIVE,
    Packet,
    clear,
    has_hit,
    hit_distance,
    restart,
    set_ray,
)
from ..world.environment import radiance
from ..world.offsets import past
from ..world.shading import Block, load_hits, shade
from ..world.surface import NOTHING, Hit, Interaction, Ray, hit_in, interaction
from ..world.tables import World
from ..world.tracing import intersect_world, ray_of
from .camera import Tile, View, pixel_ray

_MAX_SKIPS = 64
"""Inner sides of glass that a view ray may pass before it enters one."""

class ViewScratch(NamedTuple):
    """What one thread needs to look at a block of pixels."""

    packet: Packet
    block: Block
    second: Block
    far: Scalars
    """T_FAR that each lane started with"""
    asked: Flags
    """lanes of the block that are in the picture, while those behind glass are traced again"""


class OpaqueLayer(NamedTuple):
    """What the camera would see without refractive objects. One sample per pixel."""

    color: F32_3D
    """shape (H, W, 4): radiance, premultiplied by coverage, and coverage. Surfaces cover, and so does a visible
    environment where nothing was hit; else the picture is open there"""
    depth: F32_2D
    """shape (H, W) z_depth [m]; inf where nothing was hit"""
    normal: F32_3D
    """shape (H, W, 3): geometric normal on the camera's side"""


class RefractiveLayer(NamedTuple):
    """The n-th refractive surface that each view ray enters, as a `surface.Hit`. All planes have shape (H, W)."""

    part: I32_2D
    """`NOTHING` where there is none"""
    primitive: I32_2D
    instance: I32_2D
    material: I32_2D
    u: F32_2D
    v: F32_2D
    t: F32_2D
    """hit distance along the view ray [m]"""
    inside: U8_2D
    """1 where the hit is not one that the ray enters by: it starts in glass, or looks at an inner side"""


def new_refractive_layer(width: int, height: int) -> RefractiveLayer:
    """A layer with nothing in it."""
    part, primitive, instance, material = (np.full((height, width), NOTHING, np.int32) for _ in range(4))
    u, v, t = (np.zeros((height, width), np.float32) for _ in range(3))
    return RefractiveLayer(part, primitive, instance, material, u, v, t, np.zeros((height, width), np.uint8))


@inlined
def _enters(world: World, hit: Hit, ray: Ray) -> bool:
    """The ray meets a refractive surface from outside: any side of a sheet, the outer side of a solid."""
    if world.geometry.sheet[hit.part] != 0 or is_sheet(world.materials.model[hit.material]):
        return True
    return dot(interaction(world.geometry, hit, ray, 0.0).ng, ray.direction) < 0.0


@inlined
def _is_refractive(world: World, hit: Hit) -> bool:
    return world.materials.model[hit.material] != Model.NONE.value


@inlined
def _note(layer: RefractiveLayer, x: int, y: int, hit: Hit, inside: bool) -> None:
    layer.part[y, x] = hit.part
    layer.primitive[y, x] = hit.primitive
    layer.instance[y, x] = hit.instance
    layer.material[y, x] = hit.material
    layer.u[y, x] = hit.u
    layer.v[y, x] = hit.v
    layer.t[y, x] = hit.t
    layer.inside[y, x] = 1 if inside else 0


@inlined
def add_view_ray(
    packet: Packet, view: View, lane: int, x: int, y: int, near: float, far: float, mask: int
) -> float:
    """Put the view ray of a pixel into a lane, from distance `near` (or the near plane) to `far` [m].

    Returns:
        Where it ends: `far`, or the far plane [m].
    """
    origin, direction, cosine = pixel_ray(view, x + 0.5, y + 0.5)
    start = max(near, view.clipping[0] / cosine)
    stop = min(far, view.clipping[1] / cosine)
    set_ray(packet, lane, origin, direction, start, stop, mask)
    return stop


@inlined
def pixel_spread(view: View) -> float:
    """Growth of a pixel's cone per metre along its ray; its width at the eye is left out."""
    return 0.0 if view.orthographic else (view.window[1] - view.window[0]) / view.size[0]


@kernel
def opaque_tile(
    world: World,
    view: View,
    scratch: ViewScratch,
    tile: Tile,
    sample: int,
    layer: OpaqueLayer,
    first: RefractiveLayer,
) -> tuple[int, int, int]:
    """Fill `layer` and `first`, the nearest refractive layer, over a tile.

    Returns:
        (rays traced, refractive pixels, refractive pixels whose first surface is not one that they enter).
    """
    packet, block, far = scratch.packet, scratch.block, scratch.far
    packet.tally[0] = 0
    width, height = view.size[0], view.size[1]
    entered = left = 0
    for y0 in range(tile[1], tile[3], BLOCK_HEIGHT):
        for x0 in range(tile[0], tile[2], BLOCK_WIDTH):
            clear(packet)
            for lane in range(LANES):
                x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
                if x < width and y < height:
                    far[lane] = add_view_ray(packet, view, lane, x, y, 0.0, math.inf, EVERYTHING)
                    set_key(block.key, lane, Key(x, y, 0))
            intersect_world(packet, world, far, COHERENT)
            behind = False
            for lane in range(LANES):
                x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
                if packet.valid[lane] == 0:
                    continue
                first.part[y, x] = NOTHING
                first.inside[y, x] = 0
                if not has_hit(packet, lane):
                    continue
                hit = hit_in(packet, lane, world.geometry)
                if _is_refractive(world, hit):
                    behind = True
                    entered += 1
                    inside = not _enters(world, hit, ray_of(packet, lane))
                    left += 1 if inside else 0
                    _note(first, x, y, hit, inside)
            if behind:
                _trace_behind_glass(scratch, world, view, x0, y0)
            load_hits(block, packet, world, pixel_spread(view))
            shade(block, scratch.second, packet, world, sample, OPAQUE)
            _write_opaque(layer, block, world, view, x0, y0)
    return packet.tally[0], entered, left


@inlined
def _trace_behind_glass(scratch: ViewScratch, world: World, view: View, x0: int, y0: int) -> None:
    """Trace again, glass left out, the lanes that met glass first; the others keep the hits they have."""
    packet = scratch.packet
    for lane in range(LANES):
        scratch.asked[lane] = packet.valid[lane]
        again = has_hit(packet, lane) and _is_refractive(world, hit_in(packet, lane, world.geometry))
        packet.valid[lane] = 0
        if again:
            x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
            scratch.far[lane] = add_view_ray(packet, view, lane, x, y, 0.0, math.inf, OPAQUE)
    intersect_world(packet, world, scratch.far, COHERENT)
    for lane in range(LANES):
        packet.valid[lane] = scratch.asked[lane]


@inlined
def _write_opaque(layer: OpaqueLayer, block: Block, world: World, view: View, x0: int, y0: int) -> None:
    """Put the colours of a block into the picture; the sky where nothing was hit."""
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
            layer.color[y, x, 3] = 1.0
            continue
        layer.depth[y, x] = math.inf
        sky = radiance(world.environment, direction, 0.0) if world.environment.present else (0.0, 0.0, 0.0)
        for c in range(3):
            layer.color[y, x, c] = sky[c]
            layer.normal[y, x, c] = 0.0
        layer.color[y, x, 3] = 1.0 if world.environment.present else 0.0


@kernel
def peel_tile(
    world: World,
    view: View,
    scratch: ViewScratch,
    tile: Tile,
    depth: F32_2D,
    previous: RefractiveLayer,
    layer: RefractiveLayer,
    inside: bool,
) -> tuple[int, int]:
    """Fill `layer` with the next refractive surface entered behind `previous` and before the opaque `depth`.

    `inside`: go on only where `previous` is an inner side, and leave the other pixels as they are; `layer` is then
    `previous` itself. Returns (rays traced, pixels found).
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
                if inside and previous.inside[y, x] == 0:
                    continue
                if previous.part[y, x] != NOTHING:
                    start = past(previous.t[y, x])
                    _, _, cosine = pixel_ray(view, x + 0.5, y + 0.5)
                    far[lane] = add_view_ray(packet, view, lane, x, y, start, depth[y, x] / cosine, REFRACTIVE)
                layer.part[y, x] = NOTHING
                layer.inside[y, x] = 0
            entered += _peel_block(world, packet, far, layer, x0, y0)
    return packet.tally[0], entered


@inlined
def _peel_block(world: World, packet: Packet, far: Scalars, layer: RefractiveLayer, x0: int, y0: int) -> int:
    """Send the rays in the packet on until each enters glass or meets none. Returns how many entered."""
    entered = 0
    for _ in range(_MAX_SKIPS):
        intersect_world(packet, world, far, COHERENT)
        again = False
        for lane in range(LANES):
            met = has_hit(packet, lane)
            packet.valid[lane] = 0
            if not met:
                continue
            hit = hit_in(packet, lane, world.geometry)
            if _enters(world, hit, ray_of(packet, lane)):
                _note(layer, x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH, hit, False)
                entered += 1
                continue
            restart(packet, lane, past(hit_distance(packet, lane)), far[lane])
            again = True
        if not again:
            break
    return entered


@inlined
def view_point(view: View, layer: RefractiveLayer, world: World, x: int, y: int) -> tuple[Interaction, Vec, float]:
    """(interaction, direction of the view ray, z_depth [m]) of a refractive layer at a pixel."""
    origin, direction, cosine = pixel_ray(view, x + 0.5, y + 0.5)
    hit = Hit(
        layer.part[y, x], layer.primitive[y, x], layer.instance[y, x], layer.material[y, x],
        np.float64(layer.u[y, x]), np.float64(layer.v[y, x]), np.float64(layer.t[y, x]),
    )  # fmt: skip
    return interaction(world.geometry, hit, Ray(origin, direction), pixel_spread(view)), direction, hit.t * cosine
