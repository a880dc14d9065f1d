"""Light that opaque surfaces send each other: irradiance found at places of the world, and what lies between them.

A place speaks for what is around it as far as the things that it sees are away (Ward, Rubinstein and Clear, "A Ray
Tracing Solution for Diffuse Interreflection", SIGGRAPH 1988), by how light changes along the surface and with its
slope (Ward and Heckbert, "Irradiance Gradients", Eurographics Workshop on Rendering 1992). Its word fades to nothing at
the end of its reach (Tabellion and Lamorlette, "An Approximate Global Illumination System for Computer Generated
Films", SIGGRAPH 2004), so that nothing has a seam.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.arrays import F64_1D, F64_2D, F64_3D, I32_1D, I64_1D
from ..kernels.compile import inlined, kernel
from ..kernels.lanes import by_address
from ..kernels.vec import Vec, add, along, cross, dot, row, scale, sub
from .hashing import EMPTY, claim, slot_of

_TURN = math.sqrt(1.0 - math.cos(math.radians(25.0)))
"""Of normals, how far apart they are where the word of a place ends."""
_BUMP = 4.0
"""How much more it counts to be above or below a place than beside it: there, another surface begins."""
_WHISPER = 1e-4
_BITS = 19
"""Of a cell's number along each axis, of which 7 bits are left to a level."""


class Places(NamedTuple):
    """Where light has been found, R of them."""

    point: F64_2D
    """shape (R, 3) [m]"""
    normal: F64_2D
    """shape (R, 3): unit geometric normal, on the side that is lit"""
    reach: F64_1D
    """shape (R,): how far it speaks for others [m]"""
    trust: F64_1D
    """shape (R,): what its word counts beside others', above 0 .. 1; less where it speaks for more than it knows"""
    irradiance: F64_2D
    """shape (R, 3) [radiance * sr]"""
    turn: F64_3D
    """shape (R, 3, 3): colour by colour, how it changes with the normal, about an axis [1/rad]"""
    shift: F64_3D
    """shape (R, 3, 3): colour by colour, how it changes along the surface [1/m]"""


class Bounced(NamedTuple):
    """Places, and a hash table of the cells that they speak in."""

    places: Places
    cell: F64_1D
    """shape (K,): sizes of the cells of each level [m]; none where no light is bounced"""
    keys: I64_1D
    """shape (H,): -1 where a slot is free"""
    first: I32_1D
    """shape (H,): of a cell, where its places begin in `member`"""
    many: I32_1D
    """shape (H,): and how many they are"""
    member: I32_1D


def no_places(count: int = 0) -> Places:
    """Dark ones."""
    rows = (np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count), np.ones(count), np.zeros((count, 3)))
    return Places(*rows, np.zeros((count, 3, 3)), np.zeros((count, 3, 3)))


def no_bounced() -> Bounced:
    """Nothing sends light on."""
    words = (np.zeros(1, np.int32), np.zeros(1, np.int32), np.zeros(0, np.int32))
    return Bounced(no_places(), np.zeros(0), np.full(1, EMPTY, np.int64), *words)


def bounced_of(places: Places) -> Bounced:
    """The table of places. Each is in all cells that its reach touches, at the level whose cells are as wide as that:
    eight at most. So whoever looks has one cell to look at on each level."""
    if not len(places.reach):
        return no_bounced()
    level = np.ceil(np.log2(2.0 * places.reach)).astype(np.int64)
    sizes, which = np.unique(-level, return_inverse=True)
    cell = np.exp2(-sizes.astype(np.float64))
    width = cell[which]
    low = np.floor((places.point - places.reach[:, None]) / width[:, None]).astype(np.int64)
    high = np.floor((places.point + places.reach[:, None]) / width[:, None]).astype(np.int64)
    keys, members = [], []
    for corner in np.ndindex(2, 2, 2):
        there = np.all((np.array(corner) == 0) | (high > low), axis=1)
        at = np.where(np.array(corner) == 1, high, low)[there]
        keys.append(_numbered(which[there], at))
        members.append(np.flatnonzero(there))
    key, member = np.concatenate(keys), np.concatenate(members)
    order = np.lexsort((member, key))
    cells, first, count = np.unique(key[order], return_index=True, return_counts=True)
    slots = 1 << max(4, math.ceil(math.log2(3 * len(cells))))
    words = np.zeros(slots, np.int32), np.zeros(slots, np.int32)
    table = Bounced(places, cell, np.full(slots, EMPTY, np.int64), *words, member[order].astype(np.int32))
    _fill(by_address(table), cells, first.astype(np.int64), count.astype(np.int64))
    return table


@kernel
def _fill(table: Bounced, cells: I64_1D, first: I64_1D, count: I64_1D) -> None:
    for k in range(cells.shape[0]):
        slot, _ = claim(table.keys, cells[k])
        table.first[slot], table.many[slot] = first[k], count[k]


def _numbered(level: NDArray[np.int64], at: NDArray[np.int64]) -> NDArray[np.int64]:
    """As `_key`, of many."""
    most = (1 << _BITS) - 1
    x, y, z = (at & most).T
    return ((level << _BITS | x) << _BITS | y) << _BITS | z


@inlined
def _key(level: int, p: Vec, cell: float) -> int:
    most = (1 << _BITS) - 1
    x = np.int64(math.floor(p[0] / cell)) & most
    y = np.int64(math.floor(p[1] / cell)) & most
    z = np.int64(math.floor(p[2] / cell)) & most
    return int(((np.int64(level) << _BITS | x) << _BITS | y) << _BITS | z)


@inlined
def bounced_light(table: Bounced, p: Vec, ng: Vec, ns: Vec) -> tuple[Vec, float]:
    """Irradiance [radiance * sr] that comes from other surfaces, and how surely that is known. At 0 nobody speaks for
    the place, and it is dark.

    Args:
        p: place on a surface [m].
        ng, ns: its unit geometric and shading normal, on the side that is seen.
    """
    light, weights, total = (0.0, 0.0, 0.0), 0.0, 0.0
    for level in range(table.cell.shape[0]):
        slot = slot_of(table.keys, _key(level, p, table.cell[level]))
        if table.keys[slot] == EMPTY:
            continue
        for k in range(table.first[slot], table.first[slot] + table.many[slot]):
            i = table.member[k]
            word = _word_of(table.places, i, p, ng)
            if word > 0.0:
                weight = word * table.places.trust[i]
                light = along(light, _seen_from(table.places, i, p, ns), weight)
                weights += weight
                total += word
    return (scale(light, 1.0 / weights) if weights > 0.0 else light), total


@inlined
def _word_of(places: Places, i: int, p: Vec, ng: Vec) -> float:
    """How much a place has to say about another, 1 at itself and next to nothing from the end of its reach on: that
    counts where nobody else speaks."""
    n = row(places.normal, i)
    away = sub(p, row(places.point, i))
    above = _BUMP * dot(away, n)
    far = math.sqrt(dot(away, away) + above * above) / places.reach[i]
    turned = math.sqrt(max(0.0, 1.0 - dot(n, ng))) / _TURN
    return max(0.0, 1.0 - max(far, turned)) + max(0.0, _WHISPER * (1.0 - max(far / 4.0, turned / 2.0)))


@inlined
def _seen_from(places: Places, i: int, p: Vec, ns: Vec) -> Vec:
    """The irradiance of a place, carried to another on a surface that looks along `ns`."""
    axis, away = cross(row(places.normal, i), ns), sub(p, row(places.point, i))
    e = row(places.irradiance, i)
    for_turn = (dot(axis, row(places.turn[i], 0)), dot(axis, row(places.turn[i], 1)), dot(axis, row(places.turn[i], 2)))
    for_shift = (
        dot(away, row(places.shift[i], 0)), dot(away, row(places.shift[i], 1)), dot(away, row(places.shift[i], 2)),
    )  # fmt: skip
    e = add(e, add(for_turn, for_shift))
    return (max(0.0, e[0]), max(0.0, e[1]), max(0.0, e[2]))


@kernel
def certainty(table: Bounced, point: F64_2D, normal: F64_2D, first: int, last: int, known: F64_1D) -> None:
    """Fill how surely light is known at places: what `bounced_light` says of rows `first` to before `last`."""
    for k in range(first, last):
        n = row(normal, k)
        known[k] = bounced_light(table, row(point, k), n, n)[1]
