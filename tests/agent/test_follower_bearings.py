"""A route to a node whose landmarks have no depth: found, driven to and parked at by bearings alone."""

from dataclasses import replace

import numpy as np
import pytest

from agent.homing.localizer import BearingLocalizer
from agent.localizing.fix import Fix
from agent.localizing.lookout import Expected, Lookout, LookoutSettings
from agent.navigating.detour import Detour
from agent.navigating.follower import Follower, FollowerSettings, Progress
from agent.observation import Observation, Odometry, RobotDescription
from agent.vision.lens import Lens
from agent.vision.sift import Sift
from hybridmap.camera import Camera
from hybridmap.node import Landmarks, Node
from hybridmap.pose import Pose2, PoseGaussian
from hybridmap.query import RouteLeg

HERE = PoseGaussian(Pose2(), np.zeros((3, 3)))
CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3)
ROBOT = RobotDescription(camera=CAMERA)


@pytest.fixture(scope="module")
def bare(node) -> Node:
    """The view from the origin without a single depth."""
    known = node.landmarks
    nothing = np.full(len(known), np.nan, np.float32)
    return replace(node, landmarks=Landmarks(known.pixels, known.codes, nothing, nothing))


def lookout() -> Lookout:
    lens = Lens(ROBOT)
    return Lookout(ROBOT, lens, Sift(lens), LookoutSettings(), np.random.default_rng(0))


@pytest.mark.parametrize(
    ("start", "seed"),
    [(Pose2(-0.6, -0.3, 0.2), 1), (Pose2(0.3, 0.0, 0.1), 2)],
)
def test_a_node_without_depths_is_parked_at(walls, bare, start, seed):
    """The robot believes to be 10 cm and 3 degrees elsewhere; its wheels err, and pixels are noisy."""
    rng = np.random.default_rng(seed)
    lens, believed = Lens(ROBOT), start @ Pose2(*rng.normal(0.0, [0.1, 0.1, 0.05]))
    fix = Fix(bare.id, PoseGaussian.from_sigmas(believed, 0.1, 0.05))
    route = (RouteLeg(bare, HERE, None),)
    follower = Follower(ROBOT, lens, Sift(lens), route, fix, Detour(ROBOT), FollowerSettings(), rng)
    pose, odometry, by_bearings = start, Odometry(0.0, 0.0), 0
    for tick in range(500):
        image = walls.render(pose) + rng.normal(0.0, 2.0, (CAMERA.height, CAMERA.width))
        seen = np.clip(image, 0, 255).astype(np.uint8)
        command = follower.step(Observation(tick * 100_000_000, odometry, seen))
        by_bearings += isinstance(follower.fix.localizer, BearingLocalizer)
        if follower.progress is Progress.ARRIVED:
            break
        way, turn = command.forward * ROBOT.tick, command.turn * ROBOT.tick
        pose = pose @ Odometry(way, turn).motion()
        odometry = Odometry(way * (1.0 + rng.normal(0.0, 0.02)), turn * (1.0 + rng.normal(0.0, 0.02)))
    assert follower.progress is Progress.ARRIVED
    assert pose.distance(Pose2()) < 0.01
    assert abs(pose.heading) < np.radians(1.0)
    assert by_bearings > 10


def test_the_way_tells_the_depths(walls, bare):
    """After 30 cm backward the node is as if it had been mapped."""
    pose = Pose2(-0.5, 0.2, -0.1)
    found = lookout().find(walls.render(pose), [Expected(3, bare, pose @ Pose2(0.05, -0.05, 0.03))])
    assert found is not None
    leg, localizer = found
    assert leg == 3
    assert isinstance(localizer, BearingLocalizer)
    assert not localizer.node.landmarks.has_depth.any()
    for tick in range(12):
        step = Odometry(-0.025, 0.0)
        pose = pose @ step.motion()
        localizer.step(Observation(tick, step, walls.render(pose)))
    known = localizer.node.landmarks
    assert known.has_depth.sum() > 25
    true = walls.depth_at(Pose2(), known.pixels)
    off = (np.abs(known.depths - true) / true)[known.has_depth]
    assert np.median(off) < 0.03
    assert localizer.pose.mean.distance(pose) < 0.03
    # From here on any look recognises it by its depths.
    again = lookout().find(walls.render(pose), [Expected(3, localizer.node, pose)])
    assert again is not None
    assert not isinstance(again[1], BearingLocalizer)


def test_a_fresh_look_keeps_what_the_way_has_told(walls, bare):
    pose = Pose2(-0.5, 0.2, -0.1)
    found = lookout().find(walls.render(pose), [Expected(0, bare, pose)])
    assert found is not None
    held = found[1]
    assert isinstance(held, BearingLocalizer)
    for tick in range(6):
        pose = pose @ Pose2(-0.02)
        held.step(Observation(tick, Odometry(-0.02, 0.0), walls.render(pose)))
    before = held.pose
    renewed = lookout().find(walls.render(pose), [Expected(0, bare, pose, held=held)])
    assert renewed is not None
    assert renewed[1] is held
    assert held.pose.mean.distance(before.mean) == 0.0
    pose = pose @ Pose2(-0.02)
    held.step(Observation(9, Odometry(-0.02, 0.0), walls.render(pose)))
    assert held.in_sight
    assert held.pose.mean.distance(pose) < 0.05


def test_bearings_are_believed_only_where_the_robot_may_be(walls, bare):
    pose = Pose2(-0.8, 0.3, -0.1)
    image = walls.render(pose)
    assert lookout().find(image, [Expected(0, bare, pose)]) is not None
    # The line is the same from twice as far away, and that cannot be told.
    assert lookout().find(image, [Expected(0, bare, Pose2(-1.6, 0.6, -0.1))]) is not None
    assert lookout().find(image, [Expected(0, bare, Pose2(-0.8, -0.9, -0.1))]) is None
    assert lookout().find(image, [Expected(0, bare, Pose2(0.8, -0.3, -0.1))]) is None
    assert lookout().find(image, [Expected(0, bare, Pose2(-0.8, 0.3, 0.3))]) is None


def test_a_blind_image_shows_no_node(bare):
    dark = np.full((CAMERA.height, CAMERA.width), 3, np.uint8)
    assert lookout().find(dark, [Expected(0, bare, Pose2())]) is None


def test_depths_that_say_nothing_are_no_depths(walls, node):
    """Sigmas as large as the depths: recognition by depth would refuse it, bearings do not."""
    known = node.landmarks
    vague = replace(known, depth_sigmas=known.depths.copy())
    pose = Pose2(-0.5, 0.2, -0.1)
    found = lookout().find(walls.render(pose), [Expected(0, replace(node, landmarks=vague), pose)])
    assert found is not None
    assert isinstance(found[1], BearingLocalizer)
