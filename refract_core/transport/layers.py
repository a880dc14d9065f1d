"""One refractive layer over a tile: entry, exit, tiers for what comes through and what is reflected, and their sum.

The surface is composited as HDRP does it: what comes through replaces the diffuse light by 1 - opacity, reflection and
highlights are added on top. Layers are drawn far to near; each sees the ones behind it in the screen's colour.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..kernels.arrays import F32_2D, F32_3D, I64_1D
from ..kernels.compile import inlined, kernel
from ..kernels.lanes import BLOCK_HEIGHT, BLOCK_WIDTH, LANES, Scalars, Vectors, Words, put
from ..kernels.sampling import Key, set_key
from ..kernels.vec import dot, row, scale
from ..optics.interface import channel_iors, fresnel_dielectric, reflect, transmitted_roughness
from ..scene import Param
from ..view.camera import Tile, View
from ..view.gbuffer import OpaqueLayer, RefractiveLayer, view_point
from ..view.planes import Planes
from ..world.embree import OPAQUE
from ..world.offsets import off_surface
from ..world.shading import Block, gather, load_surface
from ..world.surface import NOTHING, share_input
from ..world.tables import World
from .exits import EMBEDDED, LOST, Exits, find_exits, load_medium
from .tiers import BY_MARCH, NONE, PROBE, RAY, SCREEN, SKY, Asking, Query, TierScratch, ask

_RED, _GREEN, _BLUE = 0, 1, 2


class LayerScratch(NamedTuple):
    """What one thread needs to draw a block of a layer."""

    work: TierScratch
    block: Block
    """the layer's surfaces"""
    exits: Exits
    query: Query
    parts: Words
    opacity: Scalars
    through: Vectors
    """radiance that comes through, before Fresnel"""


class LayerResult(NamedTuple):
    """A composited layer before it is put into the picture. float32, written only where the layer is."""

    color: F32_3D
    """shape (H, W, 4): radiance of the pixel with this layer in front, premultiplied by coverage, and coverage"""
    depth: F32_2D
    """shape (H, W) z_depth [m]"""
    normal: F32_3D
    """shape (H, W, 3): geometric normal, towards the viewer"""


def new_layer_result(width: int, height: int) -> LayerResult:
    """Planes of zeros."""
    return LayerResult(
        np.zeros((height, width, 4), np.float32),
        np.zeros((height, width), np.float32),
        np.zeros((height, width, 3), np.float32),
    )


@kernel
def put_tile(
    layer: RefractiveLayer, result: LayerResult, opaque: OpaqueLayer, size: I64_1D, tile: Tile
) -> None:
    """Draw a composited layer into the picture, where it is."""
    for y in range(tile[1], min(tile[3], size[1])):
        for x in range(tile[0], min(tile[2], size[0])):
            if layer.part[y, x] == NOTHING:
                continue
            for c in range(3):
                opaque.color[y, x, c] = result.color[y, x, c]
                opaque.normal[y, x, c] = result.normal[y, x, c]
            opaque.depth[y, x] = result.depth[y, x]
            opaque.color[y, x, 3] = result.color[y, x, 3]


@inlined
def _tan_of_lobe(roughness: float) -> float:
    """Tangent of the half angle within which a reflected GGX lobe keeps half of its rays: twice the median slope."""
    return 2.0 * roughness * roughness


@kernel
def refract_tile(
    world: World,
    asking: Asking,
    model: int,
    scratch: LayerScratch,
    tile: Tile,
    sample: int,
    layer: RefractiveLayer,
    result: LayerResult,
    planes: Planes,
    front: bool,
) -> int:
    """Composite `layer` over what the screen holds, into `result`, over a tile. Returns rays traced.

    Args:
        model: a `scene.Model` for every refractive material, or -1 for their own.
        front: this is the nearest layer, whose parts go into `planes`.
    """
    work, block, exits, query = scratch.work, scratch.block, scratch.exits, scratch.query
    work.packet.tally[0] = 0
    for y0 in range(tile[1], tile[3], BLOCK_HEIGHT):
        for x0 in range(tile[0], tile[2], BLOCK_WIDTH):
            if not _load_entries(scratch, layer, world, asking.screen.camera, model, x0, y0):
                continue
            gather(block, work.packet, world, sample, OPAQUE)
            # A colour that bends differently takes a way of its own: under dispersion each channel is walked alone.
            disperses = _disperses(block, layer, world, x0, y0)
            for channel in range(3 if disperses else 1):
                if disperses:
                    _reload(scratch, layer, world, asking.screen.camera, model, x0, y0)
                _set_index(exits, world, layer, x0, y0, channel if disperses else _GREEN)
                find_exits(exits, block, scratch.parts, work.packet, world, not asking.by_proxy)
                _query_exits(scratch, world)
                ask(query, asking, asking.by_proxy, work, world, sample)
                for lane in range(LANES):
                    if query.on[lane] == 0:
                        continue
                    t = row(exits.transmittance, lane)
                    for c in range(3):
                        if not disperses or c == channel:
                            scratch.through[lane, c] = query.color[lane, c] * t[c]
                if not disperses or channel == _GREEN:
                    _note_transmission(planes, front, sample, query, exits, x0, y0)
            _query_reflections(scratch, world)
            ask(query, asking, BY_MARCH, work, world, sample)
            _composite(result, planes, front, sample, scratch, x0, y0)
    return work.packet.tally[0]


@inlined
def _load_entries(
    scratch: LayerScratch, layer: RefractiveLayer, world: World, view: View, model: int, x0: int, y0: int
) -> bool:
    """Look at the layer's surface in every pixel of a block. False if there is none."""
    block, exits, query = scratch.block, scratch.exits, scratch.query
    some = False
    for lane in range(LANES):
        x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
        block.on[lane] = exits.on[lane] = 0
        if x >= view.size[0] or y >= view.size[1] or layer.part[y, x] == NOTHING:
            continue
        some = True
        at, direction, z = view_point(view, layer, world, x, y)
        block.on[lane] = 1
        set_key(block.key, lane, Key(x, y, 0))
        set_key(query.key, lane, Key(x, y, 0))
        load_surface(block, lane, at, world, scale(direction, -1.0))
        if dot(row(block.ns, lane), direction) >= 0.0:  # interpolated normals may face away at silhouettes
            put(block.ns, lane, row(block.ng, lane))
        load_medium(exits, lane, at, world, model)
        scratch.parts[lane] = at.hit.part
        query.z_self[lane] = z
        scratch.opacity[lane] = share_input(world, at, Param.OPACITY.value)
    return some


@inlined
def _reload(
    scratch: LayerScratch, layer: RefractiveLayer, world: World, view: View, model: int, x0: int, y0: int
) -> None:
    """Undo what a walk through other media left in `exits`."""
    for lane in range(LANES):
        if scratch.block.on[lane] != 0:
            at, _, _ = view_point(view, layer, world, x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH)
            load_medium(scratch.exits, lane, at, world, model)


@inlined
def _disperses(block: Block, layer: RefractiveLayer, world: World, x0: int, y0: int) -> bool:
    """The material that some lane has hit disperses."""
    for lane in range(LANES):
        if block.on[lane] != 0:
            x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
            if world.materials.abbe[layer.material[y, x]] > 0.0:
                return True
    return False


@inlined
def _set_index(exits: Exits, world: World, layer: RefractiveLayer, x0: int, y0: int, channel: int) -> None:
    """The ior that a colour channel finds; green has the authored one."""
    for lane in range(LANES):
        if exits.on[lane] == 0:
            continue
        x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
        abbe = np.float64(world.materials.abbe[layer.material[y, x]])
        red, green, blue = channel_iors(exits.ior[lane], abbe)
        exits.ior_now[lane] = red if channel == _RED else (green if channel == _GREEN else blue)


@inlined
def _query_exits(scratch: LayerScratch, world: World) -> None:
    """Ask what the rays see that have come through."""
    query, exits, block = scratch.query, scratch.exits, scratch.block
    for lane in range(LANES):
        query.on[lane] = exits.on[lane]
        if exits.on[lane] == 0:
            continue
        put(query.origin, lane, row(exits.point, lane))
        put(query.direction, lane, row(exits.direction, lane))
        put(query.normal, lane, row(block.ns, lane))
        rough = block.roughness[lane]
        query.blur[lane] = _tan_of_lobe(transmitted_roughness(rough, exits.ior[lane], True))
        query.roughness[lane] = rough
        query.thing[lane] = world.geometry.thing[scratch.parts[lane]]
        query.embedded[lane] = 1 if exits.status[lane] == EMBEDDED else 0


@inlined
def _query_reflections(scratch: LayerScratch, world: World) -> None:
    """Ask what the surfaces mirror."""
    query, block = scratch.query, scratch.block
    for lane in range(LANES):
        query.on[lane] = block.on[lane]
        query.embedded[lane] = 0
        if block.on[lane] == 0:
            continue
        wo, n, ng = row(block.wo, lane), row(block.ns, lane), row(block.ng, lane)
        r = reflect(scale(wo, -1.0), n)
        if dot(r, ng) <= 0.0:
            r = reflect(scale(wo, -1.0), ng)
        put(query.origin, lane, off_surface(row(block.point, lane), ng, r))
        put(query.direction, lane, r)
        put(query.normal, lane, n)
        query.blur[lane] = _tan_of_lobe(block.roughness[lane])
        query.roughness[lane] = block.roughness[lane]
        query.thing[lane] = world.geometry.thing[scratch.parts[lane]]


@inlined
def _note_transmission(
    planes: Planes, front: bool, sample: int, query: Query, exits: Exits, x0: int, y0: int
) -> None:
    """What the exits were and which tiers answered, before the query is used again."""
    for lane in range(LANES):
        if query.on[lane] == 0:
            continue
        exits.unanswered[lane] = max(0.0, query.weight[lane, NONE])
        if not front:
            continue
        x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
        planes.mask[y, x] += 1.0
        planes.screen[y, x] += query.weight[lane, SCREEN]
        planes.ray[y, x] += query.weight[lane, RAY]
        planes.probe[y, x] += query.weight[lane, PROBE]
        planes.sky[y, x] += query.weight[lane, SKY]
        planes.none[y, x] += exits.unanswered[lane]
        for c in range(3):
            planes.transmittance[y, x, c] += exits.transmittance[lane, c]
        if exits.status[lane] != LOST:
            planes.confidence[y, x] += query.confidence[lane]
        if sample == 0:
            planes.thickness[y, x] = exits.thickness[lane]
            planes.path_length[y, x] = exits.path_length[lane]


@inlined
def _composite(
    result: LayerResult, planes: Planes, front: bool, sample: int, scratch: LayerScratch, x0: int, y0: int
) -> None:
    """(1 - opacity) of the diffuse gives way to what came through; reflection and highlights stay whole."""
    block, query, exits = scratch.block, scratch.query, scratch.exits
    for lane in range(LANES):
        if block.on[lane] == 0:
            continue
        x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
        n, wo, opacity = row(block.ns, lane), row(block.wo, lane), scratch.opacity[lane]
        f = fresnel_dielectric(min(1.0, max(0.0, dot(n, wo))), 1.0 / exits.ior[lane])
        clear_share = (1.0 - opacity) * (1.0 - f)
        for c in range(3):
            refraction = scratch.through[lane, c] * clear_share
            reflection = query.color[lane, c] * f + block.specular[lane, c]
            diffuse = block.emissive[lane, c] + block.albedo[lane, c] * block.diffuse[lane, c] / np.pi
            result.color[y, x, c] = refraction + reflection + opacity * diffuse
            result.normal[y, x, c] = block.ng[lane, c]
            if front:
                planes.refraction[y, x, c] += refraction
                planes.reflection[y, x, c] += reflection
                if sample == 0:
                    planes.normal[y, x, c] = block.ns[lane, c]
        result.color[y, x, 3] = 1.0 - exits.unanswered[lane] * clear_share
        result.depth[y, x] = query.z_self[lane]
        if front and sample == 0:
            planes.z_depth[y, x] = query.z_self[lane]
