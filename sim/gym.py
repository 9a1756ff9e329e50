"""A Gymnasium environment: one robot parks before what it sees, in a new world for each seed.

    import gymnasium
    env = gymnasium.make("mapweave.sim.gym:mapweave/Park-v0")

Gymnasium is an extra: `pip install 'mapweave[gym]'`.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.observation import Command, Observation
from mapweave.hybridmap.errors import InvalidValue, SettingsError
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.sim.placement import is_clear
from mapweave.sim.robots import RobotSetup
from mapweave.sim.simulation import TICK, Simulation
from mapweave.sim.world import World
from mapweave.sim.worlds.catalog import make_world

try:
    import gymnasium
    from gymnasium import spaces
except ImportError:
    raise SettingsError("mapweave.sim.gym needs Gymnasium: pip install 'mapweave[gym]'") from None

REACHED = 0.05
"""A robot is parked when it is nearer than this to the goal, m,"""
REACHED_ANGLE = math.radians(3.0)
"""turned less than this against it, rad,"""
REACHED_STILL = 0.02
"""and moved less than this in the last tick, m and rad."""
NEAREST, FARTHEST = 0.5, 2.0
"""Goals are so far from the start, m."""
ANGLE_WORTH = 0.3
"""A radian off is as bad as so many m off."""
REACH = 1e3
"""Bounds of observations that have none by nature, m and rad."""

Seen = dict[str, Any]


class MapweaveEnv(gymnasium.Env[Seen, NDArray[np.float32]]):
    """Drive to a pose that is given relative to the start.

    Observation, a dict:
        image: (H, W) uint8, as the camera gives it; where a frame was dropped, the one before.
        odometry: (2,) float32, m ahead and rad to the left since the last step, by the encoders.
        proximity: (K,) float32, m along each ranger.
        bumped: 1 while the bumper is pressed.
        goal: (3,) float32, x m, y m, heading rad of the goal in the frame where the robot started.

    Action: (2,) float32, speed m/s and turn rate rad/s, for the next 0.1 s.

    Reward: what the robot came nearer (m, and 0.3 m a radian), less 0.002 a step and 1 a collision; 5 when
    parked. Nothing more can be earned by coming near again, so the best is to be quick.

    Info: `world_from_robot` and `world_from_goal` (3,), true; `distance` m, `angle` rad, `collisions`,
    `success`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": round(1 / TICK)}  # noqa: RUF012

    def __init__(
        self,
        kind: str = "arena",
        seconds: float = 60.0,
        robot: RobotSetup | None = None,
        render_mode: str | None = None,
        **parameters: Any,
    ) -> None:
        """Define the spaces; the world is built by `reset`.

        Args:
            kind: of world, see mapweave.sim.worlds.catalog.
            seconds: an episode that takes longer is truncated, simulated s.
            robot: what to drive.
            render_mode: "rgb_array", or None.
            parameters: of the world.

        Raises:
            InvalidValue: a render mode or a time that cannot be.
        """
        if render_mode not in (None, "rgb_array"):
            raise InvalidValue(f"render_mode is {render_mode!r}, must be 'rgb_array' or None")
        if not seconds >= TICK:
            raise InvalidValue(f"an episode of {seconds} s is shorter than a tick")
        self.render_mode = render_mode
        self._kind, self._parameters = kind, parameters
        self._setup = robot or RobotSetup("robot")
        self._limit = round(seconds / TICK)
        d = self._setup.describe()
        shape = (d.camera.height, d.camera.width)
        high = np.array([d.max_forward, d.max_turn], np.float32)
        self.action_space = spaces.Box(-high, high, dtype=np.float32)
        self.observation_space = spaces.Dict(
            {
                "image": spaces.Box(0, 255, shape, np.uint8),
                "odometry": spaces.Box(-REACH, REACH, (2,), np.float32),
                "proximity": spaces.Box(0.0, d.ranger_reach, (len(d.ranger_bearings),), np.float32),
                "bumped": spaces.Discrete(2),
                "goal": spaces.Box(-REACH, REACH, (3,), np.float32),
            }
        )
        self._simulation: Simulation | None = None
        self._world_from_start = self._world_from_goal = Pose2()
        self._image: NDArray[np.uint8] = np.zeros(shape, np.uint8)
        self._best = 0.0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Seen, dict[str, Any]]:
        """Begin an episode in a new world; the same seed gives the same.

        Raises:
            InvalidValue: the kind of world has no place for a robot and its goal.
        """
        super().reset(seed=seed)
        self.close()
        for _ in range(20):
            number = int(self.np_random.integers(2**31))
            world = make_world(self._kind, number, **self._parameters)
            simulation = Simulation(world, [self._setup], number)
            self._world_from_start = simulation.truth(self._setup.name)
            goal = self._choose_goal(world)
            if goal is not None:
                self._simulation, self._world_from_goal = simulation, goal
                break
            simulation.close()
        else:
            raise InvalidValue(f"in 20 worlds of kind {self._kind} a robot had no goal to go to")
        self._best = self._cost()
        return self._seen(simulation.step({})[self._setup.name]), self._info(False)

    def step(self, action: NDArray[np.float32]) -> tuple[Seen, float, bool, bool, dict[str, Any]]:
        """Drive for a tick.

        Raises:
            InvalidValue: before `reset`, or with an action that is no number.
        """
        simulation, name = self._running(), self._setup.name
        forward, turn = (float(value) for value in action)
        if not (math.isfinite(forward) and math.isfinite(turn)):
            raise InvalidValue(f"the action ({forward}, {turn}) is not finite")
        collisions, before = simulation.collisions(name), simulation.truth(name)
        observation = simulation.step({name: Command(forward, turn)})[name]
        moved = before.inverse() @ simulation.truth(name)
        still = math.hypot(moved.x, moved.y) < REACHED_STILL and abs(moved.heading) < REACHED_STILL
        distance, angle = self._off()
        success = still and distance < REACHED and abs(angle) < REACHED_ANGLE
        nearer = max(0.0, self._best - self._cost())
        self._best -= nearer
        reward = nearer - 0.002 - (simulation.collisions(name) - collisions) + 5.0 * success
        truncated = not success and simulation.tick > self._limit
        return self._seen(observation), reward, success, truncated, self._info(success)

    def render(self) -> NDArray[np.uint8] | None:
        """(H, W, 3) the camera's last picture, if asked for by the render mode."""
        return np.repeat(self._image[..., None], 3, axis=2) if self.render_mode else None

    def close(self) -> None:
        """Release the physics. Idempotent."""
        if self._simulation is not None:
            self._simulation.close()
            self._simulation = None

    def _running(self) -> Simulation:
        if self._simulation is None:
            raise InvalidValue("call reset first")
        return self._simulation

    def _choose_goal(self, world: World) -> Pose2 | None:
        """A free place visible from the start, with a way there, and about the robot's present heading."""
        start = self._world_from_start
        radius = self._setup.describe().radius + 0.1
        for _ in range(50):
            distance = self.np_random.uniform(NEAREST, FARTHEST)
            bearing = self.np_random.uniform(-math.pi / 4, math.pi / 4)
            turn = self.np_random.uniform(-math.pi / 6, math.pi / 6)
            goal = start @ Pose2(distance * math.cos(bearing), distance * math.sin(bearing), turn)
            if is_clear(world.plan, [(start.x, start.y), (goal.x, goal.y)], radius):
                return goal
        return None

    def _off(self) -> tuple[float, float]:
        """How far from the goal: m, and rad."""
        off = self._world_from_goal.inverse() @ self._running().truth(self._setup.name)
        return math.hypot(off.x, off.y), wrap_angle(off.heading)

    def _cost(self) -> float:
        distance, angle = self._off()
        return distance + ANGLE_WORTH * abs(angle)

    def _seen(self, agent_observation: Observation) -> Seen:
        if agent_observation.image is not None:
            self._image = agent_observation.image
        goal = self._world_from_start.inverse() @ self._world_from_goal
        return {
            "image": self._image.copy(),
            "odometry": np.array(
                [agent_observation.odometry.forward, agent_observation.odometry.turn], np.float32
            ),
            "proximity": agent_observation.proximity.astype(np.float32),
            "bumped": np.int64(agent_observation.bumped),
            "goal": goal.vector.astype(np.float32),
        }

    def _info(self, success: bool) -> dict[str, Any]:
        distance, angle = self._off()
        simulation, name = self._running(), self._setup.name
        return {
            "world_from_robot": simulation.truth(name).vector,
            "world_from_goal": self._world_from_goal.vector,
            "distance": distance,
            "angle": angle,
            "collisions": simulation.collisions(name),
            "success": success,
        }


gymnasium.register(id="mapweave/Park-v0", entry_point="mapweave.sim.gym:MapweaveEnv")
