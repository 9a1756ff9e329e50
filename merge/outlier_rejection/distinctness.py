"""Distinctness: which landmarks identify a place.

In a warehouse the same cartons are in every other bay. Landmarks that two nodes share there are found again
between many nodes, each time with correct geometry: nothing in the two images shows that it is another bay.
But the fleet's maps do. A node's landmark that was recognised at one place, and at another that by that
robot's own drive is different, occurs twice; so does one that a loop closure recognised against its map's own
drive. Such a landmark is aliased: it shows what is seen, not where. It counts for no link of its node; only
the rest of a link's landmarks support it. (Text retrieval weights words by how few documents contain them,
Sparck Jones 1972; here geometry shows at how many places a landmark is.)

What remains of a true link is unique: a sign, a wall, a bay with other goods.

Who says that a landmark occurs twice is the source of that: the robot by whose drive the two places differ.
A robot is believed about the links of its own maps; about links between others only if a second one says the
same. Else one robot with a wrong drive, or with copies of others' nodes, would part all maps.

Landmarks are followed from node to node, by the images that a robot saw on its way and by loops that agree
with it: what is found out at one node holds for all that show the same thing.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.explanation import ALIASED
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.node import EdgeKind
from mapweave.hybridmap.pose import Array
from mapweave.merge.pose_graph.factors import LOOP_FLOOR
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link, link_of
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.merge.settings import ConsistencySettings
from mapweave.registration.pose_arrays import PoseGaussians, compose_poses, inverse_poses

FOLLOWED = (EdgeKind.MAPPED, EdgeKind.TURNED)
"""Edges whose two nodes share landmarks that were tracked from image to image."""

Landmark = tuple[NodeId, int]
"""Which node, and which of its landmarks."""
ENOUGH = 2
"""Robots that say the same are believed about all links."""
Sources = dict[Landmark, set[str]]
"""Aliased landmarks with the names of robots that say so, `ENOUGH` of them at most."""


def weigh(
    links: Sequence[Link],
    by_node: Mapping[NodeId, Fragment],
    maps: Mapping[MapId, HybridMap],
    consistency: ConsistencySettings | None = None,
) -> list[Link]:
    """Count how many landmarks of each link are found at other places too.

    Args:
        links: verified, both nodes in fragments.
        by_node: the fragment of each node.
        maps: with the robots' own edges.
        consistency: when two measurements contradict each other,

    Returns:
        The links in the same order; where there are such landmarks, with their number among the evidence.
        Links without landmarks are unchanged. The result does not depend on the order.
    """
    c = consistency or ConsistencySettings()
    # A robot's edges between nodes of others are not images: those nodes would lose links by them.
    own = (e for a in maps.values() for e in a.edges.values() if e.within)
    claims = [link_of(e) for e in own if e.kind is EdgeKind.LOOP]
    with_landmarks = (link for link in (*links, *claims) if len(link.shared))
    connected = [link for link in with_landmarks if link.a in by_node and link.b in by_node]
    aliased: Sources = {}
    if connected:
        sides = _Sides.of(connected, by_node)
        loops, pairs = sides.loops(), sides.pairs()
        astray = sides.contradict(loops, None, c)
        claimed = [(end, connected[k].a.agent) for k in loops[astray] for end in _ends(connected[k])]
        for i, j in pairs[sides.contradict(pairs[:, 0], pairs[:, 1], c)]:
            node, a, b = sides.meeting(i, j)
            source = sides.agent(i)
            claimed += [((node, int(landmark)), source) for landmark in np.intersect1d(a, b)]
        if claimed:
            aliased = _followed(claimed, [connected[k] for k in loops[~astray]], maps)
    return [_weighed(link, aliased) for link in links]


APART_XY = 0.5
"""Recognitions contradict each other if they are further apart than this, m,"""
APART_HEADING = 0.26
"""or turned by more than this, rad. Less is how well places are measured, not another place."""


@dataclass(frozen=True, eq=False)
class _Sides:
    """N links, each from both of its sides: row k as link k has it, row N + k turned round.

    Attributes:
        links: N.
        poses: (2N) of the far end in the near one.
        near: (2N,) rows in `places`.
        far: (2N,) likewise.
        fragments: (P,) which fragment a place is in.
        places: (P, 3) m, m, rad, all nodes of the fragments, each in its fragment's frame.
        graphs: of the fragments.
        starts: (F,) first row of each fragment.
    """

    links: Sequence[Link]
    poses: PoseGaussians
    near: NDArray[np.int64]
    far: NDArray[np.int64]
    fragments: NDArray[np.int64]
    places: Array
    graphs: tuple[PoseGraph, ...]
    starts: NDArray[np.int64]

    @staticmethod
    def of(links: Sequence[Link], by_node: Mapping[NodeId, Fragment]) -> _Sides:
        """The distinctness of links with both nodes in fragments."""
        graphs = {by_node[node].name: by_node[node].graph for link in links for node in link.pair}
        sizes = [len(graph.nodes) for graph in graphs.values()]
        starts = np.cumsum([0, *sizes[:-1]])
        first = dict(zip(graphs, starts.tolist(), strict=True))
        a, b = (
            np.array([first[by_node[node].name] + graphs[by_node[node].name].rows[node] for node in nodes])
            for nodes in zip(*(link.pair for link in links), strict=True)
        )
        far_poses = PoseGaussians(
            np.array([(m.x, m.y, m.heading) for m in (link.a_from_b.mean for link in links)]),
            np.array([link.a_from_b.covariance for link in links]),
        )
        back = far_poses.inverse()
        return _Sides(
            links,
            PoseGaussians(
                np.concatenate([far_poses.means, back.means]),
                np.concatenate([far_poses.covariances, back.covariances]),
            ),
            np.concatenate([a, b]),
            np.concatenate([b, a]),
            np.repeat(np.arange(len(sizes)), sizes),
            np.concatenate([graph.means for graph in graphs.values()]),
            tuple(graphs.values()),
            starts,
        )

    def loops(self) -> NDArray[np.int64]:
        """(L,) links within one fragment."""
        count = len(self.links)
        same_fragment = self.fragments[self.near[:count]] == self.fragments[self.far[:count]]
        return np.flatnonzero(same_fragment)

    def pairs(self) -> NDArray[np.int64]:
        """(K, 2) sides that go from one node into one other fragment, two by two."""
        out = np.flatnonzero(self.fragments[self.near] != self.fragments[self.far])
        keys = self.near[out] * len(self.graphs) + self.fragments[self.far[out]]
        order = np.argsort(keys, kind="stable")
        cuts = np.flatnonzero(np.diff(keys[order])) + 1
        groups = np.split(out[order], cuts)
        pairs = [pair for group in groups for pair in combinations(group.tolist(), 2)]
        return np.array(pairs, np.int64).reshape(-1, 2)

    def meeting(self, i: int, j: int) -> tuple[NodeId, NDArray[np.int64], NDArray[np.int64]]:
        """The node from which two sides go, and (K,) and (L,) indices of its landmarks that each rests on."""
        count = len(self.links)
        links = self.links[i % count], self.links[j % count]
        columns = int(i >= count), int(j >= count)
        a, b = (link.shared[:, column] for link, column in zip(links, columns, strict=True))
        return links[0].pair[columns[0]], a, b

    def agent(self, side: int) -> str:
        """The robot into whose map a side goes."""
        agent: str = self.graphs[self.fragments[self.far[side]]].anchor.agent
        return agent

    def contradict(
        self,
        sides: NDArray[np.int64],
        but: NDArray[np.int64] | None,
        c: ConsistencySettings,
    ) -> NDArray[np.bool_]:
        """(K,) whether two sides that go out from one node contradict the way between their far ends.

        Args:
            sides: (K,) which.
            but: (K,) which; None: loops, and the way between the two ends of each.
            c: when they contradict it,
        """
        starts = self.far[sides]
        ends = self.near[sides] if but is None else self.far[but]
        own = compose_poses(inverse_poses(self.places[ends]), self.places[starts])
        off = compose_poses(self._between(sides, but).means, own)
        much = (np.hypot(off[:, 0], off[:, 1]) > APART_XY) | (abs(off[:, 2]) > APART_HEADING)
        out = np.zeros(len(sides), bool)
        # Covariances cost more than all the rest: only where places seem to be different.
        for fragment in np.unique(self.fragments[starts[much]]):
            rows = np.flatnonzero(much & (self.fragments[starts] == fragment))
            nodes, first = self.graphs[fragment].nodes, self.starts[fragment]
            back = self.graphs[fragment].relative(
                [nodes[k - first] for k in ends[rows]], [nodes[k - first] for k in starts[rows]]
            )
            loop = self._between(sides[rows], None if but is None else but[rows]) @ back
            out[rows] = PoseGaussians(loop.means, loop.covariances + LOOP_FLOOR).distances2() > c.gate
        return out

    def _between(self, sides: NDArray[np.int64], but: NDArray[np.int64] | None) -> PoseGaussians:
        """Relative pose of the far ends by the links alone; of a loop, of its far and its near end."""
        back = self.poses.take(sides).inverse()
        return back if but is None else back @ self.poses.take(but)


def _ends(link: Link) -> set[Landmark]:
    """The landmarks that a link rests on, at either end."""
    return {(node, int(k)) for node, column in zip(link.pair, link.shared.T, strict=True) for k in column}


def _followed(
    claimed: Iterable[tuple[Landmark, str]], loops: Sequence[Link], maps: Mapping[MapId, HybridMap]
) -> Sources:
    """All landmarks that show the same things as some that are claimed to be aliased, with who says so."""
    by_loop: dict[NodeId, list[Link]] = defaultdict(list)
    for link in loops:
        by_loop[link.a].append(link)
        by_loop[link.b].append(link.turned())
    onward: dict[NodeId, dict[int, list[Landmark]]] = {}
    sources: Sources = defaultdict(set)
    waiting = list(claimed)
    while waiting:
        (node, landmark), source = waiting.pop()
        known = sources[node, landmark]
        if source in known or len(known) == ENOUGH:
            continue
        known.add(source)
        if node not in onward:
            onward[node] = _next_to(node, by_loop.get(node, ()), maps[node.map])
        waiting += [(same, source) for same in onward[node].get(landmark, ())]
    return sources


def _next_to(node: NodeId, loops: Iterable[Link], hybrid_map: HybridMap) -> dict[int, list[Landmark]]:
    """Which landmarks of other nodes show the same things as a node's own."""
    ways = [link_of(edge) for edge in hybrid_map.edges_at(node) if edge.kind in FOLLOWED and edge.within]
    table: dict[int, list[Landmark]] = defaultdict(list)
    for way in (*(way if way.a == node else way.turned() for way in ways), *loops):
        for i, j in way.shared.tolist():
            table[i].append((way.b, j))
    return table


def _weighed(link: Link, aliased: Sources) -> Link:
    count = 0
    if aliased:
        agents = {link.a.agent, link.b.agent}

        def counts(landmark: Landmark) -> bool:
            sources = aliased.get(landmark, ())
            return len(sources) == ENOUGH or not agents.isdisjoint(sources)

        count = sum(counts((link.a, i)) or counts((link.b, j)) for i, j in link.shared.tolist())
    if count == link.aliased:
        return link
    evidence = {name: value for name, value in link.evidence.items() if name != ALIASED}
    return replace(link, evidence={**evidence, ALIASED: float(count)} if count else evidence)
