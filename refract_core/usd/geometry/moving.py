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
_BEYOND = 1.0
"""Time codes before the first sample and after the last in which they do so, too."""


def points_at(prim: Usd.Prim, time: Usd.TimeCode) -> Any:
    """`points` at a time, as USD returns them: by velocities where there are as many at the same sample."""
    geometry = UsdGeom.PointBased(prim)
    if _holds(geometry.GetVelocitiesAttr(), time.GetValue()):
        return geometry.ComputePointsAtTime(time, time)
    return geometry.GetPointsAttr().Get(time)


def flies(attribute: Usd.Attribute) -> bool:
    """A velocity, or the like, is sampled; USD takes none without a time."""
    return bool(attribute) and attribute.GetNumTimeSamples() > 0


def _holds(attribute: Usd.Attribute, time: float) -> bool:
    """Something flies by it then: between its samples, and up to a time code before the first and after the last, for
    shutters that are open there. What ended long ago stands."""
    if not flies(attribute):
        return False
    before, after = attribute.GetBracketingTimeSamples(time)
    return bool(before < after or abs(time - before) <= _BEYOND)


def moves_between(attribute: Usd.Attribute, first: float, last: float) -> bool:
    """Whether a velocity, or the like, that holds anywhere in a span of time is not 0."""
    times = (first, *attribute.GetTimeSamplesInInterval(Gf.Interval(first, last)))
    return any(_holds(attribute, time) and np.any(np.asarray(attribute.Get(time) or 0.0)) for time in times)
