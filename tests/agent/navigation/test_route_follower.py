"""The end of a route: the robot is at the goal only if a fresh look says so."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapweave import Camera, Command, Node, Observation, Odometry, Pose2, PoseGaussian, RobotDescription
from mapweave.agent.localization.fix import Fix
from mapweave.agent.localization.node_detector import Expected, NodeDetector
from mapweave.agent.navigation.local_planner import LocalPlanner
from mapweave.agent.navigation.route_follower import (
    MOST_CANDIDATES,
    STALLED_PARKING,
    ProgressMonitor,
    RouteFollower,
    RouteProgress,
)
from mapweave.agent.servo.servo_step import ServoStep
from mapweave.agent.servo.supervisor import Servo
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.query import RouteLeg
from mapweave.registration.recognition import recognise
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift
from tests.hand_held import photograph
from tests.quick import first_quick

HERE = PoseGaussian(Pose2(), np.zeros((3, 3)))


CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3)
ROBOT = RobotDescription(camera=CAMERA)


class Deluded:
    """A localizer whose tracks have slid: it is certain to be at the goal, wherever it is."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self.pose = PoseGaussian.from_sigmas(Pose2(), 0.002, 0.001)
        self.visible = np.arange(len(node.landmarks))
        self.in_sight = True

    def step(self, observation: Observation) -> None:
        """It learns nothing."""


def follower_at_the_goal(node: Node) -> RouteFollower:
    lens = Lens(ROBOT.camera, ROBOT.distortion)
    fix = Fix(node.id, HERE, Deluded(node))  # type: ignore[arg-type]
    route = (RouteLeg(node, HERE, None),)
    rng = np.random.default_rng(0)
    return RouteFollower(ROBOT, lens, Sift(lens), route, fix, LocalPlanner(ROBOT), AgentSettings(), rng)


def parked(follower: RouteFollower, walls, pose: Pose2) -> Pose2:
    """Where a robot that follows a route from a pose arrives."""
    odometry = Odometry(0.0, 0.0)
    for tick in range(400):
        command = follower.step(Observation(tick * 100_000_000, odometry, walls.render(pose)))
        if follower.progress is RouteProgress.ARRIVED:
            break
        odometry = Odometry(command.forward * ROBOT.tick, command.turn * ROBOT.tick)
        pose = pose @ odometry.motion()
    assert follower.progress is RouteProgress.ARRIVED
    return pose


@pytest.mark.parametrize(
    "begin", first_quick([Pose2(-0.01, 0.02, -0.015), Pose2(-0.03, 0.0, 0.0), Pose2(0.02, -0.02, 0.02)], 1)
)
def test_drifted_tracks_do_not_park_the_robot_next_to_the_goal(walls, node, begin):
    """The robot's estimate is parked, 2 to 3 cm off. It detects the goal again, and drives the rest."""
    pose = parked(follower_at_the_goal(node), walls, begin)
    assert pose.distance(Pose2()) < 0.01
    assert abs(pose.heading) < np.radians(1.0)


@pytest.mark.parametrize(
    ("scale", "pitch", "roll"), first_quick([(1.25, 0.02, -0.015), (0.8, -0.02, 0.01)], 1)
)
def test_it_parks_where_a_photograph_was_taken_by_hand(walls, node, scale, pitch, roll):
    """Tilted, and of a scale that is off by a quarter: the robot has only the photograph to go by."""
    held = photograph(node, scale, pitch, roll)
    pose, lens = Pose2(-0.7, 0.12, -0.1), Lens(ROBOT.camera, ROBOT.distortion)
    lookout = NodeDetector(ROBOT, lens, Sift(lens), np.random.default_rng(0))
    estimated = Pose2(scale * pose.x, scale * pose.y, pose.heading)
    detection = lookout.find(walls.render(pose), [Expected(0, held, estimated)])
    assert detection is not None
    rng, route = np.random.default_rng(0), (RouteLeg(held, HERE, None),)
    follower = RouteFollower(
        ROBOT, lens, Sift(lens), route, Fix.of(detection[1]), LocalPlanner(ROBOT), AgentSettings(), rng
    )
    pose = parked(follower, walls, pose)
    assert pose.distance(Pose2()) < 0.02
    assert abs(pose.heading) < np.radians(1.0)


class Measured(Deluded):
    """A localizer that knows where the robot is, and says how well it does."""

    def __init__(self, node: Node, pose: Pose2, sigma: float) -> None:
        super().__init__(node)
        self.pose = PoseGaussian.from_sigmas(pose, sigma, 0.001)
        self._covariance = self.pose.covariance

    def step(self, observation: Observation) -> None:
        self.pose = PoseGaussian(self.pose.mean @ observation.odometry.motion(), self._covariance)

    def restart(self, pose: PoseGaussian) -> None:
        """It knows already."""


@pytest.mark.parametrize(
    ("sigma", "nearer"), [(0.0015, False), (0.003, True), (0.02, True)], ids=["sure", "unsure", "blurred"]
)
def test_a_robot_that_may_be_a_centimetre_off_drives_the_rest(node, monkeypatch, sigma, nearer):
    """It arrives 6.5 mm off by its tracks. With how well the goal itself says so, that may be too much."""
    begin = Pose2(0.0, 0.0065, 0.0)
    follower, true = follower_at_the_goal(node), Measured(node, begin, sigma)
    monkeypatch.setattr(RouteFollower, "_detect_goal", lambda *_: true)
    monkeypatch.setattr(RouteFollower, "_detect", lambda *_: False)
    odometry, dark, said = Odometry(0.0, 0.0), np.full((CAMERA.height, CAMERA.width), 3, np.uint8), ""
    for tick in range(400):
        command = follower.step(Observation(tick * 10**8, odometry, dark))
        if follower.fix.localizer is not true:
            true.step(Observation(0, odometry, dark))
        said = follower.detail
        if follower.progress is RouteProgress.ARRIVED:
            break
        odometry = Odometry(command.forward * ROBOT.tick, command.turn * ROBOT.tick)
    assert follower.progress is RouteProgress.ARRIVED
    off = 1e3 * true.pose.mean.distance(Pose2())
    assert off <= 4.0 if nearer else off == pytest.approx(6.5)
    assert said == f"at the goal, {off:.0f} +- {1e3 * sigma:.0f} mm off"


def test_a_vague_look_does_not_move_a_robot_that_its_way_has_brought_to_the_goal(node, monkeypatch):
    """Of landmarks close together a look knows little: it says 9 mm, give or take 7. The tracks are right."""
    follower, restarts = follower_at_the_goal(node), []
    vague = Measured(node, Pose2(0.0, -0.009, 0.0), 0.007)

    def restart(pose: PoseGaussian) -> None:
        restarts.append(pose)
        vague.pose = pose

    monkeypatch.setattr(vague, "restart", restart)
    monkeypatch.setattr(RouteFollower, "_detect_goal", lambda *_: vague)
    monkeypatch.setattr(RouteFollower, "_detect", lambda *_: False)
    dark = np.full((CAMERA.height, CAMERA.width), 3, np.uint8)
    for tick in range(20):
        assert follower.step(Observation(tick * 10**8, Odometry(0.0, 0.0), dark)) == Command()
        if follower.progress is RouteProgress.ARRIVED:
            break
    assert follower.progress is RouteProgress.ARRIVED
    assert len(restarts) == 1
    assert restarts[0].mean.distance(Pose2()) < 0.002


def test_a_robot_that_sees_nothing_of_the_goal_has_not_arrived(walls, node):
    follower = follower_at_the_goal(node)
    dark = np.full((CAMERA.height, CAMERA.width), 3, np.uint8)
    seen = []
    for tick in range(40):
        follower.step(Observation(tick * 100_000_000, Odometry(0.0, 0.0), dark))
        seen.append(follower.progress)
        if follower.progress is RouteProgress.UNSURE:
            break
    assert RouteProgress.ARRIVED not in seen
    assert seen[-1] is RouteProgress.UNSURE


def test_a_new_detection_replaces_tracks_only_with_many_more_landmarks(walls, node):
    """Tracks have been filtered for a while; a look that knows hardly more has not."""
    lens, pose = Lens(ROBOT.camera, ROBOT.distortion), Pose2(-0.3, 0.1, -0.1)
    image = walls.render(pose)
    lookout = NodeDetector(ROBOT, lens, Sift(lens), np.random.default_rng(0))
    view = Sift(lens).extract(image).view(CAMERA)
    recognition = recognise(node, view, None, np.random.default_rng(0))
    assert recognition is not None
    assert recognition.inliers > 20
    assert lookout.find(image, [Expected(0, node, pose, tracked=recognition.inliers - 2)]) is None
    taken = lookout.find(image, [Expected(0, node, pose, tracked=recognition.inliers // 2)])
    assert taken is not None
    assert taken[1].pose.mean.distance(pose) < 0.05


def test_nodes_are_found_where_they_are_expected_only(walls, node):
    lens, pose = Lens(ROBOT.camera, ROBOT.distortion), Pose2(-0.3, 0.1, -0.1)
    lookout = NodeDetector(ROBOT, lens, Sift(lens), np.random.default_rng(0))
    image, elsewhere = walls.render(pose), pose @ Pose2(-0.5)
    assert lookout.find(image, [Expected(3, node, elsewhere)]) is None
    detection = lookout.find(image, [Expected(7, node, elsewhere), Expected(3, node, elsewhere, doubt=2.0)])
    assert detection is not None
    assert detection[0] == 3


def test_a_servo_that_gets_no_nearer_gives_way_to_a_drive_around(node, monkeypatch):
    """A robot waited at an obstacle until its patience ended, and the drive around had none left."""
    standing = ServoStep(Command(), "driving", None, "leg 1 of 2")

    monkeypatch.setattr(Servo, "command", lambda *_: standing)
    follower = follower_at_the_goal(node)
    follower.fix.localizer.pose = PoseGaussian.from_sigmas(Pose2(-1.0, 0.0, 0.0), 0.002, 0.001)
    dark = np.full((CAMERA.height, CAMERA.width), 3, np.uint8)
    commands = [follower.step(Observation(k * 10**8, Odometry(0.0, 0.0), dark)) for k in range(140)]
    moved = [command.forward > 0.0 for command in commands]
    stood = round(STALLED_PARKING / ROBOT.tick)
    assert not any(moved[: stood - 1])
    assert all(moved[stood + 2 : stood + 30])
    assert follower.progress is RouteProgress.DRIVING


@given(st.lists(st.floats(0.0, 5.0), min_size=1, max_size=60))
def test_headway_counts_since_the_robot_came_nearer(distances):
    headway, best, since = ProgressMonitor(), np.inf, 0
    for distance in distances:
        headway.take(distance, 0.1)
        since += 1
        if distance < best - headway.step:
            best, since = distance, 0
        assert headway.stood == pytest.approx(0.1 * since)
        assert headway.best == best


def test_a_route_with_a_thousand_nodes_in_one_place_needs_few_detections(node, monkeypatch):
    tried = []
    monkeypatch.setattr(NodeDetector, "find", lambda self, image, wanted, left_out: tried.append(len(wanted)))
    lens = Lens(ROBOT.camera, ROBOT.distortion)
    ahead = PoseGaussian(Pose2(0.5), np.zeros((3, 3)))
    route = (RouteLeg(node, HERE, None), *[RouteLeg(node, ahead, None)], *[RouteLeg(node, HERE, None)] * 1000)
    follower = RouteFollower(
        ROBOT, lens, Sift(lens), route, Fix(node.id, HERE), LocalPlanner(ROBOT), AgentSettings(),
        np.random.default_rng(0),
    )  # fmt: skip
    for tick in range(8):
        follower.step(Observation(tick, Odometry(0.0, 0.0), np.zeros((240, 320), np.uint8)))
    assert tried
    assert max(tried) <= MOST_CANDIDATES + 1
