"""The queue: requests become jobs, equal requests the same job, and each job gets a worker of its own."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import os
import time
from collections import Counter
from collections.abc import AsyncIterator, Iterator
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from .digests import identifier_of
from .limits import Limits
from .metrics import Metrics
from .pool import Source, Worker
from .problems import KINDS, Problem
from .store import Record, Store, now

log = logging.getLogger("refract.service")
_SWEEP = 10.0  # [s]


class _Plane(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
    name: str
    white: float


class _Picture(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
    width: int
    height: int
    time_code: float


class _Done(BaseModel):
    """What a worker may say at its end. It has read a stranger's file, so it is not believed blindly."""

    model_config = ConfigDict(strict=True, extra="forbid")
    width: int | None = None
    height: int | None = None
    aovs: list[_Plane] = []
    pictures: list[_Picture] = []


class Jobs:
    """All jobs of one app."""

    def __init__(
        self, store: Store, limits: Limits, metrics: Metrics, source: Source, *, workers: int, queue: int,
        stage_root: Path | None,
    ) -> None:  # fmt: skip
        """
        Args:
            source: of workers.
            workers: jobs at once.
            queue: jobs that may wait.
        """
        self.store, self.limits, self.metrics, self.source = store, limits, metrics, source
        self.workers, self.places, self.stage_root = workers, workers + queue, stage_root
        self.records = store.load_all()
        self.draining = False
        self.streams = 0
        self._held = 0
        self._active: set[str] = set()
        self._line: asyncio.Queue[str] = asyncio.Queue()
        self._given: dict[int, Worker] = {}
        """By `id` of the record: one that was cancelled and asked for again has two for a moment."""
        self._running: set[int] = set()
        self._waiters: Counter[str] = Counter()
        self._kept: set[str] = set()
        self._news: dict[str, asyncio.Event] = {}
        self._tasks: list[asyncio.Task[None]] = []
        self._usual = 1.0

    # --- life -------------------------------------------------------------------------------------------------------

    def start(self) -> None:
        self.source.start()
        self._tasks = [asyncio.create_task(self._slot()) for _ in range(self.workers)]
        self._tasks.append(asyncio.create_task(self._sweep()))

    async def stop(self) -> None:
        """Let what is under way finish, for a while."""
        self.draining = True
        deadline = time.monotonic() + self.limits.drain_seconds
        while self._active and time.monotonic() < deadline:
            await asyncio.sleep(0.05)
        for identifier in list(self._active):
            self._end(self.records[identifier], "failed", Problem("interrupted", "the service was stopped"))
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self.source.stop()

    # --- in ---------------------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def place(self) -> Iterator[None]:
        """Hold a place in the queue while a request's body arrives. Raises Problem where there is none."""
        if self.draining:
            raise Problem("unavailable", "the service is about to stop", headers={"Retry-After": "10"})
        if len(self._active) + self._held >= self.places:
            wait = max(1, min(60, math.ceil(self._usual * len(self._active) / self.workers)))
            text = f"{len(self._active)} jobs are waiting or running"
            raise Problem("queue-full", text, headers={"Retry-After": str(wait)})
        self._held += 1
        try:
            yield
        finally:
            self._held -= 1

    def submit(self, kind: str, settings: dict[str, Any], digest: str, stage: str, upload: Path | None) -> Record:
        """The job of a request: a new one, or the one that is already there.

        Args:
            digest: of all the stage is made of.
            stage: path under the stage root, or the name the uploaded file shall have.
            upload: the uploaded file, which is moved; None for a stage of ours.
        """
        identifier = identifier_of(kind, settings, digest)
        known = self.records.get(identifier)
        if known and known.status in ("queued", "running", "done"):
            self.metrics.cached.inc()
            return known
        self.store.remove(identifier)
        record = Record(identifier, kind, settings, stage, upload is not None)
        self.store.save(record)
        if upload:
            os.replace(upload, self.store.folder(identifier) / stage)
        self._kept.discard(identifier)
        self.records[identifier] = record
        self._active.add(identifier)
        self._count()
        self._line.put_nowait(identifier)
        return record

    # --- listening --------------------------------------------------------------------------------------------------

    def keep(self, record: Record) -> None:
        """Finish this job even if nobody waits for it."""
        self._kept.add(record.id)

    @contextlib.asynccontextmanager
    async def waiting(self, record: Record) -> AsyncIterator[None]:
        """Count as one who waits; a job nobody waits for any more is cancelled, unless it is kept."""
        self._waiters[record.id] += 1
        try:
            yield
        finally:
            self._waiters[record.id] -= 1
            if not self._waiters[record.id]:
                del self._waiters[record.id]
                if record.id not in self._kept and not record.ended:
                    log.info("job %s: nobody waits for it any more", record.id)
                    await self.cancel(record)

    async def news(self, record: Record) -> None:
        """Returns when something about the job has changed."""
        if not record.ended:
            await self._news.setdefault(record.id, asyncio.Event()).wait()

    async def ended(self, record: Record) -> None:
        while not record.ended:
            await self.news(record)

    def _tell(self, record: Record) -> None:
        if event := self._news.pop(record.id, None):
            event.set()

    async def cancel(self, record: Record) -> None:
        """Stop a job for real; what has ended stays as it is."""
        if record.ended:
            return
        self._end(record, "cancelled", Problem("cancelled", "the job was cancelled"))
        if worker := self._given.get(id(record)):
            await self.source.kill(worker)

    # --- work -------------------------------------------------------------------------------------------------------

    async def _slot(self) -> None:
        """One worker after the other, each made before there is a job for it."""
        while True:
            worker, work = await self.source.fork(), self.store.new_work()
            record = None
            try:
                while record is None or record.ended:
                    record = self.records.get(await self._line.get())
                worker = await self._begin(record, worker, work)
                await self._run(record, worker, work)
            except Exception:
                log.exception("a job failed in the server")
                if record is not None and not record.ended:
                    self._end(record, "failed", Problem("internal", "the service could not do this job"))
            finally:
                if record is not None:
                    self._given.pop(id(record), None)
                await self.source.kill(worker)
                worker.close()
                self.store.drop_work(work)

    async def _begin(self, record: Record, worker: Worker, work: Path) -> Worker:
        """Give a job to a worker; to another one where it ended while it waited, which is not the job's fault."""
        root = self.stage_root
        if record.uploaded:
            root = work / "in"
            os.replace(self.store.folder(record.id) / record.stage, root / record.stage)
        threads = max(1, (os.cpu_count() or 1) // self.workers)
        order = {
            "kind": record.kind, "stage": record.stage, "root": str(root), "folder": str(work),
            "settings": {**record.settings, "threads": threads}, "limits": asdict(self.limits),
        }  # fmt: skip
        while True:
            self._given[id(record)] = worker
            with contextlib.suppress(ConnectionError):
                await worker.give(order)
                if await worker.hear() == {"began": True} or record.ended:
                    return worker
            worker.close()
            worker = await self.source.fork()

    async def _run(self, record: Record, worker: Worker, work: Path) -> None:
        if record.ended:
            return
        started = time.monotonic()
        waited = datetime.now(UTC) - datetime.fromisoformat(record.created)
        self.metrics.waited.observe(waited.total_seconds())
        record.status, record.started, record.stage_of_work = "running", now(), "starting"
        self.store.save(record)
        self._running.add(id(record))
        self._count()
        self._tell(record)
        problem: Problem | None = None
        try:
            async with asyncio.timeout(self.limits.job_seconds):
                problem = await self._listen(record, worker, work)
        except TimeoutError:
            await self.source.kill(worker)
            problem = Problem("time-limit", f"the job was stopped after {self.limits.job_seconds} s")
        finally:
            self._running.discard(id(record))
            self._count()
        if record.ended:
            return
        seconds = time.monotonic() - started
        self._usual = 0.8 * self._usual + 0.2 * seconds
        self.metrics.worked.labels(record.kind).observe(seconds)
        if problem is None:
            self.store.take_results(work, record)
            self._end(record, "done", None)
        else:
            self._end(record, "failed", problem)

    async def _listen(self, record: Record, worker: Worker, work: Path) -> Problem | None:
        """Follow a worker to its end."""
        done: dict[str, Any] | None = None
        while message := await worker.hear():
            if "problem" in message:
                return _problem_of(message["problem"])
            if "done" in message:
                done = message["done"]
                break
            self._progress(record, message)
        if done is not None:
            try:
                record.result = _Done.model_validate(done).model_dump(exclude_none=True)
                return None
            except ValidationError:
                pass
        await self.source.kill(worker)
        code = await worker.code
        if record.ended:  # cancelled, which is why
            return None
        if worker.lost:
            return Problem("interrupted", "the service had to start its workers anew")
        self.metrics.crashes.inc()
        return _crash_of(record, code, work)

    def _progress(self, record: Record, message: dict[str, Any]) -> None:
        if isinstance(message.get("progress"), int | float) and math.isfinite(message["progress"]):
            fraction = round(min(max(float(message["progress"]), record.fraction), 1.0), 4)
            step = (fraction, str(message.get("stage", ""))[:200])
            if step[1] == record.stage_of_work and fraction - record.fraction < 0.01:
                return
            record.fraction, record.stage_of_work = step
        elif "warning" in message and len(record.warnings) < self.limits.warnings:
            record.warnings.append({"path": str(message.get("path"))[:500], "text": str(message["warning"])[:500]})
        self._tell(record)

    def _end(self, record: Record, status: str, problem: Problem | None) -> None:
        record.status, record.finished = status, now()
        record.problem = problem.document(f"/v1/jobs/{record.id}") if problem else None
        record.stage_of_work = status
        if status == "done":
            record.fraction = 1.0
        self._active.discard(record.id)
        self._count()
        self.metrics.jobs.labels(record.kind, problem.slug if problem else status).inc()
        with contextlib.suppress(OSError):
            self.store.drop_stage(record)
            self.store.save(record)
        self._tell(record)

    def _count(self) -> None:
        self.metrics.running.set(len(self._running))
        self.metrics.queued.set(max(0, len(self._active) - len(self._running)))

    # --- retention --------------------------------------------------------------------------------------------------

    async def _sweep(self) -> None:
        while True:
            await asyncio.sleep(_SWEEP)
            try:
                self.sweep()
            except OSError:
                log.exception("old jobs could not be removed")

    def sweep(self) -> None:
        """End jobs that have waited too long; remove results that are too old, or too much."""
        longest = timedelta(seconds=self.limits.queue_seconds)
        for identifier in list(self._active):
            record = self.records[identifier]
            if record.status == "queued" and datetime.now(UTC) - datetime.fromisoformat(record.created) > longest:
                text = f"no worker was free within {self.limits.queue_seconds} s"
                self._end(record, "failed", Problem("unavailable", text))
        ended = sorted((r for r in self.records.values() if r.ended), key=lambda r: r.finished or "", reverse=True)
        oldest = (datetime.now(UTC) - timedelta(seconds=self.limits.retention_seconds)).isoformat()
        total = 0
        for record in ended:
            with contextlib.suppress(FileNotFoundError):
                total += self.store.size(record.id)
            if (record.finished or "") < oldest or total > self.limits.retention_bytes:
                self.store.remove(record.id)
                self.records.pop(record.id, None)
                self._kept.discard(record.id)


def _problem_of(message: Any) -> Problem:
    """A worker's own words, if they are in order."""
    if isinstance(message, dict) and message.get("slug") in KINDS and isinstance(message.get("detail"), str):
        errors = [
            {"pointer": str(one.get("pointer"))[:1100], "detail": str(one.get("detail"))[:500]}
            for one in message.get("errors") or [] if isinstance(one, dict)
        ]  # fmt: skip
        return Problem(message["slug"], message["detail"][:1000], errors=errors[:20],
                       prim=str(message.get("prim") or "")[:1024])  # fmt: skip
    return Problem("stage-crashed", "the worker ended without an answer")


def _crash_of(record: Record, code: int, work: Path) -> Problem:
    """What the end of a worker means to the client; its last words are for the log alone."""
    said = ""
    with contextlib.suppress(OSError):
        said = (work / "worker.log").read_text("utf-8", "replace")[-4000:]
    log.warning("job %s: worker ended with %d\n%s", record.id, code, said)
    if code in (-24, -25) or (code == -9 and "CPU" in said):
        return Problem("time-limit", "the job used more processor time than this service allows")
    if "bad_alloc" in said or "MemoryError" in said or "Cannot allocate memory" in said:
        return Problem("memory-limit", "the job ran out of memory")
    how = f"signal {-code}" if code < 0 else f"code {code}"
    return Problem("stage-crashed", f"the worker that read the stage ended with {how}")
