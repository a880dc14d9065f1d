"""What USD says while it works, heard instead of printed on stderr."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pxr import UsdUtils


@contextmanager
def captured() -> Iterator[list[str]]:
    """Takes USD's warnings away from stderr; they are in the list once the block is left."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    heard: list[str] = []
    try:
        yield heard
    finally:
        heard.extend(words_of(diagnostic) for diagnostic in delegate.TakeUncoalescedDiagnostics())


def words_of(diagnostic: Any) -> str:
    """A warning or error in one line. USD quotes files, and those may hold bytes that are no text."""
    try:
        return " ".join(str(diagnostic.commentary).split())
    except UnicodeDecodeError:
        return "USD's own words quote bytes of the file that are not text"
