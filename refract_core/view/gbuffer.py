"""What the camera sees without glass, lit, and where glass stands before it."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ..kernels.arrays import F32_2D, F32_3D, I32_2D, U8_2D
from ..kernels.compile import inlined, kernel
from ..kernels.lanes import BLOCK_HEIGHT, BLOCK_WIDTH, LANES, Flags, Scalars
from ..kernels.sampling import Key, set_key
from ..scene import Model
from ..world.embree import (
    COHERENT,
    EVERYTHING,
    OPAQUE,
    Packet,
    clear,
    has_hit,
    set_ray,
)
from ..world.environment import background
from ..world.shading import Block, load_hits, shade
from ..world.surface import Hit, hit_in
from ..world.tables import World
from ..world.tracing import belongs_to, intersect_world
from .camera import Tile, View, pixel_ray


class ViewScratch(NamedTuple):
    """What one thread needs to look at a block of pixels."""

    packet: Packet
    block: Block
    second: Block
    far: Scalars
    """T_FAR that each lane started with"""
    asked: Flags
    """lanes of the block that are in the picture, while those behind glass are traced again"""


class PictureHits(NamedTuple):
    """What each pixel shows, as `surface.Hit`: shape (H, W) each, or (0, 0) where nobody asks. Its distance is in the
    picture's depth."""

    part: I32_2D
    primitive: I32_2D
    instance: I32_2D
    material: I32_2D
    chance: I32_2D
    """1 where it is there by chance, or something else is not"""
    u: F32_2D
    v: F32_2D
    emissive: F32_3D
    """shape (H, W, 3): radiance; this and the next filtered over the pixel's cone"""
    albedo: F32_3D
    """shape (H, W, 3)"""


def new_hits(width: int, height: int) -> PictureHits:
    """Room for the hits of a picture."""
    words, numbers = np.zeros((5, height, width), np.int32), np.zeros((2, height, width), np.float32)
    colors = np.zeros((2, height, width, 3), np.float32)
    return PictureHits(*words, *numbers, *colors)


class OpaqueLayer(NamedTuple):
    """What the camera would see without refractive objects. One sample per pixel."""

    color: F32_3D
    """shape (H, W, 4): radiance, premultiplied by coverage, and coverage. Surfaces cover, and so does a visible
    environment where nothing was hit; else the picture is open there"""
    depth: F32_2D
    """shape (H, W) z_depth [m]; inf where nothing was hit"""
    normal: F32_3D
    """shape (H, W, 3): geometric normal on the camera's side"""
    irradiance: F32_3D
    """shape (H, W, 3): diffuse light that arrives there"""
    gloss: F32_3D
    """shape (H, W, 3): radiance that is neither emitted nor diffuse: highlights and what is mirrored"""
    seen: F32_3D
    """shape (H, W, 4): share of the lamps' light, and of the sky's by colour, that arrives, 0 .. 1; (0, 0, 4) where
    nobody asks"""
    glass: U8_2D
    """shape (H, W): 1 where the camera's ray meets glass first"""
    hits: PictureHits


@inlined
def is_refractive(world: World, hit: Hit) -> bool:
    """The hit is on glass."""
    return world.materials.model[hit.material] != Model.NONE.value


@inlined
def add_view_ray(packet: Packet, view: View, lane: int, px: float, py: float, mask: int) -> float:
    """Put the view ray through a pixel coordinate into a lane. Returns where it ends, the far plane [m]."""
    origin, direction, cosine = pixel_ray(view, px, py)
    stop = view.clipping[1] / cosine
    set_ray(packet, lane, origin, direction, view.clipping[0] / cosine, stop, mask)
    return stop


@kernel
def opaque_tile(
    world: World,
    view: View,
    scratch: ViewScratch,
    tile: Tile,
    sample: int,
    layer: OpaqueLayer,
) -> tuple[int, int]:
    """Fill `layer` over a tile. Returns (rays traced, pixels with glass before them)."""
    packet, block, far = scratch.packet, scratch.block, scratch.far
    packet.tally[0] = 0
    width, height = view.size[0], view.size[1]
    glass = 0
    for y0 in range(tile[1], tile[3], BLOCK_HEIGHT):
        for x0 in range(tile[0], tile[2], BLOCK_WIDTH):
            clear(packet)
            for lane in range(LANES):
                x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
                if x < width and y < height:
                    far[lane] = add_view_ray(packet, view, lane, x + 0.5, y + 0.5, EVERYTHING)
                    belongs_to(packet, lane, x, y, sample)
                    set_key(block.key, lane, Key(x, y, 0, sample))
            intersect_world(packet, world, far, COHERENT)
            behind = False
            for lane in range(LANES):
                x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
                if packet.valid[lane] == 0:
                    continue
                layer.glass[y, x] = 0
                if has_hit(packet, lane) and is_refractive(world, hit_in(packet, lane, world.geometry)):
                    layer.glass[y, x] = 1
                    behind = True
                    glass += 1
            if behind:
                trace_behind_glass(scratch, world, view, x0, y0, sample)
            load_hits(block, packet, world, view.spread)
            shade(block, scratch.second, packet, world, OPAQUE)
            write_opaque(layer, block, world, view, x0, y0)
    return packet.tally[0], glass


@inlined
def trace_behind_glass(scratch: ViewScratch, world: World, view: View, x0: int, y0: int, sample: int) -> None:
    """Trace again, glass left out, the lanes that met glass first; the others keep the hits they have."""
    packet = scratch.packet
    for lane in range(LANES):
        scratch.asked[lane] = packet.valid[lane]
        again = has_hit(packet, lane) and is_refractive(world, hit_in(packet, lane, world.geometry))
        packet.valid[lane] = 0
        if again:
            x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
            scratch.far[lane] = add_view_ray(packet, view, lane, x + 0.5, y + 0.5, OPAQUE)
            belongs_to(packet, lane, x, y, sample)
    intersect_world(packet, world, scratch.far, COHERENT)
    for lane in range(LANES):
        packet.valid[lane] = scratch.asked[lane]


@inlined
def keep_hits(hits: PictureHits, packet: Packet, world: World, x0: int, y0: int, width: int, height: int) -> None:
    """Note the hits of a block of pixels, as far as they are within the picture."""
    for lane in range(LANES):
        x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
        if x >= width or y >= height:
            continue
        hits.chance[y, x] = packet.chance[lane]
        if not has_hit(packet, lane):
            continue
        hit = hit_in(packet, lane, world.geometry)
        hits.part[y, x], hits.primitive[y, x], hits.instance[y, x] = hit.part, hit.primitive, hit.instance
        hits.material[y, x] = hit.material
        hits.u[y, x], hits.v[y, x] = hit.u, hit.v


@inlined
def write_opaque(layer: OpaqueLayer, block: Block, world: World, view: View, x0: int, y0: int) -> None:
    """Put the colours of a block into the picture; the sky where nothing was hit."""
    for lane in range(LANES):
        x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
        if x >= view.size[0] or y >= view.size[1]:
            continue
        _, direction, cosine = pixel_ray(view, x + 0.5, y + 0.5)
        if block.on[lane] != 0:
            for c in range(3):
                diffuse = block.emissive[lane, c] + block.albedo[lane, c] * block.diffuse[lane, c] / math.pi
                layer.color[y, x, c] = block.color[lane, c]
                layer.normal[y, x, c] = block.ng[lane, c]
                layer.irradiance[y, x, c] = block.diffuse[lane, c]
                layer.gloss[y, x, c] = block.color[lane, c] - diffuse
                if layer.hits.part.shape[0] > 0:
                    layer.hits.emissive[y, x, c] = block.emissive[lane, c]
                    layer.hits.albedo[y, x, c] = block.albedo[lane, c]
            layer.depth[y, x] = block.distance[lane] * cosine
            layer.color[y, x, 3] = 1.0
            continue
        layer.depth[y, x] = math.inf
        sky, covered = background(world.environment, direction)
        for c in range(3):
            layer.color[y, x, c] = sky[c]
            layer.normal[y, x, c] = 0.0
        layer.color[y, x, 3] = covered
