"""Measured thickness in a layer: as `primvars:refraction:thickness` on prims, or as a map of a material.

The renderer takes a connected map first, then the primvar, then the constant. So a primvar has the material's own map
disconnected, and a map stands in a material of its own for each object: a material that is on several objects is
specialized (`UsdShade`'s base materials), and each object bound to its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

from ...scene import F64, Notice
from ..geometry.primvars import Topology
from ..geometry.refined import Refinement
from ..geometry.triangulate import Index
from ..layers.write import apply_api
from ..materials.read import THICKNESS_PRIMVAR
from .find import Body, Coat

MADE = "bake thickness"
INPUT = "inputs:refraction:thickness"
_NAME = f"primvars:{THICKNESS_PRIMVAR}"
_AGREE = 1.0e-3
"""Values at a point that differ less, against the largest of all, are one."""


_SAME_UV = 1.0e-6


@dataclass(frozen=True)
class Values:
    """A primvar."""

    edit: str
    interpolation: str
    values: F64
    """shape (N,), scene units"""


@dataclass(frozen=True)
class Map:
    """A picture, as the thickness of a glass material on one object."""

    coat: Coat
    owner: str
    """Name of the object's prim."""
    alone: bool
    """The material is on nothing else."""
    file: str
    """Absolute path of the picture, which holds parts of `scale`."""
    uv: str
    scale: float
    """[scene units]"""
    mean: float
    """[scene units]: what holds where the picture cannot be read"""
    tiled: bool


# --- values ---------------------------------------------------------------------------------------------------------


def spread_values(body: Body, values: F64) -> tuple[str, F64]:
    """Interpolation and values of a primvar for a mesh.

    Args:
        values: shape (T, 3), at the triangle corners of the body.
    """
    assert body.topology is not None
    at = values[:, [0, 2, 1]] if body.mirrored else values
    points, corners = body.topology.vertices, body.topology.corners
    if isinstance(body.topology.refinement, Refinement):
        return _spread_to_cage(body.topology, body.topology.refinement.cage_corners[corners], at)
    of_point = np.full(body.topology.point_count, at.mean())  # what no triangle uses is not drawn
    of_point[points.ravel()] = at.ravel()
    if np.abs(of_point[points] - at).max() <= _AGREE * at.max():
        return str(UsdGeom.Tokens.vertex), of_point
    of_corner = np.full(body.topology.corner_count, at.mean())
    of_corner[corners.ravel()] = at.ravel()
    return str(UsdGeom.Tokens.faceVarying), of_corner


def _spread_to_cage(topology: Topology, corners: Index, at: F64) -> tuple[str, F64]:
    """The same for a subdivision surface: what its cage can carry, linear in between.

    Args:
        corners: shape (T, 3): the prim's face corner that each triangle corner stands at; -1: at none
    """
    rows = corners >= 0
    points = topology.vertices[rows]
    of_point = np.full(topology.point_count, at.mean())
    of_point[points] = at[rows]
    if np.abs(of_point[points] - at[rows]).max() <= _AGREE * at.max():
        return str(UsdGeom.Tokens.varying), of_point
    of_corner = np.full(topology.corner_count, at.mean())
    of_corner[corners[rows]] = at[rows]
    return str(UsdGeom.Tokens.faceVarying), of_corner


def write_values(layer: Sdf.Layer, stage: Usd.Stage, every: Iterable[Values], unmapped: Iterable[str]) -> None:
    """Author primvars, and disconnect what would come before them.

    Args:
        stage: the stage below the layer, or the layer's own.
        unmapped: paths of materials whose thickness is connected to something.
    """
    every = list(every)
    indexed = {one.edit for one in every if _has(stage, one.edit, f"{_NAME}:indices")}
    with Sdf.ChangeBlock():
        for one in every:
            spec = Sdf.CreatePrimInLayer(layer, one.edit)
            single = one.interpolation == UsdGeom.Tokens.constant
            kind = Sdf.ValueTypeNames.Float if single else Sdf.ValueTypeNames.FloatArray
            attribute = _fresh(spec, _NAME, kind)
            values = np.ascontiguousarray(one.values, np.float32)
            attribute.default = float(values[0]) if single else Vt.FloatArray.FromNumpy(values)
            attribute.SetInfo("interpolation", one.interpolation)
            if one.edit in indexed:
                _fresh(spec, f"{_NAME}:indices", Sdf.ValueTypeNames.IntArray).default = Sdf.ValueBlock()
        for path in unmapped:
            spec = Sdf.CreatePrimInLayer(layer, path)
            _attribute(spec, INPUT, Sdf.ValueTypeNames.Float).connectionPathList.ClearEditsAndMakeExplicit()


MADE_UV = "refraction:st"
"""The primvar of coordinates that were made."""


def uv_of_corners(body: Body, uv: F64) -> F64 | None:
    """Values of a face-varying primvar, shape (N, 2); None where the prim's own faces cannot carry them.

    Args:
        uv: shape (T, 3, 2), at the triangle corners of the body.
    """
    assert body.topology is not None
    if body.topology.refinement is not None:  # its corners are those of the limit surface
        return None
    at = uv[:, [0, 2, 1]] if body.mirrored else uv
    of_corner = np.zeros((body.topology.corner_count, 2))
    of_corner[body.topology.corners.ravel()] = at.reshape(-1, 2)
    # A face of several triangles may lie in several charts.
    return of_corner if np.abs(of_corner[body.topology.corners] - at).max() <= _SAME_UV else None


def write_uvs(layer: Sdf.Layer, uvs: Mapping[str, F64]) -> None:
    """Author made coordinates, by path of the prim."""
    with Sdf.ChangeBlock():
        for path, values in uvs.items():
            spec = Sdf.CreatePrimInLayer(layer, path)
            attribute = _fresh(spec, f"primvars:{MADE_UV}", Sdf.ValueTypeNames.TexCoord2fArray)
            attribute.default = Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(values, np.float32))
            attribute.SetInfo("interpolation", UsdGeom.Tokens.faceVarying)


def _has(stage: Usd.Stage, path: str, name: str) -> bool:
    prim = stage.GetPrimAtPath(path)
    return bool(prim) and bool(prim.GetAttribute(name)) and prim.GetAttribute(name).HasAuthoredValue()


def _fresh(spec: Sdf.PrimSpec, name: str, kind: Sdf.ValueTypeName) -> Sdf.AttributeSpec:
    """A new attribute in place of what the layer has of that name."""
    if known := spec.properties.get(name):
        spec.RemoveProperty(known)
    return Sdf.AttributeSpec(spec, name, kind)


def _attribute(spec: Sdf.PrimSpec, name: str, kind: Sdf.ValueTypeName) -> Sdf.AttributeSpec:
    return spec.attributes.get(name) or Sdf.AttributeSpec(spec, name, kind)


# --- maps -----------------------------------------------------------------------------------------------------------


def write_maps(layer: Sdf.Layer, stage: Usd.Stage, maps: Iterable[Map]) -> dict[str, str]:
    """Author maps; returns, by path of the prim or GeomSubset, the material that is now bound to it."""
    taken: set[str] = set()
    bound: dict[str, str] = {}
    for one in maps:
        path = one.coat.edit
        if not one.alone:
            path = _free_name(stage, f"{path}_{one.owner}", taken)
            bound[one.coat.bound] = path
        known = stage.GetPrimAtPath(one.coat.bound)
        binds = bool(known) and known.HasAPI(UsdShade.MaterialBindingAPI)
        with Sdf.ChangeBlock():
            if not one.alone:
                _specialize(layer, path, one.coat.edit)
                _bind(layer, one.coat, path, has_api=binds)
            _connect(layer, path, one)
    return bound


def _free_name(stage: Usd.Stage, path: str, taken: set[str]) -> str:
    name, count = path, 1
    while name in taken or stage.GetPrimAtPath(name):
        count += 1
        name = f"{path}_{count}"
    taken.add(name)
    return name


def _specialize(layer: Sdf.Layer, path: str, base: str) -> None:
    spec = Sdf.CreatePrimInLayer(layer, path)
    spec.specifier = Sdf.SpecifierDef
    spec.typeName = "Material"
    spec.specializesList.prependedItems = [Sdf.Path(base)]


def _bind(layer: Sdf.Layer, coat: Coat, material: str, *, has_api: bool) -> None:
    spec = Sdf.CreatePrimInLayer(layer, coat.bound)
    if not has_api:
        apply_api(spec, "MaterialBindingAPI")
    relationship = spec.relationships.get(coat.binding) or Sdf.RelationshipSpec(spec, coat.binding, custom=False)
    relationship.targetPathList.explicitItems = [Sdf.Path(material)]


def _connect(layer: Sdf.Layer, path: str, one: Map) -> None:
    """The two nodes of a picture on an object's uv."""
    types = Sdf.ValueTypeNames
    material = Sdf.CreatePrimInLayer(layer, path)
    reader = _shader(layer, f"{path}/RefractThicknessUv", "UsdPrimvarReader_float2")
    _fresh(reader, "inputs:varname", types.String).default = one.uv
    _fresh(reader, "outputs:result", types.Float2)
    texture = _shader(layer, f"{path}/RefractThickness", "UsdUVTexture")
    wrap = "repeat" if one.tiled else "clamp"
    for name, kind, value in (
        ("file", types.Asset, Sdf.AssetPath(one.file)),
        ("sourceColorSpace", types.Token, "raw"),
        ("scale", types.Float4, Gf.Vec4f(one.scale, one.scale, one.scale, 1.0)),
        ("fallback", types.Float4, Gf.Vec4f(one.mean, one.mean, one.mean, 1.0)),
        ("wrapS", types.Token, wrap),
        ("wrapT", types.Token, wrap),
    ):
        _fresh(texture, f"inputs:{name}", kind).default = value
    _fresh(texture, "outputs:r", types.Float)
    st = _fresh(texture, "inputs:st", types.Float2)
    st.connectionPathList.explicitItems = [reader.path.AppendProperty("outputs:result")]
    port = _attribute(material, INPUT, types.Float)
    port.connectionPathList.explicitItems = [texture.path.AppendProperty("outputs:r")]


def _shader(layer: Sdf.Layer, path: str, identifier: str) -> Sdf.PrimSpec:
    spec = Sdf.CreatePrimInLayer(layer, path)
    spec.specifier = Sdf.SpecifierDef
    spec.typeName = "Shader"
    token = Sdf.ValueTypeNames.Token
    if "info:id" not in spec.attributes:
        Sdf.AttributeSpec(spec, "info:id", token, Sdf.VariabilityUniform).default = identifier
    return spec


def lost_bindings(layer: Sdf.Layer, bound: dict[str, str]) -> Iterable[Notice]:
    """Prims on which something else binds more strongly than the binding that was written."""
    if not bound:
        return
    stage = Usd.Stage.Open(layer)
    for path, material in bound.items():
        prim = stage.GetPrimAtPath(path)
        found = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial(UsdShade.Tokens.full)[0] if prim else None
        if found and str(found.GetPath()) != material:
            text = f"its map is in {material}, but a stronger binding gives it {found.GetPath()}; bind it by hand"
            yield Notice(path, text)
