"""What a kernel was compiled from, as a number: two kernels with one key are the same machine code.

In it go the code of the function and of every function it calls, the constants they use, the code that lays out and
reads records, the options of the compiler, and the versions of Python, numba and LLVM. numba itself adds what it is
compiled for: the types of the arguments (a record's fields among them) and the processor. Text that means nothing
(comments, docstrings, line numbers) is not in it.
"""

from __future__ import annotations

import hashlib
import importlib.util
import sys
from collections.abc import Iterator, Sequence
from enum import Enum, EnumMeta
from functools import cache
from importlib import metadata
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

_FOREIGN = ("builtins", "cmath", "math", "numba", "numpy", "operator")
"""Libraries that numba has its own versions of; its version stands for theirs."""
_MACHINERY = ("pointer", "pointer_type", "jit", "linking")
"""The rooms beside this one whose code decides what is compiled."""


def key_of(function: Any) -> str:
    """The key of a kernel, 16 hexadecimal digits. `function`: decorated with `kernel` or not."""
    found: dict[FunctionType, str] = {}
    waiting = [_plain(function)]
    while waiting:
        one = waiting.pop()
        if one not in found:
            text, callees = _described(one)
            found[one] = hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()
            waiting += callees
    first = found[_plain(function)]
    return hashlib.sha256("\n".join([_machinery(), first, *sorted(found.values())]).encode()).hexdigest()[:16]


def _plain(function: Any) -> FunctionType:
    """The Python function behind a decorated one."""
    plain: FunctionType = getattr(function, "py_func", function)
    return plain


@cache
def _machinery() -> str:
    parts = [str(sys.version_info[:3]), metadata.version("numba"), metadata.version("llvmlite")]
    for room in _MACHINERY:
        name = f"{__package__}.{room}"
        spec = importlib.util.find_spec(name)
        assert spec is not None
        assert spec.loader is not None
        code = spec.loader.get_code(name)  # type: ignore[attr-defined]
        parts.append(_code_text(code, True))
    return hashlib.sha256("\n".join(parts).encode("utf-8", "surrogatepass")).hexdigest()


@cache
def _described(function: FunctionType) -> tuple[str, tuple[FunctionType, ...]]:
    """A function's own code and constants as a text, and the compiled functions that it calls."""
    code, callees = function.__code__, []
    names = sorted(set(_names(code)))
    used = {name: function.__globals__[name] for name in names if name in function.__globals__}
    cells = function.__closure__ or ()
    used |= {name: cell.cell_contents for name, cell in zip(code.co_freevars, cells, strict=True)}
    parts = [function.__module__, function.__qualname__, _code_text(code, function.__doc__ is not None)]
    for name, value in [*used.items(), ("=", function.__defaults__), ("*=", function.__kwdefaults__)]:
        text, called = _value(value, names)
        parts.append(f"{name} {text}")
        callees += called
    return "\n".join(parts), tuple(callees)


def _names(code: CodeType) -> Iterator[str]:
    """Names that code looks up: globals, and attributes, which cannot be told from them and do no harm."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _code_text(code: CodeType, has_doc: bool) -> str:
    """Instructions, names and constants, without the docstring, which is the first constant where there is one."""
    constants = list(code.co_consts)
    if has_doc and constants and isinstance(constants[0], str):
        constants[0] = None
    texts = [_code_text(c, True) if isinstance(c, CodeType) else _constant_text(c) for c in constants]
    numbers = (code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags)
    return f"{numbers} {code.co_code.hex()} {code.co_names} {code.co_varnames} {code.co_freevars} {texts}"


def _constant_text(constant: Any) -> str:
    """As `repr`, but a set's members have no order."""
    return f"{sorted(map(repr, constant))}" if isinstance(constant, frozenset) else repr(constant)


def _value(value: Any, names: Sequence[str]) -> tuple[str, list[FunctionType]]:
    """A constant as a text, and the compiled functions it holds. `names`: what may be looked up in a module."""
    if isinstance(getattr(value, "py_func", None), FunctionType):
        place = f"{value.py_func.__module__}.{value.py_func.__qualname__}"
        return f"compiled {place} {getattr(value, 'merged', '')}", [value.py_func]
    if isinstance(value, Enum):
        return f"{type(value).__qualname__}.{value.name}={value.value!r}", []
    if isinstance(value, EnumMeta):
        return repr([(member.name, member.value) for member in value]), []  # type: ignore[var-annotated]
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}", []
    if isinstance(value, tuple | list):
        held = [_value(item, names) for item in value]
        return f"{type(value).__qualname__}({', '.join(t for t, _ in held)})", [f for _, called in held for f in called]
    if isinstance(value, dict):
        return _value([*value.items()], names)
    if isinstance(value, ModuleType):
        if value.__name__.partition(".")[0] in _FOREIGN:
            return value.__name__, []
        inside = {name: vars(value)[name] for name in names if name in vars(value)}
        return _value([*inside.items()], names)
    if isinstance(value, type):
        fields = getattr(value, "_fields", ())
        return f"{value.__module__}.{value.__qualname__} {fields}", []
    if isinstance(value, bool | int | float | complex | str | bytes | frozenset | np.generic | np.dtype | None):
        return f"{type(value).__name__} {_constant_text(value)}", []
    # Nothing else can be a constant of compiled code, but what says itself how it is to be told apart.
    return f"{type(value).__qualname__} {getattr(value, 'key', '')}", []
