"""`mapweave agent` on a small disk of its own that becomes full; run by a test.

    unshare --user --map-root-user --mount python -m tests.mapweave.full_disk_agent FOLDER

Prints what was seen as JSON.
"""

import json
import os
import signal
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

from mapweave import AgentStatus, HybridMap, MapId
from mapweave.agent.replication.journal import Journal
from mapweave.mapserver.log.opening import open_store
from mapweave.scenarios.children import Children, free_port
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.codec import encode_body
from mapweave.wire.messages import decode
from mapweave.wire.zenoh_bus import ZenohBus
from tests.disks import empty, fill, mount
from tests.mapweave.test_kept_maps import KEYS, PATIENCE, Body
from tests.waiting import eventually

MAP = MapId("r0", 1)
STILL = 3.0
"""s, in which an agent that ends on a full disk ends."""
NEW = 3
"""Nodes that are made while the disk is full."""


class Robot:
    """An agent whose data is on the disk `disk`, its body, and a server on another disk."""

    def __init__(self, root: Path, children: Children, bus: ZenohBus, endpoint: str) -> None:
        """Mount the disk; no agent runs yet."""
        self.root, self.children, self.endpoint = root, children, endpoint
        self.disk = mount(root / "disk", "16m")
        self.bus = bus
        Body(bus)

    def start(self, *more: str) -> None:
        """Start the agent: it maps what it is carried past, on the map that it has."""
        network = ["--fleet", "kept", "--connect", self.endpoint]
        arguments = ["agent", "r0", "--data", str(self.disk), *network]
        self.children.start("r0", [*arguments, *(more or ["--mission", "carried"])])

    def status(self) -> AgentStatus | None:
        """What it says of itself."""
        self.children.check()
        replies = [r for r in self.bus.ask(KEYS.agent_status("r0"), b"", 2.0) if not r.error]
        return decode(replies[0].payload, AgentStatus) if replies else None

    def nodes(self) -> int:
        """On its map."""
        status = self.status()
        return 0 if status is None else status.status.nodes

    def wait_mapped(self, nodes: int) -> int:
        """Until it has so many nodes, and returns how many."""
        eventually(lambda: self.nodes() >= nodes, PATIENCE)
        return self.nodes()

    def wait_stored(self) -> None:
        """Until the server has all that the robot has mapped so far."""

        def stored() -> bool:
            now = self.status()
            return now is not None and now.unsent == 0 and now.status.nodes > 0

        eventually(stored, PATIENCE)

    def lines(self) -> list[str]:
        """What it has said so far."""
        return (self.root / "logs" / "r0.log").read_text(errors="replace").splitlines()

    def wait_for_line(self, words: str, after: int = 0) -> None:
        """Until it says that."""
        eventually(lambda: any(words in line for line in self.lines()[after:]), PATIENCE)


def filled_and_emptied(robot: Robot) -> dict[str, Any]:
    """The disk is full for a while: the robot maps on, and what it mapped is stored afterwards."""
    before = robot.wait_mapped(2)
    robot.wait_stored()
    began = len(robot.lines())
    fill(robot.disk)
    robot.wait_for_line("the disk is full", began)
    while_full = robot.wait_mapped(robot.nodes() + NEW)
    status = robot.status()
    said: dict[str, Any] = {"new while full": while_full - before, "lines": robot.lines()[began:]}
    said["failure"] = None if status is None else status.last_error
    empty(robot.disk)
    robot.wait_for_line("has room again", began)
    robot.wait_stored()
    said["nodes after"] = robot.nodes() - while_full
    said["lines after"] = robot.lines()[began:]
    return said


def killed_and_lost_while_full(robot: Robot) -> dict[str, Any]:
    """It is killed on a full disk. Begun again, it does not find itself, and a full disk takes no new map."""
    fill(robot.disk)
    robot.wait_mapped(robot.nodes() + NEW)
    robot.children.kill("r0")
    empty(robot.disk)
    began = len(robot.lines())
    robot.start()
    robot.wait_for_line(f"takes up map {MAP}", began)
    fill(robot.disk)
    robot.wait_for_line("the disk is full", began)
    time.sleep(STILL)
    robot.children.check()
    empty(robot.disk)
    robot.wait_for_line("it begins map r0.2", began)
    robot.wait_mapped(NEW)
    robot.wait_stored()
    return {"lines": robot.lines()[began:]}


def ended_while_full(robot: Robot) -> dict[str, Any]:
    """It is asked to end on a full disk."""
    began = len(robot.lines())
    fill(robot.disk)
    robot.wait_for_line("the disk is full", began)
    robot.wait_mapped(robot.nodes() + NEW)
    pid = robot.children.pid("r0")
    os.kill(pid, signal.SIGTERM)
    status = robot.children._running.pop("r0").wait(PATIENCE)
    empty(robot.disk)
    return {"status": status, "lines": robot.lines()[began:]}


def on_both_disks(robot: Robot) -> dict[str, Any]:
    """Of each map how many nodes the robot's disk has, and whether the server's has the same."""
    journal, store = Journal(robot.disk / "r0.sqlite"), open_store(robot.root / "server" / "s0.sqlite")
    said: dict[str, Any] = {}
    with closing(journal), closing(store):
        for which in journal.maps():
            maps = HybridMap(journal.replay(which)), HybridMap(c.body for c in store.replay(which))
            kept, stored = (sorted(encode_body(body) for body in one.contents()) for one in maps)
            same = kept == stored and journal.head(which) == store.watermark(which)
            said[str(which)] = {"nodes": len(maps[0].nodes), "same": same}
    return said


def main() -> None:
    """Run all of it and print what was seen."""
    root, endpoint = Path(sys.argv[1]), f"tcp/127.0.0.1:{free_port()}"
    with Children(root / "logs") as children:
        data = str(root / "server")
        children.start("server", ["server", "--fleet", "kept", "--listen", endpoint, "--data", data])
        with closing(ZenohBus(BusSettings(mode="client", endpoints=(endpoint,)))) as bus:
            asked = KEYS.server_status("s0")
            eventually(lambda: any(not reply.error for reply in bus.ask(asked, b"", 1.0)), PATIENCE)
            robot = Robot(root, children, bus, endpoint)
            robot.start()
            said: dict[str, Any] = {"disk": str(robot.disk), "full": filled_and_emptied(robot)}
            said |= {"lost": killed_and_lost_while_full(robot), "ended": ended_while_full(robot)}
            began = len(robot.lines())
            robot.start("--mission", "idle", "--resume", "r0.2")
            robot.wait_for_line("takes up map r0.2", began)
            robot.wait_mapped(1)
            robot.wait_stored()
            children.end("r0")
            children.end("server")
            said["maps"] = on_both_disks(robot)
            print(json.dumps(said))


if __name__ == "__main__":
    main()
