"""A stage on disk to a `Scene`: opened, looked through, and moved into engine world."""

from __future__ import annotations

import math
import os
import re
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Tf, Usd, UsdGeom, UsdLux

from ..errors import StageError, UsageError
from ..scene import F64, Balls, Mesh, Notice, Scene, Sphere, prim_of
from ..settings import AS_IT_IS, Opening
from ..world.solid import areas
from .camera import choose_camera, read_cameras
from .diagnostics import captured, opened, words_of
from .geometry.cages import FINENESS, fineness_for
from .geometry.curves import cuts_for
from .geometry.dots import Dots, read_dots, spread_dots
from .geometry.many import Bodies, Cloud, Group, bounds_of_cloud, bounds_of_group, shared, to_balls
from .geometry.parts import MOST_IN_ALL, Bound, Part, Tables, affordable, assemble, bind
from .geometry.place import Placed, bounds_of, place, to_mesh, to_sphere
from .geometry.refined import MOST_TRIANGLES, Fineness
from .geometry.shapes import INWARDS, TURN, Shape, read_shape
from .geometry.skel import posed
from .geometry.standins import ROOT
from .geometry.traverse import POINTS, Placement, refuse_too_many, some_of, told_of, walk
from .geometry.ways import with_ways
from .layers import mtlx
from .layers.write import is_gltf
from .lights.bodies import lamp_bodies
from .lights.meshes import glow_of, glowing, mesh_lights, own_glows
from .lights.read import read_lights
from .opening import mask_of, open_as
from .ours import recognised
from .preview import preview_stage
from .probes.pictures import read_cubemap
from .probes.read import read_probes
from .registering import register
from .shutter import with_shutters
from .values import triple

Keep = Callable[[list[Placement], Tables], list[Placement]]
"""Some of what is drawn."""

FALLBACK_METRES_PER_UNIT = 0.01
_WARNINGS = 20
_LOOSE = re.compile(r"Found material bindings on prim at path \(([^)]*)\) but MaterialBindingAPI is not applied")
_KINDS = ("MaterialX ", "MDL ", "elementSize ", "glass: ")
"""How notices begin that are said once of all prims: about a kind of node, or a mistake of a whole exporter."""


def open_stage(path: str | os.PathLike[str], opening: Opening = AS_IT_IS) -> Usd.Stage:
    """Opens a stage, with the newest content of its files; of a .mtlx file, balls of its materials.

    What composition left out is reported by `scene_from_stage`, as notices of the scene.

    Args:
        opening: session layer, variants and mask.

    Raises:
        StageError: the file is missing, unreadable, or not USD, or its instances stand for millions of prims.
        UsageError: the opening asks for what is not there.
    """
    register()
    name = os.fspath(path)
    file = Path(name)
    if not file.exists():
        file = Path(name.partition("[")[0])  # "package.usdz[layer.usda]"
    if not name or not file.exists():
        raise StageError(f"{name or 'the stage path'}: there is no such file; check the path")
    if file.is_dir():
        raise StageError(f"{name}: is a folder; name a .usd, .usda, .usdc or .usdz file in it")
    if is_gltf(name):
        raise StageError(f"{name}: is glTF, not USD; `refract convert {name} {file.stem}.usdz` makes a stage of it")
    if file.suffix.lower() == ".usdz" and not zipfile.is_zipfile(file):  # USD may open what is left as an empty stage
        reason = "the package has no directory at its end, so it was cut off; copy or pack it again"
        raise StageError(f"{name}: cannot be read as .usd, .usda, .usdc or .usdz: {reason}")
    stage, reason = opened(lambda: _opened(name, mask_of(opening)))
    if stage is None:
        raise StageError(f"{name}: cannot be read as .usd, .usda, .usdc or .usdz: {reason}")
    with captured():
        for layer in stage.GetUsedLayers():  # USD keeps layers in memory; a changed file would show its old content
            mtlx.forget_old(layer)
            if not layer.anonymous and not layer.dirty:
                layer.Reload()
        mtlx.stand_in(stage)
    open_as(stage, opening)
    with captured():
        recognised(stage)
    refuse_too_many(stage)
    return stage


def _opened(name: str, mask: Usd.StagePopulationMask | None) -> Usd.Stage | None:
    if mtlx.is_file(name):
        return preview_stage(name)
    return Usd.Stage.Open(name) if mask is None else Usd.Stage.OpenMasked(name, mask)


def time_range(stage: Usd.Stage) -> tuple[float, float]:
    """First and last time code; an unauthored end equals the start, an unauthored start is 0."""
    start = float(stage.GetStartTimeCode())
    return start, float(stage.GetEndTimeCode()) if stage.HasAuthoredMetadata("endTimeCode") else start


def load_stage(
    path: str | os.PathLike[str] | Usd.Stage | Sdf.Layer,
    *,
    time_code: float | None = None,
    purposes: tuple[str, ...] = ("default", "render"),
    camera: str = "",
    complexity: str = "low",
    pixels: int = 0,
    opening: Opening = AS_IT_IS,
) -> Scene:
    """Reads a stage at one time, of any file but glTF, which `verbs.table.load_stage` reads as well.

    Args:
        path: of a file; or a stage that is open, or a layer as the root of one, with what was edited and not saved.
            They are not changed, and how a stage is loaded, masked and muted is as its owner has it
        time_code: None takes the stage's startTimeCode, or 0 where it has none
        purposes: which of default, render, proxy and guide are drawn
        camera: prim path or name of the camera that `Scene.cameras` begins with; '' chooses one
        complexity: how fine subdivision surfaces are: low, medium, high or veryhigh
        pixels: longer side of the pictures that will be drawn; above 1024 surfaces of few faces are finer
        opening: session layer, variants and mask; of files, for an open stage is its owner's to change

    Raises:
        StageError: the stage cannot be opened or read.
        UsageError: it has no such camera, there is no such complexity, the opening asks for what is not there, or
            `path` is none of the three.
    """
    how: dict[str, Any] = {
        "time_code": time_code, "purposes": purposes, "camera": camera, "complexity": complexity, "pixels": pixels,
    }  # fmt: skip
    if isinstance(path, str | os.PathLike):
        return scene_from_stage(open_stage(path, opening), **how)
    return scene_from_stage(_held(path, opening), **how)


def _held(given: Usd.Stage | Sdf.Layer, opening: Opening) -> Usd.Stage:
    """The stage that somebody has in memory. Raises UsageError, StageError."""
    register()
    if not isinstance(given, Usd.Stage | Sdf.Layer):
        raise UsageError(f"a stage is a path, a Usd.Stage or an Sdf.Layer, not {type(given).__name__}")
    if opening != AS_IT_IS:
        raise UsageError("an opening is for files; edit the session layer, variants or mask of the open stage itself")
    if not given:
        raise StageError("the stage is closed: nothing holds it any more; keep it, or give its path")
    stage = given if isinstance(given, Usd.Stage) else Usd.Stage.Open(given)
    refuse_too_many(stage)
    return stage


def scene_from_stage(
    stage: Usd.Stage,
    *,
    time_code: float | None = None,
    purposes: tuple[str, ...] = ("default", "render"),
    camera: str = "",
    complexity: str = "low",
    pixels: int = 0,
    keep: Keep | None = None,
    orbits: bool = False,
) -> Scene:
    """Reads an opened stage at one time; see `load_stage`. The stage is not changed.

    Args:
        keep: which of the drawn prims are read at all; None reads every one
        orbits: the picture is taken by a camera of its own (`RenderSettings.orbits`), so nothing is said of those here
    """
    if time_code is not None and not math.isfinite(time_code):
        raise UsageError(f"time_code is {time_code}; it must be a finite number")
    if complexity not in FINENESS:
        raise UsageError(f"complexity is '{complexity}', not known; choose from {', '.join(FINENESS)}")
    fineness = fineness_for(complexity, pixels)
    time = Usd.TimeCode(time_range(stage)[0] if time_code is None else time_code)
    notices = _composition_notices(stage)
    authored = stage
    with captured():  # composing again repeats the same warnings
        stage = recognised(posed(stage, time, notices))
    with captured() as heard:
        try:
            scene = _read(stage, time, purposes, camera, fineness, notices, keep, orbits)
            # What is posed stands still.
            scene = replace(scene, cameras=with_shutters(authored, time, scene.cameras, notices))
        except Tf.ErrorException as error:
            reason = words_of(error.args[0])
            raise StageError(f"{stage.GetRootLayer().identifier}: USD cannot read it: {reason}") from error
    notices.extend(_said(heard, scene.name))
    named = (replace(notice, path=notice.path.removeprefix(ROOT)) for notice in notices)
    return replace(scene, notices=tuple(_grouped(dict.fromkeys(named))))


def _said(heard: list[str], name: str) -> Iterator[Notice]:
    """What USD warned of while a stage was read, the same of many prims once."""
    warnings = dict.fromkeys(" ".join(text.split()) for text in heard)
    loose = {text: found[1] for text in warnings if (found := _LOOSE.search(text))}
    if loose:
        text = "bound to a material without MaterialBindingAPI, which USD may not follow one day; the binding is used"
        prims = sorted(set(loose.values()))  # USD asks many at once, on threads
        yield Notice(prims[0], f"{text} ({some_of(prims)})")
    for text in [text for text in warnings if text not in loose][:_WARNINGS]:
        yield Notice(name, f"USD says: {text}")


def _grouped(notices: dict[Notice, None]) -> list[Notice]:
    """What is said of many prims alike, said once."""
    paths: dict[str, list[str]] = {}
    for notice in notices:
        if notice.text.startswith(_KINDS):
            paths.setdefault(notice.text, []).append(notice.path)
    found = []
    for notice in notices:
        where = paths.get(notice.text, [notice.path])
        if where[0] == notice.path:
            found.append(told_of(where, notice.text))
    return found


def _composition_notices(stage: Usd.Stage) -> list[Notice]:
    """What composition could not bring together: missing references, payloads, sublayers."""
    root = stage.GetRootLayer().identifier
    found = [Notice(path, text) for path, text in mtlx.told(stage)]
    unread = {notice.path for notice in found}
    for error in stage.GetCompositionErrors():
        prim = error.rootSite.path
        where = root if prim in (Sdf.Path.emptyPath, Sdf.Path.absoluteRootPath) else str(prim)
        text = " ".join(str(error).split())
        if any(f"@{path}@" in text for path in unread):
            continue
        found.append(Notice(where, f"part of the stage is missing, the rest is used: {text}"))
    return found


def _origin(low: F64, high: F64) -> F64:
    """The scene's centre on a grid of up to a quarter of its size [m]: what moves a little moves no origin, so frames
    of a sequence share it, and what a probe was baked from stays the same to the bit."""
    step = 2.0 ** math.ceil(math.log2(max(float((high - low).max()), 1e-6) / 8.0))
    return np.asarray(np.round((low + high) / (2.0 * step)) * step)


def _read(
    stage: Usd.Stage, time: Usd.TimeCode, purposes: tuple[str, ...], camera: str, fineness: Fineness,
    notices: list[Notice], keep: Keep | None, orbits: bool,
) -> Scene:  # fmt: skip
    """Everything of a stage in engine world, whose origin is the middle of what is drawn."""
    metres_per_unit = stage_unit(stage, notices)
    metres_from_stage = _upright(stage, notices) @ np.diag([metres_per_unit] * 3 + [1.0])
    tables = Tables(time, metres_per_unit, notices, fineness)
    found = walk(stage, time, purposes, notices, as_drawn=True)
    lamps = [placement for placement in found if not placement.prim.IsA(UsdGeom.Gprim)]
    drawn = [placement for placement in found if placement.prim.IsA(UsdGeom.Gprim)]
    placed, groups, clouds = _placed(stage, keep(drawn, tables) if keep else drawn, metres_from_stage, tables)
    extent = _extent([bounds_of(placed), *map(bounds_of_group, groups), *map(bounds_of_cloud, clouds)])
    if extent is None:
        notices.append(Notice("/", "nothing is visible at this time and with these purposes; the scene is empty"))
        extent = -np.ones(3), np.ones(3)
    centre = _origin(*extent)
    meshes, spheres = _drawn(placed, centre)
    many = {str(placement.prim.GetPath()) for placement in drawn if placement.instance is not None}
    meshes = glowing(
        stage, time, meshes, tables.materials, metres_per_unit=metres_per_unit, notices=notices, instanced=many
    )
    bodies = Bodies()
    instances = tuple(bodies.instances(groups.pop(0), centre) for _ in range(len(groups)))
    balls = tuple(to_balls(cloud, centre) for cloud in clouds)
    materials = with_ways(tables.materials, meshes, spheres, instances, balls, metres_per_unit, notices)
    engine_from_stage = metres_from_stage.copy()
    engine_from_stage[:3, 3] = -centre
    bounds = triple(extent[0] - centre), triple(extent[1] - centre)
    frame: dict[str, Any] = {
        "engine_from_stage": engine_from_stage,
        "metres_per_unit": metres_per_unit,
        "notices": notices,
    }
    every_mesh = (*meshes, *(many.mesh for many in instances))
    every_ball: tuple[Sphere | Balls, ...] = (*spheres, *balls)
    every_camera = read_cameras(stage, time, **frame)
    cameras = choose_camera(stage, every_camera, camera, bounds, orbits=orbits, **frame)
    things = [prim_of(mesh.path) for mesh in meshes] + [prim_of(ball.path) for ball in spheres]
    every_path = [many.paths for many in instances] + [cloud.paths for cloud in balls]
    things += [owner for some in every_path for owner, _ in some.owners()]
    paths = tuple(dict.fromkeys(things))
    lit_by = [(lamp.prim, lamp.run.path(row), lamp.worlds[row]) for lamp in lamps for row in range(len(lamp.worlds))]
    lights, environment = read_lights(stage, time, purposes=purposes, drawn=paths, instanced=lit_by, **frame)
    more_meshes, more_spheres, glows = lamp_bodies(lights, len(materials))
    meshes, spheres, materials = (*meshes, *more_meshes), (*spheres, *more_spheres), [*materials, *glows]
    every = Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies())
    glow = {m for m, material in enumerate(tables.materials) if material.emits}
    used = {m for mesh in every_mesh for m in np.unique(mesh.materials).tolist()}
    used |= {ball.material for ball in every_ball}
    lit = bool(glow & used) or any(prim.HasAPI(UsdLux.LightAPI) for prim in every)
    return Scene(
        meshes=meshes,
        materials=tuple(materials),
        spheres=spheres,
        instances=instances,
        balls=balls,
        textures=tuple(tables.textures.values()),
        lights=lights,
        environment=environment,
        camera_light=not lit,
        cameras=cameras,
        probes=read_probes(stage, time, read_cubemap=read_cubemap, **frame),
        bounds=bounds,
        stage_from_engine=np.linalg.inv(engine_from_stage).astype(np.float64),
        metres_per_unit=metres_per_unit,
        time_code=float(time.GetValue()),
        name=stage.GetRootLayer().realPath or stage.GetRootLayer().identifier,
    )


def _drawn(placed: list[Placed], centre: F64) -> tuple[tuple[Mesh, ...], tuple[Sphere, ...]]:
    """Engine world records. Empties `placed`, so that float64 points go as float32 ones come."""
    meshes: list[Mesh] = []
    spheres: list[Sphere] = []
    while placed:
        item = placed.pop()
        if item.radius > 0.0:
            spheres.append(to_sphere(item, centre))
        else:
            meshes.append(to_mesh(item, centre))
    return tuple(reversed(meshes)), tuple(reversed(spheres))


def stage_unit(stage: Usd.Stage, notices: list[Notice]) -> float:
    """Metres per scene unit; USD's fallback, with a notice, where what is authored is no length."""
    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        return FALLBACK_METRES_PER_UNIT
    authored = float(stage.GetMetadata(UsdGeom.Tokens.metersPerUnit))  # unlike UsdGeom's call, takes any number type
    if math.isfinite(authored) and authored > 0.0:
        return authored
    text = f"metersPerUnit is {authored:g}; it must be finite and above 0, so {FALLBACK_METRES_PER_UNIT} is used"
    notices.append(Notice(stage.GetRootLayer().identifier, text))
    return FALLBACK_METRES_PER_UNIT


def _upright(stage: Usd.Stage, notices: list[Notice]) -> F64:
    """Rotation that takes the stage's up axis to +Y, shape (4, 4); X stays X."""
    turned = np.eye(4)
    axis = str(UsdGeom.GetStageUpAxis(stage))
    if axis == UsdGeom.Tokens.z:
        turned[1:3, 1:3] = [[0.0, 1.0], [-1.0, 0.0]]
    elif axis != UsdGeom.Tokens.y:
        notices.append(Notice(stage.GetRootLayer().identifier, f"upAxis is '{axis}'; it must be Y or Z, so Y is used"))
    return turned


def _extent(bounds: list[tuple[F64, F64] | None]) -> tuple[F64, F64] | None:
    """Lowest and highest corner of all; None where there is nothing."""
    known = [box for box in bounds if box is not None]
    if not known:
        return None
    return np.min([low for low, _ in known], axis=0), np.max([high for _, high in known], axis=0)


def _placed(
    stage: Usd.Stage, placements: list[Placement], metres_from_stage: F64, tables: Tables
) -> tuple[list[Placed], list[Group], list[Cloud]]:
    """Reads every prim once and puts it wherever it is drawn."""
    prims = list({placement.prim.GetPath(): placement.prim for placement in placements}.values())
    shapes: dict[Sdf.Path, Shape | None] = {}
    parts: dict[Sdf.Path, Part | None] = {}
    points: dict[Sdf.Path, Dots | None] = {}
    tables.cuts = cuts_for(placements, tables.time, tables.fineness, tables.notices)
    asked, tables.fineness = tables.fineness, affordable(placements, tables.time, tables.fineness)
    for prim, bound in zip(prims, bind(prims, tables.notices), strict=True):
        if prim.GetTypeName() == POINTS:
            points[prim.GetPath()] = read_dots(prim, bound, tables)
        else:
            parts[prim.GetPath()] = _part(prim, bound, shapes, tables)
    tables.notices.extend(_coarse(parts, asked, tables.fineness))
    tables.notices.extend(_turned(prims, parts))
    proxies = any(placement.prim.IsInstanceProxy() for placement in placements)
    own = mesh_lights(stage) if proxies else frozenset()
    _glow_in_many_places(stage, placements, parts, metres_from_stage, tables)
    solid = [placement for placement in placements if placement.prim.GetTypeName() != POINTS]
    alone, groups, clouds = shared(solid, parts, own, metres_from_stage, tables)
    for placement in placements:
        if (dots := points.get(placement.prim.GetPath())) is not None:
            for one in spread_dots(dots, placement, metres_from_stage, tables):
                if isinstance(one, Cloud):
                    clouds.append(one)
                else:
                    groups.append(one)
    placed = []
    for placement in alone:
        part = parts[placement.prim.GetPath()]
        item = place(part, placement, metres_from_stage, tables) if part is not None else None
        if item is not None:
            placed.append(item)
    return placed, groups, clouds


def _glow_in_many_places(
    stage: Usd.Stage, placements: list[Placement], parts: dict[Sdf.Path, Part | None], metres_from_stage: F64,
    tables: Tables,
) -> None:  # fmt: skip
    """Gives the meshes of point instancers that are lights their glow; it is one, whatever the scale of each place."""
    instanced = {placement.prim.GetPath(): placement for placement in reversed(placements) if placement.instance}
    lights = own_glows(stage) if instanced else {}
    how: dict[str, Any] = {"metres_per_unit": tables.metres_per_unit, "notices": tables.notices}
    for path, placement in instanced.items():
        part, light = parts.get(path), lights.get(str(path))
        if part is None or light is None:
            continue
        matrix = (metres_from_stage[:3, :3] @ placement.worlds[0][:, :3]) @ part.shape.prim_from_shape[:3, :3]
        corners = (part.shape.points.astype(np.float64) @ matrix.T)[part.shape.triangles]
        if (glow := glow_of(light, float(areas(corners).sum()), tables.time, **how)) is not None:
            tables.materials.append(glow)
            number = np.full(len(part.shape.triangles), len(tables.materials) - 1, np.int32)
            parts[path] = part._replace(materials=number)


def _coarse(parts: dict[Sdf.Path, Part | None], asked: Fineness, used: Fineness) -> Iterator[Notice]:
    """Subdivision surfaces that are not as fine as they were asked to be."""
    shapes = {str(path): part.shape for path, part in parts.items() if part is not None}
    if cages := [path for path, shape in shapes.items() if shape.cage]:
        text = f"drawn as its cage, with smooth normals: its surface would have over {MOST_TRIANGLES:,} triangles"
        yield Notice(cages[0], f"{text} ({some_of(cages)})")
    less = [path for path, shape in shapes.items() if shape.coarse or (shape.subdivided and used.steps < asked.steps)]
    if less:
        text = f"subdivided fewer than {asked.steps} times: more would make over {used.triangles:,} triangles of a mesh"
        text += f", or over {MOST_IN_ALL:,} of all" if used.steps < asked.steps else ""
        yield Notice(less[0], f"{text} ({some_of(less)})")


def _turned(prims: list[Usd.Prim], parts: dict[Sdf.Path, Part | None]) -> Iterator[Notice]:
    """Which glass is inside out; the instances of one native prototype are told of together."""
    found: dict[Sdf.Path, list[str]] = {}
    for prim in prims:
        part = parts.get(prim.GetPath())
        if part is not None and part.shape.inside_out:
            authored = prim.GetPrimInPrototype() if prim.IsInstanceProxy() else prim
            found.setdefault(authored.GetPath(), []).append(str(prim.GetPath()))
    bubble = "a bubble belongs to the mesh of the glass around it, or is a body of ior 1"
    text = f"{INWARDS}; it is drawn turned outwards. {TURN.capitalize()} (refract validate STAGE --fix OUT); {bubble}"
    for paths in found.values():
        yield told_of(paths, text)


def _part(prim: Usd.Prim, bound: Bound, shapes: dict[Sdf.Path, Shape | None], tables: Tables) -> Part | None:
    """A prim's shape and materials; None, and a notice, where USD cannot read it."""
    # Proxies of one native prototype share its geometry; inherited materials and primvars may differ.
    shared = prim.IsInstanceProxy()
    key = prim.GetPrimInPrototype().GetPath() if shared else prim.GetPath()
    try:
        if key in shapes:
            shape = shapes[key]
        else:
            cut = tables.cuts.get(prim.GetPath())
            shape = read_shape(prim, tables.time, tables.notices, tables.fineness, cut)
        if shared:
            shapes[key] = shape
        part = assemble(prim, shape, bound, tables) if shape is not None else None
        topology = part.shape.topology if part is not None else None
        if part is not None and topology is not None and topology.refinement is not None and not shared:
            part = part._replace(shape=replace(part.shape, topology=None))  # what it was made of is larger than it is
        return part
    except Tf.ErrorException as error:
        reason = " ".join(words_of(part) for part in error.args)
        tables.notices.append(Notice(str(prim.GetPath()), f"skipped: USD cannot read it: {reason}"))
        return None
