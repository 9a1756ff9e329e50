"""How the way until a correction of the geometry continues in that from then on."""

from __future__ import annotations

from dataclasses import dataclass

from mapweave.hybridmap.pose import Pose2

STAYS = Pose2()
"""No move."""


@dataclass(frozen=True, slots=True)
class WayCorrection:
    """A similarity of the plane: lengths are scaled about the origin, then all is moved.

    Attributes:
        moved: `map_from_map`, m and rad.
        scale: of lengths before.
    """

    moved: Pose2 = STAYS
    scale: float = 1.0

    def apply(self, map_from_robot: Pose2) -> Pose2:
        """A pose of before as one of from now on."""
        return self.moved @ scaled(map_from_robot, self.scale)

    def seen_from(self, world_from_map: Pose2) -> WayCorrection:
        """The same for poses `world_from_robot`."""
        back = scaled(world_from_map.inverse(), self.scale)
        return WayCorrection(world_from_map @ self.moved @ back, self.scale)

    @staticmethod
    def about(centre: Pose2, scale: float) -> WayCorrection:
        """Lengths are scaled, and the position of a pose stays."""
        away = 1.0 - scale
        return WayCorrection(Pose2(away * centre.x, away * centre.y), scale)


def scaled(pose: Pose2, scale: float) -> Pose2:
    """A pose with a position that is further away by a factor; the heading stays."""
    return Pose2(scale * pose.x, scale * pose.y, pose.heading)
