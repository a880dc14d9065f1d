"""The engine's deterministic sequence, written again: which number belongs to which pixel, sample and purpose.

All that depends on it is which of several equally right samples is taken; so this is the one place to change when the
engine deals its dimensions anew.
"""

from __future__ import annotations

import math
import struct

Key = tuple[int, int, int]
"""What a sequence hangs on: a pixel, and the branch, the way to the ray as digits to the base 4."""

SKY_COSINE, MIRROR, ROUGH_LEAF, SKY_PICK, SKY_RADIANCE, SHADOW_LENGTH, LIGHT_PICK, FIRST_LIGHT = 1, 2, 3, 5, 6, 7, 8, 16

_WORD = 0xFFFFFFFF


MIRRORED, THROUGH, GLANCED = 1, 2, 3
"""How a branch goes on: off an opaque surface, through glass, back from glass."""


def branched(branch: int, step: int) -> int:
    return 4 * branch + step


def mirror_key(key: Key) -> Key:
    return key[0], key[1], branched(key[2], MIRRORED)


def hashed(x: int, y: int, z: int) -> int:
    """Thirty-two bits of three integers: a linear mix, then PCG's RXS-M-XS output (O'Neill 2014)."""
    state = (x * 0x8DA6B343 + y * 0xD8163841 + z * 0xCB1AB31F) & _WORD
    state = (state * 747796405 + 2891336453) & _WORD
    word = ((state >> ((state >> 28) + 4)) ^ state) * 277803737 & _WORD
    return (word >> 22) ^ word


def pair(key: Key, sample: int, purpose: int) -> tuple[float, float]:
    """Point `sample` of a key's scrambled (0,2)-sequence: digit k of the sample, times column k of the generator
    matrices. The first is the identity, mirrored; the second is Pascal's triangle modulo 2 (Sobol 1967)."""
    x, y, branch = key
    dimension = 4096 * branch + purpose
    u, v = hashed(x, y, 2 * dimension), hashed(x, y, 2 * dimension + 1)
    for k in range(sample.bit_length()):
        if sample >> k & 1:
            u ^= 1 << (31 - k)
            v ^= sum((math.comb(k, r) & 1) << (31 - r) for r in range(k + 1))
    return u / 2**32, v / 2**32


def jitters(samples: int) -> list[tuple[float, float]]:
    """Offsets of all samples in their pixel, the one nearest to its centre first: x evenly, y in the order of van der
    Corput's numbers, as evenly."""
    mirrored = [int(bin(i)[:1:-1], 2) / 2.0 ** (len(bin(i)) - 2) for i in range(samples)]
    ranks = {value: k for k, value in enumerate(sorted(mirrored))}
    points = [((i + 0.5) / samples - 0.5, (ranks[mirrored[i]] + 0.5) / samples - 0.5) for i in range(samples)]
    return sorted(points, key=lambda p: (p[0] ** 2 + p[1] ** 2, p))


def float_bits(x: float) -> int:
    """The word of a number as float32."""
    bits: int = struct.unpack("<I", struct.pack("<f", x))[0]
    return bits
