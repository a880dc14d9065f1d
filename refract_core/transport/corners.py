"""Pixels from their corners: a picture with few rays, and none too many where it is smooth
(docs/decisions/corners.md).

A corner is shared by four pixels. Its view ray is followed like any other, and its leaves are kept. A pixel compares
those of its four corners: a leaf that all have is seen all over the pixel; its weight and light are their mean, and its
texture is looked at all over the quadrilateral between them. Where corners differ by more than the eye would pass, the
pixel is an *edge*, and is drawn with samples of its own.
"""

from __future__ import annotations

import math

import numpy as np

from ..kernels.arrays import I64_1D
from ..kernels.compile import flag, inlined, kernel
from ..kernels.lanes import BLOCK_HEIGHT, BLOCK_WIDTH, LANES, put
from ..kernels.sampling import Key
from ..kernels.vec import Vec, add, dot, length, lerp, mul, normalize, row, scale, sub
from ..view.camera import Tile, View, pixel_ray
from ..view.gbuffer import OpaqueLayer
from ..view.planes import Planes
from ..world.shading import entering, is_painted_alone, load_surface, paint
from ..world.surface import (
    NOTHING,
    Hit,
    Interaction,
    Ray,
    corners_of,
    interaction,
    is_round,
    kept_hit,
    surface_of,
)
from ..world.tables import World
from .answers import MOST_ANSWERS, Answers, add_direct, add_sky, body_light, keep_answers
from .behind import EDGE, OPEN
from .between import THIN, look_between
from .crossing import Rules
from .edges import draw_edges, expected_error, set_for
from .patch import PATCH, ROW, CornerScratch, Refining, Ways, corner
from .pixels import add_glass, keep_glass
from .rays import MIRRORED_SIDE, THROUGH_SIDE, VIEW, Rays
from .tiers import Asking
from .tree import CELL, TreeScratch, clear_slot, follow, start

_GLASS_ONLY = flag(False)
_ALIKE = 0.9
"""Cosine of the normals of a surface above which neighbours may see the same side of it."""
_SAME_WAY = 0.98
"""Cosine of directions above which their rays have come the same way."""
_SMOOTH = 5.0
"""Times the tolerance that light may change along a surface that all corners see: there a mean is exact to the second
order."""
_PAINTED = 0.2
"""Times the tolerance, below which a texture is not looked at between the corners."""
_FAR_APART = 2.5
"""Times the width that corners look at, from which on what lies between them is looked at whatever they say."""
_MOST_TAPS = 8
"""Along each side of a quadrilateral."""


# --- a patch ------------------------------------------------------------------------------------------------------


@kernel
def corner_tile(
    world: World,
    asking: Asking,
    rules: Rules,
    view_ray: Rays,
    refining: Refining,
    scratch: TreeScratch,
    own: CornerScratch,
    tile: Tile,
    view: View,
    opaque: OpaqueLayer,
    planes: Planes,
    ways: Ways,
) -> int:
    """Draw a patch: `planes` get as much as they would from all samples. What is added up in which order hangs on the
    patch, so the picture is cut into patches in one way only.

    Args:
        asking: its screen shows the corners.
        view: of the pixels.
        opaque: the corners' opaque picture, with hits.
        ways: filled for the patch.

    Returns:
        Rays traced.
    """
    scratch.packet.tally[0] = scratch.work.packet.tally[0] = 0
    x0, y0 = tile[0], tile[1]
    width, height = min(PATCH, view.size[0] - x0), min(PATCH, view.size[1] - y0)
    keep_answers(scratch.answers, True)
    _draw_corners(
        scratch, world, asking, rules, view_ray, opaque, x0, y0, width + 1, height + 1, refining.corner_rays
    )
    keep_answers(scratch.answers, False)
    for j in range(height + 1):
        for i in range(width + 1):
            ways.at[y0 + j, x0 + i] = scratch.cell.ways[j * ROW + i]
    look_between(scratch, own, world, refining, view, x0, y0, width, height)
    edges = 0
    for j in range(height):
        for i in range(width):
            contrast = math.inf
            if own.thin[j * PATCH + i] != THIN:
                contrast = _draw_pixel(scratch, own, world, refining, view, planes, x0 + i, y0 + j, j * ROW + i)
            ways.state[y0 + j, x0 + i] = EDGE if contrast > refining.tolerance else OPEN
            if contrast > refining.tolerance:
                own.edges[edges], own.sets[edges] = (y0 + j) * view.size[0] + x0 + i, set_for(refining, contrast)
                own.contrast[edges] = contrast if contrast < math.inf else 1.0
                edges += 1
    draw_edges(scratch, own, world, asking, rules, view_ray, refining, view, planes, edges)
    return scratch.packet.tally[0] + scratch.work.packet.tally[0]


@inlined
def _draw_corners(
    scratch: TreeScratch, world: World, asking: Asking, rules: Rules, view_ray: Rays, opaque: OpaqueLayer,
    x0: int, y0: int, columns: int, rows: int, times: int,
) -> None:  # fmt: skip
    """Fill the slots of a patch, a row of 33 after the other: blocks of 4x2 corners with glass, cell by cell."""
    view = asking.screen.camera
    submerged = view_ray.media.depth[0] > 0
    count = 0
    for by in range(0, rows, BLOCK_HEIGHT):
        for bx in range(0, columns, BLOCK_WIDTH):
            for lane in range(LANES):
                i, j = bx + lane % BLOCK_WIDTH, by + lane // BLOCK_WIDTH
                if i >= columns or j >= rows:
                    continue
                x, y, slot = x0 + i, y0 + j, j * ROW + i
                scratch.answers.filled[slot] = 0
                if opaque.glass[y, x] == 0 and not submerged:
                    _keep_opaque(scratch, world, view, opaque, x, y, slot)
                else:
                    scratch.cell.spread[slot] = view.spread
                    count = start(scratch, view, view_ray, count, slot, x + 0.5, y + 0.5, Key(x, y, 0, 0))
            if count > CELL - LANES:
                follow(scratch, world, asking, rules, view, count, _GLASS_ONLY, times)
                count = 0
    if count > 0:
        follow(scratch, world, asking, rules, view, count, _GLASS_ONLY, times)
    for j in range(rows):
        for i in range(columns):
            slot = j * ROW + i
            if scratch.answers.filled[slot] == 0 and scratch.cell.glass[slot] == 0:  # it passed what glass it met
                first, facing = scratch.cell.part[slot], row(scratch.cell.facing, slot)
                _keep_opaque(scratch, world, view, opaque, x0 + i, y0 + j, slot)
                scratch.cell.part[slot] = first
                put(scratch.cell.facing, slot, facing)


@inlined
def _keep_opaque(
    scratch: TreeScratch, world: World, view: View, opaque: OpaqueLayer, x: int, y: int, slot: int
) -> None:
    """Take a corner from the opaque picture."""
    cell = scratch.cell
    clear_slot(cell, slot)
    origin, direction, cosine = pixel_ray(view, x + 0.5, y + 0.5)
    light = row(opaque.color[y], x)
    put(cell.color, slot, light)
    cell.missing[slot] = 1.0 - opaque.color[y, x, 3]
    cell.chance[slot] = opaque.hits.chance[y, x]
    cell.part[slot] = NOTHING
    cell.z_depth[slot] = opaque.depth[y, x]
    put(cell.normal, slot, row(opaque.normal[y], x))
    put(cell.facing, slot, row(opaque.normal[y], x))
    if opaque.depth[y, x] == math.inf:
        add_sky(scratch.answers, slot, direction, light)
        return
    t = opaque.depth[y, x] / cosine
    hits = opaque.hits
    hit = Hit(
        hits.part[y, x], hits.primitive[y, x], hits.instance[y, x], hits.material[y, x],
        np.float64(hits.u[y, x]), np.float64(hits.v[y, x]), t,
    )  # fmt: skip
    cell.part[slot] = surface_of(world.geometry, hit)
    at = interaction(world.geometry, hit, Ray(origin, direction), view.spread * t)
    emissive, albedo = row(hits.emissive[y], x), row(hits.albedo[y], x)
    irradiance, gloss = row(opaque.irradiance[y], x), row(opaque.gloss[y], x)
    add_direct(scratch.answers, slot, world, at, direction, emissive, albedo, irradiance, gloss, view.spread * t)


# --- a pixel ------------------------------------------------------------------------------------------------------


@inlined
def _draw_pixel(
    scratch: TreeScratch, own: CornerScratch, world: World, refining: Refining, view: View, planes: Planes,
    x: int, y: int, slot: int,
) -> float:  # fmt: skip
    """Make a pixel of its corners, and return their contrast; where it is over the tolerance nothing is done."""
    answers = scratch.answers
    for k in range(4):
        if answers.filled[corner(slot, k)] > MOST_ANSWERS:
            return math.inf
        own.used[k] = 0
        for c in range(3):
            own.alone[k, c] = own.shared[k, c] = 0.0
    for side in range(3):
        put(own.light, side, (0.0, 0.0, 0.0))
    seen = (0.0, 0.0, 0.0)
    for k in range(4):
        seen = add(seen, scale(row(scratch.cell.color, corner(slot, k)), 0.25))
    for n in range(answers.filled[slot]):
        r = slot * MOST_ANSWERS + n
        if not _match(answers, own, slot, r):
            continue
        light = _light_of_four(scratch, own, world, refining, seen)
        put(own.light, answers.side[r], add(row(own.light, answers.side[r]), light))
    for k in range(4):
        base = corner(slot, k) * MOST_ANSWERS
        for n in range(answers.filled[corner(slot, k)]):
            if (own.used[k] >> n) & 1 != 0:
                continue
            r = base + n
            there = body_light(answers, r, row(answers.emissive, r), row(answers.albedo, r))
            light = mul(row(answers.weight, r), there)
            put(own.alone, k, add(row(own.alone, k), light))
            put(own.light, answers.side[r], add(row(own.light, answers.side[r]), scale(light, 0.25)))
    contrast = _contrast(scratch, own, refining, slot)
    if contrast <= refining.tolerance:
        _write_pixel(scratch, own, planes, refining.samples, x, y, slot, view.orthographic)
        planes.confidence[y, x] *= 1.0 - min(1.0, expected_error(contrast, 4))
    return contrast


@inlined
def _match(answers: Answers, own: CornerScratch, slot: int, r: int) -> bool:
    """Whether the other corners have an answer like row `r` of the first; if so, all four are noted, and used up."""
    own.found[0] = r
    for k in range(1, 4):
        base = corner(slot, k) * MOST_ANSWERS
        found = -1
        for n in range(answers.filled[corner(slot, k)]):
            if found < 0 and (own.used[k] >> n) & 1 == 0 and _alike(answers, r, base + n):
                found = base + n
        if found < 0:
            return False
        own.found[k] = found
    for k in range(4):
        own.used[k] |= 1 << (own.found[k] - corner(slot, k) * MOST_ANSWERS)
    return True


@inlined
def _alike(answers: Answers, r: int, s: int) -> bool:
    """Two corners see the same surface by the same way."""
    if answers.way[r] != answers.way[s] or answers.side[r] != answers.side[s]:
        return False
    if (answers.share[r] > 0.0) != (answers.share[s] > 0.0):
        return False
    dr, ds = row(answers.direction, r), row(answers.direction, s)
    if dot(dr, ds) < _SAME_WAY * dot(dr, dr):  # those of a glow are 0
        return False
    nr = row(answers.normal, r)
    return dot(nr, row(answers.normal, s)) >= _ALIKE * dot(nr, nr)


@inlined
def _light_of_four(
    scratch: TreeScratch, own: CornerScratch, world: World, refining: Refining, seen: Vec
) -> Vec:
    """Light that a pixel gets from four answers that match; and what each corner gets of it goes to `own.shared`."""
    answers, found = scratch.answers, own.found
    weight, emissive, albedo = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for k in range(4):
        weight = add(weight, scale(row(answers.weight, found[k]), 0.25))
        emissive = add(emissive, scale(row(answers.emissive, found[k]), 0.25))
        albedo = add(albedo, scale(row(answers.albedo, found[k]), 0.25))
    if answers.share[found[0]] > 0.0 and _is_painted(answers, found, world, weight, seen, refining):
        _filter(scratch, own, world)
        emissive, albedo = row(own.filtered, 0), row(own.filtered, 1)
    light = (0.0, 0.0, 0.0)
    for k in range(4):
        r = found[k]
        there = body_light(answers, r, emissive, albedo)
        light = add(light, scale(there, 0.25))
        put(own.shared, k, add(row(own.shared, k), mul(row(answers.weight, r), there)))
    return mul(weight, light)


@inlined
def _is_painted(
    answers: Answers, found: I64_1D, world: World, weight: Vec, seen: Vec, refining: Refining
) -> bool:
    """A texture changes the light of four answers by so much that it has to be looked at between them."""
    hit = kept_hit(answers.hits, found[0])
    if world.materials.driven[hit.material] == 0 or is_round(world.geometry, hit.part):
        return False
    # Corners that lie farther apart than each of them looks may agree by chance, as on a floor that is seen edge-on.
    sides = _sides(answers, found)
    apart = max(sides[0], sides[1]) > _FAR_APART * answers.wide[found[0]]
    if apart and max(weight[0], weight[1], weight[2]) * answers.share[found[0]] > _PAINTED * refining.tolerance:
        return True
    for c in range(3):
        low, high = math.inf, -math.inf
        for k in range(4):
            r = found[k]
            lit = answers.albedo[r, c] * answers.irradiance[r, c] / math.pi
            light = weight[c] * answers.share[r] * (answers.emissive[r, c] + lit)
            low, high = min(low, light), max(high, light)
        more = _shown(seen[c] + high - low, refining.exposure) - _shown(seen[c], refining.exposure)
        if more > _PAINTED * refining.tolerance:
            return True
    return False


@inlined
def _sides(answers: Answers, found: I64_1D) -> tuple[float, float]:
    """How wide and how high the quadrilateral between the points is where four rays meet a surface [m]."""
    a, b = row(answers.point, found[0]), row(answers.point, found[1])
    c, d = row(answers.point, found[2]), row(answers.point, found[3])
    wide = 0.5 * (length(sub(b, a)) + length(sub(d, c)))
    return wide, 0.5 * (length(sub(c, a)) + length(sub(d, b)))


@inlined
def _filter(scratch: TreeScratch, own: CornerScratch, world: World) -> None:
    """Emission and albedo of a surface, over the quadrilateral between the points where four rays meet it."""
    answers, found, block = scratch.answers, own.found, scratch.block_of_one
    a, b = row(answers.point, found[0]), row(answers.point, found[1])
    c, d = row(answers.point, found[2]), row(answers.point, found[3])
    wide, high = _sides(answers, found)
    narrow = max(min(wide, high), 1e-9)
    step = max(0.5 * narrow, max(wide, high) / _MOST_TAPS)
    # Of the distance between taps, each looks at half: what a mip level holds reaches twice as far. Where that is not
    # enough for a long quadrilateral, it looks at more, up to all of it.
    look = step * min(1.0, step / narrow)
    across, down = min(_MOST_TAPS, math.ceil(wide / step - 1e-6)), min(_MOST_TAPS, math.ceil(high / step - 1e-6))
    across, down = max(across, 2), max(down, 2)
    emissive, albedo = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    first = kept_hit(answers.hits, found[0])
    alone = is_painted_alone(world, first.material)
    share = (1.0, 1.0, 1.0)
    if alone:  # what it mirrors is the same all over the pixel
        wo = scale(row(answers.direction, found[0]), -1.0)
        load_surface(block, 0, interaction(world.geometry, first, Ray(a, wo), 0.0), world, wo)
        share = entering(block, 0)
    for j in range(down):
        t = (j + 0.5) / down
        for i in range(across):
            s = (i + 0.5) / across
            p = lerp(lerp(a, b, s), lerp(c, d, s), t)
            near = found[(1 if s > 0.5 else 0) + (2 if t > 0.5 else 0)]
            hit = _moved(world, kept_hit(answers.hits, near), sub(p, row(answers.point, near)))
            wo = scale(row(answers.direction, near), -1.0)
            if alone:
                shines, sends = paint(Interaction(hit, p, wo, wo, look), world, share)
            else:
                load_surface(block, 0, interaction(world.geometry, hit, Ray(p, wo), look), world, wo)
                shines, sends = row(block.emissive, 0), row(block.albedo, 0)
            emissive, albedo = add(emissive, shines), add(albedo, sends)
    put(own.filtered, 0, scale(emissive, 1.0 / (across * down)))
    put(own.filtered, 1, scale(albedo, 1.0 / (across * down)))


@inlined
def _moved(world: World, hit: Hit, off: Vec) -> Hit:
    """The place beside a hit, in the plane of its triangle: so a texture goes on beyond the triangle's border."""
    a, b, c = corners_of(world.geometry, hit.part, hit.instance, hit.primitive)
    x, y = sub(b, a), sub(c, a)
    xx, xy, yy = dot(x, x), dot(x, y), dot(y, y)
    area = xx * yy - xy * xy
    if area <= 0.0:
        return hit
    px, py = dot(off, x), dot(off, y)
    u, v = hit.u + (yy * px - xy * py) / area, hit.v + (xx * py - xy * px) / area
    return Hit(hit.part, hit.primitive, hit.instance, hit.material, u, v, hit.t)


@inlined
def _shown(light: float, exposure: float) -> float:
    """About how bright it is to the eye; above white by ratios, so that highlights count in pictures that keep them."""
    shown = max(0.0, light * exposure)
    return math.sqrt(shown) if shown < 1.0 else 1.0 + 0.5 * math.log(shown)


@inlined
def _contrast(scratch: TreeScratch, own: CornerScratch, refining: Refining, slot: int) -> float:
    """By how much the corners differ in what their mean would not do justice to."""
    most = 0.0
    for c in range(3):
        common = 0.25 * (own.shared[0, c] + own.shared[1, c] + own.shared[2, c] + own.shared[3, c])
        low, high, dark, bright = math.inf, -math.inf, math.inf, -math.inf
        for k in range(4):
            alone = _shown(common + own.alone[k, c], refining.exposure)
            low, high = min(low, alone), max(high, alone)
            shared = _shown(own.shared[k, c], refining.exposure)
            dark, bright = min(dark, shared), max(bright, shared)
        most = max(most, high - low, (bright - dark) / _SMOOTH)
    cell = scratch.cell
    least, all_missing = math.inf, -math.inf
    for k in range(4):
        if cell.chance[corner(slot, k)] != 0:  # that four agree says nothing
            return 1.0
        missing = cell.missing[corner(slot, k)]
        least, all_missing = min(least, missing), max(all_missing, missing)
    return max(most, all_missing - least)


@inlined
def _write_pixel(
    scratch: TreeScratch, own: CornerScratch, planes: Planes, samples: int, x: int, y: int, slot: int,
    orthographic: bool,
) -> None:  # fmt: skip
    """Write a pixel's light, and the mean of what else its corners know."""
    cell = scratch.cell
    nearness, z, normal, missing = 0.0, 0.0, (0.0, 0.0, 0.0), 0.0
    glass = -1
    for k in range(4):
        i = corner(slot, k)
        z += 0.25 * cell.z_depth[i]
        nearness += 0.25 / cell.z_depth[i]
        normal = add(normal, row(cell.normal, i))
        missing += 0.25 * cell.missing[i]
        if cell.glass[i] != 0:
            add_glass(planes, cell, i, x, y, 0.25 * samples)
            glass = i if glass < 0 else glass
    for c in range(3):
        through, mirrored = own.light[THROUGH_SIDE, c], own.light[MIRRORED_SIDE, c]
        planes.beauty[y, x, c] = samples * (own.light[VIEW, c] + through + mirrored)
        if glass >= 0:
            planes.refraction[y, x, c] = samples * through
            planes.reflection[y, x, c] = samples * mirrored
    planes.beauty[y, x, 3] = samples * (1.0 - missing)
    if glass >= 0:
        keep_glass(planes, cell, glass, x, y)
    if dot(normal, normal) > 0.0:
        normal = normalize(normal)
    # Over a plane depth is affine in the picture for parallel rays, and its reciprocal for those from a point.
    planes.z_depth[y, x] = z if orthographic or nearness == 0.0 else 1.0 / nearness
    for c in range(3):
        planes.normal[y, x, c] = normal[c]
