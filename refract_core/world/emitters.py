"""What glows, made into lights: triangles of opaque materials that emit become trees (`world.glow`), spheres lamps.

A triangle emits what its material says; where that is a texture, large ones are cut, and each piece emits the mean over
it. Each object is a light, unless there are very many: then neighbours of one colour are one together. A closed mesh
shines outwards, but inwards where the eye is in it; an open one to both sides.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.arrays import F64_2D, F64_3D, I32_1D
from ..kernels.compile import inlined, kernel
from ..kernels.lanes import by_address, put
from ..kernels.vec import along, cross, length, sub
from ..scene import F32, F64, Light, LightKind, Param, Scene
from .environment import TEXEL_LUMINANCE
from .glow import FLAT, Glow, GlowTree, no_glow
from .glow_views import ROWS, bodies_of, joined, tables_of
from .solid import across, along_a_curve, areas, by_halves, encloses
from .surface import Hit, Interaction, Ray, color_input, corners_of, interaction, share_input
from .tables import World, rows_of

_MOST_LIGHTS = 16
"""Lights that all that glows may be, and as many exact spheres; more of these are triangles, too."""
_MOST_PIECES = 1 << 16
"""Pieces of an object that are looked at; of more, an even choice by area stands for all."""
_PIECES = 128
"""Pieces that an object is cut into whose glow is a picture or a primvar, about."""
_MOST_CUTS = 4
"""Times that a triangle is cut in four at most."""
_BRIGHTEST = 1e30
"""Radiance that anything has at most, so that sums stay numbers."""
_FAINT = 1e-4
"""Part of all the power of what glows below which an object lights nothing."""
_LEVELS_SEEN = 7
"""Of a tree, from the top, whose nodes have tables of what they send in each direction."""
_SHADES = 8.0
"""Steps of colour that are told apart where objects are put together."""
_PLACES = ((1 / 3, 1 / 3), (0.6, 0.2), (0.2, 0.6), (0.2, 0.2))
"""Where on a piece emission is looked up: its middle, and nearer to its corners."""


class _Pieces(NamedTuple):
    """E pieces of triangles, each of which shines to one side."""

    part: I32_1D
    primitive: I32_1D
    bary: F64_3D
    """shape (E, 3, 2): u and v of their corners in the triangle"""
    corner: F64
    """shape (E, 3, 3): counter-clockwise seen from where they shine to [m]"""
    radiance: F64_2D
    """shape (E, 3)"""


def what_glows(world: World, scene: Scene, eye: F64) -> Glow | None:
    """Everything that is drawn and emits light, or None.

    Args:
        world: not by address.
        eye: shape (3,): of the camera [m].
    """
    emits = np.array([material.emits and not material.refractive for material in scene.materials], np.bool_)
    if not emits[world.geometry.material].any():
        return None
    seen, exact = by_address(world), world.geometry.sphere[:, 3] > 0.0
    objects: dict[int, list[_Pieces]] = {}
    # What glows in many places has been settled to be alone.
    alone = np.flatnonzero((world.geometry.place < 0) & (world.geometry.ball < 0)).tolist()
    parts = [part for part in alone if emits[world.geometry.material[rows_of(world.geometry, part)]].any()]
    few = exact[parts].sum() <= _MOST_LIGHTS
    balls: list[Light] = []
    for part in parts:
        pieces = _facets(world, part) if exact[part] else _pieces(world, scene, part, emits, eye)
        emission_of(seen, pieces.part, pieces.primitive, pieces.bary, pieces.radiance)
        np.nan_to_num(pieces.radiance, copy=False, nan=0.0, posinf=_BRIGHTEST)
        np.clip(pieces.radiance, 0.0, _BRIGHTEST, out=pieces.radiance)
        if exact[part] and few:
            balls += _lamp(world, part, pieces.radiance[0])
        else:
            if exact[part]:  # its triangles are larger than it is
                pieces = pieces._replace(radiance=pieces.radiance * _share_of_round())
            objects.setdefault(int(world.geometry.thing[part]), []).append(pieces)
    whole = [_Pieces(*(np.concatenate(column) for column in zip(*parts, strict=True))) for parts in objects.values()]
    lights, trees = _lights(whole)
    starts = np.cumsum([0, *(len(tree.power) for tree in trees)])[:-1]
    return Glow((*lights, *balls), (*starts.tolist(), *[-1] * len(balls)), _one(trees, starts))


# --- what an object emits -------------------------------------------------------------------------------------------


@kernel
def emission_of(
    world: World, part: I32_1D, primitive: I32_1D, bary: F64_3D, radiance: F64_2D
) -> None:
    """Fill the mean radiance of pieces, of what of them is there."""
    for e in range(part.shape[0]):
        a, b, c = corners_of(world.geometry, part[e], 0, primitive[e])
        wide = math.sqrt(0.5 * length(cross(sub(b, a), sub(c, a))) * abs(_share_of(bary, e)))
        total = (0.0, 0.0, 0.0)
        material = world.geometry.material[world.geometry.first[part[e]] + primitive[e]]
        for s, t in _PLACES:
            u = bary[e, 0, 0] + s * (bary[e, 1, 0] - bary[e, 0, 0]) + t * (bary[e, 2, 0] - bary[e, 0, 0])
            v = bary[e, 0, 1] + s * (bary[e, 1, 1] - bary[e, 0, 1]) + t * (bary[e, 2, 1] - bary[e, 0, 1])
            hit = Hit(part[e], primitive[e], 0, material, u, v, 1.0)
            at = interaction(world.geometry, hit, Ray((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), wide)
            light = color_input(world, at, Param.EMISSIVE.value)
            total = along(total, (max(0.0, light[0]), max(0.0, light[1]), max(0.0, light[2])), 0.25 * _there(world, at))
        put(radiance, e, total)


@inlined
def _share_of(bary: F64_3D, e: int) -> float:
    """Part of its triangle that a piece is; negative where it is turned round."""
    u1, v1 = bary[e, 1, 0] - bary[e, 0, 0], bary[e, 1, 1] - bary[e, 0, 1]
    u2, v2 = bary[e, 2, 0] - bary[e, 0, 0], bary[e, 2, 1] - bary[e, 0, 1]
    return float(u1 * v2 - u2 * v1)


@inlined
def _there(world: World, at: Interaction) -> float:
    """How much of a place a cut-out leaves."""
    m = at.hit.material
    if world.materials.cutout[m] == 0:
        return 1.0
    opacity, threshold = share_input(world, at, Param.OPACITY.value), world.materials.threshold[m]
    if threshold > 0.0:
        return 1.0 if opacity >= threshold else 0.0
    return opacity


def _pieces(world: World, scene: Scene, part: int, emits: NDArray[np.bool_], eye: F64) -> _Pieces:
    """Triangles of a part that emit, cut, turned to where they shine, those of an open mesh twice."""
    geometry = world.geometry
    mesh = scene.meshes[geometry.thing[part]]
    rows = rows_of(geometry, part)
    glowing = np.flatnonzero(emits[geometry.material[rows]])
    corners = geometry.points[geometry.triangles[rows][glowing]].astype(np.float64)
    area = areas(corners)
    kept = area > 0.0
    glowing, corners, area = glowing[kept], corners[kept], area[kept]
    if len(area) > _MOST_PIECES:  # of equal area each, then; too small to be cut
        chosen = np.searchsorted(np.cumsum(area) / area.sum(), (np.arange(_MOST_PIECES) + 0.5) / _MOST_PIECES)
        glowing, corners = glowing[chosen], _of_area(corners[chosen], area.sum() / _MOST_PIECES)
        area = np.full(_MOST_PIECES, area.sum() / _MOST_PIECES)
    driven = world.materials.driven[geometry.material[rows][glowing]] >> Param.EMISSIVE.value & 1
    cuts = np.clip(np.ceil(np.log(area / area.sum() * _PIECES) / math.log(4.0)), 0, _MOST_CUTS)
    which, bary = _cut(np.where(driven != 0, cuts, 0).astype(np.int64))
    sides = np.matmul(
        np.stack([1.0 - bary.sum(axis=2), bary[:, :, 0], bary[:, :, 1]], axis=2), corners[which]
    )
    if geometry.sheet[part] != 0:
        which = np.concatenate([which, which])
        bary, sides = (np.concatenate([side, side[:, ::-1]]) for side in (bary, sides))
    elif encloses(mesh.points, mesh.triangles, eye):
        bary, sides = bary[:, ::-1], sides[:, ::-1]
    return _Pieces(
        np.full(len(which), part, np.int32), glowing[which].astype(np.int32), np.ascontiguousarray(bary),
        np.ascontiguousarray(sides), np.zeros((len(which), 3)),
    )  # fmt: skip


def _of_area(corners: F64, area: float) -> F64:
    """Triangles of another area about the same middles."""
    middle = corners.mean(axis=1, keepdims=True)
    grown: F64 = middle + (corners - middle) * np.sqrt(area / areas(corners))[:, None, None]
    return grown


def _cut(cuts: NDArray[np.int64]) -> tuple[NDArray[np.int64], F64]:
    """Pieces of triangles, each cut in four so many times: whose they are, and u and v of their corners."""
    which = np.arange(len(cuts))
    bary = np.broadcast_to(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), (len(cuts), 3, 2)).copy()
    for done in range(_MOST_CUTS):
        again = cuts[which] > done
        a, b, c = (bary[again, k] for k in range(3))
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        four = [np.stack(corners, axis=1) for corners in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        bary = np.concatenate([bary[~again], *four])
        which = np.concatenate([which[~again], *[which[again]] * 4])
    return which, bary


def _facets(world: World, part: int) -> _Pieces:
    """An exact sphere as 80 triangles around it, each of which has the emission of its one place. They touch it, for a
    shadow ray must end before it meets it."""
    ball = world.geometry.sphere[part].astype(np.float64)
    corners = _round() * ball[3] + ball[:3]
    count = len(corners)
    bary = np.full((count, 3, 2), 1.0 / 3.0)
    return _Pieces(
        np.full(count, part, np.int32), np.zeros(count, np.int32), bary, corners, np.zeros((count, 3))
    )


@cache
def _round() -> F64:
    """Shape (80, 3, 3): an icosahedron, each face cut in four, around the unit sphere and a little off it."""
    g = (1.0 + math.sqrt(5.0)) / 2.0
    places = np.array([(a, b * g, 0.0) for a in (-1, 1) for b in (-1, 1)])
    points = np.concatenate([np.roll(places, k, axis=1) for k in range(3)])
    near = np.linalg.norm(points[:, None] - points[None], axis=2) < 2.1
    threes = [(i, j, k) for i in range(12) for j in range(i) for k in range(j)]
    met = [(i, j, k) for i, j, k in threes if near[i, j] and near[j, k] and near[i, k]]
    a, b, c = (points[list(column)] for column in zip(*met, strict=True))
    ab, bc, ca = a + b, b + c, c + a
    faces = np.concatenate([np.stack(f, axis=1) for f in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    faces /= np.linalg.norm(faces, axis=2, keepdims=True)
    normals = across(faces)
    turned = (normals * faces[:, 0]).sum(axis=1) < 0.0
    faces[turned] = faces[turned][:, ::-1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    grown: F64 = faces / np.abs((normals * faces[:, 0]).sum(axis=1)).min() * 1.0001
    return grown


@cache
def _share_of_round() -> float:
    """What the unit sphere has of the area of the triangles around it."""
    return 4.0 * math.pi / float(areas(_round()).sum())


def _lamp(world: World, part: int, radiance: F64) -> list[Light]:
    centre, radius = world.geometry.sphere[part, :3].astype(np.float64), float(world.geometry.sphere[part, 3])
    return [_light(LightKind.BALL, radiance, centre, radius)] if radiance.max() > 0.0 else []


def _light(kind: LightKind, radiance: F64, centre: F64, size: float) -> Light:
    place = np.eye(4)
    place[:3, 3] = centre
    r, g, b = (float(c) for c in radiance)
    return Light("", kind, (r, g, b), place, (size, 0.0))


# --- objects as lights ----------------------------------------------------------------------------------------------


def _lights(objects: list[_Pieces]) -> tuple[list[Light], list[GlowTree]]:
    """A light and its tree for each object, or for neighbours of one colour."""
    light = [pieces.radiance * areas(pieces.corner)[:, None] for pieces in objects]
    power = np.array([flux.sum(axis=0) @ TEXEL_LUMINANCE for flux in light])
    kept = [k for k in np.argsort(-power, kind="stable") if power[k] > _FAINT * power.sum()]
    if len(kept) > _MOST_LIGHTS:
        middles = np.array([objects[k].corner.mean(axis=(0, 1)) for k in kept])
        colours = np.array([light[k].sum(axis=0) / max(light[k].sum(), 1e-300) for k in kept])
        shade = np.round(colours * _SHADES).astype(np.int64) @ np.array([100, 10, 1])
        order = np.lexsort((along_a_curve(middles).argsort(), shade))
        running = np.cumsum(power[kept][order])
        group = np.minimum(running / running[-1] * _MOST_LIGHTS, _MOST_LIGHTS - 1).astype(np.int64)
        groups = [[kept[k] for k in order[group == g]] for g in np.unique(group)]
    else:
        groups = [[k] for k in kept]
    lights, trees = [], []
    for members in groups:
        corner = np.concatenate([objects[k].corner for k in members])
        radiance = np.concatenate([objects[k].radiance for k in members])
        weight = radiance @ TEXEL_LUMINANCE
        shines = weight > 0.0
        corner, radiance, weight = corner[shines], radiance[shines], weight[shines]
        area = areas(corner)
        colour = (radiance * area[:, None]).sum(axis=0) / (weight * area).sum()
        trees.append(_tree(corner, weight, area))
        lights.append(_light(LightKind.GLOW, colour, trees[-1].node[0, :3], 0.0))
    return lights, trees


def _tree(corner: F64, weight: F64, area: F64) -> GlowTree:
    """A whole binary tree over triangles along a curve through places and normals; leaves beyond the last are empty."""
    normal = across(corner) / (2.0 * area)[:, None]
    middle = corner.mean(axis=1)
    order = _order(middle, normal)
    corner, weight, area, normal, middle = (column[order] for column in (corner, weight, area, normal, middle))
    depth = max(0, math.ceil(math.log2(len(area))))
    count = 1 << depth
    # Where the nodes of each level stand, each before what is below it: the left one right behind, the right one after
    # all that is below the left.
    places = [np.zeros(1, np.int64)]
    for level in range(depth):
        below = 1 << (depth - level)
        places.append(np.stack([places[-1] + 1, places[-1] + below], axis=1).ravel())
    nodes = 2 * count - 1
    tree = GlowTree(
        np.zeros((nodes, 4)), np.zeros((nodes, 3)), np.zeros(nodes), np.zeros(nodes), np.zeros(nodes, np.int32),
        np.zeros(nodes, np.int32), np.full(nodes, -1, np.int32), _axes(corner, middle), np.full(nodes, -1, np.int32),
        np.zeros((0, 5), np.float32),
    )  # fmt: skip
    filled = np.zeros((count, 9))  # weight times area; that times middle and normal; area
    power = weight * area
    filled[: len(area)] = np.column_stack([power, power[:, None] * middle, power[:, None] * normal, area, area])
    low, high = np.full((count, 3), math.inf), np.full((count, 3), -math.inf)
    low[: len(area)], high[: len(area)] = corner.min(axis=1), corner.max(axis=1)
    for level in range(depth, -1, -1):
        at, size = places[level], 1 << (depth - level)
        tree.power[at], tree.facing[at], tree.area[at] = filled[:, 0], filled[:, 4:7], filled[:, 7]
        with np.errstate(invalid="ignore", divide="ignore"):
            centre = np.where(filled[:, :1] > 0.0, filled[:, 1:4] / filled[:, :1], 0.0)
            reach = np.maximum(np.abs(high - centre), np.abs(centre - low))
        tree.node[at, :3] = centre
        tree.node[at, 3] = np.where(filled[:, 0] > 0.0, np.linalg.norm(reach, axis=1), 0.0)
        tree.after[at] = at + 2 * size - 1
        if level < depth:
            tree.right[at] = at + size
        filled = filled.reshape(-1, 2, 9).sum(axis=1) if level else filled
        low, high = (low.reshape(-1, 2, 3).min(axis=1), high.reshape(-1, 2, 3).max(axis=1)) if level else (low, high)
    leaves = places[depth][: len(area)]
    tree.triangle[leaves] = np.arange(len(area))
    return _with_views(tree, places, normal * power[:, None], middle)


def _with_views(tree: GlowTree, places: list[NDArray[np.int64]], facing: F64, middle: F64) -> GlowTree:
    """The tree with tables for its upper nodes that are not flat.

    Args:
        places: of the nodes of each level.
        facing: shape (T, 3): normals of the triangles, times area and weight [m^2]; `middle`: where they are [m].
    """
    levels = places[:-1][:_LEVELS_SEEN]
    if not levels:
        return tree
    whole, at = np.zeros((2, len(places[-1]), 3))
    whole[: len(facing)], at[: len(facing)] = facing, middle
    centre = tree.node[levels[-1], :3]
    shape = len(centre), -1, 3
    bodies = bodies_of(whole.reshape(shape), at.reshape(shape) - centre[:, None])
    tables: list[F32] = []
    for nodes in reversed(levels):
        above = tree.node[nodes, :3]
        if len(above) < len(centre):
            bodies, centre = joined(bodies, centre - np.repeat(above, 2, axis=0)), above
        flat = np.linalg.norm(tree.facing[nodes], axis=1) >= FLAT * tree.power[nodes]
        bent = np.flatnonzero(~flat & (tree.power[nodes] > 0.0))
        tree.table[nodes[bent]] = sum(map(len, tables)) + ROWS * np.arange(len(bent))
        tables.append(tables_of(bodies[bent]))
    return tree._replace(tables=np.concatenate(tables))


def _axes(corner: F64, middle: F64) -> F64:
    """As `GlowTree.corner`."""
    axes: F64 = np.stack([middle, corner[:, 0] - middle, (corner[:, 1] - corner[:, 2]) / math.sqrt(3.0)], axis=1)
    return np.ascontiguousarray(axes)


def _order(middle: F64, normal: F64) -> NDArray[np.int64]:
    """Along Morton's curve through normals and places: what is flat and near stands together."""
    low, size = middle.min(axis=0), max(float(np.ptp(middle, axis=0).max()), 1e-30)
    return by_halves(np.column_stack([(normal + 1.0) / 2.0, (middle - low) / size]))


def _one(trees: list[GlowTree], starts: NDArray[np.int64]) -> GlowTree:
    """All trees in one table."""
    if not trees:
        return no_glow()
    triangles = np.cumsum([0, *(len(tree.corner) for tree in trees)])[:-1]
    tables = np.cumsum([0, *(len(tree.tables) for tree in trees)])[:-1]
    moved = [
        tree._replace(
            right=np.where(tree.right > 0, tree.right + start, 0).astype(np.int32),
            after=(tree.after + start).astype(np.int32),
            triangle=np.where(tree.triangle >= 0, tree.triangle + first, -1).astype(np.int32),
            table=np.where(tree.table >= 0, tree.table + before, -1).astype(np.int32),
        )
        for tree, start, first, before in zip(trees, starts, triangles, tables, strict=True)
    ]
    columns: list[Any] = [np.concatenate(column) for column in zip(*moved, strict=True)]
    return GlowTree(*columns)
