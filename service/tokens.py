"""Bearer tokens: who somebody is, and what they may do. The service keeps hashes, never a token itself.

A line of the token file is a token alone, which may do everything, or `NAME sha256:HEX SCOPES`. Lines of one name are
one owner: what one of its tokens has rendered, the others may see.
"""

from __future__ import annotations

import hashlib
import hmac
import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from refract_core.errors import UsageError

SCOPES = {"read": "what there is, and the owner's own jobs", "render": "work, and its cancellation",
          "metrics": "/metrics"}  # fmt: skip
"""What a token can be for -> what that lets it ask."""
SIGNABLE = "/v1/thumbnails/"
"""Where the addresses begin that a signature opens, too. A look at one may be work."""
_SHORTEST = 8
_NAME = re.compile(r"[A-Za-z0-9._@-]{1,64}")
_DIGEST = re.compile(r"sha256:([0-9a-fA-F]{64})")


class Token(NamedTuple):
    owner: str
    digest: str
    """SHA-256, in small hexadecimal digits."""
    scopes: frozenset[str]


def tokens_of(lines: Iterable[str]) -> tuple[Token, ...]:
    """Raises UsageError: a line is not written as it must be. The text never holds what may be a token."""
    found: list[Token] = []
    for number, line in enumerate(lines, 1):
        words = line.split()
        if len(words) == 1:
            found.append(_plain(words[0]))
            continue
        named, digest = (_NAME.fullmatch(words[0]), _DIGEST.fullmatch(words[1])) if len(words) == 3 else (None, None)
        if not named or not digest:
            raise UsageError(f"token {number}: write NAME sha256:HEX SCOPES, or a token alone")
        scopes = frozenset(words[2].split(","))
        if unknown := scopes - SCOPES.keys():
            raise UsageError(f"token {number}, of {words[0]}: there is no scope {sorted(unknown)[0]!r}; choose from "
                             f"{', '.join(SCOPES)}")  # fmt: skip
        found.append(Token(words[0], digest[1].lower(), scopes))
    if len({token.digest for token in found}) < len(found):
        raise UsageError("one token stands in two lines; each may have one name")
    return tuple(found)


def _plain(token: str) -> Token:
    if len(token) < _SHORTEST:
        raise UsageError(f"a bearer token is shorter than {_SHORTEST} characters; take a long random one")
    digest = hashlib.sha256(token.encode()).hexdigest()
    return Token(f"token-{digest[:12]}", digest, frozenset(SCOPES))


def token_in(authorization: str, tokens: Sequence[Token]) -> Token | None:
    """The token of an `Authorization` header."""
    scheme, _, given = authorization.partition(" ")
    if scheme.lower() != "bearer":
        return None
    digest = hashlib.sha256(given.strip().encode("latin-1")).hexdigest()  # as a header's bytes came
    matches = [token for token in tokens if hmac.compare_digest(digest, token.digest)]
    return matches[0] if matches else None


def needed(method: str, path: str) -> str:
    """The scope that a request asks for; '' where everybody may."""
    if path == "/metrics":
        return "metrics"
    if not path.startswith("/v1/"):
        return ""
    looks = method in ("GET", "HEAD", "OPTIONS") and not path.startswith(SIGNABLE)
    return "read" if looks else "render"
