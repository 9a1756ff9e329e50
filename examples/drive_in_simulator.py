"""Two simulated robots map a room: `python examples/drive_in_simulator.py`; other examples take the maps."""

from pathlib import Path

import mapweave
from mapweave.agent.mission import Explore
from mapweave.agent.pipeline import Pipeline
from mapweave.sim.simulation import Simulation
from mapweave.sim.worlds.catalog import make_world

FOLDER, OFFICE = Path("out/examples"), make_world("office", 7)
FOLDER.mkdir(parents=True, exist_ok=True)
PLACES = {"r0": mapweave.Pose2(1.9, 3.0, -2.8), "r1": mapweave.Pose2(2.2, 3.0, -0.8)}


def drive(robot: str) -> Path:
    if (path := FOLDER / f"{robot}.mapweave").exists():
        return path
    # Of one seed they would share a clock, and be known to have been there at the same time.
    with Simulation(OFFICE, [robot], seed=int(robot[1:]), poses=[PLACES[robot]]) as simulation:
        pipeline, command = Pipeline(mapweave.MapId(robot, 1), simulation.describe(robot)), mapweave.Command()
        pipeline.set_mission(Explore())
        for _ in range(400):  # of 0.1 s
            command = pipeline.step(simulation.step({robot: command})[robot]).command
    mapweave.write_map_file(path, mapweave.MapFile("agent", robot, tuple(pipeline.map.contents())))
    return path


if __name__ == "__main__":
    print(drive("r0"), drive("r1"))
