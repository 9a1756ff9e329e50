"""Trajectory segments: where a robot was around a node, and what its proximity sensors saw there."""

from dataclasses import dataclass, field

import numpy as np

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array

MOST = 24
"""Moments of one segment."""
LONGEST = 300.0
"""s; a segment covers no more time before or after its node."""
FURTHEST = 30.0
"""m; nor anything further away."""


@dataclass(frozen=True, eq=False)
class TrajectorySegment:
    """K moments about a node's image.

    Attributes:
        ages: (K,) s after the image, ascending; negative before it.
        node_from_robot: (K, 3) m, m and rad: where the robot was, in the node's robot frame.
        distances: (K, S) m, what the node's S proximity sensors saw then; see
            `mapweave.hybridmap.ranges.Ranges`.
    """

    ages: Array = field(default_factory=lambda: np.zeros(0))
    node_from_robot: Array = field(default_factory=lambda: np.zeros((0, 3)))
    distances: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        """Refuse shapes that do not belong together, and numbers out of range (InvalidValue)."""
        k = len(self.ages)
        shapes = (np.shape(self.ages), np.shape(self.node_from_robot), np.shape(self.distances)[:1])
        if shapes != ((k,), (k, 3), (k,)) or np.ndim(self.distances) != 2 or k > MOST:
            raise InvalidValue(f"trajectory: shapes {shapes} do not agree, or more than {MOST} moments")
        if not (np.abs(self.ages) <= LONGEST).all() or (np.diff(self.ages) < 0.0).any():
            raise InvalidValue(f"trajectory: ages do not ascend, or are beyond {LONGEST:g} s")
        near = np.abs(self.node_from_robot[:, :2]) <= FURTHEST
        if not (near.all() and np.isfinite(self.node_from_robot).all()):
            raise InvalidValue(f"trajectory: a pose is no number, or further away than {FURTHEST:g} m")

    def __len__(self) -> int:
        return len(self.ages)


NO_SEGMENT = TrajectorySegment()
"""Of a node whose robot shares no clock with others."""
