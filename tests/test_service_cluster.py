"""Jobs of the service on a Dask cluster: the same answers, the same locks, and what happens when machines go."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import httpx
import pytest
from service_server import (
    BALL,
    LONG,
    PATIENCE,
    PATIENT,
    ROOT,
    SMALL,
    WARM_UP,
    Server,
    children,
    kill,
    running,
    until,
    upload,
)
from service_stages import HEAD, escapes, referring
from typer.testing import CliRunner

from refract_core.cli import app
from refract_core.errors import RefractError
from service.cluster_worker import Ended, Order, perform
from service.digests import engine
from service.gather import checked, files_of
from service.limits import Limits
from service.problems import Problem

distributed = pytest.importorskip("distributed")
# Dask leaves sockets and loops of its own for the garbage collector.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]
GOOD = ROOT / "usd_samples" / "good"
SECONDS = {"stage": "marble.usda", "image_width": 800, "samples": 24}
"""Some seconds of work: time to do something meanwhile, for a job that has to come to its end."""
SOON = 30.0
"""[s] What ends within it ended because it was stopped: `LONG` takes longer by itself."""
WORD = "Xyzzy"


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    options = {"n_workers": 2, "threads_per_worker": 1, "processes": True, "host": "127.0.0.1"}
    with distributed.LocalCluster(**options, dashboard_address="127.0.0.1:0", silence_logs=50) as two:
        yield two


@pytest.fixture(scope="module")
def dask(cluster: Any) -> Iterator[Any]:
    """To look at the cluster from outside."""
    with distributed.Client(cluster, set_as_default=False) as found:
        found.wait_for_workers(2, timeout=WARM_UP)
        yield found


@pytest.fixture(scope="module")
def server(cluster: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("cluster")
    (folder / "secret.usda").write_text(f'{HEAD}def Sphere "World"\n{{\n    string {WORD} = "{WORD}"\n}}\n')
    address = cluster.scheduler_address.replace("tcp://", "dask://")
    with running(folder / "data", "--stage-root", str(GOOD), "--executor", address, *PATIENT) as server:
        yield server


@pytest.fixture
def client(server: Server) -> Iterator[httpx.Client]:
    with server.client() as client:
        yield client


def start(client: httpx.Client, work: dict[str, Any], exposure: float) -> str:
    """A job that runs. Returns its address."""
    answer = client.post("/v1/render", json={**work, "exposure": exposure}, headers={"Prefer": "respond-async"})
    assert answer.status_code == 202, answer.text
    where = answer.headers["location"]
    until(lambda: client.get(where).json()["fraction"] > 0.0)
    return str(where)


def forks(dask: Any) -> list[int]:
    """Processes that do a job or wait for one, of all Dask workers."""
    return [fork for worker in dask.run(os.getpid).values() for nursery in below(worker) for fork in children(nursery)]


def below(pid: int) -> list[int]:
    """Children of all threads, which come and go."""
    found = []
    for path in Path(f"/proc/{pid}/task").glob("*/children"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            found += [int(word) for word in path.read_text().split()]
    return found


def busy_with_a_job(dask: Any) -> list[str]:
    """Addresses of Dask workers that do one, and not only greet the service."""
    doing = dask.processing().items()
    return [address for address, keys in doing if any(str(key).startswith("refract-job-") for key in keys)]


def test_the_same_bytes_as_from_this_machine(client: httpx.Client, tmp_path: Path) -> None:
    wishes: list[dict[str, Any]] = [
        {"json": {"stage": "marble.usda", **SMALL, "aovs": ["thickness"]}},
        {"files": upload(BALL), "data": {"settings": '{"image_width": 32, "samples": 1}'}},
    ]
    there = [client.post("/v1/render", **wish) for wish in wishes]
    assert [answer.status_code for answer in there] == [200, 200]
    with running(tmp_path / "here", "--stage-root", str(GOOD)) as local, local.client() as near:
        here = [near.post("/v1/render", **wish) for wish in wishes]
        places = [answer.headers["content-location"] for answer in here]
        assert [answer.headers["content-location"] for answer in there] == places  # the same jobs, too
        plane = f"{places[0]}/aovs/thickness.png"
        assert near.get(plane).content == client.get(plane).content
    assert [answer.content for answer in there] == [answer.content for answer in here]


def test_the_other_verbs_answer(client: httpx.Client) -> None:
    report = client.post("/v1/inspect", json={"stage": "marble.usda"})
    assert report.status_code == 200
    assert report.json()["cameras"]
    assert client.post("/v1/validate", files=upload(BALL)).status_code == 200
    converted = client.post("/v1/convert", files=upload(BALL))
    assert converted.content[:2] == b"PK"


def test_every_worker_tells_what_confines_it(client: httpx.Client) -> None:
    until(lambda: client.get("/readyz").json()["confinement"]["cluster_workers"] == 2)
    assert client.get("/readyz").json()["confinement"]["threads"] == 1


@pytest.mark.parametrize("name", escapes("/x/y.usda"))
def test_no_stage_reaches_out_of_its_folder(client: httpx.Client, server: Server, name: str) -> None:
    stage = escapes(str(server.data.parent / "secret.usda"))[name]
    answer = client.post("/v1/render", files=upload(stage), data={"settings": '{"image_width": 32, "samples": 1}'})
    assert (answer.status_code, answer.json()["type"]) == (422, "/problems/stage-refused")
    assert WORD not in answer.text


def test_a_cancelled_job_ends_where_it_runs(client: httpx.Client, dask: Any) -> None:
    where = start(client, LONG, 0.25)
    before = set(forks(dask))
    assert before
    client.delete(where)
    until(lambda: not before & set(forks(dask)), SOON)
    assert client.get(where).json()["status"] == "cancelled"


def test_a_job_outlives_the_worker_it_ran_on(client: httpx.Client, dask: Any) -> None:
    where = start(client, SECONDS, 0.5)
    (busy,) = busy_with_a_job(dask)
    (pid,) = dask.run(os.getpid, workers=[busy]).values()
    kill(pid)
    until(lambda: client.get(where).json()["status"] == "done", WARM_UP)
    dask.wait_for_workers(2, timeout=WARM_UP)


def test_the_end_of_its_process_fails_one_job(client: httpx.Client, dask: Any) -> None:
    where = start(client, LONG, 0.75)
    for pid in forks(dask):
        kill(pid)
    until(lambda: client.get(where).json()["status"] == "failed")
    assert client.get(where).json()["problem"]["type"] == "/problems/stage-crashed"
    assert client.post("/v1/render", json={"stage": "marble.usda", **SMALL, "exposure": 1.5}).status_code == 200


# --- what travels


def an_order(root: Path, *names: str, version: str = "") -> Order:
    files = tuple((name, hashlib.sha256((root / name).read_bytes()).hexdigest()) for name in names)
    job = {"kind": "render", "stage": names[0], "settings": {**SMALL, "format": "png"}, "limits": asdict(Limits())}
    return Order("test", "token", job, str(root), files, version or engine())


def test_a_stage_goes_by_path_or_with_its_files(dask: Any, tmp_path: Path) -> None:
    (tmp_path / "stage.usda").write_text(BALL.replace("metersPerUnit = 1", "subLayers = [@more.usda@]"))
    (tmp_path / "more.usda").write_text('#usda 1.0\ndef DomeLight "Sky"\n{\n}\n')
    order = an_order(tmp_path, "stage.usda", "more.usda")
    content = {name: (tmp_path / name).read_bytes() for name, _ in order.files}

    by_path: Ended = dask.submit(perform, order, None, pure=False).result()
    (tmp_path / "more.usda").write_text("#usda 1.0\n")
    assert dask.submit(perform, order, None, pure=False).result() is None  # other files than the order tells
    elsewhere = order._replace(root="/nowhere")
    assert dask.submit(perform, elsewhere, None, pure=False).result() is None
    with_files: Ended = dask.submit(perform, elsewhere, content, pure=False).result()
    assert by_path.files["image.png"] == with_files.files["image.png"]
    assert with_files.files.keys() == {"image.png"}


def test_another_version_is_refused(dask: Any) -> None:
    order = an_order(GOOD, "marble.usda", version="0.0.0+other")
    with pytest.raises(RefractError, match=r"0\.0\.0\+other"):
        dask.submit(perform, order, None, pure=False).result()


async def ask(root: Path, stage: str) -> list[str]:
    return await files_of(str(root), stage, asdict(Limits()))


def test_the_files_of_a_stage_are_found_by_a_locked_process(tmp_path: Path) -> None:
    found = asyncio.run(ask(GOOD, "marble.usda"))
    assert {"marble.usda", "parts/studio.usda", "textures/wood.png"} <= set(found)
    (tmp_path / "secret.usda").write_text(HEAD)
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "out.usda").write_text(referring("../secret.usda"))
    with pytest.raises(Problem, match="leads out of") as refused:
        asyncio.run(ask(tmp_path / "root", "out.usda"))
    assert refused.value.slug == "stage-refused"


def test_the_locked_process_is_not_believed(tmp_path: Path) -> None:
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "link").symlink_to(tmp_path)
    assert checked(["a.usda", "b/../c.usda"], str(tmp_path / "root")) == ["a.usda", "b/../c.usda"]
    for path in ("../x", "/etc/passwd", "a/../../x", "link/x"):
        with pytest.raises(Problem):
            checked(["a.usda", path], str(tmp_path / "root"))


# --- clusters that are not there


def kept_port() -> socket.socket:
    """A port where nobody listens, and that nobody else is given, while the scheduler to come may listen there."""
    kept = socket.socket()
    kept.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    kept.bind(("127.0.0.1", 0))
    return kept


def test_a_service_waits_for_its_cluster_and_outlives_it(tmp_path: Path) -> None:
    kept = kept_port()
    port = kept.getsockname()[1]
    command = [sys.executable, "-m", "refract_core.cli", "serve", "--port", "0", "--data", str(tmp_path / "data"),
               "--executor", f"dask://127.0.0.1:{port}"]  # fmt: skip
    with open(tmp_path / "log", "w") as errors:
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=errors, text=True)
    assert process.stdout
    try:
        url = process.stdout.readline().split()[-1]
        with httpx.Client(base_url=url, timeout=PATIENCE, trust_env=False) as client:
            assert client.get("/readyz").status_code == 503
            until(lambda: "no Dask scheduler answers there" in (tmp_path / "log").read_text())
            options = {"n_workers": 1, "threads_per_worker": 1, "processes": True, "host": "127.0.0.1"}
            with distributed.LocalCluster(
                **options, scheduler_port=port, dashboard_address="127.0.0.1:0", silence_logs=50
            ):
                until(lambda: client.get("/readyz").status_code == 200, WARM_UP)
                assert client.post("/v1/render", files=upload(BALL)).status_code == 200
            until(lambda: client.get("/readyz").status_code == 503)
            assert client.get("/livez").status_code == 200
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(PATIENCE)
        process.stdout.close()
        kept.close()


def test_addresses_are_checked_before_anything_starts(tmp_path: Path) -> None:
    found = CliRunner().invoke(app, ["serve", "--executor", "tcp://127.0.0.1:8786"])
    assert found.exit_code == 2
    assert "--executor is 'tcp://127.0.0.1:8786'; write dask://HOST:PORT" in found.output
