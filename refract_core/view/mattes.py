"""Which thing and which material the samples of a pixel see first: what mattes are made from.

Glass is what is seen, not what is seen through it. These rays go beside those of the picture and tell nothing else, so
that kernels that every picture needs know nothing of mattes.
"""

from __future__ import annotations

from ..kernels.arrays import F32_3D, I32_1D, I32_3D
from ..kernels.compile import kernel
from ..kernels.lanes import BLOCK_HEIGHT, BLOCK_WIDTH, LANES
from ..world.embree import COHERENT, EVERYTHING, clear, has_hit
from ..world.surface import hit_in, thing_of
from ..world.tables import World
from ..world.tracing import belongs_to, intersect_world
from .camera import Tile, View
from .gbuffer import ViewScratch, add_view_ray


@kernel
def see_first(
    world: World, view: View, scratch: ViewScratch, tile: Tile, sample: int, things: I32_3D, materials: I32_3D
) -> int:
    """Note what one sample of each pixel of a tile sees. Returns rays traced.

    Args:
        things: shape (S, h, w) of the tile's pixels: number of the thing, or -1.
        materials: the same: row of the material, or -1.
    """
    packet, far = scratch.packet, scratch.far
    packet.tally[0] = 0
    right, bottom = tile[0] + things.shape[2], tile[1] + things.shape[1]
    for y0 in range(tile[1], bottom, BLOCK_HEIGHT):
        for x0 in range(tile[0], right, BLOCK_WIDTH):
            clear(packet)
            for lane in range(LANES):
                x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
                if x < right and y < bottom:
                    far[lane] = add_view_ray(packet, view, lane, x + 0.5, y + 0.5, EVERYTHING)
                    belongs_to(packet, lane, x, y, sample)
            intersect_world(packet, world, far, COHERENT)
            for lane in range(LANES):
                x, y = x0 + lane % BLOCK_WIDTH, y0 + lane // BLOCK_WIDTH
                if x >= right or y >= bottom:
                    continue
                row, column = y - tile[1], x - tile[0]
                things[sample, row, column] = materials[sample, row, column] = -1
                if has_hit(packet, lane):
                    hit = hit_in(packet, lane, world.geometry)
                    things[sample, row, column] = thing_of(world.geometry, hit)
                    materials[sample, row, column] = hit.material
    return packet.tally[0]


@kernel
def rank(
    seen: I32_3D, hashes: I32_1D, tile: Tile, kept: I32_1D, counts: I32_1D, bits: I32_3D, ranks: F32_3D
) -> None:
    """Put what the samples of a tile's pixels saw into `ranks`, the largest share first.

    Args:
        seen: shape (S, h, w): rows of `hashes`, or -1. Rows with equal hashes count as one.
        kept, counts: working memory, shape (S,) each.
        bits: the memory of `ranks`, as integers.
        ranks: shape (H, W, 2 R) of the picture: bits of a hash, and share, by turns; zeros.
    """
    samples = seen.shape[0]
    for y in range(seen.shape[1]):
        for x in range(seen.shape[2]):
            kinds = 0
            for s in range(samples):
                row = seen[s, y, x]
                if row < 0:
                    continue
                found = 0
                while found < kinds and kept[found] != hashes[row]:
                    found += 1
                if found == kinds:
                    kept[kinds] = hashes[row]
                    counts[kinds] = 0
                    kinds += 1
                counts[found] += 1
            for r in range(min(kinds, ranks.shape[2] // 2)):
                best = 0
                for k in range(1, kinds):
                    # Of equal shares the smaller hash: the order must not hang on that of the samples.
                    if counts[k] > counts[best] or (counts[k] == counts[best] and kept[k] < kept[best]):
                        best = k
                bits[tile[1] + y, tile[0] + x, 2 * r] = kept[best]
                ranks[tile[1] + y, tile[0] + x, 2 * r + 1] = counts[best] / samples
                counts[best] = -1
