"""Which landmarks identify a place: aisles of equal shelves, where only a few things are unique."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.merging import merge_maps
from mapweave.merge.outlier_rejection.distinctness import weigh
from mapweave.merge.outlier_rejection.segmentation import fragments_of
from mapweave.merge.pose_graph.fragments import fragment_by_node
from mapweave.merge.pose_graph.links import Link
from tests.quick import first_quick

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, 0.3)
SIGMAS = np.array([0.02, 0.02, 0.01])
BAY = 3.0
"""Every so many metres along the aisle the same cartons stand again."""
CARTONS, SIGNS = 12, 30
"""Landmarks in each bay that are in all others too, and those that are in it alone."""


class Aisle:
    """Robots along an aisle. What a node shows are numbers of things: cartons have the same in every bay."""

    def __init__(self, seed: int, signs: tuple[int, ...] = (), cartons: int = CARTONS) -> None:
        self.rng = np.random.default_rng(seed)
        self.maps: dict[MapId, HybridMap] = {}
        self.truth: dict[NodeId, Pose2] = {}
        self.things: dict[NodeId, list[int]] = {}
        self.signs = signs
        self.cartons = cartons

    def shown(self, bay: int) -> list[int]:
        """All things in a bay, in an order that differs from node to node."""
        own = [1000 * (bay + 1) + k for k in range(SIGNS)] if bay in self.signs else []
        return [int(k) for k in self.rng.permutation([*range(self.cartons), *own])]

    def drive(self, agent: str, bays: Sequence[int], views: int = 3) -> None:
        """Map some bays, a few nodes in each."""
        hybrid_map = HybridMap()
        before: NodeId | None = None
        stops = [(bay, view) for bay in bays for view in range(views)]
        for k, (bay, view) in enumerate(stops):
            node = NodeId(agent, 1, 2 * k + 1)
            aside, turn = self.rng.uniform(-0.2, 0.2, 2)
            self.truth[node] = Pose2(BAY * bay + 0.5 * view, aside, turn)
            self.things[node] = self.shown(bay)
            still = PoseGaussian(Pose2(), np.zeros((3, 3)))
            hybrid_map.apply(NodePut(Node(node, k * 10**9, still, CAMERA, Landmarks.empty())))
            if before is not None:
                hybrid_map.apply(EdgePut(self.step(before, node, NodeId(agent, 1, 2 * k))))
            before = node
        self.maps[MapId(agent, 1)] = hybrid_map

    def driven(self, **bays: Sequence[int]) -> Aisle:
        """With a drive of each robot."""
        for agent, some in bays.items():
            self.drive(agent, some)
        return self

    def step(self, a: NodeId, b: NodeId, edge_id: NodeId) -> Edge:
        """A step of the way; within a bay its landmarks were tracked."""
        true = self.truth[a].inverse() @ self.truth[b]
        shared = self.common(a, b) if true.x < 0.8 else np.zeros((0, 2), np.int64)
        mean = true @ Pose2.from_vector(self.rng.normal(0, SIGMAS / 4))
        return Edge(edge_id, a, b, PoseGaussian(mean, np.diag((SIGMAS / 4) ** 2)), EdgeKind.MAPPED, shared)

    def common(self, a: NodeId, b: NodeId) -> np.ndarray:
        """(K, 2) landmarks of two nodes that look the same."""
        seats = {thing: j for j, thing in enumerate(self.things[b])}
        pairs = [(i, seats[thing]) for i, thing in enumerate(self.things[a]) if thing in seats]
        return np.array(pairs, np.int64).reshape(-1, 2)

    def links(self, least: int = 10) -> list[Link]:
        """What comparing nodes gives: each takes the other's bay for its own, if they show enough alike."""
        collected = []
        for a, b in combinations(sorted(self.truth), 2):
            shared = self.common(a, b)
            if len(shared) < least or (a.map == b.map and b.number - a.number < 6):
                continue
            there = self.truth[b]
            shift = BAY * round((self.truth[a].x - there.x) / BAY)
            apparent = self.truth[a].inverse() @ Pose2(there.x + shift, there.y, there.heading)
            mean = apparent @ Pose2.from_vector(self.rng.normal(0, SIGMAS))
            evidence = {"inliers": float(len(shared)), "share": 0.6}
            collected.append(Link(a, b, PoseGaussian(mean, np.diag(SIGMAS**2)), shared, evidence))
        return collected

    def true(self, link: Link) -> bool:
        """Whether a link's two nodes really stand to each other as it says."""
        return link.a_from_b.mean.distance(self.truth[link.a].inverse() @ self.truth[link.b]) < 0.5

    def signs_shared(self, link: Link) -> int:
        """Of the things that both ends show, those that there is one of."""
        return sum(self.things[link.a][i] >= 1000 for i in link.shared[:, 0])

    def weighed(self, links: Sequence[Link]) -> list[Link]:
        return weigh(links, fragment_by_node(fragments_of(self.maps)), self.maps)


def silent(links: Sequence[Link]) -> list[Link]:
    """The same links, without their landmarks."""
    return [replace(link, shared=np.zeros((0, 2), np.int64)) for link in links]


@pytest.mark.parametrize("seed", range(3))
def test_landmarks_of_one_bay_alone_are_counted(seed: int):
    aisle = Aisle(seed, signs=(1, 2)).driven(a=[0, 1, 2], b=[1, 2, 3])
    links = aisle.links()
    between = [link for link in aisle.weighed(links) if not link.within]
    assert {aisle.true(link) for link in between} == {True, False}
    for link in between:
        assert len(link.shared) - link.aliased == aisle.signs_shared(link), str(link.pair)
        assert link.telling <= aisle.true(link)


@pytest.mark.parametrize("seed", first_quick(range(4), 2))
def test_maps_are_joined_where_they_share_unique_landmarks(seed: int):
    aisle = Aisle(seed, signs=(2, 3)).driven(a=[0, 1, 2, 3], b=[2, 3, 4, 5, 6])
    merged = merge_maps(aisle.maps, aisle.links())
    between = [link for link in merged.links if not link.within]
    assert len(merged.components) == 1 and between
    assert all(aisle.true(link) for link in between)


@pytest.mark.parametrize("seed", range(4))
def test_aliased_aisles_are_not_joined(seed: int):
    aisle = Aisle(seed).driven(a=[0, 1], b=[3, 4, 5])
    links = aisle.links()
    merged = merge_maps(aisle.maps, links)
    assert len(merged.components) == 2 and not merged.links
    assert any("found at other places too" in refusal.reason for refusal in merged.refused)


def test_a_view_of_one_bay_alone_is_ambiguous():
    """One bay each, of another place: nothing shows that there are two of it. Then the merge is accepted."""
    aisle = Aisle(5).driven(a=[0], b=[3])
    assert len(merge_maps(aisle.maps, aisle.links()).components) == 1


def test_without_landmarks_the_better_supported_of_two_bays_wins():
    """What distinctness is for: the same links, counted by how many landmarks agree, join wrongly."""
    wrong = 0
    for seed in range(4):
        aisle = Aisle(seed)
        aisle.drive("a", [0, 1])
        aisle.drive("b", [3, 4, 5], views=2)
        aisle.drive("c", [6, 7, 8], views=2)
        merged = merge_maps(aisle.maps, silent(aisle.links()))
        wrong += any(not aisle.true(link) for link in merged.links)
        assert not merge_maps(aisle.maps, aisle.links()).links
    assert wrong > 0


def test_aliasing_found_for_one_node_is_used_for_its_neighbours():
    """A second node of the bay was compared with one place only; that shows its landmarks too."""
    aisle = Aisle(7)
    aisle.drive("a", [0], views=2)
    aisle.drive("b", [3, 4], views=1)
    first, second = aisle.maps[MapId("a", 1)].nodes
    links = [link for link in aisle.links(least=1) if not link.within]
    some = [link for link in links if link.a == first] + [link for link in links if link.a == second][:1]
    assert [link.aliased for link in aisle.weighed(some)] == [CARTONS] * 3
    alone = [link for link in some if link.a == second]
    assert [link.aliased for link in aisle.weighed(alone)] == [0]


def test_without_aliasing_all_landmarks_count():
    aisle = Aisle(8, signs=tuple(range(6)), cartons=0).driven(a=[0, 1, 2], b=[1, 2, 3])
    links = aisle.links()
    assert links and all(again is link for link, again in zip(links, aisle.weighed(links), strict=True))


def test_measured_badly_is_not_another_place():
    """Two links from one node that are a hand's breadth off each other show one place."""
    aisle = Aisle(9, signs=(1,), cartons=0)
    aisle.drive("a", [1], views=1)
    aisle.drive("b", [1], views=2)
    links = [link for link in aisle.links() if not link.within]
    shifted = links[0].a_from_b.mean @ Pose2(0.2, 0.0, 0.0)
    links[0] = replace(links[0], a_from_b=PoseGaussian(shifted, links[0].a_from_b.covariance))
    assert len(links) == 2 and not any(link.aliased for link in aisle.weighed(links))


def test_a_way_that_is_hardly_known_contradicts_nothing():
    """A robot slid while it drove from one sight of a bay to the next, and its covariance says so."""
    aisle = Aisle(11, signs=(1,), cartons=0)
    aisle.drive("a", [1], views=1)
    aisle.drive("b", [1], views=2)
    links = [link for link in aisle.links() if not link.within]
    b = aisle.maps[MapId("b", 1)]
    (step,) = b.edges.values()
    for sigma, doubles in ((0.01, SIGNS), (0.5, 0)):
        slid = PoseGaussian(step.a_from_b.mean @ Pose2(0.8, 0.0, 0.0), np.diag([sigma, sigma, 0.02]) ** 2)
        b.edges[step.id] = replace(step, a_from_b=slid)
        assert [link.aliased for link in aisle.weighed(links)] == [doubles] * 2


def test_order_does_not_matter():
    aisle = Aisle(10, signs=(1, 2)).driven(a=[0, 1, 2], b=[1, 2, 3])
    links = aisle.links()
    collected = {link.pair: link.aliased for link in aisle.weighed(links)}
    aisle.rng.shuffle(links)  # type: ignore[arg-type]
    aisle.maps = dict(reversed(aisle.maps.items()))
    turned = [link.turned() if k % 2 else link for k, link in enumerate(links)]
    assert {link.canonical().pair: link.aliased for link in aisle.weighed(turned)} == collected


def test_one_robot_alone_takes_no_landmarks_from_links_of_others():
    """It shows a bay once more, elsewhere on its way; a second robot that does so is believed."""
    aisle = Aisle(1, signs=(0,), cartons=0).driven(a=[0], b=[0])
    aliased = []
    for robot in ("y", "z"):
        aisle.drive(robot, [0, 5])
        for node, pose in aisle.truth.items():
            if node.agent == robot and pose.x > 4 * BAY:
                aisle.things[node] = aisle.shown(0)
        weighed = aisle.weighed(aisle.links())
        aliased.append({link.pair: link.aliased for link in weighed if not link.within})
    between = [pair for pair in aliased[0] if {end.agent for end in pair} == {"a", "b"}]
    own = [pair for pair in aliased[0] if pair[1].agent == "y"]
    assert len(between) == 9 and {aliased[0][pair] for pair in between} == {0}
    assert {aliased[0][pair] for pair in own} == {SIGNS}
    assert {aliased[1][pair] for pair in between} == {SIGNS}
