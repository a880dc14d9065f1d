"""Around the app: who may come in, what every answer carries, and how an early refusal reaches the client."""

from __future__ import annotations

import asyncio
import hmac
import secrets
import time
from collections.abc import Sequence
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from .metrics import Metrics
from .problems import Problem, respond

_LINGER = 2.0
"""[s] A client that is still sending when it is refused would lose the answer if the connection closed at once."""
_POLICY = "default-src 'self'; img-src 'self' blob: data:; object-src 'none'; base-uri 'none'; frame-ancestors 'none'"


class Edge:
    """ASGI middleware."""

    def __init__(self, app: ASGIApp, *, tokens: Sequence[str], metrics: Metrics) -> None:
        self.app, self.metrics = app, metrics
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

        async def hear() -> Message:
            nonlocal unread
            message = await receive()
            if not message.get("more_body"):
                unread = False
            return message

        async def say(message: Message) -> None:
            if message["type"] == "http.response.start":
                route = getattr(scope.get("route"), "path", "none")
                self.metrics.requests.labels(route, str(message["status"])).inc()
                message["headers"] = [*message["headers"], (b"x-request-id", identifier.encode()),
                                      (b"x-content-type-options", b"nosniff"), (b"referrer-policy", b"no-referrer"),
                                      (b"content-security-policy", _POLICY.encode())]  # fmt: skip
                if unread:
                    message["headers"].append((b"connection", b"close"))
            last = message["type"] == "http.response.body" and not message.get("more_body")
            if last and unread and not expects:
                await send({**message, "more_body": True})
                await _drain(hear)
                message = {"type": "http.response.body", "body": b"", "more_body": False}
            await send(message)

        problem = self._refusal(scope, headers)
        await (respond(problem) if problem else self.app)(scope, hear, say)

    def _refusal(self, scope: Scope, headers: Headers) -> Problem | None:
        path = scope["path"]
        if self.tokens and (path == "/metrics" or path.startswith("/v1/")):
            scheme, _, given = headers.get("authorization", "").partition(" ")
            matches = [hmac.compare_digest(given.strip().encode(), token) for token in self.tokens]
            if scheme.lower() != "bearer" or not any(matches):
                return Problem("unauthorized", "this service asks for a bearer token")
        origin = headers.get("origin")
        if scope["method"] not in ("GET", "HEAD", "OPTIONS") and origin and not _same_host(origin, headers):
            return Problem("cross-origin", "a page of another site may not ask for work here")
        return None


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
