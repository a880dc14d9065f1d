"""Words to a shop when its job has ended: a signed POST, to an address on the public internet and nowhere else.

A stranger names the address, so it is a way to make this machine speak to its neighbours. Names are resolved by us,
every address must be public, and the connection goes to one of those that were looked at: a name that changes its mind
between the look and the call changes nothing. Redirects are not followed, and of the answer only its status is read.
"""

from __future__ import annotations

import asyncio
import ipaddress
import json
import logging
import re
import socket
import ssl
import time
from collections.abc import Awaitable, Callable, Sequence
from typing import NamedTuple, Protocol
from urllib.parse import urlsplit

from .problems import Problem
from .signing import signature_of
from .store import Record

log = logging.getLogger("refract.service")
Resolve = Callable[[str, int], Awaitable[list[str]]]
SECONDS = 10.0
"""For one attempt, from the look at the name to the answer's status."""
WAITS = (1.0, 5.0, 25.0, 125.0)
"""[s] before each further attempt"""
_AGAIN = (408, 425, 429)
"""Statuses below 500 after which another attempt may do better."""
_TRANSLATED = tuple(ipaddress.ip_network(one) for one in ("64:ff9b::/96", "64:ff9b:1::/48", "2002::/16", "2001::/32"))
"""IPv6 that stands for IPv4 somewhere else: NAT64, 6to4, Teredo."""
_NOBODY = "names no host on the public internet"


class Ending(Protocol):
    """What tells when a job has ended: `jobs.Jobs`."""

    async def ended(self, record: Record) -> None: ...


class Target(NamedTuple):
    """Where a webhook goes, as far as its address tells."""

    secure: bool
    host: str
    port: int
    path: str
    """with its query"""


def target_of(url: str) -> Target:
    """Take an address apart. Raises Problem: it is none that a webhook may have."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port
    except ValueError:
        host, port, parts = "", None, urlsplit("")
    if parts.scheme not in ("http", "https") or not host or not re.fullmatch(r"[!-~]{1,2048}", url) or "\\" in url:
        raise refused("is not an address that begins with https:// or http://")
    if parts.username is not None or parts.password is not None:
        raise refused("holds a name or a password; leave them out")
    if port == 0:
        raise refused(_NOBODY)
    secure = parts.scheme == "https"
    path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    return Target(secure, host, port or (443 if secure else 80), path)


def refused(detail: str) -> Problem:
    return Problem("invalid-settings", f"/webhook: {detail}", errors=[{"pointer": "/webhook", "detail": detail}])


def is_public(address: str) -> bool:
    """Whether an IP address belongs to the public internet, and not to this machine."""
    try:
        found = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return False
    if isinstance(found, ipaddress.IPv6Address):
        if found.ipv4_mapped:
            found = found.ipv4_mapped
        elif found.is_site_local or any(found in one for one in _TRANSLATED):
            return False
    return found.is_global and not found.is_multicast and not found.is_reserved and not _is_ours(found)


def _is_ours(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> bool:
    """One can only bind to an address of this machine."""
    family = socket.AF_INET if address.version == 4 else socket.AF_INET6
    try:
        with socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.bind((str(address), 0))
    except OSError:
        return False
    return True


async def resolved(host: str, port: int) -> list[str]:
    """Addresses of a name. Raises OSError."""
    found = await asyncio.get_running_loop().getaddrinfo(host, port, type=socket.SOCK_STREAM)
    return list(dict.fromkeys(str(address[0]) for *_, address in found))


class Webhooks:
    """All that are still to be sent."""

    def __init__(
        self, key: str, most: int, *, resolve: Resolve = resolved, allowed: Callable[[str], bool] = is_public,
        waits: Sequence[float] = WAITS, seconds: float = SECONDS,
    ) -> None:  # fmt: skip
        """
        Args:
            key: signs what is sent; '' sends nothing.
            most: under way at once.
            allowed: whether an address may be spoken to.
            waits: [s] before each further attempt.
            seconds: for one attempt.
        """
        self.key, self.most, self.resolve, self.allowed = key, most, resolve, allowed
        self.waits, self.seconds = waits, seconds
        self._tasks: dict[tuple[str, str], asyncio.Task[None]] = {}

    async def check(self, url: str) -> None:
        """Refuse, before the work, what could not be sent. Raises Problem."""
        if not self.key:
            raise refused("is not possible here: this service has no key to sign with")
        if len(self._tasks) >= self.most:
            raise Problem("queue-full", "too many webhooks are still to be sent", headers={"Retry-After": "30"})
        target = target_of(url)
        try:
            async with asyncio.timeout(self.seconds):
                await self._address_of(target)
        except (OSError, UnicodeError):  # a timeout is one, too
            raise refused(_NOBODY) from None

    def follow(self, jobs: Ending, record: Record, url: str) -> None:
        """Send word to an address, which was checked, when a job has ended; once, however often this is asked."""
        key = (record.id, url)
        if key not in self._tasks:
            task = asyncio.create_task(self._deliver(jobs, record, url))
            self._tasks[key] = task
            task.add_done_callback(lambda _done: self._tasks.pop(key, None))

    async def stop(self) -> None:
        """Whatever has not been sent is lost."""
        tasks = list(self._tasks.values())
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _deliver(self, jobs: Ending, record: Record, url: str) -> None:
        await jobs.ended(record)
        body = json.dumps(record.document(), allow_nan=False).encode()
        target = target_of(url)
        said = ""
        for wait in (0.0, *self.waits):
            await asyncio.sleep(wait)
            try:
                async with asyncio.timeout(self.seconds):
                    status = await self._post(target, record.status, body)
            except (OSError, UnicodeError, ValueError) as error:  # of the network, of TLS, of what is no HTTP
                said = type(error).__name__
                continue
            except Problem:
                said = "no public address"
                break
            if 200 <= status < 300:
                return
            said = f"status {status}"
            if status < 500 and status not in _AGAIN:
                break
        log.warning("job %s: its webhook could not be delivered to %s: %s", record.id, target.host, said)

    async def _address_of(self, target: Target) -> str:
        """Where to connect to. Raises OSError for a name without addresses, Problem where one of them is not public."""
        found = await self.resolve(target.host, target.port)
        if not found or not all(self.allowed(one) for one in found):
            raise refused(_NOBODY)
        return found[0]

    async def _post(self, target: Target, event: str, body: bytes) -> int:
        """Send once. Returns the status; nothing else of the answer is read."""
        address = await self._address_of(target)
        now = int(time.time())
        host = f"[{target.host}]" if ":" in target.host else target.host
        usual = target.port == (443 if target.secure else 80)
        head = "\r\n".join([
            f"POST {target.path} HTTP/1.1", f"Host: {host}{'' if usual else f':{target.port}'}",
            "Content-Type: application/json", f"Content-Length: {len(body)}", "User-Agent: refract",
            f"Refract-Event: {event}", f"Refract-Timestamp: {now}",
            f"Refract-Signature: v1={signature_of(self.key, f'{now}.'.encode() + body)}", "Connection: close", "", "",
        ])  # fmt: skip
        reader, writer = await asyncio.open_connection(
            address, target.port, limit=4096, ssl=ssl.create_default_context() if target.secure else None,
            server_hostname=target.host if target.secure else None,
        )  # fmt: skip
        try:
            writer.write(head.encode("ascii") + body)
            await writer.drain()
            found = re.match(rb"HTTP/1\.[01] ([1-5]\d\d)[ \r]", await reader.readline())
            if not found:
                raise ValueError("no HTTP/1.1")
            return int(found[1])
        finally:
            writer.close()
