"""The simulator as a library: a world, a robot, steps, observations."""

from mapweave.agent.observation import Command
from mapweave.extras import exit_without

exit_without("sim")
from mapweave.sim.simulation import Simulation
from mapweave.sim.worlds.catalog import make_world

with Simulation(make_world("office", 7), ["robot"], seed=7) as simulation:
    for _ in range(50):
        seen = simulation.step({"robot": Command(forward=0.2, turn=0.1)})["robot"]
        print(f"{seen.stamp_ns / 1e9:.1f} s: {seen.image.shape} image, nearest {seen.proximity.min():.2f} m")
    print("it is really at", simulation.truth("robot"))
