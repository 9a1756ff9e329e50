"""A second agent for a robot is refused before it moves anything."""

import threading
import time

import pytest

from mapweave.agent.drivers.claim import Claim
from mapweave.hybridmap.errors import DeviceError
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub

KEYS = Keys("test")


@pytest.mark.slow
def test_the_second_is_refused_and_the_first_stays(hub: MemoryHub):
    first, second = MemoryBus(hub), MemoryBus(hub)
    claim = Claim(first, KEYS, "r0")
    with pytest.raises(DeviceError, match="another agent drives r0; stop it"):
        Claim(second, KEYS, "r0", leaving=0.1)
    other = Claim(second, KEYS, "r1")
    # The first is still seen.
    seen: list[tuple[str, bool]] = []
    watching = second.watch(KEYS.robot_drivers_of("r0"), lambda key, alive: seen.append((key, alive)))
    time.sleep(0.1)
    assert seen == [(KEYS.robot_driver("r0", claim.number), True)]
    for closing in (watching, claim, other):
        closing.close()
    Claim(second, KEYS, "r0").close()
    first.close()
    second.close()


def test_one_that_leaves_is_waited_for(hub: MemoryHub):
    first, second = MemoryBus(hub), MemoryBus(hub)
    Claim(first, KEYS, "r0")
    dying = threading.Timer(0.8, first.close)
    dying.start()
    Claim(second, KEYS, "r0", leaving=3.0).close()
    dying.join()
    second.close()


def test_of_two_at_the_same_time_exactly_one_stays(hub: MemoryHub):
    buses = [MemoryBus(hub) for _ in range(2)]
    claims: list[Claim] = []
    refused: list[str] = []
    ready = threading.Barrier(2)

    def take(bus: MemoryBus) -> None:
        ready.wait()
        try:
            claims.append(Claim(bus, KEYS, "r0", leaving=0.1))
        except DeviceError as error:
            refused.append(str(error))

    threads = [threading.Thread(target=take, args=(bus,)) for bus in buses]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (len(claims), len(refused)) == (1, 1)
    for bus in buses:
        bus.close()
