"""A thing from all sides: one picture for each, or all of them in one file that turns."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable
from dataclasses import replace

from ..errors import ImageError, UsageError
from ..files import check_place
from ..progress import Report
from .executors import Crew
from .orders import check_range, size_text, stop_if
from .render_files import Order, render_files

FRAMES = (1, 10_000)
_GROUP = re.compile("#+")


def turntable(
    order: Order, fps: float, report: Report, cancel: Callable[[], bool], crew: Crew | None = None
) -> None:
    """Render a turn, and write it as pictures or as one file.

    Args:
        order: `turn` says how many pictures; its `out` is a pattern with a ### group, or a .gif, .webp or .mp4.
        fps: pictures a second, in one file.

    Raises:
        RefractError: whatever goes wrong.
    """
    from ..images.animation import ANIMATED, check_animation, write_animation

    check_range("--frames", order.turn, FRAMES)
    name = os.path.basename(order.out)
    if len(order.cameras) > 1:
        raise UsageError("--camera may be given once: a turn starts from one camera")
    if groups := _GROUP.findall(name):
        if len(groups) > 1:
            raise UsageError(f"{order.out}: the file name needs one ### group; it has {len(groups)}")
        render_files(order, report, cancel, crew)
        return
    if os.path.splitext(name)[1].lower() not in ANIMATED:
        what = f"{order.out}: one name for {order.turn} pictures"
        raise UsageError(f"{what}; put a #### group in it, such as turn.####.png, or write {', '.join(ANIMATED)}")
    check_animation(order.out, fps)
    check_place(order.out, ImageError)
    if order.skip_existing and os.path.exists(order.out):
        report.done(order.out, "exists, skipped")
        return
    with tempfile.TemporaryDirectory(prefix="refract-") as folder:
        pictures = os.path.join(folder, "turn.#####.png")
        render_files(replace(order, out=pictures), _within(report), cancel, crew)
        stop_if(cancel, "no unfinished file was left")
        report.progress(1.0, "writing")
        write_animation(order.out, [os.path.join(folder, one) for one in sorted(os.listdir(folder))], fps)
    report.done(order.out, f"{order.turn} pictures, {size_text(os.path.getsize(order.out))}")


def _within(report: Report) -> Report:
    """Who is told of the pictures between: nobody hears of files that do not stay."""
    return report._replace(done=lambda _path, _text: None)
