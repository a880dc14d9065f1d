"""One client cannot have all of the service, and who is refused is told when to come back. Without workers, or with
workers of another time: a loop whose clock jumps to the next thing that happens."""

from __future__ import annotations

import asyncio
import json
import random
import socket
import statistics
from collections.abc import Callable, Coroutine, Iterator
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from service_server import PATIENCE, until
from test_service_edge import listening, talk

from service import tasks
from service.jobs import Jobs
from service.limits import Limits
from service.metrics import Metrics
from service.problems import Problem
from service.shares import Client, Line, Pace, Shares, address_of, ends
from service.store import Store

A, B, C = (Client(f"10.0.0.{last}") for last in (1, 2, 3))


# --- shares


@pytest.mark.parametrize(("one", "other", "same"), [
    ("10.0.0.1", "10.0.0.2", False), ("10.0.0.1", "::ffff:10.0.0.1", True), ("2001:db8::1", "2001:db8::2:3:4:5", True),
    ("2001:db8::1", "2001:db8:0:1::1", False), ("fe80::1%eth0", "fe80::1", True), ("", "10.0.0.1", False),
])  # fmt: skip
def test_a_client_is_an_address_or_a_network_of_ipv6(one: str, other: str, same: bool) -> None:
    assert (address_of(one) == address_of(other)) is same


@pytest.mark.parametrize(("workers", "queue", "share"), [(1, 1, 50), (1, 16, 50), (2, 16, 50), (8, 1, 50), (4, 0, 99),
                                                         (2, 3, 1), (1, 0, 50), (2, 2, 100)])  # fmt: skip
def test_one_client_never_has_all_places_of_several(workers: int, queue: int, share: int) -> None:
    places = Shares(Limits(share=share), workers, queue).places
    assert places.total == workers + queue
    if share < 100 and places.total > 1:
        assert 1 <= places.own < places.total
    else:
        assert places.own == places.total
    assert places.own >= min(workers, places.total - 1)  # who is alone may keep all workers busy


def test_a_share_is_of_an_address_and_of_a_token() -> None:
    def taken(clients: list[Client]) -> int:
        share = Shares(Limits(event_streams=8), 1, 1).streams
        for key, client in enumerate(clients):
            if not (share.full or share.spent(client)):
                share.take(key, client)
        return len(share)

    assert taken([A] * 20) == 4
    assert taken([Client(A.address, "one"), Client(A.address, "other")] * 10) == 4  # two tokens of one client
    assert taken([Client(f"10.0.0.{last}", "one") for last in range(20)]) == 4  # one token on many machines
    assert taken([A, B] * 10) == 8


def test_what_is_given_back_can_be_had_again() -> None:
    shares = Shares(Limits(bodies=2), 1, 1)
    for _ in range(3):
        with shares.bodies.one(A, "bodies"):
            with pytest.raises(Problem) as caught, shares.bodies.one(A, "bodies"):
                pass
            assert caught.value.slug == "share-spent"
            with shares.bodies.one(B, "bodies"), pytest.raises(Problem) as caught, shares.bodies.one(C, "bodies"):
                pass
            assert caught.value.slug == "queue-full"
    assert len(shares.bodies) == 0


# --- turns


def test_clients_take_turns() -> None:
    of = {**{f"a{n}": A for n in range(5)}, "b0": B, "b1": B, "c0": C}
    line = Line(8, lambda key: of[str(key)], lambda: 0.0)
    for name in of:
        line.put_nowait(name)
    expected = ["a0", "b0", "c0", "a1", "b1", "a2", "a3", "a4"]
    assert line.order() == expected
    assert [line._next() for _ in of] == expected


def test_a_worker_is_left_to_others_while_others_come() -> None:
    now, of = 0.0, {f"a{n}": A for n in range(9)} | {"b": B}
    line = Line(2, lambda key: of[str(key)], lambda: now)
    for n in range(3):
        line.put_nowait(f"a{n}")
    assert [line._next(), line._next(), line._next()] == ["a0", "a1", None]  # who is alone has both
    line.put_nowait("b")
    line.drop("a0")
    assert line._next() == "b"
    line.drop("b")
    assert line._next() is None  # a1 runs, and b may come again
    now = 100.0
    assert line._next() == "a2"  # b has not


def test_a_job_that_ends_while_it_waits_leaves_the_line() -> None:
    line = Line(1, lambda key: A, lambda: 0.0)
    for name in ("x", "y"):
        line.put_nowait(name)
    line.drop("x")
    assert (line._next(), line.order()) == ("y", [])


# --- when to come back


def test_jobs_end_in_the_order_of_a_queue() -> None:
    """By hand: two workers, 3 and 5 s left; then jobs of 4, 1 and 2 s."""
    assert ends([3.0, 5.0], [4.0, 1.0, 2.0], 2) == [3.0, 5.0, 7.0, 6.0, 8.0]
    assert ends([], [4.0], 2) == [4.0]


def test_what_is_left_follows_progress_then_what_was_measured() -> None:
    pace = Pace()
    assert pace.left("render", 8.0, 100.0, 0.8) == pytest.approx(2.0)
    assert pace.left("render", 8.0, 100.0) == 8.0  # nothing is known but that it lasts
    assert pace.left("render", 98.0, 100.0) == 2.0  # when it is stopped
    for seconds in (10.0, 12.0, 2.0):
        pace.add("render", seconds)
    assert pace.left("render", 8.0, 100.0) == pytest.approx(3.0)  # as those of 10 and 12 s
    assert pace.left("render", 0.0, 100.0) == pytest.approx(8.0)


class Loop(asyncio.SelectorEventLoop):
    """Its clock jumps to the next thing that is to happen."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0

    def time(self) -> float:
        return self.now

    def _run_once(self) -> None:
        if not self._ready and self._scheduled:  # type: ignore[attr-defined]
            self.now = max(self.now, self._scheduled[0].when())  # type: ignore[attr-defined]
        super()._run_once()  # type: ignore[misc]


class Sleeper:
    """A worker whose job is to take its time: as many seconds as the settings say, with or without progress."""

    def __init__(self) -> None:
        self.code: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self.lost = False
        self.said: Iterator[tuple[float, dict[str, Any]]] = iter(())

    async def give(self, job: dict[str, Any]) -> None:
        Path(job["folder"], "out", f"image.{job['settings']['format']}").write_bytes(b"picture")
        seconds, steps = job["settings"]["seconds"], 20 if job["settings"]["tells"] else 1
        progress = [(seconds / steps, {"progress": n / steps, "stage": "image"}) for n in range(1, steps)]
        self.said = iter([(0.0, {"began": True}), *progress, (seconds / steps, {"done": {}})])

    async def hear(self) -> dict[str, Any] | None:
        seconds, message = next(self.said)
        await asyncio.sleep(seconds)
        return message

    def close(self) -> None:
        pass


class Sleepers:
    """Where they come from."""

    def __init__(self) -> None:
        self.report: dict[str, Any] = {"threads": 1}
        self.ready = asyncio.Event()
        self.ready.set()

    def start(self) -> None:
        pass

    async def stop(self) -> None:
        pass

    async def fork(self) -> Sleeper:
        return Sleeper()

    async def kill(self, worker: Any) -> None:
        if not worker.code.done():
            worker.code.set_result(-9)


def in_another_time(folder: Path, work: Callable[[Jobs, Loop], Coroutine[Any, Any, None]], **settings: int) -> None:
    """Run `work` with the service's own queue over such workers."""
    with asyncio.Runner(loop_factory=Loop) as runner:
        loop = runner.get_loop()
        assert isinstance(loop, Loop)

        async def all_of_it() -> None:
            jobs = Jobs(Store(folder), Limits(job_seconds=3600), Metrics(), Sleepers(), stage_root=None, **settings)
            jobs.shares.clock = loop.time
            jobs.start()
            await work(jobs, loop)
            for task in jobs._tasks:
                task.cancel()
            await asyncio.gather(*jobs._tasks, return_exceptions=True)

        runner.run(all_of_it())


def send(jobs: Jobs, client: Client, number: int, seconds: float, tells: bool = False) -> int | None:
    """Ask for a job. Returns Retry-After, None where there was a place."""
    try:
        jobs.submit("render", {"seconds": seconds, "tells": tells, "format": "png"}, str(number), "x", None, client)
    except Problem as problem:
        return int(problem.headers["Retry-After"])
    return None


def clients() -> Iterator[Client]:
    number = 0
    while True:
        number += 1
        yield Client(f"10.{number >> 16}.{number >> 8 & 255}.{number & 255}")


@pytest.mark.parametrize(("tells", "least", "most"), [(False, 10.0, 10.0), (False, 9.0, 11.0), (True, 2.0, 40.0)])
@pytest.mark.parametrize("workers", [1, 3])
def test_retry_after_tells_the_truth(tmp_path: Path, workers: int, tells: bool, least: float, most: float) -> None:
    """The queue is kept full; one who is refused at any moment tries again and again, and notes when it got in."""
    dice, names, waits = random.Random(1), clients(), []

    async def work(jobs: Jobs, loop: Loop) -> None:
        number = 0

        def another() -> int | None:
            nonlocal number
            number += 1
            return send(jobs, next(names), number, dice.uniform(least, most), tells)

        while not another():
            pass
        jobs.shares._told.clear()
        for _ in range(40):
            await asyncio.sleep(dice.uniform(0.0, most))
            while not another():  # it is full when the next one comes
                pass
            jobs.shares._told.clear()
            told, since = another(), loop.time()
            assert told is not None
            while another() is not None:
                jobs.shares._told.clear()
                await asyncio.sleep(0.05)
            waits.append((told, loop.time() - since))

    in_another_time(tmp_path, work, workers=workers, queue=4)
    settled = waits[5:]  # when some have been measured
    ratios = [told / max(real, 1.0) for told, real in settled]
    assert 0.5 <= statistics.median(ratios) <= 2.0
    assert 0.5 <= sum(told for told, _ in settled) / sum(real for _, real in settled) <= 2.0
    for told, real in settled if most < 2 * least else ():  # else a job that has just begun can be anything
        assert real / 2 - 1.0 <= told <= 2 * real + 1.0  # in whole seconds, of which 1 is the least


def test_all_who_come_back_when_they_were_told_find_a_place(tmp_path: Path) -> None:
    """They are refused at the same moment, and must not be told the same place."""
    served, names = [], clients()

    async def work(jobs: Jobs, loop: Loop) -> None:
        for number in range(6):
            assert send(jobs, next(names), number, 10.0) is None
        await asyncio.sleep(11.0)  # two have ended, and are measured
        for number in range(6, 8):
            assert send(jobs, next(names), number, 10.0) is None

        async def patient(number: int, client: Client) -> None:
            told = send(jobs, client, number, 10.0)
            assert told is not None
            await asyncio.sleep(told)
            served.append(send(jobs, client, number, 10.0) is None)

        await asyncio.gather(*(patient(100 + n, next(names)) for n in range(5)))

    in_another_time(tmp_path, work, workers=2, queue=4)
    assert served == [True] * 5


def test_who_asks_in_vain_all_the_time_does_not_put_others_off(tmp_path: Path) -> None:
    async def work(jobs: Jobs, loop: Loop) -> None:
        for number in range(3):
            send(jobs, Client(f"10.1.0.{number}"), number, 10.0)
        for number in range(1000):
            send(jobs, A, 100 + number, 10.0)
        told = send(jobs, B, 5000, 10.0)
        assert told is not None
        assert told <= 20  # the second place, at most; one job in ten seconds

    in_another_time(tmp_path, work, workers=1, queue=2)


def test_a_client_that_floods_the_queue_does_not_make_others_wait_for_all_of_it(tmp_path: Path) -> None:
    waited = []

    async def work(jobs: Jobs, loop: Loop) -> None:
        async def flood() -> None:
            for number in range(10_000):
                send(jobs, A, number, 10.0)
                await asyncio.sleep(0.5)

        attack = asyncio.create_task(flood())
        await asyncio.sleep(60.0)
        for number in range(20):
            settings = {"seconds": 1.0, "tells": False, "format": "png"}
            record = jobs.submit("render", settings, f"b{number}", "x", None, B)
            since = loop.time()
            await jobs.ended(record)
            assert record.status == "done"
            waited.append(loop.time() - since)
            await asyncio.sleep(5.0)
        attack.cancel()

    in_another_time(tmp_path, work, workers=2, queue=16)
    assert waited[0] <= 11.5  # A had both workers
    assert max(waited[1:]) <= 2.0  # within twice what it takes when all is quiet


# --- over HTTP


def post(address: tuple[str, int], samples: int, source: str, *, whole: bool = True, via: str = "") -> socket.socket:
    """Send a job from an address of this machine; `whole`: with the end of its body; `via`: for whom, as it says."""
    body = json.dumps({"stage": "marble.usda", "samples": samples}).encode()
    connection = socket.create_connection(address, timeout=PATIENCE, source_address=(source, 0))
    connection.sendall(b"POST /v1/render HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
                       b"Prefer: respond-async\r\nConnection: close\r\n"
                       b"X-Forwarded-For: %s\r\nContent-Length: %d\r\n\r\n" % (via.encode(), len(body))
                       + (body if whole else body[:5]))  # fmt: skip
    return connection


def answer(connection: socket.socket) -> tuple[int, dict[str, Any], str]:
    """Status, document and head."""
    with connection:
        said = b"".join(iter(lambda: connection.recv(65536), b""))
    head, _, body = said.partition(b"\r\n\r\n")
    return int(head.split()[1]), json.loads(body), head.decode().lower()


def slug(told: tuple[int, dict[str, Any], str]) -> tuple[int, str]:
    return told[0], str(told[1].get("type", "")).removeprefix("/problems/")


def test_places_are_shared_and_what_exists_needs_none(tmp_path: Path) -> None:
    with listening(tmp_path, workers=1, queue=3) as address:

        def ask(samples: int, last: int) -> tuple[int, str]:
            return slug(answer(post(address, samples, f"127.0.0.{last}")))

        assert [ask(samples, 1) for samples in (1, 2)] == [(202, "")] * 2
        refused = answer(post(address, 3, "127.0.0.1"))
        assert slug(refused) == (429, "share-spent")
        assert "retry-after: " in refused[2]
        assert [ask(samples, 2) for samples in (4, 5)] == [(202, "")] * 2
        assert ask(6, 3) == (429, "queue-full")
        assert [ask(samples, last) for samples, last in ((1, 3), (1, 1), (4, 1))] == [(202, "")] * 3


@pytest.mark.parametrize(("proxies", "forwarded"), [((), False), (("127.0.0.1",), True), (("10.0.0.0/8",), False)])
def test_only_a_proxy_we_know_says_for_whom_it_asks(tmp_path: Path, proxies: tuple[str, ...], forwarded: bool) -> None:
    """Else a client would have as many shares as it can think of addresses."""
    with listening(tmp_path, workers=1, queue=7, proxies=proxies) as address:
        told = [slug(answer(post(address, n, "127.0.0.1", via=f"9.9.9.9, 192.0.2.{n}"))) for n in range(1, 7)]
    assert told.count((202, "")) == (6 if forwarded else 4)
    assert set(told) <= {(202, ""), (429, "share-spent")}


def test_a_body_that_trickles_holds_no_place_and_ends(tmp_path: Path) -> None:
    limits = Limits(body_seconds=2, bodies=8)
    with listening(tmp_path, workers=1, queue=1, limits=limits) as address, ExitStack() as stack:
        slow = [stack.enter_context(post(address, n + 1, "127.0.0.1", whole=False)) for n in range(4)]
        until(lambda: slug(answer(post(address, 50, "127.0.0.1"))) == (429, "share-spent"))
        seconds = int(answer(post(address, 50, "127.0.0.1"))[2].partition("retry-after: ")[2].split()[0])
        assert 0 < seconds <= 3
        assert slug(answer(post(address, 60, "127.0.0.2"))) == (202, "")
        assert [slug(answer(one)) for one in slow] == [(408, "request-timeout")] * 4


def test_streams_of_events_are_shared(tmp_path: Path) -> None:
    with listening(tmp_path, limits=Limits(event_streams=4)) as address, ExitStack() as stack:
        job = answer(post(address, 1, "127.0.0.1"))[1]["links"]["events"]

        def listen(last: int) -> tuple[socket.socket, bytes]:
            one = socket.create_connection(address, timeout=PATIENCE, source_address=(f"127.0.0.{last}", 0))
            stack.enter_context(one)
            one.sendall(f"GET {job} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
            return one, one.recv(12)

        first, said = listen(1)
        assert said == b"HTTP/1.1 200"
        assert [listen(1)[1] for _ in range(2)] == [b"HTTP/1.1 200", b"HTTP/1.1 429"]
        assert [listen(last)[1] for last in (2, 3, 4)] == [b"HTTP/1.1 200", b"HTTP/1.1 200", b"HTTP/1.1 429"]
        first.close()
        until(lambda: listen(1)[1] == b"HTTP/1.1 200")


@pytest.mark.parametrize("side", ["image_width", "image_height"])
def test_a_side_of_a_picture_is_bounded_by_name(tmp_path: Path, side: str) -> None:
    """4194304 x 1 has no more pixels than are allowed, and took 38 s."""
    body = json.dumps({"stage": "marble.usda", "image_width": 1, "image_height": 1, side: 1 << 22}).encode()
    head = b"POST /v1/render HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nConnection: close\r\n"
    with listening(tmp_path) as address:
        said = talk(address, head + b"Content-Length: %d\r\n\r\n" % len(body) + body)
    problem = json.loads(said.partition(b"\r\n\r\n")[2])
    assert (problem["status"], problem["type"]) == (422, "/problems/limit-exceeded")
    assert problem["detail"] == f"side would be {1 << 22}; the limit is {Limits().side}"
    assert problem["errors"][0]["pointer"] == f"/{side}"


def test_a_side_that_follows_from_the_camera_is_bounded_too() -> None:
    limits = {**asdict(Limits()), "side": 100}
    tasks._check_size(100, 100, 1, limits)
    for size in ((1, 101), (101, 1)):
        with pytest.raises(Problem) as caught:
            tasks._check_size(*size, 1, limits)
        assert (caught.value.slug, "side would be 101; the limit is 100" in caught.value.detail) == (
            "limit-exceeded", True
        )  # fmt: skip
