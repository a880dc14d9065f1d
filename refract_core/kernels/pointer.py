"""Records of arrays, handed to kernels by address.

numba passes a NamedTuple by value: every array of it becomes eight or nine arguments of every function it goes through.
A `World` of sixty arrays then costs minutes to compile and kilobytes of stack per call. A `Pointer` is one machine word
instead. Attributes read as they do on the record (`world.geometry.points`); nothing is counted, copied or owned: the
Python object keeps the arrays alive for as long as the kernel runs.

The memory behind it is a row of 64-bit words: address and shape of an array, the bits of a number, or, for a record
inside a record, its words in place. `pointer_type` reads them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

INT, FLOAT, BOOL = "int", "float", "bool"


class Array(NamedTuple):
    """A C-contiguous array as a field or an argument."""

    dtype: str
    """as numpy writes it, such as '<f4'"""
    ndim: int


class Layout(NamedTuple):
    """The words of a record."""

    record: str
    """name of its class"""
    fields: tuple[tuple[str, Kind], ...]
    """each with its name, in order"""


class Row(NamedTuple):
    """A tuple of numbers, which only arguments and results are."""

    kinds: tuple[Kind, ...]


Kind = str | Array | Layout | Row
"""What a field is: INT, FLOAT, BOOL, an array, or a record in place."""


class Pointer:
    """A record (NamedTuple of C-contiguous arrays, numbers and such records) that kernels take by address.

    Raises:
        TypeError: a field is none of these.
    """

    __slots__ = ("_memory", "address", "layout", "record")

    def __init__(self, record: Any) -> None:
        self.record = record
        words: list[int] = []
        self.layout = _describe(record, words)
        self._memory = np.array(words, np.uint64)
        self.address = int(self._memory.ctypes.data)


def _describe(record: Any, words: list[int]) -> Layout:
    """Append the record's words and give its layout."""
    fields: list[tuple[str, Kind]] = []
    for name, value in zip(record._fields, record, strict=True):
        kind: Kind
        if isinstance(value, np.ndarray):
            if not value.flags.c_contiguous:
                raise TypeError(f"{type(record).__name__}.{name} is not C-contiguous")
            words += [value.ctypes.data, *value.shape]
            kind = Array(value.dtype.str, value.ndim)
        elif isinstance(value, tuple) and hasattr(value, "_fields"):
            kind = _describe(value, words)
        elif isinstance(value, bool | np.bool_):
            words.append(int(value))
            kind = BOOL
        elif isinstance(value, int | np.integer):
            if not -(1 << 63) <= value < 1 << 63:
                raise TypeError(f"{type(record).__name__}.{name} is too large for 64 bits")
            words.append(int(value) & 0xFFFFFFFFFFFFFFFF)
            kind = INT
        elif isinstance(value, float | np.floating):
            words.append(int(np.float64(value).view(np.uint64)))
            kind = FLOAT
        else:
            raise TypeError(f"{type(record).__name__}.{name} is a {type(value).__name__}, not an array or a number")
        fields.append((name, kind))
    return Layout(type(record).__name__, tuple(fields))


def words_of(kind: Kind) -> int:
    """How many words a field takes."""
    if isinstance(kind, Array):
        return 1 + kind.ndim
    if isinstance(kind, Layout):
        return sum(words_of(inner) for _, inner in kind.fields)
    return 1
