"""Cameras of a stage, which one is meant, and one that frames everything where there is none."""

from __future__ import annotations

import math

import numpy as np
from pxr import Gf, Usd, UsdGeom, UsdRender

from ..errors import UsageError
from ..scene import F64, Camera, Notice

FOCAL_LENGTH = 50.0
APERTURE = (20.955, 15.2908)
"""Horizontal and vertical [tenths of a scene unit]; fallbacks of UsdGeomCamera."""
MAIN_CAMERA = "main_cam"


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
    unit = 0.1 * metres_per_unit if orthographic else 1.0 / focal
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
    )


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
    time: Usd.TimeCode,
    cameras: tuple[Camera, ...],
    wanted: str,
    bounds: tuple[tuple[float, float, float], tuple[float, float, float]],
    notices: list[Notice],
) -> tuple[Camera, ...]:
    """The cameras with the one to use in front, and notices about what of it is ignored.

    The order of choice: `wanted` (a prim path or name), the camera of the stage's render settings, a camera named
    main_cam, the first by path, and one made to frame everything.

    Raises:
        UsageError: where `wanted` is no camera of the stage.
    """
    chosen = _choose(stage, cameras, wanted, notices)
    if chosen is None:
        notices.append(Notice("/", "the stage has no camera; one that frames everything from the front is used"))
        return (frame_everything(bounds),)
    if (UsdGeom.Camera(stage.GetPrimAtPath(chosen.path)).GetFStopAttr().Get(time) or 0.0) > 0.0:
        notices.append(Notice(chosen.path, "fStop is above 0, but depth of field is ignored; everything is in focus"))
    return (chosen, *(camera for camera in cameras if camera is not chosen))


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


def frame_everything(bounds: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Camera:
    """A 50 mm camera in front of the bounds, looking along -Z, as far away as usdrecord puts its own: the diagonal of
    the bounds' front face spans the picture's width. Bounds so tall that this would cut them are seen from farther.

    Args:
        bounds: min and max [m], engine world
    """
    low, high = np.array(bounds, np.float64)
    width, height, depth = high - low
    right, top = APERTURE[0] / 2 / FOCAL_LENGTH, APERTURE[1] / 2 / FOCAL_LENGTH
    distance = float(max(math.hypot(width, height) / 2 / right, height / 2 / top) + depth / 2) or 1.0
    pose = np.eye(4)
    pose[:3, 3] = (low + high) / 2 + (0.0, 0.0, distance)
    return Camera("", pose, (-right, right, -top, top), clipping=(distance * 1.0e-3, distance * 1.0e3))
