"""Kernels compiled by numba in the running process, and kept on disk under the key of what they were compiled from.

numba's own cache looks at the file a function stands in, not at what it calls, and its folder is a setting of the whole
process. Here every kernel has its own cache with its own place; a host's kernels keep theirs.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cache
from typing import Any

import llvmlite.binding as llvm
import numba
from numba import types
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.extending import typeof_impl

from . import linking, pointer_type, store
from .external import External, tell

__all__ = ["NONE", "ahead", "called_from_python", "inlined", "kernel", "pointer_type", "type_of"]

OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    # Products and sums may fuse (FMA); NaN, infinity and the order of operations keep their meaning.
    "fastmath": {"contract", "nsz"},
}
_ONE_AT_A_TIME = threading.RLock()
NONE = types.none
"""The type of no result."""


class _Place:
    """Where numba's cache keeps one kernel (what numba calls a locator)."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._py_file = function.__code__.co_filename  # asked for by numba's warnings
        self._stem = store.stem(function)

    def ensure_cache_path(self) -> None:
        store.folder().mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        return str(store.folder())

    def get_source_stamp(self) -> str:
        return self._stem

    def get_disambiguator(self) -> str:
        return ""


class _Kept(CompileResultCacheImpl):  # type: ignore[misc]
    """numba's writing and reading of compiled code, with a place of our own."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._lineno = function.__code__.co_firstlineno
        self._locator = _Place(function)
        self._filename_base = store.stem(function)


class _Cache(FunctionCache):  # type: ignore[misc]
    _impl_class = _Kept

    def _index_key(self, signature: Any, codegen: Any) -> Any:
        """Within one kernel's file: the arguments and the processor. The code is in the file's name."""
        return signature, codegen.magic_tuple()

    def save_overload(self, signature: Any, data: Any) -> None:
        if store.Keeping.allowed:
            super().save_overload(signature, data)


def kernel(function: Callable[..., Any]) -> Any:
    """numba's form of a kernel, which Python may call, and which is kept on disk."""
    with _ONE_AT_A_TIME:
        made = numba.njit(**OPTIONS, **linking.KERNEL)(function)
        made._cache = _Cache(function)
        return made


@cache
def _inlined(function: Callable[..., Any], merged: bool) -> Any:
    return numba.njit(_nrt=False, forceinline=merged, no_cfunc_wrapper=True, **OPTIONS, **linking.TEXT)(function)


def inlined(function: Callable[..., Any], merged: bool) -> Any:
    """numba's form of a function that kernels call; the same one for all of them."""
    with _ONE_AT_A_TIME:
        return _inlined(function, merged)


def ahead(function: Callable[..., Any]) -> Any:
    """A kernel to be compiled for other machines: no entry for Python, nothing allocated."""
    return numba.njit(_nrt=False, no_cfunc_wrapper=True, **OPTIONS, **linking.AHEAD)(function)


def called_from_python(function: Callable[..., Any]) -> Any:
    """A function of kernels on its own, for Python; it is not kept."""
    with _ONE_AT_A_TIME:
        return numba.njit(_nrt=False, **OPTIONS, **linking.KERNEL)(function)


def type_of(made: Any) -> Any:
    """The type of a compiled function as a constant of another one."""
    return types.Dispatcher(made)


@typeof_impl.register(External)
def _typeof_external(value: External, _context: Any) -> Any:
    return types.ExternalFunction(value.name, types.void(*[types.intp] * value.arguments))


# Compiled code holds a function's name, so that it can be kept on disk; LLVM puts in the address when it is loaded.
tell(llvm.add_symbol)
