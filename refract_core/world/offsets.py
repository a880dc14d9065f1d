"""How far a ray stays away from the surfaces it left, passes and looks for: one reason, one place.

Points and distances go through float32 once, in Embree's records, so a hit at distance r from the origin of engine
world is misplaced by up to 6e-8 r, and by some times that after a sum of a few terms. Half of all rays restarted at
their own hit point meet the surface they left (measured, tnear 0). Every margin here is a multiple of the same reach:
`RELATIVE` of the distance, 80 times the rounding, and `ABSOLUTE` for what happens at the origin itself.
"""

from __future__ import annotations

from ..kernels.compile import inlined
from ..kernels.vec import Vec, along, dot

RELATIVE = 1e-5
ABSOLUTE = 1e-6  # [m]


@inlined
def _reach(point: Vec) -> float:
    """Margin at a point [m]: what float32 may misplace there, and a good deal more."""
    return RELATIVE * max(abs(point[0]), abs(point[1]), abs(point[2])) + ABSOLUTE


@inlined
def off_surface(point: Vec, ng: Vec, direction: Vec) -> Vec:
    """Start of a ray that leaves a surface: moved along the normal to the side it goes to [m]."""
    step = _reach(point)
    if dot(ng, direction) < 0.0:
        step = -step
    return along(point, ng, step)


@inlined
def past(t: float) -> float:
    """Where a ray goes on behind a surface that it met at distance `t` and that shall not stop it [m]."""
    return t * (1.0 + RELATIVE) + ABSOLUTE


@inlined
def short_of(t: float) -> float:
    """Where a ray towards a point at distance `t` ends, so that the surface the point lies on is not in its way [m]."""
    return t * (1.0 - 10.0 * RELATIVE)


@inlined
def tie(point: Vec) -> float:
    """Surfaces nearer to each other than this are in the same place, as where a glass stands on a table [m].

    Two hits may be off by a margin each, in either direction.
    """
    return 4.0 * _reach(point)
