"""Denoising by HTTP, in a worker that is locked in."""

from __future__ import annotations

from importlib import metadata
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from service_server import PATIENT, ROOT, SMALL, running
from test_denoise import needs_oidn

from refract_core.images import denoise
from refract_core.images.pictures import read_texture
from service import routes
from service.limits import Limits
from service.problems import Problem


def test_without_the_extra_it_is_422_with_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> None:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "files", absent)
    denoise._file.cache_clear()
    jobs: Any = SimpleNamespace(limits=Limits())
    routes.check_limits({"denoise": False}, jobs)
    with pytest.raises(Problem) as caught:
        routes.check_limits({"denoise": True}, jobs)
    denoise._file.cache_clear()
    document = caught.value.document()
    assert document["status"] == 422
    assert document["errors"][0]["pointer"] == "/denoise"
    assert "pip install 'usd-refract[denoise]'" in document["errors"][0]["detail"]


@needs_oidn
@pytest.mark.slow
def test_a_worker_that_is_locked_in_denoises(tmp_path: Any) -> None:
    words = ("--stage-root", str(ROOT / "usd_samples" / "good"), "--workers", "1", *PATIENT)
    asked = {**SMALL, "stage": "marble.usda", "image_width": 96, "samples": 4, "format": "png"}
    with running(tmp_path / "data", *words) as server, server.client() as client:
        planes = ["albedo", "denoising_normal"]
        answers = [client.post("/v1/render", json={**asked, "aovs": planes, "denoise": told}) for told in (False, True)]
        assert [one.status_code for one in answers] == [200, 200], [one.text[:500] for one in answers]
        raw, quiet = (read_texture(one.content, name="picture", color_space="auto").pixels for one in answers)
        job = client.get(answers[1].headers["content-location"]).json()
    assert [one["name"] for one in job["aovs"]] == planes
    assert (raw != quiet).any()
    assert np.abs(raw.astype(float) - quiet).mean() < 4.0  # of 255: it is the same picture
