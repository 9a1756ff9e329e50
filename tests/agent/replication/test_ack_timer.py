"""The time of an overdue acknowledgement against RFC 6298's equations."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave.agent.replication.beacon_timer import AckTimer

LEAST, MOST = 0.5, 10.0


def timed(*took: float) -> AckTimer:
    timer = AckTimer(LEAST, MOST)
    for sequence, seconds in enumerate(took, 1):
        timer.sent(sequence, 100.0 * sequence)
        timer.settled(sequence, 100.0 * sequence + seconds)
    return timer


@given(st.lists(st.floats(0.0, 60.0), min_size=1, max_size=30))
def test_it_is_rfc_6298_within_bounds(took: list[float]):
    srtt, rttvar = took[0], took[0] / 2
    for r in took[1:]:
        rttvar = (1 - 1 / 4) * rttvar + 1 / 4 * abs(srtt - r)
        srtt = (1 - 1 / 8) * srtt + 1 / 8 * r
    assert timed(*took).timeout == pytest.approx(min(max(srtt + 4 * rttvar, LEAST), MOST))


def test_without_a_measurement_it_is_the_shortest():
    timer = AckTimer(LEAST, MOST)
    timer.sent(1, 0.0)
    timer.settled(0, 5.0)
    assert timer.timeout == LEAST


def test_one_change_is_timed_after_the_other():
    timer = AckTimer(LEAST, MOST)
    timer.sent(1, 0.0)
    timer.sent(2, 1.0)
    timer.settled(2, 2.0)
    assert timer.timeout == pytest.approx(2.0 + 4 * 1.0)


def test_what_a_server_had_to_ask_for_says_nothing():
    timer = AckTimer(LEAST, MOST)
    timer.sent(7, 0.0)
    timer.asked_for(8, 20)
    timer.asked_for(5, 7)
    timer.settled(7, 9.0)
    assert timer.timeout == LEAST


def test_what_waited_for_a_server_that_was_away_says_nothing():
    timer = AckTimer(LEAST, MOST)
    timer.sent(7, 0.0)
    timer.forget()
    timer.settled(7, 9.0)
    assert timer.timeout == LEAST


def test_it_falls_again_after_a_slow_hour():
    assert timed(*[8.0] * 20).timeout == pytest.approx(8.0, abs=0.5)
    assert timed(*[8.0] * 20, *[0.02] * 60).timeout == LEAST
