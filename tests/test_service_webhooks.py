"""Webhooks: signed, to public addresses alone, tried again, and never followed elsewhere."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from service_server import BALL, InProcess, upload

from service.app import Settings, create_app
from service.problems import Problem
from service.signing import is_from
from service.store import Record
from service.webhooks import Webhooks, is_public, target_of

KEY = "a-key-of-the-tests"


@pytest.mark.parametrize("address", [
    "127.0.0.1", "127.8.9.1", "0.0.0.0", "10.1.2.3", "172.16.0.1", "172.31.255.255", "192.168.1.1", "169.254.169.254",
    "100.64.0.1", "192.0.2.1", "198.18.0.1", "224.0.0.1", "240.0.0.1", "255.255.255.255", "::", "::1", "fe80::1",
    "fe80::1%eth0", "fc00::1", "fd12::1", "fec0::1", "ff02::1", "::ffff:127.0.0.1", "::ffff:10.0.0.1",
    "64:ff9b::7f00:1", "64:ff9b:1::1", "2002:7f00:1::", "2002:a00:1::1", "2001:0:1::1", "2001:db8::1", "no address", "",
])  # fmt: skip
def test_what_is_not_public_is_not_spoken_to(address: str) -> None:
    assert not is_public(address)


@pytest.mark.parametrize("address", ["93.184.215.14", "8.8.8.8", "2606:2800:21f:cb07::1", "::ffff:8.8.8.8"])
def test_what_is_public_is(address: str) -> None:
    assert is_public(address)


@pytest.mark.parametrize("url", [
    "", "example.com", "ftp://example.com", "file:///etc/passwd", "http://", "http://user:word@example.com",
    "http://user@example.com", "http://exa mple.com", "http://example.com/\r\nX: 1", "http://example.com:0/",
    "http://example.com:99999/", "http://[::1", "http://exämple.com", "http://example.com\\@127.0.0.1/", "gopher://x",
])  # fmt: skip
def test_what_is_no_address_of_a_webhook_is_refused(url: str) -> None:
    with pytest.raises(Problem) as caught:
        target_of(url)
    assert caught.value.errors[0]["pointer"] == "/webhook"


def test_an_address_is_taken_apart() -> None:
    assert target_of("https://shop.example/a?b=c#d") == (True, "shop.example", 443, "/a?b=c")
    assert target_of("http://[2606:2800::1]:8080") == (False, "2606:2800::1", 8080, "/")


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "[::1]", "2130706433", "0x7f.1", "127.1", "0", "10.0.0.1",
                                  "169.254.169.254", "[::ffff:127.0.0.1]", "nothing.invalid"])  # fmt: skip
def test_a_request_with_a_webhook_to_a_neighbour_is_refused(tmp_path: Path, host: str) -> None:
    client = InProcess(create_app(Settings(data=str(tmp_path / "data"), key=KEY)))
    settings = json.dumps({"webhook": f"http://{host}/x"})
    answer = client.post("/v1/render", files=upload(BALL), data={"settings": settings},
                         headers={"Prefer": "respond-async"})  # fmt: skip
    assert answer.status_code == 422, host
    assert [one["pointer"] for one in answer.json()["errors"]] == ["/webhook"]
    assert not list((tmp_path / "data" / "jobs").iterdir())


def test_a_service_without_a_key_sends_nothing(tmp_path: Path) -> None:
    client = InProcess(create_app(Settings(data=str(tmp_path / "data"))))
    settings = json.dumps({"webhook": "https://example.com/x"})
    answer = client.post("/v1/inspect", files=upload(BALL), data={"settings": settings})
    assert "no key" in answer.json()["detail"]


# --- delivery, to a listener of this machine


class Listener:
    """Answers with one status after the other, and keeps what it was sent."""

    def __init__(self, *statuses: int | bytes) -> None:
        self.statuses = list(statuses)
        self.heard: list[tuple[dict[str, str], bytes]] = []
        self.connections = 0
        self.port = 0
        self.tasks: list[asyncio.Task[Any]] = []

    async def __call__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        task = asyncio.current_task()
        assert task is not None
        self.tasks.append(task)
        try:
            await self._answer(reader, writer)
        finally:
            writer.close()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        lines = (await reader.readuntil(b"\r\n\r\n")).decode().split("\r\n")
        headers = {name.lower(): value for name, _, value in (line.partition(": ") for line in lines[1:] if line)}
        self.heard.append(({**headers, "request": lines[0]}, await reader.readexactly(int(headers["content-length"]))))
        status = self.statuses.pop(0) if self.statuses else 200
        if status == 0:  # no answer, until the other side goes
            await reader.read()
            return
        told = status if isinstance(status, bytes) else f"HTTP/1.1 {status} Word\r\n".encode()
        writer.write(told + f"Location: http://127.0.0.1:{self.port}/elsewhere\r\n\r\n".encode())
        await writer.drain()


class Ended:
    async def ended(self, record: Record) -> None:
        return


def delivered(listener: Listener, resolve: Any = None, allowed: Callable[[str], bool] | None = None,
              count: int = 1, seconds: float = 5.0) -> None:  # fmt: skip
    """Send word of a job, and wait until that has come to its end."""

    async def here(_host: str, _port: int) -> list[str]:
        return ["127.0.0.1"]

    async def work() -> None:
        server = await asyncio.start_server(listener, "127.0.0.1", 0)
        listener.port = server.sockets[0].getsockname()[1]
        hooks = Webhooks(KEY, 10, resolve=resolve or here, allowed=allowed or (lambda _address: True),
                         waits=(0.0, 0.0, 0.0), seconds=seconds)  # fmt: skip
        record = Record("a" * 64, "render", {"format": "png"}, "stage.usda", True, status="done")
        for _ in range(count):
            hooks.follow(Ended(), record, f"http://shop.example:{listener.port}/hook?x=1")
        await asyncio.gather(*hooks._tasks.values())
        server.close()
        await asyncio.gather(*listener.tasks)

    asyncio.run(work())


def test_a_webhook_is_signed_and_tells_the_job() -> None:
    listener = Listener(204)
    delivered(listener, count=3)
    ((headers, body),) = listener.heard  # once, however often it was asked for
    assert headers["request"] == "POST /hook?x=1 HTTP/1.1"
    assert headers["host"] == f"shop.example:{listener.port}"
    assert headers["refract-event"] == "done"
    assert json.loads(body)["id"] == "a" * 64
    stamp, signature = headers["refract-timestamp"], headers["refract-signature"]
    now = time.time()
    assert is_from(KEY, stamp, signature, body, now=now)
    assert not is_from(KEY, stamp, signature, body + b" ", now=now)
    assert not is_from(KEY, str(int(stamp) + 1), signature, body, now=now)
    assert not is_from("another-key-of-the-tests", stamp, signature, body, now=now)
    assert not is_from(KEY, stamp, signature, body, now=now + 301.0)  # sent again by somebody who heard it


@pytest.mark.parametrize(("statuses", "attempts"), [
    ((200,), 1), ((500, 503, 200), 3), ((429, 200), 2), ((500, 500, 500, 500, 500), 4), ((404,), 1), ((302,), 1),
    ((307,), 1), ((b"nonsense\r\n", 200), 2), ((b"x" * 9000, 200), 2),
])  # fmt: skip
def test_attempts_are_bounded_and_no_redirect_is_followed(statuses: tuple[int | bytes, ...], attempts: int) -> None:
    listener = Listener(*statuses)
    delivered(listener)
    assert len(listener.heard) == attempts
    assert not any("elsewhere" in headers["request"] for headers, _ in listener.heard)


def test_a_listener_that_does_not_answer_is_left() -> None:
    listener = Listener(0, 200)
    delivered(listener, seconds=0.3)
    assert listener.connections == 2


def test_a_name_that_turns_to_a_neighbour_is_not_followed() -> None:
    answers = iter([["203.0.113.5"], ["127.0.0.1"], ["8.8.8.8", "127.0.0.1"]])

    async def turning(_host: str, _port: int) -> list[str]:
        return next(answers)

    async def work() -> None:
        hooks = Webhooks(KEY, 10, resolve=turning, allowed=lambda address: not address.startswith("127."))
        await hooks.check("http://shop.example/")  # public when it is looked at
        with pytest.raises(Problem):
            await hooks.check("http://shop.example/")
        with pytest.raises(Problem):  # one of several is enough
            await hooks.check("http://shop.example/")

    asyncio.run(work())
    listener = Listener(200)

    async def neighbour(_host: str, _port: int) -> list[str]:
        return ["127.0.0.1"]

    delivered(listener, resolve=neighbour, allowed=is_public)
    assert listener.connections == 0
