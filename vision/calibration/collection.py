"""Which frames of a moving camera or board become views, and what to show next."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapweave.hybridmap.errors import InvalidValue
from mapweave.vision.calibration.camera_calibration import CameraCalibration, calibrate_camera
from mapweave.vision.calibration.coverage import ViewCoverage, coverage_of, is_new
from mapweave.vision.calibration.views import BoardDetector, BoardView
from mapweave.vision.lens import LensModel

STILL = 0.005
"""Motion of the corners since the frame before, as a share of the image's width: more blurs them."""
FRESH_VIEWS = 5
"""After so many more views a set that covers everything is calibrated again."""


@dataclass(frozen=True, eq=False)
class Guidance:
    """What a person is shown.

    Attributes:
        coverage: of the views so far.
        hint: what to do next.
        view: the target in this frame, or None.
        taken: whether it was kept.
    """

    coverage: ViewCoverage
    hint: str
    view: BoardView | None
    taken: bool


@dataclass(eq=False)
class ViewCollection:
    """Collects views until they calibrate the camera well.

    Attributes:
        detector: of the target.
        model: of the lens; None if it is to be found.
        views: so far.
        done: the calibration, once it is good.
    """

    detector: BoardDetector
    model: LensModel | None = None
    views: list[BoardView] = field(default_factory=list)
    done: CameraCalibration | None = None
    _before: BoardView | None = None
    _calibrate_at: int = 0
    _problem: str = ""

    def see(self, image: NDArray[np.uint8], name: str = "") -> Guidance:
        """Look at the next frame, (H, W) grey."""
        view = self.detector.find(image, name)
        before, self._before = self._before, view
        still = view is not None and before is not None and motion(before, view) <= STILL * image.shape[1]
        taken = view is not None and still and is_new(view, self.views)
        if taken and view is not None:
            self.views.append(view)
            self._try()
        coverage = coverage_of(self.views)
        hint = coverage.missing[0] if coverage.missing else self._problem
        if self.done is not None:
            hint = "done"
        elif view is None and self.views:
            hint = f"the target is not seen; {hint}"
        elif view is not None and not still:
            hint = f"hold still; then {hint}" if self.views else "hold still"
        return Guidance(coverage, hint, view, taken)

    def _try(self) -> None:
        """Calibrate, once everything is covered."""
        if coverage_of(self.views).missing or len(self.views) < self._calibrate_at:
            return
        self._calibrate_at = len(self.views) + FRESH_VIEWS
        try:
            found = calibrate_camera(self.views, self.model)
        except InvalidValue as error:
            self._problem = str(error)
            return
        self._problem = found.problems[0] if found.problems else ""
        if not found.problems:
            self.done = found


def motion(before: BoardView, view: BoardView) -> float:
    """Mean motion of the corners that both views show, px; infinite if there are none."""
    _, first, second = np.intersect1d(before.ids, view.ids, assume_unique=True, return_indices=True)
    if not len(first):
        return float("inf")
    return float(np.linalg.norm(before.pixels[first] - view.pixels[second], axis=1).mean())
