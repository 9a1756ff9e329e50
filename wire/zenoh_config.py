"""The session settings: no scouting, only the configured endpoints."""

import base64
import json
from typing import Any

from mapweave.wire.access_rules import access_control
from mapweave.wire.bus_settings import (
    NEXT_ENDPOINT,
    RETRY_FIRST,
    RETRY_LONGEST,
    ROUTER_QUEUE,
    BusSettings,
)
from mapweave.wire.credentials import Credentials
from mapweave.wire.keys import Keys

ACCEPT_PENDING = 8192
"""Connections of which a router does not know yet who they are."""
ACCEPT_TIMEOUT = 10.0
"""s; a silent new connection is dropped after this time. A handshake that a busy router breaks off at its end
leaves a client that believes itself connected, and of which the router knows nothing."""
MAX_SESSIONS = 16384
"""Robots, people and routers that a router takes at once. With Zenoh's own 1000 the thousandth robot
tries to connect for ever and is given no reason."""

LARGEST = {"put": 2**18, "query": 2**20, "reply": 2**25}
"""Bytes of what a client may send: twice a change, several views, the largest piece of a log. The router
drops what is larger before anything reads it."""


LARGEST_MESSAGE = 2**26
"""Bytes of a message that a router puts together: twice the largest reply. Zenoh's own default is 1 GiB."""


def session_values(settings: BusSettings) -> dict[str, object]:
    """Zenoh's configuration, by path."""
    retry = {
        "period_init_ms": round(RETRY_FIRST * 1e3),
        "period_max_ms": round(RETRY_LONGEST * 1e3),
        "period_increase_factor": 2,
    }
    routes = settings.mode == "router"
    endpoints = settings.routers if routes else settings.endpoints
    attempt = settings.attempt if len(endpoints) == 1 else min(settings.attempt, NEXT_ENDPOINT)
    values: dict[str, object] = {
        "mode": settings.mode,
        "connect/endpoints": list(endpoints),
        "listen/endpoints": list(settings.listen) if routes else [],
        "connect/retry": retry,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # There is no scouting, so opening a router need not wait half a second for it.
        "scouting/delay": 1,
        # With Zenoh's own 100, a hundred idle connections keep all others out.
        "transport/unicast/accept_pending": ACCEPT_PENDING,
        "transport/unicast/accept_timeout": round(ACCEPT_TIMEOUT * 1e3),
        "transport/unicast/open_timeout": round(attempt * 1e3),
        "transport/link/tx/lease": round(settings.lease * 1e3),
        "transport/link/tx/queue/size/data": ROUTER_QUEUE if routes else 2,
        "transport/shared_memory/enabled": False,
    }
    if routes:
        values["transport/unicast/max_sessions"] = MAX_SESSIONS
        values["transport/link/rx/max_message_size"] = LARGEST_MESSAGE
        values["low_pass_filter"] = [
            {"id": name, "flows": ["ingress"], "messages": [name], "key_exprs": ["mapweave/**"],
             "size_limit": size}
            for name, size in LARGEST.items()
        ]  # fmt: skip
    if settings.session:
        values["id"] = settings.session
    if settings.timestamps:
        values["timestamping/enabled"] = True
    if settings.credentials is not None:
        values |= _proof(settings.credentials, settings)
    if settings.access is not None:
        certified = settings.credentials is not None and settings.credentials.certified
        values["access_control"] = access_control(Keys(settings.fleet), settings.access, certified)
        if settings.access.passwords:
            values["transport/auth/usrpwd/dictionary_file"] = settings.access.passwords
    return values


def router_file(settings: BusSettings) -> str:
    """The same as a configuration file, for a zenohd."""
    tree: dict[str, Any] = {}
    for path, value in session_values(settings).items():
        *folders, last = path.split("/")
        node = tree
        for folder in folders:
            node = node.setdefault(folder, {})
        node[last] = value
    return json.dumps(tree, indent=2)


def _proof(credentials: Credentials, settings: BusSettings) -> dict[str, object]:
    if not credentials.certified:
        return {
            "transport/auth/usrpwd/user": credentials.name,
            "transport/auth/usrpwd/password": credentials.password,
        }
    sides = {"client": ("connect",), "router": ("listen", "connect") if settings.routers else ("listen",)}
    own = {
        f"{side}_{part}_base64": _base64(text)
        for side in sides[settings.mode]
        for part, text in (
            ("private_key", credentials.private_key),
            ("certificate", credentials.certificate),
        )
    }
    return {
        "transport/link/tls": {
            "root_ca_certificate_base64": _base64(credentials.authority),
            **own,
            "enable_mtls": True,
            "close_link_on_expiration": True,
            # A router has whatever address the network gave it. Its certificate is one of the fleet's
            # authority, and no robot's key would pass: see the name constraint of `server_name`.
            "verify_name_on_connect": True,
        }
    }


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()
