"""Maps whose lengths are all too long or too short by one factor are corrected, and no others."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import minimize

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.merging import merge_maps
from mapweave.merge.outlier_rejection.segmentation import fragments_of
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.map_scales import TAILS, WHEELS, LengthRatio, MapScale, MapScales, combined
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.verification import verify
from mapweave.merge.settings import ConsistencySettings
from mapweave.registration.recognition import by_scales
from synthetic.maps import changes_of
from synthetic.wrong_geometry import ODD, SCENES, OdometryFault, draw_fleet
from tests.examined import examined_once
from tests.quick import first_quick

SEED = 9412
Content = tuple[list[Node], list[Edge]]


def longer(content: Content, way: float, depth: float) -> Content:
    """A map with ways and depths multiplied by factors."""

    def moved(pose: PoseGaussian) -> PoseGaussian:
        return PoseGaussian(Pose2(way * pose.mean.x, way * pose.mean.y, pose.mean.heading), pose.covariance)

    def deeper(marks: Landmarks) -> Landmarks:
        depths, sigmas = ((depth * one).astype(np.float32) for one in (marks.depths, marks.depth_sigmas))
        return replace(marks, depths=depths, depth_sigmas=sigmas)

    nodes = [
        replace(node, map_from_robot=moved(node.map_from_robot), landmarks=deeper(node.landmarks))
        for node in content[0]
    ]
    return nodes, [replace(edge, a_from_b=moved(edge.a_from_b)) for edge in content[1]]


class Fleet:
    """Four maps of a house, and links between them, all verified."""

    def __init__(self) -> None:
        fleet = draw_fleet(SEED, SCENES["house"], OdometryFault.NONE)
        self.contents, self.truth = fleet.maps, fleet.truth
        self._maps: dict[tuple[float, float], dict[MapId, HybridMap]] = {}
        self._links: dict[int, list[Link]] = {}
        # Where views look at the same things, as their descriptors say in a server.
        self.pairs = [
            (a, b)
            for k, first in enumerate(sorted(fleet.maps))
            for second in sorted(fleet.maps)[k + 1 :]
            for a in fleet.maps[first][0]
            for b in near(a.id, (node.id for node in fleet.maps[second][0]), fleet.truth)
        ]

    def maps(self, way: float = 1.0, depth: float = 1.0) -> dict[MapId, HybridMap]:
        """The maps, of which one has other lengths."""
        if (way, depth) not in self._maps:
            contents = {**self.contents, ODD: longer(self.contents[ODD], way, depth)}
            self._maps[way, depth] = {
                which: HybridMap(changes_of(*content)) for which, content in contents.items()
            }
        return self._maps[way, depth]

    def links(self, maps: Mapping[MapId, HybridMap]) -> list[Link]:
        """Links between them."""
        if id(maps) not in self._links:
            verdicts = (verify(a_node(maps, a.id), a_node(maps, b)) for a, b in self.pairs)
            self._links[id(maps)] = [verdict for verdict in verdicts if isinstance(verdict, Link)]
        return self._links[id(maps)]


def a_node(maps: Mapping[MapId, HybridMap], node: NodeId) -> Node:
    return maps[node.map].nodes[node]


def near(node: NodeId, others: Iterable[NodeId], truth: Mapping[NodeId, Pose2]) -> list[NodeId]:
    """The two nodes that look most like one by where they are."""

    def off(other: NodeId) -> float:
        a_from_b = truth[node].inverse() @ truth[other]
        return math.hypot(a_from_b.x, a_from_b.y) + 2.0 * abs(math.remainder(a_from_b.heading, math.tau))

    return sorted(others, key=off)[:2]


@pytest.fixture(scope="module", autouse=True)
def examined() -> Iterator[None]:
    """One map of a fleet has other lengths in each test: what the other three show stays."""
    with examined_once():
        yield


@pytest.fixture(scope="module")
def fleet() -> Fleet:
    return Fleet()


def scales_of(fleet: Fleet, way: float, depth: float) -> dict[MapId, MapScale]:
    maps = fleet.maps(way, depth)
    return MapScales().of(maps, fragments_of(maps, ConsistencySettings()), fleet.links(maps))


def apart(one: MergedMap, other: MergedMap, odd: bool) -> float:
    """By how much nodes of the others, or of the odd map, differ from the others' first node, m."""
    first = min(node for node in one.poses if node.map != ODD)
    nodes = [node for node in one.poses if (node.map == ODD) == odd]
    places = [{node: m.pose(first).inverse() @ m.pose(node) for node in nodes} for m in (one, other)]
    return max(places[0][node].distance(places[1][node]) for node in nodes)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.05, 0.96])
def test_a_map_with_long_lengths_bends_and_parts_no_others(fleet: Fleet, factor: float):
    sound, maps = fleet.maps(), fleet.maps(factor, factor)
    links = fleet.links(maps)
    right, merged = merge_maps(sound, fleet.links(sound)), merge_maps(maps, links)
    assert len(right.components) == len(merged.components) == 1
    assert apart(right, merged, odd=False) < 0.025
    assert apart(right, merged, odd=True) < 0.04
    others = [{link.pair for link in one.links if ODD not in link.maps} for one in (right, merged)]
    assert others[0] == others[1]
    # Maps and links are given as they were measured.
    assert merged.maps[ODD] is maps[ODD]
    given = {link.pair: link.a_from_b for link in links}
    assert all(link.a_from_b is given[link.pair] for link in merged.links if not link.within)
    turned = merge_maps(dict(reversed(maps.items())), links[::-1])
    assert all(turned.pose(node) == merged.pose(node) for node in merged.poses)


@pytest.mark.parametrize("factor", first_quick([0.96, 1.05, 1.03], 2))
def test_the_factor_is_found(fleet: Fleet, factor: float):
    scales = scales_of(fleet, factor, factor)
    odd = scales.pop(ODD)
    # Within what it says, and by how much the prior draws it.
    assert odd.sigma < 0.004
    assert odd.log == pytest.approx(math.log(factor), abs=3.0 * odd.sigma)
    assert abs(odd.undone - odd.log) < 0.003
    assert all(scale.undone == 0.0 for scale in scales.values())


@pytest.mark.parametrize(("way", "depth"), [(1.0, 1.0), (1.0, 1.3), (1.1, 1.0)])
def test_what_is_no_factor_of_all_lengths_is_left(fleet: Fleet, way: float, depth: float):
    assert all(scale.undone == 0.0 for scale in scales_of(fleet, way, depth).values())


def test_false_links_make_no_factor(fleet: Fleet):
    maps = fleet.maps()
    rng = np.random.default_rng(SEED)

    def perhaps_false(link: Link) -> Link:
        if rng.random() < 0.5:
            return link
        anywhere = Pose2.from_vector(rng.uniform(-3, 3, 3))
        return replace(link, a_from_b=PoseGaussian(anywhere, link.a_from_b.covariance))

    links = [perhaps_false(link) for link in fleet.links(maps)]
    found = MapScales().of(maps, fragments_of(maps, ConsistencySettings()), links)
    assert not any(scale.undone for scale in found.values())


def test_a_link_changes_with_depths_as_is_said(fleet: Fleet):
    maps, more = fleet.maps(), fleet.maps(1.0, 1.02)
    checked = 0
    for link in fleet.links(maps):
        other = verify(a_node(more, link.a), a_node(more, link.b))
        # With the same landmarks: one that joins or leaves is another matter.
        if link.b.map != ODD or not isinstance(other, Link) or len(other.shared) != len(link.shared):
            continue
        by = by_scales(a_node(maps, link.a), a_node(maps, link.b), link.shared, link.a_from_b.mean)
        assert by is not None
        moved = (link.a_from_b.mean.inverse() @ other.a_from_b.mean).vector
        checked += np.allclose(moved, by[:, 1] * math.log(1.02), atol=2e-3, rtol=0.1)
        checked -= not np.allclose(moved, by[:, 1] * math.log(1.02), atol=2e-2, rtol=0.3)
    assert checked > 30


def test_factors_are_those_of_least_squares_with_the_prior():
    which = [MapId(f"r{k}", 1) for k in range(4)]
    logs = np.array([0.002, -0.004, 0.0, 0.05])
    ratios = {
        (which[a], which[b]): LengthRatio(logs[b] - logs[a] + 0.001 * (b - a - 1), 0.003 + 0.001 * a, 0.0)
        for a in range(4)
        for b in range(a + 1, 4)
    }

    def cost(x: np.ndarray) -> float:
        out = sum(
            0.5 * ((x[which.index(b)] - x[which.index(a)] - ratio.log) / ratio.sigma) ** 2
            for (a, b), ratio in ratios.items()
        )
        return float(out + (TAILS / WHEELS) ** 2 * np.sqrt(1.0 + (x / TAILS) ** 2).sum())

    best = minimize(cost, np.zeros(4), tol=1e-12).x
    found = combined(ratios)
    assert [found[one].log for one in which] == pytest.approx(list(best), abs=1e-5)
    assert [found[one].undone for one in which] == [0.0, 0.0, 0.0, 0.05]
    # Of two maps nothing shows which is wrong: they meet in the middle.
    two = combined({(which[0], which[1]): LengthRatio(0.04, 0.004, 0.0)})
    assert [two[one].log for one in which[:2]] == pytest.approx([-0.02, 0.02], abs=1e-3)


def test_what_did_not_change_is_not_made_again(fleet: Fleet):
    maps = fleet.maps(1.05, 1.05)
    links, scales = fleet.links(maps), MapScales()
    pieces = fragments_of(maps, ConsistencySettings())
    logs = {which: scale.undone for which, scale in scales.of(maps, pieces, links).items() if scale.undone}
    some = next(link for link in links if link.b.map == ODD)
    ends = 0.0, logs[ODD]
    for before, after in pairwise(
        (scales.corrected_maps(maps, logs)[ODD], scales.corrected_link(some, maps, ends)) for _ in range(2)
    ):
        assert before[0] is after[0] and before[1] is after[1]
