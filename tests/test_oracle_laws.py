"""The oracle itself against closed forms: what the engine is held against must be right on its own."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import reduce
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from oracle import Oracle, Pixel
from oracle.optics import iors
from scenes import (
    ROOM,
    box,
    camera,
    constant_room,
    dome,
    glass,
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

import refract_core as rc
from refract_core.scene import Camera, Material, Mesh, Model, Scene, Sphere

WIDTH, HEIGHT = 8, 6
LENS = camera((0.3, 0.4, 2.4), fov=0.45, aspect=WIDTH / HEIGHT)
LIQUID, ICE, CUP = 1, 2, 3


def oracle_of(what: Scene, cut: float = 0.02, **settings: Any) -> Oracle:
    chosen = {"samples": 1, "tiers": ("ray", "sky"), "max_layers": 32, **settings}
    made = Oracle(what, rc.RenderSettings(image_width=WIDTH, image_height=HEIGHT, **chosen), WIDTH, HEIGHT)
    made.cut = cut
    return made


def pixels(what: Scene, cut: float = 0.02, **settings: Any) -> Iterator[Pixel]:
    oracle = oracle_of(what, cut, **settings)
    return (oracle.pixel(x, y) for y in range(HEIGHT) for x in range(WIDTH))


def middle(what: Scene, cut: float) -> dict[str, list[float]]:
    """The one pixel of a camera that looks straight at what is tested."""
    settings = rc.RenderSettings(image_width=1, image_height=1, samples=1, tiers=("ray",), max_layers=32)
    made = Oracle(what, settings, 1, 1)
    made.cut = cut
    return made.pixel(0, 0).planes


def of_each(planes: Iterable[Pixel], name: str) -> NDArray[np.float64]:
    return np.array([pixel.planes[name] for pixel in planes])


# --- White furnace: light of one radiance from everywhere is that radiance, whatever is in its way ------------------


def _drink() -> list[Mesh]:
    """A cup with a liquid that reaches into its wall, ice that floats in it, and a straw through its surface."""
    return [
        box("/liquid", (0.44, 0.3, 0.44), LIQUID, turned((0, 1, 0), 20)),
        box("/ice", (0.15, 0.15, 0.15), ICE, turned((1, 2, 3), 50), (0.1, 0.25, 0.1)),
        shell("/cup", 0.8, 0.5, CUP, 4),
        box("/straw", (0.03, 0.6, 0.03), 0, turned((0, 0, 1), 25), (-0.1, 0.3, 0.1)),
    ]


@pytest.mark.parametrize("cut", [0.005, 0.02, 0.2, 1.0])
@pytest.mark.parametrize("inputs", [{}, {"abbe": 20.0}, {"ROUGHNESS": 0.4}], ids=["clear", "dispersive", "rough"])
def test_nested_glass_in_a_white_room_is_white(cut: float, inputs: dict[str, Any]) -> None:
    walls, materials = constant_room()
    kinds = [replace(glass(Model.TRACED, n, **inputs), priority=k) for k, n in enumerate((1.33, 1.31, 1.5))]
    what = scene([*walls, *_drink()], [*materials, *kinds], cameras=(LENS,))
    assert of_each(pixels(what, cut, tiers=("ray",)), "beauty") == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("model", [Model.SPHERE, Model.BOX, Model.THIN, Model.TRACED, Model.SINGLE])
@pytest.mark.parametrize("eye", [(0.3, 0.4, 2.4), (0.05, 0.1, 0.4)], ids=["outside", "inside"])
def test_a_body_in_a_body_under_a_white_sky_is_white(model: Model, eye: tuple[float, float, float]) -> None:
    outer = Sphere("/outer", (0.0, 0.0, 0.0), 0.6, 0)
    inner = box("/inner", (0.2, 0.3, 0.15), 1, turned((1, 2, 3), 40), (0.1, 0.0, 0.0))
    lens = camera(eye, fov=0.6, aspect=WIDTH / HEIGHT, clipping=(1e-3, 100.0))
    glasses = [glass(model, 1.6, abbe=30.0), glass(Model.TRACED, 1.3)]
    what = scene([inner], glasses, [outer], environment=dome(1.0), cameras=(lens,))
    assert of_each(pixels(what), "beauty") == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("model", [Model.BOX, Model.TRACED])
def test_glass_that_stands_on_the_floor_shows_the_floor(model: Model) -> None:
    """Its bottom lies in the floor but for rounding; the ray of a typed model, let out in the middle of the real body,
    comes there in air."""
    walls, materials = constant_room()
    standing = box("/box", (0.5, 0.5, 0.5), 1, centre=(0, 0.5 + 1e-6 - ROOM, 0))
    lens = camera((0, -1.5, 1.5), (0, -2.5, 0))
    what = scene([*walls, standing], [*materials, glass(model, THICKNESS=0.2)], cameras=(lens,))
    assert of_each(pixels(what, tiers=("ray",)), "beauty") == pytest.approx(1.0, abs=1e-9)


# --- Glass of index 1 is not there ----------------------------------------------------------------------------------


@pytest.mark.parametrize("model", [Model.SPHERE, Model.BOX, Model.THIN, Model.TRACED, Model.SINGLE])
def test_glass_of_index_one_is_not_there(model: Model) -> None:
    walls, materials = position_room()
    bodies = [replace(mesh, materials=np.maximum(mesh.materials, 1)) for mesh in _drink()[:3]]
    air = replace(glass(model, 1.0, THICKNESS=0.3), priority=1)
    others = [glass(Model.TRACED, 1.0), glass(Model.TRACED, 1.0, abbe=20.0)]
    bare = scene(walls, materials, cameras=(LENS,))
    what = scene([*walls, *bodies], [*materials, air, *others], cameras=(LENS,))
    expected, found = (of_each(pixels(s, tiers=("ray",)), "beauty") for s in (bare, what))
    # Rays start beside the surfaces they leave: some 6e-6 m each, in colours a sixth of that.
    assert found == pytest.approx(expected, abs=3e-6)


# --- Slabs: the series of all internal reflections, summed ----------------------------------------------------------


def _between(slabs: Sequence[Mesh], materials: Sequence[Material], lit: int) -> Scene:
    """Slabs in a black room of which one wall shines; the camera looks straight at them."""
    walls, black = position_room()
    own = [replace(wall, materials=np.full(2, 1 if k == lit else 0, np.int32)) for k, wall in enumerate(walls)]
    of_walls = [material("/black"), material("/lit", EMISSIVE=1.0)]
    assert len(black) == 1
    lens = camera((0, 0, 2.5), aspect=1.0, fov=1e-3)
    return scene([*own, *slabs], [*of_walls, *materials], cameras=(lens,))


BEHIND_CAMERA, AHEAD = 4, 5
"""The walls at +z and -z."""


def _face(n1: float, n2: float) -> float:
    return ((n1 - n2) / (n1 + n2)) ** 2


def _added(first: tuple[float, float], second: tuple[float, float]) -> tuple[float, float]:
    """Reflectance and transmittance of two layers without interference (the adding method; Stokes 1862)."""
    (r1, t1), (r2, t2) = first, second
    return r1 + t1 * t1 * r2 / (1.0 - r1 * r2), t1 * t2 / (1.0 - r1 * r2)


def _interface(n1: float, n2: float) -> tuple[float, float]:
    return _face(n1, n2), 1.0 - _face(n1, n2)


@pytest.mark.parametrize("ior", [1.1, 1.5, 2.4])
@pytest.mark.parametrize("opacity", [0.0, 0.4])
def test_a_slab_reflects_two_f_over_one_plus_f(ior: float, opacity: float) -> None:
    """Clear; and with a face that lets only some of the light in, and shines by itself."""
    slab, f = box("/slab", (2.0, 2.0, 0.2), 2), _face(1.0, ior)
    stuff = glass(Model.TRACED, ior, OPACITY=opacity, EMISSIVE=0.3)
    back, ahead = (middle(_between([slab], [stuff], wall), 0.0) for wall in (BEHIND_CAMERA, AHEAD))
    let_in, own = 1.0 - opacity, 0.3 * opacity
    assert back["beauty"][0] == pytest.approx(f + let_in * (1.0 - f) * f / (1.0 + f) + own, abs=1e-6)
    assert ahead["beauty"][0] == pytest.approx(let_in * (1.0 - f) / (1.0 + f) + own, abs=1e-6)
    assert ahead["refraction"][0] == pytest.approx(let_in * (1.0 - f) / (1.0 + f), abs=1e-6)
    assert back["reflection"][0] == pytest.approx(f, abs=1e-6)


@pytest.mark.parametrize("card_at", [0.1, 0.7])
def test_a_typed_slab_is_as_deep_as_its_thickness(card_at: float) -> None:
    """Whatever its mesh; or as deep as what stands in it."""
    body, distance, f = box("/body", (2.0, 2.0, 1.0), 2, centre=(0, 0, -1.0)), 0.3, _face(1.0, 1.5)
    card = quad("/card", [(-1, -1, -card_at), (1, -1, -card_at), (1, 1, -card_at), (-1, 1, -card_at)], 1)
    stuff = glass(Model.BOX, 1.5, THICKNESS=0.4, TRANSMITTANCE=0.5, absorption_distance=distance)
    planes = middle(_between([body, card], [stuff], AHEAD), 0.0)
    way = min(card_at, 0.4)
    assert planes["path_length"][0] == pytest.approx(way, rel=1e-5)
    assert planes["beauty"][0] == pytest.approx((1.0 - f) * 0.5 ** (way / distance), rel=1e-5)
    assert planes["layers"] == [1.0]


def test_absorption_counts_once_a_pass() -> None:
    """Beer-Lambert on every leg of the series."""
    tint, depth, distance = (0.9, 0.5, 0.1), 0.4, 0.7
    stuff = glass(Model.TRACED, 2.0, TRANSMITTANCE=tint, absorption_distance=distance)
    slab = box("/slab", (2.0, 2.0, depth / 2), 2)
    back, ahead = (middle(_between([slab], [stuff], wall), 0.0) for wall in (BEHIND_CAMERA, AHEAD))
    for c in range(3):
        f, left = _face(1.0, 2.0), tint[c] ** (depth / distance)
        among = (1.0 - f) ** 2 / (1.0 - (f * left) ** 2)
        assert back["beauty"][c] == pytest.approx(f + among * f * left**2, rel=3e-5)
        assert ahead["beauty"][c] == pytest.approx(among * left, rel=3e-5)


@pytest.mark.parametrize("priorities", [(0, 1), (1, 0), (0, 0)], ids=["far", "near", "equal"])
def test_overlapping_slabs_are_one_stack(priorities: tuple[int, int]) -> None:
    """Where two bodies share a space, one of them fills it: three interfaces, wherever the middle one comes to lie."""
    near, far = (box("/slab", (2.0, 2.0, 0.3), k, centre=(0, 0, z)) for k, z in ((2, 0.2), (3, -0.2)))
    of = [glass(Model.TRACED, n, priority=p) for n, p in zip((1.3, 2.0), priorities, strict=True)]
    back, ahead = (middle(_between([near, far], of, wall), 1e-7) for wall in (BEHIND_CAMERA, AHEAD))
    r, t = reduce(_added, [_interface(1.0, 1.3), _interface(1.3, 2.0), _interface(2.0, 1.0)])
    assert back["beauty"][0] == pytest.approx(r, abs=1e-5)
    assert ahead["beauty"][0] == pytest.approx(t, abs=1e-5)


@pytest.mark.parametrize("priority", [-1, 0, 1])
def test_a_body_within_a_body_is_seen_unless_it_yields(priority: int) -> None:
    """A bubble of air, of lower priority than the glass around it, is not there; else it is four interfaces."""
    outer, inner = box("/outer", (2.0, 2.0, 0.6), 2), box("/bubble", (1.9, 1.9, 0.2), 3)
    skin: dict[str, Any] = {"OPACITY": 0.5, "EMISSIVE": 1.0} if priority < 0 else {}
    of = [glass(Model.TRACED, 1.8), glass(Model.TRACED, 1.0, priority=priority, **skin)]
    back, ahead = (middle(_between([outer, inner], of, wall), 1e-7) for wall in (BEHIND_CAMERA, AHEAD))
    wall = _interface(1.0, 1.8)
    r, t = reduce(_added, [wall, wall, wall, wall] if priority >= 0 else [wall, wall])
    assert back["beauty"][0] == pytest.approx(r, abs=1e-5)
    assert ahead["beauty"][0] == pytest.approx(t, abs=1e-5)
    assert ahead["layers"] == [1.0 if priority < 0 else 2.0]


def test_what_is_cut_is_not_lost() -> None:
    """At a cut of 1 every ray goes on as one, with all of the light: the front wall and nothing else."""
    slab = box("/slab", (2.0, 2.0, 0.2), 2)
    ahead = middle(_between([slab], [glass(Model.TRACED, 1.5)], AHEAD), 1.0)
    assert ahead["beauty"][0] == pytest.approx(1.0, abs=1e-12)
    assert ahead["path_length"][0] == pytest.approx(0.4, rel=1e-5)
    assert ahead["layers"] == [1.0]
    assert ahead["weight.ray"] == [1.0]


# --- The eye in a medium --------------------------------------------------------------------------------------------


def _sea(lens: Camera, **inputs: Any) -> Scene:
    walls, materials = position_room()
    water = box("/water", (2.0, 1.0, 2.0), 1, centre=(0, -1.0, 0))
    return scene([*walls, water], [*materials, glass(Model.TRACED, **inputs)], cameras=(lens,))


@pytest.mark.parametrize("abbe", [0.0, 15.0])
def test_snells_window(abbe: float) -> None:
    """From under water, upwards: the world above in a cone of asin(1 / n), around it the mirrored ground; a channel at
    a time where the water disperses."""
    lens = camera((0.1, -0.8, 0.2), (0.1, 1.0, 0.21), fov=1.4, aspect=WIDTH / HEIGHT, clipping=(1e-4, 100.0))
    made = oracle_of(_sea(lens, ior=1.33, abbe=abbe), cut=1.0, tiers=("ray",))
    origins, directions = view_rays(lens, WIDTH, HEIGHT)
    up = np.array([0.0, 1.0, 0.0])
    seen = {True: 0, False: 0}
    for y in range(HEIGHT):
        for x in range(WIDTH):
            o, d = origins[y, x], directions[y, x]
            surface = o + d * (0.0 - o[1]) / d[1]
            if max(abs(surface[0]), abs(surface[2])) > 2.0:
                continue
            out = [snell(d, -up, n) for n in iors(1.33, abbe)]
            planes = made.pixel(x, y).planes
            assert planes["mask"] == [1.0]
            if all(way is None for way in out):
                seen[False] += 1
                assert sum(planes["refraction"]) == 0.0
                continue
            for c, way in enumerate(out):
                if way is not None:
                    seen[True] += 1
                    place = wall_hit(surface, way)[c]
                    assert where(np.array(planes["refraction"]))[c] == pytest.approx(place, abs=1e-4)
            if all(way is not None for way in out):
                assert sum(planes["reflection"]) == 0.0
    assert min(seen.values()) >= 8


def test_the_eye_sees_what_is_with_it_in_the_water() -> None:
    """The first thing met is none of the water's own surface."""
    lens = camera((0.0, -1.0, 1.0), (0.0, -1.0, 0.0), fov=1e-3, clipping=(1e-7, 100.0))
    sea = _sea(lens, ior=1.33, TRANSMITTANCE=0.5, absorption_distance=0.8)
    card = quad("/card", [(-1, -2, 0.4), (1, -2, 0.4), (1, 0, 0.4), (-1, 0, 0.4)], len(sea.materials))
    what = replace(sea, meshes=(*sea.meshes, card), materials=(*sea.materials, material("/card", EMISSIVE=0.7)))
    planes = middle(what, 0.02)
    left = 0.5 ** (0.6 / 0.8)
    assert planes["beauty"] == pytest.approx([0.7 * left] * 3 + [1.0], rel=1e-5)
    assert planes["refraction"] == pytest.approx([0.7 * left] * 3, rel=1e-5)
    assert planes["transmittance"] == pytest.approx([left] * 3, rel=1e-5)
    assert planes["path_length"] == pytest.approx([0.6], rel=1e-5)
    assert (planes["mask"], planes["layers"], planes["weight.ray"]) == ([1.0], [0.0], [1.0])


@pytest.mark.parametrize("orthographic", [False, True])
def test_what_the_eye_is_in_absorbs_from_the_eye_on(orthographic: bool) -> None:
    """Found around a perspective eye; for an orthographic one, by the wall that its rays meet first from inside."""
    lens = camera(
        (0.1, -0.8, 0.2), (0.3, -0.9, -3.0), fov=0.1, aspect=WIDTH / HEIGHT, clipping=(1e-7, 100.0),
        orthographic=orthographic,
    )  # fmt: skip
    stuff = {"ior": 1.0, "TRANSMITTANCE": 0.5, "absorption_distance": 0.8}
    seas = _sea(lens, ior=1.0), _sea(lens, **stuff)
    clear, found = (of_each(pixels(sea, tiers=("ray",)), "beauty")[:, :3] for sea in seas)
    origins, directions = view_rays(lens, WIDTH, HEIGHT)
    way = ((-2.0 - origins[..., 2]) / directions[..., 2]).reshape(-1)
    assert found == pytest.approx(clear * 0.5 ** (way / 0.8)[:, None], rel=1e-5)


# --- Alpha, and the data beside the picture -------------------------------------------------------------------------


def test_clear_glass_in_nothing_hides_what_it_mirrors_back() -> None:
    """There is no light, and no background but ahead: alpha is the share of light that comes from behind the camera."""
    ball = Sphere("/ball", (0.0, 0.0, 0.0), 0.5, 0)
    what = scene([quad("/far", [(5, 5, 5), (6, 5, 5), (6, 6, 5), (5, 6, 5)], 1)], [glass(Model.TRACED), material("/m")],
                 [ball], cameras=(LENS,))  # fmt: skip
    found = list(pixels(what))
    assert any(pixel.planes["mask"] == [1.0] for pixel in found)
    planes = of_each(found, "beauty")
    assert planes[:, :3] == pytest.approx(0.0, abs=0.0)
    assert (planes[:, 3] >= 0.0).all()
    assert planes[:, 3].max() <= 1.0
    straight = camera((0.0, 0.0, 2.4), fov=1e-3, aspect=1.0)
    f = _face(1.0, 1.7)
    # Front and back mirror the middle ray; what the back has mirrored, the front lets out whole, being below the cut.
    alpha = middle(scene([], [glass(Model.TRACED, 1.7)], [ball], cameras=(straight,)), 0.02)["beauty"][3]
    assert alpha == pytest.approx(f + (1.0 - f) * f, abs=1e-6)


def test_index_one_over_a_checker_is_the_checker_by_its_alpha() -> None:
    """Absorbing glass of index 1, drawn over nothing: what it lets by of what lies behind is one minus its alpha."""
    tint = 0.6
    body = box("/body", (0.5, 0.5, 0.1), 0)
    stuff = glass(Model.TRACED, 1.0, TRANSMITTANCE=tint, absorption_distance=0.2)
    lens = camera((0, 0, 2.5), orthographic=True, fov=0.3, aspect=WIDTH / HEIGHT)
    alone = middle(scene([body], [stuff], cameras=(lens,)), 0.02)
    assert alone["beauty"] == pytest.approx([0.0, 0.0, 0.0, 1.0 - tint], abs=1e-5)
    assert alone["weight.none"] == [1.0]
    assert alone["transmittance"] == pytest.approx([tint] * 3, abs=1e-5)


def test_shares_of_the_tiers_are_means_over_what_goes_through() -> None:
    """Half of a ball's rays end on a floor, the others in the sky; every pixel's shares sum to one."""
    floor = quad("/floor", [(-9, -0.6, 9), (9, -0.6, 9), (9, -0.6, -9), (-9, -0.6, -9)], 1)
    ball = Sphere("/ball", (0.0, 0.0, 0.0), 0.5, 0)
    what = scene([floor], [glass(Model.TRACED, 1.7), material("/floor", DIFFUSE=0.5)], [ball], environment=dome(0.5),
                 cameras=(LENS,))  # fmt: skip
    met = [pixel.planes for pixel in pixels(what, 0.002) if pixel.planes["mask"] == [1.0]]
    names = [f"weight.{tier}" for tier in ("screen", "ray", "probe", "sky", "none")]
    assert [sum(planes[name][0] for name in names) for planes in met] == pytest.approx([1.0] * len(met), abs=1e-9)
    assert any(0.01 < planes["weight.ray"][0] < 0.99 for planes in met)
    assert all(math.isclose(planes["confidence"][0], 1.0, abs_tol=1e-9) for planes in met)
