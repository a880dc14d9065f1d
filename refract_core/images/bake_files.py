"""The files of baked probes: their names and folder, what is known of each, and how many are made at once."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import StageError
from ..files import folder_beside
from ..scene import Probe

_BATCH = 16
"""Probes captured together, which share one BVH; their collections must also fit into the masks of one scene."""
_BATCH_TEXELS = 1 << 21
"""... and texels on one face of each, together: what is held in memory at once."""


class Task(NamedTuple):
    """A probe to bake."""

    probe: Probe
    file: str
    """the texture to write"""
    digest: str


class Baked(NamedTuple):
    """What a layer says about one probe."""

    texture: str
    """absolute path, which may be inside a package"""
    record: Mapping[str, Any]
    """the customData `refractBake`; empty where there is none"""
    resolution: int | None = None
    """[texels]; None leaves the stage's own"""


def file_names(paths: Iterable[str]) -> dict[str, str]:
    """A texture's file name for each prim path: the same for the same stage, and unique where case does not count."""
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


@contextmanager
def texture_folder(out: str) -> Iterator[str]:
    """Where textures are written, tried before the work. Not left behind empty."""
    with folder_beside(out, "probes") as place:
        folder = Path(place)
        try:
            folder.mkdir(exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError as error:
            raise StageError(f"{folder}: is not a folder that textures can be written to: {error.strerror}") from error
        try:
            yield place
        finally:
            if not any(folder.iterdir()):
                folder.rmdir()


def batches(tasks: list[Task]) -> Iterator[list[Task]]:
    """The tasks, a few at a time."""
    batch: list[Task] = []
    texels = 0
    for task in tasks:
        more = task.probe.resolution**2
        if batch and (len(batch) == _BATCH or texels + more > _BATCH_TEXELS):
            yield batch
            batch, texels = [], 0
        batch.append(task)
        texels += more
    if batch:
        yield batch


def size_text(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1_000_000 else f"{max(count // 1000, 1)} kB"
