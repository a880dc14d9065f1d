"""A scene as it is drawn: in a studio or in surroundings from a file, before a background, as the settings say.

Nothing of this is in the stage, nor in what is baked, measured or converted: it is put around a scene that is about to
be drawn (docs/decisions/a-studio.md).
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product

import numpy as np

from ..scene import F64, Camera, Environment, Light, LightKind, Notice, Scene
from ..settings import RenderSettings
from .domes import SETS, Softbox, corners_of, dome_of, towards
from .files import read_environment
from .floor import floor_material, floor_mesh

ROOT = "/__studio__"
"""Paths of what is composed begin with it; no prim of a stage is named so by accident."""
USUAL = "softbox"
_FAR = 1000.0
"""Sizes of a thing between it and its lamps."""
_SUN_WIDTH = math.radians(0.53)


def dressed(scene: Scene, camera: Camera, settings: RenderSettings) -> tuple[Scene, tuple[Notice, ...]]:
    """The scene with what the settings put around it, and what is to be said about that.

    Args:
        camera: of the picture: a studio's front faces it

    Raises:
        ImageError: the file of surroundings cannot be read, or is no latlong picture.
    """
    notices: tuple[Notice, ...] = ()
    name = settings.studio
    if not name and not settings.environment and wants_light(scene, camera, settings):
        name = USUAL
        text = "no light, no dome and nothing that glows, so a studio of soft boxes lights it; --studio none leaves "
        notices = (Notice("/", text + "that out"),)
    before = settings.background
    if name in SETS:
        floor = before in ("", "environment")
        scene = with_studio(scene, camera, name, floor=floor)
    elif settings.environment:
        scene = replace(scene, environment=Environment(read_environment(settings.environment)), camera_light=False)
    return _before(scene, camera, settings), notices


def wants_light(scene: Scene, camera: Camera, settings: RenderSettings) -> bool:
    """It has no light at all, and is a thing that one looks at from outside. A place that one stands in keeps what it
    has, as surroundings would not get in; so does one with probes, which somebody has built for other surroundings."""
    things = scene.meshes or scene.spheres or scene.instances or scene.balls
    dark = scene.camera_light and settings.camera_light
    return bool(things) and dark and not scene.probes and "sky" in settings.tiers and _looks_at(camera, scene)


def _looks_at(camera: Camera, scene: Scene) -> bool:
    """Whether a camera stands outside of the bounds of what is drawn, and may see some of it."""
    low, high = np.array(scene.bounds, np.float64)
    pose = camera.world_from_camera
    if (pose[:3, 3] > low).all() and (pose[:3, 3] < high).all():
        return False
    corners = np.array([(*corner, 1.0) for corner in product(*zip(low, high, strict=True))])
    x, y, z, _ = np.linalg.inv(pose) @ corners.T
    wide = np.ones(8) if camera.orthographic else -z
    left, right, bottom, top = camera.window
    beside = ((x < left * wide).all(), (x > right * wide).all(), (y < bottom * wide).all(), (y > top * wide).all())
    return not any(beside) and bool((-z > 0.0).any() or camera.orthographic)


def with_studio(scene: Scene, camera: Camera, name: str, *, floor: bool = True) -> Scene:
    """The scene in a studio, and without the light that would shine from the camera.

    Args:
        camera: of the picture
        name: of `domes.SETS`
        floor: put one under it, unless the camera would see that from below
    """
    chosen, dome = SETS[name], dome_of(name)
    turn = turned_to(camera)
    environment = Environment(dome, np.ascontiguousarray(turn.T))
    lights = scene.lights + tuple(_lamp(box, chosen.scale, scene, turn) for box in chosen.boxes if box.lamp)
    if max(chosen.sun) > 0.0:
        lights += (_sun(chosen.sun, turn @ towards(*chosen.sun_from)),)
    scene = replace(scene, environment=environment, lights=lights, camera_light=False)
    return _on_floor(scene, camera, chosen.floor) if floor else scene


def turned_to(camera: Camera) -> F64:
    """World from studio, shape (3, 3): about the up axis, until the studio's front is where the camera is."""
    back, up = camera.world_from_camera[:3, 2], camera.world_from_camera[:3, 1]
    # Seen from straight above, or below, what is at the bottom of the picture is in front.
    x, z = (back - np.copysign(1.0, back[1]) * up)[[0, 2]]
    length = math.hypot(x, z)
    s, c = (x / length, z / length) if length > 1e-9 else (0.0, 1.0)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _lamp(box: Softbox, scale: float, scene: Scene, turn: F64) -> Light:
    """A soft box so far away that all of the floor sees the same of it."""
    low, high = np.array(scene.bounds, np.float64)
    distance = _FAR * (float((high - low).max()) or 1.0)
    corners = corners_of(box)
    place = np.eye(4)
    right, up = corners[1] - corners[0], corners[3] - corners[0]
    sides = float(np.linalg.norm(right)), float(np.linalg.norm(up))
    x, y = -turn @ right / sides[0], turn @ up / sides[1]  # it shines along its -Z, so it looks the other way
    place[:3, :3] = np.stack((x, y, np.cross(x, y)), axis=1)
    place[:3, 3] = (low + high) / 2.0 + distance * (turn @ towards(box.azimuth, box.elevation))
    radiance = (box.radiance * scale,) * 3
    return Light(f"{ROOT}/Box", LightKind.RECT, radiance, place, (sides[0] * distance, sides[1] * distance))


def _sun(irradiance: tuple[float, float, float], towards_it: F64) -> Light:
    """A light as far and as wide as the sun.

    Args:
        irradiance: of a surface that faces it
        towards_it: unit direction
    """
    place = np.eye(4)
    across = np.cross((0.0, 1.0, 0.0), towards_it)
    across /= np.linalg.norm(across)
    place[:3, :3] = np.stack((across, np.cross(towards_it, across), towards_it), axis=1)
    width = math.pi * math.sin(_SUN_WIDTH / 2.0) ** 2
    radiance = (irradiance[0] / width, irradiance[1] / width, irradiance[2] / width)
    return Light(f"{ROOT}/Sun", LightKind.DISTANT, radiance, place, (_SUN_WIDTH, 0.0))


def _on_floor(scene: Scene, camera: Camera, albedo: tuple[float, float]) -> Scene:
    mesh = floor_mesh(f"{ROOT}/Floor", scene.bounds, len(scene.materials), albedo)
    level = float(mesh.points[0, 1])
    pose = camera.world_from_camera
    if pose[1, 3] <= level or (camera.orthographic and pose[1, 2] < 0.0):
        return scene
    material = floor_material(f"{ROOT}/Floor")
    return replace(scene, meshes=(*scene.meshes, mesh), materials=(*scene.materials, material))


def _before(scene: Scene, camera: Camera, settings: RenderSettings) -> Scene:
    """The scene before the background that is asked for."""
    if settings.background in ("", "environment"):
        return scene
    around = scene.environment or Environment(np.zeros((2, 4, 3), np.float32))
    if settings.background == "transparent":
        return replace(scene, environment=replace(around, hidden=True, backdrop=None))
    brightness = camera.exposure_scale * 2.0**settings.exposure  # so that the picture has that very colour
    r, g, b = (_linear(int(settings.background[k : k + 2], 16)) / brightness for k in (1, 3, 5))
    return replace(scene, environment=replace(around, hidden=True, backdrop=(r, g, b)))


def _linear(code: int) -> float:
    """Of an 8-bit sRGB value (IEC 61966-2-1)."""
    value = code / 255.0
    return float(value / 12.92 if value <= 0.04045 else ((value + 0.055) / 1.055) ** 2.4)
