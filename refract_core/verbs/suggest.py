"""Which model and thickness come nearest to the reference: each is tried on each glass material, everything else as it
is, and judged by the pixels that the material's prims show.

What was tried is what is written: a candidate's values are those of the scene it was drawn with, and a measured
thickness is read from the same layer that `bake thickness` would write.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..models import SHEET, Behind, Model
from ..scene import Material, Mesh, Notice, Param, Scene, Source, Sphere
from ..settings import AS_IT_IS, Opening
from ..thickness.fit import alike, fit
from ..usd.convert.author import Addition, add, begin
from ..usd.convert.find import Glass, find_glass
from ..usd.layers.write import overlay, save
from ..usd.materials.read import THICKNESS_PRIMVAR
from ..usd.thickness.find import stage_of
from ..usd.values import neat
from .bake_thickness import bake_over
from .compare import displayed, psnr
from .compare_numbers import Mask, Trial, Trials, Written, glass_of
from .orders import stop_if
from .override import override

if TYPE_CHECKING:
    from ..images.frame import Frame
    from .compare_renders import Drawn

MADE = "compare --suggest"
_STATE = "nothing was written"
_WHITE = (1.0, 1.0, 1.0)

Read = Callable[[Any], Scene]
"""`scene_from_stage` with the order's time, purposes and camera."""


class Candidate(NamedTuple):
    """One way to draw a material."""

    model: Model
    thickness: str
    """As `Trial.thickness`."""
    value: float | None
    """[m]: the fitted thickness"""
    now: bool


@dataclass(frozen=True)
class Suggestion:
    """What was found, and the layer that says so."""

    trials: tuple[Trials, ...]
    written: Written | None
    notices: tuple[Notice, ...]
    layer: Any
    """Sdf.Layer, or None where nothing is to be written."""

    def save(self) -> None:
        """Write the layer, whole or not at all. Raises StageError."""
        if self.written is not None:
            save(self.layer, self.written.file)


def suggest(
    stage: str,
    write: str,
    drawn: Drawn,
    read: Read,
    cancel: Callable[[], bool],
    opening: Opening = AS_IT_IS,
) -> Suggestion:
    """Try every model, with typed and measured thickness, on every glass material that is seen.

    Args:
        stage: its path.
        write: path of the layer that `Suggestion.save` is to write; '' makes none.
        drawn: the picture and its reference.
        read: makes scenes as the picture's was made.
        opening: of the picture's stage.

    Raises:
        RefractError: whatever goes wrong while drawing.
    """
    scene, notices = drawn.scene, []
    names = list(dict.fromkeys(owner.material for owner in drawn.owners.every))
    glass = glass_by_name(stage, names, opening)
    prims = [owner.path for owner in drawn.owners.every]
    measured, left = measured_scene(stage, glass, prims, read, cancel, opening)
    found: list[Trials] = []
    winners: dict[str, tuple[Candidate, Scene]] = {}
    for name in names:
        places = _places(drawn, name)
        if not places:
            notices.append(Notice(name, "no pixel shows it first, so nothing was tried; take another camera"))
            continue
        tried: list[Trial] = []
        scenes: list[tuple[Candidate, Scene]] = []
        for candidate in candidates(scene, name, measured):
            stop_if(cancel, _STATE)
            changed = scene if candidate.now else applied(scene, name, candidate, measured)
            what = f"{name} as {candidate.model.token} {candidate.thickness}".strip()
            frame = drawn.frame if candidate.now else drawn.draw(changed, what)
            tried.append(_judged(candidate, frame, drawn, places, scene.metres_per_unit))
            scenes.append((candidate, changed))
        trials = Trials(name, tuple(tried), tuple(_notes(scene, name, places, left)))
        found.append(trials)
        winners[name] = scenes[tried.index(trials.best)]
    if not write:
        return Suggestion(tuple(found), None, tuple(notices), None)
    layer, changed_names, lost = authored(stage, scene, glass, winners, opening)
    frame = drawn.draw(read(stage_of(layer, opening)), "as suggested")
    score = drawn.against(frame).score(_counted(drawn))
    assert score is not None
    return Suggestion(tuple(found), Written(write, changed_names, score), (*notices, *lost), layer)


# --- what there is --------------------------------------------------------------------------------------------------


def glass_by_name(
    stage: str, names: list[str], opening: Opening = AS_IT_IS
) -> dict[str, Glass]:
    """What a layer can say about the scene's glass, by the name of the material."""
    work = begin(stage, flatten=False, opening=opening)
    every = {glass.path: glass for glass in find_glass(work.stage, work.time, work.unit)}
    return {name: every[name] for name in names if name in every}


def measured_scene(
    stage: str,
    glass: dict[str, Glass],
    prims: list[str],
    read: Read,
    cancel: Callable[[], bool] = lambda: False,
    opening: Opening = AS_IT_IS,
) -> tuple[Scene, dict[str, str]]:
    """The scene with every thickness measured that can be, and by path of a prim why one could not."""
    layer = overlay(stage, made=MADE)
    sized = next(model.token for model in Model if model.sized)  # of a model that fixes it none would be measured
    add(layer, [Addition(one.edit, True, {"refraction:model": sized}, {}) for one in glass.values() if one.edit])
    left = bake_over(layer, prims, cancel=cancel, opening=opening)
    return read(stage_of(layer, opening)), {notice.path: notice.text for notice in left}


def _things(scene: Scene, name: str) -> Iterator[Mesh | Sphere]:
    """What is drawn with a material."""
    rows = [row for row, material in enumerate(scene.materials) if material.name == name]
    yield from (mesh for mesh in scene.meshes if np.isin(mesh.materials, rows).any())
    yield from (ball for ball in scene.spheres if ball.material in rows)
    yield from (many.mesh for many in scene.instances if np.isin(many.mesh.materials, rows).any())


def _places(drawn: Drawn, name: str) -> dict[str, Mask]:
    """Prims with the material on them that some pixel shows: path -> pixels."""
    glass = glass_of(drawn.frame.planes)
    found = {}
    for owner in drawn.owners.every:
        if owner.material == name:
            mask = drawn.owners.pixels(lambda one, owner=owner: one == owner)  # type: ignore[misc]
            mask = mask if glass is None else mask & glass
            if mask.any():
                found[owner.path] = mask
    return found


def _notes(scene: Scene, name: str, places: dict[str, Mask], left: dict[str, str]) -> Iterator[str]:
    if len(places) > 1:
        yield f"{len(places)} prims share it, so it gets one model, by all of their pixels together"
    seen = [thing for thing in _things(scene, name) if thing.path in places]
    models = {material.model for material in scene.materials if material.name == name}
    solid = [thing.path for thing in seen if isinstance(thing, Sphere) or thing.closed]
    if solid and SHEET in models:
        kept = f"keep '{SHEET.token}' if a shell is meant"
        yield f"{solid[0]} is closed, so the reference takes it for solid glass; {kept}"
    if len(solid) < len(seen) and any(model.sized for model in models):
        opened = next(thing.path for thing in seen if thing.path not in solid)
        yield f"{opened} is open, so the reference knows no thickness of it, and draws it as '{SHEET.token}'"
    for path in places:
        if path in left:
            yield f"{path}: thickness not measured, {left[path].removeprefix('left alone: ')}"


# --- what is tried --------------------------------------------------------------------------------------------------


def candidates(scene: Scene, name: str, measured: Scene) -> Iterator[Candidate]:
    """Every model with every thickness that there is for it; what the stage has comes first."""
    now = next(material.model for material in scene.materials if material.name == name and material.refractive)
    things = list(_things(scene, name))
    own = now.sized or any(THICKNESS_PRIMVAR in thing.primvars for thing in things)
    typed = "authored" if own else "fitted"
    value = None if own else _fitted(things)
    has_measured = any(_differs(a, b) for a, b in zip(things, _things(measured, name), strict=True))
    found = []
    for model in Model:
        if model.behind in (Behind.NOTHING, Behind.SCENE) and model is not now:  # neither stands for a body
            continue
        if not model.sized:
            found.append(Candidate(model, "", None, model is now))
        elif own or value is not None:
            found.append(Candidate(model, typed, value, model is now))
        if model.sized and has_measured:
            found.append(Candidate(model, "measured", None, False))
    yield from sorted(found, key=lambda one: not one.now)


def _differs(before: Mesh | Sphere, after: Mesh | Sphere) -> bool:
    """A thickness was measured on it, and is another one than it had."""
    values = after.primvars.get(THICKNESS_PRIMVAR)
    known = before.primvars.get(THICKNESS_PRIMVAR)
    return values is not None and not (known is not None and np.array_equal(values, known))


def _fitted(things: list[Mesh | Sphere]) -> float | None:
    """One thickness [m] for all: a ball's diameter or a box's smallest side, as `refract convert` has it; None where
    all is flat."""
    every = [
        2.0 * one.radius if isinstance(one, Sphere) else fit(one.points.astype(np.float64), one.triangles).thickness
        for one in things
    ]
    known = [thickness for thickness in every if thickness > 0.0]
    if not known:
        return None
    return known[0] if alike(known) else float(np.median(known))


def applied(scene: Scene, name: str, candidate: Candidate, measured: Scene) -> Scene:
    """A scene in which one material is drawn in another way."""
    changes: dict[str, Any] = {"model": candidate.model.token}
    if candidate.value is not None:
        changes["thickness"] = neat(candidate.value / scene.metres_per_unit)
    changed = override(scene, {name: changes})
    before = {row: material for row, material in enumerate(scene.materials) if material.name == name}
    materials = list(changed.materials)
    for row, old in before.items():
        materials[row] = _same_glass(materials[row], old)
    if candidate.thickness == "measured":
        source = _thickness_source(measured, name)
        for row in before:
            inputs = list(materials[row].inputs)
            inputs[Param.THICKNESS] = source
            materials[row] = replace(materials[row], inputs=tuple(inputs))
        changed = _with_primvars(changed, name, measured)
    return replace(changed, materials=tuple(materials))


def _same_glass(material: Material, before: Material) -> Material:
    """A material whose model has an absorption distance of its own, so that its glass absorbs as before (Beer-Lambert).

    A mapped colour stays as it is, as everywhere.
    """
    color = before.inputs[Param.TRANSMITTANCE]
    if material.absorption_distance == before.absorption_distance or color.driven:
        return material
    power = material.absorption_distance / before.absorption_distance
    red, green, blue, alpha = color.value
    inputs = list(material.inputs)
    inputs[Param.TRANSMITTANCE] = replace(color, value=(red**power, green**power, blue**power, alpha))
    return replace(material, inputs=tuple(inputs))


def _thickness_source(measured: Scene, name: str) -> Source:
    return next(one.inputs[Param.THICKNESS] for one in measured.materials if one.name == name and one.refractive)


def _with_primvars(scene: Scene, name: str, measured: Scene) -> Scene:
    """The measured thickness on everything that has the material."""
    chosen = {id(thing) for thing in _things(scene, name)}

    def taken(thing: Any, other: Any) -> Any:
        values = other.primvars.get(THICKNESS_PRIMVAR)
        if id(thing) not in chosen or values is None:
            return thing
        return replace(thing, primvars={**thing.primvars, THICKNESS_PRIMVAR: values})

    meshes = tuple(taken(one, other) for one, other in zip(scene.meshes, measured.meshes, strict=True))
    spheres = tuple(taken(one, other) for one, other in zip(scene.spheres, measured.spheres, strict=True))
    both = zip(scene.instances, measured.instances, strict=True)
    instances = tuple(replace(one, mesh=taken(one.mesh, other.mesh)) for one, other in both)
    return replace(scene, meshes=meshes, spheres=spheres, instances=instances)


def _judged(candidate: Candidate, frame: Frame, drawn: Drawn, places: dict[str, Mask], unit: float) -> Trial:
    shown, truth = displayed(frame.planes["beauty"][..., :3]), drawn.contrast.truth
    together = np.logical_or.reduce(list(places.values()))
    return Trial(
        model=candidate.model.token,
        thickness=candidate.thickness,
        value=None if candidate.value is None else neat(candidate.value / unit),
        psnr=psnr(shown, truth, together),
        objects={path: psnr(shown, truth, mask) for path, mask in places.items()},
        now=candidate.now,
    )


def _counted(drawn: Drawn) -> Mask:
    glass = glass_of(drawn.frame.planes)
    return drawn.contrast.everywhere if glass is None or not glass.any() else glass


# --- what is written ------------------------------------------------------------------------------------------------


def authored(
    stage: str,
    scene: Scene,
    glass: dict[str, Glass],
    winners: dict[str, tuple[Candidate, Scene]],
    opening: Opening = AS_IT_IS,
) -> tuple[Any, tuple[str, ...], list[Notice]]:
    """A layer over the stage with the winners in it, the materials it changes, and what could not be written."""
    layer, lost, changed = overlay(stage, made=MADE), [], []
    additions: list[Addition] = []
    prims: list[str] = []
    for name, (candidate, drawn_as) in winners.items():
        if candidate.now:
            continue
        one = glass.get(name)
        if one is None or not one.edit:
            lost.append(Notice(name, "lies in an instance of another file, out of a layer's reach; nothing is written"))
            continue
        changed.append(name)
        additions.append(_addition(one, candidate, scene, drawn_as))
        if candidate.thickness == "measured":
            prims += [thing.path for thing in _things(scene, name)]
    add(layer, additions)
    if prims:
        lost += bake_over(layer, list(dict.fromkeys(prims)), opening=opening)
    return layer, tuple(changed), lost


def _addition(glass: Glass, candidate: Candidate, scene: Scene, drawn_as: Scene) -> Addition:
    """What makes a stage's material the one that was drawn."""
    unit = scene.metres_per_unit
    row = next(one for one in drawn_as.materials if one.name == glass.path and one.refractive)
    before = next(one for one in scene.materials if one.name == glass.path and one.refractive)
    values: dict[str, Any] = {"refraction:model": candidate.model.token}
    connections: dict[str, str] = {}
    if candidate.value is not None:
        values["inputs:refraction:thickness"] = neat(candidate.value / unit)
    color = row.inputs[Param.TRANSMITTANCE]
    tint = tuple(neat(value) for value in color.value[:3])
    if not glass.applied:
        values["inputs:refraction:ior"] = neat(row.inputs[Param.IOR].value[0])
        if row.abbe > 0.0:
            values["inputs:refraction:abbeNumber"] = neat(row.abbe)
        if glass.color_from:
            connections["inputs:refraction:transmittanceColor"] = glass.color_from
    if color != before.inputs[Param.TRANSMITTANCE] or not (glass.applied or tint == _WHITE):
        values["inputs:refraction:transmittanceColor"] = tint
    moved = bool(before.model.fixed_thickness) or not glass.applied
    if moved and not candidate.model.fixed_thickness and tint != _WHITE:
        values["inputs:refraction:absorptionDistance"] = neat(row.absorption_distance / unit)
    new_map = glass.color_map is not None and not glass.applied
    maps = {"inputs:refraction:transmittanceColor": glass.color_map} if new_map and glass.color_map else {}
    return Addition(glass.edit, True, values, connections, maps)
