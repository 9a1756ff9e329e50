"""The names and addresses under which a fleet's routers are reached."""

import ipaddress
import re
from collections.abc import Iterable

from mapweave.hybridmap.errors import InvalidValue

HOST_NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?")


def check_hosts(hosts: Iterable[str]) -> None:
    """Refuse what is no name and no address (InvalidValue)."""
    for host in hosts:
        # What ends in a number is an address: no such name exists.
        is_name = HOST_NAME.fullmatch(host) and not host.rpartition(".")[2].isdigit()
        if not (is_name or _is(ipaddress.IPv4Address, host) or _is(ipaddress.IPv6Address, host)):
            raise InvalidValue(
                f"--at {host!r}: write a name or an address without a port, such as 192.168.1.10"
            )


def endpoints_of(hosts: Iterable[str], scheme: str, port: int) -> tuple[str, ...]:
    """Where robots find the routers at these hosts, as Zenoh writes it."""
    return tuple(f"{scheme}/{f'[{host}]' if ':' in host else host}:{port}" for host in hosts)


def _is(address: type[ipaddress.IPv4Address | ipaddress.IPv6Address], host: str) -> bool:
    try:
        address(host)
    except ValueError:
        return False
    return "%" not in host
