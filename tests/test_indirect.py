"""Light between surfaces: against a closed form, and against quadrature in plain numpy."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import box, camera, draw, glass, light, material, quad, scene

import refract_core as rc
from refract_core.scene import LightKind, Mesh, Model, Scene
from refract_core.settings import RenderSettings

pytestmark = pytest.mark.draws

F64 = NDArray[np.float64]


def picture(what: Scene, side: int = 48, **settings: Any) -> F64:
    chosen = {"samples": 16, "tolerance": 0.03, "light_samples": 16, "emission_light": True, **settings}
    return draw(what, side, side, **chosen)["beauty"][..., :3].astype(np.float64)


# --- a furnace ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("indirect", ["off", "one", "full"])
def test_in_a_closed_room_that_glows_light_is_a_geometric_series(indirect: str) -> None:
    """Every wall emits L and sends back a share a of what arrives, pi L of it: L (1 + a + a^2 ..), everywhere."""
    glows, share = np.array([1.0, 0.5, 0.25]), np.array([0.4, 0.5, 0.7])
    walls = material("/walls", EMISSIVE=tuple(glows), DIFFUSE=tuple(share), IOR=1.0)
    room = box("/room", (1.5, 1.0, 2.0), 0)
    seen = picture(scene([room], [walls], cameras=(camera((0.3, 0.1, 1.2), (0, -0.2, -2), 1.2),)), indirect=indirect)
    series = {"off": 1 + share, "one": 1 + share + share**2, "full": 1 / (1 - share)}[indirect]
    np.testing.assert_allclose(seen, np.broadcast_to(glows * series, seen.shape), rtol=0.01)


# --- rooms with a card in them --------------------------------------------------------------------------------------


class Wall:
    """A rectangle: a corner, two sides, a normal and what it sends back."""

    def __init__(self, corner: Any, u: Any, v: Any, share: Any) -> None:
        self.corner, self.u, self.v = (np.array(x, np.float64) for x in (corner, u, v))
        across = np.cross(self.u, self.v)
        self.area = float(np.linalg.norm(across))
        self.normal, self.share = across / self.area, np.array(share)

    def mesh(self, path: str, index: int) -> Mesh:
        a, u, v = self.corner, self.u, self.v
        return quad(path, [a, a + u, a + u + v, a + v], index)

    def places(self, count: int) -> F64:
        at = (np.arange(count) + 0.5) / count
        s, t = np.meshgrid(at, at)
        return self.corner + s.reshape(-1, 1) * self.u + t.reshape(-1, 1) * self.v

    def blocks(self, a: F64, b: F64) -> NDArray[np.bool_]:
        """Whether it stands between points, shape (N, 3) each."""
        way = b - a
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((self.corner - a) @ self.normal) / (way @ self.normal)
            met = a + t[:, None] * way - self.corner
            s, w = met @ self.u / (self.u @ self.u), met @ self.v / (self.v @ self.v)
        return (t > 1e-6) & (t < 1 - 1e-6) & (s > 0) & (s < 1) & (w > 0) & (w < 1)


class Room:
    """Six walls that look inwards, a card in the air and a point light."""

    def __init__(self, seed: int) -> None:
        dice = np.random.default_rng(seed)
        x, y, z = dice.uniform(0.8, 1.6, 3)
        shares = dice.uniform(0.1, 0.9, (7, 3))
        u, v, w = (2 * x, 0, 0), (0, 2 * y, 0), (0, 0, 2 * z)
        low, high = (-x, -y, -z), ((x, -y, -z), (-x, y, -z), (-x, -y, z))
        sides = [(low, w, u), (high[1], u, w), (low, v, w), (high[0], w, v), (low, u, v), (high[2], v, u)]
        self.walls = [Wall(*side, share) for side, share in zip(sides, shares[:6], strict=True)]
        at = dice.uniform(-0.5, 0.1, 2)
        self.card = Wall((at[0], dice.uniform(-0.4, 0.2) * y, at[1]), (0, 0, 0.5), (0.5, 0, 0), shares[6])
        self.lamp = np.array([dice.uniform(-0.5, 0.5) * x, 0.6 * y, dice.uniform(-0.5, 0.5) * z])
        self.floor = y

    def scene(self) -> Scene:
        walls = [*self.walls, self.card]
        meshes = [wall.mesh(f"/wall{k}", k) for k, wall in enumerate(walls)]
        paint = [material(f"/paint{k}", DIFFUSE=tuple(wall.share), IOR=1.0) for k, wall in enumerate(walls)]
        lamp = light(LightKind.SPHERE, self.lamp, (0, -1, 0), (0.0, 0.0))
        eye = (0.0, -self.floor + 0.25, 0.0)
        lens = camera(eye, (0.0, -self.floor, 0.0), 1.2, orthographic=True)
        return scene(meshes, paint, lights=(replace(lamp, radiance=(1.0, 1.0, 1.0)),), cameras=(lens,))

    def direct(self, p: F64, n: F64) -> F64:
        way = self.lamp - p
        far = np.linalg.norm(way, axis=1)
        cosine = np.maximum(0.0, (way * n).sum(axis=1) / far)
        cosine[self.card.blocks(p, np.broadcast_to(self.lamp, p.shape))] = 0.0
        found: F64 = cosine / far**2
        return found

    def bounced(self, p: F64, n: F64, count: int = 60) -> F64:
        """Irradiance that comes by one surface, shape (3,), at one place, by the rule of rectangles."""
        total = np.zeros(3)
        for wall, side in [*((w, 1.0) for w in self.walls), (self.card, 1.0), (self.card, -1.0)]:
            at, facing = wall.places(count), side * wall.normal
            way = p - at
            far = np.linalg.norm(way, axis=1)
            near = np.maximum(far, 1e-9)
            form = np.maximum(0, way @ facing) * np.maximum(0, -way @ n) / near**4
            if wall is not self.card:
                form[self.card.blocks(at, np.broadcast_to(p, at.shape))] = 0.0
            sent = self.direct(at, np.broadcast_to(facing, at.shape))
            total += wall.share * (form * sent).sum() / np.pi * wall.area / count**2
        return total


@pytest.mark.parametrize("seed", range(6))
def test_rooms_are_lit_as_by_quadrature(seed: int) -> None:
    """Everything the floor gets by one surface, at the middles of pixels of a picture of it."""
    room = Room(seed)
    what = room.scene()
    ours = picture(what, 32, indirect="one") - picture(what, 32, indirect="off")
    lens = what.cameras[0]
    left, right, bottom, top = lens.window
    up = np.array([0.0, 1.0, 0.0])
    found, wanted = [], []
    for j, i in np.ndindex(16, 16):
        x, y = left + (2 * i + 0.5) / 32 * (right - left), top - (2 * j + 0.5) / 32 * (top - bottom)
        m = lens.world_from_camera
        p = m[:3, 3] + x * m[:3, 0] + y * m[:3, 1]
        p[1] = -room.floor
        around = p + (right - left) / 16 * np.array([(a, 0, b) for a in (-1, 0, 1) for b in (-1, 0, 1)])
        shaded = room.card.blocks(around, np.broadcast_to(room.lamp, around.shape))
        inside = np.all(np.abs(around[:, (0, 2)]) < -room.walls[0].corner[[0, 2]])
        if inside and shaded.all() == shaded.any():  # no edge of what arrives directly, which is not asked about
            wanted.append(room.bounced(p, up) * room.walls[0].share / np.pi)
            found.append(ours[2 * j, 2 * i])
    ratio = np.array(found) / np.array(wanted)
    assert len(ratio) > 80
    assert np.quantile(np.abs(ratio - 1), 0.99) < 0.13
    assert np.sqrt(np.square(ratio - 1).mean()) < 0.045
    assert np.abs(ratio.mean() - 1) < 0.025


def test_an_edge_between_walls_has_no_teeth() -> None:
    """Along the foot of a wall that is lit from below light changes as a slow curve does. Places there see something
    that is nearer than they may speak for, so what they say is not what is beside them: one alone was a dark tooth."""
    white = material("/white", DIFFUSE=0.8, IOR=1.0)
    floor = quad("/floor", [(-3, 0, 3), (3, 0, 3), (3, 0, -1), (-3, 0, -1)], 0)
    wall = quad("/wall", [(-3, 0, -1), (3, 0, -1), (3, 3, -1), (-3, 3, -1)], 0)
    lamp = light(LightKind.RECT, (0, 0.02, 0.6), (0, 1, 0), (0.4, 0.4), 5.0)
    lens = camera((0.1, 1.3, 1.0), (0.13, 0, -0.9), 0.2)
    what = scene([floor, wall], [white], lights=(lamp,), cameras=(lens,))
    beside = (picture(what, 96, indirect="one") - picture(what, 96, indirect="off"))[43:46, :, 0]  # the edge: above 42
    for row in beside:
        x = np.linspace(-1, 1, 96)
        assert np.std(row / np.polyval(np.polyfit(x, row, 3), x)) < 0.09


def test_light_goes_round_more_than_once() -> None:
    """`full` is brighter than `one`, by less than the walls that send back most would make it, everywhere."""
    room = Room(3)
    off, one, full = (picture(room.scene(), 16, indirect=name) for name in ("off", "one", "full"))
    most = max(float(wall.share.max()) for wall in [*room.walls, room.card])
    assert (one >= off - 1e-6).all()
    assert (full >= one * 0.98).all()
    assert full.mean() > 1.05 * one.mean()
    assert full.mean() - off.mean() < (one.mean() - off.mean()) / (1.0 - most)


def test_how_the_work_is_cut_up_changes_nothing() -> None:
    what = Room(4).scene()
    alone = picture(what, 40, indirect="one", jobs=1, tile_size=64)
    np.testing.assert_array_equal(picture(what, 40, indirect="one", jobs=3, tile_size=16), alone)


def test_a_session_draws_the_same_and_looks_around_again_where_something_moved() -> None:
    session = rc.Session()
    settings = RenderSettings(image_width=24, image_height=24, indirect="one", jobs=1)
    for what in (Room(5).scene(), Room(5).scene(), Room(6).scene()):
        kept = rc.render(what, settings, session=session).planes["beauty"]
        np.testing.assert_array_equal(kept, rc.render(what, settings).planes["beauty"])
    light_off = replace(Room(6).scene(), lights=())
    np.testing.assert_array_equal(rc.render(light_off, settings, session=session).planes["beauty"][..., :3], 0.0)


def test_what_is_seen_through_glass_of_air_is_lit_alike() -> None:
    """The place behind is found by rays, not by the picture."""
    what = Room(7).scene()
    eye = camera((0.0, 0.0, 0.4), (0.0, -0.3, -1.0), 0.6)
    bare = replace(what, cameras=(eye,))
    pane = box("/pane", (0.5, 0.5, 0.02), len(what.materials), centre=(0.0, -0.1, 0.1))
    through = replace(
        bare, meshes=(*bare.meshes, pane), materials=(*bare.materials, glass(Model.TRACED, 1.0)), camera_light=False
    )
    ours = picture(through, 32, indirect="one", tiers=("ray", "sky"))
    wanted = picture(bare, 32, indirect="one", tiers=("ray", "sky"))
    middle = np.s_[10:22, 10:22]
    assert np.median(np.abs(ours[middle] / wanted[middle] - 1.0)) < 0.01


def test_an_unknown_word_is_refused_by_name() -> None:
    with pytest.raises(rc.UsageError, match=r"indirect has 'some'.*off, one, full"):
        RenderSettings(indirect="some")
