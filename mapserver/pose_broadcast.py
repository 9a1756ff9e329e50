"""Publishes to each agent the merged poses of its nodes, when they have changed noticeably.

An agent's own map stays as it is: its nodes keep their poses, and routes come as answers. It stores these
poses beside its map.
"""

import math
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.limits import MAX_POSITION
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.mapserver.services import guarded
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.wire.bus import Bus, Request
from mapweave.wire.keys import Keys
from mapweave.wire.pose_messages import MergedPose, PoseNews


@dataclass
class _Published:
    """What was published to one agent."""

    places: dict[NodeId, MergedPose] = field(default_factory=dict)
    sequence: int = 0
    last: float = -math.inf


EVERY = 2.0
"""Shortest time between two messages to one agent, s."""
BEAT = 15.0
"""After this time the number of the last message is sent again, so that lost ones are missed, s."""
MOST = 2048
"""Nodes in one message."""
DISTANCE = 0.05
"""A node that has moved less than this since it was published is not sent again, m."""
TURN = math.radians(1.0)
"""A node that has turned less than this since it was published is not sent again, rad."""


class PoseBroadcast:
    """Publishes news on request, and answers questions with all published poses."""

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        name: str,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin to answer."""
        self._clock = clock
        self._bus, self._keys, self._name = bus, keys, name
        self._run = secrets.randbits(64)
        self._lock = threading.Lock()
        self._published: dict[str, _Published] = {}
        self._graphs: tuple[PoseGraph, ...] = ()
        self._checked_at = -math.inf
        self._serving = bus.serve(keys.all_poses(name), self._answer)

    def close(self) -> None:
        """Stop answering."""
        self._serving.close()

    def tell(self, merged: MergedMap, now: float | None = None) -> None:
        """Publish what has changed since the last time, if it is due."""
        now = self._clock() if now is None else now
        if now - self._checked_at < EVERY:
            return
        self._checked_at = now
        with self._lock:
            if merged.graphs != self._graphs:
                self._publish_news(merged, now)
            for agent, published in self._published.items():
                if now - published.last >= BEAT:
                    self._send(agent, PoseNews(self._run, published.sequence, published.sequence), now)

    def _publish_news(self, merged: MergedMap, now: float) -> None:
        before, now_solved = set(map(id, self._graphs)), set(map(id, merged.graphs))
        removed = [
            node
            for graph in self._graphs
            if id(graph) not in now_solved
            for node in graph.nodes
            if node not in merged.poses
        ]
        moved = self._moved(graph for graph in merged.graphs if id(graph) not in before)
        self._graphs = merged.graphs
        news: dict[str, tuple[dict[NodeId, MergedPose], list[NodeId]]] = {}
        for node, place in moved:
            news.setdefault(node.agent, ({}, []))[0][node] = place
        for node in removed:
            news.setdefault(node.agent, ({}, []))[1].append(node)
        for agent, (places, lost) in sorted(news.items()):
            published = self._published.setdefault(agent, _Published())
            rest, left = iter(places.items()), iter(lost)
            while True:
                some = dict(islice(rest, MOST))
                less = tuple(islice(left, MOST))
                if not some and not less:
                    break
                published.sequence += 1
                published.places |= some
                for node in less:
                    published.places.pop(node, None)
                self._send(
                    agent, PoseNews(self._run, published.sequence - 1, published.sequence, some, less), now
                )

    def _moved(self, graphs: Iterable[PoseGraph]) -> Iterator[tuple[NodeId, MergedPose]]:
        """Nodes that have moved noticeably since they were published."""
        nothing = _Published()
        for graph in graphs:
            for node, (x, y, heading) in zip(graph.nodes, graph.means.tolist(), strict=True):
                if not (abs(x) <= MAX_POSITION and abs(y) <= MAX_POSITION):
                    # No message holds it. The merge sets such a map apart, but is first done without.
                    continue
                before = self._published.get(node.agent, nothing).places.get(node)
                if before is not None and before.frame == graph.anchor:
                    pose = before.merged_from_node
                    close = math.hypot(x - pose.x, y - pose.y) <= DISTANCE
                    if close and abs(wrap_angle(heading - pose.heading)) <= TURN:
                        continue
                yield node, MergedPose(graph.anchor, Pose2(x, y, heading))

    def _send(self, agent: str, news: PoseNews, now: float) -> None:
        self._published[agent].last = now
        self._bus.publish(self._keys.poses(self._name, agent), news.encode(agent))

    def _answer(self, request: Request) -> None:
        guarded(lambda _: self._whole(request.key))(request)

    def _whole(self, key: str) -> bytes:
        _, agent = self._keys.parse_poses(key)
        with self._lock:
            published = self._published.get(agent, _Published())
            return PoseNews(self._run, 0, published.sequence, dict(published.places)).encode(agent)
