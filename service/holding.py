"""One service for one folder of jobs: two would take each other's workers' folders away."""

from __future__ import annotations

import fcntl
import os
import weakref
from pathlib import Path

from refract_core.errors import UsageError


class Hold:
    """A lock on a folder, which ends with this object, at `release`, and in any case with the process."""

    def __init__(self, folder: Path) -> None:
        """
        Raises:
            UsageError: another service has the folder.
            OSError: the folder cannot be used.
        """
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        lock = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        self.release = weakref.finalize(self, os.close, lock)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            raise UsageError(f"--data {folder}: another service uses this folder; give each one of its own") from None
        except OSError:
            self.release()
            raise
