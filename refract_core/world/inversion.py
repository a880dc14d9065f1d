"""Drawing one of many intervals in proportion to its chance, by inversion with a guide (Chen and Asau 1974).

A search by halves in a table that is large and read at random waits for memory at every step; a guide leaves two.
"""

from __future__ import annotations

import numpy as np

from ..kernels.compile import inlined
from ..scene import F32, F64

I16 = np.ndarray[tuple[int, ...], np.dtype[np.int16]]


def guide_of(cdf: F32 | F64) -> I16:
    """Where the search for a chance begins: shape (G,), an entry for four intervals.

    Args:
        cdf: shape (N + 1,), N up to 32767: chance before interval i; the last is 1.
    """
    count = max((len(cdf) - 1) // 4, 1)
    return (np.searchsorted(cdf, np.arange(count) / count, side="right") - 1).astype(np.int16)


@inlined
def pick(cdf: F32 | F64, guide: I16, u: float) -> int:
    """Index i with cdf[i] <= u < cdf[i + 1], of an interval that is not empty, for u in 0 .. 1."""
    cells, last = guide.shape[0], cdf.shape[0] - 2
    i = int(guide[min(int(u * cells), cells - 1)])
    while i < last and cdf[i + 1] <= u:
        i += 1
    return i
