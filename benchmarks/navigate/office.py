"""An office with one robot in it, mapped once and kept: the stage of the navigation benchmark."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mapweave.agent.settings import AgentSettings
from mapweave.fleet import send_order
from mapweave.hybridmap.agent_status import AgentStatus
from mapweave.hybridmap.errors import InvalidFile, NotConnected
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder
from mapweave.hybridmap.pose import Pose2
from mapweave.scenarios.fleet import SERVER, TICKS_PER_SECOND, TrialStage
from mapweave.scenarios.local_fleet import LocalFleet
from mapweave.scenarios.reports import Reports
from mapweave.scenarios.scenario import load_scenario, scenario_path
from mapweave.storage.map_file import MapFile, unpack_map_file

ROBOT = "r0"
TRUTH = "truth.json"
"""Where each node's image was truly taken: for scoring only."""
LOOK_EVERY = 5.0
"""How often it is looked whether exploration is complete, simulated s."""


@dataclass(frozen=True, eq=False)
class Mapped:
    """What exploration has left.

    Attributes:
        nodes: of the merged map, with the edges of the server.
        truth: `world_from_robot` of every node, when its image was taken.
    """

    nodes: HybridMap
    truth: dict[NodeId, Pose2]


class Office:
    """A fleet of one robot and its map server over a bus in memory. A context manager."""

    def __init__(self, folder: Path, seed: int, rooms: int) -> None:
        """Choose the office.

        Args:
            folder: for the robot's journal and the server's store; what is there is taken up.
            seed: of the office and the robot.
            rooms: along the corridor.
        """
        scenario = load_scenario(scenario_path("office"), ["robots=1", f"world.rooms={rooms}"])
        scenario = replace(scenario, missions={ROBOT: "idle"})
        self._folder = folder
        self._fleet = LocalFleet(TrialStage(scenario, seed, folder, AgentSettings()))
        self.control = self._fleet.control
        self.ticks = 0

    def __enter__(self) -> Office:
        """Start server, world and robot."""
        self._fleet.start()
        self._reports = Reports(self._fleet.bus, self._fleet.keys)
        return self

    def __exit__(self, *_: object) -> None:
        """Close journal and store."""
        self._fleet.end()

    def command(self, kind: MissionKind, node: NodeId | None = None) -> None:
        """Tell the robot what to do; it begins with the next tick."""
        send_order(self._fleet.bus, self._fleet.keys, MissionOrder.new(ROBOT, kind, "benchmark", node))

    def advance(self, seconds: float) -> AgentStatus:
        """Let simulated time pass; returns what the robot says then."""
        self.ticks += max(1, round(seconds * TICKS_PER_SECOND))
        self._fleet.advance(self.ticks)
        report = self._reports.agent(ROBOT)
        if report is None:
            raise NotConnected("the robot does not answer")
        return report

    def merged(self) -> MapFile:
        """The server's map."""
        replies = self._fleet.bus.ask(self._fleet.keys.server_map(SERVER), b"", 120.0)
        if not replies or replies[0].error:
            raise NotConnected("the map server does not hand out its map")
        return unpack_map_file(replies[0].payload)

    def explore(self, seconds: float, on_time: Callable[[float, str], None]) -> None:
        """Explore until nothing new is in reach, or for a time; the truth is kept beside the map.

        Args:
            seconds: simulated time at most.
            on_time: called with the simulated time and a word on progress.
        """
        self.command(MissionKind.EXPLORE)
        while self.ticks < seconds * TICKS_PER_SECOND:
            report = self.advance(LOOK_EVERY)
            on_time(self.ticks / TICKS_PER_SECOND, f"{report.status.nodes} nodes")
            if report.status.finished:
                break
        truth_of_nodes = self.control.truth_of(HybridMap(self.merged().changes).nodes.values())
        truth = {str(node): pose.vector.tolist() for node, pose in truth_of_nodes.items()}
        (self._folder / TRUTH).write_text(json.dumps(truth), encoding="utf-8")

    def mapped(self) -> Mapped:
        """The map that is there, with the truth that was kept.

        Raises:
            InvalidFile: it was not kept, or is of another map.
        """
        path, nodes = self._folder / TRUTH, HybridMap(self.merged().changes)
        try:
            kept = json.loads(path.read_text(encoding="utf-8"))
            truth = {node: Pose2.from_vector(np.array(kept[str(node)], np.float64)) for node in nodes.nodes}
        except (OSError, ValueError, KeyError) as error:
            raise InvalidFile(f"{path}: {error}; map the office again, in another folder") from None
        return Mapped(nodes, truth)
