"""A differential-drive robot in PyBullet: two driven wheels, two casters, encoders, bumper."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from mapweave.agent.drivers.robot import clip
from mapweave.agent.observation import Command, Odometry, RobotDescription
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim import surface
from mapweave.sim.floorplan import Rectangle
from mapweave.sim.texture import Texture
from mapweave.sim.world import Block, PanelSet, block_panels

if TYPE_CHECKING:
    from mapweave.sim.physics import Physics

WHEEL_RADIUS = 0.05
"""Nominal, m: as the robot assumes."""
BODY_HEIGHT = 0.2
"""Top of the footprint's cylinder, m; the camera stands on a mast above."""
CASTER_AT = 0.11
"""Casters ahead of and behind the axle, m."""
CASTER_GAP = 5e-5
"""Casters end above the wheels' lowest points, else a robot with small wheels stands on casters alone, m."""
WHEEL_MASS = 0.2
"""kg."""
ROTOR_SHARE = 0.25
"""Inertia of a wheel's motor behind its gears, at the rim, as a share of the robot's mass.

For a robot of 4 kg, a rotor of 1e-6 kg m2 behind gears of 1:50. Without it, a wheel is so light that motor
and floor do not agree on its speed within the solver's iterations: a robot that stands creeps by 0.1 mm in
half a second.
"""
SLIP_WANDERS = 1.0
"""Correlation time of slip, s."""
EPISODE_TICKS = 10
"""A collision is over when the robot has touched nothing for so long."""


@dataclass(frozen=True)
class BodySettings:
    """How a robot's body differs from the ideal.

    Attributes:
        radius_error: standard deviation of each wheel's true radius, as a share.
        axle_error: likewise of the axle's length.
        slip: standard deviation of a wheel's slip ratio, which wanders over about a second.
        ticks_per_turn: of a wheel's encoder.
        motor_lag: time constant of the wheels' speed, s.
        motor_force: largest torque of a motor, N m.
        mass: kg.
    """

    radius_error: Annotated[float, Meta(ge=0.0, le=0.1)] = 0.003
    axle_error: Annotated[float, Meta(ge=0.0, le=0.2)] = 0.005
    slip: Annotated[float, Meta(ge=0.0, le=0.3)] = 0.01
    ticks_per_turn: Annotated[int, Meta(ge=8, le=10**7)] = 4096
    motor_lag: Annotated[float, Meta(ge=0.01, le=2.0)] = 0.12
    motor_force: Annotated[float, Meta(ge=0.1, le=20.0)] = 1.5
    mass: Annotated[float, Meta(ge=1.0, le=30.0)] = 4.0

    def wheel_noise(self, tick: float) -> float:
        """A wheel's noise, as a calibration drive would measure it, as a share of the way of a tick (s).

        Slip is correlated from tick to tick; over a way it has the effect of so much white noise.
        """
        return self.slip * math.sqrt(2.0 * SLIP_WANDERS / tick)


class Body:
    """One robot in the physics.

    Attributes:
        number: PyBullet's number of the body.
        bumped: whether the robot touched anything but the floor at the end of the last tick.
        collisions: number of collisions; contacts within a second are the same collision.
    """

    def __init__(
        self,
        physics: Physics,
        floor: int,
        pose: Pose2,
        description: RobotDescription,
        seed: tuple[int, ...],
        settings: BodySettings | None = None,
    ) -> None:
        """Put a robot on the floor.

        Args:
            physics: of the simulation.
            floor: number of the floor's body.
            pose: world_from_robot.
            description: of the robot, nominal; its true wheels and axle differ a little.
            seed: of the differences and of slip.
            settings: how much they may differ.
        """
        self._physics = physics
        self._floor = floor
        self._settings = settings or BodySettings()
        self._description = description
        self._rng = np.random.default_rng(seed)
        s = self._settings
        self._radii = WHEEL_RADIUS * (1.0 + s.radius_error * self._rng.standard_normal(2))
        self._axle = description.axle * (1.0 + s.axle_error * float(self._rng.standard_normal()))
        self.number = self._build(pose)
        self._targets: Array = np.zeros(2)
        self._speeds: Array = np.zeros(2)
        self._slips: Array = np.zeros(2)
        self._angles: Array = self._wheel_angles()
        self._turned: Array = np.zeros(2)
        self._ticks: Array = np.zeros(2)
        self._free_ticks = EPISODE_TICKS
        self.bumped = False
        self.collisions = 0

    def _build(self, pose: Pose2) -> int:
        p, s = self._physics, self._settings
        wheel_shapes = [p.createCollisionShape(p.GEOM_SPHERE, radius=float(r)) for r in self._radii]
        caster = p.createCollisionShape(p.GEOM_SPHERE, radius=WHEEL_RADIUS)
        # The footprint begins above the floor, so that only wheels and casters touch it.
        height = BODY_HEIGHT - 0.03
        base = p.createCollisionShape(
            p.GEOM_CYLINDER, radius=self._description.radius, height=height,
            collisionFramePosition=[0, 0, 0.03 + height / 2 - WHEEL_RADIUS],
        )  # fmt: skip
        half = self._axle / 2
        # Suspended such that wheels of any size end at the same height: the robot is level.
        left, right = (self._radii - WHEEL_RADIUS).tolist()
        places = [
            [0, half, left], [0, -half, right], [CASTER_AT, 0, CASTER_GAP], [-CASTER_AT, 0, CASTER_GAP],
        ]  # fmt: skip
        number = int(
            p.createMultiBody(
                baseMass=s.mass, baseCollisionShapeIndex=base, basePosition=[pose.x, pose.y, WHEEL_RADIUS],
                baseOrientation=p.getQuaternionFromEuler([0, 0, pose.heading]),
                baseInertialFramePosition=[0, 0, 0.0],
                linkMasses=[WHEEL_MASS, WHEEL_MASS, 0.05, 0.05],
                linkCollisionShapeIndices=[*wheel_shapes, caster, caster],
                linkVisualShapeIndices=[-1] * 4, linkPositions=places, linkOrientations=[[0, 0, 0, 1]] * 4,
                linkInertialFramePositions=[[0, 0, 0]] * 4, linkInertialFrameOrientations=[[0, 0, 0, 1]] * 4,
                linkParentIndices=[0] * 4,
                linkJointTypes=[p.JOINT_REVOLUTE, p.JOINT_REVOLUTE, p.JOINT_FIXED, p.JOINT_FIXED],
                linkJointAxis=[[0, 1, 0]] * 4,
            )
        )  # fmt: skip
        for wheel, radius in enumerate(self._radii.tolist()):
            # The rotor turns about the wheel's own axis only.
            ball = 0.4 * WHEEL_MASS * radius**2
            rotor = ROTOR_SHARE * s.mass * radius**2
            p.changeDynamics(
                number, wheel, lateralFriction=1.0, jointDamping=0.0,
                localInertiaDiagonal=[ball, ball + rotor, ball],
            )  # fmt: skip
        for other_link in (2, 3, -1):
            p.changeDynamics(number, other_link, lateralFriction=0.0)
        p.changeDynamics(number, -1, activationState=p.ACTIVATION_STATE_DISABLE_SLEEPING)
        return number

    def drive(self, command: Command) -> None:
        """Take a command for the coming tick; clipped to the robot's limits."""
        d = self._description
        command = clip(command, d)
        half = command.turn * d.axle / 2
        self._targets = np.array([command.forward - half, command.forward + half]) / WHEEL_RADIUS
        # Slip is a property of floor and tyre: it wanders and the encoders do not see it.
        keep = math.exp(-d.tick / SLIP_WANDERS)
        fresh = self._rng.standard_normal(2) * self._settings.slip * math.sqrt(1.0 - keep**2)
        self._slips = keep * self._slips + fresh

    def substep(self, seconds: float) -> None:
        """Move the motors a little toward their speed; call before each step of the physics."""
        p, s = self._physics, self._settings
        share = 1.0 - math.exp(-seconds / s.motor_lag)
        self._speeds += share * (self._targets - self._speeds)
        p.setJointMotorControlArray(
            self.number, [0, 1], p.VELOCITY_CONTROL, targetVelocities=self._speeds * (1.0 - self._slips),
            forces=[s.motor_force] * 2,
        )  # fmt: skip

    def settle(self) -> None:
        """After a tick: read the wheels, count collisions."""
        angles = self._wheel_angles()
        # The encoder sees the wheel turn; of that, the slip was lost on the floor.
        self._turned += (angles - self._angles) / (1.0 - self._slips)
        self._angles = angles
        self.bumped = self._touches()
        # A robot that is pressed against a wall rattles: it may be free for a moment.
        if self.bumped:
            self.collisions += int(self._free_ticks >= EPISODE_TICKS)
        self._free_ticks = 0 if self.bumped else self._free_ticks + 1

    def odometry(self) -> Odometry:
        """What the encoders measured since the last call, by the nominal wheels and axle."""
        per_turn = self._settings.ticks_per_turn
        ticks = np.round(self._turned / (2 * math.pi) * per_turn)
        left, right = (ticks - self._ticks) / per_turn * 2 * math.pi * WHEEL_RADIUS
        self._ticks = ticks
        return Odometry(float(left + right) / 2, float(right - left) / self._description.axle)

    def _touches(self) -> bool:
        contacts = self._physics.getContactPoints(bodyA=self.number)
        return any(c[2] != self._floor and c[1] != c[2] and c[8] <= 0.0 for c in contacts)

    def position_and_rotation(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(3,) m of the robot's origin on the floor, and (3, 3) rotation of its axes, in world."""
        position, orientation = self._physics.getBasePositionAndOrientation(self.number)
        rotation = np.array(self._physics.getMatrixFromQuaternion(orientation)).reshape(3, 3)
        return np.array(position) - rotation @ [0.0, 0.0, WHEEL_RADIUS], rotation

    @property
    def pose(self) -> Pose2:
        """world_from_robot, true."""
        position, rotation = self.position_and_rotation()
        return Pose2(float(position[0]), float(position[1]), math.atan2(rotation[1, 0], rotation[0, 0]))

    def put(self, pose: Pose2) -> None:
        """Pick the robot up and put it down elsewhere. The wheels do not turn."""
        p = self._physics
        orientation = p.getQuaternionFromEuler([0, 0, pose.heading])
        p.resetBasePositionAndOrientation(self.number, [pose.x, pose.y, WHEEL_RADIUS], orientation)
        p.resetBaseVelocity(self.number, [0, 0, 0], [0, 0, 0])
        for wheel, angle in zip((0, 1), self._angles.tolist(), strict=True):
            p.resetJointState(self.number, wheel, angle, 0.0)
        self._speeds[:] = 0.0
        self._targets[:] = 0.0
        self.bumped = False
        self._free_ticks = EPISODE_TICKS

    def _wheel_angles(self) -> Array:
        return np.array([state[0] for state in self._physics.getJointStates(self.number, [0, 1])])


def body_panels(number: int) -> PanelSet:
    """A robot's appearance to others, in its own frame: a low crate with its own prints."""
    side = 0.21
    textures = [
        Texture(round(side * 300), round(0.17 * 300), (0xB0D1, number, k), surface.crate) for k in range(4)
    ]
    return PanelSet.of(block_panels(Block(Rectangle(0.0, 0.0, side, side), 0.03, BODY_HEIGHT), textures))
