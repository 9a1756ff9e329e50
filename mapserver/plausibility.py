"""Plausibility: what is in a map that no robot can have measured, in words.

Such a map is merged as far as its links carry it, but it moves and joins no others
(mapweave.merge.pose_graph.staged_optimization), and it is no second place: where it shows what other maps
show it makes no answer ambiguous (mapweave.mapserver.active_nodes).
"""

from collections import Counter
from collections.abc import Collection, Container, Mapping

from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId
from mapweave.hybridmap.node import EdgeKind
from mapweave.mapserver.retrieval.compared_landmarks import MOST_LANDMARKS
from mapweave.merge.mutual_exclusion.trajectories import runs_backwards
from mapweave.merge.pose_graph.merged_map import MergedMap


def implausible(hybrid_map: HybridMap) -> str:
    """What no robot can have measured; empty if all of a map may be true."""
    nodes = sorted(hybrid_map.nodes.values(), key=lambda node: node.id)
    most = max(nodes, key=lambda node: len(node.landmarks), default=None)
    if most is not None and len(most.landmarks) > MOST_LANDMARKS:
        return f"node {most.id} has {len(most.landmarks)} landmarks, of which {MOST_LANDMARKS} are compared"
    for clock in sorted({node.clock for node in nodes} - {""}):
        if runs_backwards([node for node in nodes if node.clock == clock]):
            return f"its clock {clock} runs backwards: nothing is concluded from its times"
    return ""


def contradict_themselves(merged: MergedMap) -> dict[MapId, str]:
    """Maps whose own loops contradict their own way, in words.

    A robot closes no loop that contradicts its way: this tells a wrong way apart from places that look alike,
    which contradict each other as well.
    """
    refused = {refusal.edge for refusal in merged.refused if refusal.edge is not None}
    many = Counter(MapId(*edge[:2]) for edge in refused)
    out: dict[MapId, str] = {}
    for map_id in sorted(map_id for map_id, count in many.items() if count >= LEAST_CONTRADICTIONS):
        if map_id not in merged.maps:
            continue
        edges = sorted(merged.maps[map_id].edges.values(), key=lambda edge: edge.id)
        # Of two nodes the last loop counts; the others are refused for that alone.
        loops = {(edge.a, edge.b): edge.id for edge in edges if edge.kind is EdgeKind.LOOP and edge.within}
        against = len(refused.intersection(loops.values()))
        if against >= max(LEAST_CONTRADICTIONS, 0.5 * len(loops)):
            out[map_id] = f"it contradicts itself: {against} of its {len(loops)} loops do not fit its own way"
    return out


def contradict_each_other(merged: MergedMap) -> dict[MapId, str]:
    """Maps of robots that leave very many which show the same places and contradict each other, in words.

    Counted are maps that nothing joins with another robot's, with links to other maps of their own robot of
    which none is accepted.
    """
    refused = {
        (end.map, other.map)
        for refusal in merged.refused
        if refusal.link is not None and refusal.a.agent == refusal.b.agent and refusal.a.map != refusal.b.map
        for end, other in (refusal.pair, refusal.pair[::-1])
    }
    joined = {map_id for graph in merged.graphs if len(graph.maps) > 1 for map_id in graph.maps}
    by_robot: dict[str, list[MapId]] = {}
    for map_id in sorted({first for first, _ in refused} - joined):
        by_robot.setdefault(map_id.agent, []).append(map_id)
    return {
        map_id: f"it and {len(some) - 1} others of its robot show the same places and contradict each other"
        for some in by_robot.values()
        if len(some) > MOST_FRAGMENTS
        for map_id in some
    }


LEAST_CONTRADICTIONS = 4
"""Loops of a map that contradict its own way, at least: one or two may be false."""
LEAST_NODES = 4
"""Of a map whose geometry can be tested."""
MOST_FRAGMENTS = 8
"""Of a robot, and maps with wrong geometry. One that loses its way leaves one or two a day."""


def fragments(maps: Mapping[MapId, HybridMap], pruned: Container[MapId] = ()) -> list[MapId]:
    """Maps with fewer nodes that their robots have left for others: nothing tells whether they are right.

    Of a robot that leaves very many, the newest as well.

    Args:
        maps: by id.
        pruned: maps that had more nodes, which newer ones have superseded.
    """
    small: dict[str, list[MapId]] = {}
    newest: dict[str, int] = {}
    for map_id, hybrid_map in sorted(maps.items()):
        newest[map_id.agent] = map_id.epoch
        if len(hybrid_map.nodes) < LEAST_NODES and map_id not in pruned:
            small.setdefault(map_id.agent, []).append(map_id)
    return [
        map_id
        for robot, some in small.items()
        for map_id in some
        if map_id.epoch < newest[robot] or len(some) > MOST_FRAGMENTS
    ]


def unreliable_robots(
    maps: Mapping[MapId, HybridMap], wrong: Collection[MapId], pruned: Container[MapId] = ()
) -> dict[str, set[MapId]]:
    """Robots with very many maps, and most of their nodes in them, that are wrong or too small: these maps.

    No test finds every wrong map, and each is one more place where a robot seems to be.
    """
    bad: dict[str, set[MapId]] = {}
    balance = Counter[str]()
    for map_id, hybrid_map in maps.items():
        if map_id in wrong or (len(hybrid_map.nodes) < LEAST_NODES and map_id not in pruned):
            bad.setdefault(map_id.agent, set()).add(map_id)
            balance[map_id.agent] += len(hybrid_map.nodes)
        else:
            balance[map_id.agent] -= len(hybrid_map.nodes)
    return {robot: some for robot, some in bad.items() if len(some) > MOST_FRAGMENTS and balance[robot] > 0}


def scattered(maps: Mapping[MapId, HybridMap], pruned: Container[MapId] = ()) -> dict[MapId, str]:
    """The fragments of each robot that leaves very many, in words; see `fragments`.

    One view that comes again in many maps would move the nodes of others as often as it comes.
    """
    by_robot: dict[str, list[MapId]] = {}
    for map_id in fragments(maps, pruned):
        by_robot.setdefault(map_id.agent, []).append(map_id)
    words = f"its robot has left {MOST_FRAGMENTS} maps and more with fewer than {LEAST_NODES} nodes each"
    return {one: words for some in by_robot.values() if len(some) >= MOST_FRAGMENTS for one in some}
