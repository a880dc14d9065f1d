"""Pictures that have an address: cached by their ETag, of stages by name and by digest, opened by a signature."""

from __future__ import annotations

import hashlib
import io
import os
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from service_server import BALL, PATIENT, ROOT, InProcess, Server, running

from refract_core.images.pictures import read_texture
from service.app import Settings, create_app
from service.client import Client, Refused
from service.limits import Limits
from service.shelf import Shelf
from service.signing import expiry, signed

GOOD = ROOT / "usd_samples" / "good"
TOKEN, KEY = "a-token-of-the-tests", "a-key-of-the-tests"
READER, SHOP = "a-token-that-reads", "a-token-of-a-shop"
AUTHORIZED = {"Authorization": f"Bearer {TOKEN}"}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("thumbnails")
    named = ((READER, "reader", "read"), (SHOP, "shop", "read,render"))
    lines = [f"{name} sha256:{hashlib.sha256(token.encode()).hexdigest()} {scopes}" for token, name, scopes in named]
    (folder / "tokens").write_text("\n".join([TOKEN, *lines]))
    (folder / "key").write_text(KEY)
    words = ("--stage-root", str(GOOD), "--workers", "1", "--token-file", str(folder / "tokens"), "--key-file",
             str(folder / "key"), *PATIENT)  # fmt: skip
    with running(folder / "data", *words) as server:
        yield server


@pytest.fixture
def client(server: Server) -> Iterator[httpx.Client]:
    with server.client(headers=AUTHORIZED) as client:
        yield client


def width_of(answer: httpx.Response) -> int:
    assert answer.status_code == 200, answer.text
    return int(read_texture(answer.content, name="picture", color_space="raw").pixels.shape[1])


# --- signatures


def test_a_signed_address_holds_until_its_time_and_no_other_does() -> None:
    address = signed(KEY, "/v1/thumbnails/a%20b.usda", "w=64", 1000)
    path, _, query = address.partition("?")
    assert expiry(KEY, path, query, 999.0) == 1000
    assert expiry(KEY, path, query, 1000.0) is None
    for other_path, other_query in (
        (path + "x", query), (path, query.replace("w=64", "w=65")), (path, query.replace("1000", "2000")),
        (path, query + "&w=65"), (path, "w=65&" + query), (path, query.replace("signature=", "signature=0")[:-1]),
        (path, query.partition("&signature")[0]), (path, ""),
    ):  # fmt: skip
        assert expiry(KEY, other_path, other_query, 0.0) is None
    assert expiry("another-key-of-the-tests", path, query, 0.0) is None
    assert expiry("", path, query, 0.0) is None


# --- the shelf


def test_a_shelf_keeps_what_was_asked_for_last(tmp_path: Path) -> None:
    shelf = Shelf(tmp_path / "stages", Limits(kept_bytes=25))
    digests = [str(number) * 64 for number in range(3)]
    for age, digest in enumerate(digests):
        (tmp_path / "new").write_bytes(b"0123456789")
        shelf.put(digest, ".usda", tmp_path / "new")
        os.utime(tmp_path / "stages" / f"{digest}.usda", (time.time() - 100 + age,) * 2)
    shelf.sweep()
    assert [bool(shelf.find(digest)) for digest in digests] == [False, True, True]
    old = Shelf(tmp_path / "stages", Limits(retention_seconds=10))
    os.utime(tmp_path / "stages" / f"{digests[1]}.usda", (0, 0))
    old.sweep()
    assert [bool(old.find(digest)) for digest in digests] == [False, False, True]


@pytest.mark.parametrize(("query", "pointer"), [
    ("w=0", "/image_width"), ("w=x", "/w"), ("w=1.5", "/image_width"), ("size=3", "/size"), ("w=1&w=2", "/w"),
    ("variant=red", "/variants/0"), ("format=gif", "/format"), ("time=nan", "/time"), ("root=a.usda", "/root"),
    ("w=99999999", "/image_width"),
])  # fmt: skip
def test_a_wrong_query_is_told_by_its_parameter(tmp_path: Path, query: str, pointer: str) -> None:
    client = InProcess(create_app(Settings(data=str(tmp_path / "data"), stage_root=str(GOOD))))
    answer = client.get(f"/v1/thumbnails/window.usda?{query}")
    assert answer.status_code == 422
    assert [one["pointer"] for one in answer.json()["errors"]] == [pointer]


# --- pictures beside stages


@pytest.fixture
def gallery(tmp_path: Path) -> Path:
    """A stage root: a stage with a picture, one without, one whose picture is a link that leads out, one too large."""
    root = tmp_path / "root"
    root.mkdir()
    for name in ("shown", "plain", "leading", "huge"):
        (root / f"{name}.usda").write_text(BALL)
    (tmp_path / "secret.png").write_bytes(b"secret")
    (root / "shown.png").write_bytes(b"a picture")
    (root / "leading.png").symlink_to(tmp_path / "secret.png")
    (root / "huge.png").write_bytes(bytes(2000))
    (root / "alone.png").write_bytes(b"no stage of this name")
    return root


def test_a_picture_beside_a_stage_is_listed_and_sent_as_it_is(gallery: Path, tmp_path: Path) -> None:
    limits = Limits(result_bytes=1000)
    client = InProcess(create_app(Settings(data=str(tmp_path / "data"), stage_root=str(gallery), limits=limits)))
    listed = {one["path"]: one["picture"] for one in client.get("/v1/stages").json()["stages"]}
    assert listed == {"shown.usda": "/v1/pictures/shown.usda", "plain.usda": "", "leading.usda": "", "huge.usda": ""}
    first = client.get(listed["shown.usda"])
    assert (first.content, first.headers["content-type"]) == (b"a picture", "image/png")
    assert first.headers["cache-control"] == "public, max-age=300"
    again = client.get("/v1/pictures/shown.usda", headers={"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    for hidden in ("plain", "leading", "huge"):
        assert client.get(f"/v1/pictures/{hidden}.usda").status_code == 404
    for wrong in ("alone.usda", "alone.png", "shown.png", "%2e%2e/secret.usda", "%2e%2e/secret.png"):
        assert client.get(f"/v1/pictures/{wrong}").status_code in (404, 422)
    (gallery / "shown.png").write_bytes(b"another picture")
    assert client.get("/v1/pictures/shown.usda", headers={"If-None-Match": first.headers["etag"]}).status_code == 200


# --- the service


@pytest.mark.slow
def test_a_thumbnail_is_drawn_once_and_kept_by_caches(client: httpx.Client, server: Server) -> None:
    first = client.get("/v1/thumbnails/window.usda?w=48")
    assert width_of(first) == 48
    assert first.headers["cache-control"] == "private, max-age=300"
    before = server_jobs(client)
    again = client.get("/v1/thumbnails/window.usda?w=48")
    assert (again.content, again.headers["etag"]) == (first.content, first.headers["etag"])
    same = client.get("/v1/thumbnails/window.usda?w=48", headers={"If-None-Match": first.headers["etag"]})
    assert (same.status_code, same.content, same.headers["etag"]) == (304, b"", first.headers["etag"])
    assert same.headers["cache-control"] == first.headers["cache-control"]
    assert server_jobs(client) == before
    assert client.get("/v1/thumbnails/window.usda?w=32").headers["etag"] != first.headers["etag"]
    webp = client.get("/v1/thumbnails/window.usda?w=48&format=webp")
    assert webp.headers["content-type"] == "image/webp"
    for wrong in ("../good/window.usda", "nothing.usda", "%2e%2e/x.usda"):
        assert client.get(f"/v1/thumbnails/{wrong}").status_code in (404, 422)


def server_jobs(client: httpx.Client) -> float:
    lines = client.get("/metrics").text.splitlines()
    return sum(float(line.rpartition(" ")[2]) for line in lines if line.startswith("refract_jobs_total{"))


@pytest.mark.slow
def test_a_stage_that_was_sent_has_thumbnails_by_its_digest(client: httpx.Client, server: Server) -> None:
    content = BALL.encode()
    digest = hashlib.sha256(content).hexdigest()
    assert client.get(f"/v1/thumbnails/{digest}").status_code == 404
    assert client.put(f"/v1/stages/{digest}", content=content).status_code == 201
    assert client.put(f"/v1/stages/{digest}", content=content).status_code == 204
    small = client.get(f"/v1/thumbnails/{digest}?w=24")
    assert width_of(small) == 24
    assert small.headers["cache-control"] == "private, max-age=86400"
    assert width_of(client.get(f"/v1/thumbnails/{digest}?w=16")) == 16  # the stage is still there
    wrong = client.put(f"/v1/stages/{'0' * 64}", content=content)
    assert (wrong.status_code, digest in wrong.json()["detail"]) == (422, True)
    assert client.put(f"/v1/stages/{'0' * 64}", content=b"no stage at all").status_code == 415
    assert client.put("/v1/stages/x", content=content).status_code == 404
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("a.usda", BALL)
        archive.writestr("b.usda", BALL)
    digest = hashlib.sha256(stream.getvalue()).hexdigest()
    sent = client.put(f"/v1/stages/{digest}", content=stream.getvalue(), headers={"Content-Type": "application/zip"})
    assert sent.status_code == 201
    assert width_of(client.get(f"/v1/thumbnails/{digest}?w=16&root=b.usda")) == 16
    assert client.get(f"/v1/thumbnails/{digest}?w=16").status_code == 422
    assert not [name for name in os.listdir(server.data / "work") if name.startswith("upload-")]


@pytest.mark.slow
def test_a_signed_address_is_open_to_all_until_its_time(client: httpx.Client, server: Server) -> None:
    ours = Client(server.url, token=TOKEN)
    address = ours.thumbnail_address("window.usda", {"w": 40, "variant": []}, key=KEY, seconds=600)
    with server.client() as anybody:
        answer = anybody.get(address)
        assert width_of(answer) == 40
        assert answer.headers["cache-control"] in {f"public, max-age={seconds}" for seconds in range(290, 301)}
        assert anybody.get(address.replace("w=40", "w=41")).status_code == 401
        assert anybody.get("/v1/thumbnails/window.usda?w=40").status_code == 401
        assert anybody.request("PUT", address).status_code == 401
        over = ours.thumbnail_address("window.usda", {"w": 40}, key=KEY, seconds=-1)
        assert anybody.get(over).status_code == 401
        assert anybody.get(address.replace("/thumbnails/", "/jobs/")).status_code == 401


@pytest.mark.slow
def test_a_thumbnail_is_work_and_belongs_to_who_asks(client: httpx.Client, server: Server) -> None:
    path = "/v1/thumbnails/window.usda?w=24"
    address = Client(server.url).thumbnail_address("window.usda", {"w": 24}, key=KEY, seconds=600)
    with server.client(headers={"Authorization": f"Bearer {READER}"}) as reader:
        assert reader.get(path).json()["type"] == "/problems/forbidden"
        signed_one = reader.get(address)
        assert width_of(signed_one) == 24
    with server.client(headers={"Authorization": f"Bearer {SHOP}"}) as shop:
        theirs, ours = shop.get(path), client.get(path)
        jobs = {answer.headers["content-location"] for answer in (theirs, ours, signed_one)}
        assert len(jobs) == 3
        assert shop.get(theirs.headers["content-location"]).status_code == 200
        assert client.get(theirs.headers["content-location"]).status_code == 404
        assert shop.get(signed_one.headers["content-location"]).status_code == 404


@pytest.mark.slow
def test_the_client_keeps_stages_and_asks_for_thumbnails(server: Server, tmp_path: Path) -> None:
    ours = Client(server.url, token=TOKEN)
    (tmp_path / "small.usda").write_text(BALL.replace("ior = 1.5", "ior = 1.4"))
    digest = ours.keep(tmp_path / "small.usda")
    assert digest == ours.keep(tmp_path / "small.usda")
    first = ours.thumbnail(digest, {"w": 20, "format": "webp"})
    assert first is not None
    assert first.content.startswith(b"RIFF")
    assert ours.thumbnail(digest, {"w": 20, "format": "webp"}, etag=first.etag) is None
    with pytest.raises(Refused):
        ours.thumbnail("nothing.usda")
