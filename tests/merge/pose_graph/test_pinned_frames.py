"""Pinned frames: a component is moved as a whole, and what does not depend on its frame stays."""

import math

import numpy as np
import pytest

from mapweave.hybridmap.constraint_subject import Apart, RetiredMap
from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.manual_constraint import ManualConstraint, ManualConstraints
from mapweave.hybridmap.pin import Pin
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.mapserver.merging.merger import Merger
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.pinned_frames import frame_changes
from synthetic.maps import looking_around, map_tours, merger_of
from synthetic.world import room

A, B = MapId("a", 1), MapId("b", 1)
APART = ManualConstraints([ManualConstraint(Apart((A, B)), True, "anna", 10**18)])
POSE = Pose2(120.25, -3.5, 2.5)


@pytest.fixture(scope="module")
def merger() -> Merger:
    """Two robots have looked around in one room."""
    rng = np.random.default_rng(6)
    # Each robot's frame is where it begins.
    tours = {A: looking_around(4), B: looking_around(4)[::-1]}
    return merger_of(map_tours(room(0, 0, 5, 4, 700, rng), tours, rng))


def merged(merger: Merger, *pins: Pin, apart: bool = False) -> MergedMap:
    merger.constrain(APART if apart else ManualConstraints())
    merger.pin(pins)
    return merger.merged()


def of(map_id: MapId, merger: Merger) -> NodeId:
    return sorted(merger.maps[map_id].nodes)[2]


def test_a_pinned_node_has_its_pose_and_the_map_its_shape(merger: Merger):
    free, pin = merged(merger), Pin(of(B, merger), POSE)
    held = merged(merger, pin)
    assert held.pose(pin.node) == POSE
    nodes = sorted(free.poses)
    for a in nodes:
        for b in nodes:
            expected = free.pose(a).inverse() @ free.pose(b)
            found = held.pose(a).inverse() @ held.pose(b)
            assert np.allclose(found.vector, expected.vector, atol=1e-9)
            # Relative covariances do not depend on the node that is held.
            one, other = free.relative(a, b), held.relative(a, b)
            assert one is not None and other is not None
            assert np.allclose(one.covariance, other.covariance, rtol=1e-3, atol=1e-9)
    # The frame is that of the pin: its node is exact, and what was exact before is not.
    first = nodes[0]
    assert np.trace(held.poses[pin.node].merged_from_robot.covariance) < 1e-9
    assert np.trace(held.poses[first].merged_from_robot.covariance) > 1e-7
    assert np.trace(free.poses[first].merged_from_robot.covariance) < 1e-9
    assert np.array_equal(merged(merger).pose(first).vector, free.pose(first).vector)


def test_a_frame_does_not_jump_when_its_component_joins_another(merger: Merger):
    pin = Pin(of(B, merger), POSE)
    apart, one = merged(merger, pin, apart=True), merged(merger, pin)
    assert len(apart.components) == 2 and len(one.components) == 1
    # What the merge has learned moves nodes by centimetres.
    for node in merger.maps[B].nodes:
        assert one.pose(node).distance(apart.pose(node)) < 0.15
    # Without the pin it takes the frame of the other one.
    free_apart, free = merged(merger, apart=True), merged(merger)
    jumps = [wrap_angle(free.pose(n).heading - free_apart.pose(n).heading) for n in merger.maps[B].nodes]
    assert min(map(abs, jumps)) > 1.0


def test_the_older_of_two_pins_holds_and_the_change_is_known(merger: Merger):
    old, new = Pin(of(B, merger), POSE), Pin(of(A, merger), Pose2(-5.0, 1.0, -0.3))
    apart = merged(merger, old, new, apart=True)
    assert apart.pose(old.node) == old.merged_from_node and apart.pose(new.node) == new.merged_from_node
    assert frame_changes(apart) == ()
    one = merged(merger, old, new)
    assert one.pose(old.node) == old.merged_from_node
    (change,) = frame_changes(one)
    assert (change.pinned, change.holding) == (new.node, old.node)
    for node in merger.maps[A].nodes:
        moved = change.now_from_pinned @ apart.pose(node)
        assert one.pose(node).distance(moved) < 0.15


def test_pins_outlast_a_retired_node_and_the_beginning_of_a_server(merger: Merger):
    pin = Pin(of(A, merger), POSE)
    merger.pin([pin])
    assert merger.apart().pose(pin.node) == POSE
    gone = Pin(NodeId("c", 1, 7), Pose2())
    found = merged(merger, gone, pin)
    assert found.pose(pin.node) == POSE
    assert frame_changes(found) == ((gone.node, None, Pose2()),)


def test_components_that_do_not_change_stay_the_same_objects(merger: Merger):
    pin = Pin(of(A, merger), POSE)
    first = merged(merger, pin, apart=True)
    merger.constrain(ManualConstraints([*APART.made, ManualConstraint(RetiredMap(B), True, "anna", 10**18)]))
    second = merger.merged()
    assert second is not first and second.graphs[0] is first.graphs[0]


@pytest.mark.parametrize("pose", [Pose2(1e6, 0.0, 0.0), Pose2(0.0, math.nan, 0.0), Pose2(0.0, 0.0, math.inf)])
def test_a_pose_out_of_range_is_refused(pose: Pose2):
    with pytest.raises(InvalidValue, match="give a position within"):
        Pin(NodeId("a", 1, 1), pose)
