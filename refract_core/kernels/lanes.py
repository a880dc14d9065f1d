"""Records of lanes: what eight rays carry side by side through a kernel, one row per lane.

A record is a NamedTuple whose fields are annotated with one of the column types below; `new_lanes` makes the arrays the
annotations promise, so that dtype and shape are written once, beside the field's meaning. The arrays are working memory
of one thread (`scratch`): a kernel finds nothing of use in them when it starts, and leaves nothing to be used when it
ends. What a kernel returns goes into the arrays of its caller.
"""

from __future__ import annotations

import threading
from typing import Annotated, Any, NamedTuple, TypeVar, get_type_hints

import numpy as np
from numpy.typing import NDArray

from .compile import inlined
from .pointer import Pointer
from .vec import Vec

LANES = 8
"""Rays of a packet, a block of 4x2 pixels. Eight is native from AVX2 on; sixteen only with AVX-512, and elsewhere
Embree takes such a packet apart ray by ray (docs/decisions/packets-of-eight.md)."""
BLOCK_WIDTH, BLOCK_HEIGHT = 4, 2


class Column(NamedTuple):
    """What one field of a record of lanes is made of."""

    dtype: type[np.generic]
    per_lane: tuple[int, ...] = ()

    @property
    def axes(self) -> int:
        """Number of axes of its array."""
        return 1 + len(self.per_lane)


Flags = Annotated[NDArray[np.int32], Column(np.int32)]
"""shape (8,) int32: 0 or 1, or a small code"""
Words = Annotated[NDArray[np.int32], Column(np.int32)]
"""shape (8,) int32: numbers of parts, things, ..."""
Scalars = Annotated[NDArray[np.float64], Column(np.float64)]
"""shape (8,) float64"""
Vectors = Annotated[NDArray[np.float64], Column(np.float64, (3,))]
"""shape (8, 3) float64"""

R = TypeVar("R")


def _columns(record: Any) -> list[Any]:
    hints = get_type_hints(record, include_extras=True)
    return [hints[name] for name in record._fields]


def new_lanes(record: type[R], count: int = LANES) -> R:
    """A record of lanes with all its arrays at zero; records inside it too. `count`: rows.

    A record that needs more than zeros (Embree's packet wants aligned memory) brings its own `fresh()`.
    """
    fresh = getattr(record, "fresh", None)
    if fresh is not None:
        made: R = fresh()
        return made
    fields: list[Any] = []
    for hint in _columns(record):
        columns = [extra for extra in getattr(hint, "__metadata__", ()) if isinstance(extra, Column)]
        if columns:
            fields.append(np.zeros((count, *columns[0].per_lane), columns[0].dtype))
        else:
            fields.append(new_lanes(hint, count))
    return record(*fields)


_THREAD = threading.local()


def by_address(record: R) -> R:
    """A record as a kernel takes it: a `Pointer` to it.

    It is typed as the record, because that is what the kernel reads: `def peel(view: View)` is called with
    `by_address(view)`, and a checker sees whether the record is the right one. Python itself reads the record it came
    from, not this.
    """
    pointer: Any = Pointer(record)
    typed: R = pointer
    return typed


def scratch(record: type[R]) -> R:
    """The calling thread's own record of this type, by address, made once per thread."""
    if not hasattr(_THREAD, "kept"):
        _THREAD.kept = {}
    if record not in _THREAD.kept:
        _THREAD.kept[record] = by_address(new_lanes(record))
    found: R = _THREAD.kept[record]
    return found


@inlined
def put(rows: NDArray[Any], lane: int, v: Vec) -> None:
    """Write a vector into a row of an (N, 3) array."""
    rows[lane, 0] = v[0]
    rows[lane, 1] = v[1]
    rows[lane, 2] = v[2]
