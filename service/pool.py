"""Warm one-shot workers: what they are to the queue, and the process of this machine that forks them."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import secrets
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any, Protocol

import refract_core

from .worker import environment

log = logging.getLogger("refract.service")
_LINE = 1 << 20
"""Longest message of a worker [bytes]."""


class Worker(Protocol):
    """A process that waits for its one job."""

    code: asyncio.Future[int]
    """Exit code; negative is a signal."""
    lost: bool
    """It ended for no reason of its own."""

    async def give(self, job: dict[str, Any]) -> None: ...

    async def hear(self) -> dict[str, Any] | None:
        """Next message; None when it has ended, or talks nonsense."""

    def close(self) -> None: ...


class Source(Protocol):
    """Where workers come from."""

    ready: asyncio.Event

    @property
    def report(self) -> dict[str, Any]:
        """What confines workers; empty until there is one."""

    def start(self) -> None: ...

    async def stop(self) -> None: ...

    async def fork(self) -> Worker:
        """A new warm worker; waits until there can be one."""

    async def kill(self, worker: Worker) -> None: ...


class Child:
    """A worker on this machine."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, identifier: str) -> None:
        self.reader, self.writer, self.identifier = reader, writer, identifier
        self.code: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self.lost = False

    async def give(self, job: dict[str, Any]) -> None:
        self.writer.write(json.dumps(job, allow_nan=False).encode() + b"\n")
        await self.writer.drain()

    async def hear(self) -> dict[str, Any] | None:
        try:
            line = await self.reader.readuntil(b"\n")
            message = json.loads(line)
        except (asyncio.IncompleteReadError, asyncio.LimitOverrunError, ConnectionError, ValueError, RecursionError):
            return None
        return message if isinstance(message, dict) else None

    def close(self) -> None:
        self.writer.close()


class Nursery:
    """The process that forks workers, kept alive."""

    def __init__(self) -> None:
        self.report: dict[str, Any] = {}
        self.ready = asyncio.Event()
        self.restarts = -1
        self._workers: dict[str, Child] = {}
        self._control: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        self._task = asyncio.create_task(self._keep())

    async def stop(self) -> None:
        if self._task:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
        self._end()

    @property
    def pid(self) -> int:
        return self._process.pid if self._process else 0

    async def _keep(self) -> None:
        wait = 0.1
        while True:
            self.restarts += 1
            started = asyncio.get_running_loop().time()
            try:
                await self._run()
                log.warning("the process that forks workers has ended; it is started anew")
            except Exception as error:  # whatever keeps it from starting may pass
                wait = min(wait, 2.0) if isinstance(error, OSError) else wait
                log.exception("the process that forks workers cannot be started; trying again in %.1f s", wait)
            finally:
                self.ready.clear()
                self._end()
            if asyncio.get_running_loop().time() - started > 60:
                wait = 0.1
            await asyncio.sleep(wait)
            wait = min(wait * 2, 30.0)

    async def _run(self) -> None:
        """From start to end of one such process."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        self._control = ours
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "refract_core.service.worker", str(theirs.fileno())], pass_fds=[theirs.fileno()],
                cwd=Path(refract_core.__file__).parents[1], env=environment(), stdin=subprocess.DEVNULL, stdout=2,
            )  # fmt: skip
        log.info("the first worker is getting warm; where kernels are to be compiled first, it takes a minute or two")
        loop = asyncio.get_running_loop()
        while data := await loop.sock_recv(ours, 65536):
            message = json.loads(data)
            if "ready" in message:
                self.report = message["ready"]
                self.ready.set()
                log.info("ready for jobs")
            elif "ended" in message and (worker := self._workers.pop(message["ended"], None)):
                worker.code.set_result(message["code"])

    def _end(self) -> None:
        if self._control:
            self._control.close()
            self._control = None
        if self._process:
            self._process.kill()
            self._process.wait()
            self._process = None
        for worker in self._workers.values():
            if not worker.code.done():
                worker.lost = True
                worker.code.set_result(-9)
        self._workers.clear()

    async def fork(self) -> Child:
        while True:
            await self.ready.wait()
            ours, theirs = socket.socketpair()
            identifier = secrets.token_hex(8)
            with theirs:
                try:
                    assert self._control is not None
                    socket.send_fds(self._control, [json.dumps({"fork": identifier}).encode()], [theirs.fileno()])
                except (OSError, AssertionError):  # it has just ended
                    ours.close()
                    await asyncio.sleep(0.1)
                    continue
            try:
                reader, writer = await asyncio.open_connection(sock=ours, limit=_LINE)
            except BaseException:
                ours.close()  # which ends the worker too
                raise
            worker = Child(reader, writer, identifier)
            self._workers[identifier] = worker
            return worker

    async def kill(self, worker: Worker) -> None:
        assert isinstance(worker, Child)
        if self._control and not worker.code.done():
            with contextlib.suppress(OSError):
                await asyncio.get_running_loop().sock_sendall(
                    self._control, json.dumps({"kill": worker.identifier}).encode()
                )
