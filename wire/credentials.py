"""What proves to a router who connects, and to a client which router it is: certificates or a password."""

from dataclasses import dataclass, field
from enum import StrEnum

from mapweave.hybridmap.errors import SettingsError


class Role(StrEnum):
    """What an identity may do; see `mapweave.wire.access_rules`."""

    ROBOT = "robot"
    """Publishes its own map, asks the server, answers for itself."""
    SERVER = "server"
    """Runs the router and the map server."""
    OPERATOR = "operator"
    """Reads everything, gives missions, drives robots, corrects the map."""
    VIEWER = "viewer"
    """Reads the map, the robots and explanations."""


@dataclass(frozen=True, slots=True)
class Credentials:
    """The credentials of one identity: either certificates, or a password.

    Attributes:
        name: of the identity: the certificate's common name, or the user name.
        role: what it may do.
        authority: certificate of the fleet's authority, PEM.
        certificate: signed by it, PEM.
        private_key: PEM.
        password: of user `name`.
    """

    name: str
    role: Role
    authority: str = field(default="", repr=False)
    certificate: str = field(default="", repr=False)
    private_key: str = field(default="", repr=False)
    password: str = field(default="", repr=False)

    def __post_init__(self) -> None:
        """Refuse half of either.

        Raises:
            SettingsError: a part is missing.
        """
        certified = bool(self.authority), bool(self.certificate), bool(self.private_key)
        if any(certified) == bool(self.password) or any(certified) != all(certified):
            raise SettingsError(
                f"the key of {self.name} needs authority, certificate and private_key, or a password"
            )

    @property
    def certified(self) -> bool:
        """Whether it is a certificate, not a password."""
        return bool(self.certificate)


@dataclass(frozen=True, slots=True)
class Member:
    """An identity that a router admits.

    Attributes:
        name: the agent's, the server's or the person's.
        role: what it may do.
        subject: the common name of its certificate, or its user name.
    """

    name: str
    role: Role
    subject: str


@dataclass(frozen=True, slots=True)
class RouterAccess:
    """The members that a router admits.

    Attributes:
        members: with good keys.
        passwords: file with a line `name:password` for each user, where there are no certificates.
        revoked: subjects whose keys were revoked, with when and why, for the log. They are denied everything.
    """

    members: tuple[Member, ...]
    passwords: str = ""
    revoked: tuple[tuple[str, str], ...] = ()
