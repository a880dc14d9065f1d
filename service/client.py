"""A client of the service: `Client("http://127.0.0.1:8000").render("marble.usda", {"image_width": 320}).content`.

Thin: each method is one request, settings are those of the documentation, and every refusal is a `Refused` with the
problem document in it. Needs nothing but Python's own library.
"""

from __future__ import annotations

import hashlib
import http.client
import json
import os
import secrets
import time
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypedDict
from urllib.parse import quote, urlencode, urlsplit

from .signing import signed

Kind = Literal["render", "convert", "bake-probes", "bake-thickness", "inspect", "validate"]
Source = str | Path | Mapping[str, bytes | Path]
"""A stage: the name of one that the service has, a file to send, or several files by their names in the upload."""
ENDED = ("done", "failed", "cancelled")


class OverrideValues(TypedDict, total=False):
    """Values of one material that win over what the stage authors."""

    model: str
    ior: float
    thickness: float
    roughness: float
    transmittanceColor: list[float]
    absorptionDistance: float
    abbeNumber: float


class RenderSettings(TypedDict, total=False):
    """What a render may ask for; docs/service.md says what each means."""

    stage: str
    """Of an upload of several files, the one to open."""
    webhook: str
    """Address that is told when the job has ended; `signing.is_from` says whether the service did it."""
    camera: str
    azimuth: float
    elevation: float
    distance: float
    fit: float
    fov: float
    focal_length: float
    look_at: str | list[float]
    image_width: int
    image_height: int
    quality: str
    preset: str
    samples: int
    tolerance: float
    light_samples: int
    caustics: int
    indirect: str
    cut: float
    tiers: list[str]
    screen: str
    model: str
    max_layers: int
    denoise: bool
    exposure: float
    motion_blur: bool
    camera_light: bool
    emission_light: bool
    studio: str
    background: str
    purposes: list[str]
    time_code: float
    widths: list[int]
    time_codes: list[float]
    variants: list[str]
    format: str
    aovs: list[str]
    color_correction: str
    overrides: dict[str, OverrideValues]


class ConvertSettings(TypedDict, total=False):
    """What a conversion may ask for."""

    stage: str
    webhook: str
    model: str
    only: list[str]
    thickness: str
    to: str
    flatten: bool


class Thumbnail(TypedDict, total=False):
    """What the address of a thumbnail may ask for."""

    w: int
    """Width [pixels]."""
    camera: str
    variant: list[str]
    """`/Prim{set=name}`, or `{set=name}` of the default prim."""
    time: float
    format: str
    root: str
    """Of an archive, the file to open."""


class BakeProbesSettings(TypedDict, total=False):
    """`only` names probes; `layout` is strip, cross or latlong."""

    stage: str
    webhook: str
    only: list[str]
    resolution: int
    layout: str
    samples: int


class BakeThicknessSettings(TypedDict, total=False):
    """`along` is normal or refracted; `texture` asks for pictures in place of primvars."""

    stage: str
    webhook: str
    only: list[str]
    along: str
    texture: int


Settings = RenderSettings | ConvertSettings | BakeProbesSettings | BakeThicknessSettings


class Refused(Exception):
    """The service refused a request, or a job failed."""

    def __init__(self, document: Mapping[str, Any], retry_after: float | None = None) -> None:
        super().__init__(f"{document.get('title', 'refused')}: {document.get('detail', '')}")
        self.document = dict(document)
        """RFC 9457"""
        self.slug = str(document.get("type", "")).rpartition("/")[2]
        self.status = int(document.get("status", 0))
        self.retry_after = retry_after
        """[s] after which to try again; None where that would not help"""


@dataclass(frozen=True)
class Result:
    """One file that the service made."""

    content: bytes
    media_type: str
    etag: str
    job: str
    """Its path, such as `/v1/jobs/0123...`"""
    warnings: int
    """How many the job has; `Client.job` tells them."""


@dataclass(frozen=True)
class Job:
    """How a job is doing."""

    id: str
    kind: Kind
    status: str
    """queued, running, done, failed or cancelled"""
    fraction: float
    warnings: tuple[Mapping[str, str], ...] = ()
    width: int | None = None
    """[pixels]"""
    height: int | None = None
    """[pixels]"""
    aovs: tuple[Mapping[str, Any], ...] = ()
    pictures: tuple[Mapping[str, Any], ...] = ()
    problem: Mapping[str, Any] | None = None
    links: Mapping[str, str] = field(default_factory=dict)

    @property
    def ended(self) -> bool:
        return self.status in ENDED

    @staticmethod
    def of(document: Mapping[str, Any]) -> Job:
        """What this program knows of a document; a newer service may say more."""
        told: dict[str, Any] = {name: document[name] for name in Job.__dataclass_fields__ if name in document}
        lists: dict[str, Any] = {name: tuple(value) for name, value in told.items() if isinstance(value, list)}
        return Job(**{**told, **lists})


class Client:
    """Requests to one service. Has no state but its address, so threads may share it."""

    def __init__(self, url: str = "http://127.0.0.1:8000", *, token: str = "", timeout: float = 600.0,
                 patience: float = 0.0) -> None:  # fmt: skip
        """
        Args:
            token: sent with every request, where not ''.
            timeout: [s] longest silence of the service.
            patience: [s] for how long a request that is told to come again later does so; 0 raises at once.

        Raises:
            ValueError: not the address of a service.
        """
        parts = urlsplit(url)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise ValueError(f"url is '{url}'; it must begin with http:// or https:// and name a host")
        self.url, self.timeout, self.patience = url.rstrip("/"), timeout, patience
        self._secure, self._host, self._port = parts.scheme == "https", parts.hostname, parts.port
        self._base = parts.path.rstrip("/")
        self._token = token

    # --- work

    def render(self, source: Source, settings: RenderSettings | None = None, *, accept: str = "*/*") -> Result:
        """The picture; several `widths` or `time_codes` give one .zip. Raises Refused."""
        return self._result(*self._work("render", source, settings, {"Accept": accept}))

    def convert(self, source: Source, settings: ConvertSettings | None = None) -> Result:
        """The stage as a .usdz with its glass described. Raises Refused."""
        return self._result(*self._work("convert", source, settings, {"Accept": "model/vnd.usdz+zip"}))

    def bake_probes(self, source: Source, settings: BakeProbesSettings | None = None) -> Result:
        """The stage as a .usdz with its reflection probes baked. Raises Refused."""
        return self._result(*self._work("bake-probes", source, settings, {"Accept": "model/vnd.usdz+zip"}))

    def bake_thickness(self, source: Source, settings: BakeThicknessSettings | None = None) -> Result:
        """The stage as a .usdz with the thickness of its glass measured. Raises Refused."""
        return self._result(*self._work("bake-thickness", source, settings, {"Accept": "model/vnd.usdz+zip"}))

    def inspect(self, source: Source, *, stage: str = "") -> dict[str, Any]:
        """What is in a stage. Raises Refused."""
        return self._report("inspect", source, stage)

    def validate(self, source: Source, *, stage: str = "") -> dict[str, Any]:
        """What is wrong with a stage. Raises Refused."""
        return self._report("validate", source, stage)

    def submit(self, kind: Kind, source: Source, settings: Settings | None = None) -> Job:
        """Ask for a job, and do not wait for it. Raises Refused."""
        return Job.of(json.loads(self._work(kind, source, settings, {"Prefer": "respond-async"})[1]))

    def _report(self, kind: Kind, source: Source, stage: str) -> dict[str, Any]:
        wanted: RenderSettings | None = {"stage": stage} if stage else None
        found: dict[str, Any] = json.loads(self._work(kind, source, wanted, {"Accept": "application/json"})[1])
        return found

    # --- jobs

    def job(self, job: Job | str) -> Job:
        """How a job is doing, by its id or its path. Raises Refused."""
        return Job.of(json.loads(self._ask("GET", _path_of(job))[1]))

    def cancel(self, job: Job | str) -> Job:
        """Stop a job; one that has ended stays as it is. Raises Refused."""
        return Job.of(json.loads(self._ask("DELETE", _path_of(job))[1]))

    def events(self, job: Job | str) -> Iterator[Job]:
        """The job whenever it has changed, the last time when it has ended. Raises Refused."""
        connection, answer = self._open("GET", f"{_path_of(job)}/events", None, {})
        try:
            _check(answer)
            for line in answer:
                if line.startswith(b"data: "):
                    yield Job.of(json.loads(line.removeprefix(b"data: ")))
        finally:
            connection.close()

    def wait(self, job: Job | str) -> Job:
        """The job when it is done. Raises Refused where it failed or was cancelled."""
        last = next(iter(deque(self.events(job), maxlen=1)), None)
        if last is None or not last.ended:
            last = self.job(job)
        if last.problem:
            raise Refused(last.problem)
        return last

    def image(self, job: Job | str, number: int | None = None) -> Result:
        """The picture of a render that is done; of several, one by its number. Raises Refused."""
        return self._result(*self._ask("GET", f"{_path_of(job)}/{'image' if number is None else f'pictures/{number}'}"))

    def aov(self, job: Job | str, name: str) -> Result:
        """One plane of a render as a PNG. Raises Refused."""
        return self._result(*self._ask("GET", f"{_path_of(job)}/aovs/{quote(name, safe='')}.png"))

    # --- thumbnails

    def keep(self, stage: Path | bytes) -> str:
        """Send a stage to stay for a while. Returns its digest, by which thumbnails are asked for. Raises Refused."""
        content = stage if isinstance(stage, bytes) else stage.read_bytes()
        zipped = isinstance(stage, Path) and stage.suffix.lower() == ".zip"
        digest = hashlib.sha256(content).hexdigest()
        media = "application/zip" if zipped else "application/octet-stream"
        self._ask("PUT", f"/v1/stages/{digest}", content, {"Content-Type": media})
        return digest

    def thumbnail(self, stage: str, query: Thumbnail | None = None, *, etag: str = "") -> Result | None:
        """A picture of a stage, by its name or its digest; None where the one with this ETag still holds.

        Raises:
            Refused: by the service.
        """
        path, asked = _thumbnail(stage, query or {})
        headers = {"If-None-Match": etag} if etag else {}
        found, content = self._ask("GET", f"{path}?{asked}" if asked else path, headers=headers)
        return self._result(found, content) if content else None

    def thumbnail_address(self, stage: str, query: Thumbnail | None = None, *, key: str, seconds: int) -> str:
        """An address that anybody may open for a while. Nothing is asked of the service.

        Args:
            key: what the service has as its `--key-file`.
            seconds: for how long.
        """
        path, asked = _thumbnail(stage, query or {})
        return self.url + signed(key, path, asked, int(time.time()) + seconds)

    # --- about the service

    def stages(self) -> list[str]:
        """Names of the stages that the service has. Raises Refused."""
        return [one["path"] for one in json.loads(self._ask("GET", "/v1/stages")[1])["stages"]]

    def limits(self) -> dict[str, int]:
        """Every limit by its name. Raises Refused."""
        return {one["name"]: one["value"] for one in json.loads(self._ask("GET", "/v1/limits")[1])["limits"]}

    # --- one request

    def _work(
        self, kind: Kind, source: Source, settings: Settings | None, headers: Mapping[str, str]
    ) -> tuple[Mapping[str, str], bytes]:
        body, media = _body(source, settings or {})
        return self._ask("POST", f"/v1/{kind}", body, {**headers, "Content-Type": media})

    def _ask(
        self, method: str, path: str, body: bytes | None = None, headers: Mapping[str, str] | None = None
    ) -> tuple[Mapping[str, str], bytes]:
        """Headers, in small letters, and content of an answer. Raises Refused."""
        until = time.monotonic() + self.patience
        while True:
            connection, answer = self._open(method, path, body, headers or {})
            try:
                _check(answer)
                return {name.lower(): value for name, value in answer.getheaders()}, answer.read()
            except Refused as refused:
                wait = refused.retry_after
                if wait is None or time.monotonic() + wait > until:
                    raise
            finally:
                connection.close()
            time.sleep(wait)

    def _open(
        self, method: str, path: str, body: bytes | None, headers: Mapping[str, str]
    ) -> tuple[http.client.HTTPConnection, http.client.HTTPResponse]:
        kind = http.client.HTTPSConnection if self._secure else http.client.HTTPConnection
        connection = kind(self._host, self._port, timeout=self.timeout)
        token = {"Authorization": f"Bearer {self._token}"} if self._token else {}
        try:
            connection.request(method, self._base + path, body, {**token, **headers})
            return connection, connection.getresponse()
        except BaseException:
            connection.close()
            raise

    def _result(self, headers: Mapping[str, str], content: bytes) -> Result:
        return Result(
            content, headers.get("content-type", ""), headers.get("etag", ""), headers.get("content-location", ""),
            int(headers.get("refract-warnings", "0")),
        )  # fmt: skip


def _check(answer: http.client.HTTPResponse) -> None:
    """Raise Refused for an answer that is a problem."""
    if answer.status < 400:
        return
    content, wait = answer.read(), answer.getheader("Retry-After") or ""
    try:
        document = json.loads(content)
    except ValueError:
        document = None
    if not isinstance(document, dict):  # of something between us and the service
        document = {"title": f"status {answer.status}", "status": answer.status, "detail": answer.reason}
    raise Refused(document, float(wait) if wait.isdigit() else None)


def _thumbnail(stage: str, query: Thumbnail) -> tuple[str, str]:
    """Path and query of a thumbnail."""
    return f"/v1/thumbnails/{quote(stage)}", urlencode(query, doseq=True)


def _path_of(job: Job | str) -> str:
    identifier = job.id if isinstance(job, Job) else job.rpartition("/")[2]
    return f"/v1/jobs/{quote(identifier, safe='')}"


def _body(source: Source, settings: Mapping[str, Any]) -> tuple[bytes, str]:
    """The body of a request, and its type."""
    if isinstance(source, str):
        return json.dumps({**settings, "stage": source}, allow_nan=False).encode(), "application/json"
    parts = [("settings", "", json.dumps(settings, allow_nan=False).encode())]
    if isinstance(source, Path):
        parts.append(("stage", source.name, source.read_bytes()))
    else:
        parts += [
            ("file", name, content.read_bytes() if isinstance(content, os.PathLike) else content)
            for name, content in source.items()
        ]
    boundary = secrets.token_hex(16)
    lines = b"".join(
        b"".join((f"--{boundary}\r\n{_disposition(name, file)}\r\n\r\n".encode(), content, b"\r\n"))
        for name, file, content in parts
    )
    return lines + f"--{boundary}--\r\n".encode(), f"multipart/form-data; boundary={boundary}"


def _disposition(name: str, file: str) -> str:
    """Raises ValueError: a name with characters that a head cannot hold."""
    if any(letter in file for letter in "\r\n\0\""):
        raise ValueError(f"the file name {file!r} holds a line break or a quotation mark")
    named = f'; filename="{file}"' if file else ""
    return f'Content-Disposition: form-data; name="{name}"{named}'
