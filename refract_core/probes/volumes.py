"""Volumes of reflection probes: where a ray leaves them and how much a point belongs to them.

Scalar functions for kernels. Points, directions and normals are (x, y, z) tuples in the volume's own frame (rotation
and translation only, metres), centred on the volume. `extents` is the half size of a box as any indexable of three.
Six values per face come in the order +x -x +y -y +z -z, as any indexable of six: a tuple or a row of an array.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from ..kernels.compile import inlined
from ..kernels.vec import Vec, dot, length, normalize

PARALLEL = 1e-8
"""A direction component smaller than this never reaches the planes across it."""
MIN_BLEND = 1e-4
"""Shortest blend distance [m]: 0 is a hard edge (HDRP, VolumeProjection.hlsl)."""
INFINITE_DISTANCE = 65504.0
"""Distance at which an infinite proxy is hit [m] (HDRP, LightLoop.cs)."""
MIN_SCREEN_FADE = 1e-3
"""Shortest fade at the edge of the screen (HDRP, ScreenSpaceRefraction.cs)."""


@inlined
def smooth01(x: float) -> float:
    """3 x^2 - 2 x^3 for `x` clamped to 0 .. 1."""
    s = min(max(x, 0.0), 1.0)
    return s * s * (3.0 - 2.0 * s)


@inlined
def ray_box(o: Vec, d: Vec, extents: Sequence[float]) -> float:
    """Distance along `d` at which the ray leaves the box (slab method, Kay & Kajiya 1986).

    HDRP takes the nearest far plane and so assumes an origin inside and no zero component; the same number comes
    back there. A ray from outside that crosses the box gives its far side.

    Args:
        o: Origin [m].
        d: Direction, unit if the distance shall be in metres.
        extents: Half size [m].

    Returns:
        Distance >= 0, or -1 where no point of the box lies ahead.
    """
    near, far = 0.0, math.inf
    for axis in range(3):
        if abs(d[axis]) < PARALLEL:
            if abs(o[axis]) > extents[axis]:
                return -1.0
            continue
        side = math.copysign(extents[axis], d[axis])
        near = max(near, (-side - o[axis]) / d[axis])
        far = min(far, (side - o[axis]) / d[axis])
    if far < near or far == math.inf:
        return -1.0
    return far


@inlined
def ray_sphere(o: Vec, d: Vec, radius: float) -> float:
    """Distance along unit `d` at which the ray leaves the sphere.

    Unlike HDRP's routine a ray from outside that points away gives -1, not a number without meaning.

    Args:
        o: Origin [m].
        d: Unit direction.
        radius: [m]

    Returns:
        Distance >= 0 [m], or -1 where no point of the sphere lies ahead.
    """
    b = dot(o, d)
    c = dot(o, o) - radius * radius
    squared = b * b - c
    if squared < 0.0 or (c > 0.0 and b > 0.0):
        return -1.0
    root = math.sqrt(squared)
    # Two forms of the same root, so that nothing cancels near the surface.
    return -c / (b + root) if b > 0.0 else root - b


@inlined
def normal_fade(normal: Vec, from_capture: Vec) -> float:
    """1 where the surface faces the capture point, 0 where it turns away (HDRP, ImageBasedLighting.hlsl)."""
    return min(max(1.5 - 2.5 * dot(normal, normalize(from_capture)), 0.0), 1.0)


@inlined
def face_weight(ray: Vec, face_fade: Sequence[float]) -> float:
    """How much the faces a ray heads for are let in: a cone of 60 to 75 degrees around each axis, times its fade."""
    total = 0.0
    for axis in range(3):
        total += min(max(4.0 * ray[axis] - 1.0, 0.0), 1.0) * face_fade[2 * axis]
        total += min(max(-4.0 * ray[axis] - 1.0, 0.0), 1.0) * face_fade[2 * axis + 1]
    return min(total, 1.0)


@inlined
def influence_box(
    p: Vec,
    normal: Vec,
    ray: Vec,
    from_capture: Vec,
    extents: Sequence[float],
    blend_distance: Sequence[float],
    blend_normal_distance: Sequence[float],
    face_fade: Sequence[float],
) -> float:
    """Weight of a box influence volume at a point, 0 .. 1 (HDRP, VolumeProjection.hlsl and LightEvaluation.hlsl).

    Continuous in `p` where the blend normal distances are 0; within them HDRP switches the normal's test on at once.

    Args:
        p: Point [m]; for refraction the exit point.
        normal: Unit normal; for refraction that of the entry.
        ray: Unit direction of the ray that asks.
        from_capture: `p` minus the capture point, same frame.
        extents: Half size [m].
        blend_distance: Depth behind each face at which the weight reaches 1 [m]; infinite for no face.
        blend_normal_distance: Depth behind each face up to which normals must face the capture point [m].
        face_fade: 0 .. 1 per face.
    """
    depth, normal_depth = 1.0, 1.0
    for face in range(6):
        axis = face // 2
        distance = extents[axis] - p[axis] if face % 2 == 0 else extents[axis] + p[axis]
        if not math.isinf(blend_distance[face]):
            depth = min(depth, distance / max(blend_distance[face], MIN_BLEND))
        normal_depth = min(normal_depth, distance / max(blend_normal_distance[face], MIN_BLEND))
    weight = max(depth, 0.0) * face_weight(ray, face_fade)
    if normal_depth < 1.0:
        weight *= normal_fade(normal, from_capture)
    return smooth01(weight)


@inlined
def influence_sphere(
    p: Vec,
    normal: Vec,
    from_capture: Vec,
    radius: float,
    blend_distance: float,
    blend_normal_distance: float,
) -> float:
    """Weight of a sphere influence volume at a point, 0 .. 1 (HDRP, VolumeProjection.hlsl and LightEvaluation.hlsl).

    Args:
        p: Point [m]; for refraction the exit point.
        normal: Unit normal; for refraction that of the entry.
        from_capture: `p` minus the capture point, same frame.
        radius: [m]
        blend_distance: Depth below the surface at which the weight reaches 1 [m]; infinite for no surface.
        blend_normal_distance: Depth up to which normals must face the capture point [m].
    """
    distance = radius - length(p)
    weight = 1.0
    if not math.isinf(blend_distance):
        weight = 1.0 - min(max(blend_distance - distance, 0.0) / max(blend_distance, MIN_BLEND), 1.0)
    if distance < blend_normal_distance:
        weight *= normal_fade(normal, from_capture)
    return smooth01(weight)


@inlined
def edge_fade(u: float, v: float, fade_length: float) -> float:
    """Weight of a screen position, 1 inside, 0 at and beyond the edge (HDRP, EdgeOfScreenFade).

    Args:
        u: 0 .. 1 across the screen.
        v: 0 .. 1 up or down the screen.
        fade_length: Screen Weight Distance, 0.001 .. 1: the fade takes half of it on each side.
    """
    steep = 1.0 / max(fade_length, MIN_SCREEN_FADE)
    return smooth01(steep * (1.0 - abs(2.0 * u - 1.0))) * smooth01(steep * (1.0 - abs(2.0 * v - 1.0)))


@inlined
def update_headroom(h: float, w: float) -> tuple[float, float]:
    """Add a weight to those spent so far (HDRP, UpdateLightingHierarchyWeights).

    Args:
        h: Weight spent, 0 .. 1.
        w: Weight asked for, >= 0.

    Returns:
        Weight spent now, at most 1, and the part of `w` that found room.
    """
    total = h + w
    spent = min(max(total, 0.0), 1.0)
    return spent, w - min(max(total - spent, 0.0), 1.0)


def distance_fade(distance: float, fade_distance: float) -> float:
    """Weight of a probe by its distance to the camera: 1 up to 0.9 `fade_distance`, 0 from it on [m] (HDRP)."""
    if distance >= fade_distance:
        return 0.0
    return min((fade_distance - distance) / (0.1 * fade_distance), 1.0)
