"""`refract convert`: glass found by its own shaders, described by RefractMaterialAPI, the model by its shape."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from ..errors import StageError, UsageError
from ..files import folder_beside, write_whole
from ..models import BY_TOKEN, MODELS, SHEET, SOLID, Behind, Model
from ..scene import Notice
from ..settings import AS_IT_IS, Opening
from ..thickness.fit import alike, together
from ..usd.convert import gltf_stage
from ..usd.convert.author import Addition, Work, add, begin
from ..usd.convert.find import Glass, find_glass
from ..usd.convert.gltf_write import write_gltf
from ..usd.convert.mtlx_write import write_mtlx
from ..usd.convert.standard import write_surfaces
from ..usd.convert.uses import Use, find_uses
from ..usd.layers.write import EXTENSIONS, GLTF, check_out, is_gltf, save
from ..usd.thickness.find import stage_of
from ..usd.values import neat
from .orders import make_folder_of, refuse_existing, select, stop_if

THICKNESS = ("typed", "measured")
TARGETS = ("preview", "openpbr", "gltf", "mtlx")
MTLX = ".mtlx"


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
    """Standard surface to write back: preview, openpbr or gltf. Where `out` is a .glb, .gltf or .mtlx file, what it is
    says its extension, and this may say gltf or mtlx again."""
    overwrite: bool = False
    opening: Opening = AS_IT_IS
    """Session layer, variants and mask."""

    def __post_init__(self) -> None:
        for flag, value, known in (
            ("--model", self.model, MODELS), ("--thickness", self.thickness, THICKNESS), ("--to", self.to, TARGETS)
        ):  # fmt: skip
            if value and value not in known:
                raise UsageError(f"{flag} is '{value}', which is not known; choose from {', '.join(known)}")
        if self.to == "mtlx" and self.kind != "mtlx":
            raise UsageError(f"--to mtlx writes a file of its own; end the name of OUT with {MTLX}")
        if self.kind and self.to not in ("", self.kind):
            raise UsageError(f"--to {self.to} goes into a USD file, and {self.out} is none; leave --to out")

    @property
    def kind(self) -> str:
        """What OUT is where it is no USD file: gltf or mtlx."""
        extension = os.path.splitext(self.out)[1].lower()
        return "gltf" if extension in GLTF else "mtlx" if extension == MTLX else ""


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
    """Output or picture that drives the colour, or ''."""
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
    check_out(order.stage, order.out, overwrite=order.overwrite, extensions=(*EXTENSIONS, *GLTF, MTLX))
    progress(0.0, "opening")
    with _folder(order) as folder:
        work, found, pictures = _look(order, folder)
        chosen = select(found, order.only, lambda glass: (glass.path,), "glass")
        stop_if(cancel, "nothing was written")
        progress(0.5, "shapes")
        uses = find_uses(work.stage, work.time, [glass.path for glass in chosen if not glass.applied])
        plans = [_plan(glass, uses.get(glass.path, []), order.model, work.unit) for glass in chosen]
        stop_if(cancel, "nothing was written")
        progress(0.8, "writing")
        add(work.layer, [addition for plan in plans for addition in plan.additions])
        left: tuple[Notice, ...] = ()
        if order.thickness == "measured":
            from .bake_thickness import bake_over

            prims = [path for plan in plans for path in plan.sized]
            left = bake_over(work.layer, prims, cancel=cancel, opening=work.opening)
        _write_pictures(pictures)
        rows = [plan.row for plan in plans]
        if order.kind:
            told, more = _export(order, work, folder)
        else:
            told, more = _write_back(order.to, work, rows) if order.to else {}, ()
            save(work.layer, order.out)
    noted = [replace(row, notes=(*row.notes, *told.pop(row.path, ()))) for row in rows]
    of_others = (Notice(path, text) for path, texts in told.items() for text in texts)  # opaque ones have no row
    return Converted(tuple(noted), (*work.notices, *left, *more, *of_others))


@contextmanager
def _folder(order: ConvertOrder) -> Iterator[str]:
    """Where pictures go that OUT refers to; a glTF file takes them in."""
    if order.kind != "gltf":
        with folder_beside(order.out, "textures") as beside:
            yield beside
        return
    with TemporaryDirectory(prefix="refract-") as folder:
        yield folder


_Told = dict[str, tuple[str, ...]]
"""What there is to say of single materials, by path."""


def _write_back(target: str, work: Work, rows: Iterable[Row]) -> _Told:
    """Standard surfaces into the layer. What was done."""
    # Unmasked: what a material in an instance is made of may lie outside of the mask.
    stage = stage_of(work.layer, replace(work.opening, mask=()))
    return write_surfaces(stage, target, [row.path for row in rows if row.action != "skipped"])


def _export(order: ConvertOrder, work: Work, folder: str) -> tuple[_Told, tuple[Notice, ...]]:
    """Write OUT as what it is. What it does not say of single materials, and of all."""
    stage = stage_of(work.layer)
    made = write_gltf(stage, order.out) if order.kind == "gltf" else write_mtlx(stage, order.out, folder)
    _write_pictures(made.pictures)
    write_whole(order.out, made.content, StageError)
    return made.notes, made.notices


def _look(order: ConvertOrder, pictures: str) -> tuple[Work, list[Glass], dict[str, bytes]]:
    """The stage with its glass, and the pictures that belong beside it: path and content."""
    if is_gltf(order.stage):
        if order.opening != AS_IT_IS:
            flags = "--variant, --session-layer and --mask"
            raise UsageError(f"{flags} change how a USD stage is opened, and {order.stage} is none; leave them out")
        work, found, content = gltf_stage.begin(order.stage, pictures)
        if not order.overwrite:
            refuse_existing(path for path, picture in content.items() if not _holds(path, picture))
        return work, found, content
    work = begin(order.stage, flatten=order.flatten or bool(order.kind), opening=order.opening)
    return work, find_glass(work.stage, work.time, work.unit), {}


def _holds(path: str, content: bytes) -> bool:
    return os.path.isfile(path) and Path(path).read_bytes() == content


def _write_pictures(pictures: Mapping[str, bytes]) -> None:
    for path, content in pictures.items():
        make_folder_of(path)
        write_whole(path, content, StageError)


# --- one material ---------------------------------------------------------------------------------------------------


def _plan(glass: Glass, uses: list[Use], forced: str, unit: float) -> _Plan:
    """Decide what is added for one material.

    Args:
        forced: the model of `--model`, or ''.
        unit: metres per scene unit.
    """
    row = Row(glass.path, glass.shader, "applied", ior=neat(glass.ior), abbe=neat(glass.abbe), shapes=len(uses))
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
    color, distance = _absorption(glass, model, thickness, uses, unit, more)
    if glass.authored:
        more.append(f"authored already, and kept: {', '.join(sorted(glass.authored))}")
    driver = glass.color_from or (glass.color_map.told() if glass.color_map else "")
    row = replace(
        row, model=model.token, color=color, color_from=driver, distance=distance,
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
    if best.model.sized and (holder := next((use for use in uses if use.holds), None)):
        return SOLID, f"{holder.path} holds {holder.holds}, which '{best.model.token}' would hide", notes
    opened = [use.path for use in uses if not all(fit.closed for fit in use.fits)]
    if best.model.behind is Behind.MESH and opened:
        notes.append(f"{opened[0]} is open, so it is drawn as '{SHEET.token}'; give it a material of its own to say so")
    return best.model, best.why, notes


def _thickness(glass: Glass, uses: list[Use]) -> tuple[float | None, dict[str, float] | None, list[str]]:
    """Thickness of the material, of single prims that need another, and notes.

    The second is None where one prim is drawn in several sizes, so that no typed number holds.
    """
    if glass.thickness > 0.0:
        return neat(glass.thickness), {}, ["thickness as its shader has it"]
    by_use = {use: [fit.thickness for fit in use.fits if fit.thickness > 0.0] for use in uses if not use.typed}
    every = [value for values in by_use.values() for value in values]
    if not every:
        return None, {}, ["nothing to take a thickness from; author inputs:refraction:thickness"] if not uses else []
    middle = neat(median(every))
    if alike(every):
        return middle, {}, []
    several = [use.path for use, values in by_use.items() if not (alike(values) and use.edit and use.whole)]
    if several:
        return middle, None, [f"{several[0]} is drawn in several sizes; the median is used"]
    per_prim = {use.edit: neat(median(values)) for use, values in by_use.items() if values}
    return middle, per_prim, [f"shapes differ in size: {len(per_prim)} prims get primvars:refraction:thickness"]


def _absorption(
    glass: Glass, model: Model, thickness: float | None, uses: list[Use], unit: float, notes: list[str]
) -> tuple[tuple[float, float, float], float | None]:
    """Colour and the distance after which it is left; None where the model fixes it or nothing is absorbed."""
    color = tuple(neat(value) for value in glass.color)
    driven = bool(glass.color_from or glass.color_map)
    clear = color == (1.0, 1.0, 1.0) and not driven
    if model.fixed_thickness:
        own = f"the {model.token} model's {model.fixed_thickness * 1000:g} mm"
        if clear or glass.distance is None:
            return color, None  # type: ignore[return-value]
        if driven:
            notes.append(f"the colour is mapped, so it holds for {own} instead of its own distance")
            return color, None  # type: ignore[return-value]
        # After the way through a wall of fixed thickness, color^(thickness / distance) is left.
        power = model.fixed_thickness / (glass.distance * unit)
        notes.append(f"colour taken from {neat(glass.distance):g} units to {own}")
        return tuple(neat(value**power) for value in color), None  # type: ignore[return-value]
    if clear:
        return color, None  # type: ignore[return-value]
    if glass.distance is not None:
        return color, neat(glass.distance)  # type: ignore[return-value]
    # As the renderer reads a shader's tint, so that the picture stays: after the mean way through a body.
    ways = [fit.way for use in uses for fit in use.fits if fit.way > 0.0]
    distance = glass.thickness or (neat(median(ways)) if ways else thickness or 1.0)
    notes.append(f"its colour tints a surface at any depth; here it is left after {distance:g} units")
    return color, distance  # type: ignore[return-value]


def _additions(glass: Glass, row: Row, per_prim: dict[str, float]) -> Iterable[Addition]:
    """What is authored on the material, and on single prims that need another thickness."""
    values: dict[str, Any] = {"refraction:model": row.model, "inputs:refraction:ior": row.ior}
    if row.color != (1.0, 1.0, 1.0) or row.color_from:
        values["inputs:refraction:transmittanceColor"] = row.color
    connections = {"inputs:refraction:transmittanceColor": glass.color_from}
    maps = {"inputs:refraction:transmittanceColor": glass.color_map}
    if row.thickness is not None:
        connections["inputs:refraction:thickness"] = glass.thickness_from
        maps["inputs:refraction:thickness"] = glass.thickness_map
    for name, value in (("absorptionDistance", row.distance), ("thickness", row.thickness)):
        if value is not None:
            values[f"inputs:refraction:{name}"] = value
    if row.abbe > 0.0:
        values["inputs:refraction:abbeNumber"] = row.abbe
    mine = {name: value for name, value in values.items() if name not in glass.authored}
    wired = {name: source for name, source in connections.items() if source and name not in glass.authored}
    made = {name: what for name, what in maps.items() if what is not None and name not in glass.authored}
    yield Addition(glass.edit, True, mine, wired, made, glass.space)
    for path, thickness in per_prim.items():
        yield Addition(path, False, {"primvars:refraction:thickness": thickness}, {})
