"""A map server in this process, and what robots and people get from it."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from mapweave.hybridmap.agent_status import FleetStatus
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Pose2, PoseGaussian, wrap_angle
from mapweave.hybridmap.query import Certainty, RelocalizeAnswer, View
from mapweave.mapserver.relocalization.verdict import FLOOR_HEADING, FLOOR_XY, GATE
from mapweave.mapserver.server import MapServer
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.wire.bus import Closing, Request, Sample
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import Ack, Head, LogAnswer, LogRequest, Mark, decode_record
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import decode, encode_view

KEYS = Keys("liars")
LOG_ID = 7
LIMIT = 240.0
"""For a log to be taken and merged, s."""
AT_ONCE = 64
"""Changes in one answer for a part of a log."""
RIGHT_M = 0.35
"""An answered position nearer to the truth than this is right."""


NOWHERE = PoseGaussian(Pose2(), np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class TrialAnswer:
    """The answer that a lost robot got.

    Attributes:
        found: whether it says where the robot is, for certain, on the map of the robots concerned.
        frame: first node of these robots in the component where that is.
        pose: of the robot in its frame.
        right: whether that is true.
    """

    found: bool
    frame: NodeId | None = None
    pose: PoseGaussian = NOWHERE
    right: bool = False

    def agrees(self, other: TrialAnswer) -> bool:
        """Whether two answers say the same, within what they are certain of."""
        off = self.pose.inverse() @ other.pose
        spread = off.covariance + np.diag([FLOOR_XY**2, FLOOR_XY**2, FLOOR_HEADING**2])
        vector = off.mean.vector
        return self.frame == other.frame and float(vector @ np.linalg.solve(spread, vector)) < GATE


@dataclass(frozen=True, eq=False)
class FleetResult:
    """The links, poses and answers that some robots end with.

    Attributes:
        links: between their maps and within them.
        components: their nodes, by the component that holds them; parts without them are left out.
        poses: of their nodes, in the frame of the first node of the same component.
        answers: to lost robots.
        superseded: their nodes that others replace.
    """

    links: frozenset[tuple[NodeId, NodeId]]
    components: frozenset[frozenset[NodeId]]
    poses: Mapping[NodeId, Pose2]
    answers: Sequence[TrialAnswer]
    superseded: frozenset[NodeId]


class Served:
    """A server and a bus beside it that plays all robots."""

    def __init__(self, path: Path) -> None:
        """Open the store."""
        hub = MemoryHub()
        self._buses = MemoryBus(hub), MemoryBus(hub)
        self._server = MapServer(self._buses[0], KEYS, path, "s0")
        self._bus = self._buses[1]
        self._acks: dict[MapId, int] = {}
        self._tokens: list[Closing] = []

    def __enter__(self) -> Self:
        """Begin to serve."""
        self._server.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop."""
        self._server.__exit__(kind, error, trace)
        for bus in self._buses:
            bus.close()

    def settle(self) -> bool:
        """Whether all that has come is merged in time."""
        return self._server.settle(LIMIT)

    def send(self, logs: Mapping[MapId, list[bytes]], extra: Sequence[tuple[MapId, int, bytes]] = ()) -> bool:
        """Send logs as agents do: changes one by one, then a beacon; what is asked for is given.

        Returns:
            Whether all changes are settled in time.
        """
        closing = [self._bus.serve(KEYS.log(map_id), _teller(log)) for map_id, log in logs.items()]
        closing += [self._bus.subscribe(KEYS.acks(agent), self._hear) for agent in {m.agent for m in logs}]
        self._tokens += [self._bus.announce(KEYS.agent_alive(min(logs)))]
        for map_id, log in logs.items():
            for k, message in enumerate(log, start=1):
                self._bus.publish(KEYS.change(map_id), message, Mark(k, LOG_ID).encode())
        for map_id, sequence, message in extra:
            self._bus.publish(KEYS.change(map_id), message, Mark(sequence, LOG_ID).encode())
        for map_id, log in logs.items():
            newest = max([len(log), *(sequence for which, sequence, _ in extra if which == map_id)])
            self._bus.publish(KEYS.head(map_id), Head(LOG_ID, newest).encode())
        taken = _within(LIMIT, lambda: all(self._acks.get(m, 0) >= len(log) for m, log in logs.items()))
        for one in closing:
            one.close()
        return taken

    def alive(self) -> bool:
        """Whether it answers people."""
        replies = self._bus.ask(KEYS.server_status("s0"), b"", 20.0)
        return bool(replies) and not replies[0].error and bool(decode_record(replies[0].payload))

    def named(self, agent: str) -> str:
        """What the page's timeline says against a robot, by name; empty if it says nothing.

        A map that had been joined until then is accused as the reason of the split.
        """
        return accusing((event.words for event in self._server.history()), agent)

    def in_status(self, agent: str) -> bool:
        """Whether the status of the robots says something against one that is there."""
        replies = self._bus.ask(KEYS.robots("s0"), b"", 20.0)
        entries = decode(replies[0].payload, FleetStatus).robots if replies else ()
        return any(entry.robot == agent and entry.accusation for entry in entries)

    def links_joining(self, agent: str) -> int:
        """How many links there are between a robot's maps and those of others."""
        return sum((link.a.agent == agent) != (link.b.agent == agent) for link in self._server.merged().links)

    def seen(
        self, maps: Collection[MapId], lost: Sequence[tuple[View, Pose2]], truth: Mapping[NodeId, Pose2]
    ) -> FleetResult:
        """What the robots of some maps end with.

        Args:
            maps: of these robots.
            lost: views of lost robots, and where they truly are.
            truth: where the nodes of these maps truly are.
        """
        merged = self._server.merged()
        frames = _frames(merged, maps)
        parts = {first: frozenset(n for n in frames if frames[n] == first) for first in frames.values()}
        return FleetResult(
            frozenset(link.pair for link in merged.links if {link.a.map, link.b.map} <= {*maps}),
            frozenset(parts.values()),
            {node: merged.pose(first).inverse() @ merged.pose(node) for node, first in frames.items()},
            [self._answer(merged, frames, view, at, truth) for view, at in lost],
            frozenset(node for node in merged.superseded if node.map in maps),
        )

    def _answer(
        self,
        merged: MergedMap,
        frames: Mapping[NodeId, NodeId],
        view: View,
        at: Pose2,
        truth: Mapping[NodeId, Pose2],
    ) -> TrialAnswer:
        replies = self._bus.ask(KEYS.relocalize("s0"), encode_view(view), 60.0)
        answer = decode(replies[0].payload, RelocalizeAnswer)
        if answer.certainty is not Certainty.FOUND:
            return TrialAnswer(False)
        best = answer.candidates[0]
        number = merged.component_of(best.node)
        first = next((f for f in sorted({*frames.values()}) if merged.component_of(f) == number), None)
        if first is None:
            # On a map of the fourth robot alone: it is of no use to the others, true or not.
            return TrialAnswer(True)
        way = merged.pose(first).inverse() @ merged.pose(best.node)
        pose = PoseGaussian(way, np.zeros((3, 3))) @ best.node_from_robot
        return TrialAnswer(True, first, pose, (truth[first] @ pose.mean).distance(at) < RIGHT_M)

    def _hear(self, sample: Sample) -> None:
        ack = Ack.decode(sample.payload)
        self._acks[ack.map] = max(ack.watermark, self._acks.get(ack.map, 0))


def accusing(words: Iterable[str], agent: str) -> str:
    """The first words that say something against a map of a robot, from where they do; empty if none do."""
    accused = f"map {agent}."
    return next((one[one.index(accused) :] for one in words if accused in one), "")


def difference(one: Pose2, other: Pose2) -> float:
    """How far two poses are apart, m; a turn counts as what it moves at a metre."""
    return max(one.distance(other), abs(float(wrap_angle(one.heading - other.heading))))


def _frames(merged: MergedMap, maps: Collection[MapId]) -> dict[NodeId, NodeId]:
    """The first node of these maps in the component of each of their nodes."""
    out: dict[NodeId, NodeId] = {}
    for component in merged.components:
        theirs = sorted(node for node in component if node.map in maps)
        out |= dict.fromkeys(theirs, theirs[0]) if theirs else {}
    return out


def _teller(log: Sequence[bytes]) -> Callable[[Request], None]:
    def tell(request: Request) -> None:
        asked = LogRequest.decode(request.payload)
        last = min(asked.last, asked.first + AT_ONCE - 1, len(log))
        rows = [(k, log[k - 1]) for k in range(asked.first, last + 1)]
        request.reply(LogAnswer(LOG_ID, asked.first, last, tuple(rows)).encode())

    return tell


def _within(seconds: float, condition: Callable[[], bool]) -> bool:
    end = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True
