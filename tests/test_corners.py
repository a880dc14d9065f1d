"""Pixels made from their corners, and quiet light: closed forms, and the picture of many samples as a second opinion
(docs/decisions/corners.md).

`PLAIN` draws the latter: every sample of every pixel, without corners. What is compared with it is the whole of it, so
the bounds here are those of what the eye sees, not of rounding; where light has a closed form, that is what counts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from random_scenes import random_scene
from scenes import (
    ROOM,
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
    surrounding,
    turned,
    view_rays,
    wall_hit,
)

import refract_core as rc
from refract_core.scene import (
    Channel,
    Environment,
    LightKind,
    Material,
    Mesh,
    Model,
    Scene,
    Source,
    Sphere,
    Texture,
    Volume,
)
from refract_core.settings import named_settings

pytestmark = pytest.mark.draws

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

GOOD: dict[str, Any] = {"samples": 16, "tolerance": 0.03, "light_samples": 16}
FINE: dict[str, Any] = {"samples": 64, "tolerance": 0.005, "light_samples": 64}
PLAIN: dict[str, Any] = {"samples": 256, "tolerance": 0.0}
WHITE = material("/white", DIFFUSE=1.0)
FLOOR = [(-50, 0, 50), (50, 0, 50), (50, 0, -50), (-50, 0, -50)]
WEIGHTS = ("weight.screen", "weight.ray", "weight.probe", "weight.sky", "weight.none")


def rms(of: ArrayLike) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(of, np.float64)))))


def shown(picture: dict[str, F32]) -> F64:
    """About how bright it is to the eye, which is what a tolerance is of."""
    return np.sqrt(np.clip(picture["beauty"][..., :3].astype(np.float64), 0.0, 1.0))


def off(a: dict[str, F32], b: dict[str, F32], here: Any = np.s_[:]) -> float:
    """How far pictures are apart to the eye."""
    return rms((shown(a) - shown(b))[here])


# --- Coverage ---------------------------------------------------------------------------------------------------------


def clipped(polygon: F64, axis: int, sign: float, at: float) -> F64:
    """The part of a convex polygon on one side of a line across an axis (Sutherland and Hodgman 1974)."""
    kept = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        da, db = sign * (a[axis] - at), sign * (b[axis] - at)
        if da >= 0:
            kept.append(a)
        if (da >= 0) != (db >= 0):
            kept.append(a + (b - a) * (da / (da - db)))
    return np.array(kept).reshape(-1, 2)


def area(polygon: F64) -> float:
    if len(polygon) < 3:
        return 0.0
    x, y = polygon.T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def coverage(polygon: F64, size: int) -> F64:
    """Share of every pixel of a window from -1 to 1 that a convex polygon covers."""
    edges = np.linspace(-1, 1, size + 1)
    found = np.zeros((size, size))
    for j in range(size):
        strip = clipped(clipped(polygon, 1, 1.0, edges[j]), 1, -1.0, edges[j + 1])
        for i in range(size if len(strip) else 0):
            part = clipped(clipped(strip, 0, 1.0, edges[i]), 0, -1.0, edges[i + 1]) if len(strip) else strip
            found[size - 1 - j, i] = area(part) / (edges[1] - edges[0]) ** 2
    return found


def cards(seed: int) -> tuple[F64, Scene]:
    """A shining polygon of four corners before nothing, and the scene of it."""
    angles = np.random.default_rng(seed).uniform(0.15, 0.85, 4) * math.pi / 2 + np.arange(4) * math.pi / 2
    polygon = 0.85 * np.stack([np.cos(angles), np.sin(angles)], 1)
    card = quad("/card", [(x, y, 0.0) for x, y in polygon])
    flat = camera(orthographic=True, fov=1.0)
    return polygon, scene([card], [material("/shining", EMISSIVE=0.9)], cameras=(flat,))


@pytest.mark.parametrize("seed", range(4))
def test_an_edge_covers_what_it_covers(seed: int) -> None:
    """Light and alpha of every pixel against the area of the polygon in it; and the sum of it all to half a pixel.
    Evenly spread samples of a straight edge are off by less than one of the strips that they stand in."""
    polygon, what = cards(seed)
    expected = coverage(polygon, 24)
    assert ((expected > 0) & (expected < 1)).sum() > 40
    picture = draw(what, 24, 24, **GOOD)
    np.testing.assert_allclose(picture["beauty"][..., 0], 0.9 * picture["beauty"][..., 3], atol=1e-6)
    alpha = picture["beauty"][..., 3]
    inside = (expected == 0) | (expected == 1)
    np.testing.assert_allclose(alpha[inside], expected[inside], atol=1e-6)
    assert np.abs(alpha - expected).max() < 0.2
    assert rms((alpha - expected)[~inside]) < 0.07
    assert abs(float((alpha - expected).sum())) < 1.0


def test_more_samples_draw_edges_better() -> None:
    """At least by the root of their number, over 256 pixels of edges."""
    errors = []
    for samples in (4, 16, 64):
        apart = []
        for seed in range(4):
            polygon, what = cards(seed)
            apart.append(draw(what, 24, 24, **{**GOOD, "samples": samples})["beauty"][..., 3] - coverage(polygon, 24))
        errors.append(rms(apart))
    assert errors[1] < 0.55 * errors[0]
    assert errors[2] < 0.55 * errors[1]


def test_where_there_is_no_glass_nothing_is_refracted_or_reflected() -> None:
    """At edges neither: all that a pixel says of glass is 0."""
    picture = draw(cards(0)[1], 24, 24, **GOOD)
    for name in ("refraction", "reflection", "mask", "transmittance", "path_length", "layers", *WEIGHTS):
        assert (picture[name] == 0.0).all(), name


@pytest.mark.parametrize("settings", [GOOD, FINE], ids=["good", "fine"])
def test_of_light_that_passes_glass_one_part_went_through_and_the_other_was_mirrored(settings: dict[str, Any]) -> None:
    """Refraction and reflection are all of the light where glass fills the pixel, and at its rim what the samples that
    met it have seen: never more than the pixel has."""
    walls, materials, textures = checker_room()
    what = scene([*walls, TURNED], [*materials, glass(Model.TRACED)], textures=textures)
    picture = draw(what, 32, 32, **settings)
    both, beauty, mask = picture["refraction"] + picture["reflection"], picture["beauty"][..., :3], picture["mask"]
    whole, rim = mask == 1.0, (mask > 0.0) & (mask < 1.0)
    assert whole.sum() > 100
    assert rim.sum() > 40
    np.testing.assert_allclose(both[whole], beauty[whole], atol=1e-5)
    assert (both[rim] <= beauty[rim] + 1e-5).all()
    # Light in this room is at most 1, so what sees no glass brings at most its share of the pixel.
    assert (both[rim] >= beauty[rim] - (1.0 - mask[rim])[:, None] - 1e-5).all()
    total = sum(picture[name].astype(np.float64) for name in WEIGHTS)
    np.testing.assert_allclose(np.asarray(total)[mask > 0.0], 1.0, atol=1e-5)


TURNED = box("/turned", (0.5, 0.6, 0.4), 6, turned((1, 2, 3), 40))


@pytest.mark.parametrize("settings", [GOOD, FINE], ids=["good", "fine"])
def test_what_an_eye_in_glass_sees_came_through_it(settings: dict[str, Any]) -> None:
    """A card in the glass that the eye is in: its light is refracted light, though no interface was met."""
    around = box("/around", (3.0, 3.0, 3.0), 1, centre=(0, 0, 2.0))
    card = quad("/card", [(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)])
    what = scene([card, around], [material("/shining", EMISSIVE=0.7), glass(Model.TRACED)])
    picture = draw(what, 8, 8, **settings)
    assert (picture["mask"] == 1.0).all()
    np.testing.assert_allclose(picture["refraction"], 0.7, atol=1e-6)
    np.testing.assert_allclose(picture["beauty"][..., :3], 0.7, atol=1e-6)


# --- What textures do -------------------------------------------------------------------------------------------------


def place_of(picture: dict[str, F32]) -> F64:
    return (picture["beauty"][..., :3].astype(np.float64) * 2 - 1) * ROOM


@pytest.mark.parametrize("glassy", [False, True], ids=["seen", "through clear glass"])
@pytest.mark.parametrize("slant", [0.0, 1.0], ids=["facing", "slanted"])
def test_a_ramp_is_its_middle_in_every_pixel(slant: float, glassy: bool) -> None:
    """The mean of what is linear is its value in the middle: exact for parallel rays, also across the diagonals of the
    walls. Colours change by a tenth from pixel to pixel, so that it is looked at between the corners."""
    walls, materials = position_room()
    lens = camera((0.2, slant, 1.8), (0, 0, 0), fov=0.9, orthographic=True)
    pane = box("/pane", (2.4, 2.4, 0.1), 1, turned((1, 0, 0), -30), (0, 0, 0.4))
    what = scene([*walls, pane] if glassy else walls, [*materials, glass(Model.TRACED, 1.0)], cameras=(lens,))
    picture = draw(what, 12, 12, **GOOD)
    expected = wall_hit(*view_rays(lens, 12, 12))
    nearly = wall_hit(*view_rays(lens, 12 * 64, 12 * 64))
    corners = [nearly[j::64, i::64] for j in (0, 63) for i in (0, 63)]
    flat = np.all([np.abs(c).argmax(-1) == np.abs(expected).argmax(-1) for c in corners], axis=0)
    assert flat.mean() > 0.7
    assert (picture["mask"] > 0.0).all() == glassy
    np.testing.assert_allclose(place_of(picture)[flat], expected[flat], atol=2e-5)


def stripes(count: int) -> Texture:
    """Black and white along u, 32 texels each."""
    u = np.arange(count * 32) // 32 % 2
    return Texture("stripes", np.broadcast_to(u[None, :, None], (8, len(u), 4)).astype(np.float32))


@pytest.mark.parametrize("degrees", [0.0, 45.0, 70.0])
def test_stripes_are_the_share_of_white_in_a_pixel(degrees: float) -> None:
    """Seen from a slant, too, where a pixel is up to three times as long as wide. A tap is half as wide as its cell of
    at least 2 x 2, so an edge of two stripes is off by less than an eighth of what is in a pixel."""
    turn = turned((0, 1, 0), degrees)
    wall = quad("/wall", np.array([(-4, -4, 0), (4, -4, 0), (4, 4, 0), (-4, 4, 0)]) @ turn.T)
    painted = material("/painted", EMISSIVE=Source(texture=0, uv_primvar="st"))
    what = scene([wall], [painted], textures=(stripes(16),), cameras=(camera((0, 0, 9), fov=1.2, orthographic=True),))
    size = 32
    edges = np.linspace(-1.2, 1.2, size + 1) / math.cos(math.radians(degrees))

    def white(x: F64) -> F64:
        """Integral of the stripes, each 0.5 wide, from the wall's left border."""
        k = np.floor((x + 4) / 0.5)
        return np.asarray(np.floor(k / 2) * 0.5 + np.where(k % 2 == 1, x + 4 - 0.5 * k, 0.0))

    expected = np.diff(white(edges)) / np.diff(edges)
    picture = draw(what, size, size, **GOOD)["beauty"][..., 0]
    assert np.abs(picture - expected).max() < 0.125
    assert rms(picture - expected) < 0.05


def test_a_checker_through_a_ball_is_drawn_as_by_many_samples() -> None:
    """Clear glass in a checkered room: to 30 dB, at least 10 dB above the picture of one sample."""
    walls, materials, textures = checker_room()
    what = scene(walls, [*materials, glass(Model.TRACED)], [Sphere("/ball", (0, 0, 0), 0.8, 6)], textures=textures)
    truth, mine, single = (draw(what, 32, 32, **k) for k in (PLAIN, GOOD, {"samples": 1}))
    here = truth["mask"] == 1.0
    assert here.sum() > 200
    error = rms((mine["beauty"] - truth["beauty"])[here])
    assert error < 10 ** (-30 / 20)
    assert error < 10 ** (-10 / 20) * rms((single["beauty"] - truth["beauty"])[here])


def test_stripes_that_run_into_the_distance_are_grey_there() -> None:
    """A floor seen edge-on, striped across: a pixel that three periods or more run through differs from their mean by
    less than a twelfth of black and white, whatever stripes its corners happen to stand on."""
    pixels = np.zeros((16, 16, 4), np.float32)
    pixels[:8] = 1.0
    pixels[..., 3] = 1.0
    stripes = material("/stripes", EMISSIVE=Source(texture=0, channel=Channel.RGB, uv_primvar="st"), IOR=1.0)
    floor = quad("/floor", [(-400, 0, 0), (400, 0, 0), (400, 0, -800), (-400, 0, -800)])
    floor = replace(floor, primvars={"st": floor.primvars["st"] * np.float32(800.0)})  # of a metre each
    size = 64
    slope = 0.2 * (2.0 * (np.arange(size + 1)) / size - 1.0)  # of the rays through the edges of rows, downwards
    for height in np.linspace(0.8, 1.4, 13):
        lens = camera((0, height, 0), (0, height, -1), 0.2)
        what = scene([floor], [stripes], textures=(Texture("stripes", pixels),), cameras=(lens,))
        seen = draw(what, size, size, **GOOD)["beauty"][..., 0].astype(np.float64)
        depth = height / np.maximum(slope, 1e-6)
        run = depth[:-1] - depth[1:]
        far = (run >= 3.0) & (depth[:-1] < 700.0)
        assert far.sum() >= 5
        assert np.abs(seen[far] - 0.5).max() < 1.0 / 12.0 + 0.02


# --- Quiet light ------------------------------------------------------------------------------------------------------


def above(x: float, fov: float) -> Any:
    """Looks straight down at the floor from under the things that cast shadows."""
    return camera((x, 0.9, 0), (x, 0, 0), fov=fov, orthographic=True)


@pytest.mark.parametrize(
    ("light_samples", "worst", "mean"), [(16, 0.09, 0.02), (64, 0.045, 0.01)], ids=["16 rays", "64 rays"]
)
def test_an_endless_wall_hides_half_its_angle_of_the_sky(light_samples: int, worst: float, mean: float) -> None:
    """Under an even sky a floor gets (1 + cos t) / 2 before a wall that is t high (Nusselt's analogue). A cell is
    filled if its corners differ by 0.09 or less, so nothing may be farther off."""
    wall = quad("/wall", [(0, 0, 500), (0, 0, -500), (0, 1, -500), (0, 1, 500)])
    lens = camera((1.2, 3, 0), (1.2, 0, 0), fov=1.0, orthographic=True)
    what = scene([quad("/floor", FLOOR), wall], [WHITE], environment=dome(1.0), cameras=(lens,))
    picture = draw(what, 40, 40, **{**GOOD, "light_samples": light_samples})
    expected = 0.5 + 0.5 * np.cos(np.arctan2(1.0, picture["P"][..., 0]))
    error = picture["beauty"][..., 0] - expected
    assert np.abs(error).max() < worst
    assert rms(error) < mean


def test_a_corner_of_walls_leaves_a_quarter_of_the_sky() -> None:
    """Beside two endless walls that stand at right angles: half of the half."""
    a = quad("/a", [(0, 0, 90), (0, 0, 0), (0, 90, 0), (0, 90, 90)])
    b = quad("/b", [(0, 0, 0), (90, 0, 0), (90, 90, 0), (0, 90, 0)])
    ground = quad("/floor", [(0, 0, 50), (50, 0, 50), (50, 0, 0), (0, 0, 0)])
    lens = camera((0.3, 0.9, 0.3), (0.3, 0, 0.3), fov=0.25, orthographic=True)
    what = scene([ground, a, b], [material("/matt", DIFFUSE=0.8)], environment=dome(1.0), cameras=(lens,))
    picture = draw(what, 24, 24, **GOOD)["beauty"][..., 0]
    assert np.abs(picture / 0.8 - 0.25).max() < 0.09
    assert picture.mean() / 0.8 == pytest.approx(0.25, abs=0.01)


def test_light_that_nothing_stands_before_has_no_noise() -> None:
    """An open floor under a panel and an even sky: the sum of both, the panel's by quadrature. Under any sky the
    same picture comes of one ray and of sixteen."""
    panel = light(LightKind.RECT, (0.2, 2, 0), (0, -1, 0), (1.0, 0.6), 3.0)
    uneven = Environment(np.random.default_rng(5).uniform(0.2, 1.0, (8, 16, 3)).astype(np.float32))
    lens = above(0.1, 0.5)
    even, once, often = (
        draw(scene([quad("/floor", FLOOR)], [WHITE], lights=(panel,), environment=sky, cameras=(lens,)), 16, 16,
             **{**GOOD, "light_samples": rays})
        for sky, rays in ((dome(0.4), 1), (uneven, 1), (uneven, 16))
    )  # fmt: skip
    np.testing.assert_allclose(often["beauty"], once["beauty"], rtol=1e-6)
    u, v = np.meshgrid((np.arange(100) + 0.5) / 100 - 0.5, (np.arange(60) + 0.5) / 60 * 0.6 - 0.3)
    for i, j in ((0, 0), (8, 8), (3, 12)):
        x, _, z = even["P"][j, i].astype(np.float64)
        squared = (u + 0.2 - x) ** 2 + 4.0 + (v - z) ** 2
        expected = 0.4 + 3.0 * float((4.0 / squared**2).mean()) * 0.6 / math.pi
        assert even["beauty"][j, i, 0] == pytest.approx(expected, rel=1e-3)


def disk_share(x: F64) -> F64:
    """Share of a unit disk to one side of a line at the distance x from its middle."""
    x = np.clip(x, -1, 1)
    return np.asarray(0.5 + (x * np.sqrt(1 - x * x) + np.arcsin(x)) / math.pi)


def half_shadow(lamp: Any, fov: float, at: float = 0.0, **settings: Any) -> tuple[F64, F64]:
    """Places along x around `at`, and the share of a lamp that is seen past a straight edge one metre above the floor
    at x = 0."""
    card = quad("/card", [(-30, 1, 30), (0, 1, 30), (0, 1, -30), (-30, 1, -30)])
    lens = above(at, fov)
    floor = quad("/floor", FLOOR)
    open_, hidden = (
        draw(scene(things, [WHITE], lights=(lamp,), cameras=(lens,)), 48, 48, **{**GOOD, **settings})
        for things in ([floor], [floor, card])
    )
    share = hidden["beauty"][..., 0].astype(np.float64) / open_["beauty"][..., 0]
    return hidden["P"][0, :, 0].astype(np.float64), share


SUN = light(LightKind.DISTANT, (0, 9, 0), (0, -1, 0), (0.2, 0.0), 30.0)
"""Its radius is 0.1."""
PANEL = light(LightKind.RECT, (0, 6, 0), (0, -1, 0), (0.3, 0.3), 50.0)
HALF_SHADOWS: list[tuple[Any, float, Callable[[F64], F64]]] = [
    (SUN, 0.15, lambda x: disk_share(x / math.tan(0.1))),
    (PANEL, 0.05, lambda x: np.clip(0.5 + x * 5 / 0.3, 0, 1)),
]


@pytest.mark.parametrize(("lamp", "fov", "share"), HALF_SHADOWS, ids=["sun", "panel"])
def test_a_half_shadow_is_the_share_of_the_lamp_that_is_seen(
    lamp: Any, fov: float, share: Callable[[F64], F64]
) -> None:
    """Past a straight edge. Where nearly all is seen 25 neighbours may find no doubt, so there it is off by a share
    that so many do not find; between, rays find it, four times as many twice as well or better."""
    errors = []
    for rays in (16, 64):
        x, found = half_shadow(lamp, fov, light_samples=rays)
        expected = share(x)
        between = (expected > 0.2) & (expected < 0.8)
        assert between.sum() > 8
        assert np.abs(found - expected).max() < 0.12
        apart = x[1] - x[0]
        for near, worst in ((3.0, 1e-5), (1.0, 0.01)):  # places take the mean with those two pixels from them
            steady = (share(x - near * apart) == share(x + near * apart)) & ((expected == 0) | (expected == 1))
            assert steady.sum() > 4
            assert np.abs(found - expected)[:, steady].max() < worst
        np.testing.assert_allclose(found.mean(0), expected, atol=0.03)
        errors.append(rms((found - expected)[:, between]))
    assert errors[0] < 0.05
    assert errors[1] < 0.5 * errors[0]


def test_a_half_shadow_of_four_pixels_is_found_wherever_it_falls() -> None:
    """Cells of eight pixels are asked in their corners; between them, too, no place is black or white by chance."""
    pixel = 0.06 / 4
    for shift in range(0, 8, 2):
        x, found = half_shadow(PANEL, 24 * pixel, shift * pixel)
        expected = np.clip(0.5 + x * 5 / 0.3, 0, 1)
        assert ((expected > 0.1) & (expected < 0.9)).sum() in (3, 4)
        assert np.abs(found - expected).max() < 0.2
        np.testing.assert_allclose(found.mean(0), expected, atol=0.03)


def test_a_wide_half_shadow_and_a_sky_half_hidden_have_no_grain() -> None:
    """Past an edge, below a panel as wide as it hangs high, and under a sky that is bright at the zenith: at `good`
    next neighbours differ by little, and the picture is that of 64 times as many rays."""
    panel = light(LightKind.RECT, (0, 3, 0), (0, -1, 0), (3.0, 3.0), 1.0)
    card = quad("/card", [(-30, 1, 30), (0, 1, 30), (0, 1, -30), (-30, 1, -30)])
    zenith = np.full((16, 32, 3), 0.2, np.float32)
    zenith[:2] = 4.0
    for lit, off, apart in (({"lights": (panel,)}, 0.012, 0.008), ({"environment": Environment(zenith)}, 0.05, 0.03)):
        what = scene([quad("/floor", FLOOR), card], [WHITE], cameras=(above(0.0, 0.5),), **lit)
        few, many = (draw(what, 64, 64, **{**GOOD, "light_samples": rays})["beauty"][..., 0] for rays in (16, 1024))
        assert np.ptp(many) > many.mean()
        error = (few - many) / many.mean()
        assert abs(error.mean()) < 0.005
        assert rms(error) < off
        assert rms(error[:, 1:] - error[:, :-1]) < apart


@pytest.mark.parametrize("kind", [LightKind.RECT, LightKind.DISK])
def test_the_last_of_a_light_fades_into_the_dark(kind: LightKind) -> None:
    """Past a slanting edge, where nearly all of a wide light is hidden: by quadrature over what is left of it. The
    finders' single rays miss its last twentieth or hit it by chance, and left ragged borders of that height."""
    n, half, turn = 200, 1.5, turned((0, 1, 0), 33)
    panel = light(kind, (0, 3, 0), (0, -1, 0), (2.0 * half, 2.0 * half) if kind is LightKind.RECT else (half, 0.0), 1.0)
    card = quad("/card", np.array([(-30, 1, 30), (0, 1, 30), (0, 1, -30), (-30, 1, -30)]) @ turn.T)
    middle = turn @ (-0.47 * half, 0.9, 0.0)
    lens = camera(middle, middle * (1, 0, 1), fov=0.3 * half, orthographic=True)
    lit, free = (
        draw(scene([quad("/floor", FLOOR), *things], [WHITE], lights=(panel,), cameras=(lens,)), 64, 64, **GOOD)
        for things in ([card], [])
    )
    found = lit["beauty"][::7, :, 0] / free["beauty"][::7, :, 0]
    u, v = np.meshgrid(*[(np.arange(n) + 0.5) / n * 2.0 - 1.0] * 2)
    on = np.ones((n, n), bool) if kind is LightKind.RECT else u * u + v * v < 1.0
    points = np.stack([half * u[on], np.full(on.sum(), 3.0), half * v[on]], -1)
    expected = np.empty_like(found)
    for at in np.ndindex(found.shape):
        p = lit["P"][7 * at[0], at[1]].astype(np.float64)
        worth = ((points - p) ** 2).sum(1) ** -2.0
        seen = (points @ turn)[:, 0] > -2.0 * (p @ turn)[0]  # the edge, as the place sees it at the light's height
        expected[at] = worth[seen].sum() / worth.sum()
    deep = expected < 0.05
    assert 50 < (expected[deep] > 0.005).sum() < deep.sum()
    assert abs((found - expected).mean()) < 0.0015
    assert rms((found - expected)[deep]) < 0.004


@pytest.mark.parametrize("kind", [LightKind.RECT, LightKind.DISK])
def test_a_light_seen_through_a_slit_is_seen_everywhere(kind: LightKind) -> None:
    """Its rim is hidden from two sides, and a tenth of it is seen: at most one place of a hundred finds nothing."""
    half, turn = 1.5, turned((0, 1, 0), 20)
    panel = light(kind, (0, 3, 0), (0, -1, 0), (2.0 * half, 2.0 * half) if kind is LightKind.RECT else (half, 0.0), 1.0)
    cards = [
        quad(f"/card{side}", np.array([(x, 1, 30), (x + 30, 1, 30), (x + 30, 1, -30), (x, 1, -30)]) @ turn.T)
        for side, x in enumerate((0.04, -30.04))
    ]
    lens = camera((0, 0.9, 0), (0, 0, 0), fov=0.2, orthographic=True)
    lit, free = (
        draw(scene([quad("/floor", FLOOR), *things], [WHITE], lights=(panel,), cameras=(lens,)), 64, 64, **GOOD)
        for things in (cards, [])
    )
    found = lit["beauty"][..., 0] / free["beauty"][..., 0]
    assert 0.08 < found.mean() < 0.12
    assert (found < 0.1 * found.mean()).mean() < 0.01


def test_a_sharp_shadow_is_as_sharp_as_its_pixels() -> None:
    """A lamp without size behind a straight edge: a step, whose one column of pixels in between has its share of it."""
    x, found = half_shadow(light(LightKind.DISTANT, (0, 9, 0), (0, -1, 0), (0.0, 0.0), 1.0), 0.1)
    lit = np.clip(x * 48 / 0.2 + 0.5, 0, 1)
    apart = np.abs(found - lit)
    assert apart[:, np.abs(x) > 0.2 / 48].max() < 1e-5
    assert apart.max() <= 0.5 + 1e-5


def test_the_shadow_of_a_rod_two_pixels_wide_is_found() -> None:
    """All of it, and no more: the rod takes its width out of the light of the floor."""
    size, fov = 48, 0.6
    pixel = 2 * fov / size
    turn = turned((0, 1, 0), 20)
    rod = quad("/rod", np.array([(-pixel, 1, 9), (pixel, 1, 9), (pixel, 1, -9), (-pixel, 1, -9)]) @ turn.T)
    for width, settings in ((0.0, GOOD), (0.02, GOOD), (0.02, FINE)):
        lamp = light(LightKind.DISTANT, (0, 9, 0), (0, -1, 0), (width, 0.0), 1.0 if width == 0.0 else 3000.0)
        what = [scene(things, [WHITE], lights=(lamp,), cameras=(above(0.0, fov),))
                for things in ([quad("/floor", FLOOR), rod], [quad("/floor", FLOOR)])]  # fmt: skip
        dark, lit = (draw(one, size, size, **settings)["beauty"][..., 0] for one in what)
        lost = (1.0 - dark / lit)[size // 4 : -size // 4]
        across = 2.0 / math.cos(math.radians(20))
        assert lost.sum(1).mean() == pytest.approx(across, rel=0.03)
        assert np.abs(lost.sum(1) - across).max() < 0.6
        assert lost.max() > 0.9


BLUE = np.array([0.05, 0.1, 0.25])


def sunny(things: Sequence[Mesh], lens: Any, sun: float) -> Scene:
    """A white floor under a blue sky in which four texels of 128 x 64 are a yellow sun, far up."""
    sky = np.full((64, 128, 3), BLUE, np.float32)
    sky[10:12, 40:42] = sun * np.array([1.2, 1.0, 0.4])
    floor = quad("/floor", FLOOR)
    kinds = [material("/floor", DIFFUSE=0.8), material("/black")]
    return scene([floor, *things], kinds, environment=Environment(sky), cameras=(lens,))


@pytest.mark.parametrize(
    ("settings", "sun"),
    [
        ((GOOD, FINE), 40.0), ((GOOD, FINE), 400.0),
        (({"samples": 64, "tolerance": 0.0},), 400.0),
    ],
    ids=["40", "400", "400, without corners"],
)  # fmt: skip
def test_where_the_sun_of_a_sky_is_hidden_the_rest_of_the_sky_is_left(settings: Any, sun: float) -> None:
    """In the middle of a card's shadow: the sky's own light, in its colour, over the half space, less what the card
    hides of it (by quadrature over the card)."""
    half = 0.15
    card = quad("/card", [(-half, 1, half), (half, 1, half), (half, 1, -half), (-half, 1, -half)], 1)
    wide = draw(sunny([card], above(0.0, 1.5), sun), 128, 128, **GOOD)
    shade = wide["beauty"][..., 0]
    x, _, z = wide["P"][shade < 0.5 * (shade.max() + shade.min())].mean(0)
    u, v = np.meshgrid(*[(np.arange(200) + 0.5) / 200 * 2 * half - half] * 2)
    hidden = float((((u - x) ** 2 + 1 + (v - z) ** 2) ** -2.0).sum()) * (2 * half / 200) ** 2
    expected = 0.8 * BLUE * (1 - hidden / math.pi)
    lens = camera((x, 0.9, z), (x, 0, z), fov=0.03, orthographic=True)
    for chosen in settings:
        found = draw(sunny([card], lens, sun), 8, 8, **chosen)["beauty"][..., :3].mean((0, 1))
        # The sun is nine tenths of the light: `good` finds it hidden to a fiftieth of that.
        np.testing.assert_allclose(found, expected, rtol=0.2 if chosen is GOOD else 0.1)


def test_the_sky_that_a_plate_hides_is_missing_wherever_it_is() -> None:
    """A plate of 13 pixels just over the floor, out of the picture; against the picture of many samples."""
    plate = quad("/plate", [(-0.1, 0.06, 0.1), (0.1, 0.06, 0.1), (0.1, 0.06, -0.1), (-0.1, 0.06, -0.1)])
    lens = camera((0.13, 0.05, 0.13), (0.13, 0, 0.13), fov=0.5, orthographic=True)
    what = scene([quad("/floor", FLOOR), plate], [WHITE], environment=dome(1.0), cameras=(lens,))
    truth, good = (draw(what, 64, 64, **k)["beauty"][..., 0] for k in (PLAIN, GOOD))
    assert truth.min() < 0.3
    assert np.abs(good - truth).max() < 0.25


# --- The picture of many samples as a second opinion ------------------------------------------------------------------

BOWLS = [
    Sphere(f"/bowl{i}", place, 0.3, 6)
    for i, place in enumerate([(-0.4, 0.0, 0.3), (0.35, 0.1, 0.2), (0.0, -0.3, -0.3), (0.1, 0.5, -0.4)])
]
METAL = material("/metal", METALLIC=1.0, ROUGHNESS=0.0, DIFFUSE=0.9)
CUTOUT = material("/grid", EMISSIVE=0.6, OPACITY=Source(texture=6), opacity_threshold=0.5)


def in_checkers(kinds: Sequence[Material], *things: Mesh | Sphere, **fields: Any) -> Scene:
    walls, materials, textures = checker_room()
    holes = np.kron(np.indices((4, 4)).sum(0) % 2, np.ones((8, 8)))[..., None] * np.ones(4)
    meshes = [t for t in things if isinstance(t, Mesh)]
    balls = [t for t in things if isinstance(t, Sphere)]
    pictures = (*textures, Texture("holes", holes.astype(np.float32)))
    return scene([*walls, *meshes], [*materials, *kinds], balls, textures=pictures, **fields)


def small(path: str, index: int, centre: ArrayLike) -> Mesh:
    return box(path, (0.3, 0.3, 0.25), index, turned((1, 2, 0), 30), centre)


def lit(what: Material, **fields: Any) -> Scene:
    """A turned box of glass over a floor, lit by a panel and a dome."""
    floor = quad("/floor", [(-2, -0.6, 2), (2, -0.6, 2), (2, -0.6, -2), (-2, -0.6, -2)])
    lamp = light(LightKind.RECT, (1, 2, 1), (-1, -2, -1), (1.0, 0.6), 8.0)
    turned_box = box("/box", (0.5, 0.5, 0.4), 1, turned((1, 2, 3), 40))
    return scene([floor, turned_box], [material("/floor", DIFFUSE=0.7), what], lights=(lamp,), **fields)


def half_probed() -> Scene:
    """A probe that answers for half, and fades out on the way to its border."""
    room = surrounding()
    near = Volume(np.eye(4), False, (0.6,) * 3)
    probe = replace(room, influence=near, resolution=32, weight=0.5, blend_distance=(0.3,) * 6)
    return in_checkers([glass(Model.TRACED)], TURNED, probes=(probe,))


CLEAR = glass(Model.TRACED)
SCENES: dict[str, Callable[[], tuple[Scene, dict[str, Any]]]] = {
    "glass": lambda: (in_checkers([CLEAR], TURNED), {}),
    "parallel rays": lambda: (in_checkers([CLEAR], TURNED, cameras=(camera(fov=1.0, orthographic=True),)), {}),
    "prism": lambda: (in_checkers([glass(Model.TRACED, 1.6, abbe=15.0)], TURNED), {}),
    "mirrors": lambda: (
        in_checkers([CLEAR, METAL], TURNED, small("/near", 7, (0.6, 0.2, 0.6)), small("/far", 7, (-0.2, 0, -0.9))), {}
    ),
    "cut-outs": lambda: (
        in_checkers([CLEAR, CUTOUT], TURNED, quad("/grid", [(-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1)], 7)), {}
    ),
    "eye in glass": lambda: (
        in_checkers([CLEAR, material("/card", EMISSIVE=0.5)], box("/around", (1.2, 1.0, 0.8), 6, centre=(0, 0, 2.5)),
                    small("/inside", 7, (0.2, 0, 1.9))), {}
    ),
    "many leaves": lambda: (in_checkers([CLEAR], *BOWLS), {"cut": 1e-3, "max_layers": 32}),
    "rough": lambda: (in_checkers([glass(Model.TRACED, ROUGHNESS=0.4)], TURNED), {}),
    "thin and box": lambda: (
        in_checkers([glass(Model.THIN), glass(Model.BOX, THICKNESS=0.5)], small("/box", 7, (-0.4, 0, 0)),
                    quad("/pane", [(-0.2, -0.8, 0.6), (0.9, -0.8, 0.2), (0.9, 0.7, 0.2), (-0.2, 0.7, 0.6)], 6)), {}
    ),
    "milky glass": lambda: (
        lit(glass(Model.TRACED, OPACITY=0.4, DIFFUSE=(0.6, 0.3, 0.5), ROUGHNESS=0.3), environment=dome(0.3)), {}
    ),
    "before nothing": lambda: (
        lit(glass(Model.TRACED, TRANSMITTANCE=0.6, absorption_distance=0.5), cameras=(camera((0, 0.9, 2.4)),)), {}
    ),
    "half a probe": lambda: (half_probed(), {"tiers": ("probe", "ray", "sky")}),
    "only half a probe": lambda: (half_probed(), {"tiers": ("probe", "sky")}),
    "screen": lambda: (in_checkers([CLEAR], TURNED), {"tiers": ("screen", "probe", "ray", "sky")}),
}  # fmt: skip
SIZE = 32
PAINTED = ("thin and box", "eye in glass")
"""Where glass hardly bends, so that most that is left to be wrong is a texture between its taps."""


@cache
def pictures(name: str) -> tuple[dict[str, F32], dict[str, F32], dict[str, F32]]:
    """By many samples, good and fine."""
    what, settings = SCENES[name]()
    kinds = ({**PLAIN, "samples": 64 if name == "many leaves" else 256}, GOOD, FINE)
    truth, good, fine = (draw(what, SIZE, SIZE, **{"tiers": ("ray", "sky"), **settings, **kind}) for kind in kinds)
    return truth, good, fine


@pytest.mark.parametrize("name", SCENES)
def test_it_is_the_picture_of_many_samples(name: str) -> None:
    """Light, alpha and what is known of glass: no lean of the whole, and no pixel in glass that is something else."""
    truth, good, fine = pictures(name)
    glassy = truth["mask"] == 1.0
    assert glassy.mean() > 0.05
    for picture in (good, fine):
        for plane, values in picture.items():
            assert plane in ("Z", "P") or np.isfinite(values).all(), plane
        assert picture["beauty"].mean(axis=(0, 1)) == pytest.approx(truth["beauty"].mean(axis=(0, 1)), abs=2e-3)
        assert picture["beauty"][glassy].mean() == pytest.approx(truth["beauty"][glassy].mean(), rel=0.01)
        assert picture["mask"].mean() == pytest.approx(truth["mask"].mean(), abs=5e-3)
        for plane in ("refraction", "reflection", "transmittance"):
            expected = truth[plane][glassy].mean()
            assert picture[plane][glassy].mean() == pytest.approx(expected, abs=5e-3, rel=0.02), plane
        total = sum(picture[w].astype(np.float64) for w in WEIGHTS)
        assert (np.asarray(total) < 1.0 + 1e-5).all()
        assert ((picture["beauty"][..., 3] >= 0.0) & (picture["beauty"][..., 3] <= 1.0 + 1e-6)).all()


@pytest.mark.parametrize("name", SCENES)
def test_it_is_off_by_less_than_its_tolerance_and_by_less_with_more_time(name: str) -> None:
    """To the eye, over the pixels in glass; a finer one brings it nearer, as far as it is not a texture's edges, of
    which a pixel takes no more than its taps (so they are worth a twentieth here)."""
    truth, good, fine = pictures(name)
    glassy = truth["mask"] == 1.0
    errors = off(good, truth, glassy), off(fine, truth, glassy)
    assert errors[0] < GOOD["tolerance"]
    assert errors[1] < (1.05 if name in PAINTED else 0.75) * errors[0]
    alpha = [rms((p["beauty"] - truth["beauty"])[..., 3]) for p in (good, fine)]
    assert alpha[0] < GOOD["tolerance"]
    assert alpha[1] <= alpha[0]


def test_a_corner_with_more_leaves_than_are_kept_loses_none_of_its_light() -> None:
    """White furnace: balls in balls' light, of dense glass, followed to a last part in 100 000."""
    walls, materials = constant_room(0.75)
    balls = [replace(ball, material=1) for ball in BOWLS]
    what = scene(walls, [*materials, glass(Model.TRACED, 2.4)], balls)
    picture = draw(what, 16, 16, **GOOD, cut=1e-5, max_layers=32)
    assert picture["mask"].mean() > 0.1
    np.testing.assert_allclose(picture["beauty"][..., :3], 0.75, atol=1e-4)


def test_rough_glass_has_less_grain_than_from_as_many_samples() -> None:
    """Light is asked along as many rays a corner as lights get, so neighbours that are alike share what they know."""
    what, settings = SCENES["rough"]()
    truth, good, _ = pictures("rough")
    plain = draw(what, SIZE, SIZE, **{**settings, "samples": 16, "tolerance": 0.0})
    here = truth["mask"] == 1.0
    assert off(good, truth, here) < 0.9 * off(plain, truth, here)


def test_what_mirrors_roughly_is_drawn_better_with_more_time() -> None:
    """A rough metal floor before a shining card."""
    floor = quad("/floor", [(-2, -0.5, 2), (2, -0.5, 2), (2, -0.5, -2), (-2, -0.5, -2)])
    card = quad("/card", [(-0.5, -0.3, -1), (0.5, -0.3, -1), (0.5, 0.1, -1), (-0.5, 0.1, -1)], 1)
    kinds = [material("/metal", METALLIC=1.0, DIFFUSE=0.9, ROUGHNESS=0.25), material("/card", EMISSIVE=0.9)]
    what = scene([floor, card], kinds, cameras=(camera((0, 0.3, 2.5), (0, -0.3, 0)),))
    truth, good, fine = (draw(what, SIZE, SIZE, **k) for k in (PLAIN, GOOD, FINE))
    assert rms(fine["beauty"] - truth["beauty"]) < 0.75 * rms(good["beauty"] - truth["beauty"])


def test_a_place_lies_on_what_is_seen() -> None:
    """P of a slanted wall, as it does with one sample."""
    turn = turned((0, 1, 0), 60)
    wall = quad("/wall", np.array([(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)]) @ turn.T)
    what = scene([wall], [material("/wall", EMISSIVE=0.5)])
    for settings in ({"samples": 1}, GOOD):
        aside = draw(what, 24, 24, **settings)["P"] @ (turn @ np.array([0, 0, 1.0]))
        assert np.abs(aside).max() < 1e-5


RANDOM = (1, 3, 4, 6, 7, 8, 11, 13, 15)


def test_random_scenes_are_the_pictures_of_many_samples() -> None:
    """Whatever is in them: without a lean, within the tolerance over them all, and nearer with a finer one."""
    means, errors = [], []
    for seed in RANDOM:
        what = random_scene(seed)
        truth, good, fine = (draw(what, 24, 18, **k) for k in (PLAIN, GOOD, FINE))
        means.append([shown(p).mean() / shown(truth).mean() for p in (good, fine)])
        errors.append([off(p, truth) for p in (good, fine)])
        alpha = [rms((p["beauty"] - truth["beauty"])[..., 3]) for p in (good, fine)]
        assert max(alpha) < GOOD["tolerance"], seed
        for plane, values in good.items():
            assert plane in ("Z", "P") or np.isfinite(values).all(), (seed, plane)
    assert np.array(means) == pytest.approx(1.0, abs=0.02)
    assert np.mean(means, axis=0) == pytest.approx(1.0, abs=0.003)
    good_error, fine_error = np.sqrt(np.mean(np.square(errors), axis=0))
    assert good_error < GOOD["tolerance"]
    assert fine_error < 0.75 * good_error


# --- Alpha ------------------------------------------------------------------------------------------------------------


def test_a_transparent_picture_composites_right_over_any_background() -> None:
    """Grey glass that bends, alone: beauty plus (1 - alpha) of a colour is the picture before a card of that colour,
    for the card fills all that is ahead."""
    kinds = [material("/far", EMISSIVE=0.8), glass(Model.TRACED, 1.3, TRANSMITTANCE=0.5, absorption_distance=0.4)]
    ball = Sphere("/ball", (0.1, 0, 0), 0.6, 1)
    far = quad("/far", [(-1e4, -1e4, -9), (1e4, -1e4, -9), (1e4, 1e4, -9), (-1e4, 1e4, -9)])
    for settings in (GOOD, FINE):
        alone, before = (draw(scene(m, kinds, [ball]), 32, 32, tiers=("ray",), **settings) for m in ([], [far]))
        assert alone["beauty"][16, 16, 3] > 0.3
        laid = alone["beauty"][..., :3] + (1.0 - alone["beauty"][..., 3:]) * 0.8
        apart = laid - before["beauty"][..., :3]
        assert rms(apart) < 0.3 * settings["tolerance"]
        assert abs(float(apart.mean())) < 1e-3


def test_glass_that_is_not_there_over_nothing_is_nothing() -> None:
    picture = draw(scene([TURNED], [CLEAR] * 6 + [glass(Model.TRACED, 1.0)]), 24, 24, tiers=("ray",), **GOOD)
    assert picture["mask"].mean() > 0.05
    assert np.abs(picture["beauty"]).max() < 1e-5


# --- Cutting up the work ----------------------------------------------------------------------------------------------


def furnished() -> Scene:
    """Glass, a lamp, an uneven sky and textures; all of meshes."""
    checks = np.kron(np.indices((8, 8)).sum(0) % 2, np.ones((8, 8)))[..., None].repeat(4, 2).astype(np.float32)
    sky = np.random.default_rng(3).uniform(0.1, 0.7, (8, 16, 3)).astype(np.float32)
    sky[2, 3] = 6.0
    floor = quad("/floor", [(-2, -0.6, 2), (2, -0.6, 2), (2, -0.6, -2), (-2, -0.6, -2)])
    kinds = [
        material("/floor", DIFFUSE=Source(texture=0, scale=(0.7,) * 4), ROUGHNESS=0.3, IOR=1.5),
        glass(Model.TRACED), glass(Model.TRACED, ROUGHNESS=0.3), METAL,
    ]  # fmt: skip
    things = [
        floor, box("/a", (0.5, 0.4, 0.4), 1, turned((1, 2, 3), 40), (-0.5, 0, 0.2)),
        box("/b", (0.3, 0.3, 0.3), 2, turned((1, 0, 3), 40), (0.6, 0, 0.3)), small("/c", 3, (0.2, 0, -0.8)),
    ]  # fmt: skip
    lamp = light(LightKind.RECT, (1, 2, 1), (-1, -2, -1), (1.0, 0.6), 6.0)
    lens = camera((0, 0.5, 2.4), (0, -0.1, 0), aspect=4 / 3)
    textures = (Texture("checks", checks),)
    return scene(things, kinds, textures=textures, lights=(lamp,), environment=Environment(sky), cameras=(lens,))


def test_tiles_and_threads_change_no_bit_of_any_plane() -> None:
    """A picture larger than a tile of the quiet light, whose borders are not those of tiles or patches."""
    what = furnished()
    whole = draw(what, 84, 72, tile_size=512, jobs=1, **GOOD, **ALL_TIERS)
    for tile, jobs in ((8, 2), (24, 1), (64, 2)):
        other = draw(what, 84, 72, tile_size=tile, jobs=jobs, **GOOD, **ALL_TIERS)
        for name, plane in whole.items():
            np.testing.assert_array_equal(other[name], plane, err_msg=f"{name} in tiles of {tile}")


def test_brushed_metal_is_quieter_the_better_the_quality() -> None:
    walls, kinds, textures = checker_room()
    brushed = material("/brushed", METALLIC=1.0, ROUGHNESS=0.3, DIFFUSE=0.9)
    what = scene(walls, [*kinds, brushed], [Sphere("/ball", (0, 0, 0), 0.8, len(kinds))], textures=textures)
    truth = shown(draw(what, 64, 64, **PLAIN))
    noise = [rms(shown(draw(what, 64, 64, **named_settings(quality))) - truth) for quality in ("draft", "good", "best")]
    assert noise[0] > noise[1] > noise[2]
    assert noise[2] < 0.02


@pytest.mark.parametrize("behind", [False, True])
@pytest.mark.parametrize(("width", "apart"), [(0.3, 0.45), (0.55, 0.2), (0.8, 0.2)])
def test_wires_thinner_than_a_pixel_are_not_broken(width: float, apart: float, behind: bool) -> None:
    """So slanting that they pass between corners for many rows, thin ones between middles, too: every row has all of
    each, as exactly as sixteen samples tell. And the same behind a slab of glass that bends nothing."""
    size, fov = 64, 1.0
    pixel = 2 * fov / size
    wires = [
        quad(f"/wire{i}", [(x, 0.5, 9), (x + width * pixel, 0.5, 9), (x + width * pixel, 0.5, -9), (x, 0.5, -9)], 1)
        for i, x in enumerate(np.linspace(-0.8, 0.8, 6))
    ]
    turn = turned((0, 1, 0), 3)
    wires = [replace(wire, points=(wire.points @ turn.T).astype(np.float32)) for wire in wires]
    slabs = [box("/slab", (20, 0.1, 20), 2, centre=(0, 1, 0))] if behind else []
    kinds = [material("/white", EMISSIVE=1.0, DIFFUSE=0.0), material("/black", DIFFUSE=0.0, IOR=1.0)]
    kinds.append(glass(Model.TRACED, 1.0))
    what = scene([quad("/floor", FLOOR), *wires, *slabs], kinds, cameras=(above(0.0, fov),))
    lost = 1.0 - draw(what, size, size, **GOOD)["beauty"][..., 0]
    assert lost.sum(1) == pytest.approx(6 * width / math.cos(math.radians(3)), rel=apart)
    assert lost.sum(1).mean() == pytest.approx(6 * width / math.cos(math.radians(3)), rel=0.03)


def test_a_narrow_side_of_a_body_is_not_broken() -> None:
    """A step in a sheet, seen from above: its slope is a third of a pixel wide, and of the same mesh as the rest."""
    size, fov, slope = 64, 1.0, math.radians(75)
    pixel = 2 * fov / size
    x, step = 0.3 * pixel, 0.3 * pixel * math.tan(slope)
    rows = np.array([[(-9, 0, z), (-x, 0, z), (x, 2 * step, z), (9, 2 * step, z)] for z in (9, -9)], np.float32)
    points = (rows.reshape(-1, 3) @ turned((0, 1, 0), 3).T).astype(np.float32)
    order = np.array([(k, k + 1, k + 5, k + 4) for k in range(3)])
    sheet = Mesh("/sheet", points, order[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3), np.zeros(6, np.int32))
    lamp = light(LightKind.DISTANT, (0, 9, 0), (0, -1, 0), (0.0, 0.0), 1.0)
    dull = material("/dull", DIFFUSE=1.0, IOR=1.0)
    picture = draw(scene([sheet], [dull], lights=(lamp,), cameras=(above(0.0, fov),)), size, size, **GOOD)
    light_of = picture["beauty"][8:-8, :, 0] / picture["beauty"][8, 2, 0]
    lost = (1.0 - light_of).sum(1)
    expected = 0.6 * (1.0 - math.cos(slope)) / math.cos(math.radians(3))
    assert lost.mean() == pytest.approx(expected, rel=0.06)
    assert lost.min() > 0.6 * expected


def test_glass_that_the_eye_passes_costs_no_samples() -> None:
    """An eye within a typed ball does not see it, for back faces refract nothing: no pixel is an edge for it."""
    walls, kinds = constant_room(0.75)
    around = Sphere("/around", (0.0, 0.0, 2.0), 0.4, len(kinds))
    chosen: dict[str, Any] = {"tiers": ("ray", "sky"), "emission_light": False, **GOOD}
    settings = rc.RenderSettings(image_width=64, image_height=64, jobs=1, **chosen)
    bare, within = (
        rc.render(scene(walls, [*kinds, glass(Model.SPHERE)], things), settings) for things in ([], [around])
    )
    np.testing.assert_allclose(within.planes["beauty"], bare.planes["beauty"], atol=1e-6)
    assert float(within.metadata["refract:rays"]) < 5 * float(bare.metadata["refract:rays"])


def test_an_edge_that_only_its_middle_shows_is_not_given_up() -> None:
    """A wire of glass that no corner sees: its pixels took every sample, so they are as sure as other edges are."""
    size, fov = 64, 1.0
    x = 0.25 * 2 * fov / size  # half a pixel wide, and as far from the corners on both sides as it can be
    wire = [(x, 0.5, 9), (x + fov / size, 0.5, 9), (x + fov / size, 0.5, -9), (x, 0.5, -9)]
    kinds = [material("/white", EMISSIVE=1.0, DIFFUSE=0.0), glass(Model.THIN)]
    what = scene([quad("/floor", FLOOR), quad("/wire", wire, 1)], kinds, cameras=(above(0.0, fov),))
    picture = draw(what, size, size, **GOOD)
    seen = picture["mask"] > 0.1
    assert seen.sum() == size
    assert picture["confidence"][seen].min() > 0.3


def test_where_confidence_is_low_the_picture_is_off_and_by_about_that() -> None:
    """The fifth of the glass that is trusted least has the largest error, and 1 - confidence is its order."""
    what = furnished()
    good = draw(what, 160, 120, tiers=("ray", "sky"), **GOOD)
    truth = draw(what, 160, 120, tiers=("ray", "sky"), **PLAIN)
    inside = good["mask"] > 0.5
    doubt, off = 1.0 - good["confidence"][inside], np.abs(shown(good) - shown(truth)).max(-1)[inside]
    fifths = np.array_split(np.argsort(doubt, kind="stable"), 5)
    errors = np.array([off[fifth].mean() for fifth in fifths])
    assert errors[4] > 1.5 * errors[:3].max()
    assert 0.3 < doubt[fifths[4]].mean() / errors[4] < 3.0


ALL_TIERS: dict[str, Any] = {"tiers": ("screen", "probe", "ray", "sky")}
