"""What HTTP, the queue and a process per job cost, and whether anything stays behind.

    python -m benchmarks.service [--requests 200] [--workers 2] [--repeat 15]

Latency: a 320 x 180 render of marble.usda through a warm service with one worker, and by the engine in this process
(stage read, rendered and saved as the worker does it, the same number of threads), by turns; medians. Throughput:
all requests differ, so none is answered from the store; meanwhile /livez is asked every 20 ms. What the service holds
(memory of all its processes, descriptors, children, bytes of scratch) is read before and after.
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import httpx

import refract_core as rc

GOOD = Path(__file__).parents[1] / "usd_samples" / "good"
STAGE = "marble.usda"
ASKED = {"image_width": 320, "image_height": 180, "samples": 1}


class Held(NamedTuple):
    """What the service holds."""

    processes: int
    memory: int
    """[bytes] proportional set size, all processes"""
    descriptors: int
    scratch: int
    """[bytes]"""


@contextmanager
def service(workers: int, data: Path) -> Iterator[tuple[str, int]]:
    """A server's address and process."""
    command = [sys.executable, "-m", "refract_core.cli", "serve", "--port", "0", "--stage-root", str(GOOD),
               "--workers", str(workers), "--queue", "64", "--data", str(data)]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout
    try:
        found = re.search(r"http://\S+", process.stdout.readline())
        assert found
        while httpx.get(f"{found.group()}readyz", trust_env=False).status_code != 200:
            time.sleep(0.1)
        yield found.group(), process.pid
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait()


def family(pid: int) -> list[int]:
    below = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [pid, *(other for child in below for other in family(int(child)))]


def held(pid: int, data: Path) -> Held:
    every = family(pid)
    memory = 0
    for one in every:
        found = re.search(r"^Pss:\s+(\d+)", Path(f"/proc/{one}/smaps_rollup").read_text(), re.MULTILINE)
        memory += int(found.group(1)) * 1024 if found else 0
    descriptors = sum(len(os.listdir(f"/proc/{one}/fd")) for one in every)
    scratch = sum(path.stat().st_size for path in (data / "work").rglob("*") if path.is_file())
    return Held(len(every), memory, descriptors, scratch)


def engine_seconds(folder: Path) -> float:
    start = time.perf_counter()
    settings = rc.RenderSettings(**ASKED, jobs=os.cpu_count() or 1)  # type: ignore[arg-type]
    rc.render(rc.load_stage(GOOD / STAGE), settings).save(folder / "engine.png")
    return time.perf_counter() - start


def request(client: httpx.Client, number: int) -> float:
    """A render that nobody asked for before."""
    start = time.perf_counter()
    answer = client.post("/v1/render", json={"stage": STAGE, **ASKED, "exposure": number * 1e-5})
    while answer.status_code == 429:
        time.sleep(0.05)
        answer = client.post("/v1/render", json={"stage": STAGE, **ASKED, "exposure": number * 1e-5})
    assert answer.status_code == 200, answer.text
    return time.perf_counter() - start


def latency(repeat: int, folder: Path) -> None:
    through, alone = list[float](), list[float]()
    with service(1, folder / "one") as (url, _), httpx.Client(base_url=url, timeout=60.0, trust_env=False) as client:
        for number in range(-2, repeat):
            time.sleep(0.5)  # the next worker is made ready between requests
            http, engine = request(client, number), engine_seconds(folder)
            if number >= 0:  # the first are slower in this process
                through.append(http)
                alone.append(engine)
    over = statistics.median(one - other for one, other in zip(through, alone, strict=True))
    print(f"latency, 320 x 180: {statistics.median(through) * 1e3:.0f} ms through HTTP, "
          f"{statistics.median(alone) * 1e3:.0f} ms engine alone, overhead {over * 1e3:.0f} ms")  # fmt: skip


def throughput(requests: int, workers: int, folder: Path) -> None:
    with service(workers, folder / "many") as (url, pid):
        with httpx.Client(base_url=url, timeout=120.0, trust_env=False) as client:
            for number in range(4):
                request(client, 1_000_000 + number)
        time.sleep(1.0)
        before = held(pid, folder / "many")
        stop, pulses = threading.Event(), list[float]()

        def pulse() -> None:
            with httpx.Client(base_url=url, timeout=10.0, trust_env=False) as other:
                while not stop.wait(0.02):
                    start = time.perf_counter()
                    other.get("/livez")
                    pulses.append(time.perf_counter() - start)

        listener = threading.Thread(target=pulse)
        listener.start()
        start = time.perf_counter()
        with (
            httpx.Client(base_url=url, timeout=120.0, trust_env=False) as client,
            ThreadPoolExecutor(workers + 1) as pool,
        ):
            times = list(pool.map(lambda number: request(client, number), range(1, requests + 1)))
        seconds = time.perf_counter() - start
        stop.set()
        listener.join()
        time.sleep(2.0)  # the last connections and folders go
        after = held(pid, folder / "many")
    cuts = statistics.quantiles(pulses, n=100)
    print(f"throughput, {workers} workers: {requests} requests in {seconds:.1f} s, {requests / seconds:.2f} a second, "
          f"median {statistics.median(times) * 1e3:.0f} ms")  # fmt: skip
    print(f"/livez meanwhile: median {statistics.median(pulses) * 1e3:.1f} ms, p99 {cuts[98] * 1e3:.1f} ms")
    for name, old, new in zip(Held._fields, before, after, strict=True):
        print(f"  {name:12} before {old:>12,}  after {new:>12,}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--requests", type=int, default=200)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=15)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        latency(options.repeat, Path(folder))
        throughput(options.requests, options.workers, Path(folder))


if __name__ == "__main__":
    main()
