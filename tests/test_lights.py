"""Closed-form light against quadrature, and against what a rendered white floor shows."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scenes import box, camera, draw, light, material, quad, scene

from refract_core.kernels.compile import kernel
from refract_core.kernels.pointer import Pointer
from refract_core.scene import Light, LightKind, Mesh, Model, Scene, Shadow, Shaping
from refract_core.world.lamps import _picture_levels, pack_lights
from refract_core.world.lights import irradiance_factor
from refract_core.world.polygon import _angle_over_sine
from refract_core.world.shaping import shape_matt

pytestmark = pytest.mark.draws

F64 = NDArray[np.float64]

FLOOR = [(-50, 0, 50), (50, 0, 50), (50, 0, -50), (-50, 0, -50)]
WHITE = material("/white", DIFFUSE=1.0)


@kernel
def _factors(lights, points, normals, out):  # type: ignore[no-untyped-def]
    for i in range(points.shape[0]):
        p = (points[i, 0], points[i, 1], points[i, 2])
        out[i] = irradiance_factor(lights, 0, p, (normals[i, 0], normals[i, 1], normals[i, 2]))


def factor(of: Light, points: ArrayLike, normals: ArrayLike) -> F64:
    """Irradiance per radiance of one light."""
    p, n = np.atleast_2d(np.asarray(points, np.float64)), np.atleast_2d(np.asarray(normals, np.float64))
    out = np.empty(len(p))
    table = pack_lights(Scene((), (), lights=(of,)), np.zeros(3))
    _factors(Pointer(table), p, n / np.linalg.norm(n, axis=1, keepdims=True), out)
    return out


def flat_quadrature(of: Light, samples: Callable[[], tuple[F64, float]], point: F64, normal: F64) -> float:
    """Sum of cos_receiver cos_light / d^2 dA over points of a one-sided flat light."""
    local, area = samples()
    m = of.world_from_light
    to = local @ m[:3, :2].T + m[:3, 3] - point
    d2 = (to * to).sum(1)
    receiver = np.maximum(to @ (normal / np.linalg.norm(normal)), 0)
    emitter = np.maximum(to @ m[:3, 2], 0)
    return float((receiver * emitter / d2**2).mean() * area)


def rect_samples(width: float, height: float) -> Callable[[], tuple[F64, float]]:
    def samples() -> tuple[F64, float]:
        x, y = np.meshgrid((np.arange(500) + 0.5) / 500 - 0.5, (np.arange(500) + 0.5) / 500 - 0.5)
        return np.stack([x.ravel() * width, y.ravel() * height], 1), width * height

    return samples


def disk_samples(radius: float) -> Callable[[], tuple[F64, float]]:
    def samples() -> tuple[F64, float]:
        r, a = np.meshgrid(np.sqrt((np.arange(400) + 0.5) / 400) * radius, (np.arange(400) + 0.5) / 400 * 2 * np.pi)
        return np.stack([(r * np.cos(a)).ravel(), (r * np.sin(a)).ravel()], 1), math.pi * radius**2

    return samples


# Facing, oblique, grazing with the light partly below the horizon, and near enough to fill the sky.
PLACES = [
    ((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((1.5, 0.3, -0.7), (0.2, 1.0, 0.4)),
    ((2.0, 1.8, 0.0), (0.1, 1.0, 0.2)),
    ((1.0, 1.0, 1.0), (-1.0, 0.05, 0.3)),
    ((0.2, 1.9, 0.1), (0.0, 1.0, 0.0)),
    ((0.2, 1.9, 0.1), (1.0, 0.3, 0.0)),
]


@pytest.mark.parametrize(("point", "normal"), PLACES)
def test_rect_equals_quadrature(point: tuple[float, ...], normal: tuple[float, ...]) -> None:
    """500 x 500 midpoints of the light, clipped at the receiver's horizon."""
    lamp = light(LightKind.RECT, (0, 2, 0), (0.3, -1, 0.2), (1.6, 0.9))
    expected = flat_quadrature(lamp, rect_samples(1.6, 0.9), np.array(point), np.array(normal))
    assert factor(lamp, point, normal)[0] == pytest.approx(expected, rel=2e-3, abs=2e-4)


@pytest.mark.parametrize(("point", "normal"), PLACES)
def test_disk_equals_quadrature(point: tuple[float, ...], normal: tuple[float, ...]) -> None:
    """The engine's twelve-gon has the disk's area, so only its outline differs."""
    lamp = light(LightKind.DISK, (0, 2, 0), (0.3, -1, 0.2), (0.6, 0))
    expected = flat_quadrature(lamp, disk_samples(0.6), np.array(point), np.array(normal))
    assert factor(lamp, point, normal)[0] == pytest.approx(expected, rel=2e-3, abs=2e-4)


@pytest.mark.parametrize("height", [0.2, 1.0, 5.0])
def test_disk_overhead_is_the_textbook_ratio(height: float) -> None:
    """E / L = pi r^2 / (r^2 + h^2) under the middle of a disk (any radiometry text)."""
    lamp = light(LightKind.DISK, (0, height, 0), (0, -1, 0), (0.6, 0))
    expected = math.pi * 0.36 / (0.36 + height**2)
    assert factor(lamp, (0, 0, 0), (0, 1, 0))[0] == pytest.approx(expected, rel=2e-3)


@pytest.mark.parametrize("elevation", [90, 40, 12, 5, 0, -8, -25])
def test_sphere_equals_quadrature_over_its_cone(elevation: float) -> None:
    """Mean of max(cos, 0) over directions spread evenly in the cone the ball fills; below the horizon it is clipped."""
    a = math.radians(elevation)
    centre = np.array([math.cos(a), math.sin(a), 0]) * 2.0
    cos_cone = math.sqrt(1 - (0.7 / 2.0) ** 2)
    z, phi = np.meshgrid(1 - (np.arange(500) + 0.5) / 500 * (1 - cos_cone), (np.arange(500) + 0.5) / 500 * 2 * np.pi)
    s = np.sqrt(1 - z * z)
    up = z * math.sin(a) + s * np.cos(phi) * math.cos(a)  # the y of each direction
    expected = float(np.maximum(up, 0).mean() * 2 * math.pi * (1 - cos_cone))
    lamp = light(LightKind.SPHERE, centre, (0, -1, 0), (0.7, 0))
    assert factor(lamp, (0, 0, 0), (0, 1, 0))[0] == pytest.approx(expected, rel=2e-3, abs=1e-4)


def test_inside_a_sphere_light_everything_shines() -> None:
    lamp = light(LightKind.SPHERE, (0, 0.1, 0), (0, -1, 0), (0.7, 0))
    assert factor(lamp, (0, 0, 0), (0, 1, 0))[0] == pytest.approx(math.pi)


@pytest.mark.parametrize("degrees", [0.0, 30.0, 75.0])
@pytest.mark.parametrize("angle", [0.0, 0.00925, 0.2])
def test_distant_light(degrees: float, angle: float) -> None:
    """Above the horizon a cone of half angle a gives pi sin^2 a cos t (its projected solid angle); angle 0 gives the
    irradiance itself."""
    t = math.radians(degrees)
    lamp = light(LightKind.DISTANT, (0, 0, 0), (-math.sin(t), -math.cos(t), 0), (angle, 0))
    expected = math.cos(t) * (math.pi * math.sin(angle / 2) ** 2 if angle else 1.0)
    assert factor(lamp, (3, 2, 1), (0, 1, 0))[0] == pytest.approx(expected, rel=1e-9)
    assert factor(lamp, (3, 2, 1), (0, -1, 0))[0] == 0.0


@pytest.mark.parametrize("kind", [LightKind.SPHERE, LightKind.RECT, LightKind.DISK])
@pytest.mark.parametrize("size", [0.0, 0.01])
def test_inverse_square(kind: LightKind, size: float) -> None:
    """Twice as far is a quarter, for points exactly and for small lights to (size / distance)^2."""
    near, far = (factor(light(kind, (0, h, 0), (0, -1, 0), (size, size)), (0, 0, 0), (0, 1, 0))[0] for h in (1.0, 2.0))
    assert near / far == pytest.approx(4.0, rel=1e-3)


@pytest.mark.parametrize("kind", [LightKind.RECT, LightKind.DISK])
@pytest.mark.parametrize("size", [0.0, 0.5])
def test_flat_lights_shine_to_one_side(kind: LightKind, size: float) -> None:
    lamp = light(kind, (0, 2, 0), (0, 1, 0), (size, size))
    assert factor(lamp, (0.1, 0, 0), (0, 1, 0))[0] == 0.0
    assert factor(lamp, (0.1, 4, 0), (0, -1, 0))[0] > 0.0


# --- In a picture ---------------------------------------------------------------------------------------------------


def look_down(lamps: tuple[Light, ...], more: tuple[Mesh, ...] = (), **fields: Any) -> Scene:
    """A white floor seen from above at an angle."""
    return scene(
        [quad("/floor", FLOOR), *more], [WHITE], lights=lamps, cameras=(camera((0, 4, 3), (0, 0, 0)),), **fields
    )


@pytest.mark.parametrize(
    "lamp",
    [
        light(LightKind.RECT, (0, 2, 0), (0.2, -1, 0), (1.0, 0.6), 3.0),
        light(LightKind.DISK, (0, 2, 0), (0, -1, 0), (0.4, 0), 3.0),
        light(LightKind.SPHERE, (0.3, 2, 0), (0, -1, 0), (0.2, 0), 3.0),
        light(LightKind.SPHERE, (0.3, 2, 0), (0, -1, 0), (0.0, 0), 3.0),
        light(LightKind.DISTANT, (0, 9, 0), (0.3, -1, 0.1), (0.0, 0), 3.0),
    ],
    ids=["rect", "disk", "sphere", "point", "distant"],
)
def test_a_white_floor_shows_irradiance_over_pi(lamp: Light) -> None:
    """Lambert: radiance = albedo E / pi, at the place that the P plane names."""
    planes = draw(look_down((lamp,)), 32, 32)
    places = planes["P"].reshape(-1, 3).astype(np.float64)
    expected = 3.0 * factor(lamp, places, np.broadcast_to([0.0, 1, 0], places.shape)) / math.pi
    assert np.abs(places[:, 1]).max() < 1e-5
    np.testing.assert_allclose(planes["beauty"][..., 0].ravel(), expected, rtol=1e-3, atol=1e-5)


def test_two_lights_add_up() -> None:
    a = light(LightKind.RECT, (1, 2, 0), (0, -1, 0), (1.0, 0.6))
    b = light(LightKind.SPHERE, (-1, 2, 0), (0, -1, 0), (0.2, 0), 5.0)
    one, two, both = (draw(look_down(lamps), 16, 16)["beauty"] for lamps in ((a,), (b,), (a, b)))
    np.testing.assert_allclose(both[..., :3], one[..., :3] + two[..., :3], rtol=1e-5)


def test_shadow_falls_where_a_line_to_the_light_is_blocked() -> None:
    """A point light at height 3 over a card from -0.5 to 0.5 at height 1: its shadow on the floor reaches 0.75."""
    lamp = light(LightKind.SPHERE, (0, 3, 0), (0, -1, 0), (0.0, 0))
    card = quad("/card", [(-0.5, 1, 0.5), (0.5, 1, 0.5), (0.5, 1, -0.5), (-0.5, 1, -0.5)])
    planes = draw(look_down((lamp,), (card,)), 96, 96)
    floor = planes["P"][..., 1] < 0.5
    place = np.abs(planes["P"][floor][:, [0, 2]]).max(-1)
    lit = planes["beauty"][floor][:, 0] > 0
    assert (place < 0.74).any()
    assert not lit[place < 0.74].any()
    assert lit[place > 0.76].all()


@pytest.mark.parametrize("once", [False, True], ids=["many rays", "one ray each"])
@pytest.mark.parametrize("kind", [LightKind.RECT, LightKind.DISK, LightKind.SPHERE, LightKind.CYLINDER])
def test_what_hides_a_part_of_a_lamp_hides_what_that_part_brings(kind: LightKind, once: bool) -> None:
    """A lamp that is near and leans, of which a board leaves less and less to the floor below: Lambert's sum over those
    points of the lamp that the floor sees past the board's edge. Also where each sample sends one ray."""
    sizes = {LightKind.RECT: (1.6, 1.2), LightKind.DISK: (0.8, 0.0), LightKind.SPHERE: (0.45, 0.0)}
    size = sizes.get(kind, (0.4, 1.5))
    lamp = light(kind, (0.3, 0.8, 0.1), (0.5, -1, 0.1), size)
    edge, height = 0.1, 0.3
    board = quad("/board", [(-50, height, 50), (edge, height, 50), (edge, height, -50), (-50, height, -50)])
    below = camera((0, 0.2, 0), (0, 0, 0), 0.3, orthographic=True)
    what = scene([quad("/floor", FLOOR), board], [WHITE], lights=(lamp,), cameras=(below,))
    rays = {"samples": 256, "tolerance": 0.0} if once else {"samples": 16, "tolerance": 0.03, "light_samples": 1024}
    planes = draw(what, 16, 16, **rays)
    m = lamp.world_from_light
    local, faces = face_of(kind, size)
    points, faces = local @ m[:3, :3].T + m[:3, 3], faces @ m[:3, :3].T
    hidden, all_of_it = [], []
    for place in (places := planes["P"].reshape(-1, 3).astype(np.float64)):
        to = points - place
        free = place[0] + to[:, 0] * height / to[:, 1] > edge
        brought = np.maximum(to[:, 1], 0) * np.maximum(-(to * faces).sum(1), 0) / (to * to).sum(1) ** 2
        hidden.append((brought * free).sum())
        all_of_it.append(brought.sum())
    unhidden = factor(lamp, places, np.broadcast_to([0.0, 1, 0], places.shape)) / math.pi
    shares = np.array(hidden) / all_of_it
    assert shares.min() < 0.2
    assert shares.max() > 0.8
    stray = planes["beauty"][..., 0].ravel() / unhidden - shares
    if once:  # 256 tosses stray by .03, the mean of 64 pixels by .004
        means = stray[np.argsort(shares)].reshape(4, 64).mean(1)
        assert np.abs(means).max() < 0.008, means
    else:
        assert np.abs(stray).max() < 0.05
        assert np.quantile(np.abs(stray), 0.99) < 0.02


def face_of(kind: LightKind, size: tuple[float, float]) -> tuple[F64, F64]:
    """Points spread evenly over a lamp, and where each faces, shape (N, 3); lamps shine along -z, tubes lie along x."""
    u, v = (one.ravel() for one in np.meshgrid((np.arange(200) + 0.5) / 200, (np.arange(200) + 0.5) / 200))
    turn = (np.cos(2 * np.pi * v), np.sin(2 * np.pi * v))
    if kind is LightKind.SPHERE:
        z = 2 * u - 1
        faces = np.stack([np.sqrt(1 - z * z) * turn[0], np.sqrt(1 - z * z) * turn[1], z], 1)
        return faces * size[0], faces
    if kind is LightKind.CYLINDER:
        faces = np.stack([0 * u, *turn], 1)
        return faces * size[0] + np.stack([(u - 0.5) * size[1], 0 * u, 0 * u], 1), faces
    r = np.sqrt(u) * size[0]
    flat = (r * turn[0], r * turn[1]) if kind is LightKind.DISK else ((u - 0.5) * size[0], (v - 0.5) * size[1])
    return np.stack([*flat, 0 * u], 1), np.tile([0.0, 0, -1], (len(u), 1))


def test_glass_casts_no_shadow_and_a_solid_does() -> None:
    """Light is not bent on its way to an opaque surface (no caustics), so it passes glass straight and whole."""
    lamp = light(LightKind.DISTANT, (0, 9, 0), (0, -1, 0.5), (0.0, 0))
    pane = material("/pane", Model.THIN, OPACITY=0.0)
    block = box("/block", (0.5, 0.1, 0.5), 1, centre=(0, 1, 1.5))
    view: dict[str, Any] = {"lights": (lamp,), "cameras": (camera((0, 0.9, -3), (0, 0, 1.2)),)}
    glass_scene = scene([quad("/floor", FLOOR), block], [WHITE, pane], **view)
    solid_scene = scene([quad("/floor", FLOOR), block], [WHITE, WHITE], **view)
    clear, dark = draw(glass_scene, 48, 48), draw(solid_scene, 48, 48)
    floor = (clear["mask"] == 0) & np.isfinite(clear["Z"]) & (np.abs(dark["P"][..., 1]) < 1e-4)
    bright = clear["beauty"][floor][:, 0]
    assert bright.min() == pytest.approx(bright.max(), rel=1e-4)
    assert (dark["beauty"][floor][:, 0] == 0).any()


@pytest.mark.parametrize("albedo", [1.0, 0.25])
def test_the_camera_light_shows_facing_surfaces_at_their_albedo(albedo: float) -> None:
    """A stage without lights: a matt surface that faces the eye looks as its colour; turned it darkens by cos t."""
    wall = quad("/wall", [(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)])
    planes = draw(scene([wall], [material("/m", DIFFUSE=albedo)], camera_light=True), 33, 33)
    to_eye = np.array([0, 0, 2.5]) - planes["P"]
    cosine = to_eye[..., 2] / np.linalg.norm(to_eye, axis=-1)
    np.testing.assert_allclose(planes["beauty"][..., 0], albedo * cosine, rtol=1e-4)
    assert planes["beauty"][16, 16, 0] == pytest.approx(albedo, rel=1e-4)


@kernel
def _angles(cosines: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    for i in range(len(cosines)):
        out[i] = _angle_over_sine(cosines[i])


def test_an_angle_over_its_sine() -> None:
    angles = np.linspace(1e-4, math.pi / 2.0, 5001)
    found = np.empty_like(angles)
    _angles(np.cos(angles), found)
    assert found == pytest.approx(angles / np.sin(angles), rel=1e-7)


# --- Cylinders ------------------------------------------------------------------------------------------------------


def tube(radius: float, length: float, centre: ArrayLike = (0, 2, 0), face: ArrayLike = (0.3, -1, 0.2)) -> Light:
    return light(LightKind.CYLINDER, centre, face, (radius, length))


def tube_quadrature(of: Light, point: ArrayLike, normal: ArrayLike) -> float:
    """Sum of cos_receiver cos_emitter / d^2 dA over 600 x 600 places of the round of a cylinder."""
    m, (radius, length) = of.world_from_light, of.size
    x, phi = np.meshgrid((np.arange(600) + 0.5) / 600 - 0.5, (np.arange(600) + 0.5) / 600 * 2 * np.pi)
    out = np.stack([0 * phi.ravel(), np.cos(phi).ravel(), np.sin(phi).ravel()], 1) @ m[:3, :3].T
    to = m[:3, 3] + x.ravel()[:, None] * length * m[:3, 0] + out * radius - np.asarray(point)
    d2 = (to * to).sum(1)
    n = np.asarray(normal, np.float64)
    receiver = np.maximum(to @ (n / np.linalg.norm(n)), 0)
    emitter = np.maximum(-(to * out).sum(1), 0)
    return float((receiver * emitter / d2**2).mean() * 2 * np.pi * radius * length)


TUBE_PLACES = [
    ((0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ((1.5, 0.3, -0.7), (0.2, 1.0, 0.4)),
    ((2.0, 1.8, 0.0), (0.1, 1.0, 0.2)),  # beyond its end
    ((2.0, 1.8, 0.0), (-1.0, 0.2, 0.2)),
    ((0.2, 1.5, 0.3), (0.0, 1.0, 0.0)),
    ((0.2, 1.9, 0.5), (1.0, 0.3, 0.0)),  # the horizon cuts it along
    ((-0.5, 3.0, 0.4), (0.2, -0.1, -1.0)),
    ((3.0, 4.0, -5.0), (-1.0, -1.0, 2.0)),
]


@pytest.mark.parametrize(("radius", "length"), [(0.25, 1.6), (0.05, 1.0), (0.3, 0.2)])
@pytest.mark.parametrize(("point", "normal"), TUBE_PLACES)
def test_cylinder_equals_quadrature(
    radius: float, length: float, point: tuple[float, ...], normal: tuple[float, ...]
) -> None:
    lamp = tube(radius, length)
    expected = tube_quadrature(lamp, point, normal)
    assert factor(lamp, point, normal)[0] == pytest.approx(expected, rel=5e-3, abs=5e-4)


@pytest.mark.parametrize(("point", "normal"), TUBE_PLACES)
def test_a_line_is_the_limit_of_thin_cylinders(point: tuple[float, ...], normal: tuple[float, ...]) -> None:
    """Per radiance times width: a hair of 1 mm shows 2 mm of width."""
    thin = tube_quadrature(tube(1e-3, 1.6), point, normal) / 2e-3
    assert factor(tube(0.0, 1.6), point, normal)[0] == pytest.approx(thin, rel=5e-3, abs=1e-6)


@pytest.mark.parametrize("height", [0.1, 1.0, 4.0])
def test_an_endless_line_is_the_textbook_one(height: float) -> None:
    """Of an infinite line, per radiance times width, at distance h: the integral of h^2 / (h^2 + t^2)^2, pi / 2 h."""
    assert factor(tube(0.0, 1e4, (0, height, 0), (0, -1, 0)), (0, 0, 0), (0, 1, 0))[0] == pytest.approx(
        math.pi / (2 * height), rel=1e-6
    )


@pytest.mark.parametrize("place", [(0.0, 2.0, 0.0), (3.0, 2.1, 0.0), (-0.2, 2.0, 0.1)])
def test_ends_and_inside_of_a_cylinder_are_dark(place: tuple[float, ...]) -> None:
    """UsdLuxCylinderLight: it shines outward, and not from its end caps."""
    lamp = tube(0.3, 1.0, face=(0, -1, 0))
    for normal in ((1.0, 0, 0), (-1.0, 0, 0), (0, 1.0, 0), (0, -1.0, 0)):
        assert factor(lamp, place, normal)[0] == 0.0


# --- Shaped lights --------------------------------------------------------------------------------------------------


@kernel
def _shaped(lights, points, normals, out):  # type: ignore[no-untyped-def]
    for i in range(points.shape[0]):
        p = (points[i, 0], points[i, 1], points[i, 2])
        n = (normals[i, 0], normals[i, 1], normals[i, 2])
        even = irradiance_factor(lights, 0, p, n)
        tint = shape_matt(lights, 0, p, n)
        for c in range(3):
            out[i, c] = even * tint[c]


def shaped_factor(of: Light, points: ArrayLike, normals: ArrayLike) -> F64:
    """Irradiance per radiance of one light and colour, with its shaping; shape (N, 3)."""
    p, n = np.atleast_2d(np.asarray(points, np.float64)), np.atleast_2d(np.asarray(normals, np.float64))
    out = np.empty((len(p), 3))
    table = pack_lights(Scene((), (), lights=(of,)), np.zeros(3))
    _shaped(Pointer(table), p, n / np.linalg.norm(n, axis=1, keepdims=True), out)
    return out


def surface(of: Light) -> tuple[F64, F64, float]:
    """65 536 places spread evenly over a light, in its own frame: points, normals, and the area of each."""
    m = 256
    u, v = (a.ravel() for a in np.meshgrid((np.arange(m) + 0.5) / m, (np.arange(m) + 0.5) / m))
    a, b = of.size
    down = np.broadcast_to([0.0, 0.0, -1.0], (m * m, 3))
    if of.kind is LightKind.RECT:
        return np.stack([(u - 0.5) * a, (v - 0.5) * b, 0 * u], 1), down, a * b / m**2
    if of.kind is LightKind.DISK:
        r, t = a * np.sqrt(u), 2 * np.pi * v
        return np.stack([r * np.cos(t), r * np.sin(t), 0 * u], 1), down, np.pi * a * a / m**2
    if of.kind is LightKind.SPHERE:
        z, t = 2 * u - 1, 2 * np.pi * v
        s = np.sqrt(1 - z * z)
        out = np.stack([s * np.cos(t), s * np.sin(t), z], 1)
        return a * out, out, 4 * np.pi * a * a / m**2
    t = 2 * np.pi * v
    out = np.stack([0 * t, np.cos(t), np.sin(t)], 1)
    return a * out + np.stack([(u - 0.5) * b, 0 * u, 0 * u], 1), out, 2 * np.pi * a * b / m**2


def usdlux_share(of: Light, places: F64, leaving: F64) -> F64:
    """What UsdLux leaves of the radiance at `places`, in unit directions `leaving`, all in the light's frame."""
    shaping = of.shaping
    cosine = -leaving[:, 2]
    off = np.arccos(np.clip(cosine, -1, 1))
    share = np.ones((len(leaving), 3))
    if shaping.focus > 0:
        factor = np.abs(cosine) ** shaping.focus
        share = np.array(shaping.focus_tint) * (1 - factor[:, None]) + factor[:, None]
    start = shaping.cone * (1 - shaping.softness)
    if shaping.softness > 0:
        x = np.clip((off - start) / (shaping.cone - start), 0, 1)
        share = share * (1 - x * x * (3 - 2 * x))[:, None]
    share[off > shaping.cone] = 0
    if shaping.profile is not None:
        rows, columns = shaping.profile.shape
        y = off / np.pi * (rows - 1)
        x = np.arctan2(leaving[:, 1], leaving[:, 0]) / (2 * np.pi) % 1.0 * (columns - 1)
        j, i = np.minimum(y.astype(int), rows - 2), np.minimum(x.astype(int), max(columns - 2, 0))
        k = np.minimum(i + 1, columns - 1)
        top = shaping.profile[j, i] * (1 - x + i) + shaping.profile[j, k] * (x - i)
        bottom = shaping.profile[j + 1, i] * (1 - x + i) + shaping.profile[j + 1, k] * (x - i)
        share = share * (top * (1 - y + j) + bottom * (y - j))[:, None]
    if shaping.picture is not None:  # its first corner at +x +y, its last at -x -y
        height, width = shaping.picture.shape[:2]
        column = np.clip(((0.5 - places[:, 0] / of.size[0]) * width).astype(int), 0, width - 1)
        row = np.clip(((0.5 - places[:, 1] / of.size[1]) * height).astype(int), 0, height - 1)
        share = share * shaping.picture[row, column]
    return share


def shaped_quadrature(of: Light, point: ArrayLike, normal: ArrayLike) -> F64:
    """Sum of share cos_receiver cos_emitter / d^2 dA over the light; a point's intensity over the square."""
    m = of.world_from_light
    n = np.asarray(normal, np.float64) / np.linalg.norm(normal)
    if of.size == (0.0, 0.0):
        to = m[:3, 3] - np.asarray(point)
        d = np.linalg.norm(to)
        share = usdlux_share(of, np.zeros((1, 3)), (-to / d @ m[:3, :3])[None])[0]
        return np.asarray(share * max(0.0, to @ n / d) / d**2)
    places, normals, area = surface(of)
    to = places @ m[:3, :3].T + m[:3, 3] - np.asarray(point)
    d = np.linalg.norm(to, axis=1)
    receiver = np.maximum(to @ n / d, 0)
    leaving = -(to @ m[:3, :3]) / d[:, None]
    emitter = np.maximum((leaving * normals).sum(1), 0)
    weight = receiver * emitter / d**2 * area
    return np.asarray((usdlux_share(of, places, leaving) * weight[:, None]).sum(0))


def _measured(columns: int) -> NDArray[np.float32]:
    """A profile of 10 degrees by 60: a beam that is no circle."""
    off = np.radians(np.arange(0, 181, 10))[:, None]
    around = np.linspace(0, 2 * np.pi, columns)[None, :] if columns > 1 else np.zeros((1, 1))
    return np.asarray(np.clip(np.cos(off * (1.0 + 0.3 * np.cos(2 * around))), 0, None) * 2.0, np.float32)


def _painting() -> NDArray[np.float32]:
    """Colours of 8 x 4 texels with one bright one; no symmetry."""
    picture = np.random.default_rng(3).uniform(0.0, 1.0, (4, 8, 3)).astype(np.float32)
    picture[1, 6] = (4.0, 2.0, 0.5)
    return picture


LAMPS = {
    "rect": light(LightKind.RECT, (0, 2, 0), (0.1, -1, 0.05), (0.8, 0.5)),
    "disk": light(LightKind.DISK, (0, 2, 0), (0.1, -1, 0.05), (0.3, 0)),
    "sphere": light(LightKind.SPHERE, (0, 2, 0), (0.1, -1, 0.05), (0.25, 0)),
    "point": light(LightKind.SPHERE, (0, 2, 0), (0.1, -1, 0.05), (0.0, 0)),
    "cylinder": light(LightKind.CYLINDER, (0, 2, 0), (0.1, -1, 0.05), (0.08, 0.9)),
}
SHAPINGS = {
    "spot": Shaping(cone=math.radians(30)),
    "soft": Shaping(cone=math.radians(40), softness=0.6),
    "little soft": Shaping(cone=math.radians(40), softness=0.05),
    "focus": Shaping(focus=8.0),
    "tinted": Shaping(focus=3.0, focus_tint=(0.1, 0.5, 1.0)),
    "measured": Shaping(profile=_measured(7)),
    "round": Shaping(profile=_measured(1), cone=math.radians(50), softness=0.2),
}


@pytest.mark.parametrize("lamp", LAMPS)
@pytest.mark.parametrize("shaping", SHAPINGS)
def test_a_shaped_light_equals_quadrature(lamp: str, shaping: str) -> None:
    """On a floor under it, out of its cone, and near to it; upright and tilted. Within a fiftieth of what the light
    brings there without shaping where a cone's edge cuts it, and a three-hundredth on an average."""
    of = replace(LAMPS[lamp], shaping=SHAPINGS[shaping])
    places = [(x, y, 0.2 * x) for y in (0.0, 1.2) for x in np.linspace(-1.6, 1.6, 9)]
    normals = [(0.0, 1.0, 0.0), (0.5, 1.0, -0.3)]
    errors = []
    for normal in normals:
        found = shaped_factor(of, places, [normal] * len(places))
        even = factor(of, places, [normal] * len(places))
        for k, place in enumerate(places):
            if even[k] > 1e-6:
                errors.append(np.abs(found[k] - shaped_quadrature(of, place, normal)).max() / even[k])
    assert max(errors) < 2e-2
    assert np.mean(errors) < 3e-3


@pytest.mark.parametrize("height", [0.4, 1.0, 3.0])
@pytest.mark.parametrize("normal", [(0.0, 1.0, 0.0), (1.0, 0.4, 0.2)])
def test_a_picture_on_a_rectangle_equals_quadrature(height: float, normal: tuple[float, ...]) -> None:
    """Of every colour, within half a hundredth of the light: a texel of 8 x 4 is one bright spot of a panel."""
    of = light(LightKind.RECT, (0.2, height, 0.1), (0.1, -1, 0.05), (1.6, 0.9))
    of = replace(of, shaping=Shaping(picture=_painting()))
    for place in ((0.0, 0.0, 0.0), (0.7, 0.0, -0.3), (-1.5, 0.0, 0.5)):
        expected = shaped_quadrature(of, place, normal)
        assert shaped_factor(of, place, normal)[0] == pytest.approx(expected, rel=5e-3, abs=5e-4)


def test_a_light_before_which_a_cone_ends_asks_for_no_rays() -> None:
    lamp = replace(LAMPS["disk"], shaping=Shaping(cone=0.2))
    assert (shaped_factor(lamp, (1.5, 0, 0), (0, 1, 0)) == 0).all()


def test_the_picture_on_a_light_is_its_own_mean() -> None:
    """Levels of squares keep what a picture of any size holds; NaN is black."""
    picture = np.random.default_rng(5).uniform(0, 2, (37, 90, 3)).astype(np.float32)
    picture[3, 4] = np.nan
    levels = _picture_levels(picture)
    assert [len(level) for level in levels] == [1, 2, 4, 8, 16, 32, 64, 128]
    for level in levels:
        np.testing.assert_allclose(level.mean((0, 1)), np.nan_to_num(picture).mean((0, 1)), rtol=1e-4)


# --- Shadows and links in a picture ---------------------------------------------------------------------------------

CARD = [(-0.5, 1, 0.5), (0.5, 1, 0.5), (0.5, 1, -0.5), (-0.5, 1, -0.5)]


def under_the_card(lamp: Light, **settings: Any) -> tuple[F64, F64]:
    """Light on the floor in the deep of the card's shadow, and what would be there without it; shape (3,)."""
    planes = draw(look_down((lamp,), (quad("/card", CARD),)), 64, 64, **settings)
    free = draw(look_down((lamp,)), 64, 64, **settings)
    place = planes["P"]
    deep = (place[..., 1] < 0.5) & (np.abs(place[..., [0, 2]]).max(-1) < 0.45)
    assert deep.sum() > 20
    return planes["beauty"][deep][:, :3].astype(np.float64).mean(0), free["beauty"][deep][:, :3].mean(0)


POINT = light(LightKind.SPHERE, (0, 3, 0), (0, -1, 0), (0.0, 0))


@pytest.mark.parametrize("samples", [1, 4])
def test_a_light_without_shadows_shines_through(samples: int) -> None:
    found, free = under_the_card(replace(POINT, casts_shadow=False), samples=samples)
    np.testing.assert_allclose(found, free, rtol=1e-5)


@pytest.mark.parametrize("samples", [1, 4])
def test_a_shadow_has_its_colour(samples: int) -> None:
    found, free = under_the_card(replace(POINT, shadow=Shadow(color=(0.1, 0.0, 0.5))), samples=samples)
    np.testing.assert_allclose(found, free * (0.1, 0.0, 0.5), rtol=1e-5, atol=1e-7)


def test_what_is_too_far_casts_no_shadow() -> None:
    """The card is 1 m above the floor, and a little more along a slanted ray."""
    found, free = under_the_card(replace(POINT, shadow=Shadow(distance=0.98)))
    np.testing.assert_allclose(found, free, rtol=1e-5)
    assert under_the_card(replace(POINT, shadow=Shadow(distance=1.2)))[0].max() == 0.0


@pytest.mark.parametrize("gamma", [0.5, 1.0, 3.0])
def test_a_shadow_fades_over_its_falloff(gamma: float) -> None:
    """A sun above: the card is 1 m from every place, half way into the falloff from 0.5 to 1.5."""
    sun = light(LightKind.DISTANT, (0, 9, 0), (0, -1, 0), (0.0, 0))
    sun = replace(sun, shadow=Shadow(distance=1.5, falloff=1.0, gamma=gamma))
    found, free = under_the_card(sun, samples=64, tolerance=0.0)
    assert found / free == pytest.approx(np.full(3, 1.0 - 0.5**gamma), abs=0.02)


@pytest.mark.parametrize("samples", [1, 4])
def test_a_light_lights_what_it_is_linked_to(samples: int) -> None:
    left = quad("/left", [(-9, 0, 9), (0, 0, 9), (0, 0, -9), (-9, 0, -9)])
    right = quad("/right", [(0, 0, 9), (9, 0, 9), (9, 0, -9), (0, 0, -9)])
    glossy = material("/glossy", DIFFUSE=0.5, IOR=1.5, ROUGHNESS=0.3, CLEARCOAT=1.0)

    def picture(lit: tuple[str, ...] | None) -> dict[str, NDArray[np.float32]]:
        lamp = replace(light(LightKind.RECT, (0, 2, -1), (0, -1, 0), (0.5, 0.5), 4.0), lit=lit)
        eye = camera((0, 4, 3), (0, 0, 0))
        return draw(scene([left, right], [glossy], lights=(lamp,), cameras=(eye,)), 32, 32, samples=samples)

    whole, some = picture(None), picture(("/left",))
    on_left = whole["P"][..., 0] < -0.3
    np.testing.assert_array_equal(some["beauty"][on_left], whole["beauty"][on_left])
    assert some["beauty"][whole["P"][..., 0] > 0.3][:, :3].max() == 0.0
    assert whole["beauty"][..., :3].min() > 0.0


@pytest.mark.parametrize("samples", [1, 4])
def test_only_those_cast_shadows_that_a_light_names(samples: int) -> None:
    """Two cards side by side; the light knows of one, another light of both."""
    cards = [quad(f"/card{k}", np.array(CARD) + np.array([1.2 * k - 0.6, 0, 0])) for k in range(2)]

    def shadows(casters: tuple[str, ...] | None) -> list[bool]:
        lamp = replace(light(LightKind.DISTANT, (0, 9, 0), (0, -1, 0), (0.0, 0)), casters=casters)
        planes = draw(look_down((lamp,), tuple(cards)), 96, 96, samples=samples)
        p = planes["P"]
        under = [(p[..., 1] < 0.5) & (np.abs(p[..., 0] - 1.2 * k + 0.6) < 0.4) & (np.abs(p[..., 2]) < 0.4)
                 for k in range(2)]  # fmt: skip
        return [bool((planes["beauty"][mask][:, 0] == 0.0).all()) for mask in under]

    assert shadows(None) == [True, True]
    assert shadows(("/card1",)) == [False, True]
    assert shadows(()) == [False, False]


@pytest.mark.parametrize("kind", [LightKind.RECT, LightKind.CYLINDER])
def test_a_mirror_shows_the_light_itself(kind: LightKind) -> None:
    """A polished floor under a light: its picture is the light's own, of its radiance; a cone shuts it off."""
    of = light(kind, (0, 2, 0), (0, -1, 0), (1.0, 0.6) if kind is LightKind.RECT else (0.2, 1.0), 3.0)
    mirror = material("/mirror", DIFFUSE=1.0, METALLIC=1.0, ROUGHNESS=0.0)
    eye = camera((0, 4, 2), (0, 0, 0))
    bright = draw(scene([quad("/floor", FLOOR)], [mirror], lights=(of,), cameras=(eye,)), 64, 64)["beauty"][..., 0]
    assert bright.max() == pytest.approx(3.0, rel=0.02)
    assert 0.003 < (bright > 1.5).mean() < 0.2
    narrow = replace(of, shaping=Shaping(cone=math.radians(2)))
    dark = draw(scene([quad("/floor", FLOOR)], [mirror], lights=(narrow,), cameras=(eye,)), 64, 64)["beauty"][..., 0]
    assert dark.max() == 0.0
