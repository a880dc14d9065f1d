"""One refractive layer over a tile: entry, exit, tiers for what comes through and what is reflected, and their sum.

The surface is composited as HDRP does it: what comes through replaces the diffuse light by 1 - opacity, reflection and
highlights are added on top. Layers are drawn far to near; each sees the ones behind it in the screen's colour.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.compile import inlined, kernel
from ..kernels.lanes import BLOCK_HEIGHT, BLOCK_WIDTH, LANES, Scalars, Vectors, Words
from ..kernels.vec import dot, row, scale
from ..optics.interface import channel_iors, fresnel_dielectric, reflect, transmitted_roughness
from ..scene import Param
from ..view.gbuffer import view_point
from ..world.embree import OPAQUE, Packet
from ..world.shading import Block, gather, load_surface
from ..world.surface import float_input, material_of
from ..world.tracing import off_surface
from .exits import EMBEDDED, LOST, Exits, find_exits, load_medium
from .tiers import BY_MARCH, Query, ask


class Choices(NamedTuple):
    """What the settings come to, for kernels."""

    tiers: NDArray[np.int32]
    """tier codes in the order asked"""
    hdrp: bool
    """screen tier by proxy"""
    model: int
    """override for every refractive material, or -1"""


class LayerScratch(NamedTuple):
    """What one thread needs to draw a block of a layer."""

    packet: Packet
    block: Block
    second: Block
    third: Block
    exits: Exits
    query: Query
    parts: Words
    ior: Scalars
    z_self: Scalars
    opacity: Scalars
    through: Vectors


class LayerResult(NamedTuple):
    """A composited layer before it is put into the picture. float32, written only where the layer is."""

    color: NDArray[np.float32]
    """shape (H, W, 3): radiance of the pixel with this layer in front"""
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]
    """shape (H, W) z_depth [m]"""
    normal: NDArray[np.float32]
    """shape (H, W, 3): geometric normal, towards the viewer"""


def new_layer_result(width: int, height: int) -> LayerResult:
    """Planes of zeros."""
    return LayerResult(
        np.zeros((height, width, 3), np.float32),
        np.zeros((height, width), np.float32),
        np.zeros((height, width), np.float32),
        np.zeros((height, width, 3), np.float32),
    )


@kernel
def put_tile(layer, result, opaque, size, tile):  # type: ignore[no-untyped-def]
    """Draw a composited layer into the picture (an OpaqueLayer), where it is."""
    for y in range(tile[1], min(tile[3], size[1])):
        for x in range(tile[0], min(tile[2], size[0])):
            if layer.part[y, x] < 0:
                continue
            for c in range(3):
                opaque.color[y, x, c] = result.color[y, x, c]
                opaque.normal[y, x, c] = result.normal[y, x, c]
            opaque.depth[y, x] = result.depth[y, x]
            opaque.alpha[y, x] = max(opaque.alpha[y, x], result.alpha[y, x])


@inlined
def _tan_of_lobe(roughness):  # type: ignore[no-untyped-def]
    """Tangent of the half angle within which a reflected GGX lobe keeps half of its rays: twice the median slope."""
    return 2.0 * roughness * roughness


@kernel
def refract_tile(world, screen, probes, thing_probe, choices, scratch, tile, sample, layer, result, planes, front):  # type: ignore[no-untyped-def]
    """Composite `layer` over what `screen` holds, into `result`, over a tile (x0, y0, x1, y1). Returns rays traced.

    `front`: this is the nearest layer, whose parts go into `planes`.
    """
    packet, block, second, third = scratch.packet, scratch.block, scratch.second, scratch.third
    exits, query, parts, ior = scratch.exits, scratch.query, scratch.parts, scratch.ior
    z_self, opacity, through = scratch.z_self, scratch.opacity, scratch.through
    packet.tally[0] = 0
    view = screen.camera
    for y0 in range(tile[1], tile[3], BLOCK_HEIGHT):
        for x0 in range(tile[0], tile[2], BLOCK_WIDTH):
            some = _load_entries(block, exits, layer, world, view, choices, x0, y0, parts, z_self, opacity)
            if not some:
                continue
            gather(block, packet, world, sample, OPAQUE)
            channels = _dispersive(block, layer, world, x0, y0)
            for channel in range(channels):
                if channels > 1:
                    _reload(block, exits, layer, world, view, choices, x0, y0)
                _set_iors(exits, world, layer, x0, y0, ior, channel if channels > 1 else 1)
                find_exits(exits, block, parts, packet, world, ior, not choices.hdrp)
                _query_exits(query, exits, block, parts, world)
                ask(query, choices.tiers, choices.hdrp, screen, probes, thing_probe, z_self, block, second, third,
                    packet, world, sample)  # fmt: skip
                for lane in range(LANES):
                    if query.on[lane] == 0:
                        continue
                    t = row(exits.transmittance, lane)
                    for c in range(3):
                        if channels == 1 or c == channel:
                            through[lane, c] = query.color[lane, c] * t[c]
                if channels == 1 or channel == 1:
                    _note_transmission(planes, front, sample, query, exits, x0, y0)
            _query_reflections(query, block, parts, world)
            ask(query, choices.tiers, BY_MARCH, screen, probes, thing_probe, z_self, block, second, third,
                packet, world, sample)  # fmt: skip
            _composite(result, planes, front, sample, query, exits, block, through, opacity, z_self, x0, y0)
    return packet.tally[0]


@inlined
def _load_entries(block, exits, layer, world, view, choices, x0, y0, parts, z_self, opacity):  # type: ignore[no-untyped-def]
    """Look at the layer's surface in every pixel of a block. False if there is none."""
    some = False
    for lane in range(LANES):
        x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
        block.on[lane] = exits.on[lane] = 0
        if x >= view.size[0] or y >= view.size[1] or layer.part[y, x] < 0:
            continue
        some = True
        hit, direction, z = view_point(view, layer, world, x, y)
        m = material_of(world.geometry, hit.part, hit.primitive)
        block.on[lane] = 1
        block.pixel[lane, 0], block.pixel[lane, 1] = x, y
        load_surface(block, lane, hit, world, scale(direction, -1.0))
        ns = row(block.ns, lane)
        if dot(ns, direction) >= 0.0:  # interpolated normals may face away at silhouettes
            ng = row(block.ng, lane)
            for c in range(3):
                block.ns[lane, c] = ng[c]
        load_medium(exits, lane, hit, world, choices.model)
        parts[lane] = hit.part
        z_self[lane] = z
        value = float_input(world.geometry, world.materials, world.textures, hit, m, Param.OPACITY.value)
        opacity[lane] = min(1.0, max(0.0, value))
    return some


@inlined
def _reload(block, exits, layer, world, view, choices, x0, y0):  # type: ignore[no-untyped-def]
    """Undo what a walk through other media left in `exits`."""
    for lane in range(LANES):
        if block.on[lane] != 0:
            hit, _, _ = view_point(view, layer, world, x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH)
            load_medium(exits, lane, hit, world, choices.model)


@inlined
def _dispersive(block, layer, world, x0, y0):  # type: ignore[no-untyped-def]
    """3 where the material that some lane has hit disperses, else 1."""
    for lane in range(LANES):
        if block.on[lane] != 0:
            x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
            m = material_of(world.geometry, layer.part[y, x], layer.primitive[y, x])
            if world.materials.abbe[m] > 0.0:
                return 3
    return 1


@inlined
def _set_iors(exits, world, layer, x0, y0, ior, channel):  # type: ignore[no-untyped-def]
    for lane in range(LANES):
        if exits.on[lane] == 0:
            continue
        x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
        m = material_of(world.geometry, layer.part[y, x], layer.primitive[y, x])
        red, green, blue = channel_iors(exits.ior[lane], np.float64(world.materials.abbe[m]))
        ior[lane] = red if channel == 0 else (green if channel == 1 else blue)


@inlined
def _query_exits(query, exits, block, parts, world):  # type: ignore[no-untyped-def]
    for lane in range(LANES):
        query.on[lane] = exits.on[lane]
        if exits.on[lane] == 0:
            continue
        for c in range(3):
            query.origin[lane, c] = exits.point[lane, c]
            query.direction[lane, c] = exits.direction[lane, c]
            query.normal[lane, c] = block.ns[lane, c]
        rough = block.roughness[lane]
        bent = transmitted_roughness(rough, exits.ior[lane], True)
        query.blur[lane] = _tan_of_lobe(bent)
        query.roughness[lane] = rough
        query.thing[lane] = world.geometry.thing[parts[lane]]
        query.embedded[lane] = 1 if exits.status[lane] == EMBEDDED else 0


@inlined
def _query_reflections(query, block, parts, world):  # type: ignore[no-untyped-def]
    for lane in range(LANES):
        query.on[lane] = block.on[lane]
        query.embedded[lane] = 0
        if block.on[lane] == 0:
            continue
        wo, n, ng = row(block.wo, lane), row(block.ns, lane), row(block.ng, lane)
        r = reflect(scale(wo, -1.0), n)
        if dot(r, ng) <= 0.0:
            r = reflect(scale(wo, -1.0), ng)
        start = off_surface(row(block.point, lane), ng, r)
        for c in range(3):
            query.origin[lane, c] = start[c]
            query.direction[lane, c] = r[c]
            query.normal[lane, c] = n[c]
        query.blur[lane] = _tan_of_lobe(block.roughness[lane])
        query.roughness[lane] = block.roughness[lane]
        query.thing[lane] = world.geometry.thing[parts[lane]]


@inlined
def _note_transmission(planes, front, sample, query, exits, x0, y0):  # type: ignore[no-untyped-def]
    """What the exits were and which tiers answered, before the query is used again."""
    for lane in range(LANES):
        if query.on[lane] == 0:
            continue
        exits.unanswered[lane] = max(0.0, query.weight[lane, 4])
        if not front:
            continue
        x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
        planes.mask[y, x] += 1.0
        planes.screen[y, x] += query.weight[lane, 0]
        planes.ray[y, x] += query.weight[lane, 1]
        planes.probe[y, x] += query.weight[lane, 2]
        planes.sky[y, x] += query.weight[lane, 3]
        planes.none[y, x] += exits.unanswered[lane]
        for c in range(3):
            planes.transmittance[y, x, c] += exits.transmittance[lane, c]
        if exits.status[lane] != LOST:
            planes.confidence[y, x] += query.confidence[lane]
        if sample == 0:
            planes.thickness[y, x] = exits.thickness[lane]
            planes.path_length[y, x] = exits.path_length[lane]


@inlined
def _composite(result, planes, front, sample, query, exits, block, through, opacity, z_self, x0, y0):  # type: ignore[no-untyped-def]
    """(1 - opacity) of the diffuse gives way to what came through; reflection and highlights stay whole."""
    for lane in range(LANES):
        if block.on[lane] == 0:
            continue
        x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
        n, wo = row(block.ns, lane), row(block.wo, lane)
        f = fresnel_dielectric(min(1.0, max(0.0, dot(n, wo))), 1.0 / exits.ior[lane])
        clear_share = (1.0 - opacity[lane]) * (1.0 - f)
        for c in range(3):
            refraction = through[lane, c] * clear_share
            reflection = query.color[lane, c] * f + block.specular[lane, c]
            diffuse = block.emissive[lane, c] + block.albedo[lane, c] * block.diffuse[lane, c] / np.pi
            result.color[y, x, c] = refraction + reflection + opacity[lane] * diffuse
            result.normal[y, x, c] = block.ng[lane, c]
            if front:
                planes.refraction[y, x, c] += refraction
                planes.reflection[y, x, c] += reflection
                if sample == 0:
                    planes.normal[y, x, c] = block.ns[lane, c]
        result.alpha[y, x] = 1.0 - exits.unanswered[lane] * clear_share
        result.depth[y, x] = z_self[lane]
        if front and sample == 0:
            planes.z_depth[y, x] = z_self[lane]
