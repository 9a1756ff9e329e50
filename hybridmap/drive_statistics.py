"""Statistics of a drive: edges driven, nodes skipped, relocalizations."""

from __future__ import annotations

from dataclasses import dataclass, replace

REACHED = 0.45
"""A node on the way was reached if the robot came this near to it, m; else it was skipped. It is twice the
distance within which the follower takes a node for passed."""


@dataclass(frozen=True)
class DriveStatistics:
    """Counts of one drive.

    Attributes:
        edges: of the map that were driven: each ends at a node that was reached, or where the robot
            recognised another node ahead.
        skipped: nodes of the route that were left for later ones before they were reached.
        relocalizations: times that the lost robot was localized.
        blocks: times that an obstacle was in the way.
    """

    edges: int = 0
    skipped: int = 0
    relocalizations: int = 0
    blocks: int = 0

    def passed(self, distances: list[float]) -> DriveStatistics:
        """After the route's next nodes were passed at these distances, m."""
        reached = sum(distance <= REACHED for distance in distances)
        edges, skipped = self.edges + bool(distances), self.skipped + len(distances) - reached
        return replace(self, edges=edges, skipped=skipped)

    def found(self) -> DriveStatistics:
        """After one more relocalization."""
        return replace(self, relocalizations=self.relocalizations + 1)

    def blocked(self) -> DriveStatistics:
        """After one more block."""
        return replace(self, blocks=self.blocks + 1)
