"""Slots: places where one job after the other is done, kept alive whatever happens in them."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable

from .metrics import Metrics

log = logging.getLogger("refract.service")
_FIRST, _LONGEST = 0.1, 2.0
"""[s] Between attempts of a slot that fails. A shortage that has ended is over for every slot within the second."""

Ready = Callable[[], None]
Work = Callable[[Ready], Awaitable[None]]
"""One job, from its warm worker to its end. It calls what it is given as soon as it has all that a job needs."""


class Slots:
    """`count` slots. One that fails is started again, a little later each time, until it has what it needs."""

    def __init__(self, count: int, work: Work, metrics: Metrics) -> None:
        self.count, self.work, self.metrics = count, work, metrics
        self.failing: set[int] = set()
        """Slots whose last attempt ended before they could have taken a job."""
        self._show()

    @property
    def live(self) -> int:
        return self.count - len(self.failing)

    def start(self) -> list[asyncio.Task[None]]:
        return [asyncio.create_task(self._keep(number)) for number in range(self.count)]

    async def _keep(self, number: int) -> None:
        wait = _FIRST

        def ready() -> None:
            nonlocal wait
            wait = _FIRST
            self.failing.discard(number)
            self._show()

        while True:
            try:
                await self.work(ready)
                continue
            except asyncio.CancelledError:
                task = asyncio.current_task()
                if task is None or task.cancelling():  # by us; a library may raise it for reasons of its own
                    raise
                log.warning("a slot was interrupted; it is started again")
            except OSError as error:  # the machine is short of something
                log.warning("a slot gets no worker and is started again: %s", error.strerror or error)
            except Exception:
                log.exception("a slot failed; it is started again")
            self.failing.add(number)
            self.metrics.slot_failures.inc()
            self._show()
            await asyncio.sleep(wait)
            wait = min(2 * wait, _LONGEST)

    def _show(self) -> None:
        self.metrics.slots.labels("live").set(self.live)
        self.metrics.slots.labels("failing").set(len(self.failing))
