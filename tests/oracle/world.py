"""What a ray meets: every triangle and every sphere is asked, nothing is sorted into a tree."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

from refract_core.scene import Material, Mesh, Model, Scene, Sphere

from .vec import Vec, at, cross, dot, facing, scaled, sub, unit, vec

OPAQUE, GLASS = 1, 2
NEAR = 2e-6
"""Where a ray that leaves a surface begins [m], so as not to meet it again."""
_EDGE = 1e-12


class Face(NamedTuple):
    """One triangle, or one sphere."""

    thing: int
    """number of its prim, meshes first"""
    part: int
    """number among the runs of one kind (solid, cut-out, glass) that each prim falls into"""
    shape: Mesh | Sphere
    number: int
    """of the triangle in its mesh"""
    material: int
    kind: int
    sheet: bool
    """both of its sides face the air"""
    a: Vec
    ab: Vec
    ac: Vec
    ng: Vec


class Hit(NamedTuple):
    """A place where a ray met a face."""

    t: float
    face: Face
    u: float
    v: float
    point: Vec
    ng: Vec
    """outward"""
    ns: Vec
    """interpolated, on the side of ng"""
    width: float = 0.0
    """of the ray's cone there [m]"""


class Body(NamedTuple):
    """The faces of one prim and the box around them."""

    low: Vec
    high: Vec
    faces: tuple[Face, ...]
    ball: tuple[Vec, float] | None
    kinds: int


class World:
    """A scene as rays see it."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.bodies: list[Body] = []
        part = 0
        for thing, mesh in enumerate(scene.meshes):
            body, part = _mesh_body(scene, mesh, thing, part)
            self.bodies.append(body)
        for k, sphere in enumerate(scene.spheres):
            self.bodies.append(_sphere_body(scene, sphere, len(scene.meshes) + k, part))
            part += 1

    def material(self, hit: Hit) -> Material:
        return self.scene.materials[hit.face.material]

    def candidates(self, origin: Vec, direction: Vec, near: float, far: float, kinds: int) -> list[Hit]:
        """All hits between two distances, nearest first, holes included."""
        found: list[tuple[float, Face, float, float]] = []
        for body in self.bodies:
            if body.kinds & kinds == 0 or not _crosses(body, origin, direction):
                continue
            if body.ball is not None:
                for t in _ball(*body.ball, origin, direction):
                    if near < t < far:
                        found.append((t, body.faces[0], 0.0, 0.0))
                continue
            for face in body.faces:
                if face.kind & kinds and (met := _triangle(face, origin, direction)) and near < met[0] < far:
                    found.append((met[0], face, met[1], met[2]))
        found.sort(key=lambda m: m[0])
        return [hit_of(*met, origin, direction) for met in found]


def first(hits: list[Hit], present: Callable[[Hit], bool]) -> Hit | None:
    return next(all_present(hits, present), None)


def all_present(hits: list[Hit], present: Callable[[Hit], bool]) -> Iterator[Hit]:
    return (hit for hit in hits if present(hit))


def hit_of(t: float, face: Face, u: float, v: float, origin: Vec, direction: Vec) -> Hit:
    point = at(origin, direction, t)
    shape = face.shape
    if isinstance(shape, Sphere):
        ng = unit(sub(point, shape.centre))
        return Hit(t, face, u, v, point, ng, ng)
    ns = face.ng
    if shape.normals is not None:
        corners = [vec(n) for n in shape.normals[face.number]]
        weights = (1.0 - u - v, u, v)
        mean = vec([sum(w * n[c] for w, n in zip(weights, corners, strict=True)) for c in range(3)])
        ns = facing(unit(mean), face.ng) if dot(mean, mean) > 0.0 else face.ng
    return Hit(t, face, u, v, point, face.ng, ns)


def _kind(material: Material) -> int:
    return OPAQUE if material.model is Model.NONE else GLASS


def _rank(material: Material, static: bool) -> int:
    """Order in which a prim's faces are split into parts."""
    if material.model is not Model.NONE:
        return 4
    return (2 if material.cutout else 0) + (0 if static else 1)


def _mesh_body(scene: Scene, mesh: Mesh, thing: int, part: int) -> tuple[Body, int]:
    ranks = [_rank(scene.materials[m], mesh.static) for m in mesh.materials]
    parts = {rank: part + k for k, rank in enumerate(sorted(set(ranks)))}
    points = [vec(p) for p in mesh.points]
    faces = []
    for i, (corners, m) in enumerate(zip(mesh.triangles, mesh.materials, strict=True)):
        a, b, c = (points[int(k)] for k in corners)
        ab, ac = sub(b, a), sub(c, a)
        kind = _kind(scene.materials[m])
        ng = unit(cross(ab, ac))
        faces.append(Face(thing, parts[ranks[i]], mesh, i, int(m), kind, not mesh.closed, a, ab, ac, ng))
    low = vec([min(p[c] for p in points) - 1e-6 for c in range(3)])
    high = vec([max(p[c] for p in points) + 1e-6 for c in range(3)])
    kinds = 0
    for face in faces:
        kinds |= face.kind
    return Body(low, high, tuple(faces), None, kinds), part + len(parts)


def _sphere_body(scene: Scene, ball: Sphere, thing: int, part: int) -> Body:
    kind = _kind(scene.materials[ball.material])
    zero = (0.0, 0.0, 0.0)
    face = Face(thing, part, ball, 0, ball.material, kind, False, zero, zero, zero, zero)
    centre, r = vec(ball.centre), ball.radius
    return Body(sub(centre, (r, r, r)), sub(centre, (-r, -r, -r)), (face,), (centre, r), kind)


def _crosses(body: Body, o: Vec, d: Vec) -> bool:
    """The whole line crosses the box (slabs, Kay and Kajiya 1986); hits decide the rest."""
    near, far = -math.inf, math.inf
    for c in range(3):
        if abs(d[c]) < 1e-300:
            if not body.low[c] <= o[c] <= body.high[c]:
                return False
            continue
        a, b = (body.low[c] - o[c]) / d[c], (body.high[c] - o[c]) / d[c]
        if a > b:
            a, b = b, a
        near, far = max(near, a), min(far, b)
    return near <= far and far >= 0.0


def _ball(centre: Vec, radius: float, o: Vec, d: Vec) -> tuple[float, ...]:
    to = sub(centre, o)
    middle = dot(to, d)
    aside = sub(to, scaled(d, middle))
    squared = radius * radius - dot(aside, aside)
    if squared <= 0.0:
        return ()
    half = math.sqrt(squared)
    return (middle - half, middle + half)


def _triangle(face: Face, o: Vec, d: Vec) -> tuple[float, float, float] | None:
    """Distance and barycentrics (Moeller and Trumbore 1997)."""
    ab, ac = face.ab, face.ac
    hx, hy, hz = d[1] * ac[2] - d[2] * ac[1], d[2] * ac[0] - d[0] * ac[2], d[0] * ac[1] - d[1] * ac[0]
    det = ab[0] * hx + ab[1] * hy + ab[2] * hz
    if det == 0.0:
        return None
    a = face.a
    sx, sy, sz = o[0] - a[0], o[1] - a[1], o[2] - a[2]
    u = (sx * hx + sy * hy + sz * hz) / det
    if u < -_EDGE or u > 1.0 + _EDGE:
        return None
    qx, qy, qz = sy * ab[2] - sz * ab[1], sz * ab[0] - sx * ab[2], sx * ab[1] - sy * ab[0]
    v = (d[0] * qx + d[1] * qy + d[2] * qz) / det
    if v < -_EDGE or u + v > 1.0 + _EDGE:
        return None
    return (ac[0] * qx + ac[1] * qy + ac[2] * qz) / det, u, v
