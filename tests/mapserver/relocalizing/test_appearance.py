"""Places without depths: recognised, told as places and not as postures, and honest about twins."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hybridmap.change import EdgePut, NodePut
from hybridmap.hybrid_map import HybridMap
from hybridmap.node import Edge, EdgeKind, MapId, Node, NodeId
from hybridmap.pose import Pose2, PoseGaussian, wrap_angle
from hybridmap.query import Certainty, RelocalizeAnswer, View
from hybridmap.ruling import Rulings
from mapserver.places.placeindex import PlaceIndex
from mapserver.relocalizing.appearance import Appearance, rivals
from mapserver.relocalizing.relocalization import Relocalizer
from merge.graph.merged import MergedMap
from merge.graph.verdicts import Verdicts
from merge.islands import Islands
from synthetic.world import World, room, take_node, take_view
from wire.messages import decode_relocalize_answer, encode_relocalize_answer

HERE = PoseGaussian.from_sigmas(Pose2(), 0.01, 0.01)
AT = Pose2(2.0, 2.5, 0.1)


def bare(node: Node) -> Node:
    """A node without depths."""
    unknown = np.full(len(node.landmarks), np.nan, np.float32)
    return replace(node, landmarks=replace(node.landmarks, depths=unknown, depth_sigmas=unknown))


def place(seed: int, number: int = 1, at: Pose2 = AT) -> tuple[World, Node]:
    rng = np.random.default_rng(seed)
    world = room(0.0, 0.0, 6.0, 5.0, 900, rng)
    posture = PoseGaussian(at, HERE.covariance)
    return world, take_node(world, NodeId("r0", 1, number), at, posture, rng)


def mapped(nodes: list[Node]) -> MergedMap:
    """One map with an edge from each node to the next."""
    one = HybridMap(map(NodePut, nodes))
    for k, (a, b) in enumerate(pairwise(nodes)):
        way = PoseGaussian(a.map_from_robot.mean.inverse() @ b.map_from_robot.mean, HERE.covariance)
        one.apply(EdgePut(Edge(NodeId("r0", 1, 100 + k), a.id, b.id, way, EdgeKind.MAPPED)))
    maps = {MapId("r0", 1): one}
    return Islands().merge(maps, Verdicts(), set(maps), Rulings())


def told(nodes: list[Node], view: View) -> RelocalizeAnswer:
    index, known = PlaceIndex(), {node.id: node for node in nodes}
    index.extend(nodes)
    return Relocalizer(index, known.get, mapped(nodes)).answer(view)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("off", [Pose2(), Pose2(0.4, 0.15, 0.1), Pose2(-0.3, 0.3, -0.15)])
def test_a_place_without_depths_is_told_with_its_heading(seed: int, off: Pose2) -> None:
    world, node = place(seed)
    view, _ = take_view(world, AT @ off, np.random.default_rng(seed + 100))
    answer = told([bare(node)], view)
    assert answer.certainty is Certainty.PLACE and "distance" in answer.reason
    (best,) = answer.candidates
    assert best.node == node.id and not best.distance_known and 0.0 < best.probability < 1.0
    assert best.merged_from_robot is not None and best.component == 0
    # The posture is within what it says of itself, and it says that it knows little of where.
    assert best.node_from_robot.mahalanobis2(off) < 16.3
    assert math.sqrt(best.node_from_robot.covariance[:2, :2].trace()) > 0.9
    sigma = math.sqrt(best.node_from_robot.covariance[2, 2])
    assert abs(wrap_angle(best.node_from_robot.mean.heading - off.heading)) < min(4.0 * sigma, 0.1)
    assert told([node], view).certainty is Certainty.FOUND


@pytest.mark.parametrize("seed", range(4))
def test_elsewhere_is_no_place(seed: int) -> None:
    world, node = place(seed)
    for heading in (1.7, 3.1, -1.6):
        view, _ = take_view(world, Pose2(2.0, 2.5, heading), np.random.default_rng(seed))
        assert told([bare(node)], view).certainty is Certainty.UNKNOWN
        stranger, _ = take_view(place(seed + 50)[0], AT, np.random.default_rng(seed))
        assert told([bare(node)], stranger).certainty is Certainty.UNKNOWN


def test_two_places_that_look_the_same_are_ambiguous_and_neighbours_are_not() -> None:
    world, node = place(1)
    near = take_node(
        world, NodeId("r0", 1, 2), AT @ Pose2(0.2, 0.1, 0.05),
        PoseGaussian(AT @ Pose2(0.2, 0.1, 0.05), HERE.covariance), np.random.default_rng(7),
    )  # fmt: skip
    there = PoseGaussian(Pose2(14.0, 2.5, 0.1), HERE.covariance)
    twin = replace(near, map_from_robot=there)
    view, _ = take_view(world, AT @ Pose2(0.1, 0.0, 0.0), np.random.default_rng(3))
    assert told([bare(node), bare(near)], view).certainty is Certainty.PLACE
    answer = told([bare(node), bare(twin)], view)
    assert answer.certainty is Certainty.AMBIGUOUS and len(answer.candidates) == 2
    assert not any(one.distance_known for one in answer.candidates)
    assert sum(one.probability for one in answer.candidates) <= 1.0


def test_a_node_with_depths_is_not_recognised_by_its_looks() -> None:
    world, node = place(2)
    view, _ = take_view(world, AT, np.random.default_rng(5))
    known = {node.id: node, NodeId("r0", 1, 9): None}
    appearance = Appearance(known.get, mapped([node]))
    assert appearance.answer(view, list(known)) is None


def test_the_rest_of_the_answer_says_on_the_wire_that_the_distance_is_not_known() -> None:
    world, node = place(3)
    view, _ = take_view(world, AT, np.random.default_rng(5))
    for answer in (told([bare(node)], view), told([node], view)):
        again = decode_relocalize_answer(encode_relocalize_answer(answer))
        assert again.certainty is answer.certainty and again.reason == answer.reason
        assert [one.distance_known for one in again.candidates] == [
            one.distance_known for one in answer.candidates
        ]


@pytest.mark.parametrize("shape", ["one point", "two points", "a line", "a row"])
def test_pixels_from_which_no_geometry_follows_do_no_harm(shape: str) -> None:
    """All descriptors match. Spread along a line it is the same image; crowded it is nothing."""
    _, node = place(4)
    n, rng = len(node.landmarks), np.random.default_rng(1)
    x = rng.uniform(10, 300, n)
    pixels = {
        "one point": np.full((n, 2), 100.0),
        "a line": np.stack([x, 0.5 * x + 20], axis=1),
        "a row": np.stack([x, np.full(n, 120.0)], axis=1),
        "two points": np.where(rng.random((n, 1)) < 0.5, 50.0, 200.0) * np.ones((1, 2)),
    }[shape].astype(np.float32)
    flat = replace(bare(node), landmarks=replace(bare(node).landmarks, pixels=pixels))
    view = View(pixels, node.landmarks.codes, node.camera)
    wanted = Certainty.UNKNOWN if "point" in shape else Certainty.PLACE
    assert told([flat], view).certainty is wanted


def test_rivals_are_the_best_and_one_of_each_other_place() -> None:
    seen = {1: 50, 2: 45, 3: 31, 10: 40, 11: 39, 20: 29}
    assert rivals(seen, lambda a, b: abs(a - b) <= 2, 0.6) == [1, 10]
