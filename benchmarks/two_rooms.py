"""Rooms as plain numbers, for any renderer: meshes, finishes, lamps, a sky and an eye.

`emissive_room`: a closed, checkered room in which every opaque surface shines by itself and nothing is lit, with a
ball, a torus, a blob, a hollow ball, a slab and a pane of glass. What differs between two pictures of it is refraction
alone.

`lit_room`: a textured floor and wall, a lamp of one square metre and an even sky, with a ball, a cube, a torus and a
hollow ball of glass and an opaque ball.

`table_room`: a ball, a cube, a lens and a hollow, tinted bottle of glass and a matt ball on a table, under a lamp of
one square metre, a globe and a sun of some degrees. `benchmarks.light` draws it.

Everything is in metres, right-handed, Y up. Triangles are counter-clockwise from outside; opaque surfaces shine, and
are lit, on that side. All glass is closed and smooth, of one index, and touches nothing.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from refract_core.scene import F32, F64, U32

from .room import globe

IOR = 1.5
Colour = tuple[float, float, float]
"""Linear red, green, blue."""
Glow = Colour | str
"""A colour, or the name of one of `Room.images`."""


class Finish(NamedTuple):
    """What a surface is made of: glass, or one of radiance and albedo."""

    glass: bool = False
    """smooth, of index IOR, in air"""
    tint: Colour = (1.0, 1.0, 1.0)
    """of glass: what a centimetre of it lets through"""
    radiance: Glow | None = None
    """it shines, and reflects nothing"""
    albedo: Glow | None = None
    """it is matt (Lambert)"""


class Solid(NamedTuple):
    """One mesh."""

    name: str
    finish: Finish
    points: F32
    """shape (V, 3) [m]"""
    triangles: U32
    """shape (T, 3)"""
    normals: F32 | None = None
    """shape (V, 3): unit shading normals; None means flat"""
    st: F32 | None = None
    """shape (V, 2): place in the finish's image, which is repeated; (0, 0) is its lower left corner"""


class Lamp(NamedTuple):
    """A rectangle that shines to one side. Not seen by the eye; a black board stands behind it."""

    world_from_lamp: F64
    """shape (4, 4), column vectors: rotation and translation [m]. It shines along its -Z."""
    size: tuple[float, float]
    """along its x and y [m]"""
    radiance: Colour


class Globe(NamedTuple):
    """A ball that shines, not seen by the eye."""

    centre: tuple[float, float, float]
    """[m]"""
    radius: float
    """[m]"""
    radiance: Colour


class Sun(NamedTuple):
    """A disk of even light, infinitely far away, not seen by the eye."""

    towards: tuple[float, float, float]
    """the middle of it; of any length"""
    angle: float
    """across [degrees]"""
    radiance: Colour


class Eye(NamedTuple):
    """A pinhole, upright, whose window has 16:9."""

    place: tuple[float, float, float]
    """[m]"""
    target: tuple[float, float, float]
    """in the middle of the picture [m]"""
    half_height: float
    """of the window at distance 1"""


class Room(NamedTuple):
    """Everything that a renderer has to know."""

    name: str
    solids: tuple[Solid, ...]
    images: dict[str, F32]
    """name -> shape (H, W, 3), linear, row 0 on top; bilinear between the texels"""
    eye: Eye
    lamp: Lamp | None = None
    sky: Colour = (0.0, 0.0, 0.0)
    """radiance from everywhere outside"""
    others: tuple[Globe | Sun, ...] = ()
    """lights beside the lamp"""

    def digest(self) -> str:
        """Changes with every number in the room."""
        found = hashlib.sha256()
        lights = self.sky, self.lamp and self.lamp[1:], *self.others
        for part in (self.name, self.eye, *lights, [s[:2] for s in self.solids]):
            found.update(repr(part).encode())
        arrays: list[NDArray[np.generic] | None] = [self.lamp.world_from_lamp if self.lamp else None]
        arrays += [array for solid in self.solids for array in solid[2:]]
        for array in [*arrays, *self.images.values()]:
            found.update(b"-" if array is None else np.ascontiguousarray(array).tobytes())
        return found.hexdigest()[:12]


# ------------------------------------------------------------------------------------------------ shapes


GLASS = Finish(glass=True)


def place(centre: ArrayLike, yaw: float = 0.0, pitch: float = 0.0) -> F64:
    """Where a thing stands: turned by `pitch` about x, by `yaw` about y [degrees], then moved [m]; shape (4, 4)."""
    a, b = np.radians([yaw, pitch])
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = about_y @ about_x, centre
    return m


def _smooth(name: str, finish: Finish, points: F64, triangles: NDArray[np.int64], at: F64) -> Solid:
    """A mesh with the mean normal, by area, at every point."""
    points = points @ at[:3, :3].T + at[:3, 3]
    corners = points[triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = np.zeros_like(points)
    for k in range(3):
        np.add.at(sums, triangles[:, k], across)
    normals: F32 = (sums / np.linalg.norm(sums, axis=1, keepdims=True)).astype(np.float32)
    return Solid(name, finish, points.astype(np.float32), triangles.astype(np.uint32), normals)


def _ball(name: str, finish: Finish, at: F64, radius: float, rings: int = 96) -> Solid:
    """36,480 triangles with 96 rings."""
    points, triangles = globe(rings, 2 * rings)
    return _smooth(name, finish, radius * points, triangles, at)


def _shell(name: str, at: F64, radius: float, wall: float) -> Solid:
    """A ball with a hollow one inside it, turned inside out."""
    points, triangles = globe(96, 192)
    both = np.concatenate([radius * points, (radius - wall) * points])
    return _smooth(name, GLASS, both, np.concatenate([triangles, triangles[:, ::-1] + len(points)]), at)


def _blob(name: str, at: F64, radius: float) -> Solid:
    """A ball with dents."""
    points, triangles = globe(96, 192)
    x, y, z = points.T
    bulge = 1.0 + 0.12 * np.sin(3.0 * x + 1.0) * np.cos(4.0 * y) + 0.10 * np.sin(4.0 * z + 2.0 * x + 0.5)
    return _smooth(name, GLASS, radius * points * bulge[:, None], triangles, at)


def _torus(name: str, at: F64, radius: float, tube: float) -> Solid:
    """It lies flat before it is placed. `radius`: of the circle in the middle of the tube."""
    around, across = 192, 96
    a = 2.0 * np.pi * np.arange(around)[:, None] / around
    b = 2.0 * np.pi * np.arange(across)[None] / across
    reach = radius + tube * np.cos(b)
    points = np.stack([reach * np.cos(a), tube * np.sin(b) + 0.0 * a, -reach * np.sin(a)], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    p, q = (i * across + j).ravel(), ((i + 1) % around * across + j).ravel()
    r, s = ((i + 1) % around * across + (j + 1) % across).ravel(), (i * across + (j + 1) % across).ravel()
    return _smooth(name, GLASS, points, np.concatenate([np.stack([p, q, r], 1), np.stack([p, r, s], 1)]), at)


def _lathe(name: str, finish: Finish, at: F64, profile: F64) -> Solid:
    """A body turned about y. `profile`: shape (K, 2), distance from y and height [m], from its lowest place on y, on
    the outside first, to its last one on y."""
    around = 128
    turn = 2.0 * np.pi * np.arange(around) / around
    ring = np.stack([np.cos(turn), 0.0 * turn, -np.sin(turn)], 1)
    up = np.array([0.0, 1.0, 0.0])
    rings = [r * ring + y * up for r, y in profile[1:-1]]
    points = np.concatenate([[profile[0, 1] * up], *rings, [profile[-1, 1] * up]])
    here, after, last = np.arange(around), (np.arange(around) + 1) % around, len(points) - 1
    faces = [np.stack([0 * here, 1 + after, 1 + here], 1)]
    for first in range(1, last - around, around):
        p, q = first + here, first + after
        faces += [np.stack([p, q, q + around], 1), np.stack([p, q + around, p + around], 1)]
    faces.append(np.stack([last - around + here, last - around + after, 0 * here + last], 1))
    return _smooth(name, finish, points, np.concatenate(faces), at)


def _arc(centre: tuple[float, float], radius: float, start: float, stop: float, count: int) -> F64:
    """Part of a profile: `start` and `stop` are counter-clockwise from outwards [degrees]."""
    a = np.radians(np.linspace(start, stop, count))
    return np.stack([centre[0] + radius * np.cos(a), centre[1] + radius * np.sin(a)], 1)


def _lens(name: str, at: F64, radius: float, bend: float, rim: float) -> Solid:
    """Convex on both sides, round about y. `bend`: radius of its surfaces; `rim`: thickness at the edge [m]. Its edge
    is a smooth arc."""
    half = float(np.degrees(np.arcsin(radius / bend)))
    low = float(np.sqrt(bend**2 - radius**2)) - rim / 2.0
    below = _arc((0.0, low), bend, -90.0, half - 90.0, 49)
    small = rim / 2.0 / float(np.cos(np.radians(half)))
    edge = _arc((radius - small * float(np.sin(np.radians(half))), 0.0), small, half - 90.0, 90.0 - half, 9)[1:-1]
    above = _arc((0.0, -low), bend, 90.0 - half, 90.0, 49)
    profile = np.concatenate([below, edge, above])
    profile[[0, -1], 0] = 0.0
    return _lathe(name, GLASS, at, profile)


def _bottle(name: str, finish: Finish, at: F64) -> Solid:
    """Hollow, open on top, 93 cm high; its walls are 2.5 cm thick, and its base is where y is 0."""
    belly, neck = (0.12, 0.50), (0.12 + 0.26 * 0.5, 0.50 + 0.26 * 0.75**0.5)  # the shoulder's two arcs, which touch
    outer = [
        np.zeros((1, 2)), _arc((0.19, 0.05), 0.05, -90.0, 0.0, 12), _arc(belly, 0.12, 0.0, 60.0, 14),
        _arc(neck, 0.14, -120.0, -180.0, 14)[1:],
    ]  # fmt: skip
    inner = [
        _arc((0.0975, 0.92), 0.0125, 0.0, 180.0, 12), _arc(neck, 0.165, -180.0, -120.0, 14),
        _arc(belly, 0.095, 60.0, 0.0, 14)[1:], _arc((0.165, 0.075), 0.05, 0.0, -90.0, 12), np.array([[0.0, 0.025]]),
    ]  # fmt: skip
    return _lathe(name, finish, at, np.concatenate([*outer, *inner]))


def _block(name: str, at: F64, size: tuple[float, float, float]) -> Solid:
    """A closed box with flat faces. `size`: its full sides [m]."""
    half = np.array(size) / 2.0
    corner = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    quads = ((4, 6, 7, 5), (0, 1, 3, 2), (2, 3, 7, 6), (0, 4, 5, 1), (1, 5, 7, 3), (0, 2, 6, 4))
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.uint32)
    return Solid(name, GLASS, (corner @ at[:3, :3].T + at[:3, 3]).astype(np.float32), triangles)


def _quad(name: str, finish: Finish, corners: ArrayLike, metres: tuple[float, float] = (1.0, 1.0)) -> Solid:
    """Four corners, counter-clockwise; `metres`: its sides, so that an image's tile is 1 m long."""
    st = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * metres
    order = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)
    return Solid(name, finish, np.array(corners, np.float32), order, st=st.astype(np.float32))


# ------------------------------------------------------------------------------------------------ images


_TILE = 64
"""Texels along a tile of 2 x 2 squares, which is 1 m long."""


def _checkers(colour: Colour, dark: float) -> F32:
    """2 x 2 squares; they are a little brighter to the upper right, so that an image that lies wrong is noticed."""
    y, x = np.mgrid[:_TILE, :_TILE]
    light = np.where((x // (_TILE // 2) + y // (_TILE // 2)) % 2 == 0, 1.0, dark)
    slope = 0.8 + 0.1 * (x + (_TILE - 1 - y)) / (_TILE - 1)
    return ((light * slope)[..., None] * np.array(colour)).astype(np.float32)


# ------------------------------------------------------------------------------------------------ the rooms


_HALF = (3.0, 2.0, 3.3)
"""Of the emissive room [m]"""
_WALLS: tuple[Colour, ...] = (
    (0.9, 0.5, 0.4), (0.4, 0.6, 0.9), (0.9, 0.9, 0.85), (0.6, 0.45, 0.3), (0.8, 0.8, 0.4), (0.5, 0.85, 0.7),
)  # fmt: skip
"""Radiance of the light squares on the walls +x -x +y -y +z -z; the dark ones have a fifth."""
_BALLS: tuple[tuple[tuple[float, float, float], float, Colour], ...] = (
    ((-1.7, -1.0, -1.9), 0.7, (0.9, 0.15, 0.1)),
    ((1.6, 0.7, -2.3), 0.6, (0.1, 0.6, 0.15)),
    ((0.3, -1.5, -1.0), 0.4, (0.95, 0.75, 0.1)),
    ((2.2, -1.1, 1.7), 0.6, (0.15, 0.3, 0.95)),
    ((-2.1, 0.9, 2.4), 0.7, (0.7, 0.2, 0.8)),
)
"""Centre [m], radius [m], radiance."""


def _wall(which: int) -> Solid:
    """A wall of the emissive room, facing inwards: +x -x +y -y +z -z."""
    axis, side = which // 2, 1.0 - 2.0 * (which % 2)
    s, t = (axis + 1) % 3, (axis + 2) % 3
    points = np.zeros((4, 3))
    points[:, axis] = side * _HALF[axis]
    points[:, s] = np.array([-1.0, 1.0, 1.0, -1.0]) * _HALF[s] * -side
    points[:, t] = np.array([-1.0, -1.0, 1.0, 1.0]) * _HALF[t]
    finish = Finish(radiance=f"checkers{which}")
    return _quad(f"wall{which}", finish, points, (2.0 * _HALF[s], 2.0 * _HALF[t]))


def emissive_room() -> Room:
    """Nothing is lit; everything opaque shines."""
    glass = (
        _ball("ball", GLASS, place((-1.25, 0.50, 0.0)), 0.5),
        _torus("torus", place((0.0, 0.55, -0.1), 20.0, 60.0), 0.36, 0.14),
        _blob("blob", place((1.25, 0.50, -0.1)), 0.46),
        _shell("shell", place((-0.95, -0.65, 0.3)), 0.45, 0.02),
        _block("slab", place((0.25, -0.65, 0.1), 25.0, 10.0), (0.9, 0.7, 0.2)),
        _block("pane", place((1.25, -0.45, 0.7), -30.0, 0.0), (0.7, 1.1, 0.01)),
    )
    balls = tuple(
        _ball(f"glow{i}", Finish(radiance=colour), place(centre), radius, 48)
        for i, (centre, radius, colour) in enumerate(_BALLS)
    )
    images = {f"checkers{i}": _checkers(colour, 0.2) for i, colour in enumerate(_WALLS)}
    eye = Eye((0.0, 0.1, 2.9), (0.0, 0.0, 0.0), float(np.tan(np.radians(25.0))))
    return Room("emissive", (*(_wall(i) for i in range(6)), *balls, *glass), images, eye)


def _lamp() -> Lamp:
    """1 x 1 m, tilted towards the table."""
    return Lamp(place((-1.1, 2.6, 1.0), -20.0, -60.0), (1.0, 1.0), (22.0, 20.5, 18.5))


def _board(lamp: Lamp) -> Solid:
    """The lamp's back, 2 mm behind its face: elsewhere than in a picture no rectangle shines without one."""
    x, y = np.array(lamp.size) / 2.0
    corners = np.array([[-x, -y, 0.002], [x, -y, 0.002], [x, y, 0.002], [-x, y, 0.002]])
    m = lamp.world_from_lamp
    return _quad("board", Finish(albedo=(0.0, 0.0, 0.0)), corners @ m[:3, :3].T + m[:3, 3])


def lit_room() -> Room:
    """A lamp, an even sky, a floor and a wall."""
    lamp = _lamp()
    things = (
        _quad("floor", Finish(albedo="wood"), [[-4, 0, 3], [4, 0, 3], [4, 0, -2], [-4, 0, -2]], (8.0, 5.0)),
        _quad("wall", Finish(albedo="paint"), [[-4, 0, -2], [4, 0, -2], [4, 3, -2], [-4, 3, -2]], (8.0, 3.0)),
        _ball("matt", Finish(albedo=(0.7, 0.25, 0.2)), place((1.45, 0.40, -0.9)), 0.4, 48),
        _ball("ball", GLASS, place((-0.95, 0.46, 0.1)), 0.45),
        _block("cube", place((0.25, 0.36, 0.35), 30.0), (0.6, 0.7, 0.6)),
        _torus("torus", place((1.25, 0.45, 0.2), 30.0, 70.0), 0.32, 0.11),
        _shell("shell", place((-0.15, 0.41, -0.85)), 0.4, 0.02),
        _board(lamp),
    )
    images = {"wood": _checkers((0.8, 0.62, 0.45), 0.35), "paint": _checkers((0.5, 0.68, 0.8), 0.6)}
    eye = Eye((0.0, 1.35, 3.2), (0.05, 0.45, 0.0), float(np.tan(np.radians(21.0))))
    return Room("lit", things, images, eye, lamp, (0.50, 0.55, 0.62))


def table_room() -> Room:
    """Three kinds of lights, all that they do through four kinds of glass, and no sky."""
    lamp = _lamp()
    amber = Finish(glass=True, tint=(0.96, 0.88, 0.70))
    things = (
        _quad("floor", Finish(albedo="wood"), [[-4, 0, 3], [4, 0, 3], [4, 0, -2], [-4, 0, -2]], (8.0, 5.0)),
        _quad("wall", Finish(albedo=(0.5, 0.62, 0.7)), [[-4, 0, -2], [4, 0, -2], [4, 3, -2], [-4, 3, -2]], (8.0, 3.0)),
        _ball("matt", Finish(albedo=(0.7, 0.3, 0.2)), place((0.45, 0.28, -1.05)), 0.28, 48),
        _ball("ball", GLASS, place((-1.0, 0.405, -0.1)), 0.4),
        _block("cube", place((-0.15, 0.255, 0.5), 30.0), (0.5, 0.5, 0.5)),
        _lens("lens", place((0.62, 0.42, 0.35), 40.0, 25.0), 0.34, 0.62, 0.02),
        _bottle("bottle", amber, place((1.35, 0.005, -0.35))),
        _board(lamp),
    )
    images = {"wood": _checkers((0.8, 0.66, 0.5), 0.5)}
    eye = Eye((0.0, 1.35, 3.2), (0.05, 0.35, 0.0), float(np.tan(np.radians(21.0))))
    sun = Sun((0.55, 1.0, 0.35), 12.0, (34.0, 30.0, 25.0))
    globe = Globe((-0.1, 1.75, -1.1), 0.22, (9.0, 10.0, 12.0))
    return Room("table", things, images, eye, lamp._replace(radiance=(15.0, 14.5, 14.0)), others=(globe, sun))


ROOMS: dict[str, Callable[[], Room]] = {"emissive": emissive_room, "lit": lit_room}
