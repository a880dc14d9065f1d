"""Signatures by a key that the service and a shop share: of addresses that anybody may then open, of what is sent."""

from __future__ import annotations

import hashlib
import hmac
import re

_SIGNED = re.compile(r"(?P<query>(?:.*&)?expires=(?P<expires>\d{1,12}))&signature=(?P<signature>[0-9a-f]{64})")


def signature_of(key: str, message: bytes) -> str:
    """HMAC-SHA256 in hexadecimal (RFC 2104)."""
    return hmac.new(key.encode(), message, hashlib.sha256).hexdigest()


def is_from(key: str, timestamp: str, signature: str, body: bytes, *, now: float, tolerance: float = 300.0) -> bool:
    """Whether a webhook was sent by the service that has the key, just now.

    Args:
        timestamp: the header Refract-Timestamp.
        signature: the header Refract-Signature.
        tolerance: [s] by which the clocks may differ; what is older may have been recorded, and sent again.
    """
    good = f"v1={signature_of(key, f'{timestamp}.'.encode() + body)}"
    timely = timestamp.isascii() and timestamp.isdigit() and abs(now - int(timestamp[:12])) <= tolerance
    return hmac.compare_digest(good.encode(), signature.encode()) and timely


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
