"""How a ROS 2 graph is reached."""

import os
import re
from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from mapweave.hybridmap.errors import SettingsError
from mapweave.wire.bus_settings import DEFAULT_ENDPOINT, ENDPOINT

NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
"""One part of a ROS name."""
DOMAIN_VARIABLE = "ROS_DOMAIN_ID"
LARGEST_DOMAIN = 232
"""Largest number that DDS knows."""


@dataclass(frozen=True)
class Ros2Link:
    """A ROS 2 graph behind a Zenoh router.

    Attributes:
        endpoint: Zenoh endpoint of `rmw_zenohd`, of another router, or of the bridge.
        domain: ROS domain; None takes the environment variable ROS_DOMAIN_ID, else 0.
        namespace: of the robot, for example `/robot1`. Topics without a leading slash are in it. With
            `bridge` it is the namespace that the bridge is started with.
        bridge: whether zenoh-bridge-ros2dds connects the robot, not rmw_zenoh.
    """

    endpoint: str = DEFAULT_ENDPOINT
    domain: Annotated[int, Meta(ge=0, le=LARGEST_DOMAIN)] | None = None
    namespace: str = ""
    bridge: bool = False

    def __post_init__(self) -> None:
        """Refuse what cannot work.

        Raises:
            SettingsError: an endpoint or a namespace that is none.
        """
        if not ENDPOINT.fullmatch(self.endpoint):
            raise SettingsError(f"endpoint {self.endpoint!r}: endpoints look like {DEFAULT_ENDPOINT}")
        if self.namespace.strip("/"):
            check_name(self.namespace.strip("/"))

    def domain_id(self) -> int:
        """The number of the domain.

        Raises:
            SettingsError: the environment variable is no number of a domain.
        """
        if self.domain is not None:
            return self.domain
        text = os.environ.get(DOMAIN_VARIABLE, "") or "0"
        if not (text.isascii() and text.isdigit() and int(text) <= LARGEST_DOMAIN):
            raise SettingsError(f"{DOMAIN_VARIABLE} is {text!r}; it must be 0 to {LARGEST_DOMAIN}")
        return int(text)

    def topic(self, name: str) -> str:
        """The full name of a topic, with a leading slash.

        Raises:
            SettingsError: it is no name of a topic.
        """
        check_name(name)
        # A bridge puts its namespace before every topic, those with a leading slash included.
        absolute = name.startswith("/") and not self.bridge
        parts = (name,) if absolute else (self.namespace, name)
        return "".join(f"/{part.strip('/')}" for part in parts if part.strip("/"))


def check_name(name: str) -> str:
    """Return a topic or namespace, or raise SettingsError if it is none."""
    parts = name.removeprefix("/").split("/")
    if not all(NAME.fullmatch(part) for part in parts):
        raise SettingsError(
            f"{name!r} is no ROS name: use parts of a-z, A-Z, 0-9 and '_' that begin with no digit, "
            "joined by '/'"
        )
    return name
