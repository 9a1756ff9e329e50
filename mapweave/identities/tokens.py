"""Tokens with which members of a fleet log in over HTTP. Only their hashes are kept, beside the identities.

A token is 32 random bytes, so its plain SHA-256 cannot be turned back, and no guess meets it. They
are changed by `KeyFolder`, with the lock of its folder held.
"""

import hashlib
import secrets
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec

from mapweave.hybridmap.errors import SettingsError
from mapweave.identities.key_file import write_private
from mapweave.storage.atomic_file import read_whole
from mapweave.storage.os_errors import reason_of
from mapweave.wire.conversion import json_value

TOKENS = "tokens.json"
PREFIX = "mapweave_"
"""By which people and scanners know a token when they see one."""


@dataclass(frozen=True)
class StoredToken:
    """What is kept of a token.

    Attributes:
        name: whose it is.
        sha256: its hash, hexadecimal.
        issued: when it was made, ISO 8601.
        expires: when it ends.
    """

    name: str
    sha256: str
    issued: str
    expires: str

    def __post_init__(self) -> None:
        """Refuse an end that is no time (ValueError)."""
        time_of(self.expires)

    @property
    def expired(self) -> bool:
        """Whether it has ended."""
        return time_of(self.expires) <= datetime.now(UTC)


def time_of(words: str) -> datetime:
    """A time in the words of ISO 8601.

    Raises:
        ValueError: it is none, or its offset from UTC is missing.
    """
    try:
        time = datetime.fromisoformat(words)
    except ValueError:
        time = None
    if time is None or time.tzinfo is None:
        raise ValueError(f"{words[:40]!r} is no time with its offset from UTC")
    return time


def hash_of(token: str) -> str:
    """The hash by which a token is known."""
    return hashlib.sha256(token.encode("utf-8", errors="replace")).hexdigest()


def read_tokens(folder: Path) -> tuple[StoredToken, ...]:
    """All tokens of a folder of keys, oldest first.

    Raises:
        SettingsError: their file is damaged.
    """
    try:
        return json_value(read_whole(folder / TOKENS), tuple[StoredToken, ...])
    except FileNotFoundError:
        return ()
    except OSError as error:
        raise SettingsError(f"{folder / TOKENS}: {reason_of(error)}") from None
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{folder / TOKENS}: {error}") from None


def add_token(folder: Path, name: str, days: float) -> str:
    """Make a token; it is returned, and nowhere else."""
    token, now = PREFIX + secrets.token_urlsafe(32), datetime.now(UTC)
    expires = (now + timedelta(days=days)).isoformat(timespec="seconds")
    made = StoredToken(name, hash_of(token), now.isoformat(timespec="seconds"), expires)
    _write(folder, (*(one for one in read_tokens(folder) if not one.expired), made))
    return token


def end_tokens(folder: Path, name: str) -> int:
    """End all tokens of a name; returns how many there were."""
    before = read_tokens(folder)
    left = tuple(one for one in before if one.name != name)
    if len(left) < len(before):
        _write(folder, left)
    return len(before) - len(left)


def _write(folder: Path, tokens: tuple[StoredToken, ...]) -> None:
    write_private(folder / TOKENS, msgspec.json.format(msgspec.json.encode(tokens), indent=1).decode() + "\n")
