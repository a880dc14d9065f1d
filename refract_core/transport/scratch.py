"""Working memory of a kernel: made once per thread, handed over by address."""

from __future__ import annotations

import threading
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kernels.pointer import Pointer
from ..world.embree import LANES, Packet, new_packet
from ..world.shading import Block, new_block
from .exits import Exits, new_exits
from .tiers import Query, new_query


class Scratch(NamedTuple):
    """What one thread needs to draw a 4x2 block of pixels. No kernel finds anything of use in it when it starts."""

    packet: Packet
    block: Block
    second: Block
    third: Block
    exits: Exits
    query: Query
    far: NDArray[np.float64]
    """shape (8,): T_FAR that each lane started with"""
    parts: NDArray[np.int32]
    ior: NDArray[np.float64]
    z_self: NDArray[np.float64]
    opacity: NDArray[np.float64]
    through: NDArray[np.float64]
    """shape (8, 3)"""


_THREAD = threading.local()


def scratch() -> Pointer:
    """The calling thread's own."""
    if not hasattr(_THREAD, "scratch"):
        z = np.zeros
        _THREAD.scratch = Pointer(
            Scratch(
                new_packet(), new_block(), new_block(), new_block(), new_exits(), new_query(),
                z(LANES), z(LANES, np.int32), z(LANES), z(LANES), z(LANES), z((LANES, 3)),
            )
        )  # fmt: skip
    found: Pointer = _THREAD.scratch
    return found
