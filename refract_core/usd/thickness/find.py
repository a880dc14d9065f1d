"""Glass whose thickness can be measured: which prims it is on, and their geometry as it is drawn."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Usd, UsdGeom, UsdShade

from ...scene import F64, U32, Material, Model, Notice, Param, Texture
from ...settings import AS_IT_IS, PURPOSES, Opening
from ...world.solid import across, signed_volume
from ..convert.find import editable, find_glass, original
from ..diagnostics import captured
from ..geometry.parts import Bound, bind
from ..geometry.place import uniform_scale
from ..geometry.primvars import Corners, Topology, read_primvar, spread
from ..geometry.shapes import Shape, read_shape
from ..geometry.skel import posed
from ..geometry.traverse import CURVES, DRAWN, Placement, walk
from ..geometry.triangulate import turned_over, weld
from ..materials.read import THICKNESS_PRIMVAR, has_api, read_material
from ..opening import open_as
from ..ours import recognised
from ..stage import stage_unit, time_range

SAME_SIZE = 1.0e-3
"""Relative difference up to which two placements have one size."""
UV = "st"


@dataclass(frozen=True)
class Coat:
    """A glass material on a prim or on one of its GeomSubsets."""

    material: str
    """Path of the material; in an instance, that of its prototype"""
    edit: str
    """Path at which a layer can say more about it; '' where none can."""
    bound: str
    """Path at which its binding can be changed; '' where it cannot."""
    binding: str
    """Name of the relationship that binds it."""
    applied: bool
    """It has RefractMaterialAPI."""
    mapped: bool
    """Something connected to its thickness comes before the primvar."""
    model: Model
    ior: float
    multiplier: float
    """As authored on it, on top of every thickness."""


@dataclass(frozen=True)
class Candidate:
    """A prim with glass on it. Several may share one place to edit: proxies of an instance."""

    paths: tuple[str, ...]
    """Path of the prim, or of all the proxies"""
    edit: str
    """Path at which a layer can say more about it; '' where none can."""
    prim: Usd.Prim
    placements: tuple[F64, ...]
    """world_from_prim, shape (3, 4), of everything that is drawn with it"""
    coats: tuple[Coat, ...]

    @property
    def path(self) -> str:
        return self.paths[0]


@dataclass(frozen=True)
class Body:
    """A prim as it is drawn, in the stage's world and units."""

    points: F64
    """shape (V, 3)"""
    triangles: U32
    """shape (T, 3), counter-clockwise seen from outside"""
    normals: F64
    """shape (T, 3, 3): unit shading normals per triangle corner"""
    topology: Topology | None
    """Where the corners come from; None on a gprim, which carries one value"""
    mirrored: bool
    """The last two corners of every triangle changed places"""
    radius: float
    """> 0: an exact sphere"""
    uv: F64 | None
    """shape (T, 3, 2)"""
    uv_name: str
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Found:
    """What `find_candidates` finds."""

    candidates: tuple[Candidate, ...]
    bound_to: dict[str, frozenset[str]]
    """Prims that each glass material is on, by its path"""
    notices: tuple[Notice, ...]
    time: Usd.TimeCode
    drawn: Usd.Stage
    """The stage in the pose of that time; prims live as long as it does"""


# --- which prims ----------------------------------------------------------------------------------------------------


def find_candidates(stage: Usd.Stage) -> Found:
    """Every prim that is drawn with glass at the stage's first time, in the order of the stage.

    Raises:
        StageError: a material names an unknown model, or instances expand to more prims than can be drawn.
    """
    notices: list[Notice] = []
    time = Usd.TimeCode(time_range(stage)[0])
    unit = stage_unit(stage, notices)
    glass = {original(stage.GetPrimAtPath(found.path)): found for found in find_glass(stage, time, unit)}
    if not glass:
        return Found((), {}, tuple(notices), time, stage)
    drawn: dict[Sdf.Path, list[Placement]] = defaultdict(list)
    in_pose = posed(stage, time, notices)
    for placement in walk(in_pose, time, PURPOSES, notices):
        if placement.prim.GetTypeName() in DRAWN:
            drawn[placement.prim.GetPath()].append(placement)
    prims = [placements[0].prim for placements in drawn.values()]
    rows = _Rows(time, unit, notices)
    groups: dict[str, list[Candidate]] = defaultdict(list)
    bound_to: dict[str, set[str]] = defaultdict(set)
    for prim, bound in zip(prims, bind(prims, notices), strict=True):
        at_stage = stage.GetPrimAtPath(prim.GetPath())
        coats = tuple(_coats(at_stage, bound, frozenset(glass), rows))
        for coat in coats:
            bound_to[coat.material].add(str(prim.GetPath()))
        if coats:
            edit = str(editable(at_stage) or "")
            places = tuple(world for placement in drawn[prim.GetPath()] for world in placement.worlds)
            groups[edit or str(original(at_stage))].append(Candidate((str(prim.GetPath()),), edit, prim, places, coats))
    candidates = tuple(_merged(group) for group in groups.values())
    frozen = {path: frozenset(users) for path, users in bound_to.items()}
    return Found(candidates, frozen, tuple(dict.fromkeys(notices)), time, in_pose)


def stage_of(layer: Sdf.Layer, opening: Opening = AS_IT_IS) -> Usd.Stage:
    """The stage whose root a layer is; a door for those who know no USD."""
    with captured():  # whoever opened the stage below has been told
        stage = Usd.Stage.Open(layer)
        open_as(stage, opening)
        return recognised(stage)


def _merged(group: list[Candidate]) -> Candidate:
    """Proxies of one prim in a prototype as one candidate, which is drawn wherever any of them is."""
    first = group[0]
    coats = tuple(dict.fromkeys(coat for one in group for coat in one.coats))
    places = tuple(place for one in group for place in one.placements)
    return Candidate(tuple(one.path for one in group), first.edit, first.prim, places, coats)


class _Rows:
    """Glass materials as the renderer reads them on a closed mesh, each once."""

    def __init__(self, time: Usd.TimeCode, unit: float, notices: list[Notice]) -> None:
        self.time, self.unit, self.notices = time, unit, notices
        self.known: dict[Sdf.Path, Material] = {}
        self.textures: dict[str, Texture] = {}

    def row(self, material: UsdShade.Material) -> Material:
        place = original(material.GetPrim())
        if place not in self.known:
            self.known[place] = read_material(
                material, self.time, metres_per_unit=self.unit, closed=True, textures=self.textures,
                notices=self.notices,
            )  # fmt: skip
        return self.known[place]


def _coats(prim: Usd.Prim, bound: Bound, glass: frozenset[Sdf.Path], rows: _Rows) -> Iterator[Coat]:
    """The glass on one prim."""
    sites = [(prim, bound.material), *((subset.GetPrim(), material) for subset, material in bound.subsets)]
    for site, material in sites:
        if material is None or original(material.GetPrim()) not in glass:
            continue
        row = rows.row(material)
        if not row.refractive:
            continue
        yield _coat(prim.GetStage().GetPrimAtPath(site.GetPath()), material, row, rows)


def _coat(site: Usd.Prim, material: UsdShade.Material, row: Material, rows: _Rows) -> Coat:
    """One material on one prim or subset, and where a layer can reach it."""
    source = row.inputs[Param.THICKNESS]
    multiplier = material.GetInput("refraction:thicknessMultiplier")
    value = multiplier.Get(rows.time) if multiplier else None
    at_stage = site.GetStage().GetPrimAtPath(material.GetPath())
    applied = has_api(at_stage)
    return Coat(
        material=str(original(at_stage)),
        edit=str(editable(at_stage) or ""),
        bound=str(editable(site) or ""),
        binding=_binding(site),
        applied=applied,
        mapped=applied and not row.model.fixed_thickness and source.primvar != THICKNESS_PRIMVAR,
        model=row.model,
        ior=max(float(row.inputs[Param.IOR].value[0]), 1.0),
        multiplier=float(value) if isinstance(value, float) and value > 0.0 else 1.0,
    )


def _binding(site: Usd.Prim) -> str:
    """The relationship that binds a prim's material: its own name, or the general one where a collection does it."""
    api = UsdShade.MaterialBindingAPI(site)
    for purpose in (UsdShade.Tokens.full, UsdShade.Tokens.preview):
        material, relationship = api.ComputeBoundMaterial(purpose)
        if material and relationship and not relationship.GetName().startswith("material:binding:collection"):
            return str(relationship.GetName())
    return "material:binding"


# --- their geometry -------------------------------------------------------------------------------------------------


def read_body(candidate: Candidate, time: Usd.TimeCode, *, wants_uv: bool) -> Body | str:
    """The geometry of a candidate; a sentence that says why it cannot be measured where that is so."""
    if candidate.prim.GetTypeName() in CURVES:
        return "it is curves, whose thickness is their widths"
    notices: list[Notice] = []
    shape = read_shape(candidate.prim, time, notices)
    if shape is None:
        return "; ".join(notice.text for notice in notices)
    linear = np.stack(candidate.placements)[:, :3, :3] @ shape.prim_from_shape[:3, :3]
    if not np.isfinite(linear).all() or np.abs(np.linalg.det(linear)).min() <= 0.0:
        return "its transform is not finite, or has a scale of 0"
    if several := _several_sizes(linear):
        return several
    if not shape.closed:
        return _flaw(shape)
    mirrored = bool(np.linalg.det(linear[0]) < 0.0)
    points = shape.points.astype(np.float64) @ linear[0].T
    triangles = turned_over(shape.triangles) if mirrored else shape.triangles
    corners = points[triangles] - points[triangles[0, 0]]
    if signed_volume(points, triangles) <= 0.0:
        return "its faces look inwards; turn its orientation round, unless it is a bubble in other glass"
    uv_name, uv = _uv(candidate.prim, shape, time, notices, mirrored) if wants_uv else ("", None)
    return Body(
        points=points,
        triangles=triangles,
        normals=_normals(shape, corners, linear[0], mirrored),
        topology=shape.topology,
        mirrored=mirrored,
        radius=uniform_scale(linear[0], SAME_SIZE) if shape.is_sphere else 0.0,
        uv=uv,
        uv_name=uv_name,
        notes=(*_notes(shape, candidate.prim), *(notice.text for notice in notices)),
    )


def _notes(shape: Shape, prim: Usd.Prim) -> Iterable[str]:
    if shape.cage:
        yield "measured on the control cage of the subdivision surface, which is what is drawn"
    if shape.varying or any(above.GetTypeName() == "SkelRoot" for above in _above(prim)):
        yield "its geometry changes in time; measured at the first time of the stage"


def _above(prim: Usd.Prim) -> Iterator[Usd.Prim]:
    while prim := prim.GetParent():
        yield prim


def _several_sizes(linear: F64) -> str:
    """What is wrong where placements differ by more than a turn, a mirror or a place; '' where they do not."""
    grams = np.swapaxes(linear, 1, 2) @ linear
    differ = np.abs(grams - grams[0]).max(axis=(1, 2)) > 2.0 * SAME_SIZE * np.abs(grams[0]).max()
    if not differ.any():
        return ""
    scales = np.sqrt(np.trace(grams, axis1=1, axis2=2) / 3.0)
    return (
        f"its {len(linear)} instances have different sizes, from {scales.min():.3g} to {scales.max():.3g} times the "
        "prim's own; one thickness would not fit all"
    )


def _flaw(shape: Shape) -> str:
    """Why a mesh does not close a volume."""
    corners = weld(shape.points)[shape.triangles.astype(np.int64)]
    tail, head = corners.ravel(), corners[:, [1, 2, 0]].ravel()
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    _, edge, uses = np.unique((low << 32) | high, return_inverse=True, return_counts=True)
    forward = np.bincount(edge, tail < head, len(uses))
    if many := int((uses > 2).sum()):
        return f"it is not manifold: {many} edges have more than two faces"
    if single := int((uses == 1).sum()):
        return f"it is open: {single} edges have one face only, so there may be no far side"
    turned = int((forward * 2 != uses).sum())
    return f"its faces are not all turned the same way: {turned} edges have two that disagree"


def _normals(shape: Shape, corners: F64, linear: F64, mirrored: bool) -> F64:
    """Unit normals per triangle corner, shape (T, 3, 3). `corners`: shape (T, 3, 3), the triangles' own, turned."""
    if shape.normals is None:
        flat = across(corners)
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-300)
        return np.repeat(flat[:, None], 3, axis=1)
    turned = shape.normals.values.astype(np.float64) @ np.linalg.inv(linear)
    turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-300)
    assert shape.normals.rows is not None
    rows = turned_over(shape.normals.rows) if mirrored else shape.normals.rows
    out: F64 = turned[rows]
    return out


def _uv(
    prim: Usd.Prim, shape: Shape, time: Usd.TimeCode, notices: list[Notice], mirrored: bool
) -> tuple[str, NDArray[np.float64] | None]:
    """The object's own uv: `st`, else the first primvar of texture coordinates; '' and None where there is none."""
    primvars = UsdGeom.PrimvarsAPI(prim).FindPrimvarsWithInheritance()
    coordinates = (Sdf.ValueTypeNames.TexCoord2fArray, Sdf.ValueTypeNames.TexCoord2hArray)
    names = sorted(p.GetPrimvarName() for p in primvars if p.GetTypeName() in coordinates and p.HasValue())
    for name in dict.fromkeys([UV, *names]):
        corners: Corners | None = read_primvar(prim, name, time, shape.topology, notices)
        if corners is not None and corners.rows is not None and corners.values.shape[1] == 2:
            return name, spread(corners, mirrored=mirrored).astype(np.float64)
    return "", None
