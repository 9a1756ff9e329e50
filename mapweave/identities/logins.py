"""Whose a token is, and whether that still holds. The files are read again whenever they have changed."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from mapweave.hybridmap.errors import SettingsError
from mapweave.identities.key_folder import CATALOGUE, Identity, KeyFolder
from mapweave.identities.tokens import TOKENS, StoredToken, hash_of, read_tokens
from mapweave.wire.credentials import Role

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Login:
    """A member of the fleet who has shown a token.

    Attributes:
        name: whose token it is.
        role: what that one may do.
        sha256: hash of the token.
    """

    name: str
    role: Role
    sha256: str


class Logins:
    """Logins of the members of one fleet. Thread-safe: nothing but whole values is replaced.

    Attributes:
        hosts: names and addresses under which the fleet's server is reached.
    """

    def __init__(self, folder: Path) -> None:
        """Read the identities and their tokens.

        Raises:
            SettingsError: they are missing or damaged.
        """
        self._folder = folder
        catalogue = KeyFolder(folder).catalogue
        self.hosts = catalogue.hosts
        self._seen: tuple[tuple[int, int, int], ...] = ()
        self._tokens: Mapping[str, tuple[StoredToken, Identity]] = {}
        self._read()

    def login(self, token: str) -> Login | None:
        """Whose token it is; None if it is no good one."""
        sha256 = hash_of(token)
        found = self._good(sha256)
        return None if found is None else Login(found.name, found.role, sha256)

    def good(self, login: Login) -> bool:
        """Whether a login still holds: neither the token nor the identity was revoked or has expired."""
        found = self._good(login.sha256)
        return found is not None and (found.name, found.role) == (login.name, login.role)

    def _good(self, sha256: str) -> Identity | None:
        seen = self._stamps()
        if seen != self._seen:
            try:
                self._read()
            except SettingsError as error:
                # What cannot be read lets no client in.
                log.error("no login is possible: %s", error)
                self._seen, self._tokens = seen, {}
        token, identity = self._tokens.get(sha256, (None, None))
        if token is None or identity is None or token.expired or identity.state != "good":
            return None
        return identity

    def _read(self) -> None:
        seen = self._stamps()
        known = {one.name: one for one in KeyFolder(self._folder).catalogue.identities}
        tokens = read_tokens(self._folder)
        self._tokens = {one.sha256: (one, known[one.name]) for one in tokens if one.name in known}
        self._seen = seen

    def _stamps(self) -> tuple[tuple[int, int, int], ...]:
        return tuple(_stamp(self._folder / name) for name in (CATALOGUE, TOKENS))


def _stamp(path: Path) -> tuple[int, int, int]:
    """What changes when a file is replaced."""
    try:
        found = path.stat()
    except OSError:
        return 0, 0, 0
    return found.st_ino, found.st_mtime_ns, found.st_size
