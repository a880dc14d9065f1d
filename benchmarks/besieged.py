"""A service of our own to attack, and what it holds: for `benchmarks.attack` and `benchmarks.soak`."""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import httpx

from .hostile import BALL
from .pages import ROOT

GOOD = ROOT / "usd_samples" / "good"
STAGE = "marble.usda"
ATTACKER, HONEST = "127.0.0.1", "127.0.0.2"
"""Addresses of clients: on the loopback a client may choose its own."""
PATIENCE = 400.0
"""[s] Longer than any job may wait and run: an answer that takes longer never comes."""
WARM_UP = 900.0
"""[s] for the first worker, who may have to compile the kernels"""
QUICK = {"image_width": 32, "samples": 1}
_SETTLE = 20.0
"""[s] What has not gone by then stays."""
_TELLS = ("Traceback", "site-packages", "/usr/lib/python", str(ROOT), sys.prefix, f"{tempfile.gettempdir()}/")
"""What no answer may hold: paths of the server."""
_OURS = frozenset({500, 502, 504})
"""Statuses that are a fault of the service, where 501, 503, 505 and 507 tell what it cannot do now."""


class Held(NamedTuple):
    """What a service holds."""

    processes: int
    descriptors: int
    files: int
    """in its folder of work, and in its folder for temporary files"""
    shared: int
    """segments, queues and semaphores of the whole machine, System V and POSIX"""
    memory: int
    """[bytes] proportional set size, all processes"""


@dataclass
class Tally:
    """What came back; filled by several threads."""

    sent: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)
    """Answers that must not be: 500s, server paths, none at all. Each says what was sent."""
    told: int = 0
    """Answers of 501, 503, 505 and 507."""
    notes: list[str] = field(default_factory=list)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def answer(self, what: str, status: int, text: str = "") -> None:
        """Count an answer. `text`: its body where it is no picture."""
        slug = re.search(r'"/problems/([a-z-]+)"', text)
        name = slug.group(1) if slug else str(status)
        with self._lock:
            self.sent += 1
            self.outcomes[name] += 1
            if status in _OURS:
                self.faults.append(f"{what}: {status} {name}")
            elif status >= 500:
                self.told += 1
            if found := [word for word in _TELLS if word in text]:
                self.faults.append(f"{what}: tells {found[0]}")

    def event(self, what: str, name: str, *, fault: bool = False) -> None:
        """Count what is no answer: a connection that closed, or one that hangs."""
        with self._lock:
            self.sent += 1
            self.outcomes[name] += 1
            if fault:
                self.faults.append(f"{what}: {name}")


@dataclass(frozen=True)
class Siege:
    """A service under attack."""

    url: str
    process: subprocess.Popen[str]
    data: Path
    log: Path
    temporary: Path
    """Its folder for temporary files, which nobody else uses."""

    @property
    def address(self) -> tuple[str, int]:
        host, _, port = self.url.removeprefix("http://").rstrip("/").rpartition(":")
        return host, int(port)

    def client(self, source: str = ATTACKER, timeout: float = PATIENCE) -> httpx.Client:
        """A client with an address of its own."""
        limits = httpx.Limits(max_connections=None, max_keepalive_connections=0)
        transport = httpx.HTTPTransport(local_address=source, limits=limits)
        return httpx.Client(base_url=self.url, timeout=timeout, transport=transport, trust_env=False)

    def connect(self, source: str = ATTACKER, timeout: float = 15.0) -> socket.socket:
        return socket.create_connection(self.address, timeout, (source, 0))

    # --- the honest client

    def honest(self, timeout: float = PATIENCE) -> float:
        """Seconds of a small render that nobody asked for before. Raises httpx.HTTPError where it is refused."""
        start = time.perf_counter()
        with self.client(HONEST, timeout) as client:
            answer = client.post("/v1/render", files={"stage": ("a.usda", BALL.encode())}, data=_fresh())
            answer.raise_for_status()
        return time.perf_counter() - start

    def recovered(self, seconds: float) -> float | None:
        """Seconds until it takes connections, is ready and renders again; None where it does not within `seconds`."""
        start = time.perf_counter()
        while time.perf_counter() - start < seconds:
            with contextlib.suppress(httpx.HTTPError), self.client(HONEST, 10.0) as client:
                if client.get("/readyz").status_code == 200:
                    self.honest(seconds)
                    return time.perf_counter() - start
            time.sleep(0.05)
        return None

    # --- what it holds

    def family(self) -> list[int]:
        return _family(self.process.pid)

    def metric(self, name: str, labels: str = "") -> float:
        """Sum of one metric over its labels, or over those that match."""
        with self.client(HONEST, 60.0) as client:
            lines = client.get("/metrics").text.splitlines()
        wanted = re.compile(rf"{name}(\{{.*{labels}.*\}}){'?' if not labels else ''} ")
        return sum(float(line.rpartition(" ")[2]) for line in lines if wanted.match(line))

    def idle(self, seconds: float = PATIENCE) -> bool:
        """Wait until nothing waits or runs."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            with contextlib.suppress(httpx.HTTPError):
                if self.metric("refract_jobs_running") + self.metric("refract_jobs_queued") == 0.0:
                    return True
            time.sleep(0.1)
        return False

    def held(self) -> Held:
        every = self.family()
        files = sum(1 for place in (self.data / "work", self.temporary) for _ in place.rglob("*"))
        return Held(len(every), sum(map(_descriptors, every)), files, _shared(), sum(map(_memory, every)))

    def settled(self, before: Held, *, well: bool = True) -> Held:
        """What it holds when all is done. `well`: it does jobs, so that there is something to wait for."""
        self.idle(PATIENCE if well else 5.0)
        end = time.monotonic() + _SETTLE
        while True:
            now = self.held()
            if now[:4] == before[:4] or time.monotonic() > end:
                return now
            time.sleep(0.5)


_numbers = itertools.count(1)


def _fresh(**settings: Any) -> dict[str, str]:
    """Settings of a form that no job had before."""
    words = {**QUICK, **settings, "exposure": next(_numbers) * 1e-6}
    return {"settings": str(words).replace("'", '"')}


def fresh(**settings: Any) -> dict[str, Any]:
    """A render of the sample under the stage root that nobody asked for before."""
    return {"stage": STAGE, **QUICK, **settings, "exposure": next(_numbers) * 1e-6}


@contextlib.contextmanager
def besieged(
    folder: Path,
    *words: str,
    descriptors: int = 0,
    data: Path | None = None,
    program: tuple[str, ...] = ("-m", "refract_core.cli"),
    variables: Mapping[str, str] | None = None,
) -> Iterator[Siege]:
    """A service with the default limits, until the end of the block.

    Args:
        folder: for its log and, where `data` is not given, its jobs.
        words: further words of its command line.
        descriptors: RLIMIT_NOFILE of the service; 0 leaves it.
        data: its folder of jobs.
        program: what Python runs as `refract`.
        variables: further ones of its environment.
    """
    data, temporary = data or folder / "data", folder / "tmp"
    temporary.mkdir(exist_ok=True)
    command = [sys.executable, *program, "serve", "--port", "0", "--stage-root", str(GOOD), "--data",
               str(data), *words]  # fmt: skip
    if descriptors:
        command = [sys.executable, "-c", _LOWER, str(descriptors), *command]
    log = folder / "log"
    with open(log, "a") as errors:
        process = subprocess.Popen(
            command, cwd=ROOT, stdout=subprocess.PIPE, stderr=errors, text=True,
            env={**os.environ, "TMPDIR": str(temporary), **(variables or {})},
        )  # fmt: skip
    assert process.stdout
    try:
        found = re.search(r"http://\S+", process.stdout.readline())
        if not found:
            raise RuntimeError(f"the service did not start:\n{log.read_text()[-2000:]}")
        siege = Siege(found.group(), process, data, log, temporary)
        end = time.monotonic() + WARM_UP
        while not _ready(siege):
            if process.poll() is not None or time.monotonic() > end:
                raise RuntimeError(f"the service is not ready:\n{log.read_text()[-2000:]}")
            time.sleep(0.05)
        yield siege
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
        try:
            process.wait(60.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()


_LOWER = """
import os, resource, sys
most = int(sys.argv[1])
resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
os.execv(sys.argv[2], sys.argv[2:])
"""


def end_in_order() -> None:
    """Let SIGTERM end this program as Ctrl-C does, so that no service of its own is left."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)


def many_sockets() -> int:
    """Let this process have as many descriptors as it may. Returns how many."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    return most


def _ready(siege: Siege) -> bool:
    with contextlib.suppress(httpx.HTTPError), siege.client(HONEST, 10.0) as client:
        return client.get("/readyz").status_code == 200
    return False


def _family(pid: int) -> list[int]:
    found = [pid]
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            found += [other for child in path.read_text().split() for other in _family(int(child))]
    return found


def _descriptors(pid: int) -> int:
    with contextlib.suppress(OSError):
        return len(os.listdir(f"/proc/{pid}/fd"))
    return 0


def _memory(pid: int) -> int:
    with contextlib.suppress(OSError):
        found = re.search(r"^Pss:\s+(\d+)", Path(f"/proc/{pid}/smaps_rollup").read_text(), re.MULTILINE)
        return int(found.group(1)) * 1024 if found else 0
    return 0


def _shared() -> int:
    posix = sum(len(os.listdir(place)) for place in ("/dev/shm", "/dev/mqueue") if Path(place).is_dir())
    tables = [Path(f"/proc/sysvipc/{name}") for name in ("shm", "sem", "msg")]
    return posix + sum(max(0, len(table.read_text().splitlines()) - 1) for table in tables if table.is_file())


def cpu_seconds(siege: Siege) -> float:
    """Processor time of what runs, and of workers that have ended [s]."""
    total = 0.0
    for pid in siege.family():
        with contextlib.suppress(OSError):
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
            total += sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")
    return total


def leaks(before: Held, after: Held) -> Sequence[str]:
    """What was not there before, for people. Memory is no part of it: records of jobs are kept."""
    names = Held._fields[:4]
    return [
        f"{late - early:+d} {name}"
        for name, early, late in zip(names, before[:4], after[:4], strict=True)
        if late > early
    ]
