"""The event `lie` of a scenario: what would become of the others if a robot had lied about its map."""

import logging
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.ids import NodeId
from mapweave.hybridmap.pose import Pose2
from mapweave.hybridmap.query import View
from mapweave.mapserver.own_maps import maps_of
from mapweave.scenarios.actions import TryLies
from mapweave.scenarios.figures import measured
from mapweave.scenarios.fleet import TrialFleet, TrialStage
from mapweave.scenarios.liar.lies import EVERY, WAYS, Map
from mapweave.scenarios.liar.trial import ContainmentOutcome, LiarTrial, row, totals
from mapweave.sim.camera import CameraSetup
from mapweave.sim.floorplan import BuildingPlan
from mapweave.sim.imager import Imager
from mapweave.sim.scene import Scene
from mapweave.sim.world import PanelSet, World
from mapweave.storage.map_file import MapFile
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift

NEAR = (0.2, 0.2, 0.15)
"""Standard deviations of a lost robot's pose around a node, m, m and rad."""
CLEARANCE = 0.25
"""Of a lost robot from walls, m."""
TRIES = 1000
"""Places that are tried for a lost robot before it is given up."""


@dataclass(frozen=True)
class Lies:
    """What came of the ways in which one robot lied.

    Attributes:
        robot: that lied.
        outcomes: by way.
    """

    robot: str
    outcomes: Mapping[str, ContainmentOutcome]

    def figures(self) -> dict[str, Any]:
        """The figures of the trial, see mapweave.scenarios.figures."""
        counts = totals(self.outcomes)
        return {
            "lies": counts["ways"],
            "lies_not_contained": len(counts["not_contained"]),
            "lies_not_named": len(counts["not_named"]),
            "lies_moved_m": measured(counts["max_pose_difference_m"]),
            "lies_answers_changed": counts["answers_changed"],
        }


def lie(
    stage: TrialStage, fleet: TrialFleet, action: TryLies, merged: MapFile, note: Callable[[str, bool], None]
) -> Lies:
    """Give the others' maps to a server, then the robot's with one lie in it; for each way again.

    The fleet itself goes on untouched.

    Args:
        stage: of the trial.
        fleet: whose maps these are.
        action: who lies, and how.
        merged: the merged map of the fleet.
        note: called with a line for each way, and whether it is trouble.

    Raises:
        InvalidValue: a robot has no map.
    """
    maps = {map_id: _drive(hybrid) for map_id, hybrid in maps_of(merged).items() if hybrid.nodes}
    own = [map_id for map_id in maps if map_id.agent == action.robot]
    if not own or len({map_id.agent for map_id in maps}) < 3:
        raise InvalidValue(f"lie: {action.robot} and two other robots must have a map")
    truth = fleet.control.truth_of(node for nodes, _ in maps.values() for node in nodes)
    liar = max(own, key=lambda map_id: len(maps[map_id][0]))
    others = {node: pose for node, pose in truth.items() if node.agent != action.robot}
    camera = next(robot.camera for robot in stage.scenario.robots if robot.name == action.robot)
    lost = lost_views(stage.scenario.world(stage.seed), camera, others, action.queries, stage.seed)
    outcomes = {}
    with tempfile.TemporaryDirectory() as folder, _silent():
        trial = LiarTrial(liar, maps, lost, others, stage.seed, Path(folder))
        note(row("an honest fourth robot", trial.beside), not trial.beside.contained)
        for name in action.ways or EVERY:
            outcomes[name] = one = trial.outcome(EVERY[name])
            note(row(name, one), name in WAYS and not (one.contained and one.accused))
    return Lies(action.robot, outcomes)


@contextmanager
def _silent() -> Iterator[None]:
    """Without the log lines of the servers that are lied to: hundreds of changes are refused."""
    before = logging.root.manager.disable
    logging.disable(logging.ERROR)
    try:
        yield
    finally:
        logging.disable(before)


def lost_views(
    world: World, camera: CameraSetup, near: Mapping[NodeId, Pose2], count: int, seed: int
) -> list[tuple[View, Pose2]]:
    """Views of lost robots near nodes, and where they truly are.

    Args:
        world: that they look at.
        camera: of theirs.
        near: where nodes truly are, `world_from_robot`.
        count: how many.
        seed: chooses where.

    Raises:
        InvalidValue: there is no room near the nodes.
    """
    rng = np.random.default_rng([seed, 0x105])
    imager = Imager(camera, world.background, (seed, 0x105))
    scene, sift = Scene([PanelSet.of(world.panels)]), Sift(Lens(camera.intrinsics, camera.distortion))
    out = []
    for at in _poses(world.plan, list(near.values()), count, rng):
        cos, sin = np.cos(at.heading), np.sin(at.heading)
        rotation = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        image = imager.picture(scene, (np.array([at.x, at.y, 0.0]), rotation), 1.0, 0.0, 1.0)
        out.append((sift.extract(image).view(camera.intrinsics), at))
    return out


def _poses(plan: BuildingPlan, near: list[Pose2], count: int, rng: np.random.Generator) -> list[Pose2]:
    out: list[Pose2] = []
    for _ in range(TRIES):
        at = near[int(rng.integers(len(near)))] @ Pose2.from_vector(rng.normal(0.0, NEAR))
        if plan.is_free(at.x, at.y, CLEARANCE):
            out.append(at)
        if len(out) == count:
            return out
    raise InvalidValue("lie: there is no room near the nodes for lost robots")


def _drive(hybrid: HybridMap) -> Map:
    """The nodes of a map in the order in which they were made, and the edges between them."""
    nodes = sorted(hybrid.nodes.values(), key=lambda node: node.id)
    edges = sorted(
        (edge for edge in hybrid.edges.values() if edge.a in hybrid.nodes and edge.b in hybrid.nodes),
        key=lambda edge: edge.id,
    )
    return nodes, edges
