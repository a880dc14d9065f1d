"""uvicorn with our limits: heads that never end, signals, and a word when it is ready."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import sys
from dataclasses import replace
from http import HTTPStatus
from types import FrameType
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from refract_core.errors import UsageError

from . import confine
from .app import Settings, create_app
from .edge import GUARDS
from .gate import Gate, fitting
from .journal import listen
from .problems import Problem, of_status, respond

_AT_ONCE, _BACKLOG = 32, 1024
"""Connections that asyncio takes in before the gate sees the first of them, and those that the system keeps for it."""
log = logging.getLogger("refract.service")
_LINGER = 1.0
"""[s] What a client still sends after an error is read and thrown away for this long: if the connection closed at
once, its system would drop the answer."""


def serve(settings: Settings, host: str, port: int, log: str = "auto") -> None:
    """Run until SIGTERM or Ctrl-C; then refuse new work and let running jobs finish for a while.

    Args:
        log: one of `journal.KINDS`.

    Raises:
        UsageError: the address cannot be used.
    """
    listen(log)
    settings = replace(settings, host=host, limits=fitting(settings.limits, settings.workers))
    app = create_app(settings)
    gate = Gate(settings.limits.connections, app.state.metrics)
    config = uvicorn.Config(
        app, host=host, port=port, http=_patient(settings.limits.header_seconds, gate), ws="none", lifespan="on",
        timeout_keep_alive=15, timeout_graceful_shutdown=settings.limits.drain_seconds, server_header=False,
        log_config=None, access_log=False, backlog=_AT_ONCE, loop="asyncio",
        proxy_headers=False,  # `create_app` has those
    )  # fmt: skip
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # With the protocol named, asyncio switches Nagle's delay off; else each answer would take 40 ms more.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(_BACKLOG)  # before the address is told: who comes at once waits, and is not refused
    except (OSError, OverflowError) as error:
        listener.close()
        raise UsageError(f"--host {host} --port {port}: cannot be used: {error}") from error
    shown = f"[{host}]" if ":" in host else host
    lacking = {} if settings.executor else confine.missing(confine.available())
    for text in lacking.values():
        logging.getLogger("refract.service").warning("%s", text)
    without = f" (workers are confined without {', '.join(lacking)})" if lacking else ""
    print(f"refract serves http://{shown}:{listener.getsockname()[1]}/{without}", flush=True)
    _Server(config).run(sockets=[listener])


class _Server(uvicorn.Server):
    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        for listener in sockets or ():
            listener.listen(_BACKLOG)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        self.config.app.state.jobs.draining = True  # type: ignore[union-attr]
        super().handle_exit(sig, frame)


def _patient(seconds: float, gate: Gate) -> type[H11Protocol]:
    """uvicorn's own protocol, which ends a connection that does not get to the end of a head in time or finds no place,
    and answers what is not HTTP with a problem document too."""

    class Patient(H11Protocol):
        _giving_up: asyncio.TimerHandle | None = None
        _refused = False

        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            if gate.enter(self):
                self._watch()
            else:
                text = "too many connections are open"
                self._refuse(Problem("unavailable", text, headers={"Retry-After": "2"}))

        def leave(self) -> None:
            self._refused = True
            self.transport.abort()

        def data_received(self, data: bytes) -> None:
            if not self._refused:
                super().data_received(data)
                self._watch()

        def send_400_response(self, msg: str) -> None:
            """uvicorn calls this where h11 cannot read on: in a head, or in the chunks of a body."""
            status = getattr(sys.exception(), "error_status_hint", 400)
            self._refuse(of_status(status) if status != 400 else Problem("bad-request", "this is no HTTP/1.1"))

        def _refuse(self, problem: Problem) -> None:
            """Answer without having read a request, and close."""
            self._refused = True
            answer = respond(problem)
            begun = self.conn.our_state not in (h11.IDLE, h11.SEND_RESPONSE)
            if self.cycle is not None and not self.cycle.response_complete:  # its body ends here
                self.cycle.disconnected = True
                self.cycle.message_event.set()
            if begun:
                self.transport.close()
                return
            headers = [*answer.raw_headers, *GUARDS, (b"cross-origin-resource-policy", b"same-origin"),
                       (b"connection", b"close")]  # fmt: skip
            reason = HTTPStatus(answer.status_code).phrase.encode()
            with contextlib.suppress(h11.LocalProtocolError):  # the answer to a HEAD has no body
                self._write(h11.Response(status_code=answer.status_code, headers=headers, reason=reason))
                self._write(h11.Data(data=bytes(answer.body)))
                self._write(h11.EndOfMessage())
            if self.transport.can_write_eof():
                self.transport.write_eof()
            self.loop.call_later(_LINGER, self.transport.close)

        def _write(self, event: h11.Event) -> None:
            self.transport.write(self.conn.send(event) or b"")

        def on_response_complete(self) -> None:
            super().on_response_complete()
            if not self._busy():
                gate.waits(self)

        def _busy(self) -> bool:
            return self.cycle is not None and not self.cycle.response_complete

        def _watch(self) -> None:
            busy = self._busy()
            if busy:
                gate.works(self)
            if busy and self._giving_up:
                self._giving_up.cancel()
                self._giving_up = None
            elif not busy and not self._giving_up:
                gate.waits(self)
                self._giving_up = self.loop.call_later(seconds, self._give_up)

        def _give_up(self) -> None:
            self._giving_up = None
            if (self.cycle is None or self.cycle.response_complete) and not self.transport.is_closing():
                self.transport.close()

        def connection_lost(self, exc: Exception | None) -> None:
            if self._giving_up:
                self._giving_up.cancel()
            gate.gone(self)
            super().connection_lost(exc)

    return Patient
