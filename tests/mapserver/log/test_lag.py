"""How long a change is known of and missing, against all announcements kept by brute force."""

from hypothesis import given
from hypothesis import strategies as st

from mapweave.hybridmap.ids import MapId
from mapweave.mapserver.log.agent_log import MOST_ANNOUNCED, AgentLog, PullSettings
from mapweave.mapserver.log.entry import Applied

STEPS = st.lists(
    st.tuples(st.integers(1, 300), st.floats(0.001, 3.0), st.sampled_from([0.0, 0.0, 0.3, 1.0])), max_size=8
)
"""Announcements in a row, s between them, and which share of what is missing is settled then."""


@given(STEPS)
def test_the_lag_is_never_too_small(steps: list[tuple[int, float, float]]):
    log = AgentLog(MapId("r0", 1), 7, PullSettings())
    announced: list[tuple[int, float]] = []
    now, newest, watermark, began = 0.0, 0, 0, 0.0
    for count, pause, share in steps:
        for _ in range(count):
            now, newest = now + pause, newest + 2
            began = now if not announced else began
            log.announce(newest, now)
            log.announce(newest - 1, now + 1.0)
            announced.append((newest, now))
        watermark += int(share * (newest - watermark))
        log.settled(Applied((), (), watermark))
        announced = [(number, at) for number, at in announced if number > watermark]
        true = now - announced[0][1] if announced else 0.0
        assert true <= log.lag(now) <= now - began + 1e-9
        if not announced or watermark == 0:
            assert log.lag(now) == true
        assert len(log._announced) <= MOST_ANNOUNCED
