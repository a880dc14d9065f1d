"""One kernel, one optimisation: what a kernel calls is linked into it once, as it was written.

Left alone, numba optimises every function together with all it calls, and makes machine code and an entry for Python of
each: two hundred functions that only kernels call, most of them time and again in their callers' callers. Here such a
function stays LLVM's text, tidied for itself; a kernel links the text of all it needs and is optimised once. The
first render compiles in half the time, and pictures are the same bit by bit.

This stands on numba's inner classes, so on its minor version (`TRIED`). Under any other one kernels are compiled as
numba does it by itself: right, but slower to compile.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import llvmlite.binding as llvm
import numba
from numba.core.codegen import CPUCodeLibrary, JITCodeLibrary
from numba.core.compiler import Compiler

TRIED = "0.68."
"""The numba this was tried with; pyproject.toml asks for the same."""


def is_known() -> bool:
    """The inner classes of the installed numba are those that this room knows."""
    return bool(numba.__version__.startswith(TRIED))


class _WithoutEnvironment:
    """numba's code generator, for functions that have no machine code to tell their environment to."""

    def __init__(self, codegen: Any) -> None:
        self._codegen = codegen

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)

    def set_env(self, *_arguments: Any) -> None:
        """Nobody reads it: only what raises Python exceptions with values would."""


class Text(JITCodeLibrary):  # type: ignore[misc]
    """A function that only kernels call: LLVM's text, without machine code."""

    @property
    def codegen(self) -> Any:
        return _WithoutEnvironment(self._codegen)

    def finalize(self) -> None:
        self._raise_if_finalized()
        for below in self._linking_libraries:
            self._reload_init.update(below._reload_init)
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Where Python would enter: a function that raises TypeError, as nothing else is there."""
        self._ensure_finalized()
        address: int = llvm.address_of_symbol("PyErr_BadArgument")
        return address

    def own_module(self) -> Any:
        """The text of this function alone."""
        return super()._get_module_for_linking()

    def _get_module_for_linking(self) -> Any:
        """For a library that does not know this room: with all it calls."""
        whole = self.own_module().clone()
        for library in _callees(self):
            whole.link_in(_module_of(library), preserve=True)
        return whole


class Kernel(JITCodeLibrary):  # type: ignore[misc]
    """A kernel: its own text and that of all it calls, once each, optimised together."""

    def finalize(self) -> None:
        for library in _callees(self):
            self._final_module.link_in(_module_of(library), preserve=True)
            self._reload_init.update(library._reload_init)
        self._linking_libraries.clear()
        super().finalize()


class Ahead(Kernel):
    """A kernel that is going to run elsewhere: optimised, but not made machine code here."""

    @property
    def codegen(self) -> Any:
        return _WithoutEnvironment(self._codegen)

    def _finalize_final_module(self) -> None:
        self._verify_declare_only_symbols()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """As `Text`: there is nothing to be called."""
        self._ensure_finalized()
        address: int = llvm.address_of_symbol("PyErr_BadArgument")
        return address

    def module(self) -> Any:
        """The optimised module, which is this library's last use of it."""
        self._ensure_finalized()
        return self._final_module


def _callees(library: Any) -> list[Any]:
    """Everything that a library calls, directly or not, callers before what they call: LLVM inlines in that order, and
    frames were slower in any other."""
    seen: set[Any] = set()
    after: list[Any] = []

    def visit(one: Any) -> None:
        for below in one._linking_libraries:
            if below not in seen:
                seen.add(below)
                if isinstance(below, Text):
                    visit(below)
                after.append(below)

    visit(library)
    return after[::-1]


def _module_of(library: CPUCodeLibrary) -> Any:
    return library.own_module() if isinstance(library, Text) else library._get_module_for_linking()


def _pipeline(kind: type[JITCodeLibrary]) -> type[Compiler]:
    """numba's compiler, with another kind of library for what it makes."""

    class Pipeline(Compiler):  # type: ignore[misc]
        def compile_extra(self, function: Callable[..., Any]) -> Any:
            self.state.library = kind(self.state.targetctx.codegen(), function.__qualname__)
            self.state.library.enable_object_caching()
            return super().compile_extra(function)

    return Pipeline


KERNEL: dict[str, Any] = {"pipeline_class": _pipeline(Kernel)} if is_known() else {}
"""Options of a kernel's decorator."""
AHEAD: dict[str, Any] = {"pipeline_class": _pipeline(Ahead), "no_cpython_wrapper": True} if is_known() else {}
"""Options of a kernel's decorator that is compiled ahead of time."""
TEXT: dict[str, Any] = {"pipeline_class": _pipeline(Text), "no_cpython_wrapper": True} if is_known() else {}
"""Options of the decorator of a function that kernels call."""
