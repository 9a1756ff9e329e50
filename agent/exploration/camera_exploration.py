"""Exploration by the camera alone: on floor that was driven over or seen to be free."""

from collections.abc import Iterator
from dataclasses import replace

from mapweave.agent.camera_occupancy import BEARINGS, CameraOccupancyGrid
from mapweave.agent.camera_occupancy import REACH as READ
from mapweave.agent.cautious_driving import CREEP, SLOW
from mapweave.agent.exploration.behaviours import Phase
from mapweave.agent.exploration.explorer import Explorer
from mapweave.agent.exploration.viewpoint_selection import REACH
from mapweave.agent.mapping.episode import Move
from mapweave.agent.mapping.mapper import Mapper
from mapweave.agent.observation import Command, RobotDescription
from mapweave.agent.settings import ExplorerSettings
from mapweave.hybridmap.ids import MapId

CLOSED = 0.05
"""With no more than this share of its border unknown the reachable floor counts as explored."""
NEAR = 1.0
"""Least distance between two places, m: less floor is seen free around one than by proximity sensors."""


class CameraExploration(Explorer):
    """Frontier exploration with readings of the camera's occupancy grid in place of proximity sensors.

    A turn on the spot shows no depths, so every place is looked around at with drives.
    """

    spacing = NEAR

    def __init__(
        self,
        map_id: MapId,
        description: RobotDescription,
        mapper: Mapper,
        floor: CameraOccupancyGrid,
        settings: ExplorerSettings | None = None,
        seed: int = 0,
    ) -> None:
        """See Explorer; the description is the robot's own, without rangers."""
        s = settings or ExplorerSettings()
        slow = replace(s, drive_speed=min(s.drive_speed, SLOW), travel_speed=min(s.travel_speed, SLOW))
        super().__init__(map_id, with_readings(description), mapper, floor, slow, seed)
        self._camera_floor = floor
        self._moves.patience = s.drive_speed / CREEP

    def _scan(self) -> Iterator[Move]:
        yield from self._look_around()

    def _stand(self) -> Iterator[Move]:
        share = self._camera_floor.open_border(self._moves.position, REACH)
        if share <= CLOSED:
            yield from super()._stand()
        self._moves.phase = Phase.NOT_DARED
        self._moves.detail = f"{share:.0%} of the border of the known floor is unknown"
        while True:
            yield Command()


def with_readings(description: RobotDescription) -> RobotDescription:
    """The robot with the readings of its camera's occupancy grid for those of rangers."""
    return replace(description, ranger_bearings=BEARINGS, ranger_reach=READ)
