"""The simulator as a process: a world, its robots, and the bridge to the bus."""

import threading
from collections.abc import Sequence

from mapweave.hybridmap.errors import DeviceError
from mapweave.sim.bridge import SimBridge
from mapweave.sim.robots import RobotSetup
from mapweave.sim.simulation import Simulation
from mapweave.sim.world import World
from mapweave.terminal import stamped
from mapweave.wire.bus import Bus
from mapweave.wire.keys import Keys

PATIENCE = 60.0
"""How long the other robots wait for one that does not ask, s; they must not give up their body before."""
ANSWER = 1.0
"""A base that is there answers sooner, s."""


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
        held: time passes only on request.

    Raises:
        MapweaveError: the world holds no place for so many robots, or one of them has a base already.
    """
    for name in (setup.name for setup in robots):
        # Two bases of one name would end the agent that drives the first.
        if any(not reply.error for reply in bus.ask(Keys(fleet).robot_describe(name), b"", ANSWER)):
            raise DeviceError(f"robot {name} has a base already: stop the other `mapweave sim serve`")
    with Simulation(world, robots, seed) as simulation:
        bridge = SimBridge(simulation, bus, fleet, PATIENCE, held=held)
        try:
            names = ", ".join(simulation.robots)
            print(stamped(f"simulating {names} in {world.name}, seed {seed}"), flush=True)
            bridge.run(stop)
        finally:
            bridge.close()
