"""One node's landmarks in the images: tracked from where a recognition has found them."""

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.arrays import among
from mapweave.agent.vision.track_quality import RejectionCounter
from mapweave.agent.vision.tracker import Tracker
from mapweave.hybridmap.pose import Array
from mapweave.vision.lens import Lens
from mapweave.vision.sift import Features


class NodeTracks:
    """Follows landmarks until they are lost or refused too often. Ids are their indices in the node."""

    def __init__(
        self,
        lens: Lens,
        image: NDArray[np.uint8],
        features: Features,
        pairs: NDArray[np.integer],
        most_refusals: int,
    ) -> None:
        """Begin where a recognition has found the landmarks.

        Args:
            lens: of the camera.
            image: (H, W) grey.
            features: of the image.
            pairs: (N, 2) indices of landmarks, and of the features that show them.
            most_refusals: a track that is refused this often in a row is given up.
        """
        self._tracker = Tracker(lens)
        self._tracker.track(image)
        self._rejections = RejectionCounter(most_refusals)
        self.renew(features, pairs)

    @property
    def ids(self) -> NDArray[np.int64]:
        """(N,) landmarks that are tracked now."""
        return self._tracker.ids

    @property
    def pixels(self) -> Array:
        """(N, 2) px in the ideal image, where they are seen."""
        return self._tracker.pixels

    def renew(self, features: Features, pairs: NDArray[np.integer]) -> None:
        """Continue from a detection of the landmarks in the last image; rejections are counted from zero."""
        self._tracker.clear()
        self._tracker.add(pairs[:, 0].astype(np.int64), features.raw[pairs[:, 1]])
        self._rejections.forget()

    def follow(self, image: NDArray[np.uint8], expected: Array) -> None:
        """Into the next image, (H, W) grey; expected: (N, 2) px in the ideal image, NaN where unknown."""
        self._tracker.track(image, expected)

    def judge(self, accepted: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Take in which tracks the filter accepted, (N,); returns the landmarks that are dropped."""
        given_up = self._rejections.judge(self.ids, accepted)
        self._tracker.keep(~among(self.ids, given_up))
        return given_up
