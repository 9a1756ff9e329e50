"""A real server over Zenoh: places and closures from the shell, and what robots get to know of them."""

import json
import re
import time
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from mapweave.agent.fleet_client import FleetClient
from mapweave.agent.mission_control import MissionControl
from mapweave.cli import main
from mapweave.exit_status import NO, USAGE
from mapweave.fleet import Fleet
from mapweave.hybridmap.agent_status import Status
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.mission_order import MissionState
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import ReserveAnswer, ReserveRequest, RouteAnswer, RouteRequest
from mapweave.mapserver.server import MapServer
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.messages import decode, encode
from mapweave.wire.zenoh_bus import ZenohBus
from tests.mapserver.house import ROBOT, MappedRoom
from tests.waiting import eventually, free_port

KEYS = Keys("demo")


def test_what_is_closed_from_the_shell_holds_for_all(
    mapped_room: Callable[[], MappedRoom], capsys, monkeypatch
):
    endpoint, mapped = f"tcp/127.0.0.1:{free_port()}", mapped_room()
    first, second, last = sorted(mapped.truth)[0], sorted(mapped.truth)[1], sorted(mapped.truth)[-1]
    router = ZenohBus(BusSettings("router", listen=(endpoint,)))
    robot = ZenohBus(BusSettings(endpoints=(endpoint,)))

    def shell(*words: str) -> tuple[int, str, str]:
        status = main([*words, "--connect", endpoint])
        return status, *capsys.readouterr()

    try:
        with MapServer(router, KEYS, mapped.path, "s0") as server, Fleet(endpoint, by="anna") as fleet:
            eventually(lambda: server.status()["nodes"] == 7)
            # Until all is merged, the map lacks the edge that the closure shall close.
            assert server.settle(60.0)
            control = MissionControl("r0")
            link = FleetClient(robot, KEYS, ROBOT, control)
            standing = Status("standing", "", 7, 0, Pose2(), False, "explore", located=True)
            eventually(lambda: link.report(standing, 1) or fleet.status().robots)
            assert shell("place", "add", "kitchen", str(last), "--by", "anna")[0] == 0
            assert shell("place", "add", "door", str(second), "--by", "anna")[0] == 0
            status, out, _ = shell("map", "route", str(first), "kitchen", "--json")
            assert status == 0 and json.loads(out)["goal"] == str(last)
            sent = fleet.go("r0", "kitchen", via=["door"])
            assert sent.state is MissionState.RUNNING and sent.order.via == (second,)
            assert control.report is not None and control.report.order == sent.order

            drives = ReserveRequest("r0", first, Pose2(), (last,))

            def asks() -> ReserveAnswer:
                return decode(robot.ask(KEYS.any_reserve(), encode(drives), 5.0)[0].payload, ReserveAnswer)

            assert asks() == ReserveAnswer(1, "", None, "")
            (entry,) = fleet.status().robots
            assert entry.ahead == (last,) and server.robots().robots[0].ahead == (last,)
            status, out, _ = shell(
                "close", "kitchen", "--radius", "0.02", "--until", "+2h", "--because", "paint", "--by", "bob"
            )
            assert status == 0 and out.startswith("until ") and "UTC)\nclosure kitchen is an area" in out
            assert re.search(r'by bob: "paint"; it closes \d+ ways? of robots$', out.strip())
            answer = asks()
            assert (answer.granted, answer.closed) == (0, True)
            assert "the way ahead is closed by bob until" in answer.reason and '"paint"' in answer.reason
            request = encode(RouteRequest(first, last))
            refused = decode(robot.ask(KEYS.any_route(), request, 5.0)[0].payload, RouteAnswer)
            assert refused.legs == () and "is in kitchen, which is closed by bob" in refused.reason
            with pytest.raises(InvalidValue, match=r'is in kitchen, which is closed by bob .*"paint"'):
                fleet.go("r0", "kitchen")
            status, out, _ = shell("map", "route", str(first), "kitchen")
            assert status == NO and "closed by bob" in out
            assert "closure kitchen is an area" in shell("closures")[1]
            assert shell("reopen", "kitchen")[0] == 0
            assert shell("reopen", "kitchen")[::2] == (NO, "mapweave: there is no closure kitchen\n")
            assert asks().closed is False and fleet.go("r0", "kitchen").state is MissionState.RUNNING

            # One that ends by itself.
            soon = time.time_ns() + 300_000_000
            fleet.annotate("closure", "brief", place="kitchen", radius=0.02, end_ns=soon)
            eventually(lambda: not asks().closed)
            assert time.time_ns() >= soon

            # By a person whose clock is an hour behind.
            with monkeypatch.context() as patch:
                behind = time.time_ns() - 3600 * 10**9
                patch.setattr("mapweave.editable_map.time", SimpleNamespace(time_ns=lambda: behind))
                late = behind + 1800 * 10**9
                with pytest.raises(InvalidValue, match=r"^by the clock of the map server, .* is over"):
                    fleet.annotate("closure", "late", place="kitchen", radius=0.02, end_ns=late)

            assert shell("avoid", str(first), str(second), "--factor", "9")[0] == 0
            assert "cost times 9" in shell("closures")[1]
            assert shell("avoid", str(second), str(first), "--undo")[0] == 0
            assert shell("closures")[1].splitlines()[0].startswith("closure brief")
            for wrong, expected in (
                (["close"], USAGE), (["close", "a", "b", "c"], USAGE),
                (["close", "kitchen", "--until", "soon"], USAGE),
                (["prefer", "kitchen", "--factor", "2"], USAGE),
                (["close", "nowhere"], NO), (["close", str(first), str(first)], USAGE),
                (["close", "kitchen", "--until", "1999-01-01"], NO), (["reopen", "nothing"], NO),
            ):  # fmt: skip
                status, _, err = shell(*wrong)
                assert status == expected and err.count("\n") == 1, wrong
            link.close()
    finally:
        robot.close()
        router.close()
