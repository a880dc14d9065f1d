"""Which files a glTF file names. Read by the confined worker alone, before the glTF itself is."""

from __future__ import annotations

import json
import os
import struct
from typing import Any
from urllib.parse import unquote

_MAGIC = b"glTF"
_HEAD = struct.Struct("<4sIIII")
"""magic, version, length of all; length of the first chunk, its kind (Khronos glTF 2.0, 4.4)"""


def parts_of(path: str | os.PathLike[str]) -> list[str]:
    """Relative paths of its buffers and pictures, as the reader will open them. A file that cannot be read has none:
    the reader says what is wrong with it.
    """
    try:
        document = json.loads(_text(path))
    except (OSError, ValueError, RecursionError, struct.error):
        return []
    found = []
    for kind in ("buffers", "images"):
        parts: Any = document.get(kind) if isinstance(document, dict) else None
        for part in parts if isinstance(parts, list) else ():
            uri = part.get("uri") if isinstance(part, dict) else None
            if isinstance(uri, str) and not uri.startswith("data:"):
                found.append(unquote(uri))
    return found


def _text(path: str | os.PathLike[str]) -> bytes:
    with open(path, "rb") as file:
        if not os.fspath(path).lower().endswith(".glb"):
            return file.read()
        magic, _, _, length, _ = _HEAD.unpack(file.read(_HEAD.size))
        if magic != _MAGIC:
            raise ValueError("no binary glTF")
        return file.read(length)
