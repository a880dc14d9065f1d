"""The queue when there is no worker for it, and what a service without a folder of its own leaves behind."""

from __future__ import annotations

import asyncio
import logging
import signal
import sys
from collections.abc import Callable, Coroutine
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from service_server import BALL, LONG, PATIENCE, PATIENT, ROOT, WARM_UP, running, upload

from service.jobs import Jobs
from service.limits import Limits
from service.metrics import Metrics
from service.pool import Nursery
from service.store import Store

pytestmark = pytest.mark.slow


def in_a_loop(work: Callable[[], Coroutine[Any, Any, None]]) -> None:
    asyncio.run(work())


def test_a_nursery_that_cannot_start_tries_again_and_says_why(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    good = sys.executable

    async def work() -> None:
        monkeypatch.setattr(sys, "executable", str(tmp_path / "no_python"))
        nursery = Nursery()
        nursery.start()
        async with asyncio.timeout(PATIENCE):
            while not caplog.records:
                await asyncio.sleep(0.01)
        assert not nursery.ready.is_set()
        monkeypatch.setattr(sys, "executable", good)
        async with asyncio.timeout(WARM_UP):
            await nursery.ready.wait()
        assert nursery.report["threads"] == 1
        await nursery.stop()

    with caplog.at_level(logging.ERROR, logger="refract.service"):
        in_a_loop(work)
    assert "cannot be started; trying again" in caplog.text
    assert "no_python" in caplog.text


def test_who_waits_too_long_for_a_worker_is_told_so(tmp_path: Path) -> None:
    async def work() -> None:
        limits = Limits(queue_seconds=60)
        jobs = Jobs(Store(tmp_path), limits, Metrics(), Nursery(), workers=1, queue=4, stage_root=None)
        old, new = (jobs.submit("render", {"samples": n}, "digest", "stage.usda", None) for n in (1, 2))
        old.created = (datetime.now(UTC) - timedelta(seconds=61)).isoformat()
        jobs.sweep()
        assert (old.status, new.status) == ("failed", "queued")
        assert old.problem
        assert (old.problem["type"], old.problem["status"]) == ("/problems/unavailable", 503)

    in_a_loop(work)


def test_a_temporary_folder_goes_with_the_service(tmp_path: Path) -> None:
    places = {"TMPDIR": str(tmp_path)}
    with running(tmp_path / "unused", environment=places, own_data=False) as server, server.client() as client:
        answer = client.post("/v1/render", files=upload(BALL))
        assert answer.status_code == 200
        assert list(tmp_path.glob("refract-service-*"))
        server.process.send_signal(signal.SIGTERM)
        server.process.wait(PATIENCE)
    assert not list(tmp_path.glob("refract-service-*"))


def test_a_job_that_takes_too_long_is_stopped(tmp_path: Path) -> None:
    """By the clock; `test_service_hostile` has those that are stopped by the processor time they take."""
    words = ("--stage-root", str(ROOT / "usd_samples" / "good"), *PATIENT, "--limit", "job_seconds=1")
    with running(tmp_path / "data", *words) as server, server.client() as client:
        problem = client.post("/v1/render", json=LONG).json()
    assert problem["type"] == "/problems/time-limit"
    assert "stopped after 1 s" in problem["detail"]


def test_results_count_their_warnings(tmp_path: Path) -> None:
    left_at_home = BALL.replace('def Xform "World"', 'def Xform "World" (references = @./studio.usda@)')
    good = str(ROOT / "usd_samples" / "good")
    with running(tmp_path / "data", "--stage-root", good) as server, server.client() as client:
        whole = client.post("/v1/render", json={"stage": "marble.usda", "image_width": 32, "samples": 1})
        torn = client.post("/v1/render", files=upload(left_at_home))
        job = client.get(torn.headers["content-location"]).json()
    assert whole.headers["refract-warnings"] == "0"
    assert int(torn.headers["refract-warnings"]) == len(job["warnings"]) > 0
    assert any("studio.usda" in warning["text"] for warning in job["warnings"])
