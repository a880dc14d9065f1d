"""Bodies of requests: multipart or JSON, read with a limit on bytes and time, checked before anything is done."""

from __future__ import annotations

import asyncio
import difflib
import json
import os
import secrets
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from pydantic import ValidationError
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.types import Message

from .beside import href_of
from .limits import Limits
from .models import StageOnly
from .problems import Problem
from .tasks import pointer
from .uploads import ARCHIVE, GLTF, USD, check_together, checked_name, pack

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

SUFFIXES = USD
_MAGIC = {b"#usda ": ".usda", b"PXR-USDC": ".usdc", b"PK\x03\x04": ".usdz", b"glTF": ".glb"}
_START = 64
"""Bytes that tell what a file is."""


class Wish(NamedTuple):
    """A request, understood."""

    settings: StageOnly
    upload: Path | None
    """The uploaded stage in a temporary file, which the reader of this must move or remove."""
    suffix: str
    inner: str = ""
    """Of an upload of several files, the name of the one to open; '' leaves it to be found."""


async def read_wish(request: Request, model: type[StageOnly], limits: Limits, folder: Path) -> Wish:
    """Read and check a body.

    Raises:
        Problem: 400, 408, 413, 415 or 422.
    """
    try:
        async with asyncio.timeout(limits.body_seconds):
            return await _read(request, model, limits, folder)
    except ClientDisconnect:
        raise Problem("bad-request", "the body ended before it was complete") from None
    except TimeoutError:
        raise Problem("request-timeout", f"the body did not arrive within {limits.body_seconds} s") from None


async def _read(request: Request, model: type[StageOnly], limits: Limits, folder: Path) -> Wish:
    media = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media not in ("multipart/form-data", "application/json"):
        raise Problem("unsupported-media-type", "send application/json, or multipart/form-data with a stage")
    if request.headers.get("content-encoding", "identity").lower() != "identity":
        raise Problem("unsupported-media-type", "send the body without Content-Encoding")
    if media == "application/json":
        stream = limited(request, limits.settings_bytes).stream()
        settings = check(model, parse(b"".join([part async for part in stream])))
        if settings.stage is None:
            raise invalid("/stage", "is missing; name a stage of GET /v1/stages, or upload one as multipart/form-data")
        return Wish(settings, None, "")
    return await _read_form(limited(request, limits.body_bytes), model, limits, folder)


async def _read_form(request: Request, model: type[StageOnly], limits: Limits, folder: Path) -> Wish:
    try:
        form = await request.form(
            max_files=limits.upload_files + 1, max_fields=4, max_part_size=limits.settings_bytes
        )  # fmt: skip
    except HTTPException as error:
        if str(error.detail).startswith("Too many files"):
            raise Problem("limit-exceeded", f"the upload has more than {limits.upload_files} files") from None
        raise Problem("bad-request", f"the multipart body cannot be read: {str(error.detail)[:200]}") from None
    try:
        parts = form.multi_items()
        for name, _ in parts:
            if name not in ("stage", "settings", "file"):
                raise invalid(f"/{pointer(name[:100])}", "is no part of this request; send stage, file and settings")
        single = [name for name, _ in parts if name != "file"]
        if len(set(single)) != len(single):
            raise Problem("bad-request", "a part comes twice")
        text: Any = form.get("settings") or "{}"
        if isinstance(text, UploadFile):
            text = await text.read(limits.settings_bytes + 1)
            if len(text) > limits.settings_bytes:
                raise Problem("too-large", f"settings may have {limits.settings_bytes} bytes")
        settings = check(model, parse(text))
        stage, files = form.get("stage"), form.getlist("file")
        if not isinstance(stage, UploadFile | None) or not (stage or files):
            raise invalid("/stage", "is missing; upload a file under this name, or name a stage in a JSON body")
        path = folder / f"upload-{secrets.token_hex(8)}"
        try:
            return await _stored(settings, stage, files, limits, path)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
    finally:
        await form.close()


async def _stored(
    settings: StageOnly, stage: UploadFile | None, files: list[Any], limits: Limits, path: Path
) -> Wish:  # fmt: skip
    """Put the stage where it can be moved from: as it is, or with all files that belong to it in one archive."""
    if stage and settings.stage is not None and (files or await _suffix_of(stage) != ARCHIVE):
        raise invalid("/stage", "a file is uploaded already; leave it out of the settings")
    if stage and not files:
        suffix = await _suffix_of(stage)
        await asyncio.to_thread(_store, stage, path, limits.stage_bytes)
        return Wish(settings, path, suffix, settings.stage or "")
    named = [(checked_name(one.filename or ""), one) for one in (stage, *files) if isinstance(one, UploadFile)]
    if len(named) < len(files) + (stage is not None):
        raise invalid("/file", "is no file; send each with its name relative to the upload")
    check_together(name for name, _ in named)
    if stage and not named[0][0].lower().endswith((*USD, *GLTF)):
        raise Problem("unsupported-media-type", _SENDABLE)
    total = sum(one.size or 0 for _, one in named)
    if total > limits.stage_bytes:
        raise Problem("too-large", f"the files have {total} bytes; the limit is {limits.stage_bytes}")
    await asyncio.to_thread(pack, {name: one.file for name, one in named}, path)
    return Wish(settings, path, ARCHIVE, named[0][0] if stage else settings.stage or "")


def _store(stage: UploadFile, path: Path, most: int) -> None:
    if (stage.size or 0) > most:
        raise Problem("too-large", f"the stage has {stage.size} bytes; the limit is {most}")
    try:
        with open(path, "xb") as file:
            shutil.copyfileobj(stage.file, file, 1 << 20)
    except OSError:  # of a full disk
        path.unlink(missing_ok=True)
        raise


_SENDABLE = "the file is not USD; send .usda, .usdc, .usd, .usdz, .glb or .gltf, or a .zip with one of them"


async def _suffix_of(stage: UploadFile) -> str:
    start = await stage.read(_START)
    await stage.seek(0)
    return suffix_of(start, stage.filename or "")


def suffix_of(start: bytes, name: str) -> str:
    """What a file is, by how it begins; packages and other archives begin alike, and are told apart by their names.

    Raises:
        Problem: nothing that is read.
    """
    for magic, suffix in _MAGIC.items():
        if start.startswith(magic):
            zipped = suffix == ".usdz" and name.lower().endswith(ARCHIVE)
            return ARCHIVE if zipped else suffix
    if start.lstrip().startswith(b"{"):
        return ".gltf"
    raise Problem("unsupported-media-type", _SENDABLE)


def limited(request: Request, most: int) -> Request:
    """The same request, which raises as soon as it is known that the body is too large."""
    detail = f"the limit is {most} bytes"
    declared = request.headers.get("content-length", "")
    if declared.isdigit() and int(declared[:20]) > most:
        raise Problem("too-large", f"the body has {declared[:20]} bytes; {detail}")
    count = 0
    inner = request.receive

    async def receive() -> Message:
        nonlocal count
        message = await inner()
        count += len(message.get("body", b""))
        if count > most:
            raise Problem("too-large", f"the body is too large; {detail}")
        return message

    return Request(request.scope, receive)


def parse(text: str | bytes) -> Any:
    """JSON without what is not JSON: NaN, Infinity. Raises Problem."""

    def refuse(constant: str) -> NoReturn:
        raise ValueError(constant)

    try:
        return json.loads(text, parse_constant=refuse)
    except (ValueError, RecursionError):
        raise Problem("bad-request", "the settings are not JSON (RFC 8259)") from None


def check(model: type[StageOnly], value: Any) -> StageOnly:
    """Validate settings. Raises Problem with a pointer for each field; the input itself is never echoed."""
    try:
        return model.model_validate(value)
    except ValidationError as error:
        fields = model.model_json_schema()["properties"]
        errors = [
            {
                "pointer": "".join(f"/{pointer(str(step)[:100])}" for step in one["loc"]),
                "detail": _wrong(fields, one)[:300],
            }
            for one in error.errors(include_url=False, include_context=False, include_input=False)[:20]
        ]
        first = errors[0]
        text = f"{first['pointer']}: {first['detail']}" + (f"; and {len(errors) - 1} more" if len(errors) > 1 else "")
        raise Problem("invalid-settings", text, errors=errors) from None


def _wrong(fields: Mapping[str, Any], one: ErrorDetails) -> str:
    """What is wrong with a field, and what may be there instead: both ends of a number's range, where pydantic tells
    the one that was missed, and the nearest name to one that is not known. `fields`: JSON schemas by name."""
    name = str(one["loc"][0]) if len(one["loc"]) == 1 else ""
    if one["type"] == "extra_forbidden":
        near = difflib.get_close_matches(name[:100], fields, 1)
        return "is not known" + (f"; did you mean {near[0]}?" if near else "; leave it out, or see /docs")
    if one["type"] in ("greater_than_equal", "less_than_equal") and name in fields:
        for kind in fields[name].get("anyOf", ()):
            if "minimum" in kind and "maximum" in kind:
                return f"must be between {kind['minimum']} and {kind['maximum']}"
    return str(one["msg"])


def invalid(where: str, detail: str) -> Problem:
    return Problem("invalid-settings", f"{where}: {detail}"[:500],
                   errors=[{"pointer": where, "detail": detail}])  # fmt: skip


# --- stages of ours ---------------------------------------------------------------------------------------------------


def stages(root: Path | None, limits: Limits) -> list[dict[str, Any]]:
    """Stages under the root, the shallow ones first, each with the address of its picture."""
    found = []
    for folder, folders, names in os.walk(root or os.devnull):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(names):
            path = Path(folder, name)
            if path.suffix.lower() in SUFFIXES and path.is_file() and not name.startswith("."):
                found.append({"path": path.relative_to(root or "/").as_posix(), "bytes": path.stat().st_size})
    listed = sorted(found, key=lambda one: (str(one["path"]).count("/"), one["path"]))[:1000]
    return [{**one, "picture": href_of(root, str(one["path"]), limits)} for one in listed]


def own_stage(root: Path | None, name: str) -> str:
    """Path of a stage under the root, checked. Raises Problem."""
    problem = invalid("/stage", "there is no such stage here; see GET /v1/stages")
    if root is None or name.startswith(("/", "~")) or "\\" in name or ".." in name.split("/"):
        raise problem
    top = root.resolve()
    try:
        path = (top / name).resolve()
        known = path.is_relative_to(top) and path.suffix.lower() in SUFFIXES and path.is_file()
    except (OSError, ValueError):
        known = False
    if not known:
        raise problem
    return path.relative_to(top).as_posix()
