"""Scenes by number: small, and of everything that a scene may hold.

A table with glass standing on it, opaque things in front of, behind and inside glass, slanted panes, meshes of two
glasses, glass inside glass and glass that overlaps, of higher, lower and equal priority, a camera inside glass; every
input of every material constant, textured or by primvar; every kind of light, an environment or none.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scenes import box, camera, glass, light, material, quad, scene, turned

from refract_core.scene import (
    Camera,
    Channel,
    Environment,
    Light,
    LightKind,
    Material,
    Mesh,
    Model,
    Param,
    Scene,
    Shadow,
    Shaping,
    Source,
    Sphere,
    Texture,
    Wrap,
)

F32 = NDArray[np.float32]

_COLOURS = (Param.DIFFUSE, Param.EMISSIVE, Param.SPECULAR, Param.TRANSMITTANCE)
_RANGES: dict[Param, tuple[float, float]] = {
    Param.DIFFUSE: (0.0, 0.9), Param.EMISSIVE: (0.0, 0.4), Param.SPECULAR: (0.0, 0.8), Param.METALLIC: (0.0, 1.0),
    Param.ROUGHNESS: (0.0, 1.0), Param.CLEARCOAT: (0.0, 1.0), Param.CLEARCOAT_ROUGHNESS: (0.0, 0.6),
    Param.OPACITY: (0.0, 1.0), Param.IOR: (1.0, 2.2), Param.OCCLUSION: (0.2, 1.0), Param.THICKNESS: (0.05, 0.8),
    Param.TRANSMITTANCE: (0.2, 1.0),
}  # fmt: skip
_SKIES = 2
FLOOR = -0.5
"""Height of the table [m]."""


class Dice:
    """Choices of one scene."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def number(self, low: float, high: float) -> float:
        return float(self.rng.uniform(low, high))

    def chance(self, p: float) -> bool:
        return bool(self.rng.random() < p)

    def pick(self, of: Any) -> Any:
        return of[int(self.rng.integers(len(of)))]

    def point(self, reach: float) -> NDArray[np.float64]:
        return self.rng.uniform(-reach, reach, 3)


# --- Pictures -------------------------------------------------------------------------------------------------------


@cache
def sky(number: int) -> Environment:
    """An environment with one bright side; the second is of an odd size, so that its levels do not nest."""
    rng = np.random.default_rng(1000 + number)
    shape = ((8, 16), (7, 12))[number]
    pixels = rng.uniform(0.05, 0.6, (*shape, 3)).astype(np.float32)
    pixels[2, 3:5] = (6.0, 5.0, 4.0)
    return Environment(pixels, turned((1, 2, -1), 35.0 * (number + 1)))


def _pictures(dice: Dice) -> tuple[Texture, ...]:
    """A float one, bytes plain and sRGB, a hole pattern of 0 and 1, and a normal map. Bytes are multiples of 64: the
    smaller levels of an 8-bit picture are bytes too, and then no mean lies halfway between two."""
    rng = dice.rng
    small = rng.uniform(0.0, 1.0, (5, 4, 4)).astype(np.float32)
    plain, curved = (rng.integers(0, 4, (4, 8, 4)).astype(np.uint8) * 64 for _ in range(2))
    holes = np.repeat(rng.integers(0, 2, (4, 4, 1)), 4, axis=2).astype(np.float32)
    bumps = rng.uniform((0.35, 0.35, 0.8, 1.0), (0.65, 0.65, 1.0, 1.0), (6, 6, 4)).astype(np.float32)
    return (
        Texture("float", small), Texture("bytes", plain), Texture("srgb", curved, srgb=True), Texture("holes", holes),
        Texture("bumps", bumps),
    )  # fmt: skip


_FLOATS, _BYTES, _CURVED, _HOLES, _BUMPS = range(5)

# --- Materials ------------------------------------------------------------------------------------------------------


def _uv(dice: Dice) -> dict[str, Any]:
    """How a texture lies: wrap modes, matrix, and st from the mesh, from a constant, or from nowhere."""
    angle, grow = dice.number(0, 2 * math.pi), dice.number(0.4, 2.5)
    c, s = grow * math.cos(angle), grow * math.sin(angle)
    return {
        "wrap": (dice.pick(list(Wrap)), dice.pick(list(Wrap))),
        "uv_primvar": dice.pick(["st", "st", "st", "st", "flat_st", "nowhere", ""]),
        "uv_value": (dice.number(0, 1), dice.number(0, 1)),
        "uv_matrix": (c, -s, dice.number(-1, 1), s, c * dice.pick([1.0, -1.0]), dice.number(-1, 1)),
    }


def _driven(dice: Dice, param: Param) -> Source:
    """One input: a constant, a texture, or a primvar, within its range."""
    low, high = _RANGES[param]
    if param is Param.ROUGHNESS and dice.chance(0.5):
        low = high = dice.pick([0.0, 0.02, 0.1, 0.15, 0.3, 0.45, 1.0])
    colour = param in _COLOURS
    value = _four(dice.number(low, high) for _ in range(4)) if colour else (dice.number(low, high),) * 4
    kind = dice.rng.random()
    if kind < 0.5:
        return Source(value)
    share = [dice.number(0.6, 1.0) for _ in range(4)]
    scale = _four((high - low) * k for k in share)
    bias = _four(low + (high - low) * (1 - k) * 0.5 for k in share)
    if kind < 0.8:
        channel = Channel.RGB if colour else dice.pick(list(Channel))
        texture = dice.pick([_FLOATS, _BYTES, _CURVED])
        return Source(value, texture, channel, scale=scale, bias=bias, **_uv(dice))
    return Source(value, primvar=dice.pick(["one", "two", "three", "four", "nowhere"]), scale=scale, bias=bias)


def _four(values: Iterable[float]) -> tuple[float, float, float, float]:
    a, b, c, d = values
    return (a, b, c, d)


def _inputs(dice: Dice) -> dict[str, Any]:
    chosen: dict[str, Any] = {p.name: _driven(dice, p) for p in Param if p is not Param.NORMAL}
    if dice.chance(0.5):
        chosen["CLEARCOAT"] = Source((0.0,) * 4)
    if dice.chance(0.4):
        ranges: dict[str, Any] = {"scale": (2.0, 2.0, 2.0, 2.0), "bias": (-1.0, -1.0, -1.0, 0.0)}
        chosen["NORMAL"] = Source((0.0, 0.0, 1.0, 1.0), _BUMPS, **ranges, **_uv(dice))
    return chosen


def _opaque(dice: Dice, may_have_holes: bool = True) -> Material:
    inputs = {**_inputs(dice), "OPACITY": Source((1.0,) * 4)}
    fields: dict[str, Any] = {"specular_workflow": dice.chance(0.4)}
    if may_have_holes and dice.chance(0.2):
        inputs["OPACITY"] = _holes(dice)
        fields["opacity_threshold"] = 0.45
    return material("/opaque", **inputs, **fields)


def _holes(dice: Dice) -> Source:
    return Source(texture=_HOLES, channel=Channel.G, **{**_uv(dice), "uv_primvar": "st"})


def _glass(dice: Dice, model: Model, may_have_holes: bool = False) -> Material:
    inputs = _inputs(dice)
    inputs["OPACITY"] = Source((0.0,) * 4) if dice.chance(0.5) else inputs["OPACITY"]
    inputs["ROUGHNESS"] = Source((0.0,) * 4) if dice.chance(0.5) else inputs["ROUGHNESS"]
    threshold = 0.0
    if may_have_holes and dice.chance(0.25):
        inputs["OPACITY"], threshold = _holes(dice), 0.45
    return glass(
        model, specular_workflow=dice.chance(0.3), absorption_distance=dice.number(0.1, 1.5),
        abbe=dice.pick([0.0, 15.0, 40.0]), opacity_threshold=threshold, priority=dice.pick([0, 0, 0, 1, 2, -1]),
        **inputs,
    )  # fmt: skip


def _even(dice: Dice, priority: int) -> Material:
    """Glass of one index and one colour, whichever of its places is asked: for what the eye is in."""
    made = _glass(dice, Model.TRACED)
    inputs = list(made.inputs)
    inputs[Param.IOR] = Source((dice.number(1.05, 1.8),) * 4)
    inputs[Param.TRANSMITTANCE] = Source(_four(dice.number(0.5, 1.0) for _ in range(4)))
    return replace(made, inputs=tuple(inputs), priority=priority)


# --- Shapes ---------------------------------------------------------------------------------------------------------


def _tetrahedron(dice: Dice, index: int, centre: NDArray[np.float64]) -> Mesh:
    corners = np.array([[1, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]]) * dice.number(0.25, 0.45)
    points = corners @ turned(dice.point(1.0), dice.number(0, 360)).T + centre
    triangles = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.uint32)
    return Mesh("/tetra", points.astype(np.float32), triangles, np.full(4, index, np.int32), closed=True)


def _dressed(dice: Dice, mesh: Mesh) -> Mesh:
    """With primvars of every width, and sometimes with corner normals that are not the faces' own."""
    t = len(mesh.triangles)
    primvars: dict[str, F32] = {}
    widths = (("one", 1), ("two", 2), ("three", 3), ("four", 4))
    for name, width in widths:
        if dice.chance(0.8):
            shape = (1, 1, width) if dice.chance(0.3) else (t, 3, width)
            primvars[name] = dice.rng.uniform(0.1, 0.9, shape).astype(np.float32)
    primvars["st"] = mesh.primvars.get("st", dice.rng.uniform(0, 1.2, (t, 3, 2)).astype(np.float32))
    primvars["flat_st"] = dice.rng.uniform(0, 1, (1, 1, 2)).astype(np.float32)
    if dice.chance(0.4):
        return replace(with_bent_normals(mesh, 0.25, dice.rng), primvars=primvars)
    return replace(mesh, primvars=primvars)


def with_bent_normals(mesh: Mesh, by: float, rng: np.random.Generator) -> Mesh:
    """Corner normals that lean away from their face's by up to `by` along each axis."""
    corners = mesh.points.astype(np.float64)[mesh.triangles]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat /= np.linalg.norm(flat, axis=-1, keepdims=True)
    bent = flat[:, None] + rng.uniform(-by, by, corners.shape)
    return replace(mesh, normals=(bent / np.linalg.norm(bent, axis=-1, keepdims=True)).astype(np.float32))


class _Builder:
    """A scene in the making."""

    def __init__(self, dice: Dice, standing: bool) -> None:
        self.dice, self.standing = dice, standing
        self.meshes: list[Mesh] = []
        self.spheres: list[Sphere] = []
        self.materials: list[Material] = []

    def of(self, what: Material) -> int:
        self.materials.append(what)
        return len(self.materials) - 1

    def add(self, mesh: Mesh) -> None:
        path = f"{mesh.path}{len(self.meshes)}"
        self.meshes.append(_dressed(self.dice, replace(mesh, path=path, static=self.dice.chance(0.8))))

    def stage(self) -> None:
        """The table, and now and then a wall."""
        y = FLOOR
        table = [(-1.6, y, 1.6), (1.6, y, 1.6), (1.6, y, -1.6), (-1.6, y, -1.6)]
        self.add(quad("/table", table, self.of(_opaque(self.dice, False))))
        if self.dice.chance(0.6):
            wall = [(-1.6, y, -1.5), (1.6, y, -1.5), (1.6, 1.2, -1.8), (-1.6, 1.2, -1.8)]
            self.add(quad("/wall", wall, self.of(_opaque(self.dice))))

    def ball(self, path: str, index: int, place: NDArray[np.float64], radius: float) -> None:
        constants = {"one": self.dice.rng.uniform(0, 1, (1, 1, 1)).astype(np.float32)}
        constants["st"] = self.dice.rng.uniform(0, 1, (1, 1, 2)).astype(np.float32)
        x, y, z = (float(v) for v in place)
        self.spheres.append(Sphere(f"{path}{len(self.spheres)}", (x, y, z), radius, index, constants))

    def body(self, path: str, of: Material, place: NDArray[np.float64], size: float) -> None:
        """A ball or a turned box about a place."""
        dice = self.dice
        if dice.chance(0.4):
            self.ball(path, self.of(of), place, size)
            return
        turn = turned(dice.point(1.0), dice.number(0, 360))
        self.add(box(path, size * dice.rng.uniform(0.7, 1.0, 3), self.of(of), turn, place))

    def nested(self, z: float) -> None:
        """Glass with something in it: glass of any model, or something opaque; it may stick out a little."""
        dice = self.dice
        place, size = np.array([dice.number(-0.6, 0.6), dice.number(-0.05, 0.3), z]), dice.number(0.3, 0.5)
        self.body("/outer", _glass(dice, dice.pick([Model.TRACED, Model.TRACED, Model.SPHERE, Model.BOX])), place, size)
        model = dice.pick([Model.TRACED, Model.TRACED, Model.SPHERE, Model.BOX, Model.THIN, Model.NONE])
        of = _opaque(dice) if model is Model.NONE else _glass(dice, model)
        self.body("/inner", of, place + dice.point(0.05), size * dice.number(0.25, 0.5))

    def overlapping(self, z: float) -> None:
        """Two or three bodies of traced glass that share some space."""
        dice = self.dice
        place, size = np.array([dice.number(-0.6, 0.6), dice.number(-0.05, 0.3), z]), dice.number(0.25, 0.4)
        for _ in range(dice.pick([2, 2, 3])):
            self.body("/overlap", _glass(dice, Model.TRACED), place + dice.point(0.6) * size, size)

    def around(self, eye: NDArray[np.float64]) -> None:
        """One or two boxes of traced glass that the eye is in; the first of their faces and some more may be of another
        material."""
        dice = self.dice
        for k in range(dice.pick([1, 1, 2])):
            half, turn = dice.rng.uniform(0.15, 0.25, 3) * (k + 1), turned(dice.point(1.0), dice.number(0, 360))
            priority = dice.pick([-2, 0, 3]) + k
            mesh = box("/around", half, self.of(_even(dice, priority)), turn, eye + dice.point(0.05))
            if dice.chance(0.5):
                other = self.of(_opaque(dice, False) if dice.chance(0.7) else _even(dice, priority))
                others = dice.rng.random(len(mesh.triangles)) < 0.3
                others[0] = True
                mesh = replace(mesh, materials=np.where(others, other, mesh.materials).astype(np.int32))
            self.add(mesh)

    def thing(self, of: Material, z: float) -> None:
        """A ball, a box on the table, a turned box or a tetrahedron; of glass, sometimes with a second one on it."""
        dice = self.dice
        index = self.of(of)
        place = np.array([dice.number(-0.8, 0.8), dice.number(-0.1, 0.3), z])
        # What touches the table ties with it: there a hole, or a face that is crossed straight, would decide which of
        # two equally near surfaces a ray meets.
        stands = self.standing and not of.cutout and of.model is not Model.THIN
        kind = dice.pick(["ball", "turned", "tetra"] + ["standing"] * stands)
        if kind == "ball":
            self.ball("/ball", index, place, dice.number(0.2, 0.4))
            return
        if kind == "tetra":
            mesh = _tetrahedron(dice, index, place)
        else:
            half = dice.rng.uniform(0.15, 0.45, 3)
            turn = turned((0, 1, 0), dice.number(0, 90))
            if kind == "standing":
                place[1] = FLOOR + half[1]
            else:
                turn = turned(dice.point(1.0), dice.number(0, 360))
            mesh = box("/box", half, index, turn, place)
        if of.refractive and dice.chance(0.5):
            other = self.of(_glass(dice, of.model))
            mesh = replace(mesh, materials=np.where(dice.rng.random(len(mesh.triangles)) < 0.5, index, other))
            mesh = replace(mesh, materials=mesh.materials.astype(np.int32))
        if of.refractive and kind != "standing" and dice.chance(0.2):  # inside out: view rays meet its back first
            mesh = replace(mesh, triangles=mesh.triangles[:, ::-1].copy())
        self.add(mesh)

    def pane(self, z: float) -> None:
        """A slanted sheet of thin glass."""
        dice = self.dice
        turn = turned((dice.number(-1, 1), 1, dice.number(-0.3, 0.3)), dice.number(-70, 70))
        corners = np.array([(-0.6, -0.45, 0), (0.6, -0.45, 0), (0.6, 0.6, 0), (-0.6, 0.6, 0)]) @ turn.T
        what = _glass(dice, dice.pick([Model.THIN, Model.THIN, Model.TRACED, Model.BOX]), may_have_holes=True)
        self.add(quad("/pane", corners + np.array([dice.number(-0.4, 0.4), 0.15, z]), self.of(what)))


def _lights(dice: Dice) -> tuple[Light, ...]:
    lights = []
    for _ in range(dice.pick([1, 1, 2, 3])):
        # The camera's light is a kind for kernels; a scene asks for it by `camera_light`.
        kind = dice.pick([LightKind.DISTANT, LightKind.SPHERE, LightKind.RECT, LightKind.DISK])
        place = np.array([dice.number(-1.5, 1.5), dice.number(1.2, 2.5), dice.number(-1.0, 2.0)])
        sizes = {LightKind.DISTANT: (dice.pick([0.0, 0.02, 0.2]), 0.0), LightKind.RECT: (dice.number(0.2, 1.0), 0.4)}
        size = sizes.get(kind, (dice.pick([0.0, 0.15, 0.4]), 0.0))
        strong = 1.0 if kind is LightKind.DISTANT else 3.0 if size[0] == 0.0 else 12.0
        one = light(kind, place, -place + dice.point(0.4), size, strong * dice.number(0.5, 1.5))
        r, g, b = (r * dice.number(0.5, 1.0) for r in one.radiance)
        lights.append(replace(one, radiance=(r, g, b), diffuse=dice.pick([1.0, 0.6]), specular=dice.pick([1.0, 0.5])))
    return tuple(lights)


def _shaped(dice: Dice, one: Light, paths: list[str]) -> Light:
    """A light as it may be authored: of another kind, uneven, with odd shadows, linked. Its own dice."""
    if dice.chance(0.25) and one.kind is not LightKind.DISTANT:
        one = replace(one, kind=LightKind.CYLINDER, size=(min(one.size[0], 0.15), dice.number(0.3, 1.2)))
    chosen: dict[str, Any] = {}
    if dice.chance(0.3):
        chosen |= {"cone": math.radians(dice.number(15.0, 60.0)), "softness": dice.pick([0.0, 0.3, 1.0])}
    if dice.chance(0.2):
        chosen |= {"focus": dice.number(0.5, 6.0), "focus_tint": dice.pick([(0.0, 0.0, 0.0), (0.2, 0.5, 1.0)])}
    if dice.chance(0.2):
        profile = dice.rng.uniform(0.0, 2.0, (7, dice.pick([1, 5]))).astype(np.float32)
        profile[:, -1] = profile[:, 0]
        chosen["profile"] = profile
    if dice.chance(0.5) and one.kind is LightKind.RECT:
        chosen["picture"] = dice.rng.uniform(0.0, 2.0, (3, 5, 3)).astype(np.float32)
    if one.kind is not LightKind.DISTANT:
        one = replace(one, shaping=Shaping(**chosen))
    if dice.chance(0.3):
        distance = dice.pick([math.inf, 0.5, 1.5])
        fade = dice.pick([0.0, 0.4]) if distance < math.inf else 0.0
        one = replace(one, shadow=Shadow(dice.pick([(0.0,) * 3, (0.1, 0.3, 0.6)]), distance, fade, dice.number(0.5, 2)))
    one = replace(one, casts_shadow=dice.chance(0.9))
    some = tuple(path for path in paths if dice.chance(0.7))
    return replace(one, lit=some if dice.chance(0.15) else None, casters=some if dice.chance(0.15) else None)


def _camera(dice: Dice) -> Camera:
    eye = np.array([dice.number(-1.0, 1.0), dice.number(0.2, 1.6), dice.number(2.0, 2.8)])
    clipping = (1e-5, 1e6)
    if dice.chance(0.3):
        return camera(eye, (0, -0.05, 0), 0.8, 4 / 3, orthographic=True, exposure_scale=0.7, clipping=clipping)
    return camera(eye, (dice.number(-0.1, 0.1), -0.05, 0), dice.number(0.3, 0.42), 4 / 3, clipping=clipping)


def random_scene(seed: int, standing: bool = True) -> Scene:
    """Scene number `seed`. `standing`: glass may stand on the table, whose faces there are one with the glass's."""
    dice = Dice(seed)
    made = _Builder(dice, standing)
    made.stage()
    made.thing(_opaque(dice), dice.number(-0.9, -0.4))
    for z in (dice.number(-0.4, 0.1), dice.number(0.3, 0.8)):
        kind = dice.pick(["one", "one", "nested", "overlapping"])
        if kind == "one":
            made.thing(_glass(dice, dice.pick([Model.TRACED, Model.SINGLE, Model.SPHERE, Model.BOX, Model.THIN])), z)
        else:
            made.nested(z) if kind == "nested" else made.overlapping(z)
    if dice.chance(0.6):
        made.pane(dice.number(-0.6, 0.9))
    if dice.chance(0.5):
        made.thing(_opaque(dice), dice.number(-0.3, 0.5))
    environment = sky(dice.pick(range(_SKIES))) if dice.chance(0.6) else None
    lights = _lights(dice) if dice.chance(0.8) else ()
    dice_of_lights = Dice(seed + 10**6)
    paths = [thing.path for thing in made.meshes] + [ball.path for ball in made.spheres]
    lights = tuple(_shaped(dice_of_lights, one, paths) for one in lights)
    lens = _camera(dice)
    if dice.chance(0.2):
        made.around(lens.world_from_camera[:3, 3])
    moved = np.eye(4)
    moved[:3, :3] = turned((1, 0, 0), 90) * 100.0
    moved[:3, 3] = (5.0, -7.0, 11.0)
    return scene(
        made.meshes, made.materials, made.spheres, textures=_pictures(dice), lights=lights, environment=environment,
        camera_light=not lights, cameras=(lens,), stage_from_engine=moved, metres_per_unit=0.01,
    )  # fmt: skip
