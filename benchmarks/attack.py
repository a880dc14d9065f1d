"""Attacks on a service of our own, with the default limits, over the loopback alone: what comes back, and what stays.

    python -m benchmarks.attack [--parts NAMES] [--mutants 5000] [--write]

Each part has a service of its own. A row of the table says how many requests were sent, what must not be among the
answers (a status that is the service's own fault, a path of the server, no answer at all), how often it told what it
could not do then (501, 503, 507), what was still there when all was over (processes, descriptors, files, shared
memory), what its memory grew by, and the seconds until it was ready and rendered for somebody else. It takes about half
an hour on two cores; `--mutants` makes it shorter. Ends with 1 where something must not be. `--write` puts the table
into docs/attack.md.

    mutants      damaged stages, with known seeds, for all verbs
    prims        small stages that are large when they are composed
    pictures     pictures that claim more than they are, or unpack to more
    packages     zips
    protocol     bytes that are no HTTP, or that two programs may read differently
    escapes      code inside a worker that wants out (those of tests/escape_worker.py)
    heads        1,100 half-sent heads, and 512 descriptors
    bodies       bodies that trickle
    cancels      jobs that are cancelled, asked for again and left, all at once
    kills        kill -9 of the worker, of the process that forks workers, and of the service
    descriptors  192 descriptors, 400 connections
    disk, inodes a folder of jobs without room; needs to be root, for a small tmpfs
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import httpx

from refract_core.errors import UsageError

from . import hostile, pages
from .besieged import QUICK, Siege, Tally, besieged, cpu_seconds, end_in_order, fresh, leaks, many_sockets
from .hostile import Protocol

PAGE = pages.ROOT / "docs" / "attack.md"
VERBS = ("render", "inspect", "validate", "convert")
RECOVERY = 120.0
"""[s] What is not well by then stays ill."""
_AT_ONCE = 2
_ENDLESS = (
    b"POST /v1/render HTTP/1.1\r\nHost: localhost\r\nContent-Type: multipart/form-data; boundary=x\r\n"
    b'Content-Length: 100000\r\n\r\n--x\r\nContent-Disposition: form-data; name="stage"; filename="a"\r\n\r\n#usda'
)
"""A request whose body has begun well."""
_MEGA = 1 << 20


class Options(NamedTuple):
    """What the command line says."""

    mutants: int = 5000
    damaged_requests: int = 100
    races: int = 200
    bombs: int | None = None
    """of each kind; None is all of them"""


class Row(NamedTuple):
    """A line of the table."""

    name: str
    tally: Tally
    leaks: tuple[str, ...] = ()
    growth: int = 0
    """[bytes] memory of all processes, after less before"""
    recovery: float | None = None
    """[s]"""

    @property
    def holds(self) -> bool:
        return not self.tally.faults and not self.leaks and self.recovery is not None


# --- what is sent ----------------------------------------------------------------------------------------------------


def _post(siege: Siege, tally: Tally, what: str, verb: str, stage: bytes, **settings: Any) -> None:
    """Send a stage, patiently: who is refused for too many tries again."""
    words = {**QUICK, **settings} if verb == "render" else {}
    while True:
        try:
            with siege.client() as client:
                answer = client.post(f"/v1/{verb}", files={"stage": ("a", stage)}, data={"settings": json.dumps(words)})
        except httpx.TimeoutException:
            return tally.event(what, "no answer", fault=True)
        except httpx.TransportError as error:
            return tally.event(what, f"cut off: {type(error).__name__}", fault=True)
        if answer.status_code != 429:
            break
        time.sleep(min(float(answer.headers.get("retry-after", "1")), 2.0))
    plain = answer.headers.get("content-type", "").endswith("json")
    tally.answer(what, answer.status_code, answer.text if plain else "")


def _all(jobs: Iterable[Callable[[], None]], threads: int = _AT_ONCE) -> None:
    with ThreadPoolExecutor(threads) as pool:
        for job in [pool.submit(job) for job in jobs]:
            job.result()


def mutants(siege: Siege, tally: Tally, options: Options) -> None:
    def one(number: int, name: str, content: bytes) -> None:
        _post(siege, tally, name, VERBS[number % 5 % 4], content)

    _all(partial(one, number, name, content) for number, (name, content) in enumerate(hostile.damaged(options.mutants)))
    tally.notes.append(f"{siege.metric('refract_worker_crashes_total'):.0f} workers crashed")


def _bombs(make: Callable[[], Mapping[str, bytes]]) -> Callable[[Siege, Tally, Options], None]:
    def attack(siege: Siege, tally: Tally, options: Options) -> None:
        spent = 0.0
        for name, content in list(make().items())[: options.bombs]:
            before = cpu_seconds(siege)
            start = time.monotonic()
            _post(siege, tally, name, "render", content)
            used = max(cpu_seconds(siege) - before, 0.0)
            if used > spent:
                spent, worst = used, f"{used:.1f} CPU s at most ({name}, {time.monotonic() - start:.0f} s)"
        if spent:
            tally.notes.append(worst)

    return attack


def protocol(siege: Siege, tally: Tally, options: Options) -> None:
    attacks = hostile.protocol_attacks(options.damaged_requests)
    _all((partial(_raw, siege, tally, name, one) for name, one in attacks.items()), 32)


def _raw(siege: Siege, tally: Tally, name: str, one: Protocol) -> None:
    said, ended = b"", False
    with siege.connect() as connection:
        connection.settimeout(45.0)  # more than header_seconds and body_seconds
        with contextlib.suppress(OSError):
            connection.sendall(one.sent)
        with contextlib.suppress(OSError):
            while True:
                data = connection.recv(65536)
                if not data:
                    ended = True
                    break
                said = (said + data)[-1_000_000:]
                connection.settimeout(1.0 if not one.alone else 4.0)  # more answers, or the end
    text = said.decode("latin-1")
    answers = [int(part.split(" ", 2)[1]) for part in text.split("HTTP/1.1")[1:] if part[1:4].isdigit()]
    if not answers:
        quiet = ended or not one.sent
        return tally.event(name, "closed" if quiet else "no answer", fault=not quiet or bool(one.allowed))
    tally.answer(name, answers[0], text)
    if one.allowed and answers[0] not in one.allowed:
        tally.faults.append(f"{name}: {answers[0]}")
    if one.alone and len(answers) > 1:
        tally.faults.append(f"{name}: {len(answers)} answers to one request")
    elif one.alone and not ended:
        tally.faults.append(f"{name}: the connection stays open")


def escapes(siege: Siege, tally: Tally, options: Options) -> None:
    """A worker that is the attacker's own code from the lock on; what it does and says is in tests/escape_worker.py."""
    victim = siege.data.parent / "victim"
    victim.write_text("theirs")

    def do(what: str) -> httpx.Response:
        stage = f"#usda 1.0\n# {json.dumps({'do': what, 'victim': str(victim)})}"
        with siege.client() as client:
            return client.post("/v1/inspect", files={"stage": ("a.usda", stage.encode())})

    answer = do("all")
    job = answer.headers["content-location"].rpartition("/")[2]
    for ways in json.loads((siege.data / "jobs" / job / "report.json").read_text()).values():
        for name, said in ways.items():
            refused = str(said).startswith("refused")
            tally.event(name, "refused" if refused else str(said)[:80], fault=not refused)
    for name in ("many files", "deep", "many threads"):  # more than the limits that every service has
        answer = do(name)
        tally.answer(name, answer.status_code, answer.text)
        if answer.status_code != 422:
            tally.faults.append(f"{name}: {answer.status_code}")
    if victim.read_text() != "theirs":
        tally.faults.append("a file of others was written")


def _escapes(folder: Path, options: Options) -> Iterator[Row]:
    program = pages.ROOT / "tests" / "escape_server.py"
    if not program.is_file():
        raise UsageError(f"{program.relative_to(pages.ROOT)} is not there")
    secret = {"AWS_SECRET_ACCESS_KEY": "Xyzzy", "REFRACT_TOKEN": "Xyzzy"}
    yield _row("escapes from inside", escapes, folder, options, program=(str(program),), variables=secret)


def _half_heads(siege: Siege, tally: Tally, count: int) -> None:
    """Hold connections whose heads do not end while jobs begin and end, ask as somebody else, then let go."""
    many_sockets()
    with siege.client() as client:
        wishes = [fresh(image_width=320, samples=4) for _ in range(8)]
        asked = [client.post("/v1/render", json=wish, headers={"Prefer": "respond-async"}) for wish in wishes]
    with contextlib.ExitStack() as stack:
        for _ in range(count):
            try:
                connection = stack.enter_context(siege.connect())
                connection.sendall(b"POST /v1/render HTTP/1.1\r\nHost: localhost\r\nX-Slow: ")
                tally.event("head", "half sent")
            except OSError as error:
                tally.event("head", f"not taken: {type(error).__name__}")
        _meanwhile(siege, tally)
    end = time.monotonic() + RECOVERY
    for answer in asked:
        tally.answer("asks", answer.status_code, answer.text)
        if answer.status_code == 202:
            _how_it_ended(siege, tally, answer.headers["location"], end)


def _meanwhile(siege: Siege, tally: Tally) -> None:
    try:
        seconds = siege.honest(20.0)
    except httpx.HTTPStatusError as error:
        tally.notes.append(f"somebody else meanwhile: {error.response.status_code}")
        tally.answer("somebody else", error.response.status_code, error.response.text)
    except httpx.HTTPError as error:
        tally.notes.append(f"somebody else meanwhile: {type(error).__name__}")
    else:
        tally.notes.append(f"somebody else meanwhile: {seconds:.2f} s")


def heads(siege: Siege, tally: Tally, options: Options) -> None:
    _half_heads(siege, tally, 1100)


def descriptors(siege: Siege, tally: Tally, options: Options) -> None:
    _half_heads(siege, tally, 400)


def bodies(siege: Siege, tally: Tally, options: Options) -> None:
    """More bodies than there are places, a byte at a time, and somebody else."""
    stop = threading.Event()

    def trickle() -> None:
        with siege.connect() as connection:
            connection.settimeout(1.0)
            said, end = b"", time.monotonic() + 60.0
            with contextlib.suppress(OSError):
                connection.sendall(_ENDLESS)
                while not stop.wait(1.0) and not said and time.monotonic() < end:
                    connection.sendall(b"a")
                    with contextlib.suppress(TimeoutError):
                        said = connection.recv(65536)
        text = said.decode("latin-1")
        if text:
            tally.answer("trickle", int(text.split(" ", 2)[1]), text)
        else:
            tally.event("trickle", "left")

    with ThreadPoolExecutor(64) as pool:
        for _ in range(64):
            pool.submit(trickle)
        time.sleep(3.0)
        _meanwhile(siege, tally)
        time.sleep(35.0)  # beyond body_seconds
        stop.set()


def cancels(siege: Siege, tally: Tally, options: Options) -> None:
    """Jobs that end in every way at once: cancelled before, while and after they start, left, and asked for again."""

    def race(number: int) -> None:
        dice = random.Random(number)
        wish = fresh(image_width=dice.choice([16, 320]), samples=dice.choice([1, 16]))
        try:
            with siege.client() as client:
                if dice.random() < 0.3:  # leaves without a word
                    with contextlib.suppress(httpx.TimeoutException):
                        client.post("/v1/render", json=wish, timeout=dice.choice([0.01, 0.1, 0.5]))
                    return tally.event("leaves", "left")
                answer = client.post("/v1/render", json=wish, headers={"Prefer": "respond-async"})
                tally.answer("asks", answer.status_code, answer.text)
                if answer.status_code != 202:
                    return time.sleep(0.2)
                where = answer.headers["location"]
                time.sleep(dice.choice([0.0, 0.0, 0.05, 0.3]))
                for verb, path in dice.sample([("DELETE", where), ("GET", f"{where}/image"), ("DELETE", where),
                                               ("POST", "/v1/render"), ("GET", where)], 3):  # fmt: skip
                    answer = client.request(verb, path, json=wish if verb == "POST" else None,
                                            headers={"Prefer": "respond-async"})  # fmt: skip
                    plain = answer.headers.get("content-type", "").endswith("json")
                    tally.answer(verb, answer.status_code, answer.text if plain else "")
        except httpx.TimeoutException:
            tally.event("race", "no answer", fault=True)
        except httpx.TransportError as error:
            tally.event("race", f"cut off: {type(error).__name__}", fault=True)

    _all((partial(race, number) for number in range(options.races)), 8)


# --- what is taken away ----------------------------------------------------------------------------------------------


def kills(folder: Path, options: Options) -> Iterator[Row]:
    """kill -9 of each process, with a job under way."""
    for victim in ("worker", "forker"):
        name = {"worker": "kill -9: worker", "forker": "kill -9: forks workers"}[victim]

        def attack(siege: Siege, tally: Tally, _options: Options, victim: str = victim) -> None:
            where = _long_job(siege)
            forker = max(_children(siege.process.pid), key=lambda pid: len(_children(pid)))
            for pid in _children(forker) if victim == "worker" else [forker]:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            _how_it_ended(siege, tally, where)

        yield _row(name, attack, folder, options)
    yield _killed_service(folder)


def _long_job(siege: Siege) -> str:
    """A job that runs. Returns its address."""
    with siege.client() as client:
        answer = client.post(
            "/v1/render", json=fresh(image_width=1920, samples=64), headers={"Prefer": "respond-async"}
        )
        where = str(answer.headers["location"])
        end = time.monotonic() + 60.0
        while client.get(where).json()["fraction"] <= 0.0 and time.monotonic() < end:
            time.sleep(0.02)
    return where


def _how_it_ended(siege: Siege, tally: Tally, where: str, end: float = 0.0) -> None:
    """`end`: of patience, by `time.monotonic`; 0 is in half a minute."""
    end = end or time.monotonic() + 30.0
    with siege.client() as client:
        while True:
            try:
                job = client.get(where, timeout=10.0).json()
            except httpx.HTTPError as error:
                job = {"status": f"not told: {type(error).__name__}"}
            if job["status"] in ("done", "failed", "cancelled"):
                break
            if time.monotonic() > end:
                return tally.event("job", f"a job is still {job['status']}", fault=True)
            time.sleep(0.05)
    tally.event("job", (job["problem"] or {"type": job["status"]})["type"].removeprefix("/problems/"))


def _children(pid: int) -> list[int]:
    found = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(OSError):
            found += [int(word) for word in path.read_text().split()]
    return found


def _killed_service(folder: Path) -> Row:
    tally = Tally()
    place = _new(folder)
    with besieged(place) as first:
        for _ in range(4):
            first.honest()
        first.idle()
        time.sleep(1.0)
        before = first.held()
        where, family = _long_job(first), first.family()
        first.process.kill()
        first.process.wait()
        time.sleep(1.0)
        left = [pid for pid in family if _lives(pid)]
        if left:
            tally.event("kill", f"{len(left)} processes outlive it", fault=True)
    start = time.monotonic()
    with besieged(place) as second:
        recovery = time.monotonic() - start
        _how_it_ended(second, tally, where)
        second.honest()
        after = second.settled(before)
        return Row("kill -9: service", tally, tuple(leaks(before, after)), after.memory - before.memory, recovery)


def _lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "XZ"
    except OSError:
        return False


@contextlib.contextmanager
def _small_disk(place: Path, options: str) -> Iterator[None]:
    """A tmpfs. Raises UsageError where this user may not mount one."""
    place.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(place)], capture_output=True, text=True)
    if done.returncode:
        raise UsageError(f"a tmpfs cannot be mounted: {done.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


def _shortage(
    name: str, options_of_disk: str, use_up: Callable[[Path], None]
) -> Callable[[Path, Options], Iterator[Row]]:
    def part(folder: Path, options: Options) -> Iterator[Row]:
        place = _new(folder)
        with _small_disk(place / "disk", options_of_disk):

            def attack(siege: Siege, tally: Tally, _options: Options) -> None:
                fill = siege.data / "fill"
                fill.mkdir()
                try:
                    use_up(fill)
                    for number in range(12):
                        wish = fresh()
                        with siege.client() as client:
                            answer = client.post("/v1/render", **_as(wish, number % 2 == 0), timeout=60.0)
                            plain = answer.headers.get("content-type", "").endswith("json")
                            tally.answer("render", answer.status_code, answer.text if plain else "")
                    with siege.client() as client:
                        tally.notes.append(f"/readyz meanwhile: {client.get('/readyz').status_code}")
                    half = [path for path in (siege.data / "jobs").rglob("*") if path.name.startswith(".")]
                    tally.faults += [f"half-written: {len(half)} files"] if half else []
                finally:
                    subprocess.run(["rm", "-rf", str(fill)], check=True)

            yield _row(name, attack, folder, options, data=place / "disk" / "data")

    return part


def _as(wish: dict[str, Any], uploaded: bool) -> dict[str, Any]:
    """The same wish with its stage by name, or with a stage sent along."""
    if not uploaded:
        return {"json": wish}
    settings = json.dumps({name: value for name, value in wish.items() if name != "stage"})
    return {"files": {"stage": ("a.usda", hostile.BALL.encode())}, "data": {"settings": settings}}


def _use_up_bytes(fill: Path) -> None:
    with open(fill / "a", "wb", buffering=0) as file, contextlib.suppress(OSError):
        while file.write(b"\0" * 65536) == 65536:
            pass
    with open(fill / "b", "wb", buffering=0) as file, contextlib.suppress(OSError):
        while file.write(b"\0" * 512):
            pass


def _use_up_inodes(fill: Path) -> None:
    with contextlib.suppress(OSError):
        for number in range(1_000_000):
            (fill / str(number)).touch()


# --- the table -------------------------------------------------------------------------------------------------------

Attack = Callable[[Siege, Tally, Options], None]


def _new(folder: Path) -> Path:
    return Path(tempfile.mkdtemp(dir=folder))


def _row(name: str, attack: Attack, folder: Path, options: Options, **how: Any) -> Row:
    """One attack on a service of its own."""
    tally = Tally()
    with besieged(_new(folder), **how) as siege:
        for _ in range(4):
            siege.honest()
        siege.idle()
        time.sleep(1.0)
        before = siege.held()
        attack(siege, tally, options)
        recovery = siege.recovered(RECOVERY)
        after = siege.settled(before, well=recovery is not None)
    return Row(name, tally, tuple(leaks(before, after)), after.memory - before.memory, recovery)


def _part(name: str, attack: Attack, **how: Any) -> Callable[[Path, Options], Iterator[Row]]:
    def part(folder: Path, options: Options) -> Iterator[Row]:
        yield _row(name, attack, folder, options, **how)

    return part


PARTS: dict[str, Callable[[Path, Options], Iterator[Row]]] = {
    "protocol": _part("no HTTP", protocol),
    "escapes": _escapes,
    "heads": _part("1,100 half-sent heads", heads, descriptors=512),
    "bodies": _part("64 bodies that trickle", bodies),
    "cancels": _part("cancel races", cancels),
    "kills": kills,
    "descriptors": _part("192 descriptors, 400 half-sent heads", descriptors, descriptors=192),
    "disk": _shortage("a full disk", "size=8m", _use_up_bytes),
    "inodes": _shortage("no inodes", "size=64m,nr_inodes=200", _use_up_inodes),
    "packages": _part("zip bombs", _bombs(hostile.package_bombs)),
    "pictures": _part("image bombs", _bombs(hostile.image_bombs)),
    "prims": _part("prim bombs", _bombs(hostile.prim_bombs)),
    "mutants": _part("damaged stages", mutants),
}


HEAD = ("attack", "sent", "must not be", "told 501, 503, 507", "left behind", "memory", "recovered", "to know")


def cells(row: Row) -> list[str]:
    recovery = "never" if row.recovery is None else f"{row.recovery:.1f} s"
    numbers = [f"{row.tally.sent:,}", str(len(row.tally.faults)), str(row.tally.told)]
    left = ", ".join(row.leaks) or "nothing"
    return [row.name, *numbers, left, f"{row.growth / _MEGA:+.0f} MiB", recovery, "; ".join(row.tally.notes) or "-"]


def table(rows: Iterable[Row]) -> str:
    """Markdown, for the page."""
    return pages.table(HEAD, [cells(row) for row in rows])


def details(row: Row) -> str:
    """What the table has no room for."""
    lines = [", ".join(f"{name}: {cell}" for name, cell in zip(HEAD, cells(row), strict=True))]
    lines.append("    " + ", ".join(f"{count} {name}" for name, count in row.tally.outcomes.most_common()))
    return "\n".join([*lines, *(f"    MUST NOT BE: {fault}" for fault in row.tally.faults[:40])])


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split(","))


def main() -> None:
    """Print the table, and write it where asked to. Ends with 1 where something must not be."""
    end_in_order()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", type=_names, default=tuple(PARTS))
    parser.add_argument("--mutants", type=int, default=Options().mutants)
    parser.add_argument("--write", action="store_true", help=f"into {PAGE.relative_to(pages.ROOT)}")
    chosen = parser.parse_args()
    if unknown := [name for name in chosen.parts if name not in PARTS]:
        parser.error(f"--parts has {', '.join(unknown)}; choose from {', '.join(PARTS)}")
    if chosen.write and set(chosen.parts) != set(PARTS):
        parser.error("--write is for the whole table; leave --parts out")
    rows, left_out = list[Row](), list[str]()
    with tempfile.TemporaryDirectory(prefix="attack-") as folder:
        for name in chosen.parts:
            try:
                for row in PARTS[name](Path(folder), Options(mutants=chosen.mutants)):
                    rows.append(row)
                    print(details(row), flush=True)
            except UsageError as error:
                left_out.append(f"{name} is left out: {error}")
                print(left_out[-1], flush=True)
    print(f"\n{table(rows)}\n")
    if chosen.write:
        words = [f"`python -m benchmarks.attack` on {pages.machine()}.", "", table(rows)]
        pages.write(PAGE, {"attack": "\n".join([*words, *([""] if left_out else []), *left_out])})
    raise SystemExit(int(not all(row.holds for row in rows)))


if __name__ == "__main__":
    main()
