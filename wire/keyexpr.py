"""Key expressions: what is a key, what is a pattern, and which patterns meet.

A key is chunks joined by `/`. In a pattern, `*` matches one whole chunk and `**` any number of them,
none included. This is the part of Zenoh's key expressions that Mapweave uses.
"""

import re
from functools import lru_cache

from mapweave.hybridmap.errors import InvalidValue

CHUNK = re.compile(r"[A-Za-z0-9._-]{1,64}")
MAX_CHUNKS = 16
"""Parts of a key. A limit for messages."""


@lru_cache(maxsize=4096)
def check_key(key: str) -> str:
    """Return the key, or raise InvalidValue if it is none: Zenoh itself would put on `a/*` without a word."""
    chunks = key.split("/")
    if len(chunks) > MAX_CHUNKS or not all(CHUNK.fullmatch(chunk) for chunk in chunks):
        raise InvalidValue(f"{key!r} is no key: use chunks of a-z, 0-9, '.', '-', '_' joined by '/'")
    return key


@lru_cache(maxsize=4096)
def check_pattern(pattern: str) -> str:
    """Return the pattern, or raise InvalidValue if it is neither a key nor one with `*` or `**`."""
    chunks = pattern.split("/")
    if len(chunks) > MAX_CHUNKS or not all(c in ("*", "**") or CHUNK.fullmatch(c) for c in chunks):
        raise InvalidValue(f"{pattern!r} is no key pattern: '*' and '**' match whole chunks")
    return pattern


def is_key(pattern: str) -> bool:
    """Whether a pattern names exactly one key."""
    return "*" not in pattern


@lru_cache(maxsize=16384)
def intersects(a: str, b: str) -> bool:
    """Whether some key is matched by both patterns; a key is a pattern that matches itself."""
    return _meet(tuple(a.split("/")), tuple(b.split("/")))


def answered(asked: str, served: str) -> str:
    """The key under which a service answers: one that the question's pattern and its own both match.

    A question for `server/*/constrain/anna` at the service `server/s0/constrain/*` is answered under
    `server/s0/constrain/anna`. Where both leave a chunk open it is a pattern.
    """
    if is_key(asked) or "**" in asked or "**" in served:
        return asked if is_key(asked) else served
    pairs = zip(asked.split("/"), served.split("/"), strict=True)
    return "/".join(there if here == "*" else here for here, there in pairs)


def _meet(a: tuple[str, ...], b: tuple[str, ...]) -> bool:
    if not a:
        return all(chunk == "**" for chunk in b)
    if not b:
        return all(chunk == "**" for chunk in a)
    if a[0] == "**":
        return _meet(a[1:], b) or _meet(a, b[1:])
    if b[0] == "**":
        return _meet(a, b[1:]) or _meet(a[1:], b)
    return (a[0] == b[0] or "*" in (a[0], b[0])) and _meet(a[1:], b[1:])
