"""A room of `two_rooms` as a scene of ours."""

from __future__ import annotations

import numpy as np

from refract_core.scene import (
    F32,
    F64,
    Camera,
    Environment,
    Light,
    LightKind,
    Material,
    Mesh,
    Model,
    Scene,
    Source,
    Texture,
)

from .room import constant, surface
from .two_rooms import IOR, Eye, Finish, Globe, Glow, Room, Solid, Sun


def scene_of(room: Room) -> Scene:
    """The same numbers as records of the engine."""
    names = list(room.images)
    solids = room.solids
    low = np.min([solid.points.min(0) for solid in solids], 0)
    high = np.max([solid.points.max(0) for solid in solids], 0)
    return Scene(
        tuple(_mesh(solid, index) for index, solid in enumerate(solids)),
        tuple(_material(solid.name, solid.finish, names) for solid in solids),
        textures=tuple(Texture(name, _with_alpha(pixels)) for name, pixels in room.images.items()),
        lights=_lights(room),
        environment=_environment(room.sky) if any(room.sky) else None,
        cameras=(_camera(room.eye),),
        bounds=((low[0], low[1], low[2]), (high[0], high[1], high[2])),
        metres_per_unit=1.0,
        name=f"{room.name} room",
    )


def looking(eye: Eye) -> F64:
    """Upright frame of an eye that looks along its -Z, shape (4, 4)."""
    place, target = np.array(eye.place), np.array(eye.target)
    back = (place - target) / np.linalg.norm(place - target)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    m = np.eye(4)
    m[:3, 0], m[:3, 1], m[:3, 2], m[:3, 3] = right, np.cross(back, right), back, place
    return m


def _camera(eye: Eye) -> Camera:
    high = eye.half_height
    wide = high * 16 / 9
    return Camera("/camera", looking(eye), (-wide, wide, -high, high))


def _mesh(solid: Solid, index: int) -> Mesh:
    order = solid.triangles
    return Mesh(
        f"/{solid.name}", solid.points, order, np.full(len(order), index, np.int32),
        None if solid.normals is None else solid.normals[order],
        {} if solid.st is None else {"st": solid.st[order]},
        closed=solid.finish.glass,
    )  # fmt: skip


def _material(name: str, finish: Finish, images: list[str]) -> Material:
    if finish.glass:
        tint = constant(*finish.tint)
        return surface(f"/{name}", Model.TRACED, 0.01, OPACITY=0.0, ROUGHNESS=0.0, IOR=IOR, TRANSMITTANCE=tint)
    if finish.radiance is not None:
        return surface(f"/{name}", EMISSIVE=_source(finish.radiance, images))
    assert finish.albedo is not None
    return surface(f"/{name}", DIFFUSE=_source(finish.albedo, images), OCCLUSION=1.0)


def _source(glow: Glow, images: list[str]) -> Source:
    return Source(texture=images.index(glow), uv_primvar="st") if isinstance(glow, str) else constant(*glow)


def _with_alpha(pixels: F32) -> F32:
    return np.concatenate([pixels, np.ones_like(pixels[..., :1])], -1)


def _lights(room: Room) -> tuple[Light, ...]:
    lamp = room.lamp
    rect = [Light("/lamp", LightKind.RECT, lamp.radiance, lamp.world_from_lamp, lamp.size)] if lamp else []
    return (*rect, *(_other(light, f"/light{k}") for k, light in enumerate(room.others)))


def _other(light: Globe | Sun, path: str) -> Light:
    if isinstance(light, Globe):
        m = np.eye(4)
        m[:3, 3] = light.centre
        return Light(path, LightKind.SPHERE, light.radiance, m, (light.radius, 0.0))
    m = looking(Eye(light.towards, (0.0, 0.0, 0.0), 1.0))
    return Light(path, LightKind.DISTANT, light.radiance, m, (float(np.radians(light.angle)), 0.0))


def _environment(sky: tuple[float, float, float]) -> Environment:
    return Environment(np.full((16, 32, 3), sky, np.float32))
