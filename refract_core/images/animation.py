"""Pictures one after the other in one file: GIF and WebP by Pillow, MP4 by the program of the extra `video`."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import ImageError, UsageError
from ..files import replacing
from .codec import extension_of

if TYPE_CHECKING:
    from PIL.Image import Image as Picture

ANIMATED = (".gif", ".webp", ".mp4")
EXTRA = "needs the extra `video`: pip install 'usd-refract[video]'; .gif and .webp need nothing"
FPS = (1.0, 50.0)
"""Pictures a second; the upper end is what viewers make of a GIF."""
_COLORS = 255
"""Of a GIF, beside the one that is clear."""
_LOOKED_AT = 8
"""Pictures that a palette is made for."""
_OPAQUE = 128
"""Alpha from which on a pixel of a GIF is there."""
_VIDEO = ("-vf", "scale=out_color_matrix=bt709:out_range=tv", "-colorspace", "bt709", "-color_primaries", "bt709",
          "-color_trc", "bt709", "-movflags", "+faststart")  # fmt: skip
"""ffmpeg's own choice of a matrix is that of old television, which players do not expect."""


def check_animation(path: str, fps: float) -> None:
    """Refuse, before any work, what `write_animation` could not write.

    Raises:
        UsageError: a number of pictures a second that cannot be, or the extra is not installed.
    """
    if not FPS[0] <= fps <= FPS[1]:
        raise UsageError(f"--fps is {fps}; it must be between {FPS[0]} and {FPS[1]}")
    if extension_of(path) == ".mp4":
        _ffmpeg(path)


def write_animation(path: str, pictures: Sequence[str], fps: float) -> None:
    """Write picture files of one size as one that repeats for ever, in one step.

    Args:
        path: `.gif` has 256 colours, and pixels that are there or not; `.webp` has alpha; `.mp4` is over black.
        pictures: 8-bit files that Pillow reads.

    Raises:
        UsageError: see `check_animation`.
        ImageError: the file cannot be written.
    """
    check_animation(path, fps)
    with replacing(path, ImageError) as temporary:
        try:
            _WRITERS[extension_of(path)](temporary, pictures, fps)
        except (OSError, ValueError, RuntimeError) as error:
            if isinstance(error, OSError) and error.errno is not None:
                raise
            raise ImageError(f"{path}: cannot be encoded: {error}") from error


def _opened(picture: str) -> Picture:
    from PIL import Image

    with Image.open(picture) as file:
        return file.convert("RGBA")


def _gif(path: str, pictures: Sequence[str], fps: float) -> None:
    """One palette for all: with one for each, still parts would flicker."""
    from PIL import Image

    some = [_opened(picture).convert("RGB") for picture in pictures[:: -(-len(pictures) // _LOOKED_AT)]]
    together = Image.fromarray(np.concatenate([np.asarray(one) for one in some]))
    palette = together.quantize(_COLORS)

    def frame(picture: str) -> Picture:
        shown = _opened(picture)
        colors = np.array(shown.convert("RGB").quantize(palette=palette))
        colors[np.asarray(shown)[..., 3] < _OPAQUE] = _COLORS
        made = Image.fromarray(colors, "P")
        made.putpalette(palette.getpalette() or [])
        return made

    ends = [round(100.0 * k / fps) for k in range(len(pictures) + 1)]  # a GIF counts hundredths of a second
    frames = map(frame, pictures)
    next(frames).save(
        path, "GIF", save_all=True, append_images=frames, loop=0, disposal=2, transparency=_COLORS, optimize=False,
        duration=[10 * (end - start) for start, end in pairwise(ends)],
    )  # fmt: skip


def _webp(path: str, pictures: Sequence[str], fps: float) -> None:
    ends = [round(1000.0 * k / fps) for k in range(len(pictures) + 1)]
    frames = map(_opened, pictures)
    next(frames).save(
        path, "WEBP", save_all=True, append_images=frames, loop=0, quality=90,
        duration=[end - start for start, end in pairwise(ends)],
    )  # fmt: skip


def _mp4(path: str, pictures: Sequence[str], fps: float) -> None:
    """H.264 with 4:2:0 colours, which every player has: sides are even, so an odd one gets its last line twice."""

    def pixels(picture: str) -> NDArray[np.uint8]:
        shown = np.asarray(_opened(picture)).astype(np.uint16)
        black = ((shown[..., :3] * shown[..., 3:] + 127) // 255).astype(np.uint8)
        height, width = black.shape[:2]
        return np.ascontiguousarray(np.pad(black, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge"))

    height, width = pixels(pictures[0]).shape[:2]
    ffmpeg: Any = _ffmpeg(path)
    writer = ffmpeg.write_frames(
        path, (width, height), fps=fps, macro_block_size=2, quality=8, output_params=list(_VIDEO),
        ffmpeg_log_level="error",
    )  # fmt: skip
    writer.send(None)
    try:
        for picture in pictures:
            writer.send(pixels(picture))
    finally:
        writer.close()
    if not os.path.exists(path) or not os.path.getsize(path):
        raise ImageError(f"{path}: ffmpeg has written nothing")


def _ffmpeg(path: str) -> Any:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise UsageError(f"{path}: .mp4 {EXTRA}") from error
    return imageio_ffmpeg


_WRITERS = {".gif": _gif, ".webp": _webp, ".mp4": _mp4}
