"""What a ray is in: bodies that overlap, of which one fills the space."""

from __future__ import annotations

import math
from typing import NamedTuple

from refract_core.scene import Model, Param, Scene

from . import optics
from .shading import Shader
from .surface import color, number
from .vec import Vec, dot, unit
from .world import GLASS, OPAQUE, Face, Hit

MOST = 6
"""Bodies that a ray can be in; one more is passed straight."""
_LEAST_THICKNESS = 1e-4
_CORNERS = tuple(unit((x, y, z)) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0))
_ENOUGH = 5
"""Of the eight rays to the corners, those that must say that the eye is in a body."""


class Medium(NamedTuple):
    """One entry of a ray into a body, by the attributes it has where it was entered."""

    thing: int
    priority: int
    ior: float
    abbe: float
    tint: Vec
    distance: float


Media = tuple[Medium, ...]
"""In the order they were entered."""


def filling(media: Media) -> Medium | None:
    """The one of highest priority; of equals the one entered last. None: air."""
    found: Medium | None = None
    for m in media:
        if found is None or m.priority >= found.priority:
            found = m
    return found


def without(media: Media, thing: int) -> tuple[Medium, Media]:
    """The last entry into a thing, and what is left without it."""
    k = max(k for k, m in enumerate(media) if m.thing == thing)
    return media[k], media[:k] + media[k + 1 :]


def index(m: Medium | None, channel: int) -> float:
    """That a channel finds; green's for -1, a ray of all."""
    return 1.0 if m is None else optics.iors(m.ior, m.abbe)[1 if channel < 0 else channel]


def disperses(m: Medium | None) -> bool:
    return m is not None and m.abbe > 0.0


# --- Materials ------------------------------------------------------------------------------------------------------


def model_at(scene: Scene, hit: Hit, override: str) -> Model:
    return _model_of(scene, hit.face, override)


def _model_of(scene: Scene, face: Face, override: str) -> Model:
    """An open mesh has no far side to be traced to."""
    model = Model[override.upper()] if override else scene.materials[face.material].model
    return Model.THIN if model is Model.TRACED and face.sheet else model


def medium_at(scene: Scene, hit: Hit, model: Model) -> Medium:
    m = scene.materials[hit.face.material]
    ior = max(1.0, number(scene, hit, m, Param.IOR))
    distance = optics.THIN if model is Model.THIN else m.absorption_distance
    tint = color(scene, hit, m, Param.TRANSMITTANCE)
    return Medium(hit.face.thing, m.priority, ior, m.abbe, tint, distance)


def thickness_at(scene: Scene, hit: Hit, model: Model) -> float:
    if model is Model.THIN:
        return optics.THIN
    return max(_LEAST_THICKNESS, number(scene, hit, scene.materials[hit.face.material], Param.THICKNESS))


# --- The eye --------------------------------------------------------------------------------------------------------


def media_around(shader: Shader, eye: Vec, override: str) -> Media:
    """Closed bodies with traced faces that the eye is in, the largest first. Each has the attributes of the glass of
    the first such face, at the nearest place where one of the eight rays leaves it."""
    scene = shader.scene
    glasses = _glasses(shader, override)
    votes: dict[int, int] = {}
    exits: dict[int, Hit] = {}
    for d in _CORNERS:
        more: dict[int, int] = {}
        for hit in shader.world.candidates(eye, d, 0.0, float("inf"), OPAQUE | GLASS):
            if hit.face.thing not in glasses:
                continue
            thing, leaves = hit.face.thing, dot(hit.ng, d) > 0.0
            more[thing] = more.get(thing, 0) + (1 if leaves else -1)
            if leaves and (thing not in exits or hit.t < exits[thing].t):
                exits[thing] = hit
        for thing, count in more.items():
            votes[thing] = votes.get(thing, 0) + (count > 0)
    around = sorted((thing for thing, n in votes.items() if n >= _ENOUGH), key=lambda thing: -_bounds(shader, thing))
    return tuple(medium_at(scene, _of_glass(exits[thing], glasses[thing]), Model.TRACED) for thing in around[-MOST:])


def _of_glass(hit: Hit, material: int) -> Hit:
    return hit._replace(face=hit.face._replace(material=material))


def _glasses(shader: Shader, override: str) -> dict[int, int]:
    """The material of the first traced face of each thing that has one."""
    found: dict[int, int] = {}
    for body in shader.world.bodies:
        for face in body.faces:
            if face.kind == GLASS and _model_of(shader.scene, face, override) is Model.TRACED:
                found.setdefault(face.thing, face.material)
    return found


def _bounds(shader: Shader, thing: int) -> float:
    """Volume of the box around a body."""
    body = shader.world.bodies[thing]
    return math.prod(high - low for low, high in zip(body.low, body.high, strict=True))
