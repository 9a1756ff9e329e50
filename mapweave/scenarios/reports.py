"""Status of agents and server during a trial: asked between ticks, and received as messages."""

import threading
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mapweave.hybridmap.agent_status import AgentStatus
from mapweave.hybridmap.errors import NotConnected
from mapweave.hybridmap.ids import MapId
from mapweave.scenarios.recording import TrialTrajectory
from mapweave.wire.bus import Bus, Sample
from mapweave.wire.conversion import convert
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import decode_record
from mapweave.wire.messages import decode

PATIENCE = 120.0
"""How long the server may take to merge what it has, s."""


@dataclass(frozen=True)
class ServerReport:
    """The server's state after it has merged everything that it has.

    Attributes:
        nodes: in the merged map.
        maps: that have come.
        components: of the merged map.
    """

    nodes: int
    maps: int
    components: int


class Reports:
    """Asks for the present status, and keeps each robot's pose estimates while it mapped."""

    def __init__(self, bus: Bus, keys: Keys) -> None:
        """Begin to listen."""
        self._bus = bus
        self._keys = keys
        self._lock = threading.Lock()
        self._poses: dict[MapId, dict[int, tuple[float, float, float]]] = {}
        self._traffic: dict[str, list[int]] = {}
        self._newest_ns: dict[str, int] = {}
        self._closing = bus.subscribe(keys.agent_statuses(), self._hear)

    def agent(self, robot: str) -> AgentStatus | None:
        """An agent's status at its last tick; None if it cannot be reached."""
        for reply in self._bus.ask(self._keys.agent_status(robot), b"", 5.0):
            if not reply.error:
                report = decode(reply.payload, AgentStatus)
                self._note(robot, report)
                return report
        return None

    def agents(self, robots: Iterable[str]) -> dict[str, AgentStatus]:
        """The agents that can be reached."""
        statuses = ((robot, self.agent(robot)) for robot in robots)
        return {robot: report for robot, report in statuses if report is not None}

    def server(self, name: str) -> ServerReport:
        """The server's status when it has merged everything.

        Raises:
            NotConnected: it does not answer, or cannot.
        """
        replies = self._bus.ask(self._keys.server_status(name), b"", PATIENCE)
        for reply in replies:
            if not reply.error:
                report: ServerReport = convert(decode_record(reply.payload), ServerReport)
                return report
        raise NotConnected(f"map server {name}: {replies[0].error if replies else 'no answer'}")

    def estimates(self, robot: str) -> dict[MapId, TrialTrajectory]:
        """`map_from_robot` over time, of each map that the robot made."""
        with self._lock:
            by_map = {
                map_id: dict(sorted(p.items())) for map_id, p in self._poses.items() if map_id.agent == robot
            }
        return {
            map_id: TrialTrajectory(
                np.array(list(p), dtype=np.int64), np.array(list(p.values())).reshape(-1, 3)
            )
            for map_id, p in by_map.items()
        }

    def traffic(self, robot: str) -> int:
        """Bytes over the fleet's network, over all processes of the agent, where reported."""
        with self._lock:
            return sum(self._traffic.get(robot, []))

    def close(self) -> None:
        """Stop listening."""
        self._closing.close()

    def _hear(self, sample: Sample) -> None:
        self._note(self._keys.parse_agent_status(sample.key), decode(sample.payload, AgentStatus))

    def _note(self, robot: str, report: AgentStatus) -> None:
        status = report.status
        with self._lock:
            lives = self._traffic.setdefault(robot, [0])
            # Reports that were published and asked for may overtake each other.
            if report.stamp_ns > self._newest_ns.get(robot, -1):
                self._newest_ns[robot] = report.stamp_ns
                # A counter that has fallen belongs to an agent that was started again.
                if report.traffic < lives[-1]:
                    lives.append(0)
                lives[-1] = report.traffic
            # A robot that reports that it is lost has no estimate.
            if status.mission in ("explore", "carried") and status.nodes and not status.relocalizing:
                pose = status.map_from_robot
                by_stamp = self._poses.setdefault(MapId(robot, report.epoch), {})
                by_stamp[report.stamp_ns] = (pose.x, pose.y, pose.heading)
