"""A server and a robot's link as processes, on small disks of their own that become full; run by a test.

    unshare --mount python -m tests.benchmarks.disk_processes STORE FOLDER

Prints what was seen as JSON. STORE is sqlite or postgresql.
"""

import json
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import psycopg

from benchmarks.chaos.account import account, sent_changes
from benchmarks.chaos.agent_process import ENOUGH, FLEET, Orders
from mapweave.agent.replication.journal import Journal
from mapweave.mapserver.log.opening import open_store
from mapweave.processes import parent_watchdog
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.log_messages import decode_record
from mapweave.wire.zenoh_bus import ZenohBus
from synthetic.postgres_server import PostgresServer
from tests.disks import empty, fill, make_read_only, mount
from tests.programs import mapweave
from tests.waiting import eventually, free_port

SEED, INTERVAL = 7, 0.1
"""Of the robot; the second is s between two steps: it stays below the server's quota of changes."""
PATIENCE = 90.0
FULL = {"sqlite": "the disk is full", "postgresql": "No space left on device"}
"""What is said of a full disk; PostgreSQL's words are its own."""
STILL = 3.0
"""s in which an acknowledgement that is wrong would come."""
SIZES = {"sqlite": "24m", "postgresql": "160m", "log": "64m", "robot": "16m"}


class DiskFleet:
    """A server, whose store is on the disk `disk`, and a robot, whose journal is on the disk `robot`."""

    def __init__(self, root: Path, store: str) -> None:
        """Mount the disks; no server or robot runs yet."""
        self.root, self.disk, self.robot = root, root / "disk", root / "robot"
        self._full = {"server": FULL[store], "robot": FULL["sqlite"]}
        mount(self.disk, SIZES[store])
        mount(self.robot, SIZES["robot"])
        # What the robot says about itself is on another disk.
        for name in ("r0.truth", "r0.acks", ENOUGH):
            (self.robot / name).symlink_to(root / name)
        self.postgres = PostgresServer(self.disk, "-c", "fsync=on") if store == "postgresql" else None
        if self.postgres is not None:
            # Its write-ahead log has a disk of its own, as it may in the field.
            self.postgres.stop()
            mount(self.disk / "log_disk", SIZES["log"])
            subprocess.run(["cp", "-a", self.postgres.data / "pg_wal", self.disk / "log_disk"], check=True)
            shutil.rmtree(self.postgres.data / "pg_wal")
            (self.postgres.data / "pg_wal").symlink_to(self.disk / "log_disk" / "pg_wal")
            self.postgres.start()
        self.address = str(self.disk / "s0.sqlite") if self.postgres is None else self.postgres.database()
        port = f"tcp/127.0.0.1:{free_port()}"
        data = self.disk if self.postgres is None else root / "data"
        orders = Orders(0, (port,), str(self.robot), ("s0",), INTERVAL, SEED)
        server = [
            "mapweave", "server", "--name", "s0", "--fleet", FLEET, "--listen", port, "--data", str(data),
        ]  # fmt: skip
        self._commands = {
            "server": server if self.postgres is None else [*server, "--store", self.address],
            "robot": ["benchmarks.chaos.agent_process", json.dumps(asdict(orders))],
        }
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._bus = ZenohBus(BusSettings(endpoints=(port,)))

    def start(self, name: str) -> None:
        """Start the server or the robot."""
        with (self.root / f"{name}.log").open("ab") as output:
            self._running[name] = subprocess.Popen(
                [sys.executable, "-m", *self._commands[name]], stdin=subprocess.PIPE, stdout=output,
                stderr=subprocess.STDOUT, env=parent_watchdog.environment(),
            )  # fmt: skip

    def kill(self, name: str) -> None:
        """As by a loss of power."""
        process = self._running[name]
        process.kill()
        process.wait()

    def runs(self, name: str) -> bool:
        """Whether it has not ended."""
        return self._running[name].poll() is None

    def status(self, name: str) -> int | None:
        """With which it has ended."""
        return self._running[name].poll()

    def end(self) -> None:
        """End all."""
        self._bus.close()
        for process in self._running.values():
            process.kill()
            process.wait()
        if self.postgres is not None:
            self.postgres.stop()

    def lines(self, name: str) -> list[str]:
        """What it has said of a full disk, and tracebacks."""
        said = (self.root / f"{name}.log").read_text().splitlines()
        return [one for one in said if self._full[name] in one or one.startswith("Traceback")]

    def room_again(self, name: str) -> list[str]:
        """What it has said of a disk that has room again."""
        said = (self.root / f"{name}.log").read_text().splitlines()
        return [one for one in said if "has room again" in one]

    def troubled(self) -> bool:
        """Whether the server's status says that the disk is full."""
        return self._full["server"] in self.event()

    def acknowledged(self) -> int:
        """Up to which change the robot knows that the server has its log."""
        try:
            return int((self.root / "r0.acks").read_text().splitlines()[-1].split()[1])
        except (FileNotFoundError, IndexError):
            return 0

    def committed(self) -> int:
        """How many changes the robot's journal has, by the robot's own log."""
        lines = (self.root / "r0.truth").read_text().splitlines() if (self.root / "r0.truth").exists() else []
        return next((int(line.split()[2]) for line in reversed(lines) if line.startswith("C ")), 0)

    def wait_more(self) -> None:
        """Until changes that are yet to be made are committed and acknowledged."""
        goal = self.committed() + 20
        eventually(lambda: self.acknowledged() >= goal, PATIENCE)

    def event(self) -> str:
        """What the server's status says of its store."""
        replies = self._bus.ask(Keys(FLEET).server_status("s0"), b"", 5.0)
        return next((str(decode_record(one.payload).get("event")) for one in replies if not one.error), "")


def server_disk(fleet: DiskFleet) -> dict[str, Any]:
    """The disk of the server's store is full, and has room again; then the server is killed on a full one."""
    said: dict[str, Any] = {}
    fill(fleet.disk)
    eventually(lambda: fleet.lines("server"), PATIENCE)
    before = fleet.acknowledged()
    time.sleep(STILL)
    said["acknowledged while full"] = fleet.acknowledged() - before
    said["event"] = fleet.event()
    said["runs"] = fleet.runs("server")
    said["lines"] = fleet.lines("server")
    empty(fleet.disk)
    if fleet.postgres is not None and fleet.postgres.process.poll() is not None:
        said["postgres ended"] = True
        fleet.postgres.start()
    fleet.wait_more()
    said["lines after"], said["room again"] = fleet.lines("server"), fleet.room_again("server")
    eventually(lambda: not fleet.troubled(), PATIENCE)

    fill(fleet.disk)
    eventually(lambda: len(fleet.lines("server")) > len(said["lines"]), PATIENCE)
    fleet.kill("server")
    said["missing after kill"] = missing(fleet) if fleet.postgres is None else 0
    fleet.start("server")
    eventually(lambda: not fleet.runs("server") or fleet.event(), PATIENCE)
    said["started full"] = fleet.runs("server") or (fleet.root / "server.log").read_text().splitlines()[-1]
    empty(fleet.disk)
    if fleet.postgres is not None and fleet.postgres.process.poll() is not None:
        fleet.postgres.start()
    if not fleet.runs("server"):
        fleet.start("server")
    fleet.wait_more()
    return said


def missing(fleet: DiskFleet) -> int:
    """Acknowledged changes that the killed server's store does not have on a copy of its full disk."""
    copy = fleet.root / "copy"
    subprocess.run(["cp", "-a", fleet.disk, copy], check=True)
    store = open_store(copy / "s0.sqlite")
    (map_id,) = store.maps()
    lacking = fleet.acknowledged() - store.watermark(map_id)
    store.close()
    return max(0, lacking)


def log_disk(fleet: DiskFleet) -> dict[str, Any]:
    """The disk of PostgreSQL's write-ahead log is full: it ends, and comes back when there is room."""
    assert fleet.postgres is not None
    fill(fleet.disk / "log_disk")
    with psycopg.connect(fleet.postgres.address(), autocommit=True) as people:
        for _ in range(8):
            # Segments that are there already are used first.
            with suppress(psycopg.OperationalError):
                people.execute("SELECT pg_switch_wal()")
                time.sleep(0.2)
    eventually(lambda: "map store cannot be used" in fleet.event(), PATIENCE)
    before = fleet.acknowledged()
    time.sleep(STILL)
    said = {"acknowledged while full": fleet.acknowledged() - before, "event": fleet.event()}
    said |= {"runs": fleet.runs("server"), "postgres ended": fleet.postgres.process.poll() is not None}
    empty(fleet.disk / "log_disk")
    if said["postgres ended"]:
        fleet.postgres.start()
    fleet.wait_more()
    return said


def robot_disk(fleet: DiskFleet) -> dict[str, Any]:
    """The disk of the robot's journal is full, and has room again; then the robot is killed on a full one."""
    said: dict[str, Any] = {}
    fill(fleet.robot)
    eventually(lambda: fleet.lines("robot"), PATIENCE)
    said["runs"], said["lines"] = fleet.runs("robot"), fleet.lines("robot")
    empty(fleet.robot)
    fleet.wait_more()
    said["lines after"], said["room again"] = fleet.lines("robot"), fleet.room_again("robot")
    fill(fleet.robot)
    eventually(lambda: len(fleet.lines("robot")) > len(said["lines"]), PATIENCE)
    fleet.kill("robot")
    empty(fleet.robot)
    fleet.start("robot")
    fleet.wait_more()
    return said


def read_only_disk(fleet: DiskFleet) -> dict[str, Any]:
    """The server is started on a disk that nothing can be written to."""
    make_read_only(fleet.disk)
    before = (fleet.root / "server.log").read_text()
    fleet.start("server")
    eventually(lambda: not fleet.runs("server"), PATIENCE)
    said = (fleet.root / "server.log").read_text().removeprefix(before).splitlines()
    shown = mapweave("map", "show", fleet.address, timeout=PATIENCE)
    return {"lines": said, "status": fleet.status("server"), "show": shown.returncode}


def main() -> None:
    """Run all of it and print what was seen."""
    store, root = sys.argv[1], Path(sys.argv[2])
    fleet = DiskFleet(root, store)
    try:
        fleet.start("server")
        fleet.start("robot")
        fleet.wait_more()
        said = {"server": server_disk(fleet), "robot": robot_disk(fleet)}
        said["disks"] = {"server": str(fleet.disk), "robot": str(fleet.robot)}
        if fleet.postgres is not None:
            said["log"] = log_disk(fleet)
        (root / ENOUGH).touch()
        eventually(lambda: not fleet.runs("robot"), PATIENCE)
        fleet.kill("server")
        opened, journal = open_store(fleet.address), Journal(fleet.robot / "r0.sqlite")
        found = account(sent_changes(root, 0, SEED), journal, [opened])
        opened.close()
        journal.close()
        if fleet.postgres is None:
            said["read-only"] = read_only_disk(fleet)
        print(json.dumps(said | {"account": asdict(found)}))
    finally:
        fleet.end()


if __name__ == "__main__":
    main()
