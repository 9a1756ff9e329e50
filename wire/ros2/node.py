"""A ROS 2 node over Zenoh: it publishes, subscribes, and is seen by `ros2 topic list`."""

from __future__ import annotations

import hashlib
import logging
import secrets
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import zenoh

from mapweave.hybridmap.errors import InvalidMessage
from mapweave.wire.bus import Closing, Sample
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.ros2.attachment import GID_BYTES, Attachment, decode_attachment, encode_attachment
from mapweave.wire.ros2.entities import TopicPublication, TopicSubscription
from mapweave.wire.ros2.keys import BridgeKeys, Endpoint, EndpointRole, Keys, RmwZenohKeys
from mapweave.wire.ros2.messages import encode, type_hash
from mapweave.wire.ros2.settings import Ros2Link
from mapweave.wire.zenoh_bus import ZenohBus
from mapweave.wire.zenoh_entities import Token, Watcher

log = logging.getLogger(__name__)

DEPTH = 10
"""Messages that a topic keeps, as ROS 2 nodes do by default."""


class Arrival(NamedTuple):
    """A message that has come, not decoded yet.

    Attributes:
        kind: its type.
        data: CDR.
        published_ns: when it was published, by its publisher's clock; 0 if unknown.
        arrived_ns: `time.monotonic_ns` of its arrival.
    """

    kind: str
    data: bytes
    published_ns: int
    arrived_ns: int


class Ros2Node:
    """A node with a Zenoh session of its own. Nothing here blocks; a missing router is waited for."""

    def __init__(self, link: Ros2Link, name: str) -> None:
        """Connect, or begin to, and announce the node.

        Args:
            link: where.
            name: of the node.
        """
        self.link = link
        # The first digit is not 0: an id is a number.
        session = f"{secrets.choice('123456789abcdef')}{secrets.token_hex(16)[1:]}"
        self.keys: Keys = BridgeKeys() if link.bridge else RmwZenohKeys(link, session, name)
        self._session = session
        self._bus = ZenohBus(BusSettings(endpoints=(link.endpoint,), session=session, timestamps=True))
        self._lock = threading.Lock()
        self._entities = 0
        self._publishers: dict[str, Endpoint] = {}
        token = self.keys.node()
        if token is not None:
            self._bus.declare(Token(self._bus.owner, token))
        self.watch(EndpointRole.PUBLISHER, None, self._publisher)

    @property
    def bus(self) -> ZenohBus:
        """Its session, for keys that are not those of ROS."""
        return self._bus

    def connected(self) -> bool:
        """Whether the router is in reach."""
        return self._bus.connected()

    def publishers(self, kinds: Sequence[str]) -> list[str]:
        """Topics with a publisher of messages of these types."""
        return sorted({one.topic for one in tuple(self._publishers.values()) if one.kind in kinds})

    def watch(
        self, role: EndpointRole, topic: str | None, handler: Callable[[Endpoint, str, bool], None]
    ) -> Closing:
        """Call the handler with who else publishes or subscribes (endpoint, token, alive), now and later."""

        def presence(token: str, alive: bool) -> None:
            endpoint = self.keys.parse(token)
            if endpoint is not None and f"/{self._session}/" not in token:
                handler(endpoint, token, alive)

        return self._bus.declare(Watcher(self._bus.owner, self.keys.all_tokens(role, topic), presence))

    def subscribe(
        self, topic: str, kinds: Sequence[str], handler: Callable[[Arrival], None], latched: bool = False
    ) -> Subscriber:
        """Call the handler with each message of a topic that has one of these types.

        Args:
            topic: full name.
            kinds: types; where keys do not tell the type, and no token announces it, it is the first.
            handler: runs on the bus's worker; it must be quick.
            latched: whether messages of before are wanted that a publisher has kept (transient local).
        """
        return Subscriber(self, topic, kinds, handler, latched)

    def publisher(self, topic: str, kind: str, latched: bool = False) -> Publisher:
        """A publisher of a topic.

        Args:
            topic: full name.
            kind: type of its messages.
            latched: whether late subscribers get the last message (transient local).
        """
        return Publisher(self, topic, kind, latched)

    def announce(self, role: EndpointRole, endpoint: Endpoint, latched: bool = False) -> str:
        """Announce a publisher or subscriber; returns its token, or with the bridge another unique name."""
        with self._lock:
            self._entities += 1
            token = self.keys.token(role, self._entities, endpoint, latched, 1 if latched else DEPTH)
        if token is not None:
            self._bus.declare(Token(self._bus.owner, token))
        return token or f"{endpoint.topic}/{self._entities}"

    def listen(self, topic: str, handler: Callable[[Sample], None], latched: bool) -> None:
        """Call the handler with each message of a topic, of any type."""
        keys = self.keys.all_messages(topic)
        # Publishers with backends are not latched.
        for key in keys[:1] if latched else keys:
            self._bus.declare(TopicSubscription(self._bus.owner, key, handler, latched))

    def publication(self, endpoint: Endpoint, latched: bool) -> TopicPublication:
        """Declare a publication."""
        return self._bus.declare(TopicPublication(self._bus.owner, self.keys.messages(endpoint), latched))

    def send(self, publication: TopicPublication, payload: bytes, attachment: bytes) -> None:
        """Publish; lost without a connection."""
        with self._bus.using_session():
            try:
                publication.put(payload, attachment)
            except zenoh.ZError as error:
                log.debug("put on %s failed: %s", publication.key, error)

    def close(self) -> None:
        """Disconnect. May be called twice."""
        self._bus.close()

    def _publisher(self, endpoint: Endpoint, token: str, alive: bool) -> None:
        if alive:
            self._publishers[token] = endpoint
        else:
            self._publishers.pop(token, None)


class Subscriber:
    """A subscription of a node.

    A publisher may publish only while it has subscribers, so a subscription is announced for each publisher
    of a type that is wanted.

    Attributes:
        refused: the type of a publisher or message that is not wanted; empty if there is none.
    """

    def __init__(
        self,
        node: Ros2Node,
        topic: str,
        kinds: Sequence[str],
        handler: Callable[[Arrival], None],
        latched: bool,
    ) -> None:
        """Subscribe; see `Ros2Node.subscribe`."""
        self.topic, self.kinds, self.refused = topic, tuple(kinds), ""
        self._node, self._handler, self._latched = node, handler, latched
        self._announced: dict[tuple[Endpoint, bool], str] = {}
        node.watch(EndpointRole.PUBLISHER, topic, self._presence)
        node.listen(topic, self._receive, latched)

    def _presence(self, endpoint: Endpoint, token: str, alive: bool) -> None:
        if not alive:
            return
        if endpoint.kind not in self.kinds:
            self.refused = endpoint.kind
        elif (one := (endpoint, endpoint.backends)) not in self._announced:
            self._announced[one] = self._node.announce(EndpointRole.SUBSCRIBER, endpoint, self._latched)

    def _receive(self, sample: Sample) -> None:
        kind, _ = self._node.keys.kind_of(sample.key)
        if not kind:
            kind = next((known.kind for known, _ in self._announced), self.refused or self.kinds[0])
        if kind not in self.kinds:
            self.refused = kind
            return
        try:
            published_ns = decode_attachment(sample.attachment).stamp_ns if sample.attachment else 0
        except InvalidMessage as error:
            log.debug("%s: %s", self.topic, error)
            published_ns = 0
        self._handler(Arrival(kind, sample.payload, published_ns, time.monotonic_ns()))


class Publisher:
    """A publisher of a node.

    Subscribers of the same type may know it under another hash (ROS 2 Humble under none): they get the
    messages under theirs.

    Attributes:
        subscribers: tokens of those who subscribe.
    """

    def __init__(self, node: Ros2Node, topic: str, kind: str, latched: bool) -> None:
        """Publish; see `Ros2Node.publisher`."""
        self._node, self._latched, self.kind = node, latched, kind
        self.subscribers: set[str] = set()
        self._sequence = 0
        self._lock = threading.Lock()
        self._last: tuple[bytes, bytes] | None = None
        own = Endpoint(topic, kind, "" if node.link.bridge else type_hash(kind))
        self._publications: dict[Endpoint, TopicPublication] = {}
        self._gid = self._add(own)
        node.watch(EndpointRole.SUBSCRIBER, topic, self._presence)

    @property
    def keys(self) -> list[str]:
        """The keys on which it publishes."""
        with self._lock:
            return [publication.key for publication in self._publications.values()]

    def publish(self, message: Any) -> None:
        """Publish a message. Never blocks; lost without a connection."""
        payload = encode(message)
        with self._lock:
            self._sequence += 1
            attachment = encode_attachment(Attachment(self._sequence, time.time_ns(), self._gid))
            publications = list(self._publications.values())
            self._last = payload, attachment
        for publication in publications:
            self._node.send(publication, payload, attachment)

    def _add(self, endpoint: Endpoint) -> bytes:
        token = self._node.announce(EndpointRole.PUBLISHER, endpoint, self._latched)
        publication = self._node.publication(endpoint, self._latched)
        with self._lock:
            self._publications[endpoint] = publication
            last = self._last
        if self._latched and last is not None:
            self._node.send(publication, *last)
        return hashlib.blake2b(token.encode(), digest_size=GID_BYTES).digest()

    def _presence(self, endpoint: Endpoint, token: str, alive: bool) -> None:
        if endpoint.kind != self.kind:
            return
        (self.subscribers.add if alive else self.subscribers.discard)(token)
        if alive and endpoint not in self._publications:
            self._add(endpoint)
