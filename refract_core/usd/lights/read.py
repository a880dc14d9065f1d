"""UsdLux lights as the light table and the environment."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from pxr import Usd, UsdGeom, UsdLux

from ...scene import F64, Environment, Light, LightKind, Notice
from ...world.embree import CASTER_SHIFTS
from ..geometry.standins import is_replaced
from .bodies import obstacle, seen_by_camera
from .context import Context, note, number, value
from .domes import Dome, read_dome, rotation, sum_domes
from .emission import emission
from .meshes import is_mesh_light
from .shaping import is_linked, read_link, read_shadow, read_shaping

_DOMES = ("DomeLight", "DomeLight_1")
MOST_INSTANCED = 256
"""Places where lights of point instancers shine: each costs every point of the picture what any light does."""


class Shape(NamedTuple):
    """A light's place and size in engine world."""

    world_from_light: F64
    """shape (4, 4), rotation and translation [m]"""
    size: tuple[float, float]
    """As `scene.Light.size`."""
    factor: float
    """`radiance` per unit of emission, with `normalize` and the limit of a zero-size light in it."""


def read_lights(
    stage: Usd.Stage,
    time: Usd.TimeCode,
    *,
    engine_from_stage: F64,
    metres_per_unit: float,
    purposes: tuple[str, ...],
    notices: list[Notice],
    drawn: Sequence[str] = (),
    instanced: Sequence[tuple[Usd.Prim, str, F64]] = (),
) -> tuple[tuple[Light, ...], Environment | None]:
    """Every visible light of the stage.

    Args:
        stage: An opened stage.
        time: Time code of the frame.
        engine_from_stage: shape (4, 4), column vectors: stage world units to engine world metres.
        metres_per_unit: The scale in it; areas for `normalize` are in stage units.
        purposes: Purposes that are rendered.
        notices: What was ignored, replaced or guessed is added here.
        drawn: Paths of all prims that are drawn, which lights may be linked to.
        instanced: Lights that point instancers put somewhere: prim, path, place of shape (3, 4) in the stage's world.

    Returns:
        Finite and distant lights in stage order, and all domes summed (None where there is none).
    """
    context = Context(time, UsdGeom.XformCache(time), engine_from_stage, metres_per_unit, notices)
    lights: list[Light] = []
    domes: list[Dome] = []
    prims = iter(Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()))
    for prim in prims:
        if prim.IsA(UsdGeom.PointInstancer) or is_replaced(prim):
            prims.PruneChildren()
        elif prim.HasAPI(UsdLux.LightAPI) and _shown(prim, time, purposes):
            world = np.array(context.xforms.GetLocalToWorldTransform(prim), np.float64).T
            _read_light(context, prim, str(prim.GetPath()), world, lights, domes, drawn)
    for prim, path, place in instanced[:MOST_INSTANCED]:
        if prim.GetTypeName() in _DOMES:
            note(context, prim, "a sky inside a PointInstancer is ignored: it is the same from everywhere")
            continue
        world = np.vstack([place, (0.0, 0.0, 0.0, 1.0)])
        _read_light(context, prim, path, world, lights, domes, drawn)
    if len(instanced) > MOST_INSTANCED:
        text = f"point instancers put lights in {len(instanced)} places; the first {MOST_INSTANCED} shine"
        notices.append(Notice(instanced[MOST_INSTANCED][1], text))
    return tuple(_few_casters(lights, notices)), sum_domes(domes)


def _few_casters(lights: list[Light], notices: list[Notice]) -> list[Light]:
    """No more different sets of what casts a light's shadows than rays have masks for."""
    sets = list(dict.fromkeys(light.casters for light in lights if light.casters is not None))
    kept = {None, *sets[: len(CASTER_SHIFTS)]}
    for light in lights:
        if light.casters not in kept:
            text = f"more than {len(CASTER_SHIFTS)} different collections 'shadowLink' in one stage; everything casts "
            notices.append(Notice(light.path, f"{text}this light's shadows. Let several lights share one collection"))
    return [light if light.casters in kept else replace(light, casters=None) for light in lights]


def _read_light(
    context: Context, prim: Usd.Prim, path: str, world: F64, lights: list[Light], domes: list[Dome],
    drawn: Sequence[str],
) -> None:  # fmt: skip
    """Add one light prim to `lights` or `domes`, or a notice."""
    name = str(prim.GetTypeName())
    if name not in ROWS and name not in _DOMES:
        label = "MeshLightAPI" if prim.HasAPI(UsdLux.MeshLightAPI) else name or "LightAPI"
        if is_mesh_light(prim):  # what it makes glow is a light
            return
        hint = " (sampling of the dome goes on without it)" if name == "PortalLight" else ""
        note(context, prim, f"{label} is ignored: it is not rendered as a light{hint}")
        return
    light = UsdLux.LightAPI(prim)
    shining = emission(context, light)
    if shining is None:
        return
    _note_ignored(context, prim)
    world_from_light = context.engine_from_stage @ world
    if not np.isfinite(world_from_light).all():
        note(context, prim, "has a transform with NaN or infinity; the light is skipped; repair its xformOps")
        return
    if name in _DOMES:
        dome = read_dome(
            light, context.time, radiance=shining, world_from_light=world_from_light, notices=context.notices
        )
        domes.append(replace(dome, hidden=seen_by_camera(context, prim) is False))
        return
    row = ROWS[name]
    shape = row.read(context, prim, world_from_light)
    if shape is None:
        return
    r, g, b = (channel * shape.factor for channel in shining)
    casts_shadow, shadow = read_shadow(context, prim)
    found = Light(
        path=path,
        kind=row.kind,
        radiance=(r, g, b),
        world_from_light=shape.world_from_light,
        size=shape.size,
        diffuse=number(context, prim, "inputs:diffuse", 1.0),
        specular=number(context, prim, "inputs:specular", 1.0),
        shaping=read_shaping(context, prim, row.kind, _turn(world_from_light)[1]),
        casts_shadow=casts_shadow,
        shadow=shadow,
        lit=read_link(context, prim, "lightLink", drawn),
        casters=read_link(context, prim, "shadowLink", drawn) if casts_shadow else None,
    )
    if seen_by_camera(context, prim):
        reason = obstacle(found)
        if reason:
            text = f"is to be seen by the camera, and a body cannot shine as it does: {reason}; it stays unseen"
            note(context, prim, text)
        found = replace(found, seen=not reason)
    lights.append(found)


def _shown(prim: Usd.Prim, time: Usd.TimeCode, purposes: tuple[str, ...]) -> bool:
    imageable = UsdGeom.Imageable(prim)
    if not imageable:
        return True
    visible = imageable.ComputeVisibility(time) != UsdGeom.Tokens.invisible
    return visible and str(imageable.ComputePurpose()) in purposes


def _factor(context: Context, prim: Usd.Prim, area: float) -> float:
    """1 / sizeFactor: one, or with `normalize` one over the surface area; `area` in m^2, sizeFactor in stage units."""
    if not value(context, prim, "inputs:normalize", False):
        return 1.0
    return context.metres_per_unit**2 / area


# --- shapes ---------------------------------------------------------------------------------------------------------


def _frame(matrix: F64) -> F64:
    """Rotation and translation of a 4x4 whose -Z is kept as the emission axis; mirroring is turned into X."""
    frame = np.eye(4)
    frame[:3, :3] = _turn(matrix)[0]
    frame[:3, 3] = matrix[:3, 3]
    return frame


def _turn(matrix: F64) -> tuple[F64, bool]:
    """The rotation in a 4x4, and whether X had to be turned around for it."""
    axes = matrix[:3, :3].copy()
    if not axes[:, 2].any():  # flattened along its own axis, which a rectangle or disk survives
        axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    turned = rotation(axes)
    mirrored = bool(np.linalg.det(turned) < 0.0)
    if mirrored:
        turned[:, 0] = -turned[:, 0]
    return turned, mirrored


def _scales(context: Context, prim: Usd.Prim, matrix: F64, axes: int) -> list[float]:
    """Lengths of the first `axes` columns [m per unit]; says so where they differ or are sheared."""
    columns = matrix[:3, :3]
    lengths = [float(np.linalg.norm(columns[:, axis])) for axis in range(axes)]
    gram = columns[:, :axes].T @ columns[:, :axes]
    off = float(np.abs(gram - np.diag(np.diag(gram))).max()) if axes > 1 else 0.0
    if off > 1e-4 * max(lengths) ** 2:
        note(context, prim, "is sheared by its transform; the shear is ignored")
    return lengths


def _even(context: Context, prim: Usd.Prim, lengths: list[float], what: str) -> float:
    """One scale for a round light; the mean that keeps its area or volume where the axes differ."""
    mean = math.prod(lengths) ** (1.0 / len(lengths))
    if max(lengths) - min(lengths) > 1e-4 * max(lengths):
        note(context, prim, f"has a non-uniform scale; the {what} is read as round with the mean radius")
    return mean


def _sphere(context: Context, prim: Usd.Prim, matrix: F64) -> Shape | None:
    """A sphere; with treatAsPoint or radius 0 a point, of the radiant intensity L * pi * r^2 of that sphere."""
    scale = _even(context, prim, _scales(context, prim, matrix, 3), "sphere")
    radius = number(context, prim, "inputs:radius", 0.5) * scale
    if radius > 0.0 and not value(context, prim, "treatAsPoint", False):
        area = 4.0 * math.pi * radius**2
        return Shape(_frame(matrix), (radius, 0.0), _factor(context, prim, area))
    if value(context, prim, "inputs:normalize", False):
        return Shape(_frame(matrix), (0.0, 0.0), 0.25 * context.metres_per_unit**2)
    if radius > 0.0:
        return Shape(_frame(matrix), (0.0, 0.0), math.pi * radius**2)
    note(context, prim, "has radius 0 and inputs:normalize off, which gives no light; it is read as if normalize "
                         "were on; author inputs:normalize = 1")  # fmt: skip
    return Shape(_frame(matrix), (0.0, 0.0), 0.25 * context.metres_per_unit**2)


def _rect(context: Context, prim: Usd.Prim, matrix: F64) -> Shape | None:
    sx, sy = _scales(context, prim, matrix, 2)
    width = number(context, prim, "inputs:width", 1.0) * sx
    height = number(context, prim, "inputs:height", 1.0) * sy
    if width * height <= 0.0:
        _note_no_area(context, prim, "inputs:width and inputs:height")
        return None
    return Shape(_frame(matrix), (width, height), _factor(context, prim, width * height))


def _disk(context: Context, prim: Usd.Prim, matrix: F64) -> Shape | None:
    scale = _even(context, prim, _scales(context, prim, matrix, 2), "disk")
    radius = number(context, prim, "inputs:radius", 0.5) * scale
    if radius <= 0.0:
        _note_no_area(context, prim, "inputs:radius")
        return None
    return Shape(_frame(matrix), (radius, 0.0), _factor(context, prim, math.pi * radius**2))


def _note_no_area(context: Context, prim: Usd.Prim, names: str) -> None:
    note(context, prim, f"has no area, so it gives no light and is skipped; author {names} above 0")


def _cylinder(context: Context, prim: Usd.Prim, matrix: F64) -> Shape | None:
    """A tube about its X; with treatAsLine or radius 0 a line, of the radiance times the width of that tube."""
    along, *around = _scales(context, prim, matrix, 3)
    length = number(context, prim, "inputs:length", 1.0) * along
    radius = number(context, prim, "inputs:radius", 0.5) * _even(context, prim, around, "cylinder")
    if length <= 0.0:
        _note_no_area(context, prim, "inputs:length")
        return None
    if radius > 0.0 and not value(context, prim, "treatAsLine", False):
        return Shape(_frame(matrix), (radius, length), _factor(context, prim, 2.0 * math.pi * radius * length))
    if radius <= 0.0 and not value(context, prim, "inputs:normalize", False):
        note(context, prim, "has radius 0 and inputs:normalize off, which gives no light; it is read as if normalize "
                            "were on; author inputs:normalize = 1")  # fmt: skip
    # Radiance times width: 2 r, or with `normalize` 2 r over the area 2 pi r length, whatever r is.
    normalized = radius <= 0.0 or value(context, prim, "inputs:normalize", False)
    width = context.metres_per_unit**2 / (math.pi * length) if normalized else 2.0 * radius
    return Shape(_frame(matrix), (0.0, length), width)


def _distant(context: Context, prim: Usd.Prim, matrix: F64) -> Shape | None:
    """sizeFactor of UsdLuxLightAPI: pi sin^2(angle / 2), or pi (2 - sin^2) beyond a half angle of 90 degrees."""
    degrees = min(number(context, prim, "inputs:angle", 0.53), 360.0)
    half = math.radians(degrees) / 2.0
    size_factor = 1.0
    if half > 0.0:
        square = math.sin(half) ** 2
        size_factor = math.pi * (square if half <= math.pi / 2.0 else 2.0 - square)
    normalize = bool(value(context, prim, "inputs:normalize", False))
    return Shape(_frame(matrix), (2.0 * half, 0.0), 1.0 / size_factor if normalize else 1.0)


class Row(NamedTuple):
    """How lights of one kind are read."""

    kind: LightKind
    read: Callable[[Context, Usd.Prim, F64], Shape | None]
    """(context, prim, engine world from light) -> place and size; None with a notice where it gives no light"""


ROWS = {
    row.kind.usd_type: row
    for row in (
        Row(LightKind.DISTANT, _distant),
        Row(LightKind.SPHERE, _sphere),
        Row(LightKind.RECT, _rect),
        Row(LightKind.DISK, _disk),
        Row(LightKind.CYLINDER, _cylinder),
    )
}
"""By the prims' type."""


# --- what is ignored ------------------------------------------------------------------------------------------------


def _note_ignored(context: Context, prim: Usd.Prim) -> None:
    """One notice per thing that is authored on the light and not rendered."""
    dome = prim.GetTypeName() in _DOMES
    found = _ignored_on_domes(context, prim) if dome else []
    if dome or prim.GetTypeName() == LightKind.DISTANT.usd_type:
        found += _ignored_shaping(context, prim)
    for name in ("light:filters", "portals"):
        relationship = prim.GetRelationship(name)
        if relationship and relationship.GetTargets():
            found.append(name)
    for attribute in prim.GetAttributes():
        if attribute.GetName().startswith("inputs:") and attribute.HasAuthoredConnections():
            found.append(f"connection of {attribute.GetName()}")
    for what in found:
        note(context, prim, f"{what} is ignored; the light shines without it")


def _ignored_shaping(context: Context, prim: Usd.Prim) -> list[str]:
    """Names of what shapes other lights and is authored on a sun or a sky, for which UsdLux does not say what it is."""
    found = []
    if float(value(context, prim, "inputs:shaping:cone:angle", 180.0)) < 90.0:
        found.append("inputs:shaping:cone:angle")
    if float(value(context, prim, "inputs:shaping:focus", 0.0)) > 0.0:
        found.append("inputs:shaping:focus")
    asset = value(context, prim, "inputs:shaping:ies:file", None)
    if asset is not None and asset.path:
        found.append("inputs:shaping:ies:file")
    return found


def _ignored_on_domes(context: Context, prim: Usd.Prim) -> list[str]:
    """Names of what other lights have and skies do not: all domes are one, and shine on everything alike."""
    found = [f"collection:{name} (light linking)" for name in ("lightLink", "shadowLink") if is_linked(prim, name)]
    if value(context, prim, "inputs:shadow:enable", True) is False:
        found.append("inputs:shadow:enable = 0")
    if any(float(c) != 0.0 for c in value(context, prim, "inputs:shadow:color", (0.0, 0.0, 0.0))):
        found.append("inputs:shadow:color")
    if float(value(context, prim, "inputs:shadow:distance", -1.0)) >= 0.0:
        found.append("inputs:shadow:distance")
    for name in ("inputs:diffuse", "inputs:specular"):
        if float(value(context, prim, name, 1.0)) != 1.0:
            found.append(name)
    return found
