"""Who answers a ray that has ended, in the order of the settings, until all of its weight is spoken for."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from . import sampling
from .optics import scattered
from .screen import NOTHING, Found
from .shading import Shader, View
from .vec import ZERO, Vec, add, scaled
from .world import OPAQUE, Hit


class Leaf(NamedTuple):
    """A ray that wants a colour."""

    origin: Vec
    direction: Vec
    blur: float
    """tangent of the half angle of its cone"""
    roughness: float
    """the sky's, as the eye sees it"""
    hit: Hit | None
    """what it ended on"""
    embedded: bool
    """in a medium, where nobody can guess better than a ray"""


class Answer(NamedTuple):
    """Colour, the share each tier gave of it, and the share that nobody knew."""

    color: Vec
    screen: float
    ray: float
    sky: float
    none: float
    confidence: float


def ask(shader: Shader, leaf: Leaf, order: tuple[str, ...], view: View, on_screen: Callable[[], Found]) -> Answer:
    """`ray` meets the opaque scene, `sky` is the environment. `view`: with the branch of the ray that ended."""
    color, left, confidence = ZERO, 1.0, 0.0
    shares = {"screen": 0.0, "ray": 0.0, "sky": 0.0}
    for tier in ("ray", *order) if leaf.embedded else order:
        if left <= 1e-6:
            break
        found = _answer(shader, leaf, tier, view, on_screen)
        weight = min(found.weight, left)
        color = add(color, scaled(found.color, weight))
        answered = weight * found.coverage
        confidence += answered * found.confidence
        shares[tier] += answered
        left -= answered
    return Answer(color, shares["screen"], shares["ray"], shares["sky"], left, confidence)


def _answer(shader: Shader, leaf: Leaf, tier: str, view: View, on_screen: Callable[[], Found]) -> Found:
    if tier == "ray":
        light = _by_ray(shader, leaf, view)
        return NOTHING if light is None else Found(light, 1.0, 1.0)
    if tier == "sky":
        known = shader.sky
        return NOTHING if known is None else Found(known.lobe(leaf.direction, leaf.roughness), 1.0, 1.0)
    if tier == "screen":
        return on_screen()
    raise NotImplementedError(f"the oracle knows no tier '{tier}'")


def _by_ray(shader: Shader, leaf: Leaf, view: View) -> Vec | None:
    """What a sharp ray has met anyway; of a blurred one, a ray of its lobe."""
    d, hit = leaf.direction, leaf.hit
    if leaf.blur > 0.0:
        d = scattered(d, leaf.blur, *sampling.pair(view.key, view.sample, sampling.ROUGH_LEAF))
        hit = shader.nearest(leaf.origin, d, OPAQUE)
    return None if hit is None else shader.radiance(hit, d, view.key, view.sample)
