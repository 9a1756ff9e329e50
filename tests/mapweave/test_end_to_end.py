"""The whole system as processes over Zenoh: server with router, simulator, two agents. Nothing is faked."""

import json
import time

import numpy as np
import pytest

from mapweave import HybridMap, NodeId, Pose2
from mapweave.demo.run import run_demo
from mapweave.evaluation.map_score import pose_error, score_map
from mapweave.fleet import send_order
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder
from mapweave.scenarios.children import Children, free_port
from mapweave.scenarios.reports import Reports
from mapweave.scenarios.run import TrialOptions
from mapweave.sim.ground_truth_client import SimControl
from mapweave.storage.map_file import read_map_file, unpack_map_file
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.zenoh_bus import ZenohBus
from tests.simulator import needs_simulator

EXPLORE = 30.0
"""Simulated seconds of exploration."""


def wait_for(condition, seconds, children, what):
    """Poll; a child that has ended fails the test with its last words."""
    end = time.monotonic() + seconds
    while not condition():
        children.check()
        assert time.monotonic() < end, what
        time.sleep(0.05)


@pytest.mark.slow
@needs_simulator
@pytest.mark.timeout(420)
def test_two_robots_map_and_one_finds_its_way_back(tmp_path, opened):
    """Map for a minute, then carry a robot to another place of its room: it must find itself and park."""
    keys, endpoint = Keys("e2e"), f"tcp/127.0.0.1:{free_port()}"
    bus = opened(ZenohBus(BusSettings(mode="client", endpoints=(endpoint,))))
    network = ["--fleet", "e2e", "--connect", endpoint]
    with Children(tmp_path / "logs") as children:
        data = str(tmp_path / "server")
        children.start("server", ["server", "--fleet", "e2e", "--listen", endpoint, "--data", data])
        wait_for(bus.connected, 30, children, "no router")
        reports, control = Reports(bus, keys), SimControl(bus, "e2e")
        children.start("sim", ["sim", "serve", "office", "--set", "robots=2", "--seed", "11", *network])

        def agents():
            return reports.agents(["r0", "r1"])

        for name in ("r0", "r1"):
            children.start(
                name, ["agent", name, "--data", str(tmp_path), "--epoch", "1", "--lockstep", *network]
            )

        def explored():
            stamps = [a.stamp_ns for a in agents().values()]
            return len(stamps) == 2 and min(stamps) >= EXPLORE * 1e9

        wait_for(explored, 240, children, "no robot explores")
        for name in ("r0", "r1"):
            assert send_order(bus, keys, MissionOrder.new(name, MissionKind.STOP, "test")).open

        def idle():
            return {a.status.mission for a in agents().values()} == {"idle"}

        wait_for(idle, 20, children, "no robot stops")
        mapped = sum(a.status.nodes for a in agents().values())

        def settled():
            return reports.server("s0").nodes == mapped

        wait_for(settled, 30, children, f"the server lacks some of {mapped} nodes")

        merged = unpack_map_file(bus.ask(keys.server_map("s0"), b"", 10)[0].payload)
        whole = HybridMap(merged.changes)
        truth: dict[NodeId, Pose2] = {}
        for node in whole.nodes.values():
            truth[node.id] = control.truth_at(node.id.agent, [node.stamp_ns])[0]
        score = score_map({n: (c, p.mean) for n, (c, p) in merged.poses.items()}, [], truth)
        assert len(whole.nodes) >= 12
        assert score.ate < 0.10

        # The robot is turned around and carried a little, unnoticed.
        own = [n for n in whole.nodes.values() if n.id.agent == "r0" and len(n.landmarks) >= 30]
        goal = own[0].id
        place = truth[goal] @ Pose2(-0.1, 0.15, 2.0)
        control.kidnap("r0", place)
        assert send_order(bus, keys, MissionOrder.new("r0", MissionKind.GO, "test", goal)).open

        def parked():
            status = agents()["r0"].status
            return status.mission == "goto" and status.finished

        wait_for(parked, 90, children, "not parked")
        distance, angle = pose_error(control.status().robots["r0"].world_from_robot, truth[goal])
        assert distance < 0.05
        assert np.degrees(angle) < 3.0
        assert all(robot.collisions == 0 for robot in control.status().robots.values())

        for name in ("r0", "r1", "sim", "server"):
            children.end(name)
        reports.close()
    for name in ("r0", "r1"):
        content = read_map_file(tmp_path / f"{name}.1.mapweave", "agent")
        assert {n.agent for n in HybridMap(content.changes).nodes} == {name}


@pytest.mark.scenario
@needs_simulator
@pytest.mark.timeout(420)
def test_the_demo_of_another_seed(tmp_path):
    """`mapweave demo` with a world that no other test uses, against what the README promises."""
    report = run_demo(TrialOptions(seed=1234, out=tmp_path, quiet=True))
    print(json.dumps(report))
    assert report["components"] == 1
    assert report["false_links"] == 0
    assert report["merged_ate_m"] is not None
    assert report["merged_ate_m"] <= 0.10
    assert report["bytes_per_node"] <= 4000
    assert report["relocalization"]["found"]
    assert report["goal"]["reached"]
    assert report["collisions"] == 0
    assert report["wall_s"] < 360
    assert json.loads((tmp_path / "report.json").read_text()) == report
    for name in ("map.png", "merged.mapweave", "r0.1.mapweave", "film.webm", "report.md"):
        assert (tmp_path / name).stat().st_size > 1000
