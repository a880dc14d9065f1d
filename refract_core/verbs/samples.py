"""The stages that come with the package, each with one idea: what they are, where they are, and copies of them."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import NamedTuple

from ..errors import StageError, UsageError
from ..files import write_whole

_PACKAGE = Path(__file__).parents[1]
_INSIDE, _BESIDE = _PACKAGE / "usd_samples" / "good", _PACKAGE.parent / "usd_samples" / "good"
FOLDER = _BESIDE if _BESIDE.is_dir() and not _INSIDE.is_dir() else _INSIDE
"""Inside the package, or in a checkout beside it."""


class Sample(NamedTuple):
    """One stage."""

    name: str
    path: str
    text: str
    """What to look at, as the stage itself says it."""


def names() -> list[str]:
    """What samples there are.

    Raises:
        StageError: the package was installed without them.
    """
    found = sorted(path.stem for path in FOLDER.glob("*.usda"))
    if not found:
        raise StageError(f"{FOLDER}: the samples are not there; install the package anew")
    return found


def sample(name: str) -> str:
    """Path of a sample's stage, such as `rc.load_stage(rc.sample("marble"))`. It is not to be changed.

    Raises:
        UsageError: there is no sample of this name.
    """
    known = names()
    if name not in known:
        near = get_close_matches(name, known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"choose from {', '.join(known)}"
        raise UsageError(f"{name}: there is no such sample; {hint}")
    return str(FOLDER / f"{name}.usda")


def described(chosen: Sequence[str] = ()) -> list[Sample]:
    """Some samples, or all, with what they say of themselves. Raises UsageError."""
    from ..usd.layers.assets import documentation

    paths = {name: sample(name) for name in chosen or names()}
    return [Sample(name, path, documentation(path)) for name, path in paths.items()]


def copy_samples(chosen: Sequence[str], to: str, *, overwrite: bool = False) -> list[str]:
    """Copy samples, and all that they refer to, into a folder, which is made where it is not there.

    Args:
        chosen: names; () means all.
        overwrite: files that are there and differ are replaced.

    Returns:
        Paths of the stages, in the folder.

    Raises:
        UsageError: an unknown name, or a file is there that differs; nothing has been written then.
        StageError: something cannot be written.
    """
    from ..usd.layers.assets import files_of

    stages = [sample(name) for name in chosen or names()]
    wanted = {file: Path(to, os.path.relpath(file, FOLDER)) for stage in stages for file in files_of(stage)}
    _check(wanted.items(), to, overwrite)
    for file, target in wanted.items():
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            text = f"{target.parent}: cannot be made: {error.strerror}; choose another place"
            raise StageError(text) from error
        if not _same(file, target):
            write_whole(str(target), Path(file).read_bytes(), StageError)
    return [str(wanted[stage]) for stage in stages]


def _check(wanted: Iterable[tuple[str, Path]], to: str, overwrite: bool) -> None:
    if os.path.exists(to) and not os.path.isdir(to):
        raise UsageError(f"--to {to}: is a file; name a folder")
    for file, target in wanted:
        if target.is_dir():
            raise UsageError(f"{target}: is a folder where a file is to go; choose another folder with --to")
        if not overwrite and target.exists() and not _same(file, target):
            raise UsageError(f"{target}: exists already, and differs; choose another folder, or add --overwrite")


def _same(file: str, target: Path) -> bool:
    return target.is_file() and target.read_bytes() == Path(file).read_bytes()
