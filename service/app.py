"""The app: `create_app(settings)` for any ASGI server; `refract serve` runs it with uvicorn."""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import shutil
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from fastapi import FastAPI, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse
from fastapi.staticfiles import StaticFiles
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.routing import Match
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from refract_core.errors import UsageError
from refract_core.verbs.executors import scheduler_of
from refract_core.version import __version__

from . import live, openapi, pages, routes, thumbnails
from .edge import Edge
from .holding import Hold
from .hosts import door
from .jobs import Jobs
from .journal import Journal
from .limits import Limits
from .metrics import CONTENT_TYPE, Metrics
from .pool import Nursery, Source
from .problems import BY_STATUS, KINDS, MEDIA_TYPE, Problem, respond
from .shortage import problem_of
from .store import Store
from .tokens import tokens_of
from .webhooks import Webhooks

log = logging.getLogger("refract.service")
_STATIC = Path(__file__).parent / "static"


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How one service is set up."""

    stage_root: str = ""
    """Folder of stages that requests may name; '' means uploads only."""
    data: str = ""
    """Folder of jobs and results; '' makes a new temporary one."""
    workers: int = 2
    """Jobs at once."""
    queue: int = 16
    """Jobs that may wait."""
    executor: str = ""
    """Address of a Dask cluster that does the jobs, `dask://HOST:PORT`; '' does them on this machine."""
    host: str = ""
    """Where it listens, `--host`; '' where another server listens for it."""
    allow_hosts: tuple[str, ...] = ()
    """Names that it answers to, beside `localhost` and `host`."""
    allow_origins: tuple[str, ...] = ()
    """Other sites whose pages may use it, such as `https://shop.example.org`."""
    proxies: tuple[str, ...] = ()
    """Addresses of reverse proxies, or networks of them, which are believed in `X-Forwarded-For`."""
    tokens: tuple[str, ...] = ()
    """Lines of a token file; every request under /v1 must bring one of the tokens. None means open to all."""
    key: str = ""
    """Signs addresses of thumbnails, and webhooks; '' means neither."""
    limits: Limits = field(default_factory=Limits)

    def __post_init__(self) -> None:
        if not 1 <= self.workers <= 256:
            raise UsageError(f"--workers is {self.workers}; it must be between 1 and 256")
        if not 0 <= self.queue <= 100_000:
            raise UsageError(f"--queue is {self.queue}; it must be between 0 and 100000")
        if self.executor:
            scheduler_of(self.executor)
        if self.stage_root and not Path(self.stage_root).is_dir():
            raise UsageError(f"--stage-root {self.stage_root}: there is no such folder")
        door(self.host, self.allow_hosts, self.allow_origins)
        for proxy in self.proxies:
            try:
                ipaddress.ip_network(proxy)
            except ValueError as error:
                raise UsageError(f"--proxy {proxy}: write an address, such as 127.0.0.1, or 10.0.0.0/8") from error
        tokens_of(self.tokens)
        if self.key and len(self.key) < 16:
            raise UsageError("the key is shorter than 16 characters; take a long random one")


def create_app(settings: Settings | None = None) -> FastAPI:
    """The service as an ASGI app.

    Raises:
        UsageError: the folder for jobs cannot be used.
    """
    settings = settings or Settings()
    metrics = Metrics()
    data = Path(settings.data or mkdtemp(prefix="refract-service-")).resolve()
    try:
        hold = Hold(data)
        store = Store(data)
    except OSError as error:
        raise UsageError(f"--data {settings.data}: cannot be used: {error.strerror}") from error
    root = Path(settings.stage_root).resolve() if settings.stage_root else None
    jobs = Jobs(
        store, settings.limits, metrics, _source(settings), workers=settings.workers, queue=settings.queue,
        stage_root=root,
    )  # fmt: skip

    viewers = live.Live(jobs)
    webhooks = Webhooks(settings.key, settings.limits.webhooks)

    @contextlib.asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        jobs.start()
        viewers.start()
        try:
            yield
        finally:
            await viewers.stop()
            await jobs.stop()
            await webhooks.stop()
            hold.release()
            if not settings.data:
                shutil.rmtree(data, ignore_errors=True)

    app = FastAPI(
        title="refract", version=__version__, docs_url=None, redoc_url=None, lifespan=lifespan,
        description="Renders USD stages with glass in them.", redirect_slashes=False,
    )  # fmt: skip
    app.state.webhooks, app.state.live = webhooks, viewers
    app.state.jobs, app.state.settings, app.state.metrics = jobs, settings, metrics
    entry = door(settings.host, settings.allow_hosts, settings.allow_origins)
    app.add_middleware(Edge, door=entry, tokens=tokens_of(settings.tokens), metrics=metrics, key=settings.key)
    app.add_middleware(Journal)
    if settings.proxies:  # around all others, so that the log too has the client
        app.add_middleware(ProxyHeadersMiddleware, trusted_hosts=list(settings.proxies))
    _add_handlers(app)
    _add_pages(app, settings, metrics)
    app.include_router(routes.router)
    app.include_router(thumbnails.router)
    app.include_router(live.router)
    openapi.describe(app, tokens=bool(settings.tokens))
    app.mount("/static/swagger", _Static(packages=[("fastapi_swagger", "resources")]), name="viewer")
    app.mount("/static", _Static(directory=_STATIC), name="static")
    return app


class _Static(StaticFiles):
    """The page's files. A browser asks each time: after an upgrade it must not mix old modules with new ones."""

    def file_response(self, *arguments: Any, **options: Any) -> Response:
        answer = super().file_response(*arguments, **options)
        answer.headers["Cache-Control"] = "no-cache"
        return answer


def _source(settings: Settings) -> Source:
    if not settings.executor:
        return Nursery()
    from .cluster import Cluster

    return Cluster(settings.executor)


def _add_handlers(app: FastAPI) -> None:
    """Every error of every layer becomes a problem document."""

    async def on_problem(request: Request, error: Exception) -> Response:
        assert isinstance(error, Problem)
        return respond(error)

    async def on_http(request: Request, error: Exception) -> Response:
        assert isinstance(error, StarletteHTTPException)
        slug = BY_STATUS.get(error.status_code, "bad-request" if error.status_code < 500 else "internal")
        headers = dict(error.headers or {})
        if error.status_code == 405:
            headers["Allow"] = ", ".join(_methods_here(request))
        return respond(Problem(slug, KINDS[slug].title, headers=headers))

    async def on_validation(request: Request, error: Exception) -> Response:
        return respond(Problem("invalid-settings", "a parameter of the path or query is not valid"))

    async def on_os_error(request: Request, error: Exception) -> Response:
        problem = problem_of(error)
        if problem is None:
            return await on_anything(request, error)
        log.warning("a request is refused: %s", error.strerror if isinstance(error, OSError) else error)
        return respond(problem)

    async def on_anything(request: Request, error: Exception) -> Response:
        identifier = getattr(request.state, "request_id", "")
        log.error("request %s failed", identifier, exc_info=error)
        return respond(Problem("internal", f"the request's id is {identifier}"))

    app.add_exception_handler(Problem, on_problem)
    app.add_exception_handler(StarletteHTTPException, on_http)
    app.add_exception_handler(HTTPException, on_http)
    app.add_exception_handler(RequestValidationError, on_validation)
    app.add_exception_handler(OSError, on_os_error)
    app.add_exception_handler(Exception, on_anything)


def _methods_here(request: Request) -> list[str]:
    """Methods of a path. Starlette names those of the first route that fits, and a path may have several."""
    # FastAPI shows a router as one, which has no methods.
    ours = [*routes.router.routes, *thumbnails.router.routes, *live.router.routes]
    known = [*request.app.routes, *ours]
    fitting = [route for route in known if route.matches(request.scope)[0] is not Match.NONE]
    return sorted({method for route in fitting for method in getattr(route, "methods", None) or ()}) or ["GET"]


def _add_pages(app: FastAPI, settings: Settings, metrics: Metrics) -> None:
    problem: Mapping[int | str, dict[str, Any]] = {503: {"description": "not ready", "content": {MEDIA_TYPE: {}}}}

    @app.get("/livez", summary="The process answers")
    async def livez() -> dict[str, str]:
        return {"status": "alive"}

    @app.get("/readyz", summary="Jobs are taken", responses=dict(problem))
    async def readyz(request: Request) -> JSONResponse:
        """Whether a worker is warm, with what confines it on this machine."""
        jobs: Jobs = request.app.state.jobs
        if jobs.draining or not jobs.source.ready.is_set():
            why = "the service is about to stop" if jobs.draining else "no worker is warm yet"
            raise Problem("unavailable", why, headers={"Retry-After": "2"})
        if not jobs.store.writable():
            raise Problem("unavailable", "the folder of jobs cannot be written", headers={"Retry-After": "30"})
        slots = {"live": jobs.slots.live, "of": jobs.slots.count}
        if not jobs.slots.live:
            raise Problem("unavailable", "no slot for jobs lives; they are started again", headers={"Retry-After": "2"})
        return JSONResponse({"status": "ready", "slots": slots, "confinement": jobs.source.report})

    @app.get("/metrics", summary="For Prometheus", response_class=Response)
    async def prometheus() -> Response:
        return Response(metrics.text(), headers={"Content-Type": CONTENT_TYPE})

    @app.get("/docs", include_in_schema=False)
    async def docs() -> HTMLResponse:
        return HTMLResponse(pages.docs_page(app.openapi(), settings.limits))

    @app.get("/problems/{slug}", include_in_schema=False)
    async def about_problem(slug: str) -> HTMLResponse:
        if slug not in KINDS:
            raise Problem("not-found", "there is no such type of problem")
        return HTMLResponse(pages.problem_page(slug))

    @app.get("/static/words.js", include_in_schema=False)
    async def words() -> Response:
        return Response(pages.words(), media_type="text/javascript", headers={"Cache-Control": "no-cache"})

    @app.get("/", include_in_schema=False)
    async def front() -> HTMLResponse:
        page = _STATIC / "index.html"
        if not page.is_file():
            raise Problem("not-found", "the page is not installed")
        return HTMLResponse(page.read_text("utf-8"))
