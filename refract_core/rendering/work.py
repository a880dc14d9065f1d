"""How a picture's work gets done: items on an executor, with progress and cancel; a picture cut into tiles."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import Any, NamedTuple

from ..errors import Cancelled
from ..view.camera import Tile

Progress = Callable[[float, str], None]
Cancel = Callable[[], bool]


class Work(NamedTuple):
    """How tiles get done, and who listens."""

    executor: Executor
    progress: Progress
    cancel: Cancel

    def run(
        self, function: Callable[[Any], Any], items: Sequence[Any], told: Callable[[float], None] | None = None
    ) -> list[Any]:
        """Map in order; stop early and raise Cancelled when asked to. `told`: hears now and then what share is done."""
        if self.cancel():
            raise Cancelled("cancelled; nothing was written")
        futures = [self.executor.submit(function, item) for item in items]
        pending = set(futures)
        try:
            while pending:
                _, pending = wait(pending, timeout=0.2)
                if told:
                    told(1.0 - len(pending) / len(futures))
                if self.cancel():
                    raise Cancelled("cancelled; nothing was written")
        except BaseException:
            for future in pending:
                future.cancel()
            wait(pending)
            raise
        return [future.result() for future in futures]


@contextmanager
def working(
    executor: Executor | None, jobs: int, progress: Progress | None, cancel: Cancel | None
) -> Iterator[Work]:
    """Work on the executor given, which must share this process's memory, or on `jobs` threads (0: all cores)."""
    progress, cancel = progress or (lambda _share, _stage: None), cancel or (lambda: False)
    if executor is not None:
        yield Work(executor, progress, cancel)
        return
    with ThreadPoolExecutor(jobs or os.cpu_count() or 1) as threads:
        yield Work(threads, progress, cancel)


def tiles_of(width: int, height: int, side: int) -> list[Tile]:
    """Squares that cover the image; their sides are multiples of 8, so that cells never depend on them."""
    side = (side + 7) // 8 * 8
    return [
        (x, y, min(x + side, (width + 7) // 8 * 8), min(y + side, (height + 7) // 8 * 8))
        for y in range(0, height, side)
        for x in range(0, width, side)
    ]
