"""Cryptomatte 1.2: whose each part of a pixel is, by hashes of names (Friedman and Jones, "Fully automatic ID mattes
with support for motion blur and transparency", SIGGRAPH 2015 talks; Psyop's Cryptomatte specification 1.2.0)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field

from ..scene import F32

LEVELS = 3
"""Layers of four channels in a file, each of two ranks."""
RANKS = 2 * LEVELS


@dataclass(frozen=True)
class Matte:
    """The mattes of one kind of thing."""

    name: str
    """what its layers are called, without their number: `CryptoObject`"""
    ranks: F32
    """shape (H, W, 2 RANKS): id and coverage 0 .. 1 by turns, the largest coverage first; 0, 0 where there is no more.
    An id is the bits of a hash, read as a float"""
    manifest: Mapping[str, int] = field(default_factory=dict)
    """name -> bits of its id, of all that is in the picture"""

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels in a file, in the order of the last axis of `ranks`."""
        return tuple(f"{self.name}{level:02}.{letter}" for level in range(LEVELS) for letter in "RGBA")

    @property
    def attributes(self) -> dict[str, str]:
        """What the head of a file says of it."""
        place = f"cryptomatte/{_hex(hash_of(self.name))[:7]}"
        known = {name: _hex(bits) for name, bits in sorted(self.manifest.items())}
        return {
            f"{place}/name": self.name,
            f"{place}/hash": "MurmurHash3_32",
            f"{place}/conversion": "uint32_to_float32",
            f"{place}/manifest": json.dumps(known, separators=(",", ":"), ensure_ascii=False),
        }


def hash_of(name: str) -> int:
    """Bits of the id of a name: its hash, but for exponents that no number has (0 and 255 are zero, denormal, infinite
    or NaN), which programs would not carry unchanged."""
    bits = murmur3_32(name.encode())
    return bits ^ (1 << 23) if (bits >> 23) & 255 in (0, 255) else bits


def murmur3_32(data: bytes, seed: int = 0) -> int:
    """MurmurHash3_x86_32 (Appleby 2011)."""
    mask = 0xFFFFFFFF
    whole = len(data) // 4 * 4
    h = seed
    for start in range(0, whole, 4):
        h = _turned(h ^ _mixed(int.from_bytes(data[start : start + 4], "little")), 13)
        h = (h * 5 + 0xE6546B64) & mask
    if whole < len(data):
        h ^= _mixed(int.from_bytes(data[whole:], "little"))
    h ^= len(data)
    h = ((h ^ (h >> 16)) * 0x85EBCA6B) & mask
    h = ((h ^ (h >> 13)) * 0xC2B2AE35) & mask
    return h ^ (h >> 16)


def _mixed(k: int) -> int:
    return (_turned((k * 0xCC9E2D51) & 0xFFFFFFFF, 15) * 0x1B873593) & 0xFFFFFFFF


def _turned(x: int, by: int) -> int:
    return ((x << by) | (x >> (32 - by))) & 0xFFFFFFFF


def _hex(bits: int) -> str:
    return f"{bits:08x}"
