"""Live viewers: a locked worker that keeps one stage ready, and draws small pictures of it until nobody asks."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from service_server import BALL, PATIENT, ROOT, InProcess, Server, files_under, running, until, upload

from refract_core.images.pictures import read_texture
from service.app import Settings, create_app

pytestmark = pytest.mark.slow
GOOD = ROOT / "usd_samples" / "good"
ORDER: dict[str, Any] = {"image_width": 32, "image_height": 18, "quality": "draft", "samples": 1}
HASTY = ("--limit", "live_idle_seconds=3", "--limit", "live_pixels=4096", "--limit", "live_frame_seconds=600",
         "--limit", "live_cpu_seconds=600")  # fmt: skip


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("viewer")
    with running(folder / "data", "--stage-root", str(GOOD), "--workers", "1", *PATIENT, *HASTY) as server:
        yield server


@pytest.fixture
def client(server: Server) -> Iterator[httpx.Client]:
    with server.client() as client:
        until(lambda: viewers(client) == 0)
        yield client


def viewers(client: httpx.Client) -> float:
    (line,) = (one for one in client.get("/metrics").text.splitlines() if one.startswith("refract_live_viewers "))
    return float(line.rpartition(" ")[2])


def opened(client: httpx.Client, **what: Any) -> str:
    """Address of a new viewer."""
    answer = client.post("/v1/live", **(what or {"json": {"stage": "marble.usda"}}))
    assert answer.status_code == 201, answer.text
    assert answer.headers["location"] == answer.json()["links"]["self"]
    return str(answer.headers["location"])


def _stages(server: Server) -> list[Path]:
    return [path for path in files_under(server.data) if path.name.startswith("stage.usd")]


def drawn(client: httpx.Client, address: str, **settings: Any) -> httpx.Response:
    return client.post(f"{address}/pictures", json={**ORDER, **settings})


def pixels(answer: httpx.Response) -> np.ndarray[Any, Any]:
    assert answer.status_code == 200, answer.text
    return np.asarray(read_texture(answer.content, name="picture", color_space="raw").pixels)


def test_a_live_picture_is_the_picture_that_a_render_makes(client: httpx.Client) -> None:
    """Whatever was asked for before: settings, overrides and cameras leave nothing behind."""
    address = opened(client)
    asked: list[dict[str, Any]] = [
        {}, {"exposure": -2.0}, {"overrides": {"/World/Looks/Clear": {"ior": 1.1}}}, {"camera": "/World/Camera"}, {},
    ]  # fmt: skip
    found = [pixels(drawn(client, address, **one)) for one in asked]
    assert found[0].shape[:2] == (18, 32)
    assert np.array_equal(found[0], found[-1])
    assert not np.array_equal(found[0], found[1])
    for one, live in zip(asked, found, strict=True):
        still = client.post("/v1/render", json={"stage": "marble.usda", **ORDER, "caustics": 0, **one})
        assert np.array_equal(live, pixels(still))
    assert client.delete(address).status_code == 204
    assert drawn(client, address).status_code == 404


def test_an_upload_can_be_looked_at_and_nothing_of_it_stays(client: httpx.Client, server: Server) -> None:
    address = opened(client, files=upload(BALL))
    assert pixels(drawn(client, address)).any()
    assert _stages(server)
    until(lambda: viewers(client) == 0)  # nobody asks any more
    until(lambda: not _stages(server))
    until(lambda: len(list((server.data / "work").iterdir())) == 1)  # of the next worker
    assert drawn(client, address).status_code == 404


def test_its_worker_is_locked_as_all_are(client: httpx.Client, server: Server) -> None:
    before = set(server.workers())
    address = opened(client)
    pixels(drawn(client, address))
    (worker,) = set(server.workers()) - before
    lines = Path(f"/proc/{worker}/status").read_text().splitlines()
    status = dict(line.split(":\t", 1) for line in lines if ":\t" in line)
    confinement = client.get("/readyz").json()["confinement"]
    assert status["NoNewPrivs"] == "1"
    assert status["Seccomp"] == ("2" if confinement["seccomp"] else "0")
    assert int(status["CapEff"], 16) == 0
    limits = Path(f"/proc/{worker}/limits").read_text()
    for name in ("Max address space", "Max cpu time", "Max open files"):
        (line,) = (one for one in limits.splitlines() if one.startswith(name))
        assert "unlimited" not in line, line
    client.delete(address)
    until(lambda: not os.path.exists(f"/proc/{worker}"))


def test_one_client_has_one_and_gives_it_back(client: httpx.Client) -> None:
    address = opened(client)
    again = client.post("/v1/live", json={"stage": "marble.usda"})
    assert (again.status_code, again.json()["type"]) == (429, "/problems/share-spent")
    assert int(again.headers["retry-after"]) > 0
    client.delete(address)
    client.delete(opened(client))


def test_what_is_not_for_live_pictures_is_refused_and_the_viewer_lives_on(client: httpx.Client) -> None:
    address = opened(client)
    for wrong, pointer in (
        ({"image_width": 4000}, "/image_width"), ({"aovs": ["N"]}, "/aovs"), ({"widths": [8]}, "/widths"),
        ({"samples": 0}, "/samples"), ({"nothing": 1}, "/nothing"), ({"image_height": 0}, "/image_height"),
    ):  # fmt: skip
        answer = drawn(client, address, **wrong)
        assert answer.status_code == 422, wrong
        assert answer.json()["errors"][0]["pointer"] == pointer
    assert client.post(f"{address}/pictures", content=b"{").status_code == 415
    assert pixels(drawn(client, address)).any()
    client.delete(address)


@pytest.mark.parametrize(("stage", "slug"), [("no usd at all", "stage-invalid"), ("@/etc/passwd@", "stage-refused")])
def test_a_stage_that_cannot_be_drawn_is_told_and_ends_the_viewer(client: httpx.Client, stage: str, slug: str) -> None:
    content = f"#usda 1.0\n{stage}" if slug == "stage-invalid" else f"#usda 1.0\n(\n subLayers = [{stage}]\n)\n"
    address = opened(client, files=upload(content))
    answer = drawn(client, address)
    assert answer.json()["type"] == f"/problems/{slug}"
    assert drawn(client, address).status_code == 404
    assert viewers(client) == 0


def test_a_viewer_needs_a_stage_that_is_there(tmp_path: Path) -> None:
    client = InProcess(create_app(Settings(data=str(tmp_path / "data"), stage_root=str(GOOD))))
    for body in ({"stage": "nothing.usda"}, {}, {"stage": "marble.usda", "webhook": "https://a.b/"}):
        assert client.post("/v1/live", json=body).status_code == 422
    assert client.post(f"/v1/live/{'0' * 64}/pictures", json=ORDER).status_code == 404
    assert client.request("DELETE", f"/v1/live/{'0' * 64}").status_code == 404
