"""A merge that loses its support is undone by itself: a real server process, two robots that map on."""

import json
import re
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest

from mapweave import MapId, NodeId, Pose2
from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.merged_poses import MergedPoses
from mapweave.agent.replication.replicator import Replicator
from mapweave.cli import main
from mapweave.exit_status import DONE, NO
from mapweave.hybridmap.change import ChangeBody, EdgePut, NodePut
from mapweave.scenarios.children import Children
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.zenoh_bus import ZenohBus
from synthetic.world import room, take_map
from tests.waiting import eventually, free_port

R0, R1 = MapId("r0", 1), MapId("r1", 1)
EAST = Pose2(20.0, 0.0, 0.0)
"""Where the second of two rooms is that look alike."""
FIRST, ALL = 6, 12
"""Nodes of each robot before the two move at the same time, and in all."""
KEYS = Keys("twins")


def lives(seed: int) -> dict[MapId, list[list[ChangeBody]]]:
    """What two robots send from node to node, in rooms that look the same.

    They do much the same, the second one a while later; then, after a pause, both at the same time.
    """
    rng = np.random.default_rng(seed)
    here = room(0, 0, 5, 4, 700, rng)
    at, places = np.array([2.5, 2.0]), []
    while len(places) < ALL:
        angle = rng.uniform(-np.pi, np.pi)
        place = at + 0.5 * np.array([np.cos(angle), np.sin(angle)])
        if (np.abs(place - [2.5, 2.0]) < [1.3, 1.0]).all():
            places.append((*place, angle))
            at = place
    out: dict[MapId, list[list[ChangeBody]]] = {}
    for map_id, world, shift, late in ((R0, here, Pose2(), 0.0), (R1, here.moved(EAST), EAST, 100.0)):
        tour = [shift @ Pose2(*(np.array(one) + rng.normal(0, [0.04, 0.04, 0.0]))) for one in places]
        nodes, edges = take_map(world, map_id, tour, rng, sigma_xy=0.006, sigma_heading=0.005)
        stamps = [4.0 * k + (late if k < FIRST else 300.0) for k in range(ALL)]
        nodes = [
            replace(node, stamp_ns=round(1e9 * stamp), clock="net", radius=0.1)
            for node, stamp in zip(nodes, stamps, strict=True)
        ]
        out[map_id] = [
            [NodePut(node), *map(EdgePut, edges[max(k - 1, 0) : k])] for k, node in enumerate(nodes)
        ]
    return out


class Robot:
    """The part of an agent that talks to the server."""

    def __init__(self, map_id: MapId, folder: Path, endpoint: str, life: list[list[ChangeBody]]) -> None:
        self.map, self.life = map_id, life
        self.bus = ZenohBus(BusSettings(mode="client", endpoints=(endpoint,)))
        self.journal = Journal(folder / f"{map_id.agent}.sqlite", map_id.agent)
        self.journal.open_map(map_id.epoch)
        self.sender = Replicator(self.bus, KEYS, self.journal, map_id)
        self.poses = MergedPoses(self.bus, KEYS, map_id.agent, "s0")

    def close(self) -> None:
        self.poses.close()
        self.sender.close()
        self.journal.close()
        self.bus.close()

    def maps(self, nodes: slice) -> None:
        """Send some nodes."""
        for k, changes in enumerate(self.life[nodes]):
            self.sender.submit(changes, k)

    def frames(self) -> set[NodeId]:
        """The components of its first nodes, as published."""
        result = [self.poses.of(NodeId(*self.map, 2 * k + 1)) for k in range(FIRST)]
        return {NodeId("?", 0, 0) if item is None else item.frame for item in result}


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[tuple[Children, list[str], list[Robot], int]]:
    """A server process and two robots; arguments to ask it; its port for people."""
    port, http = free_port(), free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    serve = ["server", "--fleet", "twins", "--listen", endpoint, "--data", str(tmp_path), "--http", str(http)]
    with Children(tmp_path / "logs") as children, ExitStack() as robots:
        children.start("server", serve)
        collected = [Robot(one, tmp_path, endpoint, life) for one, life in lives(1).items()]
        for robot in collected:
            robots.callback(robot.close)
        yield children, serve, collected, http


@pytest.mark.slow
def test_a_merge_that_loses_its_support_is_undone_and_reported(
    fleet: tuple[Children, list[str], list[Robot], int], tmp_path, capfd
):
    children, serve, robots, http = fleet

    def status() -> dict[str, object]:
        time.sleep(0.05)
        try:
            with urlopen(f"http://127.0.0.1:{http}/status", timeout=5) as reply:
                return dict(json.load(reply))
        except OSError:
            children.check()
            return {}

    def holds(**wanted: object) -> Callable[[], bool]:
        return lambda: wanted.items() <= status().items()

    def said(*words: object) -> str:
        at = ["--fleet", "twins", "--connect", serve[4]]
        capfd.readouterr()
        assert main(["map", *map(str, words), *at]) in (DONE, NO)
        return capfd.readouterr().out

    for robot in robots:
        robot.maps(slice(FIRST))
    # The rooms cannot be distinguished yet: the robots have not moved at the same time.
    eventually(holds(nodes=2 * FIRST, components=1, settled=True))
    assert str(status()["event"]).startswith("r0.1 and r1.1 are one map now, by ")
    eventually(lambda: all(robot.frames() == {NodeId(*R0, 1)} for robot in robots))
    assert said("explain", R0, R1).startswith("r0.1 and r1.1 are one map: ")
    assert "the route is" in said("route", "r0.1.1", "r1.1.1")

    for robot in robots:
        robot.maps(slice(FIRST, ALL))
    eventually(holds(nodes=2 * ALL, components=2, settled=True))
    event = str(status()["event"])
    assert re.match(r"r0\.1 and r1\.1 are no longer one map: \d+ links refused \(r0 and r1 would have", event)
    assert "at the same place at the same time" in event
    # The robot whose frame it was keeps its poses; the other gets new ones.
    eventually(lambda: [robot.frames() for robot in robots] == [{NodeId(*R0, 1)}, {NodeId(*R1, 1)}])
    explained = said("explain", R0, R1)
    assert explained.startswith("r0.1 and r1.1 are not one map: ") and "at the same place" in explained
    way = said("route", "r0.1.1", "r1.1.1")
    assert "there is no way" in way and "at the same place at the same time" in way

    def history() -> list[dict[str, object]]:
        return list(json.loads(said("history", "--json"))["history"])

    before = history()
    assert [item["kind"] for item in before] == ["joined", "parted"] and before[1]["words"] == event
    logged = (tmp_path / "logs" / "server.log").read_text()
    stamped = r"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d "
    assert re.search(stamped + re.escape(event), logged, re.M)

    # Killed and started again, it has the history with dates, and reports it once.
    children.kill("server")
    children.start("server", serve)
    eventually(holds(nodes=2 * ALL, components=2, settled=True))
    assert status()["event"] == event and history() == before
    assert (tmp_path / "logs" / "server.log").read_text().count(event) == 1
    eventually(lambda: [robot.frames() for robot in robots] == [{NodeId(*R0, 1)}, {NodeId(*R1, 1)}])
