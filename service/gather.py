"""Which files a stage under the stage root is made of, found out by a process that can do nothing else.

`python -m refract_core.service.gather ROOT STAGE LAYERS BYTES` prints one line of JSON: `{"files": [...]}`, relative to
ROOT, or `{"problem": ...}` as a worker would say it.
"""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import refract_core

from . import confine
from .problems import Problem
from .worker import environment, own_files

_SECONDS = 60
_MEANS = confine.Means(memory_bytes=4 << 30, cpu_seconds=_SECONDS, file_bytes=1 << 10, open_files=256)


async def files_of(root: str, stage: str, limits: Mapping[str, int]) -> list[str]:
    """Paths relative to `root`, of `stage` and all it refers to.

    Raises:
        Problem: the stage reaches out of `root`, or cannot be read.
    """
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "refract_core.service.gather", root, stage, str(limits["layers"]),
        str(limits["stage_bytes"]),
        cwd=Path(refract_core.__file__).parents[1], env=environment(), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        async with asyncio.timeout(_SECONDS):
            said, _ = await process.communicate()
    except TimeoutError:
        raise Problem("time-limit", f"the stage's files were not found out within {_SECONDS} s") from None
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()
    try:
        answer = json.loads(said.splitlines()[-1])
    except (ValueError, IndexError):
        how = f"the process that looked for the stage's files ended with {process.returncode}"
        raise Problem("stage-crashed", how) from None
    if "problem" in answer:
        raise Problem(answer["problem"]["slug"], answer["problem"]["detail"])
    return checked([str(path) for path in answer["files"]], root)


def checked(paths: list[str], root: str) -> list[str]:
    """The same paths, if they all lie under `root`: they come from a process that has read a stranger's stage."""
    top = os.path.realpath(root)
    for path in paths:
        if os.path.commonpath([top, os.path.realpath(os.path.join(top, path))]) != top:
            raise Problem("stage-refused", "the stage refers to something outside the stage root")
    return paths


def _look(root: str, stage: str, layers: int, unpacked_bytes: int) -> dict[str, Any]:
    from refract_core.usd.layers import mtlx
    from refract_core.usd.layers.assets import files_of as all_files_of

    from . import precheck

    mtlx.make_ready()
    root = os.path.realpath(root)
    os.chdir(root)
    confine.confine([*own_files(), root], [], _MEANS)
    try:
        precheck.check_stage(stage, root, layers=layers, unpacked_bytes=unpacked_bytes)
    except precheck.TooMany as error:
        return {"problem": {"slug": "limit-exceeded", "detail": str(error)}}
    except precheck.Refused as error:
        return {"problem": {"slug": "stage-refused", "detail": str(error)}}
    found = {os.path.abspath(path) for path in all_files_of(os.path.join(root, stage))}
    return {"files": sorted(os.path.relpath(path, root) for path in found)}


def main() -> None:
    confine.die_with_parent()
    root, stage, layers, unpacked_bytes = sys.argv[1:]
    answer = json.dumps(_look(root, stage, int(layers), int(unpacked_bytes)))
    print(answer, flush=True)  # libraries print too; the last line is ours


if __name__ == "__main__":
    main()
