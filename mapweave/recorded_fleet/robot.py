"""A robot that drives along what it has recorded: journal, status and missions as an agent has them."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import networkx as nx

from mapweave.agent.fleet_client import FleetClient
from mapweave.agent.mission import Explore, GoTo, Idle, MayIDrive, Mission
from mapweave.agent.mission_control import MissionControl
from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.hybridmap.agent_status import Status
from mapweave.hybridmap.change import ChangeBody
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.mission_order import MissionKind
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.hybridmap.query import MAX_LEGS
from mapweave.wire.bus import Bus
from mapweave.wire.keys import Keys

SPEED = 0.35
"""m/s."""
TURN_RATE = 1.2
"""rad/s."""
SIGMA, HEADING_SIGMA = 0.15, 0.03
"""Of the pose that is reported, m and rad."""
BATTERY_LIFE = 7200.0
"""s."""
CLOSE = 0.02
"""m, within which a node is reached."""
ASK_EVERY = 1.0
"""s, as robots ask for the right of way."""


@dataclass
class _Motion:
    """Where it is in its own map, the nodes that it still drives to, and what it must pass before that."""

    pose: Pose2
    way: list[NodeId]
    length: float = 0.0
    via: tuple[NodeId, ...] = ()


class ReplayedRobot:
    """Announced on a bus until closed. Call `step` again and again.

    Attributes:
        name: of the robot.
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        server: str,
        map_id: MapId,
        known: Sequence[ChangeBody],
        later: Sequence[ChangeBody],
        journal: Path,
    ) -> None:
        """Go on from a journal, and map what is left when the robot gets there.

        Args:
            bus: the connection; stays the caller's.
            keys: of the fleet.
            server: that gets the map.
            map_id: the robot and its map.
            known: the part of the map that the journal has, at least one node.
            later: the rest, in the order in which it was made.
            journal: its file.
        """
        self.name, self._map, self._later = map_id.agent, HybridMap(known), list(later)
        self._began = time.monotonic()
        self._journal = Journal(journal, self.name)
        self._replicator = Replicator(bus, keys, self._journal, map_id, servers=(server,))
        self._control = MissionControl(self.name)
        self._control.unknown_goal = self._unknown
        self._client = FleetClient(
            bus, keys, map_id, self._control,
            unsent=self._replicator.unacknowledged, placed=lambda: len(self._map.nodes),
        )  # fmt: skip
        first = next(iter(self._map.nodes.values()))
        self._motion = _Motion(first.map_from_robot.mean, [])
        self._mission: Mission = Explore()
        self._number, self._asking, self._ask_at = 0, False, 0.0
        self._control.begin(MissionKind.EXPLORE)

    def step(self, seconds: float) -> None:
        """Drive on, and report."""
        mission = self._control.next(True, time.monotonic(), None)
        if mission is not None:
            self._mission = mission
            self._motion.way = []
            self._motion.via = ()
            if isinstance(mission, GoTo):
                self._motion.via = mission.via[mission.passed :]
                self._motion.way = self._way_over(*self._motion.via, mission.node)
            self._motion.length = self._left() or 1.0
        if isinstance(self._mission, Explore) and not self._motion.way:
            self._motion.way = self._explore()
        self._drive(seconds)
        self._tell_way()
        status = self._status()
        self._control.follow(status)
        elapsed = time.monotonic() - self._began
        self._client.report(status, time.time_ns(), max(0.1, 0.95 - elapsed / BATTERY_LIFE))

    def close(self) -> None:
        """Withdraw from the fleet."""
        self._client.close()
        self._replicator.close()
        self._journal.close()

    def _discover(self) -> NodeId | None:
        """Map the next node; None if there is none left."""
        if not self._later:
            return None
        some, self._later = self._later[:2], self._later[2:]
        for change in some:
            self._map.apply(change)
        self._replicator.submit(some, time.time_ns())
        return list(self._map.nodes)[-1]

    def _explore(self) -> list[NodeId]:
        """Back to where the known map ends, then beyond; all over again once all is mapped."""
        nodes = list(self._map.nodes)
        here = self._nearest()
        if here != nodes[-1]:
            return nodes[nodes.index(here) + 1 :]
        fresh = self._discover()
        return nodes[::-1] if fresh is None else [fresh]

    def _unknown(self, node: NodeId) -> str:
        if node in self._map.nodes:
            return ""
        if node.agent == self.name:
            # A copy, since the robot may map one meanwhile.
            nearest = min(list(self._map.nodes), key=lambda one: abs(one.number - node.number))
            return f"there is no node {node}; the nearest is {nearest}"
        return f"{self.name} is a recording and knows its own map alone"

    def _way_over(self, *stops: NodeId) -> list[NodeId]:
        graph, way = self._map.graph(), [self._nearest()]
        for stop in stops:
            way += nx.shortest_path(graph, way[-1], stop)[1:]
        return way

    def _tell_way(self) -> None:
        """Ask for the right of way as robots do, so that the server knows the way; it never waits."""
        if self._client.answers():
            self._asking = False
        now, way = time.monotonic(), tuple(self._motion.way[:MAX_LEGS])
        going = isinstance(self._mission, GoTo) and way
        if not going or self._asking or now < self._ask_at or not self._client.server_in_reach():
            return
        self._asking, self._ask_at = True, now + ASK_EVERY
        self._number += 1
        fix = self._nearest()
        self._client.ask(MayIDrive(self._number, fix, self._at(fix).inverse() @ self._motion.pose, way))

    def _nearest(self) -> NodeId:
        here = self._motion.pose
        return min(self._map.nodes, key=lambda node: self._at(node).distance(here))

    def _at(self, node: NodeId) -> Pose2:
        return self._map.nodes[node].map_from_robot.mean

    def _drive(self, seconds: float) -> None:
        """Straight to the next node, turned to where it drives; a node ahead is passed."""
        motion, left = self._motion, seconds
        while motion.way and left > 0.0:
            goal, pose = self._at(motion.way[0]), motion.pose
            distance = math.hypot(goal.x - pose.x, goal.y - pose.y)
            if distance < CLOSE:
                passed = motion.way.pop(0)
                while motion.via and passed == motion.via[0]:
                    motion.via = motion.via[1:]
                continue
            course = math.atan2(goal.y - pose.y, goal.x - pose.x)
            turn = wrap_angle(course - pose.heading)
            turned = min(abs(turn) / TURN_RATE, left)
            left -= turned
            heading = pose.heading + math.copysign(turned * TURN_RATE, turn)
            way = min(SPEED * left, distance)
            left -= way / SPEED
            motion.pose = Pose2(
                pose.x + way * (goal.x - pose.x) / distance,
                pose.y + way * (goal.y - pose.y) / distance,
                heading,
            )

    def _left(self) -> float:
        """m, to the end of the way."""
        poses = [self._motion.pose, *map(self._at, self._motion.way)]
        return sum(a.distance(b) for a, b in pairwise(poses))

    def _status(self) -> Status:
        motion, going = self._motion, isinstance(self._mission, GoTo)
        fix = self._nearest()
        doing, detail = "standing", ""
        if motion.way:
            doing = "mapping" if self._later and not going else "driving"
            detail = f"to {motion.way[-1]}"
        variance = SIGMA**2
        return Status(
            doing, detail, len(self._map.nodes), 40, motion.pose, going and not motion.way,
            "goto" if going else "idle" if isinstance(self._mission, Idle) else "explore",
            passed=len(self._mission.via) - len(motion.via) if isinstance(self._mission, GoTo) else 0,
            fix_node=fix, node_from_robot=self._at(fix).inverse() @ motion.pose,
            progress=1.0 - min(self._left() / motion.length, 1.0) if going else 0.0, located=True,
            covariance=(variance, 0.4 * variance, 0.5 * variance, HEADING_SIGMA**2),
        )  # fmt: skip
