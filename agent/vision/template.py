"""Patches of points as they were first seen, to which tracks are held: what keeps them from drifting.

Lucas-Kanade from frame to frame accumulates its errors, and a patch that grows while the robot approaches
biases all of them in the same direction. A match from the first image to the present one has an error that
does not grow with time (Shi and Tomasi 1994 monitor their tracks this way). The match is the inverse
compositional one of Baker and Matthews (2004), so that all derivatives are taken once, when a patch is cut.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapweave.agent.arrays import lengths
from mapweave.hybridmap.pose import Array

Floats = NDArray[np.float32]

FAINT = 0.5
"""Grey levels: a patch is taken to have at least this deviation, for a blank one cannot be normalised."""

RIDGE = 1e-3
"""Added to the normal equations, whose entries are about 1: a patch may not constrain its size."""


@dataclass(frozen=True, slots=True)
class TemplateCriteria:
    """How tracks are held to the patches in which they were first seen.

    Attributes:
        iterations: of Gauss and Newton. The guess is a track and good to a fraction of a pixel.
        agree_px: a match further than this from the track is another, similar feature.
        least_correlation: of the patch then and now, 1 for the same appearance in any light.
    """

    iterations: int = 2
    agree_px: float = 1.5
    least_correlation: float = 0.8


@dataclass(frozen=True, eq=False)
class Templates:
    """N patches in columns. Values: nothing in them is ever changed.

    Attributes:
        patches: (N, P) grey, of mean 0 and deviation 1 by the pixels' weights.
        slopes: (N, 3, P) weighted derivative of the patch by (shift right px, shift down px, growth), without
            what brightness and contrast could do as well.
        solve: (N, 3, 3) inverse of the normal equations of these.
        scales: (N,) how large the patch is now, 1 as it was cut.
    """

    patches: Floats
    slopes: Floats
    solve: Floats
    scales: Floats

    def __len__(self) -> int:
        """How many."""
        return len(self.patches)

    @property
    def columns(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Patches, slopes, solve and scales."""
        return self.patches, self.slopes, self.solve, self.scales

    def chosen(self, which: NDArray[np.bool_]) -> Templates:
        """Those that a (N,) mask selects."""
        if which.all():
            return self
        return Templates(*(column[which] for column in self.columns))

    def joined(self, added: Templates) -> Templates:
        """These and then others."""
        pairs = zip(self.columns, added.columns, strict=True)
        return Templates(*(np.concatenate(pair) for pair in pairs))


@dataclass(frozen=True, eq=False)
class Match:
    """Where N patches are in an image.

    Attributes:
        raw: (N, 2) px in the real image: found where they are held, else as they were given.
        held: (N,) whether a patch was found near its track and is unchanged.
        templates: the same patches with their present size; some cut again.
    """

    raw: Array
    held: NDArray[np.bool_]
    templates: Templates


HALF_PX = 7
"""A patch reaches this far from its point in each direction, px."""
SIGMA_PX = 4.0
"""Standard deviation of the Gaussian by which pixels far from the point count less, px: they are on another
surface, or on a slanted one, more often than those near it."""
MOST_SCALE = 1.7
"""Once a patch has grown or shrunk by more than this factor it is cut again from the present image."""


class TemplateMatcher:
    """Cuts patches and finds them again, moved, grown and lit differently."""

    def __init__(self, settings: TemplateCriteria | None = None) -> None:
        """Lay out the patch."""
        self._settings = settings or TemplateCriteria()
        self._side = side = np.arange(-HALF_PX, HALF_PX + 1, dtype=np.float32)
        # (2, P): a row for each coordinate, since rows are read much faster than columns.
        self._spots = np.stack(np.meshgrid(side, side)).reshape(2, -1)
        weights = np.exp(-(self._spots**2).sum(axis=0) / (2 * SIGMA_PX**2))
        self._weights: Floats = (weights / weights.sum()).astype(np.float32)

    def none(self) -> Templates:
        """No patches."""
        return self._cut(np.zeros((1, 1), np.float32), np.zeros((0, 2)))

    def cut(self, image: NDArray[np.uint8], raw: Array) -> Templates:
        """Cut the patches around (N, 2) px of a grey image (H, W)."""
        return self._cut(image.astype(np.float32), raw)

    def match(self, templates: Templates, image: NDArray[np.uint8], raw: Array) -> Match:
        """Find patches in an image.

        Args:
            templates: N.
            image: (H, W) grey.
            raw: (N, 2) px in the real image, where tracking from the last frame has found them.
        """
        if not len(templates):
            return Match(raw, np.zeros(0, np.bool_), templates)
        s = self._settings
        grey = image.astype(np.float32)
        at, scales = raw.astype(np.float32), templates.scales.copy()
        for _ in range(s.iterations):
            off = self._normalised(self._sampled(grey, at, scales))[0]
            off -= templates.patches
            step = np.einsum("nij,nj->ni", templates.solve, np.einsum("nip,np->ni", templates.slopes, off))
            # Inverse composition: the step moves the patch as it was cut, and is undone on the present one.
            scales = scales / np.minimum(np.maximum(1.0 + step[:, 2], 0.5), 2.0)
            at = at - scales[:, None] * step[:, :2]
        patches, _ = self._normalised(self._sampled(grey, at, scales))
        correlation = np.einsum("np,np,p->n", patches, templates.patches, self._weights)
        held = correlation >= s.least_correlation
        held &= lengths(at - raw) <= s.agree_px
        reach = HALF_PX * scales
        for along, size in zip(at.T, image.shape[::-1], strict=True):
            held &= (along >= reach) & (along <= np.float32(size) - 1 - reach)
        found = np.where(held[:, None], at.astype(np.float64), raw)
        scales = np.where(held, scales, templates.scales)
        now = Templates(templates.patches, templates.slopes, templates.solve, scales)
        return Match(found, held, self._renewed(now, held, grey, found))

    def _renewed(self, templates: Templates, held: NDArray[np.bool_], grey: Floats, raw: Array) -> Templates:
        """The patches, those that have changed their size too much cut again at their present positions."""
        most = MOST_SCALE
        strange = held & ((templates.scales > most) | (templates.scales < 1 / most))
        if not strange.any():
            return templates
        columns = []
        for old, new in zip(templates.columns, self._cut(grey, raw[strange]).columns, strict=True):
            column = old.copy()
            column[strange] = new
            columns.append(column)
        return Templates(*columns)

    def _cut(self, grey: Floats, raw: Array) -> Templates:
        at, ones = raw.astype(np.float32).reshape(-1, 2), np.ones(len(raw), np.float32)
        patches, spread = self._normalised(self._sampled(grey, at, ones))
        right, down = (
            (self._sampled(grey, at + half, ones) - self._sampled(grey, at - half, ones)) / spread
            for half in (np.array([0.5, 0.0], np.float32), np.array([0.0, 0.5], np.float32))
        )
        growth = right * self._spots[0] + down * self._spots[1]
        slopes = np.stack([right, down, growth], axis=1)
        # A change along 1 or along the patch itself is one of brightness or contrast, and no motion.
        slopes = slopes - np.einsum("nip,p->ni", slopes, self._weights)[..., None]
        alike = np.einsum("nip,np,p->ni", slopes, patches, self._weights)
        slopes = slopes - alike[..., None] * patches[:, None]
        weighted = slopes * self._weights
        normal = np.einsum("nip,njp->nij", weighted, slopes) + RIDGE * np.eye(3, dtype=np.float32)
        return Templates(patches, weighted, np.linalg.inv(normal).astype(np.float32), ones)

    def _sampled(self, grey: Floats, at: Floats, scales: Floats) -> Floats:
        """(N, P) grey levels of the patches around points, bilinear; beyond the border that of the border."""
        if not len(at):
            return np.zeros((0, self._spots.shape[1]), np.float32)
        # Columns and rows of a patch are the same for all of its rows and columns.
        along = at[:, :, None] + scales[:, None, None] * self._side
        x, y = np.empty((2, len(at), len(self._side), len(self._side)), np.float32)
        x[:], y[:] = along[:, 0, None], along[:, 1, :, None]
        x, y = x.reshape(len(at), -1), y.reshape(len(at), -1)
        found = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(found, dtype=np.float32)

    def _normalised(self, grey: Floats) -> tuple[Floats, Floats]:
        """(N, P) with mean 0 and deviation 1, in place, and (N, 1) the deviation it had."""
        grey -= np.einsum("np,p->n", grey, self._weights)[:, None]
        spread = np.sqrt(np.einsum("np,np,p->n", grey, grey, self._weights))[:, None]
        spread = np.maximum(spread, np.float32(FAINT))
        grey /= spread
        return grey, spread
