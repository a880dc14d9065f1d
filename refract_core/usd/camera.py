"""Cameras of a stage, which one is meant, and one that frames everything where there is none."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pxr import Gf, Usd, UsdGeom, UsdRender

from ..errors import UsageError
from ..scene import F64, Camera, Notice
from ..view.orbit import APERTURE, FOCAL_LENGTH, Bounds, see_everything
from .settings import authored_value
from .values import numbers

MAIN_CAMERA = "main_cam"
_TENTH = 0.1
"""Scene units of what a UsdGeomCamera's lens and film are measured in."""
_SAVED_CAMERAS = "/OmniverseKit_"
"""How the names of Omniverse's own cameras begin, which it does not save as prims."""
_SAVED_AXES = {"Front": 2, "Right": 0, "Top": 1}
"""Along which those look that are orthographic, where Y is up; where Z is, all are turned on by one."""
_SAVED_FOCAL_LENGTH = 18.147562
"""Of the view that Omniverse's applications open a stage with, over the same aperture."""


def read_cameras(
    stage: Usd.Stage,
    time: Usd.TimeCode,
    *,
    engine_from_stage: F64,
    metres_per_unit: float,
    notices: list[Notice],
) -> tuple[Camera, ...]:
    """Every camera of the stage, by path.

    Args:
        engine_from_stage: shape (4, 4), column vectors, stage world units to engine metres
    """
    cache = UsdGeom.XformCache(time)
    found = []
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        if not prim.IsA(UsdGeom.Camera):
            continue
        matrix = cache.GetLocalToWorldTransform(prim)
        camera = _read(UsdGeom.Camera(prim), time, matrix, engine_from_stage, metres_per_unit, notices)
        if camera is not None:
            found.append(camera)
    return tuple(sorted(found, key=lambda camera: camera.path))


def _read(
    camera: UsdGeom.Camera,
    time: Usd.TimeCode,
    matrix: Gf.Matrix4d,
    engine_from_stage: F64,
    metres_per_unit: float,
    notices: list[Notice],
) -> Camera | None:
    """One camera in engine world; None, and a notice, where its transform gives no pose."""
    path = str(camera.GetPath())
    pose = _rigid(matrix, engine_from_stage)
    if pose is None:
        notices.append(Notice(path, "skipped: its transform is singular or not finite"))
        return None
    orthographic = camera.GetProjectionAttr().Get(time) == UsdGeom.Tokens.orthographic
    focal = _positive(camera.GetFocalLengthAttr(), time, FOCAL_LENGTH, notices)
    across = _positive(camera.GetHorizontalApertureAttr(), time, APERTURE[0], notices)
    upward = _positive(camera.GetVerticalApertureAttr(), time, APERTURE[1], notices)
    shift = [
        _finite(attribute, time, 0.0, notices)
        for attribute in (camera.GetHorizontalApertureOffsetAttr(), camera.GetVerticalApertureOffsetAttr())
    ]
    # An orthographic aperture is a length in the scene: tenths of a unit.
    unit = _TENTH * metres_per_unit if orthographic else 1.0 / focal
    return Camera(
        path=path,
        world_from_camera=pose,
        window=(
            (shift[0] - across / 2) * unit,
            (shift[0] + across / 2) * unit,
            (shift[1] - upward / 2) * unit,
            (shift[1] + upward / 2) * unit,
        ),
        orthographic=orthographic,
        clipping=_clipping(camera, time, orthographic, metres_per_unit, notices),
        exposure_scale=_exposure(camera, time, notices),
        **_lens(camera, time, orthographic, focal, metres_per_unit, notices),
    )


def _lens(
    camera: UsdGeom.Camera, time: Usd.TimeCode, orthographic: bool, focal: float, metres_per_unit: float,
    notices: list[Notice],
) -> dict[str, Any]:  # fmt: skip
    """Radius and focus of the lens, for a `Camera`; nothing where everything is in focus.

    Source: UsdGeomCamera, where fStop 0 turns it off, and apertures are focalLength / fStop wide.
    """
    stops = _finite(camera.GetFStopAttr(), time, 0.0, notices)
    if stops <= 0.0 or _switched_off(camera, "disableDepthOfField"):
        return {}
    focus = _finite(camera.GetFocusDistanceAttr(), time, 0.0, notices)
    if focus > 0.0 and not orthographic:
        radius = focal * _TENTH / (2.0 * stops)
        return {"lens_radius": radius * metres_per_unit, "focus_distance": focus * metres_per_unit}
    why = "it is orthographic" if orthographic else f"its focusDistance is {focus:g}"
    text = f"fStop is {stops:g}, but {why}; everything is in focus"
    notices.append(Notice(str(camera.GetPath()), text))
    return {}


def _switched_off(camera: UsdGeom.Camera, name: str) -> bool:
    """Whether the stage's render settings say so by an attribute."""
    settings = UsdRender.Settings.GetStageRenderSettings(camera.GetPrim().GetStage())
    return bool(settings and authored_value(settings.GetPrim(), name))


def _rigid(matrix: Gf.Matrix4d, engine_from_stage: F64) -> F64 | None:
    """The camera's place and rotation in engine world; scale and shear of its transform mean nothing to a lens."""
    if not np.isfinite(np.array(matrix)).all() or abs(matrix.GetDeterminant()) <= 0.0:
        return None
    rotation = np.array(matrix.RemoveScaleShear().ExtractRotationMatrix()).T
    turn = engine_from_stage[:3, :3] / np.cbrt(np.linalg.det(engine_from_stage[:3, :3]))
    pose = np.eye(4)
    pose[:3, :3] = turn @ rotation
    pose[:3, 3] = (engine_from_stage @ np.append(np.array(matrix.ExtractTranslation()), 1.0))[:3]
    return pose


def _clipping(
    camera: UsdGeom.Camera, time: Usd.TimeCode, orthographic: bool, metres_per_unit: float, notices: list[Notice]
) -> tuple[float, float]:
    value = camera.GetClippingRangeAttr().Get(time)
    near, far = (float(value[0]), float(value[1])) if value is not None else (1.0, 1.0e6)
    if math.isfinite(near) and not math.isnan(far) and near < far and (orthographic or near > 0.0):
        return near * metres_per_unit, far * metres_per_unit
    text = f"clippingRange is ({near:g}, {far:g}); it must rise, and begin above 0 in perspective: nothing is clipped"
    notices.append(Notice(str(camera.GetPath()), text))
    return (-1.0e9 if orthographic else 1.0e-6, 1.0e9)


def _exposure(camera: UsdGeom.Camera, time: Usd.TimeCode, notices: list[Notice]) -> float:
    scale = float(camera.ComputeLinearExposureScale(time))
    if math.isfinite(scale) and scale > 0.0:
        return scale
    text = f"its exposure attributes give a factor of {scale:g}; it must be finite and above 0, so 1 is used"
    notices.append(Notice(str(camera.GetPath()), text))
    return 1.0


def _finite(attribute: Usd.Attribute, time: Usd.TimeCode, default: float, notices: list[Notice]) -> float:
    value = attribute.Get(time)
    if value is None:
        return default
    if math.isfinite(value):
        return float(value)
    text = f"{attribute.GetName()} is {value:g}; it must be finite, so {default:g} is used"
    notices.append(Notice(str(attribute.GetPrimPath()), text))
    return default


def _positive(attribute: Usd.Attribute, time: Usd.TimeCode, default: float, notices: list[Notice]) -> float:
    value = _finite(attribute, time, default, notices)
    if value > 0.0:
        return value
    text = f"{attribute.GetName()} is {value:g}; it must be above 0, so {default:g} is used"
    notices.append(Notice(str(attribute.GetPrimPath()), text))
    return default


def choose_camera(
    stage: Usd.Stage,
    cameras: tuple[Camera, ...],
    wanted: str,
    bounds: Bounds,
    *,
    orbits: bool,
    engine_from_stage: F64,
    metres_per_unit: float,
    notices: list[Notice],
) -> tuple[Camera, ...]:
    """The cameras with the one to use in front, and notices about what of it is ignored.

    The order of choice: `wanted` (a prim path or name), the camera of the stage's render settings, a camera named
    main_cam, the one that the stage was saved with, the first by path; where it has none, the view that it was saved
    with, and one made to frame everything.

    Args:
        orbits: the picture is taken by a camera of its own, so nothing is said of one that nobody asked for

    Raises:
        UsageError: where `wanted` is no camera of the stage.
    """
    if orbits and not wanted:
        notices = []
    chosen = _choose(stage, cameras, wanted, notices)
    if chosen is None:
        saved = _saved_view(stage, bounds, engine_from_stage, metres_per_unit, notices)
        if saved is not None:
            text = "the stage has no camera; the view it was saved with is used (customLayerData, cameraSettings)"
            notices.append(Notice("/", text))
            return (saved,)
        camera, where = see_everything(bounds)
        notices.append(Notice("/", f"the stage has no camera; one that frames everything from {where} is used"))
        return (camera,)
    return (chosen, *(camera for camera in cameras if camera is not chosen))


def _saved_with(stage: Usd.Stage) -> dict[str, Any]:
    """What Omniverse's applications write about their viewport into a stage that they save."""
    found = stage.GetRootLayer().customLayerData.get("cameraSettings")
    return found if isinstance(found, dict) else {}


def _saved_view(
    stage: Usd.Stage, bounds: Bounds, engine_from_stage: F64, metres_per_unit: float, notices: list[Notice]
) -> Camera | None:
    """The view of a viewport that a stage was saved from; None where it says nothing of use."""
    parallel = _parallel_view(stage, bounds, engine_from_stage, metres_per_unit)
    if parallel is not None:
        return parallel
    view = _saved_with(stage).get("Perspective")
    if not isinstance(view, dict):
        return None
    eye, target = numbers(view.get("position")), numbers(view.get("target"))
    ends = np.array([eye, target], np.float64) if eye and target and len(eye) == len(target) == 3 else None
    if ends is None or not np.isfinite(ends).all() or eye == target:
        text = "cameraSettings in its customLayerData name no position and target of a view; they are passed over"
        notices.append(Notice(stage.GetRootLayer().identifier, text))
        return None
    here, there = ends @ engine_from_stage[:3, :3].T + engine_from_stage[:3, 3]
    distance = float(np.linalg.norm(there - here))
    right, top = (side / 2 / _SAVED_FOCAL_LENGTH for side in APERTURE)
    reach = max(1.0e3 * distance, float(np.linalg.norm(np.abs(bounds).max(axis=0) + np.abs(here))))
    clipping = distance * 1.0e-3, 2.0 * reach
    return Camera("", _looking(here, there - here), (-right, right, -top, top), clipping=clipping)


def _parallel_view(stage: Usd.Stage, bounds: Bounds, engine_from_stage: F64, metres_per_unit: float) -> Camera | None:
    """The view from the front, the right or the top that a stage was saved in; None where it was saved in none.

    Their axes are those of the applications: the front is +Z where Y is up and +X where Z is. A view looks back along
    its axis from where it stands, and is `radius` wide.
    """
    saved = _saved_with(stage)
    name = str(saved.get("boundCamera", "")).removeprefix(_SAVED_CAMERAS)
    view = saved.get(name)
    if name not in _SAVED_AXES or not isinstance(view, dict):
        return None
    place, radius = numbers(view.get("position")), view.get("radius")
    if not place or len(place) != 3 or not np.isfinite(place).all() or not isinstance(radius, float | int):
        return None
    axis = _SAVED_AXES[name] if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y else (_SAVED_AXES[name] + 1) % 3
    if not 0.0 < radius < math.inf or place[axis] == 0.0:
        return None
    along = -np.sign(place[axis]) * np.eye(3)[axis]
    eye = engine_from_stage[:3, :3] @ np.array(place) + engine_from_stage[:3, 3]
    reach = float(np.linalg.norm(np.abs(bounds).max(axis=0) + np.abs(eye)))
    right = radius * metres_per_unit / 2.0
    top = right * APERTURE[1] / APERTURE[0]
    pose = _looking(eye, engine_from_stage[:3, :3] @ along)
    return Camera("", pose, (-right, right, -top, top), orthographic=True, clipping=(-2.0 * reach, 2.0 * reach))


def _looking(eye: F64, along: F64) -> F64:
    """A pose (4, 4) that looks from a point along a direction, upright where it can be."""
    back = -along / np.linalg.norm(along)
    across = np.cross((0.0, 1.0, 0.0), back)
    if np.linalg.norm(across) < 1.0e-6:  # straight down or up
        across = np.array([1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    pose = np.eye(4)
    pose[:3, :3] = np.stack((across, np.cross(back, across), back), axis=1)
    pose[:3, 3] = eye
    return pose


def _choose(stage: Usd.Stage, cameras: tuple[Camera, ...], wanted: str, notices: list[Notice]) -> Camera | None:
    """The camera asked for, else that of the render settings, the main one, the first; None where there is none."""
    if wanted:
        return _asked_for(cameras, wanted, notices)
    settings = UsdRender.Settings.GetStageRenderSettings(stage)
    for target in settings.GetCameraRel().GetForwardedTargets() if settings else ():
        for camera in cameras:
            if camera.path == str(target):
                return camera
        text = f"the camera {target} of the render settings is no camera of this stage; another is chosen"
        notices.append(Notice(str(settings.GetPath()), text))
    for camera in cameras:
        if _name(camera) == MAIN_CAMERA:
            return camera
    bound = str(_saved_with(stage).get("boundCamera", ""))
    for camera in cameras:
        if camera.path == bound:
            return camera
    if len(cameras) > 1:
        others = ", ".join(_paths(cameras[1:]))
        text = f"the first of the stage's cameras is used; name another to change that ({others})"
        notices.append(Notice(cameras[0].path, text))
    return cameras[0] if cameras else None


def _paths(cameras: tuple[Camera, ...]) -> list[str]:
    return [camera.path for camera in cameras[:8]] + ["..."] * (len(cameras) > 8)


def _name(camera: Camera) -> str:
    return camera.path.rpartition("/")[2]


def _asked_for(cameras: tuple[Camera, ...], wanted: str, notices: list[Notice]) -> Camera:
    matches = [camera for camera in cameras if wanted in (camera.path, _name(camera))]
    if not matches:
        known = ", ".join(_paths(cameras)) or "none at all"
        raise UsageError(f"camera '{wanted}' does not exist; the stage has {known}")
    if len(matches) > 1:
        text = f"{len(matches)} cameras are named {wanted}; the first by path is used"
        notices.append(Notice(matches[0].path, text))
    return matches[0]
