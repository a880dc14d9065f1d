"""What USD says while it works, heard instead of printed on stderr."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from pxr import Tf, UsdUtils

Found = TypeVar("Found")


@contextmanager
def captured() -> Iterator[list[str]]:
    """Takes USD's warnings away from stderr; they are in the list once the block is left."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    heard: list[str] = []
    try:
        yield heard
    finally:
        heard.extend(words_of(diagnostic) for diagnostic in delegate.TakeUncoalescedDiagnostics())


def opened(how: Callable[[], Found | None]) -> tuple[Found | None, str]:
    """What USD opens, and, where that is None, why in its own words."""
    found = None
    with captured() as heard:
        try:
            found = how()
        except Tf.ErrorException as error:
            heard.extend(words_of(part) for part in error.args)
    return found, heard[0] if heard else "USD gives no reason"


def words_of(diagnostic: Any) -> str:
    """A warning or error in one line. USD quotes files, and those may hold bytes that are no text."""
    try:
        return " ".join(str(diagnostic.commentary).split())
    except UnicodeDecodeError:
        return "USD's own words quote bytes of the file that are not text"
