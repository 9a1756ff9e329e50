"""The one file that a robot or a person gets: who they are, their key, and where the server is. TOML."""

import os
import stat
from dataclasses import dataclass
from pathlib import Path

from mapweave.hybridmap.errors import InvalidValue, SettingsError
from mapweave.hybridmap.ids import check_name
from mapweave.storage.atomic_file import write_whole
from mapweave.storage.os_errors import reason_of
from mapweave.storage.settings_file import build, read_toml
from mapweave.wire.credentials import Credentials, Role

SUFFIX = ".key.toml"
PRIVATE = 0o600
"""Permissions: only its owner may read it."""


@dataclass(frozen=True, slots=True)
class KeyFile:
    """Content of a key file.

    Attributes:
        fleet: its name.
        endpoints: of the fleet's router, tried in order.
        credentials: of one identity.
    """

    fleet: str
    endpoints: tuple[str, ...]
    credentials: Credentials

    def __post_init__(self) -> None:
        """Refuse names that cannot be parts of keys (InvalidValue)."""
        check_name(self.fleet)
        check_name(self.credentials.name)


@dataclass(frozen=True, slots=True)
class _Table:
    name: str
    role: Role
    fleet: str
    endpoints: tuple[str, ...]
    authority: str = ""
    certificate: str = ""
    private_key: str = ""
    password: str = ""


def read_key_file(path: Path) -> KeyFile:
    """Read a key file.

    Raises:
        SettingsError: it is missing, is no key file, or others than its owner may read it.
    """
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
    except FileNotFoundError:
        raise SettingsError(
            f"{path}: no such key file; `mapweave keys add NAME` at the server makes one: copy it here"
        ) from None
    except OSError as error:
        raise SettingsError(f"{path}: the key file cannot be read: {reason_of(error)}") from None
    if path.is_dir():
        raise SettingsError(f"{path}: is a folder; give one of the key files in it, NAME{SUFFIX}")
    try:
        try:
            table = build(_Table, read_toml(path), str(path))
        except SettingsError as error:
            if isinstance(error.__context__, OSError):
                raise  # what cannot be read may be whole
            raise SettingsError(f"{error}; it is no key file, or not whole: copy it once more") from None
        # systemd hands keys over in a folder of the service's own.
        handed_over = os.environ.get("CREDENTIALS_DIRECTORY") == str(path.parent)
        if mode & 0o077 and not handed_over:
            raise SettingsError(f"{path}: others may read this key (mode {mode:03o}); run: chmod 600 {path}")
        credentials = Credentials(
            table.name, table.role, table.authority, table.certificate, table.private_key, table.password
        )
        return KeyFile(table.fleet, table.endpoints, credentials)
    except InvalidValue as error:
        raise SettingsError(f"{path}: {error}") from None


def write_key_file(path: Path, content: KeyFile) -> None:
    """Write a key file that only its owner may read."""
    c = content.credentials
    endpoints = ", ".join(f'"{endpoint}"' for endpoint in content.endpoints)
    lines = [
        f"# The key of {c.name} ({c.role}) in fleet {content.fleet}. Its holder is {c.name} for the fleet.",
        f'name = "{c.name}"', f'role = "{c.role}"', f'fleet = "{content.fleet}"',
        f"endpoints = [{endpoints}]",
    ]  # fmt: skip
    if c.certified:
        parts = {"authority": c.authority, "certificate": c.certificate, "private_key": c.private_key}
        lines += [f"{name} = '''\n{pem.strip()}\n'''" for name, pem in parts.items()]
    else:
        lines.append(f'password = "{c.password}"')
    write_private(path, "\n".join(lines) + "\n")


def write_private(path: Path, text: str) -> None:
    """Write a file that only its owner can read, from its first byte."""
    before = os.umask(0o077)
    try:
        write_whole(path, text.encode())
    finally:
        os.umask(before)
    path.chmod(PRIVATE)
    give_to_folders_owner(path)


def give_to_folders_owner(path: Path) -> None:
    """A file that root writes belongs to the owner of its folder.

    A server that systemd runs owns the folder of its keys; it reads what `sudo mapweave keys add` writes.
    """
    if os.geteuid() == 0:
        folder = path.parent.stat()
        os.chown(path, folder.st_uid, folder.st_gid)
