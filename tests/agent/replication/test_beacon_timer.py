"""When beacons are due, by hand."""

import pytest

from mapweave.agent.replication.beacon_timer import RAREST, SETTLED_BEACONS, BeaconTimer

INTERVAL = 0.5
ALL = SETTLED_BEACONS * INTERVAL


@pytest.fixture
def timer() -> BeaconTimer:
    """All beacons were sent at 100 s, and servers lack nothing."""
    timer = BeaconTimer(INTERVAL)
    assert timer.due == 0.0 and timer.all_due(100.0, 0.0)
    timer.sent(100.0, lacking=False)
    return timer


def test_while_nothing_happens_they_are_rare(timer: BeaconTimer):
    assert timer.due == 100.0 + ALL
    assert not timer.all_due(timer.due - 0.1, 0.0) and timer.all_due(timer.due, 2.0)
    timer.sent(timer.due, lacking=False)
    assert timer.due == 100.0 + ALL + SETTLED_BEACONS * 2.0, "and rarer where servers have many robots"


def test_what_is_not_acknowledged_has_beacons_at_growing_intervals(timer: BeaconTimer):
    timer.changed(101.0)
    times = []
    for _ in range(6):
        times.append(timer.due)
        timer.sent(timer.due, lacking=True)
    assert times == [101.5, 102.0, 103.0, 105.0, 107.0, 109.0] and RAREST == 4
    timer.changed(109.5)
    assert timer.due == 110.0, "all of them are due before the next overdue one"


def test_who_is_acknowledged_slowly_waits_longer(timer: BeaconTimer):
    timer.published(1, 101.0)
    timer.settled(1, 103.0)
    timer.changed(103.0)
    assert timer.due == 103.0 + 2.0 + 4 * 1.0
    timer.some_settled(104.0)
    assert timer.due == 104.0 + 2.0 + 4 * 1.0, "the others have the whole time again"


def test_a_server_that_comes_hears_of_all_maps(timer: BeaconTimer):
    timer.hasten(101.0)
    assert timer.due == 101.0 and not timer.all_due(101.0, 0.0)
    timer.sent(101.0, lacking=False)
    timer.server_came(102.0)
    assert timer.due == 102.0 and timer.all_due(102.0, 0.0)
