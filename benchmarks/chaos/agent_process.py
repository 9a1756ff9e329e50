"""One robot's link in a process of its own: journal, replication, questions; and a log of what it has done.

    python -m benchmarks.chaos.agent_process '{"robot": 0, "endpoints": [...], "folder": ..., ...}'

Beside the journal it keeps a log that the journal knows nothing of, one line an event, each on the disk
before the robot goes on:

    T STEP CHANGES DIGEST      it is about to hand these changes of a step of its script to the replicator
    C STEP HEAD TIME           the journal has them: the log is now HEAD changes long

A change counts as sent from its C on. A process that was killed between the two begins by looking: what its
journal has is handed over, what it has not is handed over again. Times are those of the system's monotonic
clock, s. The acknowledgements that the journal has noted are in a file of their own: SERVER WATERMARK TIME.
"""

import hashlib
import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.chaos.disorder import DisorderedBus
from benchmarks.chaos.scripted_robot import ScriptedRobot
from mapweave.agent.fleet_client import FleetClient
from mapweave.agent.mission_control import MissionControl
from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.commands.network import stop_on_signals
from mapweave.hybridmap.agent_status import Status
from mapweave.hybridmap.change import ChangeBody
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.pose import Pose2
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.codec import encode_body
from mapweave.wire.keys import Keys
from mapweave.wire.zenoh_bus import ZenohBus

FLEET = "chaos"
STAMP = 1_000_000
"""ns between two steps of a script."""
ENOUGH = "mapped"
"""File with which robots map no more, and end when all is acknowledged."""


@dataclass(frozen=True)
class Orders:
    """What the process has to do.

    Attributes:
        robot: its number.
        endpoints: of its routers.
        folder: for the journal and the logs.
        servers: which must have every change.
        interval: between two steps, s.
        seed: of the fleet.
    """

    robot: int
    endpoints: tuple[str, ...]
    folder: str
    servers: tuple[str, ...]
    interval: float
    seed: int


class DurableLines:
    """Lines in a file, each on the disk when `write` returns."""

    def __init__(self, path: Path) -> None:
        """Go on with the file; a line that was cut off by a kill is ended."""
        self._file = os.open(path, os.O_CREAT | os.O_RDWR | os.O_APPEND)
        size = os.fstat(self._file).st_size
        if size and os.pread(self._file, 1, size - 1) != b"\n":
            os.write(self._file, b"\n")

    def write(self, line: str) -> None:
        """Add a line."""
        os.write(self._file, f"{line}\n".encode())
        os.fsync(self._file)


class NotedJournal(Journal):
    """A journal that writes down when an acknowledgement is on the disk."""

    def __init__(self, path: Path, agent: str, noted: DurableLines) -> None:
        """See Journal."""
        super().__init__(path, agent)
        self._noted = noted

    def acknowledge(self, server: str, map_id: MapId, watermark: int, reset: bool = False) -> None:
        """See Journal."""
        super().acknowledge(server, map_id, watermark, reset)
        self._noted.write(f"{server} {watermark} {time.monotonic()}")


def digest(bodies: Sequence[ChangeBody]) -> str:
    """The digest of the changes of a step."""
    return hashlib.sha256(b"".join(map(encode_body, bodies))).hexdigest()[:16]


def main() -> None:
    """Map until stopped or killed."""
    orders = Orders(**json.loads(sys.argv[1]))
    script, folder, keys = ScriptedRobot(orders.robot, orders.seed), Path(orders.folder), Keys(FLEET)
    name = script.map.agent
    stop = stop_on_signals()
    truth = DurableLines(folder / f"{name}.truth")
    journal = NotedJournal(folder / f"{name}.sqlite", name, DurableLines(folder / f"{name}.acks"))
    map_id = journal.open_map(1)
    head = journal.head(map_id)
    step = position = 0
    bodies: list[ChangeBody] = []
    while position < head:
        bodies = script.step()
        step, position = step + 1, position + len(bodies)
    if position != head:
        truth.write(f"TORN {step} {head}")
        raise SystemExit(f"{name}: half of step {step} is in the journal")
    if step:
        truth.write(f"C {step} {head} {time.monotonic()}")
    link = ZenohBus(BusSettings(endpoints=tuple(orders.endpoints)))
    bus = DisorderedBus(link, folder, [orders.seed, orders.robot, 2, head])
    replicator = Replicator(bus, keys, journal, map_id, orders.servers)
    client = FleetClient(
        bus, keys, map_id, MissionControl(name), answer_timeout=3.0, unsent=replicator.unacknowledged
    )
    try:
        while not stop.is_set() and not (folder / ENOUGH).exists():
            bodies = script.step()
            step += 1
            truth.write(f"T {step} {len(bodies)} {digest(bodies)}")
            replicator.submit(bodies, step * STAMP)
            while not replicator.flush(1.0):
                if stop.is_set():
                    return
            head += len(bodies)
            truth.write(f"C {step} {head} {time.monotonic()}")
            client.report(Status("mapping", "", step, 0, Pose2(), True), time.time_ns())
            stop.wait(orders.interval)
        while not stop.is_set() and not replicator.wait_acknowledged(1.0):
            pass
    finally:
        client.close()
        replicator.close()
        bus.close()
        link.close()
        journal.close()


if __name__ == "__main__":
    main()
