"""The march through a depth buffer, and the light of a place that the picture shows, on buffers of known planes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from scenes import camera, view_rays

from refract_core.kernels.compile import kernel
from refract_core.kernels.lanes import by_address
from refract_core.scene import Camera
from refract_core.view.camera import view_of
from refract_core.view.pyramid import (
    Screen,
    blur_level,
    color_levels,
    depth_levels,
    fill_depth_levels,
    new_blur_scratch,
    new_screen_buffers,
)
from refract_core.view.screen import light_seen, march

F64 = NDArray[np.float64]

WIDTH, HEIGHT = 96, 64
LENS = camera((0, 0, 0), (0, 0, -1), aspect=1.5)
FLAT = camera((0, 0, 0), (0, 0, -1), fov=2.0, aspect=1.5, orthographic=True)


@kernel
def _march(screen: Screen, origins: F64, directions: F64, out: F64) -> None:
    for i in range(origins.shape[0]):
        o = (origins[i, 0], origins[i, 1], origins[i, 2])
        d = (directions[i, 0], directions[i, 1], directions[i, 2])
        hit = march(screen, o, d)
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = 1.0 if hit.found else 0.0, hit.x, hit.y, hit.distance


def shoot(screen: Screen, origins: ArrayLike, directions: ArrayLike) -> F64:
    """Rows of (found, px, py, hit distance)."""
    d = np.atleast_2d(np.asarray(directions, np.float64))
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    o = np.broadcast_to(np.asarray(origins, np.float64), d.shape).copy()
    out = np.empty((len(d), 4))
    _march(by_address(screen), o, d, out)
    return out


def picture_of(planes: list[tuple[ArrayLike, ArrayLike, float]], lens: Camera = LENS) -> Screen:
    """A depth buffer of square cards (centre, unit normal, half size), each seen from any side."""
    screen = new_screen_buffers(WIDTH, HEIGHT, False)
    origin, d = view_rays(lens, WIDTH, HEIGHT)
    depth = np.full((HEIGHT, WIDTH), np.inf)
    for centre, normal, half in planes:
        c, n = np.asarray(centre, np.float64), np.asarray(normal, np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((c - origin) @ n) / (d @ n)
        p = origin + d * t[..., None]
        z = -p[..., 2]
        seen = (t > 0) & (np.abs(p - c).max(-1) <= half) & (z < depth)
        depth[seen] = z[seen]
        screen.normal[seen] = np.where((d[seen] @ n)[:, None] < 0, n, -n)
    screen.depth[: WIDTH * HEIGHT] = depth.ravel()
    fill_depth_levels(screen.depth, screen.farthest, screen.depth_level)
    return Screen(view_of(lens, WIDTH, HEIGHT), *screen)


WALL = ((0, 0, -4), (0, 0, 1), 99.0)
FLOOR = ((0, -1, 0), (0, 1, 0), 99.0)


@kernel
def _light_seen(screen: Screen, points: F64, facing: F64, out: F64) -> None:
    for i in range(points.shape[0]):
        p = (points[i, 0], points[i, 1], points[i, 2])
        seen = light_seen(screen, p, (facing[0], facing[1], facing[2]), False)
        out[i, 0] = 1.0 if seen.known else 0.0
        for c in range(3):
            out[i, 1 + c], out[i, 4 + c] = seen.irradiance[c], seen.gloss[c]


def seen_at(screen: Screen, points: ArrayLike, facing: ArrayLike = (0, 0, 1)) -> F64:
    """Rows of (known, irradiance, gloss)."""
    at = np.atleast_2d(np.asarray(points, np.float64))
    out = np.empty((len(at), 7))
    _light_seen(by_address(screen), at, np.asarray(facing, np.float64), out)
    return out


def lit(screen: Screen) -> Screen:
    """Light that grows along both sides of the picture: as bilinear as what reads it."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    screen.irradiance[:] = np.stack([x, y, x + y], -1)
    screen.gloss[:] = np.stack([y, x, 2 * x], -1)
    return screen


@pytest.mark.parametrize("lens", [LENS, FLAT], ids=["perspective", "orthographic"])
def test_a_ray_to_a_wall_ends_on_its_plane(lens: Camera) -> None:
    """Rays from points before the wall to points of it that are on the screen: the hit is that point."""
    rng = np.random.default_rng(2)
    targets = np.stack([rng.uniform(-2.5, 2.5, 300), rng.uniform(-1.7, 1.7, 300), np.full(300, -4.0)], 1)
    starts = np.stack([rng.uniform(-0.8, 0.8, 300), rng.uniform(-0.6, 0.6, 300), rng.uniform(-3.5, -2, 300)], 1)
    found = shoot(picture_of([WALL], lens), starts, targets - starts)
    assert found[:, 0].all()
    np.testing.assert_allclose(found[:, 3], np.linalg.norm(targets - starts, axis=1), rtol=1e-5)
    scale = WIDTH / (lens.window[1] - lens.window[0]) / (1.0 if lens.orthographic else 4.0)
    np.testing.assert_allclose(found[:, 1], WIDTH / 2 + targets[:, 0] * scale, atol=1e-3)
    np.testing.assert_allclose(found[:, 2], HEIGHT / 2 - targets[:, 1] * scale, atol=1e-3)


def test_a_ray_to_a_floor_ends_on_its_plane() -> None:
    """A slanted plane, seen at every distance from 2 to 40 m."""
    rng = np.random.default_rng(3)
    z = -np.exp(rng.uniform(np.log(2.5), np.log(40), 300))
    targets = np.stack([rng.uniform(-0.5, 0.5, 300) * -z, np.full(300, -1.0), z], 1)
    starts = targets * 0.5 + np.stack([np.zeros(300), rng.uniform(0, 0.2, 300), np.zeros(300)], 1)
    found = shoot(picture_of([FLOOR]), starts, targets - starts)
    assert found[:, 0].mean() > 0.98
    here = found[:, 0] > 0
    np.testing.assert_allclose(found[here, 3], np.linalg.norm(targets - starts, axis=1)[here], rtol=1e-3)


def test_the_nearer_of_two_planes_is_hit() -> None:
    """A card of half size 0.5 at z = -3 before the wall: inside its outline (a pixel is 0.05 m there) it stops rays."""
    screen = picture_of([WALL, ((0, 0, -3), (0, 0, 1), 0.5)])
    x = np.linspace(-1.4, 1.4, 57)
    targets = np.stack([x, np.full(57, 0.01), np.full(57, -3.0)], 1)
    found = shoot(screen, (0, 0, -2), targets - [0, 0, -2])
    met = -2 + found[:, 3] * -1 / np.linalg.norm(targets - [0, 0, -2], axis=1)
    inside, outside = np.abs(x) < 0.44, np.abs(x) > 0.56
    assert found[inside, 0].all()
    np.testing.assert_allclose(met[inside], -3.0, atol=1e-4)
    # Beside the card a ray goes on to the wall, or is lost behind the card; it never stops at the card's depth.
    hit = outside & (found[:, 0] > 0)
    assert hit.sum() > 20
    np.testing.assert_allclose(met[hit], -4.0, atol=1e-4)


def test_a_ray_behind_a_card_does_not_hit_it() -> None:
    """Along x behind a card at z = -3, before the wall at -4: nothing on the screen is met."""
    screen = picture_of([WALL, ((0, 0, -3), (0, 0, 1), 0.5)])
    found = shoot(screen, (-1.2, 0.02, -3.5), (1, 0, 0))
    assert found[0, 0] == 0


@pytest.mark.parametrize(
    ("origin", "direction"),
    [
        ((0, 0, -2), (0.05, 0.02, 1)),  # towards the eye and past it
        ((0, 0, -2), (1, 0, 0)),  # out of the side, never behind the wall
        ((0, 0, -2), (0, 1, -0.2)),  # out of the top
        ((0, 0, 1), (0, 0, -1)),  # starts behind the eye
        ((9, 0, -2), (0, 0, -1)),  # starts off the screen
    ],
)
def test_rays_that_leave_the_picture_miss(origin: tuple[float, ...], direction: tuple[float, ...]) -> None:
    assert shoot(picture_of([WALL]), origin, direction)[0, 0] == 0


def test_a_surface_is_not_hit_from_behind() -> None:
    """From behind the wall towards the eye its other side, which the picture does not show, is not a hit."""
    assert shoot(picture_of([WALL]), (0.1, 0.1, -5), (0, 0, 1))[0, 0] == 0


def test_the_sky_is_missed() -> None:
    found = shoot(picture_of([((0, 0, -3), (0, 0, 1), 0.5)]), (0, 0, -2), [(0.9, 0.3, -1), (0, 0, -1)])
    assert found[:, 0].tolist() == [0, 1]


# --- The light of a place -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", [LENS, FLAT], ids=["perspective", "orthographic"])
def test_a_place_in_the_picture_is_lit_as_the_pixels_around_it(lens: Camera) -> None:
    rng = np.random.default_rng(7)
    x, y = rng.uniform(1, WIDTH - 2, 200), rng.uniform(1, HEIGHT - 2, 200)
    far = 1.0 if lens.orthographic else 4.0
    left, right, bottom, top = lens.window
    places = np.stack([
        far * (left + (right - left) * (x + 0.5) / WIDTH), far * (top + (bottom - top) * (y + 0.5) / HEIGHT),
        np.full(200, -4.0),
    ], 1)  # fmt: skip
    found = seen_at(lit(picture_of([WALL], lens)), places)
    np.testing.assert_allclose(found, np.stack([np.ones(200), x, y, x + y, y, x, 2 * x], 1), rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize(
    ("place", "facing"),
    [
        ((0.3, 0.2, -3.9), (0, 0, 1)), ((0.3, 0.2, -4.1), (0, 0, 1)), ((0.3, 0.2, -4), (0, 0, -1)),
        ((0.3, 0.2, -4), (0, 0.6, 0.8)), ((40, 0.2, -4), (0, 0, 1)), ((0.3, -40, -4), (0, 0, 1)),
        ((0, 0, 4), (0, 0, 1)),
    ],
    ids=["before", "behind", "back", "slanted", "beside", "below", "behind-the-eye"],
)  # fmt: skip
def test_a_place_of_another_surface_is_not_lit(place: tuple[float, ...], facing: tuple[float, ...]) -> None:
    assert not seen_at(lit(picture_of([WALL])), place, facing).any()


def test_at_an_edge_a_surface_is_lit_by_its_own_pixels() -> None:
    """Beside a card before a wall: the wall has its light as far as pixels show more of it than of the card."""
    screen = picture_of([WALL, ((0, 0, -2), (0, 0, 1), 0.5)])
    card = (screen.depth[: WIDTH * HEIGHT] < 3.0).reshape(HEIGHT, WIDTH)
    screen.irradiance[:] = np.where(card, 9.0, 0.7)[..., None]
    left, right, *_ = LENS.window
    pixel = WIDTH / (4.0 * (right - left))  # per metre of wall
    edge = np.flatnonzero(card[HEIGHT // 2]).max()  # the last pixel of the card in this row
    past_edge = np.linspace(-3.0, 3.0, 121)  # 0: halfway between the last pixel of the card and the first of the wall
    x = (edge + 1.0 + past_edge - WIDTH / 2) / pixel
    found = seen_at(screen, np.stack([x, np.full(121, 0.01), np.full(121, -4.0)], 1))
    clear = np.abs(past_edge) > 1e-3
    np.testing.assert_array_equal(found[clear, 0], (past_edge > 0)[clear])
    np.testing.assert_allclose(found[clear & (past_edge > 0), 1:4], 0.7, rtol=1e-6)


# --- Pyramids -------------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=30)
@given(width=st.integers(1, 70), height=st.integers(1, 70), seed=st.integers(0, 99))
def test_every_depth_cell_is_the_nearest_pixel_under_it(width: int, height: int, seed: int) -> None:
    levels = depth_levels(width, height)
    depth = np.zeros(int((levels[:, 1] * levels[:, 2]).sum()), np.float32)
    base = np.random.default_rng(seed).uniform(1, 9, (height, width)).astype(np.float32)
    base[0, 0] = np.inf
    depth[: width * height] = base.ravel()
    farthest = np.zeros_like(depth)
    fill_depth_levels(depth, farthest, levels)
    assert levels[-1, 1:].tolist() == [1, 1]
    for k, (first, w, h) in enumerate(levels):
        level = depth[first : first + w * h].reshape(h, w)
        for y in range(h):
            for x in range(w):
                cell = base[y << k : (y + 1) << k, x << k : (x + 1) << k]
                assert cell.size
                assert level[y, x] == cell.min()
                if k > 0:
                    x0, y0 = max(0, (x << k) - 1), max(0, (y << k) - 1)
                    ring = base[y0 : ((y + 1) << k) + 1, x0 : ((x + 1) << k) + 1]
                    assert farthest[first + y * w + x] == np.where(np.isfinite(ring), ring, 0).max()


def test_blurring_keeps_a_constant_and_spreads_a_spot() -> None:
    """Weights sum to 1 on every level; a spot in the middle keeps its energy (each level has a quarter the texels)."""
    levels = color_levels(64, 64, True)
    for value in ("constant", "spot"):
        color = np.zeros((int((levels[:, 1] * levels[:, 2]).sum()), 4), np.float32)
        if value == "constant":
            color[: 64 * 64] = 0.7
        else:
            color[:4096].reshape(64, 64, 4)[30:34, 30:34] = 1.0
        for k in range(1, 3):
            blur_level(color, levels, k, by_address(new_blur_scratch(levels)))
            first, w, h = levels[k]
            level = color[first : first + w * h]
            if value == "constant":
                np.testing.assert_allclose(level, 0.7, rtol=1e-5)
            else:
                assert level.sum() / 4 == pytest.approx(16 / 4**k, rel=1e-3)
                assert level.max() < 1.0


def test_what_is_left_in_the_working_memory_of_a_blur_does_not_show() -> None:
    """Levels of an odd size made in memory full of NaN, and again in what that left."""
    levels = color_levels(37, 21, True)
    color = np.zeros((int((levels[:, 1] * levels[:, 2]).sum()), 4), np.float32)
    color[: 37 * 21] = np.random.default_rng(5).random((37 * 21, 4))
    work = new_blur_scratch(levels)
    work.half[:] = work.across[:] = np.nan
    made = []
    for _ in range(2):
        for k in range(1, len(levels)):
            blur_level(color, levels, k, by_address(work))
        made.append(color.copy())
    assert np.isfinite(made[0]).all()
    np.testing.assert_array_equal(made[0], made[1])


def test_color_levels_halve_and_floor_until_small() -> None:
    """HDRP: halved and floored until both sides are below 8 pixels."""
    sizes = color_levels(100, 37, True)[:, 1:].tolist()
    assert sizes == [[100, 37], [50, 18], [25, 9], [12, 4], [6, 2]]
    assert len(color_levels(100, 37, False)) == 1
    assert math.prod(sizes[1]) == color_levels(100, 37, True)[2, 0] - color_levels(100, 37, True)[1, 0]
