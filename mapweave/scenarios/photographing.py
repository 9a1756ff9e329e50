"""A person maps a stretch by photographs alone, before a robot drives along it."""

import cv2
import numpy as np

from mapweave.hybridmap.errors import InvalidFile, NotConnected
from mapweave.hybridmap.ids import MapId, NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.photographs import map_of_photographs, send_map
from mapweave.scenarios.actions import MapByPhotographs
from mapweave.scenarios.fleet import FIRST_EPOCH, SERVER, TrialFleet, TrialStage
from mapweave.sim.photographer import walk
from mapweave.sim.robots import camera_from_table

PATIENCE = 60.0
"""Wall time that the server may take to acknowledge the map, s."""
OFF = (0.15, 0.08, 0.15)
"""Standard deviations of a robot's start pose around the first photograph, m, m and rad."""


def photograph(stage: TrialStage, fleet: TrialFleet, action: MapByPhotographs) -> dict[NodeId, Pose2]:
    """Take photographs, make a map of them, and give it to the server.

    Returns:
        Where each node's photograph was really taken: `world_from_robot`, in order.

    Raises:
        MapweaveError: there is no way to walk, the photographs give no map, or the server does not take it.
    """
    camera = camera_from_table(action.camera)
    world = stage.scenario.world(stage.seed)
    taken = walk(world, camera, action.count, action.spacing, stage.seed)
    folder = stage.out / "photographs"
    folder.mkdir(parents=True, exist_ok=True)
    images = [folder / f"{number:03}.png" for number in range(1, len(taken) + 1)]
    for path, shot in zip(images, taken, strict=True):
        if not cv2.imwrite(str(path), shot.image):
            raise InvalidFile(f"{path}: cannot be written")
    map_id = MapId(action.name, FIRST_EPOCH)
    changes = map_of_photographs(
        images, camera.intrinsics, camera.distortion, action.said_spacing or action.spacing, map_id
    )
    journal = stage.agents / f"{action.name}.sqlite"
    if not send_map(changes, map_id, journal, fleet.bus, fleet.keys, SERVER, PATIENCE):
        raise NotConnected("the map server did not take the map of photographs")
    nodes = (NodeId(action.name, FIRST_EPOCH, number) for number in range(1, len(taken) + 1))
    back = Pose2(-camera.intrinsics.mount_forward)
    return {node: shot.world_from_camera @ back for node, shot in zip(nodes, taken, strict=True)}


def beside(first: Pose2, seed: int) -> Pose2:
    """Where a robot is put down that shall drive along the photographs."""
    x, y, heading = np.random.default_rng([seed, 0xF071]).normal(0.0, OFF).tolist()
    return first @ Pose2(x, y, heading)
