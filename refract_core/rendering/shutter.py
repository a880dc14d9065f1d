"""What happens while a camera's shutter is open: at which instants a picture is drawn, and by which of its samples.

The picture is the mean of its samples, and every sample sees the stage at an instant of its own, as it sees it from a
place of its own within the pixel and on the lens (docs/decisions/motion-blur.md). So whatever can move is blurred, and
nothing below here knows of time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from ..kernels.sampling import pixel_offsets, radical_inverse
from ..scene import Camera, Notice, Scene
from ..settings import RenderSettings
from .ready import Ready

MOST = 64
"""Instants of a picture. Each has the stage read and made ready anew, so samples beyond these share them."""
_SMOOTH = 64
"""Instants from which on nobody is told."""


class Moment(NamedTuple):
    """One instant that is drawn."""

    time_code: float
    samples: tuple[int, ...]
    """those of every pixel that see it, in rising order"""


class Instant(NamedTuple):
    """The stage at a moment, made ready."""

    ready: Ready
    scene: Scene
    camera: Camera
    samples: Sequence[int]


def is_open(camera: Camera, settings: RenderSettings) -> bool:
    """Something moves while the shutter of the camera that takes the picture is open. A camera of its own has none."""
    return camera.shutter[0] < camera.shutter[1] and settings.motion_blur and not settings.orbits


def moments_of(camera: Camera, settings: RenderSettings, time_code: float) -> list[Moment]:
    """The instants of a picture, each with its samples, in the order of their first ones; one sample sees none of it,
    and gets none.

    The shutter is cut into equal parts, each of which has one instant, in its middle. Which sample sees which is the
    third coordinate of the Hammersley set whose others are places in the pixel, so that coverage of what moves is even
    whichever way it moves. Sample 0, whose depth, normal and numbers the picture keeps, sees the time of the frame
    itself, or what is nearest to it while the shutter is open.
    """
    count = settings.samples
    if count < 2 or not is_open(camera, settings):
        return []
    opens, closes = camera.shutter
    parts = min(count, MOST)
    at_frame = min(max(-opens / (closes - opens), 0.0), 1.0)  # share of the shutter
    wanted = min(int(at_frame * parts), parts - 1)
    places = [round((x + 0.5) * count - 0.5) for x, _ in pixel_offsets(count)]
    ranks = {place: rank for rank, place in enumerate(sorted(range(count), key=lambda i: radical_inverse(i, 3)))}
    turn = wanted - ranks[places[0]] * parts // count
    by_part: dict[int, list[int]] = {}
    for sample, place in enumerate(places):
        by_part.setdefault((ranks[place] * parts // count + turn) % parts, []).append(sample)
    found = []
    for part, samples in by_part.items():
        share = at_frame if part == wanted else (part + 0.5) / parts
        found.append(Moment(time_code + opens + share * (closes - opens), tuple(samples)))
    return found


def shutter_of_few(
    camera: Camera, settings: RenderSettings, moments: Sequence[Moment], *, readable: bool
) -> tuple[Notice, ...]:
    """Say that a shutter was left out, or drawn by few instants.

    Args:
        readable: whoever asked for the picture can read the stage at other times
    """
    if not is_open(camera, settings) or len(moments) >= _SMOOTH:
        return ()
    opens, closes = camera.shutter
    open_while = f"its shutter is open from {opens:g} to {closes:g} while things move"
    if moments:
        text = f"what moves while its shutter is open is drawn at {len(moments)} instants, and may show as many edges"
    elif readable:
        text = f"{open_while}, but there is one sample: everything stands still at the time of the frame"
    else:
        return (Notice(camera.path, f"{open_while}, but this is one instant: everything stands still at its time"),)
    return (Notice(camera.path, f"{text}; --samples {2 * _SMOOTH} or more is smooth"),)
