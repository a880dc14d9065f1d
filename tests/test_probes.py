"""Probes: the cube's geometry, what a capture holds, and where lookups land."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scenes import (
    ROOM,
    box,
    camera,
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

from refract_core.kernels.compile import kernel
from refract_core.kernels.lanes import by_address
from refract_core.probes.lookup import ProbeTable, cube_at
from refract_core.probes.plan import in_order
from refract_core.rendering.ready import Ready, prepare
from refract_core.rendering.work import Work
from refract_core.scene import Model, Probe, Scene, Sphere, Volume
from refract_core.settings import RenderSettings

F64 = NDArray[np.float64]

CENTRE = (0.0, 0.0, 0.0)


def volume(half: float | tuple[float, float, float], sphere: bool = False, centre: ArrayLike = CENTRE) -> Volume:
    m = np.eye(4)
    m[:3, 3] = centre
    x, y, z = (float(v) for v in np.broadcast_to(half, 3))
    return Volume(m, sphere, (x, y, z))


def probe(point: tuple[float, float, float] = CENTRE, **fields: Any) -> Probe:
    base = Probe("/probe", "baked", point, volume(ROOM), volume(ROOM), resolution=64, clipping=(0.01, 100.0))
    return replace(base, **fields)


def prepared(what: Scene, samples: int = 1) -> Ready:
    """Capture the probes of a scene as a picture would."""
    chosen = RenderSettings(samples=samples, tiers=("probe", "sky"), jobs=1)
    with ThreadPoolExecutor(1) as executor:
        return prepare(what, what.cameras[0], chosen, Work(executor, lambda _f, _s: None, lambda: False))


@kernel
def _look(table: ProbeTable, k: int, directions: F64, lod: float, out: F64) -> None:
    for i in range(directions.shape[0]):
        d = (directions[i, 0], directions[i, 1], directions[i, 2])
        out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4] = cube_at(table, k, d, lod)


def look(session: Ready, directions: F64, lod: float = 0.0, k: int = 0) -> F64:
    """Rows of (r, g, b, coverage, distance)."""
    out = np.empty((len(directions), 5))
    _look(by_address(session.probes), k, np.ascontiguousarray(directions), lod, out)
    return out


def directions(count: int, seed: int = 7) -> F64:
    d = np.random.default_rng(seed).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def with_probe(one: Probe, *more: Any) -> Scene:
    """The position room with a probe and a clear ball of ior 1, so that there is glass to serve."""
    walls, materials = position_room()
    ball = Sphere("/ball", (0.4, -0.3, 0.6), 0.7, 1)
    return scene([*walls, *more], [*materials, glass(Model.TRACED, 1.0)], [ball], probes=(one,))


# --- Capture --------------------------------------------------------------------------------------------------------


def test_a_capture_holds_what_geometry_says_is_there() -> None:
    """From the middle of a cube place is linear on each face, so bilinear lookups are exact but for the half texel
    where two faces meet. Distance is along the ray."""
    session = prepared(with_probe(probe()))
    d = directions(2000)
    inner = np.sort(np.abs(d), 1)[:, 1] / np.abs(d).max(1) < 1 - 2 / 64
    seen = look(session, d)
    np.testing.assert_allclose(where(seen)[inner], wall_hit(np.zeros(3), d)[inner], atol=1e-4)
    np.testing.assert_allclose(where(seen), wall_hit(np.zeros(3), d), atol=2 * ROOM / 64)
    np.testing.assert_allclose(seen[:, 3], 1.0, rtol=1e-6)
    np.testing.assert_allclose(seen[:, 4], np.linalg.norm(wall_hit(np.zeros(3), d), axis=1), rtol=2e-2)


def test_a_capture_stands_at_its_point() -> None:
    point = (0.7, -0.4, 1.1)
    d = directions(2000, 8)
    seen = where(look(prepared(with_probe(probe(point, resolution=128))), d))
    error = np.abs(seen - wall_hit(np.array(point), d)).max(1)
    # Where a face holds an edge of the room the texel that crosses it is off by up to its width, 4 m * 2 / 128.
    assert np.median(error) < 1e-3
    assert error.max() < 2 * 4.2 * 2 / 128


@pytest.mark.parametrize("lod", [0.0, 1.0, 2.5, 9.0])
def test_levels_of_a_constant_room_are_that_constant(lod: float) -> None:
    walls, materials = constant_room(0.6)
    rough = glass(Model.TRACED, ROUGHNESS=0.5)
    what = scene(walls, [*materials, rough], [Sphere("/ball", CENTRE, 0.5, 1)], probes=(probe(),))
    session = prepared(what)
    assert session.probes.last[0] == 6
    np.testing.assert_allclose(look(session, directions(300), lod)[:, :4], [[0.6, 0.6, 0.6, 1.0]] * 300, rtol=1e-5)


def test_smooth_glass_costs_no_levels() -> None:
    assert prepared(with_probe(probe())).probes.last[0] == 0


def test_a_background_stands_in_for_the_sky() -> None:
    """HDRP's clear mode: what meets nothing is the colour, and no sky shows through it."""
    floor = quad("/floor", [(-99, -1, 99), (99, -1, 99), (99, -1, -99), (-99, -1, -99)])
    one = probe(influence=volume(200.0), proxy=None, clipping=(0.01, 1000.0), background=(0.1, 0.2, 0.4))
    materials = [material("/m", EMISSIVE=0.3), glass(Model.TRACED)]
    what = scene([floor], materials, [Sphere("/ball", CENTRE, 0.5, 1)], environment=dome(2.0), probes=(one,))
    up = look(prepared(what), np.array([[0.1, 1.0, 0.2]]))[0]
    np.testing.assert_allclose(up[:4], [0.1, 0.2, 0.4, 1.0], rtol=1e-6)


def test_the_sky_is_left_out_and_marked() -> None:
    """A floor under a dome: coverage 1 below, 0 above, and no sky in the texels."""
    floor = quad("/floor", [(-99, -1, 99), (99, -1, 99), (99, -1, -99), (-99, -1, -99)])
    ball = Sphere("/ball", CENTRE, 0.5, 1)
    one = probe(influence=volume(200.0), proxy=None, clipping=(0.01, 1000.0))
    materials = [material("/m", EMISSIVE=0.3), glass(Model.TRACED)]
    what = scene([floor], materials, [ball], environment=dome(2.0), probes=(one,))
    down, up = np.array([[0.1, -1.0, 0.2]]), np.array([[0.1, 1.0, 0.2]])
    session = prepared(what)
    np.testing.assert_allclose(look(session, down)[0, :4], [0.3, 0.3, 0.3, 1.0], rtol=1e-5)
    np.testing.assert_array_equal(look(session, up)[0, :4], 0.0)


def test_glass_hides_from_probes_and_clipping_hides_the_near() -> None:
    """The ball of glass stands between the probe and a wall; a pillar nearer than the near plane is cut away."""
    near_card = quad("/card", [(-0.2, -0.2, -0.3), (0.2, -0.2, -0.3), (0.2, 0.2, -0.3), (-0.2, 0.2, -0.3)], 0)
    d = np.array([[0.4, -0.3, 0.6], [0.0, 0.0, -1.0]])
    open_view = look(prepared(with_probe(probe(clipping=(0.5, 100.0)), near_card)), d)
    np.testing.assert_allclose(where(open_view), wall_hit(np.zeros(3), d), atol=1e-3)
    closed = look(prepared(with_probe(probe(clipping=(0.1, 100.0)), near_card)), d)
    assert closed[1, 4] == pytest.approx(0.3, rel=1e-2)


def test_baked_probes_see_static_things_only() -> None:
    block = replace(box("/block", (0.2, 0.2, 0.2), 2, centre=(0, 0, -1)), static=False)
    walls, materials = position_room()
    ball = Sphere("/ball", (0.4, -0.3, 0.6), 0.7, 1)
    ahead = np.array([[0.0, 0.0, -1.0]])
    distances = {}
    for mode in ("baked", "realtime"):
        what = scene(
            [*walls, block], [*materials, glass(Model.TRACED), material("/m", EMISSIVE=1.0)], [ball],
            probes=(probe(mode=mode),),
        )  # fmt: skip
        distances[mode] = look(prepared(what), ahead)[0, 4]
    assert distances == pytest.approx({"baked": 3.0, "realtime": 0.8}, rel=1e-3)


def test_a_probe_sees_only_what_its_collection_names() -> None:
    block = box("/block", (0.2, 0.2, 0.2), 2, centre=(0, 0, -1))
    walls, materials = position_room()
    ball = Sphere("/ball", (0.4, -0.3, 0.6), 0.7, 1)
    one = probe(captured=tuple(wall.path for wall in walls))
    what = scene([*walls, block], [*materials, glass(Model.TRACED), material("/m")], [ball], probes=(one,))
    assert look(prepared(what), np.array([[0.0, 0.0, -1.0]]))[0, 4] == pytest.approx(3.0, rel=1e-3)


def test_a_probe_at_the_eye_reproduces_the_picture() -> None:
    """Pixels are looked up along the camera's own rays, in the position room: PSNR over 50 dB (8 bits give 59)."""
    lens = camera((0.5, 0.2, 1.0), (-0.3, -0.1, -1))
    one = probe((0.5, 0.2, 1.0), resolution=256)
    what = replace(with_probe(one), cameras=(lens,))
    walls, materials = position_room()
    picture = draw(scene(walls, materials, cameras=(lens,)), 48, 48)["beauty"][..., :3]
    _, d = view_rays(lens, 48, 48)
    seen = look(prepared(what), d.reshape(-1, 3))[:, :3].reshape(48, 48, 3)
    assert -10 * np.log10(((seen - picture) ** 2).mean()) > 50


# --- Lookup ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("point", [CENTRE, (1.0, 0.6, -0.8)])
def test_a_box_proxy_finds_the_point_of_the_wall_itself(point: tuple[float, float, float]) -> None:
    """Arm's local correction is exact where the proxy is the room: clear glass of ior 1 shows the straight view."""
    picture = draw(with_probe(probe(point, resolution=256)), tiers=("probe",))
    origin, d = view_rays(camera(), 64, 64)
    here = picture["mask"] > 0
    assert here.mean() > 0.1
    error = np.abs(where(picture["beauty"]) - wall_hit(origin, d)).max(-1)[here]
    assert np.median(error) < 1e-3
    assert error.max() < 2 * 4.5 * 2 / 256  # a texel across an edge of the room
    assert picture["confidence"][here].min() > 0.97


def test_without_a_proxy_only_the_direction_counts() -> None:
    picture = draw(with_probe(probe(proxy=None)), tiers=("probe",))
    _, d = view_rays(camera(), 64, 64)
    here = picture["mask"] > 0
    error = np.abs(where(picture["beauty"]) - wall_hit(np.zeros(3), d)).max(-1)[here]
    assert np.median(error) < 1e-2
    straight = wall_hit(*view_rays(camera(), 64, 64))
    assert np.median(np.abs(where(picture["beauty"]) - straight).max(-1)[here]) > 0.3


def test_the_more_important_probe_is_asked_first_then_the_smaller() -> None:
    """HDRP: importance, then volume, then order."""
    big, small, vip = probe(path="/big"), probe(path="/small", influence=volume(1.0)), probe(path="/vip", importance=2)
    again = probe(path="/again")
    assert [p.path for p in in_order([big, small, vip, again])] == ["/vip", "/small", "/big", "/again"]


def test_outside_its_influence_a_probe_is_silent() -> None:
    far = probe(influence=volume(0.5, centre=(0, 0, -2.4)))
    picture = draw(with_probe(far), tiers=("probe",))
    here = picture["mask"] > 0
    assert not picture["weight.probe"][here].any()
    np.testing.assert_allclose(picture["weight.none"][here], 1.0)


@pytest.mark.parametrize("weight", [0.25, 1.0])
def test_weight_and_multiplier(weight: float) -> None:
    """Weight shares with what follows; multiplier scales the colour."""
    picture = draw(with_probe(probe(weight=weight, multiplier=2.0)), tiers=("probe",))
    whole = draw(with_probe(probe()), tiers=("probe",))
    here = picture["mask"] > 0
    np.testing.assert_allclose(picture["weight.probe"][here], weight, rtol=1e-5)
    expected = 2 * weight * whole["refraction"][here]
    np.testing.assert_allclose(picture["refraction"][here], expected, rtol=1e-4, atol=1e-6)
