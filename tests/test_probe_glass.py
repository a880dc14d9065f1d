"""Realtime probes that see glass (`probe:captureRefraction`): what their pictures hold."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import (
    ROOM,
    box,
    camera,
    checker_room,
    constant_room,
    dome,
    draw,
    glass,
    material,
    position_room,
    quad,
    scene,
    view_rays,
    wall_hit,
    where,
)
from test_probes import directions, look, probe

import refract_core as rc
from refract_core.rendering.picture import glass_over
from refract_core.rendering.ready import Ready, prepare
from refract_core.rendering.work import Work
from refract_core.scene import Camera, Material, Mesh, Model, Scene, Sphere
from refract_core.settings import RenderSettings

pytestmark = pytest.mark.draws

F64 = NDArray[np.float64]
SLAB = box("/slab", (2.5, 2.5, 0.2), 1, centre=(0, 0, -1.5))
"""Between the probe and the wall at -z."""
AHEAD = np.array([[0.0, 0.0, -1.0], [0.3, 0.2, -1.0], [-0.5, 0.4, -1.0]])


def prepared(what: Scene, **settings: Any) -> Ready:
    """Capture the probes of a scene as a picture does."""
    chosen = RenderSettings(**{"samples": 1, "tiers": ("probe", "sky"), "jobs": 1, **settings})
    with ThreadPoolExecutor(1) as executor:
        work, lens = Work(executor, lambda _f, _s: None, lambda: False), what.cameras[0]
        return prepare(what, lens, chosen, work, glass_over(what, lens, chosen, work))


def with_slab(kind: Material, *things: Mesh, **fields: Any) -> Scene:
    """The position room, a slab of glass before a wall, and a probe in the middle that sees glass."""
    walls, materials = position_room()
    one = probe(mode="realtime", sees_glass=True, **fields)
    return scene([*walls, SLAB, *things], [*materials, kind], probes=(one,))


def test_glass_of_ior_one_changes_no_texel() -> None:
    what = with_slab(glass(Model.TRACED, 1.0))
    without = replace(what, probes=(replace(what.probes[0], sees_glass=False),))
    d = directions(2000)
    seen, bare = (look(prepared(one), d) for one in (what, without))
    np.testing.assert_allclose(seen[:, :4], bare[:, :4], atol=2e-5)


def test_glass_absorbs_in_the_picture_and_stands_where_it_is() -> None:
    """Beer and Lambert through a slab of ior 1; the distance is that of the glass, not of the wall behind it."""
    tint = np.array([0.8, 0.5, 0.2])
    what = with_slab(glass(Model.TRACED, 1.0, TRANSMITTANCE=tuple(tint), absorption_distance=0.4), resolution=256)
    seen = look(prepared(what), AHEAD)
    slant = np.linalg.norm(AHEAD, axis=1)
    wall = (wall_hit(np.zeros(3), AHEAD) / ROOM + 1) / 2
    np.testing.assert_allclose(seen[:, :3], wall * tint ** slant[:, None], rtol=3e-3)
    np.testing.assert_allclose(seen[:, 4], 1.3 * slant, rtol=3e-3)


def test_the_picture_is_the_one_that_a_camera_there_takes() -> None:
    """Of a ball of glass in a checkered room, from the capture point, turned against the cube: PSNR above 30 dB."""
    walls, materials, textures = checker_room()
    ball = Sphere("/ball", (0.4, 0.3, -1.6), 0.9, 6)
    eye = (-0.2, 0.1, 0.4)
    lens = camera(eye, (0.4, 0.3, -1.6), fov=0.6)
    one = probe(eye, mode="realtime", sees_glass=True, resolution=512)
    what = scene(walls, [*materials, glass(Model.TRACED)], [ball], textures=textures, cameras=(lens,), probes=(one,))
    picture = draw(what, 96, 96, samples=16)
    assert 0.3 < picture["mask"].mean() < 0.9
    _, d = view_rays(lens, 96, 96)
    seen = look(prepared(what, samples=4), d.reshape(-1, 3))[:, :3].reshape(96, 96, 3)
    assert -10 * np.log10(((seen - picture["beauty"][..., :3]) ** 2).mean()) > 30
    bare = replace(what, probes=(replace(one, sees_glass=False),))
    blind = look(prepared(bare, samples=4), d.reshape(-1, 3))[:, :3].reshape(96, 96, 3)
    assert -10 * np.log10(((blind - picture["beauty"][..., :3]) ** 2).mean()) < 15


def test_what_the_collection_leaves_out_is_not_there() -> None:
    """The glass that the probe is to serve, for one; other glass stays."""
    tint = glass(Model.TRACED, 1.0, TRANSMITTANCE=0.5, absorption_distance=0.4)
    other = box("/other", (2.5, 0.2, 2.5), 1, centre=(0, -1.5, 0))
    what = with_slab(tint, other, captured=("/other", *(f"/wall{k}" for k in range(6))))
    seen = look(prepared(what), np.array([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0]]))
    np.testing.assert_allclose(where(seen[:1]), [[0, 0, -ROOM]], atol=0.05)
    np.testing.assert_allclose(seen[1, :3], [0.25, 0.0, 0.25], atol=0.01)


@pytest.mark.parametrize(("sky", "background", "shown", "cover"), [
    (0.5, None, 0.5, 1.0), (None, None, 0.0, 0.0), (None, (0.3, 0.3, 0.3), 0.3, 1.0), (0.5, (0.3, 0.3, 0.3), 0.3, 1.0),
])  # fmt: skip
def test_through_glass_in_the_open(sky: float | None, background: Any, shown: float, cover: float) -> None:
    """The sky shows through where there is one; else the picture is open, or of the background's colour."""
    floor = quad("/floor", [(-9, -2, 9), (9, -2, 9), (9, -2, -9), (-9, -2, -9)], 0)
    one = probe(mode="realtime", sees_glass=True, background=background)
    what = scene(
        [floor, SLAB], [material("/m"), glass(Model.TRACED, 1.0)], probes=(one,),
        environment=None if sky is None else dome(sky),
    )  # fmt: skip
    seen = look(prepared(what), AHEAD)
    np.testing.assert_allclose(seen[:, :4], [[shown, shown, shown, cover]] * 3, atol=1e-3)


@pytest.mark.parametrize(("layers", "tiers", "told"), [(1, "probe", 0), (2, "probe", 1), (2, "ray", 0)])
def test_glass_that_rays_meet_as_well_is_told(layers: int, tiers: str, told: int) -> None:
    what = with_slab(glass(Model.TRACED, 1.0), resolution=8)
    settings = RenderSettings(image_width=8, samples=1, jobs=1, max_layers=layers, tiers=(tiers,))
    assert [notice.path for notice in rc.render(what, settings).notices] == ["/probe"] * told


def test_glass_sees_glass_through_such_a_probe() -> None:
    """A pane shows, by the probe, what rays show through it: a green slab that a blind probe leaves out."""
    walls, materials = constant_room()
    green = glass(Model.TRACED, 1.0, TRANSMITTANCE=(0.3, 1.0, 0.3), absorption_distance=0.4)
    pane = quad("/pane", [(-2, -2, 2), (2, -2, 2), (2, 2, 2), (-2, 2, 2)], 2)
    lens: Camera = camera((0, 0, 2.5), fov=0.2)
    one = probe((0.0, 0.0, 1.9), mode="realtime", sees_glass=True)
    what = scene(
        [*walls, SLAB, pane], [*materials, green, glass(Model.THIN, 1.0)], cameras=(lens,), probes=(one,)
    )
    by_ray = draw(what, 24, 24, tiers=("ray",))["beauty"][..., :3]
    seen = draw(what, 24, 24, tiers=("probe",), max_layers=1)["beauty"][..., :3]
    blind = draw(replace(what, probes=(replace(one, sees_glass=False),)), 24, 24, tiers=("probe",), max_layers=1)
    assert by_ray[..., 0].max() < 0.35
    np.testing.assert_allclose(seen, by_ray, atol=0.01)
    assert (blind["beauty"][..., 0] > 0.99).all()
