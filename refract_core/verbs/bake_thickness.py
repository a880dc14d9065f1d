"""Baking thickness: what rays find in the geometry, as primvars or pictures in a layer over the stage.

Values are in scene units of the stage's world, as the renderer takes them: a prim under a scale of 2 gets twice the
thickness. What is measured along a ray is said at the head of `thickness`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from ..errors import UsageError
from ..files import folder_beside
from ..images.pictures import write_map
from ..models import Behind
from ..progress import Report
from ..scene import F32, F64, Notice
from ..settings import AS_IT_IS, Opening
from ..thickness.measure import Places, corner_places, measure, mended, middle_places, views
from ..thickness.picture import OVERLAP, TILES, draw, is_tiled
from ..thickness.unwrap import EXTRA, unwrap
from ..usd.layers.write import check_out, is_over, overlay, save
from ..usd.stage import open_stage
from ..usd.thickness.find import Body, Candidate, Coat, Found, find_candidates, read_body, stage_of
from ..usd.thickness.write import (
    MADE,
    MADE_UV,
    Map,
    Values,
    lost_bindings,
    spread_values,
    uv_of_corners,
    write_maps,
    write_uvs,
    write_values,
)
from ..version import __version__
from ..world.solid import areas
from .orders import JOBS, check_range, file_names, make_folder_of, refuse_existing, select, stop_if

ALONG = ("normal", "refracted")
TEXTURE = (16, 8192)
_UNEVEN = 0.05
"""Relative spread over which a prim that carries one value is told to vary."""
_OUT_OF_REACH = "it lies in an instance of another file, out of a layer's reach; make the instance not instanceable"
_STATE = "nothing was written"


@dataclass(frozen=True, kw_only=True)
class ThicknessOrder:
    """What to measure, and where to write it. Checked when made."""

    stage: str
    out: str
    """The layer over the stage; pictures go into the folder `<stem of out>.thickness` beside it, or into a .usdz."""
    only: tuple[str, ...] = ()
    """Prim paths, or paths of prims above, with * and ? for any characters; () means all glass."""
    along: str = "normal"
    texture: int = 0
    """[texels] on a side of a picture in each object's own uv; 0 writes primvars."""
    jobs: int = 0
    overwrite: bool = False
    opening: Opening = AS_IT_IS
    """Session layer, variants and mask."""

    def __post_init__(self) -> None:
        if self.along not in ALONG:
            raise UsageError(f"--along is '{self.along}', which is not known; choose from {', '.join(ALONG)}")
        if self.texture:
            check_range("--texture", self.texture, TEXTURE)
        check_range("--jobs", self.jobs, JOBS)


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
    uvs: dict[str, F64] = field(default_factory=dict)
    """Texture coordinates that were made, by path: shape (N, 2), face-varying"""


# --- the verb -------------------------------------------------------------------------------------------------------


def bake_thickness(order: ThicknessOrder, report: Report, cancel: Callable[[], bool]) -> tuple[Row, ...]:
    """Measure the glass of a stage and write a layer over it that says how thick it is.

    Args:
        order: checked completely before the first ray, as far as that is possible.
        report: told about progress, what is left alone and why, and what was measured on each prim.
        cancel: True stops the work; nothing is written.

    Raises:
        RefractError: whatever goes wrong.
    """
    check_out(order.stage, order.out, overwrite=order.overwrite, ours=MADE)
    report.progress(0.0, "reading the stage")
    stage = open_stage(order.stage, order.opening)
    found = find_candidates(stage)
    chosen = select(found.candidates, order.only, lambda one: one.paths, "glass")
    for notice in found.notices:
        report.warning(notice.path, notice.text)
    if not chosen:
        report.warning(order.stage, "has no glass; OUT is a layer that changes nothing")
    with folder_beside(order.out, "thickness") as folder:
        names = file_names(one.path for one in chosen) if order.texture else {}
        files = {path: os.path.join(folder, name) for path, name in names.items()}
        if not (order.overwrite or is_over(order.out, order.stage, made=MADE)):
            refuse_existing(files.values())
        how = How(order.along, order.texture, order.jobs, lambda: stop_if(cancel, _STATE))
        work = _measure_all(found, chosen, how, files, report.progress)
        stop_if(cancel, _STATE)
        layer = overlay(order.stage, made=MADE)
        write_values(layer, stage, work.values, _unmapped(work))
        write_uvs(layer, work.uvs)
        bound = write_maps(layer, stage, work.maps)
        _tell(report, found, work, lost_bindings(layer, bound))
        _write_pictures(work.pictures)
        save(layer, order.out)
    if chosen and not work.rows:
        report.warning(order.out, f"nothing was measured, and the layer changes nothing: {_why_nothing(work)}")
    left = len(work.left) + len(work.fixed)
    report.done(order.out, f"{len(work.rows)} prims measured along {order.along}, {left} left alone")
    return tuple(work.rows)


def _why_nothing(work: Work) -> str:
    if work.fixed:
        return f"the model of {work.fixed[0]} fixes the thickness; give it another, such as sphere or box"
    return "all of the glass was left alone, for the reasons above"


def bake_over(
    layer: Any,
    prims: Sequence[str],
    *,
    along: str = "normal",
    jobs: int = 0,
    cancel: Callable[[], bool] = lambda: False,
    opening: Opening = AS_IT_IS,
) -> tuple[Notice, ...]:
    """Author the measured thickness of prims in a layer over their stage, as primvars, in place of typed ones.

    Args:
        layer: an Sdf.Layer that holds the stage or has it as a sublayer, with the materials as they are to be.
        prims: paths; what of them is no glass, or not below the layer, is passed over.
        opening: session layer, variants and mask of the stage.

    Returns:
        What was left as it was, and why.
    """
    stage = stage_of(layer, opening)
    found = find_candidates(stage)
    wanted = set(prims)
    chosen = [candidate for candidate in found.candidates if wanted & set(candidate.paths)]
    how = How(along, 0, jobs, lambda: stop_if(cancel, _STATE))
    work = _measure_all(found, chosen, how, {}, lambda _fraction, _text: None)
    write_values(layer, stage, work.values, _unmapped(work))
    return tuple(work.left)


def _tell(report: Report, found: Found, work: Work, lost: Iterable[Notice]) -> None:
    """What was left alone and why, what comes in the way of what was written, and what was measured."""
    for notice in (*work.left, *lost):
        report.warning(notice.path, notice.text)
    for path in work.fixed:
        report.done(path, "left alone: its model fixes the thickness")
    measured = {row.path for row in work.rows}
    for coat in work.coats.values():
        others = sorted(found.bound_to[coat.material] - measured)
        if others and coat.edit:
            text = f"its thickness is disconnected, also for {others[0]}, which was not measured and takes the constant"
            report.warning(coat.edit, text)
    for row in work.rows:
        report.done(row.path, "; ".join((f"{row.least:.4g} to {row.most:.4g}, mean {row.mean:.4g}", row.how)))
        for note in row.notes:
            report.warning(row.path, note)


def _unmapped(work: Work) -> list[str]:
    return [coat.edit for coat in work.coats.values() if coat.edit]


def _write_pictures(pictures: dict[str, F32]) -> None:
    for file, picture in pictures.items():
        make_folder_of(file)
        write_map(file, picture, {"software": f"refract {__version__}"})


# --- measuring ------------------------------------------------------------------------------------------------------


def _measure_all(
    found: Found, chosen: list[Candidate], how: How, files: dict[str, str], progress: Callable[[float, str], None]
) -> Work:
    """Measure some of the glass of a stage.

    Args:
        files: path of the picture of each candidate, where there are to be pictures.
    """
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
    if why := _no_material(candidate):
        return why
    made = _unwrapped(body, how, notes) if body.uv is None else None
    if isinstance(made, str):
        return made
    if made is not None:
        body, coordinates = made
    picture = _picture(candidate, body, how, notes)
    if isinstance(picture, str):
        return picture
    if made is not None:
        work.uvs[candidate.edit] = coordinates
    file, most, mean = files[candidate.path], float(picture.max()), float(picture.mean())
    work.pictures[file] = picture / most
    for coat in candidate.coats:
        alone = found.bound_to[coat.material] <= set(candidate.paths)
        owner = candidate.edit.rsplit("/", 1)[-1]
        tiled = body.uv is not None and is_tiled(body.uv)
        work.maps.append(Map(coat, owner, alone, file, body.uv_name, most, mean, tiled))
    work.rows.append(_row(candidate, picture, os.path.basename(file), notes))
    return ""


def _row(candidate: Candidate, values: F64 | F32, how: str, notes: list[str]) -> Row:
    return Row(candidate.path, float(values.min()), float(values.mean()), float(values.max()), how, tuple(notes))


def _advice(candidate: Candidate, how: How) -> Iterator[str]:
    """What a person should know of a prim's glass before trusting the numbers."""
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
    coat = candidate.coats[0]
    return views(coat.model.behind is Behind.SLAB, coat.ior, how.along)


def _corners(candidate: Candidate, body: Body, how: How, notes: list[str]) -> F64 | str:
    """Values at the triangle corners, shape (T, 3)."""
    places, picks = corner_places(body.triangles, body.normals)
    rays = _views(candidate, how)
    values = measure(body.points, body.triangles, places, rays, jobs=how.jobs, go_on=how.go_on)
    if lost := int(np.isnan(values).sum()):
        if lost == len(values):
            return "no ray found a far side"
        notes.append(f"{lost} of {len(values)} places found no far side and take their neighbours' thickness")
    return mended(values, picks)[picks]


def _gprim(candidate: Candidate, body: Body, how: How, notes: list[str]) -> F64 | str:
    """The one value that a gprim carries, shape (1,): a sphere's diameter, of others the median over the surface."""
    rays = _views(candidate, how)
    if body.radius > 0.0:  # a path of 2 R cos t
        return np.array([2.0 * body.radius * (rays[:, 2] * rays[:, 3]).sum() / (rays[:, 3] ** 2).sum()])
    values = measure(body.points, body.triangles, middle_places(body.normals), rays, jobs=how.jobs, go_on=how.go_on)
    size = areas(body.points[body.triangles])
    known = np.isfinite(values)
    if not known.any():
        return "no ray found a far side"
    values, size = values[known], size[known]
    rank = np.argsort(values)
    half = np.searchsorted(np.cumsum(size[rank]), size.sum() / 2.0)
    middle = float(values[rank][min(int(half), len(values) - 1)])
    if values.max() - values.min() > _UNEVEN * middle:
        kind = candidate.prim.GetTypeName()
        notes.append(
            f"a {kind} carries one value, so it has the median of {values.min():.4g} to {values.max():.4g}; "
            "as a Mesh it could vary"
        )
    return np.array([middle])


def _no_material(candidate: Candidate) -> str:
    """Why there is no material that a picture could be connected to; '' where there is one."""
    for coat in candidate.coats:
        if not coat.applied:
            return "its material has no RefractMaterialAPI to connect a picture to; run refract convert first"
        if not (coat.edit and coat.bound):
            return "its material lies in an instance, out of a layer's reach; leave out --texture"
    return ""


def _unwrapped(body: Body, how: How, notes: list[str]) -> tuple[Body, F64] | str:
    """A body with coordinates made for it, and what a face-varying primvar has of them; or why it has none."""
    otherwise = "leave out --texture, which stores the thickness at the points"
    try:
        uv, charts = unwrap(body.points, body.triangles, how.texture)
    except UsageError:
        return f"it has no uv for a picture, and making some {EXTRA}; or {otherwise}"
    values = uv_of_corners(body, uv)
    if values is None:
        return f"it has no uv for a picture, and its own faces cannot carry one that is made; {otherwise}"
    notes.append(f"it had no uv: primvars:{MADE_UV} was made, {charts} chart{'s' if charts > 1 else ''}")
    return replace(body, uv=uv, uv_name=MADE_UV), values


def _picture(candidate: Candidate, body: Body, how: How, notes: list[str]) -> F32 | str:
    """Thickness by uv, shape (N, N)."""
    assert body.uv is not None
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
