"""Frames of a sequence: which time codes a person asks for, and what their files are called. As usdrecord."""

from __future__ import annotations

import os
import re
from typing import NamedTuple

from pxr import Tf, UsdUtils

from ..errors import UsageError

MAX_FRAMES = 1_000_000
_GROUP = re.compile(r"#+(?:\.#+)?")
_NUMBER = r"[-+]?\d{1,15}(?:\.\d{0,15})?"
# Checked before USD sees it: the half range "1:" crashes the process (usd-core 26.11).
_SPEC = re.compile(rf"{_NUMBER}(?::{_NUMBER}(?:x{_NUMBER})?)?", re.ASCII)


class FrameJob(NamedTuple):
    """One picture of a sequence."""

    time_code: float | None
    """None is the stage's start."""
    path: str


def frame_jobs(frames: str, pattern: str) -> list[FrameJob]:
    """The pictures to make.

    Args:
        frames: `101`, `101:110`, `101:110x2`, several of them with commas between; '' is the stage's start alone.
        pattern: output path. With several frames its file name has one group of `#`, such as `shot.###.png`, or
            `shot.###.##.png` for fractions of a frame; a single one needs none.

    Raises:
        UsageError: a malformed frame range, or a pattern that does not fit it.
    """
    groups = _GROUP.findall(os.path.basename(pattern))
    if not frames.strip():
        if groups:
            raise UsageError(f"{pattern}: the ### group needs --frames, such as --frames 1:10; or remove the group")
        return [FrameJob(None, pattern)]
    codes = parse_frames(frames)
    if not groups and len(codes) == 1:
        return [FrameJob(codes[0], pattern)]
    if len(groups) != 1:
        raise UsageError(
            f"{pattern}: with several --frames the file name needs exactly one ### group, such as frame.###.png; "
            f"it has {len(groups)}"
        )
    return [FrameJob(time_code, frame_path(pattern, time_code)) for time_code in codes]


def parse_frames(frames: str) -> list[float]:
    """Time codes of a comma-separated list of USD frame specs, in the order given, without repeats.

    Raises:
        UsageError: a spec is malformed, or asks for more than `MAX_FRAMES` frames.
    """
    codes: dict[float, None] = {}
    for spec in frames.split(","):
        codes.update(dict.fromkeys(_range(spec.strip())))
        if len(codes) > MAX_FRAMES:
            raise UsageError(f"--frames '{frames}' is over {MAX_FRAMES} frames; give a shorter range")
    return list(codes)


def _range(spec: str) -> list[float]:
    """Time codes of one frame spec. Raises UsageError."""
    if _SPEC.fullmatch(spec) is None:
        raise UsageError(_malformed(spec))
    try:
        codes = UsdUtils.TimeCodeRange.CreateFromFrameSpec(spec)
    except Tf.ErrorException as error:
        raise UsageError(_malformed(spec)) from error
    first, last, stride = codes.startTimeCode.GetValue(), codes.endTimeCode.GetValue(), codes.stride
    if abs(last - first) / abs(stride) > MAX_FRAMES:
        raise UsageError(f"--frames '{spec}' is over {MAX_FRAMES} frames; give a shorter range")
    return [code.GetValue() for code in codes]


def _malformed(spec: str) -> str:
    return (
        f"--frames '{spec}' is not a frame range; write a frame (101), a range (101:110) or a range with a stride "
        "(101:110x2, 110:101x-2), with commas between several"
    )


def frame_path(pattern: str, time_code: float) -> str:
    """`pattern` with its `#` group replaced by the time code, zero-padded to the group's width.

    Raises:
        UsageError: the time code has more decimals than the group.
    """
    folder, name = os.path.split(pattern)
    match = _GROUP.search(name)
    if match is None:
        raise UsageError(f"{pattern}: the file name has no ### group")
    whole, _, fraction = match.group().partition(".")
    width = len(whole) + (1 + len(fraction) if fraction else 0)
    number = f"{time_code:0{width}.{len(fraction)}f}"
    if abs(float(number) - time_code) > 1e-6:
        raise UsageError(
            f"{pattern}: frame {time_code:g} has more decimals than the group '{match.group()}'; "
            "add # after a dot, such as ###.##, or use a coarser stride"
        )
    return os.path.join(folder, name[: match.start()] + number + name[match.end() :])
