"""Light between surfaces made ready: where it has to be found, and how often it is sent on.

What the camera sees, and what is seen from there, asks for light. Where nobody speaks for it yet, one place of each
cell of space is looked around from; then cells are halved, until all has been spoken for. So places stand densely where
things are near each other, and a picture's worth of them is a few thousand.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.lanes import by_address, scratch
from ..scene import F64, Camera
from ..settings import RenderSettings
from ..view.camera import image_size, view_of
from ..view.places import seen_places
from ..world.bounced import Bounced, Places, bounced_of, certainty, no_bounced, no_places
from ..world.gathering import GatherScratch, gather_places, look_from
from ..world.tables import World
from .work import Work

_STEP = 4
"""Pixels between the places that the camera asks about."""
_LOOKS, _FEWEST = 4, 1 << 14
"""Rays from each of those to what else is asked about, at least, and from all of them together."""
_SHARE = 0.3
"""Of the mean distance of what a place sees, that it speaks for."""
_NEAREST, _FARTHEST = 4.0, 80.0
"""Pixels that it speaks for at least, and at most."""
_SURE = 0.25
"""How surely light has to be known at a place (`bounced_light`)."""
_ROUNDS = 3
"""Times that light is sent on before the rest is taken to go on as it did between the last two."""
_BATCH = 16
_LOOKUPS = 1 << 12


class Asked(NamedTuple):
    """Places that want light, N of them."""

    point: F64
    """shape (N, 3) [m]"""
    normal: F64
    pixel: F64
    """shape (N,): width of a pixel there, as if the camera saw it [m]"""


def indirect_of(world: World, camera: Camera, settings: RenderSettings, work: Work) -> Bounced:
    """Light that opaque surfaces of a scene send each other, or none where that is not asked for."""
    if settings.indirect == "off" or not world.lit or not world.materials.spreads.any():
        return no_bounced()
    seen = by_address(world)
    asked = _asked(seen, camera, settings, work)
    places, bounds = _places(seen, asked, work)
    if settings.indirect == "one" or not len(places.reach):
        return bounced_of(places)
    return _sent_on(world, places, bounds, work)


def _asked(world: World, camera: Camera, settings: RenderSettings, work: Work) -> Asked:
    """What the camera sees through every fourth pixel, and what is seen from there."""
    width, height = image_size(camera, settings.image_width, settings.image_height)
    columns, lines = max(1, width // _STEP), max(1, height // _STEP)
    view = view_of(camera, columns, lines)
    point, normal = np.zeros((columns * lines, 3)), np.zeros((columns * lines, 3))
    held = by_address(view)
    work.run(
        lambda line: seen_places(
            world, held, scratch(GatherScratch), line, min(line + 8, lines), point, normal
        ),
        range(0, lines, 8),
    )  # fmt: skip
    looks = max(_LOOKS, _FEWEST // len(point))
    met, facing = np.zeros((len(point) * looks, 3)), np.zeros((len(point) * looks, 3))

    def look(first: int) -> None:
        last = min(first + _LOOKUPS, len(point))
        look_from(world, scratch(GatherScratch), point, normal, first, last, looks, met, facing)

    work.run(look, range(0, len(point), _LOOKUPS))
    point, normal = np.concatenate([point, met]), np.concatenate([normal, facing])
    there = normal.any(axis=1)
    point, normal = point[there], normal[there]
    pixel = np.full(len(point), (view.window[1] - view.window[0]) / (columns * _STEP))
    if not camera.orthographic:
        pixel *= np.maximum(np.linalg.norm(point - view.axes[3], axis=1), max(camera.clipping[0], 1e-9))
    return Asked(point, normal, pixel)


def _places(world: World, asked: Asked, work: Work) -> tuple[Places, tuple[F64, F64]]:
    """Places that speak for all that is asked about, with their light; and the bounds of their reach."""
    places, nearest, farthest = no_places(), np.zeros(0), np.zeros(0)
    if not len(asked.pixel):
        return places, (nearest, farthest)
    open_ = np.arange(len(asked.pixel))
    cell = 2.0 ** math.ceil(math.log2(_FARTHEST * float(asked.pixel.max())))
    least = _NEAREST * float(asked.pixel.min()) / 2.0
    while len(open_) and cell > least:
        chosen = _one_of_each_cell(asked, open_, cell)
        more = no_places(len(chosen))
        more.point[:], more.normal[:] = asked.point[chosen], asked.normal[chosen]
        near, far = _NEAREST * asked.pixel[chosen], _FARTHEST * asked.pixel[chosen]
        _gather(world, more, (near, far), work)
        places = Places(*(np.concatenate(pair) for pair in zip(places, more, strict=True)))
        nearest, farthest = np.concatenate([nearest, near]), np.concatenate([farthest, far])
        open_ = open_[_certainty(bounced_of(places), asked, open_, work) < _SURE]
        cell /= 2.0
    return places, (nearest, farthest)


def _one_of_each_cell(asked: Asked, open_: NDArray[np.int64], cell: float) -> NDArray[np.int64]:
    """Of each side that surfaces look to in each cell, the one nearest to the cell's middle."""
    point, normal = asked.point[open_], asked.normal[open_]
    axis = np.abs(normal).argmax(axis=1)
    side = 2 * axis + (normal[np.arange(len(axis)), axis] > 0.0)
    at = np.floor(point / cell)
    away = ((point / cell - at - 0.5) ** 2).sum(axis=1)
    rows = np.column_stack([at.astype(np.int64), side])
    order = np.lexsort((open_, away, *rows.T))
    _, first = np.unique(rows[order], axis=0, return_index=True)
    return open_[order[first]]


def _gather(world: World, places: Places, bounds: tuple[F64, F64], work: Work) -> None:
    held = by_address(places)
    count = len(places.reach)
    work.run(
        lambda first: gather_places(
            world, scratch(GatherScratch), held, first, min(first + _BATCH, count), *bounds, _SHARE
        ),
        range(0, count, _BATCH),
    )  # fmt: skip


def _certainty(table: Bounced, asked: Asked, open_: NDArray[np.int64], work: Work) -> F64:
    known = np.zeros(len(open_))
    point, normal, held = asked.point[open_], asked.normal[open_], by_address(table)
    work.run(
        lambda first: certainty(held, point, normal, first, min(first + _LOOKUPS, len(open_)), known),
        range(0, len(open_), _LOOKUPS),
    )
    return known


def _sent_on(world: World, places: Places, bounds: tuple[F64, F64], work: Work) -> Bounced:
    """All bounces: a few rounds, and the rest as a geometric series by what the last has added to the one before."""
    sums = [places.irradiance.sum(axis=0)]
    light = [places]
    for _ in range(_ROUNDS - 1):
        again = Places(*(column.copy() for column in places))
        _gather(by_address(world._replace(bounced=bounced_of(light[-1]))), again, bounds, work)
        light.append(again._replace(reach=places.reach, trust=places.trust))
        sums.append(again.irradiance.sum(axis=0))
    added, before = sums[-1] - sums[-2], sums[-2] - sums[-3]
    ratio = np.clip(np.divide(added, before, out=np.zeros(3), where=before > 0.0), 0.0, 0.98)
    rest = (ratio / (1.0 - ratio))[:, None]
    last, previous = light[-1], light[-2]
    return bounced_of(last._replace(
        irradiance=last.irradiance + (last.irradiance - previous.irradiance) * rest[:, 0],
        turn=last.turn + (last.turn - previous.turn) * rest,
        shift=last.shift + (last.shift - previous.shift) * rest,
    ))  # fmt: skip
