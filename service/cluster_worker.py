"""What a Dask worker does for a service elsewhere: it hands each job to a locked process of its own machine.

A Dask worker may do whatever the cluster may, so it never opens a stranger's stage itself. It keeps a `Nursery`, as
the service does, and gives a fork of it the job: the stage in a folder of its own, and nothing else.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import stat
import tempfile
import threading
import time
from collections.abc import Callable, Coroutine, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from refract_core.errors import RefractError
from refract_core.verbs.executors import desk

from .digests import engine, file_digest
from .pool import Nursery
from .store import RESULTS, make_work

_PATIENCE = 300.0
"""[s] for the first process to get warm, kernels compiled"""
_LAST_WORDS = 4000
_OFTEN = 0.1  # [s]
_T = TypeVar("_T")


class Order(NamedTuple):
    """A job as it travels."""

    topic: str
    """Where its messages go."""
    token: str
    """What they are marked with."""
    job: dict[str, Any]
    """kind, stage, settings and limits, as `worker` takes them"""
    root: str
    """Folder in which this machine may find the same files; '' for an upload, which is nowhere else."""
    files: tuple[tuple[str, str], ...]
    """path under the root, and SHA-256, of all the stage is made of"""
    engine: str


class Ended(NamedTuple):
    """A job that came to its end, good or bad."""

    message: dict[str, Any] | None
    """`done` or `problem`; None where the process ended without a word."""
    code: int
    """exit code of the process; negative is a signal"""
    log: str
    """its last words, for the service's log"""
    files: dict[str, bytes]
    """what it made"""


async def greet() -> tuple[str, dict[str, Any]]:
    """Get warm, beside whatever work there is. Returns the engine's version, and what confines processes on this
    machine."""
    return engine(), await asyncio.to_thread(lambda: _home().report)


async def answer() -> bool:
    """To see whether this worker can be reached; whatever it works at, its loop is free."""
    return True


def perform(order: Order, content: Mapping[str, bytes] | None) -> Ended | None:
    """Do a job.

    Args:
        content: the files by their paths, in case they are not here; None to try without.

    Returns:
        None where files are missing.

    Raises:
        RefractError: another version, or this machine cannot start processes; Cancelled.
    """
    from distributed import get_worker

    if order.engine != engine():
        raise RefractError(f"the worker has refract {engine()}, the service {order.engine}; install the same on both")
    here, worker = desk(), get_worker()
    in_place = bool(order.root) and _are_here(order.root, order.files)
    if not in_place and content is None:
        return None

    def say(message: Mapping[str, Any]) -> None:
        worker.log_event(order.topic, {"token": order.token, "message": dict(message)})

    folder = Path(tempfile.mkdtemp(prefix="refract-job-", dir=here.folder))
    try:
        work = make_work(folder)
        if not in_place:
            _put(work / "in", content or {})
        threads = max(1, len(os.sched_getaffinity(0)) // worker.state.nthreads)
        job = {**order.job, "root": order.root if in_place else str(work / "in"), "folder": str(work),
               "settings": {**order.job["settings"], "threads": threads}}  # fmt: skip
        message, code = _home().do(_follow(job, say), here.cancel)
        return Ended(message, code, _last_words(work), _results(work) if message and "done" in message else {})
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _are_here(root: str, files: tuple[tuple[str, str], ...]) -> bool:
    try:
        return all(file_digest(Path(root, path)) == digest for path, digest in files)
    except OSError:
        return False


def _put(folder: Path, content: Mapping[str, bytes]) -> None:
    for name, data in content.items():
        path = folder / name
        if not path.resolve().is_relative_to(folder.resolve()):
            raise RefractError(f"{name} is not a path inside the stage root")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


def _last_words(work: Path) -> str:
    with contextlib.suppress(OSError):
        return (work / "worker.log").read_text("utf-8", "replace")[-_LAST_WORDS:]
    return ""


def _results(work: Path) -> dict[str, bytes]:
    """What is in `out`: plain files of known names, whatever else a stage may have made its process put there."""
    found = {}
    for name in os.listdir(work / "out"):
        if not RESULTS.match(name):
            continue
        descriptor = os.open(work / "out" / name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        with open(descriptor, "rb") as file:
            if stat.S_ISREG(os.fstat(descriptor).st_mode):
                found[name] = file.read()
    return found


# --- the nursery of this process


class _Home:
    """A nursery, and the thread whose loop it lives in."""

    def __init__(self) -> None:
        self.loop = asyncio.new_event_loop()
        threading.Thread(target=self.loop.run_forever, name="refract-nursery", daemon=True).start()
        self.nursery = asyncio.run_coroutine_threadsafe(self._start(), self.loop).result()

    async def _start(self) -> Nursery:
        nursery = Nursery()
        nursery.start()
        return nursery

    @property
    def report(self) -> dict[str, Any]:
        async def wait() -> None:
            async with asyncio.timeout(_PATIENCE):
                await self.nursery.ready.wait()

        try:
            asyncio.run_coroutine_threadsafe(wait(), self.loop).result()
        except TimeoutError as error:
            text = f"no process for jobs was ready within {_PATIENCE:.0f} s; see the worker's log"
            raise RefractError(text) from error
        return self.nursery.report

    def do(self, work: Coroutine[Any, Any, _T], cancel: Callable[[], bool]) -> _T:
        """Run something in the loop, until it ends or `cancel` says so."""

        async def watched() -> _T:
            task = asyncio.ensure_future(work)
            while not (await asyncio.wait({task}, timeout=_OFTEN))[0]:
                if cancel():
                    task.cancel()
            return await task

        return asyncio.run_coroutine_threadsafe(watched(), self.loop).result()


_one: list[_Home] = []
_lock = threading.Lock()


def _home() -> _Home:
    with _lock:
        if not _one:
            _one.append(_Home())
        return _one[0]


async def _follow(job: dict[str, Any], say: Callable[[Mapping[str, Any]], None]) -> tuple[dict[str, Any] | None, int]:
    """Give a job to a new process, and pass on what it says. Returns its last message and its exit code."""
    nursery = _home().nursery
    while True:
        child = await nursery.fork()
        try:
            with contextlib.suppress(ConnectionError):
                await child.give(job)
                if await child.hear() == {"began": True}:
                    say({"began": True})
                    last = await _listen(child.hear, say)
                    if last is None:
                        return None, await child.code
                    return last, 0
        finally:
            await nursery.kill(child)
            child.close()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(asyncio.shield(child.code), 5.0)


async def _listen(
    hear: Callable[[], Coroutine[Any, Any, dict[str, Any] | None]], say: Callable[[Mapping[str, Any]], None]
) -> dict[str, Any] | None:
    told = 0.0
    while message := await hear():
        if "problem" in message or "done" in message:
            return message
        if "progress" in message and time.monotonic() - told < _OFTEN:
            continue
        told = time.monotonic()
        say(message)
    return None
