"""What the machine lacks for a while costs no more than that while: descriptors, room on the disk, workers."""

from __future__ import annotations

import asyncio
import errno
import json
import os
import re
import resource
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import httpx
import pytest
from service_server import BALL, PATIENCE, ROOT, SMALL, InProcess, Server, running, until, upload

from refract_core.errors import UsageError
from service.app import Settings, create_app
from service.gate import Gate, fitting
from service.jobs import Jobs
from service.limits import Limits
from service.metrics import Metrics
from service.pool import Nursery, Worker
from service.store import Store

pytestmark = pytest.mark.slow
SOON = 5.0
"""[s] After the end of a shortage, the service is as before."""


# --- slots


class Fails(Nursery):
    """A source whose workers cannot be made, for a while."""

    def __init__(self, errors: list[BaseException]) -> None:
        super().__init__()
        self.errors, self.asked = errors, 0

    def start(self) -> None:
        self.ready.set()

    async def fork(self) -> Any:
        self.asked += 1
        if self.errors:
            raise self.errors.pop()
        return Idle()

    async def kill(self, worker: Worker) -> None:
        pass


class Idle:
    """A worker that waits."""

    lost = False

    def __init__(self) -> None:
        self.code: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self.closed = False

    async def give(self, job: dict[str, Any]) -> None:
        pass

    async def hear(self) -> dict[str, Any] | None:
        return None

    def close(self) -> None:
        self.closed = True


def jobs_of(folder: Path, source: Nursery, workers: int = 2) -> Jobs:
    return Jobs(Store(folder), Limits(drain_seconds=1), Metrics(), source, workers=workers, queue=4, stage_root=None)


@pytest.mark.parametrize(
    "error", [OSError(errno.EMFILE, "Too many open files"), RuntimeError("whatever"), asyncio.CancelledError()]
)
def test_a_slot_survives_what_happens_in_it(tmp_path: Path, error: BaseException) -> None:
    async def work() -> None:
        source = Fails([error] * 6)
        jobs = jobs_of(tmp_path, source)
        jobs.start()
        async with asyncio.timeout(PATIENCE):
            while jobs.slots.live:
                await asyncio.sleep(0.01)
            assert sample(jobs.metrics, "refract_slots", state="failing") == 2.0
            while source.errors or jobs.slots.live < 2:
                await asyncio.sleep(0.01)
        assert sample(jobs.metrics, "refract_slot_failures_total") == 6.0
        assert sample(jobs.metrics, "refract_slots", state="live") == 2.0
        await jobs.stop()

    asyncio.run(work())


def test_no_worker_is_left_over_where_no_folder_can_be_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def work() -> None:
        source = Fails([])
        jobs = jobs_of(tmp_path, source, workers=1)
        made: list[Idle] = []

        async def fork() -> Any:
            made.append(Idle())
            return made[-1]

        monkeypatch.setattr(source, "fork", fork)
        new_work = jobs.store.new_work

        def full() -> Path:
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(jobs.store, "new_work", full)
        jobs.start()
        async with asyncio.timeout(PATIENCE):
            while len(made) < 3:
                await asyncio.sleep(0.01)
            assert made[0].closed
            assert jobs.slots.live == 0
            monkeypatch.setattr(jobs.store, "new_work", new_work)
            while not jobs.slots.live:
                await asyncio.sleep(0.01)
        await jobs.stop()

    asyncio.run(work())


def sample(metrics: Metrics, name: str, **labels: str) -> float:
    value = metrics.registry.get_sample_value(name, labels)
    assert value is not None
    return value


def test_a_service_without_a_slot_is_not_ready(tmp_path: Path) -> None:
    app = create_app(Settings(data=str(tmp_path / "data"), workers=2))
    client, jobs = InProcess(app), app.state.jobs
    jobs.source.ready.set()
    assert client.get("/readyz").json()["slots"] == {"live": 2, "of": 2}
    jobs.slots.failing.add(0)
    assert client.get("/readyz").json()["slots"] == {"live": 1, "of": 2}
    jobs.slots.failing.add(1)
    answer = client.get("/readyz")
    assert (answer.status_code, answer.json()["type"]) == (503, "/problems/unavailable")
    assert answer.headers["retry-after"]


# --- connections


def few_files(count: int) -> list[str]:
    """Words that give a service so many descriptors, and no way to more."""
    change = "import os, resource, sys; resource.setrlimit(resource.RLIMIT_NOFILE, (int(sys.argv[1]),) * 2); "
    return [sys.executable, "-c", change + "os.execvp(sys.argv[2], sys.argv[2:])", str(count)]


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A service with the limits it has by itself, and the descriptors that most systems give."""
    with running(tmp_path_factory.mktemp("short") / "data", "--workers", "2", within=few_files(1024)) as server:
        yield server


@contextmanager
def half_sent(server: Server, count: int) -> Iterator[list[socket.socket]]:
    """Connections with a head that does not end."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, count + 500) if hard > 0 else count + 500, hard))
    with ExitStack() as stack:
        opened = []
        for _ in range(count):
            connection = stack.enter_context(server.connect())
            with suppress(OSError):
                connection.sendall(b"GET /livez HTTP/1.1\r\nHost: x\r\nX-Slow: ")
            opened.append(connection)
        yield opened
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def draws(server: Server, exposure: float) -> bool:
    """Whether a picture comes that nobody has asked for before."""
    settings = json.dumps({**SMALL, "exposure": exposure})
    with server.client() as client, suppress(httpx.TransportError):
        return client.post("/v1/render", files=upload(BALL), data={"settings": settings}).status_code == 200
    return False


def open_files(server: Server) -> int:
    return len(os.listdir(f"/proc/{server.process.pid}/fd"))


def test_half_sent_heads_keep_nobody_out(short: Server) -> None:
    assert draws(short, 0.0)
    before = open_files(short)
    with half_sent(short, 1100):
        until(lambda: draws(short, 0.1))  # while they are there
        assert open_files(short) < 900
    since = time.monotonic()
    until(lambda: draws(short, 0.2), SOON)
    with short.client() as client:
        assert client.get("/readyz").json()["slots"] == {"live": 2, "of": 2}
    assert time.monotonic() - since < SOON
    until(lambda: open_files(short) <= before + 2)
    assert short.metric("refract_slot_failures_total") == 0.0


def test_the_log_of_a_crowd_is_short(short: Server) -> None:
    start, began = short.log.stat().st_size, time.monotonic()
    with half_sent(short, 1100):
        pass
    seconds = time.monotonic() - began
    lines = [json.loads(line) for line in short.log.read_text()[start:].splitlines()]
    complaints = [line for line in lines if "request_id" not in line]
    assert len(complaints) <= 2 * (seconds + 2)
    assert any("one more is refused" in line["message"] for line in complaints)


def test_slow_heads_end(short: Server) -> None:
    """One byte now and then gives a head no more time than `header_seconds`."""
    with short.connect() as connection:
        connection.sendall(b"GET /livez HTTP/1.1\r\nHost: x\r\nX-Slow: ")
        began = time.monotonic()
        connection.settimeout(0.5)
        ended = False
        while not ended:
            assert time.monotonic() - began < PATIENCE
            with suppress(TimeoutError):
                try:
                    ended = connection.recv(100) == b""
                    connection.sendall(b"x")
                except (ConnectionError, BrokenPipeError):
                    ended = True


def test_who_finds_no_place_is_told_when_to_come_again(tmp_path: Path) -> None:
    with running(tmp_path / "data", "--workers", "1", "--limit", "connections=4") as server, ExitStack() as stack:
        head = b"POST /v1/render HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: 9\r\n\r\n{"
        for _ in range(4):  # requests under way, not heads: they keep their places
            stack.enter_context(server.connect()).sendall(head)
        time.sleep(1.5)
        with server.connect() as connection:
            said = b""
            while data := connection.recv(65536):
                said += data
        top, _, body = said.partition(b"\r\n\r\n")
        assert top.startswith(b"HTTP/1.1 503 ")
        assert re.search(rb"(?im)^retry-after: \d+\r?$", top)
        assert json.loads(body)["type"] == "/problems/unavailable"
        stack.close()
        until(lambda: draws(server, 0.0), SOON)


def test_connections_fit_into_the_descriptors(monkeypatch: pytest.MonkeyPatch) -> None:
    have = [(1024, 1024)]
    monkeypatch.setattr(resource, "getrlimit", lambda _what: have[0])
    monkeypatch.setattr(resource, "setrlimit", lambda _what, values: have.append(values))
    fewer = fitting(Limits(), 2)
    assert 100 < fewer.connections < 1024 // 3
    have[0] = (1024, 1_000_000)
    assert fitting(Limits(), 2) == Limits()
    assert have[-1][0] > 3 * Limits().connections  # it takes what it may have
    have[0] = (100, 100)
    with pytest.raises(UsageError, match="ulimit -n"):
        fitting(Limits(), 2)


def test_the_gate_lets_go_of_who_waits_longest() -> None:
    class One:
        left = False

        def leave(self) -> None:
            self.left = True

    async def work() -> None:
        now = [100.0]
        loop = asyncio.get_running_loop()
        loop.time = lambda: now[0]  # type: ignore[method-assign]
        gate = Gate(2, Metrics())
        first, second, third, fourth = One(), One(), One(), One()
        assert gate.enter(first)
        now[0] += 0.5
        assert gate.enter(second)
        assert not gate.enter(third)  # both are young
        now[0] += 0.6
        gate.works(first)
        assert not gate.enter(third)
        now[0] += 1.0
        assert gate.enter(third)
        assert (first.left, second.left) == (False, True)
        gate.gone(first)
        assert gate.enter(fourth)

    asyncio.run(work())
