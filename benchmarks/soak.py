"""An honest load for some minutes, and the same beside one client that floods.

    python -m benchmarks.soak [--minutes 10] [--write]

The service has the default limits and a worker for each core. Every request is a 320 x 180 render of marble.usda that
nobody asked for before. In four parts of equal length:

    quiet       one client, one request after the other: the p50 and p99 that others are compared with
    full        requests from as many clients as there are cores, and one more; by turns with the engine alone: one
                process for each core that reads the stage, renders it with one thread and writes it, again and again
    attacked    the quiet client again, beside another address that keeps asking for the same renders from 24 threads,
                holds 24 bodies that trickle and listens to events without end
    after       the quiet client alone: whether it is as before

Memory and descriptors are those of all processes of the service, every five seconds. `--write` puts the table into
docs/attack.md.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import httpx

import refract_core as rc

from . import pages
from .attack import PAGE
from .besieged import ATTACKER, GOOD, HONEST, STAGE, Held, Siege, besieged, cpu_seconds, end_in_order, fresh

SIZE = {"image_width": 320, "image_height": 180, "samples": 1}
_TURNS = 3
_FLOOD = 24
_REST = 0.2  # [s] of the quiet client between two requests
_LOOK = 5.0  # [s]


class Heard(NamedTuple):
    """One part, for one client or several."""

    seconds: tuple[float, ...]
    """of each request that was answered"""
    refused: int
    failed: tuple[str, ...]
    """What must not be."""

    @property
    def p50(self) -> float:
        return statistics.median(self.seconds)

    @property
    def p99(self) -> float:
        """The largest of fewer than a hundred."""
        return sorted(self.seconds)[min(len(self.seconds) - 1, int(0.99 * len(self.seconds)))]


class Rate(NamedTuple):
    """Renders of one side in all its turns."""

    renders: int
    seconds: float
    cpu: float
    """[s] processor time of all that took part"""


class Soaked(NamedTuple):
    """What was measured."""

    quiet: Heard
    attacked: Heard
    after: Heard
    full: Heard
    served: Rate
    alone: Rate
    held: tuple[Held, ...]
    """every few seconds"""
    flooded: int
    """requests of the flood"""


def ask(siege: Siege, source: str, until: float, rest: float) -> Heard:
    """Ask for one render after the other, until a time by `time.monotonic`."""
    took, refused, failed = list[float](), 0, list[str]()
    with siege.client(source) as client:
        while time.monotonic() < until:
            start = time.perf_counter()
            try:
                answer = client.post("/v1/render", json=fresh(**SIZE))
            except httpx.HTTPError as error:
                failed.append(type(error).__name__)
                continue
            if answer.status_code == 200:
                took.append(time.perf_counter() - start)
            elif answer.status_code in (429, 503):
                refused += 1
                time.sleep(min(float(answer.headers.get("retry-after", "1")), 1.0))
            else:
                failed.append(f"{answer.status_code} {answer.text[:200]}")
            time.sleep(rest)
    return Heard(tuple(took), refused, tuple(failed))


def together(siege: Siege, clients: int, until: float) -> Heard:
    with ThreadPoolExecutor(clients) as pool:
        found = list(pool.map(lambda _: ask(siege, HONEST, until, 0.0), range(clients)))
    return Heard(
        tuple(second for one in found for second in one.seconds), sum(one.refused for one in found),
        tuple(word for one in found for word in one.failed),
    )  # fmt: skip


# --- the engine alone ------------------------------------------------------------------------------------------------


def engine(seconds: float) -> None:
    """In a process of its own: render for so long, once before it counts. Prints renders, seconds and CPU seconds."""
    settings = rc.RenderSettings(**SIZE, jobs=1)  # type: ignore[arg-type]
    with tempfile.TemporaryDirectory() as folder:
        rc.render(rc.load_stage(GOOD / STAGE), settings).save(Path(folder) / "a.png")
        print("warm", flush=True)
        sys.stdin.readline()
        start, cpu, count = time.perf_counter(), time.process_time(), 0
        while time.perf_counter() - start < seconds:
            rc.render(rc.load_stage(GOOD / STAGE), settings).save(Path(folder) / "a.png")
            count += 1
        print(count, time.perf_counter() - start, time.process_time() - cpu, flush=True)


def alone(cores: int, seconds: float) -> Rate:
    """One such process for each core, all at once."""
    code = f"from benchmarks.soak import engine; engine({seconds!r})"
    every = [
        subprocess.Popen([sys.executable, "-c", code], cwd=pages.ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                         text=True)
        for _ in range(cores)
    ]  # fmt: skip
    for one in every:
        assert one.stdout
        assert one.stdout.readline() == "warm\n"
    said = [one.communicate("go\n")[0].split() for one in every]
    counts, times, cpu = zip(*((int(a), float(b), float(c)) for a, b, c in said), strict=True)
    return Rate(sum(counts), max(times), sum(cpu))


def full(siege: Siege, cores: int, seconds: float) -> tuple[Heard, Rate, Rate]:
    """The service and the engine by turns."""
    heard, ours, theirs = list[Heard](), list[Rate](), list[Rate]()
    for _ in range(_TURNS):
        theirs.append(alone(cores, seconds / _TURNS / 2))
        before, start = cpu_seconds(siege), time.monotonic()
        heard.append(together(siege, cores + 1, start + seconds / _TURNS / 2))
        ours.append(Rate(len(heard[-1].seconds), time.monotonic() - start, cpu_seconds(siege) - before))
    every = Heard(
        tuple(second for one in heard for second in one.seconds), sum(one.refused for one in heard),
        tuple(word for one in heard for word in one.failed),
    )  # fmt: skip
    return every, _sum(ours), _sum(theirs)


def _sum(rates: Sequence[Rate]) -> Rate:
    return Rate(sum(one.renders for one in rates), sum(one.seconds for one in rates), sum(one.cpu for one in rates))


# --- the flood -------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def flooding(siege: Siege) -> Iterator[Callable[[], int]]:
    """One address that asks for as much as it can get. Gives how often it has asked."""
    stop, asked = threading.Event(), [0] * _FLOOD

    def render(number: int) -> None:
        while not stop.is_set():
            with contextlib.suppress(httpx.HTTPError), siege.client(ATTACKER, 30.0) as client:
                while not stop.is_set():
                    answer = client.post("/v1/render", json=fresh(**SIZE), headers={"Prefer": "respond-async"})
                    asked[number] += 1
                    if answer.status_code == 202 and number % 4 == 0:  # and listens, without reading to the end
                        with client.stream("GET", f"{answer.headers['location']}/events") as stream:
                            next(stream.iter_raw(), b"")
                    elif answer.status_code == 429:
                        stop.wait(0.05)  # sooner than it was told to

    def trickle() -> None:
        head = (b"POST /v1/render HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
                b"Content-Length: 1000\r\n\r\n{")  # fmt: skip
        while not stop.is_set():
            with contextlib.suppress(OSError), siege.connect() as connection:
                connection.sendall(head)
                while not stop.wait(1.0):
                    connection.sendall(b" ")
            stop.wait(0.05)

    with ThreadPoolExecutor(2 * _FLOOD) as pool:
        try:
            for number in range(_FLOOD):
                pool.submit(render, number)
                pool.submit(trickle)
            yield lambda: sum(asked)
        finally:
            stop.set()


@contextlib.contextmanager
def watched(siege: Siege) -> Iterator[list[Held]]:
    """What it holds, every few seconds until the end of the block."""
    stop, found = threading.Event(), list[Held]()

    def look() -> None:
        while not stop.wait(_LOOK):
            found.append(siege.held())

    thread = threading.Thread(target=look)
    thread.start()
    try:
        yield found
    finally:
        stop.set()
        thread.join()


def soak(minutes: float, folder: Path) -> Soaked:
    """All four parts."""
    cores, part = len(os.sched_getaffinity(0)), minutes * 60.0 / 4
    with besieged(folder, "--workers", str(cores)) as siege:
        ask(siege, HONEST, time.monotonic() + min(5.0, part), 0.0)
        with watched(siege) as held:
            quiet = ask(siege, HONEST, time.monotonic() + part, _REST)
            busy, served, engines = full(siege, cores, part)
            with flooding(siege) as asked:
                time.sleep(min(2.0, part))
                attacked = ask(siege, HONEST, time.monotonic() + part, _REST)
                flooded = asked()
            siege.idle()
            after = ask(siege, HONEST, time.monotonic() + part, _REST)
    return Soaked(quiet, attacked, after, busy, served, engines, tuple(held), flooded)


def table(found: Soaked) -> str:
    """Markdown, for the page."""
    head = ["honest client", "renders", "p50", "p99", "p99 / quiet", "refused", "must not be"]
    parts = {"quiet": found.quiet, "as many as there are cores, and one": found.full, "attacked": found.attacked,
             "after": found.after}  # fmt: skip
    rows = [
        [
            name, str(len(one.seconds)), f"{one.p50 * 1e3:.0f} ms" if one.seconds else "-",
            f"{one.p99 * 1e3:.0f} ms" if one.seconds else "-",
            f"{one.p99 / found.quiet.p99:.1f}" if one.seconds else "-", str(one.refused), str(len(one.failed)),
        ]
        for name, one in parts.items()
    ]  # fmt: skip
    return "\n\n".join([pages.table(head, rows), throughput(found), over_time(found)])


def throughput(found: Soaked) -> str:
    ours, theirs = found.served, found.alone
    rates = ours.renders / ours.seconds, theirs.renders / theirs.seconds
    cpu = ours.cpu / max(ours.renders, 1), theirs.cpu / max(theirs.renders, 1)
    return (f"{rates[0]:.1f} renders a second through HTTP, {rates[1]:.1f} by the engine alone on the same cores: "
            f"{rates[0] / rates[1]:.0%}. A render takes {cpu[0]:.2f} CPU s of the service, {cpu[1]:.2f} of the engine. "
            f"The flood asked {found.flooded:,} times.")  # fmt: skip


def over_time(found: Soaked) -> str:
    """Memory and descriptors of the first and the last of the looks."""
    if len(found.held) < 8:
        return "Too short for anything to be said about memory over time."
    some = len(found.held) // 4
    first, last = found.held[:some], found.held[-some:]
    memory = [statistics.median(one.memory for one in part) / 2**20 for part in (first, last)]
    files = [statistics.median(one.descriptors for one in part) for part in (first, last)]
    most = max(one.memory for one in found.held) / 2**20
    return (f"Memory: {memory[0]:.0f} MiB in the first quarter of the time, {memory[1]:.0f} in the last, {most:.0f} "
            f"at most. Descriptors: {files[0]:.0f}, {files[1]:.0f}.")  # fmt: skip


def main() -> None:
    """Print the table, and write it where asked to. Ends with 1 where something must not be."""
    end_in_order()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--write", action="store_true", help=f"into {PAGE.relative_to(pages.ROOT)}")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        found = soak(chosen.minutes, Path(folder))
    text = f"`python -m benchmarks.soak --minutes {chosen.minutes:g}` on {pages.machine()}.\n\n{table(found)}"
    print(text)
    failed = [*found.quiet.failed, *found.full.failed, *found.attacked.failed, *found.after.failed]
    for word in failed[:20]:
        print(f"    MUST NOT BE: {word}")
    if chosen.write:
        pages.write(PAGE, {"soak": text})
    raise SystemExit(int(bool(failed)))


if __name__ == "__main__":
    main()
