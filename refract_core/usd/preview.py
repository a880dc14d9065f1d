"""A MaterialX file as a stage: a ball of each of its materials before a checkered wall, in daylight."""

from __future__ import annotations

import os

from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade

from ..errors import StageError
from .layers.mtlx import materials_of

MOST = 16
"""Materials that are shown, the first of the file."""
_APART = 2.4
_MARGIN = 3.2
_FLOOR = -1.15
"""Clear of the balls, for a wall of 5 mm stands for all of a thin-walled one."""
_LENS = 50.0 / 36.0
"""Distance at which a camera's picture is one unit wide."""


def preview_stage(path: str) -> Usd.Stage:
    """Show the materials of a file.

    Raises:
        StageError: it cannot be read, or has no material.
    """
    materials = materials_of(path)
    names = [child.name for child in materials.GetPrimAtPath("/MaterialX/Materials").nameChildren][:MOST]
    if not names:
        raise StageError(f"{path}: MaterialX file has no material; add a surfacematerial with a surface shader")
    stage = Usd.Stage.Open(Sdf.Layer.CreateAnonymous(f"{os.path.basename(path)}.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 0.05)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/Preview").GetPrim())
    looks = UsdGeom.Scope.Define(stage, "/Preview/Looks").GetPrim()
    looks.GetReferences().AddReference(materials.identifier, "/MaterialX/Materials")
    for place, name in enumerate(names):
        ball = UsdGeom.Sphere.Define(stage, f"/Preview/{name}")
        UsdGeom.XformCommonAPI(ball).SetTranslate(Gf.Vec3d(_APART * place, 0.0, 0.0))
        material = UsdShade.Material(stage.GetPrimAtPath(f"/Preview/Looks/{name}"))
        UsdShade.MaterialBindingAPI.Apply(ball.GetPrim()).Bind(material)
    _surroundings(stage, _APART * (len(names) - 1))
    return stage


def _surroundings(stage: Usd.Stage, wide: float) -> None:
    """A floor and a wall of squares, a sky, a sun and a camera."""
    steps = int(wide) + 16
    _squares(stage, "Floor", steps, 8, Gf.Vec3d(-8.0, _FLOOR, 4.0), Gf.Vec3d(1, 0, 0), Gf.Vec3d(0, 0, -1))
    _squares(stage, "Wall", steps, 8, Gf.Vec3d(-8.0, _FLOOR, -4.0), Gf.Vec3d(1, 0, 0), Gf.Vec3d(0, 1, 0))
    UsdLux.DomeLight.Define(stage, "/Preview/Sky").CreateIntensityAttr(0.6)
    sun = UsdLux.DistantLight.Define(stage, "/Preview/Sun")
    sun.CreateIntensityAttr(2.0)
    sun.CreateAngleAttr(2.0)
    UsdGeom.XformCommonAPI(sun).SetRotate(Gf.Vec3f(-50.0, 25.0, 0.0))
    camera = UsdGeom.Camera.Define(stage, "/Preview/Camera")
    across = wide + _MARGIN
    camera.CreateFocalLengthAttr(50.0)
    camera.CreateHorizontalApertureAttr(36.0)
    camera.CreateVerticalApertureAttr(36.0 * _MARGIN / across)
    UsdGeom.XformCommonAPI(camera).SetTranslate(Gf.Vec3d(wide / 2.0, 0.3, _LENS * across))


def _squares(
    stage: Usd.Stage, name: str, columns: int, rows: int, corner: Gf.Vec3d, across: Gf.Vec3d, up: Gf.Vec3d
) -> None:
    """A board of squares of one unit, light and dark by turns."""
    mesh = UsdGeom.Mesh.Define(stage, f"/Preview/Board/{name}")
    mesh.CreatePointsAttr([Gf.Vec3f(corner + across * i + up * j) for j in range(rows + 1) for i in range(columns + 1)])
    mesh.CreateFaceVertexCountsAttr([4] * (columns * rows))
    wide = columns + 1
    firsts = [j * wide + i for j in range(rows) for i in range(columns)]
    mesh.CreateFaceVertexIndicesAttr([k + step for k in firsts for step in (0, 1, wide + 1, wide)])
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    shades = [0.55 if (i + j) % 2 else 0.25 for j in range(rows) for i in range(columns)]
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.uniform
    )
    primvar.Set([Gf.Vec3f(shade) for shade in shades])
