"""Work on other machines: a stage told to workers, pieces of work sent out, results that each come back once.

What spreads is a frame or a probe. The code knows `concurrent.futures` alone, but for the functions that know Dask:
`crew_at`, which finds the cluster, and `desk`, which asks a worker whether anybody still waits for its result.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import secrets
import shutil
import socket
import sys
import tempfile
import threading
import warnings
import weakref
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import RefractError, StageError, UsageError
from ..progress import Report
from ..scene import Notice, Scene
from ..settings import AS_IT_IS, Opening
from ..version import __version__

if TYPE_CHECKING:
    from ..rendering.session import Session

_ADDRESS = re.compile(r"dask://([^\s/:]+|\[[0-9A-Fa-f:.]+\]):(\d{1,5})/?")
CONNECT_SECONDS = 10
_OPEN_STAGES = 4
"""Stages of different orders that a worker keeps open."""
_SAME = "install the same usd-refract[dask] on the scheduler and all workers, and start them again"
_LOST = "the cluster is lost: its scheduler has ended, or cannot be reached any more"
_NOT_HERE = "the stage is not here"


class Crew(NamedTuple):
    """Where pieces of work go."""

    executor: Executor
    width: Callable[[], int]
    """Pieces that run at once; 0 while there is no worker."""
    share: Callable[[bytes], Any]
    """Bytes that many pieces need: what to give each, which arrives as the bytes."""


@contextmanager
def crew_at(address: str) -> Iterator[Crew | None]:
    """Find a cluster by its address.

    Args:
        address: `dask://HOST:PORT` of a Dask scheduler; '' means no cluster, and gives None.

    Raises:
        UsageError: the address is malformed, or Dask is not installed.
        RefractError: nobody answers there.
    """
    if not address:
        yield None
        return
    scheduler = scheduler_of(address)
    from distributed import Client

    with silent("distributed", "distributed.client"):  # what they say about lost connections comes as an error here
        try:
            client = Client(scheduler, timeout=CONNECT_SECONDS, set_as_default=False)
        except (OSError, ValueError) as error:
            raise RefractError(nobody_at(address)) from error
        try:
            yield _crew_of(client)
        finally:
            client.close()


def scheduler_of(address: str) -> str:
    """A scheduler's address as Dask writes it.

    Args:
        address: `dask://HOST:PORT`

    Raises:
        UsageError: it is malformed, or Dask is not installed.
    """
    found = _ADDRESS.fullmatch(address)
    if found is None or int(found[2]) > 65535:
        raise UsageError(f"--executor is '{address}'; write dask://HOST:PORT, the address that `dask scheduler` prints")
    try:
        from distributed import Security
    except ImportError as error:
        raise UsageError(
            f"--executor {address} needs Dask, which is not installed: pip install 'usd-refract[dask]'"
        ) from error
    scheme = "tls" if getattr(Security(), "tls_ca_file", None) else "tcp"  # as Dask's own configuration says
    return f"{scheme}://{found[1]}:{found[2]}"


def nobody_at(address: str) -> str:
    """What to tell where no scheduler answers."""
    return (
        f"--executor {address}: no Dask scheduler answers there; start one with `dask scheduler`, or check host, port "
        "and firewall"
    )


@contextmanager
def silent(*names: str) -> Iterator[None]:
    """Loggers that say nothing for a while, because what they know is told in another way."""
    loggers = {name: logging.getLogger(name) for name in names}
    before = {name: logger.level for name, logger in loggers.items()}
    for logger in loggers.values():
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for name, logger in loggers.items():
            logger.setLevel(before[name])


def _crew_of(client: Any) -> Crew:
    """The crew of a Dask client."""

    def width() -> int:
        try:
            return sum(client.ncores().values())
        except OSError as error:
            raise RefractError(_LOST) from error

    def share(data: bytes) -> Any:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sending large graph")  # a whole stage, but only once
            return client.submit(_same, data, pure=False)

    return Crew(client.get_executor(pure=False), width, share)


def _same(data: bytes) -> bytes:
    return data


# --- in the process that gives the order


class Sent(NamedTuple):
    """A stage as workers are told of it."""

    order: str
    """Of one command alone: what a worker keeps open is never an older state of the files."""
    stage: str
    """absolute path"""
    name: str
    """what pictures say it is called"""
    files: tuple[tuple[str, str], ...]
    """path and SHA-256 of everything it is made of"""
    version: str
    opening: Opening = AS_IT_IS


def sent_stage(path: str, name: str, opening: Opening = AS_IT_IS) -> Sent:
    """What workers need to know of a stage.

    Args:
        path: of the stage, as a person wrote it.
        name: `Scene.name` of the stage.
        opening: what is changed about it.

    Raises:
        UsageError: a session layer, which is no part of the stage, and would not be there.
    """
    if opening.session_layer:
        text = "is not sent to a cluster; write a layer over the stage that has it as a sublayer, and render that"
        raise UsageError(f"--session-layer {opening.session_layer}: {text}")
    from ..usd.layers.assets import absolute, files_of

    stage = absolute(path)
    return Sent(secrets.token_hex(8), stage, name, _hashed(files_of(stage)), __version__, opening)


def spread(
    crew: Crew,
    function: Callable[[Bench, Any], Any],
    items: Sequence[Any],
    sent: Sent,
    *,
    stop: Callable[[], None],
    waiting: Callable[[], None],
) -> Iterator[tuple[Any, Any]]:
    """Do a piece of work for every item, wherever there is room. A worker that dies loses nothing.

    Args:
        function: of a module, and told the same twice gives the same twice: it may run again elsewhere.
        items: small; the stage goes by its path where a worker sees the same files there, else as one package.
        stop: asked often; what it raises ends the work, also on the workers.
        waiting: called while there is no worker.

    Yields:
        An item and its result, once for each, in the order in which they are done.

    Raises:
        RefractError: the first that a piece of work raises, or the cluster is lost.
    """
    todo = list(reversed(items))
    pending: dict[Future[Any], Any] = {}
    shared: Any = None
    try:
        while todo or pending:
            stop()
            width = crew.width()
            if width == 0:
                waiting()
            while todo and len(pending) < max(2 * width, 1):
                item = todo.pop()
                pending[crew.executor.submit(_perform, function, sent, shared, item)] = item
            done, _ = wait(pending, timeout=0.2, return_when=FIRST_COMPLETED)
            for future in done:
                item = pending.pop(future)
                result = _result_of(future)
                if result != _NOT_HERE:
                    yield item, result[0]
                    continue
                shared = crew.share(_packed(sent)) if shared is None else shared
                todo.append(item)
    finally:
        for future in pending:
            future.cancel()


def patience(report: Report) -> Callable[[], None]:
    """A `waiting` for `spread`: says once, and shows, that no worker is there."""
    said: list[bool] = []

    def waiting() -> None:
        if not said:
            said.append(True)
            report.warning("--executor", "the cluster has no worker; waiting until one joins")
        report.progress(0.0, "waiting for a worker")

    return waiting


def _result_of(future: Future[Any]) -> Any:
    """What a piece of work gave; whatever went wrong, as one of our own errors."""
    try:
        return future.result()
    except RefractError:
        raise
    except CancelledError as error:
        raise RefractError(_LOST) from error
    except MemoryError as error:
        raise RefractError("a worker is out of memory; give workers more, or run fewer on a machine") from error
    except ModuleNotFoundError as error:
        raise RefractError(f"a worker cannot run refract: {error}; {_SAME}") from error
    except Exception as error:
        if "deserialization" in str(error):  # the scheduler looks into the work too
            raise RefractError(f"the scheduler does not know this version of refract; {_SAME}") from error
        if type(error).__name__ == "KilledWorker":
            text = "several workers ended while they did the same piece of work; see their logs. Is memory too small?"
            raise RefractError(text) from error
        reason = " ".join(str(error).split())[:300]
        raise RefractError(f"the work failed on the cluster: {type(error).__name__}: {reason}") from error


def _packed(sent: Sent) -> bytes:
    from ..usd.layers.write import packed

    data = packed(sent.stage)
    if not _is_here(sent):
        raise StageError(f"{sent.stage}: the stage or a file of it was changed while the work went on; start again")
    return data


def _hashed(files: Sequence[str]) -> tuple[tuple[str, str], ...]:
    found = []
    for path in files:
        with open(path, "rb") as file:
            found.append((path, hashlib.file_digest(file, "sha256").hexdigest()))
    return tuple(found)


# --- in a worker


class Desk(NamedTuple):
    """What a worker's process offers to a piece of work."""

    cancel: Callable[[], bool]
    """True when nobody waits for the result any more."""
    folder: str | None
    """for files that only live as long as the worker"""


def desk() -> Desk:
    """The desk of this thread. On Dask, work that is cancelled runs on unless it asks."""
    distributed = sys.modules.get("distributed")
    if distributed is None:
        return Desk(lambda: False, None)
    try:
        worker = distributed.get_worker()
        key = worker.get_current_task()
    except (ValueError, KeyError):  # not on a worker: Dask is only loaded
        return Desk(lambda: False, None)

    def cancel() -> bool:
        task = worker.state.tasks.get(key)
        return task is None or task.state == "cancelled"

    return Desk(cancel, worker.local_directory)


@dataclass(frozen=True)
class _Opened:
    """A stage that a worker holds open."""

    stage: Any
    path: str
    scenes: dict[Any, Scene] = field(default_factory=dict)
    """the one read last"""
    sessions: list[Session] = field(default_factory=list)
    """the one that its pictures share; none before the first picture"""


@dataclass(frozen=True)
class Bench:
    """What a piece of work finds on a worker."""

    sent: Sent
    opened: _Opened
    cancel: Callable[[], bool]

    def read(self, **how: Any) -> Scene:
        """`scene_from_stage` of the stage, which speaks of it as the process does that gave the order."""
        from ..usd.stage import scene_from_stage

        key = tuple(sorted(how.items()))
        with _reading:
            scene = self.opened.scenes.get(key)
            if scene is None:
                scene = scene_from_stage(self.opened.stage, **how)
                scene = replace(scene, name=self.sent.name, notices=tuple(map(self._renamed, scene.notices)))
                self.opened.scenes.clear()
                self.opened.scenes[key] = scene
        return scene

    def session(self) -> Session:
        """What keeps parts of pictures of this stage, of this order alone, and ends with it."""
        from ..rendering.session import Session

        with _reading:
            if not self.opened.sessions:
                self.opened.sessions.append(Session())
        return self.opened.sessions[0]

    def _renamed(self, notice: Notice) -> Notice:
        here, there = self.opened.path, self.sent.stage
        return Notice(notice.path.replace(here, there), notice.text.replace(here, there))


_reading = threading.Lock()
"""USD is asked by one thread at a time; rendering is not."""
_open: dict[str, _Opened] = {}
"""By order, oldest first."""


def _perform(function: Callable[[Bench, Any], Any], sent: Sent, shared: bytes | None, item: Any) -> Any:
    """One piece of work: a tuple with its result, or `_NOT_HERE`."""
    if sent.version != __version__:
        where = socket.gethostname()
        raise RefractError(f"the worker on {where} has refract {__version__}, not {sent.version}; {_SAME}")
    here = desk()
    with _reading:
        opened = _opened(sent, shared, here)
    return _NOT_HERE if opened is None else (function(Bench(sent, opened, here.cancel), item),)


def _opened(sent: Sent, shared: bytes | None, here: Desk) -> _Opened | None:
    """The stage of an order: open already, opened where it lies, or out of the bytes; None where they are needed."""
    from ..usd.stage import open_stage

    if sent.order in _open:
        return _open[sent.order]
    if _is_here(sent):
        opened = _Opened(open_stage(sent.stage, sent.opening), sent.stage)
    elif shared is None:
        return None
    else:
        folder = tempfile.mkdtemp(prefix="refract-stage-", dir=here.folder)
        path = os.path.join(folder, f"{Path(sent.stage).stem}.usdz")
        Path(path).write_bytes(shared)
        opened = _Opened(open_stage(path, sent.opening), path)
        weakref.finalize(opened, shutil.rmtree, folder, ignore_errors=True)
    _open[sent.order] = opened
    while len(_open) > _OPEN_STAGES:
        del _open[next(iter(_open))]
    return opened


def _is_here(sent: Sent) -> bool:
    """Every file of the stage is where the order says, with the same content."""
    paths = [path for path, _ in sent.files]
    try:
        return all(os.path.isfile(path) for path in paths) and _hashed(paths) == sent.files
    except OSError:
        return False


def file_bytes(write: Callable[[str], None], name: str) -> bytes:
    """The bytes of a file that `write` would write under this name."""
    with tempfile.TemporaryDirectory(prefix="refract-", dir=desk().folder) as folder:
        path = os.path.join(folder, os.path.basename(name))
        write(path)
        return Path(path).read_bytes()
