"""The dome against closed forms: constants, a white half, a sun, and the density of what is drawn."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from refract_core.errors import SceneError
from refract_core.kernels.compile import kernel
from refract_core.scene import F32, F64, Environment
from refract_core.world import environment as env
from refract_core.world.environment import guide_of, pick

AXES = {
    "+x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "+y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "+z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}


@kernel
def _radiance(table: env.EnvironmentTable, d: F64, footprint: float, out: F64) -> None:
    for i in range(d.shape[0]):
        out[i, 0], out[i, 1], out[i, 2] = env.radiance(table, (d[i, 0], d[i, 1], d[i, 2]), footprint)


@kernel
def _prefiltered(table: env.EnvironmentTable, d: F64, roughness: float, out: F64) -> None:
    for i in range(d.shape[0]):
        out[i, 0], out[i, 1], out[i, 2] = env.prefiltered(table, (d[i, 0], d[i, 1], d[i, 2]), roughness)


@kernel
def _irradiance(table: env.EnvironmentTable, n: F64, out: F64) -> None:
    for i in range(n.shape[0]):
        out[i, 0], out[i, 1], out[i, 2] = env.irradiance(table, (n[i, 0], n[i, 1], n[i, 2]))


@kernel
def _draw(table: env.EnvironmentTable, u: F64, out: F64) -> None:
    for i in range(u.shape[0]):
        d, pdf, _ = env.sample_direction(table, u[i, 0], u[i, 1])
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = d[0], d[1], d[2], pdf
        out[i, 4], _ = env.direction_pdf(table, d)


@kernel
def _density(table: env.EnvironmentTable, d: F64, out: F64) -> None:
    for i in range(d.shape[0]):
        out[i], _ = env.direction_pdf(table, (d[i, 0], d[i, 1], d[i, 2]))


def radiance(table: env.EnvironmentTable, d: object, footprint: float = 0.0) -> F64:
    directions = np.atleast_2d(np.asarray(d, np.float64))
    out = np.empty((len(directions), 3))
    _radiance(table, directions, footprint, out)
    return out


def prefiltered(table: env.EnvironmentTable, d: F64, roughness: float) -> F64:
    out = np.empty((len(d), 3))
    _prefiltered(table, d, roughness, out)
    return out


def irradiance(table: env.EnvironmentTable, n: object) -> F64:
    normals = np.atleast_2d(np.asarray(n, np.float64))
    out = np.empty((len(normals), 3))
    _irradiance(table, normals, out)
    return out


def draw(table: env.EnvironmentTable, count: int, seed: int) -> F64:
    """Columns x, y, z, pdf, and the pdf asked for afterwards."""
    out = np.empty((count, 5))
    _draw(table, np.random.default_rng(seed).random((count, 2)), out)
    return out


def unit_vectors(count: int, seed: int) -> F64:
    v = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def grid(height: int, width: int) -> tuple[F64, F64]:
    """Directions at the centres of a latlong grid by the docstring of scene.Environment, and their solid angles."""
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    theta, angle = math.pi * v, (0.5 - u) * 2.0 * math.pi  # angle = atan2(x, z)
    d = np.stack([np.sin(theta) * np.sin(angle), np.cos(theta), np.sin(theta) * np.cos(angle)], axis=-1)
    areas = np.cos(theta - math.pi / height / 2) - np.cos(theta + math.pi / height / 2)
    return d.reshape(-1, 3), areas.ravel() * 2.0 * math.pi / width


def half_white(height: int, axis: F64) -> F32:
    """1 in the half of directions around `axis`, 0 elsewhere."""
    d, _ = grid(height, 2 * height)
    return np.repeat((d @ axis > 0.0).reshape(height, -1, 1), 3, axis=2).astype(np.float32)


def noise(height: int, width: int, seed: int = 0) -> F32:
    return np.random.default_rng(seed).random((height, width, 3), dtype=np.float32)


def rotation(axis: str, angle: float) -> F64:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_euler(axis, angle, degrees=True).as_matrix())


# --- Radiance -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (5, 9), (33, 64), (64, 128)])
def test_constant_map_is_constant_at_every_footprint(shape: tuple[int, int]) -> None:
    table = env.pack(Environment(np.full((*shape, 3), [0.5, 2.0, 7.0], np.float32)))
    d = np.concatenate([unit_vectors(200, 1), np.array(list(AXES.values()))])
    for footprint in (0.0, 1e-3, 0.03, 0.5, 3.0, 100.0):
        assert radiance(table, d, footprint) == pytest.approx(np.tile([0.5, 2.0, 7.0], (len(d), 1)), rel=1e-6)
    for roughness in (0.0, 0.5, 1.0):
        assert prefiltered(table, d, roughness) == pytest.approx(np.tile([0.5, 2.0, 7.0], (len(d), 1)), rel=1e-6)


def test_no_environment_is_black_and_drawn_evenly() -> None:
    table = env.pack(None)
    assert not table.present
    assert np.all(radiance(table, list(AXES.values()), 0.2) == 0.0)
    assert np.all(irradiance(table, list(AXES.values())) == 0.0)
    assert draw(table, 1000, 2)[:, 3] == pytest.approx(1.0 / (4.0 * math.pi))


def test_orientation_is_openexr_latlong() -> None:
    # Centre +Z, a quarter right -X, a quarter left +X, the seam -Z, the top row +Y, the bottom row -Y.
    pixels = np.zeros((64, 128, 3), np.float32)
    marks = {"+z": (32, 64), "-x": (32, 96), "+x": (32, 32), "-z": (32, 0)}
    for k, (row, column) in enumerate(marks.values()):
        pixels[row - 1 : row + 1, [column - 1, column]] = k + 1.0
    pixels[0], pixels[-1] = 10.0, 20.0
    table = env.pack(Environment(pixels))
    for k, name in enumerate(marks):
        assert radiance(table, AXES[name])[0, 0] == pytest.approx(k + 1.0)
    assert radiance(table, AXES["+y"])[0, 0] == pytest.approx(10.0)
    assert radiance(table, AXES["-y"])[0, 0] == pytest.approx(20.0)


def test_texel_centres_give_their_texel() -> None:
    pixels = noise(16, 32)
    d, _ = grid(16, 32)
    found = radiance(env.pack(Environment(pixels)), d)
    assert found == pytest.approx(pixels.reshape(-1, 3), abs=1e-5)
    assert radiance(env.pack(Environment(pixels)), 40.0 * d) == pytest.approx(found, abs=1e-6)


@pytest.mark.parametrize("shape", [(16, 32), (7, 13), (1, 3)])
@pytest.mark.parametrize("footprint", [0.0, 0.3, 0.9])
def test_no_seam_in_u_and_one_value_at_each_pole(shape: tuple[int, int], footprint: float) -> None:
    table = env.pack(Environment(noise(*shape)))
    height = np.linspace(-0.99, 0.99, 50)
    flat = np.sqrt(1.0 - height**2)
    left, right = (np.column_stack([side * 1e-9 + 0.0 * flat, height, -flat]) for side in (-1.0, 1.0))
    assert radiance(table, left, footprint) == pytest.approx(radiance(table, right, footprint), abs=1e-6)
    angles = np.linspace(0.0, 2.0 * math.pi, 37)
    for y in (1.0, -1.0):
        around = np.column_stack([1e-9 * np.sin(angles), np.full(37, y), 1e-9 * np.cos(angles)])
        pole = radiance(table, [0.0, y, 0.0], footprint)
        assert radiance(table, around, footprint) == pytest.approx(np.tile(pole, (37, 1)), abs=1e-6)


def test_lookup_is_continuous_in_direction_and_footprint() -> None:
    table = env.pack(Environment(noise(16, 32)))
    d = unit_vectors(2000, 3)
    beside = d + 1e-7 * unit_vectors(2000, 4)
    for footprint in (0.0, 0.19, 0.21, 0.7, 5.0):
        # At a pole's rim u turns fastest: a texel of 0.2 rad there spans 0.2 * 0.1 of arc.
        assert np.abs(radiance(table, d, footprint) - radiance(table, beside, footprint)).max() < 1e-3
    levels = [radiance(table, d, math.pi / 16 * 2.0**k * (1.0 + e)) for k in range(5) for e in (-1e-9, 1e-9)]
    for below, above in zip(levels[::2], levels[1::2], strict=True):
        assert below == pytest.approx(above, abs=1e-6)


def test_rotation_turns_the_world_into_the_dome() -> None:
    pixels = noise(16, 32)
    plain = env.pack(Environment(pixels))
    turn = rotation("x", 37.0) @ rotation("y", 110.0)
    turned = env.pack(Environment(pixels, turn))
    d = unit_vectors(300, 5)
    assert radiance(turned, d, 0.1) == pytest.approx(radiance(plain, d @ turn.T, 0.1), abs=1e-9)
    assert irradiance(turned, d) == pytest.approx(irradiance(plain, d @ turn.T), abs=1e-9)
    # The same numbers draw the same place of the dome, which is elsewhere in the world.
    assert draw(turned, 300, 6)[:, :3] @ turn.T == pytest.approx(draw(plain, 300, 6)[:, :3], abs=1e-9)


@pytest.mark.parametrize("shape", [(16, 32), (37, 61), (3, 50)])
def test_coarsest_level_is_the_mean_over_solid_angle(shape: tuple[int, int]) -> None:
    pixels = noise(*shape)
    _, areas = grid(*shape)
    mean = areas @ pixels.reshape(-1, 3).astype(np.float64) / (4.0 * math.pi)
    assert radiance(env.pack(Environment(pixels)), AXES["+x"], 1e3)[0] == pytest.approx(mean, rel=1e-5)


@pytest.mark.parametrize("roughness", [0.2, 0.5, 0.8])
def test_prefiltered_edge_is_near_the_ggx_integral(roughness: float) -> None:
    axis = np.array([0.6, 0.64, 0.48])
    table = env.pack(Environment(half_white(128, axis)))
    d, areas = grid(128, 256)
    lobes = unit_vectors(200, 7)
    cos_l = np.clip(lobes @ d.T, 0.0, 1.0)
    alpha2 = roughness**4
    weight = cos_l * areas / (0.5 * (1.0 + cos_l) * (alpha2 - 1.0) + 1.0) ** 2
    truth = weight @ (d @ axis > 0.0) / weight.sum(axis=1)
    error = prefiltered(table, lobes, roughness)[:, 0] - truth
    assert math.sqrt(float(np.mean(error**2))) < 0.06


# --- Irradiance -----------------------------------------------------------------------------------------------------


def test_irradiance_of_a_constant_map_is_pi_times_its_radiance() -> None:
    table = env.pack(Environment(np.full((40, 80, 3), 3.0, np.float32)))
    assert irradiance(table, unit_vectors(500, 8)) == pytest.approx(3.0 * math.pi, rel=1e-3)


@pytest.mark.parametrize("axis", [(0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.64, 0.48)])
def test_irradiance_of_a_white_half_is_its_closed_form(axis: tuple[float, float, float]) -> None:
    # A sky over a tilted surface: pi (1 + cos) / 2.
    table = env.pack(Environment(half_white(128, np.array(axis))))
    normals = unit_vectors(500, 9)
    expected = math.pi * (1.0 + normals @ np.array(axis)) / 2.0
    assert irradiance(table, normals)[:, 1] == pytest.approx(expected, abs=0.005 * math.pi)


def test_irradiance_of_a_sun_is_its_radiance_times_cosine_times_solid_angle() -> None:
    height, width, row, column = 512, 1024, 150, 300
    pixels = np.zeros((height, width, 3), np.float32)
    pixels[row, column] = 1e6
    d, areas = grid(height, width)
    sun = d[row * width + column]
    normals = unit_vectors(300, 10)
    expected = 1e6 * areas[row * width + column] * np.clip(normals @ sun, 0.0, 1.0)
    found = irradiance(env.pack(Environment(pixels)), normals)[:, 0]
    assert found == pytest.approx(expected, abs=0.03 * expected.max())


# --- Drawing --------------------------------------------------------------------------------------------------------


def sunny(height: int) -> F32:
    pixels = noise(height, 2 * height)
    pixels[height // 4, height // 3] = 5e4
    return pixels


@pytest.mark.parametrize("pixels", [noise(16, 32), sunny(64), sunny(512), noise(1, 1), noise(3, 7)])
def test_density_integrates_to_one(pixels: NDArray[np.float32]) -> None:
    # 768 is a multiple of every sampling map's side but 7's, whose texels are 2 * 768 / 7 columns wide.
    d, areas = grid(768, 1536)
    out = np.empty(len(d))
    _density(env.pack(Environment(pixels)), d, out)
    assert out.min() > 0.0
    assert float(out @ areas) == pytest.approx(1.0, rel=2e-3)


def test_drawn_directions_are_unit_and_carry_their_own_density() -> None:
    drawn = draw(env.pack(Environment(sunny(64), rotation("x", 30.0))), 5000, 11)
    assert np.linalg.norm(drawn[:, :3], axis=1) == pytest.approx(1.0, abs=1e-12)
    agree = np.isclose(drawn[:, 3], drawn[:, 4], rtol=1e-9)
    assert agree.mean() > 0.999  # the rest stands on a border between two texels


def test_drawn_directions_follow_luminance() -> None:
    pixels = np.zeros((4, 8, 3), np.float32)
    pixels[1, 2], pixels[2, 5], pixels[3, 6] = (8.0, 0.0, 0.0), (0.0, 4.0, 0.0), (1.0, 1.0, 30.0)
    table = env.pack(Environment(pixels))
    count = 200_000
    drawn = draw(table, count, 12)[:, :3]
    # Counted in cells of another grid than the map's, against the density integrated over them.
    d, areas = grid(300, 600)
    density = np.empty(len(d))
    _density(table, d, density)
    expected = np.bincount(_cell(d), density * areas, 6 * 9)
    counted = np.bincount(_cell(drawn), minlength=6 * 9) / count
    assert counted == pytest.approx(expected, abs=5.0 * math.sqrt(0.25 / count))


def _cell(d: F64) -> NDArray[np.int64]:
    row = np.clip(((d[:, 1] + 1.0) * 3.0).astype(np.int64), 0, 5)
    column = np.clip(((np.arctan2(d[:, 2], d[:, 0]) / math.pi + 1.0) * 4.5).astype(np.int64), 0, 8)
    return np.asarray(row * 9 + column, np.int64)


def test_estimate_of_the_mean_radiance_has_no_bias_and_a_sun_does_little_harm() -> None:
    table = env.pack(Environment(sunny(64)))
    drawn = draw(table, 20_000, 13)
    values = radiance(table, drawn[:, :3])[:, 1] / drawn[:, 3]
    d, areas = grid(512, 1024)
    truth = float(areas @ radiance(table, d)[:, 1])
    assert values.mean() == pytest.approx(truth, abs=4.0 * values.std() / math.sqrt(len(values)))
    assert values.std() / truth < 2.0
    even = float(np.std(radiance(table, unit_vectors(20_000, 14))[:, 1] * 4.0 * math.pi) / truth)
    assert values.std() / truth < 0.25 * even


# --- Bad and extreme pixels -----------------------------------------------------------------------------------------


def test_a_sun_at_the_end_of_float32_stays_finite() -> None:
    pixels = noise(64, 128)
    pixels[10:14, 30:40] = 3e38
    pixels[20, 3] = np.inf
    table = env.pack(Environment(pixels))
    d = unit_vectors(500, 15)
    for footprint in (0.0, 0.2, 10.0):
        assert np.isfinite(radiance(table, d, footprint)).all()
    assert np.isfinite(irradiance(table, d)).all()
    drawn = draw(table, 500, 16)
    assert np.isfinite(drawn).all()
    assert (drawn[:, 3] > 0.0).all()


def test_nan_and_negative_pixels_are_black() -> None:
    pixels = np.full((8, 16, 3), np.nan, np.float32)
    pixels[4:] = -1.0
    table = env.pack(Environment(pixels))
    assert np.all(radiance(table, unit_vectors(100, 17), 0.1) == 0.0)
    assert draw(table, 100, 18)[:, 3] == pytest.approx(1.0 / (4.0 * math.pi))


def test_wrong_arrays_are_refused_by_name() -> None:
    with pytest.raises(SceneError, match=r"environment\.pixels has shape \(4, 8\)"):
        env.pack(Environment(np.zeros((4, 8), np.float32)))
    with pytest.raises(SceneError, match=r"environment\.pixels"):
        env.pack(Environment(np.zeros((0, 8, 3), np.float32)))
    with pytest.raises(SceneError, match=r"environment\.dome_from_world"):
        env.pack(Environment(np.zeros((4, 8, 3), np.float32), np.full((3, 3), np.nan)))


@kernel
def _picks(cdf: F64, guide: NDArray[np.int16], chances: F64, out: NDArray[np.int64]) -> None:
    for i in range(len(chances)):
        out[i] = pick(cdf, guide, chances[i])


@pytest.mark.parametrize(
    "weights", [[1.0], [1.0, 1.0, 2.0], [0.0, 3.0, 0.0, 0.0, 1.0, 0.0], [1e-9] * 40 + [1.0] + [1e-9] * 40]
)
def test_a_guided_search_finds_the_interval(weights: list[float]) -> None:
    cdf = np.concatenate([[0.0], np.cumsum(weights)])
    cdf /= cdf[-1]
    chances = np.concatenate([np.random.default_rng(7).random(2000), cdf[cdf < 1.0], [0.0, np.nextafter(1.0, 0.0)]])
    found = np.empty(len(chances), np.int64)
    _picks(cdf, guide_of(cdf), chances, found)
    assert (cdf[found] <= chances).all()
    assert (chances < cdf[found + 1]).all()
