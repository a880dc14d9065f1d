"""What a job takes of the disk and of the table of processes, which no rlimit counts: looked at from outside.

The process that forks workers looks a few times a second, and kills what takes too much. Files that were removed but
are still open are found by the worker's descriptors, memory files too.
"""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from typing import NamedTuple

OFTEN = 0.2
"""[s] How long a job may take too much: a disk writes some hundred megabytes in that time."""
THREADS = 512
"""Of one worker: a few for each core, and some of USD's."""
_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
WORDS = "it took more of the disk than it may"
"""What a worker's log ends with that was killed for it."""


class Quota(NamedTuple):
    """What one job may take."""

    folder: str
    """Where its `out`, `tmp` and `worker.log` are; `in` was there before."""
    most_bytes: int
    most_files: int

    def excess(self, pid: int) -> str:
        """What a worker takes too much of, for its log; '' where all is well."""
        found = _Seen(self.most_bytes, self.most_files)
        with suppress(OSError):
            found.add(os.stat(os.path.join(self.folder, "worker.log")))
        waiting = [os.path.join(self.folder, name) for name in ("out", "tmp")]
        try:
            while waiting and not found.too_much:
                with os.scandir(waiting.pop()) as entries:
                    for entry in entries:
                        found.add(entry.stat(follow_symlinks=False))
                        if entry.is_dir(follow_symlinks=False):
                            waiting.append(entry.path)
                        if found.too_much:
                            break
        except FileNotFoundError:  # just removed
            pass
        except OSError as error:  # a path longer than the system takes
            return f"folder cannot be looked at: {error.strerror}"
        for status in _open_files(pid):
            found.add(status)
        if found.too_much:
            return f"folder holds over {self.most_bytes} bytes or {self.most_files} files (folder_bytes, folder_files)"
        threads = _threads(pid)
        return f"{threads} threads; at most {THREADS} are allowed" if threads > THREADS else ""


class _Seen:
    """A sum over files, each counted once by whatever names."""

    def __init__(self, most_bytes: int, most_files: int) -> None:
        self.most_bytes, self.most_files = most_bytes, most_files
        self.bytes = 0
        self.files: set[tuple[int, int]] = set()

    def add(self, status: os.stat_result) -> None:
        key = (status.st_dev, status.st_ino)
        if key not in self.files:
            self.files.add(key)
            self.bytes += max(status.st_blocks * 512, status.st_size if stat.S_ISREG(status.st_mode) else 0)

    @property
    def too_much(self) -> bool:
        return self.bytes > self.most_bytes or len(self.files) > self.most_files


def _open_files(pid: int) -> list[os.stat_result]:
    """Files of a process that have no name any more, or never had one."""
    found = []
    try:
        for name in os.listdir(f"/proc/{pid}/fd"):
            status = os.stat(f"/proc/{pid}/fd/{name}")
            if stat.S_ISREG(status.st_mode) and status.st_nlink == 0:
                found.append(status)
    except OSError:  # closed, or ended, or not ours to see
        pass
    return found


def _threads(pid: int) -> int:
    try:
        return len(os.listdir(f"/proc/{pid}/task"))
    except OSError:
        return 0


def remove(folder: str) -> None:
    """Remove a folder and all in it, however deep: paths may be longer than the system takes, and the tree deeper than
    Python calls. What cannot be removed is left, and all of it where a folder is moved away meanwhile."""
    with suppress(OSError):
        here = os.open(folder, _FOLDER)
        trail: list[tuple[tuple[int, int], str]] = []  # which folder, and the name of the one gone into
        stuck: set[tuple[int, str]] = set()
        try:
            while True:
                below = _emptied(here, len(trail), stuck)
                if not below and not trail:
                    break
                if below:
                    trail.append((_which(here), below))
                inner = os.open(below or "..", _FOLDER, dir_fd=here)
                os.close(here)
                here = inner
                if not below:
                    above, name = trail.pop()
                    if _which(here) != above:
                        return
                    try:
                        os.rmdir(name, dir_fd=here)
                    except OSError:
                        stuck.add((len(trail), name))
        finally:
            os.close(here)
        os.rmdir(folder)


def _which(descriptor: int) -> tuple[int, int]:
    status = os.fstat(descriptor)
    return status.st_dev, status.st_ino


def _emptied(here: int, depth: int, stuck: set[tuple[int, str]]) -> str:
    """Removes the files of a folder. Returns one of the folders in it, or ''."""
    with os.scandir(here) as entries:
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                if (depth, entry.name) not in stuck:
                    return entry.name
                continue
            with suppress(OSError):
                os.unlink(entry.name, dir_fd=here)
    return ""
