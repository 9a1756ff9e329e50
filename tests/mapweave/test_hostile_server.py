"""A real agent process whose map server is hostile: over TLS with keys, and without keys."""

import re
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapweave import AgentStatus, NodeId, Pose2
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder, MissionState
from mapweave.identities.key_folder import KeyFolder, Profile
from mapweave.scenarios.children import Children, free_port
from mapweave.wire.bus import Request
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.credentials import Role
from mapweave.wire.keys import Keys
from mapweave.wire.messages import decode, encode
from mapweave.wire.refusal import encode_refusal
from mapweave.wire.senders import sent_by_any
from mapweave.wire.zenoh_bus import ZenohBus
from tests.agent.scripted_fleet import A, B, a_way, at, here
from tests.waiting import eventually

KEYS = Keys("demo")
DRIVER = Path(__file__).parent / "wall_robot.py"
FLOOD = 3.0
"""s of each flood."""
GROWS, WARNS = 150.0, 40
"""MB and lines in the log at most that all floods together cost. Before, replies filled 1070 MB, and each
message that cannot be read was a line, 10 000 a second."""
FARTHEST = 25.0
"""m: six answers are tried, for 2 m each at most, and the robot looks for itself in between."""


class Hostile:
    """A router that is the map server, and the agent of r0."""

    def __init__(self, folder: Path, children: Children, profile: Profile | None) -> None:
        self.folder, self.children, port = folder, children, free_port()
        if profile is None:
            endpoint, more = f"tcp/127.0.0.1:{port}", []
            settings = BusSettings(mode="router", listen=(endpoint,))
        else:
            keys = KeyFolder.create(folder / "keys", "demo", profile, [], "s0", port)
            more = ["--keys", str(keys.add("r0", Role.ROBOT))]
            endpoint = keys.catalogue.endpoints[0]
            settings = keys.router("s0", [endpoint])
        self.bus = ZenohBus(settings)
        self.bus.announce(KEYS.server_alive("s0"))
        self.answer: Callable[[Request], None] = lambda request: request.refuse("nothing is known")
        self.bus.serve(sent_by_any(KEYS.relocalize("s0")), lambda request: self.answer(request))
        arguments = [
            "--robot", f"{DRIVER}:WallRobot", "--data", str(folder / "agents"), "--mission", "explore",
        ]  # fmt: skip
        children.start("r0", ["agent", "r0", *arguments, "--connect", endpoint, *more])
        eventually(lambda: self.status() and (folder / "way").exists(), 120.0)

    def status(self) -> AgentStatus | None:
        self.children.check()
        replies = [one for one in self.bus.ask(KEYS.agent_status("r0"), b"", 2.0) if not one.error]
        return decode(replies[0].payload, AgentStatus) if replies else None

    def way(self) -> float:
        return float((self.folder / "way").read_text())

    def peak_mb(self) -> float:
        status = Path(f"/proc/{self.children.pid('r0')}/status").read_text()
        return int(re.findall(r"VmHWM:\s+(\d+)", status)[0]) / 1024

    def log(self) -> str:
        return (self.folder / "logs" / "r0.log").read_text(errors="replace")

    def lines(self) -> int:
        return len(self.log().splitlines())

    def order(self, kind: MissionKind, node: NodeId | None = None) -> None:
        order = MissionOrder.new("r0", kind, "s0", node)
        (reply,) = self.bus.ask(KEYS.mission("r0"), encode(order), 20.0)
        assert not reply.error

    def flood(self, send: Callable[[], object]) -> None:
        end = time.monotonic() + FLOOD
        while time.monotonic() < end:
            send()


@pytest.fixture(params=[Profile.PRODUCTION, None], ids=["tls", "local"])
def hostile(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Hostile]:
    monkeypatch.setenv("WALL_ROBOT", str(tmp_path / "way"))
    monkeypatch.setenv("WALL_ROBOT_CLOCK", str(tmp_path / "clock"))
    with Children(tmp_path / "logs") as children:
        hostile = Hostile(tmp_path, children, request.param)
        yield hostile
        children.end("r0")
        hostile.bus.close()


@pytest.mark.slow
@pytest.mark.waits
@pytest.mark.timeout(600)
def test_a_hostile_server_neither_fills_nor_stops_a_robot_nor_leads_it_astray(hostile: Hostile):
    rng, bus = np.random.default_rng(0), hostile.bus
    peak, lines = hostile.peak_mb(), hostile.lines()
    hostile.answer = replies_without_end
    held: list[Request] = []
    bus.serve(sent_by_any(KEYS.known("s0")), lambda request: always_busy(request, held))
    # It is lost, and asks.
    hostile.order(MissionKind.GO, NodeId("r9", 1, 1))
    time.sleep(FLOOD)
    hostile.order(MissionKind.EXPLORE)
    for size in (50, 10_000_000):
        hostile.flood(lambda size=size: bus.publish(KEYS.ack("s0", "r0"), rng.bytes(size)))  # type: ignore[misc]
    hostile.flood(lambda: bus.publish(KEYS.poses("s0", "r0"), rng.bytes(100_000)))
    hostile.flood(lambda: bus.ask(KEYS.drive("r0"), rng.bytes(500_000), 1.0))
    for request in held:
        request.refuse("over")
    assert hostile.peak_mb() - peak < GROWS and hostile.lines() - lines < WARNS
    # It has gone on, and obeys.
    eventually(lambda: (status := hostile.status()) and status.status.nodes, 120.0)
    hostile.order(MissionKind.STOP)
    eventually(lambda: (status := hostile.status()) and status.status.doing == "idle", 20.0)
    is_led_astray_by_no_lie(hostile)
    stands_while_its_clock_jumps(hostile)


def is_led_astray_by_no_lie(hostile: Hostile) -> None:
    """It is said to be at a node, and that its goal is 9 m ahead of that."""
    hostile.answer = lambda request: request.reply(encode(at(here(A, Pose2()))))
    hostile.bus.serve(
        sent_by_any(KEYS.route("s0")), lambda request: request.reply(encode(a_way(A, B, step=9.0)))
    )
    before = hostile.way()
    hostile.order(MissionKind.GO, B)

    def ended() -> str:
        status = hostile.status()
        report = None if status is None else status.mission
        return report.reason if report is not None and report.state is MissionState.FAILED else ""

    eventually(ended, 240.0)
    assert "6 answers in a row were wrong" in ended()
    assert 2.0 < hostile.way() - before < FARTHEST


def stands_while_its_clock_jumps(hostile: Hostile) -> None:
    """As that of a robot whose machine is set by a time server that lies."""
    hostile.order(MissionKind.EXPLORE)
    for seconds in (1e9, -1e9):
        before = hostile.log()
        (hostile.folder / "clock").write_text(f"{seconds}")
        eventually(lambda before=before: "believes its clock again" in hostile.log()[len(before) :], 60.0)  # type: ignore[misc]
        said = hostile.log()[len(before) :]
        assert f"clock of the observations has jumped {'ahead' if seconds > 0 else 'back'} by" in said
        assert "no new node for" not in said


def replies_without_end(request: Any) -> None:
    """Thousand of them, of 1 MB each."""

    def reply() -> None:
        for _ in range(1000):
            request._question.query.reply(request.key, bytes(1_000_000))
        request.abandon()

    threading.Thread(target=reply, daemon=True).start()


def always_busy(request: Any, held: list[Request]) -> None:
    """For a millisecond, it says, and keeps the question open."""
    held.append(request)
    request._question.query.reply_err(encode_refusal("busy", 1e-3))
