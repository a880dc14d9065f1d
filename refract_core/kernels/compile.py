"""The one decorator of per-pixel code, and where its compiled form is kept.

numba's own cache notices a change of the file a function stands in, but not of the files it calls into. A kernel here
inlines functions of half a dozen rooms, so the cache folder is named after the sources of all of them: what is loaded
always belongs to the code that runs.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])

_ENGINE = Path(__file__).parents[1]

# Products and sums may fuse (FMA); NaN, infinity and the order of operations keep their meaning.
FASTMATH = {"contract", "nsz"}


def cache_root() -> Path:
    """Folder of the compiled kernels: REFRACT_CACHE_DIR, else XDG_CACHE_HOME/refract, else ~/.cache/refract."""
    if chosen := os.environ.get("REFRACT_CACHE_DIR"):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "refract"


_COMPILED_WINGS = ("kernels", "optics", "world", "probes", "view", "transport", "thickness")


@cache
def _cache_folder(module: str) -> str:
    """Folder for the kernels of one module."""
    room = module.rpartition(".")[2]
    digest = hashlib.sha256(f"{sys.version_info[:2]} {numba.__version__}".encode())
    for path in sorted([_ENGINE / "scene.py", *(p for wing in _COMPILED_WINGS for p in (_ENGINE / wing).glob("*.py"))]):
        digest.update(path.read_bytes())
    return str(cache_root() / "kernels" / f"{room}-{digest.hexdigest()[:16]}")


def kernel(function: Callable[..., T]) -> Callable[..., T]:
    """Compile `function` with numba when first called (or load it), to run without the GIL.

    Division by zero gives inf or NaN as in numpy, never an exception: a ray that fails is a status.
    """
    numba.config.CACHE_DIR = _cache_folder(function.__module__)
    compiled: Callable[..., T] = numba.njit(nogil=True, cache=True, error_model="numpy", fastmath=FASTMATH)(function)
    return compiled


def inlined(function: F) -> F:
    """For the functions kernels call: compiled into each caller, so not cached on their own. They allocate nothing.

    They never count references: otherwise each call counts every array of every table up and down, with atomics that
    all threads share (a texture sample took 137 ns that way, and takes 20).
    """
    compiled: F = numba.njit(
        _nrt=False, nogil=True, error_model="numpy", fastmath=FASTMATH, no_cfunc_wrapper=True
    )(function)
    return compiled


def leaf(function: F) -> F:
    """As `inlined`, for functions small enough to be merged into every caller."""
    compiled: F = numba.njit(
        _nrt=False, forceinline=True, nogil=True, error_model="numpy", fastmath=FASTMATH, no_cfunc_wrapper=True
    )(function)
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
    signatures: Any = getattr(compiled, "signatures", ())
    folder = Path(_cache_folder(compiled.__module__))
    return bool(signatures) or any(folder.rglob(f"*{compiled.__name__}*.nbc"))
