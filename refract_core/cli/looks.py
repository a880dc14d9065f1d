"""SIGUSR1: show what is finished so far."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def shown_on_signal() -> Iterator[Callable[[], bool] | None]:
    """Whether SIGUSR1 has come since the last question; None where this thread may not listen to signals."""
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "SIGUSR1"):
        yield None
        return
    came = threading.Event()

    def on_signal(_signal: int, _frame: FrameType | None) -> None:
        came.set()

    def asked() -> bool:
        if not came.is_set():
            return False
        came.clear()
        return True

    before = signal.signal(signal.SIGUSR1, on_signal)
    try:
        yield asked
    finally:
        signal.signal(signal.SIGUSR1, before)
