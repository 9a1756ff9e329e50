"""Reachability: which edges the servo could drive, and which only give the relative pose of two nodes.

An edge that a robot drove or turned along while its landmarks were followed can be driven again. One that was
only recognised may join two views of one thing from the two sides of a room. The servo holds on to the
landmarks that both nodes show: enough of them must stay in view all the way, and the other node must be no
further off, and no more turned, than the servo manages from (docs/decisions/life-of-a-map.md gives figures).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.camera import Camera
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import EdgeId
from mapweave.hybridmap.node import Edge, EdgeKind, Node
from mapweave.hybridmap.pose import Array, Pose2

# What the servo manages: from within this it parked in `benchmarks.servo` and `benchmarks.parking`.


RECOGNISED = (EdgeKind.LOOP, EdgeKind.MERGED)
"""Edges by which two nodes show the same landmarks, without a drive from one to the other."""


@dataclass(frozen=True, slots=True)
class Reachability:
    """Whether the servo could drive an edge, and why.

    Attributes:
        drivable: whether routes may use it.
        in_view: fewest common landmarks in view on the way; -1 for an edge that was driven: not counted.
        reason: in words.
    """

    drivable: bool
    in_view: int
    reason: str

    @property
    def in_sight(self) -> bool:
        """Whether common landmarks stay in view on the way: a robot that drives it sees where it is."""
        return self.drivable or self.in_view >= LEAST


FARTHEST = 2.5
"""Largest distance of two nodes between which the servo drives, m."""
WIDEST = math.radians(45.0)
"""Largest turn between their headings, rad."""
LEAST = 7
"""Common landmarks that stay in view: as many as a look for the next node asks for; the servo itself holds
on to four."""
STOPS = 9
"""Poses on the way at which landmarks in view are counted."""


def reachability_of(edge: Edge, a: Node, b: Node) -> Reachability:
    """Whether the servo could drive an edge, either way: the same landmarks are in view both ways."""
    if edge.kind not in RECOGNISED:
        return Reachability(True, -1, f"{edge.kind} by a robot: it can be driven")
    between = edge.a_from_b.mean
    count = int(least_in_view(left(edge.shared, a, b), a, b, between, STOPS))
    distance, turn = between.distance(Pose2()), abs(between.heading)
    lacks = []
    if count < LEAST:
        common = "landmark stays" if count == 1 else "landmarks stay"
        lacks.append(f"only {count} {common} in view" if count else "no landmark stays in view")
    if distance > FARTHEST:
        lacks.append(f"{_above(distance):g} m are more than the {FARTHEST:g} m that the servo manages")
    if turn > WIDEST:
        most = math.degrees(WIDEST)
        degrees = _above(math.degrees(turn))
        lacks.append(f"{degrees:g} degrees are more than the {most:.0f} that the servo manages")
    if lacks:
        return Reachability(False, count, f"ties poses, not driven: {'; '.join(lacks)}")
    return Reachability(True, count, f"can be driven: {count} landmarks stay in view")


def closed_edges(hybrid_map: HybridMap) -> set[EdgeId]:
    """Edges of a map that the servo could not drive."""
    nodes = hybrid_map.nodes
    return {
        edge.id
        for edge in hybrid_map.edges.values()
        if edge.kind in RECOGNISED
        and edge.a in nodes
        and edge.b in nodes
        and not reachability_of(edge, nodes[edge.a], nodes[edge.b]).drivable
    }


def left(
    shared: NDArray[np.int64], a: Node, b: Node, faded: Sequence[NDArray[np.bool_] | None] = (None, None)
) -> NDArray[np.int64]:
    """(K, 2) of common landmarks those that both nodes have: one may have been written again with fewer.

    Args:
        shared: landmarks of a and of b that are the same.
        a: one node.
        b: the other.
        faded: which landmarks of a and of b are faded.
    """
    out: NDArray[np.int64] = shared[(shared < [len(a.landmarks), len(b.landmarks)]).all(axis=1)]
    for side, mask in enumerate(faded):
        if mask is not None:
            out = out[~mask[out[:, side]]]
    return out


def _above(number: float) -> float:
    """The value with one decimal, rounded up, so that what is above its limit is not said to be as much."""
    return math.ceil(10.0 * number) / 10.0


def least_in_view(shared: NDArray[np.int64], a: Node, b: Node, a_from_b: Pose2, stops: int = 9) -> int:
    """Fewest common landmarks that both nodes' cameras would see at poses between the two.

    The poses lie on the straight line with the heading turning evenly. A landmark whose depth neither node
    knows counts as in view, for it is at both ends.

    Args:
        shared: (K, 2) landmarks of a and of b that are the same.
        a: one node.
        b: the other.
        a_from_b: relative pose.
        stops: poses, the ends among them.
    """
    if not len(shared):
        return 0
    points = common_points(shared, a, b, a_from_b)
    share = np.linspace(0.0, 1.0, stops)
    poses = share[:, None] * a_from_b.vector
    seen = _visible(poses, points, a.camera) & _visible(poses, points, b.camera)
    # What a node has seen is visible there, wherever noise puts the point.
    seen[[0, -1]] = True
    return int((seen | np.isnan(points[:, 0])).sum(axis=1).min())


def common_points(shared: NDArray[np.int64], a: Node, b: Node, a_from_b: Pose2) -> Array:
    """(K, 3) m, in a, common landmarks by the depth that is known better; NaN where none is.

    Args:
        shared: (K, 2) landmarks of a and of b that are the same.
        a: one node.
        b: the other.
        a_from_b: relative pose.
    """
    in_a, in_b = a.landmarks.take(shared[:, 0]), b.landmarks.take(shared[:, 1])
    by_a, by_b = in_a.points_in_robot(a.camera), a_from_b.apply(in_b.points_in_robot(b.camera))
    sigma_a = np.where(in_a.has_depth, in_a.depth_sigmas, np.inf)
    sigma_b = np.where(in_b.has_depth, in_b.depth_sigmas, np.inf)
    points: Array = np.where((sigma_a <= sigma_b)[:, None], by_a, by_b)
    return points


def _visible(poses: Array, points: Array, camera: Camera) -> NDArray[np.bool_]:
    """(S, K) whether points (K, 3) are in the image at poses (S, 3), both in one frame."""
    cosine, sine = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    dx, dy = points[:, 0] - poses[:, :1], points[:, 1] - poses[:, 1:2]
    height = np.broadcast_to(points[:, 2], dx.shape)
    in_robot = np.stack([cosine * dx + sine * dy, cosine * dy - sine * dx, height], axis=-1)
    return camera.contains(camera.project(in_robot))
