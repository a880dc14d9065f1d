"""The decorators of per-pixel code. What they give is compiled when it is first called, not when it is defined.

Nothing here knows numba: it is loaded when a kernel has to be compiled, or loaded from where it was kept (`jit`).
Kernels that were compiled when the package was built never need it (`ahead`).
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np

from . import ahead, store
from .declared import signature_of
from .external import External
from .store import cache_root, keep_nothing

__all__ = [
    "External", "Kernel", "cache_root", "flag", "inlined", "is_compiled", "keep_nothing", "kernel", "leaf", "word",
]  # fmt: skip

F = TypeVar("F", bound=Callable[..., Any])
_LOG = logging.getLogger(__name__)
_NOT_LOOKED_FOR: Any = object()


def _jit() -> Any:
    """The room that knows numba; it takes a third of a second to load."""
    from . import jit

    return jit


class Kernel:
    """A compiled function that Python calls: per tile, not per pixel. Its annotations are its signature."""

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)
        self.py_func = function
        self._native: Any = _NOT_LOOKED_FOR
        self._compiled: Any = None

    @property
    def native(self) -> ahead.Native | None:
        """The form of it that came with the package."""
        if self._native is _NOT_LOOKED_FOR:
            self._native = ahead.find(self.py_func)
        found: ahead.Native | None = self._native
        return found

    @property
    def compiled(self) -> Any:
        """numba's form of it, which compiles itself for the arguments it meets."""
        if self._compiled is None:
            self._compiled = _jit().kernel(self.py_func)
        return self._compiled

    def warm(self) -> bool:
        """Have numba compile it for what it declares, or load it. True where it had to be compiled."""
        known = tuple(_jit().pointer_type.type_of(kind) for kind in signature_of(self.py_func).arguments)
        self.compiled.compile(known)
        return not self.compiled.stats.cache_hits

    @property
    def _numba_type_(self) -> Any:
        return _jit().type_of(self.compiled)

    def __call__(self, *arguments: Any) -> Any:
        native = self.native
        if native is not None:
            try:
                return native(arguments)
            except ahead.Mismatch:
                _LOG.info("%s was not compiled for what it is called with; numba compiles it", self.py_func.__name__)
        return self.compiled(*arguments)


class Inlined:
    """A compiled function that kernels call."""

    def __init__(self, function: Callable[..., Any], merged: bool) -> None:
        functools.update_wrapper(self, function)
        self.py_func = function
        self.merged = merged
        self._for_python: Any = None

    @property
    def _numba_type_(self) -> Any:
        return _jit().type_of(_jit().inlined(self.py_func, self.merged))

    def __call__(self, *arguments: Any) -> Any:
        """Called from Python, as tests do: compiled for that alone."""
        if self._for_python is None:
            self._for_python = _jit().called_from_python(self.py_func)
        return self._for_python(*arguments)


def kernel(function: F) -> F:
    """Compile `function` when first called (or load it), to run without the GIL.

    Its annotations are its signature (`declared`); where it says that it takes a record, it is called with a `Pointer`.
    Division by zero gives inf or NaN as in numpy, never an exception: a ray that fails is a status.
    """
    compiled: Any = Kernel(function)
    return compiled


def inlined(function: F) -> F:
    """For the functions kernels call: compiled into each caller, so not kept on their own. They allocate nothing.

    They never count references: otherwise each call counts every array of every table up and down, with atomics that
    all threads share (a texture sample took 137 ns that way, and takes 20).
    """
    compiled: Any = Inlined(function, False)
    return compiled


def leaf(function: F) -> F:
    """As `inlined`, for functions small enough to be merged into every caller."""
    compiled: Any = Inlined(function, True)
    return compiled


def word(value: int) -> int:
    """A constant that kernels pass to functions as an argument, as a 64-bit integer.

    numba compiles a function anew for every Python number it is called with; one of numpy's is a value like any other.
    """
    return cast(int, np.int64(value))


def flag(value: bool) -> bool:
    """The same for a switch."""
    return cast(bool, np.bool_(value))


def is_compiled(compiled: Callable[..., Any]) -> bool:
    """A compiled form of this kernel came with the package, or is in memory or on disk."""
    assert isinstance(compiled, Kernel)
    if compiled.native is not None:
        return True
    in_memory = compiled._compiled is not None and bool(compiled._compiled.signatures)
    return in_memory or store.is_kept(compiled.py_func)
