"""Points that were lost while they should still be in view: a person walks past, and they come back."""

import numpy as np
from numpy.typing import NDArray

from mapweave.agent.vision.template import TemplateCriteria, TemplateMatcher, Templates
from mapweave.hybridmap.pose import Array

IMAGES = 60
"""A point that has not come back after so many images is given up."""


AFAR = TemplateCriteria(iterations=6, agree_px=4.0, least_correlation=0.9)
"""A patch is found again further from the expected place than that of a point that is tracked, and therefore
only with a higher correlation."""


class OccludedTracks:
    """Remembers the patches of lost points, and finds them again where they are expected.

    Attributes:
        ids: (N,) of the points that are hidden now.
    """

    def __init__(self) -> None:
        """Start with nothing hidden."""
        self.ids: NDArray[np.int64] = np.zeros(0, np.int64)
        self._matcher = TemplateMatcher(AFAR)
        self._templates = self._matcher.none()
        self._waited: NDArray[np.int64] = np.zeros(0, np.int64)

    def take(self, ids: NDArray[np.int64], templates: Templates) -> None:
        """Search for (N,) lost points and their patches from now on."""
        self.ids = np.concatenate([self.ids, ids])
        self._templates = self._templates.joined(templates)
        self._waited = np.concatenate([self._waited, np.zeros(len(ids), np.int64)])

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Give up those that a (N,) mask does not select."""
        if not mask.all():
            self.ids, self._waited = self.ids[mask], self._waited[mask]
            self._templates = self._templates.chosen(mask)

    def seek(self, image: NDArray[np.uint8], expected: Array) -> tuple[NDArray[np.int64], Array, Templates]:
        """Search for the points in an image; found points, and those searched for too long, are dropped.

        Args:
            image: (H, W) grey.
            expected: (N, 2) px in the real image, where they should be; NaN for those out of view.

        Returns:
            Of those found: ids (K,), where they are, (K, 2) px in the real image, and their patches.
        """
        inside: NDArray[np.bool_] = np.asarray(np.isfinite(expected).all(axis=1))
        match = self._matcher.match(self._templates, image, np.where(inside[:, None], expected, -1e3))
        redetected = inside & match.held
        out = self.ids[redetected], match.raw[redetected], match.templates.chosen(redetected)
        self._waited = self._waited + 1
        self.keep(~redetected & (self._waited < IMAGES))
        return out
