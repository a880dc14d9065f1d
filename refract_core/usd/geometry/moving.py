"""Points that fly: where they are between two samples by their velocities and accelerations.

Source: UsdGeomPointBased, where they win over the sample that comes next, by USD's own ComputePointsAtTime:
p + v dt + a dt^2 / 2, with dt since the sample before, in seconds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from pxr import Gf, Usd, UsdGeom

FLIGHT = ("velocities", "accelerations", "angularVelocities")
"""Attributes of point-based prims and point instancers that move things between two samples."""


def points_at(prim: Usd.Prim, time: Usd.TimeCode) -> Any:
    """`points` at a time, as USD returns them: by velocities where there are as many at the same sample."""
    geometry = UsdGeom.PointBased(prim)
    if flies(geometry.GetVelocitiesAttr()):
        return geometry.ComputePointsAtTime(time, time)
    return geometry.GetPointsAttr().Get(time)


def flies(attribute: Usd.Attribute) -> bool:
    """A velocity, or the like, is sampled; USD takes none without a time."""
    return bool(attribute) and attribute.GetNumTimeSamples() > 0


def moves_between(attribute: Usd.Attribute, first: float, last: float) -> bool:
    """Whether a velocity, or the like, that holds anywhere in a span of time is not 0."""
    times = (first, *attribute.GetTimeSamplesInInterval(Gf.Interval(first, last, False, False)))
    return any(np.any(np.asarray(attribute.Get(time) or 0.0)) for time in times)
