"""Keys and liveliness tokens of rmw_zenoh, and those of zenoh-bridge-ros2dds.

rmw_zenoh (its docs/design.md):

    <domain>/<topic>/<type>/<hash>                                 messages
    @ros2_lv/<domain>/<session>/<node>/<node>/NN/<enclave>/<namespace>/<name>
                                                                   a node
    @ros2_lv/<domain>/<session>/<node>/<entity>/MP|MS/<enclave>/<namespace>/<name>/
        <topic>/<type>/<hash>/<quality of service>[/<backends>]    a publisher, a subscriber

In a token `%` replaces each `/` of a name. Backends are named since rmw_zenoh_cpp 0.10.5 (Lyrical), 0.12.0,
for types with byte arrays, images among them: `backends:cpu:`, and further kinds of memory. Such a publisher
leaves the key of its messages unused while it can reach each subscriber by another key. Subscribers that name
the CPU alone share `<key>/_buf_cpu`, where messages are the same bytes. One that names none gets nothing.

The bridge's key is the topic itself; its tokens are
`@/<session>/@ros2_lv/MP|MS/<topic>/<type>/<quality of service>`, where `§` replaces each `/`.
"""

import re
from dataclasses import dataclass, field
from enum import StrEnum

from mapweave.hybridmap.errors import InvalidMessage
from mapweave.wire.ros2.settings import NAME, Ros2Link

ADMIN = "@ros2_lv"
NO_HASH = "TypeHashNotSupported"
"""In the place of the type's hash where ROS 2 Humble publishes or subscribes."""
HASH = re.compile(rf"RIHS01_[0-9a-f]{{64}}|{NO_HASH}")
DDS_TYPE = re.compile(r"(\w+)::msg::dds_::(\w+)_")
ROS_TYPE = re.compile(r"\w+/msg/\w+")
CPU_BACKEND, CPU_MESSAGES = "backends:cpu:", "_buf_cpu"
"""The last part of the token of a subscriber without other memory, and of the key of messages to such."""
RELIABLE, TRANSIENT_LOCAL, VOLATILE, KEEP_LAST = 1, 1, 2, 1
"""Numbers of rmw/types.h."""


class EndpointRole(StrEnum):
    """What an endpoint of a topic does."""

    PUBLISHER = "MP"
    SUBSCRIBER = "MS"


@dataclass(frozen=True)
class Endpoint:
    """A publisher or subscriber, as its token announces it.

    Attributes:
        topic: full name, with a leading slash.
        kind: type, for example `nav_msgs/msg/Odometry`.
        type_hash: of the type's definition; empty with the bridge.
        backends: whether its token names backends; the messages are the same.
    """

    topic: str
    kind: str
    type_hash: str = ""
    backends: bool = field(default=False, compare=False)


def dds_type(kind: str) -> str:
    """`nav_msgs/msg/Odometry` as DDS names it: `nav_msgs::msg::dds_::Odometry_`."""
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"


def ros_type(dds: str) -> str:
    """The inverse of `dds_type`; empty if it is no message."""
    found = DDS_TYPE.fullmatch(dds)
    return f"{found[1]}/msg/{found[2]}" if found else ""


class CommandKeys:
    """Tokens of the agents that drive a robot by a topic, beside those of ROS, which the bridge lacks.

    `mapweave_driver/<domain, or bridge>/<topic>/<number>`.
    """

    def __init__(self, link: Ros2Link) -> None:
        self._root = f"mapweave_driver/{'bridge' if link.bridge else link.domain_id()}"

    def robot_drivers_of(self, topic: str) -> str:
        """Pattern: all agents that drive by a topic."""
        return f"{self._root}/{topic.strip('/')}/*"

    def robot_driver(self, topic: str, number: int) -> str:
        """Liveliness of one of them."""
        return f"{self._root}/{topic.strip('/')}/{number}"

    def parse_robot_driver(self, key: str) -> tuple[str, int]:
        """The topic by which one drives, and the number of who does.

        Raises:
            InvalidMessage: it is no such key.
        """
        topic, _, number = key.removeprefix(f"{self._root}/").rpartition("/")
        if not (number.isascii() and number.isdigit()):
            raise InvalidMessage(f"{key}: is no agent that drives")
        return f"/{topic}", int(number)


class RmwZenohKeys:
    """Keys of rmw_zenoh in one domain, for one node of one session."""

    def __init__(self, link: Ros2Link, session: str, node: str) -> None:
        """Take the names.

        Args:
            link: domain and namespace.
            session: id of the Zenoh session, hexadecimal.
            node: name of the node.
        """
        self._domain = link.domain_id()
        self._namespace = _mangled("/" + link.namespace.strip("/"))
        self._session, self._node = session, node

    def messages(self, endpoint: Endpoint) -> str:
        """The key of a topic's messages of one type."""
        where = f"{self._domain}/{endpoint.topic.strip('/')}"
        return f"{where}/{dds_type(endpoint.kind)}/{endpoint.type_hash}"

    def all_messages(self, topic: str) -> tuple[str, ...]:
        """The patterns of a topic's messages of any type; each message comes by one of them."""
        messages = f"{self._domain}/{topic.strip('/')}/*/*"
        return messages, f"{messages}/{CPU_MESSAGES}"

    def kind_of(self, key: str) -> tuple[str, str]:
        """Type and hash of a message by its key; the type is empty if it is none."""
        kind, _, type_hash = key.removesuffix(f"/{CPU_MESSAGES}").rpartition("/")
        return ros_type(kind.rpartition("/")[2]), type_hash

    def node(self) -> str | None:
        """The token of the node itself."""
        return f"{ADMIN}/{self._domain}/{self._session}/0/0/NN/%/{self._namespace}/{self._node}"

    def token(
        self, role: EndpointRole, number: int, endpoint: Endpoint, latched: bool, depth: int
    ) -> str | None:
        """The token of a publisher or subscriber of the node.

        Args:
            role: which of the two.
            number: unique in the session, from 1.
            endpoint: topic and type; a subscriber of one with backends announces the CPU's.
            latched: whether late subscribers get the last messages (transient local).
            depth: how many messages are kept.
        """
        # All of rmw_zenoh's defaults may be left out; which these are has changed, so they are not.
        qos = f"{RELIABLE}:{TRANSIENT_LOCAL if latched else VOLATILE}:{KEEP_LAST},{depth}:,:,:,,"
        wanted = endpoint.backends and role is EndpointRole.SUBSCRIBER
        return (
            f"{ADMIN}/{self._domain}/{self._session}/0/{number}/{role}/%/{self._namespace}/{self._node}/"
            f"{_mangled(endpoint.topic)}/{dds_type(endpoint.kind)}/{endpoint.type_hash}/{qos}"
            f"{f'/{CPU_BACKEND}' if wanted else ''}"
        )

    def all_tokens(self, role: EndpointRole, topic: str | None = None) -> str:
        """The pattern of the tokens of a topic, or of all topics."""
        name = "*" if topic is None else _mangled(topic)
        return f"{ADMIN}/{self._domain}/*/*/*/{role}/*/*/*/{name}/*/*/*/**"

    def parse(self, token: str) -> Endpoint | None:
        """Read the token of a publisher or subscriber; None if it is another's or malformed."""
        parts = token.split("/")
        if len(parts) not in (13, 14):
            return None
        topic, kind, type_hash = parts[9].replace("%", "/"), ros_type(parts[10]), parts[11]
        if not (_is_topic(topic) and kind and HASH.fullmatch(type_hash)):
            return None
        return Endpoint(topic, kind, type_hash, len(parts) == 14)


class BridgeKeys:
    """Keys of zenoh-bridge-ros2dds. Types are in its tokens alone; it asks for no token of ours."""

    def messages(self, endpoint: Endpoint) -> str:
        """The key of a topic's messages."""
        return endpoint.topic.strip("/")

    def all_messages(self, topic: str) -> tuple[str, ...]:
        """The same."""
        return (topic.strip("/"),)

    def kind_of(self, key: str) -> tuple[str, str]:
        """A key does not tell the type."""
        return "", ""

    def node(self) -> str | None:
        """There is none."""
        return None

    def token(
        self, role: EndpointRole, number: int, endpoint: Endpoint, latched: bool, depth: int
    ) -> str | None:
        """There is none."""
        return None

    def all_tokens(self, role: EndpointRole, topic: str | None = None) -> str:
        """The pattern of the tokens of a topic, or of all topics."""
        name = "*" if topic is None else topic.strip("/").replace("/", "§")
        return f"@/*/{ADMIN}/{role}/{name}/*/*"

    def parse(self, token: str) -> Endpoint | None:
        """Read the token of a publisher or subscriber; None if it is malformed."""
        parts = token.split("/")
        if len(parts) != 7:
            return None
        topic, kind = "/" + parts[4].replace("§", "/"), parts[5].replace("§", "/")
        return Endpoint(topic, kind) if _is_topic(topic) and ROS_TYPE.fullmatch(kind) else None


Keys = RmwZenohKeys | BridgeKeys


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def _is_topic(name: str) -> bool:
    return all(NAME.fullmatch(part) for part in name.removeprefix("/").split("/"))
