"""Where HTTP is served, and to which clients: `--http`, with the keys of the fleet if there are any."""

from __future__ import annotations

import socket
import ssl
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mapweave.commands.usage import arguments_read

if TYPE_CHECKING:
    from mapweave.identities.key_folder import KeyFolder
    from mapweave.identities.logins import Logins
    from mapweave.mapserver.http.answering import Answering
    from mapweave.mapserver.http.last_shown import LastShown
    from mapweave.mapserver.http.web import Web
    from mapweave.wire.credentials import Credentials


ALL_ADDRESSES = ("0.0.0.0", "::")
"""To listen at, not to open."""
OWN = "localhost"


@dataclass(frozen=True)
class HttpAccess:
    """How HTTP is served.

    Attributes:
        address: host and port; port 0 takes a free one.
        logins: of the fleet's members; None without keys.
        tls: serves HTTPS; None without certificates.
    """

    address: tuple[str, int]
    logins: Logins | None
    tls: ssl.SSLContext | None

    def url(self, port: int) -> str:
        """The address for people: where all addresses are served, by a name that the certificate has.

        Args:
            port: at which the page is served; of `Web.port`, since port 0 takes a free one.
        """
        host, _ = self.address
        if self.logins is not None and host in ALL_ADDRESSES:
            host = _name_of(self.logins.hosts)
        scheme = "http" if self.tls is None else "https"
        return f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}/"

    def serve(self, server: Answering, before: LastShown | None = None) -> Web:
        """Open the port.

        Args:
            server: answers.
            before: what the page shows until the server has merged; see `mapserver.http.live.LiveUpdates`.
        """
        from mapweave.mapserver.http.last_shown import NOTHING
        from mapweave.mapserver.http.web import Web

        return Web(self.address, server, logins=self.logins, tls=self.tls, before=before or NOTHING)

    def renew(self, own: Credentials) -> None:
        """Go on with another certificate."""
        from mapweave.mapserver.http.tls import load

        if self.tls is not None:
            load(self.tls, own)


def _name_of(hosts: Sequence[str]) -> str:
    """The one name by which other machines reach the fleet's server; its own of several or of none."""
    from mapweave.mapserver.http.request_site import is_loopback

    machine = (OWN, socket.gethostname())
    others = [host for host in hosts if host not in machine and not is_loopback(host)]
    return others[0] if len(others) == 1 else OWN


def http_access(words: str, folder: KeyFolder | None, server: str) -> HttpAccess:
    """How HTTP is served.

    Args:
        words: `PORT` or `HOST:PORT`.
        folder: of the fleet's keys.
        server: whose certificate it is.

    Raises:
        UsageError: other machines would be served without a login, or unencrypted.
        SettingsError: a key is missing.
    """
    from mapweave.identities.key_file import read_key_file
    from mapweave.identities.logins import Logins
    from mapweave.mapserver.http.tls import server_context
    from mapweave.mapserver.http.web import check_reach, parse_address

    logins, tls = None, None
    with arguments_read():
        address = parse_address(words)
    if folder is not None:
        logins = Logins(folder.path)
        tls = server_context(read_key_file(folder.key_file(server)).credentials)
    with arguments_read():
        check_reach(address, logins is not None, tls is not None)
    return HttpAccess(address, logins, tls)
