"""Files that appear whole or not at all, in places that were tried before the work."""

from __future__ import annotations

import os
import secrets
import shutil
import tempfile
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import RefractError, UsageError


def check_place(path: str, error: type[RefractError]) -> None:
    """Refuse a place where no file can be written.

    Raises:
        UsageError: the folder does not exist, or `path` is one. Nobody makes folders for a name that was misspelt.
        error: the folder cannot be written.
    """
    folder = os.path.dirname(path) or "."
    if os.path.isdir(path):
        raise UsageError(f"{path}: is a folder; name a file")
    if not os.path.isdir(folder):
        raise UsageError(f"{path}: the folder {folder} does not exist; make it first")
    try:  # permission bits do not tell everything (read-only mounts, quotas, network folders), so try
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as reason:
        raise error(f"{path}: the folder {folder} cannot be written: {reason.strerror}") from reason


@contextmanager
def replacing(path: str, error: type[RefractError]) -> Iterator[str]:
    """A name beside `path` that becomes `path` when the block ends well, and is removed when it does not.

    Raises:
        error: the file cannot be written.
    """
    folder, base = os.path.split(path)
    stem, extension = os.path.splitext(base)
    temporary = os.path.join(folder, f".{stem[:32]}.{secrets.token_hex(4)}{extension.lower()}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as reason:
        raise error(f"{path}: cannot be written: {reason.strerror or reason}; choose another place") from reason
    finally:
        Path(temporary).unlink(missing_ok=True)


def write_whole(path: str, data: bytes, error: type[RefractError]) -> None:
    """Write a file in one step: it appears whole, or not at all.

    Raises:
        error: the file cannot be written.
    """
    with replacing(path, error) as temporary:
        Path(temporary).write_bytes(data)


@contextmanager
def filling(folder: str, ours: Collection[str], error: type[RefractError]) -> Iterator[str]:
    """A new folder, whose files become those of `folder` when the block ends well.

    Where `folder` is not there yet it appears whole. Where it is, each file is replaced in one step, and those of
    `ours` that were not made anew are removed; other files stay.

    Args:
        ours: names of all files that may be made here.

    Raises:
        error: something cannot be written.
    """
    path = os.path.abspath(folder)
    above = path if os.path.isdir(path) else os.path.dirname(path)
    temporary = os.path.join(above, f".{os.path.basename(path)[:32]}.{secrets.token_hex(4)}")
    try:
        os.mkdir(temporary)
        yield temporary
        if os.path.isdir(path):
            made = set(os.listdir(temporary))
            for name in sorted(made):
                os.replace(os.path.join(temporary, name), os.path.join(path, name))
            for name in set(ours) - made:
                Path(path, name).unlink(missing_ok=True)
        else:
            os.rename(temporary, path)
    except OSError as reason:
        raise error(f"{folder}: cannot be written: {reason.strerror or reason}; choose another place") from reason
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def folder_beside(out: str, suffix: str) -> Iterator[str]:
    """Where files go that OUT refers to: `shot.suffix` beside `shot.usda`, for whoever writes to make; for a package,
    which takes them in, a folder that lasts as long as the block.
    """
    stem, extension = os.path.splitext(os.path.abspath(out))
    if extension.lower() != ".usdz":
        yield f"{stem}.{suffix}"
        return
    with tempfile.TemporaryDirectory(prefix="refract-") as folder:
        yield folder
