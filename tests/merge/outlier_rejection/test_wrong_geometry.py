"""Lines of sight, and which of several maps they refute."""

from collections.abc import Sequence
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.descriptor import quantise
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Edge, EdgeKind, Landmarks, Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.outlier_rejection import wrong_geometry
from mapweave.merge.outlier_rejection.lines_of_sight import seen_through
from mapweave.merge.outlier_rejection.wrong_geometry import WrongGeometrySearch
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.settings import ConsistencySettings

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.25)
STEP = 0.3
LINK = np.diag([0.02, 0.02, 0.01]) ** 2


def facing_a_wall(map_id: MapId, number: int, distance: float, at: Pose2, count: int = 120) -> Node:
    """A view of a wall straight ahead: landmarks anywhere on it, depths known to 1 %."""
    rng = np.random.default_rng([ord(map_id.agent), number])
    pixels = rng.uniform([4, 4], [316, 236], (count, 2)).astype(np.float32)
    depths = np.full(len(pixels), distance, np.float32)
    codes = quantise(np.zeros((len(pixels), 32)))
    marks = Landmarks(pixels, codes, depths, 0.01 * depths)
    return Node(NodeId(*map_id, number), number, PoseGaussian(at, np.zeros((3, 3))), CAMERA, marks)


@pytest.mark.parametrize(
    ("ahead", "first", "second"),
    [
        # How far the second robot is said to stand ahead of the first; both see a wall 3 m away.
        (0.0, "confirmed", "confirmed"),
        (0.3, "confirmed", "confirmed"),  # Within three sigmas and 0.2 m.
        (1.5, "refuted", "hidden"),  # The first wall is 1.5 m before the second one.
        (-1.5, "hidden", "refuted"),
    ],
)
def test_a_view_through_a_wall_is_detected(ahead: float, first: str, second: str):
    one, other = (facing_a_wall(MapId("a", 1), k, 3.0, Pose2(), 500) for k in (1, 2))
    there = Pose2(ahead, 0.0, 0.0)
    for node, view, moved, expected in ((one, other, there.inverse(), first), (other, one, there, second)):
        compared, through = seen_through(node, view, moved, 0.01, 0.001)
        assert compared >= 50 if expected != "hidden" else compared == 0
        assert through == (compared if expected == "refuted" else 0)


def corridor(agent: str, scale: float = 1.0, gap: float = 0.0, count: int = 18, epoch: int = 1) -> HybridMap:
    """A robot that backs away from a wall, by steps that it measures, and once moves without noticing."""
    map_id, out, at = MapId(agent, epoch), HybridMap(), 0.0
    for k in range(count):
        true = 1.5 + STEP * k + (gap if k >= 6 else 0.0)
        out.apply(NodePut(facing_a_wall(map_id, k, true, Pose2(-at, 0.0, 0.0))))
        if k:
            step = PoseGaussian.from_sigmas(Pose2(-STEP * scale, 0.0, 0.0), 0.01, 0.005)
            ends = NodeId(*map_id, k - 1), NodeId(*map_id, k)
            out.apply(EdgePut(Edge(NodeId(*map_id, 100 + k), *ends, step, EdgeKind.MAPPED)))
        at += STEP * scale
    return out


def links_of(hybrid_map: HybridMap, other: HybridMap) -> list[Link]:
    """True links between all views whose distances from the wall are alike."""
    out = []
    for a in hybrid_map.nodes.values():
        for b in other.nodes.values():
            between = float(a.landmarks.depths[0] - b.landmarks.depths[0])
            if abs(between) < 0.8:
                evidence = {"inliers": 30.0, "share": 0.8}
                out.append(Link(a.id, b.id, PoseGaussian(Pose2(between, 0.0, 0.0), LINK), evidence=evidence))
    return out


def links_among(maps: dict[MapId, HybridMap]) -> tuple[list[MapId], dict[tuple[MapId, MapId], list[Link]]]:
    """The maps in their order, and the links of each pair."""
    ids = sorted(maps)
    return ids, {(a, b): links_of(maps[a], maps[b]) for a in ids for b in ids if a < b}


def with_jump(agents: str = "ab") -> dict[MapId, HybridMap]:
    """Sound maps, and map c, whose robot once moved without noticing."""
    maps = {MapId(agent, 1): corridor(agent) for agent in agents}
    return maps | {MapId("c", 1): corridor("c", 1.0, 2.0, 12)}


@pytest.mark.parametrize(
    ("scale", "gap", "expected"), [(1.0, 0.0, False), (1.0, 2.0, True), (2.0, 0.0, True)]
)
def test_a_map_that_jumps_or_stretches_is_wrong(scale: float, gap: float, expected: bool):
    maps = {MapId(agent, 1): corridor(agent) for agent in "ab"}
    maps[MapId("c", 1)] = corridor("c", scale, gap, 12)
    ids, links = links_among(maps)
    finder = WrongGeometrySearch(ConsistencySettings())
    wrong = finder.wrong(maps, links.__getitem__, links.keys())
    assert (set(wrong) == {ids[2]}) is expected
    if expected:
        assert wrong[ids[2]].reason == "map c.1 contradicts a.1 and b.1, which agree: its geometry is wrong"
        # Which of two is wrong cannot be decided; retired maps do not count.
        assert not finder.wrong(maps, links.__getitem__, (), [ids[0]])
        assert finder.wrong(maps, links.__getitem__, ()).keys() == wrong.keys()


@pytest.mark.parametrize("count", [3, 7])
def test_no_robot_alone_makes_maps_of_others_seem_wrong(count: int):
    """However many maps it sends that agree with each other, also if these come first."""
    maps = {MapId(agent, 1): corridor(agent) for agent in "yz"}
    maps |= {MapId("c", k): corridor("c", 1.0, 2.0, 12, k) for k in range(1, count + 1)}
    ids, links = links_among(maps)
    finder = WrongGeometrySearch(ConsistencySettings())
    assert finder.wrong(maps, links.__getitem__, links.keys()).keys() == set(ids[:-2])
    # Of two robots that contradict each other neither is wrong.
    assert not finder.wrong(maps, links.__getitem__, (), [ids[-1]])


def missed(link: Link, off: float) -> Link:
    """A false link: its nodes are so far off, m."""
    pose = PoseGaussian(link.a_from_b.mean @ Pose2(off, 0.0, 0.0), LINK)
    return Link(link.a, link.b, pose, evidence=link.evidence)


def drives(
    count: int, gap: float = 0.0
) -> tuple[dict[MapId, HybridMap], dict[tuple[MapId, MapId], list[Link]]]:
    """Maps of one robot's drives, the last with a jump after six views, and all links between them."""
    maps = {MapId("c", k): corridor("c", epoch=k) for k in range(1, count)}
    maps[MapId("c", count)] = corridor("c", 1.0, gap, 8, epoch=count)
    return maps, links_among(maps)[1]


def found(maps: dict[MapId, HybridMap], links: dict[tuple[MapId, MapId], list[Link]]) -> set[MapId]:
    """The maps that are wrong; the last contradicts the first two."""
    finder = WrongGeometrySearch(ConsistencySettings())
    wrong = set(finder.wrong(maps, links.__getitem__, links.keys()))
    first, second, *_, last = sorted(maps)
    assert not any(finder._ties[one, last].agrees for one in (first, second))
    return wrong


def test_a_few_false_links_make_no_map_wrong_that_all_others_hold_in_one_place():
    """Two false ones of nine and of fifteen, as in the life of a map (seed 62113)."""
    maps, links = drives(6)
    *others, last = sorted(maps)
    for other, count in zip(others, (9, 15), strict=False):
        some = links[other, last]
        some = [some[k] for k in np.linspace(0, len(some) - 1, count).round().astype(int)]
        off = {3: 0.4, 6: 3.0}
        links[other, last] = [missed(link, off.get(k, 0.0)) for k, link in enumerate(some)]
    assert found(maps, links) == set()


def test_a_part_of_a_map_that_few_links_show_elsewhere_makes_it_wrong():
    """Nine links in ten hold the rest of it in one place, and do not outvote them."""
    maps, links = drives(6, gap=1.0)
    *others, last = sorted(maps)
    for k, other in enumerate(others):
        before, after = (
            [one for one in links[other, last] if (one.b.number >= 6) is late] for late in (False, True)
        )
        links[other, last] = before[:12] + after[:2] if k < 2 else before
    assert sum(one.b.number >= 6 for pair in links if last in pair for one in links[pair]) == 4
    assert found(maps, links) == {last}


@settings(max_examples=10, deadline=None)
@given(st.randoms(use_true_random=False))
def test_the_order_in_which_links_were_found_changes_nothing(random: Random):
    """Of more links than are tested, those were tested that came at certain turns."""
    maps = with_jump()
    links = links_among(maps)[1]
    shuffled = {pair: random.sample(some, len(some)) for pair, some in links.items()}
    first, second = (WrongGeometrySearch(ConsistencySettings()) for _ in range(2))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(wrong_geometry, "MOST_LINKS", 5)
        wrong = first.wrong(maps, links.__getitem__, links.keys())
        assert second.wrong(maps, shuffled.__getitem__, links.keys()) == wrong


def test_a_map_that_was_left_out_when_its_links_came_is_searched_once_it_is_used():
    """Such as one that was taken for a copy. Before, it was searched when its links changed again."""
    maps = with_jump()
    ids, links = links_among(maps)
    finder = WrongGeometrySearch(ConsistencySettings())
    assert not finder.wrong(maps, links.__getitem__, links.keys(), [ids[1]])
    assert finder.wrong(maps, links.__getitem__, ()).keys() == {ids[2]}


def test_a_pair_of_maps_that_no_solver_takes_hides_no_other(monkeypatch):
    maps = with_jump("abd")
    ids, links = links_among(maps)
    real = wrong_geometry.link_sets

    def fails(links: Sequence[Link], *rest: Any) -> list[list[Link]]:
        if {links[0].a.map, links[0].b.map} == {ids[0], ids[3]}:
            raise np.linalg.LinAlgError("singular")
        return real(links, *rest)

    monkeypatch.setattr(wrong_geometry, "link_sets", fails)
    result = WrongGeometrySearch(ConsistencySettings()).wrong(maps, links.__getitem__, links.keys())
    assert result.keys() == {ids[2]}
