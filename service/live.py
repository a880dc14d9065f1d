"""Live viewers: a locked worker that holds one stage, and draws a small picture whenever it is asked for one.

A job is one picture in a process that ends with it. That is too slow to turn a thing by hand, so a viewer keeps its
process: the same fork of the same parent, locked in the same way, with one stage of one client for all its life. There
are a few of them, each client has one, and a viewer ends when nobody has asked it for a while, when it is too old, when
a picture takes too long, and with the first order that it cannot do.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import secrets
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request, Response
from starlette.responses import JSONResponse

from . import models, openapi
from .bodies import check, invalid, limited, own_stage, parse, read_wish
from .jobs import Jobs
from .live_worker import PICTURE
from .pool import Nursery, Worker
from .problems import Problem
from .routes import check_limits, client_of, jobs_of
from .shares import Client, Pace, Share, refusal

router = APIRouter(prefix="/v1")
_OFTEN = 1.0
"""[s] Between looks at who is idle."""
_MOST_WAITING = 2
"""Requests for pictures of one viewer at once: the one that is drawn, and the next."""
NOT_LIVE = ("stage", "webhook", "widths", "time_codes", "variants", "format", "aovs", "color_correction", "caustics")
"""What a render may ask for and a live picture may not."""


class Viewer:
    """One live worker."""

    def __init__(self, client: Client, worker: Worker, work: Path) -> None:
        self.id = secrets.token_hex(32)
        self.client, self.worker, self.work = client, worker, work
        self.born = self.asked = time.monotonic()
        self.lock = asyncio.Lock()
        self.waiting = 0


class Live:
    """All viewers of one app."""

    def __init__(self, jobs: Jobs) -> None:
        self.jobs, self.limits = jobs, jobs.limits
        self.viewers: dict[str, Viewer] = {}
        self.share = Share("viewer", self.limits.live_workers, 1, self.limits.live_seconds, Pace(), time.monotonic)
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        self._task = asyncio.create_task(self._sweep())

    async def stop(self) -> None:
        if self._task:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        for viewer in list(self.viewers.values()):
            await self.end(viewer)

    async def open(self, client: Client, stage: str, upload: Path | None, settings: Mapping[str, Any]) -> Viewer:
        """A viewer of a stage.

        Args:
            stage: path under the stage root, or the name the uploaded file shall have.
            upload: the uploaded file, which is moved; None for a stage of ours.

        Raises:
            Problem: there is no place for one, or not for another of this client.
        """
        self.jobs.check_open()
        if not isinstance(self.jobs.source, Nursery):
            raise Problem("unavailable", "live pictures are drawn on the service's own machine, and this one has its "
                          "jobs done by a cluster", headers={"Retry-After": "3600"})  # fmt: skip
        if self.share.full or self.share.spent(client):
            raise refusal(self.share, client, "live viewers", self.limits.live_idle_seconds)
        place = object()
        self.share.take(place, client)
        work: Path | None = None
        worker: Worker | None = None
        try:
            worker = await self.jobs.source.fork()
            work = self.jobs.store.new_work()
            root = self.jobs.stage_root
            if upload:
                root = work / "in"
                os.replace(upload, root / stage)
            await worker.give({
                "kind": "live", "stage": stage, "root": str(root), "folder": str(work),
                "settings": {**settings, "threads": os.cpu_count() or 1},
                "limits": {**asdict(self.limits), "cpu_seconds": self.limits.live_cpu_seconds},
            })  # fmt: skip
            viewer = Viewer(client, worker, work)
        except BaseException:
            self.share.give(place)
            if worker:
                await self.jobs.source.kill(worker)
                worker.close()
            if work:
                self.jobs.store.drop_work(work)
            raise
        self.share.give(place)
        self.share.take(viewer.id, client)
        self.viewers[viewer.id] = viewer
        self.jobs.metrics.live.set(len(self.viewers))
        return viewer

    async def end(self, viewer: Viewer) -> None:
        """Kill its worker, and leave nothing of it."""
        if self.viewers.pop(viewer.id, None) is None:
            return
        self.share.give(viewer.id)
        self.jobs.metrics.live.set(len(self.viewers))
        try:
            await self.jobs.source.kill(viewer.worker)
        finally:
            viewer.worker.close()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(asyncio.shield(viewer.worker.code), 5.0)  # its folder is its root until then
            self.jobs.store.drop_work(viewer.work)

    async def picture(self, viewer: Viewer, order: Mapping[str, Any]) -> bytes:
        """One picture, as PNG.

        Raises:
            Problem: too many are asked for at once; or the viewer has ended, and why.
        """
        if viewer.waiting >= _MOST_WAITING:
            raise Problem("share-spent", f"one viewer may be asked for {_MOST_WAITING} pictures at once; ask for the "
                          "next when one is there", headers={"Retry-After": "1"})  # fmt: skip
        viewer.waiting += 1
        try:
            async with viewer.lock:
                if viewer.id not in self.viewers:
                    raise Problem("not-found", "the viewer has ended; open another one")
                viewer.asked = time.monotonic()
                try:
                    return await self._drawn(viewer, order)
                except BaseException:  # also where the client has left: what comes next would be this order's answer
                    await self.end(viewer)
                    raise
                finally:
                    viewer.asked = time.monotonic()
        finally:
            viewer.waiting -= 1

    async def _drawn(self, viewer: Viewer, order: Mapping[str, Any]) -> bytes:
        try:
            async with asyncio.timeout(self.limits.live_frame_seconds):
                await viewer.worker.give(dict(order))
                while message := await viewer.worker.hear():
                    if "problem" in message:
                        raise self.jobs.problem_of(message["problem"])
                    if "frame" in message:
                        return await asyncio.to_thread(_read, viewer.work / "out" / PICTURE, self.limits.result_bytes)
        except TimeoutError:
            text = f"the picture took longer than {self.limits.live_frame_seconds} s; the viewer has ended"
            raise Problem("time-limit", text) from None
        except ConnectionError:
            pass
        if viewer.id not in self.viewers:
            raise Problem("not-found", "the viewer has ended; open another one")
        if viewer.worker.lost:
            raise Problem("interrupted", "the service had to start its workers anew")
        self.jobs.metrics.crashes.inc()
        raise Problem("stage-crashed", "the viewer's worker has ended: its time or its memory were spent, or the stage "
                      "made it crash")  # fmt: skip

    async def _sweep(self) -> None:
        while True:
            await asyncio.sleep(_OFTEN)
            now = time.monotonic()
            for viewer in list(self.viewers.values()):
                idle = not viewer.waiting and now - viewer.asked > self.limits.live_idle_seconds
                if idle or now - viewer.born > self.limits.live_seconds:
                    with contextlib.suppress(OSError):
                        await self.end(viewer)


def _read(path: Path, most: int) -> bytes:
    """A file of a worker's, which has read a stranger's: a plain one, and no link. Raises Problem."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        raise Problem("worker-fault", "the program said it was done, and made nothing") from None
    with open(descriptor, "rb") as file:
        found = file.read(most + 1)
    if len(found) > most:
        raise Problem("limit-exceeded", "the picture is larger than this service allows")
    return found


# --- routes -----------------------------------------------------------------------------------------------------------


def _live_of(request: Request) -> Live:
    live: Live = request.app.state.live
    return live


def _known(request: Request, identifier: str) -> Viewer:
    viewer = _live_of(request).viewers.get(identifier)
    if viewer is None or viewer.client.owner != client_of(request).owner:
        raise Problem("not-found", "there is no such viewer; it ends when it is idle")
    return viewer


@router.post("/live", status_code=201, response_class=Response, **openapi.live_stage())
async def open_viewer(request: Request) -> Response:
    """Keep a stage ready for small pictures, drawn as they are asked for; it is let go when nobody asks."""
    live, jobs = _live_of(request), jobs_of(request)
    with jobs.arriving(client_of(request)):
        wish = await read_wish(request, models.LiveStage, jobs.limits, jobs.store.work)
    try:
        settings = wish.settings.model_dump(exclude_none=True, exclude={"stage"})
        if "webhook" in settings:
            raise invalid("/webhook", "is for jobs; leave it out")
        if wish.inner:
            settings["stage"] = wish.inner
        stage = f"stage{wish.suffix}" if wish.upload else own_stage(jobs.stage_root, wish.settings.stage or "")
        viewer = await live.open(client_of(request), stage, wish.upload, settings)
    finally:
        if wish.upload:
            wish.upload.unlink(missing_ok=True)
    here = f"/v1/live/{viewer.id}"
    found = {"id": viewer.id, "links": {"self": here, "pictures": f"{here}/pictures"},
             "idle_seconds": jobs.limits.live_idle_seconds}  # fmt: skip
    return JSONResponse(found, 201, {"Location": here, "Cache-Control": "no-store"})


@router.post("/live/{identifier}/pictures", response_class=Response, **openapi.live_picture(NOT_LIVE))
async def live_picture(request: Request, identifier: str) -> Response:
    """One small picture of a viewer's stage. Ask for the next when it is there."""
    live, jobs = _live_of(request), jobs_of(request)
    viewer = _known(request, identifier)
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        raise Problem("unsupported-media-type", "send application/json")
    stream = limited(request, jobs.limits.settings_bytes).stream()
    try:
        async with asyncio.timeout(jobs.limits.body_seconds):
            text = b"".join([part async for part in stream])
    except TimeoutError:
        text_of = f"the body did not arrive within {jobs.limits.body_seconds} s"
        raise Problem("request-timeout", text_of) from None
    order = check(models.Render, parse(text)).model_dump(exclude_none=True)
    for name in NOT_LIVE:
        if name in order:
            raise invalid(f"/{name}", "is not for live pictures; leave it out")
    check_limits(order, jobs)
    if not order.get("image_width") or not order.get("image_height"):
        raise invalid("/image_height", "is missing; a live picture is asked for by its width and height")
    pixels = order["image_width"] * order["image_height"]
    if pixels > jobs.limits.live_pixels:
        text_of = f"live_pixels would be {pixels}; the limit is {jobs.limits.live_pixels}"
        raise Problem("limit-exceeded", text_of, errors=[{"pointer": "/image_width", "detail": text_of}])
    found = await live.picture(viewer, {**order, "caustics": 0})
    return Response(found, media_type="image/png", headers={"Cache-Control": "no-store"})


@router.delete("/live/{identifier}", status_code=204, response_class=Response, **openapi.live_end())
async def close_viewer(request: Request, identifier: str) -> Response:
    """Let a viewer's stage go."""
    await _live_of(request).end(_known(request, identifier))
    return Response(status_code=204)
