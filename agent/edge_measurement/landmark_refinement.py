"""Refinement of a node's landmarks: drives past them measure their depths more precisely."""

from dataclasses import replace

import numpy as np

from mapweave.agent.localization.fix import Fix
from mapweave.agent.localization.node_localizer import NodeLocalizer
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.node import Landmarks, Node
from mapweave.hybridmap.pose import Array
from mapweave.hybridmap.quantization import snap


class LandmarkRefinement:
    """Watches a drive and refines the landmarks of the robot's own nodes.

    Each node is written again once a drive at most: when the robot leaves it, or has arrived.
    """

    def __init__(self, own_map: HybridMap) -> None:
        """Take the robot's own map; nodes of others are theirs to mend."""
        self._map = own_map
        self._localizer: NodeLocalizer | None = None
        self._refined_nodes: set[NodeId] = set()

    def see(self, fix: Fix | None) -> Node | None:
        """Take in where the robot is now; returns a node of the map with better landmarks.

        Args:
            fix: None if the robot is lost, or has arrived.
        """
        before = self._localizer
        self._localizer = None if fix is None else fix.localizer
        return None if before is None or before is self._localizer else self._refined(before)

    def _refined(self, localizer: NodeLocalizer) -> Node | None:
        node = self._map.nodes.get(localizer.node.id)
        if (
            node is None
            or node.id in self._refined_nodes
            or len(node.landmarks) != len(localizer.node.landmarks)
        ):
            return None
        landmarks = refined(node.landmarks, *localizer.depths())
        if landmarks is None:
            return None
        self._refined_nodes.add(node.id)
        # Rounded now, the robot works with the same numbers as all receivers of the node.
        return replace(node, landmarks=snap(landmarks, node.camera))


SHARE = 0.7
"""A landmark is known better if its depth's sigma has fallen below this share of what it was."""
LEAST = 5
"""A node is written again if so many of its landmarks are refined: it costs some 3 kB."""
FLOOR = (0.01, 0.015)
"""What a depth is never better than: m, and share of the depth; as when it was mapped."""
DOUBT = 3.3
"""A depth that is off from the mapped one by more than this many sigma of that is no better one: what was
followed may be something else."""


def refined(mapped: Landmarks, depths: Array, sigmas: Array) -> Landmarks | None:
    """Take over the depths that are known better; None if they are too few.

    Args:
        mapped: N landmarks as the map has them.
        depths: (N,) m, NaN where nothing was learned.
        sigmas: (N,) m, of independent errors.
    """
    sigmas_with_floor = np.hypot(sigmas, FLOOR[0] + FLOOR[1] * depths)
    with np.errstate(invalid="ignore"):
        better = sigmas_with_floor < SHARE * mapped.depth_sigmas
        better &= np.abs(depths - mapped.depths) < DOUBT * mapped.depth_sigmas
    if np.count_nonzero(better) < LEAST:
        return None
    new = [np.where(better, measured, old).astype(np.float32) for measured, old in
           ((depths, mapped.depths), (sigmas_with_floor, mapped.depth_sigmas))]  # fmt: skip
    return replace(mapped, depths=new[0], depth_sigmas=new[1])
