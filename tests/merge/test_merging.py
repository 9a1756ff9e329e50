"""Whole merges of synthetic maps, from descriptors to poses."""

import math
from itertools import pairwise

import numpy as np
import pytest

from mapweave.hybridmap.change import EdgeRetired
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.merging import merge_maps
from mapweave.merge.pose_graph.links import Link, RefusedLink
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.verification import verify
from synthetic.maps import changes_of
from synthetic.world import World, room, take_map
from tests.merge.pose_graph.all_pairs import choose_pairs, overlaps

A, B, C = MapId("a", 1), MapId("b", 1), MapId("c", 1)


def tour(x: float, y: float, n: int, rng: np.random.Generator) -> list[Pose2]:
    """Looking around in a room whose corner is at (x, y), in turns that leave some of the view."""
    heading = rng.uniform(-math.pi, math.pi)
    return [Pose2(x + rng.uniform(1.6, 3.2), y + rng.uniform(1.4, 2.6), heading + 0.7 * k) for k in range(n)]


def office(rng: np.random.Generator) -> list[World]:
    return [room(5.0 * k, 0, 5, 4, 600, rng) for k in range(3)]


class Fleet:
    """Maps of some tours, and the truth about them."""

    def __init__(self, world: World, tours: dict[MapId, list[Pose2]], rng: np.random.Generator) -> None:
        self.maps: dict[MapId, HybridMap] = {}
        self.truth: dict[NodeId, Pose2] = {}
        for map_id, stops in tours.items():
            nodes, edges = take_map(world, map_id, stops, rng)
            self.maps[map_id] = HybridMap(changes_of(nodes, edges))
            self.truth |= {node.id: stop for node, stop in zip(nodes, stops, strict=True)}

    def merge(self, order: int = 1) -> MergedMap:
        nodes = [node for hybrid_map in self.maps.values() for node in hybrid_map.nodes.values()][::order]
        edges = [edge for hybrid_map in self.maps.values() for edge in hybrid_map.edges.values()][::order]
        by_id = {node.id: node for node in nodes}
        verdicts = [verify(by_id[a], by_id[b]) for a, b in choose_pairs(overlaps(nodes), edges)][::order]
        maps = dict(list(self.maps.items())[::order])
        links = [v for v in verdicts if isinstance(v, Link)]
        return merge_maps(maps, links, [v for v in verdicts if isinstance(v, RefusedLink)])

    def false_links(self, merged: MergedMap) -> int:
        count = 0
        for link in merged.links:
            off = (self.truth[link.a].inverse() @ self.truth[link.b]).inverse() @ link.a_from_b.mean
            count += math.hypot(off.x, off.y) > 0.5 or abs(off.heading) > math.radians(15)
        return count

    def errors(self, merged: MergedMap, component: int) -> tuple[float, float]:
        """RMS error of positions after one rigid alignment, and mean squared Mahalanobis distance.

        The distances are taken without alignment, from the component's anchor, whose pose is certain.
        """
        nodes = sorted(merged.components[component])
        result = np.array([merged.poses[n].merged_from_robot.mean.vector[:2] for n in nodes])
        true = np.array([self.truth[n].vector[:2] for n in nodes])
        u, _, vt = np.linalg.svd((result - result.mean(0)).T @ (true - true.mean(0)))
        rotation = u @ np.diag([1.0, np.linalg.det(u @ vt)]) @ vt
        off = (result - result.mean(0)) @ rotation - (true - true.mean(0))
        truth_from_merged = self.truth[nodes[0]] @ merged.poses[nodes[0]].merged_from_robot.mean.inverse()
        distances = [
            merged.poses[n].merged_from_robot.mahalanobis2(truth_from_merged.inverse() @ self.truth[n])
            for n in nodes[1:]
        ]
        return float((off**2).sum(axis=1).mean()) ** 0.5, float(np.mean(distances))


def three_robots(seed: int, n: int = 8) -> Fleet:
    rng = np.random.default_rng(seed)
    rooms = office(rng)
    tours = {
        A: tour(0, 0, n, rng) + tour(5, 0, n, rng),
        B: tour(5, 0, n, rng) + tour(10, 0, n, rng),
        C: tour(10, 0, n, rng),
    }
    return Fleet(rooms[0] + rooms[1] + rooms[2], tours, rng)


@pytest.fixture(scope="module")
def office_fleet() -> tuple[Fleet, MergedMap]:
    """Three robots' maps and their merge."""
    fleet = three_robots(1)
    return fleet, fleet.merge()


def test_three_maps_become_one(office_fleet: tuple[Fleet, MergedMap]):
    fleet, merged = office_fleet
    assert len(merged.components) == 1
    assert fleet.false_links(merged) == 0
    error, distance = fleet.errors(merged, 0)
    assert error < 0.10
    assert distance < 5.0
    assert merged.joined(A, C)
    assert {link.edge().kind for link in merged.links} == {EdgeKind.MERGED, EdgeKind.LOOP}


def test_result_does_not_depend_on_order():
    fleet = three_robots(3, n=5)
    one, two = fleet.merge(), fleet.merge(order=-1)
    assert [link.pair for link in one.links] == [link.pair for link in two.links]
    assert [(r.pair, r.reason) for r in one.refused] == [(r.pair, r.reason) for r in two.refused]
    assert one.components == two.components
    for node, place in one.poses.items():
        assert np.array_equal(
            place.merged_from_robot.mean.vector, two.poses[node].merged_from_robot.mean.vector
        )


def test_maps_of_different_places_stay_apart():
    rng = np.random.default_rng(4)
    rooms = office(rng)
    fleet = Fleet(rooms[0] + rooms[2], {A: tour(0, 0, 8, rng), B: tour(10, 0, 8, rng)}, rng)
    merged = fleet.merge()
    assert len(merged.components) == 2 and not merged.joined(A, B)
    # Each component keeps its own map's frame.
    for map_id in (A, B):
        first = min(fleet.maps[map_id].nodes)
        own = fleet.maps[map_id].nodes[first].map_from_robot.mean
        assert merged.poses[first].merged_from_robot.mean.distance(own) < 1e-9


def test_a_room_that_is_just_like_another_is_not_taken_for_it():
    """Rooms 0 and 2 look exactly alike. Both robots saw the room between them, and each saw one of them."""
    for seed in (5, 6):
        rng = np.random.default_rng(seed)
        left, middle = room(0, 0, 5, 4, 600, rng), room(5, 0, 5, 4, 900, rng)
        world = left + middle + left.moved(Pose2(10, 0, 0))
        tours = {A: tour(0, 0, 4, rng) + tour(5, 0, 9, rng), B: tour(5, 0, 9, rng) + tour(10, 0, 4, rng)}
        fleet = Fleet(world, tours, rng)
        merged = fleet.merge()
        assert fleet.false_links(merged) == 0
        refused = [r for r in merged.refused if r.link is not None]
        assert refused, "the alike rooms must have looked alike"


def test_a_room_that_fits_two_others_equally_is_joined_to_neither():
    """One robot saw two similar rooms, the other one of them: both sets have the same support."""
    rng = np.random.default_rng(7)
    left = room(0, 0, 5, 4, 600, rng)
    own_a, own_b = room(5, 0, 5, 4, 600, rng), room(-5, 0, 5, 4, 600, rng)
    world = left + own_a + left.moved(Pose2(10, 0, 0)) + own_b
    fleet = Fleet(
        world, {A: tour(0, 0, 8, rng) + tour(5, 0, 8, rng) + tour(10, 0, 8, rng), B: tour(0, 0, 8, rng)}, rng
    )
    merged = fleet.merge()
    assert fleet.false_links(merged) == 0 and not merged.joined(A, B)
    assert any("at other places too" in r.reason for r in merged.refused)


def chain(agent: str, n: int) -> HybridMap:
    rng = np.random.default_rng(1)
    nodes, edges = take_map(
        room(0, 0, 30, 4, 50, rng),
        MapId(agent, 1),
        [Pose2(1.0 * k, 2, 0) for k in range(n)],
        rng,
        sigma_xy=0.01,
    )
    return HybridMap(changes_of(nodes, edges))


def test_links_that_contradict_a_better_supported_way_round_are_refused():
    """a-b and b-c are well supported, all along; a-c says something else at one place, and agrees on it."""
    maps = {MapId(agent, 1): chain(agent, 14) for agent in "abc"}

    def links(first: str, second: str, shift: float, inliers: int, apart: int = 4) -> list[Link]:
        collected = []
        for k in range(0, 4 * apart, apart):
            a, b = NodeId(first, 1, 2 * k + 1), NodeId(second, 1, 2 * k + 1)
            true = (
                maps[a.map].nodes[a].map_from_robot.mean.inverse() @ maps[b.map].nodes[b].map_from_robot.mean
            )
            mean = PoseGaussian.from_sigmas(true @ Pose2(shift, 0, 0), 0.05, 0.05)
            collected.append(Link(a, b, mean, evidence={"inliers": float(inliers), "share": 0.8}))
        return collected

    false = links("a", "c", 2.0, 15, apart=1)
    merged = merge_maps(maps, [*links("a", "b", 0, 30), *links("b", "c", 0, 30), *false])
    assert {link.pair for link in merged.links}.isdisjoint({link.pair for link in false})
    assert len(merged.components) == 1 and len(merged.links) == 8
    reasons = {r.reason for r in merged.refused}
    assert reasons == {"contradicts better supported links by way of other maps"}
    agreeing = merge_maps(maps, [*links("a", "b", 0, 30), *links("b", "c", 0, 30), *links("a", "c", 0, 15)])
    assert len(agreeing.links) == 12


def test_a_map_in_pieces_is_joined_piece_by_piece():
    whole = chain("a", 6)
    whole.apply(EdgeRetired(NodeId("a", 1, 6)))  # between nodes 5 and 7
    merged = merge_maps({A: whole}, [])
    assert [len(part) for part in merged.components] == [3, 3]
    assert set(merged.poses) == set(whole.nodes)


def refused_links(merged: MergedMap) -> list[RefusedLink]:
    return [refusal for refusal in merged.refused if refusal.link is not None]


def test_explanations_and_summary(office_fleet: tuple[Fleet, MergedMap]):
    fleet, merged = office_fleet
    link = merged.links[0]
    assert "are linked: " in merged.explain(link.b, link.a)
    refused = merged.refused[0]
    assert refused.reason in merged.explain(refused.a, refused.b)
    known = {link.pair for link in merged.links} | {r.pair for r in merged.refused}
    unknown = next((a, b) for a, b in pairwise(sorted(fleet.truth)) if (a, b) not in known)
    assert "not compared" in merged.explain(*unknown)
    loops = sum(link.a.map == link.b.map for link in merged.links)
    result = f"{len(merged.links) - loops} links, {loops} loops, {len(refused_links(merged))} refused"
    assert loops > 1 and merged.summary() == f"40 nodes, 3 maps, 1 component, {result}"
    union = merged.union()
    assert set(union.nodes) == set(fleet.truth)
    assert len(union.edges) == sum(len(hybrid_map.edges) for hybrid_map in fleet.maps.values()) + len(
        merged.links
    )


def test_nothing_to_merge():
    assert merge_maps({}, []).summary() == "0 nodes, 0 maps, 0 components, 0 links, 0 refused"
    assert MergedMap.empty().components == ()


def test_link_edges_have_ids_of_their_own_that_stay(office_fleet: tuple[Fleet, MergedMap]):
    _, merged = office_fleet
    ids = [link.edge().id for link in merged.links]
    assert len(set(ids)) == len(ids)
    assert ids == [link.turned().canonical().edge().id for link in merged.links]
