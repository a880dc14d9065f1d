"""Closed-form light against quadrature, and against what a rendered white floor shows."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scenes import box, camera, draw, light, material, quad, scene

from refract_core.kernels.compile import kernel
from refract_core.kernels.pointer import Pointer
from refract_core.scene import Light, LightKind, Mesh, Model, Scene
from refract_core.world.lights import _angle_over_sine, irradiance_factor, pack_lights

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
    """The engine's twelve-gon has the disk's area, so only its outline differs: under a hundredth near by."""
    lamp = light(LightKind.DISK, (0, 2, 0), (0.3, -1, 0.2), (0.6, 0))
    expected = flat_quadrature(lamp, disk_samples(0.6), np.array(point), np.array(normal))
    assert factor(lamp, point, normal)[0] == pytest.approx(expected, rel=1e-2, abs=1e-3)


@pytest.mark.parametrize("height", [0.2, 1.0, 5.0])
def test_disk_overhead_is_the_textbook_ratio(height: float) -> None:
    """E / L = pi r^2 / (r^2 + h^2) under the middle of a disk (any radiometry text)."""
    lamp = light(LightKind.DISK, (0, height, 0), (0, -1, 0), (0.6, 0))
    expected = math.pi * 0.36 / (0.36 + height**2)
    assert factor(lamp, (0, 0, 0), (0, 1, 0))[0] == pytest.approx(expected, rel=1e-2)


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
