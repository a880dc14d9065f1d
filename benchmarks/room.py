"""A furnished room with one thing of glass in it, and nothing to shade: every surface but the glass is emissive.

So what differs between two pictures of it is refraction alone. The room is closed, 6 x 4 x 6.6 m, checkered, with five
coloured balls, of which the camera sees three; the glass stands in the origin, 2.6 m in front of the camera.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from refract_core.scene import (
    F32,
    F64,
    Camera,
    Material,
    Mesh,
    Model,
    Param,
    Probe,
    Scene,
    Source,
    Sphere,
    Texture,
    Volume,
)

ROOM = (3.0, 2.0, 3.3)
"""Half size [m]"""
EYE = (0.0, 0.0, 2.6)
"""Looks along -z [m]"""
HALF_WINDOW = float(np.tan(np.radians(25.0)))
"""Half height of the camera's window at distance 1: 50 degrees from bottom to top."""
IOR = 1.5
TRANSMITTANCE = (0.80, 0.92, 0.97)
"""What is left after ABSORPTION_DISTANCE"""
ABSORPTION_DISTANCE = 0.5
"""[m]"""
BALLS = (
    ((-1.7, -1.0, -1.9), 0.7, (0.9, 0.15, 0.1)),
    ((1.6, 0.7, -2.3), 0.6, (0.1, 0.6, 0.15)),
    ((0.3, -1.5, -1.0), 0.4, (0.95, 0.75, 0.1)),
    ((2.2, -1.1, 1.7), 0.6, (0.15, 0.3, 0.95)),
    ((-2.1, 0.9, 2.4), 0.7, (0.7, 0.2, 0.8)),
)
"""Centre [m], radius [m], radiance. The last two stand outside the picture."""
WALL_COLOURS = ((0.9, 0.5, 0.4), (0.4, 0.6, 0.9), (0.9, 0.9, 0.85), (0.6, 0.45, 0.3), (0.8, 0.8, 0.4), (0.5, 0.85, 0.7))
"""Radiance of the light squares on the walls +x -x +y -y +z -z; the dark ones have a fifth."""

_GLASS = 0
_WALLS = 1
_BALLS = 7
_TILE = 64  # texels along a tile of 2 x 2 squares, which is 1 m long


class Shape(NamedTuple):
    """A thing of glass, and the thickness an author would type for it."""

    make: Callable[[], Mesh | Sphere]
    thickness: float
    """smallest side of its bounding box; for the shell, its wall [m]"""


def room(shape: Shape, probes: tuple[Probe, ...] = ()) -> Scene:
    """The room with one thing of glass, whose material is `traced`."""
    thing = shape.make()
    meshes, spheres = [*_walls()], [*_balls()]
    if isinstance(thing, Mesh):
        meshes.append(thing)
    else:
        spheres.append(thing)
    low, high = tuple(-r for r in ROOM), ROOM
    return Scene(
        tuple(meshes), _materials(shape.thickness), tuple(spheres), _textures(), cameras=(camera(),), probes=probes,
        bounds=((low[0], low[1], low[2]), high), metres_per_unit=1.0, name="furnished room",
    )  # fmt: skip


def camera() -> Camera:
    """The eye, with a 16:9 window."""
    world_from_camera = np.eye(4)
    world_from_camera[:3, 3] = EYE
    wide = HALF_WINDOW * 16 / 9
    return Camera("/camera", world_from_camera, (-wide, wide, -HALF_WINDOW, HALF_WINDOW))


def box_volume(half: tuple[float, float, float]) -> Volume:
    """A box around the origin."""
    return Volume(np.eye(4), False, half)


def sphere_volume(radius: float) -> Volume:
    """A ball around the origin."""
    return Volume(np.eye(4), True, (radius, radius, radius))


def probe(proxy: Volume | None, resolution: int) -> Probe:
    """A probe in the middle of the glass, which serves the whole room. No proxy means an infinite one."""
    return Probe("/probe", "realtime", (0.0, 0.0, 0.0), box_volume(ROOM), proxy, resolution, clipping=(0.01, 100.0))


# ------------------------------------------------------------------------------------------------ furniture


def _walls() -> list[Mesh]:
    """Six quads that face inwards; `st` is in metres, so that squares are square."""
    walls = []
    for i in range(6):
        axis, side = i // 2, 1.0 - 2.0 * (i % 2)
        s, t = (axis + 1) % 3, (axis + 2) % 3
        points = np.zeros((4, 3))
        points[:, axis] = side * ROOM[axis]
        points[:, s] = np.array([-1.0, 1.0, 1.0, -1.0]) * ROOM[s]
        points[:, t] = np.array([-1.0, -1.0, 1.0, 1.0]) * ROOM[t]
        order = np.array([[0, 2, 1], [0, 3, 2]] if side > 0.0 else [[0, 1, 2], [0, 2, 3]], np.uint32)
        st = points[:, [s, t]].astype(np.float32)[order]
        index = np.full(2, _WALLS + i, np.int32)
        walls.append(Mesh(f"/wall{i}", points.astype(np.float32), order, index, None, {"st": st}))
    return walls


def _balls() -> list[Sphere]:
    return [Sphere(f"/ball{i}", centre, radius, _BALLS + i) for i, (centre, radius, _) in enumerate(BALLS)]


def _textures() -> tuple[Texture, ...]:
    y, x = np.mgrid[:_TILE, :_TILE] // (_TILE // 2)
    light = np.where((x + y) % 2 == 0, 1.0, 0.2)[..., None]
    ones = np.ones((_TILE, _TILE, 1))
    return tuple(
        Texture(f"checker{i}", np.concatenate([light * colour, ones], 2).astype(np.float32))
        for i, colour in enumerate(WALL_COLOURS)
    )


# Matt black that reflects nothing: a UsdPreviewSurface of ior 1 and roughness 1 has no gloss.
_MATT: dict[Param, float] = {
    **dict.fromkeys(Param, 0.0), Param.ROUGHNESS: 1.0, Param.OPACITY: 1.0, Param.IOR: 1.0, Param.NORMAL: 0.0,
    Param.THICKNESS: 1.0, Param.TRANSMITTANCE: 1.0,
}  # fmt: skip


def surface(name: str, model: Model = Model.NONE, distance: float = 1.0, **inputs: float | Source) -> Material:
    """A matt black material but for `inputs`, by name of `Param`; `distance`: of absorption [m]."""
    chosen = {**_MATT, **{Param[key]: value for key, value in inputs.items()}}
    sources = [value if isinstance(value, Source) else constant(value) for value in chosen.values()]
    sources[Param.NORMAL] = constant(0.0, 0.0, 1.0)
    return Material(name, tuple(sources), model, absorption_distance=distance)


def constant(x: float, y: float | None = None, z: float | None = None) -> Source:
    """The same number in all channels, or a colour."""
    return Source(value=(x, x if y is None else y, x if z is None else z, 1.0))


def _materials(thickness: float) -> tuple[Material, ...]:
    glass = surface(
        "/glass", Model.TRACED, ABSORPTION_DISTANCE, OPACITY=0.0, ROUGHNESS=0.0, IOR=IOR, THICKNESS=thickness,
        TRANSMITTANCE=constant(*TRANSMITTANCE),
    )  # fmt: skip
    walls = [surface(f"/wall{i}", EMISSIVE=Source(texture=i, uv_primvar="st")) for i in range(6)]
    balls = [surface(f"/ball{i}", EMISSIVE=constant(*colour)) for i, (_, _, colour) in enumerate(BALLS)]
    return (glass, *walls, *balls)


# ------------------------------------------------------------------------------------------------ glass


def globe(rings: int, segments: int) -> tuple[F64, NDArray[np.int64]]:
    """Points of a unit ball, shape (P, 3), by latitude and longitude, and its triangles, outward, shape (T, 3)."""
    a = np.pi * np.arange(1, rings)[:, None] / rings
    b = 2.0 * np.pi * np.arange(segments)[None] / segments
    ring = np.stack([np.sin(a) * np.cos(b), np.cos(a) + 0.0 * b, -np.sin(a) * np.sin(b)], -1).reshape(-1, 3)
    points = np.concatenate([[[0.0, 1.0, 0.0]], ring, [[0.0, -1.0, 0.0]]])
    here = np.arange(segments)
    after = (here + 1) % segments
    last = len(points) - 1
    bottom = last - segments
    faces = [np.stack([np.zeros_like(here), 1 + here, 1 + after], 1)]
    for first in range(1, bottom, segments):
        p, q = first + here, first + after
        faces += [np.stack([p, p + segments, q + segments], 1), np.stack([p, q + segments, q], 1)]
    faces.append(np.stack([bottom + here, np.full_like(here, last), bottom + after], 1))
    return points, np.concatenate(faces)


def smooth_mesh(points: F64, triangles: NDArray[np.int64]) -> Mesh:
    """A closed mesh of glass with the mean normal, by area, at every point."""
    corners = points[triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = np.zeros_like(points)
    for k in range(3):
        np.add.at(sums, triangles[:, k], across)
    normals: F32 = (sums / np.linalg.norm(sums, axis=1, keepdims=True)).astype(np.float32)[triangles]
    index = np.full(len(triangles), _GLASS, np.int32)
    return Mesh("/glass", points.astype(np.float32), triangles.astype(np.uint32), index, normals, closed=True)


def _sphere() -> Sphere:
    return Sphere("/glass", (0.0, 0.0, 0.0), 0.5, _GLASS)


def _cube() -> Mesh:
    """0.8 m, turned so that three of its faces are seen."""
    corner = np.array([[x, y, z] for x in (-0.4, 0.4) for y in (-0.4, 0.4) for z in (-0.4, 0.4)])
    quads = ((4, 6, 7, 5), (0, 1, 3, 2), (2, 3, 7, 6), (0, 4, 5, 1), (1, 5, 7, 3), (0, 2, 6, 4))
    triangles = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.uint32)
    yaw, pitch = np.radians(30.0), np.radians(20.0)
    about_y = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    points = (corner @ (about_x @ about_y).T).astype(np.float32)
    return Mesh("/glass", points, triangles, np.full(12, _GLASS, np.int32), closed=True)


def _blob() -> Mesh:
    """A ball with dents, 0.9 to 1 m across."""
    points, triangles = globe(96, 192)
    x, y, z = points.T
    radius = 0.48 * (1.0 + 0.12 * np.sin(3.0 * x + 1.0) * np.cos(4.0 * y) + 0.10 * np.sin(4.0 * z + 2.0 * x + 0.5))
    return smooth_mesh(points * radius[:, None], triangles)


def _torus() -> Mesh:
    """1 m across, 0.3 m thick, tilted towards the camera."""
    around, across = 192, 96
    a = 2.0 * np.pi * np.arange(around)[:, None] / around
    b = 2.0 * np.pi * np.arange(across)[None] / across
    reach = 0.35 + 0.15 * np.cos(b)
    flat = np.stack([reach * np.cos(a), 0.15 * np.sin(b) + 0.0 * a, -reach * np.sin(a)], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(around), np.arange(across), indexing="ij")
    p, q = (i * across + j).ravel(), ((i + 1) % around * across + j).ravel()
    r, s = ((i + 1) % around * across + (j + 1) % across).ravel(), (i * across + (j + 1) % across).ravel()
    triangles = np.concatenate([np.stack([p, q, r], 1), np.stack([p, r, s], 1)])
    tilt = np.radians(60.0)
    turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    return smooth_mesh(flat @ turn.T, triangles)


def _shell() -> Mesh:
    """A hollow ball, 1 m across, with a wall of 2 cm."""
    points, triangles = globe(96, 192)
    both = np.concatenate([points * 0.5, points * 0.48])
    return smooth_mesh(both, np.concatenate([triangles, triangles[:, ::-1] + len(points)]))


SHAPES: dict[str, Shape] = {
    "sphere": Shape(_sphere, 1.0),
    "cube": Shape(_cube, 0.8),
    "blob": Shape(_blob, 0.9),
    "torus": Shape(_torus, 0.3),
    "shell": Shape(_shell, 0.02),
}
