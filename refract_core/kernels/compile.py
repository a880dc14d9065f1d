"""The decorators of per-pixel code. What they give is compiled when it is first called, not when it is defined.

Nothing here knows numba: it is loaded when a kernel has to be compiled, or loaded from where it was kept.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np

from . import store
from .store import cache_root, keep_nothing

__all__ = ["External", "cache_root", "flag", "inlined", "is_compiled", "keep_nothing", "kernel", "leaf", "word"]

F = TypeVar("F", bound=Callable[..., Any])


_BOUND: dict[str, int] = {}
"""Addresses of C functions by their names."""


@functools.cache
def _jit() -> Any:
    """The room that knows numba; it takes a third of a second to load."""
    from . import jit

    for name, address in _BOUND.items():
        jit.bind(name, address)
    return jit


class Kernel:
    """A compiled function that Python calls: per tile, not per pixel."""

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)
        self.py_func = function
        self._compiled: Any = None

    @property
    def compiled(self) -> Any:
        """numba's form of it, which compiles itself for the arguments it meets."""
        if self._compiled is None:
            self._compiled = _jit().kernel(self.py_func)
        return self._compiled

    @property
    def _numba_type_(self) -> Any:
        return _jit().type_of(self.compiled)

    def __call__(self, *arguments: Any) -> Any:
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


class External:
    """A function of a C library that kernels call: every argument is one machine word, and it gives nothing back."""

    def __init__(self, name: str, arguments: int) -> None:
        self.name, self.arguments = name, arguments

    @property
    def key(self) -> str:
        return f"{self.name} {self.arguments}"

    @property
    def _numba_type_(self) -> Any:
        return _jit().external(self.name, self.arguments)

    def __call__(self, *words: int) -> None:
        raise TypeError(f"{self.name} is called by kernels, not by Python")

    def bind(self, address: int) -> None:
        """Say where the function is. Kernels that call it can be loaded only afterwards."""
        _BOUND[self.name] = address
        if _jit.cache_info().currsize:
            _jit().bind(self.name, address)


def kernel(function: F) -> F:
    """Compile `function` when first called (or load it), to run without the GIL.

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
    """A compiled form of this kernel is in memory or on disk."""
    assert isinstance(compiled, Kernel)
    in_memory = compiled._compiled is not None and bool(compiled._compiled.signatures)
    return in_memory or store.is_kept(compiled.py_func)
