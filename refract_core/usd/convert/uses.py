"""The shapes that glass is on, and what suits each: what `convert` decides the model from."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from pxr import Sdf, Usd, UsdGeom

from ...models import SOLID
from ...scene import F64, U32, Notice
from ...settings import PURPOSES
from ...thickness.fit import Fit, fit
from ..geometry.parts import Bound, bind
from ..geometry.shapes import Shape, read_shape
from ..geometry.traverse import DRAWN, walk
from ..materials.read import THICKNESS_PRIMVAR
from .find import editable, original

_Fits = dict[tuple[int, int, bytes], Fit]


class Use(NamedTuple):
    """One prim that a material is on, or a part of one."""

    path: str
    edit: str
    """Path at which a stronger layer can say more about it; '' where none can."""
    fits: tuple[Fit, ...]
    """One for each different size and proportion it is drawn with; thickness in scene units."""
    whole: bool
    """The material is on all of it, not on a GeomSubset."""
    typed: bool
    """It has primvars:refraction:thickness already."""
    cage: bool
    """The control cage of a subdivision surface that is too large to be subdivided, so it is what is drawn."""
    holds: str = ""
    """Path of something that stands within it, where it is a ball or a box; '' for nothing."""


def find_uses(stage: Usd.Stage, time: Usd.TimeCode, materials: Iterable[str]) -> dict[str, list[Use]]:
    """What is drawn with each of the materials.

    Args:
        materials: paths as in `Glass.path`.

    Raises:
        StageError: where instances expand to more prims than can be drawn.
    """
    wanted = {original(stage.GetPrimAtPath(path)): path for path in materials}
    if not wanted:
        return {}
    notices: list[Notice] = []
    prims, placements = drawn(stage, time, notices)
    uses: dict[str, list[Use]] = defaultdict(list)
    shapes: dict[Hashable, Shape | None] = {}
    fits: _Fits = {}
    for prim, bound in zip(prims, bind(prims, notices), strict=True):
        of_prim = None if bound.material is None else original(bound.material.GetPrim())
        of_subsets = [None if material is None else original(material.GetPrim()) for _, material in bound.subsets]
        places = placements(prim) if any(place in wanted for place in (of_prim, *of_subsets)) else []
        if not places:
            continue
        key = _signature(prim, time)
        if key not in shapes:
            shapes[key] = read_shape(prim, time, notices)
        shape = shapes[key]
        if shape is None:
            continue
        sizes = list(_sizes(places, shape))
        for place, triangles in _divided(shape, of_prim, of_subsets, bound, time):
            if place in wanted and len(triangles) and sizes:
                found = tuple(_fit(shape, triangles, *size, fits) for size in sizes)
                whole = len(triangles) == len(shape.triangles)
                typed = bool(UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance(THICKNESS_PRIMVAR))
                edit = str(editable(prim) or "")
                uses[wanted[place]].append(Use(str(prim.GetPath()), edit, found, whole, typed, shape.cage))
    holders = {use.path for group in uses.values() for use in group if any(fit.model.sized for fit in use.fits)}
    held = contents(stage, time, holders, prims, placements) if holders else {}
    return {path: [use._replace(holds=held.get(use.path, "")) for use in group] for path, group in uses.items()}


_LOOKED_AT = 64
"""Places of a prim that are looked into; of more, an even choice stands for all."""


def contents(
    stage: Usd.Stage, time: Usd.TimeCode, holders: Collection[str], prims: list[Usd.Prim],
    placements: Callable[[Usd.Prim], list[F64]],
) -> dict[str, str]:  # fmt: skip
    """Something that stands within a ball or box: what such a model hides, for it looks straight out of its far side.

    A thing is within where its bounds are in those of the holder, and its middle in the ellipsoid that touches them.

    Args:
        holders: paths of the prims that are balls or boxes.
        prims, placements: as `drawn` gives them.

    Returns:
        By path of the holder, that of what it holds.
    """
    cache = UsdGeom.BBoxCache(time, [UsdGeom.Tokens.default_, UsdGeom.Tokens.render])
    paths: list[str] = []
    boxes: list[F64] = []
    for prim in prims:
        extent = cache.ComputeUntransformedBound(prim).ComputeAlignedRange()
        if not extent.IsEmpty():
            corners = np.array([(*extent.GetCorner(k), 1.0) for k in range(8)])
            every = [corners @ place[:3].T for place in placements(prim)]
            boxes += every
            paths += [str(prim.GetPath())] * len(every)
    if not boxes:
        return {}
    points, owners = np.stack(boxes), np.array(paths)
    found: dict[str, str] = {}
    for path in sorted(holders):
        prim = stage.GetPrimAtPath(path)
        extent = cache.ComputeUntransformedBound(prim).ComputeAlignedRange()
        if extent.IsEmpty():
            continue
        middle, half = np.array(extent.GetMidpoint()), np.array(extent.GetSize()) / 2.0
        places = placements(prim)
        for row in np.unique(np.linspace(0, len(places) - 1, min(len(places), _LOOKED_AT)).astype(int)).tolist():
            linear, origin = places[row][:3, :3], places[row][:3, 3]
            if abs(np.linalg.det(linear)) < 1.0e-30 or not (half > 0.0).all():
                continue
            at = ((points - origin) @ np.linalg.inv(linear).T - middle) / half  # in a cube of -1 .. 1
            inside = (np.abs(at) < 1.0 - 1.0e-6).all(axis=(1, 2)) & ((at.mean(axis=1) ** 2).sum(axis=1) < 1.0)
            if (others := owners[inside & (owners != path)]).size:
                found[path] = str(others[0])
                break
    return found


def drawn(
    stage: Usd.Stage, time: Usd.TimeCode, notices: list[Notice]
) -> tuple[list[Usd.Prim], Callable[[Usd.Prim], list[F64]]]:
    """Every prim with a surface, and a function that gives where it is drawn: world_from_prim, shape (3, 4)."""
    every = list(Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()))
    if any(prim.GetTypeName() == "PointInstancer" for prim in every):
        places: dict[Sdf.Path, list[F64]] = defaultdict(list)
        instanced = []
        for placement in walk(stage, time, PURPOSES, notices):
            if placement.prim.GetTypeName() not in DRAWN:
                continue
            if placement.prim.GetPath() not in places:
                instanced.append(placement.prim)
            places[placement.prim.GetPath()].extend(placement.worlds)
        return instanced, lambda prim: places[prim.GetPath()]
    cache = UsdGeom.XformCache(time)

    def place(prim: Usd.Prim) -> list[F64]:
        hidden = UsdGeom.Imageable(prim).ComputeVisibility(time) == UsdGeom.Tokens.invisible
        return [] if hidden else [np.array(cache.GetLocalToWorldTransform(prim)).T[:3]]

    return [prim for prim in every if prim.GetTypeName() in DRAWN], place


def _divided(
    shape: Shape, of_prim: Sdf.Path | None, of_subsets: list[Sdf.Path | None], bound: Bound, time: Usd.TimeCode
) -> Iterator[tuple[Sdf.Path | None, U32]]:
    """The triangles of each material on a prim."""
    if not of_subsets or shape.topology is None:
        yield of_prim, shape.triangles
        return
    number = np.zeros(shape.topology.face_count, np.int64)
    places = list(dict.fromkeys([of_prim, *of_subsets]))
    for (subset, _), place in zip(bound.subsets, of_subsets, strict=True):
        value = subset.GetIndicesAttr().Get(time)
        faces = np.zeros(0, np.int64) if value is None else np.asarray(value, np.int64)
        number[faces[(faces >= 0) & (faces < len(number))]] = places.index(place)
    of_triangle = number[shape.topology.faces]
    for row, place in enumerate(places):
        yield place, shape.triangles[of_triangle == row]


_ARRAYS = (
    "points", "faceVertexCounts", "faceVertexIndices", "holeIndices", "creaseIndices", "creaseLengths",
    "creaseSharpnesses", "cornerIndices", "cornerSharpnesses",
)  # fmt: skip
_TOKENS = ("orientation", "subdivisionScheme", "interpolateBoundary", "triangleSubdivisionRule")


def _signature(prim: Usd.Prim, time: Usd.TimeCode) -> Hashable:
    """The same for prims of the same shape, so that it is looked at once."""
    if prim.GetTypeName() != "Mesh":
        return original(prim)
    values = [prim.GetAttribute(name).Get(time) for name in _ARRAYS]
    arrays = [None if value is None else hash(np.asarray(value).tobytes()) for value in values]
    return (*arrays, *(str(prim.GetAttribute(name).Get(time)) for name in _TOKENS))


def _sizes(places: list[F64], shape: Shape) -> Iterator[tuple[float, F64]]:
    """Different sizes and proportions: scale, and shape (3, 3) of how lengths and angles are changed beside it.

    The second is the product of the transposed linear part with itself, over the squared scale: two placements that
    differ by a turn, a mirror or a place have the same.
    """
    linear = np.stack(places)[:, :3, :3] @ shape.prim_from_shape[:3, :3]
    if not np.isfinite(linear).all():
        return
    grams = np.swapaxes(linear, 1, 2) @ linear
    scales = np.sqrt(np.trace(grams, axis1=1, axis2=2) / 3.0)
    grams, scales = grams[scales > 0.0], scales[scales > 0.0]
    grams /= scales[:, None, None] ** 2
    if len(scales) == 1:
        yield float(scales[0]), grams[0]
        return
    rows = np.column_stack((np.round(np.log(scales), 6), np.round(grams.reshape(-1, 9), 6)))
    _, first = np.unique(rows, axis=0, return_index=True)
    for place in np.sort(first).tolist():
        yield float(scales[place]), grams[place]


def _fit(shape: Shape, triangles: U32, scale: float, gram: F64, fits: _Fits) -> Fit:
    """What suits some triangles at one size; the same shape at another size is looked at once."""
    key = (hash(shape.points.tobytes()), hash(triangles.tobytes()), np.round(gram, 6).tobytes())
    if key not in fits:
        values, vectors = np.linalg.eigh(gram)
        stretched = shape.points.astype(np.float64) @ (vectors * np.sqrt(np.maximum(values, 0.0)))
        fits[key] = fit(stretched, triangles)
        if not fits[key].closed and shape.closed and len(triangles) < len(shape.triangles):
            fits[key] = replace(fits[key], model=SOLID, closed=True, why="an open part of a closed mesh")
    return replace(fits[key], thickness=fits[key].thickness * scale, way=fits[key].way * scale)
