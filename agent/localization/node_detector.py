"""Detection of nodes whose landmarks should be in view."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.localization.node_localizer import NodeLocalizer, NodeLocalizerSettings
from mapweave.agent.observation import RobotDescription
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Pose2, wrap_angle
from mapweave.registration.levelling import level
from mapweave.registration.pose_refinement import refine_pose
from mapweave.registration.recognition import RecognitionSettings, recognise
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Sift

PLAUSIBLE = 0.3
"""Largest distance of a recognition from the expected pose, m."""
PLAUSIBLE_TURN = 0.25
"""Likewise, rad."""
MORE = 1.3
"""Tracks are given up for a detection that finds this many times as many landmarks."""


@dataclass(frozen=True)
class NodeDetectorSettings:
    """When a node counts as found.

    Attributes:
        localizer: tracking and filtering of its landmarks from then on.
        recognition: when it counts as recognised. The thresholds are lower than for a lost robot, because the
            pose must also be the expected one.
    """

    localizer: NodeLocalizerSettings = field(default_factory=NodeLocalizerSettings)
    recognition: RecognitionSettings = field(
        default_factory=lambda: RecognitionSettings(
            least_inliers=7, least_cells=2, least_seen=0.05, least_evidence=20.0
        )
    )


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


class NodeDetector:
    """Finds nodes by their features, where they are expected and nowhere else."""

    def __init__(
        self,
        description: RobotDescription,
        lens: Lens,
        sift: Sift,
        settings: NodeDetectorSettings,
        rng: np.random.Generator,
    ) -> None:
        """Take the robot's camera.

        Args:
            description: of the robot.
            lens: of its camera.
            sift: finds features.
            settings: when a node counts as found.
            rng: for verification.
        """
        self._description = description
        self._lens = lens
        self._sift = sift
        self._settings = settings
        self._rng = rng

    def find(self, image: NDArray[np.uint8], wanted: Iterable[Expected]) -> tuple[int, NodeLocalizer] | None:
        """Search for nodes, in their order.

        Args:
            image: (H, W) grey.
            wanted: nodes that may be in view.

        Returns:
            Leg of the first that is found, and what follows its landmarks from this image on; or None.
        """
        s, features = self._settings, self._sift.extract(image)
        view = features.view(self._description.camera)
        for candidate in wanted:
            recognition = recognise(candidate.node, view, s.recognition, self._rng)
            if recognition is None or not self._plausible(recognition.node_from_robot.mean, candidate):
                continue
            if recognition.inliers > MORE * candidate.tracked:
                node, node_from_robot = (
                    candidate.node,
                    refine_pose(candidate.node, view, recognition, s.recognition.pose),
                )
                if node.landmarks.scale_share:
                    levelled = level(node, view, recognition)
                    if self._plausible(levelled.node_from_robot.mean, candidate):
                        node, node_from_robot = levelled.node, levelled.node_from_robot
                recognition = replace(recognition, node_from_robot=node_from_robot)
                return candidate.leg, NodeLocalizer(
                    self._description, self._lens, node, image, features, recognition, s.localizer
                )
        return None

    def _plausible(self, measured: Pose2, expected: Expected) -> bool:
        """Whether the robot may be there, given the expected pose."""
        _s, predicted = self._settings, expected.node_from_robot
        turned = abs(wrap_angle(measured.heading - predicted.heading))
        return (
            measured.distance(predicted) <= PLAUSIBLE * expected.doubt
            and turned <= PLAUSIBLE_TURN * expected.doubt
        )
