"""Planar probes: two pictures taken through a plane as through a window.

The plane is z = 0 of the probe's frame, and the window lies on it. Face 0 is what the mirrored eye sees on the eye's
own side, for reflections; face 1 is what the eye sees beyond the plane, for what lies behind the glass. A texel is a
place on the window, so that pictures begin exactly at the plane (what engines call an oblique near plane) and are as
fine far away on the window as close by.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from ..kernels.compile import inlined
from ..kernels.vec import Vec
from .volumes import smooth01

REFLECTED, BEHIND = 0, 1
_LEAST = 1e-6  # eye and point in the plane itself see nothing through it [m]
_SHIFT = 100.0  # HDRP: a lookup this far (in windows, inverse) from the shaded point is no longer the same pixel

Homogeneous = tuple[float, float, float, float]
"""x, y, z, w in the probe's frame: a point [m] where w is 1, a direction where it is 0"""


class WindowPlace(NamedTuple):
    """Where a point is seen through the window. It lives as long as one lookup."""

    face: int
    """REFLECTED or BEHIND; -1 where the point is not seen"""
    x: float
    """-1 .. 1 across the window, to the right"""
    y: float
    """-1 .. 1, downwards, as rows of texels go"""
    distance: float
    """from the window to the point [m]"""
    width: float
    """radius of the image of the disk around the point, as a part of the window's width"""


@inlined
def seen_from(eye: Homogeneous, face: int) -> Homogeneous:
    """Homogeneous point that a face's picture is taken from: the eye, mirrored for the reflected one."""
    return (eye[0], eye[1], eye[2] if face == BEHIND else -eye[2], eye[3])


@inlined
def through_window(c: Homogeneous, x: Vec) -> tuple[bool, float, float]:
    """Where the line from homogeneous `c` to point `x` crosses the plane z = 0: (found, x, y)."""
    # Homogeneous coordinates make one formula of both cameras: an orthographic one is a point at infinity.
    w = c[3] * x[2] - c[2]
    if abs(w) < 1e-12:
        return False, 0.0, 0.0
    return True, (c[0] * x[2] - x[0] * c[2]) / w, (c[1] * x[2] - x[1] * c[2]) / w


@inlined
def window_of(eye: Homogeneous, x: Vec, extents: Vec, radius: float) -> WindowPlace:
    """Where a point is seen through the window.

    Args:
        x: point in the probe's frame [m].
        extents: half size of the window, its first two [m].
        radius: of a disk around the point [m].
    """
    if abs(x[2]) < _LEAST or abs(eye[2]) < _LEAST:
        return WindowPlace(-1, 0.0, 0.0, 0.0, 0.0)
    # What lies on the eye's own side is seen by reflection alone; what lies beyond, only through the glass.
    face = REFLECTED if (x[2] > 0.0) == (eye[2] > 0.0) else BEHIND
    c = seen_from(eye, face)
    found, u, v = through_window(c, x)
    if not found or abs(u) > extents[0] or abs(v) > extents[1]:
        return WindowPlace(-1, 0.0, 0.0, 0.0, 0.0)
    far = math.sqrt((x[0] - u) ** 2 + (x[1] - v) ** 2 + x[2] ** 2)
    # A disk at the point looks smaller on the window by how much nearer to the eye the window is (intercept theorem).
    smaller = abs(c[2]) / (abs(c[2]) + c[3] * abs(x[2]))
    width = radius * smaller / (2.0 * math.sqrt(extents[0] * extents[1]))
    return WindowPlace(face, u / extents[0], -v / extents[1], far, width)


@inlined
def window_weight(eye: Homogeneous, p: Vec, extents: Vec, seen: WindowPlace) -> float:
    """Fade at the window's edge of a lookup that has moved outwards from the shaded point `p` (HDRP, SampleEnv)."""
    found, u, v = through_window(seen_from(eye, seen.face), p)
    if not found:
        return 1.0
    return _edge(seen.x, u / extents[0]) * _edge(seen.y, -v / extents[1])


@inlined
def _edge(x: float, own: float) -> float:
    """One axis: `x` of the lookup and of the point's `own` image, -1 .. 1 across the window."""
    if abs(x) <= abs(own):
        return 1.0
    moved = smooth01(0.5 * _SHIFT * abs(x - own))
    return 1.0 + (min(2.0 - 2.0 * abs(x), 1.0) - 1.0) * moved
