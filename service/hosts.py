"""The names this service answers to, and the sites whose pages may use it.

A page of a stranger can have its own name resolve to this machine (DNS rebinding): its browser then takes the service
for a part of that site, and `Origin` and `Host` agree. What gives it away is the name itself, so names are a list. An
address has no name that could be bound anew, so where the service listens on all addresses, each of them is right.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable
from typing import NamedTuple
from urllib.parse import urlsplit

from refract_core.errors import UsageError

Headers = list[tuple[bytes, bytes]]
Address = ipaddress.IPv4Address | ipaddress.IPv6Address

_HOST = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::\d{0,5})?", re.IGNORECASE)
_EVERYWHERE = ("", "0.0.0.0", "::")
"""What `--host` is where the service listens on all addresses, or where another server listens for it."""
_DEFAULT_PORTS = {"http": 80, "https": 443}
EXPOSED = ("ETag", "Location", "Content-Location", "Content-Range", "Preference-Applied", "Refract-Warnings",
           "Retry-After", "X-Request-ID")  # fmt: skip
"""Headers of an answer that a page of another site may read."""
_ASKED = ("Accept", "Authorization", "Content-Type", "If-None-Match", "If-Range", "Prefer", "Range", "X-Request-ID")
"""Headers that such a page may send."""
_METHODS = "GET, HEAD, POST, PUT, DELETE"
_PREFLIGHT_SECONDS = 600
"""[s] A browser need not ask again for this long."""


class Door(NamedTuple):
    """Who may come in by which name."""

    names: frozenset[str]
    """In lower case; addresses as `ipaddress` writes them."""
    every_address: bool
    """An address counts as right whichever it is, since the service listens on all of them."""
    origins: frozenset[str]
    """Other sites whose pages may use the service, as browsers write them."""

    def answers_to(self, host: str | None) -> bool:
        """Whether a `Host` header names this service."""
        found = _HOST.fullmatch(host or "")
        if not found:
            return False
        name = _plain(found[1])
        address = _address(name)
        if address is not None and (self.every_address or address.is_loopback):
            return True
        return name in self.names

    def lets_in(self, origin: str, host: str) -> bool:
        """Whether a page of `origin` may ask for work: one of the service itself, or of an allowed site."""
        return origin.lower() in self.origins or _same_site(origin, host)

    def headers(self, path: str, origin: str) -> Headers:
        """What an answer says of other sites. `origin`: of the request, or ''.

        A picture in another site's page is asked for without `Origin`, so the policy cannot follow that.
        """
        outside = bool(self.origins) and path.startswith("/v1/")
        found: Headers = [(b"cross-origin-resource-policy", b"cross-origin" if outside else b"same-origin")]
        if not self.origins:
            return found
        found.append((b"vary", b"Origin"))
        if origin.lower() in self.origins:
            found += [(b"access-control-allow-origin", origin.encode("latin-1")),
                      (b"access-control-expose-headers", ", ".join(EXPOSED).encode())]  # fmt: skip
        return found

    def preflight(self, method: str, origin: str, asked: str | None) -> dict[str, str] | None:
        """Headers that answer a browser which asks before it sends what a page of an allowed site wants; None where
        this is no such question, or no such site."""
        if method != "OPTIONS" or asked is None or origin.lower() not in self.origins:
            return None
        return {
            "Access-Control-Allow-Methods": _METHODS, "Access-Control-Allow-Headers": ", ".join(_ASKED),
            "Access-Control-Max-Age": str(_PREFLIGHT_SECONDS),
            "Vary": "Access-Control-Request-Method, Access-Control-Request-Headers",
        }  # fmt: skip


def door(host: str, hosts: Iterable[str] = (), origins: Iterable[str] = ()) -> Door:
    """
    Args:
        host: where the service listens; '' is not known.
        hosts: further names, `--allow-host`.
        origins: other sites, `--allow-origin`.

    Raises:
        UsageError: a name or a site is not written as it must be.
    """
    names = {"localhost"} if host in _EVERYWHERE else {"localhost", _name(host, "--host")}
    names |= {_name(one, "--allow-host") for one in hosts}
    return Door(frozenset(names), host in _EVERYWHERE, frozenset(_origin(one) for one in origins))


def _name(text: str, flag: str) -> str:
    """A name or an address, as in `Host`."""
    address = _address(text.strip("[]"))
    if address is not None:
        return str(address)
    found = _HOST.fullmatch(text)
    if not found or found[1] != text:
        raise UsageError(f"{flag} {text}: write a name or an address alone, without a port, such as render.example.org")
    return _plain(text)


def _origin(text: str) -> str:
    """A site as a browser writes it in `Origin`."""
    problem = UsageError(f"--allow-origin {text}: write scheme and host, such as https://shop.example.org")
    try:
        parts = urlsplit(text.lower())
        port = parts.port
    except ValueError:
        raise problem from None
    if parts.scheme not in _DEFAULT_PORTS or not _HOST.fullmatch(parts.netloc) or parts.path not in ("", "/"):
        raise problem
    if parts.query or parts.fragment:
        raise problem
    name = parts.netloc.removesuffix(f":{port}") if port == _DEFAULT_PORTS[parts.scheme] else parts.netloc
    return f"{parts.scheme}://{name}"


def _plain(name: str) -> str:
    """One way of writing for each name; an address loses its brackets."""
    name = name.lower().removesuffix(".").strip("[]")
    address = _address(name)
    return name if address is None else str(address)


def _address(text: str) -> Address | None:
    try:
        found = ipaddress.ip_address(text)
    except ValueError:
        return None
    return getattr(found, "ipv4_mapped", None) or found


def _same_site(origin: str, host: str) -> bool:
    try:
        return urlsplit(origin).netloc.lower() == host.lower()
    except ValueError:
        return False
