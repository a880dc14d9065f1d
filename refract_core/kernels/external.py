"""Functions of C libraries that kernels call: known by name when a kernel is compiled, by address when it runs."""

from __future__ import annotations

from collections.abc import Callable

_bound: dict[str, int] = {}
_listeners: list[Callable[[str, int], None]] = []


class External:
    """A function whose every argument is one machine word, and which gives nothing back."""

    def __init__(self, name: str, arguments: int) -> None:
        self.name, self.arguments = name, arguments

    @property
    def key(self) -> str:
        """What of it is compiled in."""
        return f"{self.name} {self.arguments}"

    def __call__(self, *words: int) -> None:
        raise TypeError(f"{self.name} is called by kernels, not by Python")

    def bind(self, address: int) -> None:
        """Say where the function is. Kernels that call it can run only afterwards."""
        _bound[self.name] = address
        for listener in _listeners:
            listener(self.name, address)


def tell(listener: Callable[[str, int], None]) -> None:
    """Call `listener` with name and address of every function that is bound, now or later."""
    _listeners.append(listener)
    for name, address in _bound.items():
        listener(name, address)
