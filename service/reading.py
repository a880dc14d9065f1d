"""The limit of time for checking, opening and reading a stage, which is work of USD's own that nothing interrupts.

The kernel ends the process by SIGPROF, whose exit code tells this end from others; the server makes a problem of it.
"""

from __future__ import annotations

import signal

TOO_LONG = -signal.SIGPROF
"""Exit code of a worker that took too long."""


def begins(seconds: int) -> None:
    """From now on, so much processor time of all threads together."""
    signal.signal(signal.SIGPROF, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_PROF, seconds)


def has_ended() -> None:
    """The stage is read; what comes is the job's own work."""
    signal.setitimer(signal.ITIMER_PROF, 0)
