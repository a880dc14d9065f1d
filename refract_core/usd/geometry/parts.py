"""A prim with everything that belongs to it: triangles, a material for each, and the primvars those materials read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade

from ...models import Model
from ...scene import F32, I32, Material, Notice, Texture
from ..materials.read import display_color_material, read_material
from .cages import FINENESS, is_subdivided, surface_size
from .curves import Cut
from .edges import HIDDEN, with_edges
from .primvars import as_values, read_primvar, spread
from .refined import Fineness
from .shapes import Shape
from .traverse import Placement, stays_one, told_of

MOST_IN_ALL = 4_000_000
"""Triangles that the subdivision surfaces of a stage have together, counted wherever they are drawn, but once where an
instancer draws so many that they are one mesh (`many.shared`)."""


@dataclass
class Tables:
    """What all prims of a stage share; filled while they are read."""

    time: Usd.TimeCode
    metres_per_unit: float
    notices: list[Notice]
    fineness: Fineness = FINENESS["low"]
    """Of subdivision surfaces"""
    cuts: dict[Sdf.Path, Cut] = field(default_factory=dict)
    """Of curves, by prim"""
    textures: dict[str, Texture] = field(default_factory=dict)
    materials: list[Material] = field(default_factory=list)
    numbers: dict[tuple[str, bool], int] = field(default_factory=dict)
    """Place in `materials` by prim path ('' for displayColor) and whether the mesh is closed (is transparent)."""
    of_instances: dict[tuple[str, str], F32 | None] = field(default_factory=dict)
    """Values per instance by point instancer and primvar."""
    uniform: dict[tuple[int, int], I32] = field(default_factory=dict)
    """Material of each triangle where all have the same, by their number and the material's; not to be written to."""


class Bound(NamedTuple):
    """Materials of one prim; None stands for displayColor."""

    material: UsdShade.Material | None
    subsets: tuple[tuple[UsdGeom.Subset, UsdShade.Material | None], ...]


class Part(NamedTuple):
    """A prim's shape with its materials and the primvars they read, before it is put anywhere."""

    shape: Shape
    materials: I32
    """shape (T,)"""
    primvars: dict[str, F32]
    """name -> (T, 3, D), or (1, 1, D) where constant"""
    wanted: frozenset[str]
    """Names its materials read, whether it has them or not."""

    @property
    def is_ball(self) -> bool:
        """An exact sphere wherever a transform leaves it round: all that is said of it holds everywhere on it."""
        return self.shape.is_sphere and all(values.shape[:2] == (1, 1) for values in self.primvars.values())


def affordable(placements: Sequence[Placement], time: Usd.TimeCode, fineness: Fineness) -> Fineness:
    """As fine as subdivision surfaces may be for all of a stage to have `MOST_IN_ALL` triangles of them."""
    drawn: Counter[Sdf.Path] = Counter()
    for placement in placements:
        drawn[placement.prim.GetPath()] += len(placement.worlds)
    prims = {placement.prim.GetPath(): placement.prim for placement in placements}
    meshes = [(UsdGeom.Mesh(prim), drawn[path]) for path, prim in prims.items() if is_subdivided(prim, time)]
    usual = [one for one in FINENESS.values() if one.steps == fineness.steps]
    plain = [fineness._replace(steps=steps, few=0) for steps in range(fineness.steps, 0, -1)]
    for fewer in (fineness, *usual, *plain):
        sizes = [(times, surface_size(mesh, time, fewer)) for mesh, times in meshes]
        if sum(size if stays_one(times, size) else times * size for times, size in sizes) <= MOST_IN_ALL:
            return fewer
    return fineness._replace(steps=0, few=0)


def bind(prims: Sequence[Usd.Prim], notices: list[Notice]) -> list[Bound]:
    """The materials of many prims at once: those bound for `full`, else for all purposes, else for `preview`."""
    subsets = [
        UsdShade.MaterialBindingAPI(prim).GetMaterialBindSubsets() if prim.GetTypeName() == "Mesh" else []
        for prim in prims
    ]
    asked = [*prims, *(subset.GetPrim() for group in subsets for subset in group)]
    if not asked:
        return []
    found, said = UsdShade.MaterialBindingAPI.ComputeBoundMaterials(asked, UsdShade.Tokens.full)
    missing = [place for place, material in enumerate(found) if not material]
    if missing:
        previews, _ = UsdShade.MaterialBindingAPI.ComputeBoundMaterials(
            [asked[place] for place in missing], UsdShade.Tokens.preview
        )
        for place, preview in zip(missing, previews, strict=True):
            found[place] = preview
    materials = [material if material else None for material in found]
    broken: dict[str, list[str]] = {}
    for prim, material, relationship in zip(asked, materials, said, strict=True):
        if material is None and relationship:
            targets = ", ".join(map(str, relationship.GetTargets())) or "nothing"
            broken.setdefault(targets, []).append(str(prim.GetPath()))
    for targets, paths in broken.items():
        text = f"the bound material {targets} does not exist or is no Material; displayColor is used"
        notices.append(told_of(paths, text))
    rest = iter(materials[len(prims) :])
    return [
        Bound(material, tuple((subset, next(rest)) for subset in group))
        for material, group in zip(materials[: len(prims)], subsets, strict=True)
    ]


def assemble(prim: Usd.Prim, shape: Shape, bound: Bound, tables: Tables) -> Part:
    """Reads the materials of a prim and the primvars they use."""
    materials = _triangle_materials(prim, shape, bound, tables)
    alike = shape.topology is None or not bound.subsets
    used = [tables.materials[number] for number in (materials[:1] if alike else np.unique(materials)).tolist()]
    if any(material.refractive for material in used):
        shape = shape.outwards  # only glass has a side that light enters by
    of_faces = prim.GetTypeName() == "Mesh" and not (shape.subdivided or shape.cage)
    if of_faces and any(material.model is Model.TRACED for material in used):
        whole, shape = shape, with_edges(shape)
        if shape is not whole:
            tables.notices.append(Notice(str(prim.GetPath()), HIDDEN))
    wanted: frozenset[str] = frozenset()
    for material in used:
        wanted |= _primvars_of(material)
    primvars: dict[str, F32] = {}
    for name in sorted(wanted):
        corners = read_primvar(prim, name, tables.time, shape.topology, tables.notices) or shape.natural.get(name)
        if corners is not None:
            primvars[name] = spread(corners)
    return Part(shape, materials, primvars, wanted)


def _primvars_of(material: Material) -> frozenset[str]:
    """Names of the primvars a material reads."""
    sources = material.inputs
    names = {source.primvar for source in sources} | {s.uv_primvar for s in sources if s.texture >= 0}
    return frozenset(names - {""})


def _triangle_materials(prim: Usd.Prim, shape: Shape, bound: Bound, tables: Tables) -> I32:
    """Row of the material table for each triangle, shape (T,): by GeomSubset, else by the prim."""
    if shape.topology is None or not bound.subsets:
        number = _material_number(prim, shape, bound.material, tables)
        key = (len(shape.triangles), number)
        if key not in tables.uniform:  # thousands of instances are alike: one array is enough for them
            tables.uniform[key] = np.full(len(shape.triangles), number, np.int32)
        return tables.uniform[key]
    of_face = np.full(shape.topology.face_count, -1, np.int32)
    for subset, material in bound.subsets:
        faces = _subset_faces(subset, shape.topology.face_count, tables)
        if len(faces):
            of_face[faces] = _material_number(prim, shape, material, tables)
    of_triangle = of_face[shape.topology.faces]
    if (of_triangle < 0).any():
        of_triangle[of_triangle < 0] = _material_number(prim, shape, bound.material, tables)
    return of_triangle


def _subset_faces(subset: UsdGeom.Subset, face_count: int, tables: Tables) -> I32:
    """Faces of a subset that the mesh has; a notice tells of the others."""
    path = str(subset.GetPath())
    kind = subset.GetElementTypeAttr().Get(tables.time)
    if kind != UsdGeom.Tokens.face:
        tables.notices.append(Notice(path, f"ignored: its elementType is '{kind}'; only face subsets can be used"))
        return np.zeros(0, np.int32)
    value = subset.GetIndicesAttr().Get(tables.time)
    faces = np.zeros(0, np.int32) if value is None else np.asarray(value, np.int32)
    known = (faces >= 0) & (faces < face_count)
    if not known.all():
        text = f"{int((~known).sum())} of its indices are ignored: the mesh has faces 0 .. {face_count - 1}"
        tables.notices.append(Notice(path, text))
    return faces[known]


def _material_number(prim: Usd.Prim, shape: Shape, material: UsdShade.Material | None, tables: Tables) -> int:
    """Place of a material in the table, read once for closed and once for open meshes."""
    if material is None:
        see_through = _has_opacity(prim, tables)
        key = ("", see_through)
        if key not in tables.numbers:
            tables.numbers[key] = len(tables.materials)
            tables.materials.append(display_color_material(str(prim.GetPath()), has_opacity=see_through))
        return tables.numbers[key]
    source = material.GetPrim()
    if source.IsInstanceProxy():
        source = source.GetPrimInPrototype()
    key = (str(source.GetPath()), shape.closed)
    if key not in tables.numbers:
        read = read_material(
            material,
            tables.time,
            metres_per_unit=tables.metres_per_unit,
            closed=shape.closed,
            textures=tables.textures,
            notices=tables.notices,
        )
        tables.numbers[key] = len(tables.materials)
        tables.materials.append(read)
    return tables.numbers[key]


def _has_opacity(prim: Usd.Prim, tables: Tables) -> bool:
    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance("displayOpacity")
    values = as_values(primvar.Get(tables.time)) if primvar else None
    return values is not None and bool((values < 1.0).any())


def instance_values(instancer: Usd.Prim, name: str, tables: Tables) -> F32 | None:
    """What a point instancer says of a primvar for each of its instances, shape (N, D); None where it says nothing."""
    key = (str(instancer.GetPath()), name)
    if key not in tables.of_instances:
        primvar = UsdGeom.PrimvarsAPI(instancer).GetPrimvar(name)
        said = primvar and primvar.HasValue() and primvar.GetInterpolation() != UsdGeom.Tokens.constant
        tables.of_instances[key] = as_values(primvar.ComputeFlattened(tables.time)) if said else None
    return tables.of_instances[key]
