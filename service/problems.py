"""Everything that can go wrong, as RFC 9457 problem documents. Each type has a page at `/problems/<slug>`."""

from __future__ import annotations

import json
from typing import Any, NamedTuple

from starlette.responses import Response

MEDIA_TYPE = "application/problem+json"


class Kind(NamedTuple):
    status: int
    title: str
    about: str
    """What to do, for the page of the type."""


KINDS: dict[str, Kind] = {
    "bad-request": Kind(400, "The request cannot be read", "Send the body the documentation describes."),
    "unauthorized": Kind(401, "A token is needed", "Send `Authorization: Bearer TOKEN`."),
    "forbidden": Kind(403, "The token may not do this", "Use one with the scope that detail names."),
    "cross-origin": Kind(403, "The request comes from another site",
                         "Use the service's own page, a program, or a site named with `--allow-origin`."),
    "not-found": Kind(404, "There is nothing here", "Check the path; jobs and results are removed after some time."),
    "method-not-allowed": Kind(405, "The method is not allowed here", "Use a method that the Allow header names."),
    "not-acceptable": Kind(406, "No format that is accepted can be given", "Accept one of the types named in detail."),
    "request-timeout": Kind(408, "The body took too long to arrive", "Send it faster, or a smaller one."),
    "not-done": Kind(409, "The job has no result", "Ask for the job itself: it tells its status."),
    "cancelled": Kind(409, "The job was cancelled", "Send the request again to start anew."),
    "too-large": Kind(413, "The body is too large", "See /v1/limits."),
    "range-not-satisfiable": Kind(416, "The result does not reach that far", "Content-Range tells its size in bytes."),
    "unsupported-media-type": Kind(415, "The body is of a type that is not read",
                                   "Send JSON, or multipart with USD or glTF."),
    "misdirected": Kind(421, "The service does not go by this name",
                        "Ask by `localhost`, by the address it listens on, or by a name given with `--allow-host`."),
    "invalid-settings": Kind(422, "The settings are not valid", "`errors` names each field by a JSON pointer."),
    "stage-invalid": Kind(422, "The stage cannot be read", "Try `refract validate` on it."),
    "stage-refused": Kind(422, "The stage refers to something outside itself",
                          "Upload a self-contained stage, such as a .usdz, or all its files; absolute paths, links, "
                          "expressions, and `..` out of what was sent are refused."),
    "limit-exceeded": Kind(422, "The job is larger than this service allows", "See /v1/limits."),
    "time-limit": Kind(422, "The job took too long", "Ask for fewer pixels or samples, or a simpler stage."),
    "memory-limit": Kind(422, "The job needed too much memory", "Ask for fewer pixels, or a simpler stage."),
    "stage-crashed": Kind(422, "The stage made its worker crash",
                          "The stage is damaged, or it has found a fault of this program: whoever runs the service has "
                          "the reason in its log, under the job's id. Nothing else was affected."),
    "queue-full": Kind(429, "Too many jobs are waiting", "Try again after the time in Retry-After."),
    "share-spent": Kind(429, "One client may not have more at once",
                        "Let what is under way end, or try again after the time in Retry-After; `share` of /v1/limits "
                        "says how much."),
    "head-too-large": Kind(431, "The head of the request is too large", "Send fewer or shorter headers."),
    "internal": Kind(500, "Something went wrong in the service", "Tell whoever runs it the request's id."),
    "worker-fault": Kind(500, "The job met a fault of this program",
                         "The stage may be in order: the program failed where it should have drawn it, or told what is "
                         "wrong. Whoever runs the service has the reason in its log, under the job's id."),
    "transfer-coding": Kind(501, "The transfer coding is not known", "Send Content-Length, or chunks."),
    "interrupted": Kind(503, "The service stopped before the job was done", "Send the request again."),
    "unavailable": Kind(503, "The service takes no jobs now", "Try again after the time in Retry-After."),
    "no-space": Kind(507, "The service has no room left", "Try again after the time in Retry-After."),
}  # fmt: skip

BY_STATUS = {404: "not-found", 405: "method-not-allowed", 413: "too-large", 415: "unsupported-media-type",
             416: "range-not-satisfiable", 431: "head-too-large", 501: "transfer-coding"}  # fmt: skip
"""The types of errors that a layer below tells by their status alone."""


class Problem(Exception):
    """A request or a job fails; the text is for the client."""

    def __init__(
        self, slug: str, detail: str, *, errors: list[dict[str, str]] | None = None, prim: str = "",
        headers: dict[str, str] | None = None,
    ) -> None:  # fmt: skip
        super().__init__(detail)
        self.slug, self.detail, self.errors, self.prim = slug, detail, errors or [], prim
        self.headers = headers or {}

    def document(self, instance: str = "") -> dict[str, Any]:
        kind = KINDS[self.slug]
        found: dict[str, Any] = {
            "type": f"/problems/{self.slug}", "title": kind.title, "status": kind.status, "detail": self.detail
        }  # fmt: skip
        if instance:
            found["instance"] = instance
        if self.errors:
            found["errors"] = self.errors
        if self.prim:
            found["prim"] = self.prim
        return found


def respond(problem: Problem, instance: str = "") -> Response:
    return document_response(problem.document(instance), problem.headers)


def of_status(status: int) -> Problem:
    """The problem of an error that is known by its status alone."""
    slug = BY_STATUS.get(status, "bad-request" if status < 500 else "internal")
    return Problem(slug, KINDS[slug].about)


def document_response(document: dict[str, Any], headers: dict[str, str] | None = None) -> Response:
    """A stored or new problem document as an answer."""
    content = json.dumps(document, allow_nan=False)
    extra = {"Cache-Control": "no-store", **(headers or {})}
    if document["status"] == 401:
        extra["WWW-Authenticate"] = "Bearer"
    if document["status"] in (429, 503, 507):
        extra.setdefault("Retry-After", "5")
    return Response(content, document["status"], extra, MEDIA_TYPE)
