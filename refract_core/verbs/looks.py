"""Pictures on disk before they are finished: every few seconds, or when somebody asks; and a time by which to stop."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import RefractError, UsageError
from ..progress import Report

if TYPE_CHECKING:
    from ..images.frame import Frame
    from ..rendering.unfinished import Watch

SUFFIX = "_part"
"""What husk calls its snapshots."""
LONGEST = 1e7


def check_unfinished(time_limit: float, snapshot: float, elsewhere: bool) -> None:
    """Raises UsageError where a number of seconds cannot be, or pictures are drawn where nobody can look at them."""
    for flag, seconds in (("--time-limit", time_limit), ("--snapshot", snapshot)):
        if not 0.0 <= seconds <= LONGEST:
            raise UsageError(f"{flag} is {seconds}; it must be between 0 and {LONGEST:g} seconds")
        if seconds and elsewhere:
            raise UsageError(f"{flag} is for pictures that are drawn here; leave it out, or leave --executor out")


def part_path(path: str) -> str:
    """Where the unfinished picture of a file lies: `shot_part.exr` beside `shot.exr`."""
    stem, extension = os.path.splitext(path)
    return f"{stem}{SUFFIX}{extension}"


class Looks(NamedTuple):
    """How the pictures of an order are looked at while they are drawn."""

    time_limit: float
    """[s] for each; 0 is none"""
    every: float
    """[s] between two looks; 0 is none"""
    asked: Callable[[], bool] | None
    """somebody wants to see it now"""
    report: Report

    @contextmanager
    def at(self, path: str, saving: Mapping[str, Any]) -> Iterator[Callable[[], Watch] | None]:
        """What begins to watch a picture that goes to `path`. What was finished of it goes when it is there as a whole.

        Args:
            saving: arguments of `Frame.save`.
        """
        if not (self.time_limit or self.every or self.asked):
            yield None
            return
        from ..rendering.unfinished import Watch

        written: list[str] = []
        last = time.monotonic()

        def wanted() -> bool:
            now = self.asked is not None and self.asked()
            return now or bool(self.every and time.monotonic() - last >= self.every)

        def take(frame: Frame) -> None:
            nonlocal last
            try:
                frame.save(part_path(path), **saving)
                written.append(part_path(path))
            except RefractError as error:  # a look is no reason to lose the picture
                self.report.warning(part_path(path), f"what is finished so far was not written: {error}")
            last = time.monotonic()

        def begin() -> Watch:
            nonlocal last
            last = time.monotonic()
            return Watch(last + self.time_limit if self.time_limit else math.inf, wanted, take)

        yield begin
        for name in written[:1]:
            Path(name).unlink(missing_ok=True)
