"""A person walks through a world before the robots start, and takes photographs of the way."""

import math
from dataclasses import dataclass

import numpy as np

from mapweave.hybridmap.errors import InvalidValue
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.camera import CameraSetup
from mapweave.sim.floorplan import BuildingPlan
from mapweave.sim.imager import Imager
from mapweave.sim.scene import Scene
from mapweave.sim.texture import Image
from mapweave.sim.world import PanelSet, World

CLEARANCE = 0.3
"""m on either side of the way, so that a robot can follow."""
VIEW = 1.2
"""m of free floor ahead of the last photograph: from nearer a wall shows little."""
CORNER = math.radians(35.0)
"""By which the way bends half way, at most, to either side."""
TRIES = 4000
"""Ways that are tried before it is given up."""

ASIDE, YAW, TILT, RISE, STEP = 0.03, math.radians(3.0), math.radians(1.5), 0.02, 0.2
"""Standard deviations of a hand-held camera: m across the way, rad of yaw, rad of pitch and of roll, m of
height; and the largest relative change of a step's length."""


@dataclass(frozen=True, eq=False)
class Photograph:
    """A picture, and where it was really taken: below the camera, which faced along the pose's x axis."""

    image: Image
    world_from_camera: Pose2


def walk(world: World, camera: CameraSetup, count: int, spacing: float, seed: int) -> list[Photograph]:
    """Take photographs along a free way that the seed chooses.

    Args:
        world: without robots.
        camera: that is carried, at its height.
        count: of photographs.
        spacing: m between two of them, about.
        seed: of the way, and of the hand.

    Raises:
        InvalidValue: there is no such way.
    """
    rng = np.random.default_rng([seed, 0xF070])
    way = _way(world.plan, (count - 1) * spacing, rng)
    scene = Scene([PanelSet.of(world.panels)])
    imager = Imager(camera, world.background, (seed, 0xF070))
    steps = spacing * rng.uniform(1.0 - STEP, 1.0 + STEP, count - 1)
    photographs = []
    for distance in np.concatenate([[0.0], np.cumsum(steps)]).tolist():
        held = way.at(distance) @ Pose2(0.0, rng.normal(0.0, ASIDE), rng.normal(0.0, YAW))
        pitch, roll = rng.normal(0.0, TILT, 2)
        rotation = _rotation(held.heading, pitch, roll)
        height = camera.intrinsics.mount_height
        centre = np.array([held.x, held.y, height + rng.normal(0.0, RISE)])
        origin = centre - rotation @ [camera.intrinsics.mount_forward, 0.0, height]
        image = imager.picture(scene, (origin, rotation), 1.0, 0.0, 1.0)
        photographs.append(Photograph(image, held))
    return photographs


@dataclass(frozen=True)
class _Way:
    """Two straight legs of a length in m."""

    start: Pose2
    leg: float
    bend: float

    def at(self, distance: float) -> Pose2:
        """After so many m."""
        if distance < self.leg:
            return self.start @ Pose2(distance)
        return self.start @ Pose2(self.leg, 0.0, self.bend) @ Pose2(distance - self.leg)


def _way(plan: BuildingPlan, length: float, rng: np.random.Generator) -> _Way:
    points = plan.free_points(CLEARANCE)
    longest = (1.0 + STEP) * length
    for _ in range(TRIES if len(points) else 0):
        x, y = points[rng.integers(len(points))].tolist()
        start = Pose2(x, y, float(rng.uniform(-math.pi, math.pi)))
        way = _Way(start, 0.5 * length, float(rng.uniform(-CORNER, CORNER)))
        end = way.at(longest)
        if not plan.is_free(end.x, end.y, CLEARANCE):
            continue
        along = [way.at(distance) for distance in np.arange(0.0, longest + VIEW, 0.05).tolist()]
        clearances = plan.clearances(np.array([[place.x, place.y] for place in along]))
        walked = round(longest / 0.05)
        if clearances[:walked].min() >= CLEARANCE and clearances.min() > 0.0:
            return way
    raise InvalidValue(f"there is no free way of {length:.1f} m in this world")


def _rotation(yaw: float, pitch: float, roll: float) -> Array:
    """(3, 3) from the camera's axes (x ahead, y left, z up) to world."""
    (cy, cp, cr), (sy, sp, sr) = np.cos([yaw, pitch, roll]), np.sin([yaw, pitch, roll])
    turned = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    nodded = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    rolled = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    rotation: Array = turned @ nodded @ rolled
    return rotation
