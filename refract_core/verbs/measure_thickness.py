"""What rays find on the prims of a stage, gathered before anything is written: values for primvars, or pictures."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..models import Behind
from ..scene import F32, F64, Notice

if TYPE_CHECKING:
    from ..usd.thickness import Map, Values
    from ..usd.thickness_find import Body, Candidate, Coat, Found

_UNEVEN = 0.05
"""Relative spread over which a prim that carries one value is told to vary."""
_OUT_OF_REACH = "it lies in an instance of another file, out of a layer's reach; make the instance not instanceable"


class How(NamedTuple):
    """What to measure."""

    along: str
    texture: int
    """[texels] on a side; 0 for primvars"""
    jobs: int
    go_on: Callable[[], None]
    """Called now and then; what it raises ends the work."""


@dataclass(frozen=True)
class Row:
    """What was measured on one prim. Lengths in scene units."""

    path: str
    least: float
    mean: float
    most: float
    how: str
    """constant, vertex, faceVarying, or the name of the picture"""
    notes: tuple[str, ...] = ()


@dataclass
class Work:
    """What is gathered before anything is written."""

    rows: list[Row] = field(default_factory=list)
    left: list[Notice] = field(default_factory=list)
    """What was left alone, and why."""
    fixed: list[str] = field(default_factory=list)
    """Prims whose model fixes the thickness."""
    values: list[Values] = field(default_factory=list)
    coats: dict[str, Coat] = field(default_factory=dict)
    """Materials whose map comes before the primvars, by path"""
    maps: list[Map] = field(default_factory=list)
    pictures: dict[str, F32] = field(default_factory=dict)


def measure_all(
    found: Found, chosen: list[Candidate], how: How, files: dict[str, str], progress: Callable[[float, str], None]
) -> Work:
    """Measure some of the glass of a stage.

    Args:
        files: path of the picture of each candidate, where there are to be pictures.
    """
    from ..usd.thickness_find import read_body

    work = Work()
    for number, candidate in enumerate(chosen):
        how.go_on()
        progress(number / len(chosen), f"measuring {candidate.path}")
        coats = tuple(coat for coat in candidate.coats if not coat.model.fixed_thickness)
        if not coats:
            work.fixed.append(candidate.path)
            continue
        candidate = replace(candidate, coats=coats)
        body = _OUT_OF_REACH if not candidate.edit else read_body(candidate, found.time, wants_uv=bool(how.texture))
        why = body if isinstance(body, str) else _one(candidate, body, found, how, files, work)
        if why:
            work.left.append(Notice(candidate.path, f"left alone: {why}"))
    return work


def _one(candidate: Candidate, body: Body, found: Found, how: How, files: dict[str, str], work: Work) -> str:
    """Measure one prim and note what is to be written; says why where that cannot be."""
    from ..usd.thickness import Map, Values, spread_values

    notes = [*body.notes, *_advice(candidate, how)]
    if body.topology is None or not how.texture:
        measured = _gprim(candidate, body, how, notes) if body.topology is None else None
        values = _corners(candidate, body, how, notes) if measured is None else measured
        if isinstance(values, str):
            return values
        kind, flat = ("constant", values) if body.topology is None else spread_values(body, values)
        work.values.append(Values(candidate.edit, kind, flat))
        work.coats.update({coat.material: coat for coat in candidate.coats if coat.mapped})
        work.rows.append(_row(candidate, flat, kind, notes))
        return ""
    picture = _no_material(candidate) or _picture(candidate, body, how, notes)
    if isinstance(picture, str):
        return picture
    file, most, mean = files[candidate.path], float(picture.max()), float(picture.mean())
    work.pictures[file] = picture / most
    for coat in candidate.coats:
        alone = found.bound_to[coat.material] <= set(candidate.paths)
        owner = candidate.edit.rsplit("/", 1)[-1]
        work.maps.append(Map(coat, owner, alone, file, body.uv_name, most, mean, _is_tiled(body)))
    work.rows.append(_row(candidate, picture, os.path.basename(file), notes))
    return ""


def _row(candidate: Candidate, values: F64 | F32, how: str, notes: list[str]) -> Row:
    return Row(candidate.path, float(values.min()), float(values.mean()), float(values.max()), how, tuple(notes))


def _advice(candidate: Candidate, how: How) -> Iterator[str]:
    for coat in candidate.coats:
        if coat.multiplier != 1.0:
            yield (
                f"inputs:refraction:thicknessMultiplier of {coat.material} is {coat.multiplier:g}, so that many times "
                "what was measured is drawn; author 1"
            )
        if coat.mapped and not coat.edit:
            yield f"the map of {coat.material} comes first, and lies in an instance, where it cannot be disconnected"
    kinds = {(coat.model.behind is Behind.SLAB, coat.ior) for coat in candidate.coats}
    if how.along == "refracted" and len(kinds) > 1:
        yield f"it has several kinds of glass; that of {candidate.coats[0].material} is used for all of it"


def _views(candidate: Candidate, how: How) -> F64:
    from ..thickness.measure import views

    coat = candidate.coats[0]
    return views(coat.model.behind is Behind.SLAB, coat.ior, how.along)


def _corners(
    candidate: Candidate, body: Body, how: How, notes: list[str]
) -> F64 | str:
    """Values at the triangle corners, shape (T, 3)."""
    from ..thickness.measure import corner_places, measure, mended

    places, picks = corner_places(body.triangles, body.normals)
    rays = _views(candidate, how)
    values = measure(body.points, body.triangles, places, rays, jobs=how.jobs, go_on=how.go_on)
    if lost := int(np.isnan(values).sum()):
        if lost == len(values):
            return "no ray found a far side"
        notes.append(f"{lost} of {len(values)} places found no far side and take their neighbours' thickness")
    return mended(values, picks)[picks]


def _gprim(
    candidate: Candidate, body: Body, how: How, notes: list[str]
) -> F64 | str:
    """The one value that a gprim carries, shape (1,): a sphere's diameter, of others the median over the surface."""
    from ..thickness.measure import measure, middle_places

    rays = _views(candidate, how)
    if body.radius > 0.0:  # a path of 2 R cos t
        return np.array([2.0 * body.radius * (rays[:, 2] * rays[:, 3]).sum() / (rays[:, 3] ** 2).sum()])
    values = measure(body.points, body.triangles, middle_places(body.normals), rays, jobs=how.jobs, go_on=how.go_on)
    sides = body.points[body.triangles]
    areas = np.linalg.norm(np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]), axis=1)
    known = np.isfinite(values)
    if not known.any():
        return "no ray found a far side"
    values, areas = values[known], areas[known]
    rank = np.argsort(values)
    half = np.searchsorted(np.cumsum(areas[rank]), areas.sum() / 2.0)
    middle = float(values[rank][min(int(half), len(values) - 1)])
    if values.max() - values.min() > _UNEVEN * middle:
        kind = candidate.prim.GetTypeName()
        notes.append(
            f"a {kind} carries one value, so it has the median of {values.min():.4g} to {values.max():.4g}; "
            "as a Mesh it could vary"
        )
    return np.array([middle])


def _is_tiled(body: Body) -> bool:
    from ..thickness.picture import is_tiled

    return body.uv is not None and is_tiled(body.uv)


def _no_material(candidate: Candidate) -> str:
    """Why there is no material that a picture could be connected to; '' where there is one."""
    for coat in candidate.coats:
        if not coat.applied:
            return "its material has no RefractMaterialAPI to connect a picture to; run refract convert first"
        if not (coat.edit and coat.bound):
            return "its material lies in an instance, out of a layer's reach; leave out --texture"
    return ""


def _picture(
    candidate: Candidate, body: Body, how: How, notes: list[str]
) -> F32 | str:
    """Thickness by uv, shape (N, N)."""
    from ..thickness.measure import Places, measure
    from ..thickness.picture import OVERLAP, TILES, draw

    if body.uv is None:
        return "it has no uv for a picture; leave out --texture, which stores the thickness at the points"
    if not (np.isfinite(body.uv).all() and np.abs(body.uv - 0.5).max() <= TILES + 0.5):
        return f"its uv primvars:{body.uv_name} reaches more than {TILES:g} tiles away from 0 .. 1"
    rays = _views(candidate, how)

    def thickness(places: Places) -> F64:
        return measure(body.points, body.triangles, places, rays, jobs=how.jobs, go_on=how.go_on)

    picture, overlap = draw(body.uv, body.normals, how.texture, thickness)
    if picture.max() <= 0.0:
        return f"its uv primvars:{body.uv_name} covers no texel"
    if overlap > OVERLAP:
        notes.append(
            f"its uv primvars:{body.uv_name} overlaps itself: {overlap:.0%} of the texels stand for several places and "
            "hold their mean; leave out --texture, or unwrap it"
        )
    return picture


