"""A cluster whose parts are killed, or stop answering, while jobs run on it: each job is done, or told."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest
from service_server import LONG, PATIENT, ROOT, SMALL, WARM_UP, Server, kill, running, runs, until
from test_service_cluster import SECONDS, SOON, below, start

pytest.importorskip("distributed")
pytestmark = pytest.mark.slow
GOOD = ROOT / "usd_samples" / "good"


@dataclass
class Farm:
    """A scheduler and workers, each a process that can be killed or stopped."""

    folder: Path
    port: int
    scheduler: subprocess.Popen[bytes]
    workers: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self.port}"

    def join(self, count: int) -> None:
        """Workers without a nanny: their number is their own."""
        words = ("distributed.cli.dask_worker", f"tcp://{self.address}", "--no-nanny", "--nthreads", "1",
                 "--no-dashboard", "--local-directory", str(self.folder))  # fmt: skip
        self.workers += [_run(self.folder, *words) for _ in range(count)]

    def forks(self) -> dict[int, list[int]]:
        """Processes that do a job or wait for one, by the process of their worker."""
        return {
            worker.pid: [fork for nursery in below(worker.pid) for fork in below(nursery)] for worker in self.workers
        }

    def busy(self) -> subprocess.Popen[bytes]:
        """The worker that has a job."""
        found = [worker for worker in self.workers if self.forks()[worker.pid]]
        assert len(found) == 1
        return found[0]

    def end(self) -> None:
        for process in (*self.workers, self.scheduler):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGCONT)
            process.kill()
            process.wait()


def _run(folder: Path, *words: str) -> subprocess.Popen[bytes]:
    with open(folder / "farm.log", "a") as log:
        return subprocess.Popen([sys.executable, "-m", *words], cwd=ROOT, stdout=log, stderr=log)


def _scheduler(folder: Path, port: int) -> subprocess.Popen[bytes]:
    words = ("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard")
    process = _run(folder, *words)

    def listens() -> bool:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
            return True
        return False

    until(listens)
    return process


@pytest.fixture
def farm(tmp_path: Path) -> Iterator[Farm]:
    """Two workers, each with one thread."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    farm = Farm(tmp_path, port, _scheduler(tmp_path, port))
    try:
        farm.join(2)
        yield farm
    finally:
        farm.end()


@contextlib.contextmanager
def serving(farm: Farm, name: str = "data") -> Iterator[tuple[Server, httpx.Client]]:
    words = ("--stage-root", str(GOOD), "--executor", f"dask://{farm.address}", *PATIENT, "--limit", "drain_seconds=1")
    with running(farm.folder / name, *words) as server, server.client() as client:
        until(lambda: there(client) == 2, WARM_UP)
        yield server, client


def there(client: httpx.Client) -> int:
    """Workers that the service counts on."""
    answer = client.get("/readyz")
    return int(answer.json()["confinement"]["cluster_workers"]) if answer.status_code == 200 else 0


def small(client: httpx.Client, exposure: float) -> httpx.Response:
    return client.post("/v1/render", json={"stage": "marble.usda", **SMALL, "exposure": exposure})


def state(client: httpx.Client, where: str) -> dict[str, Any]:
    found: dict[str, Any] = client.get(where).json()
    return found


def test_a_job_outlives_workers_that_are_killed(farm: Farm) -> None:
    with serving(farm) as (_, client):
        where = start(client, SECONDS, 0.5)
        worker = farm.busy()
        forks = farm.forks()[worker.pid]
        kill(worker.pid)
        until(lambda: not any(map(runs, forks)), SOON)  # nothing of it goes on
        until(lambda: state(client, where)["status"] == "done", WARM_UP)
        until(lambda: there(client) == 1)
        assert small(client, 0.6).status_code == 200


def test_a_job_is_told_when_the_scheduler_is_killed_and_the_next_scheduler_is_found(farm: Farm) -> None:
    with serving(farm) as (_, client):
        where = start(client, LONG, 0.5)
        forks = [fork for found in farm.forks().values() for fork in found]
        assert forks
        farm.scheduler.kill()
        farm.scheduler.wait()
        until(lambda: state(client, where)["status"] == "failed", SOON)
        assert state(client, where)["problem"]["type"] == "/problems/interrupted"
        until(lambda: client.get("/readyz").status_code == 503, SOON)
        until(lambda: not any(map(runs, forks)), 2 * SOON)  # nobody works at what nobody waits for
        farm.scheduler = _scheduler(farm.folder, farm.port)
        farm.join(1)
        until(lambda: client.get("/readyz").status_code == 200, WARM_UP)
        assert small(client, 0.6).status_code == 200


def test_a_scheduler_that_stops_answering_is_told_and_loses_nothing(farm: Farm) -> None:
    with serving(farm) as (_, client):
        where = start(client, SECONDS, 0.5)
        os.kill(farm.scheduler.pid, signal.SIGSTOP)
        until(lambda: client.get("/readyz").status_code == 503, SOON)
        waiting = client.post(
            "/v1/render", json={"stage": "marble.usda", **SMALL}, headers={"Prefer": "respond-async"}
        ).headers["location"]
        given_up = client.post("/v1/render", json={**LONG, "exposure": 0.7}, headers={"Prefer": "respond-async"})
        client.delete(given_up.headers["location"])  # answers, though nobody there can hear it
        assert client.get("/livez").status_code == 200
        os.kill(farm.scheduler.pid, signal.SIGCONT)
        until(lambda: client.get("/readyz").status_code == 200, SOON)
        for job in (where, waiting):
            until(lambda job=job: state(client, job)["status"] == "done", WARM_UP)
        assert small(client, 0.8).status_code == 200


def test_the_jobs_of_a_worker_that_stops_answering_are_done_by_another(farm: Farm) -> None:
    with serving(farm) as (_, client):
        where = start(client, SECONDS, 0.5)
        worker = farm.busy()
        os.kill(worker.pid, signal.SIGSTOP)
        for fork in farm.forks()[worker.pid]:  # a machine that is cut off says nothing at all
            os.kill(fork, signal.SIGSTOP)
        until(lambda: state(client, where)["status"] == "done", WARM_UP)
        assert there(client) == 1
        for number in range(4):  # none of them is given to it
            assert small(client, 1.0 + number).status_code == 200
        os.kill(worker.pid, signal.SIGCONT)
        until(lambda: there(client) == 2)
        assert small(client, 2.0).status_code == 200


def test_two_services_share_a_cluster_and_nothing_else(farm: Farm) -> None:
    with serving(farm, "one") as (first, one), serving(farm, "two") as (_, two):
        where = [start(client, {**LONG, "samples": 63 + number}, 0.5) for number, client in enumerate((one, two))]
        assert all(farm.forks().values())
        assert one.get(where[1]).status_code == 404
        one.delete(where[0])
        until(lambda: state(one, where[0])["status"] == "cancelled")
        assert small(one, 0.75).status_code == 200
        assert state(two, where[1])["status"] == "running"
        again = start(one, LONG, 1.0)
        before = farm.forks()
        first.process.kill()  # whose work ends with it, and nobody else's
        first.process.wait()
        until(lambda: sum(not set(before[pid]) & set(found) for pid, found in farm.forks().items()) == 1, SOON)
        time.sleep(0.5)
        assert state(two, where[1])["status"] == "running"
        assert again
        two.delete(where[1])
        assert small(two, 1.25).status_code == 200
