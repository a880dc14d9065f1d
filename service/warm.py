"""A tiny built-in scene that touches every kernel, so that workers find them compiled and loaded."""

from __future__ import annotations

import os
import tempfile
from typing import Any

import numpy as np

from refract_core.scene import (
    Camera,
    Environment,
    Light,
    LightKind,
    Material,
    Mesh,
    Model,
    Param,
    Probe,
    Scene,
    Source,
    Sphere,
    Texture,
    Volume,
)

_VALUES: dict[Param, Any] = {Param.OPACITY: 1.0, Param.IOR: 1.5, Param.NORMAL: (0.0, 0.0, 1.0), Param.THICKNESS: 1.0,
                             Param.TRANSMITTANCE: 0.9, Param.ROUGHNESS: 0.2, Param.DIFFUSE: 0.5}  # fmt: skip


def _material(name: str, model: Model, **changed: Any) -> Material:
    def source(param: Param) -> Source:
        x, y, z = (float(value) for value in np.broadcast_to(changed.get(param.name, _VALUES.get(param, 0.0)), 3))
        return Source(value=(x, y, z, 1.0))

    return Material(name, tuple(source(param) for param in Param), model)


def tiny_scene() -> Scene:
    """A glass ball, a glass pane and a textured floor, with a light, a sky, and both kinds of probe."""
    corners = np.array([[-2, -1, -2], [2, -1, -2], [2, -1, 2], [-2, -1, 2]], np.float32)
    triangles = np.array([[0, 2, 1], [0, 3, 2]], np.uint32)
    st = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)[triangles]
    floor = Mesh("/floor", corners, triangles, np.zeros(2, np.int32), None, {"st": st})
    pane = Mesh("/pane", corners[:, [0, 2, 1]], triangles, np.full(2, 1, np.int32), None, {"st": st}, double_sided=True)
    dull = _material("/dull", Model.NONE)
    inputs = list(dull.inputs)
    inputs[Param.DIFFUSE] = Source(texture=0, uv_primvar="st")
    dull = Material("/dull", tuple(inputs), Model.NONE)
    thin = _material("/thin", Model.THIN, OPACITY=0.0)
    ball = _material("/ball", Model.TRACED, OPACITY=0.0)
    at = np.eye(4)
    at[2, 3] = 6.0
    room = Volume(np.eye(4), False, (4.0, 4.0, 4.0))
    return Scene(
        meshes=(floor, pane),
        materials=(dull, thin, ball),
        spheres=(Sphere("/ball", (0.0, 0.0, 1.0), 0.5, 2),),
        textures=(Texture("checker", np.full((4, 4, 4), 128, np.uint8), True),),
        lights=(Light("/light", LightKind.RECT, (5.0, 5.0, 5.0), size=(1.0, 1.0)),),
        environment=Environment(np.full((8, 16, 3), 0.5, np.float32)),
        cameras=(Camera("/camera", at, (-0.5, 0.5, -0.5, 0.5)),),
        probes=(
            Probe("/probe", "realtime", (0.0, 0.0, 0.0), room, room, resolution=8),
            Probe("/planar", "realtime", (0.0, 0.0, 0.0), room, room, resolution=8, planar=True),
        ),
        bounds=((-2.0, -1.0, -2.0), (2.0, 2.0, 2.0)),
    )


def draw() -> None:
    """Compile or load every kernel. About a minute the first time, two seconds later."""
    from refract_core.render import render
    from refract_core.settings import RenderSettings

    for screen in ("march", "proxy"):
        wanted = RenderSettings(
            image_width=16, image_height=16, samples=1, screen=screen, tiers=("screen", "ray", "probe", "sky"), jobs=1
        )
        frame = render(tiny_scene(), wanted)
    with tempfile.TemporaryDirectory() as folder:  # the library of pictures too
        frame.save(os.path.join(folder, "warm.png"))
