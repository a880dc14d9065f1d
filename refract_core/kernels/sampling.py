"""The one deterministic sequence behind every sample: a function of pixel, branch, sample number and purpose.

Samples of one pixel follow the (0,2)-sequence of van der Corput and Sobol, its digits scrambled for each pixel (Kollig
and Keller, "Efficient multidimensional sampling", Computer Graphics Forum 21(3), 2002) by an integer hash (PCG output
permutation, O'Neill 2014). No state: tiles, threads and order cannot change a picture.

Every decision has a dimension of its own: its `Purpose` within its branch. A branch is a ray that follows from another
(what a mirror shows, what a ray tier meets), numbered by the way to it, so that the shadow of a light there has nothing
to do with the shadow of the same light here.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from .compile import inlined
from .lanes import Words

_TO_UNIT = 1.0 / 4294967296.0


class Purpose(IntEnum):
    """What a sample decides. Each is a dimension of a branch."""

    SKY_COSINE = 1
    """a candidate of the sky, by its cosine"""
    MIRROR = 2
    """the microfacet that a mirror ray is reflected by"""
    ROUGH_LEAF = 3
    """the ray of a rough lobe that a tier traces"""
    SKY_PICK = 5
    """which of the sky's candidates"""
    SKY_RADIANCE = 6
    """a candidate of the sky, by its radiance"""
    SHADOW_LENGTH = 7
    """how far a light's shadow reaches"""
    LIGHT_PICK = 8
    """which of a light's points"""
    LIGHT = 16
    """a point of light 0; those of the other lights follow"""


_PURPOSES = 1 << 12
"""Dimensions of a branch; lights beyond so many share theirs with another branch."""

# How a branch goes on from the one before it: the next digit, to the base 4, of its number. What an opaque surface
# mirrors, what goes through an interface of glass, and what glances off it.
MIRRORED, THROUGH, GLANCED = 1, 2, 3


class Key(NamedTuple):
    """What a sequence hangs on."""

    x: int
    y: int
    """pixel, or texel of a probe's picture"""
    branch: int
    """0 for what the pixel's own ray meets; see `branched`"""
    sample: int
    """which of the pixel's samples"""


class Keys(NamedTuple):
    """The keys of eight rays."""

    x: Words
    y: Words
    branch: Words
    sample: Words


@inlined
def set_key(keys: Keys, lane: int, key: Key) -> None:
    """Note the key of a lane."""
    keys.x[lane], keys.y[lane] = key.x, key.y
    keys.branch[lane], keys.sample[lane] = key.branch, key.sample


@inlined
def key_of(keys: Keys, lane: int) -> Key:
    """The key of a lane."""
    return Key(keys.x[lane], keys.y[lane], keys.branch[lane], keys.sample[lane])


@inlined
def branched(key: Key, step: int) -> Key:
    """The key of a ray that follows from one with `key`, by a step of the three."""
    return Key(key.x, key.y, 4 * key.branch + step, key.sample)


@inlined
def hash32(x: int, y: int, z: int) -> np.uint32:
    """Thirty-two well mixed bits of three integers; of each the lowest 32 count."""
    # Three odd factors spread the inputs over the word; one step of PCG's generator and its output permutation then
    # mix high bits into low ones, which a product alone never does.
    state = np.uint32(np.uint32(x) * np.uint32(0x8DA6B343) + np.uint32(y) * np.uint32(0xD8163841))
    state = np.uint32(state + np.uint32(z) * np.uint32(0xCB1AB31F))
    state = np.uint32(state * np.uint32(747796405) + np.uint32(2891336453))
    word = np.uint32((state >> ((state >> np.uint32(28)) + np.uint32(4))) ^ state)
    word = np.uint32(word * np.uint32(277803737))
    return np.uint32((word >> np.uint32(22)) ^ word)


@inlined
def chance_of_bits(a: int, b: int, c: int) -> float:
    """A number in [0, 1) that depends on three integers alone, as on the bits of a ray."""
    return hash32(a, b, c) * _TO_UNIT


@inlined
def unit_pair(key: Key, purpose: int) -> tuple[float, float]:
    """The point of the key's sample in its own (0,2)-sequence in [0, 1)^2, for one `Purpose`.

    Every run of 2^m samples that starts at a multiple of 2^m has one point in each box of area 2^-m of a dyadic grid,
    whatever the box's shape. Each dimension is scrambled on its own: without that a pixel's light and its lobe would be
    drawn at the same place of their squares, sample by sample, and their product would not average out.
    """
    dimension = _PURPOSES * key.branch + purpose
    u, v = hash32(key.x, key.y, 2 * dimension), hash32(key.x, key.y, 2 * dimension + 1)
    i = np.uint32(key.sample)
    mirrored, bent = np.uint32(1 << 31), np.uint32(1 << 31)
    while i != np.uint32(0):
        if i & np.uint32(1):
            u ^= mirrored
            v ^= bent
        i >>= np.uint32(1)
        mirrored >>= np.uint32(1)
        bent ^= bent >> np.uint32(1)
    return u * _TO_UNIT, v * _TO_UNIT


def pixel_offsets(samples: int) -> list[tuple[float, float]]:
    """Where the samples fall in every pixel, relative to its centre, in (-0.5, 0.5)^2; the nearest to it comes first.

    A Hammersley set whose second coordinate is ranked, so that any number of samples is a Latin square, balanced about
    the centre: one sample stands there, four have a quarter each, and the picture never leans to a side.
    """
    order = np.argsort([radical_inverse(i, 2) for i in range(samples)]).argsort()
    points = [((i + 0.5) / samples - 0.5, (int(order[i]) + 0.5) / samples - 0.5) for i in range(samples)]
    return sorted(points, key=lambda p: (p[0] * p[0] + p[1] * p[1], p))


def radical_inverse(i: int, base: int) -> float:
    """Digits of `i` to a base, mirrored at the point (van der Corput 1935; Halton 1960)."""
    value, digit = 0.0, 1.0 / base
    while i:
        value += digit * (i % base)
        i //= base
        digit /= base
    return value
