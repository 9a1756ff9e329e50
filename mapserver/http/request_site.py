"""Whether a request comes from this machine's own pages or from no page at all, by its headers.

A page of another site can make a browser on the robots' network send requests here. Headers that a page
cannot choose prevent this: `Origin` names the page's site, `Host` the name under which this server was looked
up. A name that an attacker points at this machine (DNS rebinding) is not in the list; an address is always
its own.
Images and scripts of a page are asked for without `Origin`: `Sec-Fetch-Site` says that the page is another's.
"""

import ipaddress
import socket

from mapweave.hybridmap.errors import InvalidValue


def own_names(listens_at: str) -> frozenset[str]:
    """Names of this machine, in addition to its addresses.

    Args:
        listens_at: host at which the server listens.
    """
    name = socket.gethostname().lower()
    return frozenset({"localhost", name, f"{name.partition('.')[0]}.local", listens_at.lower()})


def check_site(host: str | None, origin: str | None, names: frozenset[str], encrypted: bool = False) -> None:
    """Refuse requests that another site's page sends.

    Args:
        host: the header `Host`.
        origin: the header `Origin`; browsers send it with what a script or a form of a page asks.
        names: of this machine.
        encrypted: whether the request came by HTTPS; an unencrypted page of the same name may be another's.

    Raises:
        InvalidValue: another site's, in words.
    """
    if not host or not (_is_address(name := _without_port(host)) or name in names):
        raise InvalidValue(
            f"this server is not {(host or 'named')[:80]!r}: use its address or this machine's name"
        )
    schemes = ("https",) if encrypted else ("http", "https")
    if origin is not None and origin.lower() not in {f"{scheme}://{host.lower()}" for scheme in schemes}:
        raise InvalidValue(f"pages of {origin[:80]!r} may not ask here")


def check_part(site: str | None, destination: str | None) -> None:
    """Refuse what another site's page shows as a part of itself: each request may keep this server busy.

    Args:
        site: the header `Sec-Fetch-Site`, which scripts and older browsers do not send.
        destination: the header `Sec-Fetch-Dest`; a link to this server's page opens a document.

    Raises:
        InvalidValue: another site's, in words.
    """
    if site in ("cross-site", "same-site") and destination != "document":
        raise InvalidValue("pages of other sites may not show parts of this server")


def _without_port(host: str) -> str:
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0].lower().removesuffix(".")


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def is_loopback(host: str) -> bool:
    """Whether an address is of this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
