"""Small scenes built by hand, and a slow tracer to check fast ones against.

The *position room* is a box whose walls emit the place they stand at: the colour of a pixel tells, to float32, which
point of the wall its ray met. `where` turns colours back into points, so that a picture answers questions about rays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

import refract_core as rc
from refract_core.scene import (
    Camera,
    Environment,
    Light,
    LightKind,
    Material,
    Mesh,
    Model,
    Param,
    Probe,
    Source,
    Sphere,
    Volume,
    Wrap,
)
from refract_core.scene import Texture as Picture

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]

ROOM = 3.0
"""Half size of the rooms [m]."""

# A black, matt, non-reflecting surface: with ior 1 and roughness 1 a UsdPreviewSurface has no gloss at all.
_DEFAULTS: dict[str, Any] = {
    "DIFFUSE": 0.0, "EMISSIVE": 0.0, "SPECULAR": 0.0, "METALLIC": 0.0, "ROUGHNESS": 1.0, "CLEARCOAT": 0.0,
    "CLEARCOAT_ROUGHNESS": 0.01, "OPACITY": 1.0, "IOR": 1.0, "NORMAL": (0.0, 0.0, 1.0), "OCCLUSION": 1.0,
    "THICKNESS": 1.0, "TRANSMITTANCE": 1.0,
}  # fmt: skip

_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float64)
# Quads of a cube, counter-clockwise from outside; corner i is (i // 4, i // 2 % 2, i % 2).
_FACES = ((4, 6, 7, 5), (0, 1, 3, 2), (2, 3, 7, 6), (0, 4, 5, 1), (1, 5, 7, 3), (0, 2, 6, 4))
_QUAD_UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
_QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.uint32)


def material(name: str, model: Model = Model.NONE, **inputs: Any) -> Material:
    """A matt black material; `inputs` by `Param` name are numbers, colours or a `Source`. Fields of `Material` too."""
    fields = {k: inputs.pop(k) for k in list(inputs) if k.islower()}
    chosen = {**_DEFAULTS, **inputs}
    return Material(name, tuple(_source(chosen[p.name]) for p in Param), model, **fields)


def glass(model: Model, ior: float = 1.5, **inputs: Any) -> Material:
    """Clear, smooth glass."""
    return material("/glass", model, **{"OPACITY": 0.0, "ROUGHNESS": 0.0, "IOR": ior, **inputs})


def _source(value: Any) -> Source:
    if isinstance(value, Source):
        return value
    x, y, z = (float(v) for v in np.broadcast_to(np.asarray(value, np.float64), 3))
    return Source(value=(x, y, z, 1.0))


def quad(path: str, corners: ArrayLike, index: int = 0, **fields: Any) -> Mesh:
    """Two triangles over four corners, with `st` from 0 to 1."""
    return Mesh(
        path, np.array(corners, np.float32), _QUAD, np.full(2, index, np.int32), None, {"st": _QUAD_UV[_QUAD]}, **fields
    )


def box(path: str, half: ArrayLike, index: int, turn: F64 | None = None, centre: ArrayLike = (0, 0, 0)) -> Mesh:
    """A closed box with flat faces."""
    points = _CORNERS * np.asarray(half) @ (np.eye(3) if turn is None else turn).T + np.asarray(centre)
    triangles = np.array([t for a, b, c, d in _FACES for t in ((a, b, c), (a, c, d))], np.uint32)
    return Mesh(path, points.astype(np.float32), triangles, np.full(12, index, np.int32), closed=True)


def shell(path: str, outer: float, inner: float, index: int, steps: int = 12) -> Mesh:
    """A faceted ball with a hollow ball inside it: two latitude-longitude surfaces, the inner one turned inside out."""
    points, triangles = _globe(steps)
    both = np.concatenate([points * outer, points * inner])
    faces = np.concatenate([triangles, triangles[:, ::-1] + len(points)])
    materials = np.full(len(faces), index, np.int32)
    return Mesh(path, both.astype(np.float32), faces.astype(np.uint32), materials, closed=True)


def globe(path: str, radius: float, index: int, steps: int = 12, centre: ArrayLike = (0, 0, 0)) -> Mesh:
    """A faceted ball whose corners lie on the sphere."""
    points, triangles = _globe(steps)
    placed = (points * radius + np.asarray(centre)).astype(np.float32)
    return Mesh(path, placed, triangles.astype(np.uint32), np.full(len(triangles), index, np.int32), closed=True)


def _globe(steps: int) -> tuple[F64, NDArray[np.int64]]:
    """Points and outward triangles of a unit ball."""
    rings = [
        [math.sin(a) * math.cos(b), math.cos(a), -math.sin(a) * math.sin(b)]
        for a in np.pi * np.arange(1, steps) / steps
        for b in np.pi * np.arange(2 * steps) / steps
    ]
    points = np.array([[0.0, 1.0, 0.0], *rings, [0.0, -1.0, 0.0]])
    n, last = 2 * steps, len(points) - 1
    triangles = [[0, 1 + i, 1 + (i + 1) % n] for i in range(n)]
    for r in range(steps - 2):
        for i in range(n):
            a, b = 1 + r * n + i, 1 + r * n + (i + 1) % n
            triangles += [[a, a + n, b + n], [a, b + n, b]]
    first = 1 + (steps - 2) * n
    triangles += [[first + i, last, first + (i + 1) % n] for i in range(n)]
    return points, np.array(triangles, np.int64)


def turned(axis: ArrayLike, degrees: float) -> F64:
    """Rotation matrix (Rodrigues)."""
    x, y, z = np.asarray(axis, np.float64) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    a = math.radians(degrees)
    return np.eye(3) + math.sin(a) * k + (1 - math.cos(a)) * k @ k


def position_room() -> tuple[list[Mesh], list[Material]]:
    """Six walls that emit their own place, (p / ROOM + 1) / 2, and the one material they share (index 0)."""
    walls = []
    for i, face in enumerate(_FACES):
        points = (_CORNERS[list(face)] * ROOM).astype(np.float32)
        colours = ((points[_QUAD] / ROOM + 1) / 2).astype(np.float32)
        walls.append(Mesh(f"/wall{i}", points, _QUAD, np.zeros(2, np.int32), None, {"place": colours}))
    return walls, [material("/walls", EMISSIVE=Source(primvar="place"))]


def where(colour: NDArray[Any]) -> F64:
    """Place on the walls of the position room that a colour stands for [m]."""
    return (np.asarray(colour, np.float64)[..., :3] * 2 - 1) * ROOM


def constant_room(radiance: float = 1.0) -> tuple[list[Mesh], list[Material]]:
    """Six walls of one radiance."""
    walls, _ = position_room()
    return walls, [material("/walls", EMISSIVE=radiance)]


def checker_room() -> tuple[list[Mesh], list[Material], tuple[Picture, ...]]:
    """Six emissive checkered walls of six colours; material i belongs to wall i."""
    bright = [(1, 0.2, 0.2), (0.2, 1, 0.2), (0.2, 0.3, 1), (1, 1, 0.3), (1, 1, 1), (0.3, 1, 1)]
    y, x = np.mgrid[:256, :256]
    odd = ((x // 32 + y // 32) % 2)[..., None]
    textures, walls, materials = [], [], []
    for i, (face, colour) in enumerate(zip(_FACES, bright, strict=True)):
        rgb = np.where(odd == 1, np.array(colour), np.array(colour) / 5)
        textures.append(Picture(f"checker{i}", np.concatenate([rgb, np.ones((256, 256, 1))], 2).astype(np.float32)))
        walls.append(quad(f"/wall{i}", _CORNERS[list(face)] * ROOM, i))
        source = Source(texture=i, uv_primvar="st", wrap=(Wrap.CLAMP, Wrap.CLAMP))
        materials.append(material(f"/wall{i}", EMISSIVE=source))
    return walls, materials, tuple(textures)


def camera(
    eye: ArrayLike = (0, 0, 2.5), target: ArrayLike = (0, 0, 0), fov: float = 0.5, aspect: float = 1.0, **fields: Any
) -> Camera:
    """Looks from `eye` at `target`; `fov` is the half height of the window at distance 1."""
    eye, target = np.asarray(eye, np.float64), np.asarray(target, np.float64)
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0, 1, 0] if abs(back[1]) < 0.99 else [0, 0, -1], back)
    right /= np.linalg.norm(right)
    m = np.eye(4)
    m[:3, 0], m[:3, 1], m[:3, 2], m[:3, 3] = right, np.cross(back, right), back, eye
    return Camera("/camera", m, (-fov * aspect, fov * aspect, -fov, fov), **fields)


def light(
    kind: LightKind, centre: ArrayLike, face: ArrayLike, size: tuple[float, float], radiance: float = 1.0
) -> Light:
    """A white light at `centre` that shines along `face`."""
    frame = camera(centre, np.asarray(centre, np.float64) + np.asarray(face, np.float64)).world_from_camera
    return Light("/light", kind, (radiance,) * 3, frame, size)


def dome(radiance: float) -> Environment:
    """An environment of one radiance."""
    return Environment(np.full((16, 32, 3), radiance, np.float32))


def surrounding() -> Probe:
    """A probe at the middle of a room whose influence and proxy are the room."""
    room = Volume(np.eye(4), False, (ROOM, ROOM, ROOM))
    return Probe("/probe", "realtime", (0.0, 0.0, 0.0), room, room, resolution=64, clipping=(0.01, 100.0))


def scene(
    meshes: Sequence[Mesh], materials: Sequence[Material], spheres: Sequence[Sphere] = (), **fields: Any
) -> rc.Scene:
    """A scene in metres, with its bounds and a camera at (0, 0, 2.5)."""
    corners = [m.points.min(0) for m in meshes] + [m.points.max(0) for m in meshes]
    for ball in spheres:
        corners += [np.array(ball.centre) - ball.radius, np.array(ball.centre) + ball.radius]
    low, high = np.min(corners, 0), np.max(corners, 0)
    bounds = (tuple(map(float, low)), tuple(map(float, high)))
    base = rc.Scene(tuple(meshes), tuple(materials), tuple(spheres), cameras=(camera(),), metres_per_unit=1.0)
    return replace(base, **{"bounds": bounds, **fields})


def draw(what: rc.Scene, width: int = 64, height: int = 64, **settings: Any) -> dict[str, F32]:
    """Planes of a one-sample picture on one thread, without caustics and any studio, where what glows lights nothing,
    unless told otherwise."""
    chosen = {"samples": 1, "jobs": 1, "tiers": ("ray", "sky"), "caustics": 0, "emission_light": False,
              "studio": "none", **settings}  # fmt: skip
    return rc.render(what, rc.RenderSettings(image_width=width, image_height=height, **chosen)).planes


def view_rays(of: Camera, width: int, height: int) -> tuple[F64, F64]:
    """Origins and unit directions (H, W, 3) through pixel centres, for a camera whose aspect is the image's."""
    left, right, bottom, top = of.window
    x = left + (right - left) * (np.arange(width) + 0.5) / width
    y = top + (bottom - top) * (np.arange(height) + 0.5) / height
    m = of.world_from_camera
    plane = x[None, :, None] * m[:3, 0] + y[:, None, None] * m[:3, 1]
    if of.orthographic:
        return m[:3, 3] + plane, np.broadcast_to(-m[:3, 2], plane.shape)
    d = plane - m[:3, 2]
    return np.broadcast_to(m[:3, 3], d.shape), d / np.linalg.norm(d, axis=-1, keepdims=True)


def wall_hit(origin: F64, direction: F64, half: float = ROOM) -> F64:
    """Where rays from inside a box around the world's origin meet its walls."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (np.copysign(half, direction) - origin) / direction
    return origin + direction * np.nanmin(np.where(np.isfinite(t), t, np.inf), axis=-1, keepdims=True)


def snell(d: F64, n: F64, eta: float) -> F64 | None:
    """Direction behind an interface, built from the angle itself (sin t = eta sin i); None at total reflection."""
    cosine = -float(d @ n)
    tangent = d + cosine * n
    sine = float(np.linalg.norm(tangent)) * eta
    if sine >= 1:
        return None
    return tangent * eta - n * math.sqrt(1 - sine * sine)


def trace_mesh(mesh: Mesh, ior: float, origin: F64, direction: F64) -> tuple[F64, F64, float, int]:
    """Follow one ray through a closed mesh, triangle by triangle, until it leaves for good.

    Returns:
        Last point, last direction, length inside [m], number of total internal reflections.
    """
    corners = mesh.points.astype(np.float64)[mesh.triangles]
    a, ab, ac = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normals = np.cross(ab, ac)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    path, reflections = 0.0, 0
    for _ in range(30):
        t = _nearest(a, ab, ac, origin, direction)
        k = int(np.argmin(t))
        if not np.isfinite(t[k]):
            break
        origin = origin + t[k] * direction
        leaving = float(direction @ normals[k]) > 0
        n = -normals[k] if leaving else normals[k]
        path += float(t[k]) if leaving else 0.0
        through = snell(direction, n, ior if leaving else 1 / ior)
        if through is None:
            reflections += 1
            through = direction - 2 * float(direction @ n) * n
        direction = through
    return origin, direction, path, reflections


def _nearest(a: F64, ab: F64, ac: F64, origin: F64, direction: F64) -> F64:
    """Distance to every triangle, inf where missed (Moeller and Trumbore 1997)."""
    h = np.cross(direction, ac)
    det = (ab * h).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        s = origin - a
        u = (s * h).sum(1) / det
        q = np.cross(s, ab)
        v = (q @ direction) / det
        t = (ac * q).sum(1) / det
        return np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-7), t, np.inf)
