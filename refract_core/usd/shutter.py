"""The shutters of cameras: while they are open, and whether anything moves meanwhile."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import chain

from pxr import Gf, Usd, UsdGeom

from ..scene import Camera, Notice
from .geometry.moving import FLIGHT, flies, moves_between

CLOSED = (0.0, 0.0)
_OURS = ("primvars:", "inputs:", "refract:", "xformOp:")
"""What may be drawn though its file calls it custom."""


def with_shutters(
    stage: Usd.Stage, time: Usd.TimeCode, cameras: tuple[Camera, ...], notices: list[Notice]
) -> tuple[Camera, ...]:
    """The cameras with their shutters, as far as anything of the stage moves while those are open.

    Source: UsdGeomCamera, whose `shutter:open` and `shutter:close` are time codes after that of the frame.
    """
    known: dict[tuple[float, float], bool] = {CLOSED: False}
    found = []
    for camera in cameras:
        if not camera.path:  # it is none of the stage's
            found.append(camera)
            continue
        shutter = _shutter(UsdGeom.Camera(stage.GetPrimAtPath(camera.path)), time, notices)
        if shutter not in known:
            known[shutter] = moves(stage, *(time.GetValue() + at for at in shutter))
        found.append(replace(camera, shutter=shutter) if known[shutter] else camera)
    return tuple(found)


def _shutter(camera: UsdGeom.Camera, time: Usd.TimeCode, notices: list[Notice]) -> tuple[float, float]:
    """When it opens and closes; the same where it does not, where its attributes are no span of time, or where the
    stage has no such camera."""
    if not camera:
        return CLOSED
    opens, closes = (float(attribute.Get(time) or 0.0)
                     for attribute in (camera.GetShutterOpenAttr(), camera.GetShutterCloseAttr()))  # fmt: skip
    if opens == closes:
        return CLOSED
    if math.isfinite(opens) and math.isfinite(closes) and opens < closes:
        return opens, closes
    text = f"its shutter opens at {opens:g} and closes at {closes:g}, which is no span of time: it shows one instant"
    notices.append(Notice(str(camera.GetPath()), text))
    return CLOSED


def moves(stage: Usd.Stage, first: float, last: float) -> bool:
    """Whether any attribute that may be drawn has different values between two times."""
    every = chain(stage.Traverse(), *(Usd.PrimRange(prototype) for prototype in stage.GetPrototypes()))
    return any(
        _varies(attribute, first, last)
        for prim in every
        for attribute in prim.GetAuthoredAttributes()
        if _may_move(attribute) and (not attribute.IsCustom() or attribute.GetName().startswith(_OURS))
    )


def _may_move(attribute: Usd.Attribute) -> bool:
    return attribute.ValueMightBeTimeVarying() or (attribute.GetName() in FLIGHT and flies(attribute))


def _varies(attribute: Usd.Attribute, first: float, last: float) -> bool:
    """By its values at both ends and at every sample in between, for what is between two samples is between their
    values; a spline is taken to move, and a velocity that is not 0 moves."""
    if attribute.GetName() in FLIGHT:
        return moves_between(attribute, first, last)
    if attribute.HasSpline():
        return True
    within = attribute.GetTimeSamplesInInterval(Gf.Interval(first, last, False, False))
    start = attribute.Get(first)
    return any(attribute.Get(time) != start for time in (*within, last))
