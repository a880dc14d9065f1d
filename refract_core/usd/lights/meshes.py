"""Meshes that are lights (MeshLightAPI, GeometryLight): drawn as what glows by the light's inputs."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdLux, UsdShade

from ...scene import Material, Mesh, Notice, Param, Source, prim_of
from ...world.solid import areas
from .context import Context, note, value
from .emission import emission

_BLACK: dict[Param, tuple[float, ...]] = {
    Param.EMISSIVE: (0.0, 0.0, 0.0), Param.ROUGHNESS: (1.0,), Param.OPACITY: (1.0,), Param.IOR: (1.0,),
    Param.NORMAL: (0.0, 0.0, 1.0), Param.OCCLUSION: (1.0,),
}  # fmt: skip
"""A surface that sends nothing back; what is not here is 0."""


def is_mesh_light(prim: Usd.Prim) -> bool:
    """A mesh that shines, or what says so of one."""
    on_mesh = prim.GetTypeName() == "Mesh" and prim.HasAPI(UsdLux.LightAPI)
    return bool(on_mesh or prim.GetTypeName() == "GeometryLight")


def mesh_lights(stage: Usd.Stage) -> frozenset[str]:
    """Paths of the meshes that some light is about."""
    return frozenset(str(path) for light in _every(stage) for path in _targets(light))


def own_glows(stage: Usd.Stage) -> dict[str, Usd.Prim]:
    """Lights by the paths of the meshes that glow as they say.

    What `light:materialSyncMode` leaves to the bound material shows that: its own glow, whatever the light says. A mesh
    without material has nothing to tint, so it glows as the light says.
    """
    return _own_glows(stage, _every(stage))


def glowing(
    stage: Usd.Stage, time: Usd.TimeCode, meshes: tuple[Mesh, ...], materials: list[Material],
    *, metres_per_unit: float, notices: list[Notice], instanced: Collection[str] = (),
) -> tuple[Mesh, ...]:  # fmt: skip
    """The meshes, of which those that are lights have a material of their own, added to `materials`.

    Args:
        instanced: paths of the prims that point instancers draw, which may be none of `meshes`
    """
    context = _context(time, metres_per_unit, notices)
    drawn = {prim_of(mesh.path) for mesh in meshes} | set(instanced)
    every = list(_every(stage))
    for light in every:
        if not any(str(path) in drawn for path in _targets(light)):
            note(context, light, f"{light.GetTypeName()} has no mesh that is drawn, so it gives no light")
    lights = _own_glows(stage, every)
    if not lights:
        return meshes
    return tuple(_lit(context, mesh, lights.get(prim_of(mesh.path)), materials) for mesh in meshes)


def _every(stage: Usd.Stage) -> Iterator[Usd.Prim]:
    return filter(is_mesh_light, Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()))


def _own_glows(stage: Usd.Stage, lights: Iterable[Usd.Prim]) -> dict[str, Usd.Prim]:
    return {
        str(path): light for light in lights for path in _targets(light)
        if _own_glow(stage.GetPrimAtPath(path), light)
    }  # fmt: skip


def _targets(prim: Usd.Prim) -> Sequence[Sdf.Path]:
    if prim.GetTypeName() != "GeometryLight":
        return [prim.GetPath()]
    relationship = prim.GetRelationship("geometry")
    return list(relationship.GetTargets()) if relationship else []


def _own_glow(mesh: Usd.Prim, light: Usd.Prim) -> bool:
    """Nothing but the light says how the mesh looks."""
    mode = light.GetAttribute("light:materialSyncMode")
    if mode and mode.Get() == "noMaterialResponse":
        return True
    return bool(mesh) and not UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()[0]


def _lit(context: Context, mesh: Mesh, light: Usd.Prim | None, materials: list[Material]) -> Mesh:
    if light is None or not len(mesh.triangles):
        return mesh
    made = _glow(context, light, float(areas(mesh.points.astype(np.float64)[mesh.triangles]).sum()))
    if made is None:
        return mesh
    materials.append(made)
    return replace(mesh, materials=np.full(len(mesh.triangles), len(materials) - 1, np.int32))


def glow_of(
    light: Usd.Prim, area: float, time: Usd.TimeCode, *, metres_per_unit: float, notices: list[Notice]
) -> Material | None:
    """What a mesh of an area [m^2] looks like that glows as a light says; None, with a notice, where it does not."""
    return _glow(_context(time, metres_per_unit, notices), light, area)


def _context(time: Usd.TimeCode, metres_per_unit: float, notices: list[Notice]) -> Context:
    return Context(time, UsdGeom.XformCache(time), np.eye(4), metres_per_unit, notices)


def _glow(context: Context, light: Usd.Prim, area: float) -> Material | None:
    found = emission(context, UsdLux.LightAPI(light))
    if found is None:
        return None
    factor = 1.0
    if value(context, light, "inputs:normalize", False):
        if area <= 0.0:
            note(context, light, "has no area, so it gives no light; it is drawn without")
            return None
        factor = context.metres_per_unit**2 / area
    r, g, b_ = (channel * factor for channel in found)
    return Material(str(light.GetPath()), black((r, g, b_)))


def black(emission: tuple[float, float, float]) -> tuple[Source, ...]:
    """Inputs of a surface that glows, and sends nothing back."""
    inputs = {param: Source(_four(_BLACK.get(param, (0.0,)))) for param in Param}
    inputs[Param.EMISSIVE] = Source((*emission, 1.0))
    return tuple(inputs[param] for param in Param)


def _four(values: tuple[float, ...]) -> tuple[float, float, float, float]:
    if len(values) == 1:
        return (values[0],) * 4
    return (values[0], values[1], values[2], 1.0)
