"""What a scenario learns from the statuses of its robots."""

import random

import pytest

from mapweave.hybridmap.agent_status import AgentStatus, Status
from mapweave.hybridmap.pose import Pose2
from mapweave.scenarios.reports import Reports
from mapweave.wire.keys import Keys
from mapweave.wire.memory import MemoryBus, MemoryHub
from mapweave.wire.messages import encode
from tests.waiting import eventually

KEYS = Keys("reports")


def report(tick: int, traffic: int) -> AgentStatus:
    return AgentStatus(
        Status("mapping", "", 4, 0, Pose2(), False), tick * 100_000_000, "r0", 1, traffic=traffic
    )


@pytest.mark.parametrize("seed", range(3))
def test_traffic_is_that_of_all_lives_of_an_agent_in_whatever_order_reports_come(seed: int):
    """Each report that was overtaken counted as another life: a robot of 1 MB seemed to have sent 86 MB."""
    draw = random.Random(seed)
    hub = MemoryHub()
    bus, agent = MemoryBus(hub), MemoryBus(hub)
    reports = Reports(bus, KEYS)
    lives = [
        [report(tick, 1000 * tick) for tick in range(1, 40)],
        [report(tick, 10 * tick) for tick in range(50, 90)],
    ]
    last = report(100, 5000)
    for life in lives:
        # Neighbours change places; the newest stays last.
        for k in range(0, len(life) - 2, 2):
            if draw.random() < 0.5:
                life[k], life[k + 1] = life[k + 1], life[k]
        for one in (*life, life[-2]):
            agent.publish(KEYS.agent_status("r0"), encode(one))
    agent.publish(KEYS.agent_status("r0"), encode(last))
    eventually(lambda: reports.traffic("r0") >= 39_000 + 5000)
    assert reports.traffic("r0") == 39_000 + 5000
    for one in (bus, agent):
        one.close()
