"""A map server with a mapped room, robots that do nothing but say so, and a person."""

import http.client
import json
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapweave.agent.fleet_client import FleetClient
from mapweave.agent.mission_control import MissionControl
from mapweave.fleet import Fleet
from mapweave.hybridmap.agent_status import Status
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import View
from mapweave.mapserver.http.web import Web
from mapweave.mapserver.server import MapServer
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from synthetic.world import World, take_view
from tests.waiting import eventually

KEYS = Keys("fleet")
ROBOT = MapId("r0", 1)
STANDING = Status("standing", "", 7, 0, Pose2(0.0, 0.1, 0.0), False, "explore", located=True)
"""Of a robot that knows where it is."""


@dataclass(frozen=True, eq=False)
class MappedRoom:
    """A room that one robot has mapped, as its map server's store holds it.

    Attributes:
        path: of the store.
        world: the room.
        truth: where each node was made.
    """

    path: Path
    world: World
    truth: dict[NodeId, Pose2]

    def view(self, node: NodeId, seed: int = 5) -> View:
        """A view a little away from a node."""
        pose = self.truth[node] @ Pose2(0.1, 0.05, 0.05)
        return take_view(self.world, pose, np.random.default_rng(seed))[0]


class House:
    """A map server with a mapped room, robots that do nothing but say so, and a person."""

    def __init__(self, mapped: MappedRoom) -> None:
        self.mapped, self.hub = mapped, MemoryHub()
        self.stack = ExitStack()
        self.buses: list[MemoryBus] = []
        self.links: list[FleetClient] = []
        self.start_server()
        self.person = Fleet(fleet="fleet", by="anna", bus=self.bus())

    def bus(self) -> MemoryBus:
        self.buses.append(MemoryBus(self.hub))
        return self.buses[-1]

    def start_server(self) -> None:
        self.server: MapServer = self.stack.enter_context(MapServer(self.bus(), KEYS, self.mapped.path, "s0"))
        eventually(lambda: self.server.status()["nodes"] == 7)

    def stop_server(self) -> None:
        self.stack.close()

    def restart_server(self) -> None:
        self.stop_server()
        self.start_server()

    def robot(self, name: str = "r0") -> tuple[FleetClient, MissionControl]:
        control = MissionControl(name)
        link = FleetClient(self.bus(), KEYS, replace_agent(name), control)
        link.report(STANDING, 1)
        self.links.append(link)
        eventually(lambda: self.entry(name).status is not None)
        return link, control

    def robot_that_left(self) -> None:
        """Robot r0 has been here, and is away."""
        self.robot()[0].close()
        eventually(lambda: not self.entry("r0").alive)

    def entry(self, name: str):
        entries = {entry.robot: entry for entry in self.person.status().robots}
        return entries.get(name, type("Nothing", (), {"status": None, "alive": False}))

    def close(self) -> None:
        for link in self.links:
            link.close()
        self.stop_server()
        for bus in self.buses:
            bus.close()


def replace_agent(name: str):
    return ROBOT._replace(agent=name)


def ask(web: Web, method: str, path: str, body: object = None, **headers: str) -> tuple[int, dict]:
    """Status and JSON of an answer over HTTP, to a question without a body, with bytes or with JSON."""
    connection = http.client.HTTPConnection("127.0.0.1", web.port, timeout=20)
    data = body if isinstance(body, bytes) else json.dumps(body).encode() if body is not None else None
    connection.request(method, path, data, {"Content-Type": "application/json", **headers})
    reply = connection.getresponse()
    content = reply.read()
    connection.close()
    return reply.status, json.loads(content)
