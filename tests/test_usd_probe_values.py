"""Reflection probes: their textures, and what becomes of values that are out of range."""

from __future__ import annotations

import math

import pytest
from probe_reading import probe, read, read_one

from refract_core.errors import StageError

# ---- textures


def test_given_texture_is_read() -> None:
    found, notices = read_one('uniform token probe:mode = "custom"\nasset probe:texture = @/sky.exr@')
    assert notices == []
    assert found.texture is not None
    assert found.texture.name == "/sky.exr auto"


def test_realtime_probe_never_uses_a_texture() -> None:
    found, notices = read_one('uniform token probe:mode = "realtime"\nasset probe:texture = @/missing.exr@')
    assert (found.texture, notices) == (None, [])


@pytest.mark.parametrize(
    ("body", "word"),
    [
        ('uniform token probe:mode = "custom"', "probe:texture is not set"),
        ("asset probe:texture = @/missing.exr@", "/missing.exr does not exist"),
    ],
)
def test_probe_without_its_texture_is_captured_instead(body: str, word: str) -> None:
    found, notices = read_one(body)
    assert found.texture is None
    assert [word in text and "captured instead" in text for text in notices] == [True]


# ---- values out of range


@pytest.mark.parametrize("name", ["mode", "shape", "proxy"])
def test_unknown_token_is_an_error_that_lists_the_known_ones(name: str) -> None:
    with pytest.raises(StageError, match=rf"^/P: probe:{name} is 'banana'; choose from \w+, \w+"):
        read(probe(f'uniform token probe:{name} = "banana"'))


@pytest.mark.parametrize(
    ("authored", "field", "used"),
    [
        ("uniform int probe:resolution = 7", "resolution", 8),
        ("uniform int probe:resolution = 5000", "resolution", 4096),
        ("float2 probe:clippingRange = (5, 5)", "clipping", (0.1, 1000)),
        ("float2 probe:clippingRange = (0, 5)", "clipping", (0.1, 1000)),
        ("float2 probe:clippingRange = (1, inf)", "clipping", (0.1, 1000)),
        ("float3 probe:captureOffset = (nan, 0, 0)", "capture_point", (0, 0, 0)),
        ("float probe:fadeDistance = 0", "fade_distance", 10000),
        ("float probe:weight = 2", "weight", 1),
        ("float probe:weight = nan", "weight", 1),
        ("float probe:multiplier = -1", "multiplier", 0),
        ("int probe:importance = -3", "importance", 0),
        ("float[] probe:influence:blendDistance = [1]", "blend_distance", (0,) * 6),
        ("float[] probe:influence:blendDistance = [-1, 9, 1, 1, 1, 1]", "blend_distance", (0, 5, 1, 1, 1, 1)),
        ("float[] probe:influence:blendNormalDistance = [6, 0, 0, 0, 0, 0]", "blend_normal_distance", (5,) + (0,) * 5),
        ("float[] probe:influence:faceFade = [0, 2, 0, 0, 0, 0]", "face_fade", (0, 1, 0, 0, 0, 0)),
    ],
)
def test_values_out_of_range_are_replaced_and_told(authored: str, field: str, used: float | tuple[float, ...]) -> None:
    found, notices = read_one(authored)
    assert getattr(found, field) == pytest.approx(used)
    name = authored.split(" = ")[0].split()[-1]
    assert [text.startswith(f"{name} is ") and "used" in text for text in notices] == [True]


@pytest.mark.parametrize("size", ["(0, 1, 1)", "(1, -1, 1)", "(1, 1, inf)", "(nan, 1, 1)"])
def test_impossible_box_falls_back_to_the_schemas_size(size: str) -> None:
    found, notices = read_one(f"float3 probe:influence:size = {size}")
    assert found.influence.extents == (5.0, 5.0, 5.0)
    assert ["three numbers above 0" in text for text in notices] == [True]
    assert all(math.isfinite(extent) for extent in found.influence.extents)
