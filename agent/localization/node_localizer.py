"""Where the robot is with respect to one node: recognised by SIFT, then tracked and filtered."""

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.arrays import among
from mapweave.agent.ekf.landmark_estimates import NodeLandmarks
from mapweave.agent.ekf.localization_filter import LocalizationFilter
from mapweave.agent.observation import Observation, RobotDescription
from mapweave.agent.settings import AgentSettings
from mapweave.agent.vision.node_tracks import NodeTracks
from mapweave.hybridmap.node import Node
from mapweave.hybridmap.pose import Array, PoseGaussian
from mapweave.registration.recognition import Recognition
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Features

LEAST = 4
"""Landmarks that must be tracked (paper, section 6: n >= 4)."""
MOST_REFUSALS = 3
"""A track that the filter rejects this often in a row is dropped."""


class NodeLocalizer:
    """Follows one node's landmarks. Track ids are the landmarks' indices in the node.

    Attributes:
        node: the node that the pose refers to.
    """

    def __init__(
        self,
        description: RobotDescription,
        lens: Lens,
        node: Node,
        image: NDArray[np.uint8],
        features: Features,
        recognition: Recognition,
        settings: AgentSettings | None = None,
    ) -> None:
        """Start from a recognition of the node in an image's features."""
        self.node = node
        self._settings = settings or AgentSettings()
        self._description = description
        self._tracks = NodeTracks(lens, image, features, recognition.pairs, MOST_REFUSALS)
        self._depths, self._depth_sigmas = np.full((2, len(node.landmarks)), np.nan)
        self._teaches = True
        self._filter = self._filter_at(recognition.node_from_robot, self._tracks.ids)

    @property
    def pose(self) -> PoseGaussian:
        """`node_from_robot` now."""
        return self._filter.pose

    @property
    def visible(self) -> NDArray[np.int64]:
        """Indices of the node's landmarks that are tracked now."""
        return self._tracks.ids

    @property
    def pixels(self) -> Array:
        """(N, 2) px, where they are seen."""
        return self._tracks.pixels

    @property
    def landmarks(self) -> NodeLandmarks:
        """The landmarks that are followed, as they are known now, in the node's robot frame."""
        return self._filter.landmarks_in_node()

    @property
    def in_sight(self) -> bool:
        """Whether enough landmarks are tracked and the filter is healthy."""
        return len(self._tracks.ids) >= LEAST and self._filter.healthy

    def restart(self, pose: PoseGaussian) -> None:
        """Restart at a pose that is known better than by the tracks so far.

        The pose comes from the same landmarks, so from then on their depths do not learn from it.
        """
        self._note(np.ones(len(self._filter.ids), np.bool_))
        self._teaches = False
        self._filter = self._filter_at(pose, self._tracks.ids)

    def depths(self) -> tuple[Array, Array]:
        """Depths of all landmarks that were tracked until they left the view.

        Returns:
            (N,) m, and standard deviations (N,) m as of independent errors, see
            LocalizationState.depths; in the order of the node's landmarks, NaN for those that were not
            tracked, or dropped.
        """
        self._note(np.ones(len(self._filter.ids), np.bool_))
        return self._depths.copy(), self._depth_sigmas.copy()

    def _note(self, which: NDArray[np.bool_]) -> None:
        """Keep the depths of some of the filter's landmarks."""
        ids = self._filter.ids[which]
        if self._teaches and self._filter.healthy:
            depths, sigmas = self._filter.state.depths()
            self._depths[ids], self._depth_sigmas[ids] = depths[which], sigmas[which]

    def step(self, observation: Observation) -> None:
        """One tick: predict by the wheels, track the landmarks, update."""
        self._filter.predict(observation.odometry)
        if observation.image is None:
            return
        self._tracks.follow(observation.image, self._expected())
        lost = ~among(self._filter.ids, self._tracks.ids)
        if lost.any():
            self._note(lost)
            self._filter.remove(self._filter.ids[lost])
        if len(self._tracks.ids):
            report = self._filter.update(self._tracks.ids, self._tracks.pixels)
            bad = self._tracks.judge(report.accepted)
            if len(bad):
                self._filter.remove(bad)
                self._depths[bad] = self._depth_sigmas[bad] = np.nan

    def _filter_at(self, pose: PoseGaussian, landmarks: NDArray[np.int64]) -> LocalizationFilter:
        node, description = self.node, self._description
        scale_share = node.landmarks.scale_share
        return LocalizationFilter(
            description.camera,
            description.axle,
            description.wheel_noise,
            pose,
            landmarks,
            node.points_in_robot[landmarks],
            node.landmarks.covariances_in_robot(node.camera, scale_share=scale_share)[landmarks],
            scale_share,
            settings=self._settings.filter,
            side_slip=description.side_slip,
        )

    def _expected(self) -> Array:
        """(N, 2) px where the tracks should be now, in the tracks' order."""
        expected = self._filter.predict_pixels(self._tracks.ids)
        expected[~self._description.camera.contains(expected)] = np.nan
        return expected
