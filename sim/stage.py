"""What surrounds the robots: solids in the physics, panels in the scene, people that come and go."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.pose import Array, Pose2
from mapweave.sim.actors import Actor, figure_panels
from mapweave.sim.physics import Physics
from mapweave.sim.scene import Scene
from mapweave.sim.world import Block, PanelSet, World

SUBSTEPS = 8
"""Steps of the physics in a tick: 80 Hz."""
SOLVER_ITERATIONS = 20
"""Of PyBullet's contact solver. Together with SUBSTEPS: over a drive of 9 m and three turns, wheels without
slip then lose 3 mm to the solver, as against 2 mm with half as many steps more. Twice the iterations change
less than 0.2 mm."""

RigidPose = tuple[NDArray[np.float64], NDArray[np.float64]]
"""(3,) m of an origin, and (3, 3) rotation of its axes, in world."""


@dataclass(frozen=True, eq=False)
class _Cast:
    """An actor and its solid."""

    actor: Actor
    number: int
    panels: PanelSet


class Stage:
    """The world as it is now.

    Attributes:
        world: the building and its furniture.
        physics: where everything solid lives.
        floor: number of the floor in it.
        scene: everything that can be seen; robots first, by their order, then the building, then actors.
        lamps: brightness, 1 as painted.
    """

    def __init__(self, world: World, panels: Sequence[PanelSet], tick: float) -> None:
        """Build the world.

        Args:
            world: solid blocks and textured panels.
            panels: panels of the robots, each in its own frame.
            tick: simulated time of a tick, s.
        """
        self.world = world
        self.physics = p = Physics()
        p.setGravity(0, 0, -9.81)
        p.setTimeStep(tick / SUBSTEPS)
        # Friction along two axes by themselves, not as a cone: equally exact here, a quarter of the time.
        p.setPhysicsEngineParameter(
            deterministicOverlappingPairs=1, numSolverIterations=SOLVER_ITERATIONS, enableConeFriction=0
        )
        self.floor = int(p.createMultiBody(0, p.createCollisionShape(p.GEOM_PLANE)))
        p.changeDynamics(self.floor, -1, lateralFriction=1.0)
        self._solids = [self._solid(block) for block in world.blocks]
        self._panels = tuple(panels)
        self._still = PanelSet.of(world.panels)
        self._cast: list[_Cast] = []
        self._light = (1.0, 1.0, 0, 0)
        self.lamps = 1.0
        self._poses: tuple[RigidPose, ...] = ()
        self.scene = self._assemble()

    @property
    def actors(self) -> tuple[Actor, ...]:
        """The actors present now."""
        return tuple(member.actor for member in self._cast)

    def place_robots(self, poses: Sequence[RigidPose]) -> None:
        """Show the robots where they are now."""
        self._poses = tuple(poses)
        for number, (position, rotation) in enumerate(poses):
            self.scene.place(number, rotation, position)

    def pass_time(self, tick: int, seconds: float, robots: Array) -> None:
        """Before a tick: lamps change, actors walk or leave.

        Args:
            tick: that begins, counted from 1.
            seconds: that it takes.
            robots: (R, 2) m, in world.
        """
        old, new, begin, end = self._light
        share = 1.0 if tick >= end else (tick - begin) / (end - begin)
        self.lamps = new if share >= 1.0 else old + share * (new - old)
        leaving = [member for member in self._cast if tick > member.actor.until]
        for member in leaving:
            self.physics.removeBody(member.number)
        if leaving:
            self._cast = [member for member in self._cast if member not in leaving]
            self.scene = self._assemble()
        for number, member in enumerate(self._cast):
            member.actor.walk(seconds, robots)
            self._place(number)

    def change_light(self, factor: float, tick: int, ticks: int) -> None:
        """Change all lamps to a brightness, from a tick on, over some ticks."""
        self._light = (self.lamps, factor, tick, tick + ticks)
        if ticks == 0:
            self.lamps = factor

    def enter(self, actor: Actor, seed: Sequence[int]) -> None:
        """Add an actor; the seed is that of its appearance."""
        p, figure = self.physics, actor.figure
        half = [figure.length / 2, figure.width / 2, figure.height / 2]
        number = int(p.createMultiBody(0, p.createCollisionShape(p.GEOM_BOX, halfExtents=half)))
        self._cast.append(_Cast(actor, number, figure_panels(actor.what, seed)))
        self.scene = self._assemble()

    def rearrange(self, world: World) -> None:
        """Exchange the world for one of the same blocks and panels, some of which have moved."""
        for number, (old, new) in enumerate(zip(self.world.blocks, world.blocks, strict=True)):
            if old != new:
                self.physics.removeBody(self._solids[number])
                self._solids[number] = self._solid(new)
        self.world = world
        self._still = PanelSet.of(world.panels)
        self.scene = self._assemble()

    def close(self) -> None:
        """Release the physics. Idempotent."""
        self.physics.close()

    def _solid(self, block: Block) -> int:
        p, base, height = self.physics, block.base, block.top - block.bottom
        shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=[base.length / 2, base.width / 2, height / 2])
        place, turn = [base.x, base.y, block.bottom + height / 2], [0, 0, base.heading]
        return int(p.createMultiBody(0, shape, -1, place, p.getQuaternionFromEuler(turn)))

    def _assemble(self) -> Scene:
        scene = self.scene = Scene([*self._panels, self._still, *(member.panels for member in self._cast)])
        self.place_robots(self._poses)
        for number in range(len(self._cast)):
            self._place(number)
        return scene

    def _place(self, number: int) -> None:
        """Move an actor's solid and panels to its pose."""
        p, member = self.physics, self._cast[number]
        pose = member.actor.pose
        turn = p.getQuaternionFromEuler([0, 0, pose.heading])
        height = member.actor.figure.height
        p.resetBasePositionAndOrientation(member.number, [pose.x, pose.y, height / 2], turn)
        rotation, position = upright(pose)
        self.scene.place(len(self._panels) + 1 + number, rotation, position)


def upright(pose: Pose2) -> tuple[Array, Array]:
    """(3, 3) rotation and (3,) m position in space of an upright object on the floor."""
    rotation = np.eye(3)
    rotation[:2, :2] = pose.rotation
    return rotation, np.array([pose.x, pose.y, 0.0])
