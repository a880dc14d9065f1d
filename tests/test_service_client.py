"""The client of the service, against a service."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from service_server import BALL, LONG, PATIENT, ROOT, Server, running
from service_stages import referring

from service import client, models
from service.client import Client, Job, Refused

GOOD = ROOT / "usd_samples" / "good"
TOKEN = "a-token-of-the-tests"
SMALL: client.RenderSettings = {"image_width": 32, "samples": 1}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("client")
    (folder / "tokens").write_text(TOKEN)
    words = ("--stage-root", str(GOOD), "--workers", "1", "--token-file", str(folder / "tokens"), *PATIENT)
    with running(folder / "data", *words) as server:
        yield server


@pytest.fixture
def ours(server: Server) -> Client:
    return Client(server.url, token=TOKEN)


def test_the_client_knows_every_setting_and_no_other() -> None:
    assert client.RenderSettings.__annotations__.keys() == models.Render.model_fields.keys()
    assert client.ConvertSettings.__annotations__.keys() == models.Convert.model_fields.keys()
    assert client.BakeProbesSettings.__annotations__.keys() == models.BakeProbes.model_fields.keys()
    assert client.BakeThicknessSettings.__annotations__.keys() == models.BakeThickness.model_fields.keys()
    assert client.OverrideValues.__annotations__.keys() == models.Override.model_fields.keys()
    assert Job.__dataclass_fields__.keys() <= models.Job.model_fields.keys()


@pytest.mark.parametrize("url", ["", "localhost:8000", "ftp://x", "http://"])
def test_a_wrong_address_is_told(url: str) -> None:
    with pytest.raises(ValueError, match="http"):
        Client(url)


def test_a_name_that_would_end_a_head_is_not_sent() -> None:
    with pytest.raises(ValueError, match="line break"):
        Client().render({'a"\r\nX-Other: 1': b""})


@pytest.mark.slow
def test_stages_are_drawn_by_name_by_file_and_by_files(ours: Client, tmp_path: Path) -> None:
    assert "marble.usda" in ours.stages()
    named = ours.render("window.usda", SMALL, accept="image/webp")
    assert (named.media_type, named.content[:4]) == ("image/webp", b"RIFF")
    (tmp_path / "ball.usda").write_text(BALL)
    single = ours.render(tmp_path / "ball.usda", SMALL)
    assert single.content.startswith(b"\x89PNG")
    assert ours.image(single.job).content == single.content
    files: dict[str, bytes | Path] = {"a/shot.usda": referring("../b.usda").encode(), "b.usda": tmp_path / "ball.usda"}
    several = ours.render(files, {**SMALL, "stage": "a/shot.usda"})
    assert (several.warnings, several.media_type) == (single.warnings, "image/png")
    assert ours.inspect(files, stage="a/shot.usda")["stage"] == "a/shot.usda"
    assert ours.validate("window.usda")["findings"] is not None
    assert zipfile.ZipFile(io.BytesIO(ours.convert("preview_surface.usda").content)).namelist()
    assert zipfile.ZipFile(io.BytesIO(ours.bake_thickness(tmp_path / "ball.usda").content)).namelist()
    probes = ours.bake_probes("two_probes.usda", {"resolution": 8, "samples": 1}).content
    assert any(name.endswith(".exr") for name in zipfile.ZipFile(io.BytesIO(probes)).namelist())
    assert ours.limits()["samples"] == 64


@pytest.mark.slow
def test_jobs_are_followed_to_their_end(ours: Client) -> None:
    job = ours.submit("render", "window.usda", {**SMALL, "aovs": ["Z"]})
    seen = list(ours.events(job))
    assert (seen[-1].status, seen[-1].fraction) == ("done", 1.0)
    done = ours.wait(job)
    assert done == ours.job(done.links["self"])
    assert (done.width, done.aovs[0]["name"]) == (32, "Z")
    assert ours.aov(done, "Z").content.startswith(b"\x89PNG")
    sizes = ours.wait(ours.submit("render", "window.usda", {"widths": [8, 16], "samples": 1}))
    assert [one["width"] for one in sizes.pictures] == [8, 16]
    assert ours.image(sizes, 1).media_type == "image/png"
    stage = str(LONG["stage"])
    cancelled = ours.cancel(ours.submit("render", stage, {"image_width": 1920, "samples": 64}))
    assert cancelled.status == "cancelled"
    with pytest.raises(Refused) as caught:
        ours.wait(cancelled)
    assert caught.value.slug == "cancelled"


@pytest.mark.slow
def test_refusals_are_told_with_their_documents(ours: Client, server: Server) -> None:
    with pytest.raises(Refused) as caught:
        ours.render("nothing.usda")
    assert (caught.value.status, caught.value.slug, caught.value.retry_after) == (422, "invalid-settings", None)
    assert caught.value.document["errors"][0]["pointer"] == "/stage"
    with pytest.raises(Refused) as caught:
        Client(server.url).stages()
    assert caught.value.slug == "unauthorized"
    with pytest.raises(Refused) as caught:
        ours.job("0" * 64)
    assert caught.value.status == 404
