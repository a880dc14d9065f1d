"""From the entry of a refractive surface to where light leaves it: a closed model, or a walk from face to face.

`meet` says what an interface does, with both of its branches; `Walk.follow` takes one: through where light gets
through, back where it does not. A tree would take both, by `Split.reflectance`.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

from refract_core.scene import Model, Param, Scene

from . import optics
from .optics import Split, absorbed, entering, leaving
from .shading import Shader
from .surface import Surface, color, number, shading_normal
from .vec import Vec, dot, mul, scaled, sub, unit
from .world import GLASS, NEAR, OPAQUE, Hit, first

_MOST_INTERFACES = 24
_FORGOTTEN = 8
"""After so many reflections, each of which may double an error, float32 does not say any more where a ray is."""
_LEAST_THICKNESS = 1e-4
_CONTACT = (4e-5, 4e-6)
"""Glass stands on a table where they are nearer than this: relative to the place, and in metres."""


class Status(Enum):
    LEFT = 0
    EMBEDDED = 1
    """met something opaque inside"""
    LOST = 2


class Medium(NamedTuple):
    """What a ray is in."""

    thing: int
    ior: float
    tint: Vec
    distance: float


class Entry(NamedTuple):
    """The refraction attributes where a view ray meets glass."""

    model: Model
    thickness: float
    medium: Medium
    abbe: float


class Exit(NamedTuple):
    """Where the tiers take over. EMBEDDED: the ray from point along direction meets an opaque surface inside."""

    status: Status
    point: Vec
    direction: Vec
    path: float
    transmittance: Vec


def entry_at(scene: Scene, hit: Hit, override: str) -> Entry:
    m = scene.materials[hit.face.material]
    model = Model[override.upper()] if override else m.model
    if model is Model.TRACED and hit.face.sheet:
        model = Model.THIN  # an open mesh has no far side
    thickness = max(_LEAST_THICKNESS, number(scene, hit, m, Param.THICKNESS))
    medium = _medium(scene, hit)
    if model is Model.THIN:
        thickness = optics.THIN
        medium = medium._replace(distance=optics.THIN)
    return Entry(model, thickness, medium, m.abbe)


def _medium(scene: Scene, hit: Hit) -> Medium:
    m = scene.materials[hit.face.material]
    ior = max(1.0, number(scene, hit, m, Param.IOR))
    return Medium(hit.face.thing, ior, color(scene, hit, m, Param.TRANSMITTANCE), m.absorption_distance)


def exit_of(shader: Shader, s: Surface, entry: Entry, ior: float, measured: bool) -> Exit:
    """For one index. `measured`: a model's way ends at opaque things inside, which HDRP does not look for."""
    if entry.model is Model.TRACED:
        return Walk(shader, s, entry, ior).follow()
    passage = _passage(s, entry, ior)
    medium = entry.medium
    if measured and passage.path > 0.0:
        inside = unit(sub(passage.point, s.point))
        stop = shader.nearest(s.point, inside, OPAQUE, passage.path)
        if stop is not None:
            left = absorbed(medium.tint, medium.distance, stop.t)
            return Exit(Status.EMBEDDED, s.point, inside, stop.t, left)
    left = absorbed(medium.tint, medium.distance, passage.path)
    return Exit(Status.LEFT, passage.point, passage.direction, passage.path, left)


def _passage(s: Surface, entry: Entry, ior: float) -> optics.Passage:
    if entry.model is Model.SPHERE:
        return optics.through_sphere(s.point, s.ns, s.wo, ior, entry.thickness)
    if entry.model in (Model.BOX, Model.THIN):
        return optics.through_slab(s.point, s.ns, s.wo, ior, entry.thickness)
    return optics.Passage(0.0, s.point, scaled(s.wo, -1.0))


class Walk:
    """A ray on its way through meshes."""

    def __init__(self, shader: Shader, s: Surface, entry: Entry, ior: float) -> None:
        self.shader, self.scene = shader, shader.scene
        self.medium: Medium | None = entry.medium._replace(ior=ior)
        self.point = s.point
        self.path = 0.0
        self.left = (1.0, 1.0, 1.0)
        self.direction = self._branch(entering(scaled(s.wo, -1.0), s.ns, s.ng, ior))

    def follow(self) -> Exit:
        status = Status.LOST
        for met in range(_MOST_INTERFACES):
            self.shader.unsure = self.shader.unsure or met >= _FORGOTTEN
            hit = self._next()
            if hit is None:
                status = Status.LEFT
            elif hit.face.kind == OPAQUE:
                status = Status.LEFT if self.medium is None else Status.EMBEDDED
                self._absorb(hit.t)
            if status is not Status.LOST:
                break
            assert hit is not None
            self._meet(hit)
        return Exit(status, self.point, self.direction, self.path, self.left)

    def _next(self) -> Hit | None:
        """What is met; inside glass, an opaque surface that touches the glass there comes first."""
        o, d = self.point, self.direction
        hits = self.shader.world.candidates(o, d, NEAR, float("inf"), OPAQUE | GLASS)
        hit = first(hits, self._present)
        if hit is None or self.medium is None:
            return hit
        near = _CONTACT[0] * max(abs(c) for c in hit.point) + _CONTACT[1]
        touching = [h for h in hits if h.face.kind == OPAQUE and abs(h.t - hit.t) <= near]
        return first(touching, self._present) or hit

    def _present(self, hit: Hit) -> bool:
        return self.shader.present(hit, self.point, self.direction, None)

    def _meet(self, hit: Hit) -> None:
        """One interface of glass: out of the medium, into one, or past."""
        d, face = self.direction, hit.face
        material = self.scene.materials[face.material]
        outward = dot(hit.ng, d) > 0.0
        pane = face.sheet or material.model is Model.THIN
        self._absorb(hit.t)
        if self.medium is not None and face.thing == self.medium.thing and outward:
            n = shading_normal(self.scene, hit, material)
            split = leaving(d, n, hit.ng, self.medium.ior)
            if split.transmitted is not None:
                self.medium = None
            self.direction = self._branch(split)
        elif self.medium is None and not outward and not pane:
            self.medium = _medium(self.scene, hit)
            n = shading_normal(self.scene, hit, material)
            self.direction = self._branch(entering(d, n, hit.ng, self.medium.ior))
        elif self.medium is None and pane:
            self.left = mul(self.left, self._through_pane(hit))
        self.point = hit.point

    def _through_pane(self, hit: Hit) -> Vec:
        """What a thin pane on the way leaves: as long a way as a bent ray has inside, though it is crossed straight."""
        material = self.scene.materials[hit.face.material]
        ior = max(1.0, number(self.scene, hit, material, Param.IOR))
        cosine = max(1e-5, math.sqrt(1.0 - (1.0 - dot(hit.ng, self.direction) ** 2) / ior**2))
        return absorbed(color(self.scene, hit, material, Param.TRANSMITTANCE), optics.THIN, optics.THIN / cosine)

    def _absorb(self, length: float) -> None:
        if self.medium is not None:
            self.path += length
            self.left = mul(self.left, absorbed(self.medium.tint, self.medium.distance, length))

    @staticmethod
    def _branch(split: Split) -> Vec:
        return split.transmitted if split.transmitted is not None else split.reflected
