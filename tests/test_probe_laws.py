"""Laws of the whole hierarchy with probes in it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scenes import (
    ROOM,
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
    where,
)

from refract_core.rendering.ready import capture_probes
from refract_core.scene import Cubemap, LightKind, Model, Probe, Sphere, Volume

pytestmark = pytest.mark.draws

BALL = Sphere("/ball", (0.0, 0.0, 0.0), 0.7, 0)


def volume(half: tuple[float, ...], centre: tuple[float, float, float] = (0, 0, 0)) -> Volume:
    m = np.eye(4)
    m[:3, 3] = centre
    x, y, z = half
    return Volume(m, False, (x, y, z))


ALL = volume((ROOM,) * 3)


def probe(point: tuple[float, float, float] = (0, 0, 0), **fields: Any) -> Probe:
    base = Probe("/probe", "realtime", point, ALL, ALL, resolution=64, clipping=(0.01, 100.0))
    return replace(base, **fields)


def grey_cube(value: float) -> Cubemap:
    faces = np.zeros((6, 32, 32, 5), np.float32)
    faces[..., :3], faces[..., 3] = value, 1.0
    return Cubemap((faces,))


@pytest.mark.parametrize("roughness", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("settings", [{}, {"screen": "proxy"}], ids=["march", "proxy"])
def test_a_room_of_one_colour_has_no_seam_between_tiers(roughness: float, settings: dict[str, Any]) -> None:
    """A cube probe, a smaller one with a blend, a baked one and a window, behind the screen: all the same light."""
    walls, materials = constant_room(0.75)
    half = volume((1.0, 3.0, 3.0), (-1.5, 0, 0))
    probes = (
        probe((0.5, 0.2, 0.1)),
        probe(influence=half, blend_distance=(0.8,) * 6, importance=3),
        probe(influence=volume((0.6, 0.6, 0.6)), blend_distance=(0.4,) * 6, importance=4, cubemap=grey_cube(0.75)),
        probe(influence=volume((3.0, 3.0, 1.0)), planar=True, importance=2, weight=0.7),
    )
    materials = [*materials, glass(Model.TRACED, ROUGHNESS=roughness), glass(Model.THIN, ROUGHNESS=roughness)]
    sheet = quad("/sheet", [(0.8, -1, 0), (2, -1, 0), (2, 1, 0), (0.8, 1, 0)], 2)
    balls = [replace(BALL, material=1), replace(BALL, centre=(-1.6, 0, -0.5), material=1)]
    picture = draw(
        scene([*walls, sheet], materials, balls, probes=probes), tiers=("screen", "probe", "sky"), **settings
    )
    assert picture["weight.screen"].max() > 0.9
    assert picture["weight.probe"].max() > 0.9
    np.testing.assert_allclose(picture["beauty"][..., :3], 0.75, atol=1e-4)


def test_a_probe_at_the_eye_draws_what_the_camera_draws() -> None:
    """A sheet of ior 1 before the whole view, a probe at the eye without a proxy, faces of 1024 texels: over 45 dB."""
    walls, materials = position_room()
    materials = [*materials, material("/lamp", EMISSIVE=1.0), material("/black")]
    lens = camera((0.3, 0.2, 1.5), (-0.4, -0.2, -1), 0.4)
    things = [
        box("/block", (0.3, 0.8, 0.3), 1, centre=(-0.8, -1.0, -1.2)),
        box("/brick", (0.4, 0.2, 0.3), 2, turned((0, 1, 0), 30), (0.2, -0.4, -1.0)),
    ]
    sheet_at = lens.world_from_camera[:3, 3] - 0.5 * lens.world_from_camera[:3, 2]
    x, y = lens.world_from_camera[:3, 0], lens.world_from_camera[:3, 1]
    sheet = quad("/sheet", [sheet_at - x - y, sheet_at + x - y, sheet_at + x + y, sheet_at - x + y], len(materials))
    eye = (0.3, 0.2, 1.5)
    at_eye = probe(eye, proxy=None, influence=volume((9.0,) * 3), resolution=1024)
    common: dict[str, Any] = {"cameras": (lens,)}
    seen = draw(
        scene([*walls, *things, sheet], [*materials, glass(Model.THIN, 1.0)], probes=(at_eye,), **common),
        160, 160, tiers=("probe",), samples=16, jobs=0,
    )  # fmt: skip
    direct = draw(scene([*walls, *things], materials, **common), 160, 160, samples=16, jobs=0)
    assert seen["weight.probe"].min() > 0.999
    difference = np.clip(seen["beauty"][..., :3], 0, 1) - np.clip(direct["beauty"][..., :3], 0, 1)
    assert -10 * np.log10((difference**2).mean()) > 45


def test_in_a_box_room_a_box_proxy_is_exact_on_the_walls() -> None:
    """Glass that bends: place found by probe against place found by ray, from a capture off centre."""
    walls, materials = position_room()
    what = scene(walls, [*materials, glass(Model.SPHERE, THICKNESS=1.4)], [replace(BALL, material=1)])
    one = probe((0.8, -0.5, 0.3), resolution=512)
    by_probe = draw(replace(what, probes=(one,)), tiers=("probe",))
    by_ray = draw(what, tiers=("ray",))
    here = by_ray["mask"] > 0
    error = np.abs(where(by_probe["refraction"]) - where(by_ray["refraction"]))[here]
    assert np.median(error) < 1e-3
    assert np.quantile(error, 0.99) < 0.03


def test_leaving_an_influence_fades_without_a_step() -> None:
    """The ball slides out through the blended face. Its smoothstep is no steeper than 1.5 / blend distance."""
    walls, materials = position_room()
    blend, step = 1.0, 0.05
    one = probe(influence=volume((1.5, 3, 3)), blend_distance=(blend,) + (0.0,) * 5)
    weights = []
    for x in np.arange(0.2, 2.4, step):
        ball = Sphere("/ball", (float(x), 0, 0), 0.2, 1)
        what = scene(walls, [*materials, glass(Model.TRACED)], [ball], probes=(one,))
        lens = camera((float(x), 0.0, 2.5), (float(x), 0, 0), 0.06)
        picture = draw(replace(what, cameras=(lens,)), 16, 16, tiers=("probe",))
        assert (picture["mask"] > 0).all()
        weights.append(picture["weight.probe"].astype(float))
    change = np.abs(np.diff(weights, axis=0)).max()
    assert weights[0].min() > 0.999
    assert weights[-1].max() == 0.0
    assert change <= 1.5 * step / blend + 1e-6


@pytest.mark.parametrize("mode", ["march", "proxy"])
def test_what_is_left_after_probes_goes_to_the_sky_and_then_to_nothing(mode: str) -> None:
    one = probe(weight=0.3, proxy=None, influence=volume((9.0,) * 3), cubemap=grey_cube(1.0))
    what = scene([], [glass(Model.TRACED)], [BALL], probes=(one,), environment=dome(0.5))
    picture = draw(what, tiers=("probe", "sky"), screen=mode)
    here = picture["mask"] > 0
    np.testing.assert_allclose(picture["weight.probe"][here], 0.3, atol=1e-6)
    np.testing.assert_allclose(picture["weight.sky"][here], 0.7, atol=1e-6)
    through = picture["refraction"][here] + picture["reflection"][here]
    np.testing.assert_allclose(through, 0.3 + 0.7 * 0.5, atol=1e-4)
    alone = draw(replace(what, environment=None), tiers=("probe", "sky"), screen=mode)
    np.testing.assert_allclose(alone["weight.none"][here], 0.7, atol=1e-6)
    np.testing.assert_allclose((alone["refraction"] + alone["reflection"])[here], 0.3, atol=1e-4)


def test_headroom_follows_hdrp() -> None:
    """Two probes of weight 0.8 and 0.4: the second finds room for 0.2 (fact sheet, 3.7)."""
    one = probe(weight=0.8, importance=2, cubemap=grey_cube(1.0), proxy=None)
    two = probe(weight=0.4, importance=1, cubemap=grey_cube(0.5), proxy=None)
    picture = draw(scene([], [glass(Model.TRACED)], [BALL], probes=(two, one)), tiers=("probe",))
    here = picture["mask"] > 0
    np.testing.assert_allclose(picture["weight.probe"][here], 1.0, atol=1e-6)
    light = (picture["refraction"] + picture["reflection"])[here]
    np.testing.assert_allclose(light, 0.8 * 1.0 + 0.2 * 0.5, atol=1e-4)


def test_many_probes_change_nothing_where_they_do_not_reach() -> None:
    walls, materials = position_room()
    ball = Sphere("/ball", (1.0, 0.4, 0.2), 0.5, 1)
    what = scene(walls, [*materials, glass(Model.TRACED)], [ball])
    here = probe((0.5, 0.2, 0.1))
    places = np.random.default_rng(1).uniform([-3, -3, -3], [-1, 3, 3], (255, 3)).tolist()
    others = tuple(
        probe(path=f"/p{i}", importance=9, cubemap=grey_cube(9.0), influence=volume((0.05,) * 3, (x, y, z)))
        for i, (x, y, z) in enumerate(places)
    )
    alone = draw(replace(what, probes=(here,)), tiers=("probe",))
    crowd = draw(replace(what, probes=(*others, here)), tiers=("probe",))
    np.testing.assert_array_equal(alone["beauty"], crowd["beauty"])


def test_near_things_stay_sharp_by_hdrps_distance_based_roughness() -> None:
    """The exit touches a wall of the proxy: s / |r| is small, so the option looks the cube up sharper (4.4)."""
    rng = np.random.default_rng(5)
    faces = np.zeros((6, 64, 64, 5), np.float32)
    faces[..., :3], faces[..., 3] = rng.random((6, 64, 64, 1)), 1.0
    contrast = {}
    for option in (False, True):
        one = probe((0, 0, 5.0), proxy=volume((3, 3, 3)), cubemap=Cubemap((faces,)), distance_roughness=option)
        ball = Sphere("/ball", (0, 0, -2.0), 0.9, 0)
        what = scene([], [glass(Model.TRACED, ROUGHNESS=0.5)], [ball], probes=(one,))
        lens = camera((0, 0, 2.5), (0, 0, -2), 0.15)
        picture = draw(replace(what, cameras=(lens,)), 48, 48, tiers=("probe",), screen="proxy")
        contrast[option] = float(picture["refraction"][12:36, 12:36, 0].std())
    assert contrast[True] > 1.5 * contrast[False]


def test_a_probes_picture_is_the_same_alone_and_among_others() -> None:
    """Noise included: a soft shadow under an area light, taken once alone and once as the second of two."""
    floor = quad("/floor", [(-3, -1, 3), (3, -1, 3), (3, -1, -3), (-3, -1, -3)], 0)
    lamp = light(LightKind.RECT, (0, 2.5, 0), (0, -1, 0), (1.5, 1.5), 4.0)
    block = box("/block", (0.4, 0.1, 0.4), 0, centre=(0.2, 0.5, 0))
    what = scene([floor, block], [material("/white", DIFFUSE=0.8)], lights=(lamp,))
    one, other = probe(path="/one", resolution=32), probe((0.5, 0, 0), path="/other", resolution=16)
    (alone,) = capture_probes(what, [one], samples=2)
    _, among = capture_probes(what, [other, one], samples=2)
    assert alone.levels[0][..., :3].std() > 0.01
    np.testing.assert_array_equal(alone.levels[0], among.levels[0])
