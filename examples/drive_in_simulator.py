"""Drive a simulated robot: `python examples/drive_in_simulator.py [ROBOT ...]` maps a room of an office.

The map of each robot goes to a file in out/examples, which the other examples read.
"""

import sys
from pathlib import Path

import mapweave
from mapweave.agent.mission import Explore
from mapweave.agent.pipeline import Pipeline
from mapweave.sim.simulation import Simulation
from mapweave.sim.worlds.catalog import make_world

FOLDER = Path("out/examples")
OFFICE = make_world("office", 7)
PLACES = {"r0": mapweave.Pose2(1.9, 3.0, -2.8), "r1": mapweave.Pose2(2.2, 3.0, -0.8)}


def drive(robot: str, seconds: float = 40.0) -> Path:
    """Let a robot explore, unless it has done so already; returns its map file."""
    path = FOLDER / f"{robot}.mapweave"
    if not path.exists():
        # Of one seed they would share a clock, and be known to have been there at the same time.
        seed = list(PLACES).index(robot)
        with Simulation(OFFICE, [robot], seed, poses=[PLACES[robot]]) as simulation:
            description, command = simulation.describe(robot), mapweave.Command()
            pipeline = Pipeline(mapweave.MapId(robot, 1), description)
            pipeline.set_mission(Explore())
            for _ in range(round(seconds / description.tick)):
                seen = simulation.step({robot: command})[robot]
                command = pipeline.step(seen).command
        FOLDER.mkdir(parents=True, exist_ok=True)
        contents = tuple(pipeline.map.contents())
        mapweave.write_map_file(path, mapweave.MapFile("agent", f"{robot} in the office", contents))
    return path


if __name__ == "__main__":
    for name in sys.argv[1:] or ["r0"]:
        print(drive(name))
