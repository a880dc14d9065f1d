"""The view ray that all others of a picture start as: in air, or in the bodies that the eye is in."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..models import BY_TOKEN, Behind
from ..scene import Camera, Material, Mesh, Param, Scene
from ..world.instances import around, numbered, placed
from ..world.solid import encloses
from .rays import MOST_MEDIA, Rays, add_medium, ray_in_air


def view_ray(scene: Scene, camera: Camera, model: str) -> Rays:
    """One row: a ray of the whole light, without place or direction.

    The eye is in every closed body that winds around it and has a face of traced glass, the first of which says what
    fills the body; the smallest is entered last, and is what the ray is said to have entered. An orthographic camera
    has no eye.

    Args:
        model: token that overrides all materials' models, or ''.
    """
    ray = ray_in_air()
    if camera.orthographic:
        return ray
    eye = camera.world_from_camera[:3, 3]
    traced = np.array([_is_traced(material, model) for material in scene.materials], np.bool_)
    bodies: list[tuple[float, int, Material]] = []
    for thing, mesh in enumerate(scene.meshes):
        filling = _filling(mesh, traced)
        if filling >= 0 and encloses(mesh.points, mesh.triangles, eye):
            bodies.append((float(np.prod(np.ptp(mesh.points, axis=0))), thing, scene.materials[filling]))
    for k, ball in enumerate(scene.spheres):
        if traced[ball.material] and math.dist(ball.centre, eye) < ball.radius:
            bodies.append(((2.0 * ball.radius) ** 3, len(scene.meshes) + k, scene.materials[ball.material]))
    instances, clouds = numbered(scene)
    for first, many in instances:
        filling = _filling(many.mesh, traced)
        for k in around(many, eye) if filling >= 0 else ():
            size = float(np.prod(np.ptp(placed(many, k).points, axis=0)))
            bodies.append((size, first + k, scene.materials[filling]))
    for first, balls in clouds:
        for k in around(balls, eye) if traced[balls.material] else ():
            bodies.append(((2.0 * float(balls.radii[k])) ** 3, first + k, scene.materials[balls.material]))
    for _, thing, material in sorted(bodies, key=lambda body: -body[0])[-MOST_MEDIA:]:
        r, g, b = (float(c) for c in material.inputs[Param.TRANSMITTANCE].value[:3])
        ior = max(1.0, float(material.inputs[Param.IOR].value[0]))
        ray.thing[:] = thing
        add_medium(ray.media, 0, thing, material.priority, ior, material.abbe, (r, g, b), material.absorption_distance)
    return ray


def _filling(mesh: Mesh, traced: NDArray[np.bool_]) -> int:
    """The material that fills a body; -1 where the mesh is none of traced glass."""
    of_glass = traced[mesh.materials]
    return int(mesh.materials[of_glass.argmax()]) if mesh.closed and of_glass.any() else -1


def _is_traced(material: Material, model: str) -> bool:
    return material.refractive and (BY_TOKEN[model] if model else material.model).behind is Behind.MESH
