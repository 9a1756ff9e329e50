"""Other robots in the image: where they may stand is no place for landmarks."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from mapweave import Camera, Landmarks, MapId, NodeId, Pose2, PoseGaussian
from mapweave.agent.ekf.landmark_estimates import LandmarkEstimates
from mapweave.agent.mapping.mapper import Mapper
from mapweave.agent.mission import Explore, ServerAnswer, WhoIsNear
from mapweave.agent.observation import Observation, Odometry, RobotDescription
from mapweave.agent.robots_in_view import EVERY, NUMBER, OLDEST, OVERDUE, SIGMAS, RobotsInView
from mapweave.hybridmap.nearby import NearbyAnswer, NearbyRobot
from tests.agent.conftest import PhotoWalls
from tests.agent.ranged_body import on, rangers

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3, mount_forward=0.05)
BODY = RobotDescription(CAMERA, max_forward=0.3)
HERE = PoseGaussian(Pose2(), np.diag([1e-4, 1e-4, 1e-6]))
NODE = NodeId("r0", 1, 1)
NO_LANDMARKS = LandmarkEstimates(
    np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0), np.zeros(0)
)


class Eyes:
    """A robot that has asked, and has an answer."""

    def __init__(self, *robots: NearbyRobot) -> None:
        self.others, self.stamp_ns = RobotsInView(BODY), 0
        self.step()
        assert self.others.due
        question = self.others.question(((NODE, Pose2()),), HERE)
        assert (question.number, question.radius, question.speed) == (NUMBER, BODY.radius, BODY.max_forward)
        assert question.height > CAMERA.mount_height and question.sigma == pytest.approx(0.01)
        assert not self.others.due, "one question at a time"
        self.seen = self.step(answers=(ServerAnswer(NUMBER, NearbyAnswer(robots)),))

    def step(
        self, seconds: float = 0.0, odometry: Odometry | None = None, answers=(), landmarks=NO_LANDMARKS
    ) -> np.ndarray:
        self.stamp_ns += round(seconds * 1e9)
        observation = Observation(self.stamp_ns, odometry or Odometry(0.0, 0.0))
        return self.others.mark(observation, answers, lambda: landmarks).left_out


def other(x: float, y: float, sigma: float = 0.02, age: float = 0.0, speed: float = 0.3) -> NearbyRobot:
    return NearbyRobot("r1", Pose2(x, y, 1.0), sigma, 0.16, 0.3, speed, age)


@given(
    st.floats(0.8, 4.5), st.floats(-2.0, 2.0), st.floats(0.0, 0.1), st.floats(0.0, 1.0), st.integers(0, 2**32)
)
def test_wherever_the_other_may_be_its_body_is_in_the_region(x, y, sigma, age, seed):
    regions = Eyes(other(x, y, sigma, age)).seen
    assume(len(regions))
    random = np.random.default_rng(seed)
    around = random.uniform(-math.pi, math.pi, (500, 2))
    off = (SIGMAS * sigma + 0.3 * age) * np.sqrt(random.uniform(0, 1, 500))
    at = np.array([x, y]) + np.stack([np.cos(around[:, 0]), np.sin(around[:, 0])], axis=1) * off[:, None]
    edge = at + 0.16 * np.stack([np.cos(around[:, 1]), np.sin(around[:, 1])], axis=1)
    pixels = CAMERA.project(np.column_stack([edge, random.uniform(0.0, 0.3, 500)]))
    pixels = pixels[CAMERA.contains(pixels)]
    inside = (pixels >= regions[0, :2] - 1e-6) & (pixels <= regions[0, 2:] + 1e-6)
    assert inside.all()


def test_a_region_grows_with_age_until_it_is_given_up():
    def area(box: np.ndarray) -> float:
        return float(np.prod(box[2:] - box[:2]))

    eyes = Eyes(other(3.0, 0.0))
    (fresh,) = eyes.seen
    (older,) = eyes.step(0.5)
    (later,) = eyes.step(0.5)
    assert area(fresh) < area(older) < area(later) < 0.5 * CAMERA.width * CAMERA.height
    assert len(eyes.step(OLDEST)) == 0
    standing = Eyes(other(3.0, 0.0, speed=0.0))
    assert np.allclose(standing.step(1.0), standing.seen), "a robot that cannot drive stays"
    assert len(Eyes(other(3.0, 0.0, age=OLDEST + 0.1)).seen) == 0


def test_what_is_too_uncertain_aside_behind_or_far_leaves_the_image_as_it_is():
    assert len(Eyes(other(1.5, 0.0)).seen) == 1
    for x, y, sigma in ((1.5, 0.0, 0.6), (1.5, 4.0, 0.02), (-1.5, 0.0, 0.02), (9.0, 0.0, 0.02)):
        assert len(Eyes(other(x, y, sigma)).seen) == 0
    assert len(Eyes(other(1.5, 0.0), other(3.0, 1.0)).seen) == 2


def test_half_of_the_image_is_left_whatever_a_server_says():
    claimed = [other(2.0, -1.0 + 0.125 * k, 0.05) for k in range(16)]
    regions = Eyes(*claimed).seen
    area = float(np.prod(regions[:, 2:] - regions[:, :2], axis=1).sum())
    assert 1 < len(regions) < 16 and area < 0.5 * CAMERA.width * CAMERA.height


def test_the_region_goes_with_the_robots_own_motion():
    turned = Eyes(other(2.0, 0.0, speed=0.0))
    (box,) = turned.step(0.1, Odometry(0.0, math.radians(10.0)))
    middle = CAMERA.project(np.array([2.0 * math.cos(-0.1745), 2.0 * math.sin(-0.1745), 0.1]))
    assert box[0] < middle[0] < box[2] and middle[0] > CAMERA.cx + 40
    nearer = Eyes(other(2.0, 0.0, speed=0.0))
    (box,) = nearer.step(0.1, Odometry(0.5, 0.0))
    (same,) = Eyes(other(1.5, 0.0, speed=0.0)).seen
    assert np.allclose(box, same)


def test_a_robot_behind_a_wall_is_hidden():
    def wall(x: float, count: int = 6) -> LandmarkEstimates:
        points = np.column_stack([np.full(count, x), np.linspace(-0.05, 0.05, count), np.full(count, 0.28)])
        return LandmarkEstimates(
            np.arange(count), points, np.zeros((count, 3, 3)), points[:, 0] - 0.05, np.full(count, 0.02)
        )

    eyes = Eyes(other(3.0, 0.0))
    assert len(eyes.step(landmarks=wall(1.0))) == 0
    assert len(eyes.step(landmarks=wall(1.0, count=2))) == 1, "two landmarks may be wrong"
    assert len(eyes.step(landmarks=wall(5.0))) == 1
    nowhere = wall(1.0)._replace(points_in_robot=np.full((6, 3), np.nan), depths=np.full(6, np.inf))
    assert len(eyes.step(landmarks=nowhere)) == 1


def test_it_asks_seldom_while_no_other_can_be_near():
    def due_after(eyes: Eyes) -> float:
        waited = 0.0
        while not eyes.others.due:
            eyes.step(0.1)
            waited += 0.1
        return waited

    assert due_after(Eyes(other(2.0, 0.0))) == pytest.approx(EVERY[0], abs=0.11)
    assert due_after(Eyes(other(6.2, 0.0))) == pytest.approx(2.0, abs=0.11), "1.2 m at 0.6 m/s"
    for none_near in (Eyes(), Eyes(other(60.0, 0.0))):
        assert due_after(none_near) == pytest.approx(EVERY[1], abs=0.11)
    lost = RobotsInView(BODY)
    lost.question(((NODE, Pose2()),), HERE)
    for tick in range(round((OVERDUE + EVERY[1]) * 10)):
        assert not lost.due
        lost.mark(Observation(tick * 100_000_000, Odometry(0.0, 0.0)), (), lambda: NO_LANDMARKS)
    lost.mark(
        Observation(round((OVERDUE + EVERY[1] + 0.2) * 1e9), Odometry(0.0, 0.0)), (), lambda: NO_LANDMARKS
    )
    assert lost.due, "the question was lost; another one may get through"


def test_a_node_has_no_landmark_where_another_robot_may_stand(node, walls, description):
    region = np.array([[60.0, 40.0, 200.0, 140.0]])

    def share(landmarks: Landmarks) -> float:
        inside = (landmarks.pixels >= region[0, :2]) & (landmarks.pixels <= region[0, 2:])
        return float(inside.all(axis=1).mean())

    class Marked(PhotoWalls):
        """The same walls; another robot may stand in the region."""

        def observe(self, before: Pose2, now: Pose2, tick: int) -> Observation:
            return replace(super().observe(before, now, tick), left_out=region)

    kept_out = Marked().mapped(Mapper(MapId("r0", 1), description))
    assert share(node.landmarks) > 0.2 and share(kept_out.landmarks) == 0.0
    assert len(kept_out.landmarks) > 0.8 * len(node.landmarks), "others take their place"


def test_the_pipeline_asks_once_it_is_on_its_map_and_marks_the_image(walls):
    pipeline = on(Explore())
    seen: list[Observation] = []
    mapper_step = pipeline.mapper.step
    pipeline.mapper.step = lambda observation: (seen.append(observation), mapper_step(observation))[1]  # type: ignore[method-assign]
    moved, pose, who = Odometry(0.0, 0.0), Pose2(), []
    answers: tuple[ServerAnswer, ...] = ()
    while len(seen) < 300 and (not who or answers):
        step = pipeline.step(
            Observation(len(seen) * 100_000_000, moved, walls.render(pose), rangers(pose)), answers
        )
        assert bool(len(seen[-1].left_out)) == bool(answers)
        answers = ()
        if asked := [question for question in step.questions if isinstance(question, WhoIsNear)]:
            who += asked
            answers = (ServerAnswer(NUMBER, NearbyAnswer((other(1.6, 0.0, 0.01),))),)
        moved = Odometry(step.command.forward * BODY.tick, step.command.turn * BODY.tick)
        pose = pose @ moved.motion()
    ((nearest, node_from_robot), *_) = who[0].starts
    assert nearest in pipeline.map.nodes
    there = pipeline.map.nodes[nearest].map_from_robot.mean @ node_from_robot
    assert there.distance(pipeline.mapper.map_from_robot.mean) < 0.05


def test_a_robot_beside_this_one_is_named():
    eyes = Eyes(other(0.5, 0.0), replace(other(0.4, -0.4), robot="r2"), replace(other(3.0, 0.0), robot="r3"))

    def words() -> str:
        return eyes.others.beside.words if eyes.others.beside is not None else ""

    assert words() == f"r1 is {0.5 - BODY.radius - 0.16:.1f} m off"
    assert eyes.others.beside is not None
    assert (eyes.others.beside.x, eyes.others.beside.y) == pytest.approx((0.5, 0.0))
    eyes.step(0.5, Odometry(0.0, math.pi / 2))
    assert (eyes.others.beside.x, eyes.others.beside.y) == pytest.approx((0.0, -0.5)), "on its right now"
    assert words().startswith("r1 is"), "turning changes no distance"
    eyes.step(0.5, Odometry(-2.0, 0.0))
    assert words() == ""
    eyes.step(0.5, Odometry(2.0, 0.0))
    assert words().startswith("r1 is")
    eyes.step(OLDEST)
    assert words() == "", "what is old is not said"
