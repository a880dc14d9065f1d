"""A worker that is taken over stays alone: a list of ways out, each tried inside of a real worker, and bombs that no
limit is made shorter for. See `escape_worker.py`."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from service_server import BALL, ROOT, SMALL, Server, files_under, running, until, upload
from service_stages import laughs

from refract_core import RenderSettings, load_stage, render
from refract_core.images.codec import read_channels
from service import confine, namespaces, quota, seccomp, worker
from service.limits import Limits

pytestmark = pytest.mark.slow
PROGRAM = (str(Path(__file__).with_name("escape_server.py")),)
HEADERS = {"x86_64": Path("/usr/include/x86_64-linux-gnu/asm/unistd_64.h"),
           "aarch64": Path("/usr/include/asm-generic/unistd.h")}  # fmt: skip
locked = pytest.mark.skipif(not confine.landlock_abi() or not seccomp.works(), reason="this kernel has no lock")


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("escape")
    (folder / "victim").write_text("theirs")
    secrets = {"AWS_SECRET_ACCESS_KEY": "Xyzzy", "REFRACT_TOKEN": "Xyzzy"}
    words = ("--workers", "2", "--limit", "folder_bytes=50000000", "--limit", "folder_files=200")
    with running(folder / "data", *words, environment=secrets, program=PROGRAM) as server:
        yield server


@pytest.fixture
def client(server: Server) -> Iterator[httpx.Client]:
    """After each test, an honest stage is still rendered, by the same process that forks workers."""
    nursery = server.nursery()
    with server.client() as client:
        yield client
        answer = client.post("/v1/render", files=upload(BALL), data={"settings": json.dumps(SMALL)})
        assert answer.status_code == 200
        assert server.nursery() == nursery


def order(do: str, victim: Path) -> dict[str, Any]:
    """A stage that tells the worker of these tests what to do."""
    return upload(f"#usda 1.0\n# {json.dumps({'do': do, 'victim': str(victim)})}")


@pytest.fixture(scope="module")
def report(server: Server) -> dict[str, dict[str, str]]:
    return outcomes(server)


def outcomes(server: Server) -> dict[str, dict[str, str]]:
    """What became of every attempt, by name; what they were about is as it was."""
    victim = server.data.parent / "victim"
    before = victim.stat()
    shared = shared_memory()
    with server.client() as client:
        answer = client.post("/v1/inspect", files=order("all", victim))
        assert answer.status_code == 200, (answer.text, server.log.read_text()[-3000:])
        job = answer.headers["content-location"].rpartition("/")[2]
        found = json.loads((server.data / "jobs" / job / "report.json").read_text())
    after = victim.stat()
    assert (after.st_mode, after.st_mtime_ns, after.st_uid) == (before.st_mode, before.st_mtime_ns, before.st_uid)
    assert shared_memory() == shared
    assert server.process.poll() is None
    return dict(found)


def shared_memory() -> list[str]:
    """What is shared with all processes, and stays when they end."""
    return [line for name in ("shm", "sem", "msg") for line in Path(f"/proc/sysvipc/{name}").read_text().splitlines()]


@locked
def test_no_way_leads_out_of_a_worker(report: dict[str, dict[str, str]]) -> None:
    assert len(report["refused"]) >= 80
    assert {name for name, outcome in report["refused"].items() if not outcome.startswith("refused")} == set()


@locked
def test_the_list_of_calls_is_enough_where_there_are_no_namespaces(tmp_path: Path) -> None:
    (tmp_path / "victim").write_text("theirs")
    with running(tmp_path / "data", "--workers", "1", program=(*PROGRAM, "--without-namespaces")) as server:
        found = outcomes(server)
        with server.client() as client:
            assert client.get("/readyz").json()["confinement"]["missing"] == ["namespaces"]
            answer = client.post("/v1/render", files=upload(BALL), data={"settings": json.dumps(SMALL)})
            assert answer.status_code == 200
    assert {name for name, outcome in found["refused"].items() if not outcome.startswith("refused")} == set()


@locked
@pytest.mark.skipif(not namespaces.works(), reason="this machine lets nobody make namespaces")
def test_a_worker_cannot_tell_what_is_there(report: dict[str, dict[str, str]]) -> None:
    assert {name for name, outcome in report["hidden"].items() if not outcome.startswith("refused")} == set()


@locked
@pytest.mark.parametrize("do", ["fill", "fill removed", "many files", "deep", "many threads"])
def test_a_worker_that_takes_too_much_is_ended(client: httpx.Client, server: Server, do: str) -> None:
    answer = client.post("/v1/inspect", files=order(do, server.data))
    assert answer.json()["type"] == "/problems/limit-exceeded", answer.text
    until(lambda: not [path for path in files_under(server.data / "work") if re.fullmatch(r"a\d+|a{200}", path.name)])


def test_every_sample_is_drawn_in_a_worker_as_it_is_without(tmp_path: Path) -> None:
    """Honest work needs no call that is refused, and no file that is hidden: the pictures are the same to the bit."""
    samples = ROOT / "usd_samples" / "good"
    settings = {"image_width": 48, "samples": 1}
    with running(tmp_path / "data", "--workers", "1", "--stage-root", str(samples)) as server:
        for path in sorted(samples.glob("*.usda")):
            with server.client() as client:
                answer = client.post("/v1/render", json={"stage": path.name, **settings})
                job = client.get(answer.headers["content-location"]).json()
            assert answer.status_code == 200, (path.name, answer.text)
            assert len(job["warnings"]) == (2 if path.stem == "bottle" else 0), path.name  # it has no camera, no light
            (tmp_path / "theirs.png").write_bytes(answer.content)
            frame = render(load_stage(path), RenderSettings(image_width=48, samples=1))
            frame.save(str(tmp_path / "ours.png"))
            theirs, ours = (read_channels(str(tmp_path / name), name).pixels for name in ("theirs.png", "ours.png"))
            np.testing.assert_array_equal(theirs, ours, err_msg=path.name)


@pytest.mark.parametrize("stage", [laughs(30), laughs(30, instanceable=True)])
@pytest.mark.parametrize("verb", ["render", "validate", "convert"])
def test_prims_are_counted_before_usd_composes_them(client: httpx.Client, stage: str, verb: str) -> None:
    """The limits are those of every service; processor time of the worker is what its own count takes."""
    answer = client.post(f"/v1/{verb}", files=upload(stage))
    assert answer.json()["type"] == "/problems/limit-exceeded"
    number = sum(2**level - 1 for level in range(1, 31))
    assert answer.json()["detail"] == (
        f"the stage would be composed of {number} prims; the limit is {Limits().prims} (prims)"
    )


def test_a_stage_that_is_slow_to_compose_has_a_limit_of_its_own(tmp_path: Path) -> None:
    """45,150 prims, which is few; each is looked for in up to 300 places, which is slow."""
    chain = "".join(
        f'def "A{n}" (\n    references = </A{n - 1}>\n)\n{{\n    def "b{n}"\n    {{\n    }}\n}}\n'
        for n in range(1, 300)
    )
    words = ("--workers", "1", "--limit", "stage_seconds=2")
    with running(tmp_path / "data", *words) as server, server.client() as client:
        for verb in ("render", "inspect", "convert"):
            answer = client.post(f"/v1/{verb}", files=upload(f'#usda 1.0\ndef "A0"\n{{\n}}\n{chain}'))
            assert answer.json()["type"] == "/problems/time-limit", answer.text
            assert "stage_seconds" in answer.json()["detail"]
        answer = client.post("/v1/render", files=upload(BALL), data={"settings": json.dumps(SMALL)})
        assert answer.status_code == 200


# --- the parts


def test_the_environment_of_a_worker_is_what_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("AWS_SECRET_ACCESS_KEY", "REFRACT_TOKEN", "DATABASE_URL", "PXR_PLUGINPATH_NAME", "ANYTHING_NEW"):
        monkeypatch.setenv(name, "Xyzzy")
    monkeypatch.setenv("REFRACT_CACHE_DIR", "/there")
    found = worker.environment()
    assert "Xyzzy" not in found.values()
    assert found["REFRACT_CACHE_DIR"] == "/there"


@pytest.mark.parametrize("machine", list(HEADERS))
def test_calls_have_the_numbers_of_the_kernels_headers(machine: str) -> None:
    if not HEADERS[machine].exists():
        pytest.skip("the kernel's headers are not installed")
    known: dict[str, int] = {}
    for line in HEADERS[machine].read_text().splitlines():
        words = line.split()
        if len(words) == 3 and words[0] == "#define" and words[1].startswith("__NR") and words[2].isdigit():
            known.setdefault(words[1].split("_", 3)[-1], int(words[2]))
    known.setdefault("newfstatat", known.get("fstatat", -1))
    known.setdefault("fchmodat2", 452)  # newer than some headers
    column = list(HEADERS).index(machine)
    tables: tuple[Any, ...] = (seccomp._ALLOWED, seccomp._PRETENDED, seccomp._NOT_THERE)
    ours = {name: numbers[column] for table in tables for name, numbers in table.items()}
    for rules in (seccomp._ONLY, seccomp._WITHOUT, seccomp._WITH):
        ours |= {name: numbers[column] for name, (numbers, *_) in rules.items()}
    assert {name: number for name, number in ours.items() if number >= 0 and known.get(name) != number} == {}


@pytest.mark.parametrize("machine", ["x86_64", "aarch64"])
def test_the_filter_says_of_every_call_what_the_list_says(machine: str) -> None:
    """The program is run here as the kernel does, for every number and some arguments."""
    steps = seccomp.program(machine, 4321)
    assert len(steps) < 4096
    architecture = {"x86_64": 0xC000003E, "aarch64": 0xC00000B7}
    column = list(architecture).index(machine)

    def verdict(number: int, *arguments: int, of: int = architecture[machine]) -> int:
        data = {0: number, 4: of} | {16 + 8 * place: value for place, value in enumerate([*arguments, 0, 0, 0])}
        accumulator, at = 0, 0
        while True:
            code, true, false, operand = steps[at]
            at += 1
            if code == 0x06:
                return operand
            if code == 0x20:
                accumulator = data[operand]
                continue
            holds = {0x15: accumulator == operand, 0x25: accumulator > operand, 0x45: bool(accumulator & operand)}[code]
            at += true if holds else false

    allow, deny, nothing, done, kill = 0x7FFF0000, 0x00050001, 0x00050026, 0x00050000, 0x80000000
    allowed = {numbers[column] for numbers in seccomp._ALLOWED.values()}
    asked = {numbers[column] for rules in (seccomp._ONLY, seccomp._WITHOUT, seccomp._WITH)
             for numbers, *_ in rules.values()}  # fmt: skip
    pretended = {numbers[column] for numbers in seccomp._PRETENDED.values()}
    for number in range(463):
        if number not in asked:
            expected = allow if number in allowed else done if number in pretended else deny
            assert verdict(number) == (nothing if number in (435, 437) else expected), number
    assert {verdict(number) for number in (463, 5000, 0x40000000, 0x40000000 | 59)} == {nothing}
    assert verdict(0, of=0x40000003) == kill  # 32-bit calls have other numbers

    def of(name: str) -> int:
        return next(int(rules[name][0][column]) for rules in (seccomp._ONLY, seccomp._WITHOUT, seccomp._WITH)
                    if name in rules)  # fmt: skip

    assert verdict(of("kill"), 4321) == verdict(of("prlimit64"), 0) == verdict(of("prlimit64"), 4321) == allow
    assert verdict(of("kill"), 1) == verdict(of("kill"), 0) == verdict(of("prlimit64"), 1) == deny
    assert verdict(of("kill"), 0xFFFFFFFF) == deny
    assert verdict(of("clone"), 0x3D0F00) == allow
    assert verdict(of("clone"), 17) == deny
    assert verdict(of("openat"), 0xFFFFFF9C, 0, os.O_RDONLY | os.O_CLOEXEC) == allow
    assert verdict(of("openat"), 0xFFFFFF9C, 0, os.O_PATH) == verdict(of("openat"), 0, 0, os.O_TMPFILE) == deny
    assert verdict(of("fcntl"), 0, 1030) == verdict(of("ioctl"), 0, 0x5401) == allow
    assert verdict(of("fcntl"), 0, 8) == verdict(of("ioctl"), 0, 0x5412) == deny


def test_a_tree_deeper_than_paths_reach_is_removed(tmp_path: Path) -> None:
    (tmp_path / "tree").mkdir()
    (tmp_path / "tree" / "file").write_text("x")
    here = os.open(tmp_path / "tree", os.O_RDONLY)
    for _ in range(2000):
        os.mkdir("a" * 100, dir_fd=here)
        os.symlink("/etc", "link", dir_fd=here)
        inner = os.open("a" * 100, os.O_RDONLY, dir_fd=here)
        os.close(here)
        here = inner
    os.close(here)
    quota.remove(str(tmp_path / "tree"))
    assert list(tmp_path.iterdir()) == []
    quota.remove(str(tmp_path / "none"))


def test_files_count_once_and_also_when_they_have_no_name(tmp_path: Path) -> None:
    for name in ("out", "tmp"):
        (tmp_path / name).mkdir()
    own = quota.Quota(str(tmp_path), 1_000_000, 10)
    (tmp_path / "out" / "a").write_bytes(bytes(600_000))
    assert own.excess(os.getpid()) == ""
    with open(tmp_path / "tmp" / "b", "wb") as file:
        file.write(bytes(600_000))
        file.flush()
        assert "folder_bytes" in own.excess(os.getpid())
        os.unlink(tmp_path / "tmp" / "b")
        assert "folder_bytes" in own.excess(os.getpid())
    assert own.excess(os.getpid()) == ""
    for number in range(10):
        (tmp_path / "out" / f"f{number}").mkdir()
    assert "folder_files" in own.excess(os.getpid())


# --- a kernel that lacks something


def test_what_is_missing_is_said() -> None:
    everything = {"landlock": 7, "seccomp": True, "capabilities": True, "namespaces": True}
    assert confine.missing(everything) == {}
    assert list(confine.missing({**everything, "landlock": 0})) == ["landlock"]
    assert list(confine.missing({**everything, "namespaces": False, "seccomp": False})) == ["seccomp", "namespaces"]


LACKING = """
import sys
sys.path.insert(0, {root!r})
from refract_core.service import confine
confine.landlock_abi = lambda: 0
from refract_core.cli import main
sys.argv = ["refract", "serve", *{words!r}]
main()
"""


def test_confinement_can_be_required(tmp_path: Path) -> None:
    words = ["--port", "0", "--data", str(tmp_path / "data"), "--require-confinement"]
    code = LACKING.format(root=str(ROOT), words=words)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 2, done.stderr
    assert "Landlock" in done.stderr
    assert "http://" not in done.stdout


def test_the_start_and_readyz_say_what_is_missing(tmp_path: Path) -> None:
    script = tmp_path / "lacking.py"
    script.write_text(f"import sys\nsys.argv.insert(1, '')\n{LACKING.format(root=str(ROOT), words=[])}".replace(
        "*[]", "*sys.argv[3:]"))  # fmt: skip
    with running(tmp_path / "data", "--workers", "1", program=(str(script),)) as server:
        assert "no Landlock" in server.log.read_text()
        with server.client() as client:
            told = client.get("/readyz").json()["confinement"]["missing"]
    assert told == list(confine.missing(confine.available()))  # the workers' own process was not lied to


