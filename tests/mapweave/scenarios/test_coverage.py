"""Coverage and loops, on a floor that can be counted by hand."""

import numpy as np
import pytest

from mapweave import Edge, EdgeKind, NodeId, Pose2, PoseGaussian
from mapweave.scenarios.coverage import REACH, explored_share, longest_loop
from mapweave.scenarios.recording import TrialTrajectory
from mapweave.sim.floorplan import BuildingPlan, Rectangle

HALL = BuildingPlan((Rectangle.spanning(0, 0, 8, 4, "hall"),), ())
HALVES = BuildingPlan(
    (Rectangle.spanning(0, 0, 8, 4, "hall"),), (Rectangle.spanning(3.9, 0.0, 4.1, 4.0, "wall"),)
)


def brute(plan: BuildingPlan, places: np.ndarray) -> float:
    """Every tenth of a metre, and every node, one by one; walls by walking along the line."""
    near = total = 0
    for x in np.arange(0.05, 8, 0.1):
        for y in np.arange(0.05, 4, 0.1):
            if not plan.is_free(x, y, 0.2):
                continue
            total += 1
            for place in places:
                way = np.linspace([x, y], place, 60)
                free = all(plan.clearances(way) > 0)
                if np.hypot(*(place - [x, y])) <= REACH and free:
                    near += 1
                    break
    return near / total


def test_nothing_and_everything():
    assert explored_share(HALL, np.zeros((0, 2))) == 0.0
    grid = np.stack(np.meshgrid(np.arange(0.5, 8, 1.0), np.arange(0.5, 4, 1.0)), axis=-1).reshape(-1, 2)
    assert explored_share(HALL, grid) == 1.0
    solid = BuildingPlan(HALL.rooms, (Rectangle.spanning(0, 0, 8, 4),))
    assert explored_share(solid, grid) is None


@pytest.mark.parametrize("plan", [HALL, HALVES])
def test_against_counting(plan):
    places = np.array([[3.5, 2.0], [1.0, 1.0], [7.5, 3.5]])
    assert explored_share(plan, places) == pytest.approx(brute(plan, places), abs=0.02)


def test_a_wall_hides():
    place = np.array([[3.5, 2.0]])
    open_hall, walled = explored_share(HALL, place), explored_share(HALVES, place)
    assert open_hall is not None and walled is not None
    # Of the half that it is in, it is near less than it would be near of the whole without the wall.
    assert walled / 2 < 0.75 * open_hall
    both = np.vstack([place, [[7.9, 3.9]]])
    assert explored_share(HALVES, both) < 0.75 * explored_share(HALL, both)


def square_drive() -> TrialTrajectory:
    """Once around a square of 5 m, 0.1 m a tick, and back at the start."""
    side = np.arange(0, 5, 0.1)
    zero, full = np.zeros_like(side), np.full_like(side, 5.0)
    xy = np.concatenate(
        [np.stack(p, 1) for p in ((side, zero), (full, side), (5 - side, full), (zero, 5 - side))]
    )
    xy = np.vstack([xy, [0.0, 0.0]])
    stamps = np.arange(len(xy), dtype=np.int64) * 100_000_000
    return TrialTrajectory(stamps, np.column_stack([xy, np.zeros(len(xy))]))


def test_the_odometry_of_a_loop_is_that_of_the_drive():
    drive = square_drive()
    start, middle, end = (NodeId("r0", 1, n) for n in (1, 2, 3))
    stamps = {start: 0, middle: int(drive.stamps_ns[50]), end: int(drive.stamps_ns[-1])}
    truth = {start: Pose2(), middle: Pose2(5.0, 0.0), end: Pose2()}

    def loop(a, b, off=0.0):
        true = truth[a].inverse() @ truth[b]
        pose = PoseGaussian.from_sigmas(Pose2(true.x + off, true.y, true.heading), 0.1, 0.1)
        return Edge(NodeId("r0", 1, 9), a, b, pose, EdgeKind.LOOP)

    paths = {"r0": drive}
    assert longest_loop([], truth, paths, stamps) is None
    assert longest_loop([loop(start, middle)], truth, paths, stamps) == pytest.approx(5.0)
    both = [loop(start, middle), loop(end, start)]
    assert longest_loop(both, truth, paths, stamps) == pytest.approx(20.0)
    assert longest_loop([loop(start, middle), loop(end, start, 1.0)], truth, paths, stamps) == pytest.approx(
        5.0
    )
