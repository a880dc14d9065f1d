"""Parts of a picture, drawn on many machines, as one picture."""

from __future__ import annotations

import os
from collections.abc import Sequence

from ..errors import ImageError
from ..files import check_place
from ..progress import Report
from .orders import size_text


def join(out: str, parts: Sequence[str], report: Report) -> None:
    """Write the picture that files are parts of; it is bit by bit the one that would be drawn whole.

    Raises:
        RefractError: whatever goes wrong.
    """
    from ..images.joining import join_parts

    check_place(out, ImageError)
    width, height = join_parts(out, parts)
    report.done(out, f"{width} x {height}, {size_text(os.path.getsize(out))}")
