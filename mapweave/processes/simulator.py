"""The simulator as a process: a scenario's world, its robots, and the bridge to the bus."""

from __future__ import annotations

import threading

from mapweave.scenarios.scenario import Scenario
from mapweave.sim.bridge import SimBridge
from mapweave.sim.simulation import Simulation
from mapweave.wire.bus import Bus

PATIENCE = 60.0
"""How long the other robots wait for one that does not ask, s; they must not give up their body before."""


def run_sim(
    bus: Bus, fleet: str, scenario: Scenario, seed: int, stop: threading.Event, held: bool = False
) -> None:
    """Serve the simulated bodies of a scenario until told to stop; `held`: time passes only when asked for.

    Raises:
        MapweaveError: the world cannot be built, or holds no place for so many robots.
    """
    world = scenario.world(seed)
    with Simulation(world, scenario.robots, seed) as simulation:
        bridge = SimBridge(simulation, bus, fleet, PATIENCE, held=held)
        try:
            names = ", ".join(simulation.robots)
            print(f"simulating {names} in {world.name}, seed {seed}", flush=True)
            bridge.run(stop)
        finally:
            bridge.close()
