"""Maps with wrong geometry: in every placement by their links, other robots see through their walls.

A robot whose wheels slip, or that is carried off unnoticed, makes a map with true views and a wrong way
between them. Each of its links to a correct map is true, and no rigid placement satisfies them all: they fall
into sets that agree only within themselves (pairwise consistency, Mangelson et al., ICRA 2018). A room that
looks like another room gives such sets too. Consistency cannot distinguish the two cases. Lines of sight can:

* If the map is correct, one placement is true. Under it the landmarks of the map are where others have seen
  them, or where no robot has observed. The links of all other sets are false.
* If the map bends or jumps, each placement puts a part of it in a wrong place. Others then see through its
  walls, and it sees through theirs: they have landmarks behind them in the same direction.

So a map is wrong if lines of sight refute every placement among several maps that agree with each other, of
two other robots or of its own: no robot alone makes the map of another one seem wrong.
Clutter and wrong depths are seen through at true places too. Their share is measured on the same nodes, each
placed by its own links. Unobserved placements are not refuted, and the map may be right: it may have a room
that only looks like theirs. If it has their places in another arrangement than theirs, its own nodes see
through each other, wherever it is placed.

A map that is only a little wrong is seen through nowhere: see `mapweave.merge.outlier_rejection.bent_maps`.

Of few links between two maps some miss by chance, and the two seem to contradict each other. So a map is
right if its links to all maps that agree put the whole of it in one place.
"""

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import networkx as nx
import numpy as np

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array, Pose2, wrap_angle
from mapweave.merge.outlier_rejection.bent_maps import AGREEING, is_bent, nearly_there
from mapweave.merge.outlier_rejection.decision_cache import DecisionCache
from mapweave.merge.outlier_rejection.lines_of_sight import (
    LEAST_NODES,
    MOST_NEAR,
    MOST_SIGMA_HEADING,
    MOST_SIGMA_XY,
    REACH,
    more_than_usual,
    seen_through,
    tears,
)
from mapweave.merge.outlier_rejection.pairwise_consistency import loop_distances2
from mapweave.merge.outlier_rejection.shuffled_maps import is_shuffled
from mapweave.merge.pose_graph.component_solver import ComponentSolver
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link, thinned
from mapweave.merge.pose_graph.merged_map import WrongGeometry
from mapweave.merge.pose_graph.verdicts import MapPair
from mapweave.merge.settings import ConsistencySettings
from mapweave.registration.pose_arrays import PoseGaussians

MOST_LINKS = 60
"""Links between two pieces of map that are tested, evenly chosen: pairs of links grow by the square."""
MOST_PARTNERS = 5
"""Maps against which one is held: those with which it has most links, of all robots in turns."""
LEAST_SHARE = 0.25
"""A set of links is a placement if it has this share of the links of the largest set."""
LEAST_LANDMARKS = 50
"""Of a node that others confirm or refute: with fewer its share is chance."""
SAME_XY, SAME_HEADING = 0.5, math.radians(20.0)
"""Links of one node agree where it is if they differ by less, m and rad."""

UNSOLVABLE = (ArithmeticError, RuntimeError, ValueError)
"""What solvers raise for a map whose numbers they cannot take. Nothing is found out about it then."""


@dataclass(frozen=True, eq=False)
class _Tie:
    """The links between two maps.

    Attributes:
        links: all between the largest pieces of the two.
        best: the largest set of them that agrees.
        share: of the tested links that are in it.
    """

    links: tuple[Link, ...]
    best: tuple[Link, ...]
    share: float

    @property
    def agrees(self) -> bool:
        """Whether the two maps do."""
        return self.share >= AGREEING


class WrongGeometrySearch:
    """Finds maps with wrong geometry. What was found out of maps and links that did not change is kept."""

    def __init__(self, consistency: ConsistencySettings) -> None:
        self._s = consistency
        self._memory = DecisionCache()
        self._ties: dict[MapPair, _Tie] = {}
        self._waiting: set[MapPair] = set()
        self._checked: dict[tuple[MapId, tuple[MapId, ...]], bool] = {}

    def wrong(
        self,
        maps: Mapping[MapId, HybridMap],
        links: Callable[[MapPair], Sequence[Link]],
        stale: Collection[MapPair],
        left_out: Collection[MapId] = (),
    ) -> dict[MapId, WrongGeometry]:
        """Find them, those that contradict most others first.

        Args:
            maps: by id; never changed, only replaced.
            links: gives those between two of them.
            stale: pairs of maps whose links have changed, or of which one was replaced, since the last call.
            left_out: maps that are not used.

        Returns:
            The maps that are wrong, by id.
        """
        self._memory.forget_others(maps)
        stale = {*stale, *self._waiting}
        # Their links are sorted once both maps are used again.
        self._waiting = {pair for pair in stale if not set(pair).isdisjoint(left_out)}
        for pair in stale:
            self._ties.pop(pair, None)
            if pair in self._waiting:
                continue
            with suppress(*UNSOLVABLE):
                self._tie(pair, maps, links(pair))
        changed = [set(pair) for pair in stale]
        self._checked = {
            (map_id, partners): checked
            for (map_id, partners), checked in self._checked.items()
            if not any(pair <= {map_id, *partners} for pair in changed)
        }
        ties: dict[MapId, dict[MapId, _Tie]] = {}
        for pair, tie in self._ties.items():
            if not set(pair) & set(left_out):
                for map_id, partner in (pair, pair[::-1]):
                    ties.setdefault(map_id, {})[partner] = tie
        doubts = {
            map_id: _independent(map_id, (k for k, tie in partners.items() if not tie.agrees))
            for map_id, partners in ties.items()
        }
        out: dict[MapId, WrongGeometry] = {}
        for map_id in sorted(doubts, key=lambda map_id: (-doubts[map_id], map_id)):
            if doubts[map_id] < 2:
                break
            agreeing = self._agreeing(map_id, {k: v for k, v in ties[map_id].items() if k not in out}, ties)
            if len(agreeing) < 2:
                continue
            if (map_id, agreeing) not in self._checked:
                self._checked[map_id, agreeing] = False
                with suppress(*UNSOLVABLE):
                    self._checked[map_id, agreeing] = self._is_wrong(map_id, agreeing, maps)
            if self._checked[map_id, agreeing]:
                out[map_id] = WrongGeometry(map_id, agreeing)
        return out

    def _main(self, map_id: MapId, hybrid_map: HybridMap) -> Fragment | None:
        """The largest piece of a map."""
        return max(self.pieces(map_id, hybrid_map), key=len, default=None)

    def pieces(self, map_id: MapId, hybrid_map: HybridMap) -> list[Fragment]:
        """A map by its own edges."""
        return self._memory.fragments({map_id: hybrid_map}, self._s)

    def _tie(self, pair: MapPair, maps: Mapping[MapId, HybridMap], links: Sequence[Link]) -> None:
        """Sort the links between two maps."""
        first, second = (self._main(map_id, maps[map_id]) if map_id in maps else None for map_id in pair)
        if first is None or second is None or first is second:
            return
        inside = [link for link in links if link.a in first.graph.rows and link.b in second.graph.rows]
        if len(inside) >= self._s.least_links:
            some = thinned(inside, MOST_LINKS)
            best = link_sets(some, first, second, self._s)[0]
            self._ties[pair] = _Tie(tuple(inside), tuple(best), len(best) / len(some))

    @staticmethod
    def _agreeing(
        map_id: MapId, own: Mapping[MapId, _Tie], ties: Mapping[MapId, Mapping[MapId, _Tie]]
    ) -> tuple[MapId, ...]:
        """Maps that agree with each other, of those tied to one; empty without two robots against it."""
        some = _in_turns(sorted(own, key=lambda other: (-len(own[other].links), other)))[:MOST_PARTNERS]
        graph: nx.Graph = nx.Graph()
        graph.add_edges_from(
            (a, b) for a in some for b in some if a < b and b in ties[a] and ties[a][b].agrees
        )
        parts = [
            part
            for part in nx.connected_components(graph)
            if _independent(map_id, (k for k in part if not own[k].agrees)) >= 2
        ]
        return tuple(sorted(max(parts, key=len, default=())))

    def _is_wrong(self, map_id: MapId, agreeing: Sequence[MapId], maps: Mapping[MapId, HybridMap]) -> bool:
        """Whether every placement of a map among maps that agree is refuted."""
        placed = self._main(map_id, maps[map_id])
        pieces = [piece for partner in agreeing if (piece := self._main(partner, maps[partner])) is not None]
        assert placed is not None, "a map with links has nodes"
        pairs = [(a, b) for a in agreeing for b in agreeing if a < b and (a, b) in self._ties]
        held = [link for pair in pairs if self._ties[pair].agrees for link in self._ties[pair].best]
        graph = ComponentSolver(pieces).solve(held)[0]
        across = [
            link if link.a.map == map_id else link.turned()
            for partner in agreeing
            for link in thinned(self._ties[min(map_id, partner), max(map_id, partner)].links, MOST_LINKS)
        ]
        across = [link for link in across if link.b in graph.rows]
        every = {k: node for which in (map_id, *agreeing) for k, node in maps[which].nodes.items()}
        return all_refuted(across, placed, Fragment(graph.anchor, graph, ()), every, self._s)


def _independent(map_id: MapId, others: Iterable[MapId]) -> int:
    """How many independent maps there are against one: those of another robot count as one, as it may lie."""
    return len({other if other.agent == map_id.agent else other.agent for other in others})


def _in_turns(maps: Sequence[MapId]) -> list[MapId]:
    """The maps of different robots in turns, those of each robot in their order."""
    before = Counter[str]()
    turns: list[tuple[int, int]] = []
    for k, map_id in enumerate(maps):
        turns.append((before[map_id.agent], k))
        before[map_id.agent] += 1
    return [maps[k] for _, k in sorted(turns)]


def link_sets(
    links: Sequence[Link], first: Fragment, second: Fragment, s: ConsistencySettings
) -> list[list[Link]]:
    """Sets of links in which each agrees with nearly all, grown greedily; largest first.

    If each had to agree with each, one pair of links in a hundred that just fails the gate would cost a tenth
    of 60 sound links.

    Args:
        links: from `first` to `second`, at least one.
        first: piece of map.
        second: piece of map.
        s: when links agree.
    """
    agree = loop_distances2(links, first, second) < s.gate
    np.fill_diagonal(agree, True)
    left, sets = np.ones(len(links), np.bool_), list[list[Link]]()
    while left.any():
        support = np.where(left, (agree & left).sum(axis=1), 0)
        against, members = np.zeros(len(links), np.int64), list[int]()
        for k in np.argsort(-support, kind="stable").tolist():
            if left[k] and against[k] <= (1.0 - AGREEING) * len(members):
                members.append(k)
                against += ~agree[k]
        sets.append([links[k] for k in sorted(members)])
        left[members] = False
    return sorted(sets, key=len, reverse=True)


def is_torn(
    links: Sequence[Link], placed: Fragment, fixed: Fragment, nodes: Sequence[Node], s: ConsistencySettings
) -> bool:
    """Whether a map shows places of others in another arrangement: its own nodes see through each other.

    In a map that is right they do not, wherever it is, and whatever looks like it elsewhere.

    Args:
        links: from `placed` to `fixed`, at least one.
        placed: piece of map.
        fixed: piece of map that several robots agree on.
        nodes: of `placed`, in its order.
        s: when links agree.
    """
    best = link_sets(links, placed, fixed, s)[0]
    if len(best) >= AGREEING * len(links):
        return False  # a place that looks the same, as a whole
    first, agreeing = {link.a for link in best}, {link.key for link in best}
    near = nearly_there(links, placed, fixed)[[k for k, link in enumerate(links) if link.key in agreeing]]
    # Nodes that are a little off are of the same place: its others confirm them, which tells of no tear.
    second = {link.a for link in links} - {links[k].a for k in np.flatnonzero(near.any(axis=0)).tolist()}
    return tears(sorted(first), sorted(second), placed.graph, nodes)


def all_refuted(
    links: Sequence[Link],
    placed: Fragment,
    fixed: Fragment,
    nodes: Mapping[NodeId, Node],
    s: ConsistencySettings,
) -> bool:
    """Whether lines of sight refute every placement by links.

    Args:
        links: from `placed` to `fixed`.
        placed: piece of map that may be wrong.
        fixed: piece of map that several robots agree on.
        nodes: of both.
        s: when links agree.
    """
    if not _nodes_agree(links, fixed) or fits_whole(links, placed, fixed, s):
        return False
    if is_bent(links, placed, fixed) or is_shuffled(links, placed, fixed):
        return True
    if is_torn(links, placed, fixed, [nodes[node_id] for node_id in placed.nodes], s):
        return True
    sets = link_sets(links, placed, fixed, s)
    sets = [some_links for some_links in sets if len(some_links) >= LEAST_SHARE * len(sets[0])]
    own: dict[NodeId, list[Link]] = {}
    for link in links:
        own.setdefault(link.a, []).append(link)
    # By its own links each node is at its true place, regardless of the map's geometry.
    usual = np.concatenate(
        [_seen_through_shares(some, [some_links], placed, fixed, nodes) for some_links, some in own.items()]
    )
    return all(
        more_than_usual(
            _seen_through_shares(
                some_links, sorted(own.keys() - {k.a for k in some_links}), placed, fixed, nodes
            ),
            usual,
        )
        for some_links in sets
    )


def fits_whole(links: Sequence[Link], placed: Fragment, fixed: Fragment, s: ConsistencySettings) -> bool:
    """Whether one placement has nearly all links right, and no node is elsewhere by most of its own links.

    Parts that many links hold do not outvote another part that few links put elsewhere.

    Args:
        links: from `placed` to `fixed`, at least one.
        placed: piece of map.
        fixed: piece of map that several maps agree on.
        s: when links agree.
    """
    best = {link.key for link in link_sets(links, placed, fixed, s)[0]}
    if len(best) < AGREEING * len(links):
        return False
    agreeing = [k for k, link in enumerate(links) if link.key in best]
    near = nearly_there(links, placed, fixed, (SAME_XY, SAME_HEADING))[agreeing].any(axis=0)
    held = Counter(link.a for link in links)
    there = Counter(links[k].a for k in np.flatnonzero(near).tolist())
    return all(2 * there[node] >= count for node, count in held.items())


def _nodes_agree(links: Sequence[Link], fixed: Fragment) -> bool:
    """Whether the links of each single node agree where it is.

    They do, with any geometry of its map. Otherwise many links are false by perceptual aliasing, and a map
    with only false links would be refuted everywhere too.
    """
    places: dict[NodeId, list[Pose2]] = {}
    for link in sorted(links, key=lambda link: -link.weight):
        places.setdefault(link.a, []).append(fixed.graph.pose(link.b) @ link.a_from_b.mean.inverse())
    agree = [
        best.distance(placement) < SAME_XY
        and abs(wrap_angle(best.heading - placement.heading)) < SAME_HEADING
        for best, *rest in places.values()
        for placement in rest
    ]
    return len(agree) >= LEAST_NODES and sum(agree) >= AGREEING * len(agree)


def _seen_through_shares(
    links: Sequence[Link],
    which: Sequence[NodeId],
    placed: Fragment,
    fixed: Fragment,
    nodes: Mapping[NodeId, Node],
) -> Array:
    """For each node that can be placed, the share of its comparable landmarks that are seen through.

    Args:
        links: links from `placed` to `fixed` that place it.
        which: nodes of `placed`.
        placed: piece of map.
        fixed: piece of map.
        nodes: of both.
    """
    starts, ends = [link.a for link in links], [link.b for link in links]
    measured = PoseGaussians(
        np.stack([link.a_from_b.mean.vector for link in links]),
        np.stack([link.a_from_b.covariance for link in links]),
    ).inverse()
    means, out = fixed.graph.means, []
    for node_id in which:
        by_link = measured @ placed.graph.relative(starts, [node_id] * len(starts))
        surest = int(np.trace(by_link.covariances[:, :2, :2], axis1=1, axis2=2).argmin())
        covariance = by_link.covariances[surest]
        sigma_xy = math.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])
        sigma_heading = math.sqrt(covariance[2, 2])
        if sigma_xy > MOST_SIGMA_XY or sigma_heading > MOST_SIGMA_HEADING:
            continue
        at = fixed.graph.pose(ends[surest]) @ Pose2.from_vector(by_link.means[surest])
        away = np.hypot(means[:, 0] - at.x, means[:, 1] - at.y)
        counts = np.zeros(2, np.int64)
        for k in np.argsort(away, kind="stable")[:MOST_NEAR]:
            if away[k] < REACH:
                a, b = nodes[node_id], nodes[fixed.nodes[k]]
                b_from_a = Pose2.from_vector(means[k]).inverse() @ at
                counts += seen_through(a, b, b_from_a, sigma_xy, sigma_heading)
                counts += seen_through(b, a, b_from_a.inverse(), sigma_xy, sigma_heading)
        if counts[0] >= LEAST_LANDMARKS:
            out.append(counts[1] / counts[0])
    return np.array(out)
