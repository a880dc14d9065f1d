"""The queue: requests become jobs, equal requests the same job, and each job gets a worker of its own."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import os
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from . import quota, reading
from .bodies import own_stage
from .digests import file_digest, identifier_of, tree_digest
from .discreet import own_folders, without_folders
from .limits import Limits
from .metrics import Metrics
from .pool import Source, Worker
from .problems import KINDS, Problem
from .shares import NOBODY, Client, Shares
from .shortage import problem_of
from .slots import Ready, Slots
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


class _View(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
    camera: Annotated[str, Field(max_length=1024)]
    azimuth: float
    elevation: float
    distance: float
    look_at: Annotated[list[float], Field(min_length=3, max_length=3)]
    width: float
    orthographic: bool


class _Done(BaseModel):
    """What a worker may say at its end. It has read a stranger's file, so it is not believed blindly."""

    model_config = ConfigDict(strict=True, extra="forbid")
    width: int | None = None
    height: int | None = None
    aovs: list[_Plane] = []
    pictures: list[_Picture] = []
    view: _View | None = None


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
        self.shares = Shares(limits, workers, queue)
        self._active: set[str] = set()
        self._line = self.shares.line
        self._given: dict[int, Worker] = {}
        """By `id` of the record: one that was cancelled and asked for again has two for a moment."""
        self._running: set[int] = set()
        self._waiters: Counter[str] = Counter()
        self._kept: set[str] = set()
        self._news: dict[str, asyncio.Event] = {}
        self._tasks: list[asyncio.Task[None]] = []
        self._hidden = {*own_folders(), str(store.jobs.parent), *([str(stage_root)] if stage_root else ())}
        self.slots = Slots(workers, self._one, metrics)
        self._unsaved: set[str] = set()
        """Jobs whose end could not be written down yet."""

    # --- life -------------------------------------------------------------------------------------------------------

    def start(self) -> None:
        self.source.start()
        self._tasks = [*self.slots.start(), asyncio.create_task(self._sweep()), asyncio.create_task(self._resume())]

    async def stop(self) -> None:
        """Let what is under way finish, for a while. What still waits then and is kept waits for the next start."""
        self.draining = True
        deadline = time.monotonic() + self.limits.drain_seconds
        while self._active and time.monotonic() < deadline:
            await asyncio.sleep(0.05)
        for record in [self.records[identifier] for identifier in self._active]:
            if not (record.kept and record.status == "queued"):
                self._end(record, "failed", Problem("interrupted", "the service was stopped"))
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self.source.stop()

    async def _resume(self) -> None:
        """Queue what waited when the service ended, unless it would not be the same job any more."""
        for record in [one for one in self.records.values() if one.status == "queued" and one.id not in self._active]:
            try:
                same = await asyncio.to_thread(self._identity_now, record) == record.id
            except (OSError, Problem):  # the stage is gone, or half of it is
                same = False
            if record.ended:
                continue
            self._active.add(record.id)
            if not same:
                text = "the service ended while the job was waiting, and its stage is not there any more"
                self._end(record, "failed", Problem("interrupted", text))
                continue
            record.created = now()  # the time it may wait begins anew
            self._kept.add(record.id)
            self._count()
            self.shares.enter(record, Client("", record.owner))

    def _identity_now(self, record: Record) -> str:
        """What the id of a job would be if it came in now."""
        if record.uploaded:
            digest = file_digest(self.store.folder(record.id) / record.stage)
        else:
            if self.stage_root is None or own_stage(self.stage_root, record.stage) != record.stage:
                return ""
            digest = tree_digest(self.stage_root, record.stage)
        return identifier_of(record.kind, record.settings, digest, record.owner)

    # --- in ---------------------------------------------------------------------------------------------------------

    def check_open(self) -> None:
        """Raises Problem where nothing new is taken any more."""
        if self.draining:
            raise Problem("unavailable", "the service is about to stop", headers={"Retry-After": "10"})

    @contextlib.contextmanager
    def arriving(self, client: Client) -> Iterator[None]:
        """While a request's body arrives, which takes no place in the queue yet. Raises Problem."""
        self.check_open()
        with self.shares.bodies.one(client, "bodies that may arrive"):
            yield

    def submit(
        self, kind: str, settings: dict[str, Any], digest: str, stage: str, upload: Path | None,
        client: Client = NOBODY,
    ) -> Record:  # fmt: skip
        """The job of a request: a new one, or the one that is already there, which takes no further place.

        Args:
            digest: of all the stage is made of.
            stage: path under the stage root, or the name the uploaded file shall have.
            upload: the uploaded file, which is moved; None for a stage of ours.

        Raises:
            Problem: there is no place for another job, or not for this client.
        """
        identifier = identifier_of(kind, settings, digest, client.owner)
        known = self.records.get(identifier)
        if known and known.status in ("queued", "running", "done"):
            self.metrics.cached.inc()
            return known
        self.shares.check(client)
        self.store.remove(identifier)
        record = Record(identifier, kind, settings, stage, upload is not None, owner=client.owner)
        try:
            self.store.save(record)
            if upload:
                os.replace(upload, self.store.folder(identifier) / stage)
        except OSError:
            self.store.remove(identifier)
            raise
        self._kept.discard(identifier)
        self.records[identifier] = record
        self._active.add(identifier)
        self._count()
        self.shares.enter(record, client)
        return record

    # --- listening --------------------------------------------------------------------------------------------------

    def keep(self, record: Record) -> None:
        """Finish this job even if nobody waits for it, and after a restart of the service if need be."""
        self._kept.add(record.id)
        if not record.kept and record.status == "queued":
            record.kept = True
            with contextlib.suppress(OSError):  # of a full disk: after a restart it is told as interrupted
                self.store.save(record)

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

    async def _one(self, ready: Ready) -> None:
        """One job, by a worker that is made before there is a job for it."""
        worker = await self.source.fork()
        try:
            work = self.store.new_work()
        except BaseException:
            await self._dismiss(worker)
            raise
        ready()
        record = None
        try:
            while record is None or record.ended:
                record = self.records.get(await self._line.get())
            worker = await self._begin(record, worker, work)
            await self._run(record, worker, work)
        except Exception as error:
            log.exception("a job failed in the server")
            if record is not None and not record.ended:
                problem = problem_of(error) or Problem("internal", "the service could not do this job")
                self._end(record, "failed", problem)
        finally:
            if record is not None:
                worker = self._given.pop(id(record), worker)
            try:
                await self._dismiss(worker)
            finally:
                self.store.drop_work(work)

    async def _dismiss(self, worker: Worker) -> None:
        try:
            await self.source.kill(worker)
        finally:
            worker.close()

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
        wait = 0.0
        while True:
            self._given[id(record)] = worker
            with contextlib.suppress(ConnectionError):
                await worker.give(order)
                if await worker.hear() == {"began": True} or record.ended:
                    return worker
            await self._dismiss(worker)
            await asyncio.sleep(wait)
            wait = min(2 * wait + 0.05, 2.0)
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
        self.shares.began(record)
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
        self.metrics.worked.labels(record.kind).observe(seconds)
        if problem is None:
            self.store.take_results(work, record)
            if not (self.store.folder(record.id) / record.outcome()).is_file():
                problem = self._fault(record, work, "the program said it was done, and made nothing")
        self._end(record, "failed" if problem else "done", problem)

    async def _listen(self, record: Record, worker: Worker, work: Path) -> Problem | None:
        """Follow a worker to its end."""
        done: dict[str, Any] | None = None
        while message := await worker.hear():
            if "problem" in message:
                return self._problem_of(record, message["problem"], work)
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

    def _discreet(self, text: Any) -> str:
        return without_folders(str(text)[:10_000], self._hidden)

    def problem_of(self, message: Any) -> Problem:
        """A worker's own words, for strangers."""
        return _problem_of(message, self._discreet)

    def _problem_of(self, record: Record, message: Any, work: Path) -> Problem:
        """A worker's own words, with what only the server can know about them."""
        problem = _problem_of(message, self._discreet)
        if problem.slug == "worker-fault":
            return self._fault(record, work, problem.detail)
        if problem.slug == "no-space" and self.store.free() > self.limits.result_bytes:
            return Problem("limit-exceeded", "the files of the job are larger than this service allows")
        return problem

    def _fault(self, record: Record, work: Path, text: str) -> Problem:
        self.metrics.faults.inc()
        log.error("job %s: a fault of this program\n%s", record.id, _last_words(work))
        return Problem("worker-fault", text)

    def _progress(self, record: Record, message: dict[str, Any]) -> None:
        if isinstance(message.get("progress"), int | float) and math.isfinite(message["progress"]):
            fraction = round(min(max(float(message["progress"]), record.fraction), 1.0), 4)
            step = (fraction, self._discreet(message.get("stage", ""))[:200])
            if step[1] == record.stage_of_work and fraction - record.fraction < 0.01:
                return
            record.fraction, record.stage_of_work = step
        elif "warning" in message and len(record.warnings) < self.limits.warnings:
            path, text = (self._discreet(message.get(name))[:500] for name in ("path", "warning"))
            record.warnings.append({"path": path, "text": text})
        self._tell(record)

    def _end(self, record: Record, status: str, problem: Problem | None) -> None:
        record.status, record.finished = status, now()
        record.problem = problem.document(f"/v1/jobs/{record.id}") if problem else None
        record.stage_of_work = status
        if status == "done":
            record.fraction = 1.0
        self._active.discard(record.id)
        self.shares.ended(record)
        self._count()
        self.metrics.jobs.labels(record.kind, problem.slug if problem else status).inc()
        self._unsaved.add(record.id)
        self._save_ends()
        self._tell(record)

    def _save_ends(self) -> None:
        """Write down how jobs ended; where the disk is full, when there is room again."""
        for identifier in list(self._unsaved):
            with contextlib.suppress(OSError):
                record = self.records.get(identifier)
                if record is not None and record.ended:
                    self.store.drop_stage(record)
                    self.store.save(record)
                self._unsaved.discard(identifier)

    def _count(self) -> None:
        self.metrics.running.set(len(self._running))
        self.metrics.queued.set(max(0, len(self._active) - len(self._running)))

    # --- retention --------------------------------------------------------------------------------------------------

    async def _sweep(self) -> None:
        while True:
            await asyncio.sleep(_SWEEP)
            try:
                self.sweep()
            except Exception:  # the next round may do better; without any, the disk would fill
                log.exception("old jobs could not be removed")

    def sweep(self) -> None:
        """End jobs that have waited too long; remove results that are too old, or too much."""
        with contextlib.suppress(OSError):  # the rest of this makes room
            self.store.drop_leavings()
        self._save_ends()
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


def _problem_of(message: Any, discreet: Callable[[Any], str]) -> Problem:
    """A worker's own words, if they are in order."""
    if isinstance(message, dict) and message.get("slug") in KINDS and isinstance(message.get("detail"), str):
        errors = [
            {"pointer": discreet(one.get("pointer"))[:1100], "detail": discreet(one.get("detail"))[:500]}
            for one in message.get("errors") or [] if isinstance(one, dict)
        ]  # fmt: skip
        return Problem(message["slug"], discreet(message["detail"])[:1000], errors=errors[:20],
                       prim=discreet(message.get("prim") or "")[:1024])  # fmt: skip
    return Problem("stage-crashed", "the worker ended without an answer")


def _last_words(work: Path) -> str:
    with contextlib.suppress(OSError):
        return (work / "worker.log").read_text("utf-8", "replace")[-4000:]
    return ""


def _crash_of(record: Record, code: int, work: Path) -> Problem:
    """What the end of a worker means to the client; its last words are for the log alone."""
    said = _last_words(work)
    log.warning("job %s: worker ended with %d\n%s", record.id, code, said)
    if code == reading.TOO_LONG:
        text = "opening and reading the stage took longer than this service allows (stage_seconds)"
        return Problem("time-limit", text)
    if code == -9 and quota.WORDS in said:
        return Problem("limit-exceeded", f"the job was stopped: {quota.WORDS} (folder_bytes, folder_files)")
    if code in (-24, -25) or (code == -9 and "CPU" in said):
        return Problem("time-limit", "the job used more processor time than this service allows")
    if "bad_alloc" in said or "MemoryError" in said or "Cannot allocate memory" in said:
        return Problem("memory-limit", "the job ran out of memory")
    how = f"signal {-code}" if code < 0 else f"code {code}"
    return Problem("stage-crashed", f"the worker that read the stage ended with {how}")
