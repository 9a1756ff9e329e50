"""When a server that leads hands its merges over, and how long what has come waits for a merge."""

import random
from types import SimpleNamespace
from typing import Any, cast

import pytest

from mapweave.mapserver.merging.merge_handover import SHARE, MergeHandover
from mapweave.mapserver.merging.merger import Merger
from mapweave.mapserver.merging.stored_merges import StoredMerges
from mapweave.mapserver.merging.unmerged import MOST, STEP, Unmerged
from tests.clock import Clock


class Followed:
    """A store that others follow; a merge is written in one second, or fails."""

    term, followed, fails = 1, True, False

    def __init__(self, clock: Clock) -> None:
        self._clock, self.store = clock, self
        self.written, self.said = list[float](), [""]

    def begin(self) -> None:
        self.written.clear()

    def tell(self, trouble: str) -> None:
        if trouble != self.said[-1]:
            self.said.append(trouble)

    def write(self, *_: Any) -> int:
        if self.fails:
            raise OSError("no room")
        self.written.append(self._clock())
        self._clock.now += 1.0
        return 1


@pytest.fixture
def clock() -> Clock:
    return Clock(100.0)


@pytest.fixture
def followed(clock: Clock) -> Followed:
    return Followed(clock)


@pytest.fixture
def handover(followed: Followed, clock: Clock) -> MergeHandover:
    one = MergeHandover(cast(StoredMerges, followed), clock)
    one.lead()
    return one


def hand_over(
    handover: MergeHandover, merges: int, outdated: bool = False, trouble: str = ""
) -> float | None:
    merger = cast(Merger, SimpleNamespace(counters=SimpleNamespace(merges=merges)))
    return handover.write(merger, {}, None, outdated, trouble)


def test_a_slow_disk_takes_a_share_of_the_time(handover: MergeHandover, followed: Followed, clock: Clock):
    for merges in range(1, 200):
        wait = hand_over(handover, merges)
        clock.now += 0.5
        assert wait is None or wait <= 1.0 / SHARE
    assert len(followed.written) > 3
    assert all(b - a >= 1.0 / SHARE for a, b in zip(followed.written, followed.written[1:], strict=False))


def test_a_merge_is_handed_over_once_and_not_while_it_is_outdated(
    handover: MergeHandover, followed: Followed
):
    assert hand_over(handover, 1, outdated=True) is None and not followed.written
    for _ in range(3):
        assert hand_over(handover, 1) is None
    assert len(followed.written) == 1


def test_an_older_merge_that_is_handed_over_withdraws_no_trouble_of_a_newer_one(
    handover: MergeHandover, followed: Followed, clock: Clock
):
    hand_over(handover, 1)
    assert hand_over(handover, 2) is not None, "it waits for its time"
    clock.now += 100.0
    hand_over(handover, 2, trouble="merging failed")
    assert len(followed.written) == 2 and followed.said == ["", "merging failed"]
    hand_over(handover, 3)
    assert followed.said[-1] == ""


def test_a_merge_that_cannot_be_written_is_said_until_one_can(handover: MergeHandover, followed: Followed):
    followed.fails = True
    hand_over(handover, 1)
    assert "no room" in followed.said[-1]
    followed.fails = False
    hand_over(handover, 2)
    assert followed.said[-1] == ""


def test_the_oldest_that_is_not_merged_counts_to_a_second():
    draw, clock = random.Random(5), Clock()
    unmerged, came, merged = Unmerged(clock), list[float](), 0
    for _ in range(2000):
        clock.now += draw.expovariate(2.0)
        if draw.random() < 0.7:
            came.append(clock.now)
            unmerged.came(len(came))
        elif draw.random() < 0.3:
            merged = draw.randint(merged, len(came))
            unmerged.merged(merged)
        wanted = clock.now - came[merged] if merged < len(came) else 0.0
        assert wanted <= unmerged.seconds <= wanted + (STEP if wanted else 0.0)


def test_what_is_kept_is_bounded_and_the_oldest_is_right():
    clock = Clock()
    unmerged = Unmerged(clock)
    for number in range(1, 3 * MOST):
        clock.now += 2.0 * STEP
        unmerged.came(number)
    assert len(unmerged._steps) == MOST
    assert unmerged.seconds == clock.now - 2.0 * STEP
    unmerged.merged(3 * MOST - 2)
    assert unmerged.seconds > 0.0
    unmerged.merged(3 * MOST - 1)
    assert unmerged.seconds == 0.0
