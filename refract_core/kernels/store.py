"""Where kernels compiled on this machine are kept, and whether this process may add to them."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from .key import key_of


class Keeping:
    """Whether what is compiled is written down. Reading always goes on."""

    allowed = True


def cache_root() -> Path:
    """Folder of the compiled kernels: REFRACT_CACHE_DIR, else XDG_CACHE_HOME/refract, else ~/.cache/refract."""
    if chosen := os.environ.get("REFRACT_CACHE_DIR"):
        return Path(chosen)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "refract"


def folder() -> Path:
    """Where numba's files of all kernels are."""
    return cache_root() / "kernels"


@cache
def stem(function: Callable[..., Any]) -> str:
    """How the names of one kernel's files begin; `function`: the plain Python function."""
    return f"{function.__module__.rpartition('.')[2]}.{function.__name__}-{key_of(function)}"


def is_kept(function: Callable[..., Any]) -> bool:
    """A compiled form of this kernel, as its code is now, is on disk."""
    return any(folder().glob(f"{stem(function)}.*.nbc"))


def keep_nothing() -> None:
    """From here on this process writes no kernel: the cache is code, and who runs others' jobs must not change it."""
    Keeping.allowed = False
