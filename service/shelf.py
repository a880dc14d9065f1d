"""Stages that were sent to stay for a while, each by the SHA-256 of its content."""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import time
from pathlib import Path

from .limits import Limits
from .uploads import ARCHIVE, GLTF, USD

_NAME = re.compile(rf"([0-9a-f]{{64}})({'|'.join(re.escape(suffix) for suffix in (*USD, *GLTF, ARCHIVE))})")
DIGEST = re.compile(r"[0-9a-f]{64}")


class Shelf:
    """A folder of them. What has not been asked for the longest goes first."""

    def __init__(self, folder: Path, limits: Limits) -> None:
        self.folder, self.limits = folder, limits

    def find(self, digest: str) -> Path | None:
        """The file, which then counts as just used."""
        for path in self._all():
            if path.stem == digest:
                with contextlib.suppress(OSError):
                    os.utime(path)
                    return path
        return None

    def put(self, digest: str, suffix: str, file: Path) -> None:
        """Take a file in, which is moved."""
        self.folder.mkdir(exist_ok=True, mode=0o700)
        os.replace(file, self.folder / f"{digest}{suffix}")
        self.sweep()

    def lend(self, stage: Path, folder: Path) -> Path:
        """The same file under a name of its own, to be moved or removed."""
        path = folder / f"upload-{secrets.token_hex(8)}"
        os.link(stage, path)
        return path

    def sweep(self) -> None:
        """Remove what is too old, or too much."""
        oldest, total = time.time() - self.limits.retention_seconds, 0
        seen = [(path.stat(), path) for path in self._all()]
        for stat, path in sorted(seen, key=lambda one: one[0].st_mtime, reverse=True):
            total += stat.st_size
            if stat.st_mtime < oldest or total > self.limits.kept_bytes:
                path.unlink(missing_ok=True)

    def _all(self) -> list[Path]:
        with contextlib.suppress(FileNotFoundError):
            return [path for path in self.folder.iterdir() if _NAME.fullmatch(path.name)]
        return []
