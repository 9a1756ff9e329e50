"""Torn maps: maps that show places of two robots, in another arrangement than the one that those agree on.

Mutual exclusion refutes all links of such a map with both robots, as it does with a map of rooms that look
the same; and rooms that look the same may be in another arrangement elsewhere. But robots do not see through
walls: where the map has the one robot's places among the other's, its own nodes see through each other. In a
map that is right they do not, wherever it is.

Others are not asked, so no robot makes a map of another one seem torn.
"""

from __future__ import annotations

import zlib
from collections import Counter, defaultdict
from collections.abc import Sequence
from random import Random

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.merge.mutual_exclusion.collision import is_exclusion
from mapweave.merge.outlier_rejection.wrong_geometry import UNSOLVABLE, is_torn
from mapweave.merge.pose_graph.candidates import Pair
from mapweave.merge.pose_graph.fragments import Fragment
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from mapweave.merge.settings import ConsistencySettings

MOST_OF_A_NODE = 2
"""Links of each node that are tested, those with most landmarks: so many confirm each other."""
MOST_NODES = 100
"""Nodes of a map that are tested, drawn."""
Excluded = dict[tuple[int, int], dict[str, list[Link]]]
"""Refused links from one component to another, by the robot at their far end."""
Behind = tuple[HybridMap | PoseGraph, ...]
"""What a finding rests on besides the links, compared by identity."""


class TornMapSearch:
    """Finds torn maps in merged maps. What was found of links and components that did not change is kept."""

    def __init__(self, consistency: ConsistencySettings) -> None:
        """Nothing is known yet.

        Args:
            consistency: when links agree.
        """
        self._s = consistency
        self._known: dict[frozenset[Pair], tuple[Behind, bool]] = {}

    def torn(self, merged: MergedMap) -> dict[MapId, str]:
        """The torn maps of a merged map, and what they contradict, in words."""
        out: dict[MapId, str] = {}
        known: dict[frozenset[Pair], tuple[Behind, bool]] = {}
        for (alone, joined), by_robot in _excluded(merged).items():
            links = _thinned([link for some in by_robot.values() for link in some])
            placed, fixed = merged.graphs[alone], merged.graphs[joined]
            key = frozenset(link.key for link in links)
            # Links agree by both components: also by where the others have the nodes at the far ends.
            behind: Behind = (placed, fixed, *(merged.maps[map_id] for map_id in sorted(placed.maps)))
            before = self._known.get(key)
            if before is None or [*map(id, before[0])] != [*map(id, behind)]:
                before = behind, self._is_torn(links, placed, fixed, merged)
            known[key] = before
            if before[1]:
                *most, last = sorted(by_robot)
                robots = f"{', '.join(most)} and {last}"
                words = f"it shows places of {robots} in another arrangement than theirs"
                out |= dict.fromkeys(sorted(placed.maps), words)
        self._known = known
        return out

    def _is_torn(self, links: Sequence[Link], placed: PoseGraph, fixed: PoseGraph, merged: MergedMap) -> bool:
        if len(links) < 2:
            return False
        pieces = Fragment(placed.anchor, placed, ()), Fragment(fixed.anchor, fixed, ())
        nodes = [merged.maps[node.map].nodes[node] for node in placed.nodes]
        try:
            return is_torn(links, *pieces, nodes, self._s)
        except UNSOLVABLE:
            return False


def _excluded(merged: MergedMap) -> Excluded:
    """Links of maps that nothing joins, with components in which two robots exclude them."""
    robots = [{map_id.agent for map_id in graph.maps} for graph in merged.graphs]
    links: Excluded = defaultdict(lambda: defaultdict(list))
    excluded = Counter[tuple[int, int, str]]()
    by_reason = {reason: is_exclusion(reason) for reason in {r.reason for r in merged.refused}}
    if not any(by_reason.values()):
        return {}
    for refusal in merged.refused:
        if refusal.link is None or refusal.edge is not None or refusal.a.agent == refusal.b.agent:
            continue
        for link in (refusal.link, refusal.link.turned()):
            alone, joined = merged.component_of(link.a), merged.component_of(link.b)
            if alone is None or joined is None or len(robots[alone]) > 1 or len(robots[joined]) < 2:
                continue
            robot = link.b.agent
            links[alone, joined][robot].append(link)
            excluded[alone, joined, robot] += by_reason[refusal.reason]
    out: Excluded = {}
    for pair, by_robot in links.items():
        against = {robot: some for robot, some in by_robot.items() if 2 * excluded[*pair, robot] > len(some)}
        if len(against) >= 2:
            out[pair] = against
    return out


def _thinned(links: Sequence[Link]) -> list[Link]:
    """The links of some nodes with most landmarks, so many of each.

    The nodes are drawn: of those of two robots in turns, every second one would be of one robot alone. The
    draw depends on the links only, not on their order.
    """
    ordered = sorted(links, key=lambda link: (link.a, -link.weight, link.b))
    own: dict[NodeId, list[Link]] = {}
    for link in ordered:
        own.setdefault(link.a, []).append(link)
    draw = Random(zlib.crc32(" ".join(f"{link.a} {link.b}" for link in ordered).encode()))
    drawn = draw.sample(list(own), min(len(own), MOST_NODES))
    return [link for node in sorted(drawn) for link in own[node][:MOST_OF_A_NODE]]
