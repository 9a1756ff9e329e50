"""Corrections of the way, against complex numbers, whose products are similarities of the plane."""

import cmath

import pytest

from mapweave.agent.mapping.way_correction import WayCorrection
from mapweave.hybridmap.pose import Pose2

WAY = WayCorrection(Pose2(1.0, -2.0, 0.7), 1.3)


def number(pose: Pose2) -> complex:
    return complex(pose.x, pose.y)


@pytest.mark.parametrize("world_from_map", [Pose2(), Pose2(3.0, 4.0, -2.0)])
def test_a_correction_seen_from_elsewhere_is_the_same(world_from_map: Pose2):
    frame = cmath.exp(1j * world_from_map.heading)
    robot = Pose2(0.5, 6.0, 1.1)
    moved = WAY.seen_from(world_from_map).apply(world_from_map @ robot)
    in_map = number(WAY.moved) + 1.3 * cmath.exp(0.7j) * number(robot)
    assert number(moved) == pytest.approx(number(world_from_map) + frame * in_map)
    assert moved.heading == pytest.approx((world_from_map @ Pose2(heading=1.1 + 0.7)).heading)


def test_about_a_pose_that_pose_stays():
    here = Pose2(2.0, -1.0, 0.3)
    way = WayCorrection.about(here, 0.9)
    assert way.apply(here).vector == pytest.approx(here.vector)
    assert way.apply(Pose2(12.0, -1.0)).distance(here) == pytest.approx(9.0)
