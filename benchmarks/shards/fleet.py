"""A fleet in one building, its store, the views that lost robots ask about, and a robot that maps on."""

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.hybridmap.change import ChangeBody, EdgePut, NodePut
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import RelocalizeAnswer
from mapweave.mapserver.log.opening import open_store
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.messages import encode_view
from mapweave.wire.zenoh_bus import ZenohBus
from synthetic.building import Building
from synthetic.maps import fill_store

FLEET = "shards"
WRONG_M = 0.5
"""A place that is found this far from where the view was taken is wrong."""


class BuildingFleet:
    """Robots that have mapped a building.

    Attributes:
        building: with the truth.
        logs: of each robot.
        nodes: of all robots.
        edges: how many they have measured.
    """

    def __init__(self, robots: int, nodes: int, seed: int) -> None:
        """Draw it.

        Args:
            robots: how many.
            nodes: of each.
            seed: of all.
        """
        self.building = Building.draw(robots, nodes, seed)
        self.logs: list[list[tuple[MapId, ChangeBody]]] = [
            list(self.building.log(robot)) for robot in range(robots)
        ]
        self.nodes = [body.node for log in self.logs for _, body in log if isinstance(body, NodePut)]
        self.edges = len({body.edge.id for log in self.logs for _, body in log if isinstance(body, EdgePut)})
        self._seed = seed

    def write(self, address: Path | str, robots: Sequence[int]) -> None:
        """Write the logs of some robots to an empty store: a file, or a PostgreSQL database."""
        logs = [self.logs[robot] for robot in robots]
        store = open_store(address)
        fill_store(store, {log[0][0]: [body for _, body in log] for log in logs})
        store.close()

    def questions(self, count: int) -> list[tuple[bytes, Pose2]]:
        """Views a little beside nodes, as messages, and where each was taken."""
        rng = np.random.default_rng([self._seed, 7])
        made = []
        for _ in range(count):
            robot, number = (int(rng.integers(size)) for size in self.building.rooms.shape)
            offset = Pose2.from_vector(rng.normal(0.0, [0.12, 0.12, 0.1]))
            view, pose = self.building.view(robot, number, offset, rng)
            made.append((encode_view(view), pose))
        return made

    def is_wrong(self, answer: RelocalizeAnswer, pose: Pose2) -> bool:
        """Whether the best candidate is somewhere else."""
        best = answer.candidates[0]
        return (self.building.world_from(best.node) @ best.node_from_robot.mean).distance(pose) > WRONG_M


class MappingRobot:
    """Sends a log, a node at a time, as an agent does."""

    def __init__(
        self, log: list[tuple[MapId, ChangeBody]], endpoint: str, folder: Path, servers: Sequence[str]
    ) -> None:
        """Connect.

        Args:
            log: to be sent.
            endpoint: where.
            folder: for its journal.
            servers: that all have to have it.
        """
        self._bus = ZenohBus(BusSettings(endpoints=(endpoint,)))
        self.agent = log[0][0].agent
        self._journal = Journal(folder / f"{self.agent}.sqlite", self.agent)
        self._map = self._journal.open_map(1)
        assert self._map == log[0][0], self._map
        self._replicator = Replicator(self._bus, Keys(FLEET), self._journal, self._map, servers)
        self._left = [body for _, body in log][::-1]

    def map_on(self, changes: int = 1) -> bool:
        """Send the next changes, as far as there are any; says whether more are left."""
        for _ in range(min(changes, len(self._left))):
            self._replicator.submit([self._left.pop()], time.time_ns())
        return bool(self._left)

    def acknowledged(self, timeout: float) -> bool:
        """Whether all servers have all that was sent, within so many seconds."""
        return self._replicator.wait_acknowledged(timeout)

    def close(self) -> None:
        """Disconnect."""
        self._replicator.close()
        self._bus.close()
        self._journal.close()
