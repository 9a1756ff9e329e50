"""Which explorer a robot gets: by its rangers, by its camera, or by chance."""

from __future__ import annotations

from mapweave.agent.camera_occupancy import CameraOccupancyGrid
from mapweave.agent.exploration.camera_exploration import CameraExploration
from mapweave.agent.exploration.explorer import Explorer
from mapweave.agent.exploration.random_exploration import RandomExploration
from mapweave.agent.mapping.mapper import Mapper
from mapweave.agent.observation import RobotDescription
from mapweave.agent.occupancy_grid import OccupancyGrid
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.node import MapId


def new_explorer(
    map_id: MapId,
    description: RobotDescription,
    mapper: Mapper,
    floor: OccupancyGrid,
    settings: AgentSettings,
) -> Explorer:
    """An explorer for a robot: on the floor that it knows by rangers, or by its camera."""
    more = settings.exploration, settings.seed
    if isinstance(floor, CameraOccupancyGrid):
        return CameraExploration(map_id, description, mapper, floor, *more)
    kind = RandomExploration if settings.exploration.random else Explorer
    return kind(map_id, description, mapper, floor, *more)
