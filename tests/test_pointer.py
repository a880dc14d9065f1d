"""Records by address: what a kernel reads is what was put in, and what cannot be put in is refused."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import pytest

from refract_core.kernels.compile import inlined, kernel
from refract_core.kernels.pointer import Pointer

DTYPES = ("f4", "f8", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "?")


class Numbers(NamedTuple):
    """Every kind of number, with an array in between that takes more than one word."""

    whole: int
    real: float
    table: Any
    flag: bool
    last: int


class Shapes(NamedTuple):
    """One array of each number of axes."""

    line: Any
    plane: Any
    block: Any
    four: Any


class Inner(NamedTuple):
    """A record in a record."""

    before: Any
    number: float


class Outer(NamedTuple):
    """Records in a record, with something before, between and behind."""

    first: int
    inner: Inner
    middle: Any
    again: Inner
    deep: Numbers
    last: float


class One(NamedTuple):
    """A single field of any kind."""

    field: Any


@kernel
def numbers(record, out):  # type: ignore[no-untyped-def]
    out[0], out[1], out[2] = record.whole, record.last, 1 if record.flag else 0
    return record.real


@kernel
def copied(record, line, plane, block, four):  # type: ignore[no-untyped-def]
    for i in range(record.line.shape[0]):
        line[i] = record.line[i]
    for i in range(record.plane.shape[0]):
        for j in range(record.plane.shape[1]):
            plane[i, j] = record.plane[i, j]
    for i in range(record.block.shape[0]):
        for j in range(record.block.shape[1]):
            for k in range(record.block.shape[2]):
                block[i, j, k] = record.block[i, j, k]
    for i in range(record.four.shape[0]):
        for j in range(record.four.shape[1]):
            for k in range(record.four.shape[2]):
                for m in range(record.four.shape[3]):
                    four[i, j, k, m] = record.four[i, j, k, m]


@inlined
def summed(record):  # type: ignore[no-untyped-def]
    total = record.number
    for i in range(len(record.before)):
        total += record.before[i]
    return total


@kernel
def nested(record, out):  # type: ignore[no-untyped-def]
    out[0], out[1] = summed(record.inner), summed(record.again)
    out[2], out[3] = record.first, record.last
    out[4], out[5] = record.deep.real, record.deep.last
    out[6], out[7] = record.middle[1, 2], record.deep.table[1]


@kernel
def doubled(record):  # type: ignore[no-untyped-def]
    for i in range(record.field.size):
        record.field.ravel()[i] *= 2


@pytest.mark.parametrize("whole", [0, 1, -1, 2**63 - 1, -(2**63)])
@pytest.mark.parametrize("real", [0.0, -0.0, 1.5, -math.pi, 5e-324, math.inf, math.nan])
def test_numbers_arrive_bit_by_bit(whole: int, real: float) -> None:
    for flag in (True, False):
        out = np.zeros(3, np.int64)
        found = numbers(Pointer(Numbers(whole, real, np.zeros(2), flag, -7)), out)
        assert out.tolist() == [whole, -7, int(flag)]
        assert np.float64(found).tobytes() == np.float64(real).tobytes()


def test_numpy_numbers_are_numbers() -> None:
    out = np.zeros(3, np.int64)
    record = Numbers(np.int32(-3), np.float32(0.5), np.zeros(2), np.bool_(True), np.uint8(200))  # type: ignore[arg-type]
    assert numbers(Pointer(record), out) == 0.5
    assert out.tolist() == [-3, 200, 1]


@pytest.mark.parametrize("dtype", DTYPES)
def test_arrays_of_every_shape_and_type_arrive(dtype: str) -> None:
    rng = np.random.default_rng(1)
    shapes = ((3,), (2, 5), (4, 1, 3), (2, 3, 1, 2))
    sources = [(rng.integers(0, 2 if dtype == "?" else 100, shape)).astype(dtype) for shape in shapes]
    targets = [np.zeros_like(a) for a in sources]
    copied(Pointer(Shapes(*sources)), *targets)
    for source, target in zip(sources, targets, strict=True):
        assert (source == target).all()
        assert source.any()


def test_empty_arrays_arrive() -> None:
    empty = [np.zeros(shape, np.float32) for shape in ((0,), (0, 3), (2, 0, 3), (1, 2, 3, 0))]
    copied(Pointer(Shapes(*empty)), *empty)


def test_records_lie_in_place() -> None:
    inner, again = Inner(np.array([1.0, 2.0]), 10.0), Inner(np.array([5.0]), 20.0)
    deep = Numbers(1, 0.25, np.array([3.0, 4.0]), True, 99)
    record = Outer(7, inner, np.arange(6.0).reshape(2, 3), again, deep, 0.125)
    out = np.zeros(8)
    nested(Pointer(record), out)
    assert out.tolist() == [13.0, 25.0, 7.0, 0.125, 0.25, 99.0, 5.0, 4.0]


def test_a_kernel_writes_into_the_arrays_themselves() -> None:
    array = np.arange(6, dtype=np.float32).reshape(2, 3)
    doubled(Pointer(One(array)))
    assert (array == 2 * np.arange(6).reshape(2, 3)).all()


def test_two_layouts_of_one_record_do_not_mix() -> None:
    """The same class with fields of other types is another type to kernels."""
    for dtype in ("f4", "i8", "f4"):
        array = np.arange(4).astype(dtype)
        doubled(Pointer(One(array)))
        assert array.tolist() == [0, 2, 4, 6]


@pytest.mark.parametrize(
    ("field", "word"),
    [
        (np.zeros((4, 4))[:, ::2], "field is not C-contiguous"),
        (np.zeros((2, 3)).T, "field is not C-contiguous"),
        (np.zeros(4)[::-1], "field is not C-contiguous"),
        ("text", "field is a str"),
        (None, "field is a NoneType"),
        ([1.0], "field is a list"),
        ((1.0, 2.0), "field is a tuple"),
        (1j, "field is a complex"),
        (2**64, "field is too large"),
    ],
)
def test_what_has_no_place_is_refused(field: Any, word: str) -> None:
    with pytest.raises(TypeError, match=rf"^One\.{word}"):
        Pointer(One(field))


def test_the_record_stays_alive_with_its_pointer() -> None:
    pointer = Pointer(One(np.arange(3.0)))
    doubled(pointer)
    assert pointer.record.field.tolist() == [0.0, 2.0, 4.0]
