"""What is kept of the way between two nodes."""

from dataclasses import replace

import numpy as np
import pytest

from mapweave import MapId, Observation, Odometry, Pose2
from mapweave.agent.mapping.mapper import Mapper
from mapweave.agent.mapping.trajectory_recorder import TrajectoryRecorder
from mapweave.hybridmap.trajectory_segment import MOST

STILL = Odometry(0.0, 0.0)


@pytest.fixture
def clocked(description):
    """A robot whose clock has a name, with two rangers that see others."""
    return replace(
        description, clock="net", ranger_bearings=(0.0, 1.0), ranger_reach=3.0, ranges_see_robots=True
    )


def seen(tick: int, proximity: tuple[float, ...] = (1.0, 3.0)) -> Observation:
    return Observation(tick * 100_000_000, STILL, None, np.array(proximity))


def test_one_moment_a_second_with_the_readings(clocked):
    recorder = TrajectoryRecorder(clocked)
    recorder.clear(0)
    for tick in range(1, 46):
        recorder.step(seen(tick), Pose2(0.01 * tick, 0.0, 0.002 * tick))
    segment = recorder.segment(0, clocked.ranges(np.array([1.0, 3.0])))
    assert segment.ages == pytest.approx([1.0, 2.0, 3.0, 4.0])
    assert segment.node_from_robot == pytest.approx(np.outer([10, 20, 30, 40], [0.01, 0.0, 0.002]))
    assert segment.distances == pytest.approx(np.tile([1.0 + clocked.radius, 3.0 + clocked.radius], (4, 1)))


def test_a_missing_reading_carries_no_information(clocked):
    recorder = TrajectoryRecorder(clocked)
    recorder.clear(0)
    for tick, proximity in ((10, (2.0, 2.0)), (20, ()), (30, (2.0, 2.0))):
        recorder.step(seen(tick, proximity), Pose2())
    segment = recorder.segment(0, clocked.ranges(np.array([1.0, 3.0])))
    # A ray that ends at the sensor has no information about what is behind.
    assert segment.distances[1] == pytest.approx([0.0, 0.0]) and (segment.distances[[0, 2]] > 2.0).all()


def test_a_robot_without_sensors_keeps_poses_and_one_without_a_clock_nothing(description):
    for clock, count in (("net", 3), ("", 0)):
        robot = replace(description, clock=clock)
        recorder = TrajectoryRecorder(robot)
        for tick in range(10, 40):
            recorder.step(seen(tick), Pose2())
        segment = recorder.segment(0, robot.ranges(np.zeros(0)))
        assert (len(segment), segment.distances.shape) == (count, (count, 0))


def test_a_long_wait_is_thinned_evenly(clocked):
    recorder = TrajectoryRecorder(clocked)
    for tick in range(1, 2500):
        recorder.step(seen(tick), Pose2())
    segment = recorder.segment(0, clocked.ranges(np.array([1.0, 3.0])))
    assert MOST / 2 <= len(segment) <= MOST
    gaps = np.diff(segment.ages)
    assert gaps.max() <= 16.1 and gaps.min() == pytest.approx(gaps.max(), abs=0.2)


def test_moments_before_a_view_that_became_no_node_belong_to_the_next(clocked):
    recorder = TrajectoryRecorder(clocked)
    recorder.clear(0)
    recorder.step(seen(10), Pose2(0.3, 0.1, 0.5))
    moved = Pose2(1.0, -0.5, 2.0)
    recorder.move_anchor(moved)
    recorder.step(seen(20), Pose2(0.2, 0.0, 0.1))
    segment = recorder.segment(1_500_000_000, clocked.ranges(np.array([1.0, 3.0])))
    assert segment.ages == pytest.approx([-0.5, 0.5])
    first = moved @ Pose2(*segment.node_from_robot[0])
    assert (first.vector, tuple(segment.node_from_robot[1])) == (
        pytest.approx([0.3, 0.1, 0.5]), pytest.approx((0.2, 0.0, 0.1))
    )  # fmt: skip


def test_a_mapped_drive_records_the_trajectory(walls, clocked):
    """Forward and back before photographs: one node, whose trajectory is the true one."""
    mapper = Mapper(MapId("r0", 1), clocked)
    way = [*np.arange(0.0, 0.6, 0.025), *np.arange(0.6, 0.2, -0.025)]
    before = Pose2(way[0])
    for tick, x in enumerate(way, 1):
        observation = replace(walls.observe(before, Pose2(x), tick), proximity=np.array([x, 3.0]))
        mapper.step(observation)
        if not mapper.started:
            mapper.begin(observation)
        before = Pose2(x)
    mapper.finish(observation)
    mapper.finish_pending()
    (node,) = mapper.map.nodes.values()
    ticks = np.rint((node.segment.ages * 1e9 + node.stamp_ns) / 1e8).astype(int)
    assert len(ticks) == 3 and (np.diff(ticks) == 10).all()
    true = np.array(way)[ticks - 1]
    assert node.segment.node_from_robot[:, 0] == pytest.approx(true, abs=0.01)
    assert node.segment.node_from_robot[:, 1:] == pytest.approx(0.0, abs=0.02)
    assert node.segment.distances[:, 0] == pytest.approx(true + clocked.radius)
    # The next node begins with none of it.
    mapper.finish(replace(observation, stamp_ns=observation.stamp_ns + 1))
    mapper.finish_pending()
    assert sum(len(one.segment) for one in mapper.map.nodes.values()) == 3
