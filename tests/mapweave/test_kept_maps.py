"""No start of an agent loses a map: real processes that are killed, journals and map files."""

import shutil
import sqlite3
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mapweave import AgentStatus, EdgeKind, HybridMap, MapId, MissionKind, NodeId, Pose2
from mapweave.agent.drivers.messages import decode_step, encode_description, encode_observation
from mapweave.agent.observation import Command, Observation, Odometry, RobotDescription
from mapweave.agent.pipeline import TickResult
from mapweave.agent.replication.journal import Journal
from mapweave.agent.replication.replicator import Replicator
from mapweave.agent.settings import AgentSettings
from mapweave.cli import main
from mapweave.exit_status import NO, USAGE
from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.errors import InvalidFile
from mapweave.processes import agent_process
from mapweave.processes.agent import Agent, AgentOptions
from mapweave.processes.agent_files import epochs_of_files
from mapweave.processes.agent_process import run_agent
from mapweave.scenarios.children import Children, free_port
from mapweave.storage.map_file import MapFile, read_map_file, write_map_file
from mapweave.storage.os_errors import DISK_FULL, NO_ROOM
from mapweave.wire.bus import Request
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.codec import encode_body
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import decode
from mapweave.wire.zenoh_bus import ZenohBus
from tests.agent.conftest import DESCRIPTION, PhotoWalls
from tests.mapweave.command_line import complaint
from tests.mapweave.test_cli_files import one_node
from tests.waiting import eventually

KEYS = Keys("kept")
PATIENCE = 120.0
"""s; for a process to start and map a few views on a machine that is busy."""
WAY = [*np.arange(0.0, 1.2, 0.02), *np.arange(1.2, 0.0, -0.02)]
"""m: a body is carried back and forth before two photographs."""


class Body:
    """A camera that a person carries back and forth, as fast as its agent asks."""

    def __init__(self, bus: ZenohBus, robot: str = "r0") -> None:
        walls = PhotoWalls()
        # No two cameras give the same bits.
        noise = np.random.default_rng(list(robot.encode()))
        images = [walls.render(Pose2(float(x))) for x in WAY]
        self._images = [
            np.clip(image + noise.normal(0.0, 2.0, image.shape), 0, 255).astype(np.uint8) for image in images
        ]
        self._tick = 0
        bus.serve(KEYS.robot_describe(robot), lambda request: request.reply(encode_description(DESCRIPTION)))
        bus.serve(KEYS.robot_step(robot), self._step)

    def _step(self, request: Request) -> None:
        decode_step(request.payload)
        before, now = self._tick % len(WAY), (self._tick + 1) % len(WAY)
        self._tick += 1
        moved = Odometry(float(WAY[now] - WAY[before]), 0.0)
        request.reply(encode_observation(Observation(self._tick * 10**8, moved, self._images[now])))


@pytest.fixture
def network(tmp_path: Path) -> Iterator[tuple[Children, ZenohBus, str]]:
    """A server process with its router, a body, and an endpoint."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with Children(tmp_path / "logs") as children:
        data, asked = str(tmp_path / "server"), KEYS.server_status("s0")
        children.start("server", ["server", "--fleet", "kept", "--listen", endpoint, "--data", data])
        with closing(ZenohBus(BusSettings(mode="client", endpoints=(endpoint,)))) as bus:
            eventually(lambda: any(not reply.error for reply in bus.ask(asked, b"", 1.0)), PATIENCE)
            Body(bus)
            yield children, bus, endpoint


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_agents_that_are_killed_begun_again_and_robbed_of_their_disk_lose_no_map(
    network: tuple[Children, ZenohBus, str], tmp_path
):
    children, bus, endpoint = network
    data = tmp_path / "agents"

    def start(*more: str) -> None:
        children.start(
            "r0",
            ["agent", "r0", "--data", str(data), "--mission", "carried", "--fleet", "kept", "--connect",
             endpoint, *more],
        )  # fmt: skip

    def report() -> AgentStatus | None:
        children.check()
        replies = [r for r in bus.ask(KEYS.agent_status("r0"), b"", 2.0) if not r.error]
        return decode(replies[0].payload, AgentStatus) if replies else None

    def mapped(nodes: int) -> AgentStatus:
        """Wait until a map has so many nodes, all of them on the server's disk."""
        collected: list[AgentStatus] = []

        def done() -> bool:
            now = report()
            if now is not None and now.status.nodes >= nodes and now.unsent == 0:
                collected.append(now)
            return bool(collected)

        eventually(done, PATIENCE)
        return collected[0]

    start()
    first = mapped(2)
    assert first.epoch == 1
    children.kill("r0")
    assert not list(data.glob("*.mapweave")), "it was killed"

    start("--fresh")
    assert mapped(1).epoch == 2
    of_first = HybridMap(read_map_file(data / "r0.1.mapweave", "agent").changes)
    assert len(of_first.nodes) >= first.status.nodes
    children.kill("r0")

    # Idle: one that is to map on would try to localize, without success here, and begin a third map.
    start("--resume", "r0.1", "--mission", "idle")
    eventually(lambda: (now := report()) is not None and now.epoch == 1 and now.status.nodes >= 2, PATIENCE)
    children.end("r0")
    resumed = HybridMap(read_map_file(data / "r0.1.mapweave", "agent").changes)
    assert set(of_first.nodes) <= set(resumed.nodes)

    lost = tmp_path / "lost"
    shutil.move(data, lost)
    start()
    assert mapped(1).epoch == 3, "the server knows that there were two"
    children.end("r0")
    children.end("server")

    for source, maps in ((lost / "r0.sqlite", {1, 2}), (tmp_path / "server" / "s0.sqlite", {1, 2, 3})):
        out = tmp_path / f"out-{source.stem}"
        assert main(["map", "extract", str(source), "-o", str(out)]) == 0
        assert set(epochs_of_files(out, "r0")) == maps
        again = HybridMap(read_map_file(out / "r0.1.mapweave", "agent").changes)
        assert contents(again) == contents(resumed)


def contents(hybrid: HybridMap) -> list[bytes]:
    return sorted(map(encode_body, hybrid.contents()))


def test_a_map_that_is_not_there_cannot_be_resumed(tmp_path, capfd, closed, simulator):
    arguments = "agent", "r0", "--connect", closed, "--data", tmp_path, "--resume"
    assert complaint(capfd, *arguments, "foo", status=USAGE) == (
        "mapweave: 'foo' is no map: write it as r0.1, the robot and the map's number"
    )
    output = complaint(capfd, *arguments, "r0.3", status=NO)
    assert "there is no journal of r0" in output
    assert not list(tmp_path.iterdir()), "nothing is left behind"


def test_a_map_that_the_journal_does_not_have_cannot_be_resumed(tmp_path, capfd, closed, recording):
    driver = tmp_path / "own.py"
    driver.write_text(
        "from pathlib import Path\nfrom mapweave.agent.drivers.replay import Replay\n\nclass Own(Replay):\n"
        f"    def __init__(self, settings):\n        super().__init__(Path({str(recording)!r}))\n"
    )
    robot = ["agent", "r0", "--connect", closed, "--data", str(tmp_path / "data"), "--robot", f"{driver}:Own"]
    assert main([*robot, "--mission", "carried", "--epoch", "3"]) == 0
    assert main([*robot, "--resume", "r0.7"]) == NO
    assert "mapweave: the journal of r0 has no map r0.7; it has r0.3" in capfd.readouterr().err


def test_a_file_of_a_map_of_before_counts_as_a_number_that_is_taken(tmp_path, recording):
    """The journal is lost, the map files are not."""
    data = tmp_path / "data"
    data.mkdir()
    old = data / "walk.3.mapweave"
    write_map_file(old, MapFile("agent", "walk.3", one_node()))
    before = old.read_bytes()
    for expected in (4, 5):
        arguments = ["replay", str(recording), "--offline", "--data", str(data), "--epoch", "1"]
        assert main(arguments) == 0
        assert (data / f"walk.{expected}.mapweave").exists()
    assert old.read_bytes() == before


def test_replays_are_counted_from_one(tmp_path, recording):
    data = tmp_path / "data"
    for _ in range(2):
        assert main(["replay", str(recording), "--offline", "--data", str(data)]) == 0
    assert sorted(epochs_of_files(data, "walk")) == [1, 2]


def test_a_file_is_set_aside_before_a_damaged_journal_writes_over_it(tmp_path, recording):
    data = tmp_path / "data"
    data.mkdir()
    journal = Journal(data / "walk.sqlite", "walk")
    (put,) = one_node()
    nodes = [replace(put, node=replace(put.node, id=NodeId("walk", 1, k))) for k in (1, 2)]
    journal.append(journal.open_map(1), nodes, 0)
    journal.close()
    whole = data / "walk.1.mapweave"
    write_map_file(whole, MapFile("agent", "walk.1", tuple(nodes)))
    before = whole.read_bytes()
    with sqlite3.connect(data / "walk.sqlite") as rows:
        rows.execute("UPDATE change SET crc = crc + 1 WHERE sequence = 2")
    rows.close()
    assert main(["replay", str(recording), "--offline", "--data", str(data)]) == 0
    assert (data / "walk.1.before-damage.mapweave").read_bytes() == before
    assert len(HybridMap(read_map_file(whole).changes).nodes) == 1
    assert (data / "walk.2.mapweave").exists()


def test_a_robot_that_is_lifted_begins_a_new_map_and_keeps_the_old_one(tmp_path):
    said: list[str] = []
    walls, bus = PhotoWalls(), MemoryBus(MemoryHub())
    options = AgentOptions("r0", tmp_path, epoch=1, mission=MissionKind.CARRIED, patience=0.0)
    agent = Agent(lambda: DESCRIPTION, bus, KEYS, AgentSettings(), options, print_line=said.append)
    before = Pose2(-1.0)
    for tick, x in enumerate(np.arange(-1.0, -0.3, 0.025)):
        agent.tick(walls.observe(before, before := Pose2(float(x)), tick))
    mapped = len(agent.pipeline.map.nodes)
    assert mapped
    away = walls.observe(Pose2(2.0), Pose2(2.0), 100)
    agent.tick(replace(away, kidnapped=True))
    assert str(agent.map_id) == "r0.1"
    agent.tick(replace(away, stamp_ns=away.stamp_ns + 10**8))
    agent.close()
    bus.close()
    assert "r0: was lifted; it begins map r0.2, and the old one stays" in said
    assert len(HybridMap(read_map_file(tmp_path / "r0.1.mapweave").changes).nodes) == mapped


class Carried:
    """A robot that is carried past two photographs; it ends in the tick in which a third node was made."""

    def __init__(self, last: int = len(WAY) - 1) -> None:
        self.tick = 0
        self._walls, self._last, self._nodes = PhotoWalls(), last, 0

    def describe(self) -> RobotDescription:
        return DESCRIPTION

    def sense(self) -> Observation | None:
        if self._nodes >= 3 or self.tick >= self._last:
            return None
        self.tick += 1
        before, now = (Pose2(float(x)) for x in WAY[self.tick - 1 : self.tick + 1])
        return self._walls.observe(before, now, self.tick)

    def act(self, command: Command) -> Command:
        return command

    def close(self) -> None:
        pass

    def stepped(self, observation: Observation, step: TickResult) -> None:
        self._nodes += sum(isinstance(change, NodePut) for change in step.changes)


def loops(hybrid_map: HybridMap) -> int:
    return sum(edge.kind is EdgeKind.LOOP for edge in hybrid_map.edges.values())


@pytest.mark.slow
def test_a_process_that_ends_after_an_episode_keeps_what_follows_from_it(tmp_path):
    """Loop closures are made in the ticks after a node. Before, there was none, and they were lost."""
    robot, bus = Carried(), MemoryBus(MemoryHub())
    options = AgentOptions("r0", tmp_path, epoch=1, mission=MissionKind.CARRIED, patience=0.0)
    agent = Agent(robot.describe, bus, KEYS, AgentSettings(), options, robot.stepped)
    agent.run(robot, threading.Event())
    before = loops(agent.pipeline.map)
    agent.finish()
    agent.finish()
    after = HybridMap(agent.pipeline.map.contents())
    agent.close()
    edges = after.edges.keys()
    assert len(after.nodes) == 4, "the last one is where the drive by hand ended"
    assert loops(after) > before
    journal = Journal(tmp_path / "r0.sqlite", "r0")
    assert HybridMap(journal.replay(MapId("r0", 1))).edges.keys() == edges
    journal.close()
    options = replace(options, data=tmp_path / "process")
    run_agent(Carried(robot.tick), bus, KEYS, AgentSettings(), options, threading.Event())
    bus.close()
    file = read_map_file(tmp_path / "process" / "r0.1.mapweave")
    assert HybridMap(file.changes).edges.keys() == edges


@pytest.mark.parametrize("recorded", [False, True])
def test_changes_that_no_disk_took_are_no_success(tmp_path, monkeypatch, recorded: bool, opened):
    """Nor does who has ended say that they are written once there is room."""

    def full(*_: object) -> int:
        raise InvalidFile(f"r0.sqlite: {DISK_FULL}")

    monkeypatch.setattr(Journal, "write", full)
    monkeypatch.setattr(Replicator, "flush", lambda *_: False)
    bus = opened(MemoryBus(MemoryHub()))
    options = AgentOptions(
        "r0", tmp_path, epoch=1, mission=MissionKind.CARRIED, patience=0.0, recorded=recorded
    )
    # Until a first node.
    robot = Carried(60)
    again = ", and replay the recording again" if recorded else ""
    with pytest.raises(InvalidFile, match=rf"^r0: \d+ changes are lost: r0\.sqlite: {NO_ROOM}{again}$"):
        run_agent(robot, bus, KEYS, AgentSettings(), options, threading.Event())


class Ended:
    """A robot that has nothing more to say; meanwhile its map's file can no longer be written."""

    def __init__(self, file: Path) -> None:
        self._file = file

    def describe(self) -> RobotDescription:
        return DESCRIPTION

    def sense(self) -> Observation | None:
        self._file.mkdir()
        return None

    def act(self, command: Command) -> Command:
        return command

    def close(self) -> None:
        pass


def test_a_map_file_that_does_not_fit_on_the_disk_leaves_a_whole_journal(tmp_path, opened):
    """The journal was never closed: what waited for the disk was lost without a word."""
    bus = ZenohBus(BusSettings(endpoints=(f"tcp/127.0.0.1:{free_port()}",)))
    options = AgentOptions("r0", tmp_path, epoch=1, patience=0.0)
    with pytest.raises(InvalidFile, match=r"r0\.1\.mapweave"):
        run_agent(Ended(tmp_path / "r0.1.mapweave"), bus, KEYS, AgentSettings(), options, threading.Event())
    bus.close()
    journal = opened(Journal(tmp_path / "r0.sqlite", "r0"))  # in use, as long as the agent has not closed it
    assert journal.maps() == [MapId("r0", 1)]


@pytest.mark.parametrize(
    ("router", "words"), [(True, "no map server s0 in reach"), (False, "no server in reach")]
)
def test_an_agent_that_ends_without_a_map_server_says_so_and_does_not_wait_for_it(
    router: bool, words: str, tmp_path, capfd, monkeypatch
):
    """It said that the server has not acknowledged everything, and ended only after all its patience."""
    monkeypatch.setattr(agent_process, "ARRIVAL", 0.3)
    at = (f"tcp/127.0.0.1:{free_port()}",)
    bus = ZenohBus(BusSettings(mode="router", listen=at) if router else BusSettings(endpoints=at))
    options = AgentOptions("r0", tmp_path, epoch=1, mission=MissionKind.CARRIED, patience=20.0)
    began = time.monotonic()
    run_agent(Carried(60), bus, KEYS, AgentSettings(), options, threading.Event())
    assert time.monotonic() - began < options.patience
    bus.close()
    output = capfd.readouterr()
    assert f"r0: {words}: the map stays in the journal" in output.out + output.err


class Faster(Carried):
    """A recording of two minutes that is replayed within a second."""

    def sense(self) -> Observation | None:
        observation = super().sense()
        return observation and replace(observation, stamp_ns=observation.stamp_ns + self.tick * 10**10)


def test_seconds_without_a_server_are_those_of_who_waits(tmp_path, capfd, monkeypatch):
    """A fast replay said after a second that for 20 s no map server is in reach."""
    monkeypatch.setattr(agent_process, "ARRIVAL", 0.0)
    bus = ZenohBus(BusSettings(endpoints=(f"tcp/127.0.0.1:{free_port()}",)))
    options = AgentOptions("r0", tmp_path, epoch=1, mission=MissionKind.CARRIED, patience=0.1)
    run_agent(Faster(12), bus, KEYS, AgentSettings(), options, threading.Event())
    bus.close()
    output = capfd.readouterr()
    assert "r0: no server in reach" in (said := output.out + output.err) and "in reach for" not in said


def test_an_agent_that_has_handed_over_everything_ends_at_once_without_its_server(
    tmp_path, capfd, monkeypatch
):
    """It looked for the server again, and said that the map will be sent."""
    journal = Journal(tmp_path / "r0.sqlite", "r0")
    journal.append(map_id := journal.open_map(1), one_node(), 0)
    journal.acknowledge("s0", map_id, 1)
    journal.close()
    bus = ZenohBus(BusSettings(endpoints=(f"tcp/127.0.0.1:{free_port()}",)))
    monkeypatch.setattr(agent_process, "ARRIVAL", 60.0)
    options, began = AgentOptions("r0", tmp_path, patience=60.0), time.monotonic()
    run_agent(Ended(tmp_path / "none"), bus, KEYS, AgentSettings(), options, threading.Event())
    assert time.monotonic() - began < options.patience
    bus.close()
    output = capfd.readouterr()
    assert "r0: server s0 has it all" in output.out + output.err


def test_an_agent_that_has_mapped_nothing_says_of_no_server_that_it_has_it_all(tmp_path, capfd):
    """There is a router, and no map server."""
    bus = ZenohBus(BusSettings(mode="router", listen=(f"tcp/127.0.0.1:{free_port()}",)))
    robot = Ended(tmp_path / "folder")
    run_agent(robot, bus, KEYS, AgentSettings(), AgentOptions("r0", tmp_path, epoch=1), threading.Event())
    bus.close()
    output = capfd.readouterr()
    assert "r0: 0 nodes and 0 edges in" in output.out + output.err
    assert "s0 has" not in output.out + output.err
