"""Signatures by a key that the service and a shop share: of addresses that anybody may then open, of what is sent."""

from __future__ import annotations

import hashlib
import hmac
import re

_SIGNED = re.compile(r"(?P<query>(?:.*&)?expires=(?P<expires>\d{1,12}))&signature=(?P<signature>[0-9a-f]{64})")


def signature_of(key: str, message: bytes) -> str:
    """HMAC-SHA256 in hexadecimal (RFC 2104)."""
    return hmac.new(key.encode(), message, hashlib.sha256).hexdigest()


def signed(key: str, path: str, query: str, expires: int) -> str:
    """An address that holds until a time.

    Args:
        path: with what has to be percent-encoded.
        query: without `?`; may be ''.
        expires: seconds since 1970.
    """
    told = f"{query}&expires={expires}" if query else f"expires={expires}"
    return f"{path}?{told}&signature={signature_of(key, f'GET {path}?{told}'.encode())}"


def expiry(key: str, path: str, query: str, now: float) -> int | None:
    """Until when an address holds, in seconds since 1970; None for one that is not signed, or no longer.

    Args:
        path, query: as they came, undecoded.
    """
    found = _SIGNED.fullmatch(query)
    if not key or not found:
        return None
    good = signature_of(key, f"GET {path}?{found['query']}".encode())
    if not hmac.compare_digest(good, found["signature"]) or int(found["expires"]) <= now:
        return None
    return int(found["expires"])
