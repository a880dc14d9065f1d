"""One model of a camera for everybody: from which side and how high it looks at what, from how far, through which lens.

The camera that a stage without one gets is this model with its default numbers. Angles are in the stage's own upright:
azimuth 0 looks from the front (+Z where Y is up, -Y where Z is up), 90 from the right (+X); elevation 90 from above.
Engine world is upright already, so nothing here asks which axis that is.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from ..errors import UsageError
from ..scene import F64, Camera, Scene
from ..settings import RenderSettings

Bounds = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Lowest and highest corner [m], engine world."""
FOCAL_LENGTH = 50.0
APERTURE = (20.955, 15.2908)
"""Horizontal and vertical [tenths of a scene unit]; fallbacks of UsdGeomCamera."""
AZIMUTH, ELEVATION = 30.0, 20.0
"""Three-quarter: from the front, the right and above [degrees]."""
FIT = 1.1
"""How much larger the frame is than what it frames, as usdview's own."""
_FLAT = 0.02
"""Of its largest side: under it bounds are flat along an axis, and seen from there are a line."""
_AHEAD = 1e-3
"""Part of the bounds' diagonal: nearer than that nothing is in front of a camera."""


def see_everything(bounds: Bounds, aspect: float | None = None) -> tuple[Camera, str]:
    """A camera that frames everything, and from where, in words: what is flat like a picture from the front, all else
    from the front, the right and above, so that nothing along an axis is seen edge-on; what lies flat more from above,
    what stands flat along the depth more from the right.

    Args:
        aspect: width by height of the picture; None is that of the default film
    """
    camera = _made(bounds, RenderSettings(), _middle(bounds), bounds, aspect)
    front = _angles(bounds)[0] == 0.0
    return replace(camera, framing=True), "the front" if front else "the front, the right and above"


def orbit(scene: Scene, settings: RenderSettings, start: Camera | None = None) -> Camera:
    """The camera that the settings describe.

    Args:
        start: what they do not say is as this one has it. Where they name nothing to look at, that is the point on its
            axis nearest to the middle of everything: it turns around what it shows.

    Raises:
        UsageError: there is nothing to look at, or a lens is asked of a camera that is orthographic.
    """
    target, framed = _looked_at(scene, settings)
    aspect = settings.image_width / settings.image_height if settings.image_height else None
    if start is None:
        return _made(scene.bounds, settings, target, framed, aspect, scene.metres_per_unit)
    return _moved(start, scene, settings, target if settings.look_at != "" else None, framed, aspect)


def round_trip(scene: Scene, settings: RenderSettings, chosen: Camera, count: int) -> list[RenderSettings]:
    """Settings of so many pictures of one turn, all from the distance from which none of them cuts what it frames.

    Args:
        chosen: the camera that the scene would be seen by; it is started from where the settings name it.
    """
    start = chosen if settings.camera else None
    target, framed = _looked_at(scene, settings)
    if start is None:
        first = _angles(framed)[0] if settings.azimuth is None else settings.azimuth
    else:
        target = target if settings.look_at != "" else _ahead(start, scene)
        away = start.world_from_camera[:3, 3] - target
        first = math.degrees(math.atan2(away[0], away[2])) if settings.azimuth is None else settings.azimuth
    around = [replace(settings, azimuth=first + 360.0 * k / count) for k in range(count)]
    if settings.distance is not None or (start is not None and (settings.fit is None or start.orthographic)):
        return around
    eyes = [orbit(scene, one, start).world_from_camera[:3, 3] for one in around]
    farthest = max(float(np.linalg.norm(eye - target)) for eye in eyes) / scene.metres_per_unit
    return [replace(one, fit=None, distance=farthest) for one in around]


def _looked_at(scene: Scene, settings: RenderSettings) -> tuple[F64, Bounds]:
    """Where the camera looks [m], and what it is to frame."""
    look_at = settings.look_at
    if look_at == "":
        return _middle(scene.bounds), scene.bounds
    if isinstance(look_at, str):
        bounds = _bounds_below(scene, look_at)
        if bounds is None:
            raise UsageError(f"look_at is {look_at}, but nothing is drawn there; name a prim that is seen, or a point")
        return _middle(bounds), bounds
    engine_from_stage = np.linalg.inv(scene.stage_from_engine)
    return engine_from_stage[:3, :3] @ np.array(look_at, np.float64) + engine_from_stage[:3, 3], scene.bounds


def _bounds_below(scene: Scene, path: str) -> Bounds | None:
    """Lowest and highest corner of what is drawn of a prim and below it; None where nothing is."""
    from ..world.instances import bounds_of, take

    below = path.rstrip("/") + "/"

    def ours(name: str) -> bool:
        return name == path or name.startswith(below)

    boxes = [(mesh.points.min(axis=0), mesh.points.max(axis=0))
             for mesh in scene.meshes if ours(mesh.path) and len(mesh.points)]  # fmt: skip
    boxes += [(np.array(ball.centre) - ball.radius, np.array(ball.centre) + ball.radius)
              for ball in scene.spheres if ours(ball.path)]  # fmt: skip
    for many in scene.instances:
        chosen = np.flatnonzero([ours(name) for name in many.paths])
        if len(chosen):
            boxes.append(bounds_of(take(many, chosen)))
    for balls in scene.balls:
        chosen = np.flatnonzero([ours(name) for name in balls.paths])
        if len(chosen):
            radii = balls.radii[chosen, None]
            ends = balls.centres[chosen] - radii, balls.centres[chosen] + radii
            boxes.append((ends[0].min(axis=0), ends[1].max(axis=0)))
    if not boxes:
        return None
    low = np.min([box[0] for box in boxes], axis=0).tolist()
    high = np.max([box[1] for box in boxes], axis=0).tolist()
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])


# --- a camera of its own ------------------------------------------------------------------------------------------


def _made(
    bounds: Bounds, settings: RenderSettings, target: F64, framed: Bounds, aspect: float | None, unit: float = 1.0
) -> Camera:
    """A camera by the model alone.

    Args:
        bounds: of everything, which the far plane leaves in
        framed: what `fit` is about
        unit: metres per unit of the stage
    """
    azimuth, elevation = _angles(framed)
    azimuth = azimuth if settings.azimuth is None else settings.azimuth
    elevation = elevation if settings.elevation is None else settings.elevation
    right = _half_width(settings) or APERTURE[0] / 2 / FOCAL_LENGTH
    top = right * (APERTURE[1] / APERTURE[0] if aspect is None else 1.0 / aspect)
    window = -right, right, -top, top
    pose = _pose(azimuth, elevation)
    if settings.distance is not None:
        distance = settings.distance * unit
    else:
        fit = FIT if settings.fit is None else settings.fit
        distance = _fitting(fit, framed, target, pose, window)
    pose[:3, 3] = target + distance * pose[:3, 2]
    far = max(distance * 1.0e3, 2.0 * _reach(bounds, pose))
    return Camera("", pose, window, clipping=(distance * 1.0e-3, far))


def _angles(bounds: Bounds) -> tuple[float, float]:
    """Azimuth and elevation [degrees] from which bounds show most of what they are."""
    low, high = np.array(bounds, np.float64)
    width, height, depth = high - low
    least = _FLAT * float(max(width, height, depth))
    if depth <= least:
        return 0.0, 0.0
    return 2.0 * AZIMUTH if width <= least else AZIMUTH, 45.0 if height <= least else ELEVATION


def _pose(azimuth: float, elevation: float) -> F64:
    """Shape (4, 4): rotation of a camera that looks at the origin from these angles [degrees], upright."""
    turn, rise = math.radians(math.fmod(azimuth, 360.0)), math.radians(elevation)
    back = np.array([math.sin(turn) * math.cos(rise), math.sin(rise), math.cos(turn) * math.cos(rise)])
    across = np.array([math.cos(turn), 0.0, -math.sin(turn)])
    pose = np.eye(4)
    pose[:3, :3] = np.stack((across, np.cross(back, across), back), axis=1)
    return pose


def _half_width(settings: RenderSettings) -> float:
    """Half of the picture's width at distance 1; 0 where nobody says."""
    if settings.fov is not None:
        return math.tan(math.radians(settings.fov) / 2)
    return 0.0 if settings.focal_length is None else APERTURE[0] / 2 / settings.focal_length


def _fitting(fit: float, bounds: Bounds, target: F64, pose: F64, window: tuple[float, float, float, float]) -> float:
    """Distance to the target [m] from which a frame so much larger than the bounds shows them."""
    seen = _corners(bounds, target, pose)
    needed = np.maximum(_sideways(seen[:, 0], *window[:2]), _sideways(seen[:, 1], *window[2:])) + seen[:, 2]
    distance = fit * float(needed.max())
    if not np.ptp(seen[:, :2], axis=0).any():  # a line that is looked along, or a point
        distance = max(distance, float(seen[:, 2].max() + _AHEAD * np.ptp(seen[:, 2])))
    return distance or 1.0


def _corners(bounds: Bounds, target: F64, pose: F64) -> F64:
    """Corners of the bounds as the camera sees them, from the target, shape (8, 3) [m]: right, up, nearer."""
    low, high = np.array(bounds, np.float64)
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * (high - low) / 2
    seen: F64 = (corners + ((low + high) / 2 - target)) @ pose[:3, :3]
    return seen


def _sideways(at: F64, low: float, high: float) -> F64:
    """How far a window that reaches from `low` to `high` at distance 1 has to be for it to show a place."""
    if not low < 0.0 < high:  # a lens shifted so far that its axis is outside of the picture
        low, high = (low - high) / 2, (high - low) / 2
    return np.where(at > 0.0, at / high, at / low)


def _middle(bounds: Bounds) -> F64:
    low, high = np.array(bounds, np.float64)
    return np.asarray((low + high) / 2)


def _reach(bounds: Bounds, pose: F64) -> float:
    """How far everything may be from the camera [m]."""
    return float(np.linalg.norm(np.abs(np.array(bounds)).max(axis=0) + np.abs(pose[:3, 3])))


# --- one that starts from a camera of the stage --------------------------------------------------------------------


def _moved(
    start: Camera, scene: Scene, settings: RenderSettings, target: F64 | None, framed: Bounds, aspect: float | None
) -> Camera:
    """A camera of the stage, with what the settings say changed."""
    lensed = _with_lens(start, settings, aspect)
    named = settings.azimuth, settings.elevation, settings.distance, settings.fit
    if target is None and all(value is None for value in named):
        return lensed
    target = _ahead(start, scene) if target is None else target
    away = start.world_from_camera[:3, 3] - target
    distance = before = float(np.linalg.norm(away)) or 1.0
    azimuth = math.degrees(math.atan2(away[0], away[2])) if settings.azimuth is None else settings.azimuth
    elevation = settings.elevation
    if elevation is None:
        elevation = math.degrees(math.asin(max(-1.0, min(1.0, away[1] / distance))))
    pose = _pose(azimuth, elevation)
    window = _conformed(lensed.window, aspect)
    if settings.distance is not None:
        distance = settings.distance * scene.metres_per_unit
    elif settings.fit is not None and start.orthographic:
        seen = _corners(framed, target, pose)
        factor = settings.fit * max(_sideways(seen[:, 0], *window[:2]).max(), _sideways(seen[:, 1], *window[2:]).max())
        lensed = replace(lensed, window=_scaled(lensed.window, float(factor) or 1.0))
    elif settings.fit is not None:
        distance = _fitting(settings.fit, framed, target, pose, window)
    pose[:3, 3] = target + distance * pose[:3, 2]
    near, far = start.clipping
    focus = start.focus_distance + distance - before  # what is looked at stays as sharp as it was
    return replace(
        lensed, world_from_camera=pose, clipping=(near, max(far, 2.0 * _reach(scene.bounds, pose))),
        focus_distance=focus if focus > 0.0 else start.focus_distance,
    )  # fmt: skip


def _ahead(start: Camera, scene: Scene) -> F64:
    """The point before a camera that is nearest to the middle of everything [m]."""
    eye, forward = start.world_from_camera[:3, 3], -start.world_from_camera[:3, 2]
    ahead = float((_middle(scene.bounds) - eye) @ forward)
    diagonal = float(np.linalg.norm(np.array(scene.bounds[1]) - np.array(scene.bounds[0])))
    return np.asarray(eye + max(ahead, _AHEAD * diagonal) * forward)


def _with_lens(start: Camera, settings: RenderSettings, aspect: float | None) -> Camera:
    """The camera with the lens that the settings ask for."""
    half = _half_width(settings)
    if not half:
        return start
    if start.orthographic:
        name = "fov" if settings.fov is not None else "focal_length"
        raise UsageError(f"{name} says how wide a lens sees, but camera {start.path} is orthographic; leave it out")
    left, right, _, _ = _conformed(start.window, aspect)
    return replace(start, window=_scaled(start.window, 2.0 * half / (right - left)))


def _scaled(window: tuple[float, float, float, float], factor: float) -> tuple[float, float, float, float]:
    left, right, bottom, top = window
    return left * factor, right * factor, bottom * factor, top * factor


def _conformed(
    window: tuple[float, float, float, float], aspect: float | None
) -> tuple[float, float, float, float]:
    """What a picture of this aspect shows of it and around it, as `camera.view_of` has it."""
    left, right, bottom, top = window
    wide, high = right - left, top - bottom
    if aspect is None or not (wide > 0.0 and high > 0.0):
        return window
    more_x, more_y = max(0.0, high * aspect - wide) / 2, max(0.0, wide / aspect - high) / 2
    return left - more_x, right + more_x, bottom - more_y, top + more_y
