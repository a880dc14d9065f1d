"""Around the app: who may come in, what every answer carries, and how an early refusal reaches the client."""

from __future__ import annotations

import asyncio
import hmac
import re
import secrets
import time
from collections.abc import Sequence
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from .metrics import Metrics
from .problems import MEDIA_TYPE, Problem, of_status, respond
from .signing import expiry

_LINGER = 2.0
"""[s] A client that is still sending when it is refused would lose the answer if the connection closed at once."""
_RANGE = re.compile(rb"bytes=\s*(\d{0,18})-(\d{0,18})\s*", re.IGNORECASE)
_POLICY = "default-src 'self'; img-src 'self' blob: data:; object-src 'none'; base-uri 'none'; frame-ancestors 'none'"
SIGNABLE = "/v1/thumbnails/"
"""Where the addresses begin that a signature opens."""
GUARDS = ((b"x-content-type-options", b"nosniff"), (b"referrer-policy", b"no-referrer"),
          (b"content-security-policy", _POLICY.encode()))  # fmt: skip
"""Headers that every answer carries."""


class Edge:
    """ASGI middleware."""

    def __init__(self, app: ASGIApp, *, tokens: Sequence[str], metrics: Metrics, key: str = "") -> None:
        self.app, self.metrics, self.key = app, metrics, key
        self.tokens = [token.encode() for token in tokens]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        unread = headers.get("content-length", "0") != "0" or "transfer-encoding" in headers
        expects = headers.get("expect", "").lower() == "100-continue"
        identifier = secrets.token_hex(8)
        scope.setdefault("state", {})["request_id"] = identifier
        inner, answered = _for_the_app(scope), False

        async def hear() -> Message:
            nonlocal unread
            if answered:
                return {"type": "http.disconnect"}
            message = await receive()
            if not message.get("more_body"):
                unread = False
            return message

        async def say(message: Message) -> None:
            nonlocal answered
            if answered:
                return
            if message["type"] == "http.response.start":
                message, body = _as_problem(message)
                route = getattr(inner.get("route"), "path", "none")
                self.metrics.requests.labels(route, str(message["status"])).inc()
                message["headers"] = [*message["headers"], (b"x-request-id", identifier.encode()), *GUARDS]
                if unread:
                    message["headers"].append((b"connection", b"close"))
                await send(message)
                if body is None and scope["method"] != "HEAD":
                    return
                message = {"type": "http.response.body", "body": b"" if scope["method"] == "HEAD" else body}
            answered = not message.get("more_body")
            if answered and unread and not expects:
                await send({**message, "more_body": True})
                await _drain(receive)
                message = {"type": "http.response.body", "body": b"", "more_body": False}
            await send(message)

        problem = self._refusal(scope, headers)
        await (respond(problem) if problem else self.app)(inner, hear, say)

    def _refusal(self, scope: Scope, headers: Headers) -> Problem | None:
        path = scope["path"]
        if self.tokens and guarded(path) and not self._signed(scope):
            scheme, _, given = headers.get("authorization", "").partition(" ")
            matches = [hmac.compare_digest(given.strip().encode(), token) for token in self.tokens]
            if scheme.lower() != "bearer" or not any(matches):
                return Problem("unauthorized", "this service asks for a bearer token")
        origin = headers.get("origin")
        if scope["method"] not in ("GET", "HEAD", "OPTIONS") and origin and not _same_host(origin, headers):
            return Problem("cross-origin", "a page of another site may not ask for work here")
        return None


    def _signed(self, scope: Scope) -> bool:
        """An address that may be opened without a token."""
        raw, query = (scope.get(part, b"").decode("latin-1") for part in ("raw_path", "query_string"))
        reads = scope["method"] in ("GET", "HEAD") and scope["path"].startswith(SIGNABLE)
        return reads and expiry(self.key, raw, query, time.time()) is not None


def guarded(path: str) -> bool:
    """Where a token is asked for, if there are any. The page and the documentation are for everybody."""
    return path == "/metrics" or path.startswith("/v1/")


def _for_the_app(scope: Scope) -> Scope:
    """HEAD is GET whose body is left out. Of ranges the app is given only those that are right: others count for
    nothing (RFC 9110, 14.2), and so do several at once."""
    head = scope["method"] == "HEAD"
    kept = [
        (name, value) for name, value in scope["headers"] if name != b"range" or not (head or _is_no_range(value))
    ]
    return {**scope, "method": "GET" if head else scope["method"], "headers": kept}


def _is_no_range(value: bytes) -> bool:
    found = _RANGE.fullmatch(value)
    if not found or found.groups() == (b"", b""):
        return True
    first, last = found.groups()
    return bool(first and last) and int(last) < int(first)


def _as_problem(message: Message) -> tuple[Message, bytes | None]:
    """The start of an answer; for an error that a library tells in its own way, that of a problem document instead,
    and the document."""
    headers = {name.lower(): value for name, value in message["headers"]}
    allowed = headers.get(b"allow", b"").split(b", ")
    if b"GET" in allowed and b"HEAD" not in allowed:
        message = {**message, "headers": [*((n, v) for n, v in message["headers"] if n.lower() != b"allow"),
                                          (b"allow", headers[b"allow"] + b", HEAD")]}  # fmt: skip
    if message["status"] < 400 or headers.get(b"content-type") == MEDIA_TYPE.encode():
        return message, None
    answer = respond(of_status(message["status"]))
    kept = [(name, headers[name]) for name in (b"allow", b"content-range") if name in headers]
    return {**message, "headers": [*answer.raw_headers, *kept]}, bytes(answer.body)


def _same_host(origin: str, headers: Headers) -> bool:
    try:
        return urlsplit(origin).netloc.lower() == headers.get("host", "").lower()
    except ValueError:
        return False


async def _drain(hear: Receive) -> None:
    """Throw the rest of a body away, for a moment."""
    until = time.monotonic() + _LINGER
    try:
        async with asyncio.timeout(_LINGER):
            while time.monotonic() < until:
                message = await hear()
                if message["type"] != "http.request" or not message.get("more_body"):
                    return
    except TimeoutError:
        return
