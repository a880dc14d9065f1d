"""Lights that the camera sees: a body of the light's shape stands where the light is, and glows as it says. What glows
is light (docs/decisions/what-glows-is-light.md), so the body gives the light, too."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from pxr import Usd

from ...scene import F64, Light, LightKind, Material, Mesh, Shadow, Sphere
from ..geometry.triangulate import Index
from .context import Context, value
from .meshes import black

NAMES = (
    "inputs:visibility:camera", "primvars:visibility:camera", "primvars:ri:attributes:visibility:camera",
    "primvars:arnold:camera", "primvars:karma:light:renderlightgeo", "karma:light:renderlightgeo",
    "visibleInPrimaryRay",
)  # fmt: skip
"""Attributes that say whether a camera sees a light, as renderers have them; UsdLux itself leaves it open."""
_SIDES = 64
"""Of disks and tubes."""
_THICK = 1e-3
"""Of a plate, in parts of its smaller side."""


def seen_by_camera(context: Context, prim: Usd.Prim) -> bool | None:
    """What a light says of it; None where it says nothing."""
    for name in NAMES:
        said = value(context, prim, name, None)
        if isinstance(said, bool | int | float):
            return said > 0
    return None


def obstacle(light: Light) -> str:
    """Why a body cannot give the light that a light gives; "" where it can."""
    shaping = light.shaping
    even = shaping.focus == 0.0 and shaping.cone == math.pi and shaping.profile is None and shaping.picture is None
    for what, wrong in (
        ("it has no size", 0.0 in light.size[: 1 if light.kind in (LightKind.SPHERE, LightKind.DISK) else 2]),
        ("its light is shaped or has a picture", not even),
        ("it is linked to some prims", light.lit is not None or light.casters is not None),
        ("inputs:diffuse or inputs:specular is not 1", light.diffuse != 1.0 or light.specular != 1.0),
        ("its shadows are not those of light itself", not light.casts_shadow or light.shadow != Shadow()),
    ):
        if wrong:
            return what
    return ""


def lamp_bodies(lights: Sequence[Light], first: int) -> tuple[list[Mesh], list[Sphere], list[Material]]:
    """A body in the place of each light that the camera sees, and their materials, numbered from `first` on."""
    meshes: list[Mesh] = []
    spheres: list[Sphere] = []
    materials: list[Material] = []
    for light in lights:
        if not light.seen:
            continue
        number = first + len(materials)
        materials.append(Material(light.path, black(light.radiance)))
        if light.kind is LightKind.SPHERE:
            x, y, z = light.world_from_light[:3, 3].tolist()
            spheres.append(Sphere(light.path, (x, y, z), light.size[0], number))
        else:
            materials.append(Material(light.path, black((0.0, 0.0, 0.0))))
            meshes.append(_mesh(light, number))
    return meshes, spheres, materials


def _mesh(light: Light, glows: int) -> Mesh:
    """A plate whose front glows, or a tube whose ends do not; material `glows` + 1 sends nothing out."""
    if light.kind is LightKind.CYLINDER:
        radius, length = light.size
        y, z = _around(radius)
        ends = [np.stack([np.full(_SIDES, x), y, z], axis=1) for x in (0.5 * length, -0.5 * length)]
        points, triangles = _between(*ends)
        shines = np.arange(len(triangles)) < 2 * _SIDES
    else:
        if light.kind is LightKind.RECT:
            x, y = 0.5 * light.size[0] * np.array([1, -1, -1, 1]), 0.5 * light.size[1] * np.array([1, 1, -1, -1])
        else:
            x, y = _around(light.size[0])
        thick = _THICK * min(np.ptp(x), np.ptp(y))
        back, front = (np.stack([x, y, np.full(len(x), z)], axis=1) for z in (thick, 0.0))
        points, triangles = _between(back, front)
        shines = np.arange(len(triangles)) >= len(triangles) - (len(x) - 2)
    turned = points @ light.world_from_light[:3, :3].T + light.world_from_light[:3, 3]
    numbers = np.where(shines, glows, glows + 1).astype(np.int32)
    return Mesh(light.path, turned.astype(np.float32), triangles.astype(np.uint32), numbers, closed=True)


def _around(radius: float) -> tuple[F64, F64]:
    """Places around a circle's polygon of the same area."""
    turn = 2.0 * math.pi * np.arange(_SIDES) / _SIDES
    grown = radius * math.sqrt(2.0 * math.pi / (_SIDES * math.sin(2.0 * math.pi / _SIDES)))
    return grown * np.cos(turn), grown * np.sin(turn)


def _between(first: F64, last: F64) -> tuple[F64, Index]:
    """The body between two outlines that run counter-clockwise seen from outside before the first: its wall, two
    triangles a side, then the face at the first, then that at the last."""
    count = len(first)
    here = np.arange(count)
    following = (here + 1) % count
    wall = np.stack([here, here + count, following, following, here + count, following + count], axis=1).reshape(-1, 3)
    fan = np.arange(1, count - 1)
    begin = np.stack([np.zeros_like(fan), fan, fan + 1], axis=1)
    end = np.stack([np.zeros_like(fan), fan + 1, fan], axis=1) + count
    return np.concatenate([first, last]), np.concatenate([wall, begin, end])
