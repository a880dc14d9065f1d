"""Planar probes: two pictures taken through a plane as through a window.

The plane is z = 0 of the probe's frame, and the window lies on it. Face 0 is what the mirrored eye sees on the eye's
own side, for reflections; face 1 is what the eye sees beyond the plane, for what lies behind the glass. A texel is a
place on the window, so that pictures begin exactly at the plane (what engines call an oblique near plane) and are as
fine far away on the window as close by.
"""

from __future__ import annotations

import math

from ..kernels.compile import inlined
from .volumes import smooth01

REFLECTED, BEHIND = 0, 1
_LEAST = 1e-6  # eye and point in the plane itself see nothing through it [m]
_SHIFT = 100.0  # HDRP: a lookup this far (in windows, inverse) from the shaded point is no longer the same pixel


@inlined
def seen_from(eye, face):  # type: ignore[no-untyped-def]
    """Homogeneous point that a face's picture is taken from: the eye, mirrored for the reflected one."""
    return (eye[0], eye[1], eye[2] if face == BEHIND else -eye[2], eye[3])


@inlined
def through_window(c, x):  # type: ignore[no-untyped-def]
    """Where the line from homogeneous `c` to point `x` crosses the plane z = 0: (found, x, y)."""
    w = c[3] * x[2] - c[2]
    if abs(w) < 1e-12:
        return False, 0.0, 0.0
    return True, (c[0] * x[2] - x[0] * c[2]) / w, (c[1] * x[2] - x[1] * c[2]) / w


@inlined
def window_of(eye, x, extents, radius):  # type: ignore[no-untyped-def]
    """Where a point is seen through the window.

    Args:
        eye: homogeneous, probe's frame.
        x: point in the probe's frame [m].
        extents: half size of the window, its first two.
        radius: of a disk around the point [m].

    Returns:
        (face or -1, x, y in [-1, 1], distance from the window to the point [m], radius of the disk's image as a part
        of the window's width)
    """
    if abs(x[2]) < _LEAST or abs(eye[2]) < _LEAST:
        return -1, 0.0, 0.0, 0.0, 0.0
    face = REFLECTED if (x[2] > 0.0) == (eye[2] > 0.0) else BEHIND
    c = seen_from(eye, face)
    found, u, v = through_window(c, x)
    if not found or abs(u) > extents[0] or abs(v) > extents[1]:
        return -1, 0.0, 0.0, 0.0, 0.0
    far = math.sqrt((x[0] - u) ** 2 + (x[1] - v) ** 2 + x[2] ** 2)
    smaller = abs(c[2]) / (abs(c[2]) + c[3] * abs(x[2]))
    return face, u / extents[0], -v / extents[1], far, radius * smaller / (2.0 * math.sqrt(extents[0] * extents[1]))


@inlined
def window_weight(eye, p, face, extents, x, y):  # type: ignore[no-untyped-def]
    """Fade at the window's edge of a lookup that has moved outwards from the shaded point `p` (HDRP, SampleEnv)."""
    found, u, v = through_window(seen_from(eye, face), p)
    if not found:
        return 1.0
    return _edge(x, u / extents[0]) * _edge(y, -v / extents[1])


@inlined
def _edge(x, own):  # type: ignore[no-untyped-def]
    """One axis: `x` of the lookup and of the point's `own` image, -1 .. 1 across the window."""
    if abs(x) <= abs(own):
        return 1.0
    moved = smooth01(0.5 * _SHIFT * abs(x - own))
    return 1.0 + (min(2.0 - 2.0 * abs(x), 1.0) - 1.0) * moved
