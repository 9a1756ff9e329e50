"""Image acceptance: which images are new, and which are believed."""

from __future__ import annotations

import copy

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.mapping.kidnap_detection import FrameOverlap, KidnapDetector, relit
from mapweave.agent.observation import Observation
from mapweave.agent.settings import TrackingSettings
from mapweave.agent.vision.tracker import Tracker
from mapweave.hybridmap.pose import Array, Pose2

DROPPED = 3
"""Images that may be missing, one after the other, before the robot should wait for the next."""
STALE = (0.4, 0.5)
"""Once the wheels have moved this much, nothing can be said of an image before, m and rad."""


class ImageAcceptance:
    """Compares each image with the last one that was believed.

    An image that shows nothing of what the image before leads to expect is not believed: the tracks wait
    where they were last seen, for the light to come back or somebody to step aside. If that does not happen
    while the wheels stand, the robot was carried off.

    Attributes:
        moved: by the wheels since the last image that was believed.
        strange: how many images in a row were not believed because they show other things.
        blank: likewise because they show nothing.
        missing: how many images in a row did not come, or came a second time.
    """

    def __init__(self, detector: KidnapDetector, settings: TrackingSettings) -> None:
        """Take what compares two images, and how long strange images may last."""
        self.moved = Pose2()
        self.strange = self.blank = self.missing = 0
        self._detector, self._settings = detector, settings
        self._believed: NDArray[np.uint8] | None = None

    @property
    def doubtful(self) -> bool:
        """Whether the last image was not believed, or the last images were missing."""
        return bool(self.strange or self.blank) or self.missing > DROPPED

    @property
    def carried_off(self) -> bool:
        """Whether images have shown something else for so long that the robot must be elsewhere."""
        return self.strange >= self._settings.patience or self.blank >= self._settings.blank_patience

    def predict(self, motion: Pose2) -> None:
        """The wheels have moved."""
        self.moved = self.moved @ motion

    def new_image(self, observation: Observation) -> NDArray[np.uint8] | None:
        """The image, unless none came or the last one came again."""
        if observation.image is None or self._is_frozen(observation.image):
            self.missing += self._believed is not None
            return None
        self.missing = 0
        return observation.image

    def followed(self, tracker: Tracker, image: NDArray[np.uint8], expected: Array) -> Tracker | None:
        """The tracks as they are seen in a new image.

        Args:
            tracker: the tracks in the last image that was believed. It is left as it is unless nothing can
                be said of that image any more.
            image: the new one.
            expected: (N, 2) px, where the tracks should be.

        Returns:
            None if the image is not believed.
        """
        believed, (way, turn) = self._believed, STALE
        if believed is None or np.hypot(self.moved.x, self.moved.y) > way or abs(self.moved.heading) > turn:
            tracker.track(image, expected)
            return self._believe(image, tracker)
        overlap, moved = self._compared(tracker, image, believed, expected)
        if overlap is FrameOverlap.SAME:
            return self._believe(image, moved)
        same_light, moved = self._compared(tracker, relit(image, believed), believed, expected)
        if same_light is FrameOverlap.SAME:
            # The next image will be in the same light as this one really is.
            moved.relight(image)
            return self._believe(image, moved)
        self.strange += overlap is FrameOverlap.STRANGE
        self.blank += overlap is FrameOverlap.BLANK
        return None

    def _believe(self, image: NDArray[np.uint8], tracker: Tracker) -> Tracker:
        self.strange = self.blank = 0
        self._believed, self.moved = image, Pose2()
        return tracker

    def _compared(
        self, tracker: Tracker, image: NDArray[np.uint8], believed: NDArray[np.uint8], expected: Array
    ) -> tuple[FrameOverlap, Tracker]:
        """What an image has in common with the one before, and the tracks as they are followed into it."""
        moved = copy.copy(tracker)
        moved.track(image, expected)
        found = np.full(expected.shape, np.nan)
        found[np.isin(tracker.ids, moved.ids)] = moved.pixels
        return self._detector.compare(believed, image, self.moved.heading, expected, found), moved

    def _is_frozen(self, image: NDArray[np.uint8]) -> bool:
        """Whether an image is the last one again, to the last grey level, although the wheels have moved.

        Only an image with nothing in it is the same from everywhere.
        """
        moved = self.moved
        stands = max(abs(moved.x), abs(moved.y), abs(moved.heading)) < 1e-3
        if stands or self._believed is None or not np.array_equal(image, self._believed):
            return False
        return int(image.min()) < int(image.max())
