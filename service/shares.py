"""What one client may have of the service, whose turn it is, and when a refused one should come back.

A client is told by its address, and by its token where there are tokens; it may use up the share of neither. Of bodies
that arrive, places in the queue and streams of events it gets a part, so that others always find some; waiting jobs are
taken from each client in turn; and while others come too, one worker is left to them.
"""

from __future__ import annotations

import asyncio
import contextlib
import heapq
import ipaddress
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from .limits import Limits
from .problems import Problem
from .store import Record

Clock = Callable[[], float]
"""[s], never going back."""
_MEMORY = 60.0
"""[s] How long a client counts as one of those that come, after its last request for work."""
_MEASURED = 32
"""Jobs of a kind whose seconds are remembered."""
_TOLD = 0.05
"""Progress from which on it tells how long a job will take."""
_UNKNOWN = 1.0
"""[s] What a job takes before any has been measured."""


class Client(NamedTuple):
    """Who asks."""

    address: str = ""
    owner: str = ""
    """Name of the token, or ''."""

    def names(self) -> tuple[str, ...]:
        """Under which a share is counted."""
        return (f"address {self.address}", *([f"token {self.owner}"] if self.owner else []))

    def turn(self) -> str:
        """Whose jobs take turns with those of others."""
        return self.names()[-1]


NOBODY = Client()


def address_of(host: str) -> str:
    """One client's address. A client of IPv6 has a whole network of them, 2^64."""
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host
    address = getattr(address, "ipv4_mapped", None) or address
    if address.version == 4:
        return str(address)
    return str(ipaddress.ip_network((address, 64), strict=False))


class Pace:
    """How long things take here, as far as it has been measured."""

    def __init__(self) -> None:
        self._seconds: dict[str, deque[float]] = {}

    def add(self, kind: str, seconds: float) -> None:
        self._seconds.setdefault(kind, deque(maxlen=_MEASURED)).append(seconds)

    def usual(self, kind: str) -> float:
        """[s] The mean of what was measured last, of all kinds where there is none of this one."""
        known = self._seconds.get(kind) or [one for some in self._seconds.values() for one in some]
        return sum(known) / len(known) if known else _UNKNOWN

    def left(self, kind: str, elapsed: float, longest: float, fraction: float = 0.0) -> float:
        """[s] How much longer something takes that has taken `elapsed` already, and may take `longest`.

        By its own progress where it tells that; else as long as those that took longer did; else, where none ever did,
        as long again as it has taken.
        """
        longer = [one for one in self._seconds.get(kind, ()) if one > elapsed]
        if fraction >= _TOLD:
            found = elapsed * (1.0 - fraction) / fraction
        elif longer:
            found = sum(longer) / len(longer) - elapsed
        else:
            found = max(elapsed, _UNKNOWN if self._seconds.get(kind) else self.usual(kind))
        return min(found, max(longest - elapsed, 0.0))


def ends(running: Sequence[float], waiting: Sequence[float], workers: int) -> list[float]:
    """[s] from now when each job ends: those that run, by what is left of them, then those that wait, in order."""
    found = list(running)
    free = [*running, *[0.0] * (workers - len(running))]
    heapq.heapify(free)
    for seconds in waiting:
        found.append(heapq.heappop(free) + seconds)
        heapq.heappush(free, found[-1])
    return found


class Share:
    """Things of which there are a few: who has them, and for how long."""

    def __init__(self, kind: str, total: int, own: int, longest: float, pace: Pace, clock: Clock) -> None:
        """
        Args:
            kind: under which their seconds are measured.
            total: how many there are.
            own: how many one client may have.
            longest: [s] for which one can be had.
        """
        self.kind, self.total, self.own, self.longest, self.pace, self.clock = kind, total, own, longest, pace, clock
        self._held: dict[object, tuple[Client, float]] = {}
        self._count: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._held)

    @property
    def full(self) -> bool:
        return len(self._held) >= self.total

    def spent(self, client: Client) -> bool:
        return self.own < self.total and any(self._count[name] >= self.own for name in client.names())

    def holder(self, key: object) -> Client:
        return self._held[key][0] if key in self._held else NOBODY

    def keys(self, client: Client) -> list[object]:
        """What a client has, under either of its names."""
        names = {*client.names()}
        return [key for key, (one, _) in self._held.items() if names & {*one.names()}]

    def take(self, key: object, client: Client) -> None:
        self._held[key] = (client, self.clock())
        self._count.update(client.names())

    def give(self, key: object) -> None:
        """Nothing happens where it was given back before."""
        client, _ = self._held.pop(key, (None, 0.0))
        if client is not None:
            self._count.subtract(client.names())
            self._count += Counter()  # without those that have none

    @contextlib.contextmanager
    def one(self, client: Client, what: str) -> Iterator[None]:
        """Have one for a while. Raises Problem where there is none for this client."""
        if self.spent(client) or self.full:
            mine = self.keys(client) if self.spent(client) else list(self._held)
            now = self.clock()
            wait = min(self.pace.left(self.kind, now - self._held[key][1], self.longest) for key in mine)
            raise refusal(self, client, what, wait)
        key = object()
        self.take(key, client)
        began = self.clock()
        try:
            yield
        finally:
            self.give(key)
            self.pace.add(self.kind, self.clock() - began)


def refusal(share: Share, client: Client, what: str, wait: float) -> Problem:
    """
    Args:
        wait: [s] until it should come back.
    """
    headers = {"Retry-After": str(math.floor(wait) + 1)}  # whole seconds, and not the very moment
    if share.spent(client):
        return Problem("share-spent", f"one client may have {share.own} of {share.total} {what} at once",
                       headers=headers)  # fmt: skip
    return Problem("queue-full", f"all {share.total} {what} are taken", headers=headers)


class Line:
    """Jobs that wait, by their ids. Clients take turns, and while several come, none has all workers."""

    def __init__(self, workers: int, holder: Callable[[object], Client], clock: Clock) -> None:
        """
        Args:
            holder: client of a job.
        """
        self.workers, self.holder, self.clock = workers, holder, clock
        self._waiting: dict[str, deque[str]] = {}
        """By whose turn it is: the first is the next."""
        self._running: dict[str, str] = {}
        """Job -> whose."""
        self._seen: dict[str, float] = {}
        self._news = asyncio.Event()

    def put_nowait(self, identifier: str) -> None:
        turn = self.holder(identifier).turn()
        self._waiting.setdefault(turn, deque()).append(identifier)
        self._seen[turn] = self.clock()
        self._news.set()

    async def get(self) -> str:
        """The next job, as soon as there is one whose client may have another worker."""
        while (found := self._next()) is None:
            self._news.clear()
            await self._news.wait()
        return found

    def drop(self, identifier: str) -> None:
        """A job has ended, whether it ran or waited."""
        self._running.pop(identifier, None)
        for turn, jobs in list(self._waiting.items()):
            with contextlib.suppress(ValueError):
                jobs.remove(identifier)
            if not jobs:
                del self._waiting[turn]
        self._news.set()

    def order(self) -> list[str]:
        """Waiting jobs, the next one first."""
        columns = [list(jobs) for jobs in self._waiting.values()]
        deepest = max(map(len, columns), default=0)
        return [column[row] for row in range(deepest) for column in columns if row < len(column)]

    def _next(self) -> str | None:
        for turn, jobs in self._waiting.items():
            if self._of(turn) < self._most(turn):
                found = jobs.popleft()
                del self._waiting[turn]
                if jobs:
                    self._waiting[turn] = jobs  # behind the others
                self._running[found] = turn
                return found
        return None

    def _of(self, turn: str) -> int:
        return sum(one == turn for one in self._running.values())

    def _most(self, turn: str) -> int:
        """Workers that a client may have now."""
        since = self.clock() - _MEMORY
        self._seen = {one: seen for one, seen in self._seen.items() if seen > since or one in self._waiting}
        others = self._seen.keys() - {turn}
        return max(1, self.workers - 1) if others else self.workers


class Shares:
    """All shares of one service."""

    def __init__(self, limits: Limits, workers: int, queue: int, clock: Clock = time.monotonic) -> None:
        self.workers, self.clock, self.pace, self.limits = workers, clock, Pace(), limits
        self.bodies = self._share("body", limits.bodies, limits.body_seconds)
        self.streams = self._share("stream", limits.event_streams, math.inf)
        places = workers + queue
        own = places if limits.share >= 100 else max(1, min(places - 1, workers + queue * limits.share // 100))
        self.places = Share("place", places, own, math.inf, self.pace, self.now)
        self.line = Line(workers, self.places.holder, self.now)
        self._jobs: dict[str, Record] = {}
        self._began: dict[str, float] = {}
        self._told: dict[str, float] = {}
        """When clients that were refused were told to come back."""

    def _share(self, kind: str, total: int, longest: float) -> Share:
        percent = self.limits.share
        own = total if percent >= 100 else max(1, min(total - 1, total * percent // 100))
        return Share(kind, total, own, longest, self.pace, self.now)

    def now(self) -> float:
        return self.clock()

    def check(self, client: Client) -> None:
        """Raises Problem where there is no place for another job of this client."""
        if self.places.spent(client) or self.places.full:
            raise refusal(self.places, client, "places for jobs", self._wait(client))
        self._told.pop(client.turn(), None)

    def enter(self, record: Record, client: Client) -> None:
        """A job takes a place, and waits."""
        self.places.take(record.id, client)
        self._jobs[record.id] = record
        self.line.put_nowait(record.id)

    def began(self, record: Record) -> None:
        self._began[record.id] = self.now()

    def ended(self, record: Record) -> None:
        """A job gives its place back, however it ended."""
        began = self._began.pop(record.id, None)
        if began is not None and record.status != "cancelled":
            self.pace.add(record.kind, self.now() - began)
        self._jobs.pop(record.id, None)
        self.places.give(record.id)
        self.line.drop(record.id)

    def _wait(self, client: Client) -> float:
        """[s] until there is a place for a client that is refused now: for it alone, since each of those that were
        refused before it and have not come back yet is told of another place."""
        now = self.now()
        order = [key for key in self.line.order() if key in self._jobs]
        waiting = {*order}
        running = [key for key in self._jobs if key not in waiting]
        left = [
            self.pace.left(self._jobs[key].kind, now - self._began.get(key, now), self.limits.job_seconds,
                           self._jobs[key].fraction)
            for key in running
        ]  # fmt: skip
        found = ends(left, [self.pace.usual(self._jobs[key].kind) for key in order], self.workers)
        if self.places.spent(client):
            mine = {*self.places.keys(client)}
            return min(end for key, end in zip([*running, *order], found, strict=True) if key in mine)
        self._told = {turn: back for turn, back in self._told.items() if back > now and turn != client.turn()}
        found.sort()
        rounds, place = divmod(min(len(self._told), self.places.total), len(found))
        wait = found[place] + rounds * found[-1]
        self._told[client.turn()] = now + wait
        return wait
