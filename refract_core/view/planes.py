"""The planes of a frame while it is made: sums of colours over samples, and data that sample 0 leaves behind.

They are the frame's own arrays: `finish_tile` turns sums into values in place. Memory that no glass touches is never
written, so it costs nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.arrays import F32_2D, F32_3D, F64_2D
from ..kernels.compile import kernel
from ..kernels.vec import row, transform_direction, transform_point
from ..scene import Scene
from .camera import Tile, View, pixel_point

F32 = NDArray[np.float32]


class Planes(NamedTuple):
    """One array per AOV, shape (H, W) or (H, W, C), float32, for the life of the frame. The first group is summed, the
    second kept from sample 0; what is said of units and frames holds until `finish_tile`, which goes to the stage's."""

    beauty: F32_3D
    """(H, W, 4): radiance, and alpha"""
    mask: F32_2D
    """samples that met glass"""
    refraction: F32_3D
    """(H, W, 3): radiance that came through the nearest layer"""
    reflection: F32_3D
    """(H, W, 3): radiance that it reflected"""
    transmittance: F32_3D
    """(H, W, 3): what the glass left of the light"""
    screen: F32_2D
    """weight of a tier in what came through; so are the next three"""
    ray: F32_2D
    probe: F32_2D
    sky: F32_2D
    none: F32_2D
    """weight that no tier answered"""
    confidence: F32_2D

    normal: F32_3D
    """(H, W, 3): unit, engine world"""
    point: F32_3D
    """(H, W, 3): [stage units], stage; made by `finish_tile` alone"""
    z_depth: F32_2D
    """[m]; inf where nothing is"""
    thickness: F32_2D
    """[m]"""
    path_length: F32_2D
    """[m]"""
    layers: F32_2D
    """how many were met"""


class Finish(NamedTuple):
    """What turns sums into values."""

    share: float
    """one over the number of samples"""
    light: float
    """exposure times share"""
    unit: float
    """stage units per metre"""
    stage_from_engine: F64_2D
    """shape (4, 4), to stage units"""
    stage_rotation: F64_2D
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
def finish_tile(planes: Planes, view: View, finish: Finish, tile: Tile) -> None:
    """Sums to values over a tile, in place. `view`: that of sample 0, whose data the planes hold."""
    for y in range(tile[1], min(tile[3], view.size[1])):
        for x in range(tile[0], min(tile[2], view.size[0])):
            for c in range(3):
                planes.beauty[y, x, c] *= finish.light
            planes.beauty[y, x, 3] *= finish.share
            z = planes.z_depth[y, x]
            if z < np.inf:
                p = transform_point(finish.stage_from_engine, pixel_point(view, x + 0.5, y + 0.5, np.float64(z)))
                n = transform_direction(finish.stage_rotation, row(planes.normal[y], x))
                for c in range(3):
                    planes.point[y, x, c] = p[c]
                    planes.normal[y, x, c] = n[c]
                planes.z_depth[y, x] = z * finish.unit
            # How many samples met glass. What they saw of it is their mean, not that of all samples: at an edge a
            # transmittance is that of the glass, and the mask says how much of the pixel it covers.
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
