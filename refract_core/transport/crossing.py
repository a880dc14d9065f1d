"""What becomes of eight rays at the glass they have met (docs/decisions/one-tree.md).

`meet` says what the glass is to a ray: an interface, or something to pass. `cross` splits a ray at an interface, and
`send_mirrored` and `send_through` write the rays that go on.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.compile import inlined
from ..kernels.lanes import Column, Flags, Scalars, Vectors, Words, put
from ..kernels.sampling import GLANCED, THROUGH, hash32
from ..kernels.vec import Vec, dot, flip_towards, mul, normalize, row, scale, sub
from ..optics.interface import fresnel_dielectric, reflect, refract, transmittance, transmitted_roughness
from ..optics.models import absorption_distance_of, exit_of, is_sheet, is_walked, thickness_of
from ..scene import Param
from ..world.offsets import off_surface, past
from ..world.surface import Interaction, color_input, drawn_model, float_input, normal_input, share_input, thing_of
from ..world.tables import World
from .rays import (
    AIR,
    ALL_CHANNELS,
    MIRRORED_SIDE,
    MOST_MEDIA,
    OUT_OF_BODY,
    THROUGH_SIDE,
    VIEW,
    Rays,
    abbe_in,
    absorb,
    add_medium,
    channel_ior,
    copy_ray,
    drop_medium,
    filling,
    filling_without,
    index_in,
    slot_of,
)

_LATE = 96
"""Pieces after which a ray is let out at the next occasion."""
_FAINT = 1.0 / 32.0
"""Part of the cut below which what goes through is not followed."""

# What a piece of glass is to a ray that has met it.
PASSED, ENTERED, ANSWERED, LEFT = 0, 1, 2, 3
"""Nothing; the outside of a body; a model that answers in one step; the inside of a body that the ray is in."""

Directions = Annotated[NDArray[np.float64], Column(np.float64, (3, 3))]
"""shape (8, 3, 3) float64: a vector for each channel"""


class Rules(NamedTuple):
    """What holds for every ray of a picture."""

    max_layers: int
    """surfaces entered after which a ray in air sees no more glass"""
    cut: float
    """weight below which a branch is not followed for itself"""
    measured: bool
    """look for what stands between a model's entry and exit, which HDRP does not"""


class Meeting(NamedTuple):
    """The glass that eight rays have met, and where they go from there."""

    kind: Flags
    """PASSED .. LEFT"""
    point: Vectors
    """[m]"""
    n: Vectors
    """unit shading normal, on the side the ray comes from"""
    ng: Vectors
    """unit geometric normal, on that side"""
    thing: Words
    priority: Words
    slot: Words
    """of the body that is left"""
    model: Words
    ior: Scalars
    """authored, >= 1"""
    abbe: Scalars
    color: Vectors
    """transmittance colour"""
    distance: Scalars
    """absorption distance [m]"""
    thickness: Scalars
    """authored [m]"""
    roughness: Scalars
    """perceptual"""
    opacity: Scalars
    """on entering; 0 on leaving"""

    # The branches, from `cross` on.
    reflectance: Vectors
    mirrors: Flags
    """1 where a mirrored ray is sent"""
    mirrored_weight: Vectors
    mirrored_clear: Vectors
    mirrored: Vectors
    """unit direction"""
    channels: Words
    """rays that go through: none, one, or one per channel"""
    weight: Vectors
    """of what goes through; of one channel each where there are three rays"""
    clear: Vectors
    through: Directions
    """unit directions of what goes through, or that a model leaves in"""
    exits: Directions
    """where a model leaves [m]"""
    length: Vectors
    """way inside a model, per channel [m]"""
    t: Scalars
    """along the ray that met it [m]"""


@inlined
def meet(meeting: Meeting, lane: int, now: Rays, at: Interaction, world: World) -> None:
    """Say what the glass at a hit is to a ray, and look up its attributes. Bodies that fill no space are noted, and the
    way to the hit is absorbed along."""
    geometry, materials, hit, media = world.geometry, world.materials, at.hit, now.media
    m, thing = hit.material, thing_of(geometry, hit)
    model, open_mesh = drawn_model(world, hit), geometry.sheet[hit.part] != 0
    outer = dot(at.ng, row(now.direction, lane)) < 0.0
    slot = slot_of(media, lane, thing)
    room = media.depth[lane] < MOST_MEDIA
    _look_up(meeting, lane, at, world, model)
    meeting.thing[lane], meeting.priority[lane] = thing, materials.priority[m]
    kind = PASSED
    if is_sheet(model):
        kind = ANSWERED
    elif not is_walked(model) and slot == AIR:
        if outer or open_mesh:
            kind = ANSWERED if room else PASSED
    elif not outer and slot != AIR and (now.inner[lane] == 0 or now.thing[lane] != thing):
        kind = LEFT
    elif outer and is_walked(model):
        kind = ENTERED if room else PASSED
    elif is_walked(model) and now.met[lane] == 0 and now.side[lane] == VIEW and room:
        # The first surface, seen from inside: the near plane cut into this body.
        _note_medium(now, lane, meeting, lane, meeting.priority[lane])
        slot = media.depth[lane] - 1
        now.thing[lane] = thing
        kind = LEFT
    absorb(now, lane, hit.t)
    meeting.slot[lane], meeting.t[lane] = slot, hit.t
    if kind == PASSED:
        if now.inner[lane] != 0 and thing == now.thing[lane]:
            now.inner[lane] = 1 if outer else OUT_OF_BODY
        meeting.kind[lane] = kind
        return
    if kind == ENTERED:
        kind = _enter(meeting, lane, now)
    if now.inner[lane] == OUT_OF_BODY and kind in (ENTERED, ANSWERED):
        drop_medium(media, lane, slot_of(media, lane, now.thing[lane]))  # nothing else would ever end it
    elif kind == LEFT and filling(media, lane) != slot:
        drop_medium(media, lane, slot)  # something else fills the space on both sides
        kind = PASSED
    meeting.kind[lane] = kind
    if kind != PASSED:
        _turn(meeting, lane, at, world, row(now.direction, lane), kind != LEFT)


@inlined
def _enter(meeting: Meeting, lane: int, now: Rays) -> int:
    """PASSED, and the body noted, if what fills the space is the same behind the surface."""
    media = now.media
    k = filling(media, lane)
    if k != AIR and (
        media.priority[lane, k] > meeting.priority[lane] or media.thing[lane, k] == meeting.thing[lane]
    ):
        _note_medium(now, lane, meeting, lane, meeting.priority[lane])
        return PASSED
    return ENTERED


@inlined
def _note_medium(rays: Rays, i: int, meeting: Meeting, lane: int, priority: int) -> None:
    """The body that lane has met is one that ray `i` is in."""
    add_medium(
        rays.media, i, meeting.thing[lane], priority, meeting.ior[lane], meeting.abbe[lane], row(meeting.color, lane),
        meeting.distance[lane],
    )  # fmt: skip


@inlined
def _look_up(meeting: Meeting, lane: int, at: Interaction, world: World, model: int) -> None:
    m = at.hit.material
    meeting.model[lane] = model
    meeting.ior[lane] = max(1.0, float_input(world, at, Param.IOR.value))
    meeting.abbe[lane] = world.materials.abbe[m]
    put(meeting.color, lane, color_input(world, at, Param.TRANSMITTANCE.value))
    distance: float = np.float64(world.materials.absorption_distance[m])
    meeting.distance[lane] = absorption_distance_of(model, distance)
    meeting.thickness[lane] = thickness_of(model, float_input(world, at, Param.THICKNESS.value))
    meeting.roughness[lane] = share_input(world, at, Param.ROUGHNESS.value)
    meeting.opacity[lane] = share_input(world, at, Param.OPACITY.value)


@inlined
def _turn(meeting: Meeting, lane: int, at: Interaction, world: World, d: Vec, enters: bool) -> None:
    """Point and normals on the ray's side."""
    ng = flip_towards(at.ng, scale(d, -1.0))
    n = flip_towards(normal_input(world, at), ng)
    if dot(n, d) >= 0.0:  # interpolated normals may face away at silhouettes
        n = ng
    put(meeting.point, lane, at.point)
    put(meeting.ng, lane, ng)
    put(meeting.n, lane, n)
    if not enters:
        meeting.opacity[lane] = 0.0


# --- splitting ----------------------------------------------------------------------------------------------------


@inlined
def cross(meeting: Meeting, lane: int, now: Rays, rules: Rules) -> None:
    """Split a ray at an interface: weights and directions of what is mirrored and of what goes through."""
    media, d = now.media, row(now.direction, lane)
    leaves = meeting.kind[lane] == LEFT
    before = filling(media, lane)
    behind = filling_without(media, lane, meeting.slot[lane]) if leaves else AIR
    abbe_before = abbe_in(media, lane, before)
    abbe_behind = abbe_in(media, lane, behind) if leaves else meeting.abbe[lane]
    channel = now.channel[lane]
    splits = channel == ALL_CHANNELS and (abbe_before > 0.0 or abbe_behind > 0.0)
    meeting.channels[lane] = 3 if splits else 1
    for c in range(3):
        k = c if splits else channel
        if c == 0 or splits:
            n1 = index_in(media, lane, before, k)
            n2 = index_in(media, lane, behind, k) if leaves else channel_ior(meeting.ior[lane], meeting.abbe[lane], k)
            share = _bend(meeting, lane, c, d, n1, n2)
        _weigh(meeting, lane, now, c, share)
    r = reflect(d, row(meeting.n, lane))
    ng = row(meeting.ng, lane)
    if dot(r, ng) <= 0.0:
        r = reflect(d, ng)
    put(meeting.mirrored, lane, r)
    _cut(meeting, lane, rules.cut, now.met[lane] >= _LATE)


@inlined
def _bend(meeting: Meeting, lane: int, c: int, d: Vec, n1: float, n2: float) -> float:
    """Reflectance of an interface; what goes through is noted as channel `c`."""
    n, ng = row(meeting.n, lane), row(meeting.ng, lane)
    if meeting.kind[lane] == ANSWERED:
        p, wo = row(meeting.point, lane), scale(d, -1.0)
        length, leave, out = exit_of(
            meeting.model[lane], p, n, wo, max(1.0, n2 / n1), meeting.thickness[lane]
        )
        put(meeting.exits[lane], c, leave)
        put(meeting.through[lane], c, out)
        meeting.length[lane, c] = length
        return fresnel_dielectric(abs(dot(n, d)), n1 / n2)
    passes, out = refract(d, n, n1 / n2)
    if dot(out, ng) >= 0.0:  # a steep shading normal turns it back: by the true one it is totally reflected
        passes = False
    put(meeting.through[lane], c, out)
    return fresnel_dielectric(abs(dot(n, d)), n1 / n2) if passes else 1.0


@inlined
def _weigh(meeting: Meeting, lane: int, now: Rays, c: int, share: float) -> None:
    """Weights of channel `c` on both sides."""
    meeting.reflectance[lane, c] = share
    w, clear = now.weight[lane, c], now.clear[lane, c]
    kept = (1.0 - share) * (1.0 - meeting.opacity[lane])
    meeting.mirrored_weight[lane, c] = w * share
    meeting.mirrored_clear[lane, c] = clear * share
    meeting.weight[lane, c] = w * kept
    meeting.clear[lane, c] = clear * kept


@inlined
def _cut(meeting: Meeting, lane: int, cut: float, late: bool) -> None:
    """Drop a branch that is not worth its rays, and give its energy to the other one.

    What is mirrored goes first: what goes through ends sooner. Light that hardly gets out of a ball at each of many
    reflections must be let out each time, or it would run round in there for ever with all its weight.
    """
    r = t = 0.0
    for c in range(3):
        r = max(r, meeting.mirrored_weight[lane, c])
        t = max(t, meeting.weight[lane, c])
    if t > 0.0 and (r < cut or late):
        r = 0.0
        for c in range(3):
            if meeting.weight[lane, c] > 0.0:
                meeting.weight[lane, c] += meeting.mirrored_weight[lane, c]
                meeting.clear[lane, c] += meeting.mirrored_clear[lane, c]
                meeting.mirrored_weight[lane, c] = meeting.mirrored_clear[lane, c] = 0.0
            else:  # a channel that is totally reflected has no way through
                r = max(r, meeting.mirrored_weight[lane, c])
    elif t < cut * _FAINT:
        for c in range(3):
            meeting.mirrored_weight[lane, c] += meeting.weight[lane, c]
            meeting.mirrored_clear[lane, c] += meeting.clear[lane, c]
        t = 0.0
    meeting.mirrors[lane] = 1 if r > 0.0 else 0
    if t <= 0.0:
        meeting.channels[lane] = 0


# --- going on -----------------------------------------------------------------------------------------------------


@inlined
def _follow(to: Rays, i: int, now: Rays, lane: int, meeting: Meeting, step: int) -> None:
    """What every ray has that goes on from an interface."""
    copy_ray(to, i, now, lane)
    to.start[i] = to.begun[i] = 0.0
    to.end[i] = math.inf
    to.inner[i] = 0
    to.met[i] = now.met[lane] + 1
    to.travelled[i] += meeting.t[lane]
    to.branch[i] = 4 * now.branch[lane] + step
    to.way[i] = np.int32(hash32(now.way[lane], 4 * meeting.thing[lane] + step, 4 * meeting.kind[lane]))
    to.roughness[i] = max(now.roughness[lane], meeting.roughness[lane])
    if meeting.kind[lane] != LEFT:
        put(to.normal, i, row(meeting.n, lane))
        to.thing[i] = meeting.thing[lane]
        to.entered[i] = now.entered[lane] + 1


@inlined
def _tan_of_lobe(roughness: float) -> float:
    """Tangent of the half angle within which a reflected GGX lobe keeps half of its rays: twice the median slope."""
    return 2.0 * roughness * roughness


@inlined
def send_mirrored(to: Rays, i: int, now: Rays, lane: int, meeting: Meeting) -> int:
    """Write the mirrored ray of an interface, if there is one, to row `i`. Returns the next row."""
    if meeting.mirrors[lane] == 0:
        return i
    _follow(to, i, now, lane, meeting, GLANCED)
    r = row(meeting.mirrored, lane)
    put(to.origin, i, off_surface(row(meeting.point, lane), row(meeting.ng, lane), r))
    put(to.direction, i, r)
    put(to.weight, i, row(meeting.mirrored_weight, lane))
    put(to.clear, i, row(meeting.mirrored_clear, lane))
    to.blur[i] = math.hypot(now.blur[lane], _tan_of_lobe(meeting.roughness[lane]))
    to.lamps[i] = 1 if meeting.kind[lane] == LEFT else 0
    to.mirrored[i] = 1
    if now.side[lane] == VIEW:
        to.side[i] = MIRRORED_SIDE
    return i + 1


@inlined
def send_through(to: Rays, i: int, now: Rays, lane: int, meeting: Meeting, rules: Rules) -> int:
    """Write the rays that go through an interface to row `i` and after. Returns the next row."""
    count = meeting.channels[lane]
    for c in range(count):
        if count == 3 and meeting.weight[lane, c] <= 0.0:
            continue
        _follow(to, i, now, lane, meeting, THROUGH)
        put(to.weight, i, row(meeting.weight, lane))
        put(to.clear, i, row(meeting.clear, lane))
        if count == 3:
            to.channel[i] = c
            to.way[i] = np.int32(hash32(to.way[i], c, 1))
            for other in range(3):
                if other != c:
                    to.weight[i, other] = to.clear[i, other] = 0.0
        if now.side[lane] == VIEW:
            to.side[i] = THROUGH_SIDE
        if meeting.kind[lane] != LEFT:
            wide = transmitted_roughness(meeting.roughness[lane], meeting.ior[lane], True)
            to.blur[i] = math.hypot(now.blur[lane], _tan_of_lobe(wide))
        if meeting.kind[lane] == ANSWERED:
            _send_answered(to, i, meeting, lane, c, rules)
        else:
            d = row(meeting.through[lane], c)
            put(to.origin, i, off_surface(row(meeting.point, lane), row(meeting.ng, lane), d))
            put(to.direction, i, d)
            if meeting.kind[lane] == LEFT:
                drop_medium(to.media, i, meeting.slot[lane])
            else:
                _note_medium(to, i, meeting, lane, meeting.priority[lane])
        i += 1
    return i


@inlined
def _send_answered(to: Rays, i: int, meeting: Meeting, lane: int, c: int, rules: Rules) -> None:
    """Send a ray on its way through a model: along its inner stretch, or from its exit where nobody looks inside."""
    length = meeting.length[lane, c]
    leave, out = row(meeting.exits[lane], c), row(meeting.through[lane], c)
    if is_sheet(meeting.model[lane]) or not rules.measured or length <= 0.0:
        # Where there is no way inside, the exit lies on the very surface, and must not meet it again.
        put(to.origin, i, leave if length > 0.0 else off_surface(leave, row(meeting.ng, lane), out))
        put(to.direction, i, out)
        left = transmittance(row(meeting.color, lane), meeting.distance[lane], length)
        put(to.weight, i, mul(row(to.weight, i), left))
        to.path[i] += length
        to.travelled[i] += length
        return
    p = row(meeting.point, lane)
    inside = normalize(sub(leave, p))
    put(to.origin, i, off_surface(p, row(meeting.ng, lane), inside))
    put(to.direction, i, inside)
    to.end[i] = length
    to.inner[i] = 1
    put(to.leave_point, i, leave)
    put(to.leave_direction, i, out)
    around = filling(to.media, i)
    priority = meeting.priority[lane]
    if around != AIR:  # along the stretch it is the model's body that fills the space
        priority = max(priority, to.media.priority[i, around])
    _note_medium(to, i, meeting, lane, priority)


@inlined
def send_past(to: Rays, i: int, now: Rays, lane: int, t: float) -> int:
    """Write a ray that goes straight on behind what it met at distance `t`. Returns the next row."""
    copy_ray(to, i, now, lane)
    to.start[i] = past(t)
    to.met[i] = now.met[lane] + 1
    return i + 1


@inlined
def send_out(to: Rays, i: int, now: Rays, lane: int) -> int:
    """Write a ray that met nothing on its inner stretch, and goes on from the model's exit. Returns the next row."""
    copy_ray(to, i, now, lane)
    put(to.origin, i, row(now.leave_point, lane))
    put(to.direction, i, row(now.leave_direction, lane))
    to.start[i] = to.begun[i] = 0.0
    to.end[i] = math.inf
    to.inner[i] = 0
    to.travelled[i] += now.end[lane]
    drop_medium(to.media, i, slot_of(now.media, lane, now.thing[lane]))
    return i + 1
