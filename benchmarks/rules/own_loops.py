"""A robot's own loop closures, half of them false, merged with all rules on them, and without each."""

import statistics
from dataclasses import replace

import numpy as np

from mapweave.agent.mapping.loop_closures import LoopClosures, agrees_with_way
from mapweave.hybridmap.change import EdgePut, NodePut
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import EdgeId
from mapweave.hybridmap.node import Edge, EdgeKind
from mapweave.hybridmap.pose import Pose2, PoseGaussian
from mapweave.merge.merging import merge_maps
from mapweave.merge.pose_graph.links import Link
from synthetic.fleet import FleetSettings, SyntheticFleet, draw_fleet
from synthetic.merge_rivals import error

ALONE = FleetSettings(robots=1, nodes=120, true_links=30)
"""One robot."""
SHARES = (20, 50, 80)
"""Of false loop closures, per cent."""
RESUMED = {"whole": 0, "resumed": 3}
"""So often the robot was switched off and carried off on the way, by the name of the result."""
DROVE = 3
"""Of the loop closures one of so many was driven as well, if it is true, and measured wrongly then."""
ASTRAY = 0.7
"""So far off is that drive, m."""


def draw(
    seed: int, run: int, share: int, resumed: int
) -> tuple[SyntheticFleet, HybridMap, dict[EdgeId, bool]]:
    """A robot's map with loop closures, and which of these are true."""
    rng = np.random.default_rng([seed, run, share])
    fleet = draw_fleet(share / 100.0, rng, ALONE)
    ((map_id, whole),) = fleet.maps.items()
    out, true = HybridMap(), dict[EdgeId, bool]()
    for _, node in sorted(whole.nodes.items()):
        out.apply(NodePut(node))
    begun = {round(k * ALONE.nodes / (resumed + 1)) for k in range(1, resumed + 1)}
    for edge in whole.edges.values():
        if edge.b.number not in begun:
            out.apply(EdgePut(edge))

    def add(link: Link, kind: EdgeKind, right: bool) -> None:
        edge_id = EdgeId(map_id.agent, map_id.epoch, 10 * ALONE.nodes + len(true))
        true[edge_id] = right
        out.apply(EdgePut(Edge(edge_id, link.a, link.b, link.a_from_b, kind, evidence=link.evidence)))

    for link in sorted(fleet.links, key=lambda link: link.pair):
        add(link, EdgeKind.LOOP, link.pair in fleet.true)
    for link in sorted(fleet.links, key=lambda link: link.pair)[::DROVE]:
        if link.pair in fleet.true:
            astray = Pose2(ASTRAY * float(rng.choice([-1.0, 1.0])), 0.0, 0.0)
            measured = PoseGaussian(link.a_from_b.mean @ astray, 0.25 * link.a_from_b.covariance)
            add(replace(link, a_from_b=measured), EdgeKind.DRIVEN, False)
    return fleet, out, true


def would_send(own: HybridMap, loop: Edge) -> bool:
    """Whether a robot with this map compares the two nodes at all, and believes such a loop closure.

    What the map server is given here is drawn from everywhere, so that its own rules have something to do.
    """
    earlier, later = own.nodes[loop.a], own.nodes[loop.b]
    tried = LoopClosures(own, lambda: later.id).nearby(later, None)
    return earlier in tried and agrees_with_way(earlier, later, loop.a_from_b)


def own_loops(seed: int, count: int) -> dict[str, dict[str, dict[str, float]]]:
    """What comes of so many maps of each share of false loop closures: by whether resumed, and by share."""
    out: dict[str, dict[str, dict[str, float]]] = {}
    for name, resumed in RESUMED.items():
        for share in SHARES:
            errors, false, kept, of, sent = [], 0, 0, 0, {True: 0, False: 0}
            for run in range(count):
                fleet, own, true = draw(seed, run, share, resumed)
                merged = merge_maps({next(iter(fleet.maps)): own}, [])
                errors.append(error(merged, fleet.truth))
                refused = {refusal.edge for refusal in merged.refused}
                false += sum(not right and edge not in refused for edge, right in true.items())
                kept += sum(right and edge not in refused for edge, right in true.items())
                of += sum(true.values())
                for edge, right in true.items():
                    sent[right] += own.edges[edge].kind is EdgeKind.LOOP and would_send(own, own.edges[edge])
            out.setdefault(name, {})[str(share)] = {
                "error_m_median": round(statistics.median(errors), 4),
                "error_m_mean": round(statistics.mean(errors), 4),
                "false_loops": false,
                "true_loops": kept,
                "of_true": of,
                "true_loops_sent": sent[True],
                "false_loops_sent": sent[False],
            }
    return out
