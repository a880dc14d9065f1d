"""What surrounds a thing in a studio, as one latlong picture each: soft boxes and a graded backdrop, or sun and sky.

Studio frame: +Y up, +Z towards the camera, +X to its right; so -Z lies behind the thing. Radiance is such that a white
matt surface which faces up is about white. Below the horizon is what the floor looks like far away, which makes the
horizon itself invisible.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from ..scene import F32, F64

ROWS = 128
"""Of a dome's picture: 1.4 degrees a row, finer than the edges of the softest things in it."""


@dataclass(frozen=True)
class Softbox:
    """A lamp behind a cloth: a rectangle, seen from the thing. In the dome it has soft edges, and shows wherever a ray
    leaves; as a lamp it has sharp ones, and shadows without noise, and shows in mirrors alone. So what brings most of
    the light is a lamp, and what draws a line along glass is in the dome."""

    azimuth: float
    """of its middle, from behind the thing to the right [degrees]"""
    elevation: float
    """[degrees]"""
    width: float
    """[degrees], along the horizon; so is the next, upwards"""
    height: float
    radiance: float
    edge: float = 4.0
    """over which it fades [degrees]"""
    lamp: bool = False
    """It is a rectangular light, far away, and not in the dome."""


@dataclass(frozen=True)
class Set:
    """One studio."""

    boxes: tuple[Softbox, ...]
    around: Callable[[F64], F64]
    """directions (..., 3) in the upper half to radiance (..., 3), where no box is"""
    scale: float
    """on all light but the sun's"""
    floor: tuple[float, float]
    """albedo of the floor under the thing, and far away"""
    sun: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """irradiance of a surface that faces it"""
    sun_from: tuple[float, float] = (0.0, 0.0)
    """azimuth and elevation [degrees], as a box's"""


def _smooth(low: float, high: float, x: F64) -> F64:
    """0 below `low`, 1 above `high`, smoothly between them."""
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def towards(azimuth: float, elevation: float) -> F64:
    """Unit direction, shape (3,). Azimuth goes from -Z by +X [degrees]."""
    a, e = math.radians(azimuth), math.radians(elevation)
    return np.array([math.sin(a) * math.cos(e), math.sin(e), -math.cos(a) * math.cos(e)])


def corners_of(box: Softbox) -> F64:
    """Directions to the four corners of a box, counter-clockwise as the thing sees them, shape (4, 3), at distance 1
    along its middle."""
    middle, right = towards(box.azimuth, box.elevation), towards(box.azimuth + 90.0, 0.0)
    across = math.tan(math.radians(box.width / 2.0)) * right
    upward = math.tan(math.radians(box.height / 2.0)) * np.cross(right, middle)
    return np.array([middle - across - upward, middle + across - upward, middle + across + upward,
                     middle - across + upward])  # fmt: skip


def irradiance_of(box: Softbox) -> float:
    """Of a surface that faces up, at radiance 1 (Lambert 1760; all of the box is above the horizon)."""
    unit = corners_of(box)
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    after = np.roll(unit, -1, axis=0)
    edges = np.cross(unit, after)
    angles = np.arctan2(np.linalg.norm(edges, axis=1), (unit * after).sum(axis=1))
    turns = edges[:, 1] / np.linalg.norm(edges, axis=1)
    return abs(float(0.5 * (angles * turns).sum()))


def _box(box: Softbox, d: F64) -> F64:
    """How much of a box a direction sees, 0 .. 1."""
    middle = towards(box.azimuth, box.elevation)
    right = towards(box.azimuth + 90.0, 0.0)
    up = np.cross(right, middle)
    forward = d @ middle
    x = np.degrees(np.arctan2(d @ right, np.maximum(forward, 1e-9)))
    y = np.degrees(np.arctan2(d @ up, np.maximum(forward, 1e-9)))
    inside = _smooth(-0.5 * box.edge, 0.5 * box.edge, box.width / 2 - np.abs(x))
    inside = inside * _smooth(-0.5 * box.edge, 0.5 * box.edge, box.height / 2 - np.abs(y))
    return np.where(forward > 0.0, inside, 0.0)


def _grey(value: F64) -> F64:
    return np.repeat(value[..., None], 3, axis=-1)


def _sweep(d: F64) -> F64:
    """Black cloth all around, and behind the thing the backdrop, lit from below."""
    behind = _smooth(-0.2, 0.9, -d[..., 2] / np.maximum(np.hypot(d[..., 0], d[..., 2]), 1e-9))
    return _grey(0.07 + 0.7 * behind * (1.0 - _smooth(0.0, 0.8, d[..., 1])))


def _night(d: F64) -> F64:
    return _grey(np.full(d.shape[:-1], 0.004))


def _sky(d: F64) -> F64:
    """A clear sky: blue, paler towards the horizon and around the sun."""
    height = np.sqrt(np.clip(d[..., 1], 0.0, 1.0))[..., None]
    low, high = np.array([0.50, 0.56, 0.62]), np.array([0.10, 0.18, 0.34])
    glow = np.clip(d @ towards(*_SUN_FROM), 0.0, 1.0)[..., None] ** 24
    return np.asarray(low + (high - low) * height + glow * np.array([0.9, 0.8, 0.65]))


_SUN_FROM = (125.0, 42.0)
SETS = {
    "softbox": Set(
        boxes=(
            Softbox(-80.0, 28.0, 26.0, 52.0, 6.0, lamp=True),
            Softbox(84.0, 26.0, 11.0, 64.0, 6.6),
            Softbox(170.0, 54.0, 60.0, 40.0, 2.8, lamp=True),
        ),
        around=_sweep,
        scale=0.8,
        floor=(0.68, 0.4),
    ),
    "daylight": Set(
        boxes=(),
        around=_sky,
        scale=1.0,
        floor=(0.5, 0.42),
        sun=(2.9, 2.7, 2.35),
        sun_from=_SUN_FROM,
    ),
    "dark": Set(
        boxes=(
            Softbox(-112.0, 24.0, 14.0, 76.0, 12.0),
            Softbox(-58.0, 24.0, 9.0, 76.0, 12.0),
            Softbox(62.0, 24.0, 10.0, 76.0, 14.0),
            Softbox(0.0, 74.0, 60.0, 16.0, 5.0, lamp=True),
        ),
        around=_night,
        scale=0.7,
        floor=(0.035, 0.012),
    ),
}
"""Every studio by its name."""


def directions(rows: int) -> F64:
    """Of a picture's texels, shape (rows, 2 rows, 3), as `scene.Environment` has them."""
    theta = (np.arange(rows) + 0.5)[:, None] * (math.pi / rows)
    phi = (0.5 - (np.arange(2 * rows) + 0.5)[None, :] / (2 * rows)) * (2.0 * math.pi)
    sine = np.sin(theta)
    return np.stack([sine * np.sin(phi), np.cos(theta) + 0.0 * phi, sine * np.cos(phi)], axis=-1)


@cache
def dome_of(name: str) -> F32:
    """The surroundings of a studio by name, shape (ROWS, 2 ROWS, 3) radiance. Shared, and not to be written to."""
    chosen = SETS[name]
    d = directions(ROWS)
    light = chosen.around(d)
    for box in chosen.boxes:
        if not box.lamp:
            share = _box(box, d)[..., None]
            light = light * (1.0 - share) + share * box.radiance
    light = light * chosen.scale
    # The lower half is the floor far away, which sends on what arrives from the upper one. Right above the horizon that
    # begins as what lies below it, so that it is a part of what arrives.
    near = (1.0 - _smooth(0.0, 0.12, d[..., 1]))[..., None]
    light = light * (1.0 - near)
    rows = np.cos(np.linspace(0.0, math.pi / 2.0, ROWS // 2 + 1))
    band = ((rows[:-1] ** 2 - rows[1:] ** 2) / 2.0 * (math.pi / ROWS))[:, None, None]
    arriving = (light[: ROWS // 2] * band).sum(axis=(0, 1))
    arriving += chosen.scale * sum(box.radiance * irradiance_of(box) for box in chosen.boxes if box.lamp)
    arriving += np.array(chosen.sun) * math.sin(math.radians(chosen.sun_from[1]))
    far = chosen.floor[1] * arriving / (math.pi - chosen.floor[1] * float((near[: ROWS // 2] * band).sum()))
    light = np.where(d[..., 1:2] > 0.0, light + near * far, far)
    pixels = light.astype(np.float32)
    pixels.setflags(write=False)
    return pixels
