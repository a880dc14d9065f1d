"""Many exact spheres in one record: points, droplets, and sphere prototypes of instancers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import camera, constant_room, draw, glass, light, material, quad, scene
from test_instances import SQUARE, blurred, differing, looked

from refract_core.errors import SceneError
from refract_core.probes.digest import probe_digest
from refract_core.scene import Balls, LightKind, Model, Paths, Probe, Run, Scene, Source, Sphere, Volume
from refract_core.world.instances import settled, sphere
from refract_core.world.tables import pack_geometry

F32 = NDArray[np.float32]


def balls_of(count: int, material: int, seed: int = 0, **fields: Any) -> Balls:
    """Some, in a cube of 1 m."""
    rng = np.random.default_rng(seed)
    paths = Paths((Run(("/points/[", "]"), np.arange(count, dtype=np.int32)[:, None]),))
    centres, radii = rng.uniform(-0.5, 0.5, (count, 3)), rng.uniform(0.03, 0.12, count)
    return Balls(centres.astype(np.float32), radii.astype(np.float32), material, paths, **fields)


def two(a: tuple[float, float, float], b: tuple[float, float, float], radius: float, material: int = 0) -> Balls:
    """`/a` and `/b`."""
    return Balls(np.array([a, b], np.float32), np.full(2, radius, np.float32), material, Paths(("/a", "/b")))


def both_ways(of: Scene, balls: Balls) -> tuple[Scene, Scene]:
    return replace(of, balls=(balls,)), replace(of, spheres=tuple(sphere(balls, k) for k in range(len(balls))))


FLOOR = quad("/floor", [(-2, -0.8, 2), (2, -0.8, 2), (2, -0.8, -2), (-2, -0.8, -2)], 0)
LAMP = light(LightKind.SPHERE, (0, 2.5, 1), (0, -1, -0.4), (0.05, 0.0), 100.0)


def open_air(*materials: Any, **fields: Any) -> Scene:
    view = camera((0.3, 0.6, 2.5))
    return scene([FLOOR], [material("/white", DIFFUSE=0.8), *materials], lights=(LAMP,), cameras=(view,), **fields)


@pytest.mark.parametrize("model", [Model.NONE, Model.TRACED, Model.SPHERE])
def test_a_picture_of_many_spheres_is_that_of_single_ones(model: Model) -> None:
    colours = np.random.default_rng(1).uniform(0.1, 0.9, (40, 3)).astype(np.float32)
    tinted = Source(primvar="colour")
    if model is Model.NONE:
        what = material("/ball", DIFFUSE=tinted)
    else:
        what = glass(model, 1.4, TRANSMITTANCE=tinted, absorption_distance=0.1)
    a, b = both_ways(open_air(what), balls_of(40, 1, primvars={"colour": colours}))
    assert differing(draw(a, 64, 48), draw(b, 64, 48)) < 0.01


def test_each_is_a_thing_and_a_surface_of_its_own() -> None:
    balls = two((0, 0, 1), (0, 0, -1), 0.2)
    of = replace(scene([quad("/floor", SQUARE, 0)], [material("/m")]), balls=(balls,))
    numbers, vectors = looked(of, np.array([[0.0, 0, 3], [0, 0, 0.5]] * 4), np.array([[0, 0, -1.0]] * 8))
    assert numbers[:2, 0].tolist() == numbers[:2, 1].tolist() == [1, 2]
    np.testing.assert_allclose(vectors[:2, 0], [[0, 0, 1.2], [0, 0, -0.8]], atol=1e-7)


def test_normals_of_droplets_far_away_are_exact() -> None:
    """A drop of 1 mm, 30 m from the ray's start: float32 knows the distance to 4e-6 m, 0.4 % of the radius."""
    rng = np.random.default_rng(2)
    centres = np.array([[0, 0, 0]], np.float32)
    drop = Balls(centres, np.array([1e-3], np.float32), 0, Paths(("/a",)))
    of = replace(scene([quad("/floor", np.array(SQUARE) * 100.0, 0)], [material("/m")]), balls=(drop,))
    beside = rng.uniform(-7e-4, 7e-4, (64, 3))
    origins = np.concatenate([beside[:, :2], np.full((64, 1), 30.0)], axis=1).astype(np.float32).astype(np.float64)
    numbers, vectors = looked(of, origins, np.tile([0, 0, -1.0], (64, 1)))
    met = numbers[:, 0] == 1
    assert met.sum() > 40
    xy = origins[met, :2] / np.float64(np.float32(1e-3))
    truth = np.concatenate([xy, np.sqrt(1 - (xy**2).sum(axis=1, keepdims=True))], axis=1)
    np.testing.assert_allclose(vectors[met, 1], truth, atol=1e-9)


def test_photons_start_from_every_droplet() -> None:
    at = np.array([[-0.5, 0, 0], [0.5, 0, 0.2], [0.1, 0.2, -0.5]], np.float32)
    drops = Balls(at, np.array([0.2, 0.1, 0.15], np.float32), 1, Paths(("/a", "/b", "/c")))
    a, b = both_ways(open_air(glass(Model.TRACED, 1.33)), drops)
    settings: dict[str, Any] = {"samples": 4, "caustics": 1 << 16}
    p, q = (draw(of, 64, 64, **settings)["beauty"] for of in (a, b))
    assert p.mean() == pytest.approx(q.mean(), rel=0.02)
    assert np.abs(blurred(p) - blurred(q)).max() < 0.15 * blurred(q).max()


def test_an_eye_in_a_droplet_is_in_glass() -> None:
    walls, materials = constant_room()
    tinted = glass(Model.TRACED, 1.0, TRANSMITTANCE=(0.3, 0.6, 0.9), absorption_distance=0.5)
    of = replace(scene(walls, [*materials, tinted]), balls=(two((5, 0, 0), (0, 0, 2.5), 0.25, 1),))
    expected = np.broadcast_to([0.3, 0.6, 0.9], (8, 8, 3)) ** 0.5
    np.testing.assert_allclose(draw(of, 8, 8)["beauty"][..., :3], expected, rtol=1e-4)


def test_what_glows_lights_the_scene_as_single_ones() -> None:
    a, b = both_ways(replace(open_air(material("/bulb", EMISSIVE=20.0)), lights=()), balls_of(3, 1))
    assert len(settled(a).spheres) == 3
    np.testing.assert_array_equal(
        draw(a, 32, 32, emission_light=True)["beauty"], draw(b, 32, 32, emission_light=True)["beauty"]
    )


def test_links_tell_them_apart() -> None:
    lamp = replace(LAMP, lit=("/floor", "/b"), casters=("/b",))
    balls = two((-0.5, 0, 0), (0.5, 0, 0), 0.3)
    a, b = both_ways(replace(open_air(), lights=(lamp,)), balls)
    c, _ = both_ways(open_air(), balls)
    assert differing(draw(a), draw(b)) < 0.003 < differing(draw(a), draw(c))


def test_a_digest_does_not_hang_on_their_order_but_on_each() -> None:
    box_at = Volume(np.eye(4), False, (1.0, 1.0, 1.0))
    probe = Probe("/probe", "baked", (0.0, 0.0, 0.0), box_at, box_at)
    of, balls = open_air(), balls_of(5, 0)

    def digest(order: list[int], grow: float = 1.0) -> str:
        radii = balls.radii * np.array([grow, 1, 1, 1, 1], np.float32)
        other = replace(balls, centres=balls.centres[order], radii=radii[order])
        return probe_digest(replace(of, balls=(other,)), probe)

    assert digest([0, 1, 2, 3, 4]) == digest([3, 1, 4, 2, 0]) != digest([0, 1, 2, 3, 4], 1.01)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"radii": np.array([0.1, 0.0], np.float32)}, r"^/points/\[1\]: .*radius above 0"),
        ({"centres": np.array([[0, 0, 0], [0, np.nan, 0]], np.float32)}, r"^/points/\[1\]: .*finite"),
        ({"radii": np.ones(3, np.float32)}, "shape"),
        ({"material": 7}, "material"),
        ({"primvars": {"x": np.zeros((3, 1), np.float32)}}, "primvar x"),
    ],
)
def test_what_breaks_the_contract_is_refused(fields: dict[str, Any], words: str) -> None:
    with pytest.raises(SceneError, match=words):
        pack_geometry(replace(open_air(), balls=(replace(balls_of(2, 0), **fields),)))


def test_one_of_many_by_itself() -> None:
    balls = balls_of(3, 0, primvars={"x": np.arange(3, dtype=np.float32)[:, None], "y": np.ones((1, 1, 2), np.float32)})
    one = sphere(balls, 2)
    assert isinstance(one, Sphere)
    assert (one.path, one.primvars["x"].tolist(), one.primvars["y"].shape) == ("/points/[2]", [[[2.0]]], (1, 1, 2))
    assert one.radius == balls.radii[2]
