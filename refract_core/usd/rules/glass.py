"""Rules about glass, checked on a scene's arrays: its shape against its model, its thickness against its size."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...models import SHEET, SOLID, Behind, Model, model_for
from ...scene import F64, Material, Mesh, Param, Scene, Source, Sphere
from ...world.instances import flat
from ...world.solid import encloses, is_convex
from ..geometry.shapes import INWARDS, TURN
from .findings import ERROR, WARNING, Finding, Rule

FLAT = 0.2
"""A body is flat whose smallest side is under this part of its largest."""
LONGER = 1.5
"""A thickness is too large over this many times the body's largest side ..."""
THINNER = 0.1
"""... and that of a sphere too small under this part of its smallest."""
_MANY = 50.0
"""Two units differ much where one is so many times the other."""
_AGREES = 2.0
"""A thickness fits a body up to this factor, once its unit is put right."""
_MOST_OF_ONE = 64
"""Instances of one mesh that are looked at."""
_UNITS = {"metres": 1.0, "centimetres": 0.01, "millimetres": 0.001}

OPEN = Rule("refract.sphere-on-open", ERROR, "The sphere model stands on a closed mesh.")
FLAT_SPHERE = Rule("refract.sphere-on-flat", WARNING, "The sphere model stands on a body that is not flat.")
TRACED_OPEN = Rule("refract.traced-on-open", WARNING, "The traced model stands on a closed mesh.")
SIZE = Rule("refract.thickness-against-size", WARNING, "The thickness fits the size of the object.")
UNITS = Rule("refract.thickness-units", WARNING, "The thickness is in the unit of the stage.")
INSIDE_OUT = Rule("refract.inverted-normals", ERROR, "Closed glass faces outwards.", safe=True)
NO_UV = Rule("refract.thickness-map-without-uv", ERROR, "A mesh with a thickness map has the uv that the map reads.")


class Thickness(NamedTuple):
    """How thick a piece of glass is said to be."""

    how: str
    """typed, mapped (a texture), measured (a primvar), fixed by the model or unused by it"""
    low: float
    """[m]"""
    high: float
    """[m]"""


class Glass(NamedTuple):
    """One refractive material on one prim."""

    path: str
    row: Material
    model: Model
    points: F64
    """shape (V, 3) [m]: the corners of its triangles, engine world; a sphere's centre and its ends along the axes"""
    triangles: NDArray[np.int64]
    """shape (T, 3), indices into `points`; none on an exact sphere"""
    closed: bool
    convex: bool
    sides: tuple[float, float, float]
    """[m]: extents along its own main axes, ascending"""
    thickness: Thickness
    has_uv: bool
    """False: a thickness map reads a uv that is not there"""
    inside_out: bool = False
    """As authored; here its triangles look outwards"""
    radius: float = 0.0
    """[m]; > 0: an exact sphere"""


def glass_of(scene: Scene) -> list[Glass]:
    """Every piece of glass of a scene, in its order; of very many of one mesh, an even choice."""
    scene = flat(scene, _MOST_OF_ONE)
    refractive = [material.refractive for material in scene.materials]
    found = []
    for mesh in scene.meshes:
        for number in np.unique(mesh.materials).tolist() if len(mesh.materials) else []:
            if refractive[number]:
                found.append(_of_mesh(mesh, number, scene))
    found += [_of_sphere(ball, scene) for ball in scene.spheres if refractive[ball.material]]
    return found


def _of_mesh(mesh: Mesh, number: int, scene: Scene) -> Glass:
    """The triangles of a mesh that have one material: a body of their own only where they are all of it."""
    row = scene.materials[number]
    mine = mesh.materials == number
    points, triangles = mesh.points.astype(np.float64), mesh.triangles[mine].astype(np.int64)
    if not mine.all():
        used, places = np.unique(triangles, return_inverse=True)
        points, triangles = points[used], places.reshape(-1, 3)
    closed = mesh.closed and bool(mine.all())
    source = row.inputs[Param.THICKNESS]
    return Glass(
        mesh.path, row, row.model, points, triangles, closed, closed and is_convex(points, triangles), sides(points),
        _thickness(row, mesh.primvars, scene), source.texture < 0 or source.uv_primvar in mesh.primvars,
        mesh.inside_out,
    )  # fmt: skip


def _of_sphere(ball: Sphere, scene: Scene) -> Glass:
    row = scene.materials[ball.material]
    centre = np.array(ball.centre, np.float64)
    points = np.concatenate((centre[None], centre + np.eye(3) * ball.radius, centre - np.eye(3) * ball.radius))
    source = row.inputs[Param.THICKNESS]
    return Glass(
        ball.path, row, row.model, points, np.zeros((0, 3), np.int64), True, True, (2.0 * ball.radius,) * 3,
        _thickness(row, ball.primvars, scene), source.texture < 0 or source.uv_primvar in ball.primvars,
        radius=ball.radius,
    )  # fmt: skip


def _thickness(row: Material, primvars: dict[str, NDArray[np.float32]], scene: Scene) -> Thickness:
    source = row.inputs[Param.THICKNESS]
    if row.model.fixed_thickness:
        return Thickness("fixed", source.value[0], source.value[0])
    how, low, high = _extent(source, primvars, scene)
    return Thickness(how if row.model.sized else "unused", low, high)


def _extent(source: Source, primvars: dict[str, NDArray[np.float32]], scene: Scene) -> tuple[str, float, float]:
    """How a thickness is given (mapped, measured, typed), its least and its largest value [m]."""
    if source.texture >= 0:
        texture = scene.textures[source.texture]
        channel = min(int(source.channel), 3)
        plane = texture.pixels[..., channel]
        full = 255.0 if plane.dtype.kind == "u" else 1.0
        ends = [float(end) / full * source.scale[channel] + source.bias[channel] for end in (plane.min(), plane.max())]
        return "mapped", min(ends), max(ends)
    if source.primvar in primvars:
        values = primvars[source.primvar].astype(np.float64)
        ends = [float(end) * source.scale[0] + source.bias[0] for end in (values.min(), values.max())]
        return "measured", min(ends), max(ends)
    return "typed", source.value[0], source.value[0]


def sides(points: F64) -> tuple[float, float, float]:
    """Extents along the main axes of a cloud of points (V, 3), ascending: those of its box, however it is turned."""
    around = points - points.mean(axis=0)
    _, axes = np.linalg.eigh(around.T @ around)
    a, b, c = sorted(np.ptp(around @ axes, axis=0).tolist())
    straight = sorted(np.ptp(around, axis=0).tolist())
    return (a, b, c) if a * b * c < straight[0] * straight[1] * straight[2] else (straight[0], straight[1], straight[2])


# --- rules ----------------------------------------------------------------------------------------------------------


def glass_findings(scene: Scene, glass: list[Glass], unsure: Collection[str] = ()) -> list[Finding]:
    """What is wrong with the glass of a scene.

    Args:
        unsure: materials whose thickness is known to be wrong, so that its size tells nothing
    """
    found: list[Finding] = []
    turned = {}
    for piece in glass:
        found += _shape(piece)
        if piece.row.name not in unsure:
            found += _lengths(piece, scene.metres_per_unit)
        if not piece.has_uv:
            found.append(_no_uv(piece))
        if piece.inside_out and piece.path not in turned and not any(_holds(other, piece) for other in glass):
            turned[piece.path] = _inside_out(piece)
    return [*found, *turned.values()]


def _shape(piece: Glass) -> Iterator[Finding]:
    """The model against the shape it is on."""
    convert = "run refract convert, which chooses a model by the shape"
    model, flat = f"the {piece.model.token} model of {piece.row.name}", model_for(Behind.SLAB).token
    if piece.model.behind is Behind.MESH and not piece.closed:
        text = f"{model} is on an open mesh, which has no far side; it is drawn as '{SHEET.token}'"
        yield TRACED_OPEN.broken(piece.path, text, f"close the mesh, or set refraction:model to '{SHEET.token}'")
    elif piece.model.row.needs_closed and not piece.closed:
        text = f"{model} is on an open mesh, which has no inside; use {SHEET.token} or {flat}"
        fix = f"set refraction:model to '{SHEET.token}', or {convert}"
        yield OPEN.broken(piece.path, text, fix, "refraction:model")
    elif piece.model.behind is Behind.BALL and piece.sides[0] < FLAT * piece.sides[2]:
        a, b, c = piece.sides
        text = f"{model} is on a flat body of {a:.3g} x {b:.3g} x {c:.3g} m"
        fix = f"set refraction:model to '{flat}', or {convert}"
        yield FLAT_SPHERE.broken(piece.path, text, fix, "refraction:model")


def _lengths(piece: Glass, unit: float) -> Iterator[Finding]:
    """The unit trap first: where it explains the size, that is all there is to say."""
    if not piece.model.sized or not piece.closed or piece.sides[0] <= 0.0:
        return
    size = piece.sides[0] if piece.model.behind is Behind.SLAB else float(np.prod(piece.sides) ** (1.0 / 3.0))
    high, about = piece.thickness.high, "thickness"
    for name, metres in _UNITS.items():
        factor = metres / unit
        much = factor >= _MANY or factor <= 1.0 / _MANY
        if much and piece.convex and size / _AGREES <= high * factor <= size * _AGREES:
            text = (
                f"the thickness of {piece.row.name} is {high / unit:.3g} units, or {high:.3g} m, on a body of "
                f"{size:.3g} m; in {name} it would fit, but the unit of this stage is {unit:g} m"
            )
            fix = f"multiply inputs:refraction:thickness of {piece.row.name} by {factor:g}"
            yield UNITS.broken(piece.path, text, fix, about)
            return
    measured = "run refract bake thickness STAGE OUT, which measures it"
    if high > LONGER * piece.sides[2]:
        text = f"the thickness of {piece.row.name} is {high:.3g} m, but the body is {piece.sides[2]:.3g} m at most"
        yield SIZE.broken(piece.path, text, measured, about)
    elif piece.model.behind is Behind.BALL and high < THINNER * piece.sides[0]:
        text = f"the thickness of {piece.row.name} is {high:.3g} m, but the body is {piece.sides[0]:.3g} m at least"
        yield SIZE.broken(piece.path, text, f"{measured}; a hollow body wants the {SOLID.token} model", about)


def _no_uv(piece: Glass) -> Finding:
    source = piece.row.inputs[Param.THICKNESS]
    name = f"primvars:{source.uv_primvar}" if source.uv_primvar else "any primvar (its texture has no inputs:st)"
    text = f"the thickness map of {piece.row.name} reads {name}, which is not there, so all of it has one thickness"
    fix = "author the uv, or run refract bake thickness STAGE OUT, which stores it at the points"
    return NO_UV.broken(piece.path, text, fix, source.uv_primvar)


def _inside_out(piece: Glass) -> Finding:
    """Closed glass whose faces look inwards."""
    text = f"{INWARDS}; it is drawn turned outwards, but elsewhere light enters where it should leave"
    return INSIDE_OUT.broken(piece.path, text, TURN, "orientation")


def _holds(outer: Glass, inner: Glass) -> bool:
    """One piece of glass lies inside another: a bubble, whose faces look into the gas."""
    point = inner.points[0]
    if outer is inner or not outer.closed:
        return False
    if outer.radius > 0.0:
        return bool(np.linalg.norm(outer.points[0] - point) < outer.radius)
    return encloses(outer.points, outer.triangles, point)
