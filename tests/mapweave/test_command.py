"""Robots are commanded from the shell: real processes, of which some are killed."""

import io
import json
import os
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from mapweave import Fleet, NodeId, NotConnected, Pose2, read_map_file
from mapweave.cli import main
from mapweave.commands import status as status_command
from mapweave.commands.status import COLUMNS, SPARE, cells, table
from mapweave.exit_status import FAILED, INTERRUPTED, NO, USAGE
from mapweave.hybridmap.agent_status import AgentStatus, FleetStatus, RobotEntry, Status
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder, MissionReport, MissionState
from mapweave.scenarios.children import Children, free_port
from mapweave.wire.bus import Request
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import decode, encode
from mapweave.wire.senders import serve_senders
from mapweave.wire.zenoh_bus import ZenohBus
from tests.core_time import CoreTime
from tests.mapweave.command_line import complaint, parsers
from tests.mapweave.test_kept_maps import PATIENCE, Body
from tests.waiting import eventually

FLEET = "kept"


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_robot_is_commanded_from_the_shell_and_keeps_its_goal_when_it_is_killed(tmp_path, capfd, opened):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    network = ["--fleet", FLEET, "--connect", endpoint]
    bus = opened(ZenohBus(BusSettings(mode="client", endpoints=(endpoint,))))

    def shell(*words: str) -> tuple[int, str]:
        """Exit status and output. A busy machine may take longer than a person would wait: asked again."""
        done: list[tuple[int, str]] = []

        def run() -> bool:
            done[:] = [(main([*words, *network]), capfd.readouterr().out)]
            return done[0][0] != 1

        eventually(run, PATIENCE)
        return done[0]

    with Children(tmp_path / "logs") as children:

        def start_server() -> None:
            data = str(tmp_path / "server")
            children.start("server", ["server", "--fleet", FLEET, "--listen", endpoint, "--data", data])
            eventually(lambda: bus.ask(Keys(FLEET).any_robots(), b"", 1.0), PATIENCE)

        def start_robot(*more: str) -> None:
            data = str(tmp_path / "agents")
            children.start("r0", ["agent", "r0", "--data", data, *network, *more])

        def robot(alive: bool = True) -> dict:
            """The robot's line; waits until it is there, or gone."""
            found: list[dict] = []

            def look() -> bool:
                children.check()
                robots = json.loads(shell("status", "--json")[1])["robots"]
                found[:] = [one for one in robots if one["alive"] is alive and one["status"]]
                return bool(found)

            eventually(look, PATIENCE)
            return found[0]

        start_server()
        Body(bus)
        start_robot("--mission", "carried")
        eventually(lambda: robot()["status"]["status"]["nodes"] >= 2, PATIENCE)
        eventually(lambda: robot()["merged_from_robot"] is not None, PATIENCE)
        assert robot()["status"]["mission"]["order"]["kind"] == "carried"

        assert shell("stop", "r0")[0] == 0
        eventually(lambda: robot()["status"]["mission"]["state"] == "done", PATIENCE)
        code, printed = shell("go", "r0", "home", "--json")
        (mission,) = json.loads(printed)["missions"]
        assert (code, mission["state"], mission["order"]["node"]) == (0, "running", "r0.1.1")
        children.kill("r0")
        robot(alive=False)
        listed = shell("missions", "r0")[1].splitlines()
        assert "running" in listed[-1] and listed[-1].endswith("; the robot is gone, see `mapweave status`")
        assert not any("gone" in line for line in listed[:-1])
        start_robot()
        # The server shows the last status before the kill until the next one comes.
        eventually(lambda: robot()["status"]["mission"]["order"] == mission["order"], PATIENCE)
        assert robot()["status"]["mission"]["state"] == "running", "killed, and it goes on"

        children.kill("server")
        start_server()
        assert robot()["status"]["mission"]["order"] == mission["order"]
        with Fleet(endpoint, FLEET) as fleet:
            kinds = [report.order.kind for report in fleet.missions("r0")]
            assert kinds == ["carried", "stop", "go"], "the record outlasts the server"

        assert shell("map", "fetch", str(tmp_path / "m.mapweave"))[0] == 0
        assert len(read_map_file(tmp_path / "m.mapweave", "merged").poses) >= 2
        refused = complaint(capfd, "missions", "r9", *network, status=NO)
        assert "there is no robot r9; there are: r0" in refused
        refused = complaint(capfd, "go", "r0", "r0.7.1", *network, status=NO)
        assert "r0.7.1 is not in the merged map" in refused
        complaint(capfd, "go", "r.0", "r0.7.1", *network, status=USAGE)
        code, printed = shell("go", "r0", "r0.1.999")
        assert code == NO and "refused: there is no node r0.1.999; the nearest is r0.1." in printed
        code, printed = shell("status")
        assert code == 0 and "r0" in printed and "go to r0.1.1" in printed
        code, printed = shell("stop", "--all")
        assert code == 0 and "r0: stop" in printed
        for name in ("r0", "server"):
            children.end(name)


def test_a_stop_that_has_not_reached_its_robot_is_no_success(capsys, monkeypatch):
    order = MissionOrder.new("r0", MissionKind.STOP, "anna")
    states = iter((MissionState.SENT, MissionState.DONE))
    person = SimpleNamespace(stop=lambda robot, because: (MissionReport(order, next(states)),))
    monkeypatch.setattr("mapweave.commands.missions.fleet_of", lambda arguments: nullcontext(person))
    assert [main(["stop", "r0"]), main(["stop", "--all"])] == [NO, 0]
    assert f"r0: stop, mission {order.id}, sent" in capsys.readouterr().out


ASKING = {
    "status": [], "go": ["r0", "home"], "explore": ["r0"], "stop": ["r0"], "map fetch": ["out.mapweave"],
    "map explain": ["r0.1", "r1.1"], "map route": ["r0.1.1", "r0.1.2"], "map history": [],
    "missions": [], "map link": ["r0.1.1", "r1.1.2"], "map undo": [],
    "plan add": ["walk/images/0.png", *(f"--pair=r0.1.{k}={k},{k * k}" for k in (1, 2, 3))],
    "plan show": [], "plan export": ["office", "--format", "rmf"], "plan remove": ["office"],
    "map pin": ["r0.1.17"], "place add": ["kitchen", "r0.1.17"], "place list": [],
    "place remove": ["kitchen"], "close": ["r0.1.1"], "floor": ["first", "r0.1.17"],
    "reopen": ["kitchen"], "prefer": ["r0.1.1", "r0.1.2"], "avoid": ["r0.1.1", "r0.1.2"], "closures": [],
    "map portal add": ["lift", "r0.1.1", "r1.1.2", "--kind", "lift"], "map portal list": [],
    "map portal remove": ["lift"], "portal done": ["r0"],
    "map unmerge": ["r0.1.1", "r1.1.2"], "map retire": ["r0.1"],
    "relocalize": ["walk/images/0.png"],
    "record": ["r0", "--out", "drive"], "drive": ["r0", "--gamepad", "pad"],
    "calibrate drive": ["--robot", "remote", "--name", "r0"],
    "map from-photos": ["walk/images", "--camera", "walk/camera.toml", "--spacing", "0.5", "--out",
                        "out.mapweave", "--send"],
}  # fmt: skip
"""Commands that need a server, or a robot behind a router."""
GO_ON = ["agent", "replay", "doctor", "sim serve"]
"""Those that also look for one, and do without it."""


@pytest.fixture
def asked_in(recording: Path) -> Path:
    """The folder of what they are given: a recording, and a gamepad whose stick rests."""
    os.mkfifo(recording.parent / "pad")
    return recording.parent


def test_the_commands_that_look_for_a_server_are_known():
    found = [words for words, parser in parsers().items() if "--connect ENDPOINT" in parser.format_help()]
    assert sorted(found) == sorted([*ASKING, *GO_ON])


@pytest.mark.usefixtures("signals")
@pytest.mark.parametrize("words", ASKING)
def test_without_a_router_one_line_says_so_and_what_to_do(words: str, asked_in: Path, capfd, monkeypatch):
    """Within the time for that, and no other: whatever listens there accepts, and says nothing."""
    monkeypatch.chdir(asked_in)
    monkeypatch.setattr("mapweave.connection.SOON", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        where = f"tcp/127.0.0.1:{deaf.getsockname()[1]}"
        began = time.monotonic()
        output = complaint(capfd, *words.split(), *ASKING[words], "--connect", where)
        assert (
            f"no router at {where}: what listens there does not let this in; if the fleet has keys" in output
        )
        assert time.monotonic() - began < 5.0, "Zenoh's own patience is 10 s, that for an answer 20 s"


def timed(words: str, *arguments: str, folder: Path) -> tuple[float, int, str]:
    """How long a command of its own process takes, s, its exit status and what it says on stderr."""
    command = [sys.executable, "-m", "mapweave", *words.split(), *ASKING[words], *arguments]
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        clock = CoreTime(process)
        while process.poll() is None:
            took = clock.look()
            time.sleep(0.01)
    finally:
        process.kill()
        _, err = process.communicate()
    return took, process.returncode, err.decode()


@pytest.mark.slow
@pytest.mark.parametrize("words", ASKING)
def test_every_command_says_within_2_s_that_there_is_no_router(words: str, asked_in: Path, closed: str):
    took, status, err = timed(words, "--connect", closed, folder=asked_in)
    assert status == FAILED and "no router at" in err, err
    assert took <= 2.0


@pytest.mark.slow
def test_a_command_says_within_2_s_that_there_is_no_server(asked_in: Path):
    """A router is up."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with closing(ZenohBus(BusSettings(mode="router", listen=(endpoint,)))):
        for words in ("status", "map fetch", "map explain", "place list", "missions", "relocalize"):
            took, status, err = timed(words, "--connect", endpoint, folder=asked_in)
            assert status == FAILED and "no map server of fleet demo answers" in err, (words, err)
            assert took <= 2.0, words


@pytest.mark.slow
@pytest.mark.usefixtures("signals")
def test_a_robot_that_falls_silent_is_named_to_who_waits_for_it(capfd, monkeypatch):
    """A robot takes its mission, reports, and is gone. Before, nothing was said until the time was over."""
    monkeypatch.setattr("mapweave.fleet.SILENT", 0.3)
    endpoint, keys = f"tcp/127.0.0.1:{free_port()}", Keys(FLEET)
    taken: list[MissionReport] = []

    def take(request: Request) -> None:
        taken.append(MissionReport(decode(request.payload, MissionOrder), MissionState.RUNNING))
        request.reply(encode(taken[0]))

    with closing(ZenohBus(BusSettings(mode="router", listen=(endpoint,)))) as bus:
        serving = serve_senders(bus, keys.mission("r0"), lambda request, who: take(request))
        words = ["explore", "r0", "--wait", "--timeout", "3", "--fleet", FLEET, "--connect", endpoint]
        doing = Status("exploring", "", 1, 0, Pose2(), False)

        def report() -> None:
            eventually(lambda: taken, PATIENCE)
            for _ in range(5):
                bus.publish(keys.agent_status("r0"), encode(AgentStatus(doing, 1, "r0", mission=taken[0])))
                time.sleep(0.1)

        with ThreadPoolExecutor() as robot:
            reporting = robot.submit(report)
            assert main(words) == NO
            reporting.result()
        for one in serving:
            one.close()
    said = capfd.readouterr().err.splitlines()
    assert "r0: exploring (0%)" in said
    assert said[-1].startswith("r0: not over after 3 s (--timeout); the mission goes on")
    silent = [line for line in said if line.startswith("r0: nothing heard for ")]
    assert 1 <= len(silent) <= 9 and silent[0].endswith("is its agent running, and its network up?")
    assert said.index("r0: exploring (0%)") < said.index(silent[0])


def test_a_line_of_the_table_has_what_an_operator_asks_for():
    order = MissionOrder("a1", "r0", MissionKind.GO, 1, "anna", NodeId("r1", 1, 5), "kitchen")
    doing = Status("driving along the route", "0.4 m to node r1.1.5", 12, 40, Pose2(), False)
    status = AgentStatus(
        doing, 1, "r0", 1, 3, mission=MissionReport(order, MissionState.RUNNING, 0.25), battery=0.5,
        last_error="no map server answered", error_age=61.2,
    )  # fmt: skip
    entry = RobotEntry("r0", True, 7.04, status, Pose2(1.234, -5.0, 3.14159265), 2)
    assert cells(entry) == (
        "r0", "go to r1.1.5 (kitchen) running 25%", "driving along the route: 0.4 m to node r1.1.5",
        "1.23,-5.00 180° in part 2", "", "", "12", "50%", "3", "", "7.0 s silent",
        "no map server answered (for 61 s)",
    )  # fmt: skip
    assert cells(replace(entry, alive=False))[-1] == "", "what a robot said before it went need not hold"
    for age, words in ((7.04, "gone 7 s"), (119.0, "gone 119 s"), (180.0, "gone 3 min"), (9e4, "gone 25 h")):
        assert cells(replace(entry, alive=False, age=age))[-2] == words
    lies = RobotEntry("r1", False, accusation="map r1.1 is implausible: its clock utc runs backwards")
    assert cells(lies)[-1] == lies.accusation
    assert cells(RobotEntry("r1", False))[0] == "r1" and "gone" in cells(RobotEntry("r1", False))
    for width in (150, 240):
        lines = Console(width=width, file=(printed := io.StringIO()))
        lines.print(table(FleetStatus((entry,)), width))
        _, line = printed.getvalue().splitlines()
        assert len(line) <= width and "go to r1.1.5 (kitchen) running 25%" in line and "7.0 s silent" in line
        assert ("0.4 m to node r1.1.5" in line) is (width == 240)


def test_a_trouble_that_a_narrow_terminal_cuts_is_below_the_table_as_a_whole():
    doing = AgentStatus(
        Status("driving along the route", "0.4 m to r1.1.5", 12, 40, Pose2(), False), 1, "r0", 1
    )
    over = "over its quota: 10792 beacons"
    status = FleetStatus((RobotEntry("r0", True, 0.1, doing), RobotEntry("r1", True, 0.1, over_quota=over)))
    # The robots have neither a battery nor nodes on the server: such columns cannot be left out once more.
    assert [table(status, width).row_count for width in (80, 50, 30, 10)] == [2] * 4
    assert status_command.troubles(status, 160) == []
    assert status_command.troubles(status, 80) == [f"r1: {over}"]
    many = FleetStatus(tuple(RobotEntry(f"r{k}", True, 0.1, doing, over_quota=over) for k in range(14)))
    (*lines, more) = status_command.troubles(many, 80)
    assert lines == [f"r{k}: {over}" for k in range(10)] and more == "and 4 more with a trouble"


def test_robots_are_listed_by_their_numbers():
    names = ("anna", "r1", "r10", "r11", "r2", "r2b", "zed")
    status = FleetStatus(tuple(RobotEntry(name, True, apart="it is alone") for name in names))
    lines = Console(width=100, file=(printed := io.StringIO()))
    lines.print(table(status, 100))
    order = ["anna", "r1", "r2", "r2b", "r10", "r11", "zed"]
    assert [line.split()[0] for line in printed.getvalue().splitlines()[1:]] == order
    assert [line.split()[0] for line in status_command.apart(status)] == order


def answer_with(monkeypatch: pytest.MonkeyPatch, found: list[FleetStatus | NotConnected]) -> None:
    """Let `mapweave status` see one after the other, and then be interrupted."""

    def answer() -> FleetStatus:
        if not found:
            raise KeyboardInterrupt
        if isinstance(one := found.pop(0), NotConnected):
            raise one
        return one

    fleet = SimpleNamespace(status=answer, servers=list)
    monkeypatch.setattr(status_command, "fleet_of", lambda arguments: nullcontext(fleet))


@pytest.mark.parametrize("terminal", [True, False])
def test_watching_is_live_on_a_terminal_and_tables_elsewhere(terminal: bool, monkeypatch, capsys):
    """Into a file it wrote nothing until it was interrupted."""
    apart = "3 links were found and all refused: [they contradict each other]"
    entry = RobotEntry(
        "r0", True, 0.2, None, missing=4, lag=2.5, newest=NodeId("r0", 1, 7), links=0, apart=apart
    )
    found: list[FleetStatus | NotConnected] = [
        FleetStatus(), NotConnected("no map server"), FleetStatus((entry,)),
    ]  # fmt: skip
    waited: list[float] = []

    answer_with(monkeypatch, found)
    monkeypatch.setattr(time, "sleep", waited.append)
    console = Console(width=100, force_terminal=terminal)
    monkeypatch.setattr("mapweave.terminal.plain_or_terminal", lambda **_: console)
    assert main(["status", "--watch"]) == INTERRUPTED
    printed = capsys.readouterr().out
    assert waited == [status_command.EVERY if terminal else status_command.TABLE_EVERY] * 3
    for words in ("no robot is there", "no map server", "r0.1.7", "2.5 s", f"r0 is not merged: {apart}"):
        assert words in printed
    assert ("\x1b[" in printed) is terminal


def test_watching_for_a_script_goes_on_while_no_server_answers(monkeypatch, capsys):
    """With `--json` it ended when the server was started again; the table went on."""
    gone = NotConnected("no map server")
    found: list[FleetStatus | NotConnected] = [FleetStatus(), gone, gone, FleetStatus(), gone]

    answer_with(monkeypatch, found)
    monkeypatch.setattr(time, "sleep", lambda seconds: None)
    assert main(["status", "--watch", "--json"]) == INTERRUPTED
    out, err = capsys.readouterr()
    assert [json.loads(line) for line in out.splitlines()] == [{"robots": []}] * 2
    assert err.splitlines() == ["mapweave: no map server"] * 2 + ["mapweave: interrupted"]


def test_a_router_that_is_gone_is_not_said_to_be_up():
    hub = MemoryHub()
    with closing(MemoryBus(hub)) as bus, Fleet(bus=bus) as fleet:
        for ask in (fleet.status, fleet.missions, fleet.annotations):
            with pytest.raises(NotConnected, match="a router is up, but no map server of fleet demo answers"):
                ask()
        hub.cut(bus)
        for ask in (fleet.status, fleet.missions, fleet.annotations):
            with pytest.raises(NotConnected, match="the router is gone: start `mapweave server` there again"):
                ask()


def test_a_terminal_of_80_columns_shows_every_column():
    """Each was cut to three characters there: `ro… mission doing at no… batt… un… age last tro…`."""
    robots = []
    for name, trouble in (("r0", ""), ("r1", "no map server answered")):
        order = MissionOrder("a1", name, MissionKind.GO, 1, "anna", NodeId("r1", 1, 5), "kitchen")
        doing = Status("driving along the route", "0.4 m to node r1.1.5", 128, 40, Pose2(), False)
        mission = MissionReport(order, MissionState.RUNNING, 0.25)
        status = AgentStatus(
            doing, 1, name, 1, 1234, mission=mission, battery=0.5 if trouble else None, last_error=trouble
        )
        robots.append(
            RobotEntry(
                name, True, 7.04, status, Pose2(-12.345, -5.0, 3.0), 2, missing=3 * bool(trouble), lag=12.345,
                newest=NodeId(name, 1, 128), links=4,
            )
        )  # fmt: skip
    for shown in (robots[:1], robots):
        lines = Console(width=80, file=(printed := io.StringIO()))
        lines.print(table(FleetStatus(tuple(shown)), 80))
        head, *rows = printed.getvalue().splitlines()
        lacking = {"battery", "lag", "trouble"} if shown == robots[:1] else {*SPARE}
        assert [name for name in COLUMNS if name in head] == [c for c in COLUMNS if c not in lacking], head
        assert ("12.3 s" in rows[-1]) is (shown == robots)
        assert all("128" in row and "1234" in row and "7.0 s silent" in row for row in rows), rows
