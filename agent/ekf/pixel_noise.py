"""How uncertain the slopes of an image are: nominal, or more after images have shown so for a while."""

import numpy as np

from mapweave.hybridmap.pose import Array

MOST_EXCESS = 16.0
"""Largest ratio of the variance to the nominal variance."""
ADAPTATION = 0.1
"""Share of an image's excess that is taken over at once, 0 ... 1: what all pixels are worse by than any
tracker knows (a floor that is not flat, shaking, blur) is learned within about 1 / ADAPTATION images."""


class PixelNoise:
    """Learns from image to image. What is learned holds from the next on: one image has one noise.

    Attributes:
        variances: (2,) of a measured slope, horizontal and vertical.
    """

    def __init__(self, pixel_sigma: float, focal: Array) -> None:
        """Begin with the nominal variances.

        Args:
            pixel_sigma: standard deviation of a tracked pixel, px.
            focal: (2,) px.
        """
        self.variances: Array = np.square(pixel_sigma / focal)
        self._nominal = self.variances
        self._excess = self._next = 1.0

    def begin_image(self) -> None:
        """What was learned from the images before holds now."""
        if self._next != self._excess:
            self._excess = self._next
            self.variances = self._nominal * self._excess

    def learn(self, excess: float) -> None:
        """Learn that the squared residuals of an image are `excess` times what its noise allows.

        In logarithms, so that images twice as good and twice as bad as nominal cancel.
        """
        learned = self._excess * min(excess, MOST_EXCESS) ** ADAPTATION
        self._next = min(max(learned, 1.0), MOST_EXCESS)
