"""The whole pipeline on photographs hung on walls: the same again, without any of its inputs, and safe."""

import math
from dataclasses import replace

import numpy as np
import pytest

from mapweave import Command, Edge, EdgeKind, NodeId, Observation, Odometry, Pose2, PoseGaussian
from mapweave.agent.global_localization import pose_consistency
from mapweave.agent.localization.fix import Fix
from mapweave.agent.mission import Carried, Driven, Explore, GoTo, Idle, WhereAmI, WhoIsNear
from mapweave.agent.pipeline import Pipeline, TickResult
from mapweave.agent.settings import AgentSettings, NavigatorSettings
from mapweave.hybridmap.change import NodePut
from mapweave.vision.equidistant import Equidistant
from mapweave.vision.lens import Lens
from mapweave.wire.codec import encode_body
from tests.agent.ranged_body import BEARINGS, BODY, MAP, ROOM, essence, live, on, rangers, still

# The same again


@pytest.fixture(scope="module")
def explored(walls):
    """A pipeline after 15 seconds of exploration."""
    pipeline = on(Explore())
    return pipeline, live(walls, pipeline, 150)


@pytest.fixture(scope="module")
def drive(explored):
    """What it saw, decided and did."""
    return explored[1]


def test_exploration_maps_and_stays_in_the_room(drive):
    _, steps, poses = drive
    nodes = [change.node for step in steps for change in step.changes if isinstance(change, NodePut)]
    assert len(nodes) >= 2
    for node in nodes:
        true = Pose2() if not node.stamp_ns else poses[node.stamp_ns // 100_000_000 - 1]
        assert node.map_from_robot.mean.distance(true) < 0.03
    x, y = np.array([[p.x, p.y] for p in poses]).T
    assert x.max() - x.min() > 0.3
    gap = np.min([x - ROOM[0], ROOM[1] - x, y - ROOM[2], ROOM[3] - y])
    assert gap > BODY.radius, "it never touched what only its rangers see"
    assert steps[-1].status.nodes == len(nodes)


def test_the_same_observations_give_the_same_steps(drive):
    observations, steps, _ = drive
    again = on(Explore())
    for observation, step in zip(observations, steps, strict=True):
        assert essence(again.step(observation)) == essence(step)
    assert sum(len(step.changes) for step in steps) >= 3
    assert len({step.command for step in steps}) > 10


def test_behind_a_fisheye_the_camera_is_a_pinhole(drive):
    observations, _, _ = drive
    lens = Equidistant(115.0, 115.4, 158.6, 120.9, (-0.02, 0.004, -0.003, 0.0005))
    ideal = lens.ideal(320, 240, 0.3)
    fisheye = on(Carried(), body=replace(BODY, camera=ideal, distortion=lens))
    pinhole = on(Carried(), body=replace(BODY, camera=ideal))
    for observation in observations[:40]:
        image = Lens(ideal, lens).rectified(observation.image)
        step = fisheye.step(observation)
        assert essence(step) == essence(pinhole.step(replace(observation, image=image)))
    assert step.status.tracked > 10


def test_observations_are_not_modified(drive):
    observations, _, _ = drive
    pipeline = on(Explore())
    for observation in observations[:20]:
        image, proximity = observation.image.copy(), observation.proximity.copy()
        image.flags.writeable = proximity.flags.writeable = False
        pipeline.step(Observation(observation.stamp_ns, observation.odometry, image, proximity))
        assert np.array_equal(image, observation.image)
        assert np.array_equal(proximity, observation.proximity)


def test_the_map_is_the_replay_of_the_changes(explored):
    pipeline, (_, steps, _) = explored
    changes = [encode_body(change) for step in steps for change in step.changes]
    assert changes
    assert sorted(changes) == sorted(encode_body(body) for body in pipeline.map.contents())


# Something is missing


@pytest.mark.parametrize("mission", [Idle(), Explore(), Carried(), GoTo(NodeId("r1", 1, 1))])
def test_a_robot_without_a_camera_stops_and_reports_why(mission):
    pipeline = on(mission)
    for tick in range(40):
        step = pipeline.step(Observation(tick * 100_000_000, Odometry(0.0, 0.0), None, rangers(Pose2())))
        assert step.changes == step.questions == ()
        assert step.command == Command() or (isinstance(mission, GoTo) and tick < 10)
        assert step.command.forward == 0.0, "a lost robot may begin to turn"
    missing = "the camera gives no image: is it connected?"
    words = {
        Idle: f"no mission; {missing}",
        Explore: f"no nodes yet: {missing}",
        Carried: f"no nodes yet: no image yet; {missing}",
        GoTo: missing,
    }
    assert step.status.detail == words[type(mission)]


def test_a_camera_that_fails_now_and_then(walls):
    """Every third frame is missing: it drives by the wheels meanwhile and still makes a good node."""
    pipeline = on(Carried())
    before = Pose2()
    xs = [*np.arange(0.0, 0.7, 0.02)]
    for tick, x in enumerate(xs):
        observation = walls.observe(before, Pose2(x), tick)
        if tick % 3 == 1:
            observation = Observation(observation.stamp_ns, observation.odometry, None)
        step = pipeline.step(observation)
        before = Pose2(x)
    assert step.status.nodes >= 1
    assert step.status.map_from_robot.distance(Pose2(xs[-1])) < 0.02


def test_images_without_features_make_no_node_and_are_reported():
    pipeline = on(Carried())
    grey = np.full((240, 320), 100, np.uint8)
    for tick in range(10):
        step = pipeline.step(Observation(tick, Odometry(0.05, 0.0), grey))
    assert step.status.detail == "no nodes yet: only 0 features in view; no landmark in view"
    assert step.status.nodes == 0


def test_until_the_first_node_the_reason_is_reported(walls):
    pipeline = on(Carried())
    before, lines = Pose2(), []
    for tick, x in enumerate(np.arange(0.0, 0.8, 0.025)):
        status = pipeline.step(walls.observe(before, Pose2(x), tick)).status
        assert status.detail.startswith("no nodes yet: ") == (status.nodes == 0)
        lines.append(status.nodes)
        before = Pose2(x)
    assert lines[0] == 0
    assert lines[-1] >= 1


# Missions


def test_without_a_mission_it_stands_still(walls):
    pipeline = Pipeline(MAP, BODY)
    assert pipeline.mission == Idle()
    for tick in range(5):
        step = pipeline.step(still(walls, tick=tick, proximity=np.full(len(BEARINGS), 3.0)))
        assert step.command == Command()
        assert step.changes == ()
    assert (step.status.doing, step.status.mission) == ("idle", "idle")


def test_a_mission_can_be_changed_at_any_time(walls, drive):
    pipeline = on(Explore())
    live(walls, pipeline, 30)
    pipeline.set_mission(Idle())
    step = pipeline.step(still(walls, tick=31))
    assert step.command == Command()
    assert step.status.mission == "idle"
    pipeline.set_mission(GoTo(NodeId("r1", 1, 1)))
    step = pipeline.step(still(walls, tick=32))
    assert step.status.mission == "goto"
    assert step.status.doing == "turning to localize"
    # There is no map yet that it could have been carried away from: it begins one here.
    pipeline.set_mission(Carried())
    step = pipeline.step(still(walls, tick=33))
    assert step.status.mission == "carried"
    assert "no nodes yet" in step.status.detail


def test_a_robot_that_was_stopped_on_its_way_says_where_it_stands(walls):
    """Others are led around it: before, a robot without a mission was nowhere."""
    pipeline, node = on(GoTo(NodeId("r2", 1, 1))), NodeId("r2", 1, 7)

    def asked(tick: int, lifted: bool = False) -> list[tuple[int, WhoIsNear]]:
        odometry = Odometry(0.02 if tick % 2 else 0.0, 0.0)
        image = walls.render(Pose2(1.0, 2.0))
        observation = Observation(
            tick * 100_000_000, odometry, image, np.full(len(BEARINGS), 3.0), kidnapped=lifted
        )
        questions = pipeline.step(observation).questions
        return [(tick, question) for question in questions if isinstance(question, WhoIsNear)]

    pipeline._navigator.fix = Fix(node, PoseGaussian(Pose2(1.0, 0.5), 1e-4 * np.eye(3)))
    pipeline.set_mission(Idle())
    questions = [question for tick in range(100) for question in asked(tick)]
    assert len(questions) >= 2, "it goes on asking who is near"
    for tick, question in questions:
        ((start, pose),) = question.starts
        assert start == node
        assert pose.x == pytest.approx(1.0 + 0.01 * tick, abs=0.03), "its wheels know how it is pushed"
    assert [question for tick in range(100, 200) for question in asked(tick, lifted=True)] == []


def test_a_robot_that_was_stopped_while_it_mapped_says_where_it_stands(walls):
    """Before, it was nowhere on the page from the moment on in which a person stopped it."""
    pipeline = on(Explore())
    _, begun, poses = live(walls, pipeline, 120)
    assert begun[-1].status.located and begun[-1].status.nodes
    pipeline.set_mission(Idle())
    last = Odometry(begun[-1].command.forward * BODY.tick, begun[-1].command.turn * BODY.tick)
    for tick in range(5):
        moved = Odometry(0.0, 0.0) if tick else last
        step = pipeline.step(
            Observation((120 + tick) * 100_000_000, moved, walls.render(poses[-1]), rangers(poses[-1]))
        )
    assert step.status.located and step.status.map_from_robot.distance(poses[-1]) < 0.03
    assert pipeline.map_from_robot.mean == step.status.map_from_robot
    lifted = replace(still(walls, poses[-1], 126), kidnapped=True)
    assert not pipeline.step(lifted).status.located and pipeline.map_from_robot is None


def test_exploration_that_was_interrupted_goes_on(walls, drive):
    """The robot stops for a while in the middle of its first drive; the rest is as without the stop."""
    _, steps, _ = drive
    pipeline = on(Explore())
    _, begun, poses = live(walls, pipeline, 25)
    assert [essence(s) for s in begun] == [essence(s) for s in steps[:25]]
    pipeline.set_mission(Idle())
    stopped = poses[-1]
    last = Odometry(begun[-1].command.forward * BODY.tick, begun[-1].command.turn * BODY.tick)
    for tick in range(10):
        moved = Odometry(0.0, 0.0) if tick else last
        pipeline.step(Observation((25 + tick) * 100_000_000, moved, walls.render(stopped), rangers(stopped)))
    pipeline.set_mission(Explore())
    step = pipeline.step(still(walls, stopped, 40, proximity=rangers(stopped)))
    assert step.status.doing == begun[-1].status.doing
    assert step.status.map_from_robot.distance(stopped) < 0.02


def moved_between(walls, mission) -> list[tuple[Edge, Pose2]]:
    """Mapping, then another mission while the robot is turned, pushed and turned back, then mapping.

    Returns:
        Edges and what they should be.
    """
    xs = np.arange(-1.0, -0.3, 0.025)
    truth = [Pose2(x) for x in xs]
    truth += [truth[-1] @ Pose2(0.0, 0.0, 0.1 * k) for k in range(1, 26)]
    truth += [truth[-1] @ Pose2(0.05 * k) for k in range(1, 9)]
    truth += [truth[-1] @ Pose2(0.0, 0.0, -0.1 * k) for k in range(1, 26)]
    between = range(len(xs), len(truth))
    truth += [truth[-1] @ Pose2(0.025 * k) for k in range(1, 40)]
    pipeline, before = on(Carried()), truth[0]
    for tick, pose in enumerate(truth):
        if tick in (between.start, between.stop):
            pipeline.set_mission(mission if tick == between.start else Carried())
        pipeline.step(walls.observe(before, pose, tick))
        before = pose
    when = {node.id: truth[node.stamp_ns // 100_000_000] for node in pipeline.map.nodes.values()}
    assert len(when) >= 3
    return [(edge, when[edge.a].inverse() @ when[edge.b]) for edge in pipeline.map.edges.values()]


def test_motion_without_a_mission_is_kept(walls):
    edges = [pair for pair in moved_between(walls, Idle()) if pair[0].kind is not EdgeKind.LOOP]
    assert len(edges) >= 2
    for edge, true in edges:
        assert edge.a_from_b.mean.distance(true) < 0.05


def test_a_robot_carried_off_before_the_first_node_restarts(walls):
    """There is no map yet to look on; what is seen there is where the map begins."""
    pipeline, elsewhere = on(Carried()), np.rot90(still(walls).image, 2)
    for tick in range(60):
        image = still(walls).image if tick < 3 else elsewhere
        status = pipeline.step(Observation(tick * 100_000_000, Odometry(0.0, 0.0), image)).status
    assert status.doing == "mapping while carried" and status.tracked > 20


@pytest.mark.parametrize("start", [-0.3, 1.2], ids=["with nodes", "before the first node"])
def test_a_robot_carried_off_forgets_what_its_rangers_have_seen(walls, start):
    """Ultrasonic sensors, blind within 0.25 m: what reads 0 then may touch, wherever it was before."""
    pipeline, before, forward = on(Carried()), Pose2(start), Driven(Command(0.05))
    for tick, x in enumerate(np.arange(start, ROOM[1] - BODY.radius - 0.2, 0.025)):
        pose = Pose2(float(x))
        observation = walls.observe(before, pose, tick)
        sonar = np.where(rangers(pose) < 0.25, 0.0, rangers(pose))
        step = pipeline.step(replace(observation, proximity=sonar))
        before = pose
    assert sonar.min() == 0.0
    assert bool(step.status.nodes) == (start < 0.0)
    elsewhere = np.rot90(observation.image, 2)
    commands = []
    for k in range(40):
        still_there = Observation((tick + 1 + k) * 100_000_000, Odometry(0.0, 0.0), elsewhere, sonar)
        commands.append(pipeline.step(still_there, driven=forward).command.forward)
    assert commands[0] > 0.0, "the wall is known from farther off"
    assert commands[-1] == 0.0, "the robot knows nothing of where it is now"


def lift(walls, pipeline: Pipeline, tick: int) -> list[TickResult]:
    """A person lifts the robot, carries it, and puts it down where it sees something else."""
    away = Pose2(0.3, 0.0, math.pi)
    seen = [still(walls, tick=tick + k, kidnapped=True) for k in range(3)]
    seen += [still(walls, away, tick=tick + 3 + k) for k in range(2)]
    return [pipeline.step(observation) for observation in seen]


@pytest.mark.parametrize("mission", [Explore(), Carried()])
def test_a_robot_that_was_lifted_is_lost_once_it_is_put_down(walls, mission):
    pipeline = on(Carried())
    before = Pose2(-1.0)
    for tick, x in enumerate(np.arange(-1.0, -0.3, 0.025)):
        pipeline.step(walls.observe(before, Pose2(x), tick))
        before = Pose2(x)
    pipeline.set_mission(mission)
    elements = set(pipeline.map.nodes) | set(pipeline.map.edges)
    assert elements
    steps = lift(walls, pipeline, 100)
    assert [step.command for step in steps] == [Command()] * 5
    assert [step.status.doing for step in steps] == ["lifted"] * 5
    assert [step.status.lost for step in steps] == [False] * 3 + [True] * 2
    assert set(pipeline.map.nodes) | set(pipeline.map.edges) == elements
    # A person may know better.
    pipeline.set_mission(Carried())
    assert not pipeline.lost


def test_a_robot_that_was_lifted_before_the_first_node_maps_on(walls):
    pipeline = on(Carried())
    pipeline.step(still(walls))
    steps = lift(walls, pipeline, 1)
    assert steps[-1].status.doing == "mapping while carried"
    assert not pipeline.lost


def test_a_robot_that_was_lifted_on_its_way_asks_where_it_is(walls):
    pipeline = on(GoTo(NodeId("r1", 1, 1)))
    first = [question for tick in range(10) for question in pipeline.step(still(walls, tick=tick)).questions]
    steps = lift(walls, pipeline, 20)
    assert not any(step.questions for step in steps[:3])
    again = [q for tick in range(30, 40) for q in pipeline.step(still(walls, tick=tick)).questions]
    assert first
    assert again
    assert not pipeline.lost


def test_a_goal_that_was_given_up_stays_so_when_the_robot_is_lifted(walls):
    """Before, it drove on to a goal of which its record says that it was not reached."""
    settings = AgentSettings(navigation=NavigatorSettings(patience=0.5))
    pipeline = on(GoTo(NodeId("r1", 1, 1)), settings)
    steps = [pipeline.step(still(walls, tick=tick)) for tick in range(10)]
    assert steps[-1].status.given_up
    lift(walls, pipeline, 20)
    steps = [pipeline.step(still(walls, tick=tick)) for tick in range(30, 40)]
    assert all(step.status.given_up and step.command == Command() for step in steps)
    assert all(step.status.fix_node is None for step in steps)


# Questions


def test_a_lost_robot_asks_the_fleet(walls):
    pipeline = on(GoTo(NodeId("r1", 1, 1)))
    questions = []
    for tick in range(10):
        questions += pipeline.step(still(walls, tick=tick)).questions
    assert questions
    assert isinstance(questions[0], WhereAmI)
    assert len(questions[0].view) > 20


def test_a_late_answer_to_an_earlier_mission_is_none_to_this_one(walls):
    """Before, a route to the earlier goal was driven, and its end taken for the goal."""
    pipeline, numbers = on(GoTo(NodeId("r1", 1, 1))), list[int]()
    for tick in range(20):
        if tick == 10:
            pipeline.set_mission(GoTo(NodeId("r1", 1, 3)))
        numbers += [q.number for q in pipeline.step(still(walls, tick=tick)).questions if q.number > 0]
    assert len(numbers) >= 2 and len(set(numbers)) == len(numbers)


def test_seeds_choose_the_side():
    turns = set()
    for seed in range(6):
        pipeline = on(Explore(), AgentSettings(seed=seed))
        grey = np.full((240, 320), 100, np.uint8)
        for tick in range(3):
            step = pipeline.step(Observation(tick, Odometry(0.0, 0.0), grey, np.full(len(BEARINGS), 3.0)))
        turns.add(math.copysign(1.0, step.command.turn))
    assert turns == {1.0, -1.0}


@pytest.fixture
def near_views(monkeypatch) -> None:
    """All pictures hang in one direction, so views from places close to each other must do."""
    monkeypatch.setattr(pose_consistency, "OTHER_VIEW", (0.2, 0.9))


def carried_after_navigating(walls, places) -> tuple[Pipeline, set[NodeId], list[TickResult]]:
    """A robot that has mapped from x = -1.0 to -0.3 m, has a goal for a while, and then is carried on.

    Args:
        walls: the world.
        places: poses that it is carried through afterwards.

    Returns:
        The pipeline, what was in its map before, and the steps since.
    """
    pipeline, before = on(Carried()), Pose2(-1.0)
    for tick, x in enumerate(np.arange(-1.0, -0.3, 0.025)):
        pipeline.step(walls.observe(before, Pose2(x), tick))
        before = Pose2(x)
    elements = set(pipeline.map.nodes) | set(pipeline.map.edges)
    pipeline.set_mission(GoTo(NodeId("r1", 1, 1)))
    pipeline.step(still(walls, places[0], tick=100))
    pipeline.set_mission(Carried())
    steps, before = [], places[0]
    for tick, pose in enumerate(places, 101):
        steps.append(pipeline.step(walls.observe(before, pose, tick)))
        before = pose
    return pipeline, elements, steps


@pytest.mark.usefixtures("near_views")
def test_after_navigating_it_maps_on_once_it_recognises_a_place(walls):
    """It was carried 0.3 m further meanwhile, which the wheels do not know."""
    places = [Pose2(x) for x in np.arange(0.0, 0.9, 0.025)]
    pipeline, elements, _ = carried_after_navigating(walls, places)
    assert elements < set(pipeline.map.nodes)
    assert len(pipeline.map.components()) == 1
    first = min(node.number for node in elements)
    for node in pipeline.map.nodes.values():
        if node.id not in elements:
            true = places[node.stamp_ns // 100_000_000 - 101]
            from_start = pipeline.map.nodes[NodeId("r0", 1, first)].map_from_robot.mean.inverse()
            assert (from_start @ node.map_from_robot.mean).distance(Pose2(-1.0).inverse() @ true) < 0.05


@pytest.mark.usefixtures("near_views")
def test_it_does_not_map_on_after_navigating_to_an_unknown_place(walls):
    away = [Pose2(x, 0.0, math.pi) for x in np.arange(0.3, 0.9, 0.025)]
    pipeline, elements, steps = carried_after_navigating(walls, away)
    assert set(pipeline.map.nodes) | set(pipeline.map.edges) == elements
    assert all(step.changes == () for step in steps)
    assert "waiting to recognise a place of its own map: only 0 features" in steps[-1].status.detail
    assert not pipeline.lost
