"""What a person wants to know of a stage before it is rendered: the stage itself, its glass, its probes.

Only glass is read as geometry, so that a large stage takes little more than USD needs to open and walk it.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from pxr import Usd, UsdGeom, UsdLux, UsdShade

from ...errors import StageError
from ...scene import Model, Scene
from ...settings import AS_IT_IS, Opening, RenderSettings
from ..geometry.parts import Bound, Tables, bind
from ..geometry.traverse import Placement
from ..materials.read import has_api, read_material
from ..settings import read_settings
from ..stage import open_stage, scene_from_stage, stage_unit, time_range
from .findings import Finding
from .glass import Glass, glass_of
from .names import name_findings
from .probes import probe_findings, texture_state
from .stage import UNREADABLE, glass_found, reader_findings, scenes_of
from .values import fallback_findings, readable, value_findings


class Overview(NamedTuple):
    """A stage as it was found."""

    up_axis: str
    unit_authored: bool
    times: tuple[float, float]
    times_authored: bool
    frames_per_second: float
    prims: dict[str, int]
    """How many of each kind: all, meshes, materials, lights, instances"""
    settings: RenderSettings
    """What a render without flags would use."""
    scene: Scene
    """With its glass alone."""
    glass: list[Glass]
    with_api: frozenset[str]
    """Glass materials that have RefractMaterialAPI; the others are glass by their surface shader."""
    typed: frozenset[str]
    """Glass materials on which a thickness is authored."""
    states: dict[str, str]
    """What the texture of each probe is, by probe."""
    unsupported: list[Finding]
    """What the reader had to say."""
    suspicious: list[Finding]


def overview_of(path: str, opening: Opening = AS_IT_IS) -> Overview:
    """A stage at its first time code.

    Raises:
        StageError: it cannot be opened.
    """
    stage = open_stage(path, opening)
    values = value_findings(stage)
    other = readable(stage, values)
    found = [*values, *name_findings(stage), *fallback_findings(stage)]
    settings = _settings(other, found)
    scene = Scene((), (), metres_per_unit=stage_unit(stage, []), name=stage.GetRootLayer().identifier)
    drawn: list[Placement] = []

    def keep(placements: list[Placement], tables: Tables) -> list[Placement]:
        drawn.extend(placements)
        return _with_glass(placements, tables)

    try:
        scene = scene_from_stage(other, purposes=settings.purposes, camera=settings.camera, keep=keep)
    except StageError as error:
        found.append(UNREADABLE.broken(path, str(error)))
    glass = glass_of(scene)
    found += glass_found(stage, scene, glass, values)
    # A digest is of everything a probe sees, so then everything has to be read.
    baked = any(probe.bake is not None for probe in scene.probes)
    scene_at = scenes_of(other, scene_from_stage(other, purposes=settings.purposes)) if baked else None
    found += probe_findings(other, scene, glass, scene_at)
    materials = {piece.row.name for piece in glass}
    return Overview(
        up_axis=str(UsdGeom.GetStageUpAxis(stage)),
        unit_authored=UsdGeom.StageHasAuthoredMetersPerUnit(stage),
        times=time_range(stage),
        times_authored=stage.HasAuthoredTimeCodeRange(),
        frames_per_second=float(stage.GetFramesPerSecond()),
        prims=_counts(stage),
        settings=settings,
        scene=scene,
        glass=glass,
        with_api=frozenset(name for name in materials if (prim := stage.GetPrimAtPath(name)) and has_api(prim)),
        typed=frozenset(name for name in materials if _is_typed(stage, name)),
        states={probe.path: texture_state(other, probe, scene_at) for probe in scene.probes},
        # Without glass the reader is left with nothing, and says so; that is only true where nothing else is drawn.
        unsupported=reader_findings(
            [notice for notice in scene.notices if not (drawn and notice.text.startswith("nothing is visible"))], found
        ),
        suspicious=found,
    )


def _settings(stage: Usd.Stage, found: list[Finding]) -> RenderSettings:
    try:
        authored = read_settings(stage)
    except StageError as error:
        found.append(UNREADABLE.broken("/", str(error)))
        authored = {}
    return RenderSettings(**authored)  # type: ignore[arg-type]


def _with_glass(drawn: list[Placement], tables: Tables) -> list[Placement]:
    """What has a refractive material on it. Materials are read for that, and what they lack is told."""
    prims = list({placement.prim.GetPath(): placement.prim for placement in drawn}.values())
    refractive: dict[str, bool] = {}
    glass = {
        prim.GetPath() for prim, bound in zip(prims, bind(prims, tables.notices), strict=True)
        if _any_glass(bound, tables, refractive)
    }  # fmt: skip
    return [placement for placement in drawn if placement.prim.GetPath() in glass]


def _any_glass(bound: Bound, tables: Tables, refractive: dict[str, bool]) -> bool:
    found = False
    for material in (bound.material, *(material for _, material in bound.subsets)):
        if material is None:
            continue
        key = str(material.GetPath())
        if key not in refractive:
            refractive[key] = _is_glass(material, tables)
        found = found or refractive[key]
    return found


def _is_glass(material: UsdShade.Material, tables: Tables) -> bool:
    if _is_plain(material):
        return False
    row = read_material(
        material, tables.time, metres_per_unit=tables.metres_per_unit, closed=True,
        textures=tables.textures, notices=tables.notices,
    )  # fmt: skip
    return row.model is not Model.NONE


def _is_plain(material: UsdShade.Material) -> bool:
    """A UsdPreviewSurface of constants that says nothing of opacity: there is no glass in it, and nothing to follow."""
    if has_api(material.GetPrim()):
        return False
    shader = material.ComputeSurfaceSource("")[0]
    if not shader or shader.GetShaderId() != "UsdPreviewSurface" or material.GetOutput("mtlx:surface"):
        return False
    names = {str(name) for name in shader.GetPrim().GetAuthoredPropertyNames()}
    if "inputs:opacity" in names:
        return False
    inputs = [shader.GetPrim().GetAttribute(name) for name in names if name.startswith("inputs:")]
    return not any(attribute.HasAuthoredConnections() for attribute in inputs)


def _is_typed(stage: Usd.Stage, path: str) -> bool:
    attribute = stage.GetAttributeAtPath(f"{path}.inputs:refraction:thickness")
    return bool(attribute) and (attribute.HasAuthoredValue() or attribute.HasAuthoredConnections())


def _counts(stage: Usd.Stage) -> dict[str, int]:
    """How many prims of each kind, those of instances counted wherever they are drawn."""
    kinds: Counter[str] = Counter()
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        kinds[str(prim.GetTypeName())] += 1
        kinds["light"] += prim.HasAPI(UsdLux.LightAPI)
        kinds["instance"] += prim.IsInstance()
    every = sum(number for name, number in kinds.items() if name not in ("light", "instance"))
    return {
        "all": every, "meshes": kinds["Mesh"], "materials": kinds["Material"], "lights": kinds["light"],
        "instances": kinds["instance"], "instancers": kinds["PointInstancer"],
    }  # fmt: skip
