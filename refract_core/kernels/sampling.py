"""The one deterministic sequence behind every sample: a function of pixel, sample number and purpose, nothing else.

Samples of one pixel follow the R2 sequence (M. Roberts, "The unreasonable effectiveness of quasirandom sequences",
2018); pixels are decorrelated by a Cranley-Patterson rotation from an integer hash (PCG output permutation,
O'Neill 2014). No state: tiles, threads and order cannot change a picture.
"""

from __future__ import annotations

import numpy as np

from .compile import inlined

_A1 = 0.7548776662466927  # 1 / g, g = plastic number
_A2 = 0.5698402909980532  # 1 / g^2
_TO_UNIT = 1.0 / 4294967296.0


@inlined
def hash32(x, y, purpose):  # type: ignore[no-untyped-def]
    """Thirty-two well mixed bits of three integers."""
    state = np.uint32(np.uint32(x) * np.uint32(0x8DA6B343) + np.uint32(y) * np.uint32(0xD8163841))
    state = np.uint32(state + np.uint32(purpose) * np.uint32(0xCB1AB31F))
    state = np.uint32(state * np.uint32(747796405) + np.uint32(2891336453))
    word = np.uint32((state >> ((state >> np.uint32(28)) + np.uint32(4))) ^ state)
    word = np.uint32(word * np.uint32(277803737))
    return np.uint32((word >> np.uint32(22)) ^ word)


@inlined
def chance_of_bits(a: int, b: int, c: int) -> float:
    """A number in [0, 1) that depends on three integers alone, as on the bits of a ray."""
    return hash32(a, b, c) * _TO_UNIT


@inlined
def unit_pair(x, y, sample, purpose):  # type: ignore[no-untyped-def]
    """Point `sample` of the pixel's rotated R2 sequence in [0, 1)^2, for one purpose (a light, a lobe, ...)."""
    u = hash32(x, y, 2 * purpose) * _TO_UNIT + sample * _A1
    v = hash32(x, y, 2 * purpose + 1) * _TO_UNIT + sample * _A2
    return u - np.floor(u), v - np.floor(v)


def pixel_offset(sample: int) -> tuple[float, float]:
    """Where sample number `sample` falls in every pixel, relative to its centre, in [-0.5, 0.5)^2.

    Sample 0 is the centre, so that data AOVs, which keep sample 0, are exact at pixel centres.
    """
    return (0.5 + sample * _A1) % 1.0 - 0.5, (0.5 + sample * _A2) % 1.0 - 0.5
