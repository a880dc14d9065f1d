"""Kernels compiled ahead of time: one shared object beside this file, called without numba.

A wheel holds `built/kernels.so` and `built/kernels.json`, which says what each kernel takes and which sources all of
them were made from (`build`). They are used only if every one of these sources is the same now, byte by byte, and the
processor has what the code asks for; a kernel is called only with what it was compiled for, down to the layout of every
record. Everything else is compiled by numba when it is called (`jit`), as it is in a checkout, where nothing is built.

REFRACT_KERNELS=jit leaves the shared object alone.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import UsageError
from .external import tell
from .pointer import BOOL, FLOAT, INT, Array, Kind, Layout, Pointer, Row

ENGINE = Path(__file__).parents[1]
FOLDER = Path(__file__).parent / "built"
OBJECT, MANIFEST = "kernels.so", "kernels.json"
_FINE = (0, -2)  # numba's codes for a value, and for None
_NUMBERS: dict[str, tuple[type, Any]] = {
    INT: (int, ctypes.c_int64),
    FLOAT: (float, ctypes.c_double),
    BOOL: (bool, ctypes.c_uint8),
}


class Mismatch(Exception):
    """The kernel was not compiled for these arguments."""


# --- which kernels there are


@cache
def state() -> tuple[dict[str, Any], str]:
    """What the shared object has, by the kernels' names, and if that is nothing, why."""
    wish = os.environ.get("REFRACT_KERNELS", "")
    if wish == "jit":
        return {}, "REFRACT_KERNELS is jit"
    if wish:
        raise UsageError(f"REFRACT_KERNELS is '{wish}'; write jit, or leave it out")
    if not (FOLDER / MANIFEST).exists():
        return {}, "no kernels were compiled when this package was built"
    manifest = json.loads((FOLDER / MANIFEST).read_text("utf-8"))
    if changed := [name for name, digest in manifest["sources"].items() if digest_of(ENGINE / name) != digest]:
        return {}, f"{changed[0]} is not what the kernels were compiled from"
    try:
        library = ctypes.CDLL(str(FOLDER / OBJECT))
    except OSError as error:  # damaged, or on a disk that nothing may be run from
        return {}, f"{OBJECT} cannot be loaded: {error}"
    if ctypes.string_at(ctypes.addressof(ctypes.c_char.in_dll(library, "refract_key"))).decode() != manifest["key"]:
        return {}, f"{OBJECT} and {MANIFEST} are not of one build"
    if not library.refract_runs_here():
        return {}, f"this processor is not a {manifest['processor']}"

    def point(name: str, address: int) -> None:
        ctypes.c_void_p.in_dll(library, f"refract_to_{name}").value = address

    tell(point)
    return {name: (library, row) for name, row in manifest["kernels"].items()}, ""


def digest_of(file: Path) -> str:
    """SHA-256 of a file's bytes; '' where there is none."""
    return hashlib.sha256(file.read_bytes()).hexdigest() if file.exists() else ""


def find(function: Callable[..., Any]) -> Native | None:
    """The form of a kernel that was compiled ahead of time; None where there is none."""
    row = state()[0].get(f"{function.__module__}.{function.__qualname__}")
    return Native(*row) if row else None


# --- how they are called


class Native:
    """One kernel of the shared object.

    Its symbol is what numba makes: where the result goes, where an exception would go, then every argument flat.
    A record is its address, an array seven words and more.
    """

    def __init__(self, library: ctypes.CDLL, row: dict[str, Any]) -> None:
        self._name = row["symbol"]
        self._takes = tuple(from_json(kind) for kind in row["arguments"])
        returns = None if row["returns"] is None else from_json(row["returns"])
        self._gives, self._slot = returns, _slot_of(returns)
        self._call = library[self._name]
        self._call.restype = ctypes.c_int32
        self._call.argtypes = [ctypes.c_void_p, ctypes.c_void_p, *(c for kind in self._takes for c in _flat(kind))]

    def __call__(self, arguments: tuple[Any, ...]) -> Any:
        """Run it.

        Raises:
            Mismatch: it was compiled for other arguments.
        """
        if len(arguments) != len(self._takes):
            raise Mismatch
        words: list[Any] = []
        for kind, value in zip(self._takes, arguments, strict=True):
            _put(kind, value, words)
        slot, exception = self._slot(), ctypes.c_void_p()
        status = self._call(ctypes.byref(slot), ctypes.byref(exception), *words)
        if status not in _FINE:
            raise RuntimeError(f"kernel {self._name} ended with status {status}")
        if self._gives is None:
            return None
        if isinstance(self._gives, Row):
            return tuple(getattr(slot, name) for name, _ in slot._fields_)
        return bool(slot.value) if self._gives == BOOL else slot.value


def _flat(kind: Kind) -> list[Any]:
    """C types of an argument."""
    if isinstance(kind, Array):
        return [ctypes.c_int64] * (5 + 2 * kind.ndim)
    if isinstance(kind, Layout):
        return [ctypes.c_int64]
    if isinstance(kind, Row):
        return [c for inner in kind.kinds for c in _flat(inner)]
    return [_NUMBERS[kind][1]]


def _slot_of(kind: Kind | None) -> Any:
    """C type of a result."""
    if isinstance(kind, Row):
        fields = [(f"at{i}", _NUMBERS[str(inner)][1]) for i, inner in enumerate(kind.kinds)]
        return type("Results", (ctypes.Structure,), {"_fields_": fields})
    return ctypes.c_void_p if kind is None else _NUMBERS[str(kind)][1]


def _put(kind: Kind, value: Any, words: list[Any]) -> None:
    """Append the words of an argument. Raises Mismatch."""
    if isinstance(kind, Layout):
        if not isinstance(value, Pointer) or value.layout != kind:
            raise Mismatch
        words.append(value.address)
    elif isinstance(kind, Array):
        if not isinstance(value, np.ndarray) or value.dtype.str != kind.dtype or value.ndim != kind.ndim:
            raise Mismatch
        if not value.flags.c_contiguous:
            raise Mismatch
        # meminfo and parent, which only counting references would need; then size, size of an element, and so on
        words += (0, 0, value.size, value.itemsize, value.ctypes.data, *value.shape, *value.strides)
    elif isinstance(kind, Row):
        if not isinstance(value, tuple) or len(value) != len(kind.kinds):
            raise Mismatch
        for inner, item in zip(kind.kinds, value, strict=True):
            _put(inner, item, words)
    elif kind == INT and isinstance(value, int | np.integer) and not isinstance(value, bool):
        words.append(int(value))
    elif kind == FLOAT and isinstance(value, float | int) and not isinstance(value, bool):
        words.append(float(value))
    elif kind == BOOL and isinstance(value, bool | np.bool_):
        words.append(int(value))
    else:
        raise Mismatch


# --- kinds as JSON


def to_json(kind: Kind) -> Any:
    """A kind as the manifest holds it."""
    if isinstance(kind, Array):
        return {"array": [kind.dtype, kind.ndim]}
    if isinstance(kind, Layout):
        return {"record": kind.record, "fields": [[name, to_json(inner)] for name, inner in kind.fields]}
    if isinstance(kind, Row):
        return {"row": [to_json(inner) for inner in kind.kinds]}
    return kind


def from_json(value: Any) -> Kind:
    """The kind that `to_json` wrote."""
    if isinstance(value, str):
        return value
    if "array" in value:
        return Array(*value["array"])
    if "row" in value:
        return Row(tuple(from_json(inner) for inner in value["row"]))
    return Layout(value["record"], tuple((name, from_json(inner)) for name, inner in value["fields"]))
