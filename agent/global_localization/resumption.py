"""Resumption of a map: global localization on the own map alone, tick by tick, for a robot that maps."""

from collections import deque

import numpy as np

from mapweave.agent.global_localization.candidates import OwnMapSource, RecognizedNode
from mapweave.agent.global_localization.global_localization import TO_MAP, GlobalLocalization, SearchPolicy
from mapweave.agent.motion_primitives import Behaviour, MotionPrimitives
from mapweave.agent.observation import Command, Observation, RobotDescription
from mapweave.hybridmap.hybrid_map import HybridMap
from mapweave.hybridmap.pose import Array, Pose2
from mapweave.vision.sift import Sift

REMEMBERED = 600
"""Readings of the rangers that are kept for the grid, the latest."""


class Resumption:
    """Localizes a robot on its own map after a restart, after navigation, or after a kidnapping.

    Attributes:
        found: the place that was recognised in the last observation; None until then.
        lost: whether it has tried everything without success.
        seen: `odom_from_robot` and readings of the rangers, (K,) m, while it turned; the wheels' own
            frame begins where it began.
    """

    def __init__(
        self,
        description: RobotDescription,
        sift: Sift,
        own_map: HybridMap,
        drives: bool,
        seed: int = 0,
        policy: SearchPolicy | None = None,
    ) -> None:
        """Start the search.

        Args:
            description: of the robot.
            sift: features of an image.
            own_map: with at least one node.
            drives: whether it may turn and drive by itself.
            seed: of the recognition's random samples.
            policy: how hard it tries; `TO_MAP` without.
        """
        self.found: RecognizedNode | None = None
        self.lost = False
        self.seen: deque[tuple[Pose2, Array]] = deque(maxlen=REMEMBERED)
        self._motion = MotionPrimitives(description)
        self._localization = GlobalLocalization(
            description, sift, self._motion, OwnMapSource(own_map, np.random.default_rng(seed)),
            policy or TO_MAP,
        )  # fmt: skip
        self._behaviour = self._find(drives)

    @property
    def detail(self) -> str:
        """What it does and why, in words."""
        return self._localization.detail

    @property
    def odom_from_robot(self) -> Pose2:
        """The robot's pose by the wheels since the search began."""
        return self._motion.odom_from_robot

    def step(self, observation: Observation, standing: bool = False) -> Command:
        """One tick: returns what the wheels shall do. Once `found` is set there is nothing more to do.

        Args:
            observation: what the robot senses now.
            standing: the robot must not move; the behaviour waits.
        """
        self._motion.take_in(observation, ())
        self.seen.append((self.odom_from_robot, observation.proximity))
        return Command() if standing else next(self._behaviour)

    def _find(self, drives: bool) -> Behaviour:
        place = yield from self._localization.search() if drives else self._localization.wait()
        self.found = None if place is None else place.recognized
        self.lost = place is None
        while True:
            yield Command()
