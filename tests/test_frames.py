"""Frame ranges and file names of a sequence, by usdrecord's rules."""

from __future__ import annotations

import pytest

from refract_core.errors import UsageError
from refract_core.usd.time_codes import MAX_FRAMES, frame_jobs, frame_path, parse_frames


@pytest.mark.parametrize(
    ("spec", "codes"),
    [
        ("101", [101]),
        ("-2:1", [-2, -1, 0, 1]),
        ("101:110x4", [101, 105, 109]),
        ("3:1", [3, 2, 1]),
        ("1:2x0.5", [1, 1.5, 2]),
        ("5,1:2 , 2", [5, 1, 2]),
    ],
)
def test_frame_specs_are_those_of_usdrecord(spec: str, codes: list[float]) -> None:
    assert parse_frames(spec) == pytest.approx(codes)


@pytest.mark.parametrize("spec", ["", "x", "1:", "1:3x0", "1:3x-1", "nan", "1:inf", "1,,2", f"1:{MAX_FRAMES * 9}"])
def test_malformed_frame_specs_are_usage_errors(spec: str) -> None:
    with pytest.raises(UsageError, match="--frames"):
        parse_frames(spec)


@pytest.mark.parametrize(
    ("pattern", "time_code", "path"),
    [
        ("out/a.###.png", 7, "out/a.007.png"),
        ("a#.png", 1234, "a1234.png"),
        ("a.###.##.png", 1.25, "a.001.25.png"),
        ("a.####.png", -5, "a.-005.png"),
        ("some#folder/a_##.png", 3, "some#folder/a_03.png"),
    ],
)
def test_the_group_is_padded_to_its_width(pattern: str, time_code: float, path: str) -> None:
    assert frame_path(pattern, time_code) == path


def test_a_single_frame_needs_no_group() -> None:
    assert frame_jobs("7", "a.png") == [(7.0, "a.png")]
    assert frame_jobs("7", "a.##.png") == [(7.0, "a.07.png")]
    with pytest.raises(UsageError, match="exactly one ### group"):
        frame_jobs("7,8", "a.png")


def test_without_frames_there_is_one_job_at_the_stages_start() -> None:
    assert frame_jobs("", "some#folder/a.png") == [(None, "some#folder/a.png")]
