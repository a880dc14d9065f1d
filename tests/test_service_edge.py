"""Who may come in: names, sites of others, and requests whose length is told twice. Without workers."""

from __future__ import annotations

import hashlib
import json
import shutil
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import uvicorn
from service_server import PATIENCE, ROOT, InProcess, until

from refract_core.errors import UsageError
from service.app import Settings, create_app
from service.hosts import door

GOOD = ROOT / "usd_samples" / "good"
SHOP = "https://shop.example.org"
THEIRS = "https://example.com"


def app_of(folder: Path, **settings: Any) -> InProcess:
    return InProcess(create_app(Settings(stage_root=str(GOOD), data=str(folder / "data"), **settings)))


@contextmanager
def listening(folder: Path, **settings: Any) -> Iterator[tuple[str, int]]:
    """The app on a real socket, in a thread; no worker is started."""
    chosen = Settings(stage_root=str(GOOD), data=str(folder / "data"), **settings)
    config = uvicorn.Config(create_app(chosen), http="h11", ws="none", lifespan="off", log_level="error",
                            proxy_headers=False, server_header=False)  # fmt: skip
    with socket.create_server(("127.0.0.1", 0)) as listener:
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            until(lambda: server.started)
            yield listener.getsockname()[:2]
        finally:
            server.should_exit = True
            thread.join()


def talk(address: tuple[str, int], sent: bytes) -> bytes:
    """All that is answered until the other side closes."""
    with socket.create_connection(address, timeout=PATIENCE) as connection:
        connection.sendall(sent)
        return b"".join(iter(lambda: connection.recv(65536), b""))


# --- names


@pytest.mark.parametrize(
    ("bound", "allowed", "host", "right"),
    [
        ("127.0.0.1", (), "localhost", True), ("127.0.0.1", (), "LocalHost.:8000", True),
        ("127.0.0.1", (), "127.0.0.1:8000", True), ("127.0.0.1", (), "127.9.9.9", True),
        ("127.0.0.1", (), "[::1]:8000", True), ("127.0.0.1", (), "[::ffff:127.0.0.1]", True),
        ("127.0.0.1", (), "evil.test", False), ("127.0.0.1", (), "evil.test:8000", False),
        ("127.0.0.1", (), "localhost.evil.test", False), ("127.0.0.1", (), "127.0.0.1.nip.io", False),
        ("127.0.0.1", (), "192.168.1.5", False), ("127.0.0.1", (), None, False), ("127.0.0.1", (), "", False),
        ("127.0.0.1", (), "localhost@evil.test", False), ("127.0.0.1", (), "localhost/evil.test", False),
        ("127.0.0.1", (), "localhost evil.test", False), ("127.0.0.1", (), "evil.test, localhost", False),
        ("192.168.1.5", (), "192.168.1.5:8000", True), ("192.168.1.5", (), "192.168.1.6", False),
        ("studio.local", (), "studio.local:8000", True), ("studio.local", (), "other.local", False),
        ("2001:db8::1", (), "[2001:DB8:0:0::1]:8000", True),
        ("0.0.0.0", (), "192.168.1.6:8000", True), ("::", (), "[2001:db8::7]", True), ("", (), "10.0.0.1", True),
        ("0.0.0.0", (), "evil.test", False), ("::", (), "127.0.0.1.nip.io", False), ("0.0.0.0", (), "127.1", False),
        ("127.0.0.1", ("Render.Example.org", "10.1.1.1"), "render.example.org", True),
        ("127.0.0.1", ("render.example.org", "10.1.1.1"), "10.1.1.1:80", True),
        ("127.0.0.1", ("render.example.org",), "a.render.example.org", False),
    ],
)  # fmt: skip
def test_the_service_answers_to_its_own_names(bound: str, allowed: tuple[str, ...], host: str | None,
                                              right: bool) -> None:  # fmt: skip
    assert door(bound, allowed).answers_to(host) is right


def test_a_page_whose_name_was_bound_anew_reads_nothing(tmp_path: Path) -> None:
    """Origin and Host agree, as in a browser that was told evil.test is this machine."""
    client = app_of(tmp_path, host="127.0.0.1")
    headers = {"Host": "evil.test:8000", "Origin": "http://evil.test:8000"}
    for method, path in (("GET", "/v1/stages"), ("GET", "/"), ("GET", "/openapi.json"), ("POST", "/v1/render"),
                         ("GET", "/nothing"), ("GET", "/livez")):  # fmt: skip
        answer = client.request(method, path, headers=headers)
        assert (answer.status_code, answer.json()["type"]) == (421, "/problems/misdirected")
        assert "marble" not in answer.text
    assert "marble.usda" in client.get("/v1/stages", headers={"Host": "127.0.0.1:8000"}).text


@pytest.mark.parametrize("wrong", [
    {"allow_hosts": ("a:80",)}, {"allow_hosts": ("http://a",)}, {"allow_hosts": ("",)}, {"allow_hosts": ("*",)},
    {"allow_origins": ("*",)}, {"allow_origins": ("null",)}, {"allow_origins": ("shop.example.org",)},
    {"allow_origins": ("https://a/b",)}, {"allow_origins": ("https://a?b",)}, {"allow_origins": ("ftp://a",)},
    {"proxies": ("*",)}, {"proxies": ("localhost",)}, {"allow_origins": ("https://u@a",)}, {"allow_origins": ("https://a:x",)},
])  # fmt: skip
def test_names_and_sites_are_checked_at_the_start(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        Settings(**wrong)


# --- other sites


def test_without_allowed_sites_there_is_no_cors(tmp_path: Path) -> None:
    client = app_of(tmp_path)
    read = client.get("/v1/stages", headers={"Origin": SHOP})
    written = client.post("/v1/render", json={}, headers={"Origin": SHOP})
    asked = client.request("OPTIONS", "/v1/render", headers={"Origin": SHOP, "Access-Control-Request-Method": "POST"})
    assert (read.status_code, written.status_code, asked.status_code) == (200, 403, 405)
    for answer in (read, written, asked):
        assert not [name for name in answer.headers if name.startswith("access-control")]
        assert answer.headers["cross-origin-resource-policy"] == "same-origin"


def test_an_allowed_site_reads_and_writes(tmp_path: Path) -> None:
    client = app_of(tmp_path, allow_origins=(f"{SHOP}:443/",))
    read = client.get("/v1/stages", headers={"Origin": SHOP})
    written = client.post("/v1/render", json={"stage": "marble.usda", "samples": 100_000}, headers={"Origin": SHOP})
    assert (read.status_code, written.status_code) == (200, 422)  # a problem is for its eyes too
    for answer in (read, written):
        assert answer.headers["access-control-allow-origin"] == SHOP
        assert "Origin" in answer.headers["vary"]
        assert {"ETag", "Location", "Retry-After", "X-Request-ID"} <= {
            *answer.headers["access-control-expose-headers"].split(", ")
        }
        assert "access-control-allow-credentials" not in answer.headers
        assert answer.headers["cross-origin-resource-policy"] == "cross-origin"
    assert client.get("/", headers={"Origin": SHOP}).headers["cross-origin-resource-policy"] == "same-origin"


def test_a_site_that_is_not_allowed_stays_out_beside_one_that_is(tmp_path: Path) -> None:
    client = app_of(tmp_path, allow_origins=(SHOP,))
    for origin in (THEIRS, "http://shop.example.org", f"{SHOP}:8443", f"{SHOP}.evil.test", "null"):
        read = client.get("/v1/stages", headers={"Origin": origin})
        assert "access-control-allow-origin" not in read.headers
        assert "Origin" in read.headers["vary"]  # a cache must not give it what the shop was given
        written = client.post("/v1/render", json={}, headers={"Origin": origin})
        assert written.json()["type"] == "/problems/cross-origin"


def test_a_browser_that_asks_first_is_answered_before_a_token_is_asked_for(tmp_path: Path) -> None:
    client = app_of(tmp_path, allow_origins=(SHOP,), tokens=("a-token-of-the-tests",))
    question = {"Origin": SHOP, "Access-Control-Request-Method": "POST",
                "Access-Control-Request-Headers": "authorization, content-type, prefer"}  # fmt: skip
    answer = client.request("OPTIONS", "/v1/render", headers=question)
    assert (answer.status_code, answer.content) == (204, b"")
    assert answer.headers["access-control-allow-origin"] == SHOP
    assert {"POST", "DELETE"} <= {*answer.headers["access-control-allow-methods"].split(", ")}
    allowed = {*answer.headers["access-control-allow-headers"].lower().split(", ")}
    assert {"authorization", "content-type", "prefer", "if-none-match"} <= allowed
    assert {"Origin", "Access-Control-Request-Method"} <= {*answer.headers["vary"].split(", ")}
    refused = client.request("OPTIONS", "/v1/render", headers={**question, "Origin": THEIRS})
    assert "access-control-allow-origin" not in refused.headers


# --- tokens


def line_of(name: str, token: str, scopes: str) -> str:
    return f"{name} sha256:{hashlib.sha256(token.encode()).hexdigest()} {scopes}"


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


TOKENS = (line_of("studio", "of-the-studio", "read,render"), line_of("studio", "of-its-wall", "read"),
          line_of("press", "of-the-press", "render"), line_of("prometheus", "of-prometheus", "metrics"),
          "a-token-for-all")  # fmt: skip
MAY = {"of-the-studio": {"read", "render"}, "of-its-wall": {"read"}, "of-the-press": {"render"},
       "of-prometheus": {"metrics"}, "a-token-for-all": {"read", "render", "metrics"}}  # fmt: skip


@pytest.mark.parametrize("token", MAY)
def test_a_token_may_do_what_its_scopes_say(tmp_path: Path, token: str) -> None:
    client = app_of(tmp_path, tokens=TOKENS)
    asked = {"read": ("GET", "/v1/stages"), "render": ("POST", "/v1/render"), "metrics": ("GET", "/metrics")}
    for scope, (method, path) in asked.items():
        answer = client.request(method, path, headers=bearer(token))
        if scope in MAY[token]:
            assert answer.status_code == (415 if method == "POST" else 200)
            continue
        assert (answer.status_code, answer.json()["type"]) == (403, "/problems/forbidden")
        assert answer.headers["www-authenticate"] == f'Bearer error="insufficient_scope", scope="{scope}"'
    assert client.request("DELETE", "/v1/jobs/x", headers=bearer(token)).status_code == (
        404 if "render" in MAY[token] else 403
    )
    assert client.get("/livez").status_code == client.get("/").status_code == 200


@pytest.mark.parametrize("given", ["", "Bearer", "Bearer ", "Bearer wrong", "Basic of-the-studio", "of-the-studio",
                                   "Bearer of-the-studi", "Bearer of-the-studio2", "Bearer \xff\xfe"])  # fmt: skip
def test_a_wrong_token_is_none(tmp_path: Path, given: str) -> None:
    client = app_of(tmp_path, tokens=TOKENS)
    answer = client.get("/v1/stages", headers={"Authorization": given.encode("latin-1")})
    assert (answer.status_code, answer.headers["www-authenticate"]) == (401, "Bearer")
    hashed = TOKENS[0].split()[1].removeprefix("sha256:")
    assert client.get("/v1/stages", headers=bearer(hashed)).status_code == 401  # a stolen file opens nothing


@pytest.mark.parametrize("lines", [
    ("studio sha256:12 read",), ("studio sha256:" + "0" * 64,), ("studio " + "0" * 64 + " read",), ("short",),
    ("stu/dio sha256:" + "0" * 64 + " read",), ("studio sha256:" + "0" * 64 + " read,dance",), ("a b c d",),
    ("studio sha256:" + "0" * 64 + " ,",), (line_of("a", "of-the-studio", "read"), "of-the-studio"),
])  # fmt: skip
def test_a_token_file_is_checked_and_never_quoted(lines: tuple[str, ...]) -> None:
    with pytest.raises(UsageError) as caught:
        Settings(tokens=lines)
    assert "0000" not in str(caught.value)
    assert "of-the-studio" not in str(caught.value)


def test_a_job_is_its_owners_alone(tmp_path: Path) -> None:
    """For another token it is not there, and neither is it for one who asks for the very same."""
    client = app_of(tmp_path, tokens=TOKENS, workers=1, queue=9)
    wish = {"json": {"stage": "marble.usda"}}

    def ask(token: str) -> str:
        headers = {**bearer(token), "Prefer": "respond-async"}
        answer = client.post("/v1/render", headers=headers, **wish)
        assert answer.status_code == 202
        return answer.headers["location"]

    where = ask("of-the-studio")
    assert ask("of-the-studio") == where
    assert len({where, ask("of-the-press"), ask("a-token-for-all")}) == 3
    parts = ("", "/image", "/events", "/report", "/file", "/aovs/Z.png")
    for part in parts:
        theirs = client.get(where + part, headers=bearer("a-token-for-all"))
        nothing = client.get(f"/v1/jobs/{'0' * 64}{part}", headers=bearer("a-token-for-all"))
        assert (theirs.status_code, theirs.json()) == (404, nothing.json())
    assert client.request("DELETE", where, headers=bearer("a-token-for-all")).status_code == 404
    assert client.request("DELETE", where, headers=bearer("of-the-press")).status_code == 404
    assert client.get(where, headers=bearer("of-its-wall")).json()["status"] == "queued"
    assert client.request("DELETE", where, headers=bearer("of-the-studio")).json()["status"] == "cancelled"


def _copied(folder: Path, name: str) -> Path:
    shutil.copytree(folder / "data", folder / name / "data")
    return folder / name


def test_an_owner_is_kept_over_a_restart(tmp_path: Path) -> None:
    headers = {**bearer("of-the-studio"), "Prefer": "respond-async"}
    first = app_of(tmp_path, tokens=TOKENS)
    where = first.post("/v1/render", headers=headers, json={"stage": "marble.usda"}).headers["location"]
    again, later = (app_of(_copied(tmp_path, name), **how) for name, how in (("a", {"tokens": TOKENS}), ("b", {})))
    assert again.get(where, headers=bearer("of-its-wall")).json()["id"] == where.rpartition("/")[2]
    assert again.get(where, headers=bearer("a-token-for-all")).status_code == 404
    assert later.get(where).status_code == 404  # nor is it everybody's once no token is asked for


# --- length told twice


@pytest.mark.parametrize("length", [0, 5, 1000])
def test_two_lengths_are_refused_and_end_the_connection(tmp_path: Path, length: int) -> None:
    """A proxy that goes by the one and a server that goes by the other take two requests for one, or one for two."""
    hidden = b"GET /v1/stages HTTP/1.1\r\nHost: localhost\r\n\r\n"
    sent = (b"POST /v1/render HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
            b"Content-Length: %d\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n" % length)  # fmt: skip
    with listening(tmp_path) as address:
        said = talk(address, sent + hidden)
    head, _, body = said.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 400 ")
    assert b"connection: close" in head.lower()
    assert json.loads(body)["type"] == "/problems/bad-request"  # and nothing after it
    assert b"marble" not in said
