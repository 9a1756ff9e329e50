"""The anchored keyframe: the node that an episode has made or recognised, and the anchor relative to it."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2, PoseGaussian

HERE = PoseGaussian(Pose2(), np.zeros((3, 3)))
"""A pose relative to itself."""


@dataclass(eq=False)
class AnchoredKeyframe:
    """A node that was made or recognised, and the pose of the current anchor relative to it.

    Attributes:
        node: the node.
        tracks: (N,) the track of each landmark, -1 for one that has none.
        node_from_anchor: pose of the current anchor.
        evidence: of its recognition; empty for a node that was just made.
    """

    node: Node
    tracks: NDArray[np.int64]
    node_from_anchor: PoseGaussian = HERE
    evidence: dict[str, float] = field(default_factory=dict)
