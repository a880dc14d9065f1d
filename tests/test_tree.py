"""Laws of the tree of rays: glass in glass, overlapping bodies, the eye in a medium, series of reflections, alpha."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import (
    box,
    camera,
    checker_room,
    constant_room,
    dome,
    draw,
    glass,
    light,
    material,
    position_room,
    quad,
    scene,
    shell,
    snell,
    turned,
    view_rays,
    wall_hit,
    where,
)

from refract_core.scene import Camera, LightKind, Material, Mesh, Model, Scene, Sphere

F32 = NDArray[np.float32]
DIRECT, WHOLE = 1.0, 1e-7
"""Cuts: all light goes the way of what goes through; every branch is followed that can be seen in float32."""
STRAIGHT = camera(fov=0.01, orthographic=True)
MODELS = [Model.SPHERE, Model.BOX, Model.THIN, Model.TRACED, Model.SINGLE]


# --- Stacks, straight through, by the adding method -------------------------------------------------------------------


class Stack(NamedTuple):
    """What parallel layers do to light that falls on them straight, without interference (Stokes 1862)."""

    front: float
    """reflectance seen from before"""
    back: float
    through: float

    def __add__(self, other: Any) -> Stack:
        among = 1.0 / (1.0 - self.back * other.front)
        return Stack(
            self.front + self.through**2 * other.front * among, other.back + other.through**2 * self.back * among,
            self.through * other.through * among,
        )  # fmt: skip


def face(n1: float, n2: float) -> Stack:
    """An interface."""
    f = ((n1 - n2) / (n1 + n2)) ** 2
    return Stack(f, f, 1.0 - f)


def depth(tint: float, length: float) -> Stack:
    """A stretch that absorbs; `tint` is what one metre leaves."""
    return Stack(0.0, 0.0, tint**length)


def stacked(*layers: Stack) -> Stack:
    return reduce(Stack.__add__, layers)


BEHIND_CAMERA, AHEAD = 4, 5
"""The walls at +z and -z."""


def lit(wall: int, things: Sequence[Mesh | Sphere], kinds: Sequence[Material]) -> Scene:
    """Things in a black room of which one wall shines; `kinds` count from 2."""
    walls, _ = position_room()
    own = [replace(mesh, materials=np.full(2, int(k == wall), np.int32)) for k, mesh in enumerate(walls)]
    meshes = [t for t in things if isinstance(t, Mesh)]
    balls = [t for t in things if isinstance(t, Sphere)]
    stuff = [material("/black"), material("/lit", EMISSIVE=1.0), *kinds]
    return scene([*own, *meshes], stuff, balls, cameras=(STRAIGHT,))


def middle(what: Scene, **settings: Any) -> dict[str, Any]:
    """The planes of the one pixel that looks straight along -z."""
    planes = draw(what, 1, 1, tiers=("ray",), max_layers=32, **settings)
    return {name: plane[0, 0] for name, plane in planes.items()}


def assert_stack(expected: Stack, things: Sequence[Mesh], kinds: Sequence[Material]) -> None:
    """Light from ahead is let through, light from behind the camera is sent back, as the stack says."""
    ahead, back = (middle(lit(wall, things, kinds), cut=WHOLE) for wall in (AHEAD, BEHIND_CAMERA))
    np.testing.assert_allclose(ahead["beauty"][:3], expected.through, rtol=2e-5)
    np.testing.assert_allclose(back["beauty"][:3], expected.front, rtol=2e-5)


def slab(name: str, near: float, far: float, index: int) -> Mesh:
    """Between two planes across the view."""
    return box(f"/{name}", (2.0, 2.0, (near - far) / 2), index, centre=(0, 0, (near + far) / 2))


def tinted(ior: float, tint: float, **inputs: Any) -> Material:
    """Traced glass one metre of which leaves `tint`."""
    return glass(Model.TRACED, ior, TRANSMITTANCE=tint, absorption_distance=1.0, **inputs)


@pytest.mark.parametrize("ior", [1.1, 1.5, 2.4])
def test_a_slab_sends_back_two_f_over_one_plus_f(ior: float) -> None:
    f = ((ior - 1) / (ior + 1)) ** 2
    expected = stacked(face(1, ior), face(ior, 1))
    assert expected.front == pytest.approx(2 * f / (1 + f))
    assert_stack(expected, [slab("slab", 0.2, -0.2, 2)], [glass(Model.TRACED, ior)])


def test_every_pass_through_a_slab_absorbs() -> None:
    assert_stack(stacked(face(1, 2), depth(0.5, 0.4), face(2, 1)), [slab("slab", 0.2, -0.2, 2)], [tinted(2.0, 0.5)])


def test_light_passes_panes_both_ways() -> None:
    """What the far pane mirrors goes back through the near one. A pane mirrors before it absorbs, from either side; its
    colour is that of one crossing."""
    panes = [quad(f"/pane{k}", [(-2, -2, -k), (2, -2, -k), (2, 2, -k), (-2, 2, -k)], 2 + k) for k in range(2)]
    kinds = [glass(Model.THIN, 2.0, TRANSMITTANCE=tint) for tint in (0.8, 0.5)]
    f = 1.0 / 9.0
    near, far = (Stack(f, f, (1.0 - f) * tint) for tint in (0.8, 0.5))
    assert_stack(near + far, panes, kinds)


@pytest.mark.parametrize(("priorities", "border"), [((0, 1), 0.1), ((1, 0), -0.1), ((0, 0), 0.1)])
def test_where_bodies_overlap_the_higher_priority_fills_the_space(priorities: tuple[int, int], border: float) -> None:
    """Two slabs that share 20 cm are three interfaces; the middle one is where the higher begins or ends. Of equals,
    the one that a ray entered last: seen from one side only, so its reflections are left out."""
    bodies = [slab("near", 0.5, -0.1, 2), slab("far", 0.1, -0.5, 3)]
    kinds = [tinted(n, t, priority=p) for n, t, p in zip((1.3, 2.0), (0.5, 0.2), priorities, strict=True)]
    if priorities[0] == priorities[1]:
        planes = middle(lit(AHEAD, bodies, kinds), cut=DIRECT)
        np.testing.assert_allclose(planes["beauty"][:3], 0.5 ** (0.5 - border) * 0.2 ** (border + 0.5), rtol=1e-5)
        return
    expected = stacked(
        face(1, 1.3), depth(0.5, 0.5 - border), face(1.3, 2), depth(0.2, border + 0.5), face(2, 1)
    )  # fmt: skip
    assert_stack(expected, bodies, kinds)


def _hollow(outer: Mesh, inner: Mesh) -> Mesh:
    """One mesh of two: the inner one turned inside out."""
    points = np.concatenate([outer.points, inner.points])
    faces = np.concatenate([outer.triangles, inner.triangles[:, ::-1] + len(outer.points)]).astype(np.uint32)
    return replace(outer, points=points, triangles=faces, materials=np.concatenate([outer.materials, inner.materials]))


def test_ice_in_a_drink_in_a_cup() -> None:
    """The drink reaches into the cup's walls, which own the space that they share; the ice owns its own. Seven
    stretches of three media, eight interfaces."""
    cup = _hollow(slab("cup", 0.5, -0.5, 2), box("/hollow", (1.9, 1.9, 0.4), 2))
    drink = box("/drink", (1.95, 1.95, 0.45), 3)
    ice = box("/ice", (1.0, 1.0, 0.1), 4)
    kinds = [tinted(1.5, 0.6, priority=2), tinted(1.33, 0.3, priority=0), tinted(1.2, 0.9, priority=1)]
    wall, liquid = depth(0.6, 0.1), depth(0.3, 0.3)
    expected = stacked(
        face(1, 1.5), wall, face(1.5, 1.33), liquid, face(1.33, 1.2), depth(0.9, 0.2), face(1.2, 1.33), liquid,
        face(1.33, 1.5), wall, face(1.5, 1),
    )  # fmt: skip
    assert_stack(expected, [cup, drink, ice], kinds)


@pytest.mark.parametrize("priority", [-1, 0, 1])
def test_a_bubble_of_lower_priority_is_not_there(priority: int) -> None:
    bodies = [slab("outer", 0.5, -0.5, 2), box("/bubble", (1.9, 1.9, 0.2), 3)]
    kinds = [glass(Model.TRACED, 1.8), glass(Model.TRACED, 1.0, priority=priority)]
    faces = [face(1, 1.8), face(1.8, 1), face(1, 1.8), face(1.8, 1)]
    assert_stack(stacked(*(faces if priority >= 0 else faces[:1] + faces[-1:])), bodies, kinds)


# --- Glass in glass ---------------------------------------------------------------------------------------------------


def test_a_red_ball_in_a_clear_ball_is_seen() -> None:
    """Of one index, so rays bend at the outer ball alone; the chord of the inner one absorbs by Beer and Lambert."""
    tint, size = np.array([0.9, 0.2, 0.1]), 24
    walls, materials = constant_room()
    balls = [Sphere("/outer", (0, 0, 0), 0.9, 1), Sphere("/inner", (0.1, -0.1, 0.2), 0.4, 2)]
    kinds = [glass(Model.TRACED), glass(Model.TRACED, TRANSMITTANCE=tint, absorption_distance=0.8)]
    lens = camera(fov=0.35)
    planes = draw(scene(walls, [*materials, *kinds], balls, cameras=(lens,)), size, size, cut=DIRECT)
    origins, directions = view_rays(lens, size, size)
    seen = 0
    for y in range(size):
        for x in range(size):
            chord, o, d = 0.0, origins[y, x], directions[y, x]
            along = -float(o @ d)
            inside = 0.81 - float(o @ o) + along * along
            if inside > 0.0:
                entry = o + d * (along - math.sqrt(inside))
                way = snell(d, entry / 0.9, 1 / 1.5)
                assert way is not None
                to = np.array(balls[1].centre) - entry
                short = 0.16 - float(to @ to) + float(to @ way) ** 2
                chord = 2 * math.sqrt(max(short, 0.0))
                seen += chord > 0.0
            np.testing.assert_allclose(planes["beauty"][y, x, :3], tint ** (chord / 0.8), atol=1e-3)
    assert 50 < seen < size * size / 2


def test_an_opaque_thing_in_glass_behind_glass_is_seen() -> None:
    """An ember in a tinted box behind a tinted pane: two colours on the way to it. Index 1 mirrors nothing."""
    pane = quad("/pane", [(-2, -2, 1), (2, -2, 1), (2, 2, 1), (-2, 2, 1)], 2)
    ember = Sphere("/ember", (0, 0, 0), 0.3, 4)
    kinds = [glass(Model.THIN, 1.0, TRANSMITTANCE=0.7), tinted(1.0, 0.5), material("/ember", EMISSIVE=0.6)]
    planes = middle(lit(AHEAD, [pane, slab("body", 0.5, -0.5, 3), ember], kinds))
    np.testing.assert_allclose(planes["beauty"][:3], 0.7 * 0.5**0.2 * 0.6, rtol=1e-4)
    assert planes["layers"] == 2


def test_max_layers_hides_glass_behind_glass_but_not_glass_in_glass() -> None:
    """HDRP's one surface: what is entered counts, and a ray in air that has entered enough sees no more glass."""
    kinds = [tinted(1.0, 0.5), tinted(1.0, 0.25, priority=1)]
    behind = [slab("near", 1.0, 0.0, 2), slab("far", -1.0, -2.0, 3)]
    inside = [slab("outer", 1.0, -1.0, 2), box("/inner", (1.0, 1.0, 0.5), 3)]
    for most, apart, nested in ((1, 0.5, 0.5 * 0.25), (2, 0.5 * 0.25, 0.5 * 0.25)):
        for bodies, expected in ((behind, apart), (inside, nested)):
            planes = draw(lit(AHEAD, bodies, kinds), 1, 1, tiers=("ray",), max_layers=most)
            np.testing.assert_allclose(planes["beauty"][0, 0, :3], expected, rtol=1e-4)


def test_a_models_way_may_end_behind_its_body_in_other_glass() -> None:
    """A box 40 cm deep whose thickness is said to be a metre: the way in it ends where other glass begins, and from
    there on nothing of it is left."""
    typed = glass(Model.BOX, 1.0, THICKNESS=1.0, TRANSMITTANCE=0.5, absorption_distance=1.0)
    planes = middle(lit(AHEAD, [slab("typed", 0.7, 0.3, 2), slab("clear", 0.0, -1.0, 3)], [typed, tinted(1.0, 1.0)]))
    np.testing.assert_allclose(planes["beauty"][:3], 0.5**0.7, rtol=1e-4)
    np.testing.assert_allclose(planes["path_length"], 0.7 + 1.0, rtol=1e-4)


def test_a_models_way_may_lead_out_of_the_body_around_it() -> None:
    """The box's metre begins in tinted glass and ends outside of it: there is no more tint behind."""
    typed = glass(Model.BOX, 1.0, THICKNESS=1.0, TRANSMITTANCE=0.5, absorption_distance=1.0)
    inner = box("/typed", (1.0, 1.0, 0.2), 3)
    planes = middle(lit(AHEAD, [slab("around", 0.5, -0.5, 2), inner], [tinted(1.0, 0.2), typed]))
    np.testing.assert_allclose(planes["beauty"][:3], 0.2**0.3 * 0.5, rtol=1e-4)
    np.testing.assert_allclose(planes["path_length"], 0.3 + 1.0, rtol=1e-4)


# --- Nothing is lost --------------------------------------------------------------------------------------------------


def drinks(**inputs: Any) -> tuple[list[Mesh], list[Material]]:
    """A cup with a liquid that reaches into its wall, and ice that floats in it; materials count from 1."""
    meshes = [
        box("/liquid", (0.44, 0.3, 0.44), 1, turned((0, 1, 0), 20)),
        box("/ice", (0.15, 0.15, 0.15), 2, turned((1, 2, 3), 50), (0.1, 0.25, 0.1)),
        shell("/cup", 0.8, 0.5, 3, 6),
    ]
    kinds = [glass(Model.TRACED, n, priority=k, **inputs) for k, n in enumerate((1.33, 1.31, 1.5))]
    return meshes, kinds


@pytest.mark.parametrize("cut", [0.005, 0.02, 0.2, DIRECT])
@pytest.mark.parametrize("inputs", [{}, {"abbe": 20.0}, {"ROUGHNESS": 0.4}], ids=["clear", "dispersive", "rough"])
def test_a_drink_in_a_white_room_is_white(cut: float, inputs: dict[str, Any]) -> None:
    """Whatever is cut goes the other way, channel by channel."""
    walls, materials = constant_room()
    meshes, kinds = drinks(**inputs)
    planes = draw(scene([*walls, *meshes], [*materials, *kinds]), 24, 24, tiers=("ray",), cut=cut)
    assert planes["mask"].mean() > 0.2
    np.testing.assert_allclose(planes["beauty"][..., :3], 1.0, atol=1e-4)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("tiers", [("ray", "sky"), ("screen", "probe", "ray", "sky"), ("sky",)], ids="-".join)
def test_glass_that_disperses_in_glass_is_white_under_a_white_dome(model: Model, tiers: tuple[str, ...]) -> None:
    inner = box("/inner", (0.2, 0.3, 0.15), 1, turned((1, 2, 3), 40), (0.1, 0.0, 0.0))
    kinds = [glass(model, 1.6, abbe=30.0), glass(Model.TRACED, 1.3, abbe=20.0)]
    what = scene([inner], kinds, [Sphere("/outer", (0, 0, 0), 0.6, 0)], environment=dome(1.0))
    planes = draw(what, 32, 32, tiers=tiers)
    assert planes["mask"].mean() > 0.1
    np.testing.assert_allclose(planes["beauty"][..., :3], 1.0, atol=1e-4)


@pytest.mark.parametrize("model", MODELS)
def test_glass_turned_inside_out_is_there_and_keeps_a_white_room_white(model: Model) -> None:
    cube = box("/cube", (0.6, 0.5, 0.4), 1, turned((1, 2, 3), 40))
    wrong = replace(cube, triangles=np.ascontiguousarray(cube.triangles[:, ::-1]))
    walls, materials = constant_room()
    right, turned_out = (
        draw(scene([*walls, mesh], [*materials, glass(model)]), 48, 48, tiers=("ray",)) for mesh in (cube, wrong)
    )
    np.testing.assert_array_equal(turned_out["mask"], right["mask"])
    np.testing.assert_allclose(turned_out["beauty"][..., :3], 1.0, atol=1e-4)


# --- The eye in a medium ----------------------------------------------------------------------------------------------


def sea(lens: Camera, **inputs: Any) -> Scene:
    """Water from y = -2 to 0 in the position room."""
    walls, materials = position_room()
    water = box("/water", (2.0, 1.0, 2.0), 1, centre=(0, -1.0, 0))
    return scene([*walls, water], [*materials, glass(Model.TRACED, **inputs)], cameras=(lens,))


def test_snells_window() -> None:
    """From under water, upwards: the world above within asin(1 / 1.33) = 48.75 degrees, and all around it a mirror."""
    size, ior, up = 32, 1.33, np.array([0.0, 1.0, 0.0])
    lens = camera((0.1, -0.8, 0.2), (0.1, 1.0, 0.21), fov=1.4, clipping=(1e-4, 100.0))
    planes = draw(sea(lens, ior=ior), size, size, tiers=("ray",), cut=DIRECT)
    assert (planes["mask"] == 1.0).all()
    origins, directions = view_rays(lens, size, size)
    window = mirror = 0
    for y in range(size):
        for x in range(size):
            o, d = origins[y, x], directions[y, x]
            surface = o - d * o[1] / d[1]
            if max(abs(surface[0]), abs(surface[2])) > 2.0:  # a side of the water
                continue
            out = snell(d, -up, ior)
            angle = math.degrees(math.acos(d[1]))
            assert (out is None) == (angle > 48.75)
            if out is None:
                mirror += 1
                assert not planes["refraction"][y, x].any()
                assert planes["reflection"][y, x].any()
            else:
                window += 1
                np.testing.assert_allclose(where(planes["beauty"][y, x]), wall_hit(surface, out), atol=2e-4)
    assert min(window, mirror) > 100


@pytest.mark.parametrize("orthographic", [False, True])
def test_the_medium_of_the_eye_absorbs_from_the_eye_on(orthographic: bool) -> None:
    """Found around a perspective eye; for an orthographic one by the wall that its rays meet first, from inside."""
    lens = camera((0.1, -0.8, 0.2), (0.3, -0.9, -3), fov=0.1, clipping=(1e-5, 100), orthographic=orthographic)
    stuff = {"ior": 1.0, "TRANSMITTANCE": 0.5, "absorption_distance": 0.8}
    clear, found = (draw(sea(lens, **inputs), 12, 12, tiers=("ray",)) for inputs in ({"ior": 1.0}, stuff))
    origins, directions = view_rays(lens, 12, 12)
    way = (-2.0 - origins[..., 2]) / directions[..., 2]
    expected = clear["beauty"][..., :3] * (0.5 ** (way / 0.8))[..., None]
    np.testing.assert_allclose(found["beauty"][..., :3], expected, rtol=1e-4)
    np.testing.assert_allclose(found["path_length"], way, rtol=1e-4)


def test_the_eye_in_water_sees_what_is_with_it_there() -> None:
    """A card in the water, met before any surface of it."""
    lens = camera((0, -1, 1), (0, -1, 0), fov=0.01, clipping=(1e-5, 100))
    what = sea(lens, ior=1.33, TRANSMITTANCE=0.5, absorption_distance=0.8)
    card = quad("/card", [(-1, -2, 0.4), (1, -2, 0.4), (1, 0, 0.4), (-1, 0, 0.4)], 2)
    what = replace(what, meshes=(*what.meshes, card), materials=(*what.materials, material("/card", EMISSIVE=0.7)))
    planes = draw(what, 1, 1, tiers=("ray",))
    np.testing.assert_allclose(planes["beauty"][0, 0, :3], 0.7 * 0.5 ** (0.6 / 0.8), rtol=1e-4)
    assert planes["mask"][0, 0] == 1.0
    assert planes["layers"][0, 0] == 0.0


@pytest.mark.parametrize("order", [1, -1])
def test_of_two_bodies_around_the_eye_the_smaller_fills(order: int) -> None:
    """Of one priority, and in whichever order the scene names them: the eye has entered the smaller one last."""
    walls, materials = constant_room()
    around = [box("/small", (0.2, 0.2, 0.2), 1, centre=(0, 0, 1)), box("/big", (0.6, 0.6, 0.6), 2, centre=(0, 0, 1))]
    glasses = [glass(Model.TRACED, 1.0, TRANSMITTANCE=tint, absorption_distance=0.1) for tint in (0.6, 0.9)]
    lens = camera((0, 0, 1), (0, 0, -1), fov=0.01, clipping=(1e-5, 100))
    planes = draw(scene([*walls, *around[::order]], [*materials, *glasses], cameras=(lens,)), 1, 1, tiers=("ray",))
    np.testing.assert_allclose(planes["beauty"][0, 0, :3], 0.6**2 * 0.9**4, rtol=1e-3)
    np.testing.assert_allclose(planes["path_length"], 0.6, rtol=1e-4)


@pytest.mark.parametrize(("ahead", "seen"), [((1, 0, 0), 0.7), ((0, 0, -1), 1.0)], ids=["paint", "glass"])
def test_not_every_face_of_a_body_around_the_eye_must_be_glass(ahead: tuple[int, int, int], seen: float) -> None:
    """A tank, painted on the side that comes first, with a pane on the second. What fills it is the first traced glass,
    up to the paint, and up to a face of other traced glass, with a white room behind."""
    walls, materials = constant_room()
    glasses = [glass(Model.TRACED, 1.0, TRANSMITTANCE=tint, absorption_distance=0.1) for tint in (0.6, 0.9)]
    kinds = [*materials, material("/paint", EMISSIVE=0.7), glass(Model.THIN), *glasses]
    sides = np.array([1, 2, 3, 4, 3, 4], np.int32)  # +x, -x, +y, -y, +z, -z
    tank = replace(box("/tank", (0.4, 0.4, 0.4), 1, centre=(0, 0, 1)), materials=np.repeat(sides, 2))
    lens = camera((0, 0, 1), np.add((0, 0, 1), ahead), fov=0.01, clipping=(1e-5, 100))
    planes = draw(scene([*walls, tank], kinds, cameras=(lens,)), 1, 1, tiers=("ray",))
    np.testing.assert_allclose(planes["beauty"][0, 0, :3], seen * 0.6**4, rtol=1e-3)
    np.testing.assert_allclose(planes["path_length"], 0.4, rtol=1e-4)


# --- Alpha ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tiers", [("ray", "sky"), ("screen", "probe", "ray", "sky")], ids="-".join)
def test_a_picture_of_absorbing_glass_alone_lies_right_over_a_checker(tiers: tuple[str, ...]) -> None:
    """Grey glass of index 1: what it lets by of what lies behind is one minus its alpha, in both of two balls."""
    fields = [
        quad(f"/field{i}{j}", [(x, y, -3), (x + 0.7, y, -3), (x + 0.7, y + 0.7, -3), (x, y + 0.7, -3)], (i + j) % 2)
        for i, x in enumerate(np.arange(-2.81, 2.8, 0.7))
        for j, y in enumerate(np.arange(-2.83, 2.8, 0.7))
    ]
    balls = [Sphere("/one", (0.2, 0, 0), 0.6, 2), Sphere("/two", (-0.2, 0, -1.0), 0.5, 2)]
    dark, bright = material("/dark", EMISSIVE=(0.1, 0.2, 0.3)), material("/bright", EMISSIVE=(1.0, 0.7, 0.4))
    kinds = [dark, bright, tinted(1.0, 0.3)]
    backdrop = draw(scene(fields, kinds), tiers=("ray",))["beauty"]
    truth = draw(scene(fields, kinds, balls), tiers=("ray",))["beauty"]
    alone = draw(scene([], kinds, balls), tiers=tiers)
    over = alone["beauty"][..., :3] + (1 - alone["beauty"][..., 3:]) * backdrop[..., :3]
    assert alone["layers"].max() == 2
    np.testing.assert_allclose(over, truth[..., :3], atol=1e-4)


def test_clear_glass_alone_covers_what_it_mirrors_from_the_viewers_side() -> None:
    """What goes on ahead would have seen a background; what is sent back would not."""
    planes = draw(scene([slab("slab", 0.2, -0.2, 0)], [glass(Model.TRACED)], cameras=(STRAIGHT,)), 1, 1, cut=WHOLE)
    assert planes["beauty"][0, 0, 3] == pytest.approx(stacked(face(1, 1.5), face(1.5, 1)).front, rel=1e-4)


# --- Tiles and threads ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def everything() -> tuple[Scene, dict[str, F32]]:
    """A drink of glass that disperses, rough ice, a lamp, a marble and a pane, and a picture of it."""
    walls, materials, textures = checker_room()
    meshes, kinds = drinks(abbe=25.0, TRANSMITTANCE=(0.9, 0.6, 0.7))
    meshes = [replace(mesh, materials=mesh.materials + 5) for mesh in meshes]
    kinds[1] = glass(Model.TRACED, 1.31, ROUGHNESS=0.3, OPACITY=0.2, DIFFUSE=0.5, priority=1)
    pane = quad("/pane", [(-1.2, -1, 1), (0.2, -1, 1), (0.2, 1, 1), (-1.2, 1, 1)], 9)
    marble = Sphere("/marble", (0.8, -0.5, 0.6), 0.4, 10)
    lamp = light(LightKind.RECT, (0, 2, 0), (0, -1, 0), (1.0, 1.0), 2.0)
    what = scene(
        [*walls, *meshes, pane], [*materials, *kinds, glass(Model.THIN), glass(Model.SPHERE, THICKNESS=0.8)], [marble],
        textures=textures, lights=(lamp,),
    )  # fmt: skip
    return what, _drawn(what)


def _drawn(what: Scene, **change: int) -> dict[str, F32]:
    return draw(what, 45, 35, samples=2, tiers=("screen", "probe", "ray", "sky"), **change)


@pytest.mark.parametrize("change", [{"jobs": 3}, {"tile_size": 8}, {"tile_size": 20}, {"tile_size": 4096, "jobs": 2}])
def test_tiles_and_threads_change_nothing(everything: tuple[Scene, dict[str, F32]], change: dict[str, int]) -> None:
    what, planes = everything
    assert planes["layers"].max() >= 4
    again = _drawn(what, **change)
    for name, plane in planes.items():
        np.testing.assert_array_equal(again[name], plane, err_msg=name)


def test_a_ray_that_is_caught_is_let_out() -> None:
    """Light that meets every face of a box at more than 41.8 degrees never gets out by them. It comes in by a ball that
    overlaps the box: behind 128 walls it sees the room, as if there were no glass, and says that it knows nothing."""
    walls, materials = constant_room(0.75)
    what = scene(
        [*walls, box("/cube", (0.6, 0.5, 0.4), 1, turned((1, 2, 3), 40))], [*materials, glass(Model.TRACED)],
        [Sphere("/ball", (0.5, 0.4, -0.8), 0.8, 1)],
    )  # fmt: skip
    planes = draw(what, tiers=("ray",), cut=DIRECT)
    caught = (planes["mask"] > 0) & (planes["confidence"] < 0.5) & planes["refraction"].any(-1)
    assert caught.any()
    np.testing.assert_allclose(planes["beauty"][..., :3], 0.75, atol=1e-4)


# --- Lamps, which no ray meets, mirrored in glass ---------------------------------------------------------------------


def before_lamp(kind: LightKind, behind: bool, things: Sequence[Mesh], kinds: Sequence[Material]) -> F32:
    """What the middle pixel shows of a wide lamp of radiance 2, behind the camera or beyond the glass."""
    size = {LightKind.RECT: (6.0, 6.0), LightKind.DISTANT: (2.0, 0.0)}.get(kind, (3.0, 0.0))
    away = 8.0 if behind else -8.0
    lamp = light(kind, (0, 0, away), (0, 0, -away), size, 2.0)
    seen: F32 = middle(scene(things, kinds, lights=(lamp,), cameras=(STRAIGHT,)), cut=WHOLE)["beauty"][:3]
    return seen


@pytest.mark.parametrize("kind", [LightKind.RECT, LightKind.DISK, LightKind.SPHERE, LightKind.DISTANT])
def test_both_sides_of_a_slab_mirror_a_lamp(kind: LightKind) -> None:
    """Of what shines straight through none is seen, as lamps are not drawn; of what is mirrored on the way all is."""
    things, kinds = [slab("slab", 0.2, -0.2, 0)], [tinted(1.5, 0.5)]
    whole = stacked(face(1, 1.5), depth(0.5, 0.4), face(1.5, 1))
    np.testing.assert_allclose(before_lamp(kind, True, things, kinds), 2.0 * whole.front, rtol=1e-4)
    straight = face(1, 1.5).through * face(1.5, 1).through * depth(0.5, 0.4).through
    np.testing.assert_allclose(before_lamp(kind, False, things, kinds), 2.0 * (whole.through - straight), rtol=1e-4)


def test_what_stands_before_a_lamp_hides_its_mirror_picture() -> None:
    things = [slab("slab", 0.2, -0.2, 0), quad("/wall", [(-4, -4, 5), (4, -4, 5), (4, 4, 5), (-4, 4, 5)], 1)]
    seen = before_lamp(LightKind.RECT, True, things, [glass(Model.TRACED, 1.5), material("/black")])
    np.testing.assert_allclose(seen, 0.0, atol=1e-6)


def test_a_lamp_shows_in_glass_whose_prim_it_lights_alone() -> None:
    lamp = light(LightKind.RECT, (0, 0, 8.0), (0, 0, -1), (6.0, 6.0), 2.0)
    things, kinds = [slab("slab", 0.2, -0.2, 0)], [glass(Model.TRACED, 1.5)]
    for links, shows in ((None, True), (("/slab",), True), (("/other",), False)):
        linked = scene(things, kinds, lights=(replace(lamp, lit=links),), cameras=(STRAIGHT,))
        seen = middle(linked, cut=WHOLE)["beauty"][:3]
        assert (seen > 0.01).all() == shows
        assert (seen > 0.0).any() == shows
