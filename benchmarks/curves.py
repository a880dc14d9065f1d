"""Error against time: how long each program needs for an error, and the picture of it (SVG, written by hand)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from typing import NamedTuple


class Point(NamedTuple):
    """One picture of a program."""

    name: str
    seconds: float
    decibels: float
    """PSNR"""


class Needed(NamedTuple):
    """How long a program needs."""

    seconds: float
    """nan: it never gets there"""
    at_most: bool = False
    """Its fastest picture is there already."""


def needed(curve: Sequence[Point], decibels: float) -> Needed:
    """Seconds until a curve reaches an error for the first time; log seconds are straight between its points."""
    before: Point | None = None
    for point in sorted(curve, key=lambda p: p.seconds):
        if point.decibels >= decibels:
            if before is None:
                return Needed(point.seconds, True)
            share = (decibels - before.decibels) / (point.decibels - before.decibels)
            low, high = math.log(before.seconds), math.log(point.seconds)
            return Needed(math.exp(low + share * (high - low)))
        before = point
    return Needed(math.nan)


def times_faster(ours: Needed, theirs: Needed) -> str:
    """Their seconds by ours. `>`: ours may be faster still; `<`: theirs may; `~`: both; `-`: one never gets there."""
    ratio = theirs.seconds / ours.seconds
    if math.isnan(ratio):
        return "-"
    mark = "~" if ours.at_most and theirs.at_most else ">" if ours.at_most else "<" if theirs.at_most else ""
    return f"{mark}{ratio:.2g}" if ratio < 10.0 else f"{mark}{ratio:.0f}"


# ------------------------------------------------------------------------------------------------ the picture


_SIZE = (760, 480)
_FRAME = (70, 50, 730, 420)
"""Left, top, right, bottom of the axes."""
_INKS = ("#0b6e99", "#c2410c", "#4d7c0f", "#7e22ce")


class _Axes(NamedTuple):
    """Decades of seconds along x, tens of decibels along y."""

    decades: tuple[int, int]
    tens: tuple[int, int]

    def x(self, seconds: float) -> float:
        low, high = self.decades
        return _FRAME[0] + (math.log10(seconds) - low) / (high - low) * (_FRAME[2] - _FRAME[0])

    def y(self, decibels: float) -> float:
        low, high = self.tens
        return _FRAME[3] - (decibels / 10.0 - low) / (high - low) * (_FRAME[3] - _FRAME[1])


def svg(title: str, curves: dict[str, list[Point]]) -> str:
    """A chart of the curves, each by its name.

    Raises:
        ValueError: there is nothing to show.
    """
    points = [point for curve in curves.values() for point in curve if math.isfinite(point.decibels)]
    if not points:
        raise ValueError("no point has an error; give curves with points")
    logs, tens = [math.log10(p.seconds) for p in points], [p.decibels / 10.0 for p in points]
    axes = _Axes(*((math.floor(min(v)), max(math.ceil(max(v)), math.floor(min(v)) + 1)) for v in (logs, tens)))
    parts = [_text(_FRAME[0], 28, title, 16), *_grid(axes)]
    for k, (name, curve) in enumerate(curves.items()):
        parts += _drawn(axes, sorted(curve, key=lambda p: p.seconds), _INKS[k % len(_INKS)])
        parts.append(_text(_FRAME[0] + 12, _FRAME[1] + 20 + 18 * k, name, 14, _INKS[k % len(_INKS)]))
    size = f'width="{_SIZE[0]}" height="{_SIZE[1]}" viewBox="0 0 {_SIZE[0]} {_SIZE[1]}"'
    paper = '<rect width="100%" height="100%" fill="white"/>'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif">'
    return "\n".join([head, paper, *parts, "</svg>\n"])


def _text(x: float, y: float, text: str, size: int = 11, ink: str = "#333", anchor: str = "start") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" fill="{ink}" text-anchor="{anchor}">{escape(text)}</text>'


def _line(x0: float, y0: float, x1: float, y1: float) -> str:
    return f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="#ddd"/>'


def _grid(axes: _Axes) -> list[str]:
    left, top, right, bottom = _FRAME
    parts = []
    for decade in range(axes.decades[0], axes.decades[1] + 1):
        for step in (1, 2, 5) if decade < axes.decades[1] else (1,):
            seconds = step * 10.0**decade
            parts += [_line(axes.x(seconds), top, axes.x(seconds), bottom)]
            parts += [_text(axes.x(seconds), bottom + 18, f"{seconds:g}", anchor="middle")]
    for five in range(2 * axes.tens[0], 2 * axes.tens[1] + 1):
        parts += [_line(left, axes.y(5.0 * five), right, axes.y(5.0 * five))]
        parts += [_text(left - 8, axes.y(5.0 * five) + 4, f"{5 * five}", anchor="end")]
    return [*parts, _text((left + right) / 2, bottom + 42, "seconds", 13, anchor="middle")]


def _drawn(axes: _Axes, curve: list[Point], ink: str) -> list[str]:
    shown = [(axes.x(p.seconds), axes.y(p.decibels), p.name) for p in curve if math.isfinite(p.decibels)]
    way = " ".join(f"{x:.1f},{y:.1f}" for x, y, _ in shown)
    parts = [f'<polyline points="{way}" fill="none" stroke="{ink}" stroke-width="2"/>']
    for x, y, name in shown:
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{ink}"/>', _text(x + 7, y + 14, name, 11, ink)]
    return parts
