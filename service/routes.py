"""Routes under /v1."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request, Response
from starlette.responses import FileResponse, JSONResponse, StreamingResponse

from . import models, openapi
from .bodies import own_stage, read_wish, stages
from .digests import file_digest, tree_digest
from .jobs import Jobs
from .limits import table
from .openapi import problems
from .problems import Problem, document_response
from .store import RESULTS, Record

router = APIRouter(prefix="/v1")
_KEEP_ALIVE = 15.0  # [s] between comments in a quiet stream of events
_TYPES = {".png": "image/png", ".exr": "image/x-exr", ".json": "application/json", ".usdz": "model/vnd.usdz+zip"}
_OBJECT: dict[str, Any] = {"type": "object"}
_CONVERTED = {"type": "object", "required": ["stage", "out", "materials", "notices"]}


def _jobs(request: Request) -> Jobs:
    jobs: Jobs = request.app.state.jobs
    return jobs


# --- work -------------------------------------------------------------------------------------------------------------


@router.post("/render", response_class=Response, **openapi.work(
    models.Render, "the picture", {"image/png": {}, "image/x-exr": {}}
))  # fmt: skip
async def render(request: Request) -> Response:
    """Render a stage. Answers with the picture; `Accept` chooses image/png or image/x-exr."""
    media = _chosen(request, ("image/png", "image/x-exr"))
    return await _work(request, "render", {"format": "exr" if media == "image/x-exr" else "png"}, media)


@router.post("/convert", response_class=Response, **openapi.work(
    models.Convert, "the converted stage, or what was done",
    {"model/vnd.usdz+zip": {}, "application/json": {"schema": _CONVERTED}},
))  # fmt: skip
async def convert(request: Request) -> Response:
    """Find the glass of a stage and describe it with RefractMaterialAPI, as `refract convert`."""
    return await _work(request, "convert", {}, _chosen(request, ("model/vnd.usdz+zip", "application/json")))


@router.post("/inspect", response_class=Response, **openapi.work(
    models.StageOnly, "the report", {"application/json": {"schema": _OBJECT}}
))  # fmt: skip
async def inspect(request: Request) -> Response:
    """What is in a stage, as `refract inspect --json`."""
    return await _work(request, "inspect", {}, _chosen(request, ("application/json",)))


@router.post("/validate", response_class=Response, **openapi.work(
    models.StageOnly, "the verdict", {"application/json": {"schema": _OBJECT}}
))  # fmt: skip
async def validate(request: Request) -> Response:
    """What is wrong with a stage, as `refract validate --json`."""
    return await _work(request, "validate", {}, _chosen(request, ("application/json",)))


def _chosen(request: Request, known: tuple[str, ...]) -> str:
    """The first of the known types that the client accepts, by its order of q values."""
    header = request.headers.get("accept") or "*/*"
    best, found = 0.0, ""
    for part in header.split(","):
        media, *parameters = (word.strip().lower() for word in part.split(";"))
        weight = 1.0
        for parameter in parameters:
            if parameter.startswith("q="):
                with contextlib.suppress(ValueError):
                    weight = float(parameter[2:])
        for one in known:
            if weight > best and media in (one, "*/*", f"{one.partition('/')[0]}/*", one.replace("/x-", "/")):
                best, found = weight, one
                break
    if not found:
        raise Problem("not-acceptable", f"this can be given as {' or '.join(known)}")
    return found


async def _work(request: Request, kind: str, extra: dict[str, Any], media: str) -> Response:
    jobs = _jobs(request)
    with jobs.place():
        record = await _submit(request, kind, extra, jobs)
    if "respond-async" in request.headers.get("prefer", "").lower():
        jobs.keep(record)
        headers = {"Location": f"/v1/jobs/{record.id}", "Preference-Applied": "respond-async"}
        return JSONResponse(record.document(), 202, headers)
    if not await _done_or_gone(request, jobs, record):
        return Response(status_code=499)
    if record.problem:
        return document_response(record.problem, {"Content-Location": f"/v1/jobs/{record.id}"})
    return _result(request, jobs, record, _file_of(record, media))


async def _submit(request: Request, kind: str, extra: dict[str, Any], jobs: Jobs) -> Record:
    wish = await read_wish(request, models.KINDS[kind], jobs.limits, jobs.store.work)
    try:
        settings = {**wish.settings.model_dump(exclude_none=True, exclude={"stage"}), **extra}
        if wish.inner:
            settings["stage"] = wish.inner
        _check_limits(settings, jobs)
        if wish.upload:
            digest, stage = await asyncio.to_thread(file_digest, wish.upload), f"stage{wish.suffix}"
        else:
            assert wish.settings.stage is not None
            stage = own_stage(jobs.stage_root, wish.settings.stage)
            assert jobs.stage_root is not None
            digest = await asyncio.to_thread(tree_digest, jobs.stage_root, stage)
        return jobs.submit(kind, settings, digest, stage, wish.upload)
    finally:
        if wish.upload:
            wish.upload.unlink(missing_ok=True)


def _check_limits(settings: dict[str, Any], jobs: Jobs) -> None:
    """What can be told before the stage is read; its worker looks again at what follows from the stage."""
    limits = asdict(jobs.limits)
    width, height, samples = (settings.get(name) or 1 for name in ("image_width", "image_height", "samples"))
    asked = {
        "pixels": (width * height, "/image_width"), "samples": (samples, "/samples"),
        "pixel_samples": (width * height * samples, "/samples"), "aovs": (len(settings.get("aovs", ())), "/aovs"),
    }  # fmt: skip
    for name, (value, where) in asked.items():
        if value > limits[name]:
            text = f"{name} would be {value}; the limit is {limits[name]}"
            raise Problem("limit-exceeded", text, errors=[{"pointer": where, "detail": text}])
    for name in ("tiers", "purposes", "aovs"):
        if len(set(settings.get(name, ()))) != len(settings.get(name, ())):
            raise Problem("invalid-settings", f"{name} names something twice",
                          errors=[{"pointer": f"/{name}", "detail": "names something twice"}])  # fmt: skip


async def _done_or_gone(request: Request, jobs: Jobs, record: Record) -> bool:
    """Wait for a job or for the client to leave. Returns whether the client is still there."""

    async def gone() -> None:
        while (await request.receive())["type"] != "http.disconnect":
            pass

    async with jobs.waiting(record):
        done, left = asyncio.create_task(jobs.ended(record)), asyncio.create_task(gone())
        try:
            await asyncio.wait({done, left}, return_when=asyncio.FIRST_COMPLETED)
            return done.done()
        finally:
            for task in (done, left):
                task.cancel()
            await asyncio.gather(done, left, return_exceptions=True)


# --- jobs -------------------------------------------------------------------------------------------------------------


def _known(request: Request, identifier: str) -> Record:
    record = _jobs(request).records.get(identifier)
    if record is None:
        raise Problem("not-found", "there is no such job; it may have been removed")
    return record


@router.get("/jobs/{identifier}", response_model=models.Job, responses=problems(404))
async def job(request: Request, identifier: str) -> Response:
    """How a job is doing."""
    return JSONResponse(_known(request, identifier).document(), headers={"Cache-Control": "no-store"})


@router.delete("/jobs/{identifier}", response_model=models.Job, responses=problems(403, 404))
async def cancel(request: Request, identifier: str) -> Response:
    """Cancel a job: its process is killed. A job that has ended stays as it is."""
    record = _known(request, identifier)
    await _jobs(request).cancel(record)
    return JSONResponse(record.document())


@router.get("/jobs/{identifier}/events", response_class=StreamingResponse, responses={
    200: {"description": "server-sent events", "content": {"text/event-stream": {}}}, **problems(404, 429),
})  # fmt: skip
async def events(request: Request, identifier: str) -> StreamingResponse:
    """Progress as server-sent events: `progress`, then one of `done`, `failed`, `cancelled`; data is the job."""
    record, jobs = _known(request, identifier), _jobs(request)
    if jobs.streams >= jobs.limits.event_streams:
        raise Problem("queue-full", "too many clients listen to events", headers={"Retry-After": "5"})

    async def stream() -> AsyncIterator[str]:
        jobs.streams += 1
        try:
            while True:
                event = record.status if record.ended else "progress"
                yield f"event: {event}\ndata: {json.dumps(record.document(), allow_nan=False)}\n\n"
                if record.ended:
                    return
                await asyncio.sleep(0.05)  # at most twenty a second
                news = asyncio.create_task(jobs.news(record))
                while not (await asyncio.wait({news}, timeout=_KEEP_ALIVE))[0]:
                    yield ": still here\n\n"
        finally:
            jobs.streams -= 1

    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(stream(), headers=headers, media_type="text/event-stream")


def _file_of(record: Record, media: str = "") -> str:
    if record.kind == "render":
        return f"image.{record.settings['format']}"
    return "converted.usdz" if record.kind == "convert" and media != "application/json" else "report.json"


def _result(request: Request, jobs: Jobs, record: Record, name: str) -> Response:
    """One file of a job, or 304."""
    if record.problem:
        problem = Problem("not-done", f"the job is {record.status}")
        return document_response(problem.document(f"/v1/jobs/{record.id}"))
    if not record.ended:
        raise Problem("not-done", f"the job is {record.status}")
    path: Path = jobs.store.folder(record.id) / name
    if not RESULTS.match(name) or not path.is_file():
        raise Problem("not-found", "the job has no such result")
    tag = f'"{record.id}-{name}"'
    headers = {"ETag": tag, "Cache-Control": "private, max-age=3600, immutable", "Vary": "Accept",
               "Content-Location": f"/v1/jobs/{record.id}", "Refract-Warnings": str(len(record.warnings))}  # fmt: skip
    asked = [one.strip().removeprefix("W/") for one in request.headers.get("if-none-match", "").split(",")]
    if request.method == "GET" and (tag in asked or "*" in asked):
        return Response(status_code=304, headers=headers)
    return FileResponse(path, headers=headers, media_type=_TYPES[path.suffix])


@router.get("/jobs/{identifier}/image", response_class=Response,
            **openapi.result("the picture", "image/png", "image/x-exr"))  # fmt: skip
async def image(request: Request, identifier: str) -> Response:
    """The picture of a render."""
    record = _known(request, identifier)
    if record.kind != "render":
        raise Problem("not-found", "the job makes no picture")
    return _result(request, _jobs(request), record, _file_of(record))


@router.get("/jobs/{identifier}/aovs/{name}.png", response_class=Response, **openapi.result("the picture", "image/png"))
async def aov(request: Request, identifier: str, name: str) -> Response:
    """One AOV of a render that asked for it, as 8-bit grey or colour; the job says what white is."""
    return _result(request, _jobs(request), _known(request, identifier), f"aov.{name}.png")


@router.get("/jobs/{identifier}/file", response_class=Response, **openapi.result("the stage", "model/vnd.usdz+zip"))
async def converted(request: Request, identifier: str) -> Response:
    """The stage that a conversion made."""
    return _result(request, _jobs(request), _known(request, identifier), "converted.usdz")


@router.get("/jobs/{identifier}/report", response_class=Response, **openapi.result("the report", "application/json"))
async def report(request: Request, identifier: str) -> Response:
    """What a conversion, inspection or validation found."""
    return _result(request, _jobs(request), _known(request, identifier), "report.json")


# --- about the service ------------------------------------------------------------------------------------------------


@router.get("/stages", response_model=models.Stages)
async def own_stages(request: Request) -> dict[str, list[dict[str, Any]]]:
    """Stages that a request may name."""
    return {"stages": await asyncio.to_thread(stages, _jobs(request).stage_root)}


@router.get("/limits", response_model=models.LimitTable)
async def show_limits(request: Request) -> dict[str, Any]:
    """Every limit, and what confines workers on this machine."""
    jobs = _jobs(request)
    return {
        "limits": table(jobs.limits), "workers": jobs.workers, "queue": jobs.places - jobs.workers,
        "confinement": jobs.source.report,
    }  # fmt: skip
