"""Light that leaves opaque surfaces, and surfaces with holes in them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scenes import (
    box,
    camera,
    constant_room,
    dome,
    draw,
    glass,
    light,
    material,
    position_room,
    quad,
    scene,
    turned,
    view_rays,
    wall_hit,
    where,
)

from refract_core.scene import Channel, LightKind, Material, Model, Source, Sphere, Texture, Wrap

CARD = [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]


def test_a_metal_mirror_shows_the_place_that_geometry_says() -> None:
    """White polished metal in the position room: the wall met along d - 2 (d.n) n, times a reflectance near 1."""
    walls, materials = position_room()
    chrome = material("/chrome", DIFFUSE=1.0, METALLIC=1.0, ROUGHNESS=0.0)
    lens = camera((1.0, 0.5, 2.0), (0, 0, 0))
    planes = draw(scene([*walls, quad("/mirror", CARD, 1)], [*materials, chrome], cameras=(lens,)))
    origin, d = view_rays(lens, 64, 64)
    p = origin - d * (origin[..., 2:] / d[..., 2:])
    here = (np.abs(p) < 0.99).all(-1)
    expected = wall_hit(p, d * [1, 1, -1])[here]
    # The split-sum fit of a white metal at roughness 0 is 1 within 2 %; black and white places bound the colour.
    colour = planes["beauty"][here][:, :3]
    np.testing.assert_allclose(where(colour), expected, atol=0.02 * 6)


def ggx_albedo(cosine: float, alpha: float, steps: int = 300) -> float:
    """Share of light that single-scattering GGX sends back: mean of G2 / G1 over visible normals (Heitz 2018)."""
    u, v = np.meshgrid((np.arange(steps) + 0.5) / steps, (np.arange(steps) + 0.5) / steps)
    wo = np.array([np.sqrt(1 - cosine**2), 0, cosine])
    top = wo * [alpha, alpha, 1]
    top /= np.linalg.norm(top)
    x = np.array([0.0, 1.0, 0.0])
    y = np.cross(top, x)
    a, b = np.sqrt(u) * np.cos(2 * np.pi * v), np.sqrt(u) * np.sin(2 * np.pi * v)
    s = (1 + top[2]) / 2
    b = (1 - s) * np.sqrt(1 - a * a) + s * b
    h = a[..., None] * x + b[..., None] * y + np.sqrt(np.maximum(0, 1 - a * a - b * b))[..., None] * top
    h *= [alpha, alpha, 1]
    h /= np.linalg.norm(h, axis=-1, keepdims=True)
    leaving = (2 * (h @ wo)[..., None] * h - wo)[..., 2]

    def masked(c: Any) -> Any:
        return (np.sqrt(1 + alpha**2 * (1 / c**2 - 1)) - 1) / 2

    g = (1 + masked(cosine)) / (1 + masked(cosine) + masked(np.maximum(leaving, 1e-6)))
    return float(np.where(leaving > 0, g, 0).mean())


@pytest.mark.parametrize("roughness", [0.0, 0.1, 0.3, 0.45, 0.7, 1.0])
def test_white_metal_shows_a_room_of_one_radiance(roughness: float) -> None:
    """A perfect reflector shows an isotropic field, less at most what single-scattering GGX loses (0.91 is left at
    roughness 0.5, 0.31 at 1). More is better, since real light scatters on; more than there is, is not."""
    walls, materials = constant_room(0.5)
    chrome = material("/chrome", DIFFUSE=1.0, METALLIC=1.0, ROUGHNESS=roughness)
    ball = Sphere("/ball", (0, 0, 0), 0.8, 1)
    planes = draw(scene(walls if roughness < 0.5 else [], [*materials, chrome], [ball], environment=dome(0.5)))
    seen = planes["beauty"][24:40, 24:40, 0] / 0.5
    assert seen.max() < 1.02
    assert seen.min() > ggx_albedo(1.0, max(roughness, 0.01) ** 2) - 0.03


@pytest.mark.parametrize("albedo", [1.0, 0.5, 0.1])
def test_a_matt_ball_under_a_constant_dome_is_its_albedo(albedo: float) -> None:
    """Furnace: irradiance pi L on a convex body, so radiance albedo L. A surface of ior 1 has no Fresnel share."""
    ball = Sphere("/ball", (0, 0, 0), 0.8, 0)
    planes = draw(scene([], [material("/m", DIFFUSE=albedo)], [ball], environment=dome(2.0)))
    surface = np.isfinite(planes["Z"])
    assert surface.mean() > 0.2
    np.testing.assert_allclose(planes["beauty"][surface][:, 0], 2.0 * albedo, atol=2.0 * 0.006)


def test_a_white_plastic_ball_neither_gains_nor_loses_much() -> None:
    """Diffuse under a dielectric coat: the two shares may not sum to more than the light there is."""
    ball = Sphere("/ball", (0, 0, 0), 0.8, 0)
    plastic = material("/m", DIFFUSE=1.0, IOR=1.5, ROUGHNESS=0.6)
    planes = draw(scene([], [plastic], [ball], environment=dome(1.0)))
    seen = planes["beauty"][np.isfinite(planes["Z"])][:, 0]
    assert seen.max() < 1.03
    assert np.median(seen) > 0.95


def test_emission_is_seen_as_it_is_from_every_side() -> None:
    cube = box("/cube", (0.5, 0.5, 0.5), 0, turned((1, 2, 3), 50))
    planes = draw(scene([cube], [material("/m", EMISSIVE=(0.1, 5.0, 0.7))]))
    surface = np.isfinite(planes["Z"])
    np.testing.assert_allclose(planes["beauty"][surface][:, :3], np.broadcast_to([0.1, 5.0, 0.7], (surface.sum(), 3)))


def test_a_mirror_turned_away_from_the_light_has_no_highlight() -> None:
    """The highlight of a small light stands where the mirror direction meets it, and is the light's radiance there."""
    chrome = material("/chrome", DIFFUSE=1.0, METALLIC=1.0, ROUGHNESS=0.0)
    lamp = light(LightKind.SPHERE, (0.5, 0.5, 2.5), (0, 0, -1), (0.2, 0), 4.0)
    planes = draw(scene([quad("/mirror", np.array(CARD) * 3)], [chrome], lights=(lamp,)), 64, 64)
    _, d = view_rays(camera(), 64, 64)
    p = np.array([0, 0, 2.5]) - d * (2.5 / d[..., 2:])
    r = d * [1, 1, -1]
    c = np.array([0.5, 0.5, 2.5]) - p
    away = np.linalg.norm(c - r * (c * r).sum(-1, keepdims=True), axis=-1)
    seen = planes["beauty"][..., 0]
    assert seen[away < 0.19].min() > 0.98 * 4.0
    assert seen[away > 0.21].max() < 1e-6


# --- Cut-outs ---------------------------------------------------------------------------------------------------------


def holes() -> Texture:
    """Left half clear, right half solid, in alpha."""
    pixels = np.ones((8, 8, 4), np.float32)
    pixels[:, :4, 3] = 0.0
    return Texture("holes", pixels)


def half_clear(**fields: Any) -> Material:
    opacity = Source(texture=0, channel=Channel.A, uv_primvar="st", wrap=(Wrap.CLAMP, Wrap.CLAMP))
    return material("/leaf", OPACITY=opacity, EMISSIVE=3.0, **fields)


@pytest.mark.parametrize("roughness", [0.3, 0.45])
def test_a_rough_mirror_is_quiet_and_right(roughness: float) -> None:
    """Beside the same picture of 256 samples a pixel: pixels share what their rays see, and lose none of it. With rays
    for themselves alone they were three times as far from it."""
    metal = material("/metal", DIFFUSE=1.0, METALLIC=1.0, ROUGHNESS=roughness)
    floor = quad("/floor", [(-5, 0, 5), (5, 0, 5), (5, 0, -5), (-5, 0, -5)], 0)
    wall = quad("/wall", [(-1, 0, -1.5), (0.2, 0, -1.5), (0.2, 3, -1.5), (-1, 3, -1.5)], 1)
    lens = camera((0, 1.0, 2.0), (-0.3, 0, -0.4), 0.12)
    sun = light(LightKind.DISTANT, (0, 0, 0), (0, 0, -1), (0, 0))
    what = scene([floor, wall], [metal, material("/matt", DIFFUSE=0.9, IOR=1.0)], lights=(sun,), cameras=(lens,))
    quick = draw(what, samples=16, tolerance=0.03, tiers=("screen", "ray", "sky"))["beauty"][..., 0].astype(np.float64)
    right = draw(what, samples=256, tolerance=0.0)["beauty"][..., 0].astype(np.float64)
    assert quick.mean() == pytest.approx(right.mean(), rel=0.003)
    assert np.sqrt(np.square(quick - right).mean()) < 0.03 * right.mean()


def test_a_half_shadow_in_a_mirror_is_quiet() -> None:
    """Beside the same picture of 256 samples a pixel. One ray to the lamp from where a mirror ray ends was three times
    as far off."""
    chrome = material("/chrome", DIFFUSE=1.0, METALLIC=1.0, ROUGHNESS=0.0)
    mirror = quad("/mirror", [(-4, 0, -2), (4, 0, -2), (4, 4, -2), (-4, 4, -2)], 1)
    floor = quad("/floor", [(-4, 0, 4), (4, 0, 4), (4, 0, -2), (-4, 0, -2)], 0)
    card = quad("/card", [(-0.7, 1.2, 0.5), (0.5, 1.2, 0.5), (0.5, 1.2, -0.6), (-0.7, 1.2, -0.6)], 0)
    lamp = light(LightKind.RECT, (0, 3, 0), (0, -1, 0), (0.5, 0.5), 5.0)
    lens = camera((0, 1.0, 0.9), (0, 0.4, -2), 0.25)
    paint = [material("/grey", DIFFUSE=0.8, IOR=1.0), chrome]
    what = scene([floor, mirror, card], paint, lights=(lamp,), cameras=(lens,))
    quick = draw(what, samples=16, tolerance=0.03, tiers=("screen", "ray", "sky"))["beauty"][..., 0].astype(np.float64)
    right = draw(what, samples=256, tolerance=0.0)["beauty"][..., 0].astype(np.float64)
    assert quick.mean() == pytest.approx(right.mean(), rel=0.003)
    assert np.sqrt(np.square(quick - right).mean()) < 0.06 * right.mean()


def test_a_cut_out_lets_view_rays_through_its_holes() -> None:
    wall = quad("/wall", np.array(CARD) * 4 - [0, 0, 1], 1)
    leaf = half_clear(opacity_threshold=0.5)
    planes = draw(scene([quad("/leaf", CARD), wall], [leaf, material("/m", EMISSIVE=1.0)], textures=(holes(),)))
    row = planes["beauty"][32, :, 0]
    # The leaf spans 2 of the 2.5 m seen: pixels 6.4 to 57.6; its middle is the middle of the picture.
    assert (row[:31] == 1.0).all()
    assert (row[33:57] == 3.0).all()
    assert (row[59:] == 1.0).all()


def test_a_cut_out_lets_light_through_its_holes() -> None:
    """Sun straight down on a leaf at height 1: its solid half, x > 0, is the shadow."""
    leaf = quad("/leaf", [(-1, 1, 1), (1, 1, 1), (1, 1, -1), (-1, 1, -1)])
    floor = quad("/floor", [(-9, 0, 9), (9, 0, 9), (9, 0, -9), (-9, 0, -9)], 1)
    sun = light(LightKind.DISTANT, (0, 5, 0), (0, -1, 0), (0.0, 0))
    planes = draw(
        scene([leaf, floor], [half_clear(opacity_threshold=0.5), material("/m", DIFFUSE=1.0)], textures=(holes(),),
              lights=(sun,), cameras=(camera((0, 0.9, 4), (0, 0.3, 0)),)), 64, 64,
    )  # fmt: skip
    ground = np.isfinite(planes["Z"]) & (np.abs(planes["P"][..., 1]) < 1e-4)
    x, z = planes["P"][ground][:, 0], planes["P"][ground][:, 2]
    lit = planes["beauty"][ground][:, 0] > 0
    under = (np.abs(z) < 0.95) & (np.abs(x) < 0.95)
    assert (under & (x > 0.1)).any()
    assert not lit[under & (x > 0.1)].any()
    assert lit[under & (x < -0.1)].all()
    assert lit[(np.abs(z) > 1.05) | (np.abs(x) > 1.05)].all()


@pytest.mark.parametrize("coverage", [0.25, 0.7])
def test_presence_averages_to_its_coverage(coverage: float) -> None:
    """A veil of radiance 3 before a wall of radiance 1: mean 3 c + (1 - c). 40 x 40 pixels x 8 samples: the standard
    error is 2 sqrt(c (1 - c) / 12800) < 0.009; five of those are allowed."""
    veil = material("/veil", OPACITY=coverage, EMISSIVE=3.0, opacity_presence=True)
    wall = quad("/wall", np.array(CARD) * 4 - [0, 0, 1], 1)
    what = scene([quad("/veil", np.array(CARD) * 2), wall], [veil, material("/m", EMISSIVE=1.0)])
    planes = draw(what, 40, 40, samples=8)
    assert planes["beauty"][..., 0].mean() == pytest.approx(3 * coverage + 1 - coverage, abs=0.045)
    assert not planes["mask"].any()


@pytest.mark.parametrize("behind", [False, True], ids=["seen", "through glass"])
def test_samples_of_a_pixel_share_what_is_there_by_chance(behind: bool) -> None:
    """Of 16 samples that take turns, as many meet a veil as its coverage says, but for two, in every pixel."""
    coverage = 0.37
    veil = material("/veil", OPACITY=coverage, EMISSIVE=1.0, DIFFUSE=0.0, opacity_presence=True)
    wall = quad("/wall", np.array(CARD) * 4 - [0, 0, 1], 1)
    pane = box("/pane", (3.0, 3.0, 0.05), 2, centre=(0, 0, 1.0))
    things = [quad("/veil", np.array(CARD) * 2), wall, *([pane] if behind else [])]
    what = scene(things, [veil, material("/m", DIFFUSE=0.0), glass(Model.TRACED, 1.0)])
    found = draw(what, 24, 24, samples=16, tolerance=0.03)["beauty"][..., 0]
    assert np.abs(found - coverage).max() < 2.01 / 16
    assert found.mean() == pytest.approx(coverage, abs=0.01)
    assert found.std() < 0.06  # of 16 tosses of a coin it would be .12


@pytest.mark.parametrize("layers", [2, 5])
def test_layers_of_one_mesh_are_there_each_for_itself(layers: int) -> None:
    """Of what is behind n veils, (1 - c)^n is seen, in every pixel: they are not there together or not at all."""
    coverage = 0.3
    veil = material("/veil", OPACITY=coverage, DIFFUSE=0.0, SPECULAR=0.0, IOR=1.0, opacity_presence=True)
    one = quad("/veils", np.array(CARD) * 2, 0)
    points = np.concatenate([one.points - np.array([0, 0, 0.2 * k], np.float32) for k in range(layers)])
    triangles = np.concatenate([one.triangles + np.uint32(4 * k) for k in range(layers)])
    veils = replace(one, points=points, triangles=triangles, materials=np.tile(one.materials, layers),
                    primvars={})  # fmt: skip
    wall = quad("/wall", np.array(CARD) * 4 - [0, 0, 3], 1)
    found = draw(scene([veils, wall], [veil, material("/m", EMISSIVE=1.0)]), 24, 24, samples=64)["beauty"][..., 0]
    assert found.mean() == pytest.approx(0.7**layers, abs=0.01)
    assert np.abs(found - 0.7**layers).max() < 4.01 / 64


@pytest.mark.parametrize("coverage", [0.25, 0.7])
@pytest.mark.parametrize("twice", [False, True])
def test_the_shadow_of_what_is_there_by_a_share_has_no_grain(coverage: float, twice: bool) -> None:
    """What is under a veil, or two, gets just that share of the light, at each place."""
    veil = material("/veil", OPACITY=coverage, opacity_presence=True)
    floor = quad("/floor", [(-2, 0, 2), (2, 0, 2), (2, 0, -2), (-2, 0, -2)], 0)
    above = np.array([(-3, 1, 3), (3, 1, 3), (3, 1, -3), (-3, 1, -3)])
    veils = [quad("/veil", above * (1, y, 1), 1) for y in ((1.0, 1.5) if twice else (1.0,))]
    lamp = light(LightKind.DISTANT, (0, 5, 0), (0, -1, 0), (0.0, 0.0), 1.0)
    eye = camera((0, 0.9, 1.5), (0, 0, 0.0), 0.2)
    white = [material("/floor", DIFFUSE=0.5, SPECULAR=0.0, IOR=1.0), veil]
    with_veils, without = (
        draw(scene(things, white, cameras=(eye,), lights=(lamp,)), 16, 16, samples=1)["beauty"][..., 0]
        for things in ([floor, *veils], [floor])
    )
    np.testing.assert_allclose(with_veils, without * (1.0 - coverage) ** len(veils), rtol=1e-4)


def test_glass_is_left_out_of_mirrors() -> None:
    """Opaque surfaces reflect the opaque scene only: a mirror shows the room as if the glass were not there."""
    walls, materials = position_room()
    chrome = material("/chrome", DIFFUSE=1.0, METALLIC=1.0, ROUGHNESS=0.0)
    mirror = quad("/mirror", CARD, 1)
    ball = Sphere("/ball", (0, 0, 2.9), 0.05, 2)  # behind the eye
    with_glass = scene([*walls, mirror], [*materials, chrome, glass(Model.TRACED)], [ball])
    without = scene([*walls, mirror], [*materials, chrome])
    np.testing.assert_array_equal(draw(with_glass)["beauty"], draw(without)["beauty"])


@pytest.mark.parametrize("base", [0.0, 0.5])
def test_a_coat_has_no_highlight_in_the_shadow(base: float) -> None:
    """Under a roof, of a light without a diffuse share; a polished base has no highlight to ask a shadow for."""
    floor = quad("/floor", [(-2, 0, 2), (2, 0, 2), (2, 0, -2), (-2, 0, -2)], 0)
    roof = quad("/roof", [(-2, 0.5, 2), (2, 0.5, 2), (2, 0.5, -2), (-2, 0.5, -2)], 1)
    lamp = replace(light(LightKind.SPHERE, (0, 3, -2), (0, -1, 0), (0.3, 0.0), 50.0), diffuse=0.0)
    coated = material("/coated", ROUGHNESS=base, IOR=1.5, CLEARCOAT=1.0, CLEARCOAT_ROUGHNESS=0.6)
    eye = camera((0, 0.4, 1.5), (0, 0, 0.0), 0.2)
    planes = draw(scene([floor, roof], [coated, material("/roof")], lights=(lamp,), cameras=(eye,)), 8, 8)
    assert planes["beauty"][4, 4, :3].max() == 0.0


@pytest.mark.parametrize("channel", [Channel.R, Channel.G, Channel.B, Channel.A])
def test_one_channel_of_a_picture_drives_a_colour(channel: Channel) -> None:
    """UsdUVTexture: scale and bias act on the channels, then one of them is picked, and is grey as a colour."""
    values, scale, bias = (0.5, 0.25, 0.75, 1.0), (1.0, 0.4, 2.0, 0.5), (0.0, 0.1, 0.0, 0.3)
    picture = Texture("picture", np.tile(np.array(values, np.float32), (2, 2, 1)))
    driven = material("/wall", EMISSIVE=Source(texture=0, channel=channel, scale=scale, bias=bias))
    wall = quad("/wall", [(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)], 0)
    planes = draw(scene([wall], [driven], textures=(picture,)), 8, 8)
    expected = values[channel] * scale[channel] + bias[channel]
    np.testing.assert_allclose(planes["beauty"][4, 4, :3], expected, rtol=1e-6)


@pytest.mark.parametrize(("opacity", "there"), [(0.49, False), (0.5, True), (0.51, True)])
def test_a_cut_out_is_there_from_its_threshold_on(opacity: float, there: bool) -> None:
    """UsdPreviewSurface: opaque where opacity is at least the threshold, absent elsewhere."""
    wall = quad("/wall", [(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)], 0)
    leaf = material("/leaf", EMISSIVE=0.7, OPACITY=opacity, opacity_threshold=0.5)
    planes = draw(scene([wall], [leaf]), 8, 8)
    assert planes["beauty"][4, 4, 3] == float(there)


def test_what_stands_behind_a_light_casts_no_shadow() -> None:
    """A ceiling above the lamp takes nothing from the floor below it."""
    floor = quad("/floor", [(-2, -1, 2), (2, -1, 2), (2, -1, -2), (-2, -1, -2)], 0)
    ceiling = quad("/ceiling", [(-4, 2, 4), (-4, 2, -4), (4, 2, -4), (4, 2, 4)], 0)
    lamp = light(LightKind.SPHERE, (0, 1, 0), (0, -1, 0), (0.2, 0.0), 5.0)
    grey = material("/grey", DIFFUSE=0.5)
    eye = camera((0, 0.5, 3.0), (0, -1, 0), 0.3)
    alone, under = (
        draw(scene(things, [grey], lights=(lamp,), cameras=(eye,)), 16, 16)["beauty"]
        for things in ([floor], [floor, ceiling])
    )
    assert alone[8, 8, 0] > 0.01
    np.testing.assert_array_equal(alone[6:10, 6:10], under[6:10, 6:10])


@pytest.mark.parametrize("height", [0.2, 0.5, 1.0, 2.0])
def test_a_wall_takes_its_share_of_an_even_sky(height: float) -> None:
    """A floor before an endless wall at distance 1 sees (1 + cos a) / 2 of an even sky, a the wall's height in angle
    (the view factor of a half plane above an edge; Howell, A Catalog of Radiation Heat Transfer, A-5)."""
    floor = quad("/floor", [(-50, 0, 50), (50, 0, 50), (50, 0, -50), (-50, 0, -50)], 0)
    wall = quad("/wall", [(-50, 0, -1), (50, 0, -1), (50, height, -1), (-50, height, -1)], 1)
    lens = camera((0, 3, 0), (0, 0, 0), fov=0.002)
    what = scene([floor, wall], [material("/floor", DIFFUSE=0.5, SPECULAR=0.0, ROUGHNESS=1.0, specular_workflow=True),
                                 material("/wall", DIFFUSE=0.0)], environment=dome(1.0), cameras=(lens,))  # fmt: skip
    seen = draw(what, 16, 16, samples=64)["beauty"][..., 0].mean()
    assert seen == pytest.approx(0.5 * (1.0 + math.cos(math.atan(height))) / 2.0, abs=0.012 * 0.5)
