"""How a robot looks for a place of its own map, in rooms of known landmarks."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from mapweave import Command, HybridMap, MapId, Observation, Odometry, RobotDescription
from mapweave.agent.global_localization.candidates import OwnMapSource
from mapweave.agent.global_localization.global_localization import MOVE, GlobalLocalization
from mapweave.agent.global_localization.pose_consistency import OTHER_VIEW
from mapweave.agent.global_localization.resumption import TO_MAP, Resumption, SearchPolicy
from mapweave.agent.motion_primitives import MotionPrimitives
from mapweave.hybridmap.change import NodePut
from mapweave.hybridmap.node import CODE_BYTES
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.vision.sift import Features
from synthetic.world import CAMERA, World, room, take_map, take_view

BEARINGS = tuple(np.linspace(-math.pi, math.pi, 16, endpoint=False).tolist())
BODY = RobotDescription(CAMERA, ranger_bearings=BEARINGS, ranger_reach=3.0)
QUICK = replace(TO_MAP, turns=(1, 1), places=2)
FREE = np.full(len(BEARINGS), 3.0)
PLACE = Pose2(2.5, 2.0)
HEADINGS = np.arange(0, math.tau, math.tau / 7)


@pytest.fixture(scope="module")
def home() -> World:
    """A room."""
    return room(0, 0, 5, 4, 900, np.random.default_rng(0))


@pytest.fixture(scope="module")
def elsewhere() -> World:
    """Another room, with other things in it."""
    return room(0, 0, 5, 4, 900, np.random.default_rng(1))


def map_of(world: World, tour: Iterable[Pose2]) -> HybridMap:
    """A map, almost without drift; its frame is that of the first node."""
    nodes, _ = take_map(
        world, MapId("r0", 1), list(tour), np.random.default_rng(2), sigma_xy=0.002, sigma_heading=0.002
    )
    return HybridMap([NodePut(node) for node in nodes])


@pytest.fixture(scope="module")
def own_map(home: World) -> HybridMap:
    """All around one place of the room; the map's frame stands there and looks along x."""
    return map_of(home, (PLACE @ Pose2(0, 0, heading) for heading in HEADINGS))


@dataclass
class Body:
    """A robot base that executes its commands, and the features that it sees: replaces Sift.

    Attributes:
        world: that it is in; None if its lens is covered.
        pose: `world_from_robot`.
        commands: all so far.
        said: what the resumption said, without repetitions.
    """

    world: World | None
    pose: Pose2
    commands: list[Command] = field(default_factory=list)
    said: list[str] = field(default_factory=list)
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(3))

    def extract(self, image: np.ndarray) -> Features:
        if self.world is None:
            return Features(
                np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, CODE_BYTES), np.uint8), np.zeros(0)
            )
        view, _ = take_view(self.world, self.pose, self.rng)
        pixels = view.pixels.astype(np.float64)
        return Features(pixels, pixels, view.codes, np.ones(len(view)))


def search(
    own_map: HybridMap,
    robot: Body,
    ticks: int = 1000,
    drives: bool = True,
    policy: SearchPolicy = QUICK,
    proximity: np.ndarray = FREE,
    description: RobotDescription = BODY,
    carry: Iterable[Pose2] = (),
    scale: float = 1.0,
    camera: bool = True,
) -> Resumption:
    """Let a body search until it has found itself, or is lost, or the time is over.

    Args:
        own_map: its map.
        robot: it.
        ticks: the time.
        drives: whether it may.
        policy: of the resumption.
        proximity: what its rangers read all the time.
        description: of the body.
        carry: where others put it, tick by tick; its wheels notice.
        scale: by how much too far they turn then.
        camera: whether there are images.
    """
    resumption = Resumption(description, robot, own_map, drives, policy=policy)  # type: ignore[arg-type]
    moved, path = Odometry(0.0, 0.0), iter(carry)
    for tick in range(ticks):
        image = np.zeros((240, 320), np.uint8) if camera else None
        command = resumption.step(Observation(tick * 100_000_000, moved, image, proximity))
        robot.commands.append(command)
        if not robot.said or robot.said[-1] != resumption.detail:
            robot.said.append(resumption.detail)
        if resumption.found is not None or resumption.lost:
            break
        there = next(path, None)
        if there is not None:
            step = robot.pose.inverse() @ there
            moved, robot.pose = Odometry(step.x, scale * step.heading), there
        else:
            moved = Odometry(command.forward * BODY.tick, command.turn * BODY.tick)
            robot.pose = robot.pose @ moved.motion()
    return resumption


def turned(robot: Body) -> float:
    """By how much a body has turned, rad."""
    return sum(abs(command.turn) for command in robot.commands) * BODY.tick


@pytest.mark.parametrize("heading", [0.1, 1.5, -2.0, math.pi])
def test_it_turns_until_two_views_agree_where_it_is(home, own_map, heading):
    start = PLACE @ Pose2(0.15, -0.1, heading)
    robot = Body(home, start)
    resumption = search(own_map, robot)
    result = resumption.found
    assert result is not None
    here = result.node.map_from_robot.mean @ result.recognition.node_from_robot.mean
    assert here.distance(PLACE.inverse() @ robot.pose) < 0.05
    assert abs(wrap_angle(here.heading - robot.pose.heading)) < 0.03
    assert robot.commands[-1] == Command()
    assert all(command.forward == 0.0 for command in robot.commands)
    assert OTHER_VIEW[1] <= turned(robot) < math.pi, "and no further than it needs"
    # The rangers' readings are kept with the poses from which they were taken.
    assert len(resumption.seen) == len(robot.commands)
    for odom_from_robot, _ in resumption.seen:
        assert odom_from_robot.distance(Pose2()) < 1e-9
    assert (start @ resumption.odom_from_robot).distance(robot.pose) < 1e-9
    assert abs(wrap_angle((start @ resumption.odom_from_robot).heading - robot.pose.heading)) < 1e-9


def test_a_twin_of_one_wall_is_not_enough(home, elsewhere, own_map):
    """In another room hangs what hangs on a part of a wall at home: one view is recognised, and no other."""
    on_wall = np.flatnonzero((home.points[:, 0] > 4.5) & (np.abs(home.points[:, 1] - 2.0) < 1.0))
    wall = World(home.points[on_wall], home.normals[on_wall], home.vectors[on_wall])
    other = np.flatnonzero(elsewhere.points[:, 0] < 4.5)
    rest = World(elsewhere.points[other], elsewhere.normals[other], elsewhere.vectors[other])
    robot = Body(wall + rest, PLACE)
    resumption = search(own_map, robot)
    assert resumption.found is None
    assert resumption.lost
    assert any("landmarks agree; another view must, too" in lines for lines in robot.said)
    assert robot.said[-1] == ("cannot localize on its own map of 7 nodes: no two views agreed at 2 places")


def test_without_recognition_it_searches_elsewhere_and_gives_up(elsewhere, own_map):
    robot = Body(elsewhere, PLACE)
    resumption = search(own_map, robot)
    assert resumption.lost
    assert resumption.found is None
    assert robot.said[-1] == ("cannot localize on its own map of 7 nodes: nothing was recognised at 2 places")
    assert "none of 7 nodes is recognised" in robot.said
    assert "nothing here is known: driving on to search from elsewhere" in robot.said
    assert turned(robot) > 2 * math.tau
    assert sum(c.forward for c in robot.commands) * BODY.tick == pytest.approx(MOVE, abs=0.05)


def test_it_turns_to_where_there_is_most_room(elsewhere, own_map):
    """Its rangers read the same after the turn, when what is near ahead stops it at once."""
    readings = np.full(len(BEARINGS), 0.05)
    readings[1:8] = 2.0
    robot = Body(elsewhere, PLACE)
    assert search(own_map, robot, proximity=readings).lost
    assert "nothing here is known: driving on to search from elsewhere" in robot.said
    to_the_way = -sum(min(command.turn, 0.0) for command in robot.commands) * BODY.tick
    assert to_the_way == pytest.approx(-BEARINGS[4], abs=0.1)
    assert all(command.forward == 0.0 for command in robot.commands)


@pytest.mark.parametrize(("proximity", "description"), [
    (np.full(len(BEARINGS), 0.2), BODY), (np.zeros(0), replace(BODY, ranger_bearings=(), ranger_reach=0.0)),
], ids=["no room", "no rangers"])  # fmt: skip
def test_without_room_that_it_can_see_it_stays(elsewhere, own_map, proximity, description):
    robot = Body(elsewhere, PLACE)
    assert search(own_map, robot, proximity=proximity, description=description).lost
    assert robot.said[-1].endswith("nothing was recognised at 1 place")
    assert all(command.forward == 0.0 for command in robot.commands)


@pytest.mark.parametrize("camera", [True, False])
def test_with_a_covered_lens_it_is_never_lost(own_map, camera):
    robot = Body(None, PLACE)
    assert not search(own_map, robot, camera=camera).lost
    assert robot.said == ["looking", "only 0 features in view" if camera else "no image from the camera"]
    assert all(command.forward == 0.0 for command in robot.commands)


def test_a_carried_robot_waits_until_it_has_seen_two_views(home, own_map):
    robot = Body(home, PLACE)
    path = [PLACE] * 20 + [PLACE @ Pose2(0.0, 0.0, 0.05 * k) for k in range(60)]
    resumption = search(own_map, robot, ticks=80, drives=False, carry=path)
    assert resumption.found is not None
    assert 20 < len(robot.commands) < 60
    assert set(robot.commands) == {Command()}
    assert robot.said[0].startswith("waiting to recognise a place of its own map: node")


def test_a_carried_robot_need_not_turn(home):
    tour = [Pose2(1.0 + 0.4 * k, 2.0) for k in range(5)]
    path = [Pose2(1.0 + 0.05 * k, 2.1) for k in range(50)]
    robot = Body(home, path[0])
    resumption = search(map_of(home, tour), robot, ticks=50, drives=False, carry=path)
    assert resumption.found is not None
    assert robot.pose.x - path[0].x >= OTHER_VIEW[0]


@pytest.mark.parametrize(("speed", "seconds"), [(0.0, 60.0), (0.1, 6.0)])
def test_a_drive_that_goes_on_is_not_awaited_for_long(elsewhere, own_map, speed, seconds):
    """A robot that stands has time; one that drives where nothing is known begins a new map soon."""
    path = [PLACE @ Pose2(0.1 * speed * k) for k in range(700)]
    robot = Body(elsewhere, PLACE)
    assert search(own_map, robot, drives=False, carry=path).lost
    assert BODY.tick * len(robot.commands) == pytest.approx(seconds, rel=0.15)


def test_a_carried_robot_gives_up_in_the_end(elsewhere, own_map):
    patience = replace(TO_MAP, carried_views=5)
    robot = Body(elsewhere, PLACE)
    assert search(own_map, robot, drives=False, policy=patience).lost
    assert robot.said[-1].endswith("nothing was recognised in 5 images")
    assert len(robot.commands) == pytest.approx(5 * patience.carried_pause / BODY.tick, abs=6)


@pytest.mark.parametrize(("apart", "counts"), [(9.0, False), (0.1, True)])
def test_neither_of_two_similar_places_is_accepted(home, own_map, apart, counts):
    """Each of two nodes knows every second landmark; only where they are differs."""
    node = next(iter(own_map.nodes.values()))
    every = np.arange(len(node.landmarks))
    there = replace(node.map_from_robot, mean=Pose2(apart))
    a = replace(node, landmarks=node.landmarks.take(every % 2 == 0))
    b = replace(
        node,
        id=node.id._replace(number=99),
        map_from_robot=there,
        landmarks=node.landmarks.take(every % 2 == 1),
    )
    robot = Body(home, PLACE)
    search(HybridMap([NodePut(a), NodePut(b)]), robot, ticks=3)
    assert ("look the same" in robot.said[-1]) == (not counts)
    assert ("another view must, too" in robot.said[-1]) == counts


def test_a_recognition_that_is_not_exact_does_not_count(home, own_map):
    robot = Body(home, PLACE)
    assert search(own_map, robot, ticks=150, policy=replace(QUICK, sure=(1e-5, 1e-5))).found is None
    assert any("is in view, but too far off" in lines for lines in robot.said)
    assert not any("landmarks agree" in lines for lines in robot.said)


@pytest.mark.parametrize(("scale", "believed"), [(1.03, True), (0.97, True), (1.4, False), (0.5, False)])
def test_views_agree_by_the_odometry_in_between(home, own_map, scale, believed):
    robot = Body(home, PLACE)
    path = [PLACE @ Pose2(0.0, 0.0, 0.05 * k) for k in range(80)]
    resumption = search(own_map, robot, ticks=80, drives=False, carry=path, scale=scale)
    assert (resumption.found is not None) == believed


def test_the_same_observations_give_the_same_search(home, own_map):
    changes = [Body(home, PLACE @ Pose2(0.2, 0.1, 2.0)) for _ in range(2)]
    a, b = (search(own_map, change) for change in changes)
    assert changes[0].commands == changes[1].commands
    assert changes[0].said == changes[1].said
    assert a.found is not None
    assert b.found is not None
    first, second = (result.recognition.node_from_robot for result in (a.found, b.found))
    assert first.mean == second.mean
    assert np.array_equal(first.covariance, second.covariance)


@pytest.mark.parametrize("direction", np.linspace(-2.9, 2.9, 11).tolist())
def test_it_drives_toward_what_it_has_recognised_wherever_that_is(own_map: HybridMap, direction: float):
    """Where nothing is near, no reading lies on a way between two rangers, and it drove somewhere else."""
    motion = MotionPrimitives(BODY)
    motion.take_in(Observation(0, Odometry(0.0, 0.0), proximity=FREE), ())
    localization = GlobalLocalization(
        BODY, Body(None, Pose2()), motion, OwnMapSource(own_map, np.random.default_rng(0)), QUICK  # type: ignore[arg-type]
    )  # fmt: skip
    node = Pose2(0.8 * math.cos(direction), 0.8 * math.sin(direction))
    localization._hint = 40, node
    move, moved = localization._move(), None
    while moved is None:
        try:
            command = next(move)
        except StopIteration as end:
            moved = end.value
            continue
        step = Odometry(0.1 * command.forward, 0.1 * command.turn)
        motion.take_in(Observation(0, step, proximity=FREE), ())
    assert moved and motion.odom_from_robot.distance(node) < 0.15
