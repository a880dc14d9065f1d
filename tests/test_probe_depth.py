"""Probes that march their own distances (`probe:proxy = depth`): where rays end, and what that gives in a picture."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import ROOM, box, camera, dome, draw, glass, material, position_room, quad, scene, wall_hit
from test_probes import directions, prepared, probe

from refract_core.images.cubemaps import read_cubemap, write_cubemap
from refract_core.kernels.compile import kernel
from refract_core.kernels.lanes import by_address
from refract_core.probes.depth import meet_depths
from refract_core.probes.lookup import ProbeTable
from refract_core.probes.volumes import INFINITE_DISTANCE
from refract_core.rendering.ready import Ready, capture_probes
from refract_core.scene import Mesh, Model, Probe, Scene, Sphere

F64 = NDArray[np.float64]
B1 = NDArray[np.bool_]

LOW, HIGH = np.array([-0.9, -3.0, -1.4]), np.array([0.1, -0.6, -0.5])
BLOCK = box("/block", (HIGH - LOW) / 2, 2, centre=(HIGH + LOW) / 2)
"""Stands on the floor of the room."""
EYE = (0.6, 0.3, 0.9)
"""Where the probe's picture is taken."""
SIDE = 128


@kernel
def _meet_all(table: ProbeTable, origins: F64, rays: F64, out: F64) -> None:
    for i in range(rays.shape[0]):
        o, d = (origins[i, 0], origins[i, 1], origins[i, 2]), (rays[i, 0], rays[i, 1], rays[i, 2])
        eye = (table.capture[0, 0], table.capture[0, 1], table.capture[0, 2])
        met = meet_depths(table.depths, 0, table.side[0, 0], eye, o, d)
        out[i, 0], out[i, 1] = 1.0 if met.known else 0.0, met.distance


def meet(session: Ready, origins: F64, rays: F64) -> tuple[B1, F64]:
    """Whether the picture shows where each ray ends, and how far away that is [m]."""
    out = np.empty((len(rays), 2))
    _meet_all(by_address(session.probes), np.ascontiguousarray(origins), np.ascontiguousarray(rays), out)
    return out[:, 0] == 1.0, out[:, 1]


def furnished(*more: Mesh, side: int = SIDE, **fields: Any) -> Scene:
    """The position room with a black block in it, a probe that marches, and a pane of nothing before the camera."""
    walls, materials = position_room()
    one = probe(EYE, marched=True, resolution=side, **fields)
    pane = quad("/pane", [(-2, -2, 2), (2, -2, 2), (2, 2, 2), (-2, 2, 2)], 1)
    stuff = [*materials, glass(Model.THIN, 1.0), material("/block", EMISSIVE=(0.2, 0.4, 0.6))]
    return scene([*walls, pane, BLOCK, *more], stuff, probes=(one,))


class Truth(NamedTuple):
    """Where rays in the furnished room end, by Kay and Kajiya's slabs."""

    distance: F64
    """[m]"""
    on_block: B1
    slant: F64
    """cosine under which the eye of the probe sees that place"""
    seen: B1
    """by that eye"""


def slabs(origins: F64, rays: F64) -> tuple[F64, F64]:
    """Distances at which rays enter and leave the block."""
    a, b = (LOW - origins) / rays, (HIGH - origins) / rays
    return np.minimum(a, b).max(1), np.maximum(a, b).min(1)


def truth(origins: F64, rays: F64) -> Truth:
    enter, leave = slabs(origins, rays)
    wall = np.linalg.norm(wall_hit(origins, rays) - origins, axis=1)
    on_block = (enter < leave) & (enter > 0)
    distance = np.where(on_block, enter, wall)
    place = origins + rays * distance[:, None]
    towards = place - np.array(EYE)
    far = np.linalg.norm(towards, axis=1)
    towards /= far[:, None]
    enter, leave = slabs(np.broadcast_to(np.array(EYE), place.shape), towards)
    middle, half = (LOW + HIGH) / 2, (HIGH - LOW) / 2
    out = np.where(on_block[:, None], np.abs(place - middle) / half, np.abs(place) / ROOM)
    axis = out.argmax(1)
    sign = np.sign((place - np.where(on_block[:, None], middle, 0.0))[np.arange(len(axis)), axis])
    slant = towards[np.arange(len(axis)), axis] * sign * np.where(on_block, -1, 1)
    return Truth(distance, on_block, slant, ~((enter < leave) & (enter > 0) & (enter < far - 1e-6)) & (slant > 0))


def random_rays(count: int, seed: int) -> tuple[F64, F64]:
    """From places in the room and outside of the block."""
    places = np.random.default_rng(seed).uniform(-0.98 * ROOM, 0.98 * ROOM, (4 * count, 3))
    places = places[~((places > LOW - 0.02) & (places < HIGH + 0.02)).all(1)][:count]
    return places, directions(count, seed + 1)


# --- Where rays end ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("eye", [(0.0, 0.0, 0.0), EYE, (-2.0, 1.7, -1.2)])
def test_in_an_empty_room_every_ray_ends_on_the_wall_that_it_meets(eye: tuple[float, float, float]) -> None:
    """Planes are followed exactly: 1 / depth is affine on them. Only where a texel holds an edge of the room is it off
    by that texel."""
    walls, materials = position_room()
    ball = Sphere("/ball", (0.0, 0.0, 0.0), 0.5, 1)
    one = probe(eye, marched=True, resolution=SIDE)
    session = prepared(scene(walls, [*materials, glass(Model.TRACED)], [ball], probes=(one,)))
    origins, rays = random_rays(4000, 3)
    known, distance = meet(session, origins, rays)
    assert known.all()
    error = np.abs(distance - np.linalg.norm(wall_hit(origins, rays) - origins, axis=1))
    assert np.median(error) < 1e-5
    assert np.quantile(error, 0.9) < 1e-3
    texel = 2 / SIDE * (ROOM + max(map(abs, eye))) * math.sqrt(3)
    assert np.quantile(error, 0.99) < texel


@pytest.mark.parametrize("side", [64, 128, 256])
def test_what_the_probe_sees_is_met_where_ray_tracing_meets_it(side: int) -> None:
    """The error is at most what the picture's texels are wide there, but for the rim of the block: a ray that is met
    within a texel of it is missed."""
    session = prepared(furnished(side=side))
    origins, rays = random_rays(20000, 11)
    known, distance = meet(session, origins, rays)
    true = truth(origins, rays)
    fair = true.seen & (true.slant > 0.2)
    assert (fair & true.on_block).sum() > 100
    place, found = origins + rays * true.distance[:, None], origins + rays * distance[:, None]
    # As an angle at the probe's eye, in texels.
    off = np.linalg.norm(np.cross(place - EYE, found - EYE), axis=1)
    off /= np.linalg.norm(place - EYE, axis=1) * np.linalg.norm(found - EYE, axis=1) * (2 / side)
    for here in (fair & ~true.on_block, fair & true.on_block):
        assert (known[here] & (off[here] < 1.0)).mean() > 1.0 - 10.0 / side


def test_what_the_probe_does_not_see_it_does_not_answer() -> None:
    """Of what lies in the block's shadow the picture knows nothing, and little of the block's far sides: where a ray
    comes in by one and out by another, both unseen, it might as well have passed behind the block."""
    session = prepared(furnished())
    origins, rays = random_rays(20000, 23)
    known, _ = meet(session, origins, rays)
    true = truth(origins, rays)
    for on_block, most in ((False, 0.01), (True, 0.4)):
        hidden = ~true.seen & (true.on_block == on_block) & (np.abs(true.slant) > 0.1)
        assert hidden.sum() > 100
        assert known[hidden].mean() < most


def test_a_ray_into_the_open_meets_nothing() -> None:
    """Over a floor under the sky: upwards nothing, downwards the floor, from the capture point itself, too."""
    floor = quad("/floor", [(-99, -1, 99), (99, -1, 99), (99, -1, -99), (-99, -1, -99)])
    ball = Sphere("/ball", (0.0, 0.0, 0.0), 0.5, 1)
    one = probe(marched=True, proxy=None, clipping=(0.01, 1000.0))
    what = scene([floor], [material("/m"), glass(Model.TRACED)], [ball], environment=dome(1.0), probes=(one,))
    session = prepared(what)
    rays = directions(500, 5)
    for origins in (np.zeros((500, 3)), np.full((500, 3), 0.37)):
        known, distance = meet(session, origins, rays)
        assert (known & (distance == INFINITE_DISTANCE))[rays[:, 1] > 0.01].all()
        down = rays[:, 1] < -0.2
        assert known[down].all()
        np.testing.assert_allclose(distance[down], (origins[down, 1] + 1) / -rays[down, 1], rtol=1e-2)


def test_a_ray_that_leaves_what_it_starts_on_gets_away() -> None:
    """From a hundredth of a millimetre over the floor, which the picture knows to a texel."""
    session = prepared(furnished(side=64))
    count = 500
    dice = np.random.default_rng(2)
    origins = np.stack([dice.uniform(0.5, 2.5, count), np.full(count, 1e-5 - ROOM), dice.uniform(-2.5, 2.5, count)], 1)
    rays = directions(count, 9)
    rays[:, 1] = np.abs(rays[:, 1]) + 0.05
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    known, distance = meet(session, origins, rays)
    true = truth(origins, rays)
    fair = true.seen & (true.slant > 0.2)
    assert fair.sum() > 100
    off = np.abs(distance - true.distance) < 0.05 * true.distance
    assert (known & off)[fair].mean() > 0.9


# --- Pictures ---------------------------------------------------------------------------------------------------------


def test_the_block_stands_in_the_room_and_is_not_drawn_flat_on_its_wall() -> None:
    """Through a pane that is not there: what rays meet, where the probe knows it; a box proxy the size of the room
    moves the block by as much as it stands before the wall."""
    lens = camera((-1.6, 1.0, 2.6), (-0.4, -1.5, -1.0), fov=0.5)
    what = replace(furnished(), cameras=(lens,))
    flat = replace(what, probes=(replace(what.probes[0], marched=False),))
    cases = ((what, "ray"), (what, "probe"), (flat, "probe"))
    by_ray, marched, boxed = (draw(one, 96, 96, tiers=(tier,)) for one, tier in cases)
    assert (by_ray["mask"] > 0).all()
    is_block = np.abs(by_ray["beauty"][..., :3] - (0.2, 0.4, 0.6)).max(-1) < 1e-4
    assert 0.1 < is_block.mean() < 0.5
    np.testing.assert_allclose(marched["weight.probe"], 1.0, atol=1e-5)
    knows = marched["confidence"] > 0
    assert 0.02 < 1 - knows.mean() < 0.6
    assert knows[is_block].mean() > 0.3
    # Where nobody else knows either it guesses by its volume.
    np.testing.assert_allclose(marched["beauty"][~knows], boxed["beauty"][~knows], atol=1e-5)
    wrong = {}
    for name, planes in (("marched", marched), ("boxed", boxed)):
        wrong[name] = np.abs(planes["beauty"][..., :3] - by_ray["beauty"][..., :3]).max(-1) > 0.02
    assert (wrong["marched"] & knows).mean() < 0.03
    assert wrong["boxed"].mean() > 0.15
    assert (marched["confidence"][knows & ~wrong["marched"]] > 0.95).mean() > 0.95


def test_what_the_probe_does_not_know_the_next_tier_answers() -> None:
    lens = camera((-1.6, 1.0, 2.6), (-0.4, -1.5, -1.0), fov=0.5)
    what = replace(furnished(), cameras=(lens,))
    picture, real = (draw(what, 64, 64, tiers=tiers) for tiers in (("probe", "ray"), ("ray",)))
    blind = picture["weight.ray"] > 0.999
    assert 0.02 < blind.mean() < 0.6
    np.testing.assert_allclose(picture["beauty"][blind], real["beauty"][blind], atol=1e-4)
    assert picture["weight.none"].max() < 1e-6


@pytest.mark.parametrize("layout", ["strip", "cross"])
def test_a_bake_keeps_the_distances(tmp_path: Any, layout: str) -> None:
    """What a file brought along is marched as what was just taken."""
    what = furnished(side=64)
    (cube,) = capture_probes(what, what.probes, samples=1, jobs=1)
    path = str(tmp_path / "probe.exr")
    write_cubemap(path, cube, layout)
    read = read_cubemap(path, path, 64)
    baked: Probe = replace(what.probes[0], cubemap=read)
    origins, rays = random_rays(500, 31)
    (known, distance), (again, same) = (
        meet(prepared(one), origins, rays) for one in (what, replace(what, probes=(baked,)))
    )
    np.testing.assert_array_equal(again, known)
    np.testing.assert_allclose(same, distance, rtol=1e-5)
