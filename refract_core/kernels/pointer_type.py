"""How numba sees a `Pointer`: one word, whose attributes are loads from the memory behind it."""

from __future__ import annotations

from functools import cache
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

from .pointer import BOOL, FLOAT, INT, Array, Kind, Layout, Pointer, Row, words_of

_NUMBERS = {INT: types.int64, FLOAT: types.float64, BOOL: types.boolean}


class PointerType(types.Type):  # type: ignore[misc]
    """The fields of the record in order, each with its type."""

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        inner = ", ".join(f"{name}: {type_of(kind)}" for name, kind in layout.fields)
        super().__init__(name=f"Pointer({layout.record}: {inner})")

    def field(self, wanted: str) -> tuple[Any, int] | None:
        """Type of a field and the number of its first word."""
        offset = 0
        for name, kind in self.layout.fields:
            if name == wanted:
                return type_of(kind), offset
            offset += words_of(kind)
        return None


@cache
def type_of(kind: Kind) -> Any:
    """numba's type of a field or of a whole record."""
    if isinstance(kind, Array):
        return types.Array(from_dtype(np.dtype(kind.dtype)), kind.ndim, "C")
    if isinstance(kind, Layout):
        return PointerType(kind)
    if isinstance(kind, Row):
        return types.BaseTuple.from_types(tuple(type_of(inner) for inner in kind.kinds))
    return _NUMBERS[kind]


@typeof_impl.register(Pointer)
def _typeof(value: Pointer, _context: Any) -> Any:
    return type_of(value.layout)


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
    if field == types.float64:
        return builder.bitcast(load(0), ir.DoubleType())
    if field == types.boolean:
        return builder.icmp_unsigned("!=", load(0), ir.Constant(word, 0))
    return load(0)
