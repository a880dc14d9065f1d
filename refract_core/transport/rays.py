"""Rays of the tree: what one carries from interface to interface, and the media it is in.

A record holds many, row by row. `now` in the other rooms of this wing is such a record of eight, the rays of a packet.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.arrays import F64_1D, F64_2D, F64_3D, I32_1D, I32_2D
from ..kernels.compile import inlined
from ..kernels.lanes import put
from ..kernels.vec import Vec, mul, row
from ..optics.interface import channel_iors, transmittance

MOST_MEDIA = 6
"""Bodies that a ray may be in at once."""
AIR = -1
"""The slot of a medium that is none."""
ALL_CHANNELS = -1
MOST_MET = 128
"""Pieces of glass that a ray may meet before it is lost."""
OUT_OF_BODY = 2
"""A ray is on an inner stretch, and behind the wall of the real body."""

# Sides: how a ray came to be.
VIEW, THROUGH_SIDE, MIRRORED_SIDE = 0, 1, 2


class Media(NamedTuple):
    """The bodies that rays are in, in the order entered; shape (N, 6) each. What fills the space there is the one of
    the highest priority, of equals the last."""

    depth: I32_1D
    """shape (N,): how many"""
    thing: I32_2D
    priority: I32_2D
    """as `refraction:priority`"""
    ior: F64_2D
    """authored, >= 1"""
    abbe: F64_2D
    """0: no dispersion"""
    color: F64_3D
    """shape (N, 6, 3): transmittance colour"""
    distance: F64_2D
    """over which white light becomes `color` [m]"""


class Rays(NamedTuple):
    """N rays. Lengths along a ray are from its origin [m]."""

    origin: F64_2D
    """shape (N, 3) [m]"""
    direction: F64_2D
    """shape (N, 3), unit"""
    start: F64_1D
    """where it begins to look"""
    begun: F64_1D
    """where the stretch begins that has not been absorbed along yet"""
    end: F64_1D
    """where it stops looking: inf, the far plane, or the length of an inner stretch"""
    weight: F64_2D
    """shape (N, 3): share of the pixel's light that comes this way"""
    clear: F64_2D
    """shape (N, 3): the same, had nothing been absorbed"""
    normal: F64_2D
    """shape (N, 3): of the surface it last entered, on the side it came from"""
    blur: F64_1D
    """tangent of the half angle of its cone"""
    roughness: F64_1D
    """perceptual, the largest on its way"""
    path: F64_1D
    """its way inside media so far [m]"""
    travelled: F64_1D
    """its way from the eye to its origin [m]; what it sees of a texture is as wide as its cone is by then"""
    inner: I32_1D
    """1 on the inner stretch of a model, from its entry to its exit; OUT_OF_BODY once it has passed the real wall"""
    leave_point: F64_2D
    """shape (N, 3): where an inner stretch ends [m]; this and the next are of no use elsewhere"""
    leave_direction: F64_2D
    """shape (N, 3): and which way the ray goes on from there"""
    pixel: I32_1D
    """within its cell"""
    branch: I32_1D
    """of the sampling sequence"""
    way: I32_1D
    """a number for the surfaces it came by, and how it left each"""
    channel: I32_1D
    """ALL_CHANNELS, or the one that it is left with after dispersion"""
    side: I32_1D
    """VIEW, THROUGH_SIDE or MIRRORED_SIDE"""
    thing: I32_1D
    """that it last entered; -1 for none"""
    entered: I32_1D
    """surfaces that it has entered"""
    met: I32_1D
    """pieces of glass that it has met, passed ones too"""
    lamps: I32_1D
    """1 where it sees lamps: it has been mirrored inside of glass, and since then by no outside, whose highlights are
    the lamps' mirror pictures already"""
    mirrored: I32_1D
    """1 where any surface has mirrored it"""
    media: Media


def new_rays(count: int) -> Rays:
    """Rows of zeros."""

    def numbers(*shape: int) -> NDArray[np.float64]:
        return np.zeros((count, *shape))

    def words(*shape: int) -> NDArray[np.int32]:
        return np.zeros((count, *shape), np.int32)

    media = Media(
        words(), words(MOST_MEDIA), words(MOST_MEDIA), numbers(MOST_MEDIA), numbers(MOST_MEDIA),
        numbers(MOST_MEDIA, 3), numbers(MOST_MEDIA),
    )  # fmt: skip
    vectors = ("origin", "direction", "weight", "clear", "normal", "leave_point", "leave_direction")
    lengths = ("start", "begun", "end", "blur", "roughness", "path", "travelled")
    fields = {name: numbers(3) for name in vectors} | {name: numbers() for name in lengths}
    made: list[Any] = [fields[name] if name in fields else words() for name in Rays._fields[:-1]]
    return Rays._make([*made, media])


def ray_in_air() -> Rays:
    """One row: a ray of the whole light in air, without place or direction."""
    ray = new_rays(1)
    ray.weight[:] = ray.clear[:] = 1.0
    ray.end[:] = math.inf
    ray.channel[:], ray.side[:], ray.thing[:] = ALL_CHANNELS, VIEW, -1
    return ray


@inlined
def copy_ray(to: Rays, i: int, rays: Rays, j: int) -> None:
    """Row `j` into row `i` of another record."""
    for c in range(3):
        to.origin[i, c] = rays.origin[j, c]
        to.direction[i, c] = rays.direction[j, c]
        to.weight[i, c] = rays.weight[j, c]
        to.clear[i, c] = rays.clear[j, c]
        to.normal[i, c] = rays.normal[j, c]
    if rays.inner[j] != 0:
        put(to.leave_point, i, row(rays.leave_point, j))
        put(to.leave_direction, i, row(rays.leave_direction, j))
    to.start[i], to.begun[i], to.end[i] = rays.start[j], rays.begun[j], rays.end[j]
    to.blur[i], to.roughness[i], to.path[i] = rays.blur[j], rays.roughness[j], rays.path[j]
    to.travelled[i] = rays.travelled[j]
    to.inner[i], to.pixel[i], to.branch[i] = rays.inner[j], rays.pixel[j], rays.branch[j]
    to.way[i] = rays.way[j]
    to.channel[i], to.side[i], to.thing[i] = rays.channel[j], rays.side[j], rays.thing[j]
    to.entered[i], to.met[i], to.lamps[i] = rays.entered[j], rays.met[j], rays.lamps[j]
    to.mirrored[i] = rays.mirrored[j]
    to.media.depth[i] = rays.media.depth[j]
    for k in range(rays.media.depth[j]):
        _copy_medium(to.media, i, k, rays.media, j, k)


@inlined
def _copy_medium(to: Media, i: int, k: int, media: Media, j: int, l: int) -> None:  # noqa: E741
    to.thing[i, k], to.priority[i, k] = media.thing[j, l], media.priority[j, l]
    to.ior[i, k], to.abbe[i, k], to.distance[i, k] = media.ior[j, l], media.abbe[j, l], media.distance[j, l]
    for c in range(3):
        to.color[i, k, c] = media.color[j, l, c]


@inlined
def is_lost(rays: Rays, i: int) -> bool:
    """A ray has met too much glass to go on."""
    return bool(rays.met[i] >= MOST_MET)


@inlined
def filling(media: Media, i: int) -> int:
    """The slot of the medium that fills the space around a ray; AIR where it is in none."""
    return filling_without(media, i, AIR)


@inlined
def filling_without(media: Media, i: int, slot: int) -> int:
    """The same once the body in a slot is left."""
    best = AIR
    for k in range(media.depth[i]):
        if k != slot and (best == AIR or media.priority[i, k] >= media.priority[i, best]):
            best = k
    return best


@inlined
def slot_of(media: Media, i: int, thing: int) -> int:
    """Where a ray last entered `thing`; AIR if it is not in it."""
    found = AIR
    for k in range(media.depth[i]):
        if media.thing[i, k] == thing:
            found = k
    return found


@inlined
def channel_ior(ior: float, abbe: float, channel: int) -> float:
    """The index that a channel finds; all channels together take green's, the authored one."""
    red, green, blue = channel_iors(ior, abbe)
    return red if channel == 0 else (blue if channel == 2 else green)


@inlined
def index_in(media: Media, i: int, slot: int, channel: int) -> float:
    """Index of the medium in a slot; 1 of air."""
    return 1.0 if slot == AIR else channel_ior(media.ior[i, slot], media.abbe[i, slot], channel)


@inlined
def abbe_in(media: Media, i: int, slot: int) -> float:
    """Abbe number of the medium in a slot; 0, which is no dispersion, of air."""
    return 0.0 if slot == AIR else media.abbe[i, slot]


@inlined
def add_medium(
    media: Media, i: int, thing: int, priority: int, ior: float, abbe: float, color: Vec, distance: float
) -> None:
    """Enter a body; there must be room."""
    k = media.depth[i]
    media.thing[i, k], media.priority[i, k] = thing, priority
    media.ior[i, k], media.abbe[i, k], media.distance[i, k] = ior, abbe, distance
    put(media.color[i], k, color)
    media.depth[i] = k + 1


@inlined
def drop_medium(media: Media, i: int, slot: int) -> None:
    """Leave the body in a slot."""
    for k in range(slot, media.depth[i] - 1):
        _copy_medium(media, i, k, media, i, k + 1)
    media.depth[i] -= 1


@inlined
def absorb(rays: Rays, i: int, until: float) -> None:
    """Let the medium absorb along a ray, from where that was last done until a distance (Beer-Lambert)."""
    k = filling(rays.media, i)
    if k != AIR:
        length = max(0.0, until - rays.begun[i])
        color = row(rays.media.color[i], k)
        if min(color[0], color[1], color[2]) < 1.0:  # three exponentials that clear glass does not need
            put(rays.weight, i, mul(row(rays.weight, i), transmittance(color, rays.media.distance[i, k], length)))
        rays.path[i] += length
    rays.begun[i] = until
