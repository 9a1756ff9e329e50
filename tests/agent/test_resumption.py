"""How a robot looks for a place of its own map, on photographs hung on walls."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
import skimage.data

from agent.mapper import Mapper
from agent.observation import Command, Observation, Odometry, RobotDescription
from agent.resumption import Resumption, ResumptionSettings
from agent.vision.lens import Lens
from agent.vision.sift import Sift
from hybridmap.camera import Camera
from hybridmap.change import NodePut
from hybridmap.hybrid_map import HybridMap
from hybridmap.node import MapId, NodeId
from hybridmap.pose import Pose2, PoseGaussian

BEARINGS = tuple(np.linspace(-math.pi, math.pi, 16, endpoint=False).tolist())
BODY = RobotDescription(
    Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3), ranger_bearings=BEARINGS, ranger_reach=3.0
)
QUICK = ResumptionSettings(turns=(1, 1), places=2)
FREE = np.full(len(BEARINGS), 3.0)


@pytest.fixture(scope="module")
def own_map(walls) -> HybridMap:
    """A node at the world's origin, from a drive of half a metre and back."""
    mapper = Mapper(MapId("r0", 1), BODY)
    there = np.arange(0.0, 0.5, 0.025)
    before = Pose2()
    for tick, x in enumerate([*there, *there[::-1]]):
        observation = walls.observe(before, Pose2(x), tick)
        mapper.step(observation)
        if not mapper.started:
            mapper.begin(observation)
        before = Pose2(x)
    mapper.finish(observation)
    assert len(mapper.map.nodes) == 1
    return mapper.map


@pytest.fixture(scope="module")
def cat() -> np.ndarray:
    """A view that is on no map."""
    return cv2.resize(cv2.cvtColor(skimage.data.chelsea(), cv2.COLOR_RGB2GRAY), (320, 240))


@dataclass
class Search:
    """A resumption and the body that does what it is told.

    Attributes:
        resumption: it.
        pose: true posture of the body.
        commands: all so far.
        said: its details, without repetitions.
    """

    resumption: Resumption
    pose: Pose2
    commands: list[Command]
    said: list[str]


def search(
    own_map: HybridMap,
    start: Pose2,
    image: Callable[[Pose2], np.ndarray | None],
    ticks: int,
    drives: bool = True,
    settings: ResumptionSettings = QUICK,
    proximity: np.ndarray = FREE,
    body: RobotDescription = BODY,
) -> Search:
    """Let a body search until it has found itself, or is lost, or the time is over."""
    sift = Sift(Lens(body))
    state = Search(Resumption(body, sift, own_map, drives, settings), start, [], [])
    moved = Odometry(0.0, 0.0)
    for tick in range(ticks):
        observation = Observation(tick * 100_000_000, moved, image(state.pose), proximity)
        command = state.resumption.step(observation)
        state.commands.append(command)
        if not state.said or state.said[-1] != state.resumption.detail:
            state.said.append(state.resumption.detail)
        if state.resumption.found is not None or state.resumption.lost:
            break
        moved = Odometry(command.forward * body.tick, command.turn * body.tick)
        state.pose = state.pose @ moved.motion()
    return state


@pytest.mark.parametrize("away", [0.1, 2.2, -2.2, math.pi])
def test_it_turns_until_it_recognises_a_place(walls, own_map, away):
    """It starts with its back to the pictures, so it turns in steps and stands still at each look."""
    end = search(own_map, Pose2(0.1, 0.0, away), walls.render, 400)
    found = end.resumption.found
    assert found is not None
    assert found.recognition.node_from_robot.mean.distance(end.pose) < 0.05
    assert abs((found.recognition.node_from_robot.mean.inverse() @ end.pose).heading) < 0.03
    assert end.commands[-1] == Command()
    assert all(command.forward == 0.0 for command in end.commands)
    assert end.resumption.odom_from_robot.distance(Pose2()) < 1e-6
    # The rangers' readings are kept with the postures from which they were taken.
    assert len(end.resumption.seen) == len(end.commands)
    odom_from_robot, _ = end.resumption.seen[-1]
    assert (Pose2(0.1, 0.0, away) @ odom_from_robot).distance(end.pose) < 1e-6


def test_where_nothing_is_recognised_it_looks_elsewhere_and_gives_up(own_map, cat):
    readings = np.full(len(BEARINGS), 0.05)
    readings[1:8] = 2.0
    end = search(own_map, Pose2(), lambda pose: cat, 1000, proximity=readings)
    assert end.resumption.lost
    assert end.resumption.found is None
    assert end.said[-1] == "cannot find itself on its own map of 1 nodes: nothing was recognised at 2 places"
    assert "none of 1 nodes is recognised" in end.said
    turned = sum(command.turn for command in end.commands) * BODY.tick
    assert turned > 2 * math.tau - 1.6, "a whole turn at each place, less that toward the way"
    # The rangers turn with the body in this test, so what it sees ahead after the turn stops it at once.
    assert "moving on to look from elsewhere" in end.said


def test_it_drives_to_where_there_is_room(own_map, cat):
    end = search(own_map, Pose2(), lambda pose: cat, 1000)
    way = sum(command.forward for command in end.commands) * BODY.tick
    assert way == pytest.approx(QUICK.move, abs=0.05)


@pytest.mark.parametrize(
    ("proximity", "body"),
    [
        (np.full(len(BEARINGS), 0.2), BODY),
        (np.zeros(0), replace(BODY, ranger_bearings=(), ranger_reach=0.0)),
    ],
    ids=["no room", "no rangers"],
)
def test_without_room_that_it_can_see_it_stays(own_map, cat, proximity, body):
    end = search(own_map, Pose2(), lambda pose: cat, 1000, proximity=proximity, body=body)
    assert end.resumption.lost
    assert "nothing was recognised at 1 place" in end.said[-1]
    assert all(command.forward == 0.0 for command in end.commands)


@pytest.mark.parametrize("image", [None, np.full((240, 320), 60, np.uint8)], ids=["none", "grey"])
def test_with_a_covered_lens_it_is_never_lost(own_map, image):
    end = search(own_map, Pose2(), lambda pose: image, 320)
    assert not end.resumption.lost
    assert end.said[-1] in ("no image from the camera", "only 0 features in view")
    assert all(command.forward == 0.0 for command in end.commands)


def test_a_carried_robot_waits(walls, own_map, cat):
    there = iter([*[math.pi] * 20, *[0.0] * 20])
    end = search(own_map, Pose2(), lambda pose: walls.render(Pose2(0.1, 0, next(there))), 40, drives=False)
    assert end.resumption.found is not None
    assert len(end.commands) > 20
    assert set(end.commands) == {Command()}
    assert end.said[0].startswith("waiting to recognise a place of its own map: only")


def test_a_carried_robot_gives_up_in_the_end(own_map, cat):
    patience = ResumptionSettings(carried_looks=5)
    end = search(own_map, Pose2(), lambda pose: cat, 1000, drives=False, settings=patience)
    assert end.resumption.lost
    assert "nothing was recognised in 5 images" in end.said[-1]
    assert len(end.commands) == pytest.approx(5 * patience.carried_pause / BODY.tick, abs=6)


@pytest.mark.parametrize(("apart", "believed"), [(9.0, False), (0.1, True)])
def test_two_places_that_look_the_same_are_neither(walls, own_map, apart, believed):
    """Each of two nodes knows every second landmark; only where they are differs."""
    (node,) = own_map.nodes.values()
    every = np.arange(len(node.landmarks))
    there = PoseGaussian(Pose2(apart), node.map_from_robot.covariance)
    one = replace(node, landmarks=node.landmarks.take(every % 2 == 0))
    two = replace(
        node, id=NodeId("r0", 1, 99), map_from_robot=there, landmarks=node.landmarks.take(every % 2 == 1)
    )
    end = search(HybridMap([NodePut(one), NodePut(two)]), Pose2(0.1), walls.render, 3)
    assert (end.resumption.found is not None) == believed
    assert ("look the same" in end.said[-1]) == (not believed)


def test_a_recognition_that_is_not_exact_is_not_believed(walls, own_map):
    strict = replace(QUICK, sure=(1e-5, 1e-5))
    end = search(own_map, Pose2(0.1), walls.render, 3, settings=strict)
    assert end.resumption.found is None
    assert end.said[-1] == "node r0.1.1 is in view, but too far off"


def test_the_same_observations_give_the_same_search(walls, own_map):
    one, two = (search(own_map, Pose2(0.1, 0.0, 2.0), walls.render, 300) for _ in range(2))
    assert one.commands == two.commands
    assert one.said == two.said
    assert one.resumption.found is not None
    assert two.resumption.found is not None
    first, second = (end.resumption.found.recognition.node_from_robot for end in (one, two))
    assert first.mean == second.mean
    assert np.array_equal(first.covariance, second.covariance)
