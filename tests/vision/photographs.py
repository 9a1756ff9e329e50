"""Photographs, and how their points move when they are warped."""

import cv2
import numpy as np
import skimage.data


class Pictures:
    """Images whose motion is known."""

    @staticmethod
    def photograph(name: str) -> np.ndarray:
        """The middle of a picture, (240, 320) grey, as soft as a webcam's."""
        picture = getattr(skimage.data, name)()
        grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) if picture.ndim == 3 else picture
        scale = max(320 / grey.shape[1], 240 / grey.shape[0])
        if scale > 1:
            grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        top, left = (grey.shape[0] - 240) // 2, (grey.shape[1] - 320) // 2
        return cv2.GaussianBlur(grey[top : top + 240, left : left + 320], (0, 0), 0.8)

    @staticmethod
    def warped(image: np.ndarray, there_from_here: np.ndarray, noise: float = 0.0) -> np.ndarray:
        """The image after a homography of its pixels, with a camera's noise."""
        moved = cv2.warpPerspective(
            image, there_from_here, (320, 240), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
        )
        grain = np.random.default_rng(1).normal(0, noise, moved.shape) if noise else 0.0
        return np.clip(moved + grain, 0, 255).round().astype(np.uint8)

    @staticmethod
    def mapped(there_from_here: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Points after a homography, by hand."""
        out = np.column_stack([points, np.ones(len(points))]) @ there_from_here.T
        return out[:, :2] / out[:, 2:]
