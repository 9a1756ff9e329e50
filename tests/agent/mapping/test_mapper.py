"""The mapper on photographs hung on walls of known depth."""

import threading
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mapweave import HybridMap, MapId, Odometry, Pose2
from mapweave.agent.mapping import keyframe_builder
from mapweave.agent.mapping.mapper import Mapper
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.merge.mutual_exclusion.trajectories import runs_backwards
from mapweave.registration.selection import choose
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift


def drive(mapper, walls, positions, start=1):
    """Observe from each x position in turn; returns the last observation."""
    before = Pose2(positions[0])
    for tick, x in enumerate(positions, start):
        observation = walls.observe(before, Pose2(x), tick)
        mapper.step(observation)
        if not mapper.started:
            mapper.begin(observation)
        before = Pose2(x)
    return observation


def test_depths_of_a_node_are_those_of_the_walls(walls, description):
    mapper = Mapper(MapId("r0", 1), description)
    there = np.arange(0.0, 0.6, 0.025)
    last = drive(mapper, walls, [*there, *there[::-1]])
    assert mapper.take_changes() == ()
    mapper.finish(last)
    mapper.finish_pending()
    (node,) = mapper.map.nodes.values()
    assert mapper.take_changes() == (NodePut(node),)
    assert mapper.take_changes() == (), "each change leaves once"
    assert len(node.landmarks) > 30
    true = walls.depth_at(Pose2(), node.landmarks.pixels)
    error = np.abs(node.landmarks.depths - true) / true
    assert np.median(error) < 0.02
    # Landmarks at the edge between the walls may be attributed to either.
    assert np.mean(error < 0.08) > 0.9


def test_an_edge_is_the_drive_between_two_views(walls, description):
    mapper = Mapper(MapId("r0", 1), description)
    first = drive(mapper, walls, list(np.arange(0.0, 0.51, 0.025)))
    mapper.finish(first)
    mapper.finish_pending()
    second = drive(mapper, walls, list(np.arange(0.5, 0.91, 0.025)), start=50)
    mapper.finish(second)
    mapper.finish_pending()
    (edge,) = mapper.map.edges.values()
    a, b = mapper.map.nodes[edge.a], mapper.map.nodes[edge.b]
    assert abs(edge.a_from_b.mean.x - 0.5) < 0.01
    assert abs(edge.a_from_b.mean.y) < 0.01
    assert edge.a_from_b.mahalanobis2(Pose2(0.5)) < 16.3  # 99.9 % of chi-square with 3 degrees of freedom
    assert len(edge.shared) > 15
    # A shared landmark is the same physical point in both nodes.
    in_a = a.points_in_robot[edge.shared[:, 0]]
    in_b = Pose2(0.5).apply(b.points_in_robot[edge.shared[:, 1]])
    assert np.median(np.linalg.norm(in_a - in_b, axis=1)) < 0.08


def test_what_is_left_of_an_episode_is_made_at_the_end_of_the_process(walls, description):
    """A node of a further view follows in the next tick; before, a process that ended then lost it."""
    mapper = Mapper(MapId("r0", 1), description)
    there = np.arange(0.0, 0.6, 0.025)
    last = drive(mapper, walls, there)
    mapper.add_view(last)
    last = drive(mapper, walls, there[::-1], start=50)
    mapper.finish(last)
    assert mapper.take_changes() == (), "no tick does all of it"
    mapper.step(replace(last, odometry=Odometry(0.0, 0.0)))
    (node,) = mapper.map.nodes.values()
    assert mapper.take_changes() == (NodePut(node),)
    mapper.finish_pending()
    _, beside = mapper.map.nodes.values()
    (edge,) = mapper.map.edges.values()
    assert mapper.take_changes() == (NodePut(beside), EdgePut(edge))
    assert edge.a_from_b.mean.x == pytest.approx(0.575, abs=0.02)
    mapper.finish_pending()
    assert mapper.take_changes() == ()


def test_the_tick_that_ends_an_episode_leaves_its_landmarks_to_the_next(walls, description, monkeypatch):
    """That tick waits for the features of the image; with the landmarks it was the longest of all."""
    mapper, chosen = Mapper(MapId("r0", 1), description), 0

    def counting(*arguments: object) -> object:
        nonlocal chosen
        chosen += 1
        return choose(*arguments)

    monkeypatch.setattr(keyframe_builder, "choose", counting)
    last = drive(mapper, walls, np.arange(0.0, 0.6, 0.025))
    assumed = mapper.typical_depth
    mapper.finish(last)
    assert (chosen, mapper.typical_depth) == (0, assumed)
    assert mapper.map_from_robot.mean.x == pytest.approx(0.575, abs=0.02), "the pose waits for nothing"
    mapper.step(replace(last, odometry=Odometry(0.0, 0.0)))
    (node,) = mapper.map.nodes.values()
    assert chosen == 1
    assert mapper.typical_depth == np.median(node.landmarks.depths)


def test_no_tick_waits_for_features_that_are_not_asked_for(walls, description, monkeypatch):
    """It takes as long to extract them as to do the rest of that tick."""
    mapper, may_go_on, extract = Mapper(MapId("r0", 1), description), threading.Event(), Sift.extract
    last = drive(mapper, walls, np.arange(0.0, 0.6, 0.025))
    assert mapper.anchored < mapper.anchor_features

    def held(*arguments: object) -> object:
        assert may_go_on.wait(20.0), "the tick waits for the features"
        return extract(*arguments)

    monkeypatch.setattr(Sift, "extract", held)
    mapper.finish(last)
    assert mapper.tracked > 0
    assert mapper.health == ""
    may_go_on.set()
    assert mapper.anchored == mapper.anchor_features, "the next anchor's, as soon as they are asked for"


@pytest.mark.parametrize("asking", ["anchored", "anchor_features", "bearings"])
def test_a_map_is_the_same_when_features_of_the_next_anchor_are_asked_for(walls, description, asking):
    """In the tick that ends an episode, or not before they are used; at the end of the process as well."""
    maps = []
    for asks in (True, False):
        mapper = Mapper(MapId("r0", 1), description)
        for start, stretch in enumerate((np.arange(0.0, 0.5, 0.025), np.arange(0.475, 0.9, 0.025))):
            last = drive(mapper, walls, stretch, 1 + 50 * start)
            mapper.finish(last)
            if asks:
                assert np.size(getattr(mapper, asking)) > 0
        mapper.finish_pending()
        maps.append((mapper.map, mapper.anchored, mapper.map_from_robot))
    (one, anchored, pose), (other, other_anchored, other_pose) = maps
    assert len(one.nodes) == len(other.nodes) == 2
    assert (anchored, pose.mean) == (other_anchored, other_pose.mean)
    for a, b in zip(one.nodes.values(), other.nodes.values(), strict=True):
        assert a.map_from_robot.mean == b.map_from_robot.mean
        assert np.array_equal(a.landmarks.codes, b.landmarks.codes)
        assert np.array_equal(a.landmarks.depths, b.landmarks.depths)
    for edge, its_twin in zip(one.edges.values(), other.edges.values(), strict=True):
        assert edge.a_from_b.mean == its_twin.a_from_b.mean
        assert np.array_equal(edge.shared, its_twin.shared)


@pytest.mark.parametrize("forward", [0.3, -0.2])
def test_a_camera_found_further_ahead_moves_the_robot_and_no_landmark(walls, description, forward):
    """Before, the robot stayed where it was, and so the walls moved by as much."""
    mapper = Mapper(MapId("r0", 1), description)
    first = drive(mapper, walls, list(np.arange(0.0, 0.51, 0.025)))
    mounted = description.camera.mount_forward + forward
    known = replace(description, camera=replace(description.camera, mount_forward=mounted))
    mapper.recalibrate(known, Lens(known.camera, known.distortion), Pose2(-forward))
    mapper.finish(first)
    mapper.finish_pending()
    assert mapper.map_from_robot.mean.x == pytest.approx(0.5 - forward, abs=0.01)
    second = drive(mapper, walls, list(np.arange(0.5, 0.91, 0.025)), start=50)
    mapper.finish(second)
    mapper.finish_pending()
    a, b = mapper.map.nodes.values()
    assert b.map_from_robot.mean.distance(Pose2(0.5 - forward)) < 0.015
    (edge,) = mapper.map.edges.values()
    assert edge.a_from_b.mean.distance(Pose2(0.5 - forward)) < 0.015
    near = [
        np.median(node.map_from_robot.mean.apply(node.points_in_robot[left])[:, 0])
        for node in (a, b)
        for left in [node.landmarks.pixels[:, 0] < 100]
    ]
    assert near[0] == pytest.approx(near[1], abs=0.05)


@pytest.mark.parametrize("old_from_new", [Pose2(-0.3), Pose2(-0.1, 0.0, 0.05)])
def test_a_camera_found_elsewhere_leaves_the_way_without_a_jump(walls, description, old_from_new):
    """An axle goes straight ahead all along, whatever is found out about the camera above it."""
    mapper = Mapper(MapId("r0", 1), description)
    positions, way = list(np.arange(0.0, 0.51, 0.025)), []
    for tick, x in enumerate(positions, 1):
        last = drive(mapper, walls, [max(x - 0.025, 0.0), x], start=2 * tick)
        way.append(mapper.map_from_robot.mean)
    assert mapper.take_way_moved() is None
    mapper.recalibrate(description, Lens(description.camera, description.distortion), old_from_new)
    assert mapper.take_way_moved() is None, "it is put to use at the end of the episode"
    mapper.finish(last)
    moved, here = mapper.take_way_moved(), mapper.map_from_robot.mean
    assert moved is not None and mapper.take_way_moved() is None
    assert here.distance(way[-1]) > 0.09, "the camera keeps its place, so the axle has another"
    for pose, x in zip(way, positions, strict=True):
        seen = here.inverse() @ moved.apply(pose)
        assert seen.distance(Pose2(x - positions[-1])) < 0.015
        assert seen.heading == pytest.approx(0.0, abs=0.02)


def test_wheels_that_went_less_far_than_they_said_make_the_whole_map_smaller(walls, description):
    """Against the same drive, whose wheels were right: the map and the way are those of that drive."""
    maps, ways = [], []
    for assumed in (1.0, 1.1):
        mapper, way = Mapper(MapId("r0", 1), description), []
        for start, stretch in enumerate((np.arange(0.0, 0.5, 0.025), np.arange(0.475, 0.9, 0.025))):
            for tick, (before, x) in enumerate(pairwise(stretch), 2 + 50 * start):
                observation = walls.observe(Pose2(before), Pose2(x), tick)
                wheels = replace(observation.odometry, forward=assumed * observation.odometry.forward)
                last = replace(observation, odometry=wheels)
                mapper.step(last)
                if not mapper.started:
                    mapper.begin(last)
                way.append(mapper.map_from_robot.mean)
            if start:
                mapper.recalibrate(
                    description, Lens(description.camera, description.distortion), Pose2(), 1.0 / assumed
                )
            mapper.finish(last)
        mapper.finish_pending()
        moved = mapper.take_way_moved()
        here = mapper.map_from_robot.mean
        maps.append(HybridMap(mapper.take_changes()))
        ways.append([here.inverse() @ moved.apply(pose) for pose in way])
    true, found = maps
    assert found.nodes.keys() == true.nodes.keys() and len(true.nodes) == 2
    assert found.edges.keys() == true.edges.keys()
    for key, edge in true.edges.items():
        assert found.edges[key].a_from_b.mean.distance(edge.a_from_b.mean) < 0.01
        assert np.array_equal(found.edges[key].shared, edge.shared)
    for key, node in true.nodes.items():
        ours, theirs = node.landmarks, found.nodes[key].landmarks
        both = ours.has_depth & theirs.has_depth
        assert np.array_equal(ours.pixels, theirs.pixels)
        assert np.median(theirs.depths[both] / ours.depths[both]) == pytest.approx(1.0, abs=0.02)
        first, other = (m.nodes[min(m.nodes)].map_from_robot.mean.inverse() for m in maps)
        assert (other @ found.nodes[key].map_from_robot.mean).distance(
            first @ node.map_from_robot.mean
        ) < 0.01
    for mine, its in zip(*ways, strict=True):
        assert its.distance(mine) < 0.015


def test_a_map_that_another_process_began_keeps_its_lengths(walls, description):
    """Its wheels may have been others."""
    first = Mapper(MapId("r0", 1), description)
    first.finish(drive(first, walls, list(np.arange(0.0, 0.51, 0.025))))
    first.finish_pending()
    contents = first.take_changes()
    mapper = Mapper(MapId("r0", 1), description, contents=contents, next_number=9)
    last = drive(mapper, walls, list(np.arange(0.0, 0.51, 0.025)), start=50)
    mapper.recalibrate(description, Lens(description.camera, description.distortion), Pose2(), 0.9)
    mapper.finish(last)
    moved = mapper.take_way_moved()
    assert moved.scale == 1.0
    for change in contents:
        assert mapper.map.nodes[change.node.id] is change.node


@pytest.mark.parametrize(("hours", "clock"), [(1, ""), (0, "utc")])
def test_a_clock_that_was_put_back_between_two_runs_has_no_name(walls, description, hours, clock):
    """The server called such a map implausible, for good: its clock ran backwards.

    A machine without a clock of its own begins each time with an old time.
    """
    there, clocked = list(np.arange(0.0, 0.51, 0.025)), replace(description, clock="utc")
    first = Mapper(MapId("r0", 1), clocked)
    first.finish(drive(first, walls, there, start=1 + 36_000 * hours))
    first.finish_pending()
    contents = first.take_changes()
    assert contents[0].node.clock == "utc"
    mapper = Mapper(MapId("r0", 1), clocked, contents=contents, next_number=9)
    mapper.finish(drive(mapper, walls, there, start=50))
    mapper.finish_pending()
    clocks = [change.node.clock for change in mapper.take_changes() if isinstance(change, NodePut)]
    assert clocks == [clock]
    nodes = [change.node for change in contents if isinstance(change, NodePut)]
    nodes += [node for node in mapper.map.nodes.values() if node.clock]
    assert not runs_backwards({node.id: node for node in nodes}.values())


def test_a_view_without_features_gives_no_node(walls, description):
    mapper = Mapper(MapId("r0", 1), description)
    away = [Pose2(0, 0, np.pi)] * 3
    for tick, pose in enumerate(away, 1):
        observation = walls.observe(pose, pose, tick)
        mapper.step(observation)
        if not mapper.started:
            mapper.begin(observation)
    assert mapper.anchor_features == 0
    mapper.finish(observation)
    mapper.finish_pending()
    assert mapper.take_changes() == ()
    assert not mapper.map.nodes


def test_standing_still_gives_no_depth(walls, description):
    mapper = Mapper(MapId("r0", 1), description)
    last = drive(mapper, walls, [0.0] * 30)
    mapper.finish(last)
    mapper.finish_pending()
    assert not mapper.map.nodes


def test_a_covered_lens_and_lost_encoders_are_named(walls, description):
    mapper = Mapper(MapId("r", 1), description)
    pose = Pose2()
    mapper.step(walls.observe(pose, pose, 0))
    mapper.begin(walls.observe(pose, pose, 0))
    assert mapper.health == ""
    collected = []
    for tick in range(1, 40):
        before, pose = pose, Pose2(0.02 * tick, 0.0, 0.05 * np.sin(0.4 * tick))
        seen = walls.observe(before, pose, tick)
        if 20 <= tick < 26:
            seen = replace(seen, odometry=Odometry(0.0, 0.0))
        elif tick >= 30:
            seen = replace(seen, image=None)
        mapper.step(seen)
        collected.append(mapper.health)
    assert not any(collected[:18])
    assert sum("refute" in health for health in collected[19:26]) >= 4
    assert collected[-1] == "no image for 10 steps"


def test_a_camera_that_turned_away_from_all_landmarks_has_not_failed(walls, description):
    mapper = Mapper(MapId("r", 1), description)
    poses = [Pose2(0.02 * k, 0.0, 0.0) for k in range(20)] + [Pose2(0.4, 0.0, 0.1 * k) for k in range(62)]
    collected = []
    for tick, (before, pose) in enumerate(pairwise([poses[0], *poses])):
        seen = walls.observe(before, pose, tick)
        mapper.step(seen)
        if not mapper.started:
            mapper.begin(seen)
        collected.append(mapper.health)
    assert "landmark" in collected[-1], "it has turned away from what it mapped"
    mapper.finish(seen)
    mapper.finish_pending()
    mapper.step(walls.observe(pose, pose, tick + 1))
    assert mapper.anchor_features > 0 and mapper.health == ""


def test_an_edge_turns_further_if_the_images_say_so(walls, description):
    """Evenly along its way: half of it is in the direction of the way, all of it in the heading."""
    edges = []
    for turn in (0.0, 0.02):
        mapper = Mapper(MapId("r0", 1), description)
        mapper.finish(drive(mapper, walls, list(np.arange(0.0, 0.51, 0.025))))
        mapper.finish_pending()
        last = drive(mapper, walls, list(np.arange(0.5, 0.91, 0.025)), start=50)
        before = mapper.map_from_robot.mean
        mapper.correct_turn(turn)
        known = mapper.map_from_robot.mean
        assert known.heading - before.heading == pytest.approx(turn, abs=1e-9), "the robot knows it at once"
        mapper.finish(last)
        mapper.finish_pending()
        assert mapper.map_from_robot.mean.distance(known) < 1e-6, "its pose does not jump where the edge ends"
        mapper.finish(drive(mapper, walls, list(np.arange(0.9, 1.31, 0.025)), start=100))
        mapper.finish_pending()
        edges.append([edge.a_from_b.mean for edge in mapper.map.edges.values()][:2])
    (earlier, straight), (same, turned) = edges
    assert same == earlier
    assert turned.heading - straight.heading == pytest.approx(0.02, abs=1e-3)
    assert turned.y - straight.y == pytest.approx(0.01 * straight.x, abs=1e-3)
