"""Texture coordinates for a mesh that has none: charts by xatlas, each texel of which stands for one place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import UsageError
from ..scene import F64

EXTRA = "needs the extra `unwrap`: pip install 'usd-refract[unwrap]'"
_GAP = 6
"""Texels between charts: more than the rim that a picture grows around each."""


def unwrap(points: F64, triangles: NDArray[np.integer], size: int) -> tuple[F64, int]:
    """Coordinates in 0 .. 1 that overlap nowhere.

    Args:
        points: shape (V, 3).
        triangles: shape (T, 3).
        size: texels on a side of the picture that they are for.

    Returns:
        Shape (T, 3, 2), v upwards; and how many charts they are.

    Raises:
        UsageError: xatlas is not installed.
    """
    try:
        import xatlas
    except ImportError as error:
        raise UsageError(f"a mesh without uv {EXTRA}") from error
    low = points.min(axis=0)
    within = ((points - low) / max(float(np.ptp(points, axis=0).max()), 1e-300)).astype(np.float32)
    atlas = xatlas.Atlas()
    atlas.add_mesh(np.ascontiguousarray(within), np.ascontiguousarray(triangles, np.uint32))
    options = xatlas.PackOptions()
    options.padding, options.resolution = _GAP, size
    atlas.generate(pack_options=options)
    _, corners, uv = atlas[0]
    found: F64 = np.asarray(uv, np.float64)[np.asarray(corners, np.int64)]
    return found, int(atlas.chart_count)
