"""Who answers a ray that has left the glass, in the order of the settings, until all of its weight is spoken for."""

from __future__ import annotations

from typing import NamedTuple

from . import sampling
from .optics import scattered
from .shading import Shader, View
from .vec import ZERO, Vec
from .world import OPAQUE


class Leaf(NamedTuple):
    """A ray that wants a colour."""

    origin: Vec
    direction: Vec
    blur: float
    """tangent of the half angle of its cone"""
    roughness: float
    """the sky's, as the eye sees it"""
    embedded: bool = False


class Answer(NamedTuple):
    color: Vec
    ray: float
    sky: float
    none: float
    confidence: float


def ask(shader: Shader, leaf: Leaf, order: tuple[str, ...], view: View) -> Answer:
    """`ray` meets the opaque scene, `sky` is the environment. What lies inside the glass is always asked by ray."""
    for tier in ("ray", *order) if leaf.embedded else order:
        if tier == "ray":
            color = _by_ray(shader, leaf, view)
            if color is not None:
                return Answer(color, 1.0, 0.0, 0.0, 1.0)
        elif tier == "sky":
            if shader.sky is not None:
                return Answer(shader.sky.lobe(leaf.direction, leaf.roughness), 0.0, 1.0, 0.0, 1.0)
        else:
            raise NotImplementedError(f"the oracle knows no tier '{tier}'")
    return Answer(ZERO, 0.0, 0.0, 1.0, 0.0)


def _by_ray(shader: Shader, leaf: Leaf, view: View) -> Vec | None:
    d = leaf.direction
    if leaf.blur > 0.0:
        d = scattered(d, leaf.blur, *sampling.pair(view.key, view.sample, sampling.ROUGH_LEAF))
    hit = shader.nearest(leaf.origin, d, OPAQUE)
    return None if hit is None else shader.radiance(hit, d, sampling.leaf_key(view.key), view.sample)


