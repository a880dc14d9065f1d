"""What annotations say: the layout of a record's class, and the signature of a kernel.

A kernel's annotations are its signature. A parameter is a number (`int`, `float`, `bool`), an array with its axes
(`arrays`, or a column of `lanes`), a record's class, which stands for a `Pointer` to one, or a tuple of numbers.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, NamedTuple, get_args, get_origin, get_type_hints

import numpy as np

from .pointer import BOOL, FLOAT, INT, Array, Kind, Layout, Row

_NUMBERS: dict[Any, Kind] = {int: INT, float: FLOAT, bool: BOOL, np.int64: INT, np.float64: FLOAT, np.bool_: BOOL}


class Signature(NamedTuple):
    """What a kernel takes and gives."""

    arguments: tuple[Kind, ...]
    returns: Kind | None


def signature_of(function: Callable[..., Any]) -> Signature:
    """The signature that a plain Python function declares. Raises TypeError where it does not say enough."""
    hints = get_type_hints(function, include_extras=True)
    where = f"{function.__module__}.{function.__qualname__}"
    arguments = [kind_of(hints.get(name), f"{where}({name})") for name in inspect.signature(function).parameters]
    if "return" not in hints:
        raise TypeError(f"{where} does not say what it returns")
    returns = None if hints["return"] is type(None) else kind_of(hints["return"], f"{where}, its result,")
    return Signature(tuple(arguments), returns)


def kind_of(hint: Any, where: str) -> Kind:
    """What an annotation stands for. `where`: what it annotates, for the error."""
    if hint in _NUMBERS:
        return _NUMBERS[hint]
    axes = [extra.axes for extra in getattr(hint, "__metadata__", ()) if hasattr(extra, "axes")]
    if axes:
        element = get_args(get_args(hint.__origin__)[1])[0]
        return Array(np.dtype(element).str, axes[0])
    if inspect.isclass(hint) and hasattr(hint, "_fields"):
        fields = get_type_hints(hint, include_extras=True)
        return Layout(hint.__name__, tuple((f, kind_of(fields[f], f"{hint.__name__}.{f}")) for f in hint._fields))
    if get_origin(hint) is tuple and Ellipsis not in get_args(hint):
        return Row(tuple(kind_of(inner, where) for inner in get_args(hint)))
    raise TypeError(f"{where} is annotated with {hint}; a kernel's arrays say their axes, as in arrays.F32_2D")
