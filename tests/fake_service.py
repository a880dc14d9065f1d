"""A stand-in for the service: its API over canned answers, so that the page is tried without rendering anything.

A job takes `seconds`. Its picture's colour follows from its settings, so that a changed setting is a changed picture.
`samples` over 1000 is refused, `max_layers` 13 fails while rendering, and a stage called `broken` cannot be opened.
"""

from __future__ import annotations

import email.parser
import email.policy
import hashlib
import json
import struct
import threading
import time
import zlib
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from service import pages

STATIC = Path(__file__).parents[1] / "service" / "static"
TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
ENDED = ("done", "failed", "cancelled")
WIDTH, HEIGHT = 64, 36
STAGES = [
    {"path": "ball.usda", "bytes": 9, "picture": "/v1/pictures/ball.usda"},
    {"path": "room.usda", "bytes": 9, "picture": ""},
    {"path": "parts/wall.usda", "bytes": 9, "picture": ""},
]
VIEW = {"camera": "/World/Near", "azimuth": 10.0, "elevation": 20.0, "distance": 4.0, "look_at": [0.0, 1.0, 0.0],
        "width": 0.5, "orthographic": False}  # fmt: skip
VERDICT = {"format": "refract.validate/1", "errors": 1, "warnings": 1, "infos": 0, "findings": [
    {"rule": "refract.x", "severity": "warning", "path": "/World/Ball", "text": "<b>odd</b>", "fix": "", "safe": False},
    {"rule": "refract.y", "severity": "error", "path": "/World/Looks/Ball", "text": "ior is 0.5", "fix": "author 1.5",
     "safe": True},
]}  # fmt: skip
BALL = {"path": "/World/Looks/Ball", "action": "applied", "model": "sphere", "ior": 1.5, "why": "a ball", "notes": []}
CONVERTED = {"stage": "x.usda", "out": "converted.usdz", "materials": [BALL],
             "notices": [{"path": "/World", "text": "left alone"}]}  # fmt: skip
BAKED = {"stage": "x.usda", "out": "baked.usdz", "summary": "1 prims measured along normal, 1 left alone",
         "prims": [{"path": "/World/Ball", "text": "2 to 2, mean 2; constant"}],
         "notices": [{"path": "/World/Block", "text": "is open"}]}  # fmt: skip
TOOK = 1.9
"""[s] What every job says it took, whatever it did."""


def png(pixel: Any) -> bytes:
    """A WIDTH x HEIGHT RGB picture of `pixel(x, y)` -> (r, g, b)."""
    rows = b"".join(b"\0" + bytes(c for x in range(WIDTH) for c in pixel(x, y)) for y in range(HEIGHT))

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", WIDTH, HEIGHT, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def glass(name: str, model: str) -> dict[str, Any]:
    return {
        "path": f"/World/{name}", "material": f"/World/Looks/{name}", "by": "RefractMaterialAPI", "model": model,
        "ior": {"value": 1.5, "by": "constant"}, "roughness": {"value": 0.25, "by": "constant"},
        "transmittance_color": {"value": [0.5, 0.25, 1.0], "by": "constant"}, "absorption_distance": 0.75,
        "thickness": {"how": "typed", "least": 0.5, "most": 0.5},
        "closed": True, "convex": True, "size": [0.5, 0.5, 0.5], "layers": 1, "tiers": ["screen", "probe", "sky"],
        "probes": [],
    }  # fmt: skip


def facts(stage: str) -> dict[str, Any]:
    cameras = [{"path": f"/World/{name}", "used": name == "Near", "orthographic": False} for name in ("Near", "Far")]
    moves = stage.startswith("moving")
    odd = {"rule": "refract.x", "severity": "warning", "path": "/World/Ball", "text": "<b>odd</b>", "fix": ""}
    return {
        "format": "refract.inspect/1", "stage": stage, "engine": "0", "up_axis": "Y", "metres_per_unit": 1.0,
        "metres_per_unit_authored": True,
        "time": {"start": 1.0, "end": 48.0 if moves else 1.0, "authored": moves, "frames_per_second": 24.0},
        "prims": {"all": 9, "meshes": 2, "materials": 2, "lights": 1, "instances": 0, "instancers": 0},
        "settings": {"tiers": ["screen", "probe", "sky"], "max_layers": 16, "samples": 4},
        "environment": True, "glass": [glass("Ball", "sphere"), glass("Block", "box")], "probes": [], "unsupported": [],
        "cameras": cameras, "suspicious": [odd],
    }  # fmt: skip


@dataclass
class Job:
    """One render, done `seconds` after its start unless it is cancelled."""

    id: str
    settings: dict[str, Any]
    seconds: float
    started: float = field(default_factory=time.monotonic)
    cancelled: bool = False

    def document(self) -> dict[str, Any]:
        fraction = min((time.monotonic() - self.started) / max(self.seconds, 1e-6), 1.0)
        failing = self.settings.get("max_layers") == 13
        status = "cancelled" if self.cancelled else "running" if fraction < 1 else "failed" if failing else "done"
        problem = {"type": "/problems/crashed", "title": "The renderer crashed", "status": 500, "detail": "Too deep.",
                   "prim": "/World/Ball"}  # fmt: skip
        told = status == "done" and self.settings.get("samples") == 2
        warnings = [{"path": "/World/Block", "text": "drawn unrefined"}] if told else []
        whites = {"thickness": 1.24, "Z": 8.0}
        aovs = [{"name": name, "href": "", "white": whites.get(name, 1.0)} for name in self.settings["aovs"]]
        return {
            "id": self.id, "kind": "render", "status": status, "fraction": fraction, "stage_of_work": "tiles",
            "created": "", "started": "2026-01-01T00:00:00.000+00:00",
            "finished": f"2026-01-01T00:00:0{TOOK:.3f}+00:00" if status in ENDED else None, "warnings": warnings,
            "width": WIDTH, "height": HEIGHT,
            "aovs": aovs, "pictures": [], "view": VIEW if status == "done" else None,
            "problem": problem if status == "failed" else None, "links": {},
        }  # fmt: skip

    def picture(self, name: str) -> bytes:
        seed = hashlib.sha256(json.dumps(self.settings, sort_keys=True).encode()).digest()
        inside = lambda x, y: (x - 32) ** 2 + (y - 18) ** 2 < 200  # noqa: E731
        if name == "beauty":
            return png(lambda x, y: (seed[0], seed[1], seed[2]) if inside(x, y) else (x * 4, 90, y * 7))
        if name == "mask":
            return png(lambda x, y: (255,) * 3 if inside(x, y) else (0,) * 3)
        return png(lambda x, y: (x * 2,) * 3 if inside(x, y) else (0,) * 3)


class FakeService(ThreadingHTTPServer):
    """The server; `log` lists what it was asked, `jobs` what was rendered."""

    daemon_threads = True

    def __init__(self, seconds: float = 0.2, token: str = "") -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.seconds, self.token = seconds, token
        self.viewer = "a"
        """The live viewer that there is a place for; '' is none."""
        self.jobs: dict[str, Job] = {}
        self.log: list[tuple[str, str, Any]] = []
        self.thread = threading.Thread(target=self.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)

    def __enter__(self) -> FakeService:
        self.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()
        self.server_close()
        self.thread.join()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that hangs up is no news."""

    def asked(self, method: str, path: str) -> list[Any]:
        return [body for how, where, body in self.log if how == method and where.startswith(path)]


class Handler(BaseHTTPRequestHandler):
    """Answers as the API says, as far as the page needs it."""

    server: FakeService

    def log_message(self, *_: object) -> None:
        """Nothing on stderr."""

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        if path == "/":
            path = "/static/index.html"
        if path == "/static/words.js":
            return self.reply(200, pages.words().encode(), TYPES[".js"])
        if path.startswith("/static/"):
            file = STATIC / path.rpartition("/")[2]
            return self.reply(200, file.read_bytes(), TYPES[file.suffix])
        self.server.log.append(("GET", path, None))
        if self.refused():
            return None
        if path == "/v1/stages":
            return self.document(200, {"stages": STAGES})
        if path.startswith(("/v1/pictures/", "/v1/thumbnails/")):
            colour = {"/v1/pictures/ball.usda": (200, 80, 40), "/v1/thumbnails/room.usda": (40, 80, 200)}.get(path)
            if colour is None:
                return self.problem(404, "not-found", "There is nothing here", "")
            return self.reply(200, png(lambda x, y: colour), "image/png")
        if path in ("/v1/jobs/checked/file", "/v1/jobs/baked/file"):
            what = b"a converted stage" if "checked" in path else b"a baked stage"
            return self.reply(200, what, "model/vnd.usdz+zip")
        return self.job(*path.removeprefix("/v1/jobs/").split("/"))

    def live(self, settings: dict[str, Any]) -> None:
        """A new viewer, or a picture of the one there is."""
        viewer = self.server.viewer
        if not viewer:
            return self.problem(429, "queue-full", "Too many jobs are waiting", "all 2 live viewers are taken")
        if self.path == "/v1/live":
            return self.document(201, {"id": viewer})
        if self.path != f"/v1/live/{viewer}/pictures":
            return self.problem(404, "not-found", "There is nothing here", "there is no such viewer")
        return self.reply(200, Job("", settings, 0.0).picture("beauty"), "image/png")

    def do_DELETE(self) -> None:
        self.server.log.append(("DELETE", self.path, None))
        if self.path.startswith("/v1/live/"):
            return self.reply(204, b"", "")
        job = self.server.jobs[self.path.rpartition("/")[2]]
        job.cancelled = True
        self.document(200, job.document())

    def do_POST(self) -> None:
        stage, settings = self.body()
        self.server.log.append(("POST", self.path, {"stage": stage, **settings}))
        if self.refused():
            return None
        if stage.startswith("broken"):
            return self.problem(422, "stage-unreadable", "The stage cannot be opened", f"{stage} is not a USD file.")
        if self.path == "/v1/inspect":
            return self.document(200, facts(stage))
        if self.path in ("/v1/validate", "/v1/convert"):
            made = {"Content-Location": "/v1/jobs/checked"}
            return self.document(200, VERDICT if self.path == "/v1/validate" else CONVERTED, made)
        if self.path.startswith("/v1/bake-"):
            return self.document(200, BAKED, {"Content-Location": "/v1/jobs/baked"})
        if settings.get("samples", 0) > 1000:
            where = [{"pointer": "/samples", "detail": "must be at most 1000"}]
            return self.problem(422, "invalid-settings", "The settings are not valid", "One field is wrong.", where)
        if self.path.startswith("/v1/live"):
            return self.live(settings)
        if self.path == "/v1/render" and "Prefer" not in self.headers:
            time.sleep(self.server.seconds)
            return self.reply(200, Job("", settings, 0.0).picture("beauty"), "image/png")
        name = hashlib.sha256(json.dumps([stage, settings], sort_keys=True).encode()).hexdigest()
        known = self.server.jobs.get(name)
        if known is None or known.cancelled:
            self.server.jobs[name] = Job(name, settings, self.server.seconds)
        return self.document(202, self.server.jobs[name].document(), {"Location": f"/v1/jobs/{name}"})

    def body(self) -> tuple[str, dict[str, Any]]:
        raw = self.rfile.read(int(self.headers["Content-Length"]))
        kind = self.headers["Content-Type"]
        if kind == "application/json":
            settings = json.loads(raw)
            return settings.pop("stage", ""), settings
        head = f"Content-Type: {kind}\r\n\r\n".encode()
        message = email.parser.BytesParser(policy=email.policy.HTTP).parsebytes(head + raw)
        parts = {part.get_param("name", header="content-disposition"): part for part in message.iter_parts()}
        settings = json.loads(parts["settings"].get_content()) if "settings" in parts else {}
        beside = [part.get_filename() for part in message.iter_parts() if part.get_filename()][1:]
        return str(parts["stage"].get_filename()), settings | ({"beside": beside} if beside else {})

    def refused(self) -> bool:
        allowed = not self.server.token or self.headers["Authorization"] == f"Bearer {self.server.token}"
        if not allowed:
            self.problem(401, "unauthorized", "A token is needed", "Send Authorization: Bearer with a known token.")
        return not allowed

    def job(self, name: str, *rest: str) -> None:
        job = self.server.jobs.get(name)
        if job is None:
            return self.problem(404, "not-found", "There is no such job", "")
        if not rest:
            return self.document(200, job.document())
        if rest[0] == "events":
            return self.events(job)
        name = "beauty" if rest[0] == "image" else rest[1].removesuffix(".png")
        return self.reply(200, job.picture(name), "image/png")

    def events(self, job: Job) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/event-stream")
        self.end_headers()
        while True:
            document = job.document()
            event = document["status"] if document["status"] in ENDED else "progress"
            self.wfile.write(f"event: {event}\ndata: {json.dumps(document)}\n\n".encode())
            if event in ENDED:
                return
            time.sleep(0.05)

    def problem(self, status: int, slug: str, title: str, detail: str, errors: Any = None) -> None:
        body = {"type": f"/problems/{slug}", "title": title, "status": status, "detail": detail}
        self.document(status, body | ({"errors": errors} if errors else {}), kind="application/problem+json")

    def document(
        self, status: int, body: Any, headers: dict[str, str] | None = None, kind: str = "application/json"
    ) -> None:
        self.reply(status, json.dumps(body).encode(), kind, headers)

    def reply(self, status: int, body: bytes, kind: str, headers: dict[str, str] | None = None) -> None:
        self.send_response(status)
        for name, value in {"Content-Type": kind, "Content-Length": str(len(body)), **(headers or {})}.items():
            self.send_header(name, value)
        # What a careful service says of its page; the page has to work under it.
        self.send_header("Content-Security-Policy", "default-src 'self'")
        self.end_headers()
        self.wfile.write(body)
