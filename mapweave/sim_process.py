"""The simulator as a process: a world, its robots, and the bridge to the bus."""

from __future__ import annotations

import threading

from hybridmap.errors import SettingsError
from sim.bridge import SimBridge
from sim.office import make_office
from sim.simulation import Simulation
from wire.bus import Bus


def run_sim(bus: Bus, fleet: str, robots: int, rooms: int, seed: int, stop: threading.Event) -> None:
    """Serve simulated bodies r0, r1 ... until told to stop.

    Raises:
        SettingsError: a number of robots or rooms, or a seed, that cannot work.
    """
    if not 1 <= robots <= 16:
        raise SettingsError(f"--robots {robots}: use 1 to 16")
    if not 3 <= rooms <= 12:
        raise SettingsError(f"--rooms {rooms}: use 3 to 12")
    if seed < 0:
        raise SettingsError(f"--seed {seed}: use 0 or more")
    world = make_office(seed, rooms)
    with Simulation(world, [f"r{k}" for k in range(robots)], seed) as simulation:
        bridge = SimBridge(simulation, bus, fleet)
        try:
            print(f"simulating {robots} robots in an office of {rooms} rooms, seed {seed}", flush=True)
            bridge.run(stop)
        finally:
            bridge.close()
