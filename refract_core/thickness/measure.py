"""How thick glass is, measured in its own geometry: rays from places on its surface to the far side of the same object.

    normal      along -N, as glTF means a thickness (KHR_materials_volume): the distance to the far side.
    refracted   along the refracted rays of views from all sides, even in projected area. A path of length L under the
                angle t asks of the sphere model for a thickness of L / cos t, of the box model for L cos t; taken is
                the thickness with which the model's paths differ least from the real ones (least squares): with the
                model's path f through unit thickness (cos t, or 1 / cos t), sum(L f) / sum(f^2). A view along -N
                alone would give what `normal` gives.

The far side is the next surface the ray meets, hence in a hollow body the wall of the hollow.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.arrays import F32_2D, F64_2D, I64_1D, U32_2D
from ..kernels.compile import inlined, kernel
from ..kernels.lanes import LANES, Scalars, by_address, scratch
from ..kernels.vec import Vec, add, along, cross, dot, frame, normalize, row, scale, sub
from ..world.embree import (
    DIR_X,
    DIR_Y,
    DIR_Z,
    EVERYTHING,
    GEOM,
    NG_X,
    NG_Y,
    NG_Z,
    REFRACTIVE,
    SCATTERED,
    T_FAR,
    Bvh,
    Packet,
    Part,
    clear,
    intersect,
    set_ray,
)

F64 = NDArray[np.float64]
U32 = NDArray[np.uint32]
Index = NDArray[np.int64]

VIEWS = 16
"""Rays per place along `refracted`."""
CORNER = 1.0e-3
"""Part of the way to a triangle's middle at which a hard corner is measured: on the edge itself a ray would graze."""
ALIKE = 1.0e-3
"""Normals at a point that differ less in every coordinate are one."""

_START = 1.0e-5  # how far under the surface a ray starts, against half the diagonal of the object
_GRAZING = 0.02  # cosine under which a ray along a shading normal would leave through the face it starts from
_CHUNK = 1 << 15  # rays of one piece of work
_ATTEMPTS = np.array([0.0, 0.02, 0.2])  # how far towards a triangle's middle a ray starts until it finds a far side
_TURN = math.pi * (3.0 - math.sqrt(5.0))
_ROUNDS = 8
_LEVELS = 2001  # quantised values of a normal's coordinate


class Places(NamedTuple):
    """Where to measure: on triangles, with the normal that holds there."""

    triangle: I64_1D
    """shape (N,)"""
    weights: F64_2D
    """shape (N, 2): barycentric weights of the triangle's second and third corner"""
    normals: F64_2D
    """shape (N, 3): unit, outward"""


class Body(NamedTuple):
    """One object by itself, moved to the origin and scaled to half a diagonal of 1; for the length of a `measure`."""

    handle: int
    """RTCScene"""
    points: F32_2D
    """shape (V, 3), what Embree was given"""
    triangles: U32_2D
    """shape (T, 3)"""


class Casting(NamedTuple):
    """What one thread needs to cast eight rays. Nothing in it outlives them."""

    packet: Packet
    lead: Scalars
    """how far along the ray from its place it starts, > 0; below 0 once the lane has its answer"""


def views(model_is_box: bool, ior: float, method: str) -> F64:
    """Rays of each place.

    Args:
        method: `normal` or `refracted`.

    Returns:
        Shape (R, 4): unit direction in a frame whose third axis is -N, and the model's path through unit thickness.
    """
    if method == "normal":
        return np.array([[0.0, 0.0, 1.0, 1.0]])
    number = np.arange(VIEWS)
    sin_t = np.sqrt((number + 0.5) / VIEWS) / max(ior, 1.0)
    cos_t = np.sqrt(1.0 - sin_t**2)
    path = 1.0 / cos_t if model_is_box else cos_t
    return np.stack((sin_t * np.cos(_TURN * number), sin_t * np.sin(_TURN * number), cos_t, path), axis=1)


# --- where


def corner_places(triangles: U32, normals: F64) -> tuple[Places, Index]:
    """One place for every point with one normal, one for every normal of a point that has several.

    Args:
        triangles: shape (T, 3).
        normals: shape (T, 3, 3): unit, per triangle corner.

    Returns:
        The places, and shape (T, 3): the place of each triangle corner.
    """
    points, flat = triangles.reshape(-1).astype(np.int64), normals.reshape(-1, 3)
    first = np.full(int(points.max()) + 1, -1, np.int64)
    first[points[::-1]] = np.arange(len(points))[::-1]
    hard = np.zeros(len(first), bool)
    hard[points[np.abs(flat - flat[first[points]]).max(axis=1) > ALIKE]] = True
    if not hard.any() and first.min() >= 0:
        start, picks = first, points
    else:
        code = np.zeros(len(points), np.int64)
        split = hard[points]
        steps = np.rint((flat[split] + 1.0) * ((_LEVELS - 1) / 2)).astype(np.int64)
        code[split] = 1 + (steps[:, 0] * _LEVELS + steps[:, 1]) * _LEVELS + steps[:, 2]
        _, start, picks = np.unique((points << 34) | code, return_index=True, return_inverse=True)
    corner = start % 3
    weights = np.stack((corner == 1, corner == 2), axis=1).astype(np.float64)
    weights += np.where(hard[points[start]], CORNER, 0.0)[:, None] * (1.0 / 3.0 - weights)
    return Places(start // 3, weights, flat[start]), picks.reshape(-1, 3)


def middle_places(normals: F64) -> Places:
    """The middle of every triangle. `normals`: shape (T, 3, 3)."""
    middle = normals.mean(axis=1)
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-12)
    return Places(np.arange(len(normals)), np.full((len(normals), 2), 1.0 / 3.0), middle)


# --- how thick


def measure(
    points: F64,
    triangles: U32,
    places: Places,
    rays: F64,
    *,
    jobs: int = 0,
    go_on: Callable[[], None] = lambda: None,
) -> F64:
    """Thickness at every place, shape (N,), in the unit of the points; NaN where no far side was found.

    Args:
        points: shape (V, 3).
        triangles: shape (T, 3), counter-clockwise seen from outside.
        rays: as `views` gives them.
        jobs: threads; 0 means all cores.
        go_on: called now and then; what it raises ends the work.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    size = float(np.linalg.norm(high - low)) / 2.0 or 1.0
    near = ((points - (low + high) / 2.0) / size).astype(np.float32)  # float32 is finest about the origin
    triangles = np.ascontiguousarray(triangles, np.uint32)
    bvh = Bvh(near, [Part(int(REFRACTIVE), triangles)])
    body, where = by_address(Body(bvh.handle, near, triangles)), by_address(places)
    sums = np.zeros((len(places.triangle), 2))
    step = max(_CHUNK // len(rays), 1)
    pieces = [(start, min(start + step, len(sums))) for start in range(0, len(sums), step)]

    def work(piece: tuple[int, int]) -> None:
        go_on()
        _measure(scratch(Casting), body, where, rays, sums, *piece)

    threads = min(jobs or os.cpu_count() or 1, len(pieces))
    if threads > 1:
        with ThreadPoolExecutor(threads) as pool:
            for done in [pool.submit(work, piece) for piece in pieces]:
                done.result()
    else:
        for piece in pieces:
            work(piece)
    bvh.close()
    return np.divide(sums[:, 0] * size, sums[:, 1], out=np.full(len(sums), np.nan), where=sums[:, 1] > 0.0)


def mended(values: F64, picks: Index) -> F64:
    """Places without a value (NaN) take the mean of those they share triangles with, at last that of all.

    Args:
        values: shape (N,), not all NaN.
        picks: shape (T, 3), the place of each triangle corner.
    """
    values = values.copy()
    for _ in range(_ROUNDS):
        lost = ~np.isfinite(values)
        if not lost.any():
            return values
        around = picks[lost[picks].any(axis=1)]
        known = ~lost[around]
        total = np.where(known, values[around], 0.0).sum(axis=1)
        sums = np.bincount(around.ravel(), np.repeat(total, 3), len(values))
        counts = np.bincount(around.ravel(), np.repeat(known.sum(axis=1), 3), len(values))
        near = lost & (counts > 0)
        values[near] = sums[near] / counts[near]
        if not near.any():
            break
    return np.where(np.isfinite(values), values, np.nanmean(values))


# --- kernels


@inlined
def _place(body: Body, places: Places, i: int, pull: float) -> tuple[Vec, Vec]:
    """Place `i`, pulled a part of the way towards its triangle's middle, and the triangle's unit normal."""
    t = places.triangle[i]
    a = row(body.points, body.triangles[t, 0])
    b = row(body.points, body.triangles[t, 1])
    c = row(body.points, body.triangles[t, 2])
    ab, ac = sub(b, a), sub(c, a)
    second, third = places.weights[i, 0], places.weights[i, 1]
    second += pull * (1.0 / 3.0 - second)
    third += pull * (1.0 / 3.0 - third)
    return along(along(a, ab, second), ac, third), normalize(cross(ab, ac))


@inlined
def _turned(view: Vec, axis: Vec) -> Vec:
    """A view's direction in the world, `axis` being its third one."""
    t, b = frame(axis)
    return add(add(scale(t, view[0]), scale(b, view[1])), scale(axis, view[2]))


@inlined
def _cast(casting: Casting, lane: int, body: Body, places: Places, i: int, view: Vec, pull: float) -> None:
    """Put the ray of a view into place `i` into a lane."""
    p, ng = _place(body, places, i, pull)
    n = row(places.normals, i)
    if dot(ng, ng) == 0.0:  # a sliver that float32 made a line
        ng = n
    d = _turned(view, scale(n, -1.0))
    if dot(d, ng) > -_GRAZING:  # a steep shading normal must not send the ray out
        d = _turned(view, scale(ng, -1.0))
    # The ray starts under the surface by the same depth whatever its slant, and its length is counted from the place.
    casting.lead[lane] = -_START / dot(d, ng)
    set_ray(casting.packet, lane, along(p, d, casting.lead[lane]), d, 0.0, math.inf, EVERYTHING)


@kernel
def _measure(casting: Casting, body: Body, places: Places, rays: F64_2D, sums: F64_2D, first: int, last: int) -> None:
    """Cast the rays of the places `first` .. `last`; `sums` (N, 2) takes length times model path, and its square.

    Lanes are rays, not places: eight of them in a row, whichever place each belongs to.
    """
    packet, lead = casting.packet, casting.lead
    count = len(rays)
    for start in range(first * count, last * count, LANES):
        for lane in range(LANES):
            lead[lane] = 0.0
        for attempt in range(len(_ATTEMPTS)):
            clear(packet)
            for lane in range(LANES):
                ray = start + lane
                if ray < last * count and lead[lane] >= 0.0:
                    _cast(casting, lane, body, places, ray // count, row(rays, ray % count), _ATTEMPTS[attempt])
            intersect(packet, body.handle, SCATTERED)
            again = False
            for lane in range(LANES):
                if packet.valid[lane] == 0:
                    continue
                # At the last attempt a surface met from outside will do: it is there, and nothing better is.
                if _leaves(packet, lane) or (attempt == len(_ATTEMPTS) - 1 and packet.words[GEOM, lane] >= 0):
                    ray = start + lane
                    path = rays[ray % count, 3]
                    # Least squares of thickness * path = length, over the rays of a place.
                    sums[ray // count, 0] += (packet.rays[T_FAR, lane] + lead[lane]) * path
                    sums[ray // count, 1] += path * path
                    lead[lane] = -1.0
                else:
                    again = True
            if not again:
                break


@inlined
def _leaves(packet: Packet, lane: int) -> bool:
    """The lane's ray met a surface from within. A hit from outside means that it started on the wrong side."""
    if packet.words[GEOM, lane] < 0:
        return False
    rays = packet.rays
    d = (float(rays[DIR_X, lane]), float(rays[DIR_Y, lane]), float(rays[DIR_Z, lane]))
    return dot(d, (float(rays[NG_X, lane]), float(rays[NG_Y, lane]), float(rays[NG_Z, lane]))) > 0.0
