"""See inside a robot: `python examples/rerun_log.py` writes out/examples/r0.rrd.

Needs `pip install '.[sim,rerun]'`. Look at it with `rerun out/examples/r0.rrd`. `mapweave agent`, `replay`
and `sim run` have `--rerun`.
"""

import mapweave.extras

mapweave.extras.exit_without("sim", "rerun")
from drive_in_simulator import FOLDER, OFFICE, PLACES

from mapweave.agent.mission import Explore
from mapweave.agent.pipeline import Pipeline
from mapweave.processes.rerun_log import RerunLog
from mapweave.sim.simulation import Simulation

SECONDS = 20.0

log = RerunLog(str(FOLDER / "r0.rrd"), "r0")
with Simulation(OFFICE, ["r0"], seed=7, poses=[PLACES["r0"]]) as simulation:
    description, command = simulation.describe("r0"), mapweave.Command()
    pipeline = Pipeline(mapweave.MapId("r0", 1), description)
    pipeline.set_mission(Explore())
    for _ in range(round(SECONDS / description.tick)):
        seen = simulation.step({"r0": command})["r0"]
        step = pipeline.step(seen)
        log.step(seen, step, pipeline)  # hands over; a thread writes
        command = step.command
missing = log.close()
print(FOLDER / "r0.rrd", f"{len(pipeline.map.nodes)} nodes; not in it: {missing or 'nothing'}")
