"""How many connections there may be at once: fewer than there are file descriptors, and always one for the next.

A connection that is not in the middle of a request waits: for a head, or for the rest of one. When all places are
taken, the one that has waited longest gives its place up; only where none has waited for a moment is the new one told
503. So half-sent heads, however many, keep nobody out.
"""

from __future__ import annotations

import asyncio
import logging
import resource
from dataclasses import replace
from typing import Protocol

from refract_core.errors import UsageError

from .limits import Limits
from .metrics import Metrics

log = logging.getLogger("refract.service")
_YOUNG = 1.0
"""[s] An honest head arrives within it; no connection is closed for another before."""
_FILES_OF_ONE = 3
"""Descriptors of one connection: itself, and an upload on its way from one file to the next."""
_FILES_OF_WORKER = 4
_OWN_FILES = 64
_PARTING = 64
"""Connections beyond the limit that have been told 503, and get a moment to hear it; for one more the first ends."""
_LEAST = 8


class Connection(Protocol):
    """What the gate needs of a connection."""

    def leave(self) -> None:
        """Close at once: the place is for another."""


class Gate:
    """Counts connections in and out."""

    def __init__(self, most: int, metrics: Metrics) -> None:
        self.most, self.metrics = most, metrics
        self._inside: set[Connection] = set()
        self._parting: dict[Connection, None] = {}
        """In the order they came."""
        self._waiting: dict[Connection, float] = {}
        """Since when; the longest first."""

    def enter(self, connection: Connection) -> bool:
        """Take a place. False: there is none, and the connection is to be told so."""
        if len(self._inside) >= self.most and not self._make_room():
            self.metrics.refused.labels("full").inc()
            log.warning("%d connections are open, and one more is refused", self.most)
            if len(self._parting) >= _PARTING:
                first = next(iter(self._parting))
                self.gone(first)
                first.leave()
            self._parting[connection] = None
            return False
        self._inside.add(connection)
        self.metrics.connections.set(len(self._inside))
        self.waits(connection)
        return True

    def _make_room(self) -> bool:
        for connection, since in self._waiting.items():
            if asyncio.get_running_loop().time() - since < _YOUNG:
                break
            self.metrics.refused.labels("waited").inc()
            self.gone(connection)
            connection.leave()
            return True
        return False

    def waits(self, connection: Connection) -> None:
        """It is in the middle of no request."""
        if connection in self._inside and connection not in self._waiting:
            self._waiting[connection] = asyncio.get_running_loop().time()

    def works(self, connection: Connection) -> None:
        """Its request is being answered."""
        self._waiting.pop(connection, None)

    def gone(self, connection: Connection) -> None:
        self._waiting.pop(connection, None)
        self._inside.discard(connection)
        self._parting.pop(connection, None)
        self.metrics.connections.set(len(self._inside))


def fitting(limits: Limits, workers: int) -> Limits:
    """Limits with as many connections as this process has descriptors for; it takes as many as it may.

    Raises:
        UsageError: there are too few for a service.
    """
    others = _OWN_FILES + _PARTING + _FILES_OF_WORKER * workers
    wanted = others + _FILES_OF_ONE * limits.connections
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        soft = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return limits
    connections = (soft - others) // _FILES_OF_ONE
    if connections < _LEAST:
        needed = others + _FILES_OF_ONE * _LEAST
        raise UsageError(f"this process may open {soft} files; the service needs {needed} (ulimit -n, LimitNOFILE)")
    log.warning("this process may open %d files, which is enough for %d connections at once", soft, connections)
    return replace(limits, connections=connections)
