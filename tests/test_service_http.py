"""The service as a client meets it: a real process, real sockets, real renders."""

from __future__ import annotations

import contextlib
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from pxr import Usd, UsdGeom
from service_server import BALL, LONG, PATIENT, ROOT, SMALL, Server, files_under, kill, running, until, upload

from refract_core.images.pictures import read_texture

pytestmark = pytest.mark.slow
GOOD = ROOT / "usd_samples" / "good"
JSON = b"POST /v1/render HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
SOON = 30.0
"""[s] What ends within it ended because it was stopped: `LONG` takes longer by itself."""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    data = tmp_path_factory.mktemp("service") / "data"
    words = ("--stage-root", str(GOOD), "--workers", "1", "--queue", "1", *PATIENT, "--limit", "share=100")
    with running(data, *words) as server:
        yield server


@pytest.fixture
def client(server: Server) -> Iterator[httpx.Client]:
    with server.client() as client:
        yield client
    server.idle()


def post(client: httpx.Client, verb: str = "render", stage: str = BALL, **settings: Any) -> httpx.Response:
    chosen = {**SMALL, **settings} if verb == "render" else settings
    return client.post(f"/v1/{verb}", files=upload(stage), data={"settings": json.dumps(chosen)})


def pixels_of(content: bytes) -> Any:
    return read_texture(content, name="picture", color_space="auto").pixels


def test_an_upload_becomes_the_picture_that_the_command_line_makes(client: httpx.Client, tmp_path: Path) -> None:
    from refract_core.progress import reporting
    from refract_core.verbs.render_files import Order, render_files

    answer = post(client)
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "image/png"
    (tmp_path / "stage.usda").write_text(BALL)
    order = Order(stage=str(tmp_path / "stage.usda"), out=str(tmp_path / "out.png"), overrides=SMALL)
    with reporting("none") as report:
        render_files(order, report, lambda: False)
    np.testing.assert_array_equal(pixels_of(answer.content), pixels_of((tmp_path / "out.png").read_bytes()))


def test_accept_chooses_the_format(client: httpx.Client) -> None:
    answer = client.post("/v1/render", json={"stage": "traced.usda", **SMALL}, headers={"Accept": "image/x-exr"})
    assert answer.headers["content-type"] == "image/x-exr"
    assert answer.content.startswith(b"\x76\x2f\x31\x01")
    assert str(ROOT).encode() not in answer.content
    refused = client.post("/v1/render", json={"stage": "traced.usda"}, headers={"Accept": "image/gif"})
    assert refused.status_code == 406


def test_the_same_request_is_the_same_job(client: httpx.Client) -> None:
    first, second = post(client, exposure=1.0), post(client, exposure=1.0)
    assert first.headers["etag"] == second.headers["etag"]
    assert first.content == second.content
    assert post(client, exposure=2.0).headers["etag"] != first.headers["etag"]
    where, tag = first.headers["content-location"], first.headers["etag"]
    assert not tag.startswith("W/")
    assert client.get(f"{where}/image").headers["etag"] == tag
    unchanged = client.get(f"{where}/image", headers={"If-None-Match": f'"other", {tag}'})
    assert (unchanged.status_code, unchanged.content) == (304, b"")
    assert client.get(f"{where}/image", headers={"If-None-Match": '"other"'}).status_code == 200


def test_a_job_tells_its_progress_and_keeps_its_results(client: httpx.Client) -> None:
    settings = {**SMALL, "aovs": ["thickness", "weight.probe"], "exposure": 0.25}
    body = {"files": upload(BALL), "data": {"settings": json.dumps(settings)}}
    accepted = client.post("/v1/render", **body, headers={"Prefer": "respond-async"})  # type: ignore[arg-type]
    assert accepted.status_code == 202
    where = accepted.headers["location"]
    with client.stream("GET", f"{where}/events") as stream:
        assert stream.headers["content-type"].startswith("text/event-stream")
        lines = list(stream.iter_lines())
    events = [line.removeprefix("event: ") for line in lines if line.startswith("event: ")]
    assert events[-1] == "done"
    assert set(events[:-1]) <= {"progress"}
    job = client.get(where).json()
    assert json.loads(lines[-2].removeprefix("data: ")) == job
    assert (job["status"], job["fraction"], job["width"]) == ("done", 1.0, 32)
    assert [aov["name"] for aov in job["aovs"]] == settings["aovs"]
    thickness = job["aovs"][0]
    pixels = pixels_of(client.get(thickness["href"]).content)[..., 0]
    assert thickness["white"] == pytest.approx(2.0)  # the ball's, in metres
    assert pixels.max() == 255
    assert client.get(f"{where}/aovs/Z.png").status_code == 404
    assert client.delete(where).json()["status"] == "done"


def test_overrides_change_one_material(client: httpx.Client) -> None:
    plain = post(client).content
    other = post(client, overrides={"/World/Glass": {"model": "traced", "ior": 1.2, "roughness": 0.0}})
    assert other.status_code == 200
    assert other.content != plain
    same = post(client, overrides={"/World/Ball": {"ior": 1.5, "thickness": 2.0}})  # what the stage says anyway
    np.testing.assert_array_equal(pixels_of(same.content), pixels_of(plain))
    unknown = post(client, overrides={"/World/Nothing": {"ior": 1.2}}).json()
    assert unknown["prim"] == "/World/Nothing"
    assert unknown["errors"][0]["pointer"] == "/overrides/~1World~1Nothing"


def test_inspect_and_validate_answer_as_the_command_line(client: httpx.Client, tmp_path: Path) -> None:
    from refract_core.verbs.inspect import inspect
    from refract_core.verbs.validate import ValidateOrder, to_json, validate

    seen = client.post("/v1/inspect", json={"stage": "marble.usda"}).json()
    assert seen == {**inspect(str(GOOD / "marble.usda")), "stage": "marble.usda"}
    found = client.post("/v1/validate", json={"stage": "marble.usda"}).json()
    theirs = json.loads(to_json(validate(ValidateOrder(stage=str(GOOD / "marble.usda")))))
    assert [one["rule"] for one in found["findings"]] == [one["rule"] for one in theirs["findings"]]


@pytest.mark.parametrize("flatten", [False, True])
def test_convert_gives_a_package_without_paths_of_ours(client: httpx.Client, tmp_path: Path, flatten: bool) -> None:
    body = {"stage": "preview_surface.usda", "flatten": flatten}
    answer = client.post("/v1/convert", json=body)
    assert answer.headers["content-type"] == "model/vnd.usdz+zip", answer.text
    (tmp_path / "c.usdz").write_bytes(answer.content)
    stage = Usd.Stage.Open(str(tmp_path / "c.usdz"))
    assert any("RefractMaterialAPI" in prim.GetAppliedSchemas() for prim in stage.Traverse())
    text = "".join(layer.ExportToString() for layer in stage.GetUsedLayers(includeClipLayers=False))
    assert str(ROOT) not in text
    assert str(tmp_path.parents[0]) not in text.replace(str(tmp_path), "")
    report = client.post("/v1/convert", json=body, headers={"Accept": "application/json"}).json()
    assert report["materials"]


def opened(content: bytes, file: Path) -> Usd.Stage:
    """A package that opens by itself, and names no folder of the machine that made it."""
    file.write_bytes(content)
    stage = Usd.Stage.Open(str(file))
    text = "".join(layer.ExportToString() for layer in stage.GetUsedLayers(includeClipLayers=False))
    assert str(ROOT) not in text.replace(str(file.parent), "")
    assert "/out/" not in text
    return stage


def test_baked_probes_come_with_their_stage_and_their_cubemaps(client: httpx.Client, tmp_path: Path) -> None:
    body = {"stage": "two_probes.usda", "resolution": 8, "samples": 1}
    answer = client.post("/v1/bake-probes", json=body)
    assert answer.headers["content-type"] == "model/vnd.usdz+zip", answer.text
    stage = opened(answer.content, tmp_path / "baked.usdz")
    report = client.post("/v1/bake-probes", json=body, headers={"Accept": "application/json"}).json()
    assert report["prims"]
    inside = set(zipfile.ZipFile(tmp_path / "baked.usdz").namelist())
    for one in report["prims"]:
        texture = stage.GetPrimAtPath(one["path"]).GetAttribute("probe:texture").Get()
        assert texture.path.removeprefix("./") in inside
        assert texture.resolvedPath


def test_baked_thickness_is_that_of_the_geometry(client: httpx.Client, tmp_path: Path) -> None:
    answer = post(client, "bake-thickness")
    assert answer.headers["content-type"] == "model/vnd.usdz+zip", answer.text
    stage = opened(answer.content, tmp_path / "baked.usdz")
    thickness = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/World/Ball")).GetPrimvar("refraction:thickness").Get()
    assert np.allclose(thickness, 2.0, rtol=0.01)  # straight in, through the middle of a ball of radius 1
    where = answer.headers["content-location"]
    report = client.get(f"{where}/report").json()
    assert [one["path"] for one in report["prims"]] == ["/World/Ball"]
    assert client.get(f"{where}/file").content == answer.content


@pytest.mark.parametrize(("verb", "settings", "pointer"), [
    ("bake-probes", {"resolution": 4096}, "/resolution"), ("bake-probes", {"samples": 4096}, "/samples"),
    ("bake-probes", {"resolution": 4}, "/resolution"), ("bake-thickness", {"texture": 8192}, "/texture"),
    ("bake-thickness", {"along": "sideways"}, "/along"), ("bake-thickness", {"samples": 1}, "/samples"),
])  # fmt: skip
def test_a_bake_beyond_the_limits_is_refused_at_once(
    client: httpx.Client, verb: str, settings: dict[str, Any], pointer: str
) -> None:
    answer = post(client, verb, **settings)
    assert answer.status_code == 422
    assert [one["pointer"] for one in answer.json()["errors"]] == [pointer]


def test_probes_of_a_stage_count_together(client: httpx.Client) -> None:
    """Each of them is within the limits, which are looked at again when the stage has been read."""
    answer = client.post("/v1/bake-probes", json={"stage": "two_probes.usda", "resolution": 600, "samples": 64})
    assert (answer.status_code, answer.json()["type"]) == (422, "/problems/limit-exceeded"), answer.text


def test_cancel_kills_the_process(client: httpx.Client, server: Server) -> None:
    job = client.post("/v1/render", json=LONG, headers={"Prefer": "respond-async"})
    where = job.headers["location"]
    until(lambda: client.get(where).json()["fraction"] > 0.0)
    before = server.workers()
    assert before
    cancelled = client.delete(where).json()
    assert cancelled["status"] == "cancelled"
    assert cancelled["problem"]["type"] == "/problems/cancelled"
    until(lambda: not set(before) & set(server.workers()), SOON)
    assert client.get(f"{where}/image").status_code == 409
    with client.stream("GET", f"{where}/events") as stream:
        assert next(stream.iter_lines()) == "event: cancelled"
    assert post(client).status_code == 200


def test_who_leaves_cancels_what_only_they_waited_for(client: httpx.Client, server: Server) -> None:
    with server.connect() as connection:
        body = json.dumps({**LONG, "exposure": 0.5}).encode()
        head = "POST /v1/render HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        connection.sendall(f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body)
        until(lambda: server.metric("refract_jobs_running") == 1.0)
    until(lambda: server.metric("refract_jobs_running") == 0.0, SOON)


def test_a_full_queue_refuses_new_jobs_and_gives_what_there_is(client: httpx.Client, server: Server) -> None:
    picture = post(client, exposure=-3.0)
    jobs = [
        client.post("/v1/render", json={**LONG, "exposure": float(stop)}, headers={"Prefer": "respond-async"})
        for stop in (3, 4)
    ]
    assert [job.status_code for job in jobs] == [202, 202]
    refused = post(client, exposure=-4.0)
    assert (refused.status_code, refused.json()["type"]) == (429, "/problems/queue-full")
    assert int(refused.headers["retry-after"]) >= 1
    again = post(client, exposure=-3.0)
    assert (again.status_code, again.headers["etag"], again.content) == (200, picture.headers["etag"], picture.content)
    for job in jobs:
        client.delete(job.headers["location"])


def test_the_kill_of_a_worker_fails_one_job(client: httpx.Client, server: Server) -> None:
    job = client.post("/v1/render", json={**LONG, "exposure": 0.75}, headers={"Prefer": "respond-async"})
    where = job.headers["location"]
    until(lambda: client.get(where).json()["fraction"] > 0.0)
    for pid in server.workers():
        kill(pid)
    until(lambda: client.get(where).json()["status"] == "failed")
    assert client.get(where).json()["problem"]["type"] == "/problems/stage-crashed"
    assert f"job {where.rpartition('/')[2]}: worker ended with -9" in server.log.read_text()
    assert post(client).status_code == 200


def test_the_death_of_all_workers_is_survived(client: httpx.Client, server: Server) -> None:
    kill(server.nursery())
    first = post(client, exposure=-1.0)
    if first.status_code != 200:  # it had begun
        assert (first.status_code, first.json()["type"]) == (503, "/problems/interrupted")
    assert post(client, exposure=-1.0).status_code == 200


@pytest.mark.parametrize(
    ("sent", "status"),
    [
        (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03 no HTTP\r\n\r\n", 400),
        (b"GET /livez HTTP/1.1\r\n\r\n", 400),
        (b"GET /livez HTTP/1.1\r\nHost: localhost\r\nno colon\r\n\r\n", 400),
        (b"GET /livez HTTP/1.1\r\nHost: localhost\r\nX: " + b"a" * 500_000 + b"\r\n\r\n", 431),
        (b"GET /" + b"a" * 500_000 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n", 431),
        (JSON + b"Content-Length: -5\r\n\r\n", 400),
        (JSON + b"Transfer-Encoding: gzip\r\n\r\n", 501),
        (JSON + b"Transfer-Encoding: chunked\r\n\r\nZZ\r\nabc\r\n", 400),
        (JSON + b'Transfer-Encoding: chunked\r\n\r\n2\r\n{"\r\nZZ\r\nabc\r\n', 400),
    ],
)
def test_what_is_no_http_is_a_problem_document_too(server: Server, sent: bytes, status: int) -> None:
    with server.connect() as connection:
        with contextlib.suppress(ConnectionError):  # it need not listen to the end
            connection.sendall(sent)
        answer = b"".join(iter(lambda: connection.recv(65536), b""))
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 %d " % status)
    assert b"content-type: application/problem+json" in head.lower()
    assert json.loads(body)["status"] == status
    assert "Traceback" not in server.log.read_text()


def test_head_is_get_without_the_body(client: httpx.Client) -> None:
    picture = post(client, aovs=["Z"]).headers["content-location"]
    package = post(client, "convert").headers["content-location"]
    results = [f"{picture}/image", f"{picture}/aovs/Z.png", f"{package}/file", f"{package}/report"]
    others = ["/", "/livez", "/readyz", "/v1/limits", "/v1/stages", picture, f"{picture}/events", "/docs", "/nothing",
              "/openapi.json", "/static/page.js"]  # fmt: skip
    own = {"date", "x-request-id"}
    for path in (*results, *others):
        get, head = client.get(path), client.head(path)
        assert (head.status_code, head.content) == (get.status_code, b"")
        assert {**head.headers, **dict.fromkeys(own)} == {**get.headers, **dict.fromkeys(own)}, path
    for path in results:
        tag = client.head(path).headers["etag"]
        for method in ("GET", "HEAD"):
            unchanged = client.request(method, path, headers={"If-None-Match": tag})
            assert (unchanged.status_code, unchanged.content, unchanged.headers["etag"]) == (304, b"", tag)


def test_a_part_of_a_result_can_be_asked_for(client: httpx.Client) -> None:
    where = post(client).headers["content-location"] + "/image"
    whole = client.get(where)
    tag, size = whole.headers["etag"], len(whole.content)

    def ask(span: str, **headers: str) -> tuple[int, bytes, str]:
        answer = client.get(where, headers={"Range": span, **{k.replace("_", "-"): v for k, v in headers.items()}})
        return answer.status_code, answer.content, answer.headers.get("content-range", "")

    assert ask("bytes=2-9") == (206, whole.content[2:10], f"bytes 2-9/{size}")
    assert ask("bytes=-7") == (206, whole.content[-7:], f"bytes {size - 7}-{size - 1}/{size}")
    assert ask("bytes=2-9", If_Range=tag)[0] == 206
    beyond = client.get(where, headers={"Range": f"bytes={size}-"})
    assert (beyond.status_code, beyond.headers["content-range"]) == (416, f"bytes */{size}")
    assert beyond.json()["type"] == "/problems/range-not-satisfiable"
    for ignored in ("bytes=9-2", "lines=1-2", "bytes=x", "bytes=-", "bytes=0-1,4-5"):
        assert ask(ignored) == (200, whole.content, "")
    assert ask("bytes=2-9", If_Range='"other"') == (200, whole.content, "")
    assert ask(f"bytes={size}-", If_Range=f"W/{tag}") == (200, whole.content, "")


def test_livez_readyz_limits_stages(client: httpx.Client) -> None:
    assert client.get("/livez").json() == {"status": "alive"}
    assert client.get("/readyz").json()["confinement"]["threads"] == 1
    stages = {one["path"]: one for one in client.get("/v1/stages").json()["stages"]}
    size = (GOOD / "marble.usda").stat().st_size
    assert stages["marble.usda"] == {"path": "marble.usda", "bytes": size, "picture": "/v1/pictures/marble.usda"}
    assert stages["parts/studio.usda"]["picture"] == ""
    limits = client.get("/v1/limits").json()
    assert {row["name"]: row["value"] for row in limits["limits"]}["samples"] == 64


def test_an_idle_service_leaves_nothing_behind(client: httpx.Client, server: Server) -> None:
    post(client, exposure=-2.0)
    server.idle()
    until(lambda: len(list((server.data / "work").iterdir())) == 1)  # of the next worker
    until(lambda: len(server.workers()) == 1)
    until(lambda: not [path for path in files_under(server.data) if path.name.startswith("stage.usd")])


def test_a_browser_asks_anew_for_the_pages_files(client: httpx.Client) -> None:
    first = client.get("/static/page.js")
    assert first.headers["cache-control"] == "no-cache"
    again = client.get("/static/page.js", headers={"If-None-Match": first.headers["etag"]})
    assert (again.status_code, again.headers["cache-control"]) == (304, "no-cache")
