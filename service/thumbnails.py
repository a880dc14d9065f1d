"""Pictures that have an address: `GET /v1/thumbnails/{stage or digest}?w=256`, for pages, caches and CDNs.

A thumbnail is a render job as any other, and equal addresses are one job. What differs is who may keep it: its ETag is
known before anything is drawn, so that a cache that has it is answered without work.
"""

from __future__ import annotations

import asyncio
import hashlib
import re
import secrets
import time
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request, Response
from starlette.responses import FileResponse

from . import models, openapi
from .beside import picture_of
from .bodies import check, invalid, limited, own_stage, suffix_of
from .digests import identifier_of, tree_digest
from .formats import FORMATS, MEDIA, format_of
from .jobs import Jobs
from .problems import Problem
from .routes import check_limits, client_of, finished, jobs_of, result
from .shelf import DIGEST, Shelf
from .signing import expiry
from .uploads import ARCHIVE

router = APIRouter(prefix="/v1")
_WIDTH = 256  # [pixels]
_FRESH = 300
"""[s] A stage under the stage root may change at any time."""
_LASTING = 24 * 3600
"""[s] A stage that is known by its content never does; the engine may."""
_QUERY: dict[str, tuple[str, dict[str, Any]]] = {
    "w": ("width [pixels]; the height follows the camera's aspect",
          {"type": "integer", "minimum": 1, "maximum": 1 << 28, "default": _WIDTH}),
    "camera": ("path of a camera", {"type": "string", "maxLength": 1024}),
    "variant": ("`/Prim{set=name}`, or `{set=name}` of the default prim; may be repeated",
                {"type": "array", "items": {"type": "string"}, "maxItems": 64}),
    "time": ("time code", {"type": "number", "minimum": -1e9, "maximum": 1e9}),
    "format": ("of the picture; left out, Accept chooses", {"type": "string", "enum": list(FORMATS)}),
    "root": ("of an archive, the file to open", {"type": "string", "maxLength": 1024}),
    "expires": ("of a signed address: seconds since 1970", {"type": "integer", "minimum": 0}),
    "signature": ("of a signed address, its last part", {"type": "string", "pattern": "^[0-9a-f]{64}$"}),
}  # fmt: skip
_NUMBER = re.compile(r"-?\d{1,12}(\.\d{1,12})?", re.ASCII)


def _shelf(jobs: Jobs) -> Shelf:
    return Shelf(jobs.store.jobs.parent / "stages", jobs.limits)


# --- stages that stay -------------------------------------------------------------------------------------------------


@router.put("/stages/{digest}", status_code=201, response_class=Response, **openapi.stage_by_digest())
async def keep_stage(request: Request, digest: str) -> Response:
    """Send a stage to stay for a while, by the SHA-256 of its content: USD, glTF, or a .zip (as application/zip)."""
    jobs = jobs_of(request)
    if not DIGEST.fullmatch(digest):
        raise Problem("not-found", "an address of a stage ends with a SHA-256 in hexadecimal, in small letters")
    shelf = _shelf(jobs)
    if await asyncio.to_thread(shelf.find, digest):
        return Response(status_code=204)
    path = jobs.store.work / f"upload-{secrets.token_hex(8)}"
    try:
        with jobs.arriving(client_of(request)):
            suffix = await _receive(request, digest, path, jobs)
        await asyncio.to_thread(shelf.put, digest, suffix, path)
    finally:
        path.unlink(missing_ok=True)
    return Response(status_code=201, headers={"Location": f"/v1/thumbnails/{digest}"})


async def _receive(request: Request, digest: str, path: Path, jobs: Jobs) -> str:
    """Write a body to a file, and tell what it is. Raises Problem."""
    found, start = hashlib.sha256(), b""
    try:
        async with asyncio.timeout(jobs.limits.body_seconds):
            with open(path, "xb") as file:
                async for part in limited(request, jobs.limits.stage_bytes).stream():
                    found.update(part)
                    start = (start + part)[:64] if len(start) < 64 else start
                    await asyncio.to_thread(file.write, part)
    except TimeoutError:
        text = f"the body did not arrive within {jobs.limits.body_seconds} s"
        raise Problem("request-timeout", text) from None
    media = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    suffix = suffix_of(start, f"x{ARCHIVE}" if media == "application/zip" else "")
    if found.hexdigest() != digest:
        raise Problem("stage-invalid", f"the body's SHA-256 is {found.hexdigest()}, not the one of its address")
    return suffix


# --- thumbnails -------------------------------------------------------------------------------------------------------


@router.get("/thumbnails/{stage:path}", response_class=Response, **openapi.thumbnail(_QUERY, MEDIA))
async def thumbnail(request: Request, stage: str) -> Response:
    """A picture of a stage under the stage root, or of one that was sent to `/v1/stages/{digest}`. It may be cached."""
    jobs = jobs_of(request)
    settings = _settings(request)
    kept: Path | None = None
    if DIGEST.fullmatch(stage):
        kept = await asyncio.to_thread(_shelf(jobs).find, stage)
        if kept is None:
            raise Problem("not-found", "there is no such stage; it may have been removed, so send it again")
        digest, name = stage, f"stage{kept.suffix}"
    else:
        name = own_stage(jobs.stage_root, stage)
        assert jobs.stage_root is not None
        digest = await asyncio.to_thread(tree_digest, jobs.stage_root, name)
    if "stage" in settings and name != f"stage{ARCHIVE}":
        raise invalid("/root", "is for archives; leave it out")
    check_limits(settings, jobs)
    client = client_of(request)
    identifier = identifier_of("render", settings, digest, client.owner)
    keeping = {"Cache-Control": _keeping(request, kept is not None), "Vary": "Accept"}
    tag = f'"{identifier}-image.{settings["format"]}"'
    known = [one.strip().removeprefix("W/") for one in request.headers.get("if-none-match", "").split(",")]
    if tag in known:
        return Response(status_code=304, headers={"ETag": tag, **keeping})
    record = jobs.records.get(identifier)
    if record is None or record.status != "done":
        jobs.check_open()
        lent = await asyncio.to_thread(_shelf(jobs).lend, kept, jobs.store.work) if kept else None
        try:
            record = jobs.submit("render", settings, digest, name, lent, client)
        finally:
            if lent:
                lent.unlink(missing_ok=True)
    refusal = await finished(request, jobs, record)
    if refusal is not None:
        return refusal
    answer = result(request, jobs, record, f"image.{settings['format']}")
    if answer.status_code < 400:
        answer.headers.update(keeping)
    return answer


def _settings(request: Request) -> dict[str, Any]:
    """What the query asks for, as a render's settings. Raises Problem."""
    query = request.query_params
    for name in query:
        if name not in _QUERY:
            raise invalid(f"/{name[:100]}", f"is not known; choose from {', '.join(_QUERY)}")
        if len(query.getlist(name)) > 1 and name != "variant":
            raise invalid(f"/{name}", "comes twice")
    asked: dict[str, Any] = {"image_width": _WIDTH}
    for name, field in (("w", "image_width"), ("time", "time_code")):
        if name in query:
            if not _NUMBER.fullmatch(query[name]):
                raise invalid(f"/{name}", "is not a number")
            asked[field] = float(query[name]) if name == "time" or "." in query[name] else int(query[name])
    for name, field in (("camera", "camera"), ("format", "format"), ("root", "stage")):
        if name in query:
            asked[field] = query[name]
    if "variant" in query:
        asked["variants"] = query.getlist("variant")
    settings = check(models.Render, asked).model_dump(exclude_none=True)
    name = format_of(request.headers.get("accept", ""), settings.get("format", ""))
    return {**settings, "format": FORMATS[name].extension}


def _keeping(request: Request, lasting: bool) -> str:
    """Cache-Control: shared caches keep what was public, or signed, and the latter no longer than it holds."""
    seconds = _LASTING if lasting else _FRESH
    service = request.app.state.settings
    if not service.tokens:
        return f"public, max-age={seconds}"
    path = request.scope.get("raw_path", b"").decode("latin-1")
    until = expiry(service.key, path, request.scope["query_string"].decode("latin-1"), time.time())
    if until is None:
        return f"private, max-age={seconds}"
    return f"public, max-age={max(0, min(seconds, until - int(time.time())))}"


# --- pictures that lie beside stages ----------------------------------------------------------------------------------


@router.get("/pictures/{stage:path}", response_class=Response, **openapi.picture_beside())
async def picture(request: Request, stage: str) -> Response:
    """The picture that lies beside a stage of the stage root, as `picture` of GET /v1/stages says. It may be cached."""
    jobs = jobs_of(request)
    name = own_stage(jobs.stage_root, stage)
    assert jobs.stage_root is not None
    path = picture_of(jobs.stage_root, name, jobs.limits)
    if path is None:
        raise Problem("not-found", "no picture lies beside this stage; GET /v1/thumbnails draws one")
    found = path.stat()
    tag = f'"{found.st_mtime_ns:x}-{found.st_size:x}"'
    public = "private" if request.app.state.settings.tokens else "public"
    headers = {"ETag": tag, "Cache-Control": f"{public}, max-age={_FRESH}"}
    asked = [one.strip().removeprefix("W/") for one in request.headers.get("if-none-match", "").split(",")]
    if tag in asked or "*" in asked:
        return Response(status_code=304, headers=headers)
    return FileResponse(path, headers=headers, media_type="image/png", stat_result=found)
