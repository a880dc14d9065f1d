"""What the program adds by itself goes wrong somewhere: no probe, no lamp, no light where the stage says enough."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import box, checker_room, draw, glass, light, material, quad, scene, shell

import refract_core as rc
from refract_core.scene import Environment, LightKind, Model, Probe, Sphere, Volume

TIERS = rc.RenderSettings().tiers
BALL = Sphere("/ball", (0.0, 0.0, 0.0), 0.6, 0)
F0 = 0.04  # ((1.5 - 1) / (1.5 + 1))^2


def _mirrored(walls: int) -> float:
    """What parallel interfaces send back, with all reflections between them (Stokes 1862)."""
    return walls * F0 / (1.0 + (walls - 1) * F0)


@pytest.mark.parametrize("model", [Model.SPHERE, Model.BOX, Model.THIN, Model.TRACED, Model.SINGLE])
def test_glass_alone_is_not_a_black_blob(model: Model) -> None:
    """A product without a stage around it: nobody knows what is behind, so the picture is left open there. A probe at
    its centre, which saw nothing, would answer black with full weight."""
    planes = draw(scene([], [glass(model)], [BALL]), 33, 33, tiers=TIERS, cut=1e-7)
    walls = 2 if model in (Model.THIN, Model.TRACED) else 1  # these mirror on their far side, too
    np.testing.assert_allclose(planes["weight.none"][16, 16], 1.0, atol=1e-6)
    np.testing.assert_allclose(planes["beauty"][16, 16, 3], _mirrored(walls), atol=1e-3)
    assert planes["beauty"][16, 16, :3].max() == 0.0


@pytest.mark.parametrize("roughness", [0.0, 0.4])
def test_several_walls_of_glass_alone_stay_open(roughness: float) -> None:
    """Four surfaces behind one another and nothing else: what the nearest cannot answer the next one cannot either, so
    more walls never make the picture more opaque than what they reflect."""
    panes = [quad(f"/pane{k}", [(-1, -1, -k), (1, -1, -k), (1, 1, -k), (-1, 1, -k)], 0) for k in range(4)]
    planes = draw(scene(panes, [glass(Model.THIN, ROUGHNESS=roughness)]), 33, 33, tiers=TIERS, cut=1e-7)
    assert planes["layers"][16, 16] == 4
    np.testing.assert_allclose(planes["beauty"][16, 16, 3], _mirrored(4), atol=1e-3)
    assert planes["beauty"][16, 16, :3].max() == 0.0


def test_a_probe_that_saw_nothing_answers_nothing() -> None:
    """A stage's own probe in the open: what its picture covers is what it knows."""
    room = Volume(np.eye(4), False, (5.0, 5.0, 5.0))
    alone = Probe("/probe", "realtime", (0.0, 0.0, 0.0), room, room, resolution=32, clipping=(0.01, 100.0))
    wall = quad("/wall", [(-9, -9, -4), (9, -9, -4), (9, 9, -4), (-9, 9, -4)], 1)
    kinds = [glass(Model.BOX), material("/wall", EMISSIVE=0.5)]
    for things, share in (([], 0.0), ([wall], 1.0)):
        planes = draw(scene(things, kinds, [BALL], probes=(alone,)), 33, 33, tiers=("probe",))
        np.testing.assert_allclose(planes["weight.probe"][16, 16], share, atol=1e-3)
        np.testing.assert_allclose(planes["weight.none"][16, 16], 1.0 - share, atol=1e-3)


def test_what_stands_in_hollow_glass_is_seen() -> None:
    """A candle in its holder: the holder's centre lies inside the candle, where a probe would see nothing."""
    walls, materials, textures = checker_room()
    holder = shell("/holder", 0.8, 0.7, 6, 24)
    candle = Sphere("/candle", (0.0, 0.0, 0.0), 0.35, 7)
    glow = material("/candle", EMISSIVE=(0.9, 0.6, 0.2))
    what = scene([*walls, holder], [*materials, glass(Model.TRACED), glow], [candle], textures=textures)
    seen, truth = draw(what, tiers=TIERS), draw(what, tiers=("ray", "sky"))
    np.testing.assert_allclose(seen["beauty"][32, 32, :3], np.array([0.9, 0.6, 0.2]) * (1.0 - F0), rtol=0.05)
    inside = truth["mask"] > 0
    assert np.abs(seen["beauty"] - truth["beauty"])[inside][:, :3].mean() < 0.05  # the march guesses at outlines


def test_a_light_of_no_radiance_changes_nothing_and_costs_no_ray() -> None:
    floor = quad("/floor", [(-2, -1, 2), (2, -1, 2), (2, -1, -2), (-2, -1, -2)], 0)
    lamp = light(LightKind.RECT, (0, 2, 0), (0, -1, 0), (1.0, 1.0), 2.0)
    dark = replace(lamp, radiance=(0.0, 0.0, 0.0))
    settings = rc.RenderSettings(image_width=32, image_height=32, samples=1, jobs=1)

    def frame(*lights: object) -> rc.Frame:
        return rc.render(scene([floor], [material("/grey", DIFFUSE=0.5)], lights=tuple(lights)), settings)

    one, both = frame(lamp), frame(lamp, dark)
    np.testing.assert_array_equal(one.planes["beauty"], both.planes["beauty"])
    assert one.metadata["refract:rays"] == both.metadata["refract:rays"]


def test_a_black_dome_covers_and_lights_nothing() -> None:
    floor = quad("/floor", [(-2, -1, 2), (2, -1, 2), (2, -1, -2), (-2, -1, -2)], 0)
    settings = rc.RenderSettings(image_width=32, image_height=32, samples=1, jobs=1)
    black = Environment(np.zeros((4, 8, 3), np.float32))
    one = rc.render(scene([floor], [material("/grey", DIFFUSE=0.5)]), settings)
    two = rc.render(scene([floor], [material("/grey", DIFFUSE=0.5)], environment=black), settings)
    assert one.metadata["refract:rays"] == two.metadata["refract:rays"]
    np.testing.assert_array_equal(one.planes["beauty"][..., :3], two.planes["beauty"][..., :3])
    assert (two.planes["beauty"][..., 3] == 1.0).all()


def test_the_camera_light_is_said_and_can_be_left_out() -> None:
    wall = quad("/wall", [(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], 0)
    what = scene([wall], [material("/grey", DIFFUSE=0.5)], camera_light=True)
    plain = rc.RenderSettings(image_width=8, image_height=8, samples=1, jobs=1, studio="none")
    on, off = rc.render(what, plain), rc.render(what, replace(plain, camera_light=False))
    assert [n.text for n in on.notices if "--disable-camera-light" in n.text]
    assert on.planes["beauty"][4, 4, :3].min() > 0.1
    assert not off.notices
    assert off.planes["beauty"][..., :3].max() == 0.0


def test_the_camera_light_burns_no_spot_into_glass_that_faces_it() -> None:
    """A slab before a wall that the eye's lamp lights, without shadows: the wall, 2 F / (1 + F) of it lost at the two
    faces."""
    wall = quad("/wall", [(-9, -9, -1), (9, -9, -1), (9, 9, -1), (-9, 9, -1)])
    slab = box("/slab", (0.6, 0.6, 0.1), 1)
    kinds = [material("/white", DIFFUSE=0.5, SPECULAR=0.0, IOR=1.0), glass(Model.TRACED, 1.5)]
    bare = draw(scene([wall], kinds, camera_light=True), 32, 32)["beauty"][14:18, 14:18, :3]
    seen = draw(scene([wall, slab], kinds, camera_light=True), 32, 32, cut=1e-4)["beauty"][14:18, 14:18, :3]
    reflected = (0.5 / 2.5) ** 2
    np.testing.assert_allclose(seen / bare, 1.0 - 2.0 * reflected / (1.0 + reflected), rtol=2e-3)
