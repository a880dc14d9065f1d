"""Stages with glass of known thickness, and what the renderer reads of it after a bake."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade
from test_thickness import Solid, box

from refract_core.progress import Report
from refract_core.scene import Material, Mesh, Param, Scene
from refract_core.verbs.bake_thickness import Row, ThicknessOrder, bake_thickness

NAME = "refraction:thickness"
F64 = NDArray[np.float64]


def new(path: Path, *, unit: float = 1.0, up: str = "Y") -> Usd.Stage:
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    UsdGeom.SetStageUpAxis(stage, up)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/W").GetPrim())
    return stage


def glass(stage: Usd.Stage, name: str = "Glass", model: str = "sphere", **inputs: float) -> UsdShade.Material:
    material = UsdShade.Material.Define(stage, f"/W/Looks/{name}")
    material.GetPrim().ApplyAPI("RefractMaterialAPI")
    kind = Sdf.ValueTypeNames.Token
    material.GetPrim().CreateAttribute("refraction:model", kind, False, Sdf.VariabilityUniform).Set(model)
    for key, value in inputs.items():
        material.CreateInput(f"refraction:{key}", Sdf.ValueTypeNames.Float).Set(value)
    return material


def mesh(stage: Usd.Stage, path: str, solid: Solid, material: UsdShade.Material | None = None) -> UsdGeom.Mesh:
    points, triangles, normals = solid
    made = UsdGeom.Mesh.Define(stage, path)
    made.CreateSubdivisionSchemeAttr("none")
    made.CreatePointsAttr(points.astype(np.float32))
    made.CreateFaceVertexCountsAttr([3] * len(triangles))
    made.CreateFaceVertexIndicesAttr(triangles.ravel().tolist())
    made.CreateNormalsAttr(normals.reshape(-1, 3).astype(np.float32))
    made.SetNormalsInterpolation("faceVarying")
    if material:
        bind(made, material)
    return made


def bind(prim: Any, material: UsdShade.Material) -> None:
    UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(material)


def scaled(prim: Any, *factors: float) -> None:
    UsdGeom.XformCommonAPI(prim.GetPrim()).SetScale(Gf.Vec3f(*(factors * 3)[:3]))


def unwrapped(stage: Usd.Stage, path: str, material: UsdShade.Material, sides: tuple[float, float, float]) -> None:
    """A box whose six faces lie in one picture as squares."""
    made = mesh(stage, path, box(*sides), material)
    corners = np.array([[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])
    uv = [((corners + 0.1) * 0.8 + (face % 3, face // 3)) / 3 for face in range(6)]
    st = UsdGeom.PrimvarsAPI(made).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying")
    st.Set(np.concatenate(uv).reshape(-1, 2).astype(np.float32))


def mapped(stage: Usd.Stage, material: UsdShade.Material) -> None:
    """Something connected to its thickness."""
    shader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("Map"))
    shader.CreateIdAttr("UsdPrimvarReader_float")
    shader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("other")
    port = material.CreateInput(NAME, Sdf.ValueTypeNames.Float)
    port.ConnectToSource(shader.CreateOutput("result", Sdf.ValueTypeNames.Float))


def run(path: Path, out: Path, **options: Any) -> tuple[dict[str, Row], str]:
    """Rows by the prim's name, and everything that was told."""
    told: list[str] = []
    say = Report(lambda _f, _t: None, lambda p, t: told.append(f"warning {p}: {t}"),
                 lambda p, t: told.append(f"{p}: {t}"), told.append)  # fmt: skip
    rows = bake_thickness(ThicknessOrder(stage=str(path), out=str(out), **options), say, lambda: False)
    return {row.path.rsplit("/", 1)[-1]: row for row in rows}, "\n".join(told)


def drawn(scene: Scene, name: str) -> tuple[Mesh, Material]:
    (found,) = (one for one in scene.meshes if one.path.endswith(f"/{name}"))
    return found, scene.materials[int(found.materials[0])]


def metres(scene: Scene, name: str) -> F64:
    """Thickness at the triangle corners of a mesh [m], as the renderer takes it from the primvar."""
    found, material = drawn(scene, name)
    source = material.inputs[Param.THICKNESS]
    assert source.texture < 0
    assert source.primvar == NAME
    return found.primvars[NAME][..., 0].astype(np.float64) * source.scale[0] + source.bias[0]


def from_picture(scene: Scene, name: str) -> tuple[F64, Mesh]:
    """Thickness at the middle of every triangle [m], as the renderer takes it from the picture."""
    found, material = drawn(scene, name)
    source = material.inputs[Param.THICKNESS]
    pixels = scene.textures[source.texture].pixels
    assert pixels.dtype == np.float32
    u, v = found.primvars[source.uv_primvar].mean(axis=1).T
    size = len(pixels)
    texel = pixels[((1.0 - v) * size).astype(int), (u * size).astype(int), 0]
    return texel.astype(np.float64) * source.scale[0] + source.bias[0], found
