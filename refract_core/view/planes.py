"""The planes of a frame while it is made: sums of colours over samples, and data that sample 0 leaves behind.

They are the frame's own arrays: `finish_tile` turns sums into values in place. Memory that no glass touches is never
written, so it costs nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.compile import kernel
from ..kernels.vec import transform_direction, transform_point
from ..scene import Scene
from .camera import pixel_point

F32 = NDArray[np.float32]


class Planes(NamedTuple):
    """One array per AOV, shape (H, W) or (H, W, C). The first group is summed, the second kept from sample 0."""

    beauty: F32
    mask: F32
    refraction: F32
    reflection: F32
    transmittance: F32
    screen: F32
    ray: F32
    probe: F32
    sky: F32
    none: F32
    confidence: F32

    normal: F32
    point: F32
    z_depth: F32
    thickness: F32
    path_length: F32
    layers: F32


class Finish(NamedTuple):
    """What turns sums into values."""

    share: float
    """one over the number of samples"""
    light: float
    """exposure times share"""
    unit: float
    """stage units per metre"""
    stage_from_engine: NDArray[np.float64]
    stage_rotation: NDArray[np.float64]
    """shape (3, 3)"""


def new_planes(width: int, height: int) -> Planes:
    channels = {"beauty": 4, "refraction": 3, "reflection": 3, "transmittance": 3, "normal": 3, "point": 3}
    shapes = [(height, width, channels[f]) if f in channels else (height, width) for f in Planes._fields]
    return Planes(*(np.zeros(shape, np.float32) for shape in shapes))


def finish_of(scene: Scene, samples: int, exposure: float) -> Finish:
    """`exposure`: linear factor on every colour."""
    m = np.ascontiguousarray(scene.stage_from_engine, np.float64)
    rotation = np.ascontiguousarray(m[:3, :3] / np.cbrt(abs(np.linalg.det(m[:3, :3]))))
    return Finish(1.0 / samples, exposure / samples, 1.0 / scene.metres_per_unit, m, rotation)


def by_name(planes: Planes) -> dict[str, F32]:
    """AOV names (`aovs.AOVS`) to arrays."""
    return {
        "beauty": planes.beauty,
        "refraction": planes.refraction,
        "reflection": planes.reflection,
        "transmittance": planes.transmittance,
        "N": planes.normal,
        "P": planes.point,
        "Z": planes.z_depth,
        "mask": planes.mask,
        "thickness": planes.thickness,
        "path_length": planes.path_length,
        "layers": planes.layers,
        "weight.screen": planes.screen,
        "weight.ray": planes.ray,
        "weight.probe": planes.probe,
        "weight.sky": planes.sky,
        "weight.none": planes.none,
        "confidence": planes.confidence,
    }


@kernel
def finish_tile(planes, view, finish, tile):  # type: ignore[no-untyped-def]
    """Sums to values over a tile (x0, y0, x1, y1)."""
    for y in range(tile[1], min(tile[3], view.size[1])):
        for x in range(tile[0], min(tile[2], view.size[0])):
            for c in range(3):
                planes.beauty[y, x, c] *= finish.light
            planes.beauty[y, x, 3] *= finish.share
            z = planes.z_depth[y, x]
            if z < np.inf:
                p = transform_point(finish.stage_from_engine, pixel_point(view, x + 0.5, y + 0.5, np.float64(z)))
                normal = planes.normal[y, x]
                towards = (np.float64(normal[0]), np.float64(normal[1]), np.float64(normal[2]))
                n = transform_direction(finish.stage_rotation, towards)
                for c in range(3):
                    planes.point[y, x, c] = p[c]
                    planes.normal[y, x, c] = n[c]
                planes.z_depth[y, x] = z * finish.unit
            covered = planes.mask[y, x]
            if covered == 0.0:
                continue
            planes.mask[y, x] = covered * finish.share
            planes.thickness[y, x] *= finish.unit
            planes.path_length[y, x] *= finish.unit
            for c in range(3):
                planes.refraction[y, x, c] *= finish.light
                planes.reflection[y, x, c] *= finish.light
                planes.transmittance[y, x, c] /= covered
            planes.screen[y, x] /= covered
            planes.ray[y, x] /= covered
            planes.probe[y, x] /= covered
            planes.sky[y, x] /= covered
            planes.none[y, x] /= covered
            planes.confidence[y, x] /= covered


@kernel
def add_tile(planes, opaque, size, tile):  # type: ignore[no-untyped-def]
    """Add a finished sample's picture (an OpaqueLayer with its glass drawn in) to the beauty."""
    for y in range(tile[1], min(tile[3], size[1])):
        for x in range(tile[0], min(tile[2], size[0])):
            for c in range(3):
                planes.beauty[y, x, c] += opaque.color[y, x, c]
            planes.beauty[y, x, 3] += opaque.alpha[y, x]
