"""The measures of the benchmarks, against numbers from outside; each benchmark once, very small."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

import refract_core as rc
from benchmarks import lobe, mutants, room, roughness, tiers
from refract_core.scene import Mesh, Sphere

pytestmark = pytest.mark.draws

F64 = NDArray[np.float64]

COUNT = 100_000
IOR = 1.5
F0 = 0.04  # ((1.5 - 1) / (1.5 + 1))^2


def rays(alpha: float, eta: float = 1 / IOR, tilt: float = 0.0) -> lobe.Light:
    """Light that came under `tilt` [rad] through one rough interface."""
    light = lobe.straight(COUNT)
    light.direction[:] = (math.sin(tilt), 0.0, -math.cos(tilt))
    return lobe.through_interface(light, alpha, eta, np.random.default_rng(5).random((2, COUNT)))


# --- The Monte Carlo ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tilt", [0.0, 0.4, 1.0])
def test_a_smooth_interface_refracts_by_snell(tilt: float) -> None:
    found = rays(1e-8, tilt=tilt)
    np.testing.assert_allclose(found.direction[:, 0], math.sin(tilt) / IOR, atol=1e-4)
    np.testing.assert_allclose(found.direction[:, 1], 0.0, atol=1e-4)


def test_a_smooth_slab_turns_nothing_and_keeps_what_two_faces_let_through() -> None:
    """T = (1 - F0)^2 without the bounces between."""
    _, behind = lobe.slab(1e-3, IOR, COUNT)
    assert np.abs(lobe.slopes(behind)).max() < 0.01  # GGX tails
    assert lobe.median_slope(behind) < 1e-5
    np.testing.assert_allclose(behind.weight, (1 - F0) ** 2, atol=1e-3)


def test_total_reflection_lets_nothing_out() -> None:
    """Critical angle at n = 1.5: 41.8103 degrees."""
    assert rays(1e-6, IOR, math.radians(41.7)).weight.min() > 0.0
    assert rays(1e-6, IOR, math.radians(41.9)).weight.max() == 0.0


@pytest.mark.parametrize("alpha", [0.05, 0.3, 0.7])
@pytest.mark.parametrize("eta", [1 / IOR, IOR])
def test_no_interface_makes_light(alpha: float, eta: float) -> None:
    found = rays(alpha, eta, 0.3)
    assert found.weight.min() >= 0.0
    assert found.weight.max() <= 1.0
    assert 0.5 < found.weight.mean() < 1.0 - F0 + 1e-3
    np.testing.assert_allclose(np.linalg.norm(found.direction, axis=1), 1.0, atol=1e-12)


def test_normals_seen_straight_on_have_the_slopes_of_ggx() -> None:
    """Slopes of D(h) cos(h): a share s^2 / (s^2 + alpha^2) lies below s (Walter et al. 2007, equation 35)."""
    alpha = 0.3
    v = np.tile([0.0, 0.0, 1.0], (COUNT, 1))
    h = lobe.visible_normals(v, alpha, np.random.default_rng(3).random((2, COUNT)))
    slope = np.hypot(h[:, 0], h[:, 1]) / h[:, 2]
    for s in (0.1, 0.3, 0.9):
        assert (slope < s).mean() == pytest.approx(s * s / (s * s + alpha * alpha), abs=0.006)


def ggx_normals(alpha: float) -> tuple[F64, F64]:
    """Normals and their shares of D(h) cos(h), by the slopes of GGX; the steep ones, which are few, stand close."""
    t, v = ((np.indices((400, 400)) + 0.5) / 400).reshape(2, -1)
    left = (1 - t) ** 4  # share of steeper slopes
    slope = alpha * np.sqrt((1 - left) / left)
    steep = np.stack([slope * np.cos(2 * np.pi * v), slope * np.sin(2 * np.pi * v), np.ones_like(v)], 1)
    return steep / np.linalg.norm(steep, axis=1, keepdims=True), (1 - t) ** 3


@pytest.mark.parametrize(("alpha", "tilt"), [(0.5, 1.1), (0.2, 0.8), (0.8, 0.3)])
def test_normals_seen_aslant_are_those_of_ggx_by_how_much_they_show(alpha: float, tilt: float) -> None:
    """Visible normals are D(h) max(<v, h>, 0), whose integral is cos / G1 (Heitz 2018, equations 1 to 3)."""
    eye = np.array([math.sin(tilt), 0.0, math.cos(tilt)])
    h, share = ggx_normals(alpha)
    shown = np.maximum(h @ eye, 0.0) / h[:, 2]
    seen = lobe.visible_normals(np.tile(eye, (COUNT, 1)), alpha, np.random.default_rng(4).random((2, COUNT)))
    assert (seen @ eye).min() > 0.0
    for moment in (lambda n: n[:, 0], lambda n: n[:, 2], lambda n: n[:, 1] ** 2):
        assert np.mean(moment(seen)) == pytest.approx(np.average(moment(h), weights=share * shown), abs=0.004)
    g1 = 2.0 / (1.0 + math.sqrt(1.0 + (alpha * math.tan(tilt)) ** 2))
    assert np.average(shown, weights=share) == pytest.approx(math.cos(tilt) / g1, rel=0.002)


def test_an_interface_between_equals_only_masks() -> None:
    """At n = 1 nothing is bent or reflected; Smith's G1 of the way out is what is left (Walter et al., equation 34)."""
    found = rays(0.5, 1.0, 1.1)
    np.testing.assert_allclose(found.direction[:, 0], math.sin(1.1), atol=1e-12)
    np.testing.assert_allclose(found.weight, 2 / (1 + math.sqrt(1 + (0.5 * math.tan(1.1)) ** 2)), rtol=1e-9)


@pytest.mark.parametrize("ior", [1.2, 1.5, 2.0])
def test_one_face_turns_light_by_one_minus_one_over_n(ior: float) -> None:
    """Small slopes s turn light by (1 - 1 / n) s, and half of GGX's slopes are below alpha."""
    alpha = 0.02
    found = rays(alpha, 1 / ior)
    assert lobe.median_slope(found) == pytest.approx((1 - 1 / ior) * alpha, rel=0.01)


@pytest.mark.parametrize("ior", [1.2, 1.5, 2.0])
def test_two_faces_turn_light_by_the_sum_of_two_slopes(ior: float) -> None:
    """Small slopes s at entry and t at exit turn light by (n - 1)(s + t), drawn here as plain random pairs."""
    alpha = 0.02
    u = np.random.default_rng(8).random((4, COUNT))
    slope = alpha * np.sqrt(u[:2] / (1.0 - u[:2]))
    both = slope * np.exp(2j * np.pi * u[2:])
    _, behind = lobe.slab(math.sqrt(alpha), ior, COUNT)
    assert lobe.median_slope(behind) == pytest.approx((ior - 1) * float(np.median(np.abs(both.sum(0)))), rel=0.015)


def test_an_edge_is_as_wide_as_the_distance_says() -> None:
    one, two = (lobe.edge_half_width(0.3, IOR, 0.0, distance, COUNT) for distance in (1.0, 2.0))
    assert two == pytest.approx(2 * one)
    assert lobe.edge_half_width(0.3, IOR, 0.5, 1.0, COUNT) > one


# --- The measure of an edge -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [0.003, 0.03, 0.15])
def test_half_width_of_a_profile_that_is_known(width: float) -> None:
    """(1 + x / sqrt(x^2 + a^2)) / 2 is at 75 % where x = a / sqrt 3; a fade to both sides changes nothing."""
    x = np.linspace(-1, 1, 640)
    seen = 0.5 + 0.5 * x / np.hypot(x, width)
    grain = 2 / 640 / 4 if width < 0.01 else 0.0  # straight lines between pixels
    assert roughness.half_width(x, seen) == pytest.approx(width / math.sqrt(3), rel=0.01, abs=grain)
    assert roughness.half_width(x, seen * np.exp(-x * x)) == pytest.approx(width / math.sqrt(3), rel=0.01, abs=grain)


def test_half_width_forgives_noise() -> None:
    x = np.linspace(-1, 1, 128)
    noise = np.random.default_rng(1).normal(0.0, 0.005, 128)
    seen = 0.5 + 0.5 * x / np.hypot(x, 0.2) + noise
    assert roughness.half_width(x, seen) == pytest.approx(0.2 / math.sqrt(3), rel=0.04)


def test_half_width_of_what_never_gets_there_is_no_number() -> None:
    x = np.linspace(-1, 1, 64)
    assert math.isnan(roughness.half_width(x, 0.5 + 0.1 * x))
    assert math.isnan(roughness.half_width(x, np.zeros(64)))


# --- The room -------------------------------------------------------------------------------------------------------


def edge_counts(mesh: Mesh) -> tuple[int, int]:
    """Edges, and those that two triangles do not run along in opposite directions."""
    t = mesh.triangles.astype(np.int64)
    ways = np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])
    there = {(int(a), int(b)) for a, b in ways}
    assert len(there) == len(ways)
    return len(there) // 2, sum((b, a) not in there for a, b in there)


def volume(mesh: Mesh) -> float:
    """Signed volume [m^3]: positive where triangles face outwards."""
    a, b, c = mesh.points.astype(np.float64)[mesh.triangles].transpose(1, 0, 2)
    return float(np.sum(a * np.cross(b, c)) / 6)


VOLUMES = {
    "cube": 0.8**3,
    "torus": 2 * math.pi**2 * 0.35 * 0.15**2,
    "shell": 4 / 3 * math.pi * (0.5**3 - 0.48**3),
}


@pytest.mark.parametrize("name", room.SHAPES)
def test_glass_is_closed_and_faces_outwards(name: str) -> None:
    thing = room.SHAPES[name].make()
    if isinstance(thing, Sphere):
        return
    edges, open_edges = edge_counts(thing)
    assert thing.closed
    assert edges >= 18
    assert open_edges == 0
    assert volume(thing) > 0.0
    if name in VOLUMES:
        assert volume(thing) == pytest.approx(VOLUMES[name], rel=0.01)
    if thing.normals is not None:
        points = thing.points.astype(np.float64)[thing.triangles]
        flat = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        flat /= np.linalg.norm(flat, axis=1, keepdims=True)
        np.testing.assert_allclose(np.linalg.norm(thing.normals, axis=2), 1.0, atol=1e-5)
        assert np.sum(thing.normals * flat[:, None], 2).min() > 0.9


@pytest.mark.parametrize("name", room.SHAPES)
def test_glass_is_as_large_as_its_thickness_says(name: str) -> None:
    """About 0.8 to 1.3 m across, in the room; the typed thickness is its smallest side, or its wall."""
    shape = room.SHAPES[name]
    thing = shape.make()
    if isinstance(thing, Sphere):
        assert shape.thickness == 2 * thing.radius
        return
    sides = np.ptp(thing.points, axis=0)
    assert 0.6 < sides.min() <= sides.max() < 1.35
    if name == "blob":
        assert shape.thickness == pytest.approx(sides.min(), abs=0.01)
    if name == "torus":
        assert shape.thickness == pytest.approx(0.3)


def test_walls_are_the_room_and_face_inwards() -> None:
    walls = [mesh for mesh in room.room(room.SHAPES["sphere"]).meshes if mesh.path.startswith("/wall")]
    assert len(walls) == 6
    for wall in walls:
        a, b, c = wall.points[wall.triangles].astype(np.float64).transpose(1, 0, 2)
        assert (np.sum(np.cross(b - a, c - a) * a, 1) < 0.0).all()
        st = wall.primvars["st"].reshape(-1, 2)
        across = np.sort(np.ptp(wall.points, axis=0))[1:]
        np.testing.assert_allclose(np.sort(np.ptp(st, axis=0)), across)  # metres
    corners = np.concatenate([wall.points for wall in walls])
    np.testing.assert_allclose(np.ptp(corners, axis=0), [6.0, 4.0, 6.6], atol=1e-6)


def test_two_balls_stand_outside_the_picture() -> None:
    def in_picture(centre: tuple[float, float, float], radius: float) -> bool:
        ahead = room.EYE[2] - centre[2]
        high, wide = room.HALF_WINDOW, room.HALF_WINDOW * 16 / 9
        # Distance to the frustum's sides, whose normals lean back by the field of view.
        sides = [(abs(centre[0]) - wide * ahead) / math.hypot(1, wide), (abs(centre[1]) - high * ahead)
                 / math.hypot(1, high)]  # fmt: skip
        return max(sides) < radius

    assert [in_picture(centre, radius) for centre, radius, _ in room.BALLS] == [True, True, True, False, False]
    for centre, radius, _ in room.BALLS:
        assert all(abs(c) + radius <= half for c, half in zip(centre, room.ROOM, strict=True))
        assert math.dist(centre, (0, 0, 0)) > radius + 0.7


# --- The benchmarks themselves, very small --------------------------------------------------------------------------


def test_the_tiers_table_at_a_tiny_size() -> None:
    """Where the ray tier answers what the screen cannot, it cannot be worse than HDRP, nor than the screen alone."""
    pytest.importorskip("flip_evaluator")
    options = tiers.Options(size=64, samples=1, resolution=32, repeat=0)
    chosen = (tiers.SCREEN, tiers.RAY, tiers.Arrangement("ray,sky"), tiers.HDRP)
    found = tiers.measure("sphere", options, chosen)
    assert found.scores[chosen[2]].psnr == math.inf
    assert found.scores[chosen[2]].flip == 0.0
    assert 5.0 < found.scores[tiers.HDRP].psnr < found.scores[tiers.RAY].psnr
    assert found.scores[tiers.HDRP].model in tiers.TYPED
    lines = tiers.table({"sphere": found})
    assert [line.split()[0] for line in lines[2:7]] == [tiers.TRUTH.label, *(row.label for row in chosen)]
    gain = found.scores[tiers.RAY].psnr - found.scores[tiers.HDRP].psnr
    assert any(line.startswith("screen, then ray, over HDRP") and f"{gain:+.1f}" in line for line in lines)


def test_the_ray_tier_blurs_as_the_monte_carlo_does() -> None:
    """A law of the engine: the lobe's fit, and the sampling of it."""
    options = roughness.Options(rays=COUNT, samples=64)
    reference, (blur,) = roughness.row_of(0.3, options, {"ray": roughness.by_ray})
    assert blur == pytest.approx(reference, rel=0.06)


@pytest.mark.parametrize("name", ["screen", "probe", "sky", "HDRP screen", "HDRP probe"])
def test_every_tier_blurs_more_when_rougher(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(roughness, "_SKY", 1024)
    monkeypatch.setattr(roughness, "_SKY_SHIFTS", (37,))
    options = roughness.Options(size=320, rays=20_000, resolution=64)
    smooth, rough = (roughness.row_of(r, options, {name: roughness.COLUMNS[name]})[1][0] for r in (0.2, 0.4))
    assert 0.0 < smooth < rough


def test_the_edge_of_a_smooth_slab_is_a_pixel_wide_and_in_the_middle() -> None:
    """Also the sign of the wall and the sky: bright on the right. The screen fades towards its sides."""
    for order in (("screen",), ("ray",)):
        settings = rc.RenderSettings(image_width=64, image_height=8, samples=1, tiers=order)
        x, seen = roughness.profile(roughness.edge_scene(0.0, 0.1), settings)
        np.testing.assert_allclose(seen[(x > 0.01) & (x < 0.085)], 1 - F0, atol=1e-4)
        np.testing.assert_allclose(seen[x < -0.01], 0.0, atol=1e-4)
    settings = rc.RenderSettings(image_width=8, image_height=8, samples=1, tiers=("sky",))
    for angle, light in ((0.3, 1 - F0), (-0.3, 0.0)):
        frame = rc.render(roughness.sky_scene(0.0, angle, 37), settings)
        np.testing.assert_allclose(frame.planes["refraction"][..., 0], light, atol=1e-4)


@pytest.mark.parametrize("mutant", mutants.MUTANTS, ids=lambda m: m.name)
def test_every_mutant_has_its_place(mutant: mutants.Mutant) -> None:
    """The engine moves on; a mutant that cannot be made says nothing."""
    mutants.check(mutant)
    assert mutant.before != mutant.after
    assert all((mutants.ROOT / test).exists() for test in mutant.tests)
