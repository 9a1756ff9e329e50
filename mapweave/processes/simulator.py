"""The simulator as a process: a world, its robots, and the bridge to the bus."""

from __future__ import annotations

import threading
from collections.abc import Sequence

from mapweave.sim.bridge import SimBridge
from mapweave.sim.robots import RobotSetup
from mapweave.sim.simulation import Simulation
from mapweave.sim.world import World
from mapweave.wire.bus import Bus

PATIENCE = 60.0
"""How long the other robots wait for one that does not ask, s; they must not give up their body before."""


def run_sim(
    bus: Bus,
    fleet: str,
    world: World,
    robots: Sequence[RobotSetup],
    seed: int,
    stop: threading.Event,
    held: bool = False,
) -> None:
    """Serve simulated bodies in a world until `stop` is set.

    Args:
        bus: the connection.
        fleet: its name.
        world: already built.
        robots: in it.
        seed: of everything random.
        stop: ends it.
        held: time passes only when somebody asks for it.

    Raises:
        MapweaveError: the world holds no place for so many robots.
    """
    with Simulation(world, robots, seed) as simulation:
        bridge = SimBridge(simulation, bus, fleet, PATIENCE, held=held)
        try:
            names = ", ".join(simulation.robots)
            print(f"simulating {names} in {world.name}, seed {seed}", flush=True)
            bridge.run(stop)
        finally:
            bridge.close()
