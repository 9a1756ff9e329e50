"""A world that needs no simulator: a photograph hung on two walls, rendered by an exact homography."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from functools import cached_property

import numpy as np
import pytest

from mapweave import Camera, HybridMap, MapId, Node, Observation, Odometry, Pose2, RobotDescription
from mapweave.agent.mapping.mapper import Mapper
from synthetic.world import World
from tests.agent.scripted_fleet import home_map, home_world
from tests.described import described_once
from tests.photo_walls import Wall, rendered, two_walls

CAMERA = Camera(320, 240, 277.0, 277.0, 159.5, 119.5, mount_height=0.3)
DESCRIPTION = RobotDescription(camera=CAMERA)


MOST_RENDERED = 400
"""Images that are kept, 77 kB each: most drives before the walls pass the same places."""
RENDERED: OrderedDict[object, tuple[np.ndarray, list[np.ndarray]]] = OrderedDict()


class PhotoWalls:
    """A near wall on the left and a far wall on the right, facing the robot, each with a photograph."""

    @cached_property
    def walls(self) -> list[Wall]:
        """Photographs, and where they hang."""
        return two_walls()

    def depth_at(self, world_from_robot: Pose2, pixels: np.ndarray) -> np.ndarray:
        """True depth along the optical axis at pixels of a robot that looks along x exactly."""
        assert world_from_robot.heading == 0.0
        near = self.walls[1]
        depth = near[1] - world_from_robot.x
        y = world_from_robot.y - (pixels[:, 0] - CAMERA.cx) / CAMERA.fx * depth
        on_near = (y <= near[2]) & (y >= near[2] - near[4])
        return np.where(on_near, depth, self.walls[0][1] - world_from_robot.x)

    def render(self, world_from_robot: Pose2) -> np.ndarray:
        """(240, 320) grey. Who comes to a place again, in whatever test, sees the same array again."""
        at = world_from_robot.x, world_from_robot.y, world_from_robot.heading
        shown = at, tuple((id(wall[0]), *wall[1:]) for wall in self.walls)
        if (kept := RENDERED.get(shown)) is not None:
            return kept[0]
        image = rendered(self.walls, CAMERA, world_from_robot)
        image.flags.writeable = False
        # The pictures are kept with it: another one must not get the number of one that is gone.
        RENDERED[shown] = image, [wall[0] for wall in self.walls]
        if len(RENDERED) > MOST_RENDERED:
            RENDERED.popitem(last=False)
        return image

    def observe(self, before: Pose2, now: Pose2, tick: int) -> Observation:
        """What a robot with perfect wheels senses after moving from one pose to another."""
        moved = before.inverse() @ now
        forward = float(np.hypot(moved.x, moved.y)) * (1.0 if moved.x >= 0 else -1.0)
        return Observation(tick * 100_000_000, Odometry(forward, moved.heading), self.render(now))

    def mapped(self, mapper: Mapper, reach: float = 0.6) -> Node:
        """The view from the origin, mapped by driving `reach` m forth and back."""
        before, there = Pose2(), np.arange(0.0, reach, 0.025)
        for tick, x in enumerate([*there, *there[::-1]], 1):
            observation = self.observe(before, Pose2(x), tick)
            mapper.step(observation)
            if not mapper.started:
                mapper.begin(observation)
            before = Pose2(x)
        mapper.finish(observation)
        mapper.finish_pending()
        (node,) = mapper.map.nodes.values()
        return node


@pytest.fixture(scope="module", autouse=True)
def described() -> Iterator[None]:
    """Most drives begin at the same places."""
    with described_once():
        yield


@pytest.fixture(scope="session")
def walls() -> PhotoWalls:
    """The world."""
    return PhotoWalls()


@pytest.fixture(scope="session")
def node(walls) -> Node:
    """The view from its origin."""
    return walls.mapped(Mapper(MapId("r0", 1), DESCRIPTION))


@pytest.fixture
def description() -> RobotDescription:
    """The robot in it."""
    return DESCRIPTION


@pytest.fixture(scope="module")
def home() -> World:
    """A room of landmarks, for navigators whose fleet is scripted."""
    return home_world()


@pytest.fixture(scope="module")
def own_map(home: World) -> HybridMap:
    """Three nodes in a row in it, 1.2 m apart."""
    return home_map(home)
