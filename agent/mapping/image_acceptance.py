"""Image acceptance: which images are new, and which are accepted."""

import copy

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.arrays import among, same_image
from mapweave.agent.mapping.kidnap_detection import FrameOverlap, KidnapDetector, relit
from mapweave.agent.observation import Observation
from mapweave.agent.vision.tracker import Tracker
from mapweave.hybridmap.pose import Array, Pose2

DROPPED = 3
"""Images that may be missing, one after the other, before the robot should wait for the next."""
STALE = (0.4, 0.5)
"""Once the wheels have moved this much, nothing can be said of an image before, m and rad."""
PATIENCE = 30
"""Images in a row that show other things than they should before the robot takes itself for carried off.
Chosen: 3 s at 10 Hz, in which a person who walks by is gone."""
BLANK_PATIENCE = 100
"""The same for images that show nothing. Chosen: 10 s at 10 Hz, in which a light that was switched off by
mistake is on again. A robot maps nothing in the meantime."""


class ImageAcceptance:
    """Compares each image with the last accepted one.

    An image that shows nothing of what the last one predicts is rejected: the tracks wait at their last
    positions, for the light to come back or a person to step aside. If that does not happen while the wheels
    do not move, the robot was carried off.

    Attributes:
        moved: by the wheels since the last accepted image.
        strange: how many images in a row were rejected because they show other things.
        blank: likewise because they show nothing.
        missing: how many images in a row did not come, or came a second time.
    """

    def __init__(self, detector: KidnapDetector) -> None:
        """Take what compares two images."""
        self.moved = Pose2()
        self.strange = self.blank = self.missing = 0
        self._detector = detector
        self._accepted: NDArray[np.uint8] | None = None

    @property
    def doubtful(self) -> bool:
        """Whether the last image was rejected, or the last images were missing."""
        return bool(self.strange or self.blank) or self.missing > DROPPED

    @property
    def carried_off(self) -> bool:
        """Whether images have shown something else for so long that the robot must be elsewhere."""
        return self.strange >= PATIENCE or self.blank >= BLANK_PATIENCE

    def predict(self, motion: Pose2) -> None:
        """The wheels have moved."""
        self.moved = self.moved @ motion

    def new_image(self, observation: Observation) -> NDArray[np.uint8] | None:
        """The image, unless none came or the last one came again."""
        if observation.image is None or self._is_frozen(observation.image):
            self.missing += self._accepted is not None
            return None
        self.missing = 0
        return observation.image

    def followed(self, tracker: Tracker, image: NDArray[np.uint8], expected: Array) -> Tracker | None:
        """The tracks as they are seen in a new image.

        Args:
            tracker: the tracks in the last accepted image. It is unchanged unless that image is too old
                to compare with.
            image: the new one.
            expected: (N, 2) px, where the tracks should be.

        Returns:
            None if the image is rejected.
        """
        accepted, (way, turn) = self._accepted, STALE
        if accepted is None or np.hypot(self.moved.x, self.moved.y) > way or abs(self.moved.heading) > turn:
            tracker.track(image, expected)
            return self._accept(image, tracker)
        overlap, moved = self._compared(tracker, image, accepted, expected)
        if overlap is FrameOverlap.SAME:
            return self._accept(image, moved)
        same_light, moved = self._compared(tracker, relit(image, accepted), accepted, expected)
        if same_light is FrameOverlap.SAME:
            # The next image will be in the same light as this one really is.
            moved.relight(image)
            return self._accept(image, moved)
        self.strange += overlap is FrameOverlap.STRANGE
        self.blank += overlap is FrameOverlap.BLANK
        return None

    def _accept(self, image: NDArray[np.uint8], tracker: Tracker) -> Tracker:
        self.strange = self.blank = 0
        self._accepted, self.moved = image, Pose2()
        return tracker

    def _compared(
        self, tracker: Tracker, image: NDArray[np.uint8], accepted: NDArray[np.uint8], expected: Array
    ) -> tuple[FrameOverlap, Tracker]:
        """What an image has in common with the last one, and the tracks followed into it."""
        moved = copy.copy(tracker)
        moved.track(image, expected)
        followed = np.full(expected.shape, np.nan)
        followed[among(tracker.ids, moved.ids)] = moved.pixels
        return self._detector.compare(accepted, image, self.moved.heading, expected, followed), moved

    def _is_frozen(self, image: NDArray[np.uint8]) -> bool:
        """Whether an image is the last one again, to the last grey level, although the wheels have moved.

        Only an image with nothing in it is the same from everywhere.
        """
        moved = self.moved
        stands = max(abs(moved.x), abs(moved.y), abs(moved.heading)) < 1e-3
        if stands or self._accepted is None or not same_image(image, self._accepted):
            return False
        return int(image.min()) < int(image.max())
