"""`refract convert`: glass found by its own shaders, described by RefractMaterialAPI, the model by its shape."""

from __future__ import annotations

import fnmatch
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from ..errors import Cancelled, StageError, UsageError
from ..files import folder_beside, replacing
from ..models import BY_TOKEN, MODELS, SHEET, SOLID, Behind, Model
from ..scene import Notice
from ..thickness.fit import alike, together

if TYPE_CHECKING:
    from ..usd.convert.author import Addition, Work
    from ..usd.convert.find import Glass
    from ..usd.convert.shapes import Use

THICKNESS = ("typed", "measured")
TARGETS = ("preview", "openpbr", "gltf")
GLTF = (".glb", ".gltf")


@dataclass(frozen=True, kw_only=True)
class ConvertOrder:
    """What to convert, and how. Checked when made."""

    stage: str
    out: str
    flatten: bool = False
    """Everything in one layer, instead of a layer over the stage."""
    model: str = ""
    """Used for all glass, whatever its shape, where not ''."""
    only: tuple[str, ...] = ()
    """Paths of materials, or of what holds them; * and ? stand for anything. Empty means all."""
    thickness: str = "typed"
    to: str = ""
    """Standard surface to write back: preview, openpbr or gltf."""
    overwrite: bool = False

    def __post_init__(self) -> None:
        for flag, value, known in (
            ("--model", self.model, MODELS), ("--thickness", self.thickness, THICKNESS), ("--to", self.to, TARGETS)
        ):  # fmt: skip
            if value and value not in known:
                raise UsageError(f"{flag} is '{value}', which is not known; choose from {', '.join(known)}")


@dataclass(frozen=True)
class Row:
    """What became of one material. Lengths in scene units."""

    path: str
    shader: str
    """The shader that says it is glass, such as UsdPreviewSurface."""
    action: str
    """applied; kept: the schema was there before; skipped: it cannot be reached"""
    model: str = ""
    ior: float = 1.5
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    color_from: str = ""
    """Output that drives the colour, or ''."""
    distance: float | None = None
    """None where the model fixes it, or nothing is absorbed."""
    thickness: float | None = None
    """None where the model needs none."""
    abbe: float = 0.0
    shapes: int = 0
    why: str = ""
    """What decided."""
    notes: tuple[str, ...] = ()
    """What was guessed or left out."""


@dataclass(frozen=True)
class Converted:
    """What `convert` did."""

    rows: tuple[Row, ...]
    notices: tuple[Notice, ...]
    """What is missing from the stage, or was lost on the way."""


@dataclass(frozen=True)
class _Plan:
    row: Row
    additions: tuple[Addition, ...] = ()
    sized: tuple[str, ...] = ()
    """Prims whose thickness could be measured."""


def convert(
    order: ConvertOrder,
    progress: Callable[[float, str], None] = lambda _fraction, _stage: None,
    cancel: Callable[[], bool] = lambda: False,
) -> Converted:
    """Write OUT, whole or not at all, and tell what became of every material that transmits light.

    Raises:
        UsageError: the order makes no sense, or OUT cannot be used.
        StageError: the stage cannot be read, or OUT cannot be written.
        Cancelled: `cancel` said so; nothing was written.
    """
    from ..usd.convert import author as usd
    from ..usd.convert import shapes as convert_shapes
    from ..usd.convert import surfaces as convert_to
    from ..usd.layers import write

    write.check_out(order.stage, order.out, overwrite=order.overwrite)
    progress(0.0, "opening")
    with folder_beside(order.out, "textures") as folder:
        work, found, pictures = _look(order, folder)
        chosen = _chosen(found, order.only)
        _go_on(cancel)
        progress(0.5, "shapes")
        uses = convert_shapes.find_uses(work.stage, work.time, [glass.path for glass in chosen if not glass.applied])
        plans = [_plan(glass, uses.get(glass.path, []), order.model, work.unit) for glass in chosen]
        _go_on(cancel)
        progress(0.8, "writing")
        usd.add(work.layer, [addition for plan in plans for addition in plan.additions])
        left: tuple[Notice, ...] = ()
        if order.thickness == "measured":
            from .bake_thickness import bake_over

            left = bake_over(work.layer, [path for plan in plans for path in plan.sized], cancel=cancel)
        _write_pictures(pictures)
        rows = [plan.row for plan in plans]
        if order.to:
            within_reach = [row.path for row in rows if row.action != "skipped"]
            told = convert_to.write_surfaces(work.layer, order.to, within_reach)
            rows = [replace(row, notes=(*row.notes, *told.get(row.path, ()))) for row in rows]
        write.save(work.layer, order.out)
    return Converted(tuple(rows), (*work.notices, *left))


def _look(order: ConvertOrder, pictures: str) -> tuple[Work, list[Glass], dict[str, bytes]]:
    """The stage with its glass, and the pictures that belong beside it: path and content."""
    from ..usd.convert import author as usd
    from ..usd.convert import find as convert_find
    from ..usd.convert import gltf_stage as convert_gltf

    if order.stage.lower().endswith(GLTF):
        work, found, content = convert_gltf.begin(order.stage, pictures)
        _check_pictures(content, order.overwrite)
        return work, found, content
    work = usd.begin(order.stage, flatten=order.flatten)
    return work, convert_find.find_glass(work.stage, work.time, work.unit), {}


def _check_pictures(pictures: dict[str, bytes], overwrite: bool) -> None:
    for path, content in pictures.items():
        if os.path.lexists(path) and not overwrite and not (os.path.isfile(path) and _content(path) == content):
            raise UsageError(f"{path}: exists already, with another picture; remove it, or replace it with --overwrite")


def _content(path: str) -> bytes:
    with open(path, "rb") as file:
        return file.read()


def _write_pictures(pictures: dict[str, bytes]) -> None:
    for path, content in pictures.items():
        with replacing(path, StageError) as temporary:
            os.makedirs(os.path.dirname(path), exist_ok=True)
            Path(temporary).write_bytes(content)


def _go_on(cancel: Callable[[], bool]) -> None:
    if cancel():
        raise Cancelled("cancelled; nothing was written")


def _chosen(found: list[Glass], only: tuple[str, ...]) -> list[Glass]:
    """Those that `--only` names, by their own path or that of something above them."""
    if not only:
        return found
    for pattern in only:
        if not any(_matches(glass.path, pattern) for glass in found):
            few = ", ".join(glass.path for glass in found[:5]) + (", ..." if len(found) > 5 else "")
            known = f"there are {few}" if found else "there is none"
            raise UsageError(f"--only {pattern}: no glass is there; {known}")
    return [glass for glass in found if any(_matches(glass.path, pattern) for pattern in only)]


def _matches(path: str, pattern: str) -> bool:
    pattern = pattern.rstrip("/") or "/*"
    return fnmatch.fnmatchcase(path, pattern) or fnmatch.fnmatchcase(path, f"{pattern}/*")


# --- one material ---------------------------------------------------------------------------------------------------


def _plan(glass: Glass, uses: list[Use], forced: str, unit: float) -> _Plan:
    """Decide what is added for one material.

    Args:
        forced: the model of `--model`, or ''.
        unit: metres per scene unit.
    """
    row = Row(glass.path, glass.shader, "applied", ior=_neat(glass.ior), abbe=_neat(glass.abbe), shapes=len(uses))
    if glass.applied:
        return _Plan(replace(row, action="kept", why="RefractMaterialAPI is there already; nothing is changed"))
    if not glass.edit:
        why = "lies in an instance of another file, out of a layer's reach; --flatten reaches it"
        return _Plan(replace(row, action="skipped", why=why, notes=glass.notes))
    model, why, notes = _model(glass, uses, forced)
    thickness: float | None = None
    per_prim: dict[str, float] | None = {}
    more: list[str] = []
    if model.sized:
        thickness, per_prim, more = _thickness(glass, uses)
        if per_prim is None and not forced:
            model, thickness, more = SOLID, None, []
            why = "one prim is drawn in several sizes, and a typed thickness is one number"
    color, distance = _absorption(glass, model, thickness, unit, more)
    if glass.authored:
        more.append(f"authored already, and kept: {', '.join(sorted(glass.authored))}")
    row = replace(
        row, model=model.token, color=color, color_from=glass.color_from, distance=distance,
        thickness=thickness, why=why, notes=tuple(dict.fromkeys((*glass.notes, *notes, *more))),
    )  # fmt: skip
    sized = tuple(use.path for use in uses if use.edit) if model.sized else ()
    return _Plan(row, tuple(_additions(glass, row, per_prim or {})), sized)


def _model(glass: Glass, uses: list[Use], forced: str) -> tuple[Model, str, list[str]]:
    """The model, what decided, and what a person should know about it."""
    notes = []
    if any(use.cage for use in uses):
        notes.append("judged by the control cage of a subdivision surface, which is what is drawn")
    if forced:
        return BY_TOKEN[forced], "--model", notes
    if glass.thin:
        return SHEET, "thin-walled by its shader", notes
    fits = [fit for use in uses for fit in use.fits]
    if not fits:
        return SOLID, "nothing that is drawn is bound to it", notes
    best = together(fits)
    opened = [use.path for use in uses if not all(fit.closed for fit in use.fits)]
    if best.model.behind is Behind.MESH and opened:
        notes.append(f"{opened[0]} is open, so it is drawn as '{SHEET.token}'; give it a material of its own to say so")
    return best.model, best.why, notes


def _thickness(glass: Glass, uses: list[Use]) -> tuple[float | None, dict[str, float] | None, list[str]]:
    """Thickness of the material, of single prims that need another, and notes.

    The second is None where one prim is drawn in several sizes, so that no typed number holds.
    """
    if glass.thickness > 0.0:
        return _neat(glass.thickness), {}, ["thickness as its shader has it"]
    by_use = {use: [fit.thickness for fit in use.fits if fit.thickness > 0.0] for use in uses if not use.typed}
    every = [value for values in by_use.values() for value in values]
    if not every:
        return None, {}, ["nothing to take a thickness from; author inputs:refraction:thickness"] if not uses else []
    middle = _neat(median(every))
    if alike(every):
        return middle, {}, []
    several = [use.path for use, values in by_use.items() if not (alike(values) and use.edit and use.whole)]
    if several:
        return middle, None, [f"{several[0]} is drawn in several sizes; the median is used"]
    per_prim = {use.edit: _neat(median(values)) for use, values in by_use.items() if values}
    return middle, per_prim, [f"shapes differ in size: {len(per_prim)} prims get primvars:refraction:thickness"]


def _absorption(
    glass: Glass, model: Model, thickness: float | None, unit: float, notes: list[str]
) -> tuple[tuple[float, float, float], float | None]:
    """Colour and the distance after which it is left; None where the model fixes it or nothing is absorbed."""
    color = tuple(_neat(value) for value in glass.color)
    clear = color == (1.0, 1.0, 1.0) and not glass.color_from
    if model.fixed_thickness:
        own = f"the {model.token} model's {model.fixed_thickness * 1000:g} mm"
        if clear or glass.distance is None:
            return color, None  # type: ignore[return-value]
        if glass.color_from:
            notes.append(f"the colour is mapped, so it holds for {own} instead of its own distance")
            return color, None  # type: ignore[return-value]
        # After the way through a wall of fixed thickness, color^(thickness / distance) is left.
        power = model.fixed_thickness / (glass.distance * unit)
        notes.append(f"colour taken from {_neat(glass.distance):g} units to {own}")
        return tuple(_neat(value**power) for value in color), None  # type: ignore[return-value]
    if clear:
        return color, None  # type: ignore[return-value]
    if glass.distance is not None:
        return color, _neat(glass.distance)  # type: ignore[return-value]
    distance = thickness if model.sized and thickness else 1.0
    notes.append(f"its colour tints a surface at any depth; here it is left after {distance:g} units")
    return color, distance  # type: ignore[return-value]


def _additions(glass: Glass, row: Row, per_prim: dict[str, float]) -> Iterable[Addition]:
    from ..usd.convert.author import Addition

    values: dict[str, Any] = {"refraction:model": row.model, "inputs:refraction:ior": row.ior}
    connections: dict[str, str] = {}
    if row.color != (1.0, 1.0, 1.0) or row.color_from:
        values["inputs:refraction:transmittanceColor"] = row.color
        if row.color_from:
            connections["inputs:refraction:transmittanceColor"] = row.color_from
    for name, value in (("absorptionDistance", row.distance), ("thickness", row.thickness)):
        if value is not None:
            values[f"inputs:refraction:{name}"] = value
    if row.abbe > 0.0:
        values["inputs:refraction:abbeNumber"] = row.abbe
    mine = {name: value for name, value in values.items() if name not in glass.authored}
    wired = {name: source for name, source in connections.items() if name not in glass.authored}
    yield Addition(glass.edit, True, mine, wired)
    for path, thickness in per_prim.items():
        yield Addition(path, False, {"primvars:refraction:thickness": thickness}, {})


def _neat(value: float) -> float:
    """Six digits: what float32 holds, and a person can read."""
    return float(f"{value:.6g}")
