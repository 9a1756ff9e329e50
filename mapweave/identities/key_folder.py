"""The folder of a fleet's keys, beside its server: authority, identities, key files.

fleet.json        name of the fleet, profile, endpoints, identities; no secret in it
authority.pem     certificate of the authority; authority.key signs with it
passwords         of the lab profile, as the router reads them
tokens.json       hashes of the tokens for HTTP
NAME.key.toml     key file of NAME: copy it there
"""

from __future__ import annotations

import secrets
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec

from mapweave.hybridmap.errors import InvalidFile, InvalidValue, Refused, SettingsError
from mapweave.hybridmap.ids import check_name
from mapweave.identities.folder_changes import kept_on_failure, locked
from mapweave.identities.hosts import check_hosts, endpoints_of
from mapweave.identities.key_file import (
    SUFFIX,
    KeyFile,
    give_to_folders_owner,
    read_key_file,
    write_key_file,
    write_private,
)
from mapweave.identities.tokens import add_token, end_tokens, time_of
from mapweave.storage.atomic_file import read_whole, write_whole
from mapweave.storage.os_errors import reason_of
from mapweave.wire.bus_settings import DEFAULT_ENDPOINT, ENDPOINT, BusSettings
from mapweave.wire.conversion import json_value
from mapweave.wire.credentials import Credentials, Member, Role, RouterAccess

CATALOGUE = "fleet.json"
AUTHORITY, AUTHORITY_KEY, PASSWORDS = "authority.pem", "authority.key", "passwords"
PORT = 7447
"""Zenoh's default port."""
SERVER_DAYS = 825
"""Devices of Apple accept no certificate of a server that holds longer (support.apple.com, HT210176)."""
DAYS = 365
"""For which a key holds, unless it is said otherwise."""


class Profile(StrEnum):
    """How identities are proved."""

    LAB = "lab"
    """By user and password, unencrypted, for a trusted network."""
    PRODUCTION = "production"
    """By certificates, over mutual TLS."""


@dataclass(frozen=True)
class Identity:
    """A member of the fleet.

    Attributes:
        name: of the robot, server or person.
        role: what it may do.
        issued: when its present key was made, ISO 8601.
        expires: when that key ends, or an earlier one that holds longer; empty if it does not.
        subject: common name of its certificate, or its user name. After a revocation it is another one, since
            the old certificate still has the old one.
        revoked: when and why the key was revoked; empty while it is good.
        void: subjects of revoked keys, each with when and why.
    """

    name: str
    role: Role
    subject: str
    issued: str
    expires: str = ""
    revoked: str = ""
    void: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        """Refuse a name that leaves its folder or key, and an end that is no time (ValueError)."""
        _named(self.name)
        if self.expires:
            time_of(self.expires)

    @property
    def state(self) -> str:
        """The state in a word or two."""
        if self.revoked:
            return f"revoked {self.revoked}"
        over = self.expires and time_of(self.expires) <= datetime.now(UTC)
        return "expired" if over else "good"


@dataclass(frozen=True)
class Catalogue:
    """What is known of a fleet's keys.

    Attributes:
        fleet: its name.
        profile: how identities are proved.
        listen: where the router listens.
        endpoints: where robots find it.
        hosts: names and addresses in the server's certificate.
        identities: by the order in which they were added.
    """

    fleet: str
    profile: Profile
    listen: tuple[str, ...]
    endpoints: tuple[str, ...]
    hosts: tuple[str, ...]
    identities: tuple[Identity, ...] = field(default=())

    def __post_init__(self) -> None:
        """Refuse a name that leaves its key, and places where no router can listen (ValueError)."""
        _named(self.fleet)
        if not self.listen or not all(map(ENDPOINT.fullmatch, self.listen)):
            raise ValueError(f"listen: give endpoints such as {DEFAULT_ENDPOINT}")


def _named(name: str) -> None:
    try:
        check_name(name)
    except InvalidValue as error:
        # What is damaged in a file, msgspec names with its place.
        raise ValueError(str(error)) from None


class KeyFolder:
    """The keys of a fleet.

    What changes them holds the folder's lock, and first reads what other processes have changed.
    """

    def __init__(self, path: Path) -> None:
        """Read it.

        Raises:
            SettingsError: it is missing or damaged.
        """
        self.path = path
        self.catalogue = self._read_catalogue()

    def _read_catalogue(self) -> Catalogue:
        path = self.path
        try:
            return json_value(read_whole(path / CATALOGUE), Catalogue)
        except FileNotFoundError:
            raise SettingsError(f"{path}: no keys are here; make some with `mapweave keys init`") from None
        except NotADirectoryError:
            raise SettingsError(f"{path}: is a file; give the folder of `mapweave keys init`") from None
        except OSError as error:
            raise SettingsError(f"{path / CATALOGUE}: {reason_of(error)}") from None
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise SettingsError(f"{path / CATALOGUE}: {error}") from None

    @classmethod
    def create(
        cls, path: Path, fleet: str, profile: Profile, hosts: Sequence[str], server: str, port: int = PORT
    ) -> KeyFolder:
        """Make the authority and the server's key.

        Raises:
            InvalidValue: a host is no name or address.
            InvalidFile: there are keys already, or the disk does not take them; nothing is left there.
        """
        check_name(fleet)
        check_name(server)
        check_hosts(hosts)
        scheme = "tls" if profile is Profile.PRODUCTION else "tcp"
        reached = tuple(hosts) or ("127.0.0.1",)
        known = dict.fromkeys((*reached, "localhost", "127.0.0.1", "::1", socket.gethostname()))
        catalogue = Catalogue(
            fleet, profile, (f"{scheme}/0.0.0.0:{port}",),
            endpoints_of(reached, scheme, port),
            tuple(known),
        )  # fmt: skip
        new = not path.exists()
        path.mkdir(parents=True, exist_ok=True)
        try:
            with locked(path):
                if (path / CATALOGUE).exists():
                    raise InvalidFile(f"{path}: there are keys already; add to them with `mapweave keys add`")
                path.chmod(0o700)
                cls._make(path, catalogue, server)
        except BaseException:
            if new:
                with suppress(OSError):
                    path.rmdir()
            raise
        return cls(path)

    @classmethod
    def _make(cls, path: Path, catalogue: Catalogue, server: str) -> None:
        """Write all files, or none."""
        # A full disk leaves nothing, and not an authority without a server: moving takes no room.
        with TemporaryDirectory(dir=path, prefix=".") as beside:
            try:
                cls._fill(Path(beside), catalogue, server)
            except InvalidFile as error:
                raise InvalidFile(str(error).replace(str(Path(beside).resolve()), str(path))) from None
            for file in sorted(Path(beside).iterdir(), key=lambda file: file.name == CATALOGUE):
                file.replace(path / file.name)

    @classmethod
    def _fill(cls, path: Path, catalogue: Catalogue, server: str) -> None:
        """Write the authority, the catalogue and the server's key."""
        if catalogue.profile is Profile.PRODUCTION:
            from mapweave.identities.authority import Authority

            authority, private_key = Authority.create(catalogue.fleet)
            write_whole(path / AUTHORITY, authority.certificate.encode())
            write_private(path / AUTHORITY_KEY, private_key)
        write_whole(path / CATALOGUE, msgspec.json.format(msgspec.json.encode(catalogue), indent=1))
        cls(path).add(server, Role.SERVER, SERVER_DAYS)

    @property
    def profile(self) -> Profile:
        """How identities are proved."""
        return self.catalogue.profile

    def add(self, name: str, role: Role, days: float = DAYS, hosts: Sequence[str] = ()) -> Path:
        """Give an identity a key. One that it has and that was not revoked holds until it expires.

        Args:
            name: of the robot, server or person.
            role: what it may do.
            days: for which the key holds.
            hosts: of a server, where its router is reached besides the fleet's names of before. From now on
                certificates of servers have them, and new key files name them.

        Returns:
            Its key file.

        Raises:
            InvalidValue: it has a key, and another role; or a host is no name or address.
        """
        check_name(name)
        check_hosts(hosts)
        with self._changing():
            kept = self.catalogue
            scheme, _, place = kept.listen[0].partition("/")
            added = endpoints_of(hosts, scheme, int(place.rpartition(":")[2]))
            self.catalogue = replace(
                kept,
                endpoints=tuple(dict.fromkeys((*kept.endpoints, *added))),
                hosts=tuple(dict.fromkeys((*kept.hosts, *hosts))),
            )
            return self._add(name, role, days)

    def _add(self, name: str, role: Role, days: float) -> Path:
        known = self.find(name)
        if known is not None and not known.revoked and known.role is not role:
            article = "an" if known.role is Role.OPERATOR else "a"
            first = f"revoke that key first: mapweave keys revoke {name}"
            raise Refused(f"{name} is {article} {known.role} already; {first}")
        # Two keys of one second are two: a running server takes note of each.
        issued_at = datetime.now(UTC).isoformat(timespec="microseconds")
        void = () if known is None else known.void
        subject = f"{name}~{len(void)}" if void and self.profile is Profile.PRODUCTION else name
        if self.profile is Profile.PRODUCTION:
            from mapweave.identities.authority import Authority

            authority = Authority(self._read(AUTHORITY), self._read(AUTHORITY_KEY))
            hosts = self.catalogue.hosts
            issued = authority.issue(subject, role, timedelta(days=days), hosts)
            credentials = Credentials(
                name, role, authority.certificate, issued.certificate, issued.private_key
            )
            expires = issued.expires.isoformat(timespec="seconds")
            if known is not None and not known.revoked and time_of(known.expires) > issued.expires:
                # The router lets in the key of before as long as that holds.
                expires = known.expires
            identity = Identity(name, role, subject, issued_at, expires, void=void)
        else:
            credentials = Credentials(name, role, password=secrets.token_urlsafe(24))
            identity = Identity(name, role, subject, issued_at, void=void)
        if known is not None and known.revoked:
            # What a revocation that was cut off has left must not come back with the name.
            end_tokens(self.path, name)
        path = self.path / f"{name}{SUFFIX}"
        with kept_on_failure(path, self.path / PASSWORDS):
            write_key_file(path, KeyFile(self.catalogue.fleet, self.catalogue.endpoints, credentials))
            self._keep(identity, credentials.password)
        return path

    def revoke(self, name: str, because: str = "", force: bool = False) -> None:
        """Admit an identity no more.

        Args:
            name: whose key is revoked.
            because: why.
            force: also the only server.

        Raises:
            InvalidValue: there is none, its key is revoked, or it is the only server.
        """
        with self._changing():
            identity = self.find(name)
            good = [one for one in self.catalogue.identities if not one.revoked]
            if identity is None or identity.revoked:
                raise Refused(f"{name} has no key; these have: {', '.join(one.name for one in good)}")
            if not force and [one.name for one in good if one.role is Role.SERVER] == [name]:
                raise Refused(
                    f"{name} is the only server: add another one first, or give --force and then "
                    f"`mapweave keys add {name} --role server`"
                )
            when = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
            said = f"{when}{f': {because}' if because else ''}"
            with kept_on_failure(self.path / PASSWORDS):
                self._keep(replace(identity, revoked=said, void=(*identity.void, (identity.subject, said))))
            # Last: what could not be revoked stays as it was.
            (self.path / f"{name}{SUFFIX}").unlink(missing_ok=True)
            end_tokens(self.path, name)

    def token(self, name: str, days: float) -> str:
        """A new token with which an identity logs in over HTTP; only its hash is kept.

        Raises:
            InvalidValue: there is no such identity with a good key.
        """
        with self._changing():
            identity = self.find(name)
            if identity is None or identity.state != "good":
                raise Refused(f"{name} has no good key: make one, `mapweave keys add {name} --role ROLE`")
            return add_token(self.path, name, days)

    def end_tokens(self, name: str) -> int:
        """End all tokens of a name; returns how many there were."""
        with locked(self.path):
            return end_tokens(self.path, name)

    def find(self, name: str) -> Identity | None:
        """The identity of this name."""
        return next((one for one in self.catalogue.identities if one.name == name), None)

    def key_file(self, name: str) -> Path:
        """The key file of an identity.

        Raises:
            InvalidValue: it is not here.
        """
        path = self.path / f"{name}{SUFFIX}"
        if not path.exists():
            known = self.find(name)
            role = f" --role {known.role}" if known is not None and known.role is not Role.ROBOT else ""
            raise InvalidValue(f"{name} has no key here; make one with `mapweave keys add {name}{role}`")
        return path

    def router(
        self,
        server: str,
        listen: Sequence[str] = (),
        routers: Sequence[str] = (),
        own: Credentials | None = None,
    ) -> BusSettings:
        """Settings of one of the fleet's routers.

        Args:
            server: name of the map server, whose key the router has.
            listen: other endpoints than those of the keys.
            routers: that it joins.
            own: the key that the router has, if not that of the folder.

        Raises:
            InvalidValue, SettingsError: the server's key is not here, is of another role, or cannot be read.
        """
        catalogue, known = self.catalogue, self.find(server)
        add = f"mapweave keys add {server} --role {Role.SERVER}"
        if own is None and known is None:
            raise InvalidValue(f"{server} has no key here; make one with `{add}`")
        if known is not None and known.role is not Role.SERVER:
            # Other routers and robots would take nothing from it, and no one would see why.
            raise InvalidValue(
                f"the key of {server} is that of a {known.role}, and a map server needs one of its own role: "
                f"`mapweave keys revoke {server}`, then `{add}`, or another --name"
            )
        good = [Member(one.name, one.role, one.subject) for one in catalogue.identities if not one.revoked]
        bad = [pair for one in catalogue.identities for pair in one.void]
        passwords = str(self.path / PASSWORDS) if self.profile is Profile.LAB else ""
        return BusSettings(
            mode="router", listen=tuple(listen) or catalogue.listen, routers=tuple(routers),
            fleet=catalogue.fleet,
            credentials=own or read_key_file(self.key_file(server)).credentials,
            access=RouterAccess(tuple(good), passwords, tuple(bad)),
        )  # fmt: skip

    def changed(self) -> bool:
        """Whether identities came or went since this was read; afterwards this knows them."""
        before = self.catalogue
        self.catalogue = self._read_catalogue()
        return self.catalogue != before

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Hold the folder's lock, and know what others have changed before."""
        with locked(self.path):
            self.catalogue = self._read_catalogue()
            yield

    def _keep(self, identity: Identity, password: str = "") -> None:
        others = tuple(one for one in self.catalogue.identities if one.name != identity.name)
        catalogue = replace(self.catalogue, identities=(*others, identity))
        if self.profile is Profile.LAB:
            good = {one.name for one in others if not one.revoked}
            lines = [line for line in self._password_lines() if line.partition(":")[0] in good]
            if not identity.revoked:
                lines.append(f"{identity.name}:{password}")
            write_private(self.path / PASSWORDS, "".join(f"{line}\n" for line in lines))
        # Last: the server reads all of it again when this has changed.
        text = msgspec.json.format(msgspec.json.encode(catalogue), indent=1)
        write_whole(self.path / CATALOGUE, text)
        give_to_folders_owner(self.path / CATALOGUE)
        self.catalogue = catalogue

    def _password_lines(self) -> list[str]:
        """The router's lines of passwords.

        From key files, which may have been moved, only if these are gone.
        """
        if (self.path / PASSWORDS).exists():
            return self._read(PASSWORDS).splitlines()
        known = {one.name: self.path / f"{one.name}{SUFFIX}" for one in self.catalogue.identities}
        return [
            f"{n}:{read_key_file(path).credentials.password}" for n, path in known.items() if path.exists()
        ]

    def _read(self, name: str) -> str:
        try:
            return read_whole(self.path / name).decode()
        except OSError as error:
            raise SettingsError(f"{self.path / name}: {reason_of(error)}") from None
        except UnicodeDecodeError as error:
            raise SettingsError(f"{self.path / name}: {error}") from None
