"""What the orders of several verbs share: values in their ranges, what `--only` names, files that may be there already,
a wish to stop, sizes as a person reads them, and the memory that the work took.
"""

from __future__ import annotations

import fnmatch
import os
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TypeVar

from ..errors import Cancelled, StageError, UsageError

JOBS = (0, 4096)
"""Threads that may be asked for; 0 means all cores."""

Item = TypeVar("Item")


def check_range(flag: str, value: int, limits: tuple[int, int]) -> None:
    """Raises UsageError where a whole number is outside of its range, whose both ends are in it."""
    if isinstance(value, bool) or not limits[0] <= value <= limits[1]:
        raise UsageError(f"{flag} is {value}; it must be between {limits[0]} and {limits[1]}")


def select(
    items: Sequence[Item], only: Sequence[str], paths_of: Callable[[Item], Sequence[str]], what: str
) -> list[Item]:
    """The items that `--only` names, by a path of their own or of something above them; all where it names nothing.

    Args:
        only: prim paths, in which * and ? stand for any characters, also for a slash.
        paths_of: where an item is; several where an instance shows it several times.
        what: the items are, for the message.

    Raises:
        UsageError: a pattern names no item.
    """

    def named(item: Item, pattern: str) -> bool:
        pattern = pattern.rstrip("/") or "/*"
        return any(fnmatch.fnmatchcase(path, form) for path in paths_of(item) for form in (pattern, f"{pattern}/*"))

    for pattern in only:
        if not any(named(item, pattern) for item in items):
            some = [paths_of(item)[0] for item in items[:8]] + ["..."] * (len(items) > 8)
            raise UsageError(f"--only {pattern}: the stage has no such {what}; it has {', '.join(some) or 'none'}")
    return [item for item in items if not only or any(named(item, pattern) for pattern in only)]


def file_names(paths: Iterable[str]) -> dict[str, str]:
    """A picture's file name for each prim path: the same for the same stage, and unique where case does not count."""
    names: dict[str, str] = {}
    taken: set[str] = set()
    for path in sorted(paths):
        stem = path.strip("/").replace("/", "_")[-120:]
        name, count = f"{stem}.exr", 1
        while name.lower() in taken:
            count += 1
            name = f"{stem}_{count}.exr"
        taken.add(name.lower())
        names[path] = name
    return names


def refuse_existing(files: Iterable[str]) -> None:
    """Raises UsageError where one of the files is there already: nobody said that it may be replaced."""
    for file in files:
        if os.path.lexists(file):
            raise UsageError(f"{file}: exists already; choose another OUT, or replace it with --overwrite")


def make_folder_of(file: str) -> None:
    """Make the folder that a file beside OUT goes into. Raises StageError."""
    folder = Path(file).parent
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise StageError(f"{folder}: cannot be made: {error.strerror}; choose another OUT") from error


def stop_if(cancel: Callable[[], bool], state: str = "") -> None:
    """Raises Cancelled where `cancel` says so. `state`: what is left on disk then."""
    if cancel():
        raise Cancelled(f"cancelled; {state}" if state else "cancelled")


def peak_memory() -> int:
    """Most memory that this process has had in use [bytes]; 0 where nobody knows (proc_pid_status(5), getrusage(2))."""
    try:
        # getrusage counts what the process had before it became this program, too.
        found = re.search(r"^VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text("ascii", "replace"), re.MULTILINE)
    except OSError:
        found = None
    if found:
        return int(found[1]) * 1024
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def size_text(count: int) -> str:
    """Bytes, as in `1.2 MB`."""
    return f"{count / 1e6:.1f} MB" if count >= 1_000_000 else f"{max(count // 1000, 1)} kB"
