"""Textures: mip chains keep the mean, and sampling follows UsdUVTexture's words on wrapping and colour spaces."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from refract_core.scene import Texture, Wrap
from refract_core.world.textures import LARGEST, TextureTable, pack, sample

CLAMP = int(Wrap.CLAMP)
EVERY_WRAP = [int(wrap) for wrap in Wrap]


def floats(rows: Any) -> Texture:
    """A float texture from grey values; row 0 is the top."""
    grey = np.asarray(rows, np.float32)
    return Texture("grey", np.repeat(grey[..., None], 4, axis=2))


def levels_of(table: TextureTable, index: int = 0) -> list[NDArray[Any]]:
    pool: NDArray[Any] = table.float_pool if table.is_float[index] else table.bytes_pool
    chain = table.levels[index, : table.counts[index]]
    return [pool[offset : offset + w * h].reshape(h, w, 4) for offset, w, h in chain]


def red(table: TextureTable, s: float, t: float, footprint: float = 0.0, wrap: int = CLAMP, index: int = 0) -> float:
    return sample(table, index, s, t, footprint, wrap, wrap)[0]


def srgb_to_linear(value: float) -> float:
    """IEC 61966-2-1, written out here for its own sake."""
    return value / 12.92 if value <= 0.04045 else math.pow((value + 0.055) / 1.055, 2.4)


# --- packing


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 7), (5, 1), (2, 2), (3, 3), (6, 5), (17, 64), (31, 13)])
def test_every_level_has_the_mean_of_the_image(height: int, width: int) -> None:
    pixels = np.random.default_rng(7).random((height, width, 4), np.float32)
    chain = levels_of(pack([Texture("noise", pixels)]))
    assert chain[-1].shape == (1, 1, 4)
    for finer, coarser in pairwise(chain):
        assert coarser.shape[:2] == (max(finer.shape[0] // 2, 1), max(finer.shape[1] // 2, 1))
    for level in chain:
        np.testing.assert_allclose(level.mean((0, 1)), pixels.mean((0, 1)), rtol=1e-5)


def test_an_even_image_is_halved_two_by_two() -> None:
    chain = levels_of(pack([floats([[1, 3, 0, 0], [5, 7, 0, 8], [0, 0, 1, 1], [0, 4, 1, 1]])]))
    np.testing.assert_allclose(chain[1][..., 0], [[4, 2], [1, 1]])
    np.testing.assert_allclose(chain[2][..., 0], [[2]])


def test_an_odd_row_is_shared_by_overlap() -> None:
    """Five texels become two: each covers two and a half, so the middle one is split in half."""
    chain = levels_of(pack([floats([[1, 2, 3, 4, 5]])]))
    np.testing.assert_allclose(chain[1][0, :, 0], [(1 + 2 + 1.5) / 2.5, (1.5 + 4 + 5) / 2.5], rtol=1e-6)


def test_bytes_are_averaged_in_linear_light() -> None:
    """Black and white make half the light, which sRGB writes as 188, and alpha 0 and 255 make 128."""
    pixels = np.array([[[0, 0, 0, 0], [255, 255, 255, 255]]], np.uint8)
    encoded = levels_of(pack([Texture("edge", pixels, srgb=True)]))[1]
    np.testing.assert_array_equal(encoded, [[[188, 188, 188, 128]]])
    raw = levels_of(pack([Texture("edge", pixels)]))[1]
    np.testing.assert_array_equal(raw, [[[128, 128, 128, 128]]])


@pytest.mark.parametrize("srgb", [False, True])
def test_every_byte_survives_the_mip_chain(srgb: bool) -> None:
    for value in range(256):
        chain = levels_of(pack([Texture("flat", np.full((3, 6, 4), value, np.uint8), srgb)]))
        assert all((level == value).all() for level in chain)


def test_no_textures_make_a_table_that_answers_nothing() -> None:
    assert sample(pack([]), 0, 0.5, 0.5, 0.0, CLAMP, CLAMP) == (0.0, 0.0, 0.0, 0.0)


def test_textures_do_not_mix_in_their_pools() -> None:
    values = [0.25, 200, 0.75, 51]
    textures = []
    for n, value in enumerate(values, start=1):
        flat = np.full((n, n + 1, 4), value)
        pixels = flat.astype(np.uint8) if isinstance(value, int) else flat.astype(np.float32)
        textures.append(Texture(str(value), pixels))
    table = pack(textures)
    for index, value in enumerate(values):
        for footprint in (0.0, 0.4, 1.0):
            expected = value / 255 if isinstance(value, int) else value
            assert red(table, 0.3, 0.6, footprint, index=index) == pytest.approx(expected, abs=1e-6)


def test_texels_that_are_no_number_do_not_spread() -> None:
    table = pack([floats([[np.nan, np.inf, -np.inf, 2.0]])])
    np.testing.assert_array_equal(levels_of(table)[0][0, :, 0], [0.0, LARGEST, -LARGEST, 2.0])
    assert math.isfinite(red(table, 0.5, 0.5, 0.3))


# --- sampling


def test_a_texel_centre_gives_the_texel_with_the_top_row_at_t_1() -> None:
    rows = np.arange(12, dtype=np.float32).reshape(3, 4)
    table = pack([floats(rows)])
    for row in range(3):
        for column in range(4):
            value = red(table, (column + 0.5) / 4, 1 - (row + 0.5) / 3)
            assert value == pytest.approx(rows[row, column], abs=1e-6)


def test_between_centres_it_is_bilinear() -> None:
    table = pack([floats([[0, 1], [2, 5]])])
    assert red(table, 0.5, 0.5) == pytest.approx(2.0)
    assert red(table, 0.5, 0.75) == pytest.approx(0.5)  # top row
    assert red(table, 0.375, 0.75) == pytest.approx(0.25)


def test_srgb_bytes_are_decoded_before_they_are_filtered() -> None:
    table = pack([Texture("grey", np.array([[[0] * 4, [128] * 4]], np.uint8), srgb=True)])
    linear = srgb_to_linear(128 / 255)
    assert linear == pytest.approx(0.21586, abs=1e-5)
    r, g, b, a = sample(table, 0, 0.5, 0.5, 0.0, CLAMP, CLAMP)
    assert (r, g, b) == pytest.approx((linear / 2,) * 3, rel=1e-5)
    assert a == pytest.approx(64 / 255, rel=1e-5)  # alpha is never encoded


def test_every_srgb_byte_decodes_as_the_standard_says() -> None:
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 4, axis=2)
    table = pack([Texture("ramp", ramp, srgb=True)])
    decoded = [red(table, (i + 0.5) / 256, 0.5) for i in range(256)]
    np.testing.assert_allclose(decoded, [srgb_to_linear(i / 255) for i in range(256)], rtol=2e-6, atol=1e-9)


RAMP = floats([[1, 2, 3, 4]])


@pytest.mark.parametrize("x", [0.1, 0.3, 0.49, 0.77, 0.95])
@pytest.mark.parametrize("turns", [-3, -1, 0, 1, 2, 1000])
def test_repeat_has_period_one(x: float, turns: int) -> None:
    table = pack([RAMP])
    repeat = int(Wrap.REPEAT)
    assert red(table, x + turns, 0.5, wrap=repeat) == pytest.approx(red(table, x, 0.5, wrap=repeat), abs=1e-9)


def test_repeat_blends_the_last_texel_with_the_first() -> None:
    assert red(pack([RAMP]), 1.0, 0.5, wrap=int(Wrap.REPEAT)) == pytest.approx(2.5)


@pytest.mark.parametrize("x", [0.05, 0.3, 0.8])
def test_mirror_is_even_about_each_edge(x: float) -> None:
    table = pack([RAMP])
    mirror = int(Wrap.MIRROR)
    inside = red(table, x, 0.5, wrap=mirror)
    for other in (-x, 2 - x, 2 + x, 4 - x, x - 100):
        assert red(table, other, 0.5, wrap=mirror) == pytest.approx(inside, abs=1e-9)


def test_clamp_holds_the_edge_and_black_fades_to_nothing() -> None:
    table = pack([RAMP])
    for x, edge in ((-7.0, 1.0), (0.0, 1.0), (1.0, 4.0), (1e30, 4.0)):
        assert red(table, x, 0.5) == pytest.approx(edge)
    for x in (-7.0, -0.13, 1.13, 1e30):
        assert sample(table, 0, x, 0.5, 0.0, int(Wrap.BLACK), CLAMP) == (0.0, 0.0, 0.0, 0.0)
    assert sample(table, 0, 0.0, 0.5, 0.0, int(Wrap.BLACK), CLAMP)[0] == pytest.approx(0.5)


def test_each_axis_has_its_own_wrap_mode() -> None:
    table = pack([floats([[1, 2], [3, 4]])])
    value = sample(table, 0, 1.25, 1.6, 0.0, int(Wrap.REPEAT), CLAMP)[0]
    assert value == pytest.approx(1.0)  # column 0 again, top row held


@pytest.mark.parametrize("texels", [1.0, 2.0, 4.0, 8.0])
def test_a_footprint_of_n_texels_takes_the_level_where_it_is_one(texels: float) -> None:
    pixels = np.random.default_rng(1).random((8, 8, 4), np.float32)
    table = pack([Texture("noise", pixels)])
    level = int(math.log2(texels))
    size = 8 >> level
    expected = levels_of(table)[level][0, 0, 0]
    assert red(table, 0.5 / size, 1 - 0.5 / size, texels / 8) == pytest.approx(expected, rel=1e-6)


def test_between_levels_it_is_linear_in_the_logarithm() -> None:
    table = pack([floats([[0, 1], [1, 1]])])
    fine, coarse = red(table, 0.25, 0.75, 0.0), red(table, 0.25, 0.75, 1.0)
    assert (fine, coarse) == pytest.approx((0.0, 0.75))
    assert red(table, 0.25, 0.75, 0.5 * math.sqrt(2)) == pytest.approx(0.375)


@pytest.mark.parametrize("wrap", [int(Wrap.CLAMP), int(Wrap.REPEAT), int(Wrap.MIRROR)])
@pytest.mark.parametrize("size", [(1, 1), (3, 5), (16, 2)])
def test_a_constant_image_is_constant(wrap: int, size: tuple[int, int]) -> None:
    table = pack([floats(np.full(size, 0.7))])
    points = np.random.default_rng(2).uniform(-3, 3, (50, 2))
    for s, t in points:
        for footprint in (0.0, 0.01, 0.3, 1.0, 50.0, math.inf):
            assert red(table, s, t, footprint, wrap) == pytest.approx(0.7, rel=1e-6)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("wrap", EVERY_WRAP)
def test_coordinates_that_are_no_number_give_zeros(bad: float, wrap: int) -> None:
    table = pack([RAMP])
    assert sample(table, 0, bad, 0.5, 0.0, wrap, wrap) == (0.0, 0.0, 0.0, 0.0)
    assert sample(table, 0, 0.5, bad, 0.0, wrap, wrap) == (0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("footprint", [math.nan, -1.0])
def test_a_footprint_that_is_none_takes_the_full_size(footprint: float) -> None:
    table = pack([RAMP])
    assert red(table, 0.3, 0.5, footprint) == red(table, 0.3, 0.5, 0.0)


@pytest.mark.parametrize("index", [-1, 1, 10**9])
def test_a_texture_that_is_not_there_gives_zeros(index: int) -> None:
    assert sample(pack([RAMP]), index, 0.5, 0.5, 0.0, CLAMP, CLAMP) == (0.0, 0.0, 0.0, 0.0)


any_float = st.floats(width=64, allow_nan=True, allow_infinity=True)


@settings(max_examples=300, deadline=None)
@given(s=any_float, t=any_float, footprint=any_float, wraps=st.tuples(*[st.sampled_from(EVERY_WRAP)] * 2))
def test_no_input_leaves_the_image(s: float, t: float, footprint: float, wraps: tuple[int, int]) -> None:
    """The pool around the sampled texture is full of a value that would show."""
    poison = floats(np.full((2, 2), 1e6))
    table = pack([poison, floats([[1, 2, 3], [4, 5, 6], [1, 3, 5]]), poison])
    r, g, b, a = sample(table, 1, s, t, footprint, *wraps)
    assert min(r, g, b, a) >= 0.0
    assert max(r, g, b, a) <= 6.0 + 1e-6
