"""What the machine lacks for a while costs no more than that while: descriptors, room on the disk, workers."""

from __future__ import annotations

import asyncio
import errno
import json
import logging
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
from dataclasses import asdict
from pathlib import Path
from typing import Any

import httpx
import pytest
from service_server import BALL, PATIENCE, ROOT, SMALL, InProcess, Server, files_under, running, until, upload

from refract_core.errors import UsageError
from service.app import Settings, create_app
from service.digests import file_digest, tree_digest
from service.discreet import without_folders
from service.gate import Gate, fitting
from service.jobs import Jobs
from service.journal import Seldom
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
    with short.client() as client:
        until(lambda: client.get("/readyz").status_code == 200, SOON)
        assert client.get("/readyz").json()["slots"] == {"live": 2, "of": 2}
    until(lambda: draws(short, 0.2))
    until(lambda: open_files(short) <= before + 2)
    assert short.metric("refract_slot_failures_total") == 0.0


def server_connections(client: httpx.Client) -> int:
    found = re.search(r"(?m)^refract_connections (\d+)", client.get("/metrics").text)
    assert found
    return int(found[1])


def leave_free(server: Server, count: int) -> None:
    """Let a service open so many further files and no more."""
    top = max(int(name) for name in os.listdir(f"/proc/{server.process.pid}/fd"))
    resource.prlimit(server.process.pid, resource.RLIMIT_NOFILE, (top + 1 + count, 1024))


def test_a_shortage_of_descriptors_ends_no_slot(tmp_path: Path) -> None:
    root = str(ROOT / "usd_samples" / "good")
    words = ("--workers", "1", "--stage-root", root)
    with (running(tmp_path / "data", *words, within=few_files(1024)) as server, server.client() as client,
          ExitStack() as idle):  # fmt: skip
        assert client.get("/readyz").status_code == 200  # from here on, this connection is there
        for _ in range(8):  # numbers that were free between others
            idle.enter_context(server.connect())
        until(lambda: server_connections(client) >= 9)
        leave_free(server, 1)  # a worker needs two
        named = {"stage": "traced.usda", **SMALL}
        accepted = client.post("/v1/render", json=named, headers={"Prefer": "respond-async"})
        assert accepted.status_code in (202, 503)
        until(lambda: client.get("/readyz").status_code == 503)
        assert "refract_slot_failures_total 0.0" not in client.get("/metrics").text
        resource.prlimit(server.process.pid, resource.RLIMIT_NOFILE, (1024, 1024))
        until(lambda: client.get("/readyz").status_code == 200, SOON)
        until(lambda: draws(server, 0.5))
        said = [line for line in lines_of(server) if "gets no worker" in line["message"]]
        assert said
        until(lambda: len(list((server.data / "work").iterdir())) == 1)  # of the worker that waits; no leavings


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
        until(lambda: draws(server, 0.0))


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
        assert not gate.enter(One())  # both are young
        now[0] += 0.6
        gate.works(first)
        assert not gate.enter(One())
        now[0] += 1.0
        assert gate.enter(third)
        assert (first.left, second.left) == (False, True)
        gate.gone(first)
        assert gate.enter(fourth)
        crowd = [One() for _ in range(1000)]
        assert not any(gate.enter(one) for one in crowd)
        assert [one.left for one in crowd[:900]] == [True] * 900  # after they were told
        assert not crowd[-1].left

    asyncio.run(work())


# --- the disk

_MOUNT = 'mount -t tmpfs -o "$1" tmpfs "$2" && shift 2 && exec "$@"'
_CAN_MOUNT = bool(shutil.which("unshare")) and not subprocess.run(
    ["unshare", "-rm", "mount", "-t", "tmpfs", "tmpfs", "/mnt"], capture_output=True, check=False
).returncode


@contextmanager
def on_small_disk(folder: Path, options: str, *words: str) -> Iterator[tuple[Server, Path]]:
    """A service whose folders are on a disk of their own, and where that disk is seen from here."""
    disk = folder / "disk"
    disk.mkdir()
    within = ["unshare", "-rm", "sh", "-c", _MOUNT, "sh", options, str(disk)]
    places = {"TMPDIR": str(disk)}
    with running(folder / "data", "--data", str(disk / "data"), "--workers", "1", *words, within=within,
                 environment=places, own_data=False) as server:  # fmt: skip
        yield server, Path(f"/proc/{server.process.pid}/root{disk}")


def fill(disk: Path) -> Path:
    """Take every byte that is left."""
    ballast = disk / "ballast"
    with suppress(OSError), open(ballast, "wb", buffering=0) as file:
        while True:
            file.write(b"x" * 4096)
    return ballast


def files_of(disk: Path) -> set[str]:
    return {str(path.relative_to(disk)) for path in files_under(disk / "data") if path.is_file()}


@pytest.mark.skipif(not _CAN_MOUNT, reason="nothing may be mounted here")
def test_a_full_disk_is_507_and_passes(tmp_path: Path) -> None:
    with on_small_disk(tmp_path, "size=8m") as (server, disk), server.client() as client:
        assert draws(server, 0.0)
        known = files_of(disk)
        ballast = fill(disk)
        for n in range(3):
            settings = json.dumps({**SMALL, "exposure": 1.0 + n})
            answer = client.post("/v1/render", files=upload(BALL), data={"settings": settings})
            assert (answer.status_code, answer.json()["type"]) == (507, "/problems/no-space")
            assert int(answer.headers["retry-after"]) > 0
            assert str(disk) not in answer.text
        assert client.get("/readyz").status_code == 503
        assert {name for name in files_of(disk) if name.startswith("data/jobs/")} == {
            name for name in known if name.startswith("data/jobs/")
        }
        assert not [name for name in files_of(disk) if "upload" in name]
        ballast.unlink()
        until(lambda: client.get("/readyz").status_code == 200, SOON)
        assert draws(server, 1.0)


@pytest.mark.skipif(not _CAN_MOUNT, reason="nothing may be mounted here")
def test_a_result_that_finds_no_room_is_507(tmp_path: Path) -> None:
    """The disk is full only when the worker writes: its picture is larger than what is left."""
    with on_small_disk(tmp_path, "size=8m") as (server, disk), server.client() as client:
        assert draws(server, 0.0)
        ballast = fill(disk)
        with open(ballast, "r+b") as file:
            file.truncate(ballast.stat().st_size - 65536)  # enough for a stage and records
        sent = {"settings": json.dumps({"image_width": 640, "samples": 1})}
        exr = {"Accept": "image/x-exr"}
        answer = client.post("/v1/render", files=upload(BALL), data=sent, headers=exr)
        assert (answer.status_code, answer.json()["type"]) == (507, "/problems/no-space")
        job = answer.headers["content-location"].rpartition("/")[2]
        assert not [path for path in (disk / "data" / "jobs" / job).iterdir() if path.name != "record.json"]
        ballast.unlink()
        assert client.post("/v1/render", files=upload(BALL), data=sent, headers=exr).status_code == 200


@pytest.mark.skipif(not _CAN_MOUNT, reason="nothing may be mounted here")
def test_a_disk_without_inodes_is_507_and_passes(tmp_path: Path) -> None:
    with on_small_disk(tmp_path, "size=64m,nr_inodes=200") as (server, disk), server.client() as client:
        assert draws(server, 0.0)
        (disk / "many").mkdir()
        with suppress(OSError):
            for n in range(1000):
                (disk / "many" / str(n)).touch()
        settings = json.dumps({**SMALL, "exposure": 1.0})
        answer = client.post("/v1/render", files=upload(BALL), data={"settings": settings})
        assert (answer.status_code, answer.json()["type"]) == (507, "/problems/no-space")
        assert client.get("/readyz").status_code == 503
        shutil.rmtree(disk / "many")
        until(lambda: client.get("/readyz").status_code == 200, SOON)
        until(lambda: draws(server, 1.0))


def test_two_services_do_not_share_a_folder(tmp_path: Path) -> None:
    data = str(tmp_path / "data")
    first = create_app(Settings(data=data))
    job = first.state.jobs.store.new_work()
    with pytest.raises(UsageError, match="another service uses this folder"):
        create_app(Settings(data=data))
    assert job.is_dir()
    command = [sys.executable, "-m", "refract_core.cli", "serve", "--port", "0", "--data", data]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=PATIENCE)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert "another service uses this folder" in done.stderr
    assert done.stdout == ""


def test_a_queued_job_whose_stage_has_changed_is_told(tmp_path: Path) -> None:
    """What was accepted is done or told, and never done on something else."""
    root = tmp_path / "root"
    root.mkdir()
    (root / "a.usda").write_text(BALL)

    async def first() -> tuple[str, str]:
        jobs = jobs_of(tmp_path / "data", Fails([]))
        jobs.stage_root = root
        digest = file_digest(root / "a.usda")
        same = jobs.submit("render", {"samples": 1}, digest, "stage.usda", copied(root / "a.usda"))
        other = jobs.submit("render", {"samples": 1}, tree_digest(root, "a.usda"), "a.usda", None)
        left = jobs.submit("render", {"samples": 2}, tree_digest(root, "a.usda"), "a.usda", None)
        jobs.keep(same)
        jobs.keep(other)
        assert not left.kept  # whoever asked for it has lost the connection
        return same.id, other.id

    def copied(path: Path) -> Path:
        return Path(shutil.copy(path, tmp_path / "upload"))

    async def second(same: str, other: str) -> None:
        jobs = Jobs(Store(tmp_path / "data"), Limits(), Metrics(), Nursery(), workers=1, queue=4, stage_root=root)
        await jobs._resume()
        states = {record.id: record.status for record in jobs.records.values()}
        assert len(states) == 3
        assert (states.pop(same), states.pop(other), *states.values()) == ("queued", "failed", "failed")
        assert {r.problem["type"] for r in jobs.records.values() if r.problem} == {"/problems/interrupted"}

    same, other = asyncio.run(first())
    (root / "a.usda").write_text(BALL + "\n")
    asyncio.run(second(same, other))


# --- faults of ours, and what strangers are told


class Says(Idle):
    """A worker that says one thing."""

    def __init__(self, message: dict[str, Any]) -> None:
        super().__init__()
        self.messages = [{"began": True}, message]

    async def hear(self) -> dict[str, Any] | None:
        return self.messages.pop(0) if self.messages else None


def outcome(jobs: Jobs, source: Fails, message: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The document of a job whose worker says this."""
    assert jobs.stage_root is not None

    async def fork() -> Any:
        return Says(message)

    async def work() -> dict[str, Any]:
        monkeypatch.setattr(source, "fork", fork)
        jobs.start()
        record = jobs.submit("render", {"samples": 1, "format": "png"}, "digest", "a.usda", None)
        async with asyncio.timeout(PATIENCE):
            await jobs.ended(record)
        await jobs.stop()
        return record.document()

    return asyncio.run(work())


def test_a_fault_of_ours_is_counted_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def make() -> tuple[Jobs, Fails]:
        source = Fails([])
        jobs = jobs_of(tmp_path, source, workers=1)
        jobs.stage_root = tmp_path / "root"
        return jobs, source

    jobs, source = asyncio.run(make())
    fault = {"problem": {"slug": "worker-fault", "detail": "the program failed on this stage"}}
    document = outcome(jobs, source, fault, monkeypatch)
    assert (document["problem"]["type"], document["problem"]["status"]) == ("/problems/worker-fault", 500)
    assert sample(jobs.metrics, "refract_worker_faults_total") == 1.0
    assert sample(jobs.metrics, "refract_worker_crashes_total") == 0.0


def test_a_worker_that_is_done_and_made_nothing_is_a_fault_of_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    async def make() -> tuple[Jobs, Fails]:
        source = Fails([])
        jobs = jobs_of(tmp_path, source, workers=1)
        jobs.stage_root = tmp_path
        return jobs, source

    jobs, source = asyncio.run(make())
    said = outcome(jobs, source, {"done": {"width": 8, "height": 8}}, monkeypatch)
    assert (said["status"], said["problem"]["type"]) == ("failed", "/problems/worker-fault")
    assert "image" not in said["links"]


def test_an_exception_in_a_worker_is_a_fault_of_ours(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """By the worker's own road: what it says of an exception that nothing in it has caught."""
    from service import worker

    known: list[tuple[BaseException, str]] = [
        (RuntimeError("/secret/place"), "worker-fault"),
        (OSError(errno.ENOSPC, "No space left on device"), "no-space"),
        (OSError(errno.EFBIG, "File too large"), "limit-exceeded"),
        (OSError(errno.EACCES, "Permission denied"), "worker-fault"),
        (MemoryError(), "memory-limit"),
    ]
    for error, slug in known:

        def fail(*_: Any, error: BaseException = error) -> Any:
            raise error

        monkeypatch.setattr(worker, "_perform", fail)
        ours, theirs = socket.socketpair()
        with ours, theirs:
            ours.sendall(json.dumps({"folder": "/", "stage": "a.usda", "limits": asdict(Limits())}).encode() + b"\n")
            assert worker._serve(theirs.fileno(), os.open(os.devnull, os.O_WRONLY)) == 0
            said = [json.loads(line) for line in ours.recv(65536).splitlines()]
        assert said[0] == {"began": True}
        assert said[1]["problem"]["slug"] == slug
        assert "secret" not in json.dumps(said)


def test_no_document_names_a_folder_of_the_server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def make() -> tuple[Jobs, Fails]:
        source = Fails([])
        jobs = jobs_of(tmp_path / "data", source, workers=1)
        jobs.stage_root = tmp_path / "root"
        return jobs, source

    jobs, source = asyncio.run(make())
    inner = f"{jobs.store.work}/0123/out/image.png: {sys.prefix}/lib/x.py, {ROOT}."
    told = {"problem": {"slug": "stage-invalid", "detail": f"{inner}: cannot be written", "prim": f"{inner}",
                        "errors": [{"pointer": inner, "detail": inner}]}}  # fmt: skip
    said = json.dumps(outcome(jobs, source, told, monkeypatch))
    for folder in (tmp_path, sys.prefix, ROOT):
        assert str(folder) not in said
    assert "image.png: " in said


def test_a_result_above_its_limit_is_told_without_a_path(tmp_path: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    (root / "a.usda").write_text(BALL)
    words = ("--workers", "1", "--stage-root", str(root), "--limit", "result_bytes=2000")
    with running(tmp_path / "data", *words) as server, server.client() as client:
        for media in ("image/png", "image/x-exr"):
            body = {"stage": "a.usda", "image_width": 200, "samples": 1}
            answer = client.post("/v1/render", json=body, headers={"Accept": media})
            assert (answer.status_code, answer.json()["type"]) == (422, "/problems/limit-exceeded")
            assert str(tmp_path) not in answer.text


def test_prims_keep_their_names_in_texts() -> None:
    assert without_folders("/root/Glass: no normals", {"/root", "/"}) == "/root/Glass: no normals"
    assert without_folders("/srv/jobs/work/a.png; /srv/jobs.", {"/srv/jobs"}) == "work/a.png; a folder."
    assert without_folders("/srv/jobsworth/a", {"/srv/jobs"}) == "/srv/jobsworth/a"


# --- the log


def lines_of(server: Server) -> list[dict[str, Any]]:
    whole = server.log.read_text().rpartition("\n")[0]  # the last line may be on its way
    return [json.loads(line) for line in whole.splitlines()]


def test_each_request_is_a_line(tmp_path: Path) -> None:
    with running(tmp_path / "data", "--workers", "1") as server, server.client() as client:
        drawn = client.post("/v1/render", files=upload(BALL), data={"settings": json.dumps(SMALL)},
                            headers={"X-Request-ID": "shop-1.2:3"})  # fmt: skip
        assert drawn.headers["x-request-id"] == "shop-1.2:3"
        odd = client.get("/nothing?key=secret", headers={"X-Request-ID": 'a"b\\c d'})
        assert re.fullmatch("[0-9a-f]{16}", odd.headers["x-request-id"])
        long = client.get("/livez", headers={"X-Request-ID": "x" * 129})
        assert len(long.headers["x-request-id"]) == 16
        asked = {answer.headers["x-request-id"] for answer in (drawn, odd, long)}
        found: dict[str, dict[str, Any]] = {}

        def written() -> bool:  # a line comes after its answer, which the client may well have read before
            found.update({line["request_id"]: line for line in lines_of(server) if "request_id" in line})
            return asked <= set(found)

        until(written)
        line = found["shop-1.2:3"]
        assert (line["method"], line["path"], line["status"]) == ("POST", "/v1/render", 200)
        assert line["bytes"] == len(drawn.content)
        assert line["job"] == drawn.headers["content-location"].rpartition("/")[2]
        assert line["seconds"] > 0.0
        line = found[odd.headers["x-request-id"]]
        assert (line["path"], line["status"]) == ("/nothing", 404)
        assert "secret" not in server.log.read_text()
        text = client.get("/metrics").text
    for name in ("process_open_fds", "process_resident_memory_bytes", "refract_connections", "refract_slots"):
        assert re.search(rf"(?m)^{name}[{{ ]", text)


def test_the_same_complaint_comes_once_a_second() -> None:
    seldom, said = Seldom(), []

    def complain(at: float, text: str) -> None:
        record = logging.LogRecord("refract.service", logging.WARNING, "", 0, text, None, None)
        record.created = at
        if seldom.filter(record):
            said.append(record.getMessage())

    for n in range(100):
        complain(10.0 + n / 40, "no room")
    complain(12.0, "other")
    assert said == ["no room", "no room (39 more like it)", "no room (39 more like it)", "other"]


def test_text_is_for_people(tmp_path: Path) -> None:
    with running(tmp_path / "data", "--log", "text") as server, server.client() as client:
        client.get("/livez", headers={"X-Request-ID": "mine"})
        line = re.compile(r"^INFO refract.requests: GET /livez 200 in [\d.e-]+ s, mine$", re.MULTILINE)
        until(lambda: line.search(server.log.read_text()))
