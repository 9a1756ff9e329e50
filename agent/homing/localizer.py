"""Where the robot is from a node of which only bearings are known: tracked, and joined to a trail."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from agent.homing.guesses import Guesses
from agent.homing.trail import TrailSettings
from agent.observation import Observation, RobotDescription
from agent.vision.lens import Lens
from agent.vision.node_tracks import NodeTracks
from agent.vision.sift import Features
from agent.vision.tracker import TrackerSettings
from hybridmap.node import Landmarks, Node
from hybridmap.pose import Array, PoseGaussian
from hybridmap.recognising.bearing_recognition import BearingRecognition


@dataclass(frozen=True)
class BearingLocalizerSettings:
    """When a node's landmarks count as in sight, and what becomes of their depths.

    Attributes:
        tracker: tracks of the node's landmarks.
        trail: what is kept of the way.
        least: landmarks that must be tracked.
        most_miss: a track that misses by more sigma than this is refused.
        strikes: a track that is refused this often in a row is given up.
        depth_share: a landmark has a depth from here on if it is known to this share.
    """

    tracker: TrackerSettings = field(default_factory=TrackerSettings)
    trail: TrailSettings = field(default_factory=TrailSettings)
    least: int = 6
    most_miss: float = 4.0
    strikes: int = 3
    depth_share: float = 0.12


class BearingLocalizer:
    """Follows one node's landmarks. Track ids are the landmarks' indices in the node."""

    def __init__(
        self,
        description: RobotDescription,
        lens: Lens,
        node: Node,
        image: NDArray[np.uint8],
        features: Features,
        recognition: BearingRecognition,
        prior: PoseGaussian,
        settings: BearingLocalizerSettings | None = None,
    ) -> None:
        """Start from a recognition of the node in an image's features.

        Args:
            description: of the robot.
            lens: of its camera.
            node: the place.
            image: (H, W) grey.
            features: of the image.
            recognition: of the node in them.
            prior: `node_from_robot` by anything but these bearings, however uncertain.
            settings: see there.
        """
        self._settings = s = settings or BearingLocalizerSettings()
        self._node = node
        self._camera = description.camera
        self._tracks = NodeTracks(lens, image, features, recognition.pairs, s.tracker, s.strikes)
        pixels = node.landmarks.pixels
        fixes = list(recognition.fixes)
        self._guesses = Guesses(description, node.camera, pixels, fixes, prior, s.trail)
        self._guesses.see(self._tracks.ids, features.pixels[recognition.pairs[:, 1]])

    @property
    def node(self) -> Node:
        """The node that the posture refers to, with the depths that the way so far has told."""
        if not self._guesses.agreed:
            return self._node
        inverse, sigma = self._guesses.trail.inverse_depths
        old = self._node.landmarks
        with np.errstate(invalid="ignore"):
            found = (inverse > 0.0) & (sigma < self._settings.depth_share * inverse)
        depths, sigmas = old.depths.copy(), old.depth_sigmas.copy()
        depths[found] = 1.0 / inverse[found]
        sigmas[found] = sigma[found] / inverse[found] ** 2
        return replace(self._node, landmarks=Landmarks(old.pixels, old.codes, depths, sigmas))

    @property
    def pose(self) -> PoseGaussian:
        """`node_from_robot` now."""
        return self._guesses.trail.pose

    @property
    def points_in_node(self) -> Array:
        """(N, 3) m, what the way so far says of the landmarks, in the node's robot frame; NaN if nothing."""
        return self._guesses.trail.points()

    @property
    def visible(self) -> NDArray[np.int64]:
        """Indices of the node's landmarks that are tracked now."""
        return self._tracks.ids

    @property
    def pixels(self) -> Array:
        """(N, 2) px, where they are seen."""
        return self._tracks.pixels

    @property
    def in_sight(self) -> bool:
        """Whether enough landmarks are tracked."""
        return len(self._tracks.ids) >= self._settings.least

    def renew(self, features: Features, recognition: BearingRecognition) -> None:
        """Track from where a fresh look finds the landmarks in the last image; the way so far still counts.

        Args:
            features: of the last image that `step` was given.
            recognition: of the node in them.
        """
        self._tracks.renew(features, recognition.pairs)

    def step(self, observation: Observation) -> None:
        """One tick: move by the wheels, follow the landmarks, join what they show to the trail."""
        self._guesses.move(observation.odometry)
        if observation.image is None:
            return
        self._tracks.follow(observation.image, self._expected())
        ids = self._tracks.ids
        if len(ids):
            self._guesses.see(ids, self._tracks.pixels)
            misses = self._guesses.trail.misses()[ids]
            refused = self._tracks.judge(~(misses > self._settings.most_miss))
            if len(refused):
                self._guesses.forget(refused)

    def _expected(self) -> Array:
        """(N, 2) px where the tracks should be now, in the tracks' order."""
        trail = self._guesses.trail
        points = trail.points()[self._tracks.ids]
        expected = self._camera.project(trail.pose.mean.inverse().apply(points))
        expected[~self._camera.contains(expected)] = np.nan
        return expected
