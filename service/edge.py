"""Around the app: who may come in, what every answer carries, and how an early refusal reaches the client."""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Sequence

from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from .hosts import Door
from .journal import request_id
from .metrics import Metrics
from .problems import MEDIA_TYPE, Problem, of_status, respond
from .shares import Client, address_of
from .signing import expiry
from .tokens import SIGNABLE, Token, needed, token_in

_LINGER = 2.0
"""[s] A client that is still sending when it is refused would lose the answer if the connection closed at once."""
_RANGE = re.compile(rb"bytes=\s*(\d{0,18})-(\d{0,18})\s*", re.IGNORECASE)
_POLICY = "default-src 'self'; img-src 'self' blob: data:; object-src 'none'; base-uri 'none'; frame-ancestors 'none'"
GUARDS = ((b"x-content-type-options", b"nosniff"), (b"referrer-policy", b"no-referrer"),
          (b"content-security-policy", _POLICY.encode()))  # fmt: skip
"""Headers that every answer carries, beside what `Door.headers` says of other sites."""


class Edge:
    """ASGI middleware."""

    def __init__(
        self, app: ASGIApp, *, door: Door, tokens: Sequence[Token], metrics: Metrics, key: str = ""
    ) -> None:  # fmt: skip
        self.app, self.door, self.tokens, self.metrics, self.key = app, door, tokens, metrics, key

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        unread = headers.get("content-length", "0") != "0" or "transfer-encoding" in headers
        expects = headers.get("expect", "").lower() == "100-continue"
        identifier = request_id(headers.get("x-request-id"))
        state = scope.setdefault("state", {})
        state["request_id"] = identifier
        state["client"] = Client(address_of((scope.get("client") or ("",))[0]))
        inner, answered = _for_the_app(scope), False
        others = self.door.headers(scope["path"], headers.get("origin", ""))

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
                message["headers"] = [*message["headers"], (b"x-request-id", identifier.encode()), *GUARDS,
                                      *others]  # fmt: skip
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

        await (self._answer(scope, headers) or self.app)(inner, hear, say)

    def _answer(self, scope: Scope, headers: Headers) -> Response | None:
        """What is answered at the edge; None lets the request in."""
        problem = _misled(headers, self.door)
        if problem:
            return respond(problem)
        asked = headers.get("access-control-request-method")
        if welcome := self.door.preflight(scope["method"], headers.get("origin", ""), asked):
            return Response(status_code=204, headers=welcome)
        problem = self._refusal(scope, headers)
        return respond(problem) if problem else None

    def _refusal(self, scope: Scope, headers: Headers) -> Problem | None:
        wanted = needed(scope["method"], scope["path"])
        if self.tokens and wanted and not self._signed(scope):
            token = token_in(headers.get("authorization", ""), self.tokens)
            if token is None:
                return Problem("unauthorized", "this service asks for a bearer token")
            state = scope["state"]
            state["client"] = state["client"]._replace(owner=token.owner)
            if wanted not in token.scopes:
                lacks = f'Bearer error="insufficient_scope", scope="{wanted}"'
                return Problem("forbidden", f"the token has no scope {wanted}", headers={"WWW-Authenticate": lacks})
        origin = headers.get("origin")
        if scope["method"] not in ("GET", "HEAD", "OPTIONS") and origin and not self.door.lets_in(
            origin, headers.get("host", "")
        ):  # fmt: skip
            return Problem("cross-origin", "a page of another site may not ask for work here")
        return None

    def _signed(self, scope: Scope) -> bool:
        """An address that may be opened without a token."""
        raw, query = (scope.get(part, b"").decode("latin-1") for part in ("raw_path", "query_string"))
        reads = scope["method"] in ("GET", "HEAD") and scope["path"].startswith(SIGNABLE)
        return reads and expiry(self.key, raw, query, time.time()) is not None


def _misled(headers: Headers, door: Door) -> Problem | None:
    """What is wrong with a request whatever it asks for."""
    if "content-length" in headers and "transfer-encoding" in headers:
        # A proxy before us may have gone by the other one: what follows could be another client's (RFC 9112, 6.1).
        return Problem("bad-request", "Content-Length and Transfer-Encoding in one request; send one of them")
    if not door.answers_to(headers.get("host")):
        return Problem("misdirected", "this service does not go by the name in Host; see --allow-host")
    return None


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
