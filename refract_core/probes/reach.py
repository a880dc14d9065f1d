"""Which probes may reach a point, in a time that hardly depends on how many there are.

Each axis is cut at the ends of the probes' bounds; between two cuts a set of bits says which probes span the piece. A
point looks up one piece per axis by bisection and intersects the three sets: exactly the probes whose bounds hold it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.arrays import F64_2D, I64_3D
from ..kernels.compile import inlined

WORD = 32
"""Probes per word of a set."""


class Reach(NamedTuple):
    """The cut axes."""

    cuts: F64_2D
    """shape (3, C): ascending [m]"""
    sets: I64_3D
    """shape (3, C + 1, W): probe k is bit k % WORD of word k // WORD"""


def reach_of(low: NDArray[np.float64], high: NDArray[np.float64]) -> Reach:
    """Cut the axes for bounds `low` and `high`, shape (K, 3) [m], in the order in which the probes are asked."""
    count = len(low)
    words = (count + WORD - 1) // WORD
    cuts = np.sort(np.concatenate([low, high]), axis=0).T.copy()
    sets = np.zeros((3, cuts.shape[1] + 1, words), np.int64)
    for axis in range(3):
        begin = np.searchsorted(cuts[axis], low[:, axis], side="right")
        end = np.searchsorted(cuts[axis], high[:, axis], side="left") + 1
        for k in range(count):
            sets[axis, begin[k] : end[k], k // WORD] |= 1 << (k % WORD)
    return Reach(cuts, sets)


@inlined
def piece_of(cuts: NDArray[np.float64], axis: int, x: float) -> int:
    """Number of the piece of an axis that holds `x`: how many cuts are not above it."""
    low, high = 0, cuts.shape[1]
    while low < high:
        middle = (low + high) // 2
        if cuts[axis, middle] <= x:
            low = middle + 1
        else:
            high = middle
    return low


@inlined
def next_of(sets: NDArray[np.int64], i: int, j: int, m: int, k: int) -> int:
    """Least probe number from `k` on that is in the sets of pieces i, j and m of the three axes; -1 for none."""
    # Words keep 32 of their 64 bits, so that no bit is ever a sign and shifting right brings in zeros alone.
    word, bit = k // WORD, k % WORD
    while word < sets.shape[2]:
        bits = (sets[0, i, word] & sets[1, j, word] & sets[2, m, word]) >> bit
        if bits != 0:
            while bits & 1 == 0:
                bits >>= 1
                bit += 1
            return word * WORD + bit
        word += 1
        bit = 0
    return -1
