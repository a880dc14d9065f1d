"""Workers on a Dask cluster, where `pool.Nursery` has them on this machine. The service says what, Dask says where.

A job travels with its stage: by path where a worker finds the same files under the same stage root, else the files
themselves, once for all jobs that need them. What it makes comes back with its result. See `cluster_worker`.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import logging
import secrets
import time
import warnings
from collections import OrderedDict
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

from refract_core.errors import RefractError
from refract_core.verbs.executors import CONNECT_SECONDS, nobody_at, scheduler_of, silent

from . import cluster_worker
from .cluster_worker import Ended, Order
from .digests import engine, file_digest, tree_digest
from .gather import files_of
from .pool import Worker
from .problems import Problem
from .store import RESULTS

log = logging.getLogger("refract.service")
_AGAIN = 5.0  # [s] between attempts to reach the scheduler
_LOOK = 0.5  # [s] between looks at who has joined
_SILENCE = 10.0
"""[s] Who says nothing for so long, a scheduler or a worker, is taken for cut off until it speaks again."""
_PULSE = 2.0  # [s] between questions to a worker
_KEPT = 4
"""Stages kept on the cluster for jobs to come."""
_KNOWN_STAGES = 64


class _Silent(Exception):
    """The worker that has a job does not answer any more; others do."""


class Remote:
    """A job's way to the cluster and back."""

    def __init__(self, cluster: Cluster, client: Any) -> None:
        self.cluster, self.client, self.token = cluster, client, secrets.token_hex(8)
        self.code: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self.lost = False
        self.future: Any = None
        self.among: frozenset[str] = frozenset()
        """Workers one of which must do it; none means any."""
        self.move = asyncio.Event()
        """It is to be done by another worker."""
        self.messages: asyncio.Queue[dict[str, Any] | None] = asyncio.Queue()
        self._way: asyncio.Task[None] | None = None

    async def give(self, job: dict[str, Any]) -> None:
        if self.client.status != "running":
            raise ConnectionError("the scheduler is gone")
        self._way = asyncio.create_task(self._go(job))

    async def hear(self) -> dict[str, Any] | None:
        return await self.messages.get()

    def close(self) -> None:
        self.cluster.forget(self)
        if self._way:
            self._way.cancel()

    async def _go(self, job: dict[str, Any]) -> None:
        """Send a job, wait for its end, and leave all as a worker of this machine would leave it."""
        last: dict[str, Any] | None = None
        code = -9
        try:
            ended = await self.cluster.send(self, job)
            last, code = ended.message, ended.code
            await asyncio.to_thread(_leave, ended, Path(job["folder"]))
        except Problem as problem:
            last = {"problem": {"slug": problem.slug, "detail": problem.detail}}
        except CancelledError:  # by us, or with the scheduler
            self.lost = True
        except Exception as error:
            last = _trouble(error)
        finally:
            for message in ({"began": True}, last):  # the first may have been lost on its way
                self.messages.put_nowait(message)
            if not self.code.done():
                self.code.set_result(code)


class Cluster:
    """A Dask cluster, found again when it was lost."""

    def __init__(self, address: str) -> None:
        self.address = address
        self.ready = asyncio.Event()
        self._reports: dict[str, dict[str, Any]] = {}
        """By address of the Dask worker, of those that answer."""
        self._heard = 0.0
        """When the scheduler answered last, by `time.monotonic`."""
        self._silent: set[str] = set()
        """Workers that do not answer, while the scheduler does and still counts on them."""
        self._topic = f"refract-{secrets.token_hex(8)}"
        self._remotes: dict[str, Remote] = {}
        self._content: OrderedDict[str, Any] = OrderedDict()
        self._known: OrderedDict[tuple[str, str, str], tuple[str, ...]] = OrderedDict()
        self._client: Any = None
        self._task: asyncio.Task[None] | None = None
        self._over = False

    @property
    def report(self) -> dict[str, Any]:
        """The weakest of all machines."""
        reports = list(self._reports.values())
        weakest = {name: min(one.get(name, 0) for one in reports) for name in (reports[0] if reports else ())}
        return {"executor": self.address, "cluster_workers": len(reports), **weakest}

    def start(self) -> None:
        self._task = asyncio.create_task(self._keep())

    async def stop(self) -> None:
        self._over = True
        if self._task:
            self._task.cancel()
            await asyncio.wait({self._task}, timeout=_SILENCE)  # a scheduler that hangs must not keep us

    async def fork(self) -> Remote:
        await self.ready.wait()
        remote = Remote(self, self._client)
        self._remotes[remote.token] = remote
        return remote

    async def kill(self, worker: Worker) -> None:
        assert isinstance(worker, Remote)
        if worker.future is not None and not worker.code.done():
            with contextlib.suppress(OSError):
                await worker.future.cancel(force=True)

    def forget(self, remote: Remote) -> None:
        self._remotes.pop(remote.token, None)

    # --- the connection

    async def _keep(self) -> None:
        said = ""
        while not self._over:
            try:
                with silent("distributed.client"):
                    await self._meet()
                trouble = f"--executor {self.address}: the scheduler has gone away"
            except OSError:
                trouble = nobody_at(self.address)
            if self._over:  # Dask may make an error of the cancellation
                return
            if trouble != said:
                log.warning("%s; trying again every %.0f s", trouble, _AGAIN)
                said = trouble
            await asyncio.sleep(_AGAIN)

    async def _meet(self) -> None:
        """From the first word with a scheduler to the last."""
        from distributed import Client

        async with Client(
            scheduler_of(self.address), asynchronous=True, timeout=CONNECT_SECONDS, set_as_default=False
        ) as client:
            attended: dict[str, asyncio.Task[None]] = {}
            try:
                client.subscribe_topic(self._topic, self._hear)
                self._client = client
                while client.status == "running":
                    try:
                        async with asyncio.timeout(_SILENCE):
                            await self._look(client, attended)
                    except TimeoutError:  # a pause of the network; what runs is left alone, for it may pass
                        if self.ready.is_set():
                            log.warning("--executor %s: the scheduler does not answer", self.address)
                        self.ready.clear()
                    await asyncio.sleep(_LOOK)
            finally:
                for task in attended.values():
                    task.cancel()
                self.ready.clear()
                self._reports.clear()
                self._silent.clear()
                self._content.clear()

    async def _look(self, client: Any, attended: dict[str, asyncio.Task[None]]) -> None:
        """Who is there, who does not answer, and whose jobs are to be done by others."""
        there = set(await client.nthreads())
        self._heard = time.monotonic()
        for address in there - attended.keys():
            attended[address] = asyncio.create_task(self._attend(client, address))
        for address in attended.keys() - there:
            attended.pop(address).cancel()
            self._reports.pop(address, None)
            self._silent.discard(address)
        stuck: set[str] = set()
        if self._silent:
            held = await client.processing(list(self._silent))
            stuck = {str(key) for keys in held.values() for key in keys}
        live = self._reports.keys()
        for remote in self._remotes.values():
            if live and remote.future is not None:
                nobody = bool(remote.among) and not remote.among & live
                if nobody or remote.future.key in stuck:
                    remote.move.set()
        if live:
            self.ready.set()
        else:
            self.ready.clear()

    async def _attend(self, client: Any, address: str) -> None:
        """Make one of the cluster's workers warm, and see whether it answers, for as long as it is there."""
        report = await self._greet(client, address)
        while report is not None:
            asked = time.monotonic()
            answer = asyncio.create_task(client.run(cluster_worker.answer, workers=[address], on_error="return"))
            try:
                await asyncio.wait({answer}, timeout=_SILENCE)
                self._judge(address, report, asked, answer)
            finally:
                answer.cancel()
            await asyncio.sleep(_PULSE)

    def _judge(self, address: str, report: dict[str, Any], asked: float, answer: asyncio.Task[Any]) -> None:
        """Whether a worker takes part, by its answer, if there is one yet."""
        if answer.done():
            if not answer.exception() and answer.result().get(address) is True:  # else the scheduler will tell
                if address in self._silent:
                    log.info("worker %s of the cluster answers again", address)
                self._silent.discard(address)
                self._reports[address] = report
        elif self._heard > asked + _SILENCE / 2 and address not in self._silent:  # else it is the scheduler
            log.warning("worker %s of the cluster does not answer; others do its jobs", address)
            self._silent.add(address)
            self._reports.pop(address, None)

    async def _greet(self, client: Any, address: str) -> dict[str, Any] | None:
        """Returns what confines processes there; None where it takes no jobs, which is told."""
        try:
            greeted = await client.run(cluster_worker.greet, workers=[address])
            version, report = greeted[address]
        except Exception as error:
            log.warning("worker %s of the cluster takes no jobs: %s", address, _reason(error))
            return None
        if version != engine():
            log.warning("worker %s of the cluster has refract %s, not %s; install the same", address, version, engine())
            return None
        self._reports[address] = report
        log.info("worker %s of the cluster is ready", address)
        return dict(report)

    def _hear(self, event: tuple[float, Any]) -> None:
        """A message of a job, by way of the scheduler."""
        said = event[1]
        if isinstance(said, dict) and (remote := self._remotes.get(str(said.get("token")))):
            message = said.get("message")
            if isinstance(message, dict):
                remote.messages.put_nowait(message)

    # --- a job

    async def send(self, remote: Remote, job: dict[str, Any]) -> Ended:
        """Have a job done.

        Raises:
            Problem: the files of the stage cannot be told.
            RefractError: no worker can do it.
        """
        while True:
            try:
                return await self._try(remote, job)
            except _Silent:
                log.warning("a job is given to another worker of the cluster, since its own does not answer")
                self._content.clear()  # it may have been there

    async def _try(self, remote: Remote, job: dict[str, Any]) -> Ended:
        root, stage = Path(job["root"]), job["stage"]
        uploaded = root.parent == Path(job["folder"])
        paths = (stage,) if uploaded else await self._files_of(root, job)
        files = await asyncio.to_thread(_hashed, root, paths)
        travels = {name: job[name] for name in ("kind", "stage", "settings", "limits")}
        order = Order(self._topic, remote.token, travels, "" if uploaded else str(root), files, engine())
        ended = None if uploaded else await self._submit(remote, order, self._content.get(_key(order)))
        if ended is None:
            content = await self._shared(remote.client, root, order)
            if not uploaded:  # of a client's stage, nothing stays
                self._keep_content(_key(order), content)
            ended = await self._submit(remote, order, content)
        if ended is None:
            raise RefractError("the stage did not arrive")
        return ended

    async def _submit(self, remote: Remote, order: Order, content: Any) -> Ended | None:
        """Raises _Silent."""
        remote.among = frozenset(self._reports if self._silent else ())
        remote.move.clear()
        remote.future = remote.client.submit(
            cluster_worker.perform, order, content, pure=False, key=f"refract-job-{secrets.token_hex(8)}",
            workers=sorted(remote.among) or None,
        )  # fmt: skip
        result = asyncio.ensure_future(_result_of(remote.future))
        moved = asyncio.create_task(remote.move.wait())
        try:
            await asyncio.wait({result, moved}, return_when=asyncio.FIRST_COMPLETED)
            if result.done():
                return result.result()
            await remote.future.cancel(force=True)
            raise _Silent
        finally:
            result.cancel()
            moved.cancel()

    async def _files_of(self, root: Path, job: dict[str, Any]) -> tuple[str, ...]:
        """Paths of all a stage under the stage root is made of, looked up once for each state of that folder."""
        digest = await asyncio.to_thread(tree_digest, root, job["stage"])
        key = (str(root), job["stage"], digest)
        if key not in self._known:
            self._known[key] = tuple(await files_of(str(root), job["stage"], job["limits"]))
            while len(self._known) > _KNOWN_STAGES:
                self._known.popitem(last=False)
        return self._known[key]

    async def _shared(self, client: Any, root: Path, order: Order) -> Any:
        """The files on the cluster, as something to give to tasks. Dask makes them again where a worker is lost."""
        content = await asyncio.to_thread(_read, root, order.files)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sending large graph")  # a whole stage, but only once
            return client.submit(_same, content, key=f"refract-stage-{secrets.token_hex(8)}", pure=False)

    def _keep_content(self, key: str, content: Any) -> None:
        self._content[key] = content
        while len(self._content) > _KEPT:
            self._content.popitem(last=False)


async def _result_of(future: Any) -> Ended | None:
    ended: Ended | None = await future
    return ended


def _same(content: dict[str, bytes]) -> dict[str, bytes]:
    return content


def _key(order: Order) -> str:
    return hashlib.sha256(repr((order.job["stage"], order.files)).encode()).hexdigest()


def _hashed(root: Path, paths: tuple[str, ...]) -> tuple[tuple[str, str], ...]:
    return tuple((path, file_digest(root / path)) for path in paths)


def _read(root: Path, files: tuple[tuple[str, str], ...]) -> dict[str, bytes]:
    return {path: (root / path).read_bytes() for path, _ in files}


def _leave(ended: Ended, work: Path) -> None:
    (work / "worker.log").write_text(ended.log, "utf-8")
    for name, data in ended.files.items():
        if RESULTS.match(name):
            (work / "out" / name).write_bytes(data)


def _trouble(error: Exception) -> dict[str, Any]:
    """What the client is told of a job that the cluster could not do; the reason is for the log."""
    log.warning("a job could not be done on the cluster: %s", _reason(error))
    if type(error).__name__ == "KilledWorker":
        text = "several workers of the cluster ended while they did this job"
        return {"problem": {"slug": "stage-crashed", "detail": text}}
    return {"problem": {"slug": "unavailable", "detail": "no worker of the cluster could do this job"}}


def _reason(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
