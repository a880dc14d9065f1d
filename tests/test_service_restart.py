"""A service that is stopped and started again; tokens; the limits of a real server's sockets."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from service_server import BALL, LONG, PATIENCE, PATIENT, ROOT, SMALL, Server, running, runs, until, upload

pytestmark = pytest.mark.slow
GOOD = ROOT / "usd_samples" / "good"
SECONDS = {"stage": "marble.usda", "image_width": 640, "samples": 16}
"""Some seconds of work: under way when the service is told to stop, and done in the time that is left for it."""
WORDS = ("--stage-root", str(GOOD), "--workers", "1", *PATIENT, "--limit", f"drain_seconds={PATIENCE:.0f}")


def test_results_survive_a_restart_and_orphans_have_failed(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with running(data, *WORDS) as server, server.client() as client:
        picture = client.post("/v1/render", json={"stage": "traced.usda", **SMALL})
        orphan = client.post("/v1/render", json=LONG, headers={"Prefer": "respond-async"}).headers["location"]
        until(lambda: client.get(orphan).json()["status"] == "running")
        later = {"Prefer": "respond-async"}
        ours = client.post("/v1/render", json={"stage": "traced.usda", **SMALL, "exposure": 0.5}, headers=later)
        theirs = client.post("/v1/render", files=upload(BALL), headers=later)
        waiting = [ours.headers["location"], theirs.headers["location"]]
        family = [server.nursery(), *server.workers()]
        os.kill(server.process.pid, signal.SIGKILL)
        server.process.wait()
        until(lambda: not any(map(runs, family)))
    with running(data, *WORDS) as server, server.client() as client:
        where = picture.headers["content-location"]
        assert client.get(f"{where}/image").content == picture.content
        job = client.get(orphan).json()
        assert (job["status"], job["problem"]["type"]) == ("failed", "/problems/interrupted")
        for place in waiting:  # what had not begun is done
            until(lambda place=place: client.get(place).json()["status"] == "done")
            assert client.get(f"{place}/image").headers["content-type"] == "image/png"
        # a stop lets what runs finish
        accepted = client.post("/v1/render", json=SECONDS, headers={"Prefer": "respond-async"})
        until(lambda: client.get(accepted.headers["location"]).json()["status"] != "queued")
        server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(2 * PATIENCE) in (0, -signal.SIGTERM)
    record = data / accepted.headers["location"].replace("/v1/jobs", "jobs").lstrip("/") / "record.json"
    assert '"status": "done"' in record.read_text()


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server that asks for a token, and has little patience: as much as an honest client needs on a busy machine."""
    folder = tmp_path_factory.mktemp("guarded")
    (folder / "tokens").write_text("# for the tests\ncorrect-horse\nbattery-staple\n")
    words = ("--workers", "1", "--token-file", str(folder / "tokens"), "--limit", "body_seconds=3",
             "--limit", "body_bytes=100000")  # fmt: skip
    with running(folder / "data", *words, environment={"REFRACT_LIMIT_HEADER_SECONDS": "3"}) as server:
        yield server


def test_tokens(guarded: Server) -> None:
    with guarded.client() as client:
        assert client.get("/livez").status_code == 200
        for header in ({}, {"Authorization": "Bearer wrong-horse"}, {"Authorization": "Basic correct-horse"}):
            answer = client.get("/v1/limits", headers=header)
            assert answer.status_code == 401
            assert answer.headers["www-authenticate"] == "Bearer"
            assert answer.json()["type"] == "/problems/unauthorized"
        assert client.get("/metrics").status_code == 401
        for token in ("correct-horse", "battery-staple"):
            assert client.get("/v1/limits", headers={"Authorization": f"Bearer {token}"}).status_code == 200


def talk(server: Server, sent: bytes) -> str:
    """Send raw bytes, and read until the server closes."""
    with server.connect() as connection:
        connection.sendall(sent)
        said = b""
        while data := connection.recv(65536):
            said += data
    return said.decode()


HEAD = b"POST /v1/render HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer correct-horse\r\n"


def test_a_head_without_an_end_is_cut_off(guarded: Server) -> None:
    assert talk(guarded, b"GET /livez HTTP/1.1\r\nHost: localhost\r\nX-Slow: ") == ""


def test_a_body_that_does_not_come_is_408(guarded: Server) -> None:
    said = talk(guarded, HEAD + b"Content-Type: application/json\r\nContent-Length: 100\r\n\r\n{")
    assert " 408 " in said.splitlines()[0]
    assert "/problems/request-timeout" in said


def test_a_declared_body_that_is_too_large_is_refused_unread(guarded: Server) -> None:
    said = talk(guarded, HEAD + b"Content-Type: multipart/form-data; boundary=x\r\nContent-Length: 100001\r\n\r\n--x")
    assert " 413 " in said.splitlines()[0]
    assert "application/problem+json" in said


def test_a_chunked_body_is_refused_as_soon_as_it_is_too_large(guarded: Server) -> None:
    part = b"Content-Disposition: form-data; name=stage; filename=a\r\n\r\n"
    chunk = b"8000\r\n" + b"x" * 0x8000 + b"\r\n"
    first = b"--x\r\n" + part
    body = f"{len(first):x}\r\n".encode() + first + b"\r\n" + chunk * 4  # and no end
    head = HEAD + b"Content-Type: multipart/form-data; boundary=x\r\nTransfer-Encoding: chunked\r\n\r\n"
    said = talk(guarded, head + body)
    assert " 413 " in said.splitlines()[0]
    assert "/problems/too-large" in said


def test_who_leaves_in_the_middle_of_a_body_takes_no_place(guarded: Server) -> None:
    for _ in range(30):  # more than workers and queue together
        with guarded.connect() as connection:
            connection.sendall(HEAD + b"Content-Type: application/json\r\nContent-Length: 100\r\n\r\n{")
    with guarded.client(headers={"Authorization": "Bearer correct-horse"}) as client:

        def taken() -> bool:
            answer = client.post("/v1/render", files=upload(BALL), data={"settings": '{"image_width": 8}'})
            assert answer.status_code in (200, 429)
            return answer.status_code == 200

        until(taken)
