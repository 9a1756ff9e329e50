"""For how long what has come waits for a merge."""

import random

from mapweave.mapserver.merging.unmerged import MOST, STEP, Unmerged
from tests.clock import Clock


def test_the_oldest_that_is_not_merged_counts_to_a_second() -> None:
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


def test_what_is_kept_is_bounded_and_the_oldest_is_right() -> None:
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
