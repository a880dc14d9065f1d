"""Hash tables that kernels read and write: keys in an array of a power of two, found by linear probing."""

from __future__ import annotations

import numpy as np

from ..kernels.arrays import I64_1D
from ..kernels.compile import inlined

EMPTY = -1
"""What stands in a slot that is free."""


@inlined
def slot_of(keys: I64_1D, key: int) -> int:
    """Where a key is, or the free slot where it belongs (linear probing)."""
    last = keys.shape[0] - 1
    mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
    i = np.int64(mixed >> np.uint64(24)) & last
    while keys[i] != EMPTY and keys[i] != key:
        i = (i + 1) & last
    return int(i)


@inlined
def claim(keys: I64_1D, key: int) -> tuple[int, int]:
    """The slot of a key, which is its own from now on; and 1 if it was free."""
    slot = slot_of(keys, key)
    new = 1 if keys[slot] == EMPTY else 0
    keys[slot] = key
    return slot, new


@inlined
def is_full(keys: I64_1D, filled: int) -> bool:
    """Half of a table's slots are taken, from where on finding a key takes long; then it is of no use."""
    return 2 * filled > keys.shape[0]
