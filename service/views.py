"""Where a camera stands, in the numbers of the camera model: from what a viewer that turns around a thing starts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from refract_core.scene import F64, Scene

_LONGEST = 1024
"""Letters of a path that a request may have."""
_AHEAD = 1e-3
"""Part of the bounds' diagonal: nearer than that nothing is in front of a camera."""


def start_of(scene: Scene, name: str) -> dict[str, Any] | None:
    """The camera that the stage has for a picture, as `models.View`; None for one that stands nowhere.

    It looks at the point of its axis that is nearest to the middle of the glass, which a room is not turned around
    with; without any, of everything. Numbers are those of the camera
    model: degrees in engine world, which is upright, and the stage's own units and axes.

    Args:
        name: prim path or name of the camera; '' is the stage's choice.
    """
    from refract_core.rendering.ready import choose_camera

    camera = choose_camera(scene, name)
    eye, back = camera.world_from_camera[:3, 3], camera.world_from_camera[:3, 2]
    low, high = _glass(scene)
    least = _AHEAD * float(np.linalg.norm(high - low))
    away = max(float((eye - (low + high) / 2) @ back), least) * back
    distance = float(np.linalg.norm(away)) or 1.0
    target = scene.stage_from_engine[:3, :3] @ (eye - away) + scene.stage_from_engine[:3, 3]
    left, right = camera.window[:2]
    if not np.isfinite([distance, *target, right - left]).all() or len(camera.path) > _LONGEST:
        return None
    return {
        "camera": camera.path,
        "azimuth": math.degrees(math.atan2(away[0], away[2])),
        "elevation": math.degrees(math.asin(max(-1.0, min(1.0, away[1] / distance)))),
        "distance": distance / scene.metres_per_unit,
        "look_at": target.tolist(),
        "width": right - left,
        "orthographic": camera.orthographic,
    }


def _glass(scene: Scene) -> F64:
    """Lowest and highest corner of all glass, shape (2, 3) [m]; of everything where there is none."""
    from refract_core.world.instances import bounds_of

    clear = [row for row, material in enumerate(scene.materials) if material.refractive]
    meshes = [mesh for mesh in scene.meshes if len(mesh.points) and np.isin(mesh.materials, clear).any()]
    boxes = [(mesh.points.min(axis=0), mesh.points.max(axis=0)) for mesh in meshes]
    boxes += [bounds_of(many) for many in scene.instances if np.isin(many.mesh.materials, clear).any()]
    boxes += [(np.array(ball.centre) - ball.radius, np.array(ball.centre) + ball.radius)
              for ball in scene.spheres if ball.material in clear]  # fmt: skip
    boxes += [((balls.centres - balls.radii[:, None]).min(axis=0), (balls.centres + balls.radii[:, None]).max(axis=0))
              for balls in scene.balls if balls.material in clear]  # fmt: skip
    if not boxes:
        return np.array(scene.bounds, np.float64)
    low, high = zip(*boxes, strict=True)
    return np.array([np.min(low, axis=0), np.max(high, axis=0)], np.float64)
