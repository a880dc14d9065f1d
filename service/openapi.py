"""What the OpenAPI document says beside what FastAPI finds by itself: headers, problems by status, bodies, tokens."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, get_args

from fastapi import FastAPI

from . import models
from .problems import KINDS, MEDIA_TYPE, Problem
from .tokens import needed

Answers = dict[int | str, dict[str, Any]]
_PROBLEM = {"$ref": "#/components/schemas/ProblemDocument"}
_TOKEN = "token"
ALWAYS = (400, 421, 431, 500)
"""Problems that any request can meet."""
WORK = (403, 406, 408, 409, 413, 415, 422, 429, 501, 503, 507)
"""Problems of a request that becomes a job, and of the job."""


def _header(text: str, kind: str = "string", *, required: bool = True, example: str = "") -> dict[str, Any]:
    found = {"description": text, "required": required, "schema": {"type": kind}}
    return {**found, "example": example} if example else found


_HEADERS_OF: dict[int, dict[str, Any]] = {
    401: {"WWW-Authenticate": _header("Bearer")},
    403: {"WWW-Authenticate": _header("Bearer, and the scope that the token lacks", required=False)},
    416: {"Content-Range": _header("size of the result in bytes", example="bytes */1951")},
    429: {"Retry-After": _header("seconds after which to try again", "integer")},
    503: {"Retry-After": _header("seconds after which to try again", "integer")},
    507: {"Retry-After": _header("seconds after which to try again", "integer")},
}
_RESULT_HEADERS = {
    "ETag": _header("strong; the same for the same stage, settings and engine"),
    "Content-Location": _header("the job"),
    "Refract-Warnings": _header("how many warnings the job has; it tells them", "integer"),
    "Cache-Control": _header("a result never changes"),
    "Vary": _header("Accept, which chooses the format"),
}
_TAGS = (
    ("work", ("/v1/render", "/v1/convert", "/v1/bake", "/v1/inspect", "/v1/validate"), "what is done with a stage"),
    ("jobs", ("/v1/jobs",), "how a job is doing, and what it made"),
    ("thumbnails", ("/v1/thumbnails", "/v1/pictures/", "/v1/stages/"),
     "pictures with an address, and the stages sent for them"),
    ("live", ("/v1/live",), "small pictures of a stage that is kept ready"),
    ("service", ("/",), "the service itself"),
)
"""Tag, how the paths that have it begin (the first that fits counts), and what it means."""
_EXAMPLES: dict[str, dict[str, Any]] = {
    "as it is": {"stage": "marble.usda"},
    "small and quick": {"stage": "marble.usda", "image_width": 320, "samples": 1},
    "sizes for a shop": {"stage": "marble.usda", "widths": [64, 256, 1024], "format": "webp"},
    "another glass": {"stage": "marble.usda", "overrides": {"/World/Looks/Amber": {"ior": 1.33}}},
    "small probes": {"stage": "marble.usda", "resolution": 64, "layout": "latlong"},
    "as light goes": {"stage": "marble.usda", "along": "refracted"},
    "for glTF": {"stage": "preview_surface.usda", "to": "gltf", "thickness": "measured"},
}
"""Bodies, each for the requests that have these fields."""
_PATHS: dict[str, Any] = {
    "identifier": {"type": "string", "pattern": "^[0-9a-f]{64}$"},
    "digest": {"type": "string", "pattern": "^[0-9a-f]{64}$"},
    "stage": {"type": "string", "minLength": 1},
    "number": {"type": "integer", "minimum": 0, "maximum": 9999},
    "name": {"type": "string", "enum": [name for name in get_args(models.Aov) if name != "P"]},
}
"""What a part of a path may be; anything else is a 404."""
_REQUEST_ID = {"X-Request-Id": _header("in the server's log too", required=False)}


def _parameter(name: str, text: str) -> dict[str, Any]:
    return {"name": name, "in": "header", "required": False, "description": text, "schema": {"type": "string"}}


PREFER = _parameter("Prefer", "`respond-async`: answer 202 with the job at once, and do the work even if nobody waits.")
_CONDITIONS = [
    _parameter("If-None-Match", "ETags of results that are there already; `*` stands for any. Then the answer is 304."),
    _parameter("Range", "One range of bytes, such as `bytes=0-99`, which is answered with 206; others are ignored."),
    _parameter("If-Range", "An ETag: the range counts only if the result still has it."),
]


def _problem(status: int) -> dict[str, Any]:
    """A problem document, and one of this status."""
    slug = next(slug for slug, kind in KINDS.items() if kind.status == status)
    return {"schema": _PROBLEM, "example": Problem(slug, KINDS[slug].about).document()}


def problems(*statuses: int) -> Answers:
    """Answers that are problem documents."""
    return {
        status: {
            "description": " or ".join(sorted({kind.title for kind in KINDS.values() if kind.status == status})),
            "content": {MEDIA_TYPE: _problem(status)}, "headers": _HEADERS_OF.get(status, {}),
        }
        for status in statuses
    }  # fmt: skip


# --- operations -------------------------------------------------------------------------------------------------------


def work(model: type[models.StageOnly], what: str, content: dict[str, Any]) -> dict[str, Any]:
    """Keywords for a route that takes a stage.

    Args:
        model: of the JSON body.
        what: the answer.
        content: media type of the answer -> its description.
    """
    done = {"description": what, "content": content, "headers": _RESULT_HEADERS}
    accepted = {
        "model": models.Job, "description": "with `Prefer: respond-async`: the job",
        "headers": {"Location": _header("address of the job"), "Preference-Applied": _header("respond-async")},
    }  # fmt: skip
    extra = {"parameters": [PREFER], "requestBody": _body(model)}
    return {"openapi_extra": extra, "responses": {200: done, 202: accepted, **problems(*WORK)}}


def result(what: str, *media: str) -> dict[str, Any]:
    """Keywords for a route that gives one file of a job."""
    content: dict[str, Any] = {one: {} for one in media}
    whole = {"description": what, "content": content, "headers": _RESULT_HEADERS}
    part = {
        "description": "with `Range`: a part of it", "content": content,
        "headers": {**_RESULT_HEADERS, "Content-Range": _header("which part", example="bytes 0-99/1951")},
    }  # fmt: skip
    same = {"description": "with `If-None-Match`: it is there already", "headers": _RESULT_HEADERS}
    answers = {200: whole, 206: part, 304: same, **problems(404, 409, 416)}
    return {"openapi_extra": {"parameters": _CONDITIONS}, "responses": answers}


def live_stage() -> dict[str, Any]:
    """Keywords for the route that opens a live viewer."""
    made = {"model": models.Viewer, "description": "the viewer", "headers": {
        "Location": _header("address of the viewer"), "Cache-Control": _header("no-store"),
    }}  # fmt: skip
    return {"openapi_extra": {"requestBody": _body(models.LiveStage)},
            "responses": {201: made, **problems(403, 408, 413, 415, 422, 429, 503, 507)}}  # fmt: skip


def live_picture(left_out: Iterable[str]) -> dict[str, Any]:
    """Keywords for the route of live pictures.

    Args:
        left_out: fields of a render that they do not have.
    """
    schema = _inlined(models.Render)
    kept = {name: value for name, value in schema["properties"].items() if name not in left_out}
    body = {**schema, "properties": kept, "required": ["image_width", "image_height"]}
    content = {"application/json": {"schema": {key: value for key, value in body.items() if key != "description"}}}
    done = {"description": "the picture", "content": {"image/png": {}},
            "headers": {"Cache-Control": _header("no-store")}}  # fmt: skip
    return {"openapi_extra": {"requestBody": {"required": True, "content": content}},
            "responses": {200: done, **problems(403, 404, 408, 413, 415, 422, 429, 500, 503, 507)}}  # fmt: skip


def live_end() -> dict[str, Any]:
    """Keywords for the route that ends a live viewer."""
    return {"responses": {204: {"description": "it has ended"}, **problems(403, 404)}}


def stage_by_digest() -> dict[str, Any]:
    """Keywords for the route that keeps a stage."""
    body = {"required": True, "content": {
        media: {"schema": {"type": "string", "format": "binary"}}
        for media in ("application/octet-stream", "application/zip")
    }}  # fmt: skip
    made = {"description": "the stage is kept", "headers": {"Location": _header("its thumbnail")}}
    there = {"description": "it was there already"}
    refusals = problems(403, 404, 408, 413, 415, 422, 429, 503)
    return {"openapi_extra": {"requestBody": body}, "responses": {201: made, 204: there, **refusals}}


def picture_beside() -> dict[str, Any]:
    """Keywords for the route of pictures that lie beside stages."""
    headers = {name: _RESULT_HEADERS[name] for name in ("ETag", "Cache-Control")}
    found = result("the picture", "image/png")
    answers = {code: {**answer, "headers": {name: value for name, value in answer["headers"].items()
                                            if name in (*headers, "Content-Range")}}
               for code, answer in found["responses"].items() if code < 400}  # fmt: skip
    return {"openapi_extra": found["openapi_extra"], "responses": {**answers, **problems(404, 416, 422)}}


def thumbnail(query: dict[str, tuple[str, dict[str, Any]]], media: Iterable[str]) -> dict[str, Any]:
    """Keywords for the route of thumbnails.

    Args:
        query: name of a parameter -> description and schema.
    """
    asked = [{"name": name, "in": "query", "required": False, "description": text, "schema": schema}
             for name, (text, schema) in query.items()]  # fmt: skip
    found = result("the picture", *media)
    return {"openapi_extra": {"parameters": [*asked, *_CONDITIONS]},
            "responses": {**found["responses"], **problems(*WORK)}}  # fmt: skip


def _body(model: type[models.StageOnly]) -> dict[str, Any]:
    """A stage of ours by its name in JSON, or an uploaded one with settings beside it."""
    schema = _inlined(model)
    stage = schema["properties"].pop("stage")
    named = {key: value for key, value in stage["anyOf"][0].items() if key != "title"}
    ours = {**schema, "required": ["stage"], "properties": {
        "stage": {**named, "title": "Stage", "description": "a stage of GET /v1/stages"}, **schema["properties"],
    }}  # fmt: skip
    told = {**schema, "properties": {
        "stage": {**named, "title": "Stage", "description": "of an upload of several files, the one to open"},
        **schema["properties"],
    }}  # fmt: skip
    settings = {"type": "string", "contentMediaType": "application/json", "contentSchema": told}
    one = {"type": "string", "format": "binary"}
    form = {
        "type": "object", "additionalProperties": False, "anyOf": [{"required": ["stage"]}, {"required": ["file"]}],
        "properties": {
            "stage": {**one, "description": "USD, glTF, or a .zip with a stage and all that belongs to it"},
            "file": {"type": "array", "items": one, "minItems": 1, "description": (
                "a file that the stage refers to, under its relative name; of several, one may be the stage"
            )},
            "settings": settings,
        },
    }  # fmt: skip
    fitting = {name: value for name, value in _EXAMPLES.items() if value.keys() <= model.model_fields.keys()}
    examples = {name: {"value": value} for name, value in fitting.items()}
    content = {"application/json": {"schema": ours, "examples": examples}, "multipart/form-data": {"schema": form}}
    return {"required": True, "content": content}


def _inlined(model: type[models.StageOnly]) -> dict[str, Any]:
    """The schema with its definitions in place, for a document that has no room of ours for them."""
    schema = model.model_json_schema()
    known = schema.pop("$defs", {})

    def put(value: Any) -> Any:
        if isinstance(value, dict):
            if "$ref" in value:
                return put(known[value["$ref"].rpartition("/")[2]])
            if "patternProperties" in value:  # by which pydantic means that every name must fit
                value = {**value}
                ((pattern, inner),) = value.pop("patternProperties").items()
                names = {**value.get("propertyNames", {}), "pattern": pattern}
                value |= {"propertyNames": names, "additionalProperties": inner}
            return {key: put(inner) for key, inner in value.items()}
        return [put(inner) for inner in value] if isinstance(value, list) else value

    found: dict[str, Any] = put(schema)
    return found


# --- the document -----------------------------------------------------------------------------------------------------


def describe(app: FastAPI, *, tokens: bool) -> None:
    """Let the app's document tell all of this.

    Args:
        tokens: the service asks for a bearer token.
    """
    plain: Callable[[], dict[str, Any]] = app.openapi
    ready: list[dict[str, Any]] = []

    def document() -> dict[str, Any]:
        if not ready:
            ready.append(_completed(plain(), tokens))
        return ready[0]

    app.openapi = document  # type: ignore[method-assign]


def _completed(found: dict[str, Any], tokens: bool) -> dict[str, Any]:
    found["info"]["description"] += (
        " Every error is a problem document (RFC 9457). HEAD is answered wherever GET is, without the body."
    )
    for path, operations in found["paths"].items():
        for method, operation in operations.items():
            _complete(operation, needed(method.upper(), path) if tokens else "")
            operation["tags"] = [next(tag for tag, starts, _ in _TAGS if path.startswith(starts))]
    numbers = found["paths"]["/metrics"]["get"]["responses"]["200"]
    numbers["content"] = {"text/plain": {"schema": {"type": "string"}}}
    found["tags"] = [{"name": tag, "description": text} for tag, _, text in _TAGS]
    found["servers"] = [{"url": "/", "description": "where this document comes from"}]
    parts = found.setdefault("components", {})
    for name in ("HTTPValidationError", "ValidationError"):  # FastAPI's own, which nobody is ever sent
        parts.get("schemas", {}).pop(name, None)
    if tokens:
        parts["securitySchemes"] = {_TOKEN: {"type": "http", "scheme": "bearer"}}
    return found


def _complete(operation: dict[str, Any], scope: str) -> None:
    """`scope`: what a token must have; '' where none is asked for."""
    answers = operation["responses"]
    if "application/json" in answers.get("422", {}).get("content", {}):
        del answers["422"]
    for parameter in operation.get("parameters", ()):
        parameter["schema"] = _PATHS.get(parameter["name"], parameter["schema"])
    if scope:
        operation["security"] = [{_TOKEN: []}]
        said = operation.get("description", "")
        operation["description"] = f"{said}\n\nThe token needs the scope `{scope}`.".strip()
    _add(answers, (*ALWAYS, 401, 403) if scope else ALWAYS)
    for status, answer in answers.items():
        answer["headers"] = {**_HEADERS_OF.get(int(status), {}), **answer.get("headers", {}), **_REQUEST_ID}
        if MEDIA_TYPE in answer.get("content", {}):
            answer["content"][MEDIA_TYPE] = _problem(int(status))
    operation["responses"] = dict(sorted(answers.items()))


def _add(answers: dict[str, Any], statuses: Iterable[int]) -> None:
    for status, answer in problems(*statuses).items():
        answers.setdefault(str(status), answer)
