"""What the leaves of a view ray were answered, kept apart so that neighbours can be compared.

A leaf's light is taken to pieces: what its surface is like (emission and albedo, which a texture may vary), the light
that falls on it, and the rest. `corners` puts them together again, with the texture as a pixel sees it.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ..kernels.arrays import F64_1D, F64_2D, I32_1D
from ..kernels.compile import inlined
from ..kernels.lanes import put
from ..kernels.sampling import hash32
from ..kernels.vec import Vec, flip_towards, mul, row, scale
from ..world.surface import NOTHING, HitLanes, Interaction, Ray, interaction, keep_hit, kept_hit, surface_of
from ..world.tables import World
from .rays import THROUGH_SIDE, VIEW, Rays
from .tiers import Query

MOST_ANSWERS = 32
"""That are kept of one view ray."""
_NO_SURFACE = -1


class Answers(NamedTuple):
    """The leaves of N view rays. Those of slot i stand in rows 32 i and after; R = 32 N."""

    on: I32_1D
    """shape (1,): 1 while they are kept"""
    filled: I32_1D
    """shape (N,): how many there are; more than 32 where some were not kept"""
    way: I32_1D
    """shape (R,): a number for the way to the leaf and the part that it meets, by which neighbours match"""
    side: I32_1D
    """shape (R,): VIEW, THROUGH_SIDE or MIRRORED_SIDE"""
    hits: HitLanes
    """shape (R,) each"""
    share: F64_1D
    """shape (R,): weight of the surface in the light: 1, or less where a probe has answered first; 0 where all of it is
    `rest`"""
    wide: F64_1D
    """shape (R,): of the cone over which emission and albedo are filtered, where it ends [m]"""
    weight: F64_2D
    """shape (R, 3)"""
    point: F64_2D
    """shape (R, 3): where it ends [m]"""
    direction: F64_2D
    """shape (R, 3): unit, of the ray that ends there"""
    normal: F64_2D
    """shape (R, 3): unit, geometric, on the ray's side"""
    emissive: F64_2D
    """shape (R, 3): radiance; this and the next filtered over the cone of the view ray"""
    albedo: F64_2D
    """shape (R, 3)"""
    irradiance: F64_2D
    """shape (R, 3)"""
    rest: F64_2D
    """shape (R, 3): radiance that is neither emitted nor diffuse, or whose origin is not known"""


def new_answers(slots: int) -> Answers:
    """Rows of zeros."""
    rows = slots * MOST_ANSWERS
    kinds: list[Any] = [np.int32] * 4 + [np.float64] * 3
    hits = HitLanes(*(np.zeros(rows, kind) for kind in kinds))
    made: list[Any] = [np.zeros(1, np.int32), np.zeros(slots, np.int32)]
    made += [np.zeros(rows, np.int32), np.zeros(rows, np.int32), hits, np.zeros(rows), np.zeros(rows)]
    return Answers._make(made + [np.zeros((rows, 3)) for _ in range(8)])


@inlined
def keep_answers(answers: Answers, keep: bool) -> None:
    """Whether they are wanted from now on."""
    answers.on[0] = 1 if keep else 0


@inlined
def _new_row(answers: Answers, slot: int) -> int:
    """The next row of a slot; -1 if it is full."""
    k = answers.filled[slot]
    answers.filled[slot] = min(k + 1, MOST_ANSWERS + 1)
    return slot * MOST_ANSWERS + k if k < MOST_ANSWERS else -1


@inlined
def way_to(leaves: Rays, k: int, query: Query, lane: int, world: World) -> int:
    """A number for the way to leaf `k` and the surface that it meets."""
    hit = kept_hit(query.met, lane)
    what = surface_of(world.geometry, hit) if query.blur[lane] <= 0.0 and hit.part != NOTHING else NOTHING
    return int(np.int32(hash32(leaves.way[k], what, 0)))


@inlined
def add_answer(answers: Answers, slot: int, leaves: Rays, k: int, query: Query, lane: int, world: World) -> None:
    """Keep what leaf `k` was answered in a lane."""
    if answers.on[0] == 0:
        return
    r = _new_row(answers, slot)
    if r < 0:
        return
    hit = kept_hit(query.met, lane)
    keep_hit(answers.hits, r, hit)
    d = row(leaves.direction, k)
    sharp = query.blur[lane] <= 0.0  # the ray in the middle of a cone says nothing about the rest of it
    answers.way[r] = way_to(leaves, k, query, lane, world)
    answers.side[r] = max(THROUGH_SIDE, leaves.side[k])  # what an eye in glass sees has come through, too
    put(answers.weight, r, row(leaves.weight, k))
    put(answers.direction, r, d)
    put(answers.point, r, d)
    put(answers.normal, r, d)
    if sharp and hit.part != NOTHING:
        at = interaction(world.geometry, hit, Ray(row(leaves.origin, k), d), 0.0)
        put(answers.point, r, at.point)
        put(answers.normal, r, flip_towards(at.ng, scale(d, -1.0)))
    share = query.surface_share[lane]
    answers.share[r], answers.wide[r] = share, query.width[lane]
    put(answers.emissive, r, row(query.emissive, lane))
    put(answers.albedo, r, row(query.albedo, lane))
    put(answers.irradiance, r, row(query.irradiance, lane))
    for c in range(3):
        known = 0.0
        if share > 0.0:
            known = query.emissive[lane, c] + query.albedo[lane, c] * query.irradiance[lane, c] / math.pi
        answers.rest[r, c] = query.color[lane, c] - share * known


@inlined
def add_glow(answers: Answers, slot: int, light: Vec, side: int, way: int, what: int) -> None:
    """Keep light that a surface of glass sends out itself. `what`: tells its kinds apart."""
    if answers.on[0] == 0:
        return
    r = _new_row(answers, slot)
    if r < 0:
        return
    answers.hits.part[r] = NOTHING
    answers.way[r] = np.int32(hash32(way, NOTHING, what))
    answers.side[r] = side
    answers.share[r] = 0.0
    put(answers.weight, r, (1.0, 1.0, 1.0))
    put(answers.rest, r, light)
    for c in range(3):
        answers.point[r, c] = answers.direction[r, c] = answers.normal[r, c] = 0.0


@inlined
def add_direct(
    answers: Answers, slot: int, world: World, at: Interaction, direction: Vec, emissive: Vec, albedo: Vec,
    irradiance: Vec, rest: Vec, wide: float,
) -> None:  # fmt: skip
    """Keep an opaque surface that a view ray sees."""
    answers.filled[slot] = 1
    r = slot * MOST_ANSWERS
    keep_hit(answers.hits, r, at.hit)
    answers.way[r], answers.side[r] = surface_of(world.geometry, at.hit), VIEW
    answers.share[r], answers.wide[r] = 1.0, wide
    put(answers.weight, r, (1.0, 1.0, 1.0))
    put(answers.point, r, at.point)
    put(answers.direction, r, direction)
    put(answers.normal, r, flip_towards(at.ng, scale(direction, -1.0)))
    put(answers.emissive, r, emissive)
    put(answers.albedo, r, albedo)
    put(answers.irradiance, r, irradiance)
    put(answers.rest, r, rest)


@inlined
def add_sky(answers: Answers, slot: int, direction: Vec, light: Vec) -> None:
    """Keep that a view ray sees nothing, and what shines from there."""
    answers.filled[slot] = 1
    r = slot * MOST_ANSWERS
    answers.hits.part[r] = NOTHING
    answers.way[r], answers.side[r], answers.share[r] = NOTHING, VIEW, 0.0
    put(answers.weight, r, (1.0, 1.0, 1.0))
    put(answers.direction, r, direction)
    put(answers.point, r, direction)
    put(answers.normal, r, direction)
    put(answers.rest, r, light)


@inlined
def body_light(answers: Answers, r: int, emissive: Vec, albedo: Vec) -> Vec:
    """Radiance of an answer whose surface is like that."""
    share, rest = answers.share[r], row(answers.rest, r)
    if share == 0.0:
        return rest
    lit = scale(mul(albedo, row(answers.irradiance, r)), 1.0 / math.pi)
    return (
        rest[0] + share * (emissive[0] + lit[0]),
        rest[1] + share * (emissive[1] + lit[1]),
        rest[2] + share * (emissive[2] + lit[2]),
    )
