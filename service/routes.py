"""Routes under /v1."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request, Response
from starlette.responses import FileResponse, JSONResponse, StreamingResponse
from starlette.types import Receive, Scope, Send

from refract_core.errors import UsageError
from refract_core.images.denoise import check_installed

from . import models, openapi
from .bodies import invalid, own_stage, read_wish, stages
from .digests import file_digest, tree_digest
from .formats import FORMATS, MEDIA, accepted, chosen, format_of
from .jobs import Jobs
from .limits import table
from .openapi import problems
from .problems import Problem, document_response
from .shares import Client
from .store import RESULTS, STAGES_MADE, Record, count_of
from .webhooks import Webhooks

router = APIRouter(prefix="/v1")
_KEEP_ALIVE = 15.0  # [s] between comments in a quiet stream of events
_ZIP = "application/zip"
_TYPES = {
    **{f".{one.extension}": one.media for one in FORMATS.values()}, ".json": "application/json",
    ".usdz": "model/vnd.usdz+zip", ".zip": _ZIP,
}  # fmt: skip
Ask = Callable[[dict[str, Any], str], str]
"""Completes the settings of a job by the header Accept, and returns the media type of the answer."""
_OBJECT: dict[str, Any] = {"type": "object"}
_PACKAGE = _TYPES[".usdz"]
_BAKED = {"type": "object", "required": ["stage", "out", "summary", "prims", "notices"]}
_CONVERTED = {"type": "object", "required": ["stage", "out", "materials", "notices"]}


def jobs_of(request: Request) -> Jobs:
    jobs: Jobs = request.app.state.jobs
    return jobs


def client_of(request: Request) -> Client:
    client: Client = request.state.client
    return client


# --- work -------------------------------------------------------------------------------------------------------------


@router.post("/render", response_class=Response, **openapi.work(
    models.Render, "the picture, or several of them in one archive", {media: {} for media in (*MEDIA, _ZIP)}
))  # fmt: skip
async def render(request: Request) -> Response:
    """Render a stage. Answers with the picture; `Accept`, or `format` in the settings, chooses its format. Several
    `widths` or `time_codes` make several pictures, which come as one .zip, or one by one from the job."""
    chosen(request.headers.get("accept", ""), (*MEDIA, _ZIP))
    return await _work(request, "render", _ask_for_pictures)


def _ask_for_pictures(settings: dict[str, Any], accept: str) -> str:
    """Put the file's extension in place of the format's name. Returns the media type of the answer."""
    several = count_of(settings) > 1
    asked = settings.get("format", "")
    if several and not asked and not accepted(accept, MEDIA):
        asked = "png"
    name = format_of("" if several and not accepted(accept, MEDIA) else accept, asked)
    settings["format"] = FORMATS[name].extension
    if several and settings.get("aovs") and name != "exr":
        raise invalid("/aovs", "of several pictures are held by EXR alone; set format to exr, or ask for one picture")
    return _ZIP if several else FORMATS[name].media


@router.post("/convert", response_class=Response, **openapi.work(
    models.Convert, "the converted stage, or what was done",
    {_PACKAGE: {}, "application/json": {"schema": _CONVERTED}},
))  # fmt: skip
async def convert(request: Request) -> Response:
    """Find the glass of a stage and describe it with RefractMaterialAPI, as `refract convert`."""
    return await _work(request, "convert", _given(request, _PACKAGE, "application/json"))


@router.post("/bake-probes", response_class=Response, **openapi.work(
    models.BakeProbes, "the stage with its probes baked, or what was done",
    {_PACKAGE: {}, "application/json": {"schema": _BAKED}},
))  # fmt: skip
async def bake_probes(request: Request) -> Response:
    """Bake the reflection probes of a stage, as `refract bake probes`. The package holds the layer that uses them, the
    stage below it, and the cubemaps as EXR."""
    return await _work(request, "bake-probes", _given(request, _PACKAGE, "application/json"))


@router.post("/bake-thickness", response_class=Response, **openapi.work(
    models.BakeThickness, "the stage with the thickness of its glass, or what was done",
    {_PACKAGE: {}, "application/json": {"schema": _BAKED}},
))  # fmt: skip
async def bake_thickness(request: Request) -> Response:
    """Measure how thick the glass of a stage is, as `refract bake thickness`. The package holds the layer that says so,
    the stage below it, and with `texture` the pictures."""
    return await _work(request, "bake-thickness", _given(request, _PACKAGE, "application/json"))


@router.post("/inspect", response_class=Response, **openapi.work(
    models.StageOnly, "the report", {"application/json": {"schema": _OBJECT}}
))  # fmt: skip
async def inspect(request: Request) -> Response:
    """What is in a stage, as `refract inspect --json`."""
    return await _work(request, "inspect", _given(request, "application/json"))


@router.post("/validate", response_class=Response, **openapi.work(
    models.StageOnly, "the verdict", {"application/json": {"schema": _OBJECT}}
))  # fmt: skip
async def validate(request: Request) -> Response:
    """What is wrong with a stage, as `refract validate --json`."""
    return await _work(request, "validate", _given(request, "application/json"))


def _given(request: Request, *known: str) -> Ask:
    """An answer of one of these types, whatever the settings. Raises Problem where none is accepted."""
    media = chosen(request.headers.get("accept", ""), known)
    return lambda _settings, _accept: media


async def _work(request: Request, kind: str, ask: Ask) -> Response:
    jobs = jobs_of(request)
    with jobs.arriving(client_of(request)):
        record, media = await _submit(request, kind, ask, jobs)
    if "respond-async" in request.headers.get("prefer", "").lower():
        jobs.keep(record)
        headers = {"Location": f"/v1/jobs/{record.id}", "Preference-Applied": "respond-async"}
        return JSONResponse(record.document(), 202, headers)
    name = record.outcome(report=media == "application/json")
    return await finished(request, jobs, record) or result(request, jobs, record, name)


async def finished(request: Request, jobs: Jobs, record: Record) -> Response | None:
    """Wait for a job. Returns None when it is done, and else the answer."""
    if not await _done_or_gone(request, jobs, record):
        return Response(status_code=499)
    if record.problem:
        return document_response(record.problem, {"Content-Location": f"/v1/jobs/{record.id}"})
    return None


async def _submit(request: Request, kind: str, ask: Ask, jobs: Jobs) -> tuple[Record, str]:
    """The job of a request, and the media type of its answer."""
    wish = await read_wish(request, models.KINDS[kind], jobs.limits, jobs.store.work)
    try:
        settings = wish.settings.model_dump(exclude_none=True, exclude={"stage", "webhook"})
        media = ask(settings, request.headers.get("accept", ""))
        if wish.inner:
            settings["stage"] = wish.inner
        check_limits(settings, jobs)
        hook: Webhooks = request.app.state.webhooks
        if wish.settings.webhook:
            await hook.check(wish.settings.webhook)
        if wish.upload:
            digest, stage = await asyncio.to_thread(file_digest, wish.upload), f"stage{wish.suffix}"
        else:
            assert wish.settings.stage is not None
            stage = own_stage(jobs.stage_root, wish.settings.stage)
            assert jobs.stage_root is not None
            digest = await asyncio.to_thread(tree_digest, jobs.stage_root, stage)
        record = jobs.submit(kind, settings, digest, stage, wish.upload, client_of(request))
        if wish.settings.webhook:
            jobs.keep(record)
            hook.follow(jobs, record, wish.settings.webhook)
        return record, media
    finally:
        if wish.upload:
            wish.upload.unlink(missing_ok=True)


def _within(name: str, value: int, where: str, limits: Mapping[str, int]) -> None:
    if value > limits[name]:
        text = f"{name} would be {value}; the limit is {limits[name]}"
        raise Problem("limit-exceeded", text, errors=[{"pointer": where, "detail": text}])


def check_limits(settings: dict[str, Any], jobs: Jobs) -> None:
    """What can be told before the stage is read; its worker looks again at what follows from the stage."""
    limits = asdict(jobs.limits)
    height, samples = (settings.get(name) or 1 for name in ("image_height", "samples"))
    wide = max(settings.get("widths", (settings.get("image_width") or 1,)))
    count, width = count_of(settings), "/widths" if "widths" in settings else "/image_width"
    if edge := settings.get("resolution"):  # six faces in a row
        wide, height, width = 6 * edge, edge, "/resolution"
    if edge := settings.get("texture"):
        wide, height, width = edge, edge, "/texture"
    asked = {
        "pictures": (count, "/time_codes" if "time_codes" in settings else "/widths"),
        "pixels": (wide * height, width), "samples": (samples, "/samples"),
        "pixel_samples": (wide * height * samples, "/samples"), "aovs": (len(settings.get("aovs", ())), "/aovs"),
    }  # fmt: skip
    _within("side", wide, width, limits)
    _within("side", height, "/image_height", limits)
    for name, (value, where) in asked.items():
        _within(name, value, where, limits)
    for name in ("tiers", "purposes", "aovs", "widths", "time_codes", "variants"):
        if len(set(settings.get(name, ()))) != len(settings.get(name, ())):
            raise Problem("invalid-settings", f"{name} names something twice",
                          errors=[{"pointer": f"/{name}", "detail": "names something twice"}])  # fmt: skip
    if settings.get("denoise"):
        try:
            check_installed()
        except UsageError as error:
            raise invalid("/denoise", str(error).removeprefix("--denoise ")) from None
    for one, others in (("widths", ("image_width", "image_height")), ("time_codes", ("time_code",))):
        for other in others:
            if one in settings and other in settings:
                raise invalid(f"/{other}", f"says the same as {one}; leave one of them out")


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
    record = jobs_of(request).records.get(identifier)
    if record is None or record.owner != client_of(request).owner:
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
    await jobs_of(request).cancel(record)
    return JSONResponse(record.document())


@router.get("/jobs/{identifier}/events", response_class=StreamingResponse, responses={
    200: {"description": "server-sent events", "content": {"text/event-stream": {}}}, **problems(404, 429),
})  # fmt: skip
async def events(request: Request, identifier: str) -> StreamingResponse:
    """Progress as server-sent events: `progress`, then one of `done`, `failed`, `cancelled`; data is the job."""
    record, jobs = _known(request, identifier), jobs_of(request)
    held = contextlib.ExitStack()
    held.enter_context(jobs.shares.streams.one(client_of(request), "streams of events"))

    async def stream() -> AsyncIterator[str]:
        while True:
            event = record.status if record.ended else "progress"
            yield f"event: {event}\ndata: {json.dumps(record.document(), allow_nan=False)}\n\n"
            if record.ended:
                return
            await asyncio.sleep(0.05)  # at most twenty a second
            news = asyncio.create_task(jobs.news(record))
            while not (await asyncio.wait({news}, timeout=_KEEP_ALIVE))[0]:
                yield ": still here\n\n"

    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return _Held(held, stream(), headers=headers, media_type="text/event-stream")


class _Held(StreamingResponse):
    """A stream that gives something back at its end, also where its client has left before the first word."""

    def __init__(self, held: contextlib.ExitStack, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.held = held

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        with self.held:
            await super().__call__(scope, receive, send)


def result(request: Request, jobs: Jobs, record: Record, name: str) -> Response:
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
            **openapi.result("the picture", *MEDIA))  # fmt: skip
async def image(request: Request, identifier: str) -> Response:
    """The picture of a render, the first one where there are several."""
    return _picture(request, identifier, 0)


@router.get("/jobs/{identifier}/pictures", response_class=Response, **openapi.result("the pictures", _ZIP))
async def pictures(request: Request, identifier: str) -> Response:
    """All pictures of a render that makes several, as one archive."""
    record = _known(request, identifier)
    if record.kind != "render" or count_of(record.settings) < 2:
        raise Problem("not-found", "the job does not make several pictures")
    return result(request, jobs_of(request), record, record.outcome())


@router.get("/jobs/{identifier}/pictures/{number}", response_class=Response,
            **openapi.result("the picture", *MEDIA))  # fmt: skip
async def picture(request: Request, identifier: str, number: str) -> Response:
    """One picture of a render that makes several: its place in `pictures` of the job."""
    return _picture(request, identifier, int(number) if re.fullmatch("[0-9]{1,4}", number) else -1)


def _picture(request: Request, identifier: str, number: int) -> Response:
    record = _known(request, identifier)
    if record.kind != "render" or not 0 <= number < count_of(record.settings):
        raise Problem("not-found", "the job makes no such picture")
    name = f"picture.{number}" if count_of(record.settings) > 1 else "image"
    return result(request, jobs_of(request), record, f"{name}.{record.settings['format']}")


@router.get("/jobs/{identifier}/aovs/{name}.png", response_class=Response, **openapi.result("the picture", "image/png"))
async def aov(request: Request, identifier: str, name: str) -> Response:
    """One AOV of a render that asked for it, as 8-bit grey or colour; the job says what white is."""
    return result(request, jobs_of(request), _known(request, identifier), f"aov.{name}.png")


@router.get("/jobs/{identifier}/file", response_class=Response, **openapi.result("the stage", _PACKAGE))
async def made_stage(request: Request, identifier: str) -> Response:
    """The stage that a conversion or a bake made."""
    record = _known(request, identifier)
    return result(request, jobs_of(request), record, STAGES_MADE.get(record.kind, ""))


@router.get("/jobs/{identifier}/report", response_class=Response, **openapi.result("the report", "application/json"))
async def report(request: Request, identifier: str) -> Response:
    """What a conversion, bake, inspection or validation found."""
    return result(request, jobs_of(request), _known(request, identifier), "report.json")


# --- about the service ------------------------------------------------------------------------------------------------


@router.get("/stages", response_model=models.Stages)
async def own_stages(request: Request) -> dict[str, list[dict[str, Any]]]:
    """Stages that a request may name."""
    jobs = jobs_of(request)
    return {"stages": await asyncio.to_thread(stages, jobs.stage_root, jobs.limits)}


@router.get("/limits", response_model=models.LimitTable)
async def show_limits(request: Request) -> dict[str, Any]:
    """Every limit, and what confines workers on this machine."""
    jobs = jobs_of(request)
    return {
        "limits": table(jobs.limits), "workers": jobs.workers, "queue": jobs.places - jobs.workers,
        "confinement": jobs.source.report,
    }  # fmt: skip
