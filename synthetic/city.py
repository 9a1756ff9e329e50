"""Pose graphs of drives through a city of square blocks, in the manner of Manhattan.

All measurements are right, with the noise that they claim: a back end that refuses none of them and finds the
optimum costs what GTSAM's batch optimum costs. Headings that are little known lead it astray (Carlone, Tron,
Daniilidis & Dellaert, ICRA 2015, make the Manhattan data hard by them).
"""

import math

import numpy as np

from mapweave.formats.g2o import G2oEdge, G2oGraph
from mapweave.hybridmap.pose import Array, Pose2

HEADING_SIGMAS = {"grid_a": 0.01, "grid_b": 0.03, "grid_c": 0.1}
"""Of each edge, rad."""
PLACE_SIGMA = 0.05
"""Of each edge, m along and across."""
BLOCKS = 12
"""Along each side of the city, of 1 m each."""
APART = 20
"""Steps before a place that is come by again counts as a loop."""
RECOGNISED = 0.4
"""The share of places come by again that are noticed."""


def draw_grid(nodes: int, heading_sigma: float, rng: np.random.Generator) -> G2oGraph:
    """Draw a graph; its poses are those of dead reckoning.

    Args:
        nodes: how many.
        heading_sigma: of each edge, rad.
        rng: source of all that is random.
    """
    sigmas = np.array([PLACE_SIGMA, PLACE_SIGMA, heading_sigma])
    true = _drive(nodes, rng)
    edges = [_edge(k, k + 1, true, sigmas, rng) for k in range(nodes - 1)]
    at_corner: dict[tuple[int, int], list[int]] = {}
    for k, pose in enumerate(true):
        corner = at_corner.setdefault((round(pose.x), round(pose.y)), [])
        edges += [
            _edge(i, k, true, sigmas, rng) for i in corner if k - i > APART and rng.random() < RECOGNISED
        ]
        corner.append(k)
    poses = {0: Pose2()}
    for edge in edges[: nodes - 1]:
        poses[edge.j] = poses[edge.i] @ edge.i_from_j
    return G2oGraph(poses, edges)


def _drive(nodes: int, rng: np.random.Generator) -> list[Pose2]:
    """A block a step, straight on or round a corner, inside the city."""
    pose = Pose2(BLOCKS // 2, BLOCKS // 2, 0.0)
    drive = [pose]
    while len(drive) < nodes:
        turn = rng.choice([0.0, 0.5 * math.pi, -0.5 * math.pi], p=[0.6, 0.2, 0.2])
        ahead = pose @ Pose2(0.0, 0.0, turn) @ Pose2(1.0, 0.0, 0.0)
        if -0.5 < ahead.x < BLOCKS + 0.5 and -0.5 < ahead.y < BLOCKS + 0.5:
            pose = ahead
            drive.append(pose)
    return drive


def _edge(i: int, j: int, true: list[Pose2], sigmas: Array, rng: np.random.Generator) -> G2oEdge:
    measured = true[i].inverse() @ true[j] @ Pose2.from_vector(rng.normal(0.0, sigmas))
    return G2oEdge.measured(i, j, measured, np.diag(sigmas**2))
