"""How much of one robot's logs the server takes now."""

from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

from mapweave.hybridmap.change import Change, EdgePut, NodePut
from mapweave.hybridmap.counted import counted
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.mapserver.log.agent_log import AgentLog
from mapweave.mapserver.log.entry import ReceivedChange
from mapweave.mapserver.log.kept_bytes import KeptBytes
from mapweave.mapserver.log.store import Store
from mapweave.mapserver.quotas import CHANGE_BYTES, DRIVEN, EDGES, MOST_ROBOTS, Quotas, TokenBucket
from mapweave.wire.log_messages import MAX_ROWS

WORTHWHILE = 16
"""Changes for which it is worth asking a robot; fewer wait until so many may come."""
RETIRE = "retire maps with `mapweave map retire`"
ADVICE = f"{RETIRE}, or raise in [quotas]"
QUOTA = f"which is its quota: {ADVICE}"
MOST_UNMERGED = 1024
"""Changes of a robot that wait to be merged; further ones stay on its disk."""


class Full(NamedTuple):
    """Why there is no room for more of a robot.

    Attributes:
        what: is held back.
        reason: in words, for the robot.
    """

    what: str
    reason: str


class Intake:
    """The quotas of one robot: rates, and what is kept of it."""

    def __init__(
        self, agent: str, quotas: Quotas, store: Store, retired: Callable[[], Collection[MapId]]
    ) -> None:
        """Take note of the robot; what is kept of it is counted before its first change."""
        self._agent, self._quotas, self._store, self._retired = agent, quotas, store, retired
        rate, now = quotas.settings.changes, quotas.clock()
        self._changes = TokenBucket(rate, now)
        self._bytes = TokenBucket(rate * CHANGE_BYTES, now)
        self._beacons = TokenBucket(rate, now)
        self._repeats = TokenBucket(rate, now)
        self._current: AgentLog | None = None
        self._nodes = self._landmarks = 0
        self._edges_left = DRIVEN
        self._bytes_kept = KeptBytes(agent, store)
        self._retired_maps: frozenset[MapId] = frozenset()
        self._stale = True

    def beacon(self) -> bool:
        """Whether a beacon is looked at; the next one says the same."""
        return self._allowed(self._beacons, "beacons")

    def repeat(self) -> bool:
        """Whether a published change that is already here is looked at.

        It counts for itself: what was published and pulled as well takes nothing from what may be sent.
        """
        return self._allowed(self._repeats, "changes")

    def _allowed(self, bucket: TokenBucket, what: str) -> bool:
        now = self._quotas.clock()
        allowed = bucket.wait(1.0, now) <= 0.0
        if allowed:
            bucket.spend(1.0, now)
        else:
            self._quotas.hold_back(self._agent, what)
        return allowed

    def change(self, size: int, unmerged: int, lacking: int = 1) -> bool:
        """Whether a published change is taken; one that is not is pulled later.

        Args:
            size: bytes.
            unmerged: changes of the robot that wait to be merged.
            lacking: changes of the log that have not come, this one included. There must be room for all of
                them: else those behind a gap would leave none for it, and the log would hardly go on.
        """
        if self.rows(unmerged) < 1 or self._changes.available(self._quotas.clock()) < lacking:
            self._quotas.hold_back(self._agent, "changes")
            return False
        self.spend(1, size)
        return True

    def rows(self, unmerged: int) -> int:
        """How many changes may come now."""
        now = self._quotas.clock()
        if self._bytes.available(now) <= 0.0:
            return 0
        return max(0, min(MAX_ROWS, int(self._changes.available(now)), MOST_UNMERGED - unmerged))

    def pause(self) -> float:
        """After how many seconds it is worth asking for changes again."""
        now = self._quotas.clock()
        return max(self._changes.wait(WORTHWHILE, now), self._bytes.wait(WORTHWHILE * CHANGE_BYTES, now), 0.1)

    def spend(self, count: int, size: int) -> None:
        """Changes have come."""
        now = self._quotas.clock()
        self._changes.spend(count, now)
        self._bytes.spend(size, now)

    def keep_ahead_of(self, agent_log: AgentLog) -> None:
        """Changes behind a gap are kept for one map, which a robot makes at a time."""
        if self._current is not None and self._current is not agent_log:
            self._current.forget_ahead()
        self._current = agent_log

    def recount(self, map_id: MapId) -> None:
        """Another server has taken changes of a map: count again before the next."""
        self._stale = True
        self._bytes_kept.grown(map_id)

    def fitting(self, map_id: MapId, entries: Sequence[ReceivedChange]) -> tuple[int, Full | None]:
        """How many changes of a map, in order, the robot's quotas have room for, and why not more.

        Those that fit count as kept from now on.

        Raises:
            InvalidFile: the store cannot be read, or does not take that a map is compacted.
        """
        if self._stale:
            self._count()
        self._bytes_kept.compact(map_id, entries)
        count, full = self._fitting(map_id, entries)
        if full is not None:
            # People may have retired a map meanwhile.
            self._count()
            count, full = self._fitting(map_id, entries)
        return count, full

    def _fitting(self, map_id: MapId, entries: Sequence[ReceivedChange]) -> tuple[int, Full | None]:
        settings = self._quotas.settings
        added: dict[NodeId, int] = {}
        edges_here: set[NodeId] = set()
        # A retired map counts for itself: its robot may be the reason why it is.
        kept = self._bytes_kept.total(self._retired_maps - {map_id})
        for count, entry in enumerate(entries):
            added_bytes = self._bytes_kept.added_by(map_id, entry)
            if kept + added_bytes > settings.megabytes * 1e6:
                what = f"{kept / 1e6:.3g} MB of changes"
                return count, Full("changes", f"{self._agent} has {what} here, {QUOTA} `megabytes`")
            if isinstance(entry.change, Change) and isinstance(entry.change.body, EdgePut):
                edges_here.add(entry.change.body.edge.id)
                self._edges_left -= 1
                if self._edges_left < 0 and (edges := self._count_edges(len(edges_here))):
                    self._edges_left = 0
                    reason = f"{self._agent} has {counted(edges, 'edge')} here, which is its quota: {RETIRE}"
                    return count, Full("nodes", reason)
            if isinstance(entry.change, Change) and isinstance(entry.change.body, NodePut):
                node = entry.change.body.node
                before = added.get(node.id, self._store.landmarks(node.id))
                nodes = self._nodes + (before is None)
                landmarks = self._landmarks + len(node.landmarks) - (before or 0)
                if nodes > settings.nodes or landmarks > settings.landmarks:
                    what = f"{counted(self._nodes, 'node')} with {counted(self._landmarks, 'landmark')}"
                    return count, Full("nodes", f"{self._agent} has {what} here, {QUOTA} `nodes`")
                self._nodes, self._landmarks = nodes, landmarks
                added[node.id] = len(node.landmarks)
            self._bytes_kept.add(map_id, entry)
            kept += added_bytes
        return len(entries), None

    def _count_edges(self, coming: int) -> int:
        """How many edges there are if there is no room for those that come, else 0.

        Counted rarely: many change an edge that is there, and counting reads all logs of the robot.
        """
        retired = self._retired()
        kept = self._store.edges(self._agent).items()
        edges = sum(count for map_id, count in kept if map_id not in retired)
        self._edges_left = EDGES * self._nodes + DRIVEN - edges - coming
        return edges if self._edges_left < 0 else 0

    def _count(self) -> None:
        kept, retired = self._store.kept(self._agent), self._retired()
        self._bytes_kept.read()
        self._retired_maps = frozenset(map_id for map_id in retired if map_id.agent == self._agent)
        counts = [count for map_id, count in kept.items() if map_id not in retired]
        self._nodes = sum(nodes for nodes, _ in counts)
        self._landmarks = sum(landmarks for _, landmarks in counts)
        self._stale = False


class Intakes:
    """Those of all robots."""

    def __init__(self, store: Store, quotas: Quotas, retired: Callable[[], Collection[MapId]]) -> None:
        self._store, self._quotas, self._retired = store, quotas, retired
        self._intakes: dict[str, Intake] = {}

    def of(self, agent: str) -> Intake:
        """That of one robot."""
        intake = self._intakes.get(agent)
        if intake is None:
            if len(self._intakes) >= MOST_ROBOTS:
                del self._intakes[next(iter(self._intakes))]
            intake = self._intakes[agent] = Intake(agent, self._quotas, self._store, self._retired)
        return intake

    def objection(self, map_id: MapId, known: Collection[MapId]) -> str:
        """Why a new map of a robot is not taken; empty if it is."""
        retired = self._retired()
        kept = sum(other.agent == map_id.agent and other not in retired for other in known)
        if kept < self._quotas.settings.maps:
            return ""
        return f"{map_id.agent} has {counted(kept, 'map')} here, {QUOTA} `maps`"
