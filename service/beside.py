"""Pictures that lie beside the stages of the stage root, `marble.png` beside `marble.usda`, for a list of them.

They are whoever runs the service's own files, as the stages are, and are sent as they are: the server opens none.
"""

from __future__ import annotations

from pathlib import Path
from urllib.parse import quote

from .limits import Limits


def picture_of(root: Path, name: str, limits: Limits) -> Path | None:
    """The picture beside a stage; None where there is none that may be sent.

    Args:
        name: path of the stage relative to the root, checked by `bodies.own_stage`.
    """
    top = root.resolve()
    path = (top / name).with_suffix(".png")
    try:
        known = path.resolve().is_relative_to(top) and path.is_file() and path.stat().st_size <= limits.result_bytes
    except OSError:
        known = False
    return path if known else None


def href_of(root: Path | None, name: str, limits: Limits) -> str:
    """Address of the picture beside a stage; '' where there is none."""
    return f"/v1/pictures/{quote(name)}" if root is not None and picture_of(root, name, limits) else ""
