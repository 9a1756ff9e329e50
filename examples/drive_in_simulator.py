"""Two simulated robots map a room: `python examples/drive_in_simulator.py`; other examples take the maps."""

from pathlib import Path

import mapweave.extras
from mapweave.agent import mission, pipeline

mapweave.extras.exit_without("sim")
from mapweave.sim.simulation import Simulation
from mapweave.sim.worlds.catalog import make_world

FOLDER, OFFICE = Path("out/examples"), make_world("office", 7)
FOLDER.mkdir(parents=True, exist_ok=True)
PLACES = {"r0": mapweave.Pose2(1.9, 3.0, -2.8), "r1": mapweave.Pose2(2.2, 3.0, -0.8)}


def drive(robot: str) -> Path:
    if (path := FOLDER / f"{robot}.mapweave").exists():
        return path
    with Simulation(OFFICE, [robot], seed=int(robot[1:]), poses=[PLACES[robot]]) as sim:  # each its own clock
        agent, command = pipeline.Pipeline(mapweave.MapId(robot, 1), sim.describe(robot)), mapweave.Command()
        agent.set_mission(mission.Explore())
        for _ in range(400):  # of 0.1 s
            command = agent.step(sim.step({robot: command})[robot]).command
    mapweave.write_map_file(path, mapweave.MapFile("agent", robot, tuple(agent.map.contents())))
    return path


if __name__ == "__main__":
    print(drive("r0"), drive("r1"))
