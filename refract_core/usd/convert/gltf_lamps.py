"""Lights and cameras as glTF has them: KHR_lights_punctual, and the cameras of glTF 2.0.

Both have their -Z ahead, as UsdLux and UsdGeomCamera do. UsdLux counts in nits, so that a sun's illuminance is its
radiance times the integral of the cosine over its disc [lux], and a lamp's intensity its radiance times the area it
shows to who looks at it [candela].
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux

from ...scene import F64, Camera, Light, LightKind, Notice

EXTENSION = "KHR_lights_punctual"
BULB = 0.01
"""Radius [m] that a point of light has in USD, where few renderers know any."""
_HARD = 1.0e-3
"""Share of a cone that fades where it has a hard edge: glTF wants the inner angle under the outer one."""
_APERTURE = 20.955
"""Across [tenths of a unit], as UsdGeomCamera has it."""


class Lamp(NamedTuple):
    """A light of KHR_lights_punctual."""

    kind: str
    """directional, point or spot"""
    color: tuple[float, float, float]
    """Times candela, of a directional one lux"""
    inner: float = 0.0
    """Half angles of a spot [rad]: within which it is all there, beyond which there is nothing"""
    outer: float = math.pi / 4.0


class View(NamedTuple):
    """A camera of glTF 2.0."""

    window: tuple[float, float]
    """Half of its width and height: at distance 1 [unitless], of an orthographic one [m]"""
    clipping: tuple[float, float]
    """[m]"""
    orthographic: bool


# --- from a scene ---------------------------------------------------------------------------------------------------


def lamp_of(light: Light) -> Lamp:
    """The nearest that glTF has: of the same illuminance or intensity along the light's axis; a tube of its power."""
    (a, b), shaping = light.size, light.shaping
    factor = {
        LightKind.DISTANT: math.pi * math.sin(min(a / 2.0, math.pi / 2.0)) ** 2 if a > 0.0 else 1.0,
        LightKind.SPHERE: math.pi * a * a if a > 0.0 else 1.0,
        LightKind.DISK: math.pi * a * a,
        LightKind.RECT: a * b,
        # A quarter of its surface is what a convex body shows on an average (Cauchy).
        LightKind.CYLINDER: math.pi / 2.0 * a * b if a > 0.0 else math.pi / 4.0 * b,
    }[light.kind]
    r, g, b = (channel * factor for channel in light.radiance)
    if light.kind is LightKind.DISTANT:
        return Lamp("directional", (r, g, b))
    flat = light.kind in (LightKind.RECT, LightKind.DISK)
    if not flat and shaping.cone >= math.pi:
        return Lamp("point", (r, g, b))
    outer = min(shaping.cone, math.pi / 2.0)
    soft = 1.0 if flat and shaping.cone >= math.pi / 2.0 else max(shaping.softness, _HARD)
    return Lamp("spot", (r, g, b), outer * (1.0 - soft), outer)


def lost_of(light: Light) -> Iterator[str]:
    """What of a light glTF has no place for."""
    shaping = light.shaping
    if light.size != (0.0, 0.0):
        yield "size and soft shadows"
    if shaping.focus > 0.0 or shaping.profile is not None or shaping.picture is not None:
        yield "focus, IES profile or picture"
    if shaping.cone < math.pi and shaping.cone > math.pi / 2.0:
        yield "cone beyond 90 degrees"
    if not light.casts_shadow or light.lit is not None or light.casters is not None:
        yield "links and shadows"
    if (light.diffuse, light.specular) != (1.0, 1.0):
        yield "diffuse and specular factors"


def light_object(lamp: Lamp, name: str) -> dict[str, Any]:
    """As the extension writes it: a colour of at most 1, and an intensity."""
    most = max(*lamp.color, 0.0)
    color = [channel / most for channel in lamp.color] if most > 0.0 else [1.0, 1.0, 1.0]
    found: dict[str, Any] = {"name": name, "type": lamp.kind, "color": color, "intensity": most}
    if lamp.kind == "spot":
        found["spot"] = {"innerConeAngle": lamp.inner, "outerConeAngle": lamp.outer}
    return found


def shift_of(camera: Camera) -> F64:
    """Middle of a camera's window, shape (3,), in its own frame: glTF's is straight ahead."""
    left, right, bottom, top = camera.window
    return np.array([(left + right) / 2.0, (bottom + top) / 2.0, 0.0])


def camera_object(camera: Camera, name: str) -> dict[str, Any]:
    """As glTF writes it; without the shift, the lens and the exposure."""
    left, right, bottom, top = camera.window
    across, upward = (right - left) / 2.0, (top - bottom) / 2.0
    near, far = camera.clipping
    if camera.orthographic:
        near = max(near, 0.0)
        lens = {"xmag": across, "ymag": upward, "znear": near, "zfar": max(far, near + 1.0e-3)}
        return {"name": name, "type": "orthographic", "orthographic": lens}
    lens = {"yfov": 2.0 * math.atan(upward), "aspectRatio": across / upward, "znear": near, "zfar": far}
    return {"name": name, "type": "perspective", "perspective": lens}


def lost_of_camera(camera: Camera) -> Iterator[str]:
    """What of a camera glTF has no place for."""
    if not camera.orthographic and shift_of(camera).any():
        yield "aperture offset"
    if camera.lens_radius > 0.0:
        yield "depth of field"
    if camera.exposure_scale != 1.0:
        yield "exposure"
    if camera.orthographic and camera.clipping[0] < 0.0:
        yield "clipping before the camera"


# --- from a file ----------------------------------------------------------------------------------------------------


def read_lamp(found: dict[str, Any]) -> Lamp:
    """An entry of the extension's list, with the defaults of its specification.

    Raises:
        ValueError, TypeError: it is none.
    """
    kind = str(found["type"])
    if kind not in ("directional", "point", "spot"):
        raise ValueError(f"a light is of type {kind!r}; it must be directional, point or spot")
    r, g, b = (float(channel) * float(found.get("intensity", 1.0)) for channel in found.get("color", (1.0, 1.0, 1.0)))
    spot = found.get("spot") or {}
    inner, outer = float(spot.get("innerConeAngle", 0.0)), float(spot.get("outerConeAngle", math.pi / 4.0))
    if not (np.isfinite((r, g, b, outer)).all() and min(r, g, b) >= 0.0 and 0.0 <= inner <= outer and outer > 0.0):
        raise ValueError("a light has a colour, an intensity or a cone that is none")
    return Lamp(kind, (r, g, b), inner, outer)


def read_view(found: Any) -> View:
    """A camera of pygltflib. Raises ValueError, TypeError where it is none."""
    lens = {"perspective": found.perspective, "orthographic": found.orthographic}.get(found.type)
    if lens is None:
        raise ValueError(f"a camera is of type {found.type!r}; it must be perspective or orthographic, with its lens")
    if found.type == "orthographic":
        window = float(lens.xmag), float(lens.ymag)
    else:
        if not 0.0 < float(lens.yfov) < math.pi:
            raise ValueError(f"a camera's yfov is {lens.yfov}; it must be between 0 and pi")
        upward = math.tan(float(lens.yfov) / 2.0)
        window = upward * float(lens.aspectRatio or 1.0), upward
    near, far = float(lens.znear or 0.0), float(lens.zfar or 1.0e6)  # without zfar it is infinite
    if not (0.0 <= near < far and all(0.0 < side < math.inf for side in window)):
        wide, high = 2.0 * window[0], 2.0 * window[1]
        raise ValueError(f"a camera sees {wide:g} by {high:g} from {near:g} to {far:g}, which is nothing")
    return View(window, (near, far), found.type == "orthographic")


def define_lamp(stage: Usd.Stage, path: Sdf.Path, lamp: Lamp) -> None:
    """The light as UsdLux has it, in metres."""
    most = max(*lamp.color, 0.0)
    color = Gf.Vec3f(*(channel / most for channel in lamp.color)) if most > 0.0 else Gf.Vec3f(1.0)
    if lamp.kind == "directional":
        sun = UsdLux.DistantLight.Define(stage, path)
        sun.CreateAngleAttr(0.0)
        light = UsdLux.LightAPI(sun)
        light.CreateIntensityAttr(most)
    else:
        bulb = UsdLux.SphereLight.Define(stage, path)
        bulb.CreateRadiusAttr(BULB)
        bulb.CreateTreatAsPointAttr(True)
        light = UsdLux.LightAPI(bulb)
        # Of 1 / (4 pi r^2) nits a sphere shows pi r^2: a quarter, whatever scales it.
        light.CreateNormalizeAttr(True)
        light.CreateIntensityAttr(4.0 * most)
    light.CreateColorAttr(color)
    if lamp.kind == "spot":
        shaping = UsdLux.ShapingAPI.Apply(light.GetPrim())
        shaping.CreateShapingConeAngleAttr(math.degrees(lamp.outer))
        shaping.CreateShapingConeSoftnessAttr(1.0 - lamp.inner / lamp.outer)


def define_view(stage: Usd.Stage, path: Sdf.Path, view: View) -> None:
    """The camera as UsdGeom has it, in metres."""
    camera = UsdGeom.Camera.Define(stage, path)
    across, upward = view.window
    camera.CreateClippingRangeAttr(Gf.Vec2f(*view.clipping))
    if view.orthographic:
        camera.CreateProjectionAttr(UsdGeom.Tokens.orthographic)
        camera.CreateHorizontalApertureAttr(20.0 * across)
        camera.CreateVerticalApertureAttr(20.0 * upward)
        return
    camera.CreateHorizontalApertureAttr(_APERTURE)
    camera.CreateVerticalApertureAttr(_APERTURE * upward / across)
    camera.CreateFocalLengthAttr(_APERTURE / (2.0 * across))


def unwritten(stage: Usd.Stage, written: set[str]) -> Iterator[Notice]:
    """Which lights of a stage are of no kind that glTF has."""
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        if prim.HasAPI(UsdLux.LightAPI) and str(prim.GetPath()) not in written:
            yield Notice(str(prim.GetPath()), "not written: glTF has directional, point and spot lights alone")
