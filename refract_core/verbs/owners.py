"""Which pixel shows which glass: the first surface along the ray through its centre, asked of the engine itself.

The scene is drawn once more, with every glass surface glowing in a number of its own and everything else black, and no
light, sky or probe: what the pixel holds is then the number of what it shows. So there is no second opinion on what a
camera, a cut-out or an instance is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..models import Model
from ..scene import I32, Material, Mesh, Param, Scene, Source, Sphere
from ..settings import RenderSettings
from ..world.instances import sphere

NOBODY = -1


class Owner(NamedTuple):
    """One glass material on one prim."""

    path: str
    """Of the prim."""
    material: str
    """Name of the material, as `scene.Material.name`."""


@dataclass(frozen=True)
class Owners:
    """What each pixel shows first."""

    every: tuple[Owner, ...]
    """In the order of the scene, also those that no pixel shows."""
    number: I32
    """shape (H, W): index into `every`, or `NOBODY`"""

    def pixels(self, which: Callable[[Owner], bool]) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Where one of those is seen that `which` says yes to, shape (H, W)."""
        rows = [row for row, owner in enumerate(self.every) if which(owner)]
        return np.isin(self.number, rows)


def find_owners(scene: Scene, settings: RenderSettings, cancel: Callable[[], bool]) -> Owners:
    """Who is seen at the centre of each pixel of the picture that `settings` would make, however many samples it has.

    Raises:
        UsageError: no such camera.
        Cancelled: `cancel` said so.
    """
    from ..rendering.picture import render

    # Instances that are too many to be told apart have one owner, by the path of the first.
    things: tuple[Mesh | Sphere, ...] = (
        *scene.meshes, *scene.spheres, *(many.mesh for many in scene.instances),
        *(sphere(balls, 0) for balls in scene.balls if len(balls)),
    )  # fmt: skip
    every = tuple(dict.fromkeys(owner for thing in things for owner in _of(thing, scene)))
    row_of = {owner: len(scene.materials) + number for number, owner in enumerate(every)}
    numbered = replace(
        scene,
        meshes=tuple(_mesh(mesh, scene, row_of) for mesh in scene.meshes),
        spheres=tuple(_sphere(ball, scene, row_of) for ball in scene.spheres),
        instances=tuple(replace(many, mesh=_mesh(many.mesh, scene, row_of)) for many in scene.instances),
        balls=tuple(
            replace(balls, material=_sphere(sphere(balls, 0), scene, row_of).material)
            for balls in scene.balls if len(balls)
        ),
        materials=(*map(_black, scene.materials), *(_glowing(number + 1.0) for number in range(len(every)))),
        lights=(),
        environment=None,
        camera_light=False,
        probes=(),
        cameras=tuple(replace(camera, exposure_scale=1.0) for camera in scene.cameras),
    )
    plain = RenderSettings(
        camera=settings.camera, image_width=settings.image_width, image_height=settings.image_height, samples=1,
        tiers=("sky",), purposes=settings.purposes, jobs=settings.jobs, tile_size=settings.tile_size,
    )  # fmt: skip
    frame = render(numbered, plain, cancel=cancel)
    return Owners(every, np.rint(frame.planes["beauty"][..., 0]).astype(np.int32) - 1)


def _of(thing: Mesh | Sphere, scene: Scene) -> list[Owner]:
    rows = np.unique(thing.materials).tolist() if isinstance(thing, Mesh) else [thing.material]
    return [Owner(thing.path, scene.materials[row].name) for row in rows if scene.materials[row].refractive]


def _mesh(mesh: Mesh, scene: Scene, row_of: dict[Owner, int]) -> Mesh:
    rows = np.arange(len(scene.materials), dtype=np.int32)
    for row in np.unique(mesh.materials).tolist():
        rows[row] = row_of.get(Owner(mesh.path, scene.materials[row].name), row)
    return replace(mesh, materials=rows[mesh.materials])


def _sphere(ball: Sphere, scene: Scene, row_of: dict[Owner, int]) -> Sphere:
    owner = Owner(ball.path, scene.materials[ball.material].name)
    return replace(ball, material=row_of.get(owner, ball.material))


_NO_LIGHT = {param: Source() for param in Param} | {
    Param.ROUGHNESS: Source(value=(1.0, 1.0, 1.0, 1.0)),
    Param.OPACITY: Source(value=(1.0, 1.0, 1.0, 1.0)),
    Param.IOR: Source(value=(1.0, 1.0, 1.0, 1.0)),  # no gloss
    Param.NORMAL: Source(value=(0.0, 0.0, 1.0, 1.0)),
}


def _black(material: Material) -> Material:
    """A surface that sends nothing back, with the holes of the one it stands for."""
    holes = {Param.OPACITY: material.inputs[Param.OPACITY]} if material.cutout else {}
    inputs = tuple((_NO_LIGHT | holes)[param] for param in Param)
    return replace(material, inputs=inputs, model=Model.NONE, specular_workflow=False)


def _glowing(radiance: float) -> Material:
    lit = _NO_LIGHT | {Param.EMISSIVE: Source(value=(radiance, radiance, radiance, 1.0))}
    return Material("", tuple(lit[param] for param in Param))
