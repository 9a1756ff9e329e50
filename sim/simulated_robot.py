"""One simulated robot: its body, its camera, its rangers, and their faults."""

import math
import time
from collections.abc import Sequence

import numpy as np

from mapweave.agent.observation import Observation, RobotDescription
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.sim.body import Body
from mapweave.sim.faults import SensorFaults
from mapweave.sim.imager import Imager
from mapweave.sim.rangers import Rangers
from mapweave.sim.robots import RobotSetup
from mapweave.sim.stage import RigidPose, Stage
from mapweave.sim.texture import Image


class SimulatedRobot:
    """A robot on the stage.

    Attributes:
        description: the description that its agent gets.
        body: in the physics.
        rangers: distances at the last call of `measure`.
        faults: of its sensors.
        pose: world_from_robot, true, at the last call of `measure`.
        image: that it took last; None if the last observation had none.
        render_seconds: wall time that its pictures took.
    """

    def __init__(self, setup: RobotSetup, stage: Stage, place: Pose2, seed: tuple[int, int]) -> None:
        """Put a robot on the floor.

        Args:
            setup: of the robot.
            stage: of the simulation.
            place: world_from_robot.
            seed: of the simulation, and the robot's number.
        """
        base, number = seed
        self.description: RobotDescription = setup.describe()
        self.body = Body(
            stage.physics, stage.floor, place, self.description, (base, 0xB0D1, number), setup.body
        )
        self.rangers = Rangers(self.description, setup.range_noise, (base, 0x5A46E, number))
        self.faults = SensorFaults(self.description.axle, (base, 0xFA117, number))
        self.pose = place
        self.image: Image | None = None
        self.render_seconds = 0.0
        self._imager = Imager(setup.camera, stage.world.background, (base, 0x701E, number))
        self._placement: RigidPose = self.body.position_and_rotation()
        self._turn_rate = 0.0
        self._measured_tick = 0
        self._frame_tick = -1
        self._frame: Image | None = None
        self._dropped = (-1, False)

    def measure(self, tick: int) -> RigidPose:
        """Read the true pose out of the physics; call after anything that may have moved the robot."""
        self._placement = placement = self.body.position_and_rotation()
        position, rotation = placement
        pose = Pose2(float(position[0]), float(position[1]), math.atan2(rotation[1, 0], rotation[0, 0]))
        if tick > self._measured_tick:
            turned = wrap_angle(pose.heading - self.pose.heading)
            self._turn_rate = turned / ((tick - self._measured_tick) * self.description.tick)
        self.pose, self._measured_tick = pose, tick
        return placement

    def put(self, pose: Pose2) -> None:
        """Pick the robot up and put it down elsewhere (`world_from_robot`)."""
        self.body.put(pose)
        self.pose = pose
        self._turn_rate = 0.0

    def observe(self, stage: Stage, tick: int) -> Observation:
        """What the robot senses; touches nothing that other robots share."""
        begin = time.perf_counter()
        self.image = self._picture(stage, tick)
        self.render_seconds += time.perf_counter() - begin
        return Observation(
            stamp_ns=tick * round(self.description.tick * 1e9),
            odometry=self.faults.odometry(self.body.odometry(), tick),
            image=self.image,
            proximity=self.faults.ranges(self.rangers.read(), self.rangers.reach, tick),
            bumped=self.faults.bumped(self.body.bumped, tick),
        )

    def _picture(self, stage: Stage, tick: int) -> Image | None:
        if self._dropped[0] != tick:
            # Once a tick, however often it is asked, and whatever else has failed.
            self._dropped = (tick, self._imager.drops())
        if self._dropped[1] or self.faults.active("camera", "drop", tick):
            return None
        if self.faults.active("camera", "freeze", tick) and self._frame is not None:
            return self._frame
        since = (tick - self._frame_tick) * self.description.tick if self._frame_tick >= 0 else 0.0
        self._frame = self._imager.picture(
            stage.scene, self._placement, stage.lamps, self._turn_rate, since, self.faults.covered(tick)
        )
        self._frame_tick = tick
        return self._frame


def positions(robots: Sequence[SimulatedRobot]) -> np.ndarray:
    """(R, 2) m, in world."""
    return np.array([[robot.pose.x, robot.pose.y] for robot in robots]).reshape(-1, 2)
