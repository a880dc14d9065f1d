"""Marching a cube's own distances: where a ray that starts anywhere meets what the picture shows.

A face of a cube is a picture with a depth for each texel. In it a ray is a straight line, and a plane is affine in
1 / depth; so between texel centres 1 / depth is interpolated, and the ray is followed from cell to cell, a cell being
the square between four centres. It meets a surface where it comes to lie behind it. Where the surface seen ends and a
farther one begins, cells are *torn*: nothing is there to be met, and a ray that comes out of one behind the surface has
gone where the capture point does not see. If it comes back out of a torn cell nothing was in its way; if it comes back
through a surface, it has been in the body behind that, and has met a side of it that is not seen.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.arrays import F32_1D, F64_2D, I64_1D, U8_1D
from ..kernels.compile import inlined
from ..kernels.vec import Vec, along, dot, length, sub
from .faces import CUBE, direction_face, face_direction
from .volumes import INFINITE_DISTANCE

_TEAR = 0.1
"""Part of the depth by which it may change from texel to texel before a change is looked at as the end of a surface."""
_STEEPER = 2.0
"""A surface seen at a slant changes by much everywhere; its end, by this times what it changes by on both sides."""
_SLACK = 0.02
"""Part of the depth by which a ray may start behind the surface that it starts on: what texels misplace."""
_INSIDE = 1e-7  # part of a stretch after which a ray is safely in the cell that it starts in
_ROUNDING = 1e-9  # part of the distance within which two borders are crossed at once
_BEYOND = 1.001  # times the farthest distance there is nothing
_STARTS, _FRONT, _BEHIND, _MEETS, _LOST = 0, 1, 2, 3, 4
"""What has become of a ray: nothing yet, before what is seen, behind it, met, or come through a surface from behind"""


class Depths(NamedTuple):
    """The distances of those cubes that march."""

    inverse: F32_1D
    """1 / depth along the face's axis at texel centres, faces of (n + 2)^2, borders too; 0: nothing is met [1/m]"""
    torn: U8_1D
    """1 for a cell between centres of two surfaces: cell (x, y), at the place of the centre left above it"""
    first: I64_1D
    """shape (K,): offset of each cube in both; -1 for one that does not march"""
    nearest: F64_2D
    """shape (K, 2): least and largest distance of anything [m]"""


class Meets(NamedTuple):
    """Where a ray meets what a cube shows. It lives as long as the query."""

    known: bool
    """False: it ends where the capture point does not see"""
    distance: float
    """along the ray [m]; `INFINITE_DISTANCE` where it meets nothing"""


def empty_depths(sides: list[int], marches: list[bool]) -> Depths:
    """Room for the distances of cubes of these sides [texels], for those that march."""
    first, total = [], 0
    for n, wanted in zip(sides, marches, strict=True):
        first.append(total if wanted else -1)
        total += CUBE * (n + 2) ** 2 * wanted
    return Depths(
        np.zeros(total, np.float32), np.zeros(total, np.uint8), np.array(first, np.int64), np.zeros((len(sides), 2))
    )


def fill_depths(depths: Depths, k: int, texels: NDArray[np.float32]) -> None:
    """Take over the distances of cube `k` from its level 0 with borders, shape (6, n + 2, n + 2, TEXEL)."""
    share, summed = texels[..., 3].astype(np.float64), texels[..., 4].astype(np.float64)
    met = (summed > 0.0) & (share > 0.0)
    distance = np.divide(summed, share, out=np.zeros_like(summed), where=met)
    stride = texels.shape[1]
    centre = (np.arange(stride) - 0.5) / (stride - 2) * 2.0 - 1.0
    slant = np.sqrt(1.0 + centre[:, None] ** 2 + centre[None, :] ** 2)
    inverse = np.divide(slant, distance, out=np.zeros_like(distance), where=met)
    start, size = int(depths.first[k]), inverse.size
    depths.inverse[start : start + size] = inverse.ravel()
    depths.torn[start : start + size] = _torn(inverse).ravel()
    if met.any():
        depths.nearest[k] = distance[met].min(), distance[met].max()


def _torn(inverse: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Cells that have an edge between two surfaces on one of their sides, or in them; the last of each row are none."""
    across, down = _jumps(inverse), _jumps(inverse.swapaxes(1, 2)).swapaxes(1, 2)
    torn = np.zeros(inverse.shape, bool)
    torn[:, :-1, :-1] = across[:, :-1] | across[:, 1:] | down[:, :, :-1] | down[:, :, 1:]
    return torn


def _jumps(inverse: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Between neighbours along the last axis: not one surface."""
    step = np.abs(np.diff(inverse, axis=2))
    # Where one side has no neighbour within the face, the other side alone says how steep the surface is.
    beside = np.pad(step, ((0, 0), (0, 0), (1, 1)), mode="reflect")
    usual = np.minimum(beside[..., :-2], beside[..., 2:])
    near = np.maximum(inverse[..., 1:], inverse[..., :-1])
    return (step > _TEAR * near) & (step > _STEEPER * usual)


# --- marching -----------------------------------------------------------------------------------------------------


@inlined
def meet_depths(depths: Depths, k: int, side: int, capture: Vec, origin: Vec, d: Vec) -> Meets:
    """Follow a ray along unit `d` through cube `k` of `side` texels, which was taken at `capture`."""
    q = sub(origin, capture)
    away, b = length(q), dot(q, d)
    last = away + depths.nearest[k, 1] * _BEYOND
    # Within the sphere that nothing reaches into there is nothing to be met, and angles change fast: it is left out.
    radius = depths.nearest[k, 0] / _BEYOND
    root = b * b - away * away + radius * radius
    enters, leaves = last, last
    if root > 0.0:
        enters, leaves = -b - math.sqrt(root), -b + math.sqrt(root)
        if leaves <= 0.0:
            enters, leaves = last, last
    state, s = _STARTS, 0.0
    if enters > 0.0:
        state, s = _march(depths, k, side, q, d, 0.0, enters, state)
    if state < _MEETS and leaves < last:
        state, s = _march(depths, k, side, q, d, max(leaves, 0.0), last, _FRONT)
    if state >= _MEETS:
        return Meets(state == _MEETS, s)
    face, x, y = direction_face(d)
    ix, iy = min(int((x + 1.0) * 0.5 * side), side - 1) + 1, min(int((y + 1.0) * 0.5 * side), side - 1) + 1
    stride = side + 2
    open_there = depths.inverse[depths.first[k] + (face * stride + iy) * stride + ix] <= 0.0
    return Meets(open_there, INFINITE_DISTANCE)


@inlined
def _in_face(face: int, v: Vec) -> Vec:
    """A vector in the frame of a face: its x, its y, and the axis that it looks along (`faces.face_direction`)."""
    if face == 0:
        return (-v[2], -v[1], v[0])
    if face == 1:
        return (v[2], -v[1], -v[0])
    if face == 2:
        return (v[0], v[2], v[1])
    if face == 3:
        return (v[0], -v[2], -v[1])
    if face == 4:
        return (v[0], -v[1], v[2])
    return (-v[0], -v[1], -v[2])


@inlined
def _march(
    depths: Depths, k: int, side: int, q: Vec, d: Vec, start: float, end: float, state: int
) -> tuple[int, float]:
    """Follow a ray from one distance to another, face by face. Returns what it has come to, and at which distance."""
    s = start
    face, _, _ = direction_face(along(q, d, s + _INSIDE * (end - s)))
    for _ in range(2 * CUBE):
        o, v = _in_face(face, q), _in_face(face, d)
        # The ray leaves the face where the first of |x| and |y| grows to its depth.
        leave, beyond_x, beyond_y = end, 0.0, 0.0
        for axis in range(2):
            for sign in (-1.0, 1.0):
                closing = sign * v[axis] - v[2]
                if closing > 0.0:
                    crossing = (o[2] - sign * o[axis]) / closing
                    if crossing < leave:
                        leave = max(crossing, s)
                        beyond_x, beyond_y = (1.5 * sign, 0.0) if axis == 0 else (0.0, 1.5 * sign)
        state, met = _march_face(depths, depths.first[k] + face * (side + 2) ** 2, side, o, v, s, leave, state)
        if state >= _MEETS:
            return state, met
        s = leave
        if s >= end:
            break
        face, _, _ = direction_face(face_direction(face, beyond_x, beyond_y))
    return state, s


@inlined
def _march_face(
    depths: Depths, first: int, side: int, o: Vec, v: Vec, start: float, end: float, state: int
) -> tuple[int, float]:
    """Follow a ray through one face, cell by cell; `o` and `v` are in its frame."""
    # Texel coordinates, homogeneous: (ax + s bx) / (o.z + s v.z). Centres lie at whole numbers, the border's at 0.
    half = 0.5 * side
    ax, bx = half * (o[0] + o[2]) + 0.5 * o[2], half * (v[0] + v[2]) + 0.5 * v[2]
    ay, by = half * (o[1] + o[2]) + 0.5 * o[2], half * (v[1] + v[2]) + 0.5 * v[2]
    # The derivative of a quotient keeps its sign, so columns, and rows, are crossed in one direction only.
    right = 1 if bx * o[2] - ax * v[2] > 0.0 else 0
    down = 1 if by * o[2] - ay * v[2] > 0.0 else 0
    s = start
    inside = s + _INSIDE * (end - s)
    z = o[2] + inside * v[2]
    if z <= 0.0:
        return state, end
    ix = min(max(int((ax + inside * bx) / z), 0), side)
    iy = min(max(int((ay + inside * by) / z), 0), side)
    for _ in range(2 * side + 4):
        sx = _crossing(ix + right, ax, bx, o[2], v[2], s)
        sy = _crossing(iy + down, ay, by, o[2], v[2], s)
        to = min(min(sx, sy), end)
        cell = first + iy * (side + 2) + ix
        if depths.torn[cell] != 0:
            if state != _STARTS:
                state = _BEHIND  # until it is seen in front of something again
        else:
            a = _excess(depths, cell, side, ix, iy, ax + s * bx, ay + s * by, o[2] + s * v[2])
            b = _excess(depths, cell, side, ix, iy, ax + to * bx, ay + to * by, o[2] + to * v[2])
            if a <= 0.0 or (state == _STARTS and a < _SLACK):
                state = _FRONT
            if state != _FRONT and b <= 0.0:
                return _LOST, to
            if state == _FRONT and b > 0.0 and b > a:
                return _MEETS, s + (to - s) * max(0.0, -a / (b - a))
            if state == _STARTS:
                state = _BEHIND
        if to >= end:
            break
        if sx <= sy:
            ix += 1 if right != 0 else -1
        if sy <= sx:
            iy += 1 if down != 0 else -1
        if ix < 0 or iy < 0 or ix > side or iy > side:
            break
        s = to
    return state, end


@inlined
def _crossing(line: int, a: float, b: float, z: float, dz: float, s: float) -> float:
    """Distance from `s` on at which texel coordinate (a + s b) / (z + s dz) reaches `line`; inf if it never does."""
    slope = b - line * dz
    if slope == 0.0:
        return math.inf
    at = (line * z - a) / slope
    if at < s:
        return s if at > s - _ROUNDING * (1.0 + s) else math.inf
    return at


@inlined
def _excess(depths: Depths, cell: int, side: int, ix: int, iy: int, x: float, y: float, z: float) -> float:
    """Depth of a place over the depth of the surface seen there, less 1: above 0 behind it. `x` and `y` are texel
    coordinates times depth `z`. Along a ray that is linear where the surface is a plane."""
    if z <= 0.0:
        return -1.0
    fx, fy = min(max(x / z - ix, 0.0), 1.0), min(max(y / z - iy, 0.0), 1.0)
    pool, below = depths.inverse, cell + side + 2
    above = pool[cell] * (1.0 - fx) + pool[cell + 1] * fx
    under = pool[below] * (1.0 - fx) + pool[below + 1] * fx
    return z * (above * (1.0 - fy) + under * fy) - 1.0
