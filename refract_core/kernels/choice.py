"""One function out of a table by its row's number, for kernels: what would otherwise be a chain of ifs by hand."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Concatenate, ParamSpec, TypeVar

from .compile import leaf

P = ParamSpec("P")
R = TypeVar("R")


def choice(table: Mapping[Any, Callable[P, R]], otherwise: Callable[P, R]) -> Callable[Concatenate[int, P], R]:
    """A compiled function (number, *arguments) that calls the table's function of that number with the arguments.

    Compiled code cannot look a function up in a dictionary, so each row becomes an `if` around the next one, made once,
    when the table is. The ifs are merged into the caller, and LLVM makes one jump of them.

    Args:
        table: number -> compiled function. All take the same arguments and give the same types.
        otherwise: for numbers that are not in the table.
    """
    chain: Callable[..., R] = _last(otherwise)
    for number, function in reversed([*table.items()]):
        chain = _link(int(number), function, chain)
    return chain


def _last(otherwise: Callable[..., R]) -> Callable[..., R]:
    @leaf
    def last(asked: int, *arguments: Any) -> R:
        return otherwise(*arguments)

    return last


def _link(number: int, function: Callable[..., R], rest: Callable[..., R]) -> Callable[..., R]:
    @leaf
    def link(asked: int, *arguments: Any) -> R:
        if asked == number:
            return function(*arguments)
        return rest(asked, *arguments)

    return link
