"""A whole drive through a serial line: mapping, kidnapping, parking, by `mapweave agent` with a Koala."""

import time
from pathlib import Path

import numpy as np
import pytest

from mapweave import HybridMap, Pose2
from mapweave.evaluation.map_score import pose_error, score_map
from mapweave.fleet import send_order
from mapweave.hybridmap.mission_order import MissionKind, MissionOrder
from mapweave.scenarios.children import Children, free_port
from mapweave.scenarios.reports import Reports
from mapweave.sim.robots import RobotSetup
from mapweave.sim.simulation import Simulation
from mapweave.sim.worlds.catalog import make_world
from mapweave.storage.map_file import unpack_map_file
from mapweave.wire.bus_settings import BusSettings
from mapweave.wire.keys import Keys
from mapweave.wire.zenoh_bus import ZenohBus
from tests.mapweave.koala_in_simulation import (
    RANGERS,
    InSimulation,
    Koala25InSimulation,
    KoalaSilverInSimulation,
)

EXPLORE = 90.0
"""Longest exploration, s."""
SEED = 11


def settings_file(folder: Path, koala: InSimulation, simulation: Simulation) -> Path:
    d = simulation.describe("r0")
    c = d.camera
    path = folder / "robot.toml"
    path.write_text(
        f"""
[robot]
driver = "koala"

[robot.options]
port = "{koala.path}"

[robot.camera]
source = "{koala.url}"
width = {c.width}
height = {c.height}
fx = {c.fx}
fy = {c.fy}
cx = {c.cx}
cy = {c.cy}
height_m = {c.mount_height}
forward_m = {c.mount_forward}

[robot.geometry]
radius = {d.radius}
axle = {d.axle}
wheel_noise = {d.wheel_noise}
"""
    )
    return path


@pytest.mark.timeout(560)
@pytest.mark.parametrize(("kind", "least_nodes"), [
    pytest.param(Koala25InSimulation, 10, marks=(pytest.mark.slow, pytest.mark.waits)),
    pytest.param(KoalaSilverInSimulation, 5, marks=pytest.mark.scenario),
])  # fmt: skip
def test_a_koala_maps_is_carried_off_and_parks(kind: type[InSimulation], least_nodes: int, tmp_path):
    keys, endpoint = Keys("serial"), f"tcp/127.0.0.1:{free_port()}"
    network = ["--fleet", "serial", "--connect", endpoint]
    bus = ZenohBus(BusSettings(mode="client", endpoints=(endpoint,)))
    robot = RobotSetup("r0", rangers=RANGERS, ranger_reach=2.5)
    with Simulation(make_world("office", SEED), [robot], seed=SEED) as simulation:
        koala = kind(tmp_path, simulation, "r0")
        try:
            with Children(tmp_path / "logs") as children:

                def wait_for(condition, seconds, what):
                    end = time.monotonic() + seconds
                    while not condition():
                        children.check()
                        assert time.monotonic() < end, f"{what}: {reports.agents(['r0'])}"
                        time.sleep(0.1)

                store = str(tmp_path / "server")
                children.start(
                    "server", ["server", "--fleet", "serial", "--listen", endpoint, "--data", store]
                )
                reports = Reports(bus, keys)
                wait_for(bus.connected, 30, "no router")
                path = settings_file(tmp_path, koala, simulation)
                arguments = ["--data", str(tmp_path), "--epoch", "1", "--settings", str(path), *network]
                children.start("r0", ["agent", "r0", *arguments])

                def agent(condition):
                    """Whether its status says so; one that does not answer in time is asked again."""
                    result = reports.agents(["r0"])
                    return "r0" in result and condition(result["r0"].status)

                wait_for(lambda: agent(lambda status: True), 40, "no agent")
                wait_for(lambda: agent(lambda status: status.nodes >= least_nodes), EXPLORE, "few nodes")
                assert send_order(bus, keys, MissionOrder.new("r0", MissionKind.STOP, "test")).open
                wait_for(lambda: agent(lambda status: status.mission == "idle"), 10, "does not stop")
                stored = lambda status: reports.server("s0").nodes == status.nodes  # noqa: E731
                wait_for(lambda: agent(stored), 30, "nodes are not stored")
                merged = unpack_map_file(bus.ask(keys.server_map("s0"), b"", 10)[0].payload)
                nodes = HybridMap(merged.changes).nodes
                with koala.world:
                    truth = {n.id: koala.truth_at(n.stamp_ns) for n in nodes.values()}
                score = score_map({n: (c, p.mean) for n, (c, p) in merged.poses.items()}, [], truth)
                print(f"{len(nodes)} nodes, ATE {score.ate:.3f} m, {koala.late} of {koala.ticks} ticks late")
                assert len(nodes) >= least_nodes
                assert score.ate < 0.15

                # It is carried off and turned around without odometry.
                goal = next(n.id for n in nodes.values() if len(n.landmarks) >= 30)
                with koala.world:
                    simulation.kidnap("r0", truth[goal] @ Pose2(-0.1, 0.15, 2.0))
                assert send_order(bus, keys, MissionOrder.new("r0", MissionKind.GO, "test", goal)).open
                parked = lambda status: status.mission == "goto" and status.finished  # noqa: E731
                wait_for(lambda: agent(parked), 150, "not parked")
                with koala.world:
                    distance, angle = pose_error(simulation.truth("r0"), truth[goal])
                print(f"parked {distance:.3f} m and {np.degrees(angle):.1f} degrees off")
                assert distance < 0.08
                assert np.degrees(angle) < 4.0
                assert simulation.collisions("r0") == 0
                # A robot that is killed does not drive on.
                children.kill("r0")
                time.sleep(0.5)
                assert koala.wheels.speeds == (0.0, 0.0)
                reports.close()
        finally:
            koala.close()
            bus.close()
