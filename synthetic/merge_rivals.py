"""Ways to merge fleets, and what they are worth by the truth."""

from collections.abc import Callable, Mapping, Sequence

import networkx as nx
import numpy as np

from mapweave.evaluation.map_score import align
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.merge.merging import merge_maps
from mapweave.merge.outlier_rejection.max_clique import best_clique
from mapweave.merge.outlier_rejection.pairwise_consistency import EXACT, group_links, loop_distances2
from mapweave.merge.outlier_rejection.segmentation import fragments_of
from mapweave.merge.pose_graph.component_solver import ComponentSolver
from mapweave.merge.pose_graph.fragments import fragment_by_node
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap, NodePoses
from mapweave.merge.settings import ConsistencySettings
from synthetic.fleet import SyntheticFleet
from synthetic.gnc import inliers

STRAIN = 25.0
"""Chi-square with 3 degrees of freedom above which GNC holds a link for wrong."""
MAPWEAVE = "mapweave"
"""The settings that are the default."""
Maps = Mapping[MapId, HybridMap]
Rival = Callable[[Maps, Sequence[Link]], MergedMap]


def least_squares(maps: Maps, links: Sequence[Link]) -> MergedMap:
    """All links are accepted."""
    fragments = fragments_of(maps)
    by_node = fragment_by_node(fragments)
    used = [link for link in links if link.a in by_node and link.b in by_node]
    graphs = ComponentSolver(fragments).solve(used)
    return MergedMap(
        maps,
        tuple(sorted(used, key=lambda link: link.pair)),
        (),
        tuple(frozenset(graph.nodes) for graph in graphs),
        NodePoses(graphs),
        tuple(graphs),
    )


def gnc(maps: Maps, links: Sequence[Link]) -> MergedMap:
    """Graduated non-convexity over all links at once (Yang et al., RA-L 2020)."""
    return least_squares(maps, inliers(fragments_of(maps), links, STRAIN))


def pcm(maps: Maps, links: Sequence[Link]) -> MergedMap:
    """The largest pairwise consistent set between each two maps (Mangelson et al., ICRA 2018)."""
    return least_squares(maps, largest_sets(maps, links))


def pcm_gnc(maps: Maps, links: Sequence[Link]) -> MergedMap:
    """First the one, then the other, as in Kimera-Multi."""
    return gnc(maps, largest_sets(maps, links))


def largest_sets(maps: Maps, links: Sequence[Link]) -> list[Link]:
    """The links in the largest consistent set of their pair of maps, if there are two at least."""
    s, by_node = ConsistencySettings(), fragment_by_node(fragments_of(maps))
    out: list[Link] = []
    for (first, second), group in group_links(links, by_node).items():
        agree = loop_distances2(group, by_node[first], by_node[second]) < s.gate
        best = best_clique(agree, np.ones(len(group), np.int64), EXACT)
        out += [group[k].canonical() for k in best if len(best) >= s.least_links]
    return out


RIVALS: dict[str, Rival] = {
    "least_squares": least_squares,
    "gnc": gnc,
    "pcm": pcm,
    "pcm_gnc": pcm_gnc,
    MAPWEAVE: merge_maps,
}
"""By name."""


def oracle(fleet: SyntheticFleet) -> MergedMap:
    """What who knows the true links makes of them, by plain least squares."""
    links = [link for link in fleet.links if link.pair in fleet.true]
    return least_squares(fleet.maps, links)


def error(merged: MergedMap, truth: dict[NodeId, Pose2]) -> float:
    """Root mean square position error after one rigid alignment of the whole fleet, m.

    The alignment is that of the largest component. A map that is not joined with it stays where its own frame
    puts it: not to merge is no way to be right.
    """
    nodes = sorted(truth)
    estimated = positions(merged, nodes)
    true = np.array([[truth[node].x, truth[node].y] for node in nodes])
    largest = np.array([node in merged.components[0] for node in nodes])
    world_from_merged = align(estimated[largest], true[largest])
    off = world_from_merged.apply(estimated) - true
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def positions(merged: MergedMap, nodes: list[NodeId]) -> Array:
    """(N, 2) m, each in its component's frame."""
    means = [merged.poses[node].merged_from_robot.mean for node in nodes]
    return np.array([[mean.x, mean.y] for mean in means])


def precision_recall(links: tuple[Link, ...], fleet: SyntheticFleet) -> tuple[float, float]:
    """The share of the kept links that are true (1 if there is none), and of the true ones that are kept."""
    kept = {link.pair for link in links}
    good = len(kept & fleet.true)
    return good / len(kept) if kept else 1.0, good / len(fleet.true) if fleet.true else 1.0


def joined_falsely(merged: MergedMap, fleet: SyntheticFleet) -> bool:
    """Whether robots are in one component that no true links tie together, directly or by way of others."""
    tied: nx.Graph = nx.Graph()
    tied.add_nodes_from(fleet.maps)
    tied.add_edges_from((link.a.map, link.b.map) for link in merged.links if link.pair in fleet.true)
    part_of = {member: k for k, part in enumerate(nx.connected_components(tied)) for member in part}
    return any(len({part_of[node.map] for node in component}) > 1 for component in merged.components)
