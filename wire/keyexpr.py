"""Key expressions: what is a key, what is a pattern, and which patterns meet.

A key is chunks joined by `/`. In a pattern, `*` stands for one whole chunk and `**` for any number of them,
none included. This is the part of Zenoh's key expressions that Mapweave uses.
"""

from __future__ import annotations

import re
from functools import lru_cache

from mapweave.hybridmap.errors import InvalidValue

CHUNK = re.compile(r"[A-Za-z0-9._-]{1,64}")
MAX_CHUNKS = 16


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
        raise InvalidValue(f"{pattern!r} is no key pattern: '*' and '**' stand for whole chunks")
    return pattern


def is_key(pattern: str) -> bool:
    """Whether a pattern names exactly one key."""
    return "*" not in pattern


@lru_cache(maxsize=16384)
def intersects(one: str, other: str) -> bool:
    """Whether some key is matched by both patterns; a key is a pattern that matches itself."""
    return _meet(tuple(one.split("/")), tuple(other.split("/")))


def _meet(one: tuple[str, ...], other: tuple[str, ...]) -> bool:
    if not one:
        return all(chunk == "**" for chunk in other)
    if not other:
        return all(chunk == "**" for chunk in one)
    if one[0] == "**":
        return _meet(one[1:], other) or _meet(one, other[1:])
    if other[0] == "**":
        return _meet(one, other[1:]) or _meet(one[1:], other)
    return (one[0] == other[0] or "*" in (one[0], other[0])) and _meet(one[1:], other[1:])
