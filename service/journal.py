"""What the service tells its operator: a line for each request, and every other complaint once a second at most."""

from __future__ import annotations

import json
import logging
import re
import secrets
import sys
import time
from datetime import UTC, datetime
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send

log = logging.getLogger("refract.requests")
KINDS = ("auto", "text", "json")
_IDENTIFIER = re.compile(r"[A-Za-z0-9._:+/=-]{1,128}")
_JOB = re.compile(rb"/v1/jobs/([0-9a-f]{64})")
_SECOND = 1.0
_REMEMBERED = 1000


def request_id(given: str | None) -> str:
    """The client's own, if it is one that can stand in a header and a log; else a new one."""
    return given if given and _IDENTIFIER.fullmatch(given) else secrets.token_hex(8)


class Journal:
    """ASGI middleware: one line in the log for every answer, and for every client that left before it."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        started = time.monotonic()
        status, size, headers = 0, 0, dict[bytes, bytes]()

        async def say(message: Message) -> None:
            nonlocal status, size, headers
            if message["type"] == "http.response.start":
                status, headers = message["status"], {name.lower(): value for name, value in message["headers"]}
            size += len(message.get("body", b""))
            await send(message)

        try:
            await self.app(scope, receive, say)
        finally:
            job = _JOB.search(headers.get(b"content-location", b"") + headers.get(b"location", b""))
            found = {
                "request_id": headers.get(b"x-request-id", b"").decode("latin-1"),
                "method": scope["method"], "path": scope["path"], "status": status or None,
                "seconds": round(time.monotonic() - started, 4), "bytes": size,
                "client": (scope.get("client") or ("",))[0],
            }  # fmt: skip
            if job:
                found["job"] = job[1].decode()
            log.info("%s %s %s", scope["method"], ascii(scope["path"])[1:-1], status or "-", extra={"request": found})


# --- the form of a line -----------------------------------------------------------------------------------------------


class JsonLines(logging.Formatter):
    """A JSON object for each line of the log."""

    def format(self, record: logging.LogRecord) -> str:
        when = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        found: dict[str, Any] = {"time": when, "level": record.levelname.lower(), "logger": record.name,
                                 "message": record.getMessage()}  # fmt: skip
        found |= getattr(record, "request", {})
        if record.exc_info:
            found["exception"] = self.formatException(record.exc_info)
        return json.dumps(found)


class TextLines(logging.Formatter):
    """The same for people."""

    def __init__(self) -> None:
        super().__init__("%(levelname)s %(name)s: %(message)s")

    def format(self, record: logging.LogRecord) -> str:
        said = super().format(record)
        if request := getattr(record, "request", None):
            said += f" in {request['seconds']} s, {request['request_id']}"
        return said


class Seldom(logging.Filter):
    """Lets the same complaint through once a second, and then tells how often it came. Requests are no complaints."""

    def __init__(self) -> None:
        super().__init__()
        self._last: dict[tuple[str, str], tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        if hasattr(record, "request"):
            return True
        key = (record.name, record.getMessage())
        last, held = self._last.get(key, (0.0, 0))
        if last and record.created - last < _SECOND:
            self._last[key] = (last, held + 1)
            return False
        if held:
            record.msg, record.args = f"{key[1]} ({held} more like it)", None
        if len(self._last) >= _REMEMBERED:
            self._last = {old: (at, n) for old, (at, n) in self._last.items() if record.created - at < _SECOND}
        self._last[key] = (record.created, 0)
        return True


def listen(kind: str) -> None:
    """Send the log to stderr.

    Args:
        kind: one of `KINDS`; `auto` is text for a terminal, else JSON.
    """
    handler = logging.StreamHandler()
    plain = kind == "text" or (kind == "auto" and sys.stderr.isatty())
    handler.setFormatter(TextLines() if plain else JsonLines())
    handler.addFilter(Seldom())
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    for noisy in ("uvicorn", "uvicorn.error"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
