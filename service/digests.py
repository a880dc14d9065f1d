"""What makes two requests the same: the engine, an uploaded file, a stage with all that lies around it."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from pathlib import Path
from typing import Any

import refract_core

_ENGINE: list[str] = []


def engine() -> str:
    """Version of all that makes a result: release and sources."""
    if not _ENGINE:
        from refract_core.usd.registering import FOLDER
        from refract_core.version import __version__

        digest = hashlib.sha256()
        service, core = Path(__file__).resolve().parent, Path(refract_core.__file__).resolve().parent
        inside = {service, FOLDER}  # of the engine's own folder in a wheel, beside it in a checkout: the same digest
        engine = [path for path in sorted(core.rglob("*.py")) if not inside.intersection(path.parents)]
        for path in (*engine, *sorted(service.glob("*.py")), FOLDER / "generatedSchema.usda"):
            digest.update(path.read_bytes())
        _ENGINE.append(f"{__version__}+{digest.hexdigest()[:12]}")
    return _ENGINE[0]


def identifier_of(kind: str, settings: dict[str, Any], digest: str, owner: str = "") -> str:
    """Name of a job: the same for the same work on the same stage by the same engine. Each owner has jobs of its own:
    that somebody else has asked for the same is nobody's business."""
    wish = json.dumps([kind, engine(), digest, settings, *([owner] if owner else [])], sort_keys=True, allow_nan=False)
    return hashlib.sha256(wish.encode()).hexdigest()


def file_digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def tree_digest(root: Path, stage: str) -> str:
    """Of a stage under the stage root, with whatever it may refer to there: names, sizes and times of all files."""
    digest = hashlib.sha256(stage.encode())
    for folder, folders, names in os.walk(root):
        folders.sort()
        for name in sorted(names):
            with contextlib.suppress(OSError):
                seen = os.stat(os.path.join(folder, name))
                digest.update(f"{folder}/{name}\0{seen.st_size}\0{seen.st_mtime_ns}\n".encode())
    return digest.hexdigest()
