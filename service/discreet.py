"""Texts for strangers name no folder of this machine."""

from __future__ import annotations

import os
import re
import sys
import tempfile
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import refract_core
from refract_core.kernels.compile import cache_root


@cache
def own_folders() -> frozenset[str]:
    """Of the program itself, and of who runs it."""
    found = [Path(refract_core.__file__).parent, Path(refract_core.__file__).parents[1], Path(__file__).parent,
             cache_root(), sys.prefix, sys.base_prefix, os.path.expanduser("~")]  # fmt: skip
    return frozenset(str(one) for one in found)


def own_places() -> list[str]:
    """Where this process works now. A worker's folder for scratch is in that of its job."""
    here, scratch = os.getcwd(), tempfile.gettempdir()
    return [here, os.path.dirname(here), scratch, os.path.dirname(scratch)]


def without_folders(text: str, folders: Iterable[str]) -> str:
    """A text with the names of files, but not of these folders.

    A folder right below / stays: its name may as well be a prim's, such as /root, and tells little.
    """
    named = {spelt for one in folders for spelt in (one.rstrip("/"), os.path.realpath(one)) if spelt.count("/") > 1}
    for folder in sorted(named, key=len, reverse=True):
        if folder in text:
            text = re.sub(rf"{re.escape(folder)}(/|(?![\w-]))", lambda found: "" if found[1] else "a folder", text)
    return text
