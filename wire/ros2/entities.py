"""What a ROS 2 node declares in its Zenoh session."""

from collections.abc import Callable
from typing import Any

import zenoh
import zenoh.ext

from mapweave.wire.bus import Sample
from mapweave.wire.zenoh_entities import Declared, Owner, Subscription


class TopicSubscription(Subscription):
    """Messages of a topic; first those that its publishers have kept, if it is latched."""

    def __init__(self, owner: Owner, key: str, handler: Callable[[Sample], None], latched: bool) -> None:
        super().__init__(owner, key, handler)
        self._latched = latched

    def _declare_in(self, session: zenoh.Session) -> Any:
        if not self._latched:
            remote = zenoh.Locality.REMOTE
            return session.declare_subscriber(self.key, self._receive, allowed_origin=remote)
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        # What this session publishes itself is no news.
        return zenoh.ext.declare_advanced_subscriber(
            session, self.key, self._receive, allowed_origin=zenoh.Locality.REMOTE, history=history
        )


class TopicPublication(Declared):
    """A publisher of a topic.

    If it is latched, the last message is kept as rmw_zenoh does for transient-local durability: by Zenoh's
    advanced publisher, which late subscribers ask for it.
    """

    def __init__(self, owner: Owner, key: str, latched: bool) -> None:
        super().__init__(owner, key)
        self._latched = latched
        self._last: tuple[bytes, bytes] | None = None

    def _declare_in(self, session: zenoh.Session) -> Any:
        if not self._latched:
            return session.declare_publisher(self.key)
        publisher = zenoh.ext.declare_advanced_publisher(
            session, self.key, cache=zenoh.ext.CacheConfig(1), publisher_detection=True
        )
        if self._last is not None:
            publisher.put(self._last[0], attachment=self._last[1])
        return publisher

    def put(self, payload: bytes, attachment: bytes) -> None:
        """Send a message. Without a session it is lost, or kept until there is one."""
        with self._owner.lock:
            entity = self._entity
            if self._latched:
                self._last = payload, attachment
        if entity is not None:
            entity.put(payload, attachment=attachment)
