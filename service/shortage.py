"""What an error of the operating system means to a client: something is full, or used up for a moment."""

from __future__ import annotations

import errno
from collections.abc import Mapping

from .problems import Problem

_FULL = Problem("no-space", "there is no room left for the files of this job", headers={"Retry-After": "10"})
_SHORT = Problem("unavailable", "the machine is short of means for a moment", headers={"Retry-After": "5"})
_OF_SERVER = {errno.ENOSPC: _FULL, errno.EDQUOT: _FULL} | dict.fromkeys(
    (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOBUFS, errno.EAGAIN), _SHORT
)
_OF_WORKER = {
    errno.ENOSPC: _FULL, errno.EDQUOT: _FULL,
    errno.EFBIG: Problem("limit-exceeded", "a result would be larger than this service allows"),
    errno.EMFILE: Problem("limit-exceeded", "the job opened more files at once than this service allows"),
    errno.ENOMEM: Problem("memory-limit", "the job ran out of memory"),
}  # fmt: skip


def problem_of(error: BaseException) -> Problem | None:
    """The shortage of the service behind an error, or behind what it was raised from; None where there is none."""
    return _behind(error, _OF_SERVER)


def problem_of_job(error: BaseException) -> Problem | None:
    """The same inside a worker, where most means are limited for the job alone."""
    return _behind(error, _OF_WORKER)


def _behind(error: BaseException | None, known: Mapping[int, Problem]) -> Problem | None:
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        if isinstance(error, OSError) and error.errno is not None and error.errno in known:
            kind = known[error.errno]
            return Problem(kind.slug, kind.detail, headers=dict(kind.headers))
        error = error.__cause__ or error.__context__
    return None
