"""How far light goes through the bodies of a material whose colour tints a surface, without a distance of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...scene import Balls, Instances, Material, Mesh, Notice, Sphere
from ...world.instances import some_placed
from ...world.solid import mean_way

_LOOKED_AT = 64
"""Places of a mesh that are measured; of more, an even choice stands for all."""


def with_ways(
    materials: Sequence[Material], meshes: Sequence[Mesh], spheres: Sequence[Sphere], instances: Sequence[Instances],
    balls: Sequence[Balls], metres_per_unit: float, notices: list[Notice],
) -> list[Material]:  # fmt: skip
    """The materials, of which those that tint have their colour after the mean way through a body: of several the
    median."""
    ways: dict[int, list[float]] = {m: [] for m, material in enumerate(materials) if material.tints}
    for mesh in meshes if ways else ():
        if (used := _only_one(mesh)) in ways:
            ways[used].append(mean_way(mesh.points.astype(np.float64), mesh.triangles))
    for many in instances if ways else ():
        if (used := _only_one(many.mesh)) in ways:
            some = [mean_way(mesh.points.astype(np.float64), mesh.triangles) for mesh in some_placed(many, _LOOKED_AT)]
            ways[used].extend(np.repeat(some, -(-len(many) // len(some))).tolist())
    for cloud in balls:
        if cloud.material in ways:
            ways[cloud.material].extend((4.0 / 3.0 * cloud.radii.astype(np.float64)).tolist())
    for ball in spheres:
        if ball.material in ways:
            ways[ball.material].append(4.0 / 3.0 * ball.radius)
    told = list(materials)
    for m, found in ways.items():
        through = [way for way in found if way > 0.0]
        if not through:
            continue
        distance = float(np.median(through))
        told[m] = replace(materials[m], absorption_distance=distance)
        text = "has a transmission colour without a depth, which tints a surface; it is read as the colour left after "
        text += f"{distance / metres_per_unit:.3g} scene units, the mean way through its bodies; author a depth"
        notices.append(Notice(materials[m].name, text))
    return told


def _only_one(mesh: Mesh) -> int:
    """The material that a closed mesh is made of; -1 where there is none, or are several."""
    used = int(mesh.materials[0]) if len(mesh.materials) and mesh.closed else -1
    return used if (mesh.materials == used).all() else -1
