"""Records of arrays, handed to kernels by address.

numba passes a NamedTuple by value: every array of it becomes eight or nine arguments of every function it goes through.
A `World` of sixty arrays then costs minutes to compile and kilobytes of stack per call. A `Pointer` is one machine word
instead. Attributes read as they do on the record (`world.geometry.points`); nothing is counted, copied or owned: the
Python object keeps the arrays alive for as long as the kernel runs.

The memory behind it is a row of 64-bit words: address and shape of an array, the bits of a number, or, for a record
inside a record, its words in place.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import from_dtype, types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    NativeValue,
    infer_getattr,
    lower_getattr_generic,
    models,
    register_model,
    typeof_impl,
    unbox,
)
from numba.np.arrayobj import populate_array


class PointerType(types.Type):  # type: ignore[misc]
    """numba's view of a `Pointer`: the fields of the record in order, each with its type."""

    def __init__(self, record: str, fields: tuple[tuple[str, Any], ...]) -> None:
        self.record = record
        self.fields = fields
        inner = ", ".join(f"{name}: {field}" for name, field in fields)
        super().__init__(name=f"Pointer({record}: {inner})")

    def field(self, wanted: str) -> tuple[Any, int] | None:
        """Type of a field and the number of its first word."""
        offset = 0
        for name, field in self.fields:
            if name == wanted:
                return field, offset
            offset += _words(field)
        return None


def _words(field: Any) -> int:
    if isinstance(field, types.Array):
        return 1 + int(field.ndim)
    if isinstance(field, PointerType):
        return sum(_words(inner) for _, inner in field.fields)
    return 1


class Pointer:
    """A record (NamedTuple of C-contiguous arrays, numbers and such records) that kernels take by address."""

    __slots__ = ("_memory", "address", "record", "type")

    def __init__(self, record: Any) -> None:
        self.record = record
        words: list[int] = []
        self.type = _describe(record, words)
        self._memory = np.array(words, np.uint64)
        self.address = int(self._memory.ctypes.data)


def _describe(record: Any, words: list[int]) -> PointerType:
    """Append the record's words and give its type."""
    fields: list[tuple[str, Any]] = []
    for name, value in zip(record._fields, record, strict=True):
        if isinstance(value, np.ndarray):
            if not value.flags.c_contiguous:
                raise TypeError(f"{type(record).__name__}.{name} is not C-contiguous")
            words += [value.ctypes.data, *value.shape]
            fields.append((name, types.Array(from_dtype(value.dtype), value.ndim, "C")))
        elif isinstance(value, tuple):
            fields.append((name, _describe(value, words)))
        elif isinstance(value, float):
            words.append(int(np.float64(value).view(np.uint64)))
            fields.append((name, types.float64))
        else:
            words.append(int(np.int64(value).view(np.uint64)))
            fields.append((name, types.boolean if isinstance(value, bool) else types.int64))
    return PointerType(type(record).__name__, tuple(fields))


@typeof_impl.register(Pointer)
def _typeof(value: Pointer, _context: Any) -> PointerType:
    return value.type


register_model(PointerType)(models.OpaqueModel)


@unbox(PointerType)
def _unbox(_type: Any, value: Any, c: Any) -> NativeValue:
    number = c.pyapi.object_getattr_string(value, "address")
    address = c.pyapi.long_as_longlong(number)
    c.pyapi.decref(number)
    failed = cgutils.is_not_null(c.builder, c.pyapi.err_occurred())
    return NativeValue(c.builder.inttoptr(address, cgutils.voidptr_t), is_error=failed)


@infer_getattr
class _Fields(AttributeTemplate):  # type: ignore[misc]
    key = PointerType

    def generic_resolve(self, kind: PointerType, name: str) -> Any:
        found = kind.field(name)
        return found[0] if found else None


@lower_getattr_generic(PointerType)
def _load_field(context: Any, builder: Any, kind: PointerType, value: Any, name: str) -> Any:
    found = kind.field(name)
    assert found is not None
    field, offset = found
    word = ir.IntType(64)
    base = builder.bitcast(value, word.as_pointer())

    def load(k: int) -> Any:
        loaded = builder.load(builder.gep(base, [ir.Constant(word, offset + k)]))
        loaded.set_metadata("invariant.load", builder.module.add_metadata([]))
        return loaded

    if isinstance(field, PointerType):
        return builder.bitcast(builder.gep(base, [ir.Constant(word, offset)]), cgutils.voidptr_t)
    if isinstance(field, types.Array):
        array = context.make_array(field)(context, builder)
        shape = [load(1 + axis) for axis in range(field.ndim)]
        itemsize = context.get_constant(types.intp, int(np.dtype(str(field.dtype)).itemsize))
        strides = [itemsize]
        for extent in reversed(shape[1:]):
            strides.insert(0, builder.mul(strides[0], extent))
        data = builder.inttoptr(load(0), array.data.type)
        populate_array(array, data=data, shape=shape, strides=strides, itemsize=itemsize, meminfo=None)
        return array._getvalue()
    if field is types.float64 or field == types.float64:
        return builder.bitcast(load(0), ir.DoubleType())
    if field == types.boolean:
        return builder.icmp_unsigned("!=", load(0), ir.Constant(word, 0))
    return load(0)
