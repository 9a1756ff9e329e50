"""Nodes and edges as they would be had the wheels gone further, or less far, than was assumed.

All that a robot measures while it maps is a multiple of what its wheels count: where it went, and how far
away what it saw is. So a map that was made with one wrong scale is right but for one factor, and needs no
optimisation when the factor becomes known. Maps by images alone, whose scale drifts, need a similarity for
each edge (Strasdat et al., Scale drift-aware large scale monocular SLAM, RSS 2010). What proximity sensors
saw has a scale of its own.
"""

from dataclasses import replace

import numpy as np

from mapweave.agent.mapping.way_correction import WayCorrection
from mapweave.hybridmap.node import Edge, Landmarks, Node
from mapweave.hybridmap.pose import PoseGaussian
from mapweave.hybridmap.quantization import snap
from mapweave.hybridmap.trajectory_segment import FURTHEST, TrajectorySegment


def rescaled(pose: PoseGaussian, way: WayCorrection) -> PoseGaussian:
    """A pose with its uncertainty, which is a multiple of the way, too."""
    factor = np.array([way.scale, way.scale, 1.0])
    return PoseGaussian(way.apply(pose.mean), factor[:, None] * pose.covariance * factor)


def rescaled_edge(edge: Edge, scale: float) -> Edge:
    """An edge with another length."""
    return replace(edge, a_from_b=rescaled(edge.a_from_b, WayCorrection(scale=scale)))


def rescaled_node(node: Node, way: WayCorrection) -> Node:
    """A node elsewhere, with other depths. Its landmarks keep their order, to which edges refer."""
    seen, moments = node.landmarks, node.segment
    scale = np.float32(way.scale)
    landmarks = Landmarks(seen.pixels, seen.codes, scale * seen.depths, scale * seen.depth_sigmas)
    poses = moments.node_from_robot * [way.scale, way.scale, 1.0]
    near = (np.abs(poses[:, :2]) <= FURTHEST).all(axis=1)
    segment = TrajectorySegment(moments.ages[near], poses[near], moments.distances[near])
    pose = rescaled(node.map_from_robot, way)
    return replace(node, map_from_robot=pose, landmarks=snap(landmarks, node.camera), segment=segment)
