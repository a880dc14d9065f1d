"""A real `refract serve` in a process of its own, and stages to send to it."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from starlette.types import ASGIApp

ROOT = Path(__file__).parents[1]
SMALL: dict[str, Any] = {"image_width": 32, "samples": 1}
LONG: dict[str, Any] = {"stage": "marble.usda", "image_width": 1920, "samples": 64}
"""Minutes of work: still under way whatever a test did meanwhile. For servers with `PATIENT`."""
PATIENT = (
    "--limit", "job_seconds=3600", "--limit", "stage_seconds=3600", "--limit", "cpu_seconds=3600",
    "--limit", "pixel_samples=200000000",
)  # fmt: skip
"""Words for a server whose limits of time are not what is tested: jobs take long where others want the cores too."""
PATIENCE = 180.0
"""[s] Longest wait for what has to happen. Who waits for a condition loses nothing by it; only a failure comes late."""
WARM_UP = 900.0
"""[s] The same for a first worker, who may have to compile the kernels."""

BALL = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    upAxis = "Y"
)
def Xform "World"
{
    def Sphere "Ball" (prepend apiSchemas = ["MaterialBindingAPI"])
    {
        rel material:binding = </World/Glass>
        double radius = 1
    }
    def Cube "Back"
    {
        double size = 1
        double3 xformOp:translate = (0.5, 0, -3)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    def Material "Glass" (prepend apiSchemas = ["RefractMaterialAPI"])
    {
        uniform token refraction:model = "sphere"
        float inputs:refraction:ior = 1.5
        float inputs:refraction:thickness = 2
    }
}
"""


@dataclass(frozen=True)
class Server:
    """Where it listens, and its process."""

    url: str
    process: subprocess.Popen[str]
    data: Path
    log: Path

    def client(self, **options: Any) -> httpx.Client:
        return httpx.Client(base_url=self.url, timeout=PATIENCE, trust_env=False, **options)

    @property
    def address(self) -> tuple[str, int]:
        host, _, port = self.url.removeprefix("http://").rstrip("/").rpartition(":")
        return host, int(port)

    def connect(self) -> socket.socket:
        return socket.create_connection(self.address, timeout=PATIENCE)

    def metric(self, name: str) -> float:
        """Sum of one metric over its labels."""
        with self.client() as client:
            lines = client.get("/metrics").text.splitlines()
        return sum(float(line.rpartition(" ")[2]) for line in lines if re.match(rf"{name}(\{{.*\}})? ", line))

    def idle(self) -> None:
        """Wait until nothing waits or runs."""
        until(lambda: self.metric("refract_jobs_running") + self.metric("refract_jobs_queued") == 0.0)

    def nursery(self) -> int:
        """The process that forks workers."""
        found = children(self.process.pid)
        assert len(found) == 1
        return found[0]

    def workers(self) -> list[int]:
        return children(self.nursery())


def files_under(folder: Path) -> list[Path]:
    """All files and folders below one. `Path.rglob` fails where a folder goes away while it looks."""
    return [Path(above, name) for above, folders, files in os.walk(folder) for name in (*folders, *files)]


def children(pid: int) -> list[int]:
    """Processes that the first thread of a process started, and that are still there; none where it has ended."""
    try:
        text = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return []
    return [int(word) for word in text.split()]


def runs(pid: int) -> bool:
    """Whether a process runs. One that has ended and that nobody has asked for its exit code does not."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state not in "XZ"


def kill(pid: int) -> None:
    """Kill a process, which may have ended by itself."""
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)


def until(true: Any, seconds: float = PATIENCE) -> None:
    """Wait for something to become true."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.02)


@contextmanager
def running(
    data: Path, *words: str, environment: dict[str, str] | None = None, own_data: bool = True,
    within: Sequence[str] = (), program: tuple[str, ...] = ("-m", "refract_core.cli"),
) -> Iterator[Server]:  # fmt: skip
    folder = ("--data", str(data)) if own_data else ()
    command = [*within, sys.executable, *program, "serve", "--port", "0", *folder, *words]
    log = data.parent / f"{data.name}.log"
    with open(log, "w") as errors:
        variables = {**os.environ, **(environment or {})}
        process = subprocess.Popen(
            command, cwd=ROOT, stdout=subprocess.PIPE, stderr=errors, text=True, env=variables
        )
    assert process.stdout
    try:
        words_of = process.stdout.readline()
        found = re.search(r"http://\S+", words_of)
        assert found, log.read_text()
        server = Server(found.group(), process, data, log)
        with server.client() as client:
            until(lambda: client.get("/readyz").status_code == 200, WARM_UP)
        yield server
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
        try:
            process.wait(PATIENCE)
        finally:
            process.kill()
            process.stdout.close()


class InProcess:
    """A client of an app in this process, whose workers are not started."""

    def __init__(self, app: ASGIApp) -> None:
        self.transport = httpx.ASGITransport(app, raise_app_exceptions=False)

    def request(self, method: str, path: str, **options: Any) -> httpx.Response:
        async def ask() -> httpx.Response:
            async with httpx.AsyncClient(transport=self.transport, base_url="http://localhost") as client:
                return await client.request(method, path, **options)

        return asyncio.run(ask())

    def get(self, path: str, **options: Any) -> httpx.Response:
        return self.request("GET", path, **options)

    def post(self, path: str, **options: Any) -> httpx.Response:
        return self.request("POST", path, **options)


def upload(content: bytes | str, name: str = "x.usda") -> dict[str, Any]:
    """The file part of a multipart request."""
    return {"stage": (name, content if isinstance(content, bytes) else content.encode())}
