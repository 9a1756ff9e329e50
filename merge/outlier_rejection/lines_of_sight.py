"""Lines of sight: which landmarks of a node other nodes confirm, and which they see through.

Robots do not see through walls. Where a node is placed wrongly, others have landmarks behind its own in the
same direction, and it has some behind theirs. Clutter and wrong depths are seen through at true places too:
shares are compared with what is usual.
"""

import math
from collections.abc import Sequence

import numpy as np

from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.merge.pose_graph.solved_graph import PoseGraph

RARE = 0.05
"""Share of nodes, placed by their own links, that are seen through more than usual."""
REFUTED = 0.001
"""Chance, at most, that so many nodes are under a true placement (binomial)."""
LEAST_NODES = 4
"""Nodes on either side of the comparison, at least."""
MOST_SIGMA_XY, MOST_SIGMA_HEADING = 0.25, math.radians(5.0)
"""Nodes whose place is known less well, by the surest link of a placement, are not compared, m and rad."""
REACH, MOST_NEAR = 5.0, 20
"""A node is compared with the nearest others within reach, m: depths are poor beyond it."""
SIGMAS, MARGIN = 3.0, 0.2
"""What lies behind a landmark by more than so many sigmas, and so many m, is behind it."""
AROUND = 0.03
"""Two landmarks are in the same direction if they are so near to each other, rad."""
LEAST_COMPARED = 20
"""Landmarks of a node that others of its own map confirm or refute, at least."""
LEAST_THROUGH = 0.05
"""Share of its landmarks by which at least half of the nodes of a torn map are seen through."""
MOST_TURNED = math.radians(60.0)
"""Nodes of one map that are turned by more against each other are not compared, rad: who looks at things from
another side sees past their edges in every map."""


def more_than_usual(shares: Array, usual: Array) -> bool:
    """Whether more nodes than by chance are seen through more than usual.

    Args:
        shares: (N,) of the landmarks of each node that others refute, see `seen_through`.
        usual: (M,) the same among nodes of one map, for comparison.
    """
    from scipy.special import bdtrc

    if min(len(shares), len(usual)) < LEAST_NODES:
        return False
    many = int((shares > np.quantile(usual, 1.0 - RARE)).sum())
    return bool(bdtrc(many - 1, len(shares), RARE) < REFUTED)


def tears(first: Sequence[NodeId], second: Sequence[NodeId], graph: PoseGraph, nodes: Sequence[Node]) -> bool:
    """Whether two groups of a map's nodes see through each other more than each does through itself.

    Groups that look at things from different sides do so a little in every map, so it must be much more.

    Args:
        first: nodes of the map.
        second: others of it.
        graph: of the map.
        nodes: all of its nodes, in the order of the graph.
    """
    across, within = (
        np.concatenate([_shares(graph, nodes, *pair) for pair in pairs])
        for pairs in (((first, second), (second, first)), ((first, first), (second, second)))
    )
    return more_than_usual(across, within) and bool(np.median(across) >= LEAST_THROUGH)


def _shares(
    graph: PoseGraph, nodes: Sequence[Node], which: Sequence[NodeId], others: Sequence[NodeId]
) -> Array:
    """For each node that can be compared, the share of its landmarks that other nodes of its map refute.

    Args:
        graph: of the map.
        nodes: all of its nodes.
        which: of these.
        others: compared with these, where they are near.
    """
    out, rows = [], graph.index(others)
    for node_id in which:
        row = graph.rows[node_id]
        away = np.hypot(*(graph.means[rows, :2] - graph.means[row, :2]).T)
        near = [int(rows[k]) for k in np.argsort(away, kind="stable")[:MOST_NEAR] if away[k] < REACH]
        near = [k for k in near if k != row]
        if not near:
            continue
        relative = graph.relative([graph.nodes[k] for k in near], [node_id] * len(near))
        counts = np.zeros(2, np.int64)
        for k, mean, covariance in zip(near, relative.means, relative.covariances, strict=True):
            sigma_xy = math.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])
            sigma_heading = math.sqrt(covariance[2, 2])
            if sigma_xy > MOST_SIGMA_XY or sigma_heading > MOST_SIGMA_HEADING or abs(mean[2]) > MOST_TURNED:
                continue
            pose = Pose2.from_vector(mean)
            counts += seen_through(nodes[row], nodes[k], pose, sigma_xy, sigma_heading)
            counts += seen_through(nodes[k], nodes[row], pose.inverse(), sigma_xy, sigma_heading)
        if counts[0] >= LEAST_COMPARED:
            out.append(counts[1] / counts[0])
    return np.array(out)


def seen_through(
    node: Node, view: Node, view_from_node: Pose2, sigma_xy: float, sigma_heading: float
) -> tuple[int, int]:
    """How many of a node's landmarks a view can confirm or refute, and how many it refutes.

    A view confirms a landmark if it has one at this distance in the same direction. It sees through it, and
    so refutes it, if it has one only behind it. Landmarks behind everything that the view has there are
    occluded, and are no evidence: a map placed outside the walls would have too many of them.

    Args:
        node: whose landmarks.
        view: another node.
        view_from_node: relative pose,
        sigma_xy: standard deviation of that, m,
        sigma_heading: and rad.
    """
    (marks, own), (seen, known) = ((n.landmarks, n.landmarks.has_depth) for n in (node, view))
    points = view_from_node.apply(node.camera.back_project(marks.pixels[own], marks.depths[own]))
    pixels = view.camera.project(points)
    inside = view.camera.contains(pixels)
    if not inside.any() or not known.any():
        return 0, 0
    depths, pixels = points[inside, 0] - view.camera.mount_forward, pixels[inside]
    sigmas = marks.depth_sigmas[own][inside].astype(np.float64)
    variances = sigmas**2 + sigma_xy**2 + (sigma_heading * depths) ** 2
    sigmas = np.sqrt(variances[:, None] + seen.depth_sigmas[known].astype(np.float64)[None] ** 2)
    further = seen.depths[known].astype(np.float64)[None] - depths[:, None]
    across, down = (pixels[:, None, k] - seen.pixels[known, k] for k in range(2))
    off = np.sqrt(across * across + down * down) / view.camera.fx
    same_direction = off < AROUND + 2.0 * sigma_heading
    behind = (same_direction & (further > SIGMAS * sigmas + MARGIN)).any(axis=1)
    about = (same_direction & (np.abs(further) <= SIGMAS * sigmas + MARGIN)).any(axis=1)
    return int((behind | about).sum()), int((behind & ~about).sum())
