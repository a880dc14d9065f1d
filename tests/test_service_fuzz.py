"""Damaged stages, byte by byte: every one is drawn, described or refused in our own words, and nothing else happens.

100 files; `REFRACT_FUZZ=5000` sends 5000.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import re
import struct
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
from pxr import Sdf, Usd, UsdUtils
from service_server import BALL, PATIENT, ROOT, SMALL, Server, files_under, running, until, upload

from service.problems import KINDS

pytestmark = pytest.mark.slow
COUNT = int(os.environ.get("REFRACT_FUZZ", "100"))
WORKERS = 2
LISTENS = "0A"
"""State of a socket in /proc/net/tcp that is no connection."""
GOOD = ROOT / "usd_samples" / "good"
SAMPLES = ("room_of_checkers", "baked_and_realtime")
"""One with a texture and a room, one of several layers with glass and probes."""
THEIRS = {"stage-invalid", "stage-refused", "stage-crashed", "time-limit", "memory-limit", "limit-exceeded",
          "unsupported-media-type"}  # fmt: skip
"""What may be said of a damaged file."""
WORDS = re.compile(
    r"Traceback|(?<![\w.:])\w+(?:Error|Exception)\b|\.(?:cpp|py|so)\b|\bpxr|\bTf_|\bSdf_|\b0x[0-9a-f]{4,}"
)
"""What only the text of an exception has."""
NUMBERS = [b"nan", b"inf", b"-1", b"0", b"1e38", b"1e999", b"-1e30", b"2147483647", b"4294967296", b"1e-45", b"None"]


# --- files


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Each sample in one layer as text and as a crate, and with all its files as a package."""
    folder = tmp_path_factory.mktemp("sources")
    found = {}
    for name in SAMPLES:
        path = f"{GOOD}/{name}.usda"
        stage = Usd.Stage.Open(path)
        layer = stage.GetRootLayer() if len(stage.GetUsedLayers()) <= 2 else stage.Flatten()
        whole = Sdf.Layer.CreateAnonymous(".usda")
        whole.TransferContent(layer)
        whole.documentation = ""  # USD notes there where a flattened stage comes from
        UsdUtils.ModifyAssetPaths(whole, lambda asset: asset.replace(f"{GOOD}/", "./"))
        for extension in ("usda", "usdc"):
            assert whole.Export(str(folder / f"{name}.{extension}"))
        assert UsdUtils.CreateNewUsdzPackage(path, str(folder / f"{name}.usdz"))
        for extension in ("usda", "usdc", "usdz"):
            found[f"{name}.{extension}"] = (folder / f"{name}.{extension}").read_bytes()
    return found


def _number(data: bytearray, dice: random.Random) -> None:
    """Where the file has text, another number; else another word of 4 or 8 bytes."""
    numbers = list(re.finditer(rb"(?<![\w.])-?\d[\d.]*", bytes(data[8:])))
    if numbers and dice.random() < 0.7:
        chosen = dice.choice(numbers)
        data[8 + chosen.start() : 8 + chosen.end()] = dice.choice(NUMBERS)
        return
    at, size = dice.randrange(8, len(data)), dice.choice(["<I", "<Q", "<f", "<d"])
    value = dice.choice([0, 1, 2**31 - 1, 2**31]) if size in ("<I", "<Q") else dice.choice([float("nan"), 1e30, -1.0])
    word = struct.pack(size, value)
    data[at : at + len(word)] = word


def _byte(data: bytearray, dice: random.Random) -> None:
    data[dice.randrange(8, len(data))] = dice.randrange(256)


def _bit(data: bytearray, dice: random.Random) -> None:
    data[dice.randrange(8, len(data))] ^= 1 << dice.randrange(8)


def _cut(data: bytearray, dice: random.Random) -> None:
    at = dice.randrange(8, len(data))
    del data[at : at + dice.randint(1, 40)]


def _double(data: bytearray, dice: random.Random) -> None:
    at = dice.randrange(8, len(data))
    data[at:at] = data[at : at + dice.randint(1, 40)]


def _move(data: bytearray, dice: random.Random) -> None:
    here, there, size = dice.randrange(8, len(data)), dice.randrange(8, len(data)), dice.randint(1, 40)
    part = data[here : here + size]
    data[there : there + len(part)] = part


def _end(data: bytearray, dice: random.Random) -> None:
    if dice.random() < 0.2:
        del data[dice.randrange(16, len(data)) :]


WAYS: tuple[Callable[[bytearray, random.Random], None], ...] = (_number, _byte, _bit, _cut, _double, _move, _end)


def damaged(sources: dict[str, bytes], seed: int) -> tuple[str, bytes]:
    """One of the sources, damaged in one place or a few; its first eight bytes, which tell its format, stay."""
    dice = random.Random(seed)
    name = sorted(sources)[seed % len(sources)]
    data = bytearray(sources[name])
    only = dice.choice([WAYS, (_number,), (_number, _bit)])  # files that still can be read go deeper
    for _ in range(dice.choice([1, 1, 1, 2, 3, 8])):
        dice.choice(only)(data, dice)
        if len(data) < 64:
            break
    return name, bytes(data)


# --- answers


def texts(value: Any) -> Iterator[str]:
    """Every string of a JSON document."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for key, inner in value.items():
            yield str(key)
            yield from texts(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from texts(inner)


def lines_of(content: bytes) -> list[str]:
    """Lines of text in a file, long enough to be told from a word that anybody uses."""
    lines = (line.strip() for line in content.decode("utf-8", "ignore").splitlines())
    return [line for line in lines if len(line) > 15]


def told(answer: httpx.Response, content: bytes, places: list[str]) -> list[str]:
    """What an answer tells and should not."""
    found = [f"a path of the server: {place}" for place in places if place.encode() in answer.content]
    if "json" not in answer.headers.get("content-type", ""):
        return found
    said = list(texts(answer.json()))
    found += [f"words of an exception: {text}" for text in said if WORDS.search(text)]
    found += [f"a path of the server: {text}" for text in said if any(place in text for place in places)]
    everything = "\n".join(said)
    return found + [f"a line of the file: {line}" for line in lines_of(content) if line in everything]


def wrong(answer: httpx.Response, content: bytes, places: list[str]) -> tuple[str, list[str]]:
    """The outcome, and what is wrong with it."""
    found = told(answer, content, places)
    if answer.status_code == 200:
        return "200", found
    if answer.headers.get("content-type") != "application/problem+json":
        return "?", [*found, f"{answer.status_code} is no problem document: {answer.text[:200]}"]
    document = answer.json()
    slug = document["type"].removeprefix("/problems/")
    if slug not in KINDS or KINDS[slug].status != answer.status_code or document["status"] != answer.status_code:
        found.append(f"{document['type']} with {answer.status_code} is not as documented")
    if slug not in THEIRS:
        found.append(f"{slug} is not the file's fault: {document['detail']}")
    return slug, found


# --- the service


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    # Processor time ends what goes on for ever: it passes no faster where others want the cores too.
    words = ("--workers", str(WORKERS), *PATIENT, "--limit", "memory_bytes=2000000000", "--limit", "cpu_seconds=20")
    with running(tmp_path_factory.mktemp("fuzz") / "data", *words) as server:
        yield server


def _ways(seed: int) -> list[tuple[str, dict[str, Any]]]:
    more: dict[int, list[tuple[str, dict[str, Any]]]] = {0: [("convert", {})], 3: [("validate", {})]}
    return [("inspect", {}), ("render", SMALL), *more.get(seed % 7, [])]


def _send(client: httpx.Client, verb: str, name: str, content: bytes, settings: dict[str, Any]) -> httpx.Response:
    return client.post(f"/v1/{verb}", files=upload(content, name), data={"settings": json.dumps(settings)})


def _draws(server: Server, exposure: float) -> None:
    """It still works: a picture that was not asked for before."""
    with server.client() as client:
        assert _send(client, "render", "ball.usda", BALL.encode(), {**SMALL, "exposure": exposure}).status_code == 200
    server.idle()


def _uploads(server: Server) -> list[str]:
    """Files of clients, and files not written to their end."""
    found = (path.name for path in files_under(server.data))
    return [name for name in found if re.match(r"stage\.|upload-|\.[0-9a-f]{8}$", name)]


def _handles(pid: int) -> list[str]:
    """What a process holds open, by what it is."""
    found = []
    for handle in os.listdir(f"/proc/{pid}/fd"):
        with contextlib.suppress(FileNotFoundError):  # closed meanwhile
            found.append(os.readlink(f"/proc/{pid}/fd/{handle}"))
    return found


def _connections(pid: int) -> list[str]:
    """Which of them are connections to clients."""
    text = Path(f"/proc/{pid}/net/tcp").read_text()  # the service is at an address of IPv4
    lines = [line.split() for line in text.splitlines()[1:]]
    connected = {f"socket:[{inode}]" for _, _, _, state, *_, inode in (line[:10] for line in lines) if state != LISTENS}
    return [handle for handle in _handles(pid) if handle in connected]


def _held(server: Server) -> dict[str, int]:
    """How many handles a service holds that has nothing to do. Of what clients sent, and of them, nothing is left.

    It sees a little after its client that a connection is closed. So connections are waited for and not counted:
    one that was there before would make room for a leak.
    """
    until(lambda: len(list((server.data / "work").iterdir())) == WORKERS)  # of the next workers
    until(lambda: len(server.workers()) == WORKERS)
    until(lambda: not _uploads(server))
    until(lambda: not _connections(server.process.pid))
    return {"service": len(_handles(server.process.pid)), "nursery": len(_handles(server.nursery()))}


def test_damaged_files_cost_nothing_but_themselves(server: Server, sources: dict[str, bytes]) -> None:
    places = sorted({str(ROOT), str(server.data), sys.prefix, sys.base_prefix, tempfile.gettempdir() + os.sep,
                     os.path.expanduser("~") + os.sep, "/usr/lib", "/proc/"})  # fmt: skip
    outcomes: Counter[tuple[str, str, str]] = Counter()
    failures: list[str] = []
    _draws(server, exposure=0.0)
    before, nursery = _held(server), server.nursery()

    def send_damaged(seed: int) -> None:
        name, content = damaged(sources, seed)
        for verb, settings in _ways(seed):
            answer = _send(client, verb, name, content, settings)
            outcome, found = wrong(answer, content, places)
            if where := answer.headers.get("content-location"):
                found += told(client.get(where), content, places)
            outcomes[(verb, name.rpartition(".")[2], outcome)] += 1
            failures.extend(f"seed {seed} {verb} {name}: {text[:300]}" for text in found)

    with server.client() as client:
        with ThreadPoolExecutor(WORKERS) as threads:
            list(threads.map(send_damaged, range(COUNT)))
        assert client.get("/livez").status_code == client.get("/readyz").status_code == 200
    _draws(server, exposure=1.0)
    for (verb, extension, outcome), count in sorted(outcomes.items()):
        print(f"{verb:9}{extension:6}{outcome:24}{count}")
    assert not failures, "\n".join(failures)
    assert server.metric("refract_worker_faults_total") == 0.0
    until(lambda: all(count <= before[name] for name, count in _held(server).items()))  # nothing leaks
    assert server.nursery() == nursery  # it has not died
    kinds = {outcome for _, _, outcome in outcomes}
    assert {"200", "stage-invalid"} <= kinds  # some files are still good, some are not


def test_the_sources_themselves_are_drawn(server: Server, sources: dict[str, bytes]) -> None:
    with server.client() as client:
        for name, content in sources.items():
            answer = _send(client, "render", name, content, SMALL)
            assert answer.status_code == 200, (name, answer.text)


def test_a_leaked_handle_would_be_seen(server: Server, tmp_path: Path) -> None:
    pid = server.process.pid
    with server.connect():
        until(lambda: _connections(pid))
    until(lambda: not _connections(pid))
    with open(tmp_path / "open", "wb"):
        assert str(tmp_path / "open") in _handles(os.getpid())
    assert str(tmp_path / "open") not in _handles(os.getpid())


def test_a_leak_would_be_seen() -> None:
    """The checks of this file fail where they should."""
    line = 'string secret = "a long line"'
    answer = httpx.Response(422, json={"detail": f"syntax error at {line}"})
    assert told(answer, f"x\n    {line}\n".encode(), ["/srv/data"]) == [f"a line of the file: {line}"]
    for text in ("RuntimeError: no", "in pxr/usd/sdf/crate.cpp", "Traceback (most recent call last)"):
        assert told(httpx.Response(422, json={"errors": [{"detail": text}]}), b"", [])
    assert told(httpx.Response(200, content=b"\x89PNG /srv/data/x"), b"", ["/srv/data"])
    assert wrong(httpx.Response(500, json={"detail": ""}), b"", [])[1]
    assert wrong(httpx.Response(422, json={"detail": "no file is readable"}), b"", [])[1]
