"""What pictures need before their first ray, kept from one to the next: `Session`.

A part is kept beside a copy of all it was made from, and used again where that is equal, byte for byte. So nothing is
ever stale, whatever was done to an array in between; and comparing is eight times as fast as a digest that could be
trusted (docs/decisions/one-of-each-kind.md).
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Hashable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import fields, is_dataclass
from itertools import count
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import Cancelled
from .work import Cancel

P = TypeVar("P")

_CHUNK = 1 << 17
"""Words that are compared at once: they stay in the cache, and what differs early is known early."""
_WAIT = 0.2  # [s] between two questions whether to go on waiting


class Part(NamedTuple, Generic[P]):
    """Something that was made, and what it was made from."""

    number: int
    """Never given twice in a session: what is made from a part names it by this."""
    made: P
    source: Any
    """its own copy"""


class Session:
    """Parts of pictures, for the next one: tables and hierarchy of the geometry, textures, sky, pictures of probes.

        session = rc.Session()
        for scene in scenes:
            rc.render(scene, settings, session=session)

    Pictures are the same with and without it, bit by bit. A part is made anew where anything it is made from differs,
    be it another record or other numbers in the same array; arrays are compared whole, so scenes may be changed in
    place between two pictures, though not while one is drawn.

    Of each kind it keeps one part, that of the last picture that needed any, beside a copy of the arrays it was made
    from. What it drops is freed when the last picture that uses it is done. Threads may share a session: they make
    parts one after the other, and draw side by side.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._numbers = count()
        self._kept: dict[str, dict[Hashable, Part[Any]]] = {}

    def clear(self) -> None:
        """Keep nothing of what there is."""
        with self._lock:
            self._kept.clear()

    @contextmanager
    def held(self, cancel: Cancel) -> Iterator[None]:
        """Be the one that makes parts. Raises Cancelled where `cancel` says so while another one is at it."""
        while not self._lock.acquire(timeout=_WAIT):
            if cancel():
                raise Cancelled("cancelled; nothing was written")
        try:
            yield
        finally:
            self._lock.release()

    def part(self, kind: str, source: Any, make: Callable[[], P]) -> Part[P]:
        """The one part of a kind: as it is, where it was made from the same, else made and kept.

        Args:
            source: all that `make` reads: records, tuples, dictionaries, arrays, texts and numbers.
        """
        return self.parts(kind, {kind: (source, make)})[0]

    def parts(self, kind: str, wanted: Mapping[Hashable, tuple[Any, Callable[[], P]]]) -> list[Part[P]]:
        """Parts of a kind, as `part`; others of that kind are dropped, unless none is wanted.

        Args:
            wanted: by name, under which one is looked for: what it is made from, and what makes it.

        Returns:
            In the order of `wanted`.
        """
        if not wanted:
            return []
        known = self._kept.pop(kind, {})
        found = {name: part for name, part in known.items() if name in wanted and same(part.source, wanted[name][0])}
        self._kept[kind] = found
        del known  # what is dropped is gone before something takes its place
        for name, (source, make) in wanted.items():
            if name not in found:
                found[name] = Part(next(self._numbers), make(), deepcopy(source))
        return [found[name] for name in wanted]


def same(a: Any, b: Any) -> bool:
    """Equal to the last bit: NaN is itself, and -0.0 is not 0.0. Records and containers by what is in them."""
    if a is b:  # of the two, one is nobody's but the session's
        return True
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and not a.dtype.hasobject and _same_bytes(a, b)
    if isinstance(a, np.generic):
        return a.tobytes() == b.tobytes()
    if is_dataclass(a):
        return all(same(getattr(a, field.name), getattr(b, field.name)) for field in fields(a))
    if isinstance(a, tuple | list):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(value, b[name]) for name, value in a.items())
    if isinstance(a, float):
        return struct.pack("<d", a) == struct.pack("<d", b)
    return bool(a == b)


def _same_bytes(a: NDArray[Any], b: NDArray[Any]) -> bool:
    """Two arrays of the same type and shape."""
    left, right = (np.ascontiguousarray(each).reshape(-1).view(np.uint8) for each in (a, b))
    whole = len(left) // 8 * 8
    if (left[whole:] != right[whole:]).any():
        return False
    left, right = left[:whole].view(np.uint64), right[:whole].view(np.uint64)
    steps = range(0, len(left), _CHUNK)
    return all(bool((left[at : at + _CHUNK] == right[at : at + _CHUNK]).all()) for at in steps)
