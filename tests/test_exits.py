"""Walks through real meshes, seen in the colours of the position room, against a slow tracer written apart."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import (
    box,
    camera,
    constant_room,
    draw,
    glass,
    material,
    position_room,
    quad,
    scene,
    shell,
    trace_mesh,
    turned,
    view_rays,
    wall_hit,
    where,
)

from refract_core.optics.arrays import sphere_model
from refract_core.scene import Camera, Mesh, Model, Sphere

F64 = NDArray[np.float64]
SIZE = 24
DIRECT = 1.0
"""Cut that sends all light the way of what goes through: one path, whose end tells where it went."""


def picture_of(things: list[Mesh | Sphere], ior: float, lens: Camera, **inputs: Any) -> dict[str, NDArray[np.float32]]:
    walls, materials = position_room()
    meshes = [t for t in things if isinstance(t, Mesh)]
    balls = [t for t in things if isinstance(t, Sphere)]
    extra = [glass(Model.TRACED, ior, **inputs), material("/ember", EMISSIVE=0.25)]
    return draw(scene([*walls, *meshes], [*materials, *extra], balls, cameras=(lens,)), SIZE, SIZE, cut=DIRECT)


SOLIDS = {
    "slab": box("/slab", (1.5, 1.5, 0.25), 1),
    "cube": box("/cube", (0.5, 0.5, 0.5), 1, turned((1, 2, 3), 40)),
    "brick": box("/brick", (0.7, 0.3, 0.5), 1, turned((2, -1, 1), 25), (0.2, 0.1, 0.0)),
    "hollow shell": shell("/shell", 0.8, 0.5, 1),
}


@pytest.mark.parametrize("ior", [1.0, 1.33, 1.5, 2.0])
@pytest.mark.parametrize("name", list(SOLIDS))
def test_the_walk_is_the_slow_tracers_walk(name: str, ior: float) -> None:
    """Same wall, same path length, through any number of faces, total reflections and hollows.

    Rays near an edge may take another face by the last bit; one in fifty may differ, no more.
    """
    lens = camera((0.3, 0.9, 2.3), (0, 0, 0))
    mesh = SOLIDS[name]
    picture = picture_of([mesh], ior, lens)
    origin, d = view_rays(lens, SIZE, SIZE)
    seen = where(picture["refraction"])
    rows, reflections = [], 0
    for y, x in np.argwhere(picture["mask"] > 0):
        p, out, path, bounced = trace_mesh(mesh, ior, origin[y, x], d[y, x])
        if bounced > 12:  # trapped
            continue
        reflections += bounced
        rows.append((np.abs(wall_hit(p, out) - seen[y, x]).max(), abs(path - picture["path_length"][y, x])))
    assert len(rows) > 40
    errors = np.array(rows)
    assert (errors[:, 0] < 2e-3).mean() > 0.98
    assert (errors[:, 1] < 1e-3).mean() > 0.98
    if name in ("cube", "brick") and ior >= 1.5:
        assert reflections > 10  # total reflection is what these are here for


def test_a_glass_ball_walks_as_the_sphere_model_says() -> None:
    """Exact sphere, thickness = diameter: exit point, direction and length (HDRP's model is exact there)."""
    lens = camera((0.3, 0.9, 2.3), (0, 0, 0), fov=0.3)
    ball = Sphere("/ball", (0.1, 0.0, 0.1), 0.7, 1)
    picture = picture_of([ball], 1.5, lens)
    origin, d = view_rays(lens, SIZE, SIZE)
    c = np.array(ball.centre) - origin
    along = (c * d).sum(-1)
    inside = 0.49 - ((c * c).sum(-1) - along**2)
    here = inside > 0.49 * 0.05
    entry = (origin + d * (along - np.sqrt(np.maximum(inside, 0)))[..., None])[here]
    n = (entry - np.array(ball.centre)) / 0.7
    model = sphere_model(entry, n, -d[here], 1.5, 1.4)
    np.testing.assert_allclose(where(picture["refraction"])[here], wall_hit(model.point, model.direction), atol=1e-3)
    np.testing.assert_allclose(picture["path_length"][here], model.path_length, rtol=1e-4)


def test_an_opaque_thing_inside_is_seen() -> None:
    """An ember of radiance 0.25 in a glass cube: where the refracted ray meets it, its colour, and the way to it."""
    lens = camera((0, 0, 2.5), (0, 0, 0), fov=0.01)
    cube, ember = box("/cube", (0.5, 0.5, 0.5), 1), Sphere("/ember", (0, 0, 0), 0.2, 2)
    picture = picture_of([cube, ember], 1.5, lens)
    middle = np.s_[SIZE // 2 - 2 : SIZE // 2 + 2, SIZE // 2 - 2 : SIZE // 2 + 2]
    # Head-on, 0.5 - 0.2 of glass before the ember.
    np.testing.assert_allclose(picture["refraction"][middle], 0.25, rtol=1e-3)
    np.testing.assert_allclose(picture["path_length"][middle], 0.3, atol=2e-3)
    assert (picture["weight.ray"][middle] == 1).all()


def test_other_glass_on_the_way_bends_and_absorbs() -> None:
    """Two slabs one behind the other shift twice and absorb twice."""
    lens = camera((0.9, 0.6, 2.3), (0, 0, 0), fov=0.2)
    one = box("/one", (1.8, 1.8, 0.1), 1, centre=(0, 0, 0.4))
    two = box("/two", (1.8, 1.8, 0.1), 1, centre=(0, 0, -0.4))
    picture = picture_of([one, two], 1.5, lens, TRANSMITTANCE=(0.5, 0.5, 0.5), absorption_distance=0.4)
    origin, d = view_rays(lens, SIZE, SIZE)
    cos_t = np.sqrt(1 - (1 - d[..., 2] ** 2) / 2.25)
    flat = d[..., :2] / np.linalg.norm(d[..., :2], axis=-1, keepdims=True)
    inside, outside = np.sqrt(1 - cos_t**2) / cos_t, np.sqrt(1 - d[..., 2] ** 2) / -d[..., 2]
    np.testing.assert_allclose(picture["path_length"], 0.4 / cos_t, rtol=1e-4)
    np.testing.assert_allclose(picture["transmittance"][..., 0], 0.5 ** (1 / cos_t), rtol=1e-4)
    entry = origin + d * ((0.5 - origin[..., 2:]) / d[..., 2:])
    leave = entry - [0, 0, 1.0]
    leave[..., :2] += flat * (0.4 * inside + 0.6 * outside)[..., None]
    np.testing.assert_allclose(where(picture["refraction"] / picture["transmittance"]), wall_hit(leave, d), atol=2e-3)


def test_an_eye_inside_the_glass_sees_out() -> None:
    """The picture is finite and the room is there; no ray may be lost between the eye and the first face."""
    lens = camera((0, 0, 0.1), (0, 0, -1), fov=0.2)
    picture = picture_of([box("/cube", (1, 1, 1), 1)], 1.0, lens)
    origin, d = view_rays(lens, SIZE, SIZE)
    assert np.isfinite(picture["beauty"]).all()
    np.testing.assert_allclose(where(picture["beauty"]), wall_hit(origin, d), atol=1e-3)


def test_the_wrong_winding_is_still_a_walk_that_ends() -> None:
    """A cube turned inside out is glass all around but for the cube: what it shows is finite, the weights are whole
    where something goes through, and nothing has any where all is totally reflected."""
    cube = SOLIDS["cube"]
    picture = picture_of([replace(cube, triangles=cube.triangles[:, ::-1].copy())], 1.5, camera())
    assert np.isfinite(picture["beauty"]).all()
    total = np.sum([picture[f"weight.{k}"] for k in ("screen", "ray", "probe", "sky", "none")], axis=0)
    here, through = picture["mask"] > 0, picture["refraction"].any(-1)
    assert (here & through).any()
    assert (here & ~through).any()
    np.testing.assert_allclose(total, np.where(here & through, 1.0, 0.0), atol=1e-5)


def test_a_mesh_turned_inside_out_harms_no_other_glass() -> None:
    """View rays that meet a back face first go on to the next surface; those beside them keep the one they have."""
    ball = Sphere("/ball", (-0.6, 0.0, 0.0), 0.5, 1)
    cube = box("/cube", (0.4, 0.4, 0.4), 1, turned((1, 2, 3), 40), (0.6, 0.0, 0.0))
    wrong = replace(cube, triangles=cube.triangles[:, ::-1].copy())
    walls, materials = position_room()
    marble = glass(Model.SPHERE, THICKNESS=1.0)
    alone = draw(scene(walls, [*materials, marble], [ball]), max_layers=1)  # behind the ball no glass is looked for
    both = draw(scene([*walls, wrong], [*materials, marble], [ball]), max_layers=1)
    here = alone["mask"] > 0
    assert here.mean() > 0.05
    assert ((both["mask"] > 0) & ~here).mean() > 0.05
    for name in ("beauty", "layers", "mask", "path_length"):
        np.testing.assert_array_equal(both[name][here], alone[name][here], err_msg=name)


def test_a_pane_absorbs_the_same_seen_directly_and_on_the_way_of_a_ray() -> None:
    """Behind clear glass of ior 1 it is met by a walk. Its colour holds for one crossing: at 60 degrees and n = 1.5 the
    way inside is 1 / cos(t) as long, cos(t)^2 = 1 - 0.75 / 2.25 (Snell)."""
    walls, materials = constant_room()
    turn = turned((0, 1, 0), 60)
    corners = np.array([(-2, -2, 0), (2, -2, 0), (2, 2, 0), (-2, 2, 0)]) @ turn.T
    pane = quad("/pane", corners, 1)
    slab = box("/slab", (1, 1, 0.1), 2, centre=(0, 0, 1.8))
    kinds = [*materials, glass(Model.THIN, 1.5, TRANSMITTANCE=0.5), glass(Model.TRACED, 1.0)]
    expected = 0.5 ** (1.0 / math.sqrt(1.0 - 0.75 / 2.25))
    eye = camera(fov=0.02, orthographic=True)
    for things in ([pane], [pane, slab]):
        planes = draw(scene([*walls, *things], kinds, cameras=(eye,)), 9, 9, cut=DIRECT)
        np.testing.assert_allclose(planes["transmittance"][4, 4], expected, rtol=1e-4)
