"""Recognising places of the robot's own map, without any server."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.descriptor import decode
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import PoseGaussian
from mapweave.hybridmap.query import View
from mapweave.registration.recognition import Recognition, recognise

TRIES = 5
"""Nodes that are verified, by descending votes."""
VOTES = 6
"""A node with fewer votes is not tried."""
NODES_AT_ONCE = 32
"""Nodes whose descriptors are compared at once: of all nodes of a large map they took hundreds of MB."""
LEAST_INLIERS = 24
"""Landmarks that must agree: one node speaks alone here, and the map is small."""


def recognise_places(
    hybrid_map: HybridMap,
    view: View,
    rng: np.random.Generator,
) -> list[tuple[Node, Recognition]]:
    """Find the nodes of a robot's own map that a view shows (paper, section 5: the kidnapped robot).

    Every feature votes for the node that holds its nearest descriptor; the nodes with most votes are
    verified by geometry. One robot's map is small, so all descriptors are compared, some nodes
    at a time.

    Args:
        hybrid_map: the robot's own map.
        view: what it sees now.
        rng: for the verification's random samples.

    Returns:
        The nodes and how each was recognised, most inliers first.
    """
    nodes = [n for n in hybrid_map.nodes.values() if len(n.landmarks)]
    if not nodes or not len(view):
        return []
    votes = np.bincount(_nearest(nodes, decode(view.codes)), minlength=len(nodes))
    recalled: list[tuple[Node, Recognition]] = []
    for index in np.argsort(-votes, kind="stable")[:TRIES]:
        if votes[index] < VOTES:
            break
        recognition = recognise(nodes[index], view, None, rng)
        if recognition is not None and recognition.inliers >= LEAST_INLIERS:
            recalled.append((nodes[index], recognition))
    return sorted(recalled, key=lambda pair: -pair[1].inliers)


def _nearest(nodes: Sequence[Node], features: NDArray[np.float32]) -> NDArray[np.int64]:
    """Which node has the nearest descriptor of each feature.

    Args:
        nodes: with landmarks.
        features: (N, 32) descriptors.

    Returns:
        (N,) indices of nodes.
    """
    best = np.full(len(features), -np.inf, np.float32)
    nearest = np.zeros(len(features), np.int64)
    for begin in range(0, len(nodes), NODES_AT_ONCE):
        some = nodes[begin : begin + NODES_AT_ONCE]
        descriptors = decode(np.concatenate([node.landmarks.codes for node in some]))
        owner = np.repeat(np.arange(begin, begin + len(some)), [len(node.landmarks) for node in some])
        # The nearest has the greatest product less half its square.
        scores = features @ descriptors.T - 0.5 * (descriptors**2).sum(axis=1)
        at = scores.argmax(axis=1)
        score = scores[np.arange(len(features)), at]
        nearer = score > best
        best[nearer], nearest[nearer] = score[nearer], owner[at[nearer]]
    return nearest


def aliased_places(
    recalled: list[tuple[Node, Recognition]], rival: float, apart: float
) -> tuple[Node, Node] | None:
    """The node that a view shows best, and another one, elsewhere, that it shows about as well; or None.

    Args:
        recalled: most inliers first, as `recognise_places` returns them.
        rival: another node is a rival with this share of the best node's inliers;
        apart: it is elsewhere if it puts the robot further away than this, m.
    """
    if not recalled:
        return None
    node, best = recalled[0]
    robot_in_map = node.map_from_robot.mean @ best.node_from_robot.mean
    for other, other_recognition in recalled[1:]:
        other_robot_in_map = other.map_from_robot.mean @ other_recognition.node_from_robot.mean
        if (
            other_recognition.inliers >= rival * best.inliers
            and robot_in_map.distance(other_robot_in_map) > apart
        ):
            return node, other
    return None


def exact_enough(pose: PoseGaussian, sure: tuple[float, float], leniency: float = 1.0) -> bool:
    """Whether a recognition is exact enough to go on from; else another view, elsewhere, costs little.

    Args:
        pose: `node_from_robot`.
        sure: standard deviations that are good enough, m and rad.
        leniency: by how much they may be larger.
    """
    sigma = np.sqrt(np.diag(pose.covariance))
    return bool(max(sigma[:2]) <= sure[0] * leniency and sigma[2] <= sure[1] * leniency)
