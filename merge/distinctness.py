"""Distinctness: which landmarks tell a place at all.

In a warehouse the same cartons stand in every other bay. What two nodes share there is found again between
many nodes, and each time the geometry is right: nothing in the two images tells that it is another bay. But
the fleet's maps do. A node's landmark that was recognised at one place, and at another one which by that
robot's own way is not the same, is something that there is twice; so is one that a loop recognised against
its map's own way. Such a landmark says what is seen, not where. It counts for no link of its node, wherever
that leads to: only the rest of a link's landmarks speak for it. (Text retrieval has long weighed words by how
few documents they are in, Sparck Jones 1972; here geometry tells which landmarks are in how many places.)

What is left of a true link is what there is nowhere else: a sign, a wall, the one bay with other goods.

Landmarks are followed from node to node, by the images that a robot saw on its way and by loops that agree
with it: what is found out at one node holds for all that show the same thing.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from hybridmap.hybrid_map import HybridMap
from hybridmap.node import EdgeKind, MapId, NodeId
from hybridmap.pose_arrays import PoseGaussians, compose_poses, inverse_poses
from merge.consistency import ConsistencySettings
from merge.fragments import Fragment
from merge.links import DOUBLES, Link, link_of

FOLLOWED = (EdgeKind.MAPPED, EdgeKind.TURNED)
"""Edges whose two nodes share landmarks that were tracked from image to image."""

Landmark = tuple[NodeId, int]
"""Which node, and which of its landmarks."""


@dataclass(frozen=True)
class DistinctnessSettings:
    """When two recognitions mean two places.

    Attributes:
        apart_xy: they contradict each other by more than this, m, or
        apart_heading: by more than this, rad. Less is how well places are measured, not another place.
    """

    apart_xy: float = 0.25
    apart_heading: float = 0.17


def weigh(
    links: Sequence[Link],
    by_node: Mapping[NodeId, Fragment],
    maps: Mapping[MapId, HybridMap],
    consistency: ConsistencySettings | None = None,
    settings: DistinctnessSettings | None = None,
) -> list[Link]:
    """Count how many landmarks of each link are found at other places too.

    Args:
        links: verified, both nodes in fragments.
        by_node: the fragment of each node.
        maps: with the robots' own edges.
        consistency: when two measurements contradict each other,
        settings: and by how much at least.

    Returns:
        The links in the same order; where there are such landmarks, with their number among the evidence.
        Links that do not tell their landmarks stay as they are. The order has no say.
    """
    c, s = consistency or ConsistencySettings(), settings or DistinctnessSettings()
    claims = [link_of(e) for one in maps.values() for e in one.edges.values() if e.kind is EdgeKind.LOOP]
    told = (link for link in (*links, *claims) if len(link.shared))
    known = [link for link in told if link.a in by_node and link.b in by_node]
    loops = [link for link in known if by_node[link.a] is by_node[link.b]]
    astray = _contradictions([(link, None) for link in loops], by_node, c, s)
    doubles: set[Landmark] = set()
    for link, wrong in zip(loops, astray, strict=True):
        if wrong:
            doubles |= _ends(link)
    pairs = list(_pairs(known, by_node))
    for (one, other), wrong in zip(pairs, _contradictions(pairs, by_node, c, s), strict=True):
        if wrong:
            both = np.intersect1d(one.shared[:, 0], other.shared[:, 0])
            doubles |= {(one.a, int(landmark)) for landmark in both}
    agreeing = [link for link, wrong in zip(loops, astray, strict=True) if not wrong]
    doubles = _followed(doubles, agreeing, maps)
    return [_weighed(link, doubles) for link in links]


def _pairs(links: Sequence[Link], by_node: Mapping[NodeId, Fragment]) -> Iterator[tuple[Link, Link]]:
    """Links from one node into one other fragment, two by two, both seen from that node."""
    meeting: dict[tuple[NodeId, NodeId], list[Link]] = defaultdict(list)
    for link in links:
        if by_node[link.a] is not by_node[link.b]:
            meeting[link.a, by_node[link.b].name].append(link)
            meeting[link.b, by_node[link.a].name].append(link.turned())
    for some in meeting.values():
        yield from combinations(some, 2)


def _contradictions(
    pairs: Sequence[tuple[Link, Link | None]],
    by_node: Mapping[NodeId, Fragment],
    c: ConsistencySettings,
    s: DistinctnessSettings,
) -> NDArray[np.bool_]:
    """(N,) whether two links from one node to two others contradict the way between these; or, without a
    second link, a loop the way between its ends.
    """
    out = np.zeros(len(pairs), bool)
    inside: dict[NodeId, list[int]] = defaultdict(list)
    for k, (one, _) in enumerate(pairs):
        inside[by_node[one.b].name].append(k)
    for seats in inside.values():
        here = [pairs[k] for k in seats]
        graph = by_node[here[0][0].b].graph
        starts = [one.b for one, _ in here]
        ends = [one.a if other is None else other.b for one, other in here]
        a, b = graph.means[graph.index(starts)], graph.means[graph.index(ends)]
        off = compose_poses(_between(here).means, compose_poses(inverse_poses(b), a))
        far = np.flatnonzero(
            (np.hypot(off[:, 0], off[:, 1]) > s.apart_xy) | (abs(off[:, 2]) > s.apart_heading)
        )
        if len(far):
            # Covariances cost more than all the rest: only where places seem to be different.
            back = graph.relative([ends[k] for k in far], [starts[k] for k in far])
            loop = _between([here[k] for k in far]) @ back
            floor = np.diag([c.floor_xy**2, c.floor_xy**2, c.floor_heading**2])
            wrong = PoseGaussians(loop.means, loop.covariances + floor).distances2() > c.gate
            out[np.array(seats)[far[wrong]]] = True
    return out


def _between(pairs: Sequence[tuple[Link, Link | None]]) -> PoseGaussians:
    """How the far ends stand to each other by the links alone: of a loop, its b and its a."""
    back = _postures([one for one, _ in pairs]).inverse()
    onward = [k for k, (_, other) in enumerate(pairs) if other is not None]
    means, covariances = np.zeros((len(pairs), 3)), np.zeros((len(pairs), 3, 3))
    if onward:
        there = _postures([other for _, other in pairs if other is not None])
        means[onward], covariances[onward] = there.means, there.covariances
    return back @ PoseGaussians(means, covariances)


def _postures(links: Sequence[Link]) -> PoseGaussians:
    return PoseGaussians(
        np.stack([link.a_from_b.mean.vector for link in links]),
        np.stack([link.a_from_b.covariance for link in links]),
    )


def _ends(link: Link) -> set[Landmark]:
    """The landmarks that a link rests on, at either end."""
    return {(node, int(k)) for node, column in zip(link.pair, link.shared.T, strict=True) for k in column}


def _followed(
    doubles: Iterable[Landmark], loops: Sequence[Link], maps: Mapping[MapId, HybridMap]
) -> set[Landmark]:
    """All landmarks that show the same things as some."""
    by_loop: dict[NodeId, list[Link]] = defaultdict(list)
    for link in loops:
        by_loop[link.a].append(link)
        by_loop[link.b].append(link.turned())
    onward: dict[NodeId, dict[int, list[Landmark]]] = {}
    found, waiting = set(doubles), list(doubles)
    while waiting:
        node, landmark = waiting.pop()
        if node not in onward:
            onward[node] = _next_to(node, by_loop.get(node, ()), maps[node.map])
        fresh = [same for same in onward[node].get(landmark, ()) if same not in found]
        found.update(fresh)
        waiting += fresh
    return found


def _next_to(node: NodeId, loops: Iterable[Link], one: HybridMap) -> dict[int, list[Landmark]]:
    """Which landmarks of other nodes show the same things as a node's own."""
    edges = (one.edges[key] for _, _, key in one.graph.edges(node, keys=True))
    ways = [link_of(edge) for edge in edges if edge.kind in FOLLOWED]
    table: dict[int, list[Landmark]] = defaultdict(list)
    for way in (*(way if way.a == node else way.turned() for way in ways), *loops):
        for i, j in way.shared.tolist():
            table[i].append((way.b, j))
    return table


def _weighed(link: Link, doubles: set[Landmark]) -> Link:
    count = 0
    if doubles:
        count = sum((link.a, i) in doubles or (link.b, j) in doubles for i, j in link.shared.tolist())
    if count == link.doubles:
        return link
    evidence = {name: value for name, value in link.evidence.items() if name != DOUBLES}
    return replace(link, evidence={**evidence, DOUBLES: float(count)} if count else evidence)
