"""A merged map of many nodes without landmarks, for what draws maps."""

import numpy as np
import scipy.sparse as sparse
from scipy.spatial import cKDTree

from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import PoseGaussian
from mapweave.merge.pose_graph.links import Link
from mapweave.merge.pose_graph.merged_map import MergedMap, NodePoses
from mapweave.merge.pose_graph.solved_graph import PoseGraph
from synthetic.fleet import LINK_SIGMAS, FleetSettings, map_of, walk_of


def large_map(robots: int, nodes: int, links: int) -> MergedMap:
    """So many robots have walked about so many nodes each, with links where they came close to each other."""
    rng = np.random.default_rng(3)
    settings = FleetSettings(nodes=nodes, side=120.0)
    walks = {MapId(f"r{k}", 1): walk_of(settings, rng) for k in range(robots)}
    maps = {map_id: map_of(map_id, walk, rng) for map_id, walk in walks.items()}
    truth = {NodeId(*map_id, n): pose for map_id, walk in walks.items() for n, pose in enumerate(walk)}
    ids = tuple(sorted(truth))
    means = np.array([truth[node].vector for node in ids])
    near = cKDTree(means[:, :2]).query_pairs(0.8, output_type="ndarray")
    pairs = [(ids[i], ids[j]) for i, j in rng.permutation(near).tolist() if ids[i].agent != ids[j].agent]
    joined = tuple(
        Link(a, b, PoseGaussian(truth[a].inverse() @ truth[b], np.diag(LINK_SIGMAS**2)))
        for a, b in sorted((min(pair), max(pair)) for pair in pairs[:links])
    )
    graph = PoseGraph(ids[0], ids, means, sparse.identity(3 * len(ids), format="csc"))
    return MergedMap(maps, joined, (), (frozenset(ids),), NodePoses([graph]), (graph,))
