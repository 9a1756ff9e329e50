"""For all tests: one thread for algebra and images, as in Mapweave's own processes."""

from __future__ import annotations

import cv2

# First: the package itself says how many threads BLAS gets, and numpy must not be there before.
import mapweave  # noqa: F401

cv2.setNumThreads(1)
