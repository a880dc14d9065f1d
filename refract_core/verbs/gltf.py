"""glTF files where a stage is asked for: as the package that `convert` makes of each."""

from __future__ import annotations

import os
from collections.abc import Callable
from multiprocessing.util import Finalize
from tempfile import TemporaryDirectory

from ..scene import Notice
from ..usd.layers.write import is_gltf
from .convert import ConvertOrder, convert

_made: dict[tuple[str, int, int], tuple[str, tuple[Notice, ...]]] = {}
"""Path, time [ns] and size of a glTF file -> the package made of it, and what was lost on the way.

Packages live as long as the process, for scenes read their pictures late."""


def as_usd(path: str, tell: Callable[[str, str], None] = lambda _path, _text: None) -> str:
    """The path of a stage: `path` itself, or of a glTF file a package with its glass described.

    Args:
        tell: told what glTF says and a stage does not.

    Raises:
        UsageError: pygltflib is not installed.
        StageError: the glTF file cannot be read.
    """
    if not is_gltf(path) or not os.path.isfile(path):
        return path
    about = os.stat(path)
    key = os.path.abspath(path), about.st_mtime_ns, about.st_size
    if key not in _made:
        folder = TemporaryDirectory(prefix="refract-gltf-")
        Finalize(None, folder.cleanup, exitpriority=0)  # at the end of a worker process too, where atexit is not asked
        out = os.path.join(folder.name, f"{os.path.splitext(os.path.basename(path))[0]}.usdz")
        _made[key] = out, convert(ConvertOrder(stage=path, out=out)).notices
    out, notices = _made[key]
    for notice in notices:
        tell(notice.path, notice.text)
    return out
