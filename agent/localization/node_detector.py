"""Detection of nodes whose landmarks should be in view."""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.localization.node_localizer import NodeLocalizer
from mapweave.agent.observation import RobotDescription
from mapweave.agent.settings import AgentSettings
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array, Pose2, wrap_angle
from mapweave.registration.levelling import level
from mapweave.registration.pose_refinement import refine_pose
from mapweave.registration.recognition import RecognitionSettings, recognise
from mapweave.vision.lens import Lens
from mapweave.vision.sift import NOTHING, Sift


class Expected(NamedTuple):
    """A node that may be in view.

    Attributes:
        leg: number by which the caller knows it.
        node: with its landmarks.
        node_from_robot: expected pose.
        doubt: factor on the tolerances.
        tracked: landmarks of the node that are tracked already.
    """

    leg: int
    node: Node
    node_from_robot: Pose2
    doubt: float = 1.0
    tracked: int = 0


EXPECTED = RecognitionSettings(least_inliers=7, least_cells=2, least_seen=0.05)
"""Less is asked than of a lost robot, because the pose must also be the expected one."""
PLAUSIBLE = 0.3
"""A recognition this far from where the robot believes to be is not believed, m."""
PLAUSIBLE_TURN = 0.25
"""A recognition turned this much from where the robot believes to be is not believed, rad."""
MORE = 1.3
"""What is tracked already is given up for a fresh look that finds this many times as many landmarks."""


class NodeDetector:
    """Finds nodes by their features, where they are expected and nowhere else."""

    def __init__(
        self,
        description: RobotDescription,
        lens: Lens,
        sift: Sift,
        rng: np.random.Generator,
        settings: AgentSettings | None = None,
    ) -> None:
        """Take the robot's camera.

        Args:
            description: of the robot.
            lens: of its camera.
            sift: finds features.
            rng: for verification.
            settings: of the tracks and the filter of a node that was found.
        """
        self._description = description
        self._lens = lens
        self._sift = sift
        self._settings = settings
        self._rng = rng

    def find(
        self,
        image: NDArray[np.uint8],
        wanted: Iterable[Expected],
        settings: RecognitionSettings = EXPECTED,
        left_out: Array = NOTHING,
    ) -> tuple[int, NodeLocalizer] | None:
        """Search for nodes, in their order.

        Args:
            image: (H, W) grey.
            wanted: nodes that may be in view.
            settings: what a recognition takes.
            left_out: regions of the image that are not used; see Observation.

        Returns:
            Leg of the first that is found, and what follows its landmarks from this image on; or None.
        """
        features = self._sift.extract(image, left_out)
        view = features.view(self._description.camera)
        for candidate in wanted:
            recognition = recognise(candidate.node, view, settings, self._rng)
            if recognition is None or not self._plausible(recognition.node_from_robot.mean, candidate):
                continue
            if recognition.inliers > MORE * candidate.tracked:
                node, node_from_robot = (
                    candidate.node,
                    refine_pose(candidate.node, view, recognition, settings.pose),
                )
                if node.landmarks.scale_share:
                    levelled = level(node, view, recognition)
                    if self._plausible(levelled.node_from_robot.mean, candidate):
                        node, node_from_robot = levelled.node, levelled.node_from_robot
                recognition = replace(recognition, node_from_robot=node_from_robot)
                return candidate.leg, NodeLocalizer(
                    self._description, self._lens, node, image, features, recognition, self._settings
                )
        return None

    def _plausible(self, measured: Pose2, expected: Expected) -> bool:
        """Whether the robot may be there, given the expected pose."""
        predicted = expected.node_from_robot
        turned = abs(wrap_angle(measured.heading - predicted.heading))
        return (
            measured.distance(predicted) <= PLAUSIBLE * expected.doubt
            and turned <= PLAUSIBLE_TURN * expected.doubt
        )
